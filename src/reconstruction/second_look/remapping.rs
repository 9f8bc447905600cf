//! The second look itself: a reconstruction of its own, which maps the pictures again.
//!
//! In: pictures of keyframes in the order of time, the lens, shutter and noise as they are known. Out: a map, where each picture is in it, and how it lies to
//! the present one. The newest picture comes first, so time runs backwards until it is done: times are negated, and a rolling shutter's readout with them.

use std::collections::BTreeMap;

use super::kept::{Frame, Kept};
use super::moved::Placed;
use crate::features::{FeatureStage, FeaturesConfig, Feedback, FrameFeatures};
use crate::geometry::Se3;
use crate::geometry::camera_motion::CameraMotion;
use crate::image::GreyImage;
use crate::map::{KeyframeId, Map, MapId};
use crate::reconstruction::active_map::ActiveMap;
use crate::reconstruction::adjust::job::Piece;
use crate::reconstruction::config::ReconstructionConfig;
use crate::reconstruction::optics::Optics;
use crate::reconstruction::recorded::Recorded;
use crate::reconstruction::relocalise::merging::LEAST_SCALE_SIGMA;
use crate::reconstruction::relocalise::other_maps::{Sighting, Similarity, agreed_ratio, depth_ratios};
use crate::reconstruction::relocalise::spread::shows_a_place;
use crate::reconstruction::work::InlineWorker;
use crate::reconstruction::{Reconstruction, TrackingState};

/// Pictures that are looked at between two adjustments.
const PIECE: usize = 4;
/// Numbers set aside for each picture's keyframes and landmarks: several times what one makes.
const ROOM: [u32; 2] = [4, 2000];
/// Keyframes that say the same of how both maps lie, at the least.
const LEAST_AGREEING: usize = 2;

/// A second look under way.
pub struct Remapping {
    /// The newest last.
    pictures: Vec<(Frame, GreyImage)>,
    looked_at: Vec<Frame>,
    /// The map that the newest pictures are of.
    present: MapId,
    /// Numbers of keyframes and landmarks that are not its own any more.
    end: [u32; 2],
    stage: FeatureStage,
    own: Reconstruction,
    features: FrameFeatures,
    feedback: Feedback,
    /// What keyframes of the present map see of the new one.
    common: Vec<Sighting>,
}

/// What a second look has made.
pub struct Again {
    pub active: ActiveMap,
    pub looked_at: Vec<Frame>,
    pub placed: Vec<Placed>,
    /// What keyframes of the present map see of the new one, the newest last.
    pub sightings: Vec<Sighting>,
    /// How the new map lies to the present one, if they tell it.
    pub told: Option<Similarity>,
}

impl std::fmt::Debug for Remapping {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Remapping").field("pictures", &self.pictures.len()).finish_non_exhaustive()
    }
}

impl Remapping {
    pub fn new(
        pictures: Vec<(Frame, GreyImage)>,
        active: &mut ActiveMap,
        optics: &Optics,
        config: &ReconstructionConfig,
    ) -> Self {
        // The lens is the present map's.
        let config =
            ReconstructionConfig { refine_intrinsics: false, merge_after_frames: 1, loops: false, ..config.clone() };
        let mut own = Reconstruction::new(&config, &optics.camera, Box::new(InlineWorker::default()), true);
        own.optics.shutter = optics.shutter.backwards();
        own.optics.noise = optics.noise;
        own.active = active.successor();
        let next = [active.map.keyframes.next_id(), active.map.landmarks.next_id()];
        let end = std::array::from_fn(|i| next[i] + ROOM[i] * pictures.len() as u32);
        active.map.leave_numbers(end[0], end[1]);
        Self {
            pictures,
            looked_at: Vec::new(),
            present: active.id,
            end,
            stage: FeatureStage::new(&FeaturesConfig::default()),
            own,
            features: FrameFeatures::default(),
            feedback: Feedback::default(),
            common: Vec::new(),
        }
    }

    /// What came of it. The new map gets the number `map`.
    pub fn finish(mut self, map: MapId, present: &Map) -> Again {
        let placed = self.placed();
        self.let_time_run_forwards(map);
        let sightings = self.sightings(&placed, present);
        let told = self.told_by(&sightings, present);
        let Self { own, looked_at, .. } = self;
        Again { active: own.active, looked_at, placed, sightings, told }
    }

    /// Where each picture is in the new map: at its own keyframe, or beside that which its frame was recorded by.
    fn placed(&mut self) -> Vec<Placed> {
        self.own.finish();
        let mut recorded = Kept::default();
        self.own.events.drain(..).for_each(|event| recorded.hear(&event));
        let ActiveMap { map: new, id, .. } = &self.own.active;
        let keyframes: BTreeMap<i64, KeyframeId> =
            new.keyframes.iter().map(|(id, k)| (k.timestamp_ns, KeyframeId(id))).collect();
        let recorded: BTreeMap<i64, &Recorded> = recorded
            .frames
            .iter()
            .filter(|(_, place)| place.map == *id)
            .map(|(time_ns, place)| (*time_ns, place))
            .collect();
        let placed = |&Frame { map, keyframe, timestamp_ns, .. }: &Frame| {
            let own = keyframes.get(&-timestamp_ns).map(|id| (*id, Se3::identity()));
            let beside = || recorded.get(&-timestamp_ns).map(|f| (f.keyframe, f.keyframe_from_camera.relabel()));
            let (parent, parent_from_keyframe) = own.or_else(beside)?;
            new.keyframe(parent)?;
            Some(Placed { map, keyframe, parent, parent_from_keyframe })
        };
        self.looked_at.iter().filter_map(placed).collect()
    }

    /// Keyframes get their times back, and motions their direction.
    fn let_time_run_forwards(&mut self, new: MapId) {
        self.own.active.id = new;
        let (map, shutter) = (&mut self.own.active.map, self.own.optics.shutter.backwards());
        let frames: Vec<_> = map.keyframes.iter().map(|(id, k)| (KeyframeId(id), k.timestamp_ns, k.motion)).collect();
        for (id, timestamp_ns, motion) in frames {
            if let Some(frame) = self.looked_at.iter().find(|frame| frame.timestamp_ns == -timestamp_ns) {
                map.set_frame(id, new, frame.sequence, frame.timestamp_ns);
            }
            if let Some(CameraMotion { turn, shift }) = motion {
                let motion = CameraMotion { turn: -turn, shift: -shift };
                map.set_motion(id, motion, |p, o| shutter.displacement(Some(&motion), p, o.pixel.y));
            }
        }
    }

    /// What keyframes of the present map see of the new one as that is at the end, the newest last; with time running forwards.
    fn sightings(&mut self, placed: &[Placed], present: &Map) -> Vec<Sighting> {
        let (map, camera) = (&self.own.active.map, &self.own.optics.camera);
        let as_it_is = |mut sighting: Sighting| {
            present.keyframe(sighting.keyframe)?;
            let place = placed.iter().find(|p| p.keyframe == sighting.keyframe)?;
            sighting.there = place.world_from_camera(map, 1.0)?.inverse();
            sighting.found.retain_mut(|m| {
                m.displacement = -m.displacement;
                let landmark = map.landmark(m.landmark).filter(|l| l.assumed.is_none());
                landmark.inspect(|l| m.point = l.position).is_some()
            });
            shows_a_place(&sighting.found, camera).then_some(sighting)
        };
        std::mem::take(&mut self.common).into_iter().rev().filter_map(as_it_is).collect()
    }

    /// How the new map lies to the present one. All keyframes that both have tell how large it is, and one that most others agree with where.
    fn told_by(&self, sightings: &[Sighting], present: &Map) -> Option<Similarity> {
        let map = &self.own.active.map;
        if map.keyframes.next_id() > self.end[0] || map.landmarks.next_id() > self.end[1] {
            return None;
        }
        let mut ratios: Vec<f64> = sightings.iter().flat_map(|s| depth_ratios(present, s, map)).collect();
        let (scale, log_scale_sigma) = agreed_ratio(&mut ratios)?;
        let told: Vec<_> = sightings.iter().filter_map(|s| Some((s, s.similarity(present, scale)?))).collect();
        let agreeing = |(by, own): &&(&Sighting, _)| told.iter().filter(|(_, other)| by.agrees(own, other)).count();
        let best = told.iter().max_by_key(agreeing)?;
        let is_told = agreeing(&best) >= LEAST_AGREEING && 2 * agreeing(&best) > told.len() && best.1.is_valid();
        // Neighbouring pictures say much the same.
        let log_scale_sigma = log_scale_sigma.max(LEAST_SCALE_SIGMA);
        is_told.then_some(Similarity { present_from_other: best.1, log_scale_sigma })
    }
}

impl Piece for Remapping {
    fn step(&mut self) {
        for _ in 0..PIECE {
            let Some((of, picture)) = self.pictures.pop() else { return };
            self.features.sequence += 1;
            self.features.timestamp_ns = -of.timestamp_ns;
            self.stage.feedback(&self.feedback);
            self.stage.step_grey(&picture, &mut self.features);
            let estimate = self.own.track(&self.features);
            let pose = estimate.world_from_camera.filter(|_| estimate.state == TrackingState::Tracking);
            if let Some(pose) = pose.filter(|_| of.map == self.present) {
                let found = self.own.tracker.inliers().copied().collect();
                self.common.push(Sighting { keyframe: of.keyframe, there: pose.inverse(), found });
            }
            self.own.map(&self.features, &mut self.feedback);
            self.looked_at.push(of);
        }
    }

    fn is_done(&self) -> bool {
        self.pictures.is_empty()
    }
}
