//! The first map: from a two-view start to keyframes, landmarks, and poses of the frames before.

pub mod initialiser;
pub mod orientation;
pub mod turn;
mod untracked;
mod views;

use nalgebra::{Matrix3, Vector3};

use super::Reconstruction;
use super::adjust::job::Adjustment;
use super::consensus::{AGREEING_SHARE, FrameTracks, PosedViews};
use super::keyframe::bind_new;
use super::keyframe::point::{observations_of, refine_point};
use super::measurement::{Correspondence, TWO_VIEW_SIGMA_PX};
use super::odometry::Odometry;
use super::optics::Optics;
use super::track::association::{Seed, Target};
use super::track::pose::{PoseOptions, optimise_pose};
use super::track::template::{observe, refine_in};
use super::types::{PoseEstimate, TrackingState, TrajectoryEvent};
use crate::features::FrameFeatures;
use crate::features::thumbnail::thumbnail_of;
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::frames::{Camera, Keyframe as KeyframeFrame, World};
use crate::geometry::{Se3, median};
use crate::map::picture::KeyframePicture;
use crate::map::{Keyframe, KeyframeId, Landmark, LandmarkId, Observation};
use initialiser::Start;
use untracked::is_untracked;
use views::{View, Views};

/// Standard deviation of the direction of the first motion that a start may have, rad; the longer the camera moves and nothing
/// better comes the more is allowed: so much more after so many seconds, and at most so many times.
const MAX_DIRECTION_SIGMA: f64 = 0.012;
const PATIENCE_S: f64 = 0.5;
const LARGEST_RELAXATION: f64 = 8.0;
/// Steps of the first adjustment's passes.
const START_STEPS: usize = 20;

impl Reconstruction {
    /// A frame without a map: perhaps the one that makes it; else how the camera has turned since the first one.
    pub(super) fn try_start(&mut self, features: &FrameFeatures) -> PoseEstimate {
        let Optics { camera, intrinsics, .. } = &self.optics;
        let lens = intrinsics.supposed(camera);
        let starts = self.initialiser.step(features, camera, lens, &self.config);
        let orientation = self.orientation.step(features, camera, lens);
        match self.start_from(&starts, features) {
            Some(estimate) => self.go_on_turning(estimate),
            None => self.estimate_turned(features, orientation),
        }
    }

    /// The first pose of a map: its smooth pose is turned such that the orientation before goes on in it.
    fn go_on_turning(&mut self, mut estimate: PoseEstimate) -> PoseEstimate {
        if let Some(first_from_camera) = self.orientation.end(estimate.timestamp_ns) {
            self.active.odometry.turn_to(first_from_camera);
        }
        estimate.odom_from_camera = Some(self.active.odometry.odom_from_camera);
        estimate.reset_counter = self.reset_counter();
        estimate
    }

    /// Begins a map in place of the present, empty one, if one of the starts holds.
    pub(super) fn start_from(&mut self, starts: &[Start], features: &FrameFeatures) -> Option<PoseEstimate> {
        let guess = starts.iter().find_map(|start| {
            let begun = self.build_map(start, features);
            if begun.is_none() {
                self.active.clear();
            }
            begun
        })?;
        // What follows a corner that was known again without a track is bound to it.
        bind_new(&self.active.map, &mut self.active.bindings, features, self.active.reference, 0);
        // What the start could not place waits for parallax from here on.
        let newest = self.active.reference;
        for track in &features.tracks {
            if self.active.bindings.get(track.id).is_none() {
                self.active.bindings.set(track.id, Target::Seed(Seed::new(newest, track.position)));
            }
        }
        // The frame itself is placed like any other, so that its covariance and counts are honest.
        let Some(tracked) = self.track_at(features, guess) else {
            self.active.clear();
            self.initialiser.clear();
            return None;
        };
        self.solve_frames_before(features.sequence);
        self.loops.expect_more(&self.active.map);
        self.state = TrackingState::Tracking;
        self.active.last_keyframe_frame = self.counters.frames;
        self.counters.keyframes_made += self.active.map.keyframes.len() as u64;
        self.counters.landmarks_made += self.active.map.landmarks.len() as u64;
        let camera_from_world = tracked.camera_from_world;
        self.counters.frames_tracked += 1;
        self.active.odometry = Odometry::begin(features.timestamp_ns, camera_from_world);
        self.record_pose(features.timestamp_ns, &camera_from_world);
        let made = self.active.map.keyframes.iter().map(|(id, k)| (k.timestamp_ns, KeyframeId(id)));
        self.events
            .extend(made.map(|(timestamp_ns, keyframe)| TrajectoryEvent::KeyframeMade { timestamp_ns, keyframe }));
        Some(self.estimate_tracked(features, &tracked, None, true))
    }

    /// The first keyframes and their landmarks, adjusted, and the newest frame's pose; `None` if too little of it holds.
    fn build_map(&mut self, start: &Start, features: &FrameFeatures) -> Option<Se3<Camera, World>> {
        let mut depths: Vec<f64> = start.points.iter().map(|(_, point)| point.z).collect();
        // The unit of a map is the median depth of its start.
        let scale = 1.0 / median(&mut depths)?;
        let second: Se3<Camera, World> =
            Se3::new(start.second_from_first.rotation, start.second_from_first.translation * scale);
        let Views { first, between, newest } = &start.views;
        let a = self.add_view(first, Se3::identity());
        // Ascending track id, for the views in between.
        let mut points: Vec<(u64, Vector3<f64>)> =
            start.points.iter().map(|&(track, point)| (track, point * scale)).collect();
        points.sort_unstable_by_key(|p| p.0);
        let mut views = vec![(a, &first.frame)];
        let mut guess = Se3::identity();
        let position = |track| points.binary_search_by_key(&track, |p| p.0).ok().map(|i| points[i].1);
        for view in between {
            if let Some(pose) = self.solve_pose(&view.frame, &guess, position) {
                guess = pose;
                views.push((self.add_view(view, pose), &view.frame));
            }
        }
        let b = self.add_view(&View { frame: newest.clone(), pyramid: features.pyramid.clone() }, second);
        views.push((b, newest));
        let inv_sigma = 1.0 / self.config.sigma_px;
        for &(track, point) in &points {
            let seen: Vec<_> = views
                .iter()
                .filter_map(|&(k, frame)| {
                    Some((k, observe(&self.optics.camera, LandmarkId::default(), frame.track(track)?, inv_sigma)?))
                })
                .collect();
            if seen.len() >= 2 {
                let landmark = Landmark::new(point, Matrix3::from_element(f64::NAN), b);
                let id = self.active.map.add_landmark(landmark, &seen);
                if !is_untracked(track) {
                    self.active.bindings.set(track, Target::Landmark(id));
                }
            }
        }
        self.adjust_globally()?;
        self.refine_views(a);
        self.note_motion();
        self.active.reference = b;
        let (sigma, (readout_s, variance), noise) = self.adjust_globally()?;
        // Also of a start that comes to nothing.
        self.optics.noise.learn(noise);
        // What an unknown lens makes unsure becomes no surer by sharp pictures.
        let share = if self.optics.intrinsics.is_calibrated() { self.optics.noise.share() } else { 1.0 };
        let relaxation = (1.0 + self.initialiser.trying_s / PATIENCE_S).min(LARGEST_RELAXATION);
        if sigma * share > MAX_DIRECTION_SIGMA * relaxation {
            return None;
        }
        if self.optics.intrinsics.is_calibrated() {
            let mut posed = PosedViews::default();
            for &(k, frame) in &views {
                let Some(keyframe) = self.active.map.keyframe(k) else { continue };
                posed.push(frame.clone(), &keyframe.camera_from_world);
            }
            let told = posed.agreement(&self.optics.camera, &self.optics.shutter);
            if !told.is_some_and(|told| told.share >= AGREEING_SHARE) {
                // Look-alikes tell nothing against what the tracks say.
                if !start.by_corners {
                    self.initialiser.disagree();
                }
                return None;
            }
            if !self.initialiser.agree() {
                return None;
            }
            self.active.probation.begin(posed, &self.optics.shutter);
        }
        self.optics.shutter.learn(readout_s, variance);
        Some(self.active.map.keyframe(b)?.camera_from_world)
    }

    fn add_view(&mut self, view: &View, camera_from_world: Se3<Camera, World>) -> KeyframeId {
        self.active.map.add_keyframe(Keyframe {
            sequence: view.frame.sequence,
            timestamp_ns: view.frame.timestamp_ns,
            map: self.active.id,
            camera_from_world,
            motion: None,
            thumbnail: thumbnail_of(&view.pyramid),
            scale_from: None,
            picture: KeyframePicture::new(view.pyramid.clone()),
            observations: Default::default(),
            covisible: Vec::new(),
            corners: Vec::new(),
        })
    }

    /// Adjusts the whole (new, small) map at once: how surely the newest camera's direction from the first is known (rad), and the
    /// readout time found with it (s, and its variance), and what it leaves of places; `None` if too few landmarks hold.
    fn adjust_globally(&mut self) -> Option<(f64, (f64, f64), Option<f64>)> {
        let Optics { camera, shutter, noise, intrinsics, .. } = &self.optics;
        let job = Adjustment::global(&self.active.map, camera, shutter, START_STEPS)?;
        let result = job.judged_by(noise.outlier_chi2(), intrinsics.is_calibrated()).run();
        let supported = result.supported_landmarks();
        let told = (result.direction_sigma(), result.readout(), result.noise);
        result.merge(&mut self.active.map);
        (supported >= self.config.start_landmarks).then_some(told)
    }

    /// Replaces the tracked places in the later views by alignment with the first one's templates: flow drifts.
    fn refine_views(&mut self, first: KeyframeId) {
        let ids: Vec<LandmarkId> = self.active.map.landmarks.iter().map(|(id, _)| LandmarkId(id)).collect();
        for id in ids {
            let Some(landmark) = self.active.map.landmark(id) else { continue };
            let observers = landmark.observers.clone();
            let mut position = landmark.position;
            for &k in observers.iter().filter(|k| **k != first) {
                match self.refined(first, k, id, &position) {
                    Some(new) => self.active.map.replace_observation(k, new),
                    None => self.active.map.remove_observation(k, id),
                }
            }
            let seen = observations_of(&self.active.map, id);
            // With fewer than two views left the landmark is gone already.
            if let Some(covariance) =
                refine_point(&self.active.map, &seen, &self.optics.camera, self.optics.shutter.readout_s, &mut position)
            {
                self.active.map.measure_landmark(id, position, covariance);
            }
        }
    }

    /// Where a landmark is in keyframe `other`, by the template of keyframe `first`; both observe it already.
    fn refined(
        &self,
        first: KeyframeId,
        other: KeyframeId,
        id: LandmarkId,
        point: &Vector3<f64>,
    ) -> Option<Observation> {
        let [a, b] = [self.active.map.keyframe(first)?, self.active.map.keyframe(other)?];
        let start = b.observation(id)?.pixel;
        refine_in(a, &a.observation(id)?, b, point, start, &self.optics.camera, self.config.sigma_px)
    }

    /// How the camera moved at each view, from the views before and after: a rolling shutter shows it.
    fn note_motion(&mut self) {
        let poses: Vec<_> =
            self.active.map.keyframes.iter().map(|(id, k)| (id, k.timestamp_ns, k.camera_from_world)).collect();
        for (i, &(id, ..)) in poses.iter().enumerate() {
            let (before, after) = (&poses[i.saturating_sub(1)], &poses[(i + 1).min(poses.len() - 1)]);
            let dt = (after.1 - before.1) as f64 * 1e-9;
            if dt <= 0.0 {
                continue;
            }
            let motion = CameraMotion::over(&(after.2 * before.2.inverse()).relabel(), dt);
            let shutter = &self.optics.shutter;
            self.active
                .map
                .set_motion(KeyframeId(id), motion, |p, o| shutter.displacement(Some(&motion), p, o.pixel.y));
        }
    }

    /// Poses of the frames that came before the map, from the tracks that are landmarks now.
    fn solve_frames_before(&mut self, current: u64) {
        let pending: Vec<FrameTracks> = self.initialiser.pending.drain(..).collect();
        self.initialiser.clear();
        let Some((first, anchor)) =
            self.active.map.keyframes.iter().next().map(|(id, k)| (KeyframeId(id), (k.sequence, k.camera_from_world)))
        else {
            return;
        };
        let (anchor_sequence, anchor_pose) = anchor;
        let split = pending.iter().position(|f| f.sequence >= anchor_sequence).unwrap_or(pending.len());
        let (before, after) = pending.split_at(split);
        let position = |track| match self.active.bindings.get(track)? {
            Target::Landmark(id) => Some(self.active.map.landmark(*id)?.position),
            Target::Seed(_) => None,
        };
        let mut solved: Vec<(i64, Se3<Camera, World>)> = Vec::new();
        for direction in [after.iter().collect::<Vec<_>>(), before.iter().rev().collect()] {
            let mut guess = anchor_pose;
            for frame in direction.into_iter().filter(|f| f.sequence != current) {
                if let Some(pose) = self.solve_pose(frame, &guess, position) {
                    guess = pose;
                    solved.push((frame.timestamp_ns, pose));
                }
            }
        }
        solved.sort_by_key(|s| s.0);
        for (timestamp_ns, pose) in solved {
            let keyframe_from_camera = (anchor_pose * pose.inverse()).relabel::<KeyframeFrame, Camera>();
            self.counters.frames_tracked += 1;
            self.events.push(TrajectoryEvent::Pose {
                timestamp_ns,
                map: self.active.id,
                keyframe: first,
                keyframe_from_camera,
            });
        }
        self.active.probation.keep(pending);
    }

    /// Whether the picture says that the map which has just begun is of something that moves; then it is given up, and its frames have no pose again.
    pub(super) fn fails_probation(&mut self, features: &FrameFeatures, pose: &Se3<Camera, World>) -> bool {
        if !self.active.probation.fails(features, pose, &self.optics.camera) {
            return false;
        }
        let mut frames = self.active.probation.take_frames();
        frames.extend(self.initialiser.pending.drain(..));
        frames.sort_by_key(|frame| frame.sequence);
        self.give_up_map();
        self.initialiser.begin_again(frames);
        true
    }

    /// Pose of a frame from its tracks whose `position` in the world is known.
    fn solve_pose(
        &self,
        frame: &FrameTracks,
        guess: &Se3<Camera, World>,
        position: impl Fn(u64) -> Option<Vector3<f64>>,
    ) -> Option<Se3<Camera, World>> {
        let mut pairs = Vec::new();
        for &(track, pixel) in &frame.tracks {
            let Some(point) = position(track) else { continue };
            let Some(normalised) = self.optics.camera.undistort(&pixel.cast()) else { continue };
            let pixel_scale = self.optics.camera.pixel_scale(&normalised);
            pairs.push(Correspondence::new(point, normalised, pixel_scale, 1.0 / TWO_VIEW_SIGMA_PX));
        }
        let mut inlier = Vec::new();
        let solution =
            optimise_pose(guess, &pairs, &PoseOptions { leverage: false, ..PoseOptions::default() }, &mut inlier)?;
        (solution.inliers >= self.config.min_landmarks && 2 * solution.inliers >= pairs.len())
            .then_some(solution.camera_from_world)
    }
}

#[cfg(test)]
mod tests;
