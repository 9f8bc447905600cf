//! Intrinsics, refined from the motion itself.
//!
//! A calibration is never exact, and a nominal one (equal focal lengths, principal point in the middle, no distortion) is
//! a guess: a focal length that is 3 % off bends the map. When the whole map is adjusted, the logarithm of the focal length and
//! the principal point are unknowns too, with a prior around the calibrated values (Triggs et al. 2000, section 9.3 on
//! inner constraints and priors). The adjustment's own information is far too sure of itself (neighbouring keyframes
//! share the errors of their templates), so it counts only in part.
//!
//! Not here: distortion. On real sequences it traded against the focal length without end.

use super::bundle::SharedVector;
use super::local_adjustment::{MappingJob, MappingResult};
use crate::geometry::CameraModel;
use crate::map::Map;

/// Standard deviation of a measured focal length, and of a nominal one, as a share of it.
const CALIBRATED_FOCAL: f64 = 0.002;
const NOMINAL_FOCAL: f64 = 0.05;
/// Standard deviation of the principal point, as a share of the picture's width.
const CALIBRATED_CENTRE: f64 = 1e-4;
const NOMINAL_CENTRE: f64 = 0.0125;
/// Share of the adjustment's information that is believed.
const BELIEVED: f64 = 0.05;
/// A map is begun anew when the logarithm of the focal length has changed by more since its beginning, with a standard deviation
/// below the second, at most so many times.
const RESTART_CHANGE: f64 = 0.22;
const RESTART_SIGMA: f64 = 0.15;
const EAGER_KEYFRAMES: usize = 30;
const EAGER_SIGMA: f64 = 0.02;
const MAX_RESTARTS: u32 = 4;
const NEXT_MAP_WIDENING: f64 = 2.0;
/// Levenberg-Marquardt steps of each pass.
const STEPS: usize = 6;

/// How well the intrinsics that reconstruction begins with are known.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum LensPrior {
    /// They were measured, or somebody wrote down round numbers (told from the numbers themselves).
    #[default]
    Calibrated,
    /// They are a guess: standard deviations of log focal length, and of the principal point as a share of the picture's width.
    Guess { focal: f64, centre: f64 },
}

/// What is known about the camera beyond its map.
#[derive(Debug, Clone)]
pub struct Intrinsics {
    /// Nobody has calibrated this camera.
    pub guessed: bool,
    /// As it was calibrated.
    calibrated: CameraModel,
    /// Standard deviations of log focal length and principal point (px) by the calibration alone.
    sigma: SharedVector,
    /// The same with what the map says.
    pub refined_sigma: SharedVector,
    /// Focal length (px) with which the present map was begun, and maps given up because theirs was too far off.
    begun_with: f64,
    restarts: u32,
}

impl Intrinsics {
    pub fn new(camera: &CameraModel, prior: LensPrior) -> Self {
        let (focal, centre) = match prior {
            LensPrior::Guess { focal, centre } => (focal, centre),
            LensPrior::Calibrated if is_nominal(camera) => (NOMINAL_FOCAL, NOMINAL_CENTRE),
            LensPrior::Calibrated => (CALIBRATED_FOCAL, CALIBRATED_CENTRE),
        };
        let centre_px = centre * f64::from(camera.width);
        let k1s: f64 = std::env::var("K1").ok().and_then(|v| v.parse().ok()).unwrap_or(0.1);
        let ev = |k: &str, d: f64| -> f64 { std::env::var(k).ok().and_then(|v| v.parse().ok()).unwrap_or(d) };
        let (k2s, ps) = (ev("K2", 0.1), ev("PS", 0.003));
        let sigma = SharedVector::from([focal, centre_px, centre_px, k1s, k2s, ps, ps]);
        let guessed = prior != LensPrior::Calibrated;
        Self { guessed, begun_with: camera.fx, restarts: 0, calibrated: camera.clone(), sigma, refined_sigma: sigma }
    }

    /// Adjustment of the whole map, and with `refine` of the intrinsics.
    pub fn whole_job(&self, map: &Map, camera: &CameraModel, readout_s: f64, refine: bool) -> Option<MappingJob> {
        let mut job = MappingJob::whole(map, camera, readout_s, STEPS)?;
        if refine {
            self.refine(&mut job, map, camera);
        }
        Some(job)
    }

    /// Keyframes at which the whole map is to be adjusted again: when it has grown by a third, or, while a guessed lens is not known
    /// well, at every keyframe of a small map and every sixth of a larger one.
    pub fn next_whole(&self, keyframes: usize) -> usize {
        match keyframes {
            n if !self.guessed => n + n / 3,
            n if n < EAGER_KEYFRAMES && self.refined_sigma[0] > EAGER_SIGMA => 0,
            n => n + (n / 6).max(2),
        }
    }

    /// A map that was begun with a focal length far from what it has shown by now: its landmarks were chosen and its outliers judged
    /// with the wrong one, so a new map with the better one is worth more.
    pub fn wants_restart(&self, camera: &CameraModel) -> bool {
        self.guessed
            && self.restarts < MAX_RESTARTS
            && self.refined_sigma[0] < RESTART_SIGMA
            && (camera.fx / self.begun_with).ln().abs() > RESTART_CHANGE
    }

    /// The map ends: what it taught about a guessed lens is the next one's prior, less surely, because the errors of its
    /// landmarks were common to all of it.
    pub fn end_map(&mut self, camera: &CameraModel) {
        if !self.guessed {
            return;
        }
        if (camera.fx / self.begun_with).ln().abs() > RESTART_CHANGE {
            self.restarts += 1;
        }
        self.begun_with = camera.fx;
        let widened = self.refined_sigma * NEXT_MAP_WIDENING;
        self.sigma = self.sigma.zip_map(&widened, f64::min);
        self.refined_sigma = self.sigma;
        self.calibrated = camera.clone();
    }

    /// Makes the intrinsics unknowns of an adjustment.
    pub fn refine(&self, job: &mut MappingJob, map: &Map, camera: &CameraModel) {
        let off = |i: usize| self.calibrated.distortion[i] - camera.distortion[i];
        let expected = SharedVector::from([
            (self.calibrated.fx / camera.fx).ln(),
            self.calibrated.cx - camera.cx,
            self.calibrated.cy - camera.cy,
            off(0),
            off(1),
            off(2),
            off(3),
        ]);
        // Believing a part of the data is weighing the prior the more.
        let believed = if self.guessed { guess_believed() } else { BELIEVED };
        let information = self.sigma.map(|s| 1.0 / (believed * s * s));
        job.refine_intrinsics(map, camera, expected, information, self.guessed || std::env::var("NEWPX").is_ok());
    }

    /// Takes over what an adjustment found, here and in every observation of the map.
    pub fn merge(&mut self, result: &MappingResult, map: &mut Map, camera: &mut CameraModel) {
        let Some(shared) = result.shared() else { return };
        let scale = shared.change[0].exp();
        let believed = if self.guessed { guess_believed() } else { BELIEVED };
        let mut distortion = camera.distortion;
        for i in 0..4 {
            distortion[i] += shared.change[3 + i];
        }
        let refined = CameraModel::new(
            camera.width,
            camera.height,
            camera.fx * scale,
            camera.fy * scale,
            camera.cx + shared.change[1],
            camera.cy + shared.change[2],
            distortion,
        );
        let Ok(refined) = refined else { return };
        if self.guessed && !refined.covers_picture() {
            if std::env::var("VI").is_ok() { println!("REFUSED {refined:?}"); }
            return;
        }
        let prior = self.sigma.map(|s| 1.0 / (s * s));
        let information = shared.found_information * believed + super::bundle::SharedMatrix::from_diagonal(&prior);
        if let Some(covariance) = information.try_inverse() {
            self.refined_sigma = covariance.diagonal().map(|v| v.max(0.0).sqrt());
        }
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

fn guess_believed() -> f64 {
    std::env::var("BEL").ok().and_then(|v| v.parse().ok()).unwrap_or(BELIEVED)
}

/// Numbers that nobody measured.
fn is_nominal(camera: &CameraModel) -> bool {
    let centred = |c: f64, size: u32| (c - 0.5 * f64::from(size)).abs() <= 0.5;
    camera.fx == camera.fy
        && centred(camera.cx, camera.width)
        && centred(camera.cy, camera.height)
        && camera.distortion == [0.0; 5]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn round_numbers_are_a_guess_and_measured_ones_are_not() {
        let camera = |fx, fy, cx, k1| CameraModel::new(640, 480, fx, fy, cx, 240.0, [k1, 0.0, 0.0, 0.0, 0.0]).unwrap();
        assert!(is_nominal(&camera(525.0, 525.0, 320.0, 0.0)));
        assert!(is_nominal(&camera(525.0, 525.0, 319.5, 0.0)));
        assert!(!is_nominal(&camera(517.3, 516.5, 320.0, 0.0)));
        assert!(!is_nominal(&camera(525.0, 525.0, 318.6, 0.0)));
        assert!(!is_nominal(&camera(525.0, 525.0, 320.0, 0.1)));
    }
}
