//! A robot without threads: pictures with their truth in, poses out; where they lie in the truth's world, and a map's file.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use cairn::camera::Pacing;
use cairn::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use cairn::features::{FeatureStage, FeaturesConfig, Feedback, FrameFeatures};
use cairn::geometry::alignment::align;
use cairn::geometry::frames::{Camera, World};
use cairn::geometry::random::Random;
use cairn::geometry::sim3::Sim3;
use cairn::geometry::{CameraModel, Se3};
use cairn::image::GreyImage;
use cairn::map::KeyframeId;
use cairn::places::store;
use cairn::reconstruction::{InlineWorker, PoseEstimate, Reconstruction, ReconstructionConfig, TrackingState};

/// Frames a second of all simulated drives.
pub const RATE_HZ: f64 = 30.0;
/// A pose is wrong that is off by more than this share of the mapped way, or by this angle, degrees.
pub const WRONG_SHARE: f64 = 0.05;
pub const WRONG_DEG: f64 = 10.0;

pub type Pose = Se3<World, Camera>;

/// A small webcam with noise, blur and a rolling shutter.
pub fn webcam(scenario: Scenario, seed: u64) -> SimulatorConfig {
    let (width, height, texel_mm) = (320, 240, 4.0);
    SimulatorConfig { scenario, seed, width, height, texel_mm, rate_hz: RATE_HZ, ..SimulatorConfig::default() }
}

pub fn simulator(config: &SimulatorConfig) -> Simulator {
    Simulator::new(config, Pacing::LockStep).unwrap()
}

/// The picture of a frame, and where it was taken.
pub fn shown(simulator: &mut Simulator, frame: u64) -> (GreyImage, Pose) {
    let mut picture = GreyImage::new(0, 0);
    simulator.render(frame, &mut picture);
    (picture, simulator.trajectory().pose_at(simulator.timestamp_ns(frame)))
}

/// What a covered lens sees.
pub fn dark() -> GreyImage {
    let mut picture = GreyImage::new(320, 240);
    let mut noise = Random::new(4);
    picture.data.iter_mut().for_each(|v| *v = (4.0 + 1.5 * noise.normal()).clamp(0.0, 255.0) as u8);
    picture
}

/// Where the truth's world has what a map says.
#[derive(Clone, Copy)]
pub struct Standing {
    truth_from_map: Sim3<World, World>,
    /// Way that was mapped, m.
    pub way_m: f64,
}

impl Standing {
    /// How far a pose is off, m and degrees.
    pub fn error(&self, told: &Pose, truth: &Pose) -> (f64, f64) {
        let place = self.truth_from_map.transform(&told.translation);
        let turned = (self.truth_from_map.rotation * told.rotation).angle_to(&truth.rotation);
        ((place - truth.translation).norm(), turned.to_degrees())
    }

    pub fn is_wrong(&self, (metres, degrees): (f64, f64)) -> bool {
        metres > WRONG_SHARE * self.way_m || degrees > WRONG_DEG
    }
}

pub struct Robot {
    pub reconstruction: Reconstruction,
    stage: FeatureStage,
    features: FrameFeatures,
    feedback: Feedback,
    now_ns: i64,
    sequence: u64,
    pub rate_hz: f64,
    /// Where each frame was taken, by its timestamp.
    pub truths: BTreeMap<i64, Pose>,
    /// Keyframes of the map that it is to be known in.
    mapped: BTreeSet<KeyframeId>,
}

impl Robot {
    pub fn new(camera: &CameraModel) -> Self {
        let worker = Box::new(InlineWorker::default());
        let config = ReconstructionConfig { loops: true, ..ReconstructionConfig::default() };
        Self {
            reconstruction: Reconstruction::new(&config, camera, worker, true),
            stage: FeatureStage::new(&FeaturesConfig::default()),
            features: FrameFeatures::default(),
            feedback: Feedback::default(),
            now_ns: 1_000_000_000,
            sequence: 0,
            rate_hz: RATE_HZ,
            truths: BTreeMap::new(),
            mapped: BTreeSet::new(),
        }
    }

    /// So many days later.
    pub fn on_day(camera: &CameraModel, day: i64) -> Self {
        let mut robot = Self::new(camera);
        robot.now_ns += day * 86_400_000_000_000;
        robot
    }

    /// Starts a day later in what is in a file, only to be located in it. `truths`: of the frames that it was made of.
    pub fn next_day(file: &Path, camera: &CameraModel, truths: &BTreeMap<i64, Pose>) -> Self {
        let mut robot = Self::on_day(camera, 1);
        robot.reconstruction.resume(store::read(file).unwrap().saved, true);
        robot.truths = truths.clone();
        robot.note_map();
        robot
    }

    /// What is known now is the map to be known in.
    pub fn note_map(&mut self) {
        self.mapped = self.reconstruction.keyframe_poses().into_iter().map(|(id, _)| id).collect();
    }

    /// The map's file, as a daemon would leave it.
    pub fn save(&mut self, file: &Path) {
        self.reconstruction.finish();
        store::MapFile::create(file, &self.reconstruction.take_changes(true)).unwrap().close().unwrap();
    }

    /// One frame; a covered lens has no truth.
    pub fn see(&mut self, picture: &GreyImage, truth: Option<Pose>) -> PoseEstimate {
        self.look(picture);
        self.truths.extend(truth.map(|truth| (self.now_ns, truth)));
        let estimate = self.place();
        self.map();
        estimate
    }

    /// The first step of a frame: corners and tracks. Its timestamp.
    pub fn look(&mut self, picture: &GreyImage) -> i64 {
        self.stage.step_grey(picture, &mut self.features);
        self.now_ns += (1e9 / self.rate_hz) as i64;
        self.sequence += 1;
        (self.features.sequence, self.features.timestamp_ns) = (self.sequence, self.now_ns);
        self.now_ns
    }

    /// The second: its pose.
    pub fn place(&mut self) -> PoseEstimate {
        self.reconstruction.track(&self.features)
    }

    /// The third: what the map has of it.
    pub fn map(&mut self) {
        self.reconstruction.map(&self.features, &mut self.feedback);
        self.stage.feedback(&self.feedback);
        self.reconstruction.take_trajectory_events(&mut Vec::new());
    }

    /// Drives along a simulator's frames; the last pose that was told.
    pub fn drive(&mut self, simulator: &mut Simulator, frames: impl IntoIterator<Item = u64>) -> Option<Pose> {
        let mut last = None;
        for frame in frames {
            let (picture, truth) = shown(simulator, frame);
            last = self.see(&picture, Some(truth)).world_from_camera.or(last);
        }
        last
    }

    /// Pose of a frame in the map to be known in, if it is the one that it was placed in.
    pub fn known(&self, estimate: &PoseEstimate) -> Option<Pose> {
        let is_there = || self.mapped.iter().any(|id| self.reconstruction.keyframe(*id).is_some());
        estimate.world_from_camera.filter(|_| estimate.state == TrackingState::Tracking && is_there())
    }

    /// Where the map lies, by its keyframes: those to be known in, or all.
    pub fn standing(&self, all: bool) -> Option<(Standing, f64)> {
        let (mut from, mut to) = (Vec::new(), Vec::new());
        for (id, pose) in self.reconstruction.keyframe_poses() {
            let Some(view) = self.reconstruction.keyframe(id) else { continue };
            let truth = self.truths.get(&view.timestamp_ns).filter(|_| all || self.mapped.contains(&id));
            if let Some(truth) = truth {
                from.push(pose.translation);
                to.push(truth.translation);
            }
        }
        let aligned = align::<World, World>(&from, &to, true).ok()?;
        let way_m = to.windows(2).map(|w| (w[1] - w[0]).norm()).sum();
        Some((Standing { truth_from_map: aligned.to_from_from, way_m }, aligned.rmse))
    }
}

/// What came of looking for one place.
#[derive(Debug, Clone, Copy, Default)]
pub struct Outcome {
    /// Frames until the first that was placed in the map, that one counted.
    pub after: Option<usize>,
    /// Of all frames that were, the largest errors, m and degrees.
    pub worst: (f64, f64),
    pub is_wrong: bool,
}

/// The outcomes of many trials.
#[derive(Debug, Default)]
pub struct Tally {
    pub trials: Vec<Outcome>,
}

impl Tally {
    pub fn within(&self, frames: usize) -> usize {
        self.trials.iter().filter(|t| t.after.is_some_and(|n| n <= frames)).count()
    }

    pub fn wrong(&self) -> usize {
        self.trials.iter().filter(|t| t.is_wrong).count()
    }

    /// Largest errors at the median and at the most, cm and degrees.
    pub fn errors(&self) -> String {
        let mut found: Vec<(f64, f64)> = self.trials.iter().filter(|t| t.after.is_some()).map(|t| t.worst).collect();
        found.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (Some(median), Some(most)) = (found.get(found.len() / 2), found.last()) else { return "–".into() };
        let turned = found.iter().map(|e| e.1).fold(0.0, f64::max);
        format!("{:.0}, {:.0} cm, {turned:.1}°", 100.0 * median.0, 100.0 * most.0)
    }
}

/// So many frames of a place. Ends early once it has been known for ten.
pub fn look_around(robot: &mut Robot, simulator: &mut Simulator, frames: impl IntoIterator<Item = u64>) -> Outcome {
    let (mut outcome, mut known) = (Outcome::default(), 0);
    for (i, frame) in frames.into_iter().enumerate() {
        let (picture, truth) = shown(simulator, frame);
        let estimate = robot.see(&picture, Some(truth));
        if let Some(pose) = robot.known(&estimate)
            && let Some((standing, _)) = robot.standing(false)
        {
            let error = standing.error(&pose, &truth);
            outcome.after.get_or_insert(i + 1);
            outcome.worst = (outcome.worst.0.max(error.0), outcome.worst.1.max(error.1));
            outcome.is_wrong |= standing.is_wrong(error);
            known += 1;
        }
        if known == 10 {
            break;
        }
    }
    outcome
}
