//! The whole chain of steps on simulated pictures: lock-step, without threads, every frame remembered.
//!
//! Input: a simulator's configuration, which frames reach the daemon, how many. Output: a [`Run`]: one [`Record`] a frame (truth
//! beside what was published), the trajectory as the map knows it at the end, counters, and memory over time.
//! Cost: rendering, 8 to 25 ms a frame of 640x480; then what the daemon itself costs.

use std::path::Path;

use crate::camera::simulator::{Simulator, SimulatorConfig};
use crate::camera::{Pacing, SourceError};
use crate::features::{FeatureStage, FeaturesConfig, Feedback, FrameFeatures};
use crate::frame::process_cpu_ns;
use crate::geometry::frames::{Camera, World};
use crate::geometry::{Se3, median};
use crate::image::GreyImage;
use crate::map::MapSnapshot;
use crate::reconstruction::{
    Counters, InlineWorker, PoseEstimate, Reconstruction, ReconstructionConfig, TrackingState, TrajectoryEvent,
};
use crate::trajectory::{TrajectoryError, TrajectorySpool, TumPose, read_tum};

/// What to drive, and how.
#[derive(Debug, Clone)]
pub struct Drive<'a> {
    pub simulator: &'a SimulatorConfig,
    /// Of the simulator's frames, the next one that is looked at lies so many further; taken in turn. `[1]`: all.
    pub steps: &'a [u64],
    pub seconds: f64,
    pub features: &'a FeaturesConfig,
    pub reconstruction: &'a ReconstructionConfig,
}

/// The keyframe that a pose is relative to, as it was when the pose was published.
#[derive(Debug, Clone, Copy)]
pub struct Anchor {
    pub world_from_camera: Se3<World, Camera>,
    pub truth: Se3<World, Camera>,
}

/// One frame.
#[derive(Debug, Clone)]
pub struct Record {
    pub timestamp_ns: i64,
    /// World of the simulator, metres.
    pub truth: Se3<World, Camera>,
    pub estimate: PoseEstimate,
    pub anchor: Option<Anchor>,
    /// From the tracked corners to the pose, ms of CPU time (of the process, which should do nothing else): for the table, never
    /// for a decision.
    pub track_ms: f64,
}

impl Record {
    pub fn is_tracking(&self) -> bool {
        self.estimate.state == TrackingState::Tracking
    }
}

/// Size of map and process at a time.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Sizes {
    pub seconds: f64,
    pub keyframes: usize,
    pub landmarks: usize,
    /// Resident memory of the whole process, the simulator's included, MB; NaN where the system does not tell.
    pub rss_mb: f64,
}

/// What came of it.
#[derive(Debug)]
pub struct Run {
    pub records: Vec<Record>,
    /// The largest map's trajectory, ascending time; frames that were solved afterwards included.
    pub trajectory: Vec<TumPose>,
    pub counters: Counters,
    pub sizes: Vec<Sizes>,
    /// Median distance of the final map's landmarks from the last pose, map units.
    pub depth: Option<f64>,
}

/// Why there is no run.
#[derive(Debug, thiserror::Error)]
pub enum DriveError {
    #[error(transparent)]
    Source(#[from] SourceError),
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
}

/// Time between two entries of [`Run::sizes`], s.
const SIZES_EVERY_S: f64 = 10.0;

/// Runs it. `trajectory`: file to write the trajectory to (its folder must exist).
pub fn drive(what: &Drive<'_>, trajectory: &Path) -> Result<Run, DriveError> {
    let mut simulator = Simulator::new(what.simulator, Pacing::LockStep)?;
    let camera = simulator.camera_model().clone();
    let mut stage = FeatureStage::new(what.features);
    let worker = Box::new(InlineWorker::default());
    let mut reconstruction = Reconstruction::new(what.reconstruction, &camera, worker, true);
    let mut spool = TrajectorySpool::create(trajectory.parent().unwrap_or(Path::new(".")))?;
    let (mut features, mut feedback, mut picture) =
        (FrameFeatures::default(), Feedback::default(), GreyImage::new(0, 0));
    let mut events: Vec<TrajectoryEvent> = Vec::new();
    let frames = (what.seconds * what.simulator.rate_hz).round().max(0.0) as u64;
    // Room for every record before the first frame: what grows from then on is the map.
    let mut records = Vec::with_capacity(frames as usize);
    let mut sizes: Vec<Sizes> = Vec::new();
    let mut snapshot = MapSnapshot::default();
    let (mut frame, mut steps) = (0, what.steps.iter().cycle());
    while frame < frames {
        simulator.render(frame, &mut picture);
        stage.feedback(&feedback);
        stage.step_grey(&picture, &mut features);
        features.sequence = frame;
        features.timestamp_ns = simulator.timestamp_ns(frame);
        let began_ns = process_cpu_ns();
        let estimate = reconstruction.track(&features);
        let track_ms = (process_cpu_ns() - began_ns) as f64 * 1e-6;
        let anchor = estimate.anchor.and_then(|id| reconstruction.keyframe(id)).map(|k| Anchor {
            world_from_camera: k.world_from_camera,
            truth: simulator.trajectory().pose_at(k.timestamp_ns),
        });
        let truth = simulator.trajectory().pose_at(features.timestamp_ns);
        records.push(Record { timestamp_ns: features.timestamp_ns, truth, estimate, anchor, track_ms });
        reconstruction.map(&features, &mut feedback);
        reconstruction.take_trajectory_events(&mut events);
        for event in events.drain(..) {
            spool.record(&event)?;
        }
        let seconds = frame as f64 / what.simulator.rate_hz;
        frame += (*steps.next().unwrap_or(&1)).max(1);
        if frame >= frames || sizes.last().is_none_or(|s| seconds - s.seconds >= SIZES_EVERY_S) {
            reconstruction.snapshot(&mut snapshot);
            sizes.push(Sizes {
                seconds,
                keyframes: snapshot.keyframes.len(),
                landmarks: snapshot.landmarks.len(),
                rss_mb: rss_mb().unwrap_or(f64::NAN),
            });
        }
    }
    reconstruction.finish();
    reconstruction.take_trajectory_events(&mut events);
    for event in events.drain(..) {
        spool.record(&event)?;
    }
    let written = spool.write_tum(trajectory, &reconstruction.keyframe_poses())?;
    let trajectory = if written.poses_written > 0 { read_tum(trajectory)? } else { Vec::new() };
    reconstruction.snapshot(&mut snapshot);
    let depth = records.iter().rev().find_map(|r| r.estimate.world_from_camera).and_then(|pose| {
        let mut depths: Vec<f64> =
            snapshot.landmarks.iter().map(|l| (l.position_world - pose.translation).norm()).collect();
        median(&mut depths)
    });
    Ok(Run { records, trajectory, counters: reconstruction.counters(), sizes, depth })
}

/// VmRSS of /proc/self/status, MB.
fn rss_mb() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kb: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kb / 1024.0)
}
