//! The reconstruction stage's part of the wire: poses, pictures, map and keyframes of one run.

use crate::config::MountConfig;
use crate::features::FrameFeatures;
use crate::frame::Clock;
use crate::publish::{
    Conversion, FramePublisher, FrameStamp, MapContext, MapPublisher, PosePublisher, PublishError, ScaleEstimate,
};
use crate::reconstruction::{MapSnapshot, PoseEstimate};

/// Sends without ever waiting for a reader.
#[derive(Debug)]
pub struct Outlet {
    poses: PosePublisher,
    map: MapPublisher,
    frames: FramePublisher,
    conversion: Conversion,
}

impl Outlet {
    /// `clock`: what the source's timestamps count from.
    pub fn new(
        poses: PosePublisher,
        map: MapPublisher,
        frames: FramePublisher,
        mount: &MountConfig,
        clock: Clock,
    ) -> Self {
        let conversion =
            Conversion { body_from_camera: mount.body_from_camera(), scale: ScaleEstimate::Unknown, clock };
        Self { poses, map, frames, conversion }
    }

    /// One frame's pose, or its lack of one. `frames_dropped`: frames of this run that were never looked at.
    pub fn pose(&mut self, estimate: &PoseEstimate, frames_dropped: u64) -> Result<(), PublishError> {
        self.poses.publish(estimate, &self.conversion, frames_dropped).map(|_| ())
    }

    /// Takes the next pose's memory in advance, so that publishing it allocates nothing.
    pub fn prepare(&mut self) {
        self.poses.prepare();
    }

    /// The frame's grey picture, if anybody subscribes to it.
    pub fn frame(&mut self, features: &FrameFeatures) -> Result<(), PublishError> {
        let Some(picture) = features.pyramid.levels.first() else { return Ok(()) };
        let stamp = FrameStamp {
            sequence: features.sequence,
            timestamp_ns: features.timestamp_ns,
            arrival_ns: features.arrival_ns,
            clock: self.conversion.clock,
        };
        self.frames.publish(picture, &stamp).map(|_| ())
    }

    /// It is time for another map message.
    pub fn map_is_due(&self, now_ns: i64) -> bool {
        self.map.is_due(now_ns)
    }

    /// The map and its keyframes.
    pub fn map(&mut self, map: &MapSnapshot, context: &MapContext) -> Result<(), PublishError> {
        self.map.publish(map, &self.conversion, context)
    }
}
