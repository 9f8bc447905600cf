//! The calibration that belongs to the camera at hand, by its identity: for `run` and `doctor`.

use std::path::Path;

use super::{CliError, exit_code};
use crate::calibration::store::{self, CameraIdentity, Found};
use crate::camera::v4l2::identity::identity;
use crate::camera::v4l2::{CameraInfo, V4l2Config, list_cameras};
use crate::geometry::CameraModel;

/// Who a camera is.
pub fn identify(camera: &CameraInfo) -> CameraIdentity {
    identity(&camera.path, &camera.card)
}

/// The camera that a configuration means: the one it names, or the first that sends something usable.
pub fn configured(config: &V4l2Config) -> Result<CameraInfo, String> {
    let wanted = std::fs::canonicalize(&config.device);
    let mut reasons = Vec::new();
    for camera in list_cameras() {
        match camera {
            Ok(camera) if config.device == "auto" && camera.offers.is_empty() => {}
            Ok(camera) if config.device == "auto" => return Ok(camera),
            Ok(camera) => {
                if wanted.as_deref().is_ok_and(|w| w == camera.path) || Path::new(&config.device) == camera.path {
                    return Ok(camera);
                }
            }
            Err(error) => reasons.push(error.to_string()),
        }
    }
    let why = if reasons.is_empty() { String::new() } else { format!(" ({})", reasons.join("; ")) };
    Err(match config.device.as_str() {
        "auto" => format!("there is no camera{why}"),
        device => format!("{device} is no camera{why}"),
    })
}

/// Its stored calibration for pictures of a size; unreadable files are mentioned in the log.
pub fn stored(identity: &CameraIdentity, size: (u32, u32)) -> Option<Found> {
    let (found, faults) = store::find(&store::search_folders(), identity, size);
    for fault in faults {
        tracing::warn!(%fault, "calibration cannot be read, skipped");
    }
    found
}

/// A camera whose calibration is stored.
pub struct Calibrated {
    pub identity: CameraIdentity,
    pub model: CameraModel,
    /// For messages.
    pub origin: String,
}

/// The camera at hand and its stored calibration, for a configuration that names no calibration file. The outer error says why
/// there is no camera (yet), the inner one that it has no calibration.
pub fn of_config(config: &V4l2Config) -> Result<Result<Calibrated, CliError>, String> {
    let camera = configured(config)?;
    let identity = identify(&camera);
    Ok(match stored(&identity, (config.width_px, config.height_px)) {
        Some(found) => {
            let origin = found.path.display().to_string();
            tracing::info!(camera = %identity, calibration = origin, scaled_from = ?found.scaled_from, "stored calibration used");
            Ok(Calibrated { identity, model: found.camera, origin })
        }
        None => Err(CliError::new(
            exit_code::CONFIG,
            format!(
                "calibration.file is not set and there is no stored calibration of camera {identity} ({}): \
                 `cairn calibrate --camera {}` makes one in a minute",
                camera.card,
                camera.path.display()
            ),
        )),
    })
}
