//! Pictures that were seen through a wrong lens are mapped again.
//!
//! A camera that nobody has calibrated begins with a usual angle of view. Where its own is far from that, and only a turn shows it, a map has grown by
//! then whose landmarks were chosen and whose outliers were judged with the wrong lens: the next map begins with a better one
//! ([`intrinsics`](super::adjust::intrinsics)). So that what was seen before does not get lost, the pictures of keyframes are kept while the lens is
//! unknown. Once it is known, a reconstruction of its own maps them again, the newest first: those of the present map's keyframes, by which the new map is
//! joined to that one, and on from there to the first. Frames between them are recorded anew: each follows what has become of the keyframe before it and of the
//! one after it.
//!
//! In: pictures of keyframes, the lens that was found. Out: one map instead of several; nothing where too few pictures are placed again.
//!
//! Cost: 24 MB of memory and no time while the lens is unknown; then some 10 ms a picture on the mapping worker, a few pictures between two
//! adjustments. A calibrated camera pays nothing.
//!
//! Not here: pictures between the keyframes; what is still to be looked at when the run ends; a map that somebody has said where the robot is in, which stays
//! as it is; large pictures, of which too few have room. Corners are found by the usual detector, whatever the configuration says.

pub mod kept;
mod moved;
mod remapping;

use std::any::Any;

use super::adjust::intrinsics::MODEL_FLOOR;
use super::adjust::job::Piece;
use super::recorded::Recorded;
use super::relocalise::other_maps::{OtherMap, OtherMaps, retire};
use super::{Reconstruction, TrajectoryEvent};
use crate::geometry::frames::Camera;
use crate::map::{KeyframeId, MapId};
use kept::{Frame, Kept};
use moved::{Moves, Placed};
use remapping::{Again, Remapping};

/// Published standard deviation of log focal length from which on the lens is known well enough: what this lens model leaves out is half of it.
const SURE: f64 = 2.0 * MODEL_FLOOR;
/// Keyframes of the present map that it is joined by, at the least: the first ones looked at make the start of the new map.
const IN_COMMON: usize = 8;
/// Share of the pictures of a map that must have a place in the new one, or it stays aside.
const MIN_PLACED: f64 = 0.8;

impl Reconstruction {
    /// Keeps pictures while the lens is unknown; once it is known they are looked at again if a map was begun with a wrong one.
    pub(super) fn keep_for_second_look(&mut self) {
        let Self { optics, active, others, second_look, config, .. } = self;
        let Some(kept) = second_look.keeping() else { return };
        kept.keep(active);
        if !optics.intrinsics.is_found() {
            return;
        }
        kept.begun_wrongly.retain(|id| can_be_moved(others, *id));
        if kept.begun_wrongly.is_empty() {
            second_look.end();
            return;
        }
        let is_there = |of: &Frame| of.map == active.id && active.map.keyframe(of.keyframe).is_some();
        let in_common = kept.seen.iter().filter(|(of, _)| is_there(of)).count();
        if in_common >= IN_COMMON && optics.intrinsics.published_focal_sigma() <= SURE {
            let mut pictures = std::mem::take(&mut kept.seen);
            pictures.retain(|(of, _)| of.map == active.id || kept.begun_wrongly.contains(&of.map));
            second_look.begin(Box::new(Remapping::new(pictures, active, optics, config)));
        }
    }

    /// The present map is about to be put aside, as its lens was wrong.
    pub(super) fn note_begun_wrongly(&mut self) {
        if let Some(kept) = self.second_look.keeping() {
            kept.begun_wrongly.push(self.active.id);
        }
    }

    /// Some pictures were looked at again; after the last one the map that they made is joined to the present one.
    pub(super) fn take_over_second_look(&mut self, look: Box<dyn Piece>) {
        let Some(look) = self.second_look.take_done(look) else { return };
        let mut kept = self.second_look.end();
        // What nobody has fetched yet.
        self.events.iter().for_each(|event| kept.hear(event));
        let Kept { mut begun_wrongly, frames, .. } = kept;
        begun_wrongly.retain(|id| can_be_moved(&self.others, *id));
        if begun_wrongly.is_empty() || self.localise_only {
            return;
        }
        let new = MapId(self.active.next_id.0.max(self.active.id.0 + 1));
        // No other piece is ever posted.
        let Ok(look) = (look as Box<dyn Any>).downcast::<Remapping>() else { return };
        let Again { active, looked_at, placed, sightings, told } = look.finish(new, &self.active.map);
        begun_wrongly.retain(|map| {
            let asked = looked_at.iter().filter(|frame| frame.map == *map).count();
            let found = placed.iter().filter(|place| place.map == *map).count();
            asked > 0 && found as f64 >= MIN_PLACED * asked as f64
        });
        let Some(told) = told.filter(|_| !begun_wrongly.is_empty()) else { return };
        let in_both: Vec<KeyframeId> = sightings.iter().map(|s| s.keyframe).collect();
        // Nobody has ever been told where it is, so it follows the present one as a merged map does.
        let other = OtherMap { sightings, is_merged: true, ..OtherMap::new(active) };
        self.active.next_id = MapId(new.0 + 1);
        self.loops.expect_more(&other.own.map);
        self.join(other, &told.present_from_other, told.log_scale_sigma);
        for id in begun_wrongly {
            let Some(index) = self.others.kept.iter().position(|other| other.own.id == id) else { continue };
            let old = self.others.kept.remove(index);
            match Moves::of(&placed, &old, &self.active.map, told.present_from_other.scale) {
                None => self.others.kept.insert(index, old),
                Some(moves) => self.record_anew(&frames, &old, &moves),
            }
        }
        self.drop_twins(&in_both, &placed);
    }

    /// Keyframes of the present map have taken over what their twins in the new one see.
    fn drop_twins(&mut self, in_both: &[KeyframeId], placed: &[Placed]) {
        let map = &mut self.active.map;
        for place in placed.iter().filter(|place| in_both.contains(&place.keyframe)) {
            let time = |id: KeyframeId| map.keyframe(id).map(|k| k.timestamp_ns);
            let is_twin = place.parent != place.keyframe && time(place.parent) == time(place.keyframe);
            let is_needed = placed.iter().any(|p| p.parent == place.parent && !in_both.contains(&p.keyframe));
            if is_twin && !is_needed {
                map.remove_keyframe(place.parent);
            }
        }
    }

    /// Records where the frames of a map that was begun wrongly are in the present one.
    fn record_anew(&mut self, frames: &[(i64, Recorded)], old: &OtherMap, moves: &Moves<'_>) {
        // What was recorded before has a place of its own, in the map that is no more, until it is replaced.
        retire(&old.own.map, &mut self.events);
        let map = self.active.id;
        for (timestamp_ns, frame) in frames.iter().filter(|(_, frame)| frame.map == old.own.id) {
            let Some(keyframe) = old.own.map.keyframe(frame.keyframe) else { continue };
            let before = keyframe.camera_from_world.inverse() * frame.keyframe_from_camera.relabel::<Camera, Camera>();
            let Some((now, parent)) = moves.follow(*timestamp_ns, &before) else { continue };
            let Some(beside) = self.active.map.keyframe(parent) else { continue };
            self.events.push(TrajectoryEvent::Pose {
                timestamp_ns: *timestamp_ns,
                map,
                keyframe: parent,
                keyframe_from_camera: (beside.camera_from_world * now).relabel(),
            });
        }
        self.events.push(TrajectoryEvent::MapJoined { map: old.own.id, into: map, scale: 1.0 });
    }
}

/// A map kept aside that has not become a part of another one yet, and that nobody's goals lie in.
fn can_be_moved(others: &OtherMaps, id: MapId) -> bool {
    others.kept.iter().any(|other| other.own.id == id && !other.own.is_placed)
}
