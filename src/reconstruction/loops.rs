//! Loops: a place of the map that is seen again after a long way, and what follows from it.
//!
//! Every keyframe is entered into the index of [`places`](crate::places::index). What it shows is first asked for there; of the keyframes that are
//! neither covisible with it nor covisible with one that is, and not recent, the likeliest place (a keyframe and what it shares landmarks with) is tried
//! as for a lost frame ([`relocalise`](super::relocalise)): thumbnails, descriptors and P3P, then the search by projection, which must speak for
//! itself. Two keyframes recognised one soon after the other must tell the same similarity, by the depths that are known on both sides, as
//! when maps are joined ([`other_maps`](super::relocalise::other_maps)); and it must be one that the way since can have drifted by. A wrong loop
//! costs a robot more than ten missed ones.
//!
//! Then the pose graph is solved in the mapping worker ([`LoopClosure`]), and merged like an adjustment: the map moves, the smooth pose does
//! not, and the revision tells planners. What the two keyframes were found to see of the old place is fused with what they see, and the next
//! adjustments do the rest. A loop that has drifted by next to nothing is only fused.
//!
//! Cost, after the pose was published: describing and asking at each keyframe, some milliseconds; one attempt of relocalisation for every
//! few frames where the index knows a place, rarer while nothing comes of it.

use super::Reconstruction;
use super::relocalise::joining::{add_found, found_in, turned_only};
use super::relocalise::other_maps::{
    ATTEMPT_GAP, LONGEST_GAP, OtherMaps, REMEMBERED, Sighting, Similarity, similarity,
};
use super::track::association::Bindings;
use super::track::frame::Frame;
use super::types::TrajectoryEvent;
use crate::features::FrameFeatures;
use crate::features::descriptor::Descriptor;
use crate::geometry::median;
use crate::map::{KeyframeId, Map, Observation};
use crate::places::describe::PlaceDescriber;
use crate::places::index::{Candidate, PlaceIndex};
use crate::places::loops::{ClosedLoop, LoopClosure, LoopEdge};

/// Keyframes just before one are no place of old.
const RECENT: u32 = 20;
/// Neighbours whose neighbours are no place of old either.
const NEIGHBOURS: usize = 10;
/// Of the index's answer: so many are weighed with what they share landmarks with, and these neighbours of each.
const WEIGHED: usize = 10;
const GROUP: usize = 10;
/// Descriptors that a place must have, and its score against that of the neighbour that is most like the keyframe.
const MIN_VOTES: u32 = 8;
const MIN_LIKENESS: f32 = 0.1;
/// Keyframes of a place that are tried: the likeliest, and those that share most with it.
const TRIED: usize = 3;
/// Two sightings so many keyframes apart are not one soon after the other.
const SOON: u32 = 40;
/// Drift that a way can have: of the place as a share of the way, and the logarithm of the scale.
const MOST_DRIFT: f64 = 0.3;
const MOST_LOG_SCALE: f64 = 1.1;
/// Next to nothing: rotation, rad; distance, in median depths; logarithm of the scale.
const LITTLE_RAD: f64 = 0.01;
const LITTLE_DEPTHS: f64 = 0.02;
const LITTLE_LOG_SCALE: f64 = 0.02;
/// Closed loops that are remembered for the next pose graph.
const MOST_CLOSED: usize = 4096;

/// A loop that two keyframes have told.
struct FoundLoop {
    /// The newest last.
    sightings: [Sighting; 2],
    /// Of the old place in the present one's frame and unit.
    told: Similarity,
}

/// What there is of loops.
#[derive(Default)]
pub struct Loops {
    index: PlaceIndex,
    describer: PlaceDescriber,
    seen: Vec<Descriptor>,
    ranked: Vec<Candidate>,
    near: Vec<KeyframeId>,
    around: Vec<(KeyframeId, u32)>,
    /// Keyframes that were recognised in the same map, the newest last.
    sightings: Vec<Sighting>,
    waiting: Option<FoundLoop>,
    under_way: Option<FoundLoop>,
    /// Ends of the loops that were closed, the newest last.
    closed: Vec<(KeyframeId, KeyframeId)>,
    /// Frame before which nothing is tried again, and how many frames that was from the last time.
    next_attempt: u64,
    gap: u64,
    warm: usize,
}

impl Loops {
    /// What was found and not closed yet is not to be: its map has ended or is another one now.
    pub fn forget_found(&mut self) {
        self.sightings.clear();
        (self.waiting, self.under_way) = (None, None);
    }

    /// Takes out of the index what is in no map any more.
    fn follow(&mut self, map: &Map, others: &OtherMaps) {
        let is_alive =
            |id: &KeyframeId| map.keyframe(*id).is_some() || others.maps().any(|m| m.keyframe(*id).is_some());
        let gone: Vec<KeyframeId> = self.index.keyframes().filter(|id| !is_alive(id)).collect();
        gone.iter().for_each(|id| self.index.remove(*id));
        self.closed.retain(|(a, b)| is_alive(a) && is_alive(b));
    }

    /// Keyframes of the likeliest old place for what keyframe `id` sees, the likeliest first; none if nothing is likely.
    fn likeliest(&mut self, map: &Map, id: KeyframeId) -> Vec<KeyframeId> {
        let Self { index, seen, ranked, near, around, .. } = self;
        note_near(map, id, near, around);
        index.query(seen, usize::MAX, |k| map.keyframe(k).is_some(), ranked);
        let is_old = |c: &Candidate| c.keyframe.0 + RECENT <= id.0 && near.binary_search(&c.keyframe).is_err();
        let familiar = ranked.iter().find(|c| !is_old(c)).map_or(0.0, |c| c.score);
        let score_of = |k: KeyframeId| ranked.iter().find(|c| c.keyframe == k).map_or(0.0, |c| c.score);
        let likely = |c: &&Candidate| c.votes >= MIN_VOTES && c.score >= MIN_LIKENESS * familiar;
        let mut best: Option<(f32, KeyframeId)> = None;
        for c in ranked.iter().filter(|c| is_old(c)).filter(likely).take(WEIGHED) {
            map.covisible(c.keyframe, 1, GROUP, around);
            let group = c.score + around.iter().map(|a| score_of(a.0)).sum::<f32>();
            if best.is_none_or(|b| group > b.0) {
                best = Some((group, c.keyframe));
            }
        }
        let Some((_, best)) = best else { return Vec::new() };
        map.covisible(best, 1, TRIED - 1, around);
        let others = around.iter().map(|a| a.0).filter(|k| near.binary_search(k).is_err());
        std::iter::once(best).chain(others).collect()
    }

    /// How many frames until the next attempt.
    fn note_attempt(&mut self, frame: u64, found: bool) {
        match found && self.warm < REMEMBERED {
            true => (self.warm, self.gap) = (self.warm + 1, ATTEMPT_GAP),
            false => (self.warm, self.gap) = (0, (2 * self.gap).clamp(ATTEMPT_GAP, LONGEST_GAP)),
        }
        self.next_attempt = if self.warm > 0 { frame } else { frame + self.gap };
    }
}

/// A keyframe, what it shares landmarks with, and what the nearest of these do; ascending.
fn note_near(map: &Map, id: KeyframeId, near: &mut Vec<KeyframeId>, around: &mut Vec<(KeyframeId, u32)>) {
    near.clear();
    near.push(id);
    map.covisible(id, 1, usize::MAX, around);
    near.extend(around.iter().map(|a| a.0));
    for &(neighbour, _) in around.iter().take(NEIGHBOURS) {
        near.extend(map.keyframe(neighbour).into_iter().flat_map(|k| k.covisible.iter().map(|c| c.0)));
    }
    near.sort_unstable();
    near.dedup();
}

impl Reconstruction {
    /// Enters the frame that has just become the keyframe `id`, and looks whether it shows an old place.
    pub(super) fn look_for_loop(&mut self, features: &FrameFeatures, id: KeyframeId) {
        if !self.config.loops {
            return;
        }
        let Self { loops, active, others, .. } = self;
        loops.follow(&active.map, others);
        loops.describer.describe(&features.pyramid, &mut loops.seen);
        let idle = loops.waiting.is_none() && loops.under_way.is_none();
        if idle && self.pending.turned.is_none() && self.counters.frames >= self.loops.next_attempt {
            self.try_places(features, id);
        }
        let loops = &mut self.loops;
        loops.index.add(id, &loops.seen);
    }

    fn try_places(&mut self, features: &FrameFeatures, id: KeyframeId) {
        let places = self.loops.likeliest(&self.active.map, id);
        if places.is_empty() {
            self.loops.warm = 0;
            return;
        }
        let sighting = self.find_again(features, id, &places);
        self.loops.note_attempt(self.counters.frames, sighting.is_some());
        let Some(sighting) = sighting else { return };
        let map = &self.active.map;
        let (readout_s, min_parallax) = (self.optics.shutter.readout_s, self.config.min_parallax_deg.to_radians());
        let sightings = &mut self.loops.sightings;
        sightings.retain(|s| s.keyframe.0 + SOON > id.0 && map.keyframe(s.keyframe).is_some());
        let told = sightings.iter().enumerate().rev().find_map(|(i, before)| {
            let told = similarity(map, map, [before, &sighting], readout_s, min_parallax)?;
            is_plausible(map, &sighting, &told).then_some((i, told))
        });
        let Some((before, told)) = told else {
            if sightings.len() == REMEMBERED {
                sightings.remove(0);
            }
            sightings.push(sighting);
            return;
        };
        let sightings = [sightings.swap_remove(before), sighting];
        self.loops.forget_found();
        match is_little(map, &sightings[1], &told) {
            true => self.fuse_found(&sightings),
            false => {
                self.mapper.discard();
                self.loops.waiting = Some(FoundLoop { sightings, told });
            }
        }
    }

    /// Where the keyframe `id` is by the landmarks of an old place, if it is.
    fn find_again(&mut self, features: &FrameFeatures, id: KeyframeId, places: &[KeyframeId]) -> Option<Sighting> {
        let map = &self.active.map;
        let keyframe = map.keyframe(id)?;
        let bindings = Bindings::default();
        let frame = Frame {
            features,
            map,
            bindings: &bindings,
            camera: &self.optics.camera,
            config: &self.config,
            before: None,
            motion: keyframe.motion.map(turned_only),
            shutter: &self.optics.shutter,
            is_calibrated: self.optics.intrinsics.is_calibrated(),
        };
        let placed = self.relocaliser.place_among(&frame, places)?;
        let mut sighting = found_in(&frame, &self.relocaliser.tracker, id, &placed)?;
        sighting.found.retain(|m| keyframe.observation(m.landmark).is_none());
        (sighting.found.len() >= 2 * self.config.min_landmarks).then_some(sighting)
    }

    /// The loop that waits to be closed, as a job.
    pub(super) fn loop_closure(&mut self) -> Option<LoopClosure> {
        let found = self.loops.waiting.take()?;
        let map = &self.active.map;
        let edges: Vec<LoopEdge> = found.sightings.iter().filter_map(|s| loop_edge(map, s, &found.told)).collect();
        let newest = found.sightings[1].keyframe;
        let job = LoopClosure::new(map, newest, &edges, &self.loops.closed)?;
        self.loops.closed.extend(edges.iter().map(|e| (e.old, e.recognised)));
        let too_many = self.loops.closed.len().saturating_sub(MOST_CLOSED);
        self.loops.closed.drain(..too_many);
        self.loops.under_way = Some(found);
        Some(job)
    }

    /// Moves the map as a closed loop says, and fuses what is one.
    pub(super) fn take_over_loop(&mut self, closed: Option<ClosedLoop>) {
        let (Some(found), Some(ClosedLoop { correction, .. })) = (self.loops.under_way.take(), closed) else { return };
        let active = &mut self.active;
        for (id, _) in active.map.keyframes.iter() {
            let (keyframe, scale) = (KeyframeId(id), correction.of(KeyframeId(id)).scale);
            self.events.push(TrajectoryEvent::KeyframeScaled { keyframe, scale });
        }
        active.map.correct(&correction);
        let before = active.odometry.last.map(|last| last.camera_from_world);
        active.odometry.correct_scaled(&correction.of(active.reference));
        if let Some((old, new)) = before.zip(active.odometry.last.map(|last| last.camera_from_world)) {
            self.corrections.close_loop(&old, &new);
        }
        active.scale.follow(&active.map);
        self.counters.loops_closed += 1;
        self.fuse_found(&found.sightings);
        self.active.next_whole = 0;
    }

    /// What both keyframes were found to see of the old place is one with what they see.
    fn fuse_found(&mut self, sightings: &[Sighting; 2]) {
        let map = &mut self.active.map;
        for sighting in sightings {
            let own = map.keyframe(sighting.keyframe).map(|k| k.observations.clone());
            let seen: Vec<Observation> = own.unwrap_or_default();
            add_found(map, sighting, &seen, &self.optics.camera);
        }
        self.active.unadjusted = map.keyframes.iter().last().map(|(id, _)| KeyframeId(id));
    }
}

/// The keyframe that sees most of what was found, other than the one that was recognised, and how that one lies to it.
fn loop_edge(map: &Map, sighting: &Sighting, told: &Similarity) -> Option<LoopEdge> {
    let mut votes: Vec<(KeyframeId, u32)> = Vec::new();
    for m in &sighting.found {
        for &k in map.landmark(m.landmark).into_iter().flat_map(|l| &l.observers) {
            match votes.binary_search_by_key(&k, |v| v.0) {
                Ok(i) => votes[i].1 += 1,
                Err(i) => votes.insert(i, (k, 1)),
            }
        }
    }
    let old = votes.iter().filter(|v| v.0 != sighting.keyframe).max_by_key(|&&(k, n)| (n, k))?.0;
    let recognised_from_old = told.scaled(&(sighting.there * map.keyframe(old)?.camera_from_world.inverse()).relabel());
    Some(LoopEdge { old, recognised: sighting.keyframe, recognised_from_old, log_scale_sigma: told.log_scale_sigma })
}

/// How far a sighting says that its keyframe has drifted: distance, map units of the old place, and the median depth of what was found.
fn drift(map: &Map, sighting: &Sighting) -> Option<(f64, f64)> {
    let here = map.keyframe(sighting.keyframe)?.centre();
    let mut depths: Vec<f64> = sighting.found.iter().map(|m| sighting.there.transform(&m.point).z).collect();
    Some(((here - sighting.there.inverse().translation).norm(), median(&mut depths)?))
}

/// The way since the old place can have drifted so.
fn is_plausible(map: &Map, sighting: &Sighting, told: &Similarity) -> bool {
    let (Some((distance, depth)), Some(edge)) = (drift(map, sighting), loop_edge(map, sighting, told)) else {
        return false;
    };
    let (Some(old), Some(new)) = (map.keyframe(edge.old), map.keyframe(sighting.keyframe)) else { return false };
    let between = map.keyframes.iter().filter(|(id, _)| (edge.old.0..=sighting.keyframe.0).contains(id));
    let (mut way, mut before) = (0.0, old.centre());
    for (_, k) in between {
        way += (k.centre() - before).norm();
        before = k.centre();
    }
    let untold = old.scale_from != new.scale_from;
    distance <= MOST_DRIFT * way + depth * MOST_DRIFT
        && (untold || told.present_from_other.scale.ln().abs() <= MOST_LOG_SCALE)
}

/// Next to nothing has drifted.
fn is_little(map: &Map, sighting: &Sighting, told: &Similarity) -> bool {
    let Some((distance, depth)) = drift(map, sighting) else { return false };
    let scale = told.present_from_other.scale.ln().abs();
    distance < LITTLE_DEPTHS * depth
        && told.present_from_other.rotation.angle() < LITTLE_RAD
        && scale < LITTLE_LOG_SCALE.max(2.0 * told.log_scale_sigma)
}
