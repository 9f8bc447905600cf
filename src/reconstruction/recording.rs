//! Where frames are, for the trajectory that is written at the end.

use super::active_map::ActiveMap;
use super::{Reconstruction, TrajectoryEvent};
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, Keyframe as KeyframeFrame, World};

impl Reconstruction {
    /// The frame's place relative to its reference keyframe, for the trajectory that is written at the end.
    pub(super) fn record_pose(&mut self, timestamp_ns: i64, pose: &Se3<Camera, World>) {
        let ActiveMap { map, id, reference, .. } = &self.active;
        let Some(k) = map.keyframe(*reference) else { return };
        let keyframe_from_camera = (k.camera_from_world * pose.inverse()).relabel::<KeyframeFrame, Camera>();
        self.events.push(TrajectoryEvent::Pose { timestamp_ns, map: *id, keyframe: *reference, keyframe_from_camera });
    }

    /// The pose of the frame just recorded is this one.
    pub(super) fn record_instead(&mut self, timestamp_ns: i64, pose: &Se3<Camera, World>) {
        if matches!(self.events.last(), Some(TrajectoryEvent::Pose { timestamp_ns: last, .. }) if *last == timestamp_ns)
        {
            self.events.pop();
            self.record_pose(timestamp_ns, pose);
        }
    }
}
