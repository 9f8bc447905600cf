//! What one frame's tracking reads, and what the map says of the frame's landmarks.

use nalgebra::{Vector2, Vector3};

use super::association::Bindings;
use super::search::Match;
use crate::features::FrameFeatures;
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::map::{LandmarkId, Map};
use crate::reconstruction::config::ReconstructionConfig;
use crate::reconstruction::measurement::inverse_distance::Ray;
use crate::reconstruction::measurement::rolling_shutter::Shutter;
use crate::reconstruction::measurement::{PosePair, jacobian_rows};

/// Between two frames of a quick turn the camera turns by more than this, rad: what comes into view has left it a few frames later.
pub const QUICK_TURN_RAD: f64 = 0.05;

/// Everything that one frame's tracking reads.
#[derive(Clone, Copy)]
pub struct Frame<'a> {
    pub features: &'a FrameFeatures,
    pub map: &'a Map,
    pub bindings: &'a Bindings,
    pub camera: &'a CameraModel,
    pub config: &'a ReconstructionConfig,
    /// Pose of the frame before and how long ago it was taken (s), if it was tracked just before.
    pub before: Option<(Se3<Camera, World>, f64)>,
    /// Motion that is expected (that of the frame before).
    pub motion: Option<CameraMotion>,
    pub shutter: &'a Shutter,
    /// The lens is not one that is still being found.
    pub is_calibrated: bool,
}

/// Motion from the frame before to `pose`.
pub fn motion_since(frame: &Frame<'_>, pose: &Se3<Camera, World>) -> Option<CameraMotion> {
    let (before, dt) = frame.before.as_ref()?;
    Some(CameraMotion::over(&(*pose * before.inverse()), *dt))
}

pub fn is_assumed(frame: &Frame<'_>, landmark: LandmarkId) -> bool {
    frame.map.landmark(landmark).is_some_and(|l| l.assumed.is_some())
}

/// The pair with the landmark's distance eliminated, if that is assumed.
pub fn without_distance(
    frame: &Frame<'_>,
    landmark: LandmarkId,
    pose: &Se3<Camera, World>,
    pair: &PosePair,
) -> Option<PosePair> {
    let ray = Ray::of(landmark, frame.map, frame.shutter.readout_s)?;
    ray.eliminate(pose, pair)
}

/// Variance of a match's place that comes from its landmark's own uncertainty, px^2 in x and y; `p`: the landmark in the
/// coordinates of the camera at `pose`. Zero where it is not known.
pub fn landmark_variance(frame: &Frame<'_>, pose: &Se3<Camera, World>, m: &Match, p: &Vector3<f64>) -> Vector2<f64> {
    let Some(landmark) = frame.map.landmark(m.landmark).filter(|_| p.z > 1e-6) else { return Vector2::zeros() };
    let (jx, jy) = jacobian_rows(p, &frame.camera.pixel_scale(&(p.xy() / p.z)));
    let world_from_camera = pose.rotation.inverse();
    let variance = |j: &[f64; 6]| {
        let a = world_from_camera * Vector3::new(j[3], j[4], j[5]);
        a.dot(&(landmark.covariance * a))
    };
    let own = Vector2::new(variance(&jx), variance(&jy));
    if own.iter().all(|v| v.is_finite() && *v >= 0.0) { own } else { Vector2::zeros() }
}
