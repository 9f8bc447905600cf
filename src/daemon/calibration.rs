//! The camera model that reconstruction begins with, for whatever size the pictures have.

use tracing::warn;

use crate::geometry::CameraModel;
use crate::reconstruction::{LensPrior, guessed_camera};

/// A camera model and where it came from, for messages.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    pub model: CameraModel,
    pub origin: String,
    /// How well it is known.
    pub prior: LensPrior,
}

impl Calibration {
    /// Of somebody who measured it or says so.
    pub fn known(model: CameraModel, origin: String) -> Self {
        Self { model, origin, prior: LensPrior::Calibrated }
    }

    /// Nobody knows: an angle of view, degrees, to begin with.
    pub fn guessed((width, height): (u32, u32), view_deg: f64) -> Option<Self> {
        let model = guessed_camera(width, height, view_deg)?;
        Some(Self { model, origin: format!("none: {view_deg} degrees are supposed"), prior: LensPrior::UNKNOWN })
    }

    /// The model for pictures of this size: the same, or scaled if only the resolution differs.
    pub fn fit(&self, width: u32, height: u32) -> Result<CameraModel, String> {
        let (from_width, from_height) = (self.model.width, self.model.height);
        if (from_width, from_height) == (width, height) {
            return Ok(self.model.clone());
        }
        if self.prior == LensPrior::UNKNOWN {
            let longer = f64::from(from_width.max(from_height));
            let view_deg = 2.0 * (0.5 * longer / self.model.fx).atan().to_degrees();
            return guessed_camera(width, height, view_deg).ok_or_else(|| format!("no camera has {width}x{height} px"));
        }
        let scaled = self.model.scaled(width, height).map_err(|e| {
            format!(
                "{}: the calibration is for {from_width}x{from_height} px, the pictures have {width}x{height} px: {e}",
                self.origin
            )
        })?;
        warn!(from_width, from_height, width, height, "calibration scaled to the size of the pictures");
        Ok(scaled)
    }
}
