//! Bundle adjustment of two views: rotation, direction of the translation, and every point.
//!
//! Input: both camera models, where each point was seen (pixels of the pictures, distorted as they are), a first motion
//! `second_from_first` with unit translation. Output: the motion and points of least robust reprojection error, in
//! pixels, with one sigma of the motion.
//! - A point is `(x, y, rho)`: its undistorted normalised place in the first view and its inverse depth, so that
//!   `(x, y, 1) / rho` is the point and far ones (rho = 0) are no special case; unit of length: the baseline.
//! - Residuals: `pi_A(x, y, 1) - z_A` and `pi_B(R (x, y, 1) + rho t) - z_B`, each divided by what the place is uncertain
//!   by; Cauchy's loss on the four together. Parameters of the motion: left rotation, and two directions across t.
//! - Levenberg-Marquardt; the 3x3 blocks of the points are eliminated, which leaves 5x5
//!   ([`arrow`](crate::geometry::least_squares::arrow)).
//!
//! Cost: 1 us a point and iteration. Deliberately not here: more than two views (`reconstruction::adjust::bundle`), intrinsics.

use nalgebra::{Matrix2x3, Matrix3, SMatrix, UnitQuaternion, Vector2, Vector3, Vector5};

use crate::geometry::camera_model::CameraModel;
use crate::geometry::epipolar::skew;
use crate::geometry::frames::{First, Second};
use crate::geometry::least_squares::arrow::{ArrowEquations, Block};
use crate::geometry::least_squares::{LeastSquares, LmOptions, Loss, minimise};
use crate::geometry::triangulation::{intersect, nearest_match};
use crate::geometry::{Se3, essential::essential_of};

/// Trials at the most.
const MAX_ITERATIONS: usize = 50;
/// Falls off beyond two sigma, towards nothing: matches of what is no longer the same corner (an edge behind something nearer) are off by
/// many times the noise of the good ones and all to one side, and with a weight that only falls as 1 / r (Huber) they pull.
const LOSS: Loss = Loss::Cauchy(2.0);

/// A point as both pictures saw it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// Pixels of the first and of the second picture.
    pub a: Vector2<f64>,
    pub b: Vector2<f64>,
    /// One sigma of each, pixels.
    pub sigma_px: [f64; 2],
}

/// What came out.
#[derive(Debug, Clone, PartialEq)]
pub struct Adjusted {
    /// Translation of unit length.
    pub second_from_first: Se3<Second, First>,
    /// `(x, y, rho)` of each observation: see the module.
    pub points: Vec<Vector3<f64>>,
    /// Root mean square of the reprojection errors (both pictures, both coordinates) before and after, pixels.
    pub rms_before_px: f64,
    pub rms_after_px: f64,
    pub iterations: usize,
    /// One sigma of the rotation and of the translation's direction, radians, largest axis; for the noise that was left.
    pub sigma_rotation_rad: f64,
    pub sigma_direction_rad: f64,
}

struct Problem<'a> {
    cameras: [&'a CameraModel; 2],
    observations: &'a [Observation],
}

struct State {
    motion: Se3<Second, First>,
    points: Vec<Vector3<f64>>,
}

/// Residuals and derivatives of one observation: pixels over sigma.
struct Linearised {
    residual: [Vector2<f64>; 2],
    /// d residual / d point, first and second picture.
    point: [Matrix2x3<f64>; 2],
    /// d residual of the second picture / d motion.
    motion: SMatrix<f64, 2, 5>,
}

/// Two directions across a unit vector.
fn tangent(t: &Vector3<f64>) -> [Vector3<f64>; 2] {
    let a = t.cross(&Vector3::ith(t.iamin(), 1.0)).normalize();
    [a, t.cross(&a)]
}

impl Problem<'_> {
    /// Pixel errors of one observation; `None` where a point cannot be projected.
    fn errors(&self, state: &State, i: usize) -> Option<[Vector2<f64>; 2]> {
        let (point, seen) = (&state.points[i], &self.observations[i]);
        let moved = state.motion.rotation * point.xy().push(1.0) + state.motion.translation * point.z;
        Some([self.cameras[0].distort(&point.xy())? - seen.a, self.cameras[1].project(&moved)? - seen.b])
    }

    fn derivatives(&self, state: &State, i: usize) -> Option<Linearised> {
        let (point, seen) = (&state.points[i], &self.observations[i]);
        let (t, ray) = (&state.motion.translation, point.xy().push(1.0));
        let rotation = *state.motion.rotation.to_rotation_matrix().matrix();
        let turned = rotation * ray;
        let (pixel_a, by_place) = self.cameras[0].distort_jacobian(&point.xy())?;
        let (pixel_b, by_moved) = self.cameras[1].project_jacobian(&(turned + t * point.z))?;
        let [wa, wb] = seen.sigma_px.map(|s| 1.0 / s);
        let mut point_a = Matrix2x3::zeros();
        point_a.fixed_view_mut::<2, 2>(0, 0).copy_from(&(by_place * wa));
        let by_point = Matrix3::from_columns(&[rotation.column(0).into_owned(), rotation.column(1).into_owned(), *t]);
        let mut motion = SMatrix::<f64, 2, 5>::zeros();
        // exp(w) R m: the derivative by w is -[R m]x.
        motion.fixed_view_mut::<2, 3>(0, 0).copy_from(&(by_moved * -skew(&turned) * wb));
        for (k, across) in tangent(t).iter().enumerate() {
            motion.set_column(3 + k, &(by_moved * across * (point.z * wb)));
        }
        Some(Linearised {
            residual: [(pixel_a - seen.a) * wa, (pixel_b - seen.b) * wb],
            point: [point_a, by_moved * by_point * wb],
            motion,
        })
    }

    fn rms(&self, state: &State) -> f64 {
        let squared: f64 = (0..state.points.len())
            .map(|i| self.errors(state, i).map_or(f64::INFINITY, |e| e[0].norm_squared() + e[1].norm_squared()))
            .sum();
        (squared / (4 * state.points.len()) as f64).sqrt()
    }
}

impl LeastSquares for Problem<'_> {
    type State = State;
    type Normal = ArrowEquations<5, 3>;

    fn linearise(&self, state: &State) -> Self::Normal {
        let mut normal = ArrowEquations::<5, 3>::default();
        for i in 0..state.points.len() {
            let mut block = Block::<5, 3>::default();
            // Of finite cost: every point can be projected.
            if let Some(l) = self.derivatives(state, i) {
                let squared = l.residual[0].norm_squared() + l.residual[1].norm_squared();
                let (_, weight) = LOSS.evaluate(squared);
                normal.shared += l.motion.transpose() * l.motion * weight;
                normal.gradient += l.motion.transpose() * l.residual[1] * weight;
                block.own = (l.point[0].transpose() * l.point[0] + l.point[1].transpose() * l.point[1]) * weight;
                block.gradient =
                    (l.point[0].transpose() * l.residual[0] + l.point[1].transpose() * l.residual[1]) * weight;
                block.cross = l.motion.transpose() * l.point[1] * weight;
            }
            normal.blocks.push(block);
        }
        normal
    }

    /// Robust cost; infinite where a point cannot be projected.
    fn cost(&self, state: &State) -> f64 {
        let one = |i: usize| {
            let [a, b] = self.errors(state, i)?;
            let [sa, sb] = self.observations[i].sigma_px;
            Some(LOSS.evaluate(a.norm_squared() / (sa * sa) + b.norm_squared() / (sb * sb)).0)
        };
        (0..state.points.len()).map(|i| one(i).unwrap_or(f64::INFINITY)).sum()
    }

    fn step(&self, state: &State, (motion, points): &(Vector5<f64>, Vec<Vector3<f64>>)) -> State {
        let turn = UnitQuaternion::from_scaled_axis(motion.fixed_rows::<3>(0).into_owned());
        let mut rotation = turn * state.motion.rotation;
        rotation.renormalize_fast();
        let [a, b] = tangent(&state.motion.translation);
        let translation = (state.motion.translation + a * motion[3] + b * motion[4]).normalize();
        let points = state.points.iter().zip(points).map(|(p, d)| p + d).collect();
        State { motion: Se3::new(rotation, translation), points }
    }
}

/// The places in the first view and inverse depths that a motion gives to observations; far or inexact ones get the
/// inverse depth zero.
fn start_points(
    cameras: [&CameraModel; 2],
    start: &Se3<Second, First>,
    seen: &[Observation],
) -> Option<Vec<Vector3<f64>>> {
    let essential = essential_of(start);
    seen.iter()
        .map(|o| {
            let (x1, x2) = (cameras[0].undistort(&o.a)?, cameras[1].undistort(&o.b)?);
            let (y1, y2) = nearest_match(&essential, &x1, &x2).unwrap_or((x1, x2));
            let depth = intersect(start, &y1, &y2).map(|met| met.depth1).filter(|d| *d > 0.0 && d.is_finite());
            Some(y1.push(depth.map_or(0.0, |d| 1.0 / d)))
        })
        .collect()
}

/// Adjusts motion and points. `None` for fewer than five observations, or where they cannot be projected to begin with.
pub fn adjust(
    cameras: [&CameraModel; 2],
    start: &Se3<Second, First>,
    observations: &[Observation],
) -> Option<Adjusted> {
    if observations.len() < 5 {
        return None;
    }
    let translation = start.translation.try_normalize(1e-12)?;
    let motion = Se3::new(start.rotation, translation);
    let problem = Problem { cameras, observations };
    let start = State { motion, points: start_points(cameras, &motion, observations)? };
    let rms_before_px = problem.rms(&start);
    let options = LmOptions { max_iterations: MAX_ITERATIONS, relative_cost: 1e-9, ..LmOptions::default() };
    let (state, summary) = minimise(&problem, start, &options);
    if !summary.initial_cost.is_finite() {
        return None;
    }
    let (sigma_rotation_rad, sigma_direction_rad) = sigmas(&problem, &state, summary.final_cost);
    let finite = state.motion.is_finite() && state.points.iter().all(|p| p.iter().all(|v| v.is_finite()));
    finite.then(|| Adjusted {
        rms_after_px: problem.rms(&state),
        second_from_first: state.motion,
        points: state.points,
        rms_before_px,
        iterations: summary.iterations,
        sigma_rotation_rad,
        sigma_direction_rad,
    })
}

/// One sigma of rotation and direction: the inverse of the reduced equations, scaled by the noise that was left.
fn sigmas(problem: &Problem, state: &State, cost: f64) -> (f64, f64) {
    // Four residuals and three unknowns a point, five more unknowns.
    let freedom = (state.points.len() as f64 - 5.0).max(1.0);
    let inverse = problem.linearise(state).reduce(0.0).and_then(|reduced| reduced.information.try_inverse());
    let Some(covariance) = inverse.map(|m| m * (cost / freedom)) else { return (f64::NAN, f64::NAN) };
    let largest = |m: Matrix3<f64>| m.symmetric_eigenvalues().max().max(0.0).sqrt();
    let mut direction = Matrix3::zeros();
    direction.fixed_view_mut::<2, 2>(0, 0).copy_from(&covariance.fixed_view::<2, 2>(3, 3));
    (largest(covariance.fixed_view::<3, 3>(0, 0).into_owned()), largest(direction))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::random::Random;

    fn cameras() -> [CameraModel; 2] {
        let lens = [0.2, -0.4, 0.001, -0.002, 0.1];
        [
            CameraModel::new(640, 480, 520.0, 515.0, 318.0, 242.0, lens).expect("a camera"),
            CameraModel::new(800, 600, 700.0, 705.0, 402.0, 296.0, [0.0; 5]).expect("a camera"),
        ]
    }

    fn scene(seed: u64, noise_px: f64) -> (Se3<Second, First>, Vec<Vector3<f64>>, Vec<Observation>) {
        let mut random = Random::new(seed);
        let cameras = cameras();
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(0.05, -0.1, 0.03));
        let motion = Se3::new(rotation, Vector3::new(0.9, 0.1, -0.2).normalize());
        let (mut points, mut seen) = (vec![], vec![]);
        for k in 0..60 {
            // One in ten is very far away.
            let depth = if k % 10 == 0 { 1e6 } else { random.uniform(3.0, 9.0) };
            let place = Vector2::new(random.uniform(-0.4, 0.4), random.uniform(-0.3, 0.3));
            let point = place.push(1.0) * depth;
            let mut noise = || Vector2::new(random.normal(), random.normal()) * noise_px;
            let a = cameras[0].project(&point).expect("in view") + noise();
            let b = cameras[1].project(&motion.transform(&point)).expect("in view") + noise();
            points.push(point);
            seen.push(Observation { a, b, sigma_px: [1.0, 1.5] });
        }
        (motion, points, seen)
    }

    #[test]
    fn jacobians_agree_with_numeric_differences() {
        let (motion, points, seen) = scene(3, 0.5);
        let cameras = cameras();
        let problem = Problem { cameras: [&cameras[0], &cameras[1]], observations: &seen };
        let places: Vec<Vector3<f64>> = points.iter().map(|p| Vector3::new(p.x / p.z, p.y / p.z, 1.0 / p.z)).collect();
        let state = State { motion, points: places };
        let residual = |s: &State, i: usize| {
            let [a, b] = problem.errors(s, i).expect("in view");
            (a / seen[i].sigma_px[0], b / seen[i].sigma_px[1])
        };
        let h = 1e-6;
        for i in 0..5 {
            let l = problem.derivatives(&state, i).expect("in view");
            for k in 0..8 {
                let moved = |sign: f64| {
                    let mut motion = Vector5::zeros();
                    let mut points = vec![Vector3::zeros(); seen.len()];
                    if k < 5 {
                        motion[k] = sign * h;
                    } else {
                        points[i][k - 5] = sign * h;
                    }
                    residual(&problem.step(&state, &(motion, points)), i)
                };
                let (plus, minus) = (moved(1.0), moved(-1.0));
                let (da, db) = ((plus.0 - minus.0) / (2.0 * h), (plus.1 - minus.1) / (2.0 * h));
                let (ja, jb): (Vector2<f64>, Vector2<f64>) = if k < 5 {
                    (Vector2::zeros(), l.motion.column(k).into_owned())
                } else {
                    (l.point[0].column(k - 5).into_owned(), l.point[1].column(k - 5).into_owned())
                };
                assert!((da - ja).norm() < 1e-3 && (db - jb).norm() < 1e-3, "point {i} parameter {k}: {db} {jb}");
            }
        }
    }

    #[test]
    fn exact_observations_give_the_exact_motion_and_depths() {
        let (truth, points, seen) = scene(1, 0.0);
        let cameras = cameras();
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.01, 0.015, -0.01));
        let start = Se3::new(turn * truth.rotation, (truth.translation + Vector3::new(0.0, 0.05, 0.05)).normalize());
        let found = adjust([&cameras[0], &cameras[1]], &start, &seen).expect("an adjustment");
        assert!(found.second_from_first.rotation.angle_to(&truth.rotation) < 1e-8, "{found:?}");
        assert!(found.second_from_first.translation.angle(&truth.translation) < 1e-7);
        assert!(found.rms_after_px < 1e-6 && found.rms_before_px > 1.0);
        for (p, point) in found.points.iter().zip(&points) {
            assert!((p.z - 1.0 / point.z).abs() < 1e-7);
        }
    }

    #[test]
    fn the_sigmas_say_how_far_off_the_motion_is() {
        let cameras = cameras();
        let mut within = 0;
        for seed in 0..20 {
            let (truth, _, seen) = scene(seed, 1.0);
            let found = adjust([&cameras[0], &cameras[1]], &truth, &seen).expect("an adjustment");
            let rotation = found.second_from_first.rotation.angle_to(&truth.rotation);
            let direction = found.second_from_first.translation.angle(&truth.translation);
            assert!(found.sigma_rotation_rad > 1e-4 && found.sigma_direction_rad > 1e-3, "seed {seed}: {found:?}");
            within +=
                usize::from(rotation < 3.0 * found.sigma_rotation_rad && direction < 3.0 * found.sigma_direction_rad);
        }
        assert!(within >= 18, "{within} of 20 seeds (0 to 19) within three sigma");
    }

    #[test]
    fn too_few_points_or_a_motion_without_translation_give_none() {
        let (truth, _, seen) = scene(1, 0.0);
        let cameras = cameras();
        let pair = [&cameras[0], &cameras[1]];
        assert!(adjust(pair, &truth, &seen[..4]).is_none());
        assert!(adjust(pair, &Se3::identity(), &seen).is_none());
        let mut bad = seen.clone();
        bad[3].a.x = f64::NAN;
        assert!(adjust(pair, &truth, &bad).is_none());
    }
}
