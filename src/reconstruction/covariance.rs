//! Fills what is published: the estimate from what tracking found, and the map's snapshot.

use nalgebra::{Matrix6, Vector3};

use super::Reconstruction;
use super::odometry::{LONGEST_STEP_S, Step};
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
            covariance: self.covariance(tracked, motion.map(|m| m.1)),
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

// What the inverse information of a pose does not say: its landmarks' errors are not independent, since what is known of them came through
// the same few keyframes. With H the information, q the mean relative deviation of the landmarks' distances, h the time since the frame
// before, t the angle from the anchor, d the mean depth, T the readout time, k = H⁻¹ sum Jᵀ W de/dT, and m = H⁻¹ sum Jᵀ W J_l x how far the
// residuals at the templates pull the pose, the covariance is
//
//   P = A q h H⁻¹ + m mᵀ + B² t² diag(1, 1, 1, d², d², d²) + var(T) k kᵀ
//
// It grows with h as a landmark was then seen in fewer frames, from views farther apart. A and B are fitted to 1408 frames of simulated runs
// with every flaw on, seeds 201 to 204 at 30, 10 and 5 frames a second, hand-held, tour and orbit: A such that mean NEES is 6, B by likelihood. Judged on 2102 frames of seeds 211 to 216: mean NEES 6.1, 5.2 and 5.6
// at the three rates. The number of landmarks, the frame's residual and the way from the anchor add nothing to it.
/// A, 1/s.
const SHARED_ERRORS: f64 = 445.0;
/// B: standard deviation of rotation (rad) and of translation (mean depths) for each radian from the anchor: map and lens are bent.
const BENT: f64 = 1.5e-3;

/// Factor on the quality of a pose while the lens is a guess: angles and depths are off by as much as the focal length is.
const GUESSED_LENS_QUALITY: f32 = 0.5;

impl Reconstruction {
    fn lens_quality(&self) -> f32 {
        if self.optics.intrinsics.is_found() { 1.0 } else { GUESSED_LENS_QUALITY }
    }

    fn covariance(&self, tracked: &Tracked, step_s: Option<f64>) -> Matrix6<f64> {
        let mut covariance = self.covariance_in_map(tracked, step_s);
        if let Some(turn) = self.active.part() {
            let mut translation = covariance.fixed_view_mut::<3, 3>(3, 3);
            translation += self.active.scale.covariance(&self.active.map, turn, &tracked.camera_from_world);
        }
        covariance
    }

    /// The formula above, `step_s` after the frame before (`None`: that was not tracked); NaN where the information cannot be inverted.
    fn covariance_in_map(&self, tracked: &Tracked, step_s: Option<f64>) -> Matrix6<f64> {
        let unknown = Matrix6::from_element(f64::NAN);
        let information = &tracked.information;
        let Some(inverse) = information.matrix.cholesky().map(|c| c.inverse()) else { return unknown };
        let depth = mean_depth(tracked, self.tracker.matches()).unwrap_or(1.0);
        let anchor = self.active.map.keyframe(self.active.reference);
        let angle = anchor.map_or(0.0, |k| k.camera_from_world.rotation.angle_to(&tracked.camera_from_world.rotation));
        let step_s = step_s.map_or(LONGEST_STEP_S, |step_s| step_s.min(LONGEST_STEP_S));
        // Where no distance is known the information is of landmarks without a distance, and holds all that is known of them.
        let factor = information.distance_sigma.map_or(1.0, |sigma| SHARED_ERRORS * sigma * step_s);
        let (pushed, pulled) = (inverse * information.readout, inverse * information.templates);
        let mut covariance = inverse * factor
            + pulled * pulled.transpose()
            + pushed * pushed.transpose() * self.optics.shutter.variance();
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
