//! The map file of a run: `--map-file FILE`, `[map] file`, and what its faults mean to a script.
//!
//! A file that somebody names is used or refused. The camera's own (`auto`) is a convenience, which must not keep a robot from starting: where
//! it cannot be used the run goes on without, says so, and leaves it as it is. Its name holds the camera and a checksum of the
//! calibration, as a map belongs to both: a camera that is calibrated anew begins another one.

use std::path::{Path, PathBuf};

use tracing::{info, warn};

use super::{CliError, exit_code, session};
use crate::calibration::store;
use crate::config::MapConfig;
use crate::daemon::{Calibration, MapFolder, MapPlan};
use crate::places::store::{Contents, Fault, MapFile, StoreError, read_to_locate};
use crate::reconstruction::LensPrior;

/// Opens or, where it is missing, plans the file. Nothing in it changes before the first frame.
pub fn plan(path: &Path, localise_only: bool) -> Result<MapPlan, CliError> {
    let exists =
        path.try_exists().map_err(|e| CliError::new(exit_code::NO_INPUT, format!("{}: {e}", path.display())))?;
    let plan = MapPlan { path: path.into(), file: None, saved: None, edition: None, localise_only, may_fail: false };
    if localise_only {
        if !exists {
            let message = format!("{}: there is no such file, and `--localise` needs a map", path.display());
            return Err(CliError::new(exit_code::NO_INPUT, message));
        }
        let Contents { saved, edition, .. } = read_to_locate(path).map_err(|e| error(&e))?;
        if saved.maps.is_empty() {
            let message = format!("{}: there is no map in it to be located in", path.display());
            return Err(CliError::new(exit_code::DATA, message));
        }
        return Ok(MapPlan { saved: Some(saved), edition: Some(edition), ..plan });
    }
    if !exists {
        session::check_outputs([&Some(path.to_path_buf())])?;
        return Ok(plan);
    }
    let (file, Contents { saved, edition, .. }) = MapFile::open(path).map_err(|e| error(&e))?;
    Ok(MapPlan { file: Some(file), saved: Some(saved), edition: Some(edition), ..plan })
}

/// Where commands find maps by name.
pub fn folder(config: &MapConfig) -> Option<MapFolder> {
    if !config.directory.as_os_str().is_empty() {
        // Names of files are compared, so one folder has one name.
        return std::path::absolute(&config.directory).ok().map(MapFolder::new);
    }
    let state = store::state_folders().into_iter().next()?;
    Some(MapFolder::new(state.parent()?.join("maps")))
}

/// The camera's own map; `None`: there is nothing that could be used, and the log says why.
pub fn own(folder: Option<&MapFolder>, camera: &str, calibration: &Calibration) -> Option<MapPlan> {
    let Some(folder) = folder else {
        warn!(reason = "there is no state directory", "no map file, the map ends with this run");
        return None;
    };
    let open = || {
        std::fs::create_dir_all(folder.path()).map_err(|e| format!("{}: {e}", folder.path().display()))?;
        let path = own_path(folder, camera, calibration)?;
        plan(&path, false).map_err(|e| e.message)
    };
    match open() {
        Ok(plan) => {
            info!(path = %plan.path.display(), exists = plan.saved.is_some(), "map of this camera");
            Some(MapPlan { may_fail: true, ..plan })
        }
        Err(reason) => {
            warn!(reason, "no map file, the map ends with this run");
            None
        }
    }
}

/// `CAMERA-CALIBRATION.map`; of a lens that nobody calibrated the size of the pictures stands for the calibration.
fn own_path(folder: &MapFolder, camera: &str, calibration: &Calibration) -> Result<PathBuf, String> {
    let keep = |c: char| if c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.') { c } else { '_' };
    let camera: String =
        camera.trim_start_matches(|c: char| !c.is_ascii_alphanumeric()).chars().take(40).map(keep).collect();
    let camera = if camera.is_empty() { "camera" } else { &camera };
    let model = &calibration.model;
    let lens = if calibration.prior == LensPrior::Calibrated {
        let values = [model.fx, model.fy, model.cx, model.cy];
        let mut sum = crc32fast::Hasher::new();
        for value in values.iter().chain(model.lens.coefficients()) {
            sum.update(&value.to_le_bytes());
        }
        sum.update(model.lens.name().as_bytes());
        format!("{:08x}", sum.finalize())
    } else {
        "uncalibrated".into()
    };
    folder.file(&format!("{camera}-{}x{}-{lens}", model.width, model.height))
}

/// A map file that cannot be used.
pub fn error(error: &StoreError) -> CliError {
    let code = match &error.fault {
        fault if fault.is_in_the_data() => exit_code::BROKEN_MAP,
        Fault::Busy => exit_code::UNAVAILABLE,
        Fault::Read(_) => exit_code::NO_INPUT,
        _ => exit_code::CANNOT_CREATE,
    };
    CliError::new(code, error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::CameraModel;

    #[test]
    fn a_camera_and_its_calibration_have_a_map_of_their_own() {
        let dir = tempfile::tempdir().expect("folder");
        let folder = MapFolder::new(dir.path().join("state/maps"));
        let camera =
            |fx: f64| CameraModel::new(320, 240, fx, 300.0, 159.5, 119.5, [0.1, 0.0, 0.0, 0.0, 0.0]).expect("camera");
        let known = |fx: f64| Calibration::known(camera(fx), "a test".into());
        let path = |camera: &str, calibration: &Calibration| own_path(&folder, camera, calibration).expect("a name");
        let first = path("046d:0825:A/B", &known(300.0));
        let name = first.file_name().expect("name").to_string_lossy();
        assert!(name.starts_with("046d_0825_A_B-320x240-") && first.starts_with(folder.path()), "{name}");
        assert_ne!(first, path("046d:0825:A/B", &known(301.0)));
        assert_ne!(first, path("046d:0825:C", &known(300.0)));
        let guessed = |fx: f64| Calibration { prior: LensPrior::UNKNOWN, ..known(fx) };
        assert_eq!(path("../x", &guessed(1.0)), path("../x", &guessed(2.0)), "what is guessed differs every time");

        let plan = own(Some(&folder), "a", &known(300.0)).expect("a plan");
        assert!(plan.may_fail && plan.file.is_none() && folder.path().is_dir());
        std::fs::write(&plan.path, "something else").expect("written");
        assert!(own(Some(&folder), "a", &known(300.0)).is_none(), "broken, and no reason not to start");
        assert_eq!(std::fs::read(&plan.path).expect("read"), b"something else");
        assert!(own(None, "a", &known(300.0)).is_none());
    }
}
