//! Metres: what wheels, tags and heights say of the present map's scale, and what becomes of the map then.
//!
//! A map begins in an arbitrary unit. Once its scale is known to a few per cent ([`ScaleFusion`](crate::motion::scale::ScaleFusion)) its lengths become
//! metres, all at once, between two frames: keyframes, landmarks, the last frame and its motion, the smooth pose, turns with doubtful
//! scale. That is another map to whoever reads poses: it has another number, the reset counter rises by one, and what a trajectory holds of it is written in
//! the new unit. Later, where the scale is known better, the map is scaled again: then only map coordinates move, with their revision, the smooth
//! pose goes on from where it is with increments of the new length.
//!
//! An adjustment under way began from lengths that are no more; it is forgotten, as in a join, and another is posted.
//!
//! Cost: nothing without readings and words; else 2 ms every half second, after the pose was published.

use nalgebra::{UnitQuaternion, Vector3};

use super::Reconstruction;
use super::keyframe::distance_prior;
use super::odometry::Odometry;
use super::segments::{FrameEnd, Wheels};
use super::types::{TrackingState, TrajectoryEvent};
use crate::features::FrameFeatures;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, Keyframe as KeyframeFrame, World};
use crate::geometry::sim3::Sim3;
use crate::map::scale::{MapScale, ScaleSource};
use crate::map::{Correction, KeyframeId, MapId, TurnId};
use crate::motion::hand_eye::Robot;
use crate::motion::scale::{METRIC_SIGMA, ScaleMeasurement};
use crate::motion::wheel::WheelReading;

impl Reconstruction {
    /// What is known of the base before it has moved, and the standard deviation of an error common to both wheels' radii, as a share.
    /// To be said before the first reading.
    pub fn set_base(&mut self, given: Robot, radius_sigma: f64) {
        self.wheels = Wheels::new(given, radius_sigma);
    }

    /// Takes a reading of the wheels, in the clock of the frames. Readings of the time of a frame should come before it; late ones serve the
    /// segment that ends after them. `false`: it makes no sense (not finite, absurdly fast, not after the one before).
    pub fn add_wheel(&mut self, reading: &WheelReading) -> bool {
        self.wheels.scale.add_reading(reading)
    }

    /// Takes a word on the present map's scale, in its unit of now. `false`: it makes no sense or contradicts what its source has said.
    /// The map is scaled, if it is to be, after the next frame.
    pub fn add_scale(&mut self, word: &ScaleMeasurement) -> bool {
        self.active.fusion.add(word)
    }

    /// What the present map's lengths are, where the last frame was placed: in and behind a turn on the spot whose next step has an assumed length, or one
    /// that wheels told in a moment, they are metres to that doubt only.
    pub fn scale(&self) -> MapScale {
        let active = &self.active;
        match active.fusion.scale() {
            MapScale::Metric { sigma, sources } => {
                let behind = active.map.keyframe(active.reference).and_then(|k| k.scale_from);
                let doubt = active.scale.sigma_behind(behind, self.rests_on_assumed());
                MapScale::Metric { sigma: sigma.hypot(doubt), sources }
            }
            MapScale::Unknown => MapScale::Unknown,
        }
    }

    /// Most of what the last frame saw lies at assumed distances: it is in a turn on the spot, or comes out of one and its way since is not told yet.
    pub(super) fn rests_on_assumed(&self) -> bool {
        self.state == TrackingState::Tracking && self.pending.turned.is_some()
    }

    /// What the camera's height or tags say of the part of the map that keyframe `at` is in, and the standard deviation of an error that all words of the source
    /// share. Of a part of a metric map behind a turn on the spot it tells how long the unit there is, and both become one: wheels do the same by
    /// themselves, where there are any.
    pub(super) fn hear_at(&mut self, at: KeyframeId, word: &ScaleMeasurement, common_sigma: f64) {
        match self.active.map.keyframe(at).and_then(|k| k.scale_from) {
            None => {
                self.active.fusion.add_sharing(word, common_sigma);
            }
            Some(turn) if self.active.fusion.is_metric() && self.wheels.scale.is_silent() => {
                // Tags say something long before they are as sure as a map's scale has to be.
                if word.sigma <= METRIC_SIGMA {
                    self.told_behind = Some((turn, *word));
                }
            }
            Some(_) => {}
        }
    }

    /// The part of the map behind `turn` becomes metric, by what is told there; what lies before is metric already, and stays as long as it is.
    fn unify_by_word(&mut self, turn: TurnId, word: &ScaleMeasurement) {
        let Some((before_log, ..)) = self.active.fusion.fused() else { return };
        let newest = self.active.map.keyframe(self.active.reference).and_then(|k| k.scale_from);
        // The robot has gone back meanwhile, or on behind another turn: it will be asked again.
        if newest != Some(turn) {
            return;
        }
        self.discard_job();
        let before = self.active.odometry.last.map(|last| last.camera_from_world);
        let log = word.log_metres_per_unit;
        let ratio = |part: Option<TurnId>| match part {
            None => Some(before_log - log),
            Some(_) => self.wheels.log_ratio(part),
        };
        let parts = self.active.scale.parts_in_one_unit(&self.active.map, newest, ratio);
        let between: Vec<_> = parts.iter().map(|(part, _)| *part).filter(|part| self.wheels.tells(*part)).collect();
        self.move_parts(&parts, |part| part.is_none() || part == newest || between.contains(&part));
        self.scale_lengths(log.exp());
        if let Some(tags) = &mut self.tags {
            // Others that told the scale hang before the turn.
            tags.rescale(if word.source == ScaleSource::Tag { log } else { before_log }.exp());
        }
        self.active.fusion.rescale(before_log.exp());
        self.active.fusion.heard_behind_turn(word);
        let keyframes = self.active.map.keyframes.iter().map(|(id, _)| KeyframeId(id));
        self.events.extend(keyframes.map(|keyframe| TrajectoryEvent::KeyframeScaled { keyframe, scale: log.exp() }));
        let now = self.active.odometry.last.map(|last| last.camera_from_world);
        if let Some((old, new)) = before.zip(now) {
            self.corrections.moved(&old, &new);
        }
        if let Some(floor) = &mut self.floor {
            floor.rescale(log.exp(), self.active.id);
            floor.unify();
        }
    }

    /// What is known of camera and base, and how often the wheels slipped, in segments of half a second and more; `None` without readings.
    pub fn base(&self) -> Option<(Robot, u64)> {
        let scale = &self.wheels.scale;
        (!scale.is_silent()).then(|| (scale.robot(), scale.slips))
    }

    /// The wheels slip, by the last segment.
    pub fn wheels_slip(&self) -> bool {
        self.wheels.scale.slipping
    }

    /// After a frame was tracked and mapped, not in a map that is only located in: what wheels say beside it, and a
    /// change of the map's unit that is due.
    pub(super) fn follow_scale(&mut self, features: &FrameFeatures) {
        if !self.wheels.scale.is_silent() {
            self.follow_wheels(features);
        }
        if let Some(factor) = self.active.fusion.due() {
            self.rescale(factor);
        }
        if let Some((turn, word)) = self.told_behind.take() {
            self.unify_by_word(turn, &word);
        }
    }

    fn follow_wheels(&mut self, features: &FrameFeatures) {
        let end = self.frame_end(features.timestamp_ns);
        let Some(end) = end else {
            self.wheels.interrupt();
            return;
        };
        if !self.wheels.follow(end, &self.active.map) {
            return;
        }
        let Some(word) = self.wheels.scale.measurement() else { return };
        match self.wheels.newest_part() {
            // Of the newest part alone: in what the others have told its unit has no place.
            Some(turn) if self.active.fusion.is_metric() => {
                // What is known of the map's beginning, carried over the turn by the wheels, may be surer than what they tell behind it: an error common
                // to both wheels is not in it.
                let carried = self.wheels.ratio_of_beginning().zip(self.active.fusion.fused());
                let carried = carried.map(|((ratio, ratio_sigma), (log, sigma, _))| ScaleMeasurement {
                    log_metres_per_unit: log - ratio,
                    sigma: sigma.hypot(ratio_sigma),
                    ..word
                });
                let word = carried.filter(|carried| carried.sigma < word.sigma).unwrap_or(word);
                self.told_behind = (word.sigma <= METRIC_SIGMA).then_some((turn, word));
            }
            _ => _ = self.active.fusion.add(&word),
        }
    }

    /// The frame of this time, if it was tracked and its place has a scale of its own.
    fn frame_end(&self, timestamp_ns: i64) -> Option<FrameEnd> {
        let active = &self.active;
        let pose = active.odometry.last.filter(|last| last.timestamp_ns == timestamp_ns)?.camera_from_world;
        let keyframe = active.map.keyframe(active.reference)?;
        let blind = self.pending.turned.is_some() || distance_prior::is_held(&active.map, active.reference);
        let depth = distance_prior::distance_to_assume(self.tracker.matches(), &pose.inverse().translation)?;
        (self.state == TrackingState::Tracking && !blind).then(|| FrameEnd {
            timestamp_ns,
            keyframe: active.reference,
            keyframe_from_camera: (keyframe.camera_from_world * pose.inverse()).relabel::<KeyframeFrame, Camera>(),
            depth,
        })
    }

    /// Parts of the map with units of their own, behind turns on the spot, take one unit, as far as wheels tell how long theirs are: not before they tell
    /// how long the newest one is. Of a map of which nothing is metric yet.
    fn unify_units(&mut self) {
        let active = &self.active;
        let newest = active.map.keyframe(active.reference).and_then(|k| k.scale_from);
        if newest.is_some() && !self.wheels.tells_doubted() {
            return;
        }
        let parts = active.scale.parts_in_one_unit(&active.map, newest, |part| self.wheels.log_ratio(part));
        let told: Vec<_> = parts.iter().map(|(part, _)| *part).filter(|part| self.wheels.tells(*part)).collect();
        self.move_parts(&parts, |part| told.contains(&part));
    }

    /// Parts of the map take one unit by these motions; those that are `told` have the scale of the map's beginning from then on.
    fn move_parts(&mut self, parts: &[(Option<TurnId>, Sim3<World, World>)], told: impl Fn(Option<TurnId>) -> bool) {
        if parts.len() < 2 {
            return;
        }
        let of = |part: Option<TurnId>| parts.iter().find(|(id, _)| *id == part).map_or_else(Sim3::identity, |p| p.1);
        let marked: Vec<_> = self.active.map.keyframes.iter().map(|(id, k)| (KeyframeId(id), k.scale_from)).collect();
        let keyframes = marked.iter().map(|(id, part)| (*id, of(*part))).collect();
        self.move_map(&Correction { keyframes, younger: None });
        let active = &mut self.active;
        for (id, _) in marked.iter().filter(|(_, part)| told(*part)) {
            active.map.set_scale_origin(*id, None);
        }
        self.wheels.scale.unify_units();
        active.scale.follow(&active.map);
    }

    /// All that has a length of the present map becomes `factor` times as long.
    fn scale_lengths(&mut self, factor: f64) {
        let active = &mut self.active;
        active.map.transform(&Sim3::new(factor, UnitQuaternion::identity(), Vector3::zeros()));
        active.odometry.rescale(factor);
        active.scale.rescale(factor);
        active.unadjusted = active.map.newest();
        self.rescale_told(factor);
        self.wheels.rescale(factor);
        self.blind.rescale(factor);
        self.tracker.rescale(factor);
        self.active.probation.end();
        self.contradiction.look_anew();
    }

    /// What was told of the part behind a turn is of lengths that are `factor` times as long now.
    pub(super) fn rescale_told(&mut self, factor: f64) {
        if let Some((_, word)) = &mut self.told_behind {
            word.log_metres_per_unit -= factor.ln();
        }
    }

    /// The same, and in the record of a trajectory, and what tags and the floor have told. For a map of which nobody knows the scale.
    pub(super) fn change_unit(&mut self, factor: f64) {
        self.scale_lengths(factor);
        let keyframes = self.active.map.keyframes.iter().map(|(id, _)| KeyframeId(id));
        self.events.extend(keyframes.map(|keyframe| TrajectoryEvent::KeyframeScaled { keyframe, scale: factor }));
        if let Some(tags) = &mut self.tags {
            tags.rescale(factor);
        }
        if let Some(floor) = &mut self.floor {
            floor.rescale(factor, self.active.id);
        }
    }

    /// The present map's lengths become `factor` times as long; they are metres from now on.
    fn rescale(&mut self, factor: f64) {
        let first = !self.active.fusion.is_metric();
        self.discard_job();
        let before = self.active.odometry.last.map(|last| last.camera_from_world);
        if first {
            self.unify_units();
        }
        self.scale_lengths(factor);
        if let Some(tags) = &mut self.tags {
            tags.rescale(factor);
        }
        let active = &mut self.active;
        active.fusion.rescale(factor);
        let after = active.odometry.last.map(|last| last.camera_from_world);
        if first {
            active.odometry.odom_from_camera.translation *= factor;
            let (map, into) = (active.id, active.next_id);
            // The number is taken: the map that begins next must have another.
            (active.id, active.next_id) = (into, MapId(into.0 + 1));
            active.map.renumber(map, into);
            // A planner's pose was said in the old unit.
            active.is_placed = false;
            self.events.push(TrajectoryEvent::MapJoined { map, into, scale: factor });
            self.counters.resets += 1;
        } else {
            let keyframes = active.map.keyframes.iter().map(|(id, _)| KeyframeId(id));
            self.events.extend(keyframes.map(|keyframe| TrajectoryEvent::KeyframeScaled { keyframe, scale: factor }));
            if let Some((old, new)) = before.zip(after) {
                self.corrections.moved(&old, &new);
            }
        }
        if let Some(floor) = &mut self.floor {
            floor.rescale(factor, self.active.id);
        }
    }
}

impl Odometry {
    /// Lengths are `factor` times as long from now on; the smooth pose stays where it is.
    fn rescale(&mut self, factor: f64) {
        let Some(last) = &mut self.last else { return };
        let pose: &mut Se3<Camera, World> = &mut last.camera_from_world;
        pose.translation *= factor;
        if let Some((motion, _)) = &mut last.step {
            motion.translation *= factor;
        }
    }
}
