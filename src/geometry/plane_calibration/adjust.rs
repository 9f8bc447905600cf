//! Least squares over a camera and many poses of a plane.
//!
//! Parameters: nine intrinsics and the shutter's readout time, which all views share, and six a view (left perturbation `[w, v]` of the
//! camera point: `dp = w x p + v`). Each view's 6x6 is eliminated, a 10x10 remains ([`arrow`](crate::geometry::least_squares::arrow)).
//!
//! Pixels and their derivatives: [`projection`](super::projection).

use nalgebra::{Matrix3, SMatrix, SVector, UnitQuaternion, Vector2, Vector3, Vector6};

use super::projection::{Intrinsics, LensKind, PARAMETERS};
use super::view::View;
use crate::geometry::least_squares::arrow::{ArrowEquations, Block, Reduced};
use crate::geometry::least_squares::{self, LeastSquares, LmOptions, Loss};

/// What all views share: the intrinsics, then the readout time.
pub const SHARED: usize = PARAMETERS + 1;
const READOUT: usize = PARAMETERS;
type Shared = SVector<f64, SHARED>;
type Matrix10 = SMatrix<f64, SHARED, SHARED>;

/// x_camera = rotation x_board + translation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    pub rotation: Matrix3<f64>,
    pub translation: Vector3<f64>,
}

impl Default for Pose {
    /// One unit in front of the camera.
    fn default() -> Self {
        Self { rotation: Matrix3::identity(), translation: Vector3::z() }
    }
}

/// Everything that is estimated.
#[derive(Debug, Clone, PartialEq)]
pub struct State {
    pub lens: LensKind,
    pub intrinsics: Intrinsics,
    /// Time from the first row's exposure to the last one's, s.
    pub readout_s: f64,
    /// One a view, used or not.
    pub poses: Vec<Pose>,
}

/// Which of the shared parameters are estimated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Unknowns {
    pub intrinsics: [bool; PARAMETERS],
    /// The readout time is supposed to be near zero, with this weight, px^2 / s^2. `None`: it is held.
    pub readout_weight: Option<f64>,
}

impl Unknowns {
    /// Poses only.
    const NONE: Self = Self { intrinsics: [false; PARAMETERS], readout_weight: None };
    /// Everything, and nothing supposed of it.
    const ALL: Self = Self { intrinsics: [true; PARAMETERS], readout_weight: Some(0.0) };

    fn free(&self) -> [bool; SHARED] {
        std::array::from_fn(|i| self.intrinsics.get(i).copied().unwrap_or(self.readout_weight.is_some()))
    }
}

/// Where it ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Adjusted {
    pub state: State,
    /// Sum of the losses of squared residuals, px².
    pub cost: f64,
}

fn camera_point(pose: &Pose, plane: &Vector2<f64>) -> Vector3<f64> {
    pose.rotation.column(0) * plane.x + pose.rotation.column(1) * plane.y + pose.translation
}

/// Seen minus predicted, pixels; infinite behind the camera.
pub fn residuals(view: &View, state: &State, index: usize) -> Vec<Vector2<f64>> {
    (0..view.plane.len().min(view.pixels.len()))
        .map(|n| residual(view, state, index, n).unwrap_or(Vector2::repeat(f64::INFINITY)))
        .collect()
}

fn residual(view: &View, state: &State, index: usize, point: usize) -> Option<Vector2<f64>> {
    let pixel = state.lens.project(&state.intrinsics, &camera_point(&state.poses[index], &view.plane[point]))?;
    Some(view.pixels[point] - pixel - view.shear_of(point) * state.readout_s)
}

/// Root mean square distance of a view's points, pixels.
pub fn view_rms(view: &View, state: &State, index: usize, mask: &[bool]) -> f64 {
    let residuals = residuals(view, state, index);
    let kept: Vec<f64> = residuals.iter().zip(mask).filter(|(_, m)| **m).map(|(r, _)| r.norm_squared()).collect();
    if kept.is_empty() { f64::INFINITY } else { (kept.iter().sum::<f64>() / kept.len() as f64).sqrt() }
}

/// What is fitted: the used views' points that their masks keep.
struct Problem<'a> {
    views: &'a [View],
    used: &'a [bool],
    masks: &'a [Vec<bool>],
    unknowns: &'a Unknowns,
    loss: Loss,
}

impl Problem<'_> {
    /// Used views with their indices.
    fn used(&self) -> impl Iterator<Item = (usize, &View)> {
        self.views.iter().enumerate().filter(|(k, _)| self.used[*k])
    }

    /// One view's block; its part of the shared parameters is added to `normal`.
    fn add_view(&self, state: &State, index: usize, free: &Shared, normal: &mut ArrowEquations<SHARED, 6>) {
        let (view, mut block) = (&self.views[index], Block::<SHARED, 6>::default());
        for point in (0..view.pixels.len()).filter(|n| self.masks[index][*n]) {
            let p = camera_point(&state.poses[index], &view.plane[point]);
            // Of finite cost: every point can be projected.
            let Some((pixel, du, dp)) = state.lens.project_jacobian(&state.intrinsics, &p) else { continue };
            let shear = view.shear_of(point);
            let r = pixel + shear * state.readout_s - view.pixels[point];
            let (_, weight) = self.loss.evaluate(r.norm_squared());
            for axis in 0..2 {
                let (a, b, r) = (&du[axis].push(shear[axis]).component_mul(free), &dp[axis], r[axis]);
                let wa = a * weight;
                let wb = b * weight;
                normal.shared.ger(1.0, &wa, a, 1.0);
                normal.gradient.axpy(r, &wa, 1.0);
                block.cross.ger(1.0, &wa, b, 1.0);
                block.own.ger(1.0, &wb, b, 1.0);
                block.gradient.axpy(r, &wb, 1.0);
            }
        }
        normal.blocks.push(block);
    }
}

impl LeastSquares for Problem<'_> {
    type State = State;
    type Normal = ArrowEquations<SHARED, 6>;

    /// One on the diagonal of parameters that are held, nothing beside it.
    fn linearise(&self, state: &State) -> Self::Normal {
        let free = self.unknowns.free().map(|free| if free { 1.0 } else { 0.0 });
        let mut normal = ArrowEquations::<SHARED, 6>::default();
        for i in 0..SHARED {
            normal.shared[(i, i)] = 1.0 - free[i];
        }
        if let Some(weight) = self.unknowns.readout_weight {
            normal.shared[(READOUT, READOUT)] = weight;
            normal.gradient[READOUT] = weight * state.readout_s;
        }
        for (index, _) in self.used() {
            self.add_view(state, index, &free.into(), &mut normal);
        }
        normal
    }

    fn cost(&self, state: &State) -> f64 {
        let mut sum = self.unknowns.readout_weight.map_or(0.0, |weight| weight * state.readout_s * state.readout_s);
        for (k, view) in self.used() {
            for point in (0..view.pixels.len()).filter(|n| self.masks[k][*n]) {
                match residual(view, state, k, point) {
                    Some(r) => sum += self.loss.evaluate(r.norm_squared()).0,
                    None => return f64::INFINITY,
                }
            }
        }
        if sum.is_nan() { f64::INFINITY } else { sum }
    }

    fn step(&self, state: &State, (shared, poses): &(Shared, Vec<Vector6<f64>>)) -> State {
        let mut next = state.clone();
        next.intrinsics += shared.fixed_rows::<PARAMETERS>(0);
        next.readout_s += shared[READOUT];
        for ((index, _), delta) in self.used().zip(poses) {
            next.poses[index] = moved_pose(&state.poses[index], delta);
        }
        next
    }
}

/// Inverse on the free parameters, zero elsewhere; scaled so that units do not matter.
pub fn invert(matrix: &Matrix10, unknowns: &Unknowns) -> Option<Matrix10> {
    let free = unknowns.free();
    let scale = Shared::from_fn(|i, _| 1.0 / matrix[(i, i)].abs().sqrt());
    let scaled = Matrix10::from_fn(|r, c| matrix[(r, c)] * scale[r] * scale[c]);
    let inverse = scaled.cholesky()?.inverse();
    Some(Matrix10::from_fn(|r, c| if free[r] && free[c] { inverse[(r, c)] * scale[r] * scale[c] } else { 0.0 }))
}

/// By how much the views pull each shared parameter farther apart than views of corners with independent errors would: shares of the
/// standard deviation, at least 1. More than 1: corners of one view err together, or the lens is not quite of the model. `covariance`: of
/// the shared parameters, for errors of `variance`.
///
/// With g a view's gradient at the solution and I its information, poses eliminated, C g is what it pulls, and independent errors
/// give `E[g gᵀ] = I - I C I`, all in units of the variance (a sandwich estimate over views, Liang & Zeger 1986). Single parameters scatter too much for
/// so few views, so focal lengths and centre have one factor, the lens's coefficients and the readout time another.
pub fn scatter(
    views: &[View],
    used: &[bool],
    masks: &[Vec<bool>],
    state: &State,
    covariance: &Matrix10,
    variance: f64,
) -> Shared {
    let unit = covariance / variance;
    let group = |i: usize| usize::from(i >= 4);
    let (mut seen, mut expected) = ([0.0; 2], [0.0; 2]);
    for k in (0..views.len()).filter(|k| used[*k]) {
        let alone: Vec<bool> = (0..views.len()).map(|n| n == k).collect();
        // What is held is of no account: its covariance is zero.
        let problem = Problem { views, used: &alone, masks, unknowns: &Unknowns::ALL, loss: Loss::Squared };
        let Some(Reduced { information, gradient, .. }) = problem.linearise(state).reduce(0.0) else { continue };
        let pull = unit * gradient;
        let share = unit * information;
        let independent = (share - share * share) * unit;
        for i in (0..SHARED).filter(|i| unit[(*i, *i)] > 0.0) {
            seen[group(i)] += pull[i] * pull[i] / unit[(i, i)];
            expected[group(i)] += variance * independent[(i, i)] / unit[(i, i)];
        }
    }
    Shared::from_fn(|i, _| {
        let ratio = seen[group(i)] / expected[group(i)];
        if ratio.is_finite() { ratio.max(1.0).sqrt() } else { 1.0 }
    })
}

/// Information of the shared parameters with the poses eliminated (px^-2 for residuals of one pixel).
pub fn reduced_information(
    views: &[View],
    used: &[bool],
    masks: &[Vec<bool>],
    state: &State,
    unknowns: &Unknowns,
) -> Matrix10 {
    let problem = Problem { views, used, masks, unknowns, loss: Loss::Squared };
    problem.linearise(state).reduce(0.0).map_or_else(Matrix10::zeros, |reduced| reduced.information)
}

fn moved_pose(pose: &Pose, delta: &Vector6<f64>) -> Pose {
    let turn =
        UnitQuaternion::from_scaled_axis(delta.fixed_rows::<3>(0).into_owned()).to_rotation_matrix().into_inner();
    Pose { rotation: turn * pose.rotation, translation: turn * pose.translation + delta.fixed_rows::<3>(3) }
}

/// Minimises over the unknowns and the poses of the used views.
pub fn minimise(
    views: &[View],
    used: &[bool],
    masks: &[Vec<bool>],
    start: State,
    unknowns: &Unknowns,
    loss: Loss,
    max_iterations: usize,
) -> Adjusted {
    let problem = Problem { views, used, masks, unknowns, loss };
    let options = LmOptions { max_iterations, ..LmOptions::default() };
    let (mut state, summary) = least_squares::minimise(&problem, start, &options);
    // Rotations stay rotations over hundreds of products.
    for pose in &mut state.poses {
        let q = crate::geometry::rotation::quaternion(&pose.rotation);
        pose.rotation = q.to_rotation_matrix().into_inner();
    }
    Adjusted { state, cost: summary.final_cost }
}

/// The pose of one view alone, all else held.
pub fn refine_pose(view: &View, state: &mut State, index: usize) {
    let alone = [view.clone()];
    let mask = [vec![true; view.pixels.len()]];
    let start = State { poses: vec![state.poses[index]], ..*state };
    let adjusted = minimise(&alone, &[true], &mask, start, &Unknowns::NONE, Loss::Huber(2.0), 30);
    state.poses[index] = adjusted.state.poses[0];
}
