//! How a map ends and the next one begins.

use super::active_map::ActiveMap;
use super::odometry::Odometry;
use super::optics::Optics;
use super::relocalise::other_maps::{OtherMap, retire};
use super::second_look::kept::SecondLook;
use super::track::Tracker;
use super::types::{PoseEstimate, TrackingState};
use super::{LensPrior, Pending, Reconstruction};
use crate::features::FrameFeatures;
use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::map::KeyframeId;

impl Reconstruction {
    /// Drops all maps and starts over at the next frame. Maps that are only located in stay: the next frame is looked for in them as after a loss.
    pub fn reset(&mut self) {
        if self.localise_only {
            return self.forget_place();
        }
        let others = std::mem::take(&mut self.others);
        // No pose of this run hangs on what waits to be merged.
        others.kept.iter().filter(|other| !other.is_merged).for_each(|other| retire(&other.own.map, &mut self.events));
        self.end_map();
    }

    /// Poses from here on have nothing to do with those before; the maps are what they were.
    pub(super) fn forget_place(&mut self) {
        self.active.bindings.clear();
        self.end_checks();
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
        self.keep_aside(old);
    }

    /// Keeps a map, for the next one to be joined to; others may have to go for it.
    pub(super) fn keep_aside(&mut self, old: ActiveMap) {
        let gone = self.others.keep(OtherMap::new(old), self.config.max_keyframes);
        gone.iter().for_each(|map| retire(map, &mut self.events));
    }

    /// Starts over; returns the map that was.
    pub(super) fn leave_map(&mut self) -> ActiveMap {
        self.discard_job();
        self.contradiction.end();
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

    /// What the picture has said of the map until now holds no more: it was moved, is another one, or stays as it is.
    pub(super) fn end_checks(&mut self) {
        self.active.probation.end();
        self.contradiction.end();
    }

    /// Whether most of the picture has said for a second that the poses are wrong; then what the map has grown by since is dropped, and nothing is
    /// known of where the camera is.
    pub(super) fn is_contradicted(&mut self, features: &FrameFeatures, pose: &Se3<Camera, World>) -> bool {
        let Self { optics: Optics { camera, shutter, intrinsics, .. }, active, contradiction, .. } = self;
        let next = KeyframeId(active.map.keyframes.next_id());
        // The error of a lens that is a guess bends the picture.
        let told = intrinsics.is_found().then(|| contradiction.doubtful_since(features, pose, (camera, shutter), next));
        let Some(first) = told.flatten() else { return false };
        self.counters.contradictions += 1;
        if !self.localise_only {
            self.drop_keyframes_since(first);
        }
        self.forget_place();
        true
    }

    /// Without these keyframes, and what only they have seen. Frames that were recorded relative to them have no pose any more; those of the same time
    /// that were recorded relative to older ones keep theirs.
    fn drop_keyframes_since(&mut self, first: KeyframeId) {
        self.discard_job();
        if let Some(floor) = &mut self.floor {
            floor.forget();
        }
        let active = &mut self.active;
        let doubtful: Vec<_> = active.map.keyframes.ids_from(first.0).map(KeyframeId).collect();
        for id in doubtful {
            active.map.remove_keyframe(id);
        }
        // Adjustments have bent what is left, too.
        active.unadjusted = active.map.newest();
        let left = || active.map.keyframes.iter().next().map(|(id, _)| KeyframeId(id));
        active.reference = active.map.newest().or_else(left).unwrap_or(active.reference);
    }

    /// Starts over with another camera model: the pictures have another size now, or the camera was calibrated.
    pub fn change_camera(&mut self, camera: &CameraModel, prior: LensPrior) {
        self.reset();
        self.second_look = SecondLook::new(prior);
        self.optics = Optics::new(camera, prior, &self.config);
        if let Some(tags) = &mut self.tags {
            tags.forget();
        }
        if let Some(floor) = &mut self.floor {
            floor.forget();
        }
    }
}
