//! Where frames are, for the trajectory that is written at the end.

use super::active_map::ActiveMap;
use super::{Reconstruction, TrajectoryEvent};
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, Keyframe as KeyframeFrame, World};
use crate::map::{KeyframeId, Map, MapId};

/// A frame's place in a map, which goes where its keyframe goes.
#[derive(Debug, Clone, Copy)]
pub struct Recorded {
    pub map: MapId,
    pub keyframe: KeyframeId,
    pub keyframe_from_camera: Se3<KeyframeFrame, Camera>,
}

impl Recorded {
    /// Follows what becomes of its keyframe and its map.
    pub fn hear(&mut self, event: &TrajectoryEvent) {
        match *event {
            TrajectoryEvent::KeyframeRemoved { keyframe, parent, parent_from_keyframe, .. }
                if keyframe == self.keyframe =>
            {
                self.keyframe_from_camera = parent_from_keyframe * self.keyframe_from_camera;
                self.keyframe = parent;
            }
            TrajectoryEvent::KeyframeScaled { keyframe, scale } if keyframe == self.keyframe => {
                self.keyframe_from_camera.translation *= scale;
            }
            // It has become metric, or is a part of another one.
            TrajectoryEvent::MapJoined { map, into, scale } if map == self.map => {
                self.keyframe_from_camera.translation *= scale;
                self.map = into;
            }
            _ => {}
        }
    }

    /// Where it is now; `None` where its keyframe is not in `map`.
    pub fn camera_from_world(&self, map: &Map) -> Option<Se3<Camera, World>> {
        let world_from_keyframe = map.keyframe(self.keyframe)?.camera_from_world.inverse();
        Some((world_from_keyframe.relabel::<World, KeyframeFrame>() * self.keyframe_from_camera).inverse())
    }
}

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
