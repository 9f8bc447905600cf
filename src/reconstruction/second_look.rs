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
//! Cost: [`MOST_BYTES`] of memory and no time while the lens is unknown; then some 10 ms a picture on the mapping worker, a few pictures between two
//! adjustments. A calibrated camera pays nothing.
//!
//! Not here: pictures between the keyframes; what is still to be looked at when the run ends; a map that somebody has said where the robot is in, which stays
//! as it is. Corners are found by the usual detector, whatever the configuration says.

mod moved;
mod remapping;

use super::active_map::ActiveMap;
use super::adjust::intrinsics::{LensPrior, MODEL_FLOOR};
use super::adjust::job::MappingJob;
use super::relocalise::other_maps::{OtherMap, OtherMaps, retire};
use super::{Reconstruction, TrajectoryEvent};
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, Keyframe as KeyframeFrame};
use crate::image::GreyImage;
use crate::map::{Keyframe, KeyframeId, MapId};
use moved::{Moved, follow, moved};
use remapping::Placed;
pub use remapping::Remapping;

/// Pictures that are kept, bytes at the most: 80 keyframes of 640x480; beyond it every second one goes.
const MOST_BYTES: usize = 24 << 20;
/// Published standard deviation of log focal length from which on the lens is known well enough: what this lens model leaves out is half of it.
const SURE: f64 = 2.0 * MODEL_FLOOR;
/// Keyframes of the present map that it is joined by, at the least: the first ones looked at make the start of the new map.
const IN_COMMON: usize = 8;
/// Frames after which nobody waits for the lens any more: eleven minutes at 30 frames a second.
const MOST_FRAMES: usize = 20_000;
/// Share of the pictures of before that must have a place in the new map.
const MIN_PLACED: f64 = 0.8;

/// The frame that became a keyframe.
#[derive(Debug, Clone, Copy)]
pub struct Frame {
    map: MapId,
    keyframe: KeyframeId,
    sequence: u64,
    timestamp_ns: i64,
}

/// How far it has come.
pub enum SecondLook {
    /// The lens is not known yet.
    Keeping(Kept),
    /// Some pictures are still to be looked at; `rests`: an adjustment goes first.
    Waiting {
        work: Box<Remapping>,
        rests: bool,
    },
    WithWorker,
    /// Nothing is left to do: the lens is known, or it does not come.
    Over,
}

/// A frame's place in the map as it was recorded.
#[derive(Debug, Clone, Copy)]
pub struct Recorded {
    map: MapId,
    timestamp_ns: i64,
    keyframe: KeyframeId,
    keyframe_from_camera: Se3<KeyframeFrame, Camera>,
}

/// What is kept for it.
#[derive(Debug, Default)]
pub struct Kept {
    /// In the order in which they were made.
    seen: Vec<(Frame, GreyImage)>,
    /// Keyframes with smaller numbers have been asked for their pictures.
    next: u32,
    frames: Vec<Recorded>,
    /// Maps that were put aside as their lens was wrong.
    begun_wrongly: Vec<MapId>,
}

impl SecondLook {
    pub fn new(prior: LensPrior) -> Self {
        match prior {
            LensPrior::Calibrated => Self::Over,
            LensPrior::Guess { .. } => Self::Keeping(Kept::default()),
        }
    }

    /// Hears what is recorded of frames.
    pub fn hear(&mut self, events: &[TrajectoryEvent]) {
        let Self::Keeping(kept) = self else { return };
        events.iter().for_each(|event| kept.hear(event));
        if kept.frames.len() > MOST_FRAMES {
            *self = Self::Over;
        }
    }

    /// The present map is put aside, as its lens was wrong.
    pub fn note_begun_wrongly(&mut self, map: MapId) {
        if let Self::Keeping(kept) = self {
            kept.begun_wrongly.push(map);
        }
    }

    pub fn is_with_worker(&self) -> bool {
        matches!(self, Self::WithWorker)
    }

    /// The next piece for the worker; `is_alone`: no adjustment waits for it.
    pub fn next_piece(&mut self, is_alone: bool) -> Option<MappingJob> {
        let Self::Waiting { rests, .. } = self else { return None };
        if std::mem::take(rests) && !is_alone {
            return None;
        }
        let Self::Waiting { work, .. } = std::mem::replace(self, Self::WithWorker) else { return None };
        Some(MappingJob::Remap(work))
    }
}

impl Kept {
    fn hear(&mut self, event: &TrajectoryEvent) {
        let on = |id: KeyframeId| move |frame: &&mut Recorded| frame.keyframe == id;
        match *event {
            TrajectoryEvent::Pose { timestamp_ns, map, keyframe, keyframe_from_camera } => {
                self.frames.push(Recorded { map, timestamp_ns, keyframe, keyframe_from_camera });
            }
            TrajectoryEvent::KeyframeRemoved { keyframe, parent, parent_from_keyframe, .. } => {
                self.frames.iter_mut().filter(on(keyframe)).for_each(|frame| {
                    frame.keyframe_from_camera = parent_from_keyframe * frame.keyframe_from_camera;
                    frame.keyframe = parent;
                });
            }
            TrajectoryEvent::KeyframeScaled { keyframe, scale } => {
                let frames = self.frames.iter_mut().filter(on(keyframe));
                frames.for_each(|frame| frame.keyframe_from_camera.translation *= scale);
            }
            // It has become metric, or is a part of another one.
            TrajectoryEvent::MapJoined { map, into, .. } => {
                let frames = self.frames.iter_mut().map(|frame| &mut frame.map);
                let pictures = self.seen.iter_mut().map(|(of, _)| &mut of.map);
                let maps = frames.chain(pictures).chain(&mut self.begun_wrongly);
                maps.filter(|of| **of == map).for_each(|of| *of = into);
            }
            TrajectoryEvent::KeyframeRetired { .. } => {}
        }
    }

    /// Takes the pictures of the keyframes that have been made since the last time.
    fn keep(&mut self, active: &ActiveMap) {
        for id in active.map.keyframes.ids_from(self.next).map(KeyframeId) {
            let Some(Keyframe { sequence, timestamp_ns, picture, .. }) = active.map.keyframe(id) else { continue };
            let Some(finest) = picture.whole().and_then(|pyramid| pyramid.levels.first()) else { continue };
            let (sequence, timestamp_ns) = (*sequence, *timestamp_ns);
            self.seen.push((Frame { map: active.id, keyframe: id, sequence, timestamp_ns }, finest.clone()));
        }
        self.next = active.map.keyframes.next_id();
        let bytes = |seen: &[(Frame, GreyImage)]| seen.iter().map(|(_, picture)| picture.data.len()).sum::<usize>();
        while self.seen.len() > 1 && bytes(&self.seen) > MOST_BYTES {
            let mut stays = false;
            self.seen.retain(|_| {
                stays = !stays;
                stays
            });
        }
    }
}

impl Reconstruction {
    /// Keeps pictures while the lens is unknown; once it is known they are looked at again if a map was begun with a wrong one.
    pub(super) fn keep_for_second_look(&mut self) {
        let Self { optics, active, others, second_look, config, events, .. } = self;
        let SecondLook::Keeping(kept) = second_look else { return };
        kept.keep(active);
        if !optics.intrinsics.is_found() {
            return;
        }
        kept.begun_wrongly.retain(|id| can_be_moved(others, *id));
        if kept.begun_wrongly.is_empty() {
            *second_look = SecondLook::Over;
            return;
        }
        let is_there = |of: &Frame| of.map == active.id && active.map.keyframe(of.keyframe).is_some();
        let in_common = kept.seen.iter().filter(|(of, _)| is_there(of)).count();
        if in_common >= IN_COMMON && optics.intrinsics.published_focal_sigma() <= SURE {
            // What nobody has fetched yet.
            events.iter().for_each(|event| kept.hear(event));
            let work = Remapping::new(std::mem::take(kept), active, optics, config);
            *second_look = SecondLook::Waiting { work: Box::new(work), rests: false };
        }
    }

    /// Some pictures were looked at again; after the last one the map that they made is joined to the present one.
    pub(super) fn take_over_remapping(&mut self, mut work: Box<Remapping>) {
        if !self.second_look.is_with_worker() {
            return;
        }
        self.second_look = SecondLook::Over;
        work.begun_wrongly.retain(|id| can_be_moved(&self.others, *id));
        if work.begun_wrongly.is_empty() {
            return;
        }
        if !work.pictures.is_empty() {
            self.second_look = SecondLook::Waiting { work, rests: true };
            return;
        }
        let new = MapId(self.active.next_id.0.max(self.active.id.0 + 1));
        let placed = work.finish(new);
        let of_before = |map: MapId| work.begun_wrongly.contains(&map);
        let asked = work.looked_at.iter().filter(|frame| of_before(frame.map)).count();
        let found = placed.iter().filter(|place| of_before(place.map)).count();
        if found == 0 || (found as f64) < MIN_PLACED * asked as f64 {
            return;
        }
        let sightings = work.sightings(&placed, &self.active.map);
        let Some(told) = work.told_by(&sightings, &self.active.map) else { return };
        let Remapping { own, begun_wrongly, frames, .. } = *work;
        let in_both: Vec<KeyframeId> = sightings.iter().map(|s| s.keyframe).collect();
        // Nobody has ever been told where it is, so it follows the present one as a merged map does.
        let other = OtherMap { sightings, is_merged: true, ..OtherMap::new(own.active) };
        self.active.next_id = MapId(new.0 + 1);
        self.loops.expect_more(&other.map);
        self.join(other, &told.present_from_other, told.log_scale_sigma);
        for id in begun_wrongly {
            let Some(index) = self.others.kept.iter().position(|other| other.id == id) else { continue };
            let old = self.others.kept.remove(index);
            let moved = moved(&placed, &old, &self.active.map, told.present_from_other.scale);
            match moved.is_empty() {
                true => self.others.kept.insert(index, old),
                false => self.record_anew(&frames, &old, &moved),
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
    fn record_anew(&mut self, frames: &[Recorded], old: &OtherMap, moved: &[Moved<'_>]) {
        // What was recorded before has a place of its own, in the map that is no more, until it is replaced.
        retire(&old.map, &mut self.events);
        let map = self.active.id;
        for frame in frames.iter().filter(|frame| frame.map == old.id) {
            let Some(keyframe) = old.map.keyframe(frame.keyframe) else { continue };
            let before = keyframe.camera_from_world.inverse() * frame.keyframe_from_camera.relabel::<Camera, Camera>();
            let Some((now, beside)) = follow(moved, frame.timestamp_ns, &before) else { continue };
            let Some(parent) = self.active.map.keyframe(beside.place.parent) else { continue };
            self.events.push(TrajectoryEvent::Pose {
                timestamp_ns: frame.timestamp_ns,
                map,
                keyframe: beside.place.parent,
                keyframe_from_camera: (parent.camera_from_world * now).relabel(),
            });
        }
        self.events.push(TrajectoryEvent::MapJoined { map: old.id, into: map, scale: 1.0 });
    }
}

/// A map kept aside that has not become a part of another one yet, and that nobody's goals lie in.
fn can_be_moved(others: &OtherMaps, id: MapId) -> bool {
    others.kept.iter().any(|other| other.id == id && !other.is_placed)
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;

    #[test]
    fn a_frame_is_remembered_where_it_hangs_now_and_in_the_unit_of_now() {
        let step = |x: f64| Se3::new(UnitQuaternion::identity(), Vector3::x() * x);
        let pose = |timestamp_ns, keyframe| TrajectoryEvent::Pose {
            timestamp_ns,
            map: MapId(3),
            keyframe: KeyframeId(keyframe),
            keyframe_from_camera: step(1.0),
        };
        let mut look = SecondLook::new(LensPrior::UNKNOWN);
        look.hear(&[pose(1, 7), pose(2, 8), TrajectoryEvent::KeyframeScaled { keyframe: KeyframeId(7), scale: 3.0 }]);
        look.hear(&[
            TrajectoryEvent::KeyframeRemoved {
                map: MapId(3),
                keyframe: KeyframeId(7),
                parent: KeyframeId(8),
                parent_from_keyframe: step(10.0).relabel(),
            },
            TrajectoryEvent::MapJoined { map: MapId(3), into: MapId(4), scale: 1.0 },
        ]);
        look.note_begun_wrongly(MapId(4));
        let SecondLook::Keeping(kept) = &look else { panic!("the lens is not known") };
        let frames: Vec<_> =
            kept.frames.iter().map(|f| (f.map.0, f.keyframe.0, f.keyframe_from_camera.translation.x)).collect();
        assert_eq!(frames, [(4, 8, 13.0), (4, 8, 1.0)]);
        assert!(look.next_piece(true).is_none() && !look.is_with_worker());
    }

    #[test]
    fn a_calibrated_camera_keeps_nothing_and_a_lens_that_does_not_come_is_not_waited_for() {
        assert!(matches!(SecondLook::new(LensPrior::Calibrated), SecondLook::Over));
        let mut look = SecondLook::new(LensPrior::UNKNOWN);
        let (map, keyframe) = (MapId(0), KeyframeId(0));
        for timestamp_ns in 0..=MOST_FRAMES as i64 {
            assert!(matches!(look, SecondLook::Keeping(_)));
            look.hear(&[TrajectoryEvent::Pose { timestamp_ns, map, keyframe, keyframe_from_camera: Se3::identity() }]);
        }
        assert!(matches!(look, SecondLook::Over));
    }
}
