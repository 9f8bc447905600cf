//! Pose of one frame from landmarks of known position, or on known rays (motion-only adjustment).
//!
//! Input: pairs of a world point and its undistorted observation. Output: `camera_from_world` that minimises
//! `sum rho(|e|^2)`, `e = A (pi(T X) - n)` with Huber's rho (in the first round Cauchy's; Triggs et al. 2000, section 4), A the standard deviations that a
//! step on the plane z = 1 counts as ([`Correspondence::sqrt_information`]), outliers taken out between rounds by the chi-square limit and at the end by what the others make of those that decide a direction by themselves, and the 6x6
//! information of the result. Levenberg-Marquardt (`least_squares`) on the left perturbation of [`Se3::perturb_left`]. Cost: about 80 ns a
//! pair and step, more on a ray. Allocates nothing.

mod descent;
mod leverage;
mod minima;

use nalgebra::Matrix6;

pub use self::descent::PoseOptions;
use self::descent::{descend, judge};
use self::leverage::{Fit, judge_leverage};
pub use self::minima::lowest_minimum;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::reconstruction::measurement::Correspondence;

/// Rounds of optimisation, outliers judged anew after each.
const ROUNDS: usize = 3;

/// Result of [`optimise_pose`].
#[derive(Debug, Clone, Copy)]
pub struct PoseSolution {
    pub camera_from_world: Se3<Camera, World>,
    pub inliers: usize,
    /// Information (inverse covariance) of the left perturbation, inliers only, unit weights: rad and map units.
    pub information: Matrix6<f64>,
}

/// Robust pose from `start`. `inlier` (same length as `pairs`) is overwritten. `None` with fewer than four usable pairs,
/// or non-finite input.
pub fn optimise_pose(
    start: &Se3<Camera, World>,
    pairs: &[Correspondence],
    options: &PoseOptions,
    inlier: &mut Vec<bool>,
) -> Option<PoseSolution> {
    inlier.clear();
    inlier.resize(pairs.len(), true);
    if pairs.len() < 4 || !start.is_finite() {
        return None;
    }
    let mut pose = *start;
    for round in 0..ROUNDS {
        let relaxed = round == 0;
        pose = descend(&pose, pairs, inlier, options, relaxed).0;
        let limit = options.outlier_chi2 * if relaxed { options.first_round_relaxation } else { 1.0 };
        if judge(&pose, pairs, limit, inlier) < 4 {
            return None;
        }
    }
    let mut fit = Fit::of(&pose, pairs, inlier);
    if options.leverage {
        judge_leverage(&mut pose, &mut fit, pairs, options, inlier);
    }
    let solution = PoseSolution { camera_from_world: pose, inliers: fit.count, information: fit.information };
    (pose.is_finite() && fit.information.iter().all(|v| v.is_finite())).then_some(solution)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::random::Random;
    use crate::reconstruction::measurement::residual;
    use nalgebra::{Matrix2, UnitQuaternion, Vector2, Vector3, Vector6};

    pub fn scene(seed: u64, n: usize, noise_px: f64, outliers: usize) -> (Se3<Camera, World>, Vec<Correspondence>) {
        let mut generator = Random::new(seed);
        let mut random = move || generator.uniform(-1.0, 1.0);
        let truth = Se3::new(
            UnitQuaternion::from_scaled_axis(Vector3::new(random(), random(), random()) * 0.5),
            Vector3::new(random(), random(), random()),
        );
        let pairs = (0..n)
            .map(|i| {
                let p = Vector3::new(random() * 2.0, random() * 1.5, 4.0 + 2.0 * random());
                let mut normalised = Vector2::new(p.x / p.z, p.y / p.z);
                normalised += Vector2::new(random(), random()) * noise_px / 500.0;
                if i < outliers {
                    normalised += Vector2::new(random(), random()) * 0.3;
                }
                let pixel_scale = Matrix2::new(500.0, 0.0, 0.0, 510.0);
                Correspondence::new(truth.inverse().transform(&p), normalised, pixel_scale, 1.0)
            })
            .collect();
        (truth, pairs)
    }

    pub fn distance(a: &Se3<Camera, World>, b: &Se3<Camera, World>) -> f64 {
        a.rotation.angle_to(&b.rotation).max((a.translation - b.translation).norm())
    }

    #[test]
    fn exact_on_noiseless_points_from_a_start_that_is_off() {
        for seed in 1..20 {
            let (truth, pairs) = scene(seed, 60, 0.0, 0);
            let start = truth.perturb_left(&Vector6::new(0.05, -0.04, 0.06, 0.2, -0.1, 0.15));
            let mut inlier = Vec::new();
            let options = PoseOptions { steps: 20, ..PoseOptions::default() };
            let s = optimise_pose(&start, &pairs, &options, &mut inlier).unwrap();
            assert!(distance(&s.camera_from_world, &truth) < 1e-9, "seed {seed}");
            assert_eq!(s.inliers, 60);
        }
    }

    #[test]
    fn a_third_of_outliers_is_named_and_does_not_bend_the_pose() {
        for seed in 1..20 {
            let (truth, pairs) = scene(seed, 120, 1.0, 40);
            let start = truth.perturb_left(&Vector6::new(0.01, -0.01, 0.01, 0.04, -0.02, 0.03));
            let mut inlier = Vec::new();
            let s = optimise_pose(&start, &pairs, &PoseOptions::default(), &mut inlier).unwrap();
            assert!(distance(&s.camera_from_world, &truth) < 5e-3, "seed {seed}");
            assert!(inlier[40..].iter().all(|&ok| ok), "seed {seed}: a good pair was thrown out");
        }
    }

    #[test]
    fn jacobian_of_the_reprojection_agrees_with_differences() {
        for seed in 1..10 {
            let (pose, pairs) = scene(seed, 5, 3.0, 0);
            // A pinhole's scale, and one of a wide-angle lens off its axis.
            let wide = Matrix2::new(210.0, -80.0, -81.0, 130.0);
            let pairs = pairs.iter().flat_map(|p| [*p, Correspondence { sqrt_information: wide, ..*p }]);
            for pair in pairs {
                let (jx, jy) = residual(&pose, &pair).unwrap().rows();
                for i in 0..6 {
                    let mut d = Vector6::zeros();
                    d[i] = 1e-6;
                    let plus = residual(&pose.perturb_left(&d), &pair).unwrap().e;
                    let minus = residual(&pose.perturb_left(&-d), &pair).unwrap().e;
                    let numeric = (plus - minus) / 2e-6;
                    assert!((numeric.x - jx[i]).abs() < 1e-3, "seed {seed}: {} against {}", numeric.x, jx[i]);
                    assert!((numeric.y - jy[i]).abs() < 1e-3, "seed {seed}: {} against {}", numeric.y, jy[i]);
                }
            }
        }
    }

    #[test]
    fn too_few_or_non_finite_pairs_give_none() {
        let (truth, mut pairs) = scene(3, 20, 0.0, 0);
        let mut inlier = Vec::new();
        let options = PoseOptions::default();
        assert!(optimise_pose(&truth, &pairs[..3], &options, &mut inlier).is_none());
        assert!(optimise_pose(&truth, &[], &options, &mut inlier).is_none());
        for pair in &mut pairs {
            pair.point.x = f64::NAN;
        }
        assert!(optimise_pose(&truth, &pairs, &options, &mut inlier).is_none());
    }
}
