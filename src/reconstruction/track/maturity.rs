//! The gate for immature landmarks: what is new must agree with what has proved itself.
//!
//! Something large that moves past brings landmarks of its own as long as its motion looks like the parallax of something near:
//! each of them agrees with the pose, because together they bend it. Landmarks that were found in many frames did not move for
//! that long: they are mature. So the pose is solved from them alone, and an immature landmark takes part only if it lies where that pose, with its own
//! uncertainty, lets it lie. If those together still move the pose by more than its uncertainty, they lie there because they move
//! together, and they are judged once more with that pose taken as exact.
//!
//! Input: the pairs of one frame (world point, undistorted observation), which of them are of mature landmarks, the solution over all and the
//! options that it was made with. Output: the solution over the mature ones and the immature ones that agree. Test: chi-square of the
//! innovation, `e' (I + J P J')⁻¹ e` in standard deviations, P the covariance of the mature solution (Bar-Shalom, Li, Kirubarajan 2001,
//! section 5.4). Cost: two or three warm motion-only optimisations. It does not judge the mature ones: the optimisation's own outlier test does.
//!
//! Kept by ablation: without it errors over 79 recordings made harder (half A of `tests/results/derived.py`) are 6 % larger in the geometric mean.

use nalgebra::{Matrix6, Vector6};

use super::pose::{PoseOptions, PoseSolution, optimise_pose};
use crate::reconstruction::measurement::{CHI2_2D_95, Correspondence};

/// A landmark is mature once it was found in as many frames as this time holds, s, and in that many at the least.
const MATURE_S: f64 = 0.65;
const MATURE_FRAMES: u32 = 5;
/// The same in frames where the time between them is not known.
const MATURE_FOUND: u32 = 20;
/// Mature landmarks that must agree before they judge the others.
const MIN_MATURE: usize = 15;

/// 99 % limit of chi-square with six degrees of freedom.
const CHI2_6D_99: f64 = 16.812;

/// Frames in which a landmark must have been found to be mature; `step_s`: time from frame to frame.
pub fn mature_after(step_s: Option<f64>) -> u32 {
    step_s.map_or(MATURE_FOUND, |s| ((MATURE_S / s).ceil() as u32).max(MATURE_FRAMES))
}

/// Buffers, kept between frames.
#[derive(Debug, Default)]
pub struct MaturityGate {
    mature: Vec<bool>,
    /// For each pair: may it take part?
    included: Vec<bool>,
    pairs: Vec<Correspondence>,
    inlier: Vec<bool>,
}

impl MaturityGate {
    /// Room for `n` pairs.
    pub fn with_capacity(n: usize) -> Self {
        let flags = || Vec::with_capacity(n);
        Self { mature: flags(), included: flags(), pairs: Vec::with_capacity(n), inlier: flags() }
    }

    /// `mature` and `inlier`: one flag a pair; `inlier` comes from `solution` and is overwritten with the result's. `None` leaves everything as it
    /// was: no immature landmark takes part, or the mature ones are too few to decide.
    pub fn judge(
        &mut self,
        pairs: &[Correspondence],
        mature: impl Fn(usize) -> bool,
        solution: &PoseSolution,
        options: &PoseOptions,
        inlier: &mut [bool],
    ) -> Option<PoseSolution> {
        self.mature.clear();
        self.mature.extend((0..pairs.len()).map(mature));
        if !inlier.iter().zip(&self.mature).any(|(&inlier, &mature)| inlier && !mature) {
            return None;
        }
        take(pairs, &self.mature, &mut self.pairs);
        let own = optimise_pose(&solution.camera_from_world, &self.pairs, options, &mut self.inlier)?;
        if own.inliers < MIN_MATURE || 2 * own.inliers < self.pairs.len() {
            return None;
        }
        let doubt = own.information.cholesky()?.inverse();
        let mut agreed = own;
        // Together they may still pull further than one alone could: then only those count that lie just where the mature
        // pose puts them.
        for doubt in [doubt, Matrix6::zeros()] {
            self.include(pairs, &own, &doubt, options.outlier_chi2);
            take(pairs, &self.included, &mut self.pairs);
            agreed = optimise_pose(&own.camera_from_world, &self.pairs, options, &mut self.inlier)?;
            let step = agreed.camera_from_world * own.camera_from_world.inverse();
            let (w, v) = (step.rotation.scaled_axis(), step.translation);
            let pull = Vector6::new(w.x, w.y, w.z, v.x, v.y, v.z);
            if pull.dot(&(own.information * pull)) <= CHI2_6D_99 * options.outlier_chi2 / CHI2_2D_95 {
                break;
            }
        }
        let mut flags = self.inlier.iter();
        for (to, included) in inlier.iter_mut().zip(&self.included) {
            *to = *included && flags.next().copied().unwrap_or(false);
        }
        Some(agreed)
    }

    /// Includes the mature ones, and the immature ones that lie where a pose of that covariance lets them lie.
    fn include(&mut self, pairs: &[Correspondence], own: &PoseSolution, doubt: &Matrix6<f64>, limit: f64) {
        self.included.clear();
        self.included.extend(pairs.iter().zip(&self.mature).map(|(pair, &mature)| {
            mature || pair.innovation(&own.camera_from_world, doubt).is_some_and(|chi2| chi2 <= limit)
        }));
    }
}

/// The pairs whose flag is set.
fn take(pairs: &[Correspondence], flags: &[bool], out: &mut Vec<Correspondence>) {
    out.clear();
    out.extend(pairs.iter().zip(flags).filter(|(_, flag)| **flag).map(|(pair, _)| *pair));
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix2, UnitQuaternion, Vector2, Vector3};

    use super::*;
    use crate::geometry::Se3;
    use crate::geometry::frames::{Camera, World};
    use crate::geometry::random::Random;

    const FOCAL: Vector2<f64> = Vector2::new(500.0, 500.0);

    /// `still` points of a room, seen from the true pose, then `moved` near ones that went `by` since they were mapped.
    fn scene(seed: u64, still: usize, moved: usize, by: Vector3<f64>) -> (Se3<Camera, World>, Vec<Correspondence>) {
        let mut generator = Random::new(seed);
        let mut random = move || generator.uniform(-1.0, 1.0);
        let truth = Se3::new(
            UnitQuaternion::from_scaled_axis(Vector3::new(random(), random(), random()) * 0.3),
            Vector3::new(random(), random(), random()),
        );
        let pairs = (0..still + moved)
            .map(|i| {
                let near = i >= still;
                let z = if near { 1.0 + 0.1 * random() } else { 4.0 + 2.0 * random() };
                let mapped = Vector3::new(random() * 0.5 * z, random() * 0.4 * z, z);
                let seen = if near { mapped + by } else { mapped };
                let noise = Vector2::new(random(), random()) * 0.5;
                let normalised = Vector2::new(seen.x, seen.y) / seen.z + noise.component_div(&FOCAL);
                let point = truth.inverse().transform(&mapped);
                Correspondence::new(point, normalised, Matrix2::from_diagonal(&FOCAL), 1.0 / 0.3)
            })
            .collect();
        (truth, pairs)
    }

    fn solved(start: &Se3<Camera, World>, pairs: &[Correspondence]) -> (PoseSolution, Vec<bool>) {
        let mut inlier = Vec::new();
        let solution = optimise_pose(start, pairs, &PoseOptions::default(), &mut inlier).expect("a pose");
        (solution, inlier)
    }

    #[test]
    fn something_near_that_moves_bends_the_pose_until_the_mature_are_asked() {
        for seed in 1..20 {
            let (truth, pairs) = scene(seed, 60, 90, Vector3::new(0.006, 0.0, 0.0));
            let (all, mut inlier) = solved(&truth, &pairs);
            let off = |s: &PoseSolution| {
                let e = s.camera_from_world * truth.inverse();
                e.rotation.angle().max(e.translation.norm())
            };
            let bent = off(&all);
            let immature = |inlier: &[bool]| inlier[60..].iter().filter(|i| **i).count();
            assert!(bent > 0.004 && immature(&inlier) > 60, "seed {seed}: the scene is too easy, off by {bent}");
            let asked = MaturityGate::default()
                .judge(&pairs, |i| i < 60, &all, &PoseOptions::default(), &mut inlier)
                .expect("a judgement");
            assert!(off(&asked) < 0.5 * bent, "seed {seed}: off by {} and before by {bent}", off(&asked));
            assert!(immature(&inlier) < 45, "seed {seed}: {} immature took part", immature(&inlier));
        }
    }

    #[test]
    fn immature_ones_that_stand_still_take_part() {
        let (mut before, mut after) = (0, 0);
        let count = |inlier: &[bool]| inlier.iter().filter(|i| **i).count();
        for seed in 1..20 {
            let (truth, pairs) = scene(seed, 60, 90, Vector3::zeros());
            let (all, mut inlier) = solved(&truth, &pairs);
            before += count(&inlier);
            MaturityGate::default()
                .judge(&pairs, |i| i < 60, &all, &PoseOptions::default(), &mut inlier)
                .expect("a judgement");
            after += count(&inlier);
        }
        // One set in a hundred looks by chance as if it moved.
        assert!(100 * after >= 97 * before, "seeds 1 to 19: {after} of {before} take part");
    }

    #[test]
    fn maturity_is_a_matter_of_time() {
        let frames = [60.0, 30.0, 10.0, 5.0].map(|rate_hz: f64| mature_after(Some(rate_hz.recip())));
        assert_eq!((frames, mature_after(None)), ([39, 20, 7, 5], 20));
    }

    #[test]
    fn too_few_mature_or_no_immature_change_nothing() {
        let (truth, pairs) = scene(5, 60, 90, Vector3::new(0.006, 0.0, 0.0));
        let (all, inlier) = solved(&truth, &pairs);
        let mut asked = inlier.clone();
        for mature in [0, MIN_MATURE - 1, pairs.len()] {
            let judged =
                MaturityGate::default().judge(&pairs, |i| i < mature, &all, &PoseOptions::default(), &mut asked);
            assert!(judged.is_none() && asked == inlier, "{mature}");
        }
    }
}
