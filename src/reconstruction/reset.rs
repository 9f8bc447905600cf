//! How a map ends and the next one begins.

use super::active_map::ActiveMap;
use super::odometry::Odometry;
use super::optics::Optics;
use super::relocalise::other_maps::{OtherMap, retire};
use super::track::Tracker;
use super::types::{PoseEstimate, TrackingState};
use super::{LensPrior, Pending, Reconstruction};
use crate::features::FrameFeatures;
use crate::geometry::CameraModel;

impl Reconstruction {
    /// Drops all maps and starts over at the next frame. Maps that are only located in stay: the next frame is looked for in them as after a loss.
    pub fn reset(&mut self) {
        if self.localise_only {
            return self.forget_place();
        }
        let others = std::mem::take(&mut self.others);
        // No pose of this run hangs on what waits to be merged.
        others.kept.iter().filter(|other| !other.is_merged).for_each(|other| retire(&other.map, &mut self.events));
        self.end_map();
    }

    /// Poses from here on have nothing to do with those before; the maps are what they were.
    pub(super) fn forget_place(&mut self) {
        self.active.bindings.clear();
        self.active.probation.end();
        // As in a map that was loaded: nothing speaks for a frame but its landmarks.
        self.active.odometry = Odometry { lost_frames: 1, ..Odometry::default() };
        self.wheels.begin_map();
        self.blind.see();
        self.tracker = Tracker::default();
        self.pending = Pending::default();
        self.state = TrackingState::Lost;
        self.counters.resets += 1;
    }

    /// Drops the present map.
    pub(super) fn end_map(&mut self) {
        retire(&self.active.map, &mut self.events);
        self.leave_map();
    }

    /// A frame that is in no map: perhaps the one that another begins with.
    pub(super) fn begin_anew(&mut self, features: &FrameFeatures) -> PoseEstimate {
        match self.state {
            TrackingState::Initializing => self.try_start(features),
            _ => self.begin_beside(features),
        }
    }

    /// Puts the present map aside, for the next one to be joined to, and starts over.
    pub(super) fn put_aside(&mut self) {
        let old = self.leave_map();
        let gone = self.others.keep(OtherMap::new(old), self.config.max_keyframes);
        gone.iter().for_each(|map| retire(map, &mut self.events));
    }

    /// Starts over; returns the map that was.
    pub(super) fn leave_map(&mut self) -> ActiveMap {
        self.discard_job();
        self.optics.intrinsics.end_map(&self.optics.camera);
        let next = self.active.successor();
        let old = std::mem::replace(&mut self.active, next);
        self.wheels.begin_map();
        self.blind.see();
        self.corrections.end_map();
        self.initialiser.clear();
        self.orientation.clear();
        self.tracker = Tracker::default();
        self.pending = Pending::default();
        self.state = TrackingState::Initializing;
        self.counters.resets += 1;
        old
    }

    /// Starts over with another camera model: the pictures have another size now, or the camera was calibrated.
    pub fn change_camera(&mut self, camera: &CameraModel, prior: LensPrior) {
        self.reset();
        self.optics = Optics::new(camera, prior, &self.config);
        if let Some(tags) = &mut self.tags {
            tags.forget();
        }
        if let Some(floor) = &mut self.floor {
            floor.forget();
        }
    }
}
