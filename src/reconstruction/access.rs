//! What can be asked of a reconstruction between frames. Cost: what is returned, nothing else.

use std::path::Path;

use super::dead_reckoning::DeadReckoning;
use super::types::{Counters, TrackingState, TrajectoryEvent};
use super::{Corrections, LensEstimate, Reconstruction};
use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::map::{KeyframeId, KeyframeView, LandmarkId, MapId};
use crate::motion::floor::{NoFloor, Plane};
use crate::motion::scale::ScaleMeasurement;

impl Reconstruction {
    /// Events since the last call, in order; to be drained after every frame.
    pub fn take_trajectory_events(&mut self, out: &mut Vec<TrajectoryEvent>) {
        self.second_look.hear(&self.events);
        self.surroundings.hear(&self.events);
        out.append(&mut self.events);
    }

    /// Condensed pictures far from the robot may lie in this folder from now on.
    pub fn spool_pictures(&mut self, folder: &Path) {
        self.far.spool_in(folder);
    }

    /// Why a picture was not written or read, when that was counted last.
    pub fn picture_fault(&self) -> &str {
        &self.far.reason
    }

    /// Poses of all maps' keyframes, for the trajectory written at the end; those of maps that were dropped came as events.
    pub fn keyframe_poses(&self) -> Vec<(KeyframeId, Se3<World, Camera>)> {
        let maps = std::iter::once(&self.active.map).chain(self.others.maps());
        maps.flat_map(|map| map.keyframes.iter())
            .map(|(id, k)| (KeyframeId(id), k.camera_from_world.inverse()))
            .collect()
    }

    /// A keyframe of the current map, if it is there.
    pub fn keyframe(&self, id: KeyframeId) -> Option<KeyframeView> {
        self.active.map.keyframe(id).map(|k| KeyframeView {
            id,
            timestamp_ns: k.timestamp_ns,
            world_from_camera: k.camera_from_world.inverse(),
        })
    }

    /// The last frame's pose lies in or behind a turn on the spot, and its distance from there is that of an assumption.
    pub fn scale_is_assumed(&self) -> bool {
        let through = self.active.part();
        let behind = through.is_some_and(|turn| self.active.scale.is_assumed(turn));
        self.state == TrackingState::Tracking && (behind || self.rests_on_assumed())
    }

    /// What tags of a known size say of the present map's scale; the newest measurement contains those before.
    pub fn scale_by_tags(&self) -> Option<ScaleMeasurement> {
        self.tags.as_ref()?.measurement(self.active.id)
    }

    /// The floor around the newest keyframes, in the present map's unit.
    pub fn floor(&self) -> Option<&Plane> {
        self.floor.as_ref()?.plane(self.active.id)
    }

    /// Why the newest keyframe tells no floor, where one is looked for.
    pub fn no_floor(&self) -> Option<NoFloor> {
        self.floor.as_ref()?.refused()
    }

    /// Landmarks that the last frame's pose rests on, and where they were found in its picture, px; none unless it was tracked.
    pub fn matches(&self) -> impl Iterator<Item = (LandmarkId, [f32; 2])> {
        let tracked = self.state == TrackingState::Tracking;
        self.tracker.matches().iter().filter(move |_| tracked).map(|m| (m.landmark, [m.pixel.x, m.pixel.y]))
    }

    pub fn counters(&self) -> Counters {
        let DeadReckoning { total_ns, total_m, continued, .. } = self.blind;
        Counters { blind_ns: total_ns, blind_mm: (1e3 * total_m) as u64, blind_starts: continued, ..self.counters }
    }

    pub fn state(&self) -> TrackingState {
        self.state
    }

    /// How often map coordinates were corrected beyond ordinary adjustment, and how far the last time.
    pub fn corrections(&self) -> Corrections {
        self.corrections
    }

    /// The map that frames are placed in.
    pub fn map_id(&self) -> MapId {
        self.active.id
    }

    /// Maps that are kept, the current one among them.
    pub fn maps(&self) -> usize {
        self.others.kept.len() + 1
    }

    /// How often poses, and orientations before a map, became unrelated to earlier ones; of the map as it is now.
    pub fn reset_counter(&self) -> u32 {
        (self.counters.resets as u32).wrapping_add(self.orientation.restarts)
    }

    /// The camera as it is believed now: its focal length is refined from the motion.
    pub fn camera(&self) -> &CameraModel {
        &self.optics.camera
    }

    /// The lens as it is believed now, and how surely.
    pub fn lens(&self) -> LensEstimate {
        self.optics.intrinsics.estimate(&self.optics.camera)
    }

    /// Readout time of the camera's rolling shutter as it is believed now, s.
    pub fn readout_s(&self) -> f64 {
        self.optics.shutter.readout_s
    }
}
