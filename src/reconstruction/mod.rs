//! From features to poses and a map. Knows no V4L2, ring or iceoryx2.
//!
//! One frame's journey is [`Reconstruction::track`] (its pose, published at once) and then [`Reconstruction::map`] (what
//! the map learns from it). Adjustment runs elsewhere, on copies ([`MappingJob`]), and is merged after a later
//! frame's pose (or before it, where frames come slowly). In lock-step everything is a function of the input alone.

mod access;
mod active_map;
mod adjust;
mod blind;
pub mod config;
mod consensus;
mod corrections;
mod covariance;
mod dead_reckoning;
mod far_pictures;
mod graph;
mod initialise;
mod keyframe;
mod loops;
mod measurement;
mod metric;
mod odometry;
mod optics;
mod persistence;
mod recorded;
mod recording;
mod relocalise;
mod reset;
mod scale_uncertainty;
mod scanning;
mod second_look;
mod segments;
mod surroundings;
mod track;
pub mod types;
mod work;

pub use adjust::intrinsics::{FOUND_SIGMA, LensEstimate, LensKnowledge, LensPrior, guessed_camera};
pub use adjust::job::MappingJob;
pub use config::ReconstructionConfig;
pub use corrections::Corrections;
pub use dead_reckoning::Reckoned;
pub use loops::recognition::Recognition;
pub use relocalise::merging::Waiting;
pub use surroundings::NoScan;
pub use types::*;
pub use work::{InlineWorker, Work, Worker};

use active_map::ActiveMap;
use adjust::mapper::{Mapper, Merge};
use consensus::contradiction::Contradiction;
use dead_reckoning::{Ahead, DeadReckoning};
use far_pictures::FarPictures;
use initialise::initialiser::Initialiser;
use initialise::orientation::OrientationTracker;
use keyframe::cull;
use keyframe::distance_prior;
use keyframe::epipolar::EpipolarMatcher;
use keyframe::pictures::{WHOLE_PICTURES, condense_pictures, reduce_pictures};
use keyframe::{KeyframeInputs, Lens, NewKeyframe};
use loops::Loops;
use measurement::inverse_distance::mostly_assumed;
use optics::Optics;
use relocalise::Relocaliser;
use relocalise::descriptors::describe_kept;
use relocalise::other_maps::{OtherMaps, WORTH_KEEPING};
use scale_uncertainty::ToldBehind;
use second_look::kept::SecondLook;
use segments::Wheels;
use surroundings::Surroundings;
use track::frame::Frame;
use track::search::Match;
use track::{Tracked, Tracker};

use crate::features::{Feedback, FrameFeatures};
use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::image::pyramid::PyramidPool;
use crate::map::saved::Taken;
use crate::motion::floor::{Floor, ScaleConfig};
use crate::motion::hand_eye::Robot;
use crate::motion::tag::{self, TagConfig, Tags};
use crate::motion::wheel_scale::WheelConfig;

/// Share of the landmarks looked for below which a frame is looked for elsewhere too: after a stretch of blur a few landmarks can hold a pose
/// that has slid away. Without it errors over 35 sequences are 15 % larger in the geometric mean, those of one with cuts five times.
const WEAK_SHARE: f64 = 0.25;

/// What the frame just tracked is to become.
#[derive(Debug, Clone, Copy, Default)]
struct Pending {
    /// Its pose, if it becomes a keyframe.
    keyframe: Option<Se3<Camera, World>>,
    /// Most of what it sees is at assumed distances; the median parallax to where these were seen first, if they are right, degrees.
    turned: Option<f64>,
}

/// Tracking and mapping. One frame is [`track`](Self::track) (publish its result at once), then [`map`](Self::map).
pub struct Reconstruction {
    config: ReconstructionConfig,
    optics: Optics,
    state: TrackingState,
    active: ActiveMap,
    others: OtherMaps,
    loops: Loops,
    far: FarPictures,
    initialiser: Initialiser,
    /// While there is no map.
    orientation: OrientationTracker,
    contradiction: Contradiction,
    second_look: SecondLook,
    tracker: Tracker,
    relocaliser: Relocaliser,
    epipolar: EpipolarMatcher,
    /// Where tags of a known size are looked for.
    tags: Option<Tags>,
    /// Where the camera's height above the floor is known.
    floor: Option<Floor>,
    /// What was told of the part of the map behind a turn on the spot, until the frame's end.
    told_behind: Option<ToldBehind>,
    surroundings: Surroundings,
    /// Of the newest keyframes and their neighbours: when one is reduced the next takes its place, which keeps the heap in one piece.
    pictures: PyramidPool,
    mapper: Mapper,
    corrections: Corrections,
    wheels: Wheels,
    blind: DeadReckoning,
    pending: Pending,
    /// The map stays as it is: no keyframe, no adjustment, no other map.
    localise_only: bool,
    /// Maps and camera as they were when changes were last taken.
    taken: Option<Taken>,
    /// Timestamp of the newest frame, ns.
    frame_ns: i64,
    events: Vec<TrajectoryEvent>,
    /// Of these, `frames` is the clock of everything that counts frames, and `resets` is published as the reset counter.
    counters: Counters,
}

impl Reconstruction {
    /// `lockstep`: mapping results are merged a fixed number of frames after they were posted, by waiting.
    pub fn new(
        config: &ReconstructionConfig,
        camera: &CameraModel,
        worker: Box<dyn Worker<MappingJob>>,
        lockstep: bool,
    ) -> Self {
        Self::with_lens(config, camera, LensPrior::Calibrated, worker, lockstep)
    }

    /// The same with a camera whose intrinsics may be a guess.
    pub fn with_lens(
        config: &ReconstructionConfig,
        camera: &CameraModel,
        prior: LensPrior,
        worker: Box<dyn Worker<MappingJob>>,
        lockstep: bool,
    ) -> Self {
        Self {
            config: config.clone(),
            optics: Optics::new(camera, prior, config),
            state: TrackingState::Initializing,
            active: ActiveMap::default(),
            others: OtherMaps::default(),
            loops: Loops::default(),
            far: FarPictures::default(),
            initialiser: Initialiser::default(),
            orientation: OrientationTracker::default(),
            contradiction: Contradiction::default(),
            second_look: SecondLook::new(prior),
            tracker: Tracker::default(),
            relocaliser: Relocaliser::default(),
            epipolar: EpipolarMatcher::default(),
            tags: None,
            floor: None,
            told_behind: None,
            surroundings: Surroundings::default(),
            pictures: PyramidPool::new(WHOLE_PICTURES, 1),
            mapper: Mapper::new(worker, lockstep),
            corrections: Corrections::default(),
            wheels: Wheels::new(Robot::unknown(), WheelConfig::default().scale_sigma),
            blind: DeadReckoning::default(),
            pending: Pending::default(),
            localise_only: false,
            taken: None,
            frame_ns: i64::MIN,
            events: Vec::new(),
            counters: Counters::default(),
        }
    }

    /// Looks for tags of a known size in keyframes from now on, if the configuration names a size.
    pub fn look_for_tags(&mut self, config: &TagConfig) {
        self.tags = Tags::new(config);
    }

    /// Looks for the floor from now on, if the configuration says how high the camera is above it. `base`: how the camera sits on the robot, as far
    /// as that is said.
    pub fn look_for_floor(&mut self, config: &ScaleConfig, base: &Robot) {
        self.floor = Floor::new(config, base);
    }

    /// The pose of a frame. Allocates nothing once warm while there is a map older than a second and the frame is found in it, unless the one before is
    /// so long ago that an adjustment is merged first.
    pub fn track(&mut self, features: &FrameFeatures) -> PoseEstimate {
        self.counters.frames += 1;
        self.pending = Pending::default();
        let before_ns = std::mem::replace(&mut self.frame_ns, features.timestamp_ns);
        self.merge_after_gap(features.timestamp_ns.saturating_sub(before_ns));
        self.active.bindings.retain_living(&features.tracks);
        if self.state == TrackingState::Initializing && !self.localise_only {
            return self.try_start(features);
        }
        let ahead = self.look_ahead(features.timestamp_ns);
        match self.place(features, ahead.as_ref()) {
            Some(tracked) if self.fails_probation(features, &tracked.camera_from_world) => self.begin_anew(features),
            Some(tracked) if self.is_contradicted(features, &tracked.camera_from_world) => self.lose(features, None),
            Some(tracked) => self.accept(features, &tracked, ahead.as_ref()),
            None => self.lose(features, ahead.as_ref()),
        }
    }

    /// Where a frame is in the map: near the last one, where the wheels have gone from there, or anywhere.
    fn place(&mut self, features: &FrameFeatures, ahead: Option<&Ahead>) -> Option<Tracked> {
        let reference = self.expected_reference(ahead);
        let ActiveMap { map, bindings, odometry, .. } = &self.active;
        let frame = Frame {
            features,
            map,
            bindings,
            camera: &self.optics.camera,
            config: &self.config,
            before: odometry.before(features.timestamp_ns),
            was_here: odometry.last.is_some(),
            motion: odometry.motion().or_else(|| ahead.and_then(|ahead| ahead.motion)),
            shutter: &self.optics.shutter,
            outlier_chi2: self.optics.noise.outlier_chi2(),
        };
        let (guesses, n) = odometry.guesses(features.timestamp_ns, ahead.map(|ahead| &ahead.now_from_last));
        let by_wheels = |t: &Tracked| {
            let told = ahead.zip(odometry.last);
            told.is_some_and(|(a, last)| a.agrees(&last.camera_from_world, &t.camera_from_world))
        };
        // Something must speak for a pose beside a few landmarks that fit: any picture has some (15 of 220, by 3 px, where the camera was put elsewhere between
        // two frames). After lost frames that is the landmarks themselves: another place, or this one in a mirror, has more.
        let followed = odometry.followed().map(|last| {
            let dt = (features.timestamp_ns - last.timestamp_ns) as f64 * 1e-9;
            (last.camera_from_world, dt)
        });
        let believed = |tracker: &Tracker, t: &Tracked| match followed {
            Some(_) => t.by_flow || t.share() >= WEAK_SHARE || by_wheels(t) || tracker.is_next(&frame, t, followed),
            None => t.speaks_for_itself(&frame) || t.share() >= WEAK_SHARE && by_wheels(t),
        };
        let mut tracked = self.tracker.track(&frame, reference, &guesses[..n], believed);
        if tracked.as_ref().is_none_or(|t| t.share() < WEAK_SHARE) {
            let likely = self.loops.likely(map, &features.pyramid);
            self.far.ask(&likely);
            let elsewhere = self.relocaliser.place(&frame, reference, &likely);
            if elsewhere.is_none() {
                self.far.ask_ahead(self.relocaliser.ahead(map));
            }
            let better = |other: &Tracked| tracked.is_none_or(|weak| 5 * other.landmarks > 6 * weak.landmarks);
            if let Some(other) = elsewhere.filter(better) {
                std::mem::swap(&mut self.tracker, &mut self.relocaliser.tracker);
                self.contradiction.look_anew();
                tracked = Some(other);
            }
        }
        tracked
    }

    /// The place of a frame that a start has put at `pose`, found like any other's; of the matches inliers are kept.
    fn track_at(&mut self, features: &FrameFeatures, pose: Se3<Camera, World>) -> Option<Tracked> {
        let frame = Frame {
            features,
            map: &self.active.map,
            bindings: &self.active.bindings,
            camera: &self.optics.camera,
            config: &self.config,
            before: None,
            was_here: true,
            motion: None,
            shutter: &self.optics.shutter,
            outlier_chi2: self.optics.noise.outlier_chi2(),
        };
        let tracked = self.tracker.track(&frame, self.active.reference, &[pose], |_, _| true)?;
        self.tracker.keep_inliers();
        Some(tracked)
    }

    /// Notes for each landmark whether it was found. A frame that shows less than half of what should be there (blur, something
    /// in front) speaks of itself and not of its landmarks: the map must not be thinned out by it. (Without: five times the error
    /// on a desk at a third of the rate.)
    fn count_landmarks(&mut self, tracked: &Tracked) {
        let telling = 2 * tracked.landmarks >= tracked.sought;
        let map = &mut self.active.map;
        for m in self.tracker.matches().iter().filter(|m| m.inlier || telling) {
            map.count_sighting(m.landmark, m.inlier);
        }
        for id in self.tracker.missed().iter().filter(|_| telling) {
            map.count_sighting(*id, false);
        }
    }

    fn accept(&mut self, features: &FrameFeatures, tracked: &Tracked, ahead: Option<&Ahead>) -> PoseEstimate {
        let odom_by_wheels = self.odom_after_reckoning(ahead);
        if !self.localise_only {
            self.count_landmarks(tracked);
        }
        self.tracker.keep_inliers();
        if !self.localise_only {
            self.follow_assumed(&tracked.camera_from_world);
        }
        let pose = tracked.camera_from_world;
        let active = &mut self.active;
        let resumed = active.odometry.lost_frames > 0;
        if resumed {
            self.counters.relocalisations += 1;
            self.initialiser.clear();
        }
        self.state = TrackingState::Tracking;
        self.counters.frames_tracked += 1;
        active.frames += 1;
        active.reference = self.tracker.best_reference(&active.map).unwrap_or(active.reference);
        self.tracker.note_accepted(tracked);
        let step = active.odometry.accept(features.timestamp_ns, pose);
        if let Some(odom) = odom_by_wheels {
            active.odometry.odom_from_camera = odom;
        }
        let keyframe = !resumed && !self.localise_only && self.decide_keyframe(&pose);
        self.record_pose(features.timestamp_ns, &pose);
        self.pending.keyframe = keyframe.then_some(pose);
        let estimate = self.estimate_tracked(features, tracked, step.as_ref(), keyframe);
        self.note_seen(&estimate.covariance);
        estimate
    }

    /// Whether the frame just tracked becomes a keyframe; notes as well whether it comes out of a turn on the spot.
    fn decide_keyframe(&mut self, pose: &Se3<Camera, World>) -> bool {
        let ActiveMap { map, odometry, reference, .. } = &self.active;
        let Some(reference) = map.keyframe(*reference) else { return false };
        let (here, there) = (pose.inverse().translation, reference.centre());
        let parallax_deg = self.tracker.median_parallax_deg(&here, |_| Some(there));
        let matches = self.tracker.matches();
        let inputs = KeyframeInputs {
            landmarks: matches.len(),
            reference_landmarks: reference.observations.len(),
            parallax_deg,
            turn_rad: odometry.last.and_then(|last| last.step).map_or(0.0, |(step, _)| step.rotation.angle()),
        };
        let begins =
            |m: &Match| distance_prior::ray_begins(map, m.landmark).and_then(|id| Some(map.keyframe(id)?.centre()));
        let assumed = matches.iter().filter(|m| begins(m).is_some()).count();
        let is_blind = mostly_assumed(assumed, inputs.landmarks);
        self.pending.turned = is_blind.then(|| self.tracker.median_parallax_deg(&here, begins));
        keyframe::wants_keyframe(&inputs, &self.config)
    }

    fn lose(&mut self, features: &FrameFeatures, ahead: Option<&Ahead>) -> PoseEstimate {
        self.contradiction.look_anew();
        self.active.odometry.lose(features.timestamp_ns);
        if let Some(ahead) = ahead {
            return self.reckon(features, ahead);
        }
        self.blind.reckoned = None;
        self.state = TrackingState::Lost;
        if self.active.map.keyframes.len() < WORTH_KEEPING && !self.localise_only {
            // What was seen while it was lost begins the next map.
            let seen = std::mem::take(&mut self.initialiser);
            self.give_up_map();
            self.initialiser = seen;
            return self.begin_anew(features);
        }
        let is_lost_long = self.active.odometry.lost_for_s(features.timestamp_ns) > self.config.lost_s;
        if is_lost_long && let Some(tracked) = self.find_in_kept(features) {
            return self.accept(features, &tracked, None);
        }
        if self.localise_only {
            return self.estimate_none(features);
        }
        if is_lost_long {
            return self.begin_beside(features);
        }
        let Optics { camera, intrinsics, .. } = &self.optics;
        self.initialiser.watch(features, camera, intrinsics.supposed(camera));
        self.estimate_none(features)
    }

    /// Keyframe work for the frame just tracked (the same `features`), after its pose was published.
    pub fn map(&mut self, features: &FrameFeatures, feedback: &mut Feedback) {
        feedback.forget.clear();
        self.enter_loaded();
        let Self { far, active, others, loops, counters, config, .. } = self;
        let maps = (&mut active.map, others);
        far.exchange(maps, active.reference, config.detailed_keyframes, loops.is_entering(), counters);
        if self.localise_only {
            return self.bind_found(features);
        }
        self.note_motion_before(features.timestamp_ns);
        let placed = self.place_after_turn(features);
        if let Some(pose) = &placed {
            self.record_instead(features.timestamp_ns, pose);
        }
        if let Some(pose) = placed.or_else(|| self.pending.keyframe.take()) {
            self.insert_keyframe(features, pose, feedback);
            feedback.forget.sort_unstable();
        } else {
            self.ask_older();
        }
        self.merge_adjustment(Merge::WhenDue);
        self.hear_recognition(Merge::WhenDue);
        self.follow_scale(features);
        self.keep_for_second_look();
        self.post_adjustment();
    }

    /// Corrects the keyframe that the frame before has become by how the camera moved there, which the frame just tracked tells. That one is recorded
    /// relative to where the keyframe is now.
    fn note_motion_before(&mut self, timestamp_ns: i64) {
        let Self { optics, active, mapper, .. } = self;
        let Some(last) = &mut active.odometry.last else { return };
        let here = last.camera_from_world;
        let (Some((at_ns, motion)), Some(id)) = (last.motion_before.take(), active.map.newest()) else { return };
        if active.map.keyframe(id).is_none_or(|k| k.timestamp_ns != at_ns) || optics.shutter.is_off() {
            return;
        }
        let corrected = keyframe::motion::correct(&mut active.map, id, &motion, &optics.camera, &optics.shutter);
        let Some(moved) = corrected else { return };
        mapper.note_moved(moved, active.last_keyframe_frame);
        moved.apply(&mut active.map, optics.shutter.readout_s);
        self.record_instead(timestamp_ns, &here);
    }

    fn insert_keyframe(&mut self, features: &FrameFeatures, pose: Se3<Camera, World>, feedback: &mut Feedback) {
        let Self { config, optics: Optics { camera, shutter, noise, .. }, active, counters, .. } = self;
        let ActiveMap { map, bindings, .. } = active;
        let measured = self.pending.turned.is_none();
        let copied: Result<_, std::convert::Infallible> = self.pictures.fill(|own| {
            own.copy_from(&features.pyramid);
            Ok(())
        });
        let Ok(picture) = copied;
        let lens = Lens { camera, config, shutter, outlier_chi2: noise.outlier_chi2() };
        let new = NewKeyframe {
            features,
            picture,
            camera_from_world: pose,
            map_id: active.id,
            matches: self.tracker.matches(),
            motion: active.odometry.motion(),
            lens,
            scale_from: map.keyframe(active.reference).and_then(|k| k.scale_from),
            unmeasured: !measured,
            assumed_distance: distance_prior::distance_to_assume(self.tracker.matches(), &pose.inverse().translation),
        };
        let before = map.landmarks.len();
        let id = keyframe::insert_keyframe(map, bindings, &new, feedback);
        if measured {
            let min_parallax = config.min_parallax_deg.to_radians();
            distance_prior::triangulate_assumed(map, id, camera, shutter.readout_s, min_parallax);
            let first_new = map.landmarks.next_id();
            self.epipolar.complete(map, id, &lens);
            keyframe::bind_new(map, bindings, features, id, first_new);
        }
        self.events.push(TrajectoryEvent::KeyframeMade { timestamp_ns: features.timestamp_ns, keyframe: id });
        counters.keyframes_made += 1;
        counters.landmarks_made += (map.landmarks.len() - before) as u64;
        active.last_keyframe_frame = counters.frames;
        active.reference = id;
        active.scale.follow(map);
        counters.landmarks_culled += cull::cull_landmarks(map);
        let mut held = self.tags.as_ref().map_or_else(Vec::new, |tags| tags.rest_on(map));
        held.extend(self.loops.ends());
        held.extend(distance_prior::rays_begin(map, id));
        held.sort_unstable();
        // What goes leaves its poses to others, which may be wrong while the picture contradicts them.
        if !self.contradiction.is_suspected() {
            counters.keyframes_culled +=
                cull::cull_keyframes((map, active.id), id, (camera, &held), config, &mut self.events);
            let (most, turn) = ((config.max_keyframes, held.as_slice()), &mut active.thinned);
            counters.keyframes_culled += cull::thin_out((map, active.id), id, most, turn, &mut self.events);
        }
        reduce_pictures(map, id);
        let (condensed, gone) = condense_pictures(map, id, (config.detailed_keyframes, camera), describe_kept);
        counters.landmarks_culled += gone;
        self.loops.shorten(map, &condensed);
        active.unadjusted = Some(id);
        self.recognise(features, id);
        self.look_for_loop(features, id);
        if let (Some(tags), Some(picture)) = (&mut self.tags, features.pyramid.levels.first()) {
            let optics = tag::Optics { camera: &self.optics.camera, readout_s: self.optics.shutter.readout_s };
            if tags.see((&self.active.map, self.active.id), id, picture, &optics)
                && let Some(word) = tags.measurement(self.active.id)
            {
                self.hear_at(id, &word, 0.0);
            }
        }
        let (map, optics) = (&self.active.map, &self.optics);
        if let Some(floor) = &mut self.floor
            && let Some(word) = floor.see(map, self.active.id, id, &|landmark| {
                keyframe::point::floor_point(map, landmark, &optics.camera, &optics.shutter)
            })
        {
            let common_sigma = floor.common_sigma();
            self.hear_at(id, &word, common_sigma);
        }
        self.note_floor(id);
    }
}

#[cfg(test)]
mod tests;
