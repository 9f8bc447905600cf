//! Pose of one frame from landmarks of known position (motion-only adjustment).
//!
//! Input: pairs of a world point and its undistorted observation. Output: `camera_from_world` that minimises
//! `sum rho(|e|^2)`, `e = A (pi(T X) - n) / sigma` with Huber's rho (Triggs et al. 2000, section 4), A the pixels that a
//! step on the plane z = 1 counts as ([`CameraModel::pixel_scale`](crate::geometry::CameraModel::pixel_scale)), outliers taken out
//! between rounds by the chi-square limit and at the end by what the others make of those that decide a direction by themselves, and the 6x6
//! information of the result. Gauss-Newton with Levenberg damping on the left perturbation of [`Se3::perturb_left`]. Cost: about 60 ns a
//! pair and step. Allocates nothing.

mod leverage;

use nalgebra::{Matrix2, Matrix6, Vector2, Vector3, Vector6};

use self::leverage::{Fit, judge_leverage};

use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::map::Observation;

/// 95 % limit of chi-square with two degrees of freedom.
pub const CHI2_2D_95: f64 = 5.991;

/// One landmark seen in the frame.
#[derive(Debug, Clone, Copy)]
pub struct PosePair {
    /// World coordinates, map units.
    pub point: Vector3<f64>,
    /// Undistorted observation on the plane z = 1.
    pub normalised: Vector2<f64>,
    /// Pixels that steps on that plane count as there.
    pub pixel_scale: Matrix2<f64>,
    /// One over the standard deviation, 1/px.
    pub inv_sigma_px: f64,
}

impl PosePair {
    /// What a keyframe saw of `point`, as its middle row's pose would have seen it, for a readout time in seconds.
    pub fn observed(point: Vector3<f64>, seen: &Observation, camera: &CameraModel, readout_s: f64) -> Self {
        Self {
            point,
            normalised: seen.at_middle_row(readout_s),
            pixel_scale: camera.pixel_scale(&seen.normalised),
            inv_sigma_px: seen.inv_sigma_px,
        }
    }
}

/// Result of [`optimise_pose`].
#[derive(Debug, Clone, Copy)]
pub struct PoseSolution {
    pub camera_from_world: Se3<Camera, World>,
    pub inliers: usize,
    /// Information (inverse covariance) of the left perturbation, inliers only, unit weights: rad and map units.
    pub information: Matrix6<f64>,
    /// Root mean square of the inliers' residuals, px.
    pub rms_px: f64,
    /// Share of the standard deviations at which most of the residuals lie (from their median; at least 0.2). The standard deviations
    /// leave room for a bent map; what bends it is shared by neighbours in the picture, and the rest of them is this small. 1 where
    /// leverage is not judged.
    pub scale: f64,
}

/// Options of [`optimise_pose`].
#[derive(Debug, Clone, Copy)]
pub struct PoseOptions {
    /// Rounds of optimisation, outliers judged anew after each.
    pub rounds: usize,
    /// Gauss-Newton steps a round at the most.
    pub steps: usize,
    /// Limit of the squared, sigma-scaled residual above which a pair is an outlier.
    pub outlier_chi2: f64,
    /// The first round uses this many times the limit and a Cauchy weight: a poor start must not throw good pairs out.
    pub first_round_relaxation: f64,
    /// Pairs with leverage are judged by what the others make of them (`most_contradicted`). Not where distances are eliminated:
    /// such pairs agree with every way of the camera, and would contradict the few that know it.
    pub leverage: bool,
}

impl Default for PoseOptions {
    fn default() -> Self {
        Self { rounds: 3, steps: 6, outlier_chi2: CHI2_2D_95, first_round_relaxation: 4.0, leverage: true }
    }
}

/// Residual (sigma-scaled, px) of a pair; `None` behind the camera.
#[inline]
fn residual(pose: &Se3<Camera, World>, pair: &PosePair) -> Option<(Vector2<f64>, Vector3<f64>)> {
    let p = pose.transform(&pair.point);
    if p.z < 1e-6 {
        return None;
    }
    let iz = 1.0 / p.z;
    Some((scaled(&pair.pixel_scale, pair.inv_sigma_px, p.x * iz - pair.normalised.x, p.y * iz - pair.normalised.y), p))
}

/// A pinhole's scale: the short way then, with the same bits as the long one.
#[inline]
pub(crate) fn is_diagonal(scale: &Matrix2<f64>) -> bool {
    scale.m12 == 0.0 && scale.m21 == 0.0
}

/// A step on the plane z = 1 in pixels, times `factor`.
#[inline]
pub(crate) fn scaled(scale: &Matrix2<f64>, factor: f64, x: f64, y: f64) -> Vector2<f64> {
    let m = |v: f64| factor * v;
    if is_diagonal(scale) {
        return Vector2::new(m(scale.m11) * x, m(scale.m22) * y);
    }
    Vector2::new(m(scale.m11) * x + m(scale.m12) * y, m(scale.m21) * x + m(scale.m22) * y)
}

/// Rows of d e / d delta at camera point `p`: tangent `[rotation, translation]`, `p' = exp(w) p + v`.
#[inline]
pub(crate) fn jacobian_rows(p: &Vector3<f64>, scale: &Matrix2<f64>) -> ([f64; 6], [f64; 6]) {
    let iz = 1.0 / p.z;
    let (u, v) = (p.x * iz, p.y * iz);
    // d(u, v)/dp = iz [1 0 -u; 0 1 -v]; dp/dw = -[p]x, dp/dv = I.
    if is_diagonal(scale) {
        let (fx, fy) = (scale.m11, scale.m22);
        return (
            [-fx * u * v, fx * (1.0 + u * u), -fx * v, fx * iz, 0.0, -fx * u * iz],
            [-fy * (1.0 + v * v), fy * u * v, fy * u, 0.0, fy * iz, -fy * v * iz],
        );
    }
    let row = |a: f64, b: f64| {
        [
            -a * u * v - b * (1.0 + v * v),
            a * (1.0 + u * u) + b * u * v,
            -a * v + b * u,
            a * iz,
            b * iz,
            -a * u * iz - b * v * iz,
        ]
    };
    (row(scale.m11, scale.m12), row(scale.m21, scale.m22))
}

/// Robust pose from `start`. `inlier` (same length as `pairs`) is overwritten. `None` with fewer than four usable pairs,
/// non-finite input or a singular system.
pub fn optimise_pose(
    start: &Se3<Camera, World>,
    pairs: &[PosePair],
    options: &PoseOptions,
    inlier: &mut Vec<bool>,
) -> Option<PoseSolution> {
    inlier.clear();
    inlier.resize(pairs.len(), true);
    if pairs.len() < 4 || !start.is_finite() {
        return None;
    }
    let mut pose = *start;
    let rounds = options.rounds.max(1);
    for round in 0..rounds {
        let relaxed = round == 0 && rounds > 1;
        pose = descend(&pose, pairs, inlier, options, relaxed)?;
        let limit = options.outlier_chi2 * if relaxed { options.first_round_relaxation } else { 1.0 };
        if judge(&pose, pairs, limit, inlier) < 4 {
            return None;
        }
    }
    let mut fit = Fit::of(&pose, pairs, inlier);
    if options.leverage {
        judge_leverage(&mut pose, &mut fit, pairs, options, inlier);
    }
    let solution = PoseSolution {
        camera_from_world: pose,
        inliers: fit.count,
        information: fit.information,
        rms_px: (fit.sum_px2 / fit.count.max(1) as f64).sqrt(),
        scale: if options.leverage { fit.scale } else { 1.0 },
    };
    (pose.is_finite() && fit.information.iter().all(|v| v.is_finite())).then_some(solution)
}

/// Gauss-Newton steps with Levenberg damping over the current inliers.
fn descend(
    start: &Se3<Camera, World>,
    pairs: &[PosePair],
    inlier: &[bool],
    options: &PoseOptions,
    relaxed: bool,
) -> Option<Se3<Camera, World>> {
    let mut pose = *start;
    let mut lambda = 1e-6;
    let (mut h, mut g, mut cost) = linearise(&pose, pairs, inlier, options.outlier_chi2, relaxed);
    for _ in 0..options.steps {
        let mut damped = h;
        for i in 0..6 {
            damped[(i, i)] += lambda * h[(i, i)].max(1e-12);
        }
        let step: Vector6<f64> = damped.cholesky()?.solve(&-g);
        if !step.iter().all(|v| v.is_finite()) {
            return None;
        }
        let candidate = pose.perturb_left(&step);
        let (h2, g2, cost2) = linearise(&candidate, pairs, inlier, options.outlier_chi2, relaxed);
        if cost2 <= cost {
            let gain = cost - cost2;
            (pose, h, g) = (candidate, h2, g2);
            let done = gain < 1e-6 * cost || step.norm_squared() < 1e-16;
            cost = cost2;
            lambda = (lambda * 0.1).max(1e-9);
            if done {
                break;
            }
        } else {
            lambda = (lambda * 100.0).max(1e-4);
        }
    }
    Some(pose)
}

/// Says of every pair whether it lies within `limit`; how many do.
fn judge(pose: &Se3<Camera, World>, pairs: &[PosePair], limit: f64, inlier: &mut [bool]) -> usize {
    let mut count = 0;
    for (pair, flag) in pairs.iter().zip(inlier) {
        *flag = residual(pose, pair).is_some_and(|(e, _)| e.norm_squared() <= limit);
        count += usize::from(*flag);
    }
    count
}

#[inline]
pub(crate) fn accumulate(h: &mut Matrix6<f64>, jx: &[f64; 6], jy: &[f64; 6], w: f64) {
    for c in 0..6 {
        let (a, b) = (w * jx[c], w * jy[c]);
        for r in 0..=c {
            h[(r, c)] += jx[r] * a + jy[r] * b;
        }
    }
}

fn mirror(h: &mut Matrix6<f64>) {
    for c in 0..6 {
        for r in 0..c {
            h[(c, r)] = h[(r, c)];
        }
    }
}

/// Normal equations over the current inliers; Cauchy weights when `relaxed`, Huber's else.
fn linearise(
    pose: &Se3<Camera, World>,
    pairs: &[PosePair],
    inlier: &[bool],
    delta2: f64,
    relaxed: bool,
) -> (Matrix6<f64>, Vector6<f64>, f64) {
    let (mut h, mut g, mut cost) = (Matrix6::zeros(), Vector6::zeros(), 0.0);
    for (pair, _) in pairs.iter().zip(inlier).filter(|(_, ok)| **ok) {
        let Some((e, p)) = residual(pose, pair) else {
            cost += 100.0 * delta2; // behind the camera: a constant price, so that a step that does this is no gain
            continue;
        };
        let e2 = e.norm_squared();
        let w;
        if relaxed {
            cost += delta2 * (1.0 + e2 / delta2).ln();
            w = 1.0 / (1.0 + e2 / delta2);
        } else if e2 <= delta2 {
            cost += e2;
            w = 1.0;
        } else {
            let root = (e2 * delta2).sqrt();
            cost += 2.0 * root - delta2;
            w = delta2 / root;
        }
        let s = pair.inv_sigma_px;
        let (jx, jy) = jacobian_rows(&p, &(pair.pixel_scale * s));
        accumulate(&mut h, &jx, &jy, w);
        for i in 0..6 {
            g[i] += w * (jx[i] * e.x + jy[i] * e.y);
        }
    }
    mirror(&mut h);
    (h, g, cost)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::UnitQuaternion;

    pub(super) fn scene(seed: u64, n: usize, noise_px: f64, outliers: usize) -> (Se3<Camera, World>, Vec<PosePair>) {
        let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
        let mut random = move || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 11) as f64 / (1u64 << 53) as f64 * 2.0 - 1.0
        };
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
                PosePair { point: truth.inverse().transform(&p), normalised, pixel_scale, inv_sigma_px: 1.0 }
            })
            .collect();
        (truth, pairs)
    }

    pub(super) fn distance(a: &Se3<Camera, World>, b: &Se3<Camera, World>) -> f64 {
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
            let pairs = pairs.iter().flat_map(|p| [*p, PosePair { pixel_scale: wide, ..*p }]);
            for pair in pairs {
                let (_, p) = residual(&pose, &pair).unwrap();
                let (jx, jy) = jacobian_rows(&p, &pair.pixel_scale);
                for i in 0..6 {
                    let mut d = Vector6::zeros();
                    d[i] = 1e-6;
                    let (plus, _) = residual(&pose.perturb_left(&d), &pair).unwrap();
                    let (minus, _) = residual(&pose.perturb_left(&-d), &pair).unwrap();
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
