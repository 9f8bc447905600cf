//! What reconstruction does about loops: has an old place looked for at each keyframe, weighs what was found, has it closed, takes over what came
//! of it.

use super::recognition::Recognition;
use super::{ENTERED_WITH_FRAME, FoundLoop, Loops};
use crate::features::FrameFeatures;
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::median;
use crate::geometry::sim3::Sim3;
use crate::map::{Correction, KeyframeId, Map};
use crate::places::loops::{LoopClosure, LoopEdge};
use crate::places::way::shortest_way;
use crate::reconstruction::Reconstruction;
use crate::reconstruction::adjust::mapper::Merge;
use crate::reconstruction::relocalise::joining::add_found;
use crate::reconstruction::relocalise::other_maps::{REMEMBERED, Sighting, Similarity, seen_most_by, similarity};
use crate::reconstruction::types::TrajectoryEvent;
use crate::reconstruction::work::Worker;

/// Two sightings so many keyframes apart are not one soon after the other.
const SOON: u32 = 40;
/// Drift that a way can have: of the place, as a share of the way (and half of what the scale changed by, as lengths do) and of the scene's
/// depth; of the direction, rad; of the logarithm of the scale, and of a scale that wheels or tags tell. In the simulator's rooms true loops
/// had drifted by 0.3 % of the way, and in rooms that look alike wrong ones would have told a drift of 24 % of it and more.
const MOST_DRIFT: f64 = 0.08;
const MOST_DRIFT_DEPTHS: f64 = 0.15;
const MOST_RAD: f64 = 0.5;
const MOST_LOG_SCALE: f64 = 1.1;
const MOST_METRIC_LOG_SCALE: f64 = 0.1;
/// Times as many frames as for an adjustment until lock-step waits for a recognition.
const RECOGNISED_AFTER: u64 = 2;
/// Neighbours of a keyframe of old that its landmarks are looked for with.
const AROUND: usize = 20;
/// Next to nothing: rotation, rad; distance, in median depths; logarithm of the scale.
const LITTLE_RAD: f64 = 0.01;
const LITTLE_DEPTHS: f64 = 0.02;
const LITTLE_LOG_SCALE: f64 = 0.02;
/// Ends of closed loops that are remembered for the next pose graph, and that therefore no keyframe makes up for.
const MOST_CLOSED: usize = 64;

impl Reconstruction {
    /// Who recognises places from now on; without this call it is done at once, which delays the poses after it.
    pub fn recognise_in(&mut self, worker: Box<dyn Worker<Recognition>>) {
        self.loops.recogniser.discard();
        self.loops.recogniser.worker = worker;
    }

    /// Loops that were closed in the present maps: the keyframe of old, and the one that it was recognised from; the newest last.
    pub fn closed_loops(&self) -> impl Iterator<Item = (KeyframeId, KeyframeId)> {
        self.loops.closed.iter().copied()
    }

    /// Enters the frame that has just become the keyframe `id`, and with `loops` has it looked for in the likeliest old place.
    pub(in crate::reconstruction) fn look_for_loop(&mut self, features: &FrameFeatures, id: KeyframeId) {
        let Self { loops, active, others, .. } = self;
        loops.follow(&active.map, others);
        loops.describer.describe(&features.pyramid, &mut loops.seen);
        let idle = loops.waiting.is_none() && loops.under_way.is_none() && !loops.recogniser.is_busy();
        if self.config.loops && idle && self.pending.turned.is_none() && self.counters.frames >= self.loops.next_attempt
        {
            self.try_places(features, id);
        }
        let loops = &mut self.loops;
        loops.index.add(id, &loops.seen);
    }

    /// Enters some of the keyframes that wait.
    pub(in crate::reconstruction) fn enter_loaded(&mut self) {
        let Self { loops, active, others, .. } = self;
        loops.enter(&active.map, others, ENTERED_WITH_FRAME);
    }

    fn try_places(&mut self, features: &FrameFeatures, id: KeyframeId) {
        let Self { loops, active, optics, config, counters, .. } = self;
        let places = loops.likeliest(&active.map, id);
        if places.is_empty() {
            loops.warm = 0;
            return;
        }
        let Some(keyframe) = active.map.keyframe(id) else { return };
        // The frame's own picture goes back to its pool soon.
        let Some(pyramid) = keyframe.picture.shared() else { return };
        let (attempt, relocaliser) = loops.recogniser.lend();
        let work = Recognition {
            keyframe: id,
            part: active.map.part(&places, AROUND, attempt),
            places,
            features: FrameFeatures { pyramid, tracks: Vec::new(), ..*features },
            motion: keyframe.motion.map(CameraMotion::turned_only),
            camera: optics.camera.clone(),
            shutter: optics.shutter,
            outlier_chi2: optics.noise.outlier_chi2(),
            config: config.clone(),
            relocaliser,
        };
        loops.recogniser.post(work, counters.frames);
    }

    /// Takes what the search for an old place has found, if it has ended; lock-step waits for it at a fixed frame.
    pub(in crate::reconstruction) fn hear_recognition(&mut self, when: Merge) {
        if when == Merge::AtTheEnd {
            return self.loops.recogniser.discard();
        }
        let (lockstep, early) = (self.mapper.is_lockstep(), when == Merge::BeforeTracking);
        let due_after = RECOGNISED_AFTER * self.config.merge_after_frames;
        let frame = self.counters.frames;
        let Some(sighting) = self.loops.recogniser.take(frame, due_after, lockstep, early) else { return };
        let sighting = sighting.and_then(|sighting| self.still_new(sighting));
        self.loops.note_attempt(frame, sighting.is_some());
        if let Some(sighting) = sighting {
            self.weigh(sighting);
        }
    }

    /// What of a sighting is there still, and nothing that the keyframe sees anyway.
    fn still_new(&self, mut sighting: Sighting) -> Option<Sighting> {
        let map = &self.active.map;
        let keyframe = map.keyframe(sighting.keyframe)?;
        sighting.found.retain(|m| map.landmark(m.landmark).is_some() && !keyframe.observations.contains(m.landmark));
        (sighting.found.len() >= 2 * self.config.min_landmarks).then_some(sighting)
    }

    /// Whether one sighting more makes a loop.
    fn weigh(&mut self, sighting: Sighting) {
        let map = &self.active.map;
        let (readout_s, min_parallax) = (self.optics.shutter.readout_s, self.config.min_parallax_deg.to_radians());
        let id = sighting.keyframe;
        let Loops { sightings, closed, .. } = &mut self.loops;
        sightings.retain(|s| map.numbers.since(s.keyframe, id) < SOON && map.keyframe(s.keyframe).is_some());
        let is_metric = self.active.fusion.is_metric();
        let told = sightings.iter().enumerate().rev().find_map(|(i, before)| {
            let told = similarity(map, map, [before, &sighting], readout_s, min_parallax)?;
            drift(map, closed, &sighting, &told)?.is_plausible(is_metric).then_some((i, told))
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
            true => {
                let ties = ties(map, &sightings, &told);
                self.loops.tie(ties);
                self.fuse_found(&sightings);
                self.counters.loops_tied += 1;
            }
            false => {
                if self.mapper.discard() {
                    // To be done yet, should the loop not be closed.
                    (self.active.unadjusted, self.active.next_global) = (map.newest(), 0);
                }
                self.loops.waiting = Some(FoundLoop { sightings, told });
            }
        }
    }

    /// The loop that waits to be closed, as a job.
    pub(in crate::reconstruction) fn loop_closure(&mut self) -> Option<LoopClosure> {
        let found = self.loops.waiting.take()?;
        let map = &self.active.map;
        let edges: Vec<LoopEdge> = found.sightings.iter().filter_map(|s| loop_edge(map, s, &found.told)).collect();
        let newest = found.sightings[1].keyframe;
        let job = LoopClosure::new(map, newest, &edges, &self.loops.closed, self.active.fusion.is_metric())?;
        self.loops.under_way = Some(found);
        Some(job)
    }

    /// Moves the map as a closed loop says, and fuses what is one.
    pub(in crate::reconstruction) fn take_over_loop(&mut self, closed: Option<Correction>) {
        let (Some(found), Some(correction)) = (self.loops.under_way.take(), closed) else { return };
        let before = self.active.odometry.pose();
        self.end_checks();
        self.move_map(&correction);
        if let Some((old, new)) = before.zip(self.active.odometry.pose()) {
            self.corrections.close_loop(&old, &new);
        }
        self.counters.loops_closed += 1;
        // Not before: of a loop that could not be closed the ends lie as they should not.
        let ties = ties(&self.active.map, &found.sightings, &found.told);
        self.loops.tie(ties);
        self.fuse_found(&found.sightings);
        self.active.next_global = 0;
    }

    /// Moves the map, the last frame and what it saw with it, and what is told by them; the smooth pose stays.
    pub(in crate::reconstruction) fn move_map(&mut self, correction: &Correction) {
        let active = &mut self.active;
        for (id, _) in active.map.keyframes.iter() {
            let (keyframe, scale) = (KeyframeId(id), correction.of(KeyframeId(id)).scale);
            self.events.push(TrajectoryEvent::KeyframeScaled { keyframe, scale });
        }
        active.map.correct(correction);
        let here = correction.of(active.reference);
        active.odometry.correct_scaled(&here);
        self.tracker.carry(&here);
        self.wheels.follow_correction(correction);
        if let Some(floor) = &mut self.floor {
            floor.follow(&here);
        }
        active.scale.follow(&active.map);
        self.rescale_told(here.scale);
    }

    /// What both keyframes were found to see of the old place is one with what they see.
    fn fuse_found(&mut self, sightings: &[Sighting; 2]) {
        let map = &mut self.active.map;
        for sighting in sightings {
            let own = map.keyframe(sighting.keyframe).map(|k| k.observations.clone());
            add_found(map, sighting, &own.unwrap_or_default(), &self.optics.camera);
        }
        self.active.unadjusted = map.newest();
    }
}

impl Loops {
    /// From now on these lie as they should; the oldest are forgotten where there are too many.
    fn tie(&mut self, ends: Vec<(KeyframeId, KeyframeId)>) {
        self.closed.extend(ends);
        let too_many = self.closed.len().saturating_sub(MOST_CLOSED);
        self.closed.drain(..too_many);
    }
}

/// Ends of a loop that has been closed.
fn ties(map: &Map, sightings: &[Sighting; 2], told: &Similarity) -> Vec<(KeyframeId, KeyframeId)> {
    sightings.iter().filter_map(|s| loop_edge(map, s, told)).map(|e| (e.old, e.recognised)).collect()
}

/// The keyframe that sees most of what was found, other than the one that was recognised, and how that one lies to it.
fn loop_edge(map: &Map, sighting: &Sighting, told: &Similarity) -> Option<LoopEdge> {
    let old = seen_most_by(map, sighting)?;
    let there = sighting.there * map.keyframe(old)?.camera_from_world.inverse();
    // Measured in the unit of the old place; at its end it is that of the recognised keyframe.
    let scale = told.present_from_other.scale;
    let recognised_from_old = Sim3::new(scale, there.rotation, there.translation * scale);
    let (recognised, log_scale_sigma, landmarks) = (sighting.keyframe, told.log_scale_sigma, sighting.found.len());
    Some(LoopEdge { old, recognised, recognised_from_old, log_scale_sigma, landmarks })
}

/// What a sighting says of the drift between two places.
#[derive(Debug, Clone, Copy)]
struct Drift {
    /// How far the keyframe is from where it should be, map units.
    distance: f64,
    angle_rad: f64,
    log_scale: f64,
    log_scale_sigma: f64,
    /// A turn on the spot lies between, which told no scale.
    untold: bool,
    /// The shortest way between both along the links of the map, map units.
    way: f64,
    /// Median depth of what was found, map units.
    depth: f64,
}

impl Drift {
    /// The way can have drifted so.
    fn is_plausible(&self, is_metric: bool) -> bool {
        let Self { distance, angle_rad, log_scale, log_scale_sigma, untold, way, depth } = *self;
        let scale = log_scale.abs();
        let most_scale = match (is_metric, untold) {
            (true, _) => MOST_METRIC_LOG_SCALE + 3.0 * log_scale_sigma,
            (false, false) => MOST_LOG_SCALE,
            (false, true) => f64::INFINITY,
        };
        distance <= MOST_DRIFT * way + 0.5 * scale * way + MOST_DRIFT_DEPTHS * depth
            && angle_rad <= MOST_RAD
            && scale <= most_scale
    }
}

/// `None` where an end is not in the map, or nothing holds both together.
fn drift(map: &Map, closed: &[(KeyframeId, KeyframeId)], sighting: &Sighting, told: &Similarity) -> Option<Drift> {
    let (distance, depth) = offset(map, sighting)?;
    let edge = loop_edge(map, sighting, told)?;
    let untold = map.keyframe(edge.old)?.scale_from != map.keyframe(sighting.keyframe)?.scale_from;
    let Similarity { present_from_other, log_scale_sigma } = *told;
    Some(Drift {
        distance,
        angle_rad: present_from_other.rotation.angle(),
        log_scale: present_from_other.scale.ln(),
        log_scale_sigma,
        untold,
        way: shortest_way(map, closed, edge.old, edge.recognised)?,
        depth,
    })
}

/// How far a keyframe is from where a sighting says it is, map units of the old place, and the median depth of what was found.
fn offset(map: &Map, sighting: &Sighting) -> Option<(f64, f64)> {
    let here = map.keyframe(sighting.keyframe)?.centre();
    let mut depths: Vec<f64> = sighting.found.iter().map(|m| sighting.there.transform(&m.point).z).collect();
    Some(((here - sighting.there.inverse().translation).norm(), median(&mut depths)?))
}

/// Next to nothing has drifted.
fn is_little(map: &Map, sighting: &Sighting, told: &Similarity) -> bool {
    let Some((distance, depth)) = offset(map, sighting) else { return false };
    let scale = told.present_from_other.scale.ln().abs();
    distance < LITTLE_DEPTHS * depth
        && told.present_from_other.rotation.angle() < LITTLE_RAD
        && scale < LITTLE_LOG_SCALE.max(2.0 * told.log_scale_sigma)
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector2, Vector3};

    use super::*;
    use crate::geometry::{CameraModel, Se3};
    use crate::map::{LandmarkId, examples};
    use crate::reconstruction::track::search::Match;
    use crate::reconstruction::track::template::observe;
    use crate::reconstruction::{InlineWorker, ReconstructionConfig};

    /// Six keyframes side by side, 20 landmarks that the first two share; the last two have been recognised to be where those are.
    fn found_a_loop() -> Reconstruction {
        let camera = CameraModel::new(320, 240, 300.0, 300.0, 159.5, 119.5, [0.0; 5]).expect("a camera");
        let config = ReconstructionConfig::default();
        let mut r = Reconstruction::new(&config, &camera, Box::new(InlineWorker::default()), true);
        let map = &mut r.active.map;
        let ids: Vec<KeyframeId> = (0..6)
            .map(|i| {
                let pose = Se3::new(UnitQuaternion::identity(), Vector3::x() * -f64::from(i));
                map.add_keyframe(examples::keyframe(Default::default(), pose))
            })
            .collect();
        for i in 0..20 {
            let position = Vector3::new(0.05 * f64::from(i), 0.04 * f64::from(i % 7), 3.0);
            let seen = |x: f64| {
                let pixel = camera.project(&(position - Vector3::x() * x)).expect("in front");
                observe(&camera, LandmarkId(0), pixel.cast(), 1.0).expect("in the picture")
            };
            map.add_landmark(examples::landmark(position, ids[1]), &[(ids[0], seen(0.0)), (ids[1], seen(1.0))]);
        }
        let sightings = [sighting(map, 4, 0.0), sighting(map, 5, 1.0)];
        let told = Similarity { present_from_other: Sim3::identity(), log_scale_sigma: 0.01 };
        r.loops.waiting = Some(FoundLoop { sightings, told });
        r
    }

    /// All landmarks were seen from there.
    fn sighting(map: &Map, keyframe: u32, x: f64) -> Sighting {
        let found = map.landmarks.iter().map(|(id, landmark)| {
            let seen = landmark.position - Vector3::x() * x;
            Match {
                landmark: LandmarkId(id),
                template: KeyframeId(0),
                point: landmark.position,
                pixel: Vector2::new(id as f32, 9.0),
                normalised: seen.xy() / seen.z,
                displacement: Vector2::zeros(),
                inv_sigma_px: 1.0,
                inlier: true,
                is_alike: true,
            }
        });
        let there = Se3::new(UnitQuaternion::identity(), Vector3::x() * -x);
        Sighting { keyframe: KeyframeId(keyframe), there, found: found.collect() }
    }

    #[test]
    fn only_the_ends_of_a_loop_that_was_closed_are_tied() {
        let mut r = found_a_loop();
        let job = r.loop_closure().expect("a job");
        assert!(r.loops.closed.is_empty(), "it may fail yet");
        r.take_over_loop(None);
        assert!(r.loops.closed.is_empty() && r.loops.under_way.is_none());
        r.loops.waiting = found_a_loop().loops.waiting;
        let again = r.loop_closure().expect("a job");
        drop(again);
        r.take_over_loop(Some(job.run().expect("closed")));
        assert_eq!(r.loops.closed.iter().map(|tie| tie.1.0).collect::<Vec<_>>(), [4, 5]);
        r.loops.tie(vec![(KeyframeId(1), KeyframeId(2)); MOST_CLOSED]);
        assert_eq!(r.loops.closed.len(), MOST_CLOSED);
    }

    #[test]
    fn a_closure_that_is_discarded_leaves_room_for_the_next() {
        let mut r = found_a_loop();
        drop(r.loop_closure().expect("a job"));
        r.discard_job();
        assert!(r.loops.waiting.is_none() && r.loops.under_way.is_none());
    }

    #[test]
    fn an_adjustment_that_gave_way_to_a_loop_is_done_whatever_becomes_of_the_loop() {
        for is_closed in [false, true] {
            let mut r = found_a_loop();
            r.loops.forget_found();
            r.active.unadjusted = r.active.map.newest();
            r.active.next_global = 0;
            r.post_adjustment();
            assert!(r.mapper.is_busy() && r.active.unadjusted.is_none(), "it is under way");
            // Six tenths of a unit have drifted.
            let told = [sighting(&r.active.map, 4, 3.4), sighting(&r.active.map, 5, 4.4)];
            told.into_iter().for_each(|sighting| r.weigh(sighting));
            assert!(r.loops.waiting.is_some() && !r.mapper.is_busy(), "what it began from is about to move");
            let job = r.loop_closure().expect("a job");
            r.take_over_loop(is_closed.then(|| job.run().expect("closed")));
            assert_eq!(r.counters.loops_closed, u64::from(is_closed));
            r.post_adjustment();
            r.merge_adjustment(Merge::AtTheEnd);
            assert_eq!(r.counters.adjustments, 1, "closed: {is_closed}");
        }
    }

    /// After a way of ten, with nothing drifted.
    const NONE: Drift = Drift {
        distance: 0.0,
        angle_rad: 0.0,
        log_scale: 0.0,
        log_scale_sigma: 0.01,
        untold: false,
        way: 10.0,
        depth: 1.0,
    };

    #[test]
    fn a_drift_is_believed_as_far_as_the_way_explains_it() {
        assert!(NONE.is_plausible(false) && NONE.is_plausible(true));
        // The next room looks the same; a scale that has drifted explains a place that has.
        assert!(!Drift { distance: 2.8, ..NONE }.is_plausible(false));
        assert!(Drift { distance: 2.8, log_scale: -0.5, ..NONE }.is_plausible(false));
        assert!(Drift { distance: 0.9, ..NONE }.is_plausible(false));
        assert!(!Drift { distance: 0.9, way: 3.0, ..NONE }.is_plausible(false), "the way counts, as links have it");
        assert!(!Drift { angle_rad: 1.6, ..NONE }.is_plausible(false), "the same room, turned by a quarter");
        // Wheels tell the scale; a turn on the spot tells none.
        assert!(!Drift { log_scale: 0.3, ..NONE }.is_plausible(true));
        assert!(!Drift { log_scale: 1.5, ..NONE }.is_plausible(false));
        assert!(Drift { log_scale: 1.5, untold: true, ..NONE }.is_plausible(false));
        assert!(!Drift { distance: f64::NAN, ..NONE }.is_plausible(false));
    }
}
