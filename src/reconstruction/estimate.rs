//! Fills the published estimate from what tracking found.

use nalgebra::{Matrix6, Vector3};

use super::Reconstruction;
use super::search::Match;
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
            covariance: covariance(&tracked.information, &self.doubt(tracked, &angular, &linear)),
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

/// What the inverse information of a pose does not contain, as fitted on simulated runs (full effects, 5 to 30 frames a second,
/// seeds 11 and 12; judged on others by `tests/hard_cases.rs`).
#[derive(Debug, Clone, Copy)]
struct Doubt {
    /// Factor on the inverse information: residuals as they are, not as the configuration supposes them.
    factor: f64,
    /// Variance to add on each axis: rotation (rad^2), translation (map units^2).
    rotation: f64,
    translation: f64,
}

/// Per-axis residual at which the inverse information is right, px: places found in neighbouring frames share the errors of
/// their templates, so that more landmarks help less than they seem to.
const HONEST_RESIDUAL_PX: f64 = 0.31;
/// A picture's rows and its exposure take time in which the camera moves: what of that stays unknown, s. Of the rotation, by the
/// angular velocity and by its change since the frame before; of the translation, by the changes of both velocities.
const TURN_S: f64 = 5.4e-4;
const TURN_CHANGE_S: f64 = 9.3e-4;
const SHIFT_BY_TURN_CHANGE_S: f64 = 7.6e-4;
const SHIFT_CHANGE_S: f64 = 1.2e-3;
/// Shares of what an unknown readout time moves the picture by that end up in rotation and translation.
const READOUT_IN_ROTATION: f64 = 0.42;
const READOUT_IN_TRANSLATION: f64 = 0.15;
/// On all of it, so that the mean of the normalised error squared is what it should be and not only its bulk.
const TAILS: f64 = 2.0;

/// Factor on the quality of a pose while the lens is a guess: angles and depths are off by as much as the focal length is.
const GUESSED_LENS_QUALITY: f32 = 0.5;

impl Reconstruction {
    fn lens_quality(&self) -> f32 {
        if self.intrinsics.is_found() { 1.0 } else { GUESSED_LENS_QUALITY }
    }

    fn doubt(&self, tracked: &Tracked, angular: &Vector3<f64>, linear: &Vector3<f64>) -> Doubt {
        // Unknown right after a start: a guess that does not flatter.
        let or = |v: f64, unknown: f64| if v.is_finite() { v } else { unknown };
        let (turn, shift) = (or(angular.norm(), 0.5), or(linear.norm(), 0.5));
        let (turn_change, shift_change) = (or(self.last_change.0, turn), or(self.last_change.1, shift));
        let depth = mean_depth(tracked, &self.inliers).unwrap_or(1.0);
        let readout_s = self.shutter.sigma_s();
        let rotation = (TURN_S * turn).powi(2)
            + (TURN_CHANGE_S * turn_change).powi(2)
            + (READOUT_IN_ROTATION * readout_s * turn).powi(2);
        let translation = (READOUT_IN_TRANSLATION * readout_s * (turn * depth + shift)).powi(2)
            + (SHIFT_BY_TURN_CHANGE_S * turn_change * depth).powi(2)
            + (SHIFT_CHANGE_S * shift_change).powi(2);
        let residual = tracked.rms_px.max(0.1) / (std::f64::consts::SQRT_2 * HONEST_RESIDUAL_PX);
        Doubt { factor: TAILS * residual.powi(2), rotation: TAILS * rotation, translation: TAILS * translation }
    }
}

/// Mean depth of the landmarks that a pose rests on, map units.
fn mean_depth(tracked: &Tracked, inliers: &[Match]) -> Option<f64> {
    let sum: f64 = inliers.iter().map(|m| tracked.camera_from_world.transform(&m.point).z).sum();
    Some(sum / inliers.len() as f64).filter(|d| d.is_finite())
}

/// Inverse of the information with what it does not contain; NaN where it cannot be inverted.
fn covariance(information: &Matrix6<f64>, doubt: &Doubt) -> Matrix6<f64> {
    let Some(factor) = information.cholesky() else { return Matrix6::from_element(f64::NAN) };
    let mut covariance = factor.inverse() * doubt.factor;
    for i in 0..3 {
        covariance[(i, i)] += doubt.rotation;
        covariance[(i + 3, i + 3)] += doubt.translation;
    }
    covariance
}

/// Share of the sought landmarks that agree, less when they are few (100 are plenty).
fn quality(tracked: &Tracked) -> f32 {
    let share = tracked.landmarks as f32 / tracked.sought.max(1) as f32;
    share * (tracked.landmarks as f32 / 100.0).min(1.0)
}
