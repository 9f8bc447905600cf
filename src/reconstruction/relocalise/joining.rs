//! Maps that were lost: put aside when the next one begins, recognised from it, joined to it.
//!
//! A map in which frames cannot be placed any more is not given up when the next one begins. Keyframes of the present map are looked for
//! in those kept aside as a lost frame is ([`relocalise`](super::relocalise)): thumbnails, descriptors and P3P, then the search by
//! projection, which must speak for itself. Two keyframes that tell the same similarity ([`other_maps`](super::other_maps)) join the maps:
//! the other one becomes a part of the present one, whose number stays. Where the other one is the larger, or a planner has placed it and not this
//! one, both are from then on where that was, in its frame and, unless something tells the present map's scale, in its unit: there lie the places
//! that a planner has stored. The map pose then jumps, with its revision; the smooth pose does not. A map that a command merges is carried over into the present one, however large.
//! Landmarks of both that are one corner are fused, and the whole is adjusted soon, if it is not too large.
//!
//! A seam that an older keyframe told lies where the robot may not be: beyond 240 keyframes nothing adjusts it until the robot is there again.
//!
//! Cost: nothing while no map is kept; else one attempt of relocalisation for every few keyframes, rarer while nothing is recognised, after
//! the pose was published. While the present map is lost: [`taking_up`](super::taking_up).

use super::asked::Asked;
use super::other_maps::{
    ATTEMPT_GAP, LONGEST_GAP, OtherMap, OtherMaps, REMEMBERED, Sighting, at_corner, found_in, log_ratio, seen_most_by,
    similarity,
};
use crate::features::FrameFeatures;
use crate::geometry::CameraModel;
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::frames::World;
use crate::geometry::sim3::Sim3;
use crate::map::observations::Observations;
use crate::map::{Correction, KeyframeId, LandmarkId, Map};
use crate::reconstruction::Reconstruction;
use crate::reconstruction::keyframe::observe_match;
use crate::reconstruction::optics::Optics;
use crate::reconstruction::track::association::Bindings;
use crate::reconstruction::track::frame::Frame;
use crate::reconstruction::track::{Tracked, Tracker};
use crate::reconstruction::types::{PoseEstimate, TrajectoryEvent};

/// Landmarks of both maps at one corner whose depths have a larger logarithm of their ratio are two points.
const SAME_POINT_LOG: f64 = 0.2;

impl Reconstruction {
    /// A frame that the map does not know, long after the last one that it did: perhaps the one that begins the next map.
    pub(in crate::reconstruction) fn begin_beside(&mut self, features: &FrameFeatures) -> PoseEstimate {
        let Optics { camera, intrinsics, .. } = &self.optics;
        let starts = self.initialiser.step(features, camera, intrinsics.supposed(camera), &self.config);
        if starts.is_empty() {
            return self.estimate_none(features);
        }
        // A job of the old map's goes on until it is known that another one begins.
        let next = self.active.successor();
        let mut old = std::mem::replace(&mut self.active, next);
        self.tracker = Tracker::default();
        let Some(mut estimate) = self.start_from(&starts, features) else {
            // What was made of a revision meanwhile must not be taken for this map's.
            old.map.revision = self.active.map.revision.max(old.map.revision) + 1;
            self.active = old;
            return self.estimate_none(features);
        };
        self.discard_job();
        self.active.beside = Some(old.id);
        self.contradiction.end();
        self.wheels.begin_map();
        self.corrections.end_map();
        self.optics.intrinsics.end_map(&self.optics.camera);
        self.counters.resets += 1;
        estimate.reset_counter = self.reset_counter();
        self.keep_aside(old);
        estimate
    }

    /// Somebody has said where the robot is in the present map: when one that was lost is joined to it, it is not told in that one's frame; when it
    /// is lost itself, it gives its frame to the map that it is joined to. What was said of a map before holds no more.
    pub fn hold_frame(&mut self) {
        self.others.kept.iter_mut().for_each(|other| other.own.is_placed = false);
        self.active.is_placed = true;
    }

    /// Somebody has said where the robot is in the present map, or in one that is a part of it now and has given it its frame.
    pub fn is_placed(&self) -> bool {
        self.active.is_placed
    }

    /// Looks for the frame that has just become the keyframe `id` in the maps kept aside; joins the one that it is recognised in.
    pub(in crate::reconstruction) fn recognise(&mut self, features: &FrameFeatures, id: KeyframeId) {
        if self.others.kept.is_empty() || self.pending.turned.is_some() {
            return;
        }
        // One that was recognised a moment ago is asked again at once.
        let others = &mut self.others;
        if others.warm == 0 {
            if self.counters.frames < others.next_attempt {
                return;
            }
            others.turn += 1;
        }
        let index = others.turn % others.kept.len();
        let likely = self.likely_in(index, features);
        let sighting = self.find_in(index, features, id, &likely);
        let others = &mut self.others;
        match sighting.is_some() && others.warm < REMEMBERED {
            true => (others.warm, others.gap) = (others.warm + 1, ATTEMPT_GAP),
            false => (others.warm, others.gap) = (0, (2 * others.gap).min(LONGEST_GAP)),
        }
        others.next_attempt = self.counters.frames + others.gap;
        if let Some(sighting) = sighting {
            self.hear_sighting(index, sighting);
        }
    }

    /// Joins a map kept aside if two keyframes of the present one that were recognised in it tell the same; else remembers the later one.
    pub(super) fn hear_sighting(&mut self, index: usize, sighting: Sighting) {
        let other = &self.others.kept[index];
        let (readout_s, min_parallax) = (self.optics.shutter.readout_s, self.config.min_parallax_deg.to_radians());
        let tell = |(i, before)| {
            let pair = [before, &sighting];
            let told = similarity(&self.active.map, &other.own.map, pair, readout_s, min_parallax)?;
            Some((i, told, self.join_sigma(other, pair, &told)?))
        };
        // One keyframe that is asked again is no second witness.
        let others = other.sightings.iter().enumerate().rev().filter(|(_, s)| s.keyframe != sighting.keyframe);
        let told = others.into_iter().find_map(tell);
        match told {
            Some((before, told, scale_sigma)) => {
                let mut other = self.others.kept.remove(index);
                if other.is_merged {
                    // Of the others nobody knows whether they were right. And there are keyframes more to ask.
                    other.sightings = vec![other.sightings.swap_remove(before)];
                    self.others.asked = Asked::default();
                }
                other.sightings.push(sighting);
                self.others.warm = 0;
                self.join(other, &told.present_from_other, scale_sigma);
            }
            None => {
                let sightings = &mut self.others.kept[index].sightings;
                sightings.retain(|s| s.keyframe != sighting.keyframe);
                if sightings.len() == REMEMBERED {
                    sightings.remove(0);
                }
                sightings.push(sighting);
            }
        }
    }

    /// Keyframes of a map kept aside that a picture may show the place of.
    pub(super) fn likely_in(&mut self, index: usize, features: &FrameFeatures) -> Vec<KeyframeId> {
        let Some(other) = self.others.kept.get(index) else { return Vec::new() };
        self.loops.likely(&other.own.map, &features.pyramid)
    }

    /// Where the keyframe `id` is in a map kept aside, if it is; perhaps near the `likely` ones.
    pub(super) fn find_in(
        &mut self,
        index: usize,
        features: &FrameFeatures,
        id: KeyframeId,
        likely: &[KeyframeId],
    ) -> Option<Sighting> {
        // In another map's unit only the turn is known.
        let motion = self.active.map.keyframe(id)?.motion.map(CameraMotion::turned_only);
        Some(self.look_in(index, features, (id, motion), likely)?.1)
    }

    /// Where a picture that is, or is called, the keyframe `id` is in a map kept aside.
    pub(super) fn look_in(
        &mut self,
        index: usize,
        features: &FrameFeatures,
        (id, motion): (KeyframeId, Option<CameraMotion>),
        likely: &[KeyframeId],
    ) -> Option<(Tracked, Sighting)> {
        let OtherMaps { kept, relocaliser, .. } = &mut self.others;
        let other = kept.get(index)?;
        self.far.ask(likely);
        let bindings = Bindings::default();
        let frame = Frame {
            features,
            map: &other.own.map,
            bindings: &bindings,
            camera: &self.optics.camera,
            config: &self.config,
            before: None,
            was_here: false,
            motion,
            shutter: &self.optics.shutter,
            outlier_chi2: self.optics.noise.outlier_chi2(),
        };
        let Some(placed) = relocaliser.place_once(&frame, other.own.reference, likely) else {
            self.far.ask_ahead(relocaliser.ahead(&other.own.map));
            return None;
        };
        Some((placed, found_in(&frame, &relocaliser.tracker, id, &placed)?))
    }

    /// Makes the other map a part of this one. `scale_sigma`: of the logarithm of the ratio of their units.
    pub(in crate::reconstruction) fn join(
        &mut self,
        other: OtherMap,
        present_from_other: &Sim3<World, World>,
        scale_sigma: f64,
    ) {
        self.discard_job();
        let active = &mut self.active;
        let OtherMap { own: mut other, sightings, is_merged } = other;
        // The lens may be known better by now.
        other.map.undistort_anew(&self.optics.camera);
        other.map.transform(present_from_other);
        let newest = sightings.last().map(|s| s.keyframe);
        let through = newest.and_then(|id| active.map.keyframe(id)?.scale_from);
        active.scale.absorb(&other.scale, &mut other.map, present_from_other, through);
        let is_larger = other.map.keyframes.len() > active.map.keyframes.len();
        let knows_unit = active.fusion.fused().is_some();
        // Goals of a planner lie in the frame of the map that it has placed; in another unit they are nowhere.
        let keeps_goals = other.is_placed && (!knows_unit || other.fusion.is_metric());
        let goes_back = (is_larger || keeps_goals) && !is_merged && !active.is_placed;
        active.is_placed |= goes_back && keeps_goals;
        // A unit that something has told stays; else it is the other's, whose own words then hold as they are.
        let takes_unit = goes_back && !knows_unit;
        // What was measured is the ratio to the part where it was recognised; of a merged map more is doubted already.
        let of_part = if knows_unit && !is_merged { active.scale.sigma_behind(through, false) } else { 0.0 };
        let scale_sigma = scale_sigma.hypot(of_part);
        match takes_unit {
            true => active.fusion.inherit(&other.fusion, 0.0, 0.0),
            // A length of one here is 1 / scale there.
            false => active.fusion.inherit(&other.fusion, -present_from_other.scale.ln(), scale_sigma),
        }
        let own = |s: &Sighting| active.map.keyframe(s.keyframe).map(|k| k.observations.clone()).unwrap_or_default();
        let seen: Vec<Observations> = sightings.iter().map(own).collect();
        let by = sightings.last().and_then(|s| Some((seen_most_by(&other.map, s)?, s.keyframe)));
        if let Some((from, to)) = by {
            self.others.note_join(other.id, from, to);
        }
        active.map.absorb(other.map);
        if !knows_unit && through.is_some() && active.fusion.fused().is_some() {
            // What was said is of the other's unit, which is that of the part where it was recognised, and not of this map's beginning.
            let parts = active.scale.in_one_unit(&active.map, through, |_| None);
            self.move_parts(&parts);
        }
        let active = &mut self.active;
        // Two keyframes that were recognised vouch for the map.
        active.probation.end();
        self.contradiction.end();
        for (sighting, seen) in sightings.iter().zip(&seen) {
            add_found(&mut active.map, sighting, seen, &self.optics.camera);
        }
        self.events.push(TrajectoryEvent::MapJoined {
            map: other.id,
            into: active.id,
            scale: present_from_other.scale,
        });
        self.counters.maps_joined += 1;
        self.corrections.join();
        active.frames += other.frames;
        active.next_global = 0;
        active.unadjusted = active.map.newest();
        if goes_back {
            self.go_back_to(&present_from_other.inverse(), takes_unit);
        }
    }

    /// The whole map moves such that what has just become a part of it lies where it was; `takes_unit`: and is as large as it was.
    fn go_back_to(&mut self, other_from_present: &Sim3<World, World>, takes_unit: bool) {
        let before = self.active.odometry.pose();
        let Sim3 { scale, rotation, translation, .. } = *other_from_present;
        if takes_unit {
            self.change_unit(scale);
        }
        let motion = Sim3::new(1.0, rotation, if takes_unit { translation } else { translation / scale });
        self.active.scale.carry(&motion);
        self.move_map(&Correction { keyframes: Vec::new(), younger: Some(motion) });
        if let Some((old, new)) = before.zip(self.active.odometry.pose()) {
            self.corrections.carried(&old, &new);
        }
    }
}

/// Enters what a keyframe was found to see of another map, which is a part of this one by now; `seen`: what it saw before.
pub(in crate::reconstruction) fn add_found(
    map: &mut Map,
    sighting: &Sighting,
    seen: &Observations,
    camera: &CameraModel,
) {
    for m in &sighting.found {
        let Some(own) = at_corner(seen, m) else {
            if let Some(o) = observe_match(camera, m) {
                map.add_observation(sighting.keyframe, o);
            }
            continue;
        };
        let depth = |id: LandmarkId| {
            let pose = map.keyframe(sighting.keyframe)?.camera_from_world;
            Some(pose.transform(&map.landmark(id)?.position).z)
        };
        let ratio = depth(own).zip(depth(m.landmark)).and_then(|(here, there)| log_ratio(here, there));
        if map.landmark(own).is_some_and(|l| l.assumed.is_some()) {
            map.fuse(m.landmark, own);
        } else if ratio.is_some_and(|r| r.abs() < SAME_POINT_LOG) {
            map.fuse(own, m.landmark);
        }
    }
}
