//! Pairs that decide a direction of a pose by themselves, judged by what the others make of them.
//!
//! In: a pose with its pairs and flags. Out: the same without the pairs that the others contradict. Where most landmarks lie in one
//! part of the picture and far away, one that is near holds the pose by itself; if it is wrong, as at the edge of something that
//! moves past, its own residual does not tell. Cost: about 0.1 us a pair, and two warm descents for each pair taken out.
//!
//! Kept by ablation: without it errors over 52 recordings made harder (the shorter ones of half A, as `maturity`) are 4 % larger.

use nalgebra::{Matrix2, Matrix6, Vector6};

use super::descent::{PoseOptions, descend, judge};
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::reconstruction::measurement::{Correspondence, accumulate, residual};

/// Pairs that the others may contradict in one solution. What moves past a robot shows more of them, and then `maturity` decides.
const MAX_REMOVED: usize = 8;
/// A pair has leverage from this many times the mean share of the pose that pairs decide (Hoaglin, Welsch 1978).
const HIGH_LEVERAGE: f64 = 2.0;
/// Of a direction that a pair decides, this share at the least must be left to the others for them to contradict it.
const MIN_LEFT: f64 = 0.01;

/// How the inliers lie about a pose.
pub(super) struct Fit {
    pub(super) information: Matrix6<f64>,
    pub(super) count: usize,
}

impl Fit {
    pub(super) fn of(pose: &Se3<Camera, World>, pairs: &[Correspondence], inlier: &[bool]) -> Self {
        let (mut information, mut count) = (Matrix6::zeros(), 0usize);
        for (pair, _) in pairs.iter().zip(inlier).filter(|(_, ok)| **ok) {
            let Some(seen) = residual(pose, pair) else { continue };
            let (jx, jy) = seen.rows();
            accumulate(&mut information, &jx, &jy, 1.0);
            count += 1;
        }
        information.fill_lower_triangle_with_upper_triangle();
        Self { information, count }
    }

    /// The inlier with the largest studentised residual, if that is beyond the limit: its innovation, had the pose been solved without it.
    ///
    /// A pair that decides a direction of the pose by itself - the only one nearby, say - has a small residual whatever it says. With its
    /// leverage `h = J H⁻¹ Jᵀ` taken out the residual is `d = (I - h)⁻¹ e` (the deletion residual: Belsley, Kuh, Welsch 1980, section
    /// 2.1), and the others' pose puts it there with the covariance `I + h (I - h)⁻¹ = (I - h)⁻¹`: so the square of the
    /// studentised residual is `eᵀ (I - h)⁻¹ e`. All in units of the pair's own standard deviation.
    fn worst_studentised(
        &self,
        pose: &Se3<Camera, World>,
        pairs: &[Correspondence],
        inlier: &[bool],
        limit: f64,
    ) -> Option<usize> {
        let covariance = self.information.cholesky()?.inverse();
        let mut worst = (limit, None);
        for (i, (pair, _)) in pairs.iter().zip(inlier).enumerate().filter(|(_, (_, ok))| **ok) {
            let Some(seen) = residual(pose, pair) else { continue };
            let (e, (jx, jy)) = (seen.e, seen.rows());
            let (jx, jy) = (Vector6::from(jx), Vector6::from(jy));
            let (cx, cy) = (covariance * jx, covariance * jy);
            let (xx, xy, yy) = (jx.dot(&cx), jx.dot(&cy), jy.dot(&cy));
            if (xx + yy) * (self.count as f64) < 6.0 * HIGH_LEVERAGE {
                continue;
            }
            let left = Matrix2::new(1.0 - xx, -xy, -xy, 1.0 - yy);
            // Where hardly anything else decides, nothing can contradict.
            let (half_trace, determinant) = (1.0 - 0.5 * (xx + yy), left.determinant());
            if half_trace - (half_trace * half_trace - determinant).max(0.0).sqrt() < MIN_LEFT {
                continue;
            }
            let Some(inverse) = left.try_inverse() else { continue };
            let chi2 = e.dot(&(inverse * e));
            if chi2 > worst.0 {
                worst = (chi2, Some(i));
            }
        }
        worst.1
    }
}

/// Takes out the inliers that the others contradict, the worst first, for good. Those that were outliers before and agree with the pose without them
/// become inliers.
pub(super) fn judge_leverage(
    pose: &mut Se3<Camera, World>,
    fit: &mut Fit,
    pairs: &[Correspondence],
    options: &PoseOptions,
    inlier: &mut [bool],
) {
    let limit = options.outlier_chi2;
    let mut out = [0; MAX_REMOVED];
    let mut count = 0;
    while count < MAX_REMOVED && fit.worst_studentised(pose, pairs, inlier, limit).is_some() {
        // Leverage can be taken out of residuals at the very pose that these pairs give.
        let (settled, _) = descend(pose, pairs, inlier, options, false);
        (*pose, *fit) = (settled, Fit::of(&settled, pairs, inlier));
        let Some(worst) = fit.worst_studentised(pose, pairs, inlier, limit) else { break };
        inlier[worst] = false;
        let (without, _) = descend(pose, pairs, inlier, options, false);
        out[count] = worst;
        count += 1;
        (*pose, *fit) = (without, Fit::of(&without, pairs, inlier));
    }
    if count == 0 {
        return;
    }
    judge(pose, pairs, limit, inlier);
    out[..count].iter().for_each(|i| inlier[*i] = false);
    *pose = descend(pose, pairs, inlier, options, false).0;
    *fit = Fit::of(pose, pairs, inlier);
}

#[cfg(test)]
mod tests {
    use nalgebra::{Vector2, Vector3};

    use super::*;
    use crate::reconstruction::track::pose::optimise_pose;
    use crate::reconstruction::track::pose::tests::{distance, scene};

    /// Far points hardly tell a turn from a step aside; the only near one decides, and its residual stays small.
    #[test]
    fn the_only_near_pair_does_not_bend_the_pose_when_it_is_wrong_and_stays_when_it_is_right() {
        let mut kept_without = 0;
        for seed in 1..20 {
            let (truth, mut pairs) = scene(seed, 100, 0.3, 0);
            for pair in &mut pairs {
                // A small part of the picture.
                let mut p = truth.transform(&pair.point);
                let noise = pair.normalised - p.xy() / p.z;
                p = Vector3::new(0.2 * p.x, 0.2 * p.y, p.z);
                pair.point = truth.inverse().transform(&p);
                pair.normalised = p.xy() / p.z + noise;
                // The largest noise is taken for the standard deviation: at that of the noise one right pair of 20 is beyond the limit.
                pair.sqrt_information /= 0.3;
            }
            let near = Vector3::new(-0.3, 0.1, 0.7);
            let off_by = |wrong_px: f64, leverage: bool| {
                let mut pairs = pairs.clone();
                let normalised = near.xy() / near.z + Vector2::new(wrong_px / 500.0, 0.0);
                pairs.push(Correspondence { point: truth.inverse().transform(&near), normalised, ..pairs[0] });
                let mut inlier = Vec::new();
                let options = PoseOptions { leverage, ..PoseOptions::default() };
                let s = optimise_pose(&truth, &pairs, &options, &mut inlier).unwrap();
                (distance(&s.camera_from_world, &truth), inlier[100])
            };
            let off = |wrong_px| off_by(wrong_px, true);
            let (alone, _) = off(1000.0);
            let (right, kept) = off(0.0);
            assert!(kept && right < 0.01, "seed {seed}: off by {right}");
            let (wrong, kept) = off(2.5);
            assert!(!kept && wrong <= 1.01 * alone, "seed {seed}: off by {wrong}, without it by {alone}");
            kept_without += usize::from(off_by(2.5, false).1);
        }
        assert!(kept_without >= 15, "its own residual tells in all but {kept_without} of 19");
    }
}
