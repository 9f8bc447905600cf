//! Calibration with a camera, guided.
//!
//! Frames come by the same door as the daemon's ([`FrameSource`]); what to do with each is [`Guide`]'s. It ends by itself, at the time that
//! was given, or at Ctrl-C, and then keeps what there is if that is a calibration at all.

use std::process::ExitCode;
use std::sync::atomic::Ordering;
use std::time::Duration;

use super::args::CalibrateArgs;
#[cfg(feature = "tools")]
use super::output::report_folder;
use super::output::save;
#[cfg(feature = "tools")]
use super::report;
use crate::calibration::chessboard::Pattern;
use crate::calibration::guide::{Guide, Seen};
use crate::calibration::store::CameraIdentity;
use crate::camera::v4l2::V4l2Camera;
use crate::camera::{FrameSource, Grab, SourceError};
use crate::cli::session::{self, StatusLine};
use crate::cli::{CliError, exit_code};
use crate::config::Config;
use crate::frame::{RawFrame, monotonic_ns};
use crate::image::GreyImage;
use crate::image::decode::Decoder;

/// Longest wait for a frame: how late Ctrl-C is seen.
const TURN: Duration = Duration::from_millis(100);
/// Speed of the simulated sweep against its own: somebody who holds a board does not wave it.
#[cfg(feature = "tools")]
const SWEEP_SPEED: f64 = 0.1;
/// Without a single frame for so long the camera is given up, s.
const SILENCE_S: i64 = 10;

pub fn run(args: &CalibrateArgs, pattern: &Pattern) -> Result<ExitCode, CliError> {
    let mut config = args.session.open_for_result(args.quiet)?;
    session::check_outputs([&args.output])?;
    let stop = session::stop_flag()?;
    let (mut source, identity) = open(args, pattern, &mut config)?;
    if identity.is_none() && args.output.is_none() {
        return Err(CliError::new(exit_code::USAGE, "--output is needed: the simulator has no identity to keep it by"));
    }
    let mut line = StatusLine::new(args.quiet);
    let name = &source.description().name;
    line.note(&format!("{name}: show a board of {}x{} inner corners", pattern.columns, pattern.rows));
    let mut guide = Guide::new(*pattern, args.distortion.into());
    let (mut slot, mut picture, mut decoder) = (RawFrame::default(), GreyImage::default(), Decoder::default());
    let begin_ns = monotonic_ns();
    let limit_ns = i64::try_from(args.seconds).unwrap_or(300) * 1_000_000_000;
    let (mut last_frame_ns, mut first_stamp) = (begin_ns, None);
    let why = loop {
        if stop.load(Ordering::Relaxed) {
            break "stopped";
        }
        if guide.is_done() {
            break "done";
        }
        let now = monotonic_ns();
        if now - begin_ns > limit_ns {
            break "the time is over";
        }
        match source.grab(&mut slot, TURN) {
            Ok(Grab::Frame) => {}
            Ok(Grab::End) => break "the source has ended",
            Ok(Grab::TimedOut | Grab::Skipped { .. }) => {
                if now - last_frame_ns > SILENCE_S * 1_000_000_000 {
                    let message = format!("{}: no picture for {SILENCE_S} s", source.description().name);
                    return Err(CliError::new(exit_code::UNAVAILABLE, message));
                }
                continue;
            }
            Err(error) => return Err(unavailable(&error)),
        }
        last_frame_ns = now;
        // A recording's or a lock-step simulator's time counts as well, so that this ends.
        let first = *first_stamp.get_or_insert(slot.timestamp_ns);
        if slot.timestamp_ns - first > limit_ns {
            break "the time is over";
        }
        if decoder.decode(&slot, &mut picture).is_err() {
            continue;
        }
        let seen = guide.step(&picture, slot.timestamp_ns);
        let text = format!("{}; {}", guide.progress(), guide.advice(seen));
        if seen == Seen::Taken {
            line.note(&text);
        } else {
            line.show(&text);
        }
    };
    line.note(&format!("{why} after {} views", guide.views().len()));
    line.clear();
    let Some(calibrated) = guide.solution() else {
        let message = format!(
            "{why}: {} views are too few to calibrate from; {}",
            guide.views().len(),
            guide.advice(Seen::NoBoard)
        );
        return Err(CliError::new(exit_code::DATA, message));
    };
    session::print(&format!("{}{}", calibrated.table(), calibrated.words()))?;
    save(args, calibrated, identity.as_ref())?;
    #[cfg(feature = "tools")]
    if let Some(folder) = report_folder(args) {
        let views = guide.board_views();
        let size = (calibrated.camera.width, calibrated.camera.height);
        let picture_of =
            |n: usize, out: &mut GreyImage| guide.views().get(n).map(|v| out.clone_from(&v.picture)).is_some();
        let files = report::write(&folder, &views, calibrated, size, picture_of)?;
        session::print(&format!("wrote {files} pictures in {}\n", folder.display()))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn unavailable(error: &SourceError) -> CliError {
    CliError::new(exit_code::UNAVAILABLE, format!("{error}; `cairn doctor` says more"))
}

/// The source that was asked for, and who it is.
fn open(
    args: &CalibrateArgs,
    pattern: &Pattern,
    config: &mut Config,
) -> Result<(Box<dyn FrameSource>, Option<CameraIdentity>), CliError> {
    let name = args.camera.as_deref().unwrap_or("auto");
    if name == "simulator" {
        return Ok((simulated(args, pattern, config)?, None));
    }
    if name != "auto" {
        config.camera.device = name.into();
    }
    let source = V4l2Camera::open(&config.camera).map_err(|e| unavailable(&e))?;
    let identity = source.identity();
    Ok((Box::new(source), Some(identity)))
}

/// The simulator moves before its chessboard, as slowly as somebody does who holds one.
#[cfg(feature = "tools")]
pub fn before_board(config: &mut crate::camera::simulator::SimulatorConfig) {
    config.scenario = crate::camera::simulator::Scenario::CalibrationSweep;
    config.speed = (config.speed * SWEEP_SPEED).max(0.1);
    config.chessboard.enabled = true;
}

/// The simulator, moving before a board of this pattern.
#[cfg(feature = "tools")]
fn simulated(args: &CalibrateArgs, pattern: &Pattern, config: &mut Config) -> Result<Box<dyn FrameSource>, CliError> {
    use crate::camera::Pacing;
    use crate::camera::simulator::Simulator;
    let simulated = &mut config.simulator;
    before_board(simulated);
    (simulated.chessboard.columns, simulated.chessboard.rows) = (pattern.columns, pattern.rows);
    simulated.chessboard.square_m = pattern.square_m;
    let pacing = if args.lockstep { Pacing::LockStep } else { Pacing::RealTime };
    let simulator = Simulator::new(simulated, pacing).map_err(|e| CliError::new(exit_code::USAGE, e.to_string()))?;
    Ok(Box::new(simulator))
}

#[cfg(not(feature = "tools"))]
fn simulated(_: &CalibrateArgs, _: &Pattern, _: &Config) -> Result<Box<dyn FrameSource>, CliError> {
    Err(CliError::new(exit_code::USAGE, crate::cli::builds::not_in_this_build("the simulator")))
}
