//! `cairn demo`: the whole chain on a simulated camera, judged by its ground truth.

use std::fs;
use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use serde::Serialize;

use super::calibrate::before_board;
use super::session::{self, Resources, ResultArgs, SessionArgs, StageLatencies, StatusLine};
use super::{CliError, exit_code};
use crate::atomic_file::write_atomically;
use crate::camera::simulator::{Simulator, Trajectory};
use crate::camera::{FrameSource, Pacing};
use crate::daemon::{self, Calibration, MapFolder, Outputs, Parts, Status, Supply, Tick, state_name};
use crate::evaluation::{self, Reference};
use crate::frame::{Clock, process_cpu_ns};
use crate::trajectory::{TumPose, read_tum, write_tum};

/// Show the whole chain at work on a simulated camera: no webcam and no configuration needed
#[derive(Debug, clap::Args)]
pub struct DemoArgs {
    /// Length, s (1 to 3600)
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u64).range(1..=3600))]
    pub seconds: u64,
    /// Move slowly before a chessboard of 9x6 inner corners ([simulator.chessboard] says others): to try a calibration in the console
    #[arg(long)]
    pub board: bool,
    /// Folder for trajectory, truth, map, picture and summary
    #[arg(long, value_name = "DIR", default_value = "cairn-demo")]
    pub output: PathBuf,
    #[command(flatten)]
    pub result: ResultArgs,
    #[command(flatten)]
    pub session: SessionArgs,
}

/// `summary.json`.
#[derive(Debug, Clone, Serialize)]
struct Summary {
    /// Frames that the simulated camera took.
    frames: u64,
    frames_dropped: u64,
    poses_published: u64,
    maps_published: u64,
    /// Of all frames, those with a pose in the trajectory.
    coverage_percent: f64,
    /// RMSE of the positions after Sim(3) alignment, as a share of the path driven; null if nothing could be aligned.
    ate_percent_of_path: Option<f64>,
    ate_rmse_m: Option<f64>,
    rotation_rmse_deg: Option<f64>,
    path_m: f64,
    keyframes: u64,
    landmarks: u32,
    resets: u64,
    /// From a frame's arrival to its published pose, ms.
    latency_p50_ms: Option<f64>,
    latency_p95_ms: Option<f64>,
    latency_p99_ms: Option<f64>,
    stages: StageLatencies,
    #[serde(flatten)]
    resources: Resources,
    simulator: String,
    files: Vec<PathBuf>,
}

pub fn run(args: &DemoArgs) -> Result<ExitCode, CliError> {
    let mut config = args.session.open_for_result(args.result.quiet)?;
    let stop = session::stop_flag()?;
    config.simulator.duration_s = args.seconds as f64;
    if args.board {
        before_board(&mut config.simulator);
    }
    fs::create_dir_all(&args.output)
        .map_err(|e| CliError::new(exit_code::CANNOT_CREATE, format!("{}: {e}", args.output.display())))?;
    let file = |name: &str| args.output.join(name);
    let outputs = Outputs {
        trajectory: Some(file("trajectory.txt")),
        live_trajectory: Some(file("live_trajectory.txt")),
        odometry: None,
        map: Some(file("map.ply")),
        overview: Some(file("overview.png")),
    };
    let simulator = Simulator::new(&config.simulator, Pacing::RealTime)
        .map_err(|e| CliError::new(exit_code::CONFIG, e.to_string()))?;
    let (name, size) = (simulator.description().name.clone(), simulator.description().size);
    let truth = Truth {
        trajectory: simulator.trajectory().clone(),
        rate_hz: config.simulator.rate_hz,
        frames: simulator.description().frames.unwrap_or(0),
    };
    let calibration = Calibration::known(simulator.camera_model().clone(), name.clone());
    let (outlet, desk) = session::open_wire(&config, Clock::Monotonic, size).map_err(|e| session::wire_error(&e))?;
    let status = Arc::new(Status::default());
    let parts = Parts {
        config,
        supply: Supply::Once(Box::new(simulator)),
        calibration,
        outlet: Some(outlet),
        outputs: outputs.clone(),
        spool_folder: None,
        keep_lens: None,
        map_file: None,
        // So that commands on maps can be tried; nothing of a simulated room gets among a robot's maps.
        maps: std::path::absolute(file("maps")).ok().map(MapFolder::new),
        status: status.clone(),
    };
    let cpu_before_ns = process_cpu_ns();
    let mut line = StatusLine::new(args.result.quiet);
    let length = Duration::from_secs(args.seconds);
    let end = daemon::supervise(parts, Some(desk), Clock::Monotonic, &stop, &mut |tick| {
        line.show(&status_line(tick, length));
        true
    });
    line.clear();
    let end = end.map_err(|e| CliError::new(exit_code::CANNOT_CREATE, e.to_string()))?;
    session::judge(&end)?;

    let mut files = end.written.files.clone();
    let truth_path = file("truth.txt");
    let truth = truth.poses(&status);
    write_tum(&truth_path, &truth).map_err(|e| CliError::new(exit_code::CANNOT_CREATE, e.to_string()))?;
    files.push(truth_path);
    let estimate = outputs.trajectory.as_deref().map(read_tum).and_then(Result::ok).unwrap_or_default();
    let resources = Resources::now(status.processed.get(), cpu_before_ns);
    let summary_path = file("summary.json");
    files.push(summary_path.clone());
    let summary = Summary { files, ..summarise(&status, &estimate, truth, resources, name) };
    let json = session::json(&summary)?;
    write_atomically(&summary_path, |out| out.write_all(json.as_bytes()))
        .map_err(|e| CliError::new(exit_code::CANNOT_CREATE, e.to_string()))?;
    session::print(&if args.result.json { json } else { text(&summary) })?;
    if status.tracked.get() == 0 {
        return Err(CliError::new(exit_code::FAILURE, "no frame was tracked"));
    }
    Ok(ExitCode::SUCCESS)
}

/// Where the simulated camera really was.
struct Truth {
    trajectory: Trajectory,
    rate_hz: f64,
    frames: u64,
}

impl Truth {
    /// One pose for each frame that the camera was to take, as far as the run came: a frame that was dropped or skipped counts
    /// as one without a pose.
    fn poses(&self, status: &Status) -> Vec<TumPose> {
        let start_ns = self.trajectory.start_ns();
        let last_ns = status.last_arrival_ns().unwrap_or(start_ns);
        let stamps = (0..self.frames).map(|k| start_ns + (k as f64 * 1e9 / self.rate_hz).round() as i64);
        stamps
            .take_while(|stamp| *stamp <= last_ns)
            .map(|timestamp_ns| TumPose { timestamp_ns, world_from_camera: self.trajectory.pose_at(timestamp_ns) })
            .collect()
    }
}

fn status_line(tick: &Tick<'_>, length: Duration) -> String {
    let s = tick.status;
    let (landmarks, keyframes) = s.map_size();
    let latency = s.latency.snapshot().percentile_ms(0.5).unwrap_or(f64::NAN);
    format!(
        "{:5.1}/{} s  {:<12}  poses {}  landmarks {} in view, {landmarks} in map  keyframes {keyframes}  latency {latency:.1} ms  dropped {}",
        tick.elapsed.as_secs_f64(),
        length.as_secs(),
        state_name(s.state()),
        s.tracked.get(),
        s.landmarks_tracked(),
        s.dropped.get(),
    )
}

fn summarise(
    status: &Status,
    estimate: &[TumPose],
    truth: Vec<TumPose>,
    resources: Resources,
    simulator: String,
) -> Summary {
    let frames = truth.iter().map(|pose| pose.timestamp_ns).collect();
    let reference = Reference {
        ground_truth_path: PathBuf::from("truth.txt"),
        ground_truth: truth,
        frames_path: None,
        frames: Some(frames),
        notes: Vec::new(),
    };
    let figures = evaluation::evaluate(estimate, &reference).map(|outcome| outcome.figures).ok();
    let ate = figures.as_ref().and_then(|f| f.ate_m.as_ref()).map(|s| s.rmse);
    let path_m = figures.as_ref().map_or(0.0, |f| f.path_m);
    let latency = status.latency.snapshot();
    Summary {
        frames: status.captured.get(),
        frames_dropped: status.dropped.get(),
        poses_published: status.poses_published.get(),
        maps_published: status.maps_published.get(),
        coverage_percent: figures.as_ref().map_or(0.0, |f| f.coverage_percent),
        ate_percent_of_path: ate.filter(|_| path_m > 0.0).map(|ate| 100.0 * ate / path_m),
        ate_rmse_m: ate,
        rotation_rmse_deg: figures.as_ref().and_then(|f| f.rotation_deg.as_ref()).map(|s| s.rmse),
        path_m,
        keyframes: status.keyframes.get(),
        landmarks: status.map_size().0,
        resets: status.resets.get(),
        latency_p50_ms: latency.percentile_ms(0.50),
        latency_p95_ms: latency.percentile_ms(0.95),
        latency_p99_ms: latency.percentile_ms(0.99),
        stages: StageLatencies::of(status),
        resources,
        simulator,
        files: Vec::new(),
    }
}

fn text(s: &Summary) -> String {
    let percent = |v: Option<f64>| v.map_or("unknown".into(), |v| format!("{v:.2} %"));
    let mut text = format!(
        "{}\n  {} frames, {} poses published, coverage {:.1} %, {} frames dropped\n",
        s.simulator, s.frames, s.poses_published, s.coverage_percent, s.frames_dropped
    );
    text += &format!(
        "  error {} of a path of {:.2} m (RMSE after Sim(3) alignment {})\n",
        percent(s.ate_percent_of_path),
        s.path_m,
        s.ate_rmse_m.map_or("unknown".into(), |m| format!("{m:.3} m")),
    );
    text += &format!(
        "  {} landmarks in the map, {} keyframes made, {} resets\n  CPU {:.2} ms a frame (simulator included), peak memory {:.0} MB\n",
        s.landmarks, s.keyframes, s.resets, s.resources.cpu_ms_per_frame, s.resources.peak_rss_mb
    );
    text += &s.stages.table();
    for file in &s.files {
        text += &format!("wrote {}\n", file.display());
    }
    text
}
