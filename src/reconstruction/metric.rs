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
use super::active_map::ActiveMap;
use super::keyframe::distance_prior;
use super::odometry::Odometry;
use super::scale_uncertainty::{Parts, ToldBehind};
use super::segments::{FrameEnd, Wheels};
use super::types::{TrackingState, TrajectoryEvent};
use crate::features::FrameFeatures;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, Keyframe as KeyframeFrame, World};
use crate::geometry::sim3::Sim3;
use crate::map::scale::MapScale;
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

    /// What a source says of the part of the map that keyframe `at` is in, and the standard deviation of an error that all of its words share.
    pub(super) fn hear_at(&mut self, at: KeyframeId, word: &ScaleMeasurement, common_sigma: f64) {
        let part = self.active.map.keyframe(at).and_then(|k| k.scale_from);
        self.hear_of(part, word, common_sigma);
    }

    /// The same of a part. Of one behind a turn on the spot, which has a unit of its own, it is heard once it is sure enough to give it another; of
    /// several words in a frame that is the surest.
    fn hear_of(&mut self, part: Option<TurnId>, word: &ScaleMeasurement, common_sigma: f64) {
        let Some(turn) = part else {
            self.active.fusion.add_sharing(word, common_sigma);
            return;
        };
        let told = ToldBehind { turn, word: *word, common_sigma };
        let ActiveMap { fusion, scale, .. } = &self.active;
        let known = fusion.fused().filter(|_| fusion.is_metric());
        let known = known.map_or(METRIC_SIGMA, |(_, sigma, _)| sigma.hypot(scale.sigma_behind(part, false)));
        let is_surer = self.told_behind.is_none_or(|other| other.turn != turn || told.sigma() < other.sigma());
        if told.sigma() <= known.min(METRIC_SIGMA) && is_surer {
            self.told_behind = Some(told);
        }
    }

    /// The part of the map behind a turn has been told its scale, and one with it become all whose ratio to it is known; where the part that has
    /// the map's unit is metric, that stays as long as it is.
    fn become_one_with(&mut self, told: &ToldBehind) {
        let newest = Some(told.turn);
        let ActiveMap { fusion, scale, .. } = &self.active;
        let metric = fusion.fused().filter(|_| fusion.is_metric()).map(|(log, ..)| log);
        // The robot has gone back meanwhile, or on behind another turn: it will be asked again.
        if self.active.part() != newest || scale.is_enclosed(newest) {
            return;
        }
        self.discard_job();
        let before = self.active.odometry.pose();
        let log = told.word.log_metres_per_unit;
        let wheels = &self.wheels;
        let of_beginning = wheels.ratio(None, newest);
        // A metric map's beginning stays as long as it is, and by that the wheels may tell a part between more surely than by the newest.
        let stays = metric.map(|beginning| (beginning - log, 0.0));
        let by_beginning = |part| {
            let ((log, _), (ratio, sigma)) = stays.zip(wheels.ratio(part, None))?;
            Some((log + ratio, sigma))
        };
        let parts = self.active.scale.in_one_unit(&self.active.map, newest, |part| match part {
            None => stays.or(of_beginning),
            Some(_) => {
                wheels.ratio(part, newest).into_iter().chain(by_beginning(part)).min_by(|a, b| a.1.total_cmp(&b.1))
            }
        });
        self.move_parts(&parts);
        let fusion = &mut self.active.fusion;
        let Some(beginning) = metric else {
            fusion.carry(of_beginning);
            fusion.add_sharing(&told.word, told.common_sigma);
            match fusion.due() {
                Some(factor) => self.rescale(factor),
                None => self.note_moved(before),
            }
            return;
        };
        // Its words are of the beginning, which has become as much longer as the newest unit was told to be and its own was known to be.
        fusion.carry(Some((beginning - log, 0.0)));
        fusion.heard_behind_turn(&told.word, told.common_sigma);
        self.change_unit(log.exp());
        self.active.fusion.rescale(log.exp());
        self.note_moved(before);
    }

    /// The camera was at `before`, and parts of the map have moved.
    fn note_moved(&mut self, before: Option<Se3<Camera, World>>) {
        if let Some((old, new)) = before.zip(self.active.odometry.pose()) {
            self.corrections.moved(&old, &new);
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
        if let Some(told) = self.told_behind.take() {
            self.become_one_with(&told);
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
        let newest = self.wheels.newest_part();
        // What is known of a metric map's beginning, carried over the turn by the wheels, may be surer than what they tell behind it: an error common
        // to both wheels is not in it.
        let known = self.active.fusion.fused().filter(|_| newest.is_some() && self.active.fusion.is_metric());
        let carried = self.wheels.ratio(None, newest).zip(known).map(|((ratio, ratio_sigma), (log, sigma, _))| {
            ScaleMeasurement { log_metres_per_unit: log - ratio, sigma: sigma.hypot(ratio_sigma), ..word }
        });
        let word = carried.filter(|carried| carried.sigma < word.sigma).unwrap_or(word);
        self.hear_of(newest, &word, 0.0);
        let scale = &self.active.scale;
        let is_surer = |part| self.wheels.ratio(part, None).is_some_and(|(_, sigma)| scale.is_surer(part, sigma));
        if newest.is_none() && self.active.fusion.is_metric() && self.wheels.others().any(is_surer) {
            self.take_up_told();
        }
    }

    /// What is in doubt of a metric map, and what the wheels have told the ratio of since, takes its unit.
    fn take_up_told(&mut self) {
        self.discard_job();
        let before = self.active.odometry.pose();
        let parts = self.active.scale.in_one_unit(&self.active.map, None, |part| self.wheels.ratio(part, None));
        self.move_parts(&parts);
        self.note_moved(before);
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

    /// Parts of the map, and what was told of them, move and are named so.
    pub(super) fn move_parts(&mut self, parts: &Parts) {
        let keyframes: Vec<_> =
            self.active.map.keyframes.iter().map(|(id, k)| (KeyframeId(id), k.scale_from)).collect();
        let moved = keyframes.iter().map(|(id, part)| (*id, parts.of(*part).motion)).collect();
        self.active.scale.rename(parts);
        self.move_map(&Correction { keyframes: moved, younger: None });
        for (id, part) in keyframes {
            self.active.map.set_scale_origin(id, parts.of(part).name);
        }
        // What was under way began from places that are no more.
        self.active.unadjusted = self.active.map.newest();
        self.wheels.follow_parts(parts);
        if let Some(tags) = &mut self.tags {
            tags.follow_parts(|part| (parts.of(part).name, parts.of(part).motion));
        }
        if let Some(floor) = &mut self.floor {
            floor.rename(|part| parts.of(part).name);
        }
    }

    /// All that has a length of the present map becomes `factor` times as long.
    fn scale_lengths(&mut self, factor: f64) {
        let active = &mut self.active;
        let motion = Sim3::new(factor, UnitQuaternion::identity(), Vector3::zeros());
        active.map.transform(&motion);
        active.odometry.rescale(factor);
        active.scale.carry(&motion);
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
        if let Some(told) = &mut self.told_behind {
            told.word.log_metres_per_unit -= factor.ln();
        }
    }

    /// The same, and in the record of a trajectory, and what tags and the floor have told.
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
        let before = self.active.odometry.pose();
        self.scale_lengths(factor);
        if let Some(tags) = &mut self.tags {
            tags.rescale(factor);
        }
        let active = &mut self.active;
        active.fusion.rescale(factor);
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
            self.note_moved(before);
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
