//! Fills the published estimate from what tracking found.

use nalgebra::{Matrix6, Vector3};

use super::Reconstruction;
use super::tracking::Tracked;
use super::types::{PoseEstimate, TrackingState};
use crate::features::FrameFeatures;
use crate::geometry::Se3;
use crate::geometry::frames::Camera;

impl Reconstruction {
    /// No pose: initialising or lost. Everything that is not known is NaN or `None`.
    pub(super) fn estimate_none(&self, features: &FrameFeatures) -> PoseEstimate {
        PoseEstimate {
            sequence: features.sequence,
            timestamp_ns: features.timestamp_ns,
            arrival_ns: features.arrival_ns,
            state: self.state,
            world_from_camera: None,
            odom_from_camera: None,
            anchor: None,
            covariance: Matrix6::from_element(f64::NAN),
            angular_velocity: Vector3::from_element(f64::NAN),
            linear_velocity: Vector3::from_element(f64::NAN),
            landmarks: 0,
            landmarks_sought: 0,
            quality: 0.0,
            map: self.map_id,
            reset_counter: self.reset_counter,
            keyframe: false,
        }
    }

    pub(super) fn estimate_tracked(
        &self,
        features: &FrameFeatures,
        tracked: &Tracked,
        motion: Option<&(Se3<Camera, Camera>, f64)>,
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
            odom_from_camera: Some(self.odom_from_camera),
            anchor: Some(self.reference),
            covariance: covariance(&tracked.information),
            angular_velocity: angular,
            linear_velocity: linear,
            landmarks: tracked.landmarks as u32,
            landmarks_sought: tracked.sought as u32,
            quality: quality(tracked),
            keyframe,
            ..self.estimate_none(features)
        }
    }
}

/// Inverse of the information; NaN where it cannot be inverted.
fn covariance(information: &Matrix6<f64>) -> Matrix6<f64> {
    match information.cholesky() {
        Some(c) => c.inverse(),
        None => Matrix6::from_element(f64::NAN),
    }
}

/// Share of the sought landmarks that agree, less when they are few (100 are plenty).
fn quality(tracked: &Tracked) -> f32 {
    let share = tracked.landmarks as f32 / tracked.sought.max(1) as f32;
    share * (tracked.landmarks as f32 / 100.0).min(1.0)
}
