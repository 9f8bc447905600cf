//! The calibration that belongs to the camera at hand, by its identity: for `run`, `calibrate` and `doctor`.

use std::path::PathBuf;
use std::time::{SystemTime, UNIX_EPOCH};

use tracing::{info, warn};

use super::{CliError, exit_code};
use crate::calibration::store::{self, CameraIdentity, Estimate};
use crate::camera::FrameSource;
use crate::camera::v4l2::identity::identity;
use crate::camera::v4l2::{CameraInfo, Finder, V4l2Camera};
use crate::config::Config;
use crate::daemon::{Calibration, KeepLens};
use crate::reconstruction::LensPrior;

/// Who a camera is.
pub fn identify(camera: &CameraInfo) -> CameraIdentity {
    identity(&camera.path, &camera.card)
}

/// Its stored calibration for pictures of a size; unreadable files are mentioned in the log.
pub fn stored(identity: &CameraIdentity, size: (u32, u32)) -> Option<store::Found> {
    let (found, faults) = store::find(&store::search_folders(), identity, size);
    for fault in faults {
        tracing::warn!(%fault, "calibration cannot be read, skipped");
    }
    found
}

/// An open camera and what is known of its lens.
pub struct Found {
    pub camera: V4l2Camera,
    /// Finds it again when it was away.
    pub finder: Finder,
    pub calibration: Calibration,
    /// Who keeps what is learnt of a lens that nobody calibrated.
    pub keep_lens: Option<KeepLens>,
}

/// The camera at hand, open, and its stored calibration, else a guess, for a configuration that names no calibration file. The outer error
/// says why there is no camera (yet).
pub fn of_config(config: &Config) -> Result<Result<Found, CliError>, String> {
    let mut finder = Finder::new(config.camera.clone());
    let camera = finder.open().map_err(|e| e.to_string())?;
    let identity = camera.identity();
    // A calibration belongs to what the camera sends, which is not always what it is asked for.
    let size = camera.description().size.unwrap_or((config.camera.width_px, config.camera.height_px));
    if !config.calibration.ignore
        && let Some(found) = stored(&identity, size)
    {
        let origin = found.path.display().to_string();
        info!(camera = %identity, calibration = origin, scaled_from = ?found.scaled_from, "stored calibration used");
        let calibration = Calibration::known(found.camera, origin);
        return Ok(Ok(Found { camera, finder, calibration, keep_lens: None }));
    }
    let how = format!("cairn calibrate --camera {}", camera.path().display());
    warn!(camera = %identity, how, "no calibration of this camera; it can be made in a minute");
    let guess = uncalibrated(config, &store::state_folders(), Some(identity), size);
    Ok(guess.map(|(calibration, keep_lens)| Found { camera, finder, calibration, keep_lens }))
}

/// Without a calibration: what was kept of the camera's last run, else a supposed angle of view; and who keeps this run's.
pub fn uncalibrated(
    config: &Config,
    folders: &[PathBuf],
    identity: Option<CameraIdentity>,
    size: (u32, u32),
) -> Result<(Calibration, Option<KeepLens>), CliError> {
    let view_deg = config.calibration.supposed_view_deg;
    let Some(keep) = identity.filter(|_| config.calibration.keep_estimate) else {
        return Ok((guess(size, view_deg)?, None));
    };
    let calibration = match store::find_estimate(folders, &keep, size) {
        Some((kept, path)) => {
            info!(camera = %keep, path = %path.display(), fx_px = kept.camera.fx, sigma = kept.focal_sigma, "lens of the last run");
            let centre = kept.centre_sigma_px / f64::from(size.0);
            let prior = LensPrior::kept(kept.focal_sigma, centre);
            Calibration { model: kept.camera, origin: path.display().to_string(), prior }
        }
        None => guess(size, view_deg)?,
    };
    let folders = folders.to_vec();
    let keeper: KeepLens = Box::new(move |lens| {
        let [x, y] = lens.centre_sigma_px;
        let (camera, focal_sigma) = (lens.camera.clone(), lens.focal_sigma);
        let estimate = Estimate { camera, focal_sigma, centre_sigma_px: x.max(y) };
        let unix_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
        store::save_estimate(&folders, &keep, &estimate, unix_s)
            .map(|path| path.display().to_string())
            .map_err(|e| e.to_string())
    });
    Ok((calibration, Some(keeper)))
}

/// A lens of which nothing is known.
pub fn guess(size: (u32, u32), view_deg: f64) -> Result<Calibration, CliError> {
    Calibration::guessed(size, view_deg).ok_or_else(|| {
        let message = format!("no camera has {} degrees across {}x{} px", view_deg, size.0, size.1);
        CliError::new(exit_code::CONFIG, message)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::CameraModel;
    use crate::reconstruction::{LensEstimate, LensKnowledge};

    #[test]
    fn the_next_start_begins_with_what_the_last_run_found() {
        let dir = tempfile::tempdir().expect("folder");
        let folders = [dir.path().to_path_buf()];
        let (config, me) = (Config::default(), CameraIdentity::parse("046d:0825:ABC"));
        let start = |config: &Config| uncalibrated(config, &folders, me.clone(), (640, 480)).expect("a start");
        let (first, keeper) = start(&config);
        assert_eq!(first.prior, LensPrior::UNKNOWN);
        assert!((first.model.fx - 320.0 / 30f64.to_radians().tan()).abs() < 1e-9, "60 degrees");
        let camera = CameraModel::new(640, 480, 420.0, 420.0, 322.0, 236.0, [-0.1, 0.0, 0.0, 0.0, 0.0]).expect("valid");
        let knowledge = LensKnowledge::Estimated;
        let found = LensEstimate { knowledge, camera: camera.clone(), focal_sigma: 0.045, centre_sigma_px: [5.0, 6.4] };
        keeper.expect("somebody who keeps")(&found).expect("kept");
        let (next, _) = start(&config);
        assert_eq!((next.model, next.prior), (camera, LensPrior::kept(0.045, 0.01)));
        let mut config = config;
        config.calibration.keep_estimate = false;
        assert_eq!(start(&config).0.prior, LensPrior::UNKNOWN, "asked to forget");
    }
}
