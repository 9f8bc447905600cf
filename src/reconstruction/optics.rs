//! The camera as it is believed now: lens, shutter and how exactly its pictures show places, which adjustments refine.

use super::adjust::intrinsics::{Intrinsics, LensPrior};
use super::config::ReconstructionConfig;
use super::measurement::noise::PlaceNoise;
use super::measurement::rolling_shutter::Shutter;
use crate::geometry::CameraModel;
use crate::map::saved::SavedOptics;

#[derive(Debug)]
pub struct Optics {
    /// As it was given.
    pub calibration: CameraModel,
    /// As it is believed now.
    pub camera: CameraModel,
    pub intrinsics: Intrinsics,
    pub shutter: Shutter,
    pub noise: PlaceNoise,
}

impl Optics {
    pub fn new(camera: &CameraModel, prior: LensPrior, config: &ReconstructionConfig) -> Self {
        Self {
            calibration: camera.clone(),
            camera: camera.clone(),
            intrinsics: Intrinsics::new(camera, prior),
            shutter: Shutter::new(config.readout_ms * 1e-3, camera.height, config.estimate_readout),
            noise: PlaceNoise::default(),
        }
    }

    /// For another run.
    pub fn saved(&self) -> SavedOptics {
        let (readout_s, readout_information) = self.shutter.saved();
        SavedOptics {
            calibration: self.calibration.clone(),
            readout_s,
            readout_information,
            ..self.intrinsics.saved(&self.camera)
        }
    }

    /// Goes on from what another run knew of the same camera.
    pub fn resume(&mut self, saved: &SavedOptics) {
        self.calibration = saved.calibration.clone();
        self.camera = saved.camera.clone();
        self.intrinsics.resume(saved);
        self.shutter.resume(saved.readout_s, saved.readout_information);
    }
}
