//! What reconstruction does about loops: looks for an old place at each keyframe, has what was found closed, takes over what came of it.

use super::FoundLoop;
use crate::features::FrameFeatures;
use crate::geometry::median;
use crate::map::{KeyframeId, Map, Observation};
use crate::places::loops::{ClosedLoop, LoopClosure, LoopEdge};
use crate::reconstruction::Reconstruction;
use crate::reconstruction::relocalise::joining::{add_found, found_in, turned_only};
use crate::reconstruction::relocalise::other_maps::{REMEMBERED, Sighting, Similarity, similarity};
use crate::reconstruction::track::association::Bindings;
use crate::reconstruction::track::frame::Frame;
use crate::reconstruction::types::TrajectoryEvent;

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

impl Reconstruction {
    /// Enters the frame that has just become the keyframe `id`, and looks whether it shows an old place.
    pub(in crate::reconstruction) fn look_for_loop(&mut self, features: &FrameFeatures, id: KeyframeId) {
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
    pub(in crate::reconstruction) fn loop_closure(&mut self) -> Option<LoopClosure> {
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
    pub(in crate::reconstruction) fn take_over_loop(&mut self, closed: Option<ClosedLoop>) {
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
