//! A map that was kept aside is the present one again.
//!
//! A frame that has been looked for in vain in the present map for as long as it takes until another may begin is looked for in those kept aside as well,
//! one of them every few frames: a robot that stands where it is known begins no map that could be joined to it. It must be found there as a frame is
//! that nothing speaks for but its landmarks ([`Tracked::speaks_for_itself`](crate::reconstruction::track::Tracked::speaks_for_itself)), and show a place. The map that
//! it was looked for in is kept in turn. Nor is it asked what a command merges, which is no map of this run yet, nor any while the lens is a guess: a
//! map may have been put aside as its lens was wrong.
//!
//! A map that begins beside a lost one and comes to nothing gives way to that one.
//!
//! The map has another number from then on, for numbers do not go back, and the reset counter rises.

use super::LIKELY;
use super::other_maps::{LONGEST_GAP, OtherMap, OtherMaps, WORTH_KEEPING, found_there, retire};
use crate::features::FrameFeatures;
use crate::reconstruction::Reconstruction;
use crate::reconstruction::track::Tracked;
use crate::reconstruction::track::association::Bindings;
use crate::reconstruction::track::frame::Frame;
use crate::reconstruction::types::{TrackingState, TrajectoryEvent};

impl Reconstruction {
    /// Places a frame in a map kept aside, which is the present one then.
    pub(in crate::reconstruction) fn find_in_kept(&mut self, features: &FrameFeatures) -> Option<Tracked> {
        let is_due = !self.others.kept.is_empty() && self.counters.frames >= self.others.next_attempt;
        if !is_due || !self.optics.intrinsics.is_found() {
            return None;
        }
        let OtherMaps { kept, turn, gap, next_attempt, relocaliser, .. } = &mut self.others;
        *turn += 1;
        *gap = (2 * *gap).min(LONGEST_GAP);
        *next_attempt = self.counters.frames + *gap;
        let index = *turn % kept.len();
        let other = Some(&kept[index]).filter(|other| !other.is_merged)?;
        let likely = self.loops.likely(&other.map, &features.pyramid, LIKELY);
        self.far.ask(&likely);
        let bindings = Bindings::default();
        let frame = Frame {
            features,
            map: &other.map,
            bindings: &bindings,
            camera: &self.optics.camera,
            config: &self.config,
            before: None,
            was_here: false,
            motion: None,
            shutter: &self.optics.shutter,
        };
        let placed = relocaliser.place_once(&frame, other.reference, &likely);
        let Some(placed) = placed.filter(|_| found_there(&frame, &relocaliser.tracker).is_some()) else {
            self.far.ask_ahead(relocaliser.ahead(&other.map));
            return None;
        };
        let other = self.others.kept.remove(index);
        let old = self.leave_map();
        match old.map.keyframes.len() < WORTH_KEEPING && !self.localise_only {
            true => retire(&old.map, &mut self.events),
            // There are no more of them than before.
            false => self.others.add(OtherMap::new(old)),
        }
        self.take_up(other);
        std::mem::swap(&mut self.tracker, &mut self.others.relocaliser.tracker);
        Some(placed)
    }

    /// Drops the present map, which has come to nothing. If it was begun beside one that was lost, and is not a part of it now, frames are looked for
    /// in that one again.
    pub(in crate::reconstruction) fn give_up_map(&mut self) {
        let beside = self.active.beside;
        self.end_map();
        if let Some(index) = self.others.kept.iter().position(|other| Some(other.id) == beside) {
            let other = self.others.kept.remove(index);
            self.take_up(other);
        }
    }

    /// Frames are looked for in this map from now on; there is none.
    fn take_up(&mut self, other: OtherMap) {
        let OtherMap { mut map, id, reference, mut odometry, scale, fusion, frames, is_placed, .. } = other;
        let active = &mut self.active;
        self.events.push(TrajectoryEvent::MapJoined { map: id, into: active.id, scale: 1.0 });
        map.renumber(id, active.id);
        // The lens may be known better by now.
        map.undistort_anew(&self.optics.camera);
        active.map.absorb(map);
        active.next_global = self.optics.intrinsics.next_global(active.map.keyframes.len());
        odometry.lost_frames = odometry.lost_frames.max(1);
        (active.reference, active.odometry, active.frames) = (reference, odometry, frames);
        (active.scale, active.fusion, active.is_placed) = (scale, fusion, is_placed);
        self.state = TrackingState::Lost;
    }
}
