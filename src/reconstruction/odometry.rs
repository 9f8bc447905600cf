//! Where the next frame is expected, from the ones before it.

use super::Reconstruction;
use crate::geometry::Se3;
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::frames::{Camera, World};

/// Frames farther apart than this tell too little of the motion within one of them to correct a rolling shutter by it, s. (At 5 Hz
/// it still pays: hand-held and walking, errors without the correction are larger than with it.)
const MAX_SHUTTER_STEP_S: f64 = 0.3;

impl Reconstruction {
    /// Pose of the frame before and the time since, if that was tracked and not long ago.
    pub(super) fn frame_before(&self, timestamp_ns: i64) -> Option<(Se3<Camera, World>, f64)> {
        let last = self.last.as_ref().filter(|_| self.lost_frames == 0)?;
        let dt = (timestamp_ns - last.timestamp_ns) as f64 * 1e-9;
        (dt > 0.0 && dt < MAX_SHUTTER_STEP_S).then_some((last.camera_from_world, dt))
    }

    /// How the camera moved at the last frame; nothing is known of that after frames that were lost.
    pub(super) fn last_motion(&self) -> Option<CameraMotion> {
        let (motion, dt) = self.last.as_ref().filter(|_| self.lost_frames == 0)?.motion?;
        Some(CameraMotion::over(&motion, dt))
    }

    /// Constant velocity, then the last pose.
    pub(super) fn near_poses(&self, timestamp_ns: i64) -> ([Se3<Camera, World>; 2], usize) {
        let Some(last) = &self.last else { return ([Se3::identity(); 2], 0) };
        let dt = (timestamp_ns - last.timestamp_ns) as f64 * 1e-9;
        match &last.motion {
            Some((motion, over)) if self.lost_frames == 0 && dt < 5.0 * over => {
                ([motion.scaled(dt / over) * last.camera_from_world, last.camera_from_world], 2)
            }
            _ => ([last.camera_from_world; 2], 1),
        }
    }
}
