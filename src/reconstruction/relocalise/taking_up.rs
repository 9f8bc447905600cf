//! A map that was kept aside is the present one again.
//!
//! A frame that has been looked for in vain in the present map for as long as it takes until another may begin is looked for in those kept aside as well,
//! one of them every few frames: a robot that stands where it is known begins no map that could be joined to it. It must be found there as a frame is
//! that nothing speaks for but its landmarks ([`Tracked::speaks_for_itself`]), and show a place. The map that it was looked for in is kept in turn. Not
//! asked is what a command merges, which is no map of this run yet, nor any while the lens is a guess: a map may have been put aside as its lens was wrong.
//!
//! A map that begins beside a lost one and comes to nothing gives way to that one.
//!
//! A map has the number, frame and unit that it had: what a planner has stored in it holds. The reset counter rises.

use nalgebra::Matrix6;

use super::other_maps::{LONGEST_GAP, OtherMap, OtherMaps};
use crate::features::FrameFeatures;
use crate::motion::scale::ScaleFusion;
use crate::reconstruction::Reconstruction;
use crate::reconstruction::active_map::ActiveMap;
use crate::reconstruction::track::Tracked;
use crate::reconstruction::types::TrackingState;

impl Reconstruction {
    /// Places a frame in a map kept aside, which is the present one then.
    pub(in crate::reconstruction) fn find_in_kept(&mut self, features: &FrameFeatures) -> Option<Tracked> {
        let OtherMaps { kept, turn, gap, next_attempt, .. } = &mut self.others;
        let own = || kept.iter().enumerate().filter(|(_, other)| !other.is_merged);
        let (index, other) = own().nth(*turn % own().count().max(1))?;
        if self.counters.frames < *next_attempt || !self.optics.intrinsics.is_found() {
            return None;
        }
        *turn += 1;
        *gap = (2 * *gap).min(LONGEST_GAP);
        *next_attempt = self.counters.frames + *gap;
        // No keyframe of the present map: called as where it is looked for.
        let called = other.own.reference;
        let likely = self.likely_in(index, features);
        let (placed, _) = self.look_in(index, features, (called, None), &likely)?;
        let other = self.others.kept.remove(index);
        let old = self.leave_map();
        // There are no more of them than before.
        self.others.add(OtherMap::new(old));
        self.take_up(other.own);
        std::mem::swap(&mut self.tracker, &mut self.others.relocaliser.tracker);
        Some(placed)
    }

    /// Drops the present map, which has come to nothing. If it was begun beside one that was lost, and is not a part of it now, frames are looked for
    /// in that one again.
    pub(in crate::reconstruction) fn give_up_map(&mut self) {
        let beside = self.active.beside;
        self.end_map();
        if let Some(index) = self.others.kept.iter().position(|other| Some(other.own.id) == beside) {
            let other = self.others.kept.remove(index);
            self.take_up(other.own);
        }
    }

    /// Frames are looked for in this map from now on; there is none.
    fn take_up(&mut self, other: ActiveMap) {
        let ActiveMap { mut map, id, reference, mut odometry, scale, fusion, frames, is_placed, .. } = other;
        let active = &mut self.active;
        // Ids go on after those of the maps that were there meanwhile.
        map.absorb(std::mem::take(&mut active.map));
        // The lens may be known better by now.
        map.undistort_anew(&self.optics.camera);
        active.next_global = self.optics.intrinsics.next_global(map.keyframes.len());
        odometry.lost_frames = odometry.lost_frames.max(1);
        (active.map, active.id, active.reference) = (map, id, reference);
        (active.odometry, active.frames, active.scale, active.is_placed) = (odometry, frames, scale, is_placed);
        // Who has told the scale says the same again before long: that is no second word.
        active.fusion = if fusion.is_metric() { ScaleFusion::of_stored(fusion.scale()) } else { fusion };
        // Of the map before are where the floor and tags lie, and how surely the last frame was placed.
        self.blind.covariance = Matrix6::from_element(f64::NAN);
        if let Some(floor) = &mut self.floor {
            floor.forget();
        }
        if let Some(tags) = &mut self.tags {
            tags.forget();
        }
        self.state = TrackingState::Lost;
    }
}
