//! The focal length, refined from the motion itself.
//!
//! A calibration is never exact, and a nominal one (equal focal lengths, principal point in the middle, no distortion) is
//! a guess: a focal length that is 3 % off bends the map. When the whole map is adjusted, the logarithm of the focal length is
//! one more unknown, with a prior around the calibrated value. The adjustment's own information is far too sure of itself
//! (neighbouring keyframes share the errors of their templates), so it counts only in part. Not here: principal
//! point, distortion.

use super::bundle::SharedVector;
use super::local_adjustment::{MappingJob, MappingResult};
use crate::geometry::CameraModel;
use crate::map::Map;

/// Standard deviation of a measured focal length, and of a nominal one, as a share of it.
const CALIBRATED_SIGMA: f64 = 0.002;
const NOMINAL_SIGMA: f64 = 0.05;
/// Share of the adjustment's information that is believed.
const BELIEVED: f64 = 0.05;
/// Levenberg-Marquardt steps of each pass.
const STEPS: usize = 6;

/// What is known about the focal length.
#[derive(Debug, Clone)]
pub struct Focal {
    /// fx of the calibration, px.
    calibrated_px: f64,
    /// Standard deviation of its logarithm.
    sigma: f64,
    /// The same with what the map says.
    pub refined_sigma: f64,
}

impl Focal {
    pub fn new(camera: &CameraModel) -> Self {
        let sigma = if is_nominal(camera) { NOMINAL_SIGMA } else { CALIBRATED_SIGMA };
        Self { calibrated_px: camera.fx, sigma, refined_sigma: sigma }
    }

    /// Adjustment of the whole map and the focal length.
    pub fn whole_job(&self, map: &Map, camera: &CameraModel, readout_s: f64) -> Option<MappingJob> {
        let mut job = MappingJob::whole(map, camera, readout_s, STEPS)?;
        // Held: everything but the focal length.
        let mut information = SharedVector::from_element(1e18);
        information[0] = 1.0 / (BELIEVED * self.sigma * self.sigma);
        let mut expected = SharedVector::zeros();
        expected[0] = (self.calibrated_px / camera.fx).ln();
        job.refine_intrinsics(map, camera, expected, information);
        Some(job)
    }

    /// Takes over what an adjustment found, here and in every observation of the map.
    pub fn merge(&mut self, result: &MappingResult, map: &mut Map, camera: &mut CameraModel) {
        let Some(shared) = result.shared() else { return };
        let scale = shared.change[0].exp();
        let Ok(refined) = camera.with_focal(camera.fx * scale, camera.fy * scale) else { return };
        let own = shared.focal_information();
        self.refined_sigma = (BELIEVED * own + 1.0 / (self.sigma * self.sigma)).recip().sqrt();
        *camera = refined;
        for (_, keyframe) in map.keyframes.iter_mut() {
            for o in &mut keyframe.observations {
                if let Some((normalised, normalised_from_pixel)) = camera.undistort_jacobian(&o.pixel.cast()) {
                    o.normalised = normalised;
                    o.normalised_from_pixel = normalised_from_pixel;
                }
            }
        }
    }
}

/// Numbers that nobody measured.
fn is_nominal(camera: &CameraModel) -> bool {
    let centred = |c: f64, size: u32| (c - 0.5 * f64::from(size)).abs() <= 0.5;
    camera.fx == camera.fy
        && centred(camera.cx, camera.width)
        && centred(camera.cy, camera.height)
        && camera.distortion == [0.0; 5]
}
