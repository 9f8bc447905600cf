//! Intrinsics, refined from the motion itself.
//!
//! A calibration is never exact, a nominal one (equal focal lengths, principal point in the middle, no distortion) is a guess, and a
//! camera that nobody has calibrated starts with nothing but a usual angle of view. When the whole map is adjusted, the
//! logarithm of the focal length, the principal point and k1, k2, p1, p2 are unknowns too, with a prior around what was known before
//! (Triggs et al. 2000, section 9.3 on inner constraints and priors). Distortion matters most: what a calibration left of it makes
//! things at one side of the picture too near and at the other too far, and a turn carries the scale from one side to the other
//! (KITTI's calibration: a tenth of the scale lost in one turn; Krešo and Šegvić, VISAPP 2015, found its deformation field). The adjustment's own
//! information is far too sure of itself (neighbouring keyframes share the errors of their templates), so it counts only in part.
//!
//! A guessed lens differs in two more ways. The whole of a small map is adjusted at every keyframe. And a map that was begun with a focal length far from
//! what it has shown since is begun anew; what was seen before is mapped again once the lens is known ([`second_look`](crate::reconstruction::second_look)).
//!
//! **What is said of it.** The published standard deviation is the adjustment's, with [`MODEL_FLOOR`] added for what this lens model leaves
//! out, and how far the focal length has moved since the adjustment's variance was twice what it is: of an estimate that is as good as
//! it says that is one standard deviation more or less, and an estimate that still wanders (a motion that hardly shows the focal length, a
//! lens far from the supposed one) is never taken for found. It is not above the prior's. A focal length counts as found from the motion ([`LensKnowledge::Estimated`])
//! while that is at most [`FOUND_SIGMA`], and as not observable so far otherwise: without rotation it does not shrink at all, because
//! every focal length then fits with depths of its own.
//!
//! Of a calibrated wide-angle lens (Kannala-Brandt), focal length and principal point are refined as of any other.
//!
//! Not here: k3; wide-angle lenses that nobody calibrated (they are taken for pinholes, and k1
//! to p2 cannot bend those so far: a fisheye needs a calibration); finding a focal length without translation.

use super::bundle::{IntrinsicsVector, WITHOUT_DISTORTION};
use super::job::{Adjustment, FoundIntrinsics};
use crate::geometry::{CameraModel, LensModel};
use crate::map::Map;
use crate::map::saved::SavedOptics;
use crate::reconstruction::measurement::rolling_shutter::{BELIEVED, Shutter};

/// Standard deviation of a measured focal length, of a nominal one, and of an unknown one, as a share of it.
const CALIBRATED_FOCAL: f64 = 0.01;
const NOMINAL_FOCAL: f64 = 0.05;
const UNKNOWN_FOCAL: f64 = 0.25;
/// Standard deviation of the principal point, as a share of the picture's width.
const CALIBRATED_CENTRE: f64 = 1e-4;
const NOMINAL_CENTRE: f64 = 0.0125;
const UNKNOWN_CENTRE: f64 = 0.025;
/// Standard deviations of k1, k2, and p1 and p2 of a lens that was measured (or is nominal: rectified pictures have such a one), and of one
/// that nobody has.
const CALIBRATED_DISTORTION: [f64; 4] = [0.02, 0.02, 0.001, 0.001];
const GUESSED_DISTORTION: [f64; 4] = [0.1, 0.1, 0.003, 0.003];
/// Levenberg-Marquardt steps of each pass, at the most: enough to keep up with a calibrated lens, and to arrive with one that is far off.
/// A lens that is still on its way looks as sure as one that has arrived.
const STEPS: usize = 6;
const GUESSED_STEPS: usize = 30;

/// What rolling shutter and distortion beyond k1 k2 p1 p2 may cost in focal length, as a share of it.
pub const MODEL_FLOOR: f64 = 0.03;
/// Largest published standard deviation of log focal length at which it counts as found.
pub const FOUND_SIGMA: f64 = 0.09;

/// Estimates are remembered when their variance has shrunk to this share of the one remembered last, at most so many of them.
const REMEMBER_SHARE: f64 = 0.9;
const REMEMBERED: usize = 64;

/// A map is begun anew when log focal length has changed by more than this since its beginning, with a standard deviation below the
/// second number, at most so many times.
const RESTART_CHANGE: f64 = 0.22;
const RESTART_SIGMA: f64 = 0.15;
const MAX_RESTARTS: u32 = 4;
/// The next map's prior is so many times less sure than the map that ended: the errors of its landmarks were common to all of it.
const NEXT_MAP_WIDENING: f64 = 2.0;
/// A guessed lens is adjusted at every keyframe below so many of them, as long as it is less sure than this.
const EAGER_KEYFRAMES: usize = 30;
const EAGER_SIGMA: f64 = 0.02;

/// How well the intrinsics that reconstruction begins with are known.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum LensPrior {
    /// They were measured, or somebody wrote down round numbers (told from the numbers themselves).
    #[default]
    Calibrated,
    /// They are a guess: standard deviations of log focal length, and of the principal point as a share of the picture's width.
    Guess { focal: f64, centre: f64 },
}

impl LensPrior {
    /// A camera of which nothing is known but that webcams see some 60 degrees.
    pub const UNKNOWN: Self = Self::Guess { focal: UNKNOWN_FOCAL, centre: UNKNOWN_CENTRE };

    /// An estimate of an earlier run, with the standard deviations that were published with it: never surer than the floor of what the
    /// model leaves out, and never less sure than knowing nothing.
    pub fn kept(focal_sigma: f64, centre: f64) -> Self {
        Self::Guess {
            focal: focal_sigma.clamp(MODEL_FLOOR, UNKNOWN_FOCAL),
            centre: centre.clamp(0.002, UNKNOWN_CENTRE),
        }
    }
}

/// A camera of which nothing is known but an angle of view across the longer side of its pictures, degrees; `None` if there is no such camera.
pub fn guessed_camera(width: u32, height: u32, view_deg: f64) -> Option<CameraModel> {
    let half = 0.5 * f64::from(width.max(height));
    let focal = half / (0.5 * view_deg).to_radians().tan();
    let middle = |size: u32| 0.5 * f64::from(size) - 0.5;
    CameraModel::new(width, height, focal, focal, middle(width), middle(height), [0.0; 5]).ok()
}

/// Where the intrinsics in use come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LensKnowledge {
    /// A calibration (refined around it).
    #[default]
    Calibrated,
    /// Found from the motion, as surely as the standard deviation says.
    Estimated,
    /// A guess: the motion has not shown the focal length so far.
    Guessed,
}

impl LensKnowledge {
    /// As logged and printed.
    pub fn name(self) -> &'static str {
        match self {
            Self::Calibrated => "calibrated",
            Self::Estimated => "estimated",
            Self::Guessed => "guessed",
        }
    }
}

/// The lens that is supposed, and how far it may be from what it is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SupposedLens {
    pub focal_px: f64,
    /// Standard deviation of log focal length.
    pub focal_sigma: f64,
    /// The same of the principal point, px.
    pub centre_sigma_px: f64,
    /// The same of the first distortion coefficient.
    pub distortion_sigma: f64,
}

/// The lens as it is believed now.
#[derive(Debug, Clone, PartialEq)]
pub struct LensEstimate {
    pub knowledge: LensKnowledge,
    pub camera: CameraModel,
    /// Standard deviation of the focal length, as a share of it.
    pub focal_sigma: f64,
    /// Standard deviation of each coordinate of the principal point, px.
    pub centre_sigma_px: [f64; 2],
}

/// What is known about the camera beyond its map.
#[derive(Debug, Clone)]
pub struct Intrinsics {
    /// Nobody has calibrated this camera.
    guessed: bool,
    /// As it was calibrated, guessed, or found with the map before.
    expected: CameraModel,
    /// Standard deviations (log focal length, principal point in px, distortion) without the present map.
    sigma: IntrinsicsVector,
    /// The same with what the map says.
    refined_sigma: IntrinsicsVector,
    /// Focal length (px) with which the present map was begun, and maps given up because theirs was too far off.
    begun_with: f64,
    restarts: u32,
    /// The last adjustment ended in a distortion that cannot be: the next one leaves it as it is.
    hold_distortion: bool,
    /// Log focal length and its variance by the adjustment, whenever that variance had shrunk by [`REMEMBER_SHARE`].
    found_before: Vec<(f64, f64)>,
    /// How far log focal length has moved since its variance was twice the present one.
    unsettled: f64,
}

impl Intrinsics {
    pub fn new(camera: &CameraModel, prior: LensPrior) -> Self {
        let (focal, centre) = match prior {
            LensPrior::Guess { focal, centre } => (focal, centre),
            LensPrior::Calibrated if is_nominal(camera) => (NOMINAL_FOCAL, NOMINAL_CENTRE),
            LensPrior::Calibrated => (CALIBRATED_FOCAL, CALIBRATED_CENTRE),
        };
        let centre_px = centre * f64::from(camera.width);
        let [k1, k2, p1, p2] = if prior == LensPrior::Calibrated { CALIBRATED_DISTORTION } else { GUESSED_DISTORTION };
        let sigma = IntrinsicsVector::from([focal, centre_px, centre_px, k1, k2, p1, p2]);
        Self {
            guessed: prior != LensPrior::Calibrated,
            expected: camera.clone(),
            sigma,
            refined_sigma: sigma,
            begun_with: camera.fx,
            restarts: 0,
            hold_distortion: false,
            found_before: vec![(camera.fx.ln(), focal * focal)],
            unsettled: 0.0,
        }
    }

    /// All of it, for another run; what is not of the lens is left as it comes.
    pub fn saved(&self, camera: &CameraModel) -> SavedOptics {
        SavedOptics {
            calibration: self.expected.clone(),
            is_guessed: self.guessed,
            camera: camera.clone(),
            expected: self.expected.clone(),
            sigma: self.sigma.into(),
            refined_sigma: self.refined_sigma.into(),
            begun_with_px: self.begun_with,
            restarts: self.restarts,
            found_before: self.found_before.clone(),
            unsettled: self.unsettled,
            readout_s: 0.0,
            readout_information: 0.0,
        }
    }

    /// Goes on from what another run knew.
    pub fn resume(&mut self, saved: &SavedOptics) {
        *self = Self {
            guessed: saved.is_guessed,
            expected: saved.expected.clone(),
            sigma: saved.sigma.into(),
            refined_sigma: saved.refined_sigma.into(),
            begun_with: saved.begun_with_px,
            restarts: saved.restarts,
            hold_distortion: false,
            found_before: saved.found_before.clone(),
            unsettled: saved.unsettled,
        };
    }

    /// How far the lens may be from this camera's, which it is supposed to be.
    pub fn supposed(&self, camera: &CameraModel) -> SupposedLens {
        SupposedLens {
            focal_px: camera.focal_px(),
            focal_sigma: self.sigma[0],
            centre_sigma_px: self.sigma[1],
            distortion_sigma: self.sigma[3],
        }
    }

    /// What may be said of the lens.
    pub fn estimate(&self, camera: &CameraModel) -> LensEstimate {
        let knowledge = match self.guessed {
            false => LensKnowledge::Calibrated,
            true if self.is_found() => LensKnowledge::Estimated,
            true => LensKnowledge::Guessed,
        };
        LensEstimate {
            knowledge,
            camera: camera.clone(),
            focal_sigma: self.published_focal_sigma(),
            centre_sigma_px: [self.refined_sigma[1], self.refined_sigma[2]],
        }
    }

    /// Notes what the focal length was at which variance, and how far it has moved since that was twice what it is.
    fn remember(&mut self, log_focal: f64) {
        let variance = self.refined_sigma[0] * self.refined_sigma[0];
        let before = self.found_before.iter().rev().find(|(_, v)| *v >= 2.0 * variance);
        let (from, _) = before.or(self.found_before.first()).copied().unwrap_or((log_focal, variance));
        self.unsettled = (log_focal - from).abs();
        if self.found_before.last().is_none_or(|(_, v)| variance <= REMEMBER_SHARE * v || variance > *v) {
            if self.found_before.len() == REMEMBERED {
                self.found_before.remove(0);
            }
            self.found_before.push((log_focal, variance));
        }
    }

    /// By its owner, not from the motion.
    pub fn is_calibrated(&self) -> bool {
        !self.guessed
    }

    /// Calibrated, or found from the motion.
    pub fn is_found(&self) -> bool {
        !self.guessed || self.published_focal_sigma() <= FOUND_SIGMA
    }

    /// Standard deviation of log focal length as it is told.
    pub fn published_focal_sigma(&self) -> f64 {
        match self.guessed {
            true => self.refined_sigma[0].hypot(MODEL_FLOOR).hypot(self.unsettled).min(self.sigma[0].max(MODEL_FLOOR)),
            false => self.refined_sigma[0],
        }
    }

    /// Global bundle adjustment, and with `refine` of the intrinsics.
    pub fn global_job(&self, map: &Map, camera: &CameraModel, shutter: &Shutter, refine: bool) -> Option<Adjustment> {
        let steps = if self.guessed { GUESSED_STEPS } else { STEPS };
        let mut job = Adjustment::global(map, camera, shutter, steps)?;
        if refine || self.guessed {
            // Of a pinhole lens; a wide-angle one's distortion stays.
            let off = |i: usize| match (self.expected.lens, camera.lens) {
                (LensModel::RadialTangential(expected), LensModel::RadialTangential(own)) => expected[i] - own[i],
                _ => 0.0,
            };
            let expected = IntrinsicsVector::from([
                (self.expected.fx / camera.fx).ln(),
                self.expected.cx - camera.cx,
                self.expected.cy - camera.cy,
                off(0),
                off(1),
                off(2),
                off(3),
            ]);
            // Believing a part of the data is weighing the prior the more.
            let mut information = self.sigma.map(|s| 1.0 / (BELIEVED * s * s));
            if camera.lens.is_wide_angle() || self.hold_distortion {
                information.as_mut_slice()[WITHOUT_DISTORTION..].fill(f64::INFINITY);
            }
            job.refine_intrinsics(map, camera, &expected, &information);
        }
        Some(job)
    }

    /// Keyframes at which the map is to be adjusted globally again: when it has grown by a third; a guessed lens at every keyframe of a
    /// small map and when a larger one has grown by a sixth.
    pub fn next_global(&self, keyframes: usize) -> usize {
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
            && self.has_moved_far(camera)
    }

    fn has_moved_far(&self, camera: &CameraModel) -> bool {
        (camera.fx / self.begun_with).ln().abs() > RESTART_CHANGE
    }

    /// The map ends: what it taught about a guessed lens is the next one's prior, less surely.
    pub fn end_map(&mut self, camera: &CameraModel) {
        self.hold_distortion = false;
        if !self.guessed {
            return;
        }
        self.restarts += u32::from(self.has_moved_far(camera));
        self.begun_with = camera.fx;
        self.expected = camera.clone();
        self.sigma = self.sigma.zip_map(&(self.refined_sigma * NEXT_MAP_WIDENING), f64::min);
        self.refined_sigma = self.sigma;
    }

    /// The lens that an adjustment ended with: `Some(None)` if it did not ask, `None` if there can be no such lens. Then nothing of that
    /// adjustment may be taken over, for its poses and points belong to that lens.
    pub fn judge(&mut self, found: Option<&FoundIntrinsics>, camera: &CameraModel) -> Option<Option<CameraModel>> {
        let Some(found) = found else { return Some(None) };
        let refined = changed(camera, &found.change);
        self.hold_distortion = refined.is_none() && !found.held[WITHOUT_DISTORTION];
        refined.map(Some)
    }

    /// The last adjustment was refused for its distortion: another one, which leaves that as it is, is worth while.
    pub fn wants_another(&self) -> bool {
        self.hold_distortion
    }

    /// Takes over the lens of an adjustment that was merged, here and in every observation and free corner of the map.
    pub fn merge(&mut self, found: &FoundIntrinsics, refined: CameraModel, map: &mut Map, camera: &mut CameraModel) {
        // What was found with the distortion held says less of the focal length than it seems to.
        let complete = camera.lens.is_wide_angle() || !found.held[WITHOUT_DISTORTION];
        if let Some(variance) = found.variance.filter(|_| complete) {
            // The prior was the surer by the share that is believed: so were both together.
            let sigma = variance.map(|v| (v / BELIEVED).max(0.0).sqrt());
            self.refined_sigma = IntrinsicsVector::from_fn(|i, _| match found.held[i] {
                true => self.sigma[i],
                false => sigma[i].min(self.sigma[i]),
            });
        }
        if self.guessed {
            self.remember(refined.fx.ln());
        }
        *camera = refined;
        map.undistort_anew(camera);
    }
}

/// The camera with a change of its intrinsics; `None` if no camera comes of it. A distortion under which a part of the picture
/// would come to see nothing is none.
fn changed(camera: &CameraModel, change: &IntrinsicsVector) -> Option<CameraModel> {
    let scale = change[0].exp();
    let with = |lens: LensModel| {
        let (fx, fy) = (camera.fx * scale, camera.fy * scale);
        let (cx, cy) = (camera.cx + change[1], camera.cy + change[2]);
        CameraModel::new(camera.width, camera.height, fx, fy, cx, cy, lens).ok()
    };
    let LensModel::RadialTangential(mut distortion) = camera.lens else { return with(camera.lens) };
    for (d, change) in distortion.iter_mut().zip(change.iter().skip(WITHOUT_DISTORTION)) {
        *d += change;
    }
    with(distortion.into())
        .filter(|c| c.covers_picture() || !camera.covers_picture() && c.valid_radius() >= camera.valid_radius())
}

/// Numbers that nobody measured.
fn is_nominal(camera: &CameraModel) -> bool {
    let centred = |c: f64, size: u32| (c - 0.5 * f64::from(size)).abs() <= 0.5;
    camera.fx == camera.fy
        && centred(camera.cx, camera.width)
        && centred(camera.cy, camera.height)
        && camera.lens == LensModel::PINHOLE
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(fx: f64, fy: f64, cx: f64, k1: f64) -> CameraModel {
        CameraModel::new(640, 480, fx, fy, cx, 240.0, [k1, 0.0, 0.0, 0.0, 0.0]).expect("valid")
    }

    #[test]
    fn round_numbers_are_a_guess_and_measured_ones_are_not() {
        assert!(is_nominal(&camera(525.0, 525.0, 320.0, 0.0)));
        assert!(is_nominal(&camera(525.0, 525.0, 319.5, 0.0)));
        assert!(!is_nominal(&camera(517.3, 516.5, 320.0, 0.0)));
        assert!(!is_nominal(&camera(525.0, 525.0, 318.6, 0.0)));
        assert!(!is_nominal(&camera(525.0, 525.0, 320.0, 0.1)));
    }

    #[test]
    fn a_guess_is_said_to_be_one_until_its_sigma_has_shrunk() {
        let camera = camera(554.0, 554.0, 320.0, 0.0);
        let mut lens = Intrinsics::new(&camera, LensPrior::UNKNOWN);
        assert_eq!(
            (lens.estimate(&camera).knowledge, lens.estimate(&camera).focal_sigma),
            (LensKnowledge::Guessed, 0.25)
        );
        lens.refined_sigma[0] = 0.01;
        let found = lens.estimate(&camera);
        assert_eq!(found.knowledge, LensKnowledge::Estimated);
        assert!((MODEL_FLOOR..0.05).contains(&found.focal_sigma));
        let measured = Intrinsics::new(&camera, LensPrior::Calibrated).estimate(&camera);
        assert_eq!(measured.knowledge, LensKnowledge::Calibrated);
    }

    #[test]
    fn what_a_map_taught_outlives_it_but_is_believed_less() {
        let mut camera = camera(554.0, 554.0, 320.0, 0.0);
        let mut lens = Intrinsics::new(&camera, LensPrior::UNKNOWN);
        lens.refined_sigma[0] = 0.02;
        camera.fx = 400.0;
        assert!(lens.wants_restart(&camera));
        lens.end_map(&camera);
        assert!(!lens.wants_restart(&camera), "the next map begins with the better one");
        assert_eq!((lens.sigma[0], lens.expected.fx, lens.restarts), (0.04, 400.0, 1));
    }

    #[test]
    fn a_distortion_that_folds_the_picture_is_not_taken_over() {
        let camera = camera(320.0, 320.0, 320.0, 0.0);
        let mut change = IntrinsicsVector::zeros();
        (change[0], change[3]) = (0.1, -0.5);
        assert_eq!(changed(&camera, &change), None);
        change[3] = -0.05;
        assert_eq!(changed(&camera, &change).map(|c| c.lens.coefficients()[0]), Some(-0.05));
    }
}
