//! Recordings located in their own saved maps, from anywhere in them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use cairn::camera::recording::{Pacing, Recording};
use cairn::camera::{FrameSource, Grab};
use cairn::features::{FeatureStage, FeaturesConfig, Feedback, FrameFeatures};
use cairn::frame::RawFrame;
use cairn::geometry::random::Random;
use cairn::geometry::{CameraModel, median};
use cairn::map::{LandmarkId, MapSnapshot};
use cairn::places::store;
use cairn::reconstruction::{
    InlineWorker, PoseEstimate, Reconstruction, ReconstructionConfig, TrackingState, TrajectoryEvent,
};
use cairn::trajectory::{TrajectorySpool, read_tum};

use super::number;
use super::robot::Pose;
use super::support::recording;

const NAMES: [&str; 8] = [
    "new_tsukuba",
    "tum_fr1_xyz",
    "tum_fr1_desk",
    "7scenes_redkitchen",
    "uzh_parking",
    "tartanair_indoor",
    "visp_rbt",
    "kitti_03",
];
/// Frames that are looked at from a start.
const LOOKED: usize = 30;

/// What goes through a recording.
struct Viewer {
    reconstruction: Reconstruction,
    stage: FeatureStage,
    features: FrameFeatures,
    feedback: Feedback,
}

impl Viewer {
    /// `detailed`: keyframes beyond these are condensed.
    fn new(camera: &CameraModel, detailed: usize) -> Self {
        let worker = Box::new(InlineWorker::default());
        let config =
            ReconstructionConfig { loops: true, detailed_keyframes: detailed, ..ReconstructionConfig::default() };
        Self {
            reconstruction: Reconstruction::new(&config, camera, worker, true),
            stage: FeatureStage::new(&FeaturesConfig::default()),
            features: FrameFeatures::default(),
            feedback: Feedback::default(),
        }
    }

    fn see(&mut self, frame: &RawFrame) -> PoseEstimate {
        self.stage.step(frame, &mut self.features).unwrap();
        let estimate = self.reconstruction.track(&self.features);
        self.reconstruction.map(&self.features, &mut self.feedback);
        self.stage.feedback(&self.feedback);
        estimate
    }

    /// Median depth of what the last pose rests on, map units.
    fn depth(&self, pose: &Pose) -> Option<f64> {
        let mut map = MapSnapshot::default();
        self.reconstruction.snapshot(&mut map);
        let places: BTreeMap<LandmarkId, _> = map.landmarks.iter().map(|l| (l.id, l.position_world)).collect();
        let camera = pose.inverse();
        let seen = self.reconstruction.matches();
        let mut depths: Vec<f64> = seen.filter_map(|(id, _)| Some(camera.transform(places.get(&id)?).z)).collect();
        median(&mut depths)
    }
}

/// A recording's frames, its camera, the file of its map, and each frame's pose in that.
struct Mapped {
    frames: Vec<RawFrame>,
    camera: CameraModel,
    file: PathBuf,
    poses: BTreeMap<i64, Pose>,
    detailed: usize,
}

fn mapped(recording: &Path, folder: &Path, detailed: usize) -> Mapped {
    let mut source = Recording::open(recording, Pacing::LockStep).unwrap();
    let camera = source.description().camera.clone().unwrap();
    let mut viewer = Viewer::new(&camera, detailed);
    let (mut frames, mut events) = (Vec::new(), Vec::<TrajectoryEvent>::new());
    let mut spool = TrajectorySpool::create(folder).unwrap();
    loop {
        let mut frame = RawFrame::default();
        match source.grab(&mut frame, Duration::ZERO).unwrap() {
            Grab::Frame => {}
            Grab::Skipped { .. } => continue,
            Grab::TimedOut | Grab::End => break,
        }
        viewer.see(&frame);
        viewer.reconstruction.take_trajectory_events(&mut events);
        events.drain(..).for_each(|event| spool.record(&event).unwrap());
        frames.push(frame);
    }
    viewer.reconstruction.finish();
    viewer.reconstruction.take_trajectory_events(&mut events);
    events.drain(..).for_each(|event| spool.record(&event).unwrap());
    let (file, path) = (folder.join("own.map"), folder.join("poses.txt"));
    spool.write_tum(&path, &viewer.reconstruction.keyframe_poses()).unwrap();
    let poses = read_tum(&path).unwrap().into_iter().map(|p| (p.timestamp_ns, p.world_from_camera)).collect();
    store::MapFile::create(&file, &viewer.reconstruction.take_changes(true)).unwrap().close().unwrap();
    Mapped { frames, camera, file, poses, detailed }
}

/// From one start.
#[derive(Debug)]
struct Start {
    frame: usize,
    /// Frames until the first that was placed, that one counted.
    after: Option<usize>,
    /// How far that one and the worst of the next ten are from where the mapping run had them, % of the scene's depth.
    first_off: f64,
    worst_off: f64,
}

fn start(mapped: &Mapped, frame: usize) -> Start {
    let mut viewer = Viewer::new(&mapped.camera, mapped.detailed);
    viewer.reconstruction.resume(store::read(&mapped.file).unwrap().saved, true);
    let mut found = Start { frame, after: None, first_off: 0.0, worst_off: 0.0 };
    let mut known = 0;
    for (i, raw) in mapped.frames.iter().enumerate().skip(frame).take(LOOKED) {
        let estimate = viewer.see(raw);
        let told = estimate.world_from_camera.filter(|_| estimate.state == TrackingState::Tracking);
        let (Some(told), Some(own)) = (told, mapped.poses.get(&raw.timestamp_ns)) else { continue };
        let off = 100.0 * (told.translation - own.translation).norm() / viewer.depth(&told).unwrap();
        if found.after.is_none() {
            found.after = Some(i + 1 - frame);
            found.first_off = off;
        }
        found.worst_off = found.worst_off.max(off);
        known += 1;
        if known > 10 {
            break;
        }
    }
    found
}

/// Starts anywhere where the mapping run has poses.
fn starts(recording: &Path, count: usize, seed: u64, detailed: usize) -> Vec<Start> {
    let folder = tempfile::tempdir().unwrap();
    let mapped = mapped(recording, folder.path(), detailed);
    let has_pose = |i: usize| mapped.poses.contains_key(&mapped.frames[i].timestamp_ns);
    let candidates: Vec<usize> = (0..mapped.frames.len().saturating_sub(12)).filter(|i| has_pose(*i)).collect();
    let mut random = Random::new(seed);
    (0..count).map(|_| start(&mapped, candidates[random.below(candidates.len())])).collect()
}

fn told(name: &str, found: &[Start]) -> [usize; 2] {
    for missed in found.iter().filter(|s| s.after.is_none_or(|n| n > 10) || s.first_off > 2.0) {
        eprintln!("{name}, from frame {}: {missed:?}", missed.frame);
    }
    let within = found.iter().filter(|s| s.after.is_some_and(|n| n <= 10)).count();
    [within, found.iter().filter(|s| s.after.is_some() && s.first_off <= 2.0).count()]
}

#[test]
fn a_recording_is_located_in_its_own_map_from_anywhere() {
    let Some(recording) = recording("new_tsukuba") else { return };
    // All of its keyframes with pictures, and only the newest of them.
    for detailed in [200, 20] {
        let found = starts(&recording, 8, 1, detailed);
        let [within, exact] = told("new_tsukuba", &found);
        assert!(within >= 7 && exact >= 7, "{detailed}: {found:?}");
    }
}

#[test]
#[ignore = "a table of results"]
fn own_maps() {
    let trials = number("TRIALS", 100);
    println!(
        "\n| recording | starts | within 10 frames | within 30 | within 2 % of the depth | first pose off, % of the depth: median, most | the next ten, most |"
    );
    println!("|---|---:|---:|---:|---:|---:|---:|");
    for name in NAMES {
        let Some(recording) = recording(name) else { return };
        let found = starts(&recording, trials.div_ceil(NAMES.len()), 501, number("DETAILED", 200));
        let [within, exact] = told(name, &found);
        let mut firsts: Vec<f64> = found.iter().filter(|s| s.after.is_some()).map(|s| s.first_off).collect();
        firsts.sort_by(f64::total_cmp);
        let (located, most) = (firsts.len(), firsts.last().copied().unwrap_or(f64::NAN));
        let middle = firsts.get(located / 2).copied().unwrap_or(f64::NAN);
        let worst = found.iter().map(|s| s.worst_off).fold(0.0, f64::max);
        println!("| {name} | {} | {within} | {located} | {exact} | {middle:.2}, {most:.2} | {worst:.2} |", found.len());
    }
}
