//! Fundamental matrix: epipolar geometry of two views with unknown cameras.
//!
//! Matched points in pixels -> F with `x2ᵀ F x1 = 0` (eq. 4), rank two, unit Frobenius norm; inliers, statistics and
//! what the scene left open. Exactly one matrix, or `None`: too few, repeated, collinear or random matches, numbers that
//! are not finite.
//! - Seven-point: one to three matrices (Hartley & Zisserman, alg. 11.1, section 11.1.2).
//! - Robust: seven-point samples in the common loop with Sampson residuals; solutions that put sample points on opposite
//!   sides of the cameras are dropped (Chum, Werner, Matas, ICPR 2004). Local optimisation and the last refinement:
//!   Levenberg-Marquardt over the seven degrees of freedom, `F = U diag(1, s, 0) Vᵀ` (Bartoli & Sturm, PAMI 2004).
//! - A plane that most matches lie on misleads F. The homography of the inliers tells ([`Degeneracy`]); matches beside
//!   the plane then choose the epipole, two at a time, `F = [e]x H` (Chum, Werner, Matas: Two-view geometry estimation
//!   unaffected by a dominant plane, CVPR 2005).
//!
//! Cost: 1 us a sample; about 2 ms for 300 matches with 30 % outliers.

use nalgebra::{Matrix3, SMatrix, SVector, UnitQuaternion, Vector2, Vector3};

use super::displaced::{Displaced, any_cut_stands_out};
use super::epipolar::{sampson_cost, sampson_normal_equations, sampson_squared, skew};
use super::homography::{TwoWay, apply, estimate_homography};
use super::least_squares::{LeastSquares, LmOptions, Loss, NormalEquations, minimise};
use super::null_space::null_space;
use super::point_set::{Conditioning, all_finite, bounding_box, chance_near_line, spread};
use super::polynomial::real_roots;
use super::ransac::{self, Cost, Estimator, RansacOptions, Workspace};
use super::rotation::rotation_nearest;

/// The equation of a match in the entries of F, row by row.
#[inline]
fn equation(x1: &Vector2<f64>, x2: &Vector2<f64>) -> [f64; 9] {
    [x2.x * x1.x, x2.x * x1.y, x2.x, x2.y * x1.x, x2.y * x1.y, x2.y, x1.x, x1.y, 1.0]
}

/// The one to three F of seven matches, pushed to `solutions`; none when the sample leaves more of it open. The points
/// should be conditioned ([`Conditioning`]).
pub fn seven_point(x1: &[Vector2<f64>; 7], x2: &[Vector2<f64>; 7], solutions: &mut Vec<Matrix3<f64>>) {
    let rows: [[f64; 9]; 7] = std::array::from_fn(|i| equation(&x1[i], &x2[i]));
    let Some(basis) = null_space::<7, 2>(&rows) else { return };
    let [a, b] = basis.map(|v| Matrix3::from_row_slice(&v));
    // det(z A + B) = det B + z tr(adj(B) A) + z² tr(adj(A) B) + z³ det A
    let mixed = |m: &Matrix3<f64>, n: &Matrix3<f64>| {
        let (m0, m1, m2) = (m.column(0), m.column(1), m.column(2));
        m1.cross(&m2).dot(&n.column(0)) + m2.cross(&m0).dot(&n.column(1)) + m0.cross(&m1).dot(&n.column(2))
    };
    let cubic = [b.determinant(), mixed(&b, &a), mixed(&a, &b), a.determinant()];
    let roots = real_roots(&cubic);
    if roots.as_slice().is_empty() && cubic[3].abs() < 1e-12 {
        // A root at infinity.
        solutions.push(a);
    }
    for z in roots.as_slice() {
        let f = a * *z + b;
        solutions.push(f / f.norm());
    }
}

/// F of the raw points, of unit norm.
fn uncondition(f: &Matrix3<f64>, conditioning: &Conditioning) -> Option<Matrix3<f64>> {
    let f = conditioning.matrix2().transpose() * f * conditioning.matrix1();
    let norm = f.norm();
    (norm > 0.0 && norm.is_finite()).then(|| f / norm)
}

/// `U diag(1, s, 0) Vᵀ`: seven numbers, rank two whatever happens to them.
#[derive(Debug, Clone, Copy)]
struct RankTwo {
    u: Matrix3<f64>,
    v: Matrix3<f64>,
    s: f64,
}

impl RankTwo {
    /// Nearest to a matrix in the Frobenius norm; `None` when that has rank one or is not finite.
    fn nearest(f: &Matrix3<f64>) -> Option<Self> {
        if !f.iter().all(|v| v.is_finite()) {
            return None;
        }
        let svd = f.try_svd(true, true, f64::EPSILON, 200)?;
        let s = svd.singular_values[1] / svd.singular_values[0];
        // Written so that NaN fails.
        if !(s > 1e-9) {
            return None;
        }
        Some(Self { u: svd.u?, v: svd.v_t?.transpose(), s })
    }

    fn matrix(&self) -> Matrix3<f64> {
        self.u.column(0) * self.v.column(0).transpose() + self.u.column(1) * self.v.column(1).transpose() * self.s
    }

    /// dF by the seven parameters (turn of U, turn of V, s), column by column of F.
    fn directions(&self) -> SMatrix<f64, 9, 7> {
        let middle = Matrix3::from_diagonal(&Vector3::new(1.0, self.s, 0.0));
        let mut d = SMatrix::<f64, 9, 7>::zeros();
        for k in 0..3 {
            let turn = skew(&Vector3::ith(k, 1.0));
            d.column_mut(k).copy_from_slice((self.u * turn * middle * self.v.transpose()).as_slice());
            d.column_mut(3 + k).copy_from_slice((self.u * middle * turn.transpose() * self.v.transpose()).as_slice());
        }
        d.column_mut(6).copy_from_slice((self.u.column(1) * self.v.column(1).transpose()).as_slice());
        d
    }
}

/// Sampson distances as a least squares problem in F.
struct SampsonProblem<I> {
    matches: I,
    loss: Loss,
}

impl<I: Iterator<Item = (Vector2<f64>, Vector2<f64>)> + Clone> LeastSquares for SampsonProblem<I> {
    type State = RankTwo;
    type Normal = NormalEquations<7>;

    fn linearise(&self, f: &RankTwo) -> NormalEquations<7> {
        sampson_normal_equations(&f.matrix(), &f.directions(), self.matches.clone(), &self.loss)
    }

    fn cost(&self, f: &RankTwo) -> f64 {
        sampson_cost(&f.matrix(), self.matches.clone(), &self.loss)
    }

    fn step(&self, f: &RankTwo, delta: &SVector<f64, 7>) -> RankTwo {
        let turn = |k: usize| {
            let angle = delta.fixed_rows::<3>(k).into_owned();
            *UnitQuaternion::from_scaled_axis(angle).to_rotation_matrix().matrix()
        };
        RankTwo { u: f.u * turn(0), v: f.v * turn(3), s: f.s + delta[6] }
    }
}

/// The F of least Sampson distance near `start`. The points should be conditioned.
pub fn refine_fundamental(
    start: &Matrix3<f64>,
    matches: impl Iterator<Item = (Vector2<f64>, Vector2<f64>)> + Clone,
    loss: Loss,
    options: &LmOptions,
) -> Option<Matrix3<f64>> {
    let (f, _) = minimise(&SampsonProblem { matches, loss }, RankTwo::nearest(start)?, options);
    // U and V drift from orthogonal by rounding only; the rank stays two.
    let f = f.matrix();
    let norm = f.norm();
    (norm > 0.0 && norm.is_finite()).then(|| f / norm)
}

/// Fundamental matrices for the robust loop, on conditioned points.
struct Problem {
    x1: Vec<Vector2<f64>>,
    x2: Vec<Vector2<f64>>,
    /// Of the local refits.
    loss: Loss,
}

impl Problem {
    fn at(&self, i: usize) -> (Vector2<f64>, Vector2<f64>) {
        (self.x1[i], self.x2[i])
    }

    /// Are the matches on the same side of both cameras under F? `e2 x x2` and `F x1` point the same way for all.
    fn is_oriented(&self, f: &Matrix3<f64>, sample: &[usize]) -> bool {
        // e2 spans the left null space: the longest cross product of two columns.
        let (a, b, c) = (f.column(0), f.column(1), f.column(2));
        let e2 = [a.cross(&b), b.cross(&c), c.cross(&a)].into_iter().fold(Vector3::zeros(), |best: Vector3<f64>, e| {
            if e.norm_squared() > best.norm_squared() { e } else { best }
        });
        let side = |i: usize| e2.cross(&self.x2[i].push(1.0)).dot(&(f * self.x1[i].push(1.0))) > 0.0;
        let first = side(sample[0]);
        sample.iter().all(|&i| side(i) == first)
    }
}

impl Estimator for Problem {
    type Model = Matrix3<f64>;
    const SAMPLE_SIZE: usize = 7;

    fn data_count(&self) -> usize {
        self.x1.len()
    }

    fn solve_minimal(&self, sample: &[usize], models: &mut Vec<Self::Model>) {
        let at = |x: &[Vector2<f64>]| std::array::from_fn(|i| x[sample[i]]);
        seven_point(&at(&self.x1), &at(&self.x2), models);
        models.retain(|f| self.is_oriented(f, sample));
    }

    #[inline]
    fn residual_squared(&self, f: &Self::Model, i: usize) -> f64 {
        sampson_squared(f, &self.x1[i], &self.x2[i])
    }

    fn refit(&self, f: &Self::Model, inliers: &[usize]) -> Option<Self::Model> {
        if inliers.len() < 8 {
            return None;
        }
        let options = LmOptions { max_iterations: 6, relative_cost: 1e-4, ..LmOptions::default() };
        refine_fundamental(f, inliers.iter().map(|&i| self.at(i)), self.loss, &options)
    }

    fn chance(&self, threshold: f64) -> f64 {
        chance_near_line(&self.x1, threshold).max(chance_near_line(&self.x2, threshold))
    }
}

/// What the scene left open.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Degeneracy {
    /// Depth enough: no plane holds most of the inliers.
    None,
    /// A plane holds most inliers, the others fix the epipole: F is determined, by those few.
    DominantPlane { homography: Matrix3<f64>, on_plane: usize },
    /// One homography explains the inliers, as a plane does: every `[e]x H` fits them, F is one of many.
    Plane { homography: Matrix3<f64>, on_plane: usize },
    /// The same, and a webcam that only turned (or stood still) explains it too: perhaps there was no translation.
    PureRotation { homography: Matrix3<f64>, on_plane: usize },
}

/// A fundamental matrix and what it rests on.
#[derive(Debug, Clone, PartialEq)]
pub struct FundamentalEstimate {
    /// Rank two, unit Frobenius norm, for the raw points.
    pub fundamental: Matrix3<f64>,
    /// One a match.
    pub inliers: Vec<bool>,
    pub inlier_count: usize,
    /// Samples drawn.
    pub iterations: usize,
    /// MSAC score, `sum min(r² / T², 1)`.
    pub score: f64,
    pub log10_false_alarms: f64,
    pub degeneracy: Degeneracy,
}

/// The epipolar geometry that most matches agree with, or `None`. The threshold is a Sampson distance in the points'
/// unit.
pub fn estimate_fundamental(
    x1: &[Vector2<f64>],
    x2: &[Vector2<f64>],
    options: &RansacOptions,
) -> Option<FundamentalEstimate> {
    let conditioning = Conditioning::of(x1, x2)?;
    if !all_finite(x1) || !all_finite(x2) {
        return None;
    }
    let options = RansacOptions { threshold: options.threshold * conditioning.scale, ..*options };
    // Where the noise is not one, the exact matches count most in every fit.
    let least = Loss::Cauchy(options.least_share * options.threshold);
    let (loss, last_loss) =
        if options.least_share < 1.0 { (least, least) } else { (Loss::Squared, Loss::Cauchy(2.0 * options.threshold)) };
    let problem = Problem {
        x1: x1.iter().map(|x| conditioning.first(x)).collect(),
        x2: x2.iter().map(|x| conditioning.second(x)).collect(),
        loss,
    };
    let threshold = options.threshold;
    let mut workspace = Workspace::default();
    let found = ransac::estimate(&problem, &options, &mut workspace)?;
    let mut model = found.model;
    let plane = dominant_plane(&problem, &options, &workspace);
    // What fixes the epipole when a plane holds most matches: the matches beside it.
    let mut epipole = Epipole::Sure;
    if let Some(h) = &plane {
        epipole = plane_and_parallax(&problem, &options, h, &mut model);
        ransac::judge(&problem, &model, &options, &mut workspace)?;
    }
    let mut near = Vec::new();
    for _ in 0..2 {
        ransac::collect_inliers(&problem, &model, ransac::REFIT_WIDTH * threshold, &mut near);
        let matches = near.iter().map(|&i| problem.at(i));
        model = refine_fundamental(&model, matches, last_loss, &LmOptions::default())?;
    }
    let log10_false_alarms = ransac::judge(&problem, &model, &options, &mut workspace)?;
    let inliers = workspace.inliers();
    let across = |x: &[Vector2<f64>]| spread(inliers.iter().map(|&i| x[i])).1;
    if across(&problem.x1) < threshold || across(&problem.x2) < threshold {
        return None;
    }
    let degeneracy = match plane {
        None => Degeneracy::None,
        Some(h) => describe(&problem, &conditioning, &h, epipole, inliers, threshold),
    };
    Some(FundamentalEstimate {
        fundamental: uncondition(&model, &conditioning)?,
        inlier_count: inliers.len(),
        inliers: workspace.mask().to_vec(),
        iterations: found.iterations,
        score: ransac::score(&problem, &model, &Cost::msac(threshold), f64::INFINITY)?,
        log10_false_alarms,
        degeneracy,
    })
}

/// On the plane: a transfer error, which has two dimensions and the noise of both pictures, below twice the threshold.
#[inline]
fn on_plane(problem: &Problem, h: &TwoWay, i: usize, threshold: f64) -> bool {
    h.residual_squared(&problem.x1[i], &problem.x2[i]) <= 4.0 * threshold * threshold
}

/// The homography that explains more than half of the inliers, on conditioned points.
fn dominant_plane(problem: &Problem, options: &RansacOptions, workspace: &Workspace<Matrix3<f64>>) -> Option<TwoWay> {
    let inliers = workspace.inliers();
    let pick = |x: &[Vector2<f64>]| inliers.iter().map(|&i| x[i]).collect::<Vec<_>>();
    let options = RansacOptions {
        threshold: 2.0 * options.threshold,
        least_share: 1.0,
        search_iterations: usize::MAX,
        max_iterations: 300,
        min_inliers: inliers.len() / 2 + 1,
        ..*options
    };
    let found = estimate_homography(&pick(&problem.x1), &pick(&problem.x2), &options)?;
    TwoWay::new(&found.homography)
}

/// Epipolar geometries of a known plane, for the robust loop on the matches beside it.
struct Parallax<'a> {
    problem: &'a Problem,
    plane: &'a TwoWay,
    beside: Vec<usize>,
}

impl Parallax<'_> {
    /// How far a match is from where the plane puts it, in the second picture.
    fn displacement(&self, i: usize) -> f64 {
        let (x1, x2) = self.problem.at(i);
        (apply(&self.plane.forward, &x1) - x2).norm()
    }
}

impl Estimator for Parallax<'_> {
    type Model = Matrix3<f64>;
    const SAMPLE_SIZE: usize = 2;

    fn data_count(&self) -> usize {
        self.beside.len()
    }

    fn solve_minimal(&self, sample: &[usize], models: &mut Vec<Self::Model>) {
        // The line through x2 and H x1 holds the epipole.
        let line = |k: usize| {
            let (x1, x2) = self.problem.at(self.beside[sample[k]]);
            x2.push(1.0).cross(&(self.plane.forward * x1.push(1.0)))
        };
        let f = skew(&line(0).cross(&line(1))) * self.plane.forward;
        let norm = f.norm();
        if norm > 1e-12 && norm.is_finite() {
            models.push(f / norm);
        }
    }

    #[inline]
    fn residual_squared(&self, f: &Self::Model, i: usize) -> f64 {
        self.problem.residual_squared(f, self.beside[i])
    }

    fn refit(&self, _: &Self::Model, _: &[usize]) -> Option<Self::Model> {
        None
    }

    fn chance(&self, threshold: f64) -> f64 {
        self.problem.chance(threshold)
    }
}

/// Distances from the plane at which the matches beside it are asked, in thresholds.
const CUTS: [f64; 3] = [1.0, 3.0, 6.0];

/// Replaces F by one that shares the plane's homography when that explains more of the matches beside the plane: those
/// on it fit every such F, and say nothing. Returns whether the matches beside the plane fix the epipole.
fn plane_and_parallax(problem: &Problem, options: &RansacOptions, h: &TwoWay, model: &mut Matrix3<f64>) -> Epipole {
    let beside = (0..problem.data_count()).filter(|&i| !on_plane(problem, h, i, options.threshold)).collect();
    let parallax = Parallax { problem, plane: h, beside };
    let max_iterations = options.max_iterations.min(1000);
    let options = RansacOptions { max_iterations, search_iterations: usize::MAX, ..*options };
    let mut workspace = Workspace::default();
    if let Some(found) = ransac::estimate(&parallax, &options, &mut workspace) {
        if ransac::score(&parallax, model, &options.cost(), found.score).is_none() {
            *model = found.model;
        }
    } else if ransac::judge(&parallax, model, &options, &mut workspace).is_none() {
        return Epipole::Open;
    }
    let displaced = (0..parallax.beside.len()).map(|k| Displaced {
        residual_squared: parallax.residual_squared(model, k),
        distance: parallax.displacement(parallax.beside[k]),
    });
    let stranger = problem.chance(options.threshold);
    let sure = any_cut_stands_out(displaced, CUTS.map(|cut| cut * options.threshold), stranger, &options);
    if sure { Epipole::Sure } else { Epipole::UnlessTurned }
}

/// What the matches beside a plane say of the epipole.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Epipole {
    Open,
    /// Fixed, unless the camera only turned and these matches are placed badly.
    UnlessTurned,
    Sure,
}

/// Names the degeneracy of a scene whose plane `h` holds most of the inliers.
fn describe(
    problem: &Problem,
    conditioning: &Conditioning,
    h: &TwoWay,
    epipole: Epipole,
    inliers: &[usize],
    threshold: f64,
) -> Degeneracy {
    let on_plane = inliers.iter().filter(|&&i| on_plane(problem, h, i, threshold)).count();
    let raw =
        conditioning.matrix2().try_inverse().unwrap_or_else(Matrix3::identity) * h.forward * conditioning.matrix1();
    let homography = raw / raw.norm();
    let raw_matches: Vec<_> = inliers
        .iter()
        .map(|&i| {
            let (x1, x2) = problem.at(i);
            (x1 / conditioning.scale + conditioning.centroid1, x2 / conditioning.scale + conditioning.centroid2)
        })
        .collect();
    let told = |fixed: bool| match fixed {
        true if 2 * on_plane > inliers.len() => Degeneracy::DominantPlane { homography, on_plane },
        true => Degeneracy::None,
        false => Degeneracy::Plane { homography, on_plane },
    };
    match epipole {
        Epipole::Sure => told(true),
        _ if explained_by_rotation(&raw_matches, &homography, threshold / conditioning.scale) => {
            Degeneracy::PureRotation { homography, on_plane }
        }
        Epipole::UnlessTurned => told(true),
        Epipole::Open => told(false),
    }
}

/// Could a camera that only turned have made this homography (of the raw points)? Tried with the focal lengths of
/// webcams (field of view 40 to 90 degrees across the points) and the principal point in the middle of both pictures'
/// points, to 2 % of their extent. A hint: without K a shift over a frontal plane and a small turn look alike.
fn explained_by_rotation(matches: &[(Vector2<f64>, Vector2<f64>)], h: &Matrix3<f64>, threshold: f64) -> bool {
    let all: Vec<Vector2<f64>> = matches.iter().flat_map(|(x1, x2)| [*x1, *x2]).collect();
    let Some((low, high)) = bounding_box(&all) else { return false };
    let (centre, extent) = ((low + high) * 0.5, (high - low).norm());
    (0..34).any(|k| {
        let focal = extent * 0.5 * 1.03f64.powi(k);
        let calibration = Matrix3::new(focal, 0.0, centre.x, 0.0, focal, centre.y, 0.0, 0.0, 1.0);
        let Some(inverse) = calibration.try_inverse() else { return false };
        let Some(rotation) = rotation_nearest(&(inverse * h * calibration)) else { return false };
        let angle = (0.5 * (rotation.trace() - 1.0)).clamp(-1.0, 1.0).acos();
        let turn = calibration * rotation * inverse;
        let tolerance = 2.0 * threshold + 0.02 * extent * angle;
        let near = |m: &&(Vector2<f64>, Vector2<f64>)| (apply(&turn, &m.0) - m.1).norm() <= tolerance;
        matches.iter().filter(near).count() * 10 >= matches.len() * 9
    })
}

#[cfg(test)]
mod tests;
