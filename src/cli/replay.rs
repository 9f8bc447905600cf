//! `cairn replay`: a recording through the pipeline, in real time or in lock-step.

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Instant;

use serde::Serialize;
use tracing::{info, warn};

use super::session::{self, Resources, ResultArgs, SessionArgs, StageLatencies, StatusLine};
use super::{CliError, camera_calibration, exit_code, map_file};
use crate::calibration::{Unsaid, load_camera_with};
use crate::camera::recording::OwnCalibration;
use crate::camera::{Asked, Bag, FrameSource, Pacing, Recording, SourceDescription, SourceError, bag};
use crate::config::Config;
use crate::daemon::{self, Calibration, End, Outputs, Parts, Status, Supply, state_name};
use crate::frame::process_cpu_ns;
use crate::reconstruction::LensKnowledge;

/// Replay a recording: print a summary, write trajectory, map and pictures
#[derive(Debug, clap::Args)]
pub struct ReplayArgs {
    /// MCAP file, rosbag2 folder of them, or folder in TUM RGB-D or EuRoC layout
    pub dir: PathBuf,
    /// Topic of the pictures in an MCAP file, where there are several
    #[arg(long)]
    pub topic: Option<String>,
    /// Topic of the wheel odometry in an MCAP file (Odometry, its twist, or TwistWithCovarianceStamped), where there are several
    #[arg(long, value_name = "TOPIC")]
    pub wheel_topic: Option<String>,
    /// Every frame, as fast as they can be processed, with the same result every time
    #[arg(long)]
    pub lockstep: bool,
    /// Camera calibration: ours (TOML) or a YAML with fx fy cx cy and distortion [default: DIR/camera.yaml, the MCAP file's CameraInfo]
    #[arg(long, value_name = "FILE")]
    pub camera: Option<PathBuf>,
    /// As if there were no calibration: the lens is estimated from the motion. So it is, too, where the recording has none
    #[arg(long, conflicts_with = "camera")]
    pub uncalibrated: bool,
    /// Write every tracked frame as the map knows it at the end (TUM format): of the largest map, after joining; each other
    /// map's stand beside it as OUT with `.map<ID>` before the ending
    #[arg(long, value_name = "OUT")]
    pub trajectory: Option<PathBuf>,
    /// Write every map pose as it was published (TUM format)
    #[arg(long, value_name = "OUT")]
    pub live_trajectory: Option<PathBuf>,
    /// Write the odom pose of every frame with its state, dead-reckoned ones too (TUM columns and a word)
    #[arg(long, value_name = "OUT")]
    pub odometry: Option<PathBuf>,
    /// Write landmarks and keyframes (PLY)
    #[arg(long, value_name = "OUT.ply")]
    pub map: Option<PathBuf>,
    /// Go on in the map of this file and keep it there while it grows; a file that does not exist is made
    #[arg(long, value_name = "FILE")]
    pub map_file: Option<PathBuf>,
    /// Only locate in the map of `--map-file`: neither map nor file changes
    #[arg(long, requires = "map_file")]
    pub localise: bool,
    /// Write a picture of map and trajectory from above (PNG)
    #[arg(long, value_name = "OUT.png")]
    pub overview: Option<PathBuf>,
    #[command(flatten)]
    pub result: ResultArgs,
    #[command(flatten)]
    pub session: SessionArgs,
}

/// What a replay came to.
#[derive(Debug, Clone, Serialize)]
struct Summary {
    recording: String,
    mode: &'static str,
    /// Frames of the recording, as far as it was replayed.
    frames: u64,
    /// Frames whose pose was known, and published, at once.
    tracked: u64,
    coverage_percent: f64,
    /// Frames with a pose in the trajectory, those included that were solved afterwards; null if none was written.
    in_trajectory: Option<u64>,
    /// Maps that were never joined to that of the trajectory, each in a file beside it, and their poses.
    other_maps: u64,
    in_other_maps: u64,
    dropped: u64,
    unreadable: u64,
    bad_timestamps: u64,
    keyframes: u64,
    landmarks: u32,
    resets: u64,
    relocalisations: u64,
    /// Places seen again after a long way: the map was corrected, or lay right already.
    loops: u64,
    loops_tied: u64,
    /// Turns on the spot behind which the scale is an assumption.
    blind_turns: u64,
    /// Time and way for which the wheels alone told the pose.
    blind_s: f64,
    blind_m: f64,
    elapsed_s: f64,
    #[serde(flatten)]
    resources: Resources,
    intrinsics: IntrinsicsSummary,
    /// Only where the recording tells of wheels.
    #[serde(skip_serializing_if = "Option::is_none")]
    wheels: Option<WheelSummary>,
    stages: StageLatencies,
    files: Vec<PathBuf>,
}

/// What has become of the lines of `odometry.txt`.
#[derive(Debug, Clone, Copy, Serialize)]
struct WheelSummary {
    /// Believed.
    readings: u64,
    /// Not believed: a speed that cannot be, or no number.
    absurd: u64,
    /// Not believed: time repeats, goes back or jumps ahead.
    out_of_order: u64,
    /// Stretches of over 0.5 s without a reading.
    gaps: u64,
    /// Dropped because no frame asked for them.
    dropped: u64,
}

impl WheelSummary {
    /// `None`: nothing was told.
    fn of(status: &Status) -> Option<Self> {
        let w = &status.wheels;
        let (readings, absurd, out_of_order) = (w.received.get(), w.absurd.get(), w.out_of_order.get());
        let (gaps, dropped) = (w.gaps.get(), w.dropped.get());
        (readings + w.refused() > 0).then_some(Self { readings, absurd, out_of_order, gaps, dropped })
    }
}

/// The lens at the end, and how surely it is known.
#[derive(Debug, Clone, Copy, Serialize)]
struct IntrinsicsSummary {
    /// `calibrated`, `estimated` (from the motion) or `guessed` (the motion did not show it).
    knowledge: &'static str,
    /// `radial_tangential` or `kannala_brandt`.
    lens_model: &'static str,
    fx_px: f32,
    fy_px: f32,
    cx_px: f32,
    cy_px: f32,
    /// Standard deviation of the focal length, as a share of it.
    focal_sigma: f32,
    centre_sigma_px: f32,
}

impl IntrinsicsSummary {
    fn of(status: &Status) -> Self {
        let (knowledge, [fx_px, fy_px, cx_px, cy_px, focal_sigma, centre_sigma_px]) = status.lens();
        let lens_model = if status.lens_is_wide_angle() { "kannala_brandt" } else { "radial_tangential" };
        Self { knowledge: knowledge.name(), lens_model, fx_px, fy_px, cx_px, cy_px, focal_sigma, centre_sigma_px }
    }
}

pub fn run(args: &ReplayArgs) -> Result<ExitCode, CliError> {
    if args.overview.is_some() {
        super::builds::needs_tools("`--overview`")?;
    }
    let config = args.session.open_for_result(args.result.quiet)?;
    let stop = session::stop_flag()?;
    let outputs = Outputs {
        trajectory: args.trajectory.clone(),
        live_trajectory: args.live_trajectory.clone(),
        odometry: args.odometry.clone(),
        map: args.map.clone(),
        overview: args.overview.clone(),
    };
    let all = [&outputs.trajectory, &outputs.live_trajectory, &outputs.odometry, &outputs.map, &outputs.overview];
    session::check_outputs(all)?;
    let pacing = if args.lockstep { Pacing::LockStep } else { Pacing::RealTime };
    let uncalibrated = args.uncalibrated || config.calibration.ignore;
    let own = if args.camera.is_some() || uncalibrated { OwnCalibration::Ignore } else { OwnCalibration::Read };
    let recording = open(args, pacing, own).map_err(|e| CliError::new(exit_code::NO_INPUT, e.to_string()))?;
    let description = recording.description().clone();
    let calibration = calibration(args, &config, &description)?;

    let map_file = args.map_file.as_deref().map(|path| map_file::plan(path, args.localise)).transpose()?;
    let status = Arc::new(Status::default());
    let mut parts = Parts {
        config,
        supply: Supply::Once(recording),
        calibration,
        outlet: None,
        outputs,
        spool_folder: None,
        keep_lens: None,
        map_file,
        maps: None,
        status: status.clone(),
    };
    let (began, cpu_before_ns) = (Instant::now(), process_cpu_ns());
    let mut line = StatusLine::new(args.result.quiet);
    let mut show = |status: &Status| line.show(&progress(status, description.frames));
    let end = if args.lockstep {
        let (mut shown, mut logged) = (Instant::now(), Instant::now());
        daemon::lockstep::run(parts, &stop, &mut |status| {
            if shown.elapsed().as_millis() > 200 {
                shown = Instant::now();
                show(status);
            }
            if logged.elapsed().as_secs() >= 5 {
                logged = Instant::now();
                info!(
                    frames = status.captured.get(),
                    of = description.frames,
                    tracked = status.tracked.get(),
                    "progress"
                );
            }
            true
        })
    } else {
        // A planner can be tried against a recording; if a daemon runs, its services are left alone.
        let desk = match session::open_wire(&parts.config, description.clock, description.size) {
            Ok((outlet, desk)) => {
                parts.outlet = Some(outlet);
                Some(desk)
            }
            Err(error) => {
                warn!(%error, "nothing is published");
                None
            }
        };
        daemon::supervise(parts, desk, description.clock, &stop, &mut |tick| {
            show(tick.status);
            true
        })
    };
    line.clear();
    let end = end.map_err(|e| CliError::new(exit_code::CANNOT_CREATE, e.to_string()))?;
    let summary = Summary {
        recording: description.name,
        mode: if args.lockstep { "lock-step" } else { "real time" },
        elapsed_s: began.elapsed().as_secs_f64(),
        resources: Resources::now(status.processed.get(), cpu_before_ns),
        ..summarise(&status, &end)
    };
    session::print(&if args.result.json { session::json(&summary)? } else { text(&summary) })?;
    session::judge(&end)?;
    if status.tracked.get() == 0 {
        return Err(CliError::new(exit_code::FAILURE, "no frame was tracked"));
    }
    Ok(ExitCode::SUCCESS)
}

/// A folder with a list of pictures is that recording; any other with MCAP files in it, and every file, is one of those.
fn open(args: &ReplayArgs, pacing: Pacing, own: OwnCalibration) -> Result<Box<dyn FrameSource>, SourceError> {
    let is_list = args.dir.join("rgb.txt").exists() || args.dir.join("mav0/cam0/data.csv").exists();
    if !is_list && bag::files(&args.dir).is_some() {
        let asked = Asked { pictures: args.topic.as_deref(), wheels: args.wheel_topic.as_deref() };
        return Ok(Box::new(Bag::open(&args.dir, pacing, own, asked)?));
    }
    let asked = args.topic.iter().map(|t| ("--topic", t)).chain(args.wheel_topic.iter().map(|t| ("--wheel-topic", t)));
    if let Some((option, topic)) = asked.into_iter().next() {
        let reason = format!("{option} {topic}: only an MCAP file has topics");
        return Err(SourceError::Open { path: args.dir.display().to_string(), reason });
    }
    Ok(Box::new(Recording::open_with(&args.dir, pacing, own)?))
}

/// The camera that was named, else the recording's own.
fn calibration(args: &ReplayArgs, config: &Config, recording: &SourceDescription) -> Result<Calibration, CliError> {
    if let Some(path) = &args.camera {
        let unsaid = Unsaid { size: None, lens: config.calibration.unsaid_lens() };
        let model = load_camera_with(path, &unsaid).map_err(|e| CliError::new(exit_code::NO_INPUT, e.to_string()))?;
        return Ok(Calibration::known(model, path.display().to_string()));
    }
    match &recording.camera {
        Some(model) => {
            let file = args.dir.join("camera.yaml");
            let origin = if recording.name.ends_with(&args.dir.display().to_string()) && file.exists() {
                file.display().to_string()
            } else {
                recording.name.clone()
            };
            Ok(Calibration::known(model.clone(), origin))
        }
        None => {
            let view_deg = config.calibration.supposed_view_deg;
            // A stand-in where the first frame has still to tell the size: `Calibration::fit` makes it fit.
            let size = recording.size.unwrap_or((640, 480));
            warn!(dir = %args.dir.display(), view_deg, "no calibration (camera.yaml, CameraInfo or --camera): the lens is a guess");
            camera_calibration::guess(size, view_deg)
        }
    }
}

fn progress(status: &Status, frames: Option<u64>) -> String {
    let of = frames.map(|n| format!("/{n}")).unwrap_or_default();
    let (landmarks, keyframes) = status.map_size();
    format!(
        "frame {}{of}  {}  tracked {}  map {landmarks} landmarks, {keyframes} keyframes",
        status.captured.get(),
        state_name(status.state()),
        status.tracked.get(),
    )
}

fn summarise(status: &Status, end: &End) -> Summary {
    // Frames that could not even be read are frames of the recording, too.
    let frames = status.captured.get() + status.unreadable.get();
    Summary {
        recording: String::new(),
        mode: "",
        frames,
        tracked: status.tracked.get(),
        coverage_percent: 100.0 * status.tracked.get() as f64 / frames.max(1) as f64,
        in_trajectory: end.written.trajectory.map(|t| t.poses_written),
        other_maps: end.written.trajectory.map_or(0, |t| t.other_maps),
        in_other_maps: end.written.trajectory.map_or(0, |t| t.poses_in_other_maps),
        dropped: status.dropped.get(),
        unreadable: status.unreadable.get() + status.corrupt.get() + status.wrong_size.get(),
        bad_timestamps: status.bad_timestamps.get(),
        keyframes: status.keyframes.get(),
        landmarks: status.map_size().0,
        resets: status.resets.get(),
        relocalisations: status.relocalisations.get(),
        loops: status.loops_closed.get(),
        loops_tied: status.loops_tied.get(),
        blind_turns: status.blind_turns.get(),
        blind_s: status.blind_ns.get() as f64 * 1e-9,
        blind_m: status.blind_mm.get() as f64 * 1e-3,
        elapsed_s: 0.0,
        resources: Resources { cpu_ms_per_frame: 0.0, peak_rss_mb: 0.0 },
        intrinsics: IntrinsicsSummary::of(status),
        wheels: WheelSummary::of(status),
        stages: StageLatencies::of(status),
        files: end.written.files.clone(),
    }
}

fn text(s: &Summary) -> String {
    let mut text = format!(
        "{}, {}\n  {} frames, {} tracked at once, coverage {:.1} %\n",
        s.recording, s.mode, s.frames, s.tracked, s.coverage_percent
    );
    if let Some(poses) = s.in_trajectory {
        text +=
            &format!("  {poses} frames in the trajectory ({:.1} %)\n", 100.0 * poses as f64 / s.frames.max(1) as f64);
    }
    if s.other_maps > 0 {
        let (maps, poses) = (s.other_maps, s.in_other_maps);
        text += &format!("  {poses} frames in {maps} other maps, which were not joined to it: a file each beside it\n");
    }
    let faults = [
        (s.dropped, "dropped because processing could not keep up"),
        (s.unreadable, "unreadable or of another size, skipped"),
        (s.bad_timestamps, "with a timestamp that cannot be, dropped"),
    ];
    for (count, what) in faults.iter().filter(|(count, _)| *count > 0) {
        text += &format!("  {count} frames {what}\n");
    }
    text += &format!(
        "  {} landmarks in the map, {} keyframes made, {} resets\n  {:.1} s, CPU {:.2} ms a frame, peak memory {:.0} MB\n",
        s.landmarks, s.keyframes, s.resets, s.elapsed_s, s.resources.cpu_ms_per_frame, s.resources.peak_rss_mb
    );
    if s.loops + s.loops_tied > 0 {
        text += &format!("  {} loops closed, {} places more seen again where they should be\n", s.loops, s.loops_tied);
    }
    if s.blind_turns > 0 {
        text += &format!("  {} turns on the spot behind which the scale is an assumption\n", s.blind_turns);
    }
    if s.blind_s > 0.0 {
        text += &format!("  {:.1} s and {:.2} m by the wheels alone\n", s.blind_s, s.blind_m);
    }
    if let Some(w) = &s.wheels {
        let refused = w.absurd + w.out_of_order;
        text += &format!("  {} wheel readings, {refused} not believed, {} gaps of over 0.5 s\n", w.readings, w.gaps);
    }
    let lens = &s.intrinsics;
    if lens.knowledge != LensKnowledge::Calibrated.name() {
        let said = match lens.knowledge == LensKnowledge::Estimated.name() {
            true => "not calibrated; found from the motion",
            false => "not calibrated, and the motion did not show it: a guess",
        };
        let (f, percent) = (lens.fx_px, 100.0 * lens.focal_sigma);
        text += &format!(
            "  lens {said}: focal length {f:.1} px +- {percent:.0} %, centre {:.1} {:.1} px\n",
            lens.cx_px, lens.cy_px
        );
    }
    text += &s.stages.table();
    for file in &s.files {
        text += &format!("wrote {}\n", file.display());
    }
    text
}
