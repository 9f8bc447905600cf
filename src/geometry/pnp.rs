//! Camera pose from points of a map and where they are seen.
//!
//! Points (frame `From`, map unit) and undistorted normalised image points -> `to_from_from` (`To` = the camera), inliers,
//! statistics; `None` when no pose stands out: too few, collinear or random matches, numbers that are not finite.
//! Three-point samples ([`super::p3p`]) in the common loop with reprojection errors; local optimisation and the last
//! refinement by Levenberg-Marquardt over the six degrees of freedom.
//!
//! Thresholds are in normalised units: pixels divided by the focal length. Cost: about 0.3 ms for 300 points with 30 %
//! outliers.

use nalgebra::{Matrix3, UnitQuaternion, Vector2, Vector3, Vector6};

use super::Se3;
use super::least_squares::{LeastSquares, LmOptions, Loss, NormalEquations, minimise};
use super::p3p::{Pose, p3p};
use super::point_set::{all_finite, chance_near_point, spread};
use super::ransac::{self, Estimator, RansacOptions, Workspace};
use super::rotation::quaternion;

/// Reprojection error of a camera point: difference in normalised coordinates, `None` behind the camera.
#[inline]
fn difference(point: &Vector3<f64>, seen: &Vector2<f64>) -> Option<Vector2<f64>> {
    (point.z > 0.0).then(|| Vector2::new(point.x / point.z - seen.x, point.y / point.z - seen.y))
}

/// Reprojection errors as a least squares problem in a pose.
struct PoseProblem<I> {
    /// (point, where it is seen)
    matches: I,
    loss: Loss,
}

/// Rows of d(x/z, y/z) by the left perturbation `[w, v]` of a camera point: `dp = w x p + v`.
#[inline]
fn rows(p: &Vector3<f64>) -> [Vector6<f64>; 2] {
    let iz = 1.0 / p.z;
    let (x, y) = (p.x * iz, p.y * iz);
    [Vector6::new(-x * y, 1.0 + x * x, -y, iz, 0.0, -x * iz), Vector6::new(-1.0 - y * y, x * y, x, 0.0, iz, -y * iz)]
}

impl<I: Iterator<Item = (Vector3<f64>, Vector2<f64>)> + Clone> LeastSquares for PoseProblem<I> {
    type State = Pose;
    type Normal = NormalEquations<6>;

    fn linearise(&self, pose: &Pose) -> NormalEquations<6> {
        let mut normal = NormalEquations::default();
        for (point, seen) in self.matches.clone() {
            let p = pose.rotation * point + pose.translation;
            // Never from a state that costs anything finite.
            let Some(r) = difference(&p, &seen) else { return normal };
            let (_, weight) = self.loss.evaluate(r.norm_squared());
            let [a, b] = rows(&p);
            normal.add(&a, r.x, weight);
            normal.add(&b, r.y, weight);
        }
        normal
    }

    fn cost(&self, pose: &Pose) -> f64 {
        let mut sum = 0.0;
        for (point, seen) in self.matches.clone() {
            // A step that puts a point behind the camera is no step.
            let Some(r) = difference(&(pose.rotation * point + pose.translation), &seen) else {
                return f64::INFINITY;
            };
            sum += self.loss.evaluate(r.norm_squared()).0;
        }
        sum
    }

    fn step(&self, pose: &Pose, delta: &Vector6<f64>) -> Pose {
        let turn = UnitQuaternion::from_scaled_axis(delta.fixed_rows::<3>(0).into_owned());
        let turn = turn.to_rotation_matrix();
        Pose { rotation: turn * pose.rotation, translation: turn * pose.translation + delta.fixed_rows::<3>(3) }
    }
}

fn motion_of<To, From>(pose: &Pose) -> Se3<To, From> {
    Se3::new(quaternion(&pose.rotation), pose.translation)
}

/// Poses for the robust loop.
struct Problem<'a> {
    points: &'a [Vector3<f64>],
    seen: &'a [Vector2<f64>],
}

impl Problem<'_> {
    fn at(&self, i: usize) -> (Vector3<f64>, Vector2<f64>) {
        (self.points[i], self.seen[i])
    }

    fn refined(&self, start: &Pose, inliers: &[usize], loss: Loss, options: &LmOptions) -> Option<Pose> {
        let matches = inliers.iter().map(|&i| self.at(i));
        let (pose, summary) = minimise(&PoseProblem { matches, loss }, *start, options);
        summary.final_cost.is_finite().then_some(pose)
    }
}

impl Estimator for Problem<'_> {
    type Model = Pose;
    const SAMPLE_SIZE: usize = 3;

    fn data_count(&self) -> usize {
        self.points.len()
    }

    fn solve_minimal(&self, sample: &[usize], models: &mut Vec<Pose>) {
        p3p(&std::array::from_fn(|i| self.points[sample[i]]), &std::array::from_fn(|i| self.seen[sample[i]]), models);
    }

    #[inline]
    fn residual_squared(&self, pose: &Pose, i: usize) -> f64 {
        let p = pose.rotation * self.points[i] + pose.translation;
        difference(&p, &self.seen[i]).map_or(f64::INFINITY, |r| r.norm_squared())
    }

    fn refit(&self, pose: &Pose, inliers: &[usize]) -> Option<Pose> {
        let options = LmOptions { max_iterations: 5, relative_cost: 1e-4, ..LmOptions::default() };
        self.refined(pose, inliers, Loss::Squared, &options)
    }

    fn chance(&self, threshold: f64) -> f64 {
        chance_near_point(self.seen, threshold)
    }
}

/// A pose and what it rests on.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseEstimate<To, From> {
    pub to_from_from: Se3<To, From>,
    /// One a match.
    pub inliers: Vec<bool>,
    pub inlier_count: usize,
    /// Samples drawn.
    pub iterations: usize,
    /// MSAC score, `sum min(r² / T², 1)`.
    pub score: f64,
    pub log10_false_alarms: f64,
}

/// The pose that most matches agree with, or `None`. `To` is the camera's frame, `From` the points'.
pub fn estimate_pose<To, From>(
    points: &[Vector3<f64>],
    seen: &[Vector2<f64>],
    options: &RansacOptions,
) -> Option<PoseEstimate<To, From>> {
    let finite = points.iter().all(|p| p.iter().all(|v| v.is_finite()));
    if points.len() != seen.len() || !finite || !all_finite(seen) {
        return None;
    }
    let problem = Problem { points, seen };
    let mut workspace = Workspace::default();
    let found = ransac::estimate(&problem, options, &mut workspace)?;
    let mut near = Vec::new();
    ransac::collect_inliers(&problem, &found.model, ransac::REFIT_WIDTH * options.threshold, &mut near);
    let pose = problem.refined(&found.model, &near, Loss::Cauchy(2.0 * options.threshold), &LmOptions::default())?;
    let log10_false_alarms = ransac::judge(&problem, &pose, options, &mut workspace)?;
    // Points of one line: the turn about it is open.
    if spread(workspace.inliers().iter().map(|&i| seen[i])).1 < options.threshold {
        return None;
    }
    let to_from_from = motion_of(&Pose { rotation: orthonormal(&pose.rotation), ..pose });
    Some(PoseEstimate {
        to_from_from,
        inlier_count: workspace.inliers().len(),
        inliers: workspace.mask().to_vec(),
        iterations: found.iterations,
        score: ransac::score(&problem, &pose, &ransac::Cost::msac(options.threshold), f64::INFINITY)?,
        log10_false_alarms,
    })
}

/// Takes away the little that a solved rotation matrix is off.
fn orthonormal(r: &Matrix3<f64>) -> Matrix3<f64> {
    super::rotation::rotation_nearest(r).unwrap_or(*r)
}

#[cfg(test)]
mod tests {
    use super::super::random::Random;
    use super::super::synthetic::{FOCAL, random_rotation};
    use super::*;

    #[derive(Debug, Clone, Copy, PartialEq)]
    struct Camera;
    #[derive(Debug, Clone, Copy, PartialEq)]
    struct World;

    struct Case {
        pose: Se3<Camera, World>,
        points: Vec<Vector3<f64>>,
        seen: Vec<Vector2<f64>>,
        truth: Vec<bool>,
    }

    fn case(random: &mut Random, count: usize, noise_px: f64, outliers: f64) -> Case {
        let t = Vector3::new(random.normal(), random.normal(), random.normal());
        let pose = Se3::<Camera, World>::new(random_rotation(random, 3.0), t);
        let mut case = Case { pose, points: vec![], seen: vec![], truth: vec![] };
        for i in 0..count {
            let ray = Vector2::new(random.uniform(-320.0, 320.0), random.uniform(-240.0, 240.0)) / FOCAL;
            case.points.push(pose.inverse().transform(&(ray.push(1.0) * random.uniform(1.0, 8.0))));
            let good = i >= (count as f64 * outliers) as usize;
            case.truth.push(good);
            case.seen.push(if good {
                ray + Vector2::new(random.normal(), random.normal()) * (noise_px / FOCAL)
            } else {
                Vector2::new(random.uniform(-320.0, 320.0), random.uniform(-240.0, 240.0)) / FOCAL
            });
        }
        case
    }

    fn pose_of<To, From>(motion: &Se3<To, From>) -> Pose {
        Pose { rotation: *motion.rotation.to_rotation_matrix().matrix(), translation: motion.translation }
    }

    #[test]
    fn rows_equal_numeric_differences() {
        for seed in 0..30 {
            let mut random = Random::new(seed);
            let c = case(&mut random, 1, 0.0, 0.0);
            let problem = PoseProblem { matches: std::iter::empty(), loss: Loss::Squared };
            let pose = pose_of(&c.pose);
            let project = |pose: &Pose| {
                let p = pose.rotation * c.points[0] + pose.translation;
                p.xy() / p.z
            };
            let analytic = rows(&(pose.rotation * c.points[0] + pose.translation));
            for k in 0..6 {
                let h = 1e-6;
                let mut delta = Vector6::zeros();
                delta[k] = h;
                let numeric =
                    (project(&problem.step(&pose, &delta)) - project(&problem.step(&pose, &-delta))) / (2.0 * h);
                for row in 0..2 {
                    assert!((numeric[row] - analytic[row][k]).abs() < 1e-8, "seed {seed}, parameter {k}");
                }
            }
        }
    }

    #[test]
    fn exact_matches_give_the_exact_pose() {
        for seed in 0..20 {
            let c = case(&mut Random::new(seed), 50, 0.0, 0.0);
            let found = estimate_pose::<Camera, World>(&c.points, &c.seen, &RansacOptions::new(1e-3)).expect("a pose");
            let error = found.to_from_from.rotation.angle_to(&c.pose.rotation)
                + (found.to_from_from.translation - c.pose.translation).norm();
            // acos loses half of the digits of a small angle
            assert!(error < 1e-7 && found.inlier_count == 50, "seed {seed}: {error}");
        }
    }

    #[test]
    fn half_outliers_and_half_a_pixel_leave_the_pose() {
        for seed in 0..20 {
            let c = case(&mut Random::new(seed), 200, 0.5, 0.3 + 0.2 * (seed % 2) as f64);
            let options = RansacOptions::new(1.5 / FOCAL);
            let found = estimate_pose::<Camera, World>(&c.points, &c.seen, &options).expect("a pose");
            let rotation = found.to_from_from.rotation.angle_to(&c.pose.rotation);
            let translation = (found.to_from_from.translation - c.pose.translation).norm();
            assert!(rotation < 2e-3 && translation < 0.01, "seed {seed}: {rotation} {translation}");
            let kept = found.inliers.iter().zip(&c.truth).filter(|(a, b)| a == b).count();
            assert!(kept > 190, "seed {seed}: {kept}");
        }
    }

    #[test]
    fn refinement_comes_back_from_ten_degrees_off() {
        for seed in 0..20 {
            let mut random = Random::new(seed);
            let c = case(&mut random, 100, 0.0, 0.0);
            let off =
                Se3::<Camera, World>::new(random_rotation(&mut random, 0.1) * c.pose.rotation, c.pose.translation);
            let matches = c.points.iter().copied().zip(c.seen.iter().copied());
            let problem = PoseProblem { matches, loss: Loss::Huber(0.01) };
            let (found, summary) = minimise(&problem, pose_of(&off), &LmOptions::default());
            let found: Se3<Camera, World> = motion_of(&found);
            let error = found.rotation.angle_to(&c.pose.rotation) + (found.translation - c.pose.translation).norm();
            assert!(error < 1e-6 && summary.converged, "seed {seed}: {error} {summary:?}");
        }
    }

    #[test]
    fn bad_input_gives_none() {
        let c = case(&mut Random::new(7), 60, 0.0, 0.0);
        let run =
            |p: &[Vector3<f64>], x: &[Vector2<f64>]| estimate_pose::<Camera, World>(p, x, &RansacOptions::new(2e-3));
        assert!(run(&[], &[]).is_none());
        assert!(run(&c.points[..3], &c.seen[..3]).is_none(), "three matches fit anything");
        assert!(run(&c.points, &c.seen[..59]).is_none());
        let mut nan = c.points.clone();
        nan[3].x = f64::NAN;
        assert!(run(&nan, &c.seen).is_none());
        assert!(run(&[c.points[0]; 30], &[c.seen[0]; 30]).is_none());
        let line: Vec<Vector3<f64>> = (0..30).map(|i| Vector3::new(0.1, 0.05, 0.02) * f64::from(i)).collect();
        let seen: Vec<Vector2<f64>> = line.iter().map(|p| p.xy() / (p.z + 4.0)).collect();
        assert!(run(&line, &seen).is_none(), "collinear");
        for seed in 0..5 {
            let noise = case(&mut Random::new(seed), 200, 0.0, 1.0);
            assert!(run(&noise.points, &noise.seen).is_none(), "seed {seed}: random matches");
        }
    }
}
