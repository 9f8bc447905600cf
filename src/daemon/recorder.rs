//! Everything that goes to disk: trajectory spools while the daemon runs, files when they are asked for.
//!
//! The reconstruction stage hands its records over and never waits for a disk: in the daemon they cross a bounded queue
//! to a thread of their own, and a record that finds the queue full is lost and counted. In lock-step the same recorder
//! is called directly, and nothing is lost.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use crossbeam::channel::{Receiver, Sender, TrySendError};
use tracing::{info, warn};

use super::status::Status;
use crate::frame::monotonic_ns;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::map::export::write_ply;
use crate::map::{KeyframeId, MapSnapshot};
use crate::reconstruction::{LensEstimate, PoseEstimate, TrajectoryEvent};
use crate::telemetry::RateLimiter;
use crate::trajectory::{
    LiveTrajectory, OdometryLog, TrajectoryError, TrajectorySpool, TrajectorySummary, TumPose, read_tum,
};

/// Files to be written at the end; `None` is not wanted.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Outputs {
    pub trajectory: Option<PathBuf>,
    pub live_trajectory: Option<PathBuf>,
    /// The smooth pose of every frame with its state.
    pub odometry: Option<PathBuf>,
    pub map: Option<PathBuf>,
    pub overview: Option<PathBuf>,
}

impl Outputs {
    /// Those that can be written although nobody knows the map any more.
    pub(super) fn without_map(&self) -> Self {
        Self { trajectory: None, map: None, overview: None, ..self.clone() }
    }

    /// Where pictures of far keyframes may wait: beside a trajectory that is a file, else in `fallback`, else in a folder for temporary files that is
    /// not memory.
    pub fn spool_folder(&self, fallback: Option<&Path>) -> PathBuf {
        let files = [&self.trajectory, &self.live_trajectory].into_iter().flatten().filter(|path| is_file(path));
        files.filter_map(|path| path.parent()).next().or(fallback).unwrap_or(Path::new("/var/tmp")).into()
    }
}

/// Whether it is one or will be one, not a device or a pipe; also not by one of their names (`/dev/stdout` may lead to a file).
fn is_file(path: &Path) -> bool {
    let is_system = ["/dev", "/proc", "/sys"].iter().any(|folder| path.starts_with(folder));
    !is_system && std::fs::metadata(path).map_or(true, |there| there.is_file())
}

/// What reconstruction knows at the moment that a file is asked for.
#[derive(Debug, Clone, Default)]
pub struct FinalMap {
    pub keyframe_poses: Vec<(KeyframeId, Se3<World, Camera>)>,
    pub snapshot: MapSnapshot,
}

/// One thing to be recorded.
#[derive(Debug)]
#[expect(clippy::large_enum_variant, reason = "the queue's slots are made once; a box would be an allocation a frame")]
pub enum Record {
    Event(TrajectoryEvent),
    Published(PoseEstimate),
    /// The lens is better known than what was kept of it.
    Lens(Box<LensEstimate>),
}

/// Keeps what was learnt about a lens for the next start: where it lies now, or why not.
pub type KeepLens = Box<dyn FnMut(&LensEstimate) -> Result<String, String> + Send>;

/// A file that a command asks for while the daemon runs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SaveKind {
    Trajectory,
    Map,
}

/// What travels to the recorder's thread.
#[derive(Debug)]
#[expect(clippy::large_enum_variant, reason = "the queue's slots are made once; a box would be an allocation a frame")]
pub enum Order {
    Record(Record),
    Save { kind: SaveKind, path: PathBuf, map: Box<FinalMap>, reply: Sender<Result<String, String>> },
}

/// Owns the spools.
pub struct Recorder {
    trajectory: Option<TrajectorySpool>,
    live: Option<LiveTrajectory>,
    odometry: Option<Box<OdometryLog>>,
    keep_lens: Option<KeepLens>,
    faults: RateLimiter,
    status: Arc<Status>,
}

impl Recorder {
    /// Spools in the folder of the trajectory that they are for, else in `fallback`; a trajectory that is asked for but
    /// cannot be spooled is an error, one that a later command might ask for is a warning.
    pub fn new(outputs: &Outputs, fallback: Option<&Path>, status: Arc<Status>) -> Result<Self, TrajectoryError> {
        let folder = |path: &Path| path.parent().map(Path::to_path_buf).unwrap_or_default();
        let trajectory = match (&outputs.trajectory, fallback) {
            (Some(path), _) => Some(TrajectorySpool::create(&folder(path))?),
            (None, Some(fallback)) => TrajectorySpool::create(fallback)
                .inspect_err(|error| warn!(%error, "no spool, so no command can save a trajectory"))
                .ok(),
            (None, None) => None,
        };
        let live = match &outputs.live_trajectory {
            Some(path) => Some(LiveTrajectory::create(&folder(path))?),
            None => None,
        };
        let odometry =
            outputs.odometry.as_ref().map(|path| OdometryLog::create(&folder(path)).map(Box::new)).transpose()?;
        Ok(Self { trajectory, live, odometry, keep_lens: None, faults: RateLimiter::default(), status })
    }

    /// With somebody who keeps what is learnt about the lens.
    pub fn keeping(mut self, keep_lens: Option<KeepLens>) -> Self {
        self.keep_lens = keep_lens;
        self
    }

    /// Takes one record.
    pub fn record(&mut self, record: &Record) {
        let outcome = match record {
            Record::Event(event) => self.trajectory.as_mut().map_or(Ok(()), |spool| spool.record(event)),
            Record::Published(estimate) => {
                let live = self.live.as_mut().map_or(Ok(()), |spool| spool.record(estimate));
                live.and(self.odometry.as_mut().map_or(Ok(()), |log| log.record(estimate)))
            }
            Record::Lens(lens) => {
                match self.keep_lens.as_mut().map(|keep| keep(lens)) {
                    Some(Ok(path)) => info!(path, fx_px = lens.camera.fx, focal_sigma = lens.focal_sigma, "lens kept"),
                    Some(Err(reason)) => warn!(reason, "lens not kept for the next start"),
                    None => {}
                }
                Ok(())
            }
        };
        if let Err(error) = outcome {
            self.status.records_lost.add(1);
            if let Some(times) = self.faults.event(monotonic_ns()) {
                warn!(times, %error, "trajectory records lost");
            }
        }
    }

    /// Writes all files that are asked for, each whole or not at all. What was written, and what could not be.
    pub fn write(&mut self, outputs: &Outputs, map: &FinalMap) -> Written {
        let mut written = Written::default();
        if let (Some(path), Some(spool)) = (&outputs.trajectory, self.trajectory.as_mut()) {
            match spool.write_all_maps(path, &map.keyframe_poses) {
                Ok((summary, beside)) => {
                    log_summary("trajectory", &summary);
                    written.trajectory = Some(summary);
                    written.files.push(path.clone());
                    written.files.extend(beside.files);
                    written.failures.extend(beside.failures.iter().map(TrajectoryError::to_string));
                }
                Err(error) => written.failures.push(error.to_string()),
            }
        }
        if let (Some(path), Some(spool)) = (&outputs.live_trajectory, self.live.as_mut()) {
            written.note(path, spool.write_tum(path).map(|summary| log_summary("live trajectory", &summary)));
        }
        if let (Some(path), Some(log)) = (&outputs.odometry, self.odometry.as_mut()) {
            let outcome = log.write(path);
            written.note(path, outcome.map(|s| info!(what = "odometry", frames_lost = s.frames_lost, "written")));
        }
        if let Some(path) = &outputs.map {
            written.note(path, write_ply(path, &map.snapshot));
        }
        if let Some(path) = &outputs.overview {
            // The largest map's trajectory is drawn only into its own map: two maps have nothing in common.
            let belongs = written.trajectory.is_some_and(|t| t.map == Some(map.snapshot.map));
            let poses = outputs.trajectory.as_deref().filter(|_| belongs).map(read_tum).and_then(Result::ok);
            let title = format!("map {} with {} landmarks", map.snapshot.map.0, map.snapshot.landmarks.len());
            let poses = poses.unwrap_or_default();
            written.note(path, draw(path, &map.snapshot, &poses, &title));
        }
        written
    }

    fn save(&mut self, kind: &SaveKind, path: &Path, map: &FinalMap) -> Result<String, String> {
        match kind {
            SaveKind::Trajectory => {
                let spool = self.trajectory.as_mut().ok_or("no trajectory is being recorded")?;
                let summary = spool.write_tum(path, &map.keyframe_poses).map_err(|e| e.to_string())?;
                log_summary("trajectory", &summary);
                Ok(format!("{} poses written to {}", summary.poses_written, path.display()))
            }
            SaveKind::Map => {
                write_ply(path, &map.snapshot).map_err(|e| e.to_string())?;
                let (landmarks, keyframes) = (map.snapshot.landmarks.len(), map.snapshot.keyframes.len());
                info!(landmarks, keyframes, map = map.snapshot.map.0, "map written");
                Ok(format!("{landmarks} landmarks and {keyframes} keyframes written to {}", path.display()))
            }
        }
    }
}

#[cfg(feature = "tools")]
fn draw(path: &Path, map: &MapSnapshot, poses: &[TumPose], title: &str) -> Result<(), crate::plot::PlotError> {
    use crate::plot::{LengthUnit, write_overview};
    let unit = if map.scale.is_metric() { LengthUnit::Metres } else { LengthUnit::MapUnits };
    write_overview(path, map, poses, unit, title)
}

/// Whoever asks for a picture is refused before the work; this is for callers of the library.
#[cfg(not(feature = "tools"))]
fn draw(path: &Path, _: &MapSnapshot, _: &[TumPose], _: &str) -> Result<(), String> {
    Err(format!("cannot write {}: this build, the robot's, draws no pictures", path.display()))
}

fn log_summary(what: &str, s: &TrajectorySummary) {
    info!(
        what,
        poses = s.poses_written,
        map = s.map.map(|m| m.0),
        other_maps = s.other_maps,
        poses_in_other_maps = s.poses_in_other_maps,
        poses_replaced = s.poses_replaced,
        poses_unresolved = s.poses_unresolved,
        events_lost = s.events_lost,
        "written"
    );
}

/// What became of the files at the end.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Written {
    pub files: Vec<PathBuf>,
    /// What is in the trajectory, if one was written.
    pub trajectory: Option<TrajectorySummary>,
    /// One message a file that could not be written.
    pub failures: Vec<String>,
}

impl Written {
    /// What became of the map on disk.
    pub fn note_map(&mut self, outcome: Result<Option<PathBuf>, String>) {
        match outcome {
            Ok(path) => self.files.extend(path),
            Err(reason) => self.failures.push(reason),
        }
    }

    fn note<E: std::fmt::Display>(&mut self, path: &Path, outcome: Result<(), E>) {
        match outcome {
            Ok(()) => self.files.push(path.into()),
            Err(error) => self.failures.push(error.to_string()),
        }
    }
}

/// The way from the reconstruction stage to the recorder.
pub enum RecorderLink {
    /// Called directly: lock-step.
    Inline(Recorder),
    /// Across a bounded queue; a record that finds it full is lost.
    Queue(Sender<Order>, Arc<Status>),
}

impl RecorderLink {
    pub fn record(&mut self, record: Record) {
        match self {
            RecorderLink::Inline(recorder) => recorder.record(&record),
            RecorderLink::Queue(orders, status) => {
                if orders.try_send(Order::Record(record)).is_err() {
                    status.records_lost.add(1);
                }
            }
        }
    }

    /// Passes a save order on.
    pub fn save(&mut self, kind: SaveKind, path: PathBuf, map: Box<FinalMap>, reply: Sender<Result<String, String>>) {
        match self {
            RecorderLink::Inline(recorder) => drop(reply.try_send(recorder.save(&kind, &path, &map))),
            RecorderLink::Queue(orders, _) => {
                if let Err(TrySendError::Full(Order::Save { reply, .. })) =
                    orders.try_send(Order::Save { kind, path, map, reply })
                {
                    drop(reply.try_send(Err("the disk is too slow for what is being recorded".into())));
                }
            }
        }
    }
}

/// The recorder's thread: works off `orders` until every sender is gone, and gives the recorder back.
pub fn serve(mut recorder: Recorder, orders: &Receiver<Order>) -> Recorder {
    for order in orders {
        match order {
            Order::Record(record) => recorder.record(&record),
            Order::Save { kind, path, map, reply } => drop(reply.try_send(recorder.save(&kind, &path, &map))),
        }
    }
    recorder
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_wait_beside_files_only() {
        let dir = tempfile::tempdir().expect("a folder");
        let spool = |trajectory: &Path, live: Option<PathBuf>, fallback| {
            let outputs = Outputs { trajectory: Some(trajectory.into()), live_trajectory: live, ..Outputs::default() };
            outputs.spool_folder(fallback)
        };
        let [new, there] = ["new.txt", "there.txt"].map(|name| dir.path().join(name));
        std::fs::write(&there, "").expect("written");
        let state = Some(Path::new("/state"));
        assert_eq!(spool(&new, None, state), dir.path());
        assert_eq!(spool(&there, None, None), dir.path());
        for device in ["/dev/null", "/dev/stdout", "/dev/none", "/proc/self/fd/1"].map(Path::new) {
            assert_eq!(spool(device, None, state), Path::new("/state"));
            assert_eq!(spool(device, None, None), Path::new("/var/tmp"));
            assert_eq!(spool(device, Some(new.clone()), state), dir.path());
        }
        // A folder is no file.
        assert_eq!(spool(dir.path(), None, state), Path::new("/state"));
    }
}
