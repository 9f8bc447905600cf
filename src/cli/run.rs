//! `cairn run`: the daemon.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use super::reload::Reloader;
use super::session::{self, SessionArgs};
use super::{CliError, camera_calibration, exit_code};
use crate::calibration::load_camera;
use crate::camera::simulator::Simulator;
use crate::camera::v4l2::V4l2Camera;
use crate::camera::{FrameSource, Pacing};
use crate::config::{Config, SourceKind};
use crate::daemon::{self, Calibration, KeepLens, Opener, Outputs, Parts, Status, Supply};
use crate::frame::Clock;

/// Runs the daemon until SIGTERM or SIGINT; SIGHUP reads the configuration again
#[derive(Debug, clap::Args)]
pub struct RunArgs {
    #[command(flatten)]
    pub session: SessionArgs,
}

pub fn run(args: &RunArgs) -> Result<ExitCode, CliError> {
    let config = args.session.open(false)?;
    let mut reloader = Reloader::new(&args.session, &config)?;
    let stop = session::stop_flag()?;
    let outputs = outputs(&config);
    session::check_outputs([&outputs.trajectory, &outputs.live_trajectory, &outputs.map, &outputs.overview])?;
    let Source { supply, calibration, keep_lens, size } = source(&config)?;
    let (outlet, desk) =
        session::open_wire(&config, Clock::Monotonic, Some(size)).map_err(|e| session::wire_error(&e))?;
    let parts = Parts {
        supply,
        calibration,
        outlet: Some(outlet),
        outputs,
        spool_folder: Some(spool_folder()),
        keep_lens,
        status: Arc::new(Status::default()),
        config,
    };
    let end = daemon::supervise(parts, Some(desk), Clock::Monotonic, &stop, &mut |_| {
        reloader.turn();
        true
    })
    .map_err(|e| CliError::new(exit_code::CANNOT_CREATE, e.to_string()))?;
    session::judge(&end)?;
    Ok(ExitCode::SUCCESS)
}

/// Where frames come from.
struct Source {
    supply: Supply,
    /// The camera model that belongs to it.
    calibration: Calibration,
    keep_lens: Option<KeepLens>,
    /// The size of picture that is expected.
    size: (u32, u32),
}

fn source(config: &Config) -> Result<Source, CliError> {
    let ignore = config.calibration.ignore;
    match config.daemon.source {
        SourceKind::Simulator => {
            let simulator = Simulator::new(&config.simulator, Pacing::RealTime)
                .map_err(|e| CliError::new(exit_code::CONFIG, e.to_string()))?;
            let size = (config.simulator.width, config.simulator.height);
            let calibration = if ignore {
                camera_calibration::guess(size, config.calibration.supposed_view_deg)?
            } else {
                Calibration::known(simulator.camera_model().clone(), simulator.description().name.clone())
            };
            Ok(Source { supply: Supply::Once(Box::new(simulator)), calibration, keep_lens: None, size })
        }
        SourceKind::Camera => {
            let path = &config.calibration.file;
            let (calibration, keep_lens) = if path.as_os_str().is_empty() || ignore {
                camera_calibration::of_config(config)?
            } else {
                let model = load_camera(path).map_err(|e| CliError::new(exit_code::CONFIG, e.to_string()))?;
                (Calibration::known(model, path.display().to_string()), None)
            };
            let camera = config.camera.clone();
            let open: Opener =
                Box::new(move || V4l2Camera::open(&camera).map(|camera| Box::new(camera) as Box<dyn FrameSource>));
            let longest_pause = Duration::from_millis(config.daemon.camera_retry_ms);
            let size = (config.camera.width_px, config.camera.height_px);
            Ok(Source { supply: Supply::Camera { open, longest_pause }, calibration, keep_lens, size })
        }
    }
}

/// The configured files; an empty path is none.
fn outputs(config: &Config) -> Outputs {
    let named = |path: &Path| (!path.as_os_str().is_empty()).then(|| path.to_path_buf());
    let o = &config.output;
    Outputs {
        trajectory: named(&o.trajectory),
        live_trajectory: named(&o.live_trajectory),
        map: named(&o.map),
        overview: named(&o.overview),
    }
}

/// Where the trajectory is spooled that a command may ask for: the service's state folder, else one that survives in
/// size and is not memory.
fn spool_folder() -> PathBuf {
    std::env::var_os("STATE_DIRECTORY").map_or_else(|| PathBuf::from("/var/tmp"), PathBuf::from)
}
