//! Intrinsics, distortion and poses from views of a plane with known points.
//!
//! Points of the plane (x right, y down, z = 0, any unit) and where each view shows them (pixels) -> `fx fy cx cy k1 k2 p1 p2 k3`, or
//! `fx fy cx cy k1 k2 k3 k4` of a wide-angle lens ([`LensModel`](super::LensModel)), a pose a view (`camera_from_board`), standard deviations, residuals; which views and points did not fit and were left out.
//!
//! - Start: Zhang's closed form (A flexible new technique for camera calibration, PAMI 2000) without skew, and, where that gives no
//!   camera, its form with the principal point in the middle and a row of guessed focal lengths; the best of them after
//!   a few steps goes on. See [`closed_form`], also for wide-angle lenses, which start from a row of ideal equidistant ones.
//! - Levenberg-Marquardt on the reprojection errors over everything ([`adjust`]).
//! - Views whose residual is far beyond the others' are left out, the worst first, and the rest is solved again; then single points.
//! - A rolling shutter bends what moves. Where views say how fast their points moved ([`View::shear`]), the readout time is one more unknown
//!   that all of them share, supposed to be zero within [`READOUT_SIGMA_S`]: views that hardly moved leave it there, and its uncertainty
//!   is a part of everything else's.
//! - Covariance: `s² H⁻¹` of the intrinsics with the poses eliminated, `s² = sum r² / (2 points - parameters)`, times how much more the views
//!   differ than views of independent corners would ([`adjust::scatter`]; at least 1). It knows of noise, not of a
//!   bent board or of a lens that the model does not describe.
//!
//! Cost: 1 to 2 ms for 21 views of 96 points. Not here: finding the points; whether the views were enough (that is the
//! calibration room's verdict).

pub mod adjust;
pub mod closed_form;
pub mod projection;
mod view;

use nalgebra::{Matrix3, SMatrix, SVector, Vector2, Vector3};

pub use projection::{Intrinsics, LensKind, PARAMETERS};
pub use view::View;

use super::least_squares::Loss;
use super::statistics::median;
use adjust::{Pose, State, Unknowns};

/// Views that a calibration needs at the least.
pub const MIN_VIEWS: usize = 3;
/// Points that a view needs at the least.
pub const MIN_POINTS: usize = 8;
/// A view is left out if its residual is this many times the median of all, and larger by [`BAD_VIEW_PX`].
const BAD_VIEW_RATIO: f64 = 3.0;
const BAD_VIEW_PX: f64 = 0.3;
/// A point is left out if its residual is this many robust deviations, and larger than [`BAD_POINT_PX`].
const BAD_POINT_RATIO: f64 = 8.0;
const BAD_POINT_PX: f64 = 0.8;
/// What is supposed of a shutter's readout time, s: rolling ones of webcams take 10 to 33 ms, global ones none.
pub const READOUT_SIGMA_S: f64 = 0.02;
/// Noise of a corner that is supposed before the residuals tell it, px.
const SUPPOSED_NOISE_PX: f64 = 0.1;

/// Which lens model and which of its coefficients are estimated; the others are zero.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Distortion {
    None,
    /// k1 k2
    Radial,
    /// k1 k2 p1 p2
    RadialTangential,
    /// k1 k2 p1 p2 k3
    #[default]
    Full,
    /// k1 k2 k3 k4 of the wide-angle model.
    KannalaBrandt,
}

impl Distortion {
    /// Which of the nine parameters are free.
    pub fn free(self) -> [bool; PARAMETERS] {
        let count = match self {
            Self::None => 0,
            Self::Radial => 2,
            Self::RadialTangential => 4,
            Self::Full => 5,
            Self::KannalaBrandt => 4,
        };
        std::array::from_fn(|i| i < 4 + count)
    }

    /// The model that the coefficients are of.
    pub fn lens(self) -> LensKind {
        match self {
            Self::KannalaBrandt => LensKind::KannalaBrandt,
            Self::None | Self::Radial | Self::RadialTangential | Self::Full => LensKind::RadialTangential,
        }
    }
}

/// Why there is no calibration.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PlaneCalibrationError {
    #[error("{0} usable views: at least {MIN_VIEWS} are needed")]
    TooFewViews(usize),
    #[error("the views do not fix a focal length: the board must be tilted against the picture, differently each time")]
    Degenerate,
    #[error("no camera fits the views: the best has a residual of {0:.1} px")]
    NoFit(f64),
    #[error(
        "no pinhole camera fits the views, but a wide-angle lens does, with a residual of {0:.2} px: --distortion fisheye"
    )]
    NoPinhole(f64),
}

/// What was found.
#[derive(Debug, Clone, PartialEq)]
pub struct PlaneCalibration {
    /// Which model the intrinsics are of.
    pub lens: LensKind,
    /// fx fy cx cy and the lens's coefficients: [`LensKind::parameter_names`].
    pub intrinsics: Intrinsics,
    /// Which of them were estimated.
    pub free: [bool; PARAMETERS],
    /// Covariance of the intrinsics; zero where they were not estimated.
    pub covariance: SMatrix<f64, PARAMETERS, PARAMETERS>,
    /// The shutter's readout time, if it was estimated.
    pub readout: Option<Readout>,
    /// Root mean square of the points' reprojection errors (distance, as OpenCV states it), pixels.
    pub rms_px: f64,
    /// Standard deviation of one coordinate of a point, pixels.
    pub sigma_px: f64,
    pub views: Vec<SolvedView>,
}

/// Time from the first row's exposure to the last one's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Readout {
    /// Negative if the last row comes first.
    pub seconds: f64,
    /// Standard deviation; as large as [`READOUT_SIGMA_S`] where the views did not move.
    pub sigma_s: f64,
}

impl Readout {
    /// Whether the views moved enough to tell it: else it says little beyond what was supposed.
    pub fn is_shown(&self) -> bool {
        self.sigma_s < 0.5 * READOUT_SIGMA_S
    }
}

/// One view of a solution.
#[derive(Debug, Clone, PartialEq)]
pub struct SolvedView {
    /// x_camera = rotation x_board + translation, the plane's unit.
    pub rotation: Matrix3<f64>,
    pub translation: Vector3<f64>,
    /// Over the points that had a part; of a view that had none over all, infinite where no pose puts them before the camera.
    pub rms_px: f64,
    /// False: it had no part in the solution, because its residual was far beyond the others' or it has too few points.
    pub used: bool,
    /// Seen minus predicted, pixels, one a point.
    pub residuals: Vec<Vector2<f64>>,
    /// Points that had a part.
    pub used_points: Vec<bool>,
}

impl PlaneCalibration {
    /// The lens that was found.
    pub fn lens_model(&self) -> super::LensModel {
        self.lens.lens_model(&self.intrinsics)
    }

    /// Corners that had a part.
    pub fn used_points(&self) -> usize {
        let used = self.views.iter().filter(|v| v.used);
        used.map(|v| v.used_points.iter().filter(|u| **u).count()).sum()
    }

    /// Standard deviations of the intrinsics; zero where they were not estimated.
    pub fn sigmas(&self) -> [f64; PARAMETERS] {
        std::array::from_fn(|i| self.covariance[(i, i)].max(0.0).sqrt())
    }
}

/// Calibrates. `size`: width and height of the pictures, pixels. Views with fewer than [`MIN_POINTS`] points or on a line are left out.
pub fn calibrate(
    views: &[View],
    size: (u32, u32),
    distortion: Distortion,
) -> Result<PlaneCalibration, PlaneCalibrationError> {
    let moved = views.iter().any(|v| v.shear.iter().any(|s| s.norm() > 0.0));
    let readout_weight = |noise_px: f64| moved.then_some((noise_px / READOUT_SIGMA_S).powi(2));
    let mut unknowns = Unknowns { intrinsics: distortion.free(), readout_weight: readout_weight(SUPPOSED_NOISE_PX) };
    let homographies: Vec<Option<Matrix3<f64>>> = views.iter().map(homography).collect();
    let mut used: Vec<bool> = homographies.iter().map(Option::is_some).collect();
    let count = |used: &[bool]| used.iter().filter(|u| **u).count();
    if count(&used) < MIN_VIEWS {
        return Err(PlaneCalibrationError::TooFewViews(count(&used)));
    }
    let mut masks: Vec<Vec<bool>> = views.iter().map(|v| vec![true; v.pixels.len()]).collect();
    let mut state = match distortion.lens() {
        LensKind::RadialTangential => start(views, &homographies, size, &used, &masks)?,
        LensKind::KannalaBrandt => wide_start(views, size, &used, &masks)?,
    };
    // The start had k1 and k2 to get near; what is not asked for is zero.
    for (k, _) in state.intrinsics.iter_mut().zip(unknowns.intrinsics).filter(|(_, free)| !free) {
        *k = 0.0;
    }
    // Robust first: a bad view must not drag the others along.
    state = adjust::minimise(views, &used, &masks, state, &unknowns, Loss::Huber(1.0), 30).state;

    for _ in 0..views.len() {
        let rms: Vec<f64> = (0..views.len()).map(|k| adjust::view_rms(&views[k], &state, k, &masks[k])).collect();
        let mut of_used: Vec<f64> = rms.iter().zip(&used).filter(|(_, u)| **u).map(|(r, _)| *r).collect();
        let Some(median) = median(&mut of_used) else { break };
        let worst = (0..views.len()).filter(|k| used[*k]).max_by(|a, b| rms[*a].total_cmp(&rms[*b]));
        let Some(worst) = worst else { break };
        let bad = !(rms[worst] <= BAD_VIEW_RATIO * median) && !(rms[worst] <= median + BAD_VIEW_PX);
        // Most of the views must agree; else nobody knows which are bad.
        if !bad || count(&used) <= MIN_VIEWS || 2 * (count(&used) - 1) < views.len() {
            break;
        }
        used[worst] = false;
        state = adjust::minimise(views, &used, &masks, state, &unknowns, Loss::Huber(1.0), 20).state;
    }
    mask_points(views, &state, &used, &mut masks);
    let mut solved = adjust::minimise(views, &used, &masks, state, &unknowns, Loss::Squared, 100);
    if mask_points(views, &solved.state, &used, &mut masks) || moved {
        // What is supposed of the shutter weighs against residuals of the noise that there is.
        unknowns.readout_weight = readout_weight(noise(views, &solved.state, &used, &masks).max(1e-6));
        solved = adjust::minimise(views, &used, &masks, solved.state, &unknowns, Loss::Squared, 100);
    }
    // Views that had no part get the pose that suits them best, so that their residual means something.
    for k in 0..views.len() {
        if !used[k] && homographies[k].is_some() {
            adjust::refine_pose(&views[k], &mut solved.state, k);
        }
    }
    finish(views, &solved.state, &used, masks, &unknowns)
}

fn homography(view: &View) -> Option<Matrix3<f64>> {
    if view.pixels.len() < MIN_POINTS || view.pixels.len() != view.plane.len() {
        return None;
    }
    super::homography::dlt(&view.plane, &view.pixels)
}

/// The most promising start.
fn start(
    views: &[View],
    homographies: &[Option<Matrix3<f64>>],
    size: (u32, u32),
    used: &[bool],
    masks: &[Vec<bool>],
) -> Result<State, PlaneCalibrationError> {
    let states = closed_form::candidates(homographies, size).into_iter().map(|[fx, fy, cx, cy]| {
        let intrinsics = Intrinsics::from([fx, fy, cx, cy, 0.0, 0.0, 0.0, 0.0, 0.0]);
        let poses = homographies.iter().map(|h| h.and_then(|h| closed_form::pose(&h, &intrinsics)).unwrap_or_default());
        State { lens: LensKind::RadialTangential, intrinsics, readout_s: 0.0, poses: poses.collect::<Vec<Pose>>() }
    });
    best_start(states, views, used, masks)
}

/// The same for a wide-angle lens.
fn wide_start(
    views: &[View],
    size: (u32, u32),
    used: &[bool],
    masks: &[Vec<bool>],
) -> Result<State, PlaneCalibrationError> {
    let states = closed_form::wide_candidates(size).into_iter().map(|[fx, fy, cx, cy]| {
        let intrinsics = Intrinsics::from([fx, fy, cx, cy, 0.0, 0.0, 0.0, 0.0, 0.0]);
        let poses = views.iter().map(|view| closed_form::equidistant_pose(view, &intrinsics).unwrap_or_default());
        State { lens: LensKind::KannalaBrandt, intrinsics, readout_s: 0.0, poses: poses.collect::<Vec<Pose>>() }
    });
    best_start(states, views, used, masks)
}

/// Some steps from each state, with two coefficients of the lens free; the first that fits to a pixel, or else the best.
fn best_start(
    states: impl Iterator<Item = State>,
    views: &[View],
    used: &[bool],
    masks: &[Vec<bool>],
) -> Result<State, PlaneCalibrationError> {
    let unknowns = Unknowns { intrinsics: Distortion::Radial.free(), readout_weight: None };
    let mut best: Option<(f64, State)> = None;
    for state in states {
        let tried = adjust::minimise(views, used, masks, state, &unknowns, Loss::Huber(2.0), 6);
        let sane = tried.state.intrinsics.iter().take(2).all(|f| *f > 0.0 && f.is_finite());
        if sane && tried.cost.is_finite() && best.as_ref().is_none_or(|(cost, _)| tried.cost < *cost) {
            // The closed form's own answer needs no company when it fits to a pixel.
            let points: usize = views.iter().zip(used).filter(|(_, u)| **u).map(|(v, _)| v.pixels.len()).sum();
            let fits = tried.cost < points as f64;
            best = Some((tried.cost, tried.state));
            if fits {
                break;
            }
        }
    }
    best.map(|(_, state)| state).ok_or(PlaneCalibrationError::Degenerate)
}

/// Root mean square of one coordinate's residuals, pixels.
fn noise(views: &[View], state: &State, used: &[bool], masks: &[Vec<bool>]) -> f64 {
    let (mut sum, mut count) = (0.0, 0usize);
    for k in (0..views.len()).filter(|k| used[*k]) {
        for (r, _) in adjust::residuals(&views[k], state, k).iter().zip(&masks[k]).filter(|(_, kept)| **kept) {
            sum += r.norm_squared();
            count += 2;
        }
    }
    (sum / count.max(1) as f64).sqrt()
}

/// Marks points with residuals beyond what the others' allow; true if that changed anything.
fn mask_points(views: &[View], state: &State, used: &[bool], masks: &mut [Vec<bool>]) -> bool {
    let residuals: Vec<Vec<Vector2<f64>>> = (0..views.len()).map(|k| adjust::residuals(&views[k], state, k)).collect();
    let mut norms: Vec<f64> =
        residuals.iter().zip(used).filter(|(_, u)| **u).flat_map(|(r, _)| r.iter().map(|r| r.norm())).collect();
    // The median of a Rayleigh distribution is 1.177 sigma.
    let sigma = median(&mut norms).map_or(0.0, |m| m / 1.177);
    let limit = (BAD_POINT_RATIO * sigma).max(BAD_POINT_PX);
    let mut changed = false;
    for (mask, residuals) in masks.iter_mut().zip(&residuals) {
        for (keep, r) in mask.iter_mut().zip(residuals) {
            let good = r.norm() <= limit;
            changed |= *keep != good;
            *keep = good;
        }
    }
    changed
}

fn finish(
    views: &[View],
    state: &State,
    used: &[bool],
    masks: Vec<Vec<bool>>,
    unknowns: &Unknowns,
) -> Result<PlaneCalibration, PlaneCalibrationError> {
    let mut solved = Vec::with_capacity(views.len());
    let (mut sum, mut points, mut view_count) = (0.0, 0usize, 0usize);
    let all = vec![true; masks.iter().map(Vec::len).max().unwrap_or(0)];
    for (k, mask) in masks.into_iter().enumerate() {
        let residuals = adjust::residuals(&views[k], state, k);
        let has_part = used[k] && mask.contains(&true);
        let rms_px = adjust::view_rms(&views[k], state, k, if has_part { &mask } else { &all[..mask.len()] });
        if used[k] {
            view_count += 1;
            for r in residuals.iter().zip(&mask).filter(|(_, m)| **m).map(|(r, _)| r) {
                sum += r.norm_squared();
                points += 1;
            }
        }
        let Pose { rotation, translation } = state.poses[k];
        solved.push(SolvedView { rotation, translation, rms_px, used: used[k], residuals, used_points: mask });
    }
    let rms_px = (sum / points.max(1) as f64).sqrt();
    let free = &unknowns.intrinsics;
    let parameters = free.iter().filter(|f| **f).count() + 6 * view_count;
    let freedom = (2 * points).saturating_sub(parameters);
    // A tenth of the picture is no fit at all, whatever was measured.
    if freedom == 0 || !(rms_px < 20.0) {
        return Err(PlaneCalibrationError::NoFit(rms_px));
    }
    let sigma2 = sum / freedom as f64;
    let used_masks: Vec<Vec<bool>> = solved.iter().map(|v| v.used_points.clone()).collect();
    let information = adjust::reduced_information(views, used, &used_masks, state, unknowns);
    let all = adjust::invert(&information, unknowns).ok_or(PlaneCalibrationError::Degenerate)? * sigma2;
    let wider = SMatrix::from_diagonal(&adjust::scatter(views, used, &used_masks, state, &all, sigma2.max(1e-30)));
    let all = wider * all * wider;
    let covariance = all.fixed_view::<PARAMETERS, PARAMETERS>(0, 0).into_owned();
    let readout_variance = all[(PARAMETERS, PARAMETERS)].max(0.0);
    let readout = Readout { seconds: state.readout_s, sigma_s: readout_variance.sqrt().min(READOUT_SIGMA_S) };
    if (0..PARAMETERS).any(|i| free[i] && !(covariance[(i, i)] > 0.0 && covariance[(i, i)].is_finite())) {
        return Err(PlaneCalibrationError::Degenerate);
    }
    Ok(PlaneCalibration {
        lens: state.lens,
        intrinsics: SVector::from_iterator(state.intrinsics.iter().copied()),
        free: *free,
        covariance,
        readout: unknowns.readout_weight.map(|_| readout),
        rms_px,
        sigma_px: sigma2.sqrt(),
        views: solved,
    })
}

#[cfg(test)]
mod tests;
