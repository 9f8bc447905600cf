//! Homography: how the points of a plane (or of any scene, under a rotation alone) move between two views.
//!
//! Matched points of any unit (pixels or normalised) -> H with `x2 ~ H x1`, unit Frobenius norm, `det H > 0`; inliers,
//! statistics. `None` for too few, repeated, collinear or random matches and numbers that are not finite.
//! - Four-point and least squares direct linear transform on conditioned points (Hartley & Zisserman, alg. 4.2).
//! - Robust: four-point samples in the common loop; samples with three collinear points, or whose points turn over
//!   between the pictures, are rejected. Residual: symmetric transfer error `(d(x2, H x1)² + d(x1, H⁻¹ x2)²) / 2`, so
//!   that a threshold is a distance in one picture. Refined by Levenberg-Marquardt on the same error.
//!
//! Cost: 0.6 us a sample; about 0.3 ms for 300 matches with 30 % outliers. Motions of the plane: see
//! [`super::homography_decomposition`].

use nalgebra::{Matrix3, SVector, Vector2, Vector3};

use super::least_squares::{LeastSquares, LmOptions, Loss, NormalEquations, minimise};
use super::null_space::{RowTriangle, null_space};
use super::point_set::{Conditioning, all_finite, chance_near_point, spread};
use super::ransac::{self, Estimator, RansacOptions, Workspace};

/// A homography and its inverse: both directions are needed for every residual.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TwoWay {
    pub forward: Matrix3<f64>,
    pub backward: Matrix3<f64>,
}

impl TwoWay {
    /// Scaled to unit norm and positive determinant; `None` when singular or not finite.
    pub fn new(h: &Matrix3<f64>) -> Option<Self> {
        let norm = h.norm();
        if !(norm > 0.0 && norm.is_finite()) {
            return None;
        }
        let h = h / norm;
        let determinant = h.determinant();
        // A flatter map than this squeezes the picture onto a line.
        if determinant.abs() < 1e-12 {
            return None;
        }
        let forward = h * determinant.signum();
        // H⁻¹ up to scale is the adjugate: no division.
        let (a, b, c) = (forward.row(0).transpose(), forward.row(1).transpose(), forward.row(2).transpose());
        let backward = Matrix3::from_columns(&[b.cross(&c), c.cross(&a), a.cross(&b)]);
        Some(Self { forward, backward: backward / backward.norm() })
    }

    /// Squared transfer distances: (in the first picture, in the second).
    #[inline]
    pub fn transfer_squared(&self, x1: &Vector2<f64>, x2: &Vector2<f64>) -> (f64, f64) {
        ((apply(&self.backward, x2) - x1).norm_squared(), (apply(&self.forward, x1) - x2).norm_squared())
    }

    /// Mean of the two squared transfer distances.
    #[inline]
    pub fn residual_squared(&self, x1: &Vector2<f64>, x2: &Vector2<f64>) -> f64 {
        let (a, b) = self.transfer_squared(x1, x2);
        0.5 * (a + b)
    }
}

/// Image of a point; not finite when it goes to infinity.
#[inline]
pub fn apply(h: &Matrix3<f64>, x: &Vector2<f64>) -> Vector2<f64> {
    let w = 1.0 / (h.m31 * x.x + h.m32 * x.y + h.m33);
    Vector2::new((h.m11 * x.x + h.m12 * x.y + h.m13) * w, (h.m21 * x.x + h.m22 * x.y + h.m23) * w)
}

/// The two equations of a match in the entries of H, row by row.
#[inline]
fn equations(x1: &Vector2<f64>, x2: &Vector2<f64>) -> [[f64; 9]; 2] {
    let (x, y, u, v) = (x1.x, x1.y, x2.x, x2.y);
    [[x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y, -u], [0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y, -v]]
}

/// H of four matches, `None` when three of them are collinear in a picture or they turn over. The points should be
/// conditioned ([`Conditioning`]).
pub fn four_point(x1: &[Vector2<f64>; 4], x2: &[Vector2<f64>; 4]) -> Option<Matrix3<f64>> {
    let area = |p: &[Vector2<f64>; 4], [i, j, k]: [usize; 3]| (p[j] - p[i]).perp(&(p[k] - p[i]));
    let size = |p: &[Vector2<f64>; 4]| (p[1] - p[0]).norm_squared().max((p[2] - p[0]).norm_squared());
    let (size1, size2) = (size(x1), size(x2));
    let mut kept = 0;
    for triple in [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]] {
        let (a, b) = (area(x1, triple), area(x2, triple));
        // Written so that NaN fails.
        if !(a.abs() > 1e-6 * size1 && b.abs() > 1e-6 * size2) {
            return None;
        }
        kept += usize::from(a * b > 0.0);
    }
    if kept % 4 != 0 {
        return None;
    }
    let mut rows = [[0.0; 9]; 8];
    for i in 0..4 {
        [rows[2 * i], rows[2 * i + 1]] = equations(&x1[i], &x2[i]);
    }
    let [h] = null_space::<8, 1>(&rows)?;
    Some(Matrix3::from_row_slice(&h))
}

/// Least squares H of four or more matches; `None` when they do not fix one.
pub fn dlt(x1: &[Vector2<f64>], x2: &[Vector2<f64>]) -> Option<Matrix3<f64>> {
    let conditioning = Conditioning::of(x1, x2)?;
    if x1.len() < 4 {
        return None;
    }
    let mut rows = RowTriangle::<9>::default();
    for (a, b) in x1.iter().zip(x2) {
        equations(&conditioning.first(a), &conditioning.second(b)).into_iter().for_each(|row| rows.push(row));
    }
    let solution = rows.solve()?;
    if solution.next < 1e-9 * solution.largest {
        return None;
    }
    let h = Matrix3::from_row_slice(&solution.vector);
    TwoWay::new(&(conditioning.matrix2().try_inverse()? * h * conditioning.matrix1())).map(|h| h.forward)
}

/// Symmetric transfer errors as a least squares problem in the nine entries of H; its scale is held by the damping and
/// by [`TwoWay::new`].
struct TransferProblem<I> {
    matches: I,
    loss: Loss,
}

/// Projected difference `p/p3 - x` and its derivative by p, as two rows.
#[inline]
fn difference(p: &Vector3<f64>, x: &Vector2<f64>) -> (Vector2<f64>, [Vector3<f64>; 2]) {
    let w = 1.0 / p.z;
    let q = Vector2::new(p.x * w, p.y * w);
    (q - x, [Vector3::new(w, 0.0, -q.x * w), Vector3::new(0.0, w, -q.y * w)])
}

impl<I: Iterator<Item = (Vector2<f64>, Vector2<f64>)> + Clone> LeastSquares for TransferProblem<I> {
    type State = TwoWay;
    type Normal = NormalEquations<9>;

    fn linearise(&self, h: &TwoWay) -> NormalEquations<9> {
        let mut normal = NormalEquations::default();
        // The true inverse: the residual's derivative needs its scale.
        let Some(inverse) = h.forward.try_inverse() else { return normal };
        let half = std::f64::consts::FRAC_1_SQRT_2;
        for (x1, x2) in self.matches.clone() {
            let (p1, p2) = (x1.push(1.0), x2.push(1.0));
            let there = difference(&(h.forward * p1), &x2);
            let q = inverse * p2;
            let back = difference(&q, &x1);
            let (_, weight) = self.loss.evaluate(0.5 * (there.0.norm_squared() + back.0.norm_squared()));
            for k in 0..2 {
                // d(H x1) = dH x1; d(H⁻¹ x2) = -H⁻¹ dH H⁻¹ x2
                let left = inverse.tr_mul(&back.1[k]);
                let mut there_row = SVector::<f64, 9>::zeros();
                let mut back_row = SVector::<f64, 9>::zeros();
                for j in 0..3 {
                    for i in 0..3 {
                        there_row[3 * j + i] = half * there.1[k][i] * p1[j];
                        back_row[3 * j + i] = -half * left[i] * q[j];
                    }
                }
                normal.add(&there_row, half * there.0[k], weight);
                normal.add(&back_row, half * back.0[k], weight);
            }
        }
        normal
    }

    fn cost(&self, h: &TwoWay) -> f64 {
        let sum: f64 = self.matches.clone().map(|(x1, x2)| self.loss.evaluate(h.residual_squared(&x1, &x2)).0).sum();
        if sum.is_nan() { f64::INFINITY } else { sum }
    }

    fn step(&self, h: &TwoWay, delta: &SVector<f64, 9>) -> TwoWay {
        let moved = h.forward + Matrix3::from_column_slice(delta.as_slice());
        TwoWay::new(&moved).unwrap_or(TwoWay { forward: moved, backward: Matrix3::from_element(f64::NAN) })
    }
}

/// The homography of least symmetric transfer error near `start`. The points should be conditioned or normalised.
pub fn refine_homography(
    start: &TwoWay,
    matches: impl Iterator<Item = (Vector2<f64>, Vector2<f64>)> + Clone,
    loss: Loss,
    options: &LmOptions,
) -> TwoWay {
    minimise(&TransferProblem { matches, loss }, *start, options).0
}

/// Homographies for the robust loop, on conditioned points.
struct Problem {
    x1: Vec<Vector2<f64>>,
    x2: Vec<Vector2<f64>>,
}

impl Estimator for Problem {
    type Model = TwoWay;
    const SAMPLE_SIZE: usize = 4;

    fn data_count(&self) -> usize {
        self.x1.len()
    }

    fn solve_minimal(&self, sample: &[usize], models: &mut Vec<TwoWay>) {
        let at = |x: &[Vector2<f64>]| std::array::from_fn(|i| x[sample[i]]);
        models.extend(four_point(&at(&self.x1), &at(&self.x2)).and_then(|h| TwoWay::new(&h)));
    }

    #[inline]
    fn residual_squared(&self, h: &TwoWay, i: usize) -> f64 {
        h.residual_squared(&self.x1[i], &self.x2[i])
    }

    fn refit(&self, h: &TwoWay, inliers: &[usize]) -> Option<TwoWay> {
        let options = LmOptions { max_iterations: 5, relative_cost: 1e-4, ..LmOptions::default() };
        Some(refine_homography(h, inliers.iter().map(|&i| (self.x1[i], self.x2[i])), Loss::Squared, &options))
    }

    fn chance(&self, threshold: f64) -> f64 {
        chance_near_point(&self.x1, threshold).max(chance_near_point(&self.x2, threshold))
    }
}

/// A homography and what it rests on.
#[derive(Debug, Clone, PartialEq)]
pub struct HomographyEstimate {
    /// `x2 ~ H x1`, in the unit of the input.
    pub homography: Matrix3<f64>,
    /// One a match.
    pub inliers: Vec<bool>,
    pub inlier_count: usize,
    /// Samples drawn.
    pub iterations: usize,
    /// MSAC score, `sum min(r² / T², 1)`.
    pub score: f64,
    pub log10_false_alarms: f64,
}

/// The homography that most matches agree with, or `None`. The threshold is in the unit of the points.
pub fn estimate_homography(
    x1: &[Vector2<f64>],
    x2: &[Vector2<f64>],
    options: &RansacOptions,
) -> Option<HomographyEstimate> {
    let conditioning = Conditioning::of(x1, x2)?;
    if !all_finite(x1) || !all_finite(x2) {
        return None;
    }
    let problem = Problem {
        x1: x1.iter().map(|x| conditioning.first(x)).collect(),
        x2: x2.iter().map(|x| conditioning.second(x)).collect(),
    };
    let options = RansacOptions { threshold: options.threshold * conditioning.scale, ..*options };
    let mut workspace = Workspace::default();
    let found = ransac::estimate(&problem, &options, &mut workspace)?;
    let mut near = Vec::new();
    ransac::collect_inliers(&problem, &found.model, ransac::REFIT_WIDTH * options.threshold, &mut near);
    let matches = near.iter().map(|&i| (problem.x1[i], problem.x2[i]));
    let model = refine_homography(&found.model, matches, Loss::Cauchy(2.0 * options.threshold), &LmOptions::default());
    let log10_false_alarms = ransac::judge(&problem, &model, &options, &mut workspace)?;
    // Points of a line fix no homography, however many there are.
    let inliers = workspace.inliers();
    let across = |x: &[Vector2<f64>]| spread(inliers.iter().map(|&i| x[i])).1;
    if across(&problem.x1) < options.threshold || across(&problem.x2) < options.threshold {
        return None;
    }
    let h = conditioning.matrix2().try_inverse()? * model.forward * conditioning.matrix1();
    Some(HomographyEstimate {
        homography: h / h.norm(),
        inlier_count: inliers.len(),
        inliers: workspace.mask().to_vec(),
        iterations: found.iterations,
        score: ransac::score(&problem, &model, &ransac::Cost::msac(options.threshold), f64::INFINITY)?,
        log10_false_alarms,
    })
}

#[cfg(test)]
mod tests;
