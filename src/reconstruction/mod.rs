//! From features to poses and a map. Knows no V4L2, ring or iceoryx2.
//!
//! One frame's journey is [`Reconstruction::track`] (its pose, published at once) and then [`Reconstruction::map`] (what
//! the map learns from it). Adjustment runs elsewhere, on copies ([`MappingJob`]), and is merged after a later
//! frame's pose (or before it, where frames come slowly). In lock-step everything is a function of the input alone.

mod adjust;
pub mod config;
mod covariance;
mod initialise;
mod keyframe;
mod measurement;
mod odometry;
mod relocalise;
mod scale_uncertainty;
mod track;
pub mod types;

pub use adjust::intrinsics::{FOUND_SIGMA, LensEstimate, LensKnowledge, LensPrior, guessed_camera};
pub use adjust::job::{InlineWorker, MappingJob, MappingResult, MappingWorker};
pub use config::ReconstructionConfig;
pub use types::*;

use adjust::intrinsics::Intrinsics;
use adjust::job::{Merge, WHOLE_FIRST};
use initialise::initialiser::Initialiser;
use keyframe::distance_prior::{self, mostly_assumed};
use keyframe::epipolar::{EpipolarMatcher, FED, Lens};
use keyframe::{KeyframeInputs, NewKeyframe};
use measurement::rolling_shutter::Shutter;
use relocalise::Relocaliser;
use relocalise::other_maps::{OtherMaps, WORTH_KEEPING, retire};
use scale_uncertainty::ScaleDoubt;
use track::association::Bindings;
use track::frame::Frame;
use track::search::Match;
use track::{Tracked, Tracker};

use crate::features::{Feedback, FrameFeatures};
use crate::geometry::frames::{Camera, Keyframe as KeyframeFrame, Odom, World};
use crate::geometry::{CameraModel, Se3};
use crate::map::{KeyframeId, KeyframeView, Map, MapId};

/// Share of the landmarks looked for that are seen: below the first a frame is looked for elsewhere too (after a stretch of blur
/// a few landmarks can hold a pose that has slid away), below the second it is no keyframe.
const WEAK_SHARE: f64 = 0.25;
const KEYFRAME_SHARE: f64 = 0.12;

/// The frame that was tracked last.
#[derive(Debug, Clone, Copy)]
struct LastFrame {
    timestamp_ns: i64,
    camera_from_world: Se3<Camera, World>,
    /// Motion that led here, `this camera from the previous one`, and how long it took.
    motion: Option<(Se3<Camera, Camera>, f64)>,
}

/// Tracking and mapping. One frame is [`track`](Self::track) (publish its result at once), then [`map`](Self::map).
pub struct Reconstruction {
    config: ReconstructionConfig,
    camera: CameraModel,
    worker: Box<dyn MappingWorker>,
    lockstep: bool,
    state: TrackingState,
    map: Map,
    map_id: MapId,
    reset_counter: u32,
    initialiser: Initialiser,
    tracker: Tracker,
    bindings: Bindings,
    last: Option<LastFrame>,
    odom_from_camera: Se3<Odom, Camera>,
    /// Keyframe that shares most with the last frame.
    reference: KeyframeId,
    /// Frames seen, tracked or not: the clock of everything that counts frames.
    frame: u64,
    last_keyframe_frame: u64,
    lost_frames: u64,
    /// Frames tracked in the present map.
    map_frames: u64,
    /// Timestamp of the newest frame, ns.
    frame_ns: i64,
    /// Frame at which the job under way was posted.
    job_posted: Option<u64>,
    /// Newest keyframe that no adjustment has seen yet.
    unadjusted: Option<KeyframeId>,
    /// Keyframes at which the whole map is adjusted next.
    next_whole: usize,
    intrinsics: Intrinsics,
    /// Pose of the frame just tracked, if it becomes a keyframe.
    pending: Option<Se3<Camera, World>>,
    /// Most of what the frame just tracked sees is at assumed distances; the median parallax if they are right, degrees.
    turned: Option<f64>,
    scale_doubt: ScaleDoubt,
    events: Vec<TrajectoryEvent>,
    counters: Counters,
    inliers: Vec<Match>,
    angles: Vec<f64>,
    relocaliser: Relocaliser,
    others: OtherMaps,
    epipolar: EpipolarMatcher,
    shutter: Shutter,
}

impl Reconstruction {
    /// `lockstep`: mapping results are merged a fixed number of frames after they were posted, by waiting.
    pub fn new(
        config: &ReconstructionConfig,
        camera: &CameraModel,
        worker: Box<dyn MappingWorker>,
        lockstep: bool,
    ) -> Self {
        Self::with_lens(config, camera, LensPrior::Calibrated, worker, lockstep)
    }

    /// The same with a camera whose intrinsics may be a guess.
    pub fn with_lens(
        config: &ReconstructionConfig,
        camera: &CameraModel,
        prior: LensPrior,
        worker: Box<dyn MappingWorker>,
        lockstep: bool,
    ) -> Self {
        Self {
            config: config.clone(),
            camera: camera.clone(),
            worker,
            lockstep,
            state: TrackingState::Initializing,
            map: Map::default(),
            map_id: MapId(0),
            reset_counter: 0,
            initialiser: Initialiser::default(),
            tracker: Tracker::default(),
            bindings: Bindings::default(),
            last: None,
            odom_from_camera: Se3::identity(),
            reference: KeyframeId(0),
            frame: 0,
            last_keyframe_frame: 0,
            lost_frames: 0,
            map_frames: 0,
            frame_ns: i64::MIN,
            job_posted: None,
            unadjusted: None,
            pending: None,
            turned: None,
            scale_doubt: ScaleDoubt::default(),
            next_whole: WHOLE_FIRST,
            intrinsics: Intrinsics::new(camera, prior),
            events: Vec::new(),
            counters: Counters::default(),
            inliers: Vec::with_capacity(1024),
            angles: Vec::with_capacity(1024),
            relocaliser: Relocaliser::default(),
            others: OtherMaps::default(),
            epipolar: EpipolarMatcher::default(),
            shutter: Shutter::new(config.readout_ms * 1e-3, camera.height, config.estimate_readout),
        }
    }

    /// The pose of a frame. Allocates nothing once warm while there is a map and the frame is found in it, unless the one before is so
    /// long ago that an adjustment is merged first.
    pub fn track(&mut self, features: &FrameFeatures) -> PoseEstimate {
        self.frame += 1;
        self.counters.frames += 1;
        self.pending = None;
        self.turned = None;
        let before_ns = std::mem::replace(&mut self.frame_ns, features.timestamp_ns);
        self.merge_after_gap(features.timestamp_ns.saturating_sub(before_ns));
        self.bindings.retain_living(&features.tracks);
        if self.state == TrackingState::Initializing {
            return self.try_start(features);
        }
        let near = self.near_poses(features.timestamp_ns);
        let frame = Frame {
            features,
            map: &self.map,
            bindings: &self.bindings,
            camera: &self.camera,
            config: &self.config,
            before: self.frame_before(features.timestamp_ns),
            motion: self.last_motion(),
            shutter: &self.shutter,
            is_calibrated: self.intrinsics.is_calibrated(),
        };
        let near = &near.0[..near.1];
        let mut tracked = self.tracker.track(&frame, self.reference, near);
        if self.lost_frames > 0 {
            // Only an old pose speaks for it, so the landmarks must: another place, or this one in a mirror, has a few that fit.
            tracked = tracked.filter(|t| t.speaks_for_itself(self.config.min_landmarks));
        }
        if tracked.as_ref().is_none_or(|t| t.share() < WEAK_SHARE) {
            let elsewhere = self.relocaliser.place(&mut self.tracker, &frame, self.reference);
            tracked = match (tracked, elsewhere) {
                (Some(weak), Some(other)) if 5 * other.landmarks > 6 * weak.landmarks => Some(other),
                // The buffers hold the other attempt by now.
                (Some(_), _) => self.tracker.track(&frame, self.reference, near),
                (None, other) => other,
            };
        }
        self.count_landmarks(tracked.as_ref());
        if let Some(tracked) = &tracked {
            self.follow_assumed(&tracked.camera_from_world);
        }
        match tracked {
            Some(tracked) => self.accept(features, &tracked),
            None => self.lose(features),
        }
    }

    /// Notes for each landmark whether it was found. A frame that shows less than half of what should be there (blur, something
    /// in front) speaks of itself and not of its landmarks: the map must not be thinned out by it.
    fn count_landmarks(&mut self, tracked: Option<&Tracked>) {
        let Some(tracked) = tracked else { return };
        let telling = 2 * tracked.landmarks >= tracked.sought;
        for m in self.tracker.search.matches.iter().filter(|m| m.inlier || telling) {
            if let Some(l) = self.map.landmarks.get_mut(m.landmark.0) {
                l.sought += 1;
                if m.inlier {
                    l.found += 1;
                    l.disagreed = 0;
                } else {
                    l.disagreed += 1;
                }
            }
        }
        for id in self.tracker.search.missed.iter().filter(|_| telling) {
            if let Some(l) = self.map.landmarks.get_mut(id.0) {
                l.sought += 1;
            }
        }
    }

    fn accept(&mut self, features: &FrameFeatures, tracked: &Tracked) -> PoseEstimate {
        let pose = tracked.camera_from_world;
        let resumed = self.lost_frames > 0;
        if resumed {
            self.counters.relocalisations += 1;
            self.initialiser.clear();
        }
        self.lost_frames = 0;
        self.state = TrackingState::Tracking;
        self.counters.frames_tracked += 1;
        self.map_frames += 1;
        self.reference = self.tracker.best_reference(&self.map).unwrap_or(self.reference);
        self.inliers.clear();
        self.inliers.extend(self.tracker.inliers());
        self.tracker.note_distance(&pose.inverse().translation);
        let mut motion = None;
        if let Some(last) = &self.last {
            let dt = (features.timestamp_ns - last.timestamp_ns) as f64 * 1e-9;
            let step = (pose * last.camera_from_world.inverse()).relabel::<Camera, Camera>();
            self.odom_from_camera = self.odom_from_camera * step.inverse();
            motion = (dt > 0.0 && !resumed).then_some((step, dt));
        }
        self.last = Some(LastFrame { timestamp_ns: features.timestamp_ns, camera_from_world: pose, motion });
        // A blurred or covered picture gives poor templates, and its pose rests on little.
        let blurred = 2 * self.inliers.iter().filter(|m| m.blurred).count() > self.inliers.len();
        let clear = !resumed && tracked.share() >= KEYFRAME_SHARE && !(blurred && self.inliers.len() >= FED);
        let keyframe = clear && self.decide_keyframe(&pose);
        self.record_pose(features.timestamp_ns, &pose);
        self.pending = keyframe.then_some(pose);
        self.estimate_tracked(features, tracked, motion.as_ref(), keyframe)
    }

    /// Whether the frame just tracked becomes a keyframe; notes as well whether it comes out of a turn on the spot.
    fn decide_keyframe(&mut self, pose: &Se3<Camera, World>) -> bool {
        let Some(reference) = self.map.keyframe(self.reference) else { return false };
        let here = pose.inverse().translation;
        let there = reference.centre();
        let inputs = KeyframeInputs {
            frames_since_keyframe: self.frame - self.last_keyframe_frame,
            landmarks: self.inliers.len(),
            reference_landmarks: reference.observations.len(),
            parallax_deg: keyframe::median_parallax_deg(self.inliers.iter(), &here, &there, &mut self.angles),
            turn_rad: self.last.and_then(|last| last.motion).map_or(0.0, |(step, _)| step.rotation.angle()),
        };
        let is_assumed = |m: &&Match| self.map.landmark(m.landmark).is_some_and(|l| l.assumed.is_some());
        let assumed = self.inliers.iter().filter(is_assumed).count();
        self.turned = mostly_assumed(assumed, inputs.landmarks).then_some(inputs.parallax_deg);
        keyframe::wants_keyframe(&inputs, &self.config)
    }

    fn lose(&mut self, features: &FrameFeatures) -> PoseEstimate {
        self.lost_frames += 1;
        self.state = TrackingState::Lost;
        if self.map.keyframes.len() < WORTH_KEEPING {
            // What was seen while it was lost begins the next map.
            let seen = std::mem::take(&mut self.initialiser);
            self.end_map();
            self.initialiser = seen;
            return self.try_start(features);
        }
        // A map that was tracked for a moment only is worth no longer a wait.
        if self.lost_frames > self.config.lost_frames.min(self.map_frames) {
            return self.begin_beside(features);
        }
        self.initialiser.watch(features, &self.camera);
        self.estimate_none(features)
    }

    /// The frame's place relative to its reference keyframe, for the trajectory that is written at the end.
    fn record_pose(&mut self, timestamp_ns: i64, pose: &Se3<Camera, World>) {
        let Some(k) = self.map.keyframe(self.reference) else { return };
        let keyframe_from_camera = (k.camera_from_world * pose.inverse()).relabel::<KeyframeFrame, Camera>();
        self.events.push(TrajectoryEvent::Pose {
            timestamp_ns,
            map: self.map_id,
            keyframe: self.reference,
            keyframe_from_camera,
        });
    }

    /// Keyframe work for the frame just tracked (the same `features`), after its pose was published.
    pub fn map(&mut self, features: &FrameFeatures, feedback: &mut Feedback) {
        feedback.sequence = features.sequence;
        feedback.forget.clear();
        let placed = self.place_after_turn(features);
        if let Some(pose) = placed.or(self.pending.take()) {
            self.insert_keyframe(features, pose, feedback);
            feedback.forget.sort_unstable();
        }
        self.merge_adjustment(Merge::WhenDue);
        self.post_adjustment();
    }

    fn insert_keyframe(&mut self, features: &FrameFeatures, pose: Se3<Camera, World>, feedback: &mut Feedback) {
        let motion = self.last_motion();
        let new = NewKeyframe {
            features,
            camera_from_world: pose,
            map_id: self.map_id,
            matches: &self.inliers,
            motion,
            shutter: &self.shutter,
            scale_from: self.map.keyframe(self.reference).and_then(|k| k.scale_from),
            unmeasured: self.turned.is_some(),
            assumed_distance: distance_prior::distance_to_assume(&self.inliers, &pose.inverse().translation),
        };
        let before = self.map.landmarks.len();
        let id =
            keyframe::insert_keyframe(&mut self.map, &mut self.bindings, &new, &self.camera, &self.config, feedback);
        if self.turned.is_none() {
            let min_parallax = self.config.min_parallax_deg.to_radians();
            distance_prior::triangulate_assumed(&mut self.map, id, &self.camera, self.shutter.readout_s, min_parallax);
        }
        if self.turned.is_none() {
            let first_new = self.map.landmarks.next_id();
            let lens = Lens { camera: &self.camera, config: &self.config, shutter: &self.shutter };
            self.epipolar.complete(&mut self.map, id, &lens);
            keyframe::bind_new(&self.map, &mut self.bindings, features, id, first_new);
        }
        self.counters.keyframes_made += 1;
        self.counters.landmarks_made += (self.map.landmarks.len() - before) as u64;
        self.last_keyframe_frame = self.frame;
        self.reference = id;
        self.scale_doubt.follow(&self.map);
        self.counters.landmarks_culled += keyframe::cull_landmarks(&mut self.map, id);
        self.counters.keyframes_culled +=
            keyframe::cull_keyframes((&mut self.map, self.map_id), id, &self.config, &mut self.events);
        self.unadjusted = Some(id);
        self.recognise(features, id);
    }

    /// Drops all maps and starts over at the next frame.
    pub fn reset(&mut self) {
        let others = std::mem::take(&mut self.others);
        others.maps().for_each(|map| retire(map, &mut self.events));
        self.end_map();
    }

    /// Drops the present map.
    fn end_map(&mut self) {
        self.discard_job();
        retire(&self.map, &mut self.events);
        self.intrinsics.end_map(&self.camera);
        self.map.clear();
        self.scale_doubt.clear();
        self.initialiser.clear();
        self.bindings.clear();
        self.tracker = Tracker::default();
        self.last = None;
        self.pending = None;
        self.inliers.clear();
        self.next_whole = WHOLE_FIRST;
        self.unadjusted = None;
        (self.lost_frames, self.map_frames) = (0, 0);
        self.odom_from_camera = Se3::identity();
        self.state = TrackingState::Initializing;
        self.map_id = MapId(self.map_id.0 + 1);
        self.reset_counter += 1;
        self.counters.resets += 1;
    }

    fn discard_job(&mut self) {
        if self.job_posted.take().is_some() {
            self.worker.discard();
        }
    }

    /// Starts over with another camera model, because the pictures have another size now.
    pub fn change_camera(&mut self, camera: &CameraModel, prior: LensPrior) {
        self.reset();
        self.camera = camera.clone();
        self.intrinsics = Intrinsics::new(camera, prior);
        self.shutter = Shutter::new(self.config.readout_ms * 1e-3, camera.height, self.config.estimate_readout);
    }

    /// Events since the last call, in order; to be drained after every frame.
    pub fn take_trajectory_events(&mut self, out: &mut Vec<TrajectoryEvent>) {
        out.append(&mut self.events);
    }

    /// Poses of all maps' keyframes, for the trajectory written at the end; those of maps that were dropped came as events.
    pub fn keyframe_poses(&self) -> Vec<(KeyframeId, Se3<World, Camera>)> {
        let maps = std::iter::once(&self.map).chain(self.others.maps());
        maps.flat_map(|map| map.keyframes.iter())
            .map(|(id, k)| (KeyframeId(id), k.camera_from_world.inverse()))
            .collect()
    }

    /// A keyframe of the current map, if it is there.
    pub fn keyframe(&self, id: KeyframeId) -> Option<KeyframeView> {
        self.map.keyframe(id).map(|k| KeyframeView {
            id,
            timestamp_ns: k.timestamp_ns,
            world_from_camera: k.camera_from_world.inverse(),
        })
    }

    /// The last frame's pose lies behind a turn on the spot, and its distance from there is that of an assumption.
    pub fn scale_is_assumed(&self) -> bool {
        self.state == TrackingState::Tracking
            && self.map.keyframe(self.reference).is_some_and(|k| k.scale_from.is_some())
    }

    pub fn counters(&self) -> Counters {
        self.counters
    }

    pub fn state(&self) -> TrackingState {
        self.state
    }

    /// How often poses became unrelated to earlier ones; of the map as it is now.
    pub fn reset_counter(&self) -> u32 {
        self.reset_counter
    }

    /// The camera as it is believed now: its focal length is refined from the motion.
    pub fn camera(&self) -> &CameraModel {
        &self.camera
    }

    /// The lens as it is believed now, and how surely.
    pub fn lens(&self) -> LensEstimate {
        self.intrinsics.estimate(&self.camera)
    }

    /// Readout time of the camera's rolling shutter as it is believed now, s.
    pub fn readout_s(&self) -> f64 {
        self.shutter.readout_s
    }
}
