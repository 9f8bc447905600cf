//! Least squares over a camera and many poses of a plane.
//!
//! Parameters: nine intrinsics and the shutter's readout time, which all views share, and six a view (left perturbation `[w, v]` of the
//! camera point: `dp = w x p + v`). The normal equations are solved by blocks: each view's 6x6 is eliminated, a 10x10 remains (Schur). Damping by Marquardt with Nielsen's update, as in
//! [`crate::geometry::least_squares`], which is for a handful of parameters only.
//!
//! Pixels and their derivatives: [`projection`](super::projection).

use nalgebra::{Matrix3, SMatrix, SVector, UnitQuaternion, Vector2, Vector3, Vector6};

use super::projection::{Intrinsics, LensKind, PARAMETERS};
use super::view::View;
use crate::geometry::least_squares::Loss;

/// What all views share: the intrinsics, then the readout time.
pub const SHARED: usize = PARAMETERS + 1;
const READOUT: usize = PARAMETERS;
type Shared = SVector<f64, SHARED>;
type Matrix10 = SMatrix<f64, SHARED, SHARED>;
type Matrix106 = SMatrix<f64, SHARED, 6>;
type Matrix6 = SMatrix<f64, 6, 6>;

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
    pub iterations: usize,
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

fn cost(views: &[View], used: &[bool], masks: &[Vec<bool>], state: &State, unknowns: &Unknowns, loss: Loss) -> f64 {
    let mut sum = unknowns.readout_weight.map_or(0.0, |weight| weight * state.readout_s * state.readout_s);
    for (k, view) in views.iter().enumerate().filter(|(k, _)| used[*k]) {
        for point in (0..view.pixels.len()).filter(|n| masks[k][*n]) {
            match residual(view, state, k, point) {
                Some(r) => sum += loss.evaluate(r.norm_squared()).0,
                None => return f64::INFINITY,
            }
        }
    }
    if sum.is_nan() { f64::INFINITY } else { sum }
}

/// One view's part of the normal equations.
#[derive(Clone)]
struct Block {
    index: usize,
    /// Shared by pose, pose by pose, and the pose's gradient.
    cross: Matrix106,
    pose: Matrix6,
    gradient: Vector6<f64>,
}

struct Normal {
    shared: Matrix10,
    gradient: Shared,
    blocks: Vec<Block>,
}

fn linearise(
    views: &[View],
    used: &[bool],
    masks: &[Vec<bool>],
    state: &State,
    unknowns: &Unknowns,
    loss: Loss,
) -> Option<Normal> {
    let mut normal = Normal { shared: Matrix10::zeros(), gradient: Shared::zeros(), blocks: Vec::new() };
    if let Some(weight) = unknowns.readout_weight {
        normal.shared[(READOUT, READOUT)] = weight;
        normal.gradient[READOUT] = -weight * state.readout_s;
    }
    for (index, view) in views.iter().enumerate().filter(|(k, _)| used[*k]) {
        let mut block = Block { index, cross: Matrix106::zeros(), pose: Matrix6::zeros(), gradient: Vector6::zeros() };
        for point in (0..view.pixels.len()).filter(|n| masks[index][*n]) {
            let p = camera_point(&state.poses[index], &view.plane[point]);
            let (pixel, du, dp) = state.lens.project_jacobian(&state.intrinsics, &p)?;
            let shear = view.shear_of(point);
            let r = view.pixels[point] - pixel - shear * state.readout_s;
            let (_, weight) = loss.evaluate(r.norm_squared());
            for axis in 0..2 {
                let (a, b, r) = (&du[axis].push(shear[axis]), &dp[axis], r[axis]);
                let wa = a * weight;
                let wb = b * weight;
                normal.shared.ger(1.0, &wa, a, 1.0);
                normal.gradient.axpy(r, &wa, 1.0);
                block.cross.ger(1.0, &wa, b, 1.0);
                block.pose.ger(1.0, &wb, b, 1.0);
                block.gradient.axpy(r, &wb, 1.0);
            }
        }
        normal.blocks.push(block);
    }
    Some(normal)
}

/// Holds the parameters that are not free: identity there, nothing beside it.
fn hold(matrix: &mut Matrix10, free: &[bool; SHARED]) {
    for (i, _) in free.iter().enumerate().filter(|(_, f)| !**f) {
        matrix.row_mut(i).fill(0.0);
        matrix.column_mut(i).fill(0.0);
        matrix[(i, i)] = 1.0;
    }
}

/// Inverse on the free parameters, zero elsewhere; scaled so that units do not matter.
pub fn invert(matrix: &Matrix10, unknowns: &Unknowns) -> Option<Matrix10> {
    let free = unknowns.free();
    let mut held = *matrix;
    hold(&mut held, &free);
    let scale = Shared::from_fn(|i, _| 1.0 / held[(i, i)].abs().sqrt());
    let scaled = Matrix10::from_fn(|r, c| held[(r, c)] * scale[r] * scale[c]);
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
        let Some(normal) = linearise(views, &alone, masks, state, &Unknowns::NONE, Loss::Squared) else { continue };
        let Some(block) = normal.blocks.first() else { continue };
        let Some(cholesky) = block.pose.cholesky() else { continue };
        let information = normal.shared - block.cross * cholesky.solve(&block.cross.transpose());
        let pull = unit * (normal.gradient - block.cross * cholesky.solve(&block.gradient));
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
    let Some(normal) = linearise(views, used, masks, state, unknowns, Loss::Squared) else { return Matrix10::zeros() };
    let mut reduced = normal.shared;
    for block in &normal.blocks {
        if let Some(cholesky) = block.pose.cholesky() {
            reduced -= block.cross * cholesky.solve(&block.cross.transpose());
        }
    }
    reduced
}

/// Step of everything at one damping.
fn solve(normal: &Normal, damping: f64, free: &[bool; SHARED]) -> Option<(Shared, Vec<Vector6<f64>>)> {
    let damp = |v: f64| v * (1.0 + damping) + 1e-300;
    let mut reduced = normal.shared;
    for i in 0..SHARED {
        reduced[(i, i)] = damp(reduced[(i, i)]);
    }
    let mut right = normal.gradient;
    let mut eliminated = Vec::with_capacity(normal.blocks.len());
    for block in &normal.blocks {
        let mut pose = block.pose;
        for i in 0..6 {
            pose[(i, i)] = damp(pose[(i, i)]);
        }
        let cholesky = pose.cholesky()?;
        let from_shared = cholesky.solve(&block.cross.transpose());
        let from_gradient = cholesky.solve(&block.gradient);
        reduced -= block.cross * from_shared;
        right -= block.cross * from_gradient;
        eliminated.push((from_shared, from_gradient));
    }
    hold(&mut reduced, free);
    for (i, _) in free.iter().enumerate().filter(|(_, f)| !**f) {
        right[i] = 0.0;
    }
    let scale = Shared::from_fn(|i, _| 1.0 / reduced[(i, i)].abs().sqrt());
    let scaled = Matrix10::from_fn(|r, c| reduced[(r, c)] * scale[r] * scale[c]);
    let step = scaled.cholesky()?.solve(&right.component_mul(&scale)).component_mul(&scale);
    let poses = eliminated.iter().map(|(by_shared, own)| own - by_shared * step).collect();
    Some((step, poses))
}

fn moved_pose(pose: &Pose, delta: &Vector6<f64>) -> Pose {
    let turn =
        UnitQuaternion::from_scaled_axis(delta.fixed_rows::<3>(0).into_owned()).to_rotation_matrix().into_inner();
    Pose { rotation: turn * pose.rotation, translation: turn * pose.translation + delta.fixed_rows::<3>(3) }
}

fn moved(state: &State, normal: &Normal, step: &(Shared, Vec<Vector6<f64>>)) -> State {
    let mut next = state.clone();
    next.intrinsics += step.0.fixed_rows::<PARAMETERS>(0);
    next.readout_s += step.0[READOUT];
    for (block, delta) in normal.blocks.iter().zip(&step.1) {
        next.poses[block.index] = moved_pose(&state.poses[block.index], delta);
    }
    next
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
    let free = unknowns.free();
    let mut state = start;
    let mut current = cost(views, used, masks, &state, unknowns, loss);
    let (mut damping, mut growth) = (1e-4, 2.0);
    let mut normal = if current.is_finite() { linearise(views, used, masks, &state, unknowns, loss) } else { None };
    let mut iterations = 0;
    let mut small = 0;
    while iterations < max_iterations {
        iterations += 1;
        let Some(at) = normal.as_ref() else { break };
        let trial = solve(at, damping, &free).map(|step| moved(&state, at, &step));
        let trial_cost = trial.as_ref().map_or(f64::INFINITY, |t| cost(views, used, masks, t, unknowns, loss));
        match trial {
            Some(trial) if trial_cost < current => {
                let gain = (current - trial_cost) / current.max(1e-300);
                state = trial;
                current = trial_cost;
                damping = (damping / 10.0).max(1e-12);
                growth = 2.0;
                // Twice in a row, because a step may be short only because it was damped.
                small = if gain < 1e-9 { small + 1 } else { 0 };
                if small >= 2 {
                    break;
                }
                normal = linearise(views, used, masks, &state, unknowns, loss);
            }
            _ => {
                damping *= growth;
                growth *= 2.0;
                if damping > 1e12 {
                    break;
                }
            }
        }
    }
    // Rotations stay rotations over hundreds of products.
    for pose in &mut state.poses {
        let q = crate::geometry::rotation::quaternion(&pose.rotation);
        pose.rotation = q.to_rotation_matrix().into_inner();
    }
    Adjusted { state, cost: current, iterations }
}

/// The pose of one view alone, all else held.
pub fn refine_pose(view: &View, state: &mut State, index: usize) {
    let alone = [view.clone()];
    let mask = [vec![true; view.pixels.len()]];
    let start = State { poses: vec![state.poses[index]], ..*state };
    let adjusted = minimise(&alone, &[true], &mask, start, &Unknowns::NONE, Loss::Huber(2.0), 30);
    state.poses[index] = adjusted.state.poses[0];
}
