//! What one frame's tracking reads, and what the map says of the frame's landmarks.

use super::association::Bindings;
use crate::features::FrameFeatures;
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::map::{LandmarkId, Map};
use crate::reconstruction::config::ReconstructionConfig;
use crate::reconstruction::measurement::Correspondence;
use crate::reconstruction::measurement::inverse_distance::Ray;
use crate::reconstruction::measurement::rolling_shutter::Shutter;

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
    /// The map is the one that is tracked in, and a frame of this run was tracked in it, if not the one before: the camera is likely to be in it still.
    pub was_here: bool,
    /// Motion that is expected: that of the frame before, else by the wheels.
    pub motion: Option<CameraMotion>,
    pub shutter: &'a Shutter,
    /// Squared residual, in units of `config.sigma_px`, beyond which a place is an outlier.
    pub outlier_chi2: f64,
}

/// Motion from the frame before to `pose`.
pub fn motion_since(frame: &Frame<'_>, pose: &Se3<Camera, World>) -> Option<CameraMotion> {
    let (before, dt) = frame.before.as_ref()?;
    Some(CameraMotion::over(&(*pose * before.inverse()), *dt))
}

/// The pair, weighed by what is known of its landmark: of one at an assumed distance only the ray, and the distance is eliminated anew at every pose; else it
/// is whitened once, with the landmark's covariance as it shows at `pose`. (Without what is known of landmarks two of 35 sequences lose a third of their frames, and a car's errors
/// double.)
pub fn measurement_of(
    frame: &Frame<'_>,
    landmark: LandmarkId,
    pose: &Se3<Camera, World>,
    pair: Correspondence,
) -> Correspondence {
    let Some(known) = frame.map.landmark(landmark) else { return pair };
    match Ray::of(landmark, frame.map, frame.shutter.readout_s) {
        Some(ray) => Correspondence { ray: Some(ray), ..pair },
        None => pair.with_uncertain_point(pose, &known.covariance),
    }
}
