//! The first map: from a two-view start to keyframes, landmarks, and poses of the frames before.

use std::sync::Arc;

use nalgebra::{Matrix3, Vector2};

use super::bindings::{Seed, Target};
use super::initialise::{PendingFrame, Start};
use super::keyframes::{observe, refine_point};
use super::local_adjustment::MappingJob;
use super::pose_optimisation::{PoseOptions, PosePair, optimise_pose};
use super::relocalise::thumbnail_of;
use super::search::{SearchOptions, affine_warp, align_template};
use super::tracking::Frame;
use super::types::{PoseEstimate, TrackingState, TrajectoryEvent};
use super::{LastFrame, Reconstruction, Tracked};
use crate::features::FrameFeatures;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, Keyframe as KeyframeFrame, World};
use crate::image::Pyramid;
use crate::map::{Keyframe, KeyframeId, Landmark, LandmarkId};

/// Steps of the first adjustment's passes.
const START_STEPS: usize = 20;
/// Standard deviation of a frame-to-frame track's position, px.
const TRACK_SIGMA_PX: f64 = 1.5;
/// How far refinement may move a track's place in the second frame, px.
const REFINE_PX: f64 = 2.0;

impl Reconstruction {
    /// A frame without a map: perhaps the one that makes it.
    pub(super) fn try_start(&mut self, features: &FrameFeatures) -> PoseEstimate {
        let Some(start) = self.initialiser.step(features, &self.camera, &self.config) else {
            return self.estimate_none(features);
        };
        if !self.build_map(&start, features) {
            self.map.clear();
            self.bindings.clear();
            return self.estimate_none(features);
        }
        self.solve_frames_before(features.sequence);
        // What the start could not place waits for parallax from here on.
        let newest = self.reference;
        for track in &features.tracks {
            if self.bindings.get(track.id).is_none() {
                self.bindings.set(track.id, Target::Seed(Seed::new(newest, track.position)));
            }
        }
        self.state = TrackingState::Tracking;
        self.last_keyframe_frame = self.frame;
        self.counters.keyframes_made += 2;
        self.counters.landmarks_made += self.map.landmarks.len() as u64;
        // The frame itself is placed like any other, so that its covariance and counts are honest.
        let guess = [self.last.map_or_else(Se3::identity, |l| l.camera_from_world)];
        let frame = Frame {
            features,
            map: &self.map,
            bindings: &self.bindings,
            camera: &self.camera,
            config: &self.config,
            shutter: &self.shutter,
            before: None,
            motion: None,
        };
        let tracked = self.tracker.track(&frame, self.reference, &guess);
        match tracked {
            Some(tracked) => {
                let Tracked { camera_from_world, .. } = tracked;
                self.counters.frames_tracked += 1;
                self.last = Some(LastFrame { timestamp_ns: features.timestamp_ns, camera_from_world, motion: None });
                self.odom_from_camera = camera_from_world.inverse().relabel();
                self.record_pose(features.timestamp_ns, &camera_from_world);
                self.estimate_tracked(features, &tracked, None, true)
            }
            None => {
                self.reset();
                self.estimate_none(features)
            }
        }
    }

    /// Two keyframes and their landmarks, adjusted; false if too little of it holds.
    fn build_map(&mut self, start: &Start, features: &FrameFeatures) -> bool {
        let mut depths: Vec<f64> = start.points.iter().map(|p| p.point.z).collect();
        depths.sort_unstable_by(f64::total_cmp);
        // The unit of a map is the median depth of its start.
        let scale = 1.0 / depths[depths.len() / 2];
        let second: Se3<Camera, World> =
            Se3::new(start.second_from_first.rotation, start.second_from_first.translation * scale);
        let keyframe = |sequence, timestamp_ns, pose, pyramid: Arc<Pyramid>| Keyframe {
            sequence,
            timestamp_ns,
            map: self.map_id,
            camera_from_world: pose,
            motion: None,
            thumbnail: thumbnail_of(&pyramid),
            pyramid,
            observations: Vec::new(),
            covisible: Vec::new(),
        };
        let a = keyframe(start.first.sequence, start.first.timestamp_ns, Se3::identity(), start.first_pyramid.clone());
        let b = keyframe(features.sequence, features.timestamp_ns, second, features.pyramid.clone());
        let (a, b) = (self.map.add_keyframe(a), self.map.add_keyframe(b));
        let inv_sigma = 1.0 / self.config.sigma_px;
        for p in &start.points {
            let none = LandmarkId::default();
            let (Some(oa), Some(ob)) = (
                observe(&self.camera, none, p.first_pixel, inv_sigma),
                observe(&self.camera, none, p.second_pixel, inv_sigma),
            ) else {
                continue;
            };
            let landmark = Landmark {
                position: p.point * scale,
                covariance: Matrix3::from_element(f64::NAN),
                observers: Vec::new(),
                created_by: b,
                sought: 1,
                found: 1,
                disagreed: 0,
            };
            let id = self.map.add_landmark(landmark, &[(a, oa), (b, ob)]);
            self.bindings.set(p.track, Target::Landmark(id));
        }
        if !self.adjust_whole() {
            return false;
        }
        self.refine_second_view(a, b);
        self.reference = b;
        if !self.adjust_whole() {
            return false;
        }
        let Some(k) = self.map.keyframe(b) else { return false };
        self.last = Some(LastFrame {
            timestamp_ns: features.timestamp_ns,
            camera_from_world: k.camera_from_world,
            motion: None,
        });
        true
    }

    /// Adjusts the whole (new, small) map at once; false if too few landmarks hold.
    fn adjust_whole(&mut self) -> bool {
        let Some(job) = MappingJob::whole(&self.map, &self.camera, self.shutter.readout_s, START_STEPS) else {
            return false;
        };
        let result = job.run();
        let supported = result.supported_landmarks();
        result.merge(&mut self.map);
        supported >= self.config.start_landmarks
    }

    /// Replaces the tracked places in the second keyframe by alignment with the first one's templates: flow drifts.
    fn refine_second_view(&mut self, a: KeyframeId, b: KeyframeId) {
        let options =
            SearchOptions { radius_px: REFINE_PX, coarse_levels: 0, limit: 0, sigma_px: self.config.sigma_px };
        let ids: Vec<u32> = self.map.landmarks.iter().map(|(id, _)| id).collect();
        for id in ids {
            let landmark_id = LandmarkId(id);
            let refined = (|| {
                let landmark = self.map.landmark(landmark_id)?;
                let (ka, kb) = (self.map.keyframe(a)?, self.map.keyframe(b)?);
                let (oa, ob) = (ka.observation(landmark_id)?, kb.observation(landmark_id)?);
                let (_, projection) =
                    self.camera.project_jacobian(&kb.camera_from_world.transform(&landmark.position))?;
                let rotation = kb.camera_from_world.rotation * ka.camera_from_world.rotation.inverse();
                let depth = ka.camera_from_world.transform(&landmark.position).z;
                let affine = affine_warp(&projection, &rotation, depth, &oa.normalised_from_pixel);
                let found = align_template(ka, oa, &kb.pyramid, &affine, ob.pixel.cast(), &options)?;
                observe(&self.camera, landmark_id, found.pixel, found.inv_sigma_px)
            })();
            let Some(new) = refined else {
                self.map.remove_landmark(landmark_id);
                continue;
            };
            if let Some(k) = self.map.keyframes.get_mut(b.0)
                && let Ok(i) = k.observations.binary_search_by_key(&landmark_id, |o| o.landmark)
            {
                k.observations[i] = new;
            }
            let seen: Vec<_> =
                [a, b].iter().filter_map(|&k| Some((k, *self.map.keyframe(k)?.observation(landmark_id)?))).collect();
            let Some(mut position) = self.map.landmark(landmark_id).map(|l| l.position) else { continue };
            if let Some(covariance) =
                refine_point(&self.map, &seen, &self.camera, self.shutter.readout_s, &mut position)
                && let Some(l) = self.map.landmarks.get_mut(id)
            {
                l.position = position;
                l.covariance = covariance;
            }
        }
    }

    /// Poses of the frames that came before the map, from the tracks that are landmarks now.
    fn solve_frames_before(&mut self, current: u64) {
        let pending: Vec<PendingFrame> = self.initialiser.pending.drain(..).collect();
        self.initialiser.clear();
        let Some((first, anchor)) =
            self.map.keyframes.iter().next().map(|(id, k)| (KeyframeId(id), (k.sequence, k.camera_from_world)))
        else {
            return;
        };
        let (anchor_sequence, anchor_pose) = anchor;
        let split = pending.iter().position(|f| f.sequence >= anchor_sequence).unwrap_or(pending.len());
        let (before, after) = pending.split_at(split);
        let mut solved: Vec<(i64, Se3<Camera, World>)> = Vec::new();
        for direction in [after.iter().collect::<Vec<_>>(), before.iter().rev().collect()] {
            let mut guess = anchor_pose;
            for frame in direction.into_iter().filter(|f| f.sequence != current) {
                if let Some(pose) = self.solve_pending(frame, &guess) {
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
                map: self.map_id,
                keyframe: first,
                keyframe_from_camera,
            });
        }
    }

    fn solve_pending(&self, frame: &PendingFrame, guess: &Se3<Camera, World>) -> Option<Se3<Camera, World>> {
        let mut pairs = Vec::new();
        for &(track, pixel) in &frame.tracks {
            let Some(Target::Landmark(id)) = self.bindings.get(track) else { continue };
            let Some(landmark) = self.map.landmark(*id) else { continue };
            let Some(normalised) = self.camera.undistort(&pixel.cast()) else { continue };
            pairs.push(PosePair { point: landmark.position, normalised, inv_sigma_px: 1.0 / TRACK_SIGMA_PX });
        }
        let mut inlier = Vec::new();
        let focal = Vector2::new(self.camera.fx, self.camera.fy);
        let solution = optimise_pose(guess, &pairs, focal, &PoseOptions::default(), &mut inlier)?;
        (solution.inliers >= self.config.min_landmarks && 2 * solution.inliers >= pairs.len())
            .then_some(solution.camera_from_world)
    }
}
