//! `cairn run`: the daemon.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use super::reload::Reloader;
use super::session::{self, SessionArgs};
use super::{CliError, camera_calibration, exit_code, map_file};
use crate::atomic_file::remove_stale;
use crate::calibration::{Unsaid, load_camera_with};
use crate::camera::FrameSource;
use crate::camera::v4l2::Finder;
use crate::config::{Config, MapChoice, SourceKind};
use crate::daemon::{self, Calibration, Desk, KeepLens, Opener, Outputs, Parts, Status, Supply};
use crate::frame::Clock;

/// Run the daemon until SIGTERM or SIGINT; SIGHUP reads the configuration again
#[derive(Debug, clap::Args)]
pub struct RunArgs {
    #[command(flatten)]
    pub session: SessionArgs,
}

pub fn run(args: &RunArgs) -> Result<ExitCode, CliError> {
    let config = args.session.open()?;
    let mut reloader = Reloader::new(&args.session, &config)?;
    let stop = session::stop_flag()?;
    let outputs = outputs(&config);
    clear_state_folder();
    session::check_outputs([&outputs.trajectory, &outputs.live_trajectory, &outputs.map, &outputs.overview])?;
    let prepared = prepare(&config)?;
    let maps = map_file::folder(&config.map);
    let named = match config.map.choice() {
        MapChoice::Named(file) => Some(map_file::plan(file, config.map.localise)?),
        MapChoice::Auto | MapChoice::Off => None,
    };
    let (outlet, mut desk) =
        session::open_wire(&config, Clock::Monotonic, Some(prepared.size)).map_err(|e| session::wire_error(&e))?;
    let Some(Source { supply, calibration, keep_lens, camera }) =
        prepared.source(&config, &mut desk, &stop, &mut reloader)?
    else {
        return Ok(ExitCode::SUCCESS);
    };
    let own = |camera: String| map_file::own(maps.as_ref(), &camera, &calibration);
    let is_auto = config.map.choice() == MapChoice::Auto;
    let map_file = named.or_else(|| camera.filter(|_| is_auto).and_then(own));
    let parts = Parts {
        supply,
        calibration,
        outlet: Some(outlet),
        outputs,
        spool_folder: Some(spool_folder()),
        keep_lens,
        map_file,
        maps,
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
    /// Who it is, for its map; `None`: it is simulated.
    camera: Option<String>,
}

/// What can be said before the services are open; a configuration that cannot work fails here.
struct Prepared {
    /// Open already, if it is no camera.
    source: Option<Box<dyn FrameSource>>,
    /// Without one it is the camera's identity that tells it.
    calibration: Option<Calibration>,
    /// Size of picture that is expected.
    size: (u32, u32),
}

fn prepare(config: &Config) -> Result<Prepared, CliError> {
    match config.daemon.source {
        SourceKind::Simulator => simulated(config),
        SourceKind::Camera => {
            let path = &config.calibration.file;
            let unsaid = Unsaid { size: None, lens: config.calibration.unsaid_lens() };
            let load = || load_camera_with(path, &unsaid).map_err(|e| CliError::new(exit_code::CONFIG, e.to_string()));
            let named = !path.as_os_str().is_empty() && !config.calibration.ignore;
            let model = if named { Some(load()?) } else { None };
            let calibration = model.map(|model| Calibration::known(model, path.display().to_string()));
            Ok(Prepared { source: None, calibration, size: (config.camera.width_px, config.camera.height_px) })
        }
    }
}

#[cfg(feature = "tools")]
fn simulated(config: &Config) -> Result<Prepared, CliError> {
    use crate::camera::{Pacing, simulator::Simulator};
    let simulator = Simulator::new(&config.simulator, Pacing::RealTime)
        .map_err(|e| CliError::new(exit_code::CONFIG, e.to_string()))?;
    let size = (config.simulator.width, config.simulator.height);
    let calibration = if config.calibration.ignore {
        camera_calibration::guess(size, config.calibration.supposed_view_deg)?
    } else {
        Calibration::known(simulator.camera_model().clone(), simulator.description().name.clone())
    };
    Ok(Prepared { source: Some(Box::new(simulator)), calibration: Some(calibration), size })
}

/// The configuration has refused it already.
#[cfg(not(feature = "tools"))]
fn simulated(_: &Config) -> Result<Prepared, CliError> {
    Err(CliError::new(exit_code::CONFIG, super::builds::not_in_this_build("the simulator")))
}

impl Prepared {
    /// The configured source and the camera model that belongs to it. Waits for the camera if only that tells the calibration;
    /// `None`: told to stop before it came.
    fn source(
        self,
        config: &Config,
        desk: &mut Desk,
        stop: &AtomicBool,
        reloader: &mut Reloader,
    ) -> Result<Option<Source>, CliError> {
        let longest_pause = Duration::from_millis(config.daemon.camera_retry_ms);
        // Where a calibration is named the camera is whichever it belongs to.
        let mut camera = config.calibration.file.file_stem().map(|stem| stem.to_string_lossy().into_owned());
        let (calibration, keep_lens, mut first, mut finder) = match (self.calibration, self.source) {
            (Some(calibration), Some(source)) => {
                let supply = Supply::Once(source);
                return Ok(Some(Source { supply, calibration, keep_lens: None, camera: None }));
            }
            (Some(calibration), None) => (calibration, None, None, Finder::new(config.camera.clone())),
            (None, _) => {
                let sought = config.clone();
                let find = move || camera_calibration::of_config(&sought);
                let found = daemon::await_camera(desk, stop, longest_pause, find, &mut || reloader.turn())
                    .map_err(|e| CliError::new(exit_code::FAILURE, e.to_string()))?;
                let Some(found) = found else { return Ok(None) };
                let found = found?;
                camera = Some(found.camera.identity().to_string());
                (found.calibration, found.keep_lens, Some(found.camera), found.finder)
            }
        };
        let boxed = |camera| Box::new(camera) as Box<dyn FrameSource>;
        // The camera that was found is open already, lest another program takes it.
        let open: Opener = Box::new(move || first.take().map_or_else(|| finder.open(), Ok).map(boxed));
        Ok(Some(Source { supply: Supply::Camera { open, longest_pause }, calibration, keep_lens, camera }))
    }
}

/// The configured files; an empty path is none.
fn outputs(config: &Config) -> Outputs {
    let named = |path: &Path| (!path.as_os_str().is_empty()).then(|| path.to_path_buf());
    let o = &config.output;
    Outputs {
        trajectory: named(&o.trajectory),
        live_trajectory: named(&o.live_trajectory),
        odometry: None,
        map: named(&o.map),
        overview: named(&o.overview),
    }
}

/// What a save left that a power cut or `kill -9` cut off; in the service's own folder only.
fn clear_state_folder() {
    let Some(state) = std::env::var_os("STATE_DIRECTORY").filter(|folder| !folder.is_empty()).map(PathBuf::from) else {
        return;
    };
    for folder in [state.join("cameras"), state] {
        for path in remove_stale(&folder) {
            tracing::info!(path = %path.display(), "unfinished file of an earlier run removed");
        }
    }
}

/// Where the trajectory is spooled that a command may ask for: the service's state folder, else one that survives in
/// size and is not memory.
fn spool_folder() -> PathBuf {
    std::env::var_os("STATE_DIRECTORY").map_or_else(|| PathBuf::from("/var/tmp"), PathBuf::from)
}
