//! Where a frame is in a map that goes on changing.

use super::types::TrajectoryEvent;
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
