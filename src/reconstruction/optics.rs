//! The camera as it is believed now: lens and shutter, which adjustments refine.

use super::adjust::intrinsics::{Intrinsics, LensPrior};
use super::config::ReconstructionConfig;
use super::measurement::rolling_shutter::Shutter;
use crate::geometry::CameraModel;

#[derive(Debug)]
pub struct Optics {
    pub camera: CameraModel,
    pub intrinsics: Intrinsics,
    pub shutter: Shutter,
}

impl Optics {
    pub fn new(camera: &CameraModel, prior: LensPrior, config: &ReconstructionConfig) -> Self {
        Self {
            camera: camera.clone(),
            intrinsics: Intrinsics::new(camera, prior),
            shutter: Shutter::new(config.readout_ms * 1e-3, camera.height, config.estimate_readout),
        }
    }
}
