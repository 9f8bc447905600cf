//! Fills what is published: the estimate from what tracking found, and the map's snapshot.

use nalgebra::{Matrix6, Vector3};

use super::Reconstruction;
use super::odometry::Step;
use super::track::Tracked;
use super::track::search::Match;
use super::types::{OrientationEstimate, PoseEstimate, TrackingState};
use crate::features::FrameFeatures;
use crate::map::MapSnapshot;

impl Reconstruction {
    /// Fills `out` with the current map.
    pub fn snapshot(&self, out: &mut MapSnapshot) {
        self.snapshot_newest(out, [usize::MAX; 2]);
    }

    /// The same with so many landmarks and keyframes at the most, the newest.
    pub fn snapshot_newest(&self, out: &mut MapSnapshot, most: [usize; 2]) {
        out.fill_newest(self.active.id, &self.active.map, most);
        out.scale = self.scale();
    }

    /// No pose: initialising or lost. Everything that is not known is NaN or `None`.
    pub(super) fn estimate_none(&self, features: &FrameFeatures) -> PoseEstimate {
        PoseEstimate {
            sequence: features.sequence,
            timestamp_ns: features.timestamp_ns,
            arrival_ns: features.arrival_ns,
            state: self.state,
            map: self.active.id,
            map_revision: self.corrections.revision,
            reset_counter: self.reset_counter(),
            scale: self.scale(),
            ..PoseEstimate::default()
        }
    }

    /// Without a map: how the camera has turned since the first frame, if that is known, else nothing.
    pub(super) fn estimate_turned(
        &self,
        features: &FrameFeatures,
        orientation: Option<OrientationEstimate>,
    ) -> PoseEstimate {
        let none = self.estimate_none(features);
        match orientation {
            Some(_) => PoseEstimate { state: TrackingState::Orientation, orientation, ..none },
            None => none,
        }
    }

    pub(super) fn estimate_tracked(
        &self,
        features: &FrameFeatures,
        tracked: &Tracked,
        motion: Option<&Step>,
        keyframe: bool,
    ) -> PoseEstimate {
        // `motion` takes the previous camera's coordinates to this one's; the camera itself moved the other way.
        let (angular, linear) = match motion {
            Some((step, dt)) => {
                let own = step.inverse();
                (step.rotation * own.rotation.scaled_axis() / *dt, step.rotation * own.translation / *dt)
            }
            None => (Vector3::from_element(f64::NAN), Vector3::from_element(f64::NAN)),
        };
        PoseEstimate {
            state: TrackingState::Tracking,
            world_from_camera: Some(tracked.camera_from_world.inverse()),
            odom_from_camera: Some(self.active.odometry.odom_from_camera),
            anchor: Some(self.active.reference),
            covariance: self.covariance(tracked, motion.map_or(USUAL_STEP_S, |m| m.1)),
            angular_velocity: angular,
            linear_velocity: linear,
            landmarks: tracked.landmarks as u32,
            landmarks_sought: tracked.sought as u32,
            quality: quality(tracked) * self.lens_quality(),
            keyframe,
            ..self.estimate_none(features)
        }
    }
}

// What the inverse information of a pose does not say: its landmarks' errors are not independent. What is known of them came through the
// same few keyframes, so they share most of it; beside the anchor, whose templates they are, that cancels, and it shows as the camera
// leaves its place. With H the information, b the way from the anchor in mean depths, t the angle, d the mean depth, q the mean relative
// deviation of the n landmarks' distances, r the residual (whitened by the landmarks' own uncertainty; seeds included), h the time since the frame before, T the readout time and
// k = H⁻¹ sum Jᵀ W de/dT, the covariance is
//
//   P = f H⁻¹ + B² t² diag(1, 1, 1, d², d², d²) + var(T) k kᵀ
//   f = A (q / n) (S + b / (b + D)) max(1, (r / R)²) sqrt(30 h)
//
// Fitted (likelihood, Gaussian) to 2418 frames, half a second apart, of 84 simulated runs with every flaw on: seeds 101 to 110 and 113 to
// 123 at 30 and 121 to 127 at 10 frames a second, hand-held, tour and orbit; A then set for those and seeds 71 to 80 together; judged on
// others by `tests/hard_cases.rs`. (Fitted before residuals were whitened; since then mean NEES is 5.8 on seeds 71 to 80 and 6.5 on
// 141 to 150, at 30 Hz; with seeds in every quick turn 6.4 on the latter, honest would be 5.7 to 6.3.) What an adjustment says of its keyframes' places, the landmarks' ages and parallax, the speed, and the
// anchor's own residual add nothing to it.
/// A, with landmarks.
const SHARED_ERRORS: f64 = 4800.0;
/// S and D: what remains of that beside the anchor, and the way, in mean depths, at which half of the rest is there.
const BESIDE_ANCHOR: f64 = 0.035;
const SHOWN_HALF: f64 = 0.022;
/// q where no landmark's distance is known: that of a usual frame.
const USUAL_DISTANCE_SIGMA: f64 = 0.02;
/// R, px, on each axis.
const USUAL_RESIDUAL_PX: f64 = 0.43;
/// B: standard deviation of rotation (rad) and of translation (mean depths) for each radian from the anchor: map and lens are bent.
const BENT: f64 = 1.75e-3;
/// 1/30 s: at lower rates a landmark was seen in fewer frames, from views farther apart.
const USUAL_STEP_S: f64 = 1.0 / 30.0;

/// Factor on the quality of a pose while the lens is a guess: angles and depths are off by as much as the focal length is.
const GUESSED_LENS_QUALITY: f32 = 0.5;

impl Reconstruction {
    fn lens_quality(&self) -> f32 {
        if self.optics.intrinsics.is_found() { 1.0 } else { GUESSED_LENS_QUALITY }
    }

    fn covariance(&self, tracked: &Tracked, step_s: f64) -> Matrix6<f64> {
        let mut covariance = self.covariance_in_map(tracked, step_s);
        if let Some(turn) = self.active.map.keyframe(self.active.reference).and_then(|k| k.scale_from) {
            let mut translation = covariance.fixed_view_mut::<3, 3>(3, 3);
            translation += self.active.scale.covariance(&self.active.map, turn, &tracked.camera_from_world);
        }
        covariance
    }

    /// The formula above, `step_s` after the frame before; NaN where the information cannot be inverted.
    fn covariance_in_map(&self, tracked: &Tracked, step_s: f64) -> Matrix6<f64> {
        let unknown = Matrix6::from_element(f64::NAN);
        let Some(inverse) = tracked.information.matrix.cholesky().map(|c| c.inverse()) else { return unknown };
        let depth = mean_depth(tracked, self.tracker.matches()).unwrap_or(1.0);
        let pose = &tracked.camera_from_world;
        let (angle, way) = self.active.map.keyframe(self.active.reference).map_or((0.0, 0.0), |anchor| {
            let step = *pose * anchor.camera_from_world.inverse();
            (step.rotation.angle(), step.translation.norm() / depth)
        });
        let distance_sigma = tracked.information.distance_sigma.unwrap_or(USUAL_DISTANCE_SIGMA);
        let residual_px = tracked.rms_px / std::f64::consts::SQRT_2;
        let factor = SHARED_ERRORS * distance_sigma / tracked.landmarks.max(1) as f64
            * (BESIDE_ANCHOR + way / (way + SHOWN_HALF))
            * (residual_px / USUAL_RESIDUAL_PX).powi(2).max(1.0)
            * (step_s / USUAL_STEP_S).sqrt();
        let pushed = inverse * tracked.information.readout;
        let mut covariance = inverse * factor + pushed * pushed.transpose() * self.optics.shutter.variance();
        for i in 0..3 {
            covariance[(i, i)] += (BENT * angle).powi(2);
            covariance[(i + 3, i + 3)] += (BENT * angle * depth).powi(2);
        }
        covariance
    }
}

/// Mean depth of the landmarks that a pose rests on, map units.
fn mean_depth(tracked: &Tracked, inliers: &[Match]) -> Option<f64> {
    let sum: f64 = inliers.iter().map(|m| tracked.camera_from_world.transform(&m.point).z).sum();
    Some(sum / inliers.len() as f64).filter(|d| d.is_finite() && *d > 0.0)
}

/// Share of the sought landmarks that agree, less when they are few (100 are plenty).
fn quality(tracked: &Tracked) -> f32 {
    let share = tracked.landmarks as f32 / tracked.sought.max(1) as f32;
    share * (tracked.landmarks as f32 / 100.0).min(1.0)
}
