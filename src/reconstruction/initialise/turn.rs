//! The rotation between two views from their tracks alone, whether or not the camera has moved as well.
//!
//! Corresponding points on z = 1 of the lens that is supposed -> `second_from_first` rotation with its covariance, or `None` where too few
//! tracks agree on one. Two models are weighed:
//! - **Turn**: a rotation through a lens whose focal length, principal point and first distortion coefficient are known so far: seen through
//!   another one a turn's flow has a pattern that no rotation has, and looks like parallax. As a small sideways motion looks like a turn, a
//!   translation before a frontal plane is fitted along, held near none by as much as the tracks leave unexplained. With `u` the logarithm
//!   of the supposed focal length over the true one, `c` the principal point on the supposed plane, and `m = (n - c) e^u`, the place on the
//!   true lens's plane is `q(n) = m (1 + k |m|²)`, and `P = R [q(n1); 1] + t` is seen at `q(n2) = P.xy / P.z`.
//! - **Motion**: rotation and direction of a translation through a scene of any shape, by Sampson's distances to epipolar lines
//!   ([`refine_motion`]), begun with the translation that the turn's rotation leaves: the least eigenvector of `sum m mᵀ`,
//!   `m = R x1 × x2`.
//!
//! The one of the smaller GRIC is taken (Torr, Bayesian model estimation and selection for epipolar geometry, IJCV 2002, section 5): with
//! distances `e` from the model's manifold in the space of both views' points (px), whose dimension is `d` (2 and 3), `n` tracks,
//! `k` parameters, and `s` the noise of a track as the motion, which has more freedom, tells it,
//!
//! ```text
//! GRIC = sum min(e²/s², 2 (4 - d)) + n d ln 4 + k ln(4 n)
//! ```
//!
//! What no turn explains of the flow ([`unexplained_px`]) tells whether a start of a map is worth trying.
//!
//! Cost: 0.15 ms where a turn explains the tracks, 0.3 ms where it does not. Everything is on the stack or in buffers that are kept. Not
//! here: samples (tracks are mostly right, and the frame before gives the start), positions, finding the focal length of a camera that only
//! turns (Hartley 1994), which a few degrees hardly show.

use nalgebra::{
    Matrix2, Matrix2x3, Matrix2x4, Matrix3, Matrix3x4, SMatrix, SVector, SymmetricEigen, UnitQuaternion, Vector2,
    Vector3,
};

use crate::geometry::epipolar::sampson_squared;
use crate::geometry::essential::{essential_of, motion_information, refine_motion};
use crate::geometry::frames::{First, Second};
use crate::geometry::least_squares::{LeastSquares, LmOptions, Loss, NormalEquations, minimise};
use crate::geometry::{CameraModel, SIGMA_OVER_MEDIAN, Se3, median};
use crate::reconstruction::adjust::intrinsics::SupposedLens;

/// Standard deviation of a track over some dozen frames, px: the least that any are taken for.
const TRACK_PX: f64 = 0.5;
/// A track farther than this from where the model has it does not agree, px.
const AGREEING_PX: f64 = 4.0;
/// Tracks that two frames are compared by, at the most; it bounds the time.
pub const MAX_PAIRS: usize = 120;
/// Median of a length of two components with a standard deviation of one.
const RAYLEIGH_MEDIAN: f64 = 1.1774;
/// Tracks that agree, at the least, and their share.
pub const MIN_TRACKS: usize = 25;
const MIN_SHARE: f64 = 0.6;
/// The translation that a turn may hide, in residuals: depths of a room vary by a third of their mean, so what all tracks share is some
/// three times what they differ by.
const HIDDEN: f64 = 3.0;
/// What they may differ by without being noticed in the noise, px.
const UNNOTICED_PX: f64 = 0.3;
/// A translation that is held at none, px.
const HELD_PX: f64 = 1e-3;
/// Residual of a track that has no place in the other view, px.
const NOWHERE_PX: f64 = 1e3;
/// Tracks whose errors are independent, at the most: neighbours drift alike.
const INDEPENDENT: f64 = 20.0;
/// Rounds with a loss of their own scale, and steps of each, at the most.
const ROUNDS: usize = 6;
const STEPS: usize = 8;
/// GRIC: dimensions of two views' points, of the models' manifolds, and their parameters (the principal point is hardly free).
const POINT_DIMENSIONS: f64 = 4.0;
const TURN: (f64, f64) = (2.0, 8.0);
const MOTION: (f64, f64) = (3.0, 5.0);

/// One track in both views, and what a small step on the plane z = 1 counts there in the second, px.
#[derive(Debug, Clone, Copy)]
pub struct Pair {
    pub first: Vector2<f64>,
    pub second: Vector2<f64>,
    pub scale: Matrix2<f64>,
}

impl Pair {
    /// Of two pixels; see [`of`](Self::of).
    pub fn between(first: &Vector2<f32>, second: &Vector2<f32>, camera: &CameraModel) -> Option<Self> {
        Self::of(camera.undistort(&first.cast()).filter(|n| camera.is_central(n))?, second, camera)
    }

    /// Of a place on z = 1 and a pixel; `None` where the lens shows nothing, or its plane z = 1 is no longer even.
    pub fn of(first: Vector2<f64>, second: &Vector2<f32>, camera: &CameraModel) -> Option<Self> {
        let second = camera.undistort(&second.cast()).filter(|n| camera.is_central(n))?;
        Some(Self { first, second, scale: camera.pixel_scale(&second) })
    }
}

/// A rotation between two views.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewTurn {
    pub second_from_first: UnitQuaternion<f64>,
    /// Of its left perturbation (the second camera's axes), rad², without what the lens makes.
    pub covariance: Matrix3<f64>,
    /// The same perturbation for one standard deviation of the focal length, and of what is left of the distortion and of each
    /// coordinate of the principal point then, rad.
    pub by_lens: Matrix3x4<f64>,
    /// The turn that explains the tracks best: to begin with at the next frame.
    pub state: TurnState,
}

/// The median flow (px) that no turn and no lens near the supposed one explains, of at most [`MAX_PAIRS`] evenly chosen pairs.
pub fn unexplained_px(pairs: &[Pair], lens: SupposedLens, lengths: &mut Vec<f64>) -> f64 {
    let chosen: Vec<Pair> = pairs.iter().step_by(pairs.len().div_ceil(MAX_PAIRS).max(1)).copied().collect();
    let mut turn = TurnProblem { pairs: &chosen, lens, hidden_px: HELD_PX, loss: Loss::Squared };
    turn.fit(TurnState::none(), lengths).1 * RAYLEIGH_MEDIAN
}

/// The rotation near `guess`; `lengths` is scratch.
pub fn view_turn(pairs: &[Pair], guess: &TurnState, lens: SupposedLens, lengths: &mut Vec<f64>) -> Option<ViewTurn> {
    if pairs.len() < MIN_TRACKS {
        return None;
    }
    let mut turn = TurnProblem { pairs, lens, hidden_px: HELD_PX, loss: Loss::Squared };
    let held = turn.fit(TurnState { shift: Vector3::zeros(), ..*guess }, lengths);
    let unexplained = (held.1 * held.1 - TRACK_PX * TRACK_PX).max(0.0).sqrt();
    turn.hidden_px = HIDDEN * (unexplained + UNNOTICED_PX);
    let (state, typical) = turn.fit(held.0, lengths);
    // Both views' noise is in a residual of the turn.
    let moved = (typical > std::f64::consts::SQRT_2 * TRACK_PX)
        .then(|| motion(pairs, &state, typical, lens.focal_px, lengths))
        .flatten()
        .filter(|motion| {
            let sigma_px = motion.typical_px.max(TRACK_PX);
            let by_turn = gric(pairs, TURN, sigma_px, |p| 0.5 * turn.squared(&state, p));
            gric(pairs, MOTION, sigma_px, sampson_px2(&motion.second_from_first, lens.focal_px)) < by_turn
        });
    match moved {
        Some(motion) => motion.turn(pairs, lens, state),
        None => turn.judge(&state, typical),
    }
}

/// GRIC of a model whose squared distances (px²) are given.
fn gric(pairs: &[Pair], (dimension, parameters): (f64, f64), sigma_px: f64, squared: impl Fn(&Pair) -> f64) -> f64 {
    let n = pairs.len() as f64;
    let limit = 2.0 * (POINT_DIMENSIONS - dimension);
    let data: f64 = pairs.iter().map(|p| (squared(p) / (sigma_px * sigma_px)).min(limit)).sum();
    data + n * dimension * POINT_DIMENSIONS.ln() + parameters * (POINT_DIMENSIONS * n).ln()
}

/// Enough tracks agree.
fn agrees(pairs: &[Pair], squared: impl Fn(&Pair) -> f64) -> bool {
    let agreeing = pairs.iter().filter(|p| squared(p) < AGREEING_PX * AGREEING_PX).count();
    agreeing >= MIN_TRACKS && agreeing as f64 >= MIN_SHARE * pairs.len() as f64
}

/// Variance by which an information of residuals in standard deviations of a track is divided.
fn variance(typical_px: f64, tracks: usize) -> f64 {
    (typical_px / TRACK_PX).powi(2).max(1.0) * (tracks as f64 / INDEPENDENT).max(1.0)
}

/// Rotation (second from first), translation before a frontal plane one unit away, and the true lens as against the supposed one: logarithm
/// of the focal lengths' ratio, supposed to true, first coefficient of undistortion, and principal point on the supposed plane z = 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TurnState {
    rotation: UnitQuaternion<f64>,
    shift: Vector3<f64>,
    focal: f64,
    distortion: f64,
    centre: Vector2<f64>,
}

impl TurnState {
    /// Of a view and itself.
    pub fn none() -> Self {
        let (rotation, shift, centre) = (UnitQuaternion::identity(), Vector3::zeros(), Vector2::zeros());
        Self { rotation, shift, focal: 0.0, distortion: 0.0, centre }
    }

    /// The same through the lens that the tracks have told so far.
    pub fn restarted(&self) -> Self {
        Self { focal: self.focal, distortion: self.distortion, centre: self.centre, ..Self::none() }
    }

    /// What something is known of beforehand, in the order of the unknowns; of the rotation nothing.
    fn known(&self) -> SVector<f64, UNKNOWNS> {
        let (t, c) = (&self.shift, &self.centre);
        SVector::from([0.0, 0.0, 0.0, t.x, t.y, t.z, self.focal, self.distortion, c.x, c.y])
    }

    /// Place on the true lens's plane.
    fn lift(&self, n: &Vector2<f64>) -> Vector2<f64> {
        let m = (n - self.centre) * self.focal.exp();
        m * (1.0 + self.distortion * m.norm_squared())
    }

    /// Its derivatives by the unknowns of the lens.
    fn lift_jacobian(&self, n: &Vector2<f64>) -> Matrix2x4<f64> {
        let stretch = self.focal.exp();
        let m = (n - self.centre) * stretch;
        let square = m.norm_squared();
        let radial = self.distortion * square;
        let by_centre = (Matrix2::identity() * (1.0 + radial) + m * m.transpose() * (2.0 * self.distortion)) * -stretch;
        Matrix2x4::from_columns(&[
            m * (1.0 + 3.0 * radial),
            m * square,
            by_centre.column(0).into_owned(),
            by_centre.column(1).into_owned(),
        ])
    }
}

const UNKNOWNS: usize = 10;
/// Of these, where the lens begins, and how many it has.
const LENS: usize = 6;
const OF_LENS: usize = UNKNOWNS - LENS;

/// Of every descent.
fn lm_options() -> LmOptions {
    LmOptions { max_iterations: STEPS, relative_cost: 1e-4, step_norm: 1e-7, ..LmOptions::default() }
}

/// Of residuals in standard deviations of a track, scaled to how far off they typically are.
fn loss_of(typical_px: f64) -> Loss {
    Loss::Cauchy(2.0 * (typical_px / TRACK_PX).max(1.0))
}

struct TurnProblem<'a> {
    pairs: &'a [Pair],
    lens: SupposedLens,
    /// Standard deviation of what a translation makes of the tracks that a turn seems to explain, px.
    hidden_px: f64,
    loss: Loss,
}

impl TurnProblem<'_> {
    /// The state near `state` that explains the tracks best, the translation held as it is, and how well it does
    /// ([`Self::typical_px`]). The loss is left scaled to that.
    fn fit(&mut self, mut state: TurnState, lengths: &mut Vec<f64>) -> (TurnState, f64) {
        let options = lm_options();
        let mut typical = self.typical_px(&state, lengths);
        for _ in 0..ROUNDS {
            self.loss = loss_of(typical);
            let (found, summary) = minimise(self, state, &options);
            state = found;
            let before = std::mem::replace(&mut typical, self.typical_px(&state, lengths));
            if summary.converged && typical > 0.9 * before || typical <= TRACK_PX {
                break;
            }
        }
        self.loss = loss_of(typical);
        (state, typical)
    }

    /// Information of translation (frontal plane one unit away), logarithm of the focal length, distortion, and principal point.
    fn prior(&self) -> SVector<f64, UNKNOWNS> {
        let information = |sigma: f64| 1.0 / sigma.max(1e-4).powi(2);
        let SupposedLens { focal_px, focal_sigma, centre_sigma_px, distortion_sigma } = self.lens;
        let shift = (focal_px / self.hidden_px).powi(2);
        let [focal, distortion, centre] = [focal_sigma, distortion_sigma, centre_sigma_px / focal_px].map(information);
        SVector::from([0.0, 0.0, 0.0, shift, shift, shift, focal, distortion, centre, centre])
    }

    /// Where the model has a track in the second view, less where it is, px; `None` behind the camera.
    fn residual(&self, s: &TurnState, pair: &Pair) -> Option<Vector2<f64>> {
        let p = s.rotation * s.lift(&pair.first).push(1.0) + s.shift;
        (p.z > 1e-3).then(|| pair.scale * (p.xy() / p.z - s.lift(&pair.second)) * (-s.focal).exp())
    }

    fn squared(&self, s: &TurnState, pair: &Pair) -> f64 {
        self.residual(s, pair).map_or(f64::INFINITY, |e| e.norm_squared())
    }

    /// The residual, and its derivative by rotation (left), translation, and the unknowns of the lens.
    fn residual_jacobian(&self, s: &TurnState, pair: &Pair) -> Option<(Vector2<f64>, SMatrix<f64, 2, UNKNOWNS>)> {
        let turned = s.rotation * s.lift(&pair.first).push(1.0);
        let p = turned + s.shift;
        if p.z <= 1e-3 {
            return None;
        }
        let scale = pair.scale * (-s.focal).exp();
        let place = p.xy() / p.z;
        let residual = scale * (place - s.lift(&pair.second));
        let by_point = scale * Matrix2x3::new(1.0, 0.0, -place.x, 0.0, 1.0, -place.y) / p.z;
        let rotated = s.rotation.to_rotation_matrix().matrix().fixed_columns::<2>(0).into_owned();
        let by_lens = by_point * rotated * s.lift_jacobian(&pair.first) - scale * s.lift_jacobian(&pair.second);
        let mut jacobian = SMatrix::<f64, 2, UNKNOWNS>::zeros();
        jacobian.fixed_view_mut::<2, 3>(0, 0).copy_from(&(-by_point * turned.cross_matrix()));
        jacobian.fixed_view_mut::<2, 3>(0, 3).copy_from(&by_point);
        jacobian.fixed_view_mut::<2, OF_LENS>(0, LENS).copy_from(&by_lens);
        let mut by_focal = jacobian.column_mut(LENS);
        by_focal -= residual;
        Some((residual, jacobian))
    }

    /// Standard deviation on each axis as the median length tells it, px.
    fn typical_px(&self, s: &TurnState, lengths: &mut Vec<f64>) -> f64 {
        lengths.clear();
        lengths.extend(self.pairs.iter().map(|p| self.squared(s, p).sqrt()));
        median(lengths).unwrap_or(f64::INFINITY) / RAYLEIGH_MEDIAN
    }

    fn judge(&self, s: &TurnState, typical_px: f64) -> Option<ViewTurn> {
        if !agrees(self.pairs, |p| self.squared(s, p)) {
            return None;
        }
        let excess = variance(typical_px, self.pairs.len());
        let mut information = self.linearise(s).hessian / excess;
        information.fill_upper_triangle_with_lower_triangle();
        // What is known beforehand is as sure as it is.
        information += SMatrix::from_diagonal(&(self.prior() * (1.0 - 1.0 / excess)));
        let covariance = information.cholesky()?.inverse();
        // In units of the lens's own standard deviations: G = S_wl L⁻ᵀ with S_ll = L Lᵀ.
        let lens = covariance.fixed_view::<OF_LENS, OF_LENS>(LENS, LENS).into_owned().cholesky()?.l();
        let by_lens = covariance.fixed_view::<3, OF_LENS>(0, LENS) * lens.try_inverse()?.transpose();
        Some(ViewTurn {
            second_from_first: s.rotation,
            covariance: covariance.fixed_view::<3, 3>(0, 0) - by_lens * by_lens.transpose(),
            by_lens,
            state: *s,
        })
    }
}

impl LeastSquares for TurnProblem<'_> {
    type State = TurnState;
    type Normal = NormalEquations<UNKNOWNS>;

    fn linearise(&self, s: &TurnState) -> NormalEquations<UNKNOWNS> {
        let mut normal = NormalEquations::default();
        for pair in self.pairs {
            let Some((e, jacobian)) = self.residual_jacobian(s, pair) else { continue };
            let (e, jacobian) = (e / TRACK_PX, jacobian / TRACK_PX);
            let weight = self.loss.evaluate(e.norm_squared()).1;
            for axis in 0..2 {
                normal.add(&jacobian.row(axis).transpose(), e[axis], weight);
            }
        }
        let prior = self.prior();
        normal.hessian += SMatrix::from_diagonal(&prior);
        normal.gradient += prior.component_mul(&s.known());
        normal
    }

    fn cost(&self, s: &TurnState) -> f64 {
        let squared = |p| self.squared(s, p).min(NOWHERE_PX * NOWHERE_PX) / (TRACK_PX * TRACK_PX);
        let data: f64 = self.pairs.iter().map(|p| self.loss.evaluate(squared(p)).0).sum();
        let known = s.known();
        data + self.prior().dot(&known.component_mul(&known))
    }

    fn step(&self, s: &TurnState, delta: &SVector<f64, UNKNOWNS>) -> TurnState {
        let mut rotation = UnitQuaternion::from_scaled_axis(delta.fixed_rows::<3>(0).into_owned()) * s.rotation;
        rotation.renormalize_fast();
        TurnState {
            rotation,
            shift: s.shift + delta.fixed_rows::<3>(3),
            focal: s.focal + delta[LENS],
            distortion: s.distortion + delta[LENS + 1],
            centre: s.centre + delta.fixed_rows::<2>(LENS + 2),
        }
    }
}

/// A motion that explains the tracks.
struct ViewMotion {
    second_from_first: Se3<Second, First>,
    typical_px: f64,
}

fn matches(pairs: &[Pair]) -> impl Iterator<Item = (Vector2<f64>, Vector2<f64>)> + Clone + '_ {
    pairs.iter().map(|p| (p.first, p.second))
}

fn sampson_px2(motion: &Se3<Second, First>, focal_px: f64) -> impl Fn(&Pair) -> f64 {
    let essential = essential_of(motion);
    move |p| {
        let squared = sampson_squared(&essential, &p.first, &p.second) * focal_px * focal_px;
        // NaN where both are epipoles: any motion explains that.
        if squared.is_nan() { 0.0 } else { squared }
    }
}

/// The motion near the turn's rotation that explains the tracks best, if there is one.
fn motion(
    pairs: &[Pair],
    turn: &TurnState,
    typical_px: f64,
    focal_px: f64,
    lengths: &mut Vec<f64>,
) -> Option<ViewMotion> {
    let mut moment = Matrix3::zeros();
    for pair in pairs {
        let across = (turn.rotation * pair.first.push(1.0)).cross(&pair.second.push(1.0));
        // Few that are far off must not decide.
        moment += across * across.transpose() / (across.norm_squared() + (typical_px / focal_px).powi(2));
    }
    let eigen = SymmetricEigen::try_new(moment, 1e-12, 100)?;
    let start: Se3<Second, First> =
        Se3::new(turn.rotation, eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned());
    let options = lm_options();
    let loss = Loss::Cauchy(2.0 * typical_px.max(TRACK_PX) / focal_px);
    let near = refine_motion(&start, matches(pairs), loss, &options)?;
    let found = refine_motion(&near, matches(pairs), Loss::Cauchy(2.0 * TRACK_PX / focal_px), &options)?;
    let squared = sampson_px2(&found, focal_px);
    lengths.clear();
    lengths.extend(pairs.iter().map(|p| squared(p).sqrt()));
    let typical_px = SIGMA_OVER_MEDIAN * median(lengths)?;
    Some(ViewMotion { second_from_first: found, typical_px })
}

impl ViewMotion {
    fn turn(&self, pairs: &[Pair], lens: SupposedLens, state: TurnState) -> Option<ViewTurn> {
        let SupposedLens { focal_px, focal_sigma, distortion_sigma, .. } = lens;
        if !agrees(pairs, sampson_px2(&self.second_from_first, focal_px)) {
            return None;
        }
        let loss = Loss::Cauchy(2.0 * self.typical_px.max(TRACK_PX) / focal_px);
        let information = motion_information(&self.second_from_first, matches(pairs), loss)?
            * ((focal_px / TRACK_PX).powi(2) / variance(self.typical_px, pairs.len()));
        let covariance = information.cholesky()?.inverse();
        let rotation = self.second_from_first.rotation;
        // A turn across the axis is as much too large as the focal length is too short, or the distortion makes of the mean flow; about the
        // axis it is what it is. What a wrong principal point makes of the flow is none in the mean.
        let across = rotation.scaled_axis().component_mul(&Vector3::new(1.0, 1.0, 0.0));
        let square = pairs.iter().map(|p| p.second.norm_squared()).sum::<f64>() / pairs.len() as f64;
        Some(ViewTurn {
            second_from_first: rotation,
            covariance: covariance.fixed_view::<3, 3>(0, 0).into_owned(),
            by_lens: Matrix3x4::from_columns(&[
                across * focal_sigma,
                across * (2.0 * square * distortion_sigma),
                Vector3::zeros(),
                Vector3::zeros(),
            ]),
            state,
        })
    }
}

#[cfg(test)]
mod tests;
