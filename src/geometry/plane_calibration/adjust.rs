//! Least squares over a camera and many poses of a plane.
//!
//! Parameters: nine intrinsics and six a view (left perturbation `[w, v]` of the camera point: `dp = w x p + v`). The normal equations
//! are solved by blocks: each view's 6x6 is eliminated, a 9x9 remains (Schur). Damping by Marquardt with Nielsen's update, as in
//! [`crate::geometry::least_squares`], which is for a handful of parameters only.
//!
//! Pixels and their derivatives: [`projection`](super::projection).

use nalgebra::{Matrix3, SMatrix, UnitQuaternion, Vector2, Vector3, Vector6};

use super::View;
use super::projection::{Intrinsics, LensKind, PARAMETERS};
use crate::geometry::least_squares::Loss;

type Matrix9 = SMatrix<f64, PARAMETERS, PARAMETERS>;
type Matrix96 = SMatrix<f64, PARAMETERS, 6>;
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
    /// One a view, used or not.
    pub poses: Vec<Pose>,
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
    let pose = state.poses[index];
    view.plane
        .iter()
        .zip(&view.pixels)
        .map(|(plane, seen)| match state.lens.project(&state.intrinsics, &camera_point(&pose, plane)) {
            Some(pixel) => seen - pixel,
            None => Vector2::repeat(f64::INFINITY),
        })
        .collect()
}

/// Root mean square distance of a view's points, pixels.
pub fn view_rms(view: &View, state: &State, index: usize, mask: &[bool]) -> f64 {
    let residuals = residuals(view, state, index);
    let kept: Vec<f64> = residuals.iter().zip(mask).filter(|(_, m)| **m).map(|(r, _)| r.norm_squared()).collect();
    if kept.is_empty() { f64::INFINITY } else { (kept.iter().sum::<f64>() / kept.len() as f64).sqrt() }
}

fn cost(views: &[View], used: &[bool], masks: &[Vec<bool>], state: &State, loss: Loss) -> f64 {
    let mut sum = 0.0;
    for (k, view) in views.iter().enumerate().filter(|(k, _)| used[*k]) {
        for ((plane, seen), keep) in view.plane.iter().zip(&view.pixels).zip(&masks[k]) {
            if *keep {
                match state.lens.project(&state.intrinsics, &camera_point(&state.poses[k], plane)) {
                    Some(pixel) => sum += loss.evaluate((seen - pixel).norm_squared()).0,
                    None => return f64::INFINITY,
                }
            }
        }
    }
    if sum.is_nan() { f64::INFINITY } else { sum }
}

/// One view's part of the normal equations.
#[derive(Clone)]
struct Block {
    index: usize,
    /// Intrinsics by pose, pose by pose, and the pose's gradient.
    cross: Matrix96,
    pose: Matrix6,
    gradient: Vector6<f64>,
}

struct Normal {
    intrinsics: Matrix9,
    gradient: Intrinsics,
    blocks: Vec<Block>,
}

fn linearise(views: &[View], used: &[bool], masks: &[Vec<bool>], state: &State, loss: Loss) -> Option<Normal> {
    let mut normal = Normal { intrinsics: Matrix9::zeros(), gradient: Intrinsics::zeros(), blocks: Vec::new() };
    for (index, view) in views.iter().enumerate().filter(|(k, _)| used[*k]) {
        let mut block = Block { index, cross: Matrix96::zeros(), pose: Matrix6::zeros(), gradient: Vector6::zeros() };
        for ((plane, seen), keep) in view.plane.iter().zip(&view.pixels).zip(&masks[index]) {
            if !*keep {
                continue;
            }
            let p = camera_point(&state.poses[index], plane);
            let (pixel, du, dp) = state.lens.project_jacobian(&state.intrinsics, &p)?;
            let r = seen - pixel;
            let (_, weight) = loss.evaluate(r.norm_squared());
            for axis in 0..2 {
                let (a, b, r) = (&du[axis], &dp[axis], r[axis]);
                let wa = a * weight;
                let wb = b * weight;
                normal.intrinsics.ger(1.0, &wa, a, 1.0);
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
fn hold(matrix: &mut Matrix9, free: &[bool; PARAMETERS]) {
    for (i, _) in free.iter().enumerate().filter(|(_, f)| !**f) {
        matrix.row_mut(i).fill(0.0);
        matrix.column_mut(i).fill(0.0);
        matrix[(i, i)] = 1.0;
    }
}

/// Inverse on the free parameters, zero elsewhere; scaled so that units do not matter.
pub fn invert(matrix: &Matrix9, free: &[bool; PARAMETERS]) -> Option<Matrix9> {
    let mut held = *matrix;
    hold(&mut held, free);
    let scale = Intrinsics::from_fn(|i, _| 1.0 / held[(i, i)].abs().sqrt());
    let scaled = Matrix9::from_fn(|r, c| held[(r, c)] * scale[r] * scale[c]);
    let inverse = scaled.cholesky()?.inverse();
    Some(Matrix9::from_fn(|r, c| if free[r] && free[c] { inverse[(r, c)] * scale[r] * scale[c] } else { 0.0 }))
}

/// Information of the intrinsics with the poses eliminated (px^-2 for residuals of one pixel).
pub fn reduced_information(
    views: &[View],
    used: &[bool],
    masks: &[Vec<bool>],
    state: &State,
    _free: &[bool; PARAMETERS],
) -> Matrix9 {
    let Some(normal) = linearise(views, used, masks, state, Loss::Squared) else { return Matrix9::zeros() };
    let mut reduced = normal.intrinsics;
    for block in &normal.blocks {
        if let Some(cholesky) = block.pose.cholesky() {
            reduced -= block.cross * cholesky.solve(&block.cross.transpose());
        }
    }
    reduced
}

/// Step of everything at one damping.
fn solve(normal: &Normal, damping: f64, free: &[bool; PARAMETERS]) -> Option<(Intrinsics, Vec<Vector6<f64>>)> {
    let damp = |v: f64| v * (1.0 + damping) + 1e-300;
    let mut reduced = normal.intrinsics;
    for i in 0..PARAMETERS {
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
        let from_intrinsics = cholesky.solve(&block.cross.transpose());
        let from_gradient = cholesky.solve(&block.gradient);
        reduced -= block.cross * from_intrinsics;
        right -= block.cross * from_gradient;
        eliminated.push((from_intrinsics, from_gradient));
    }
    hold(&mut reduced, free);
    for (i, _) in free.iter().enumerate().filter(|(_, f)| !**f) {
        right[i] = 0.0;
    }
    let scale = Intrinsics::from_fn(|i, _| 1.0 / reduced[(i, i)].abs().sqrt());
    let scaled = Matrix9::from_fn(|r, c| reduced[(r, c)] * scale[r] * scale[c]);
    let step = scaled.cholesky()?.solve(&right.component_mul(&scale)).component_mul(&scale);
    let poses = eliminated.iter().map(|(by_intrinsics, own)| own - by_intrinsics * step).collect();
    Some((step, poses))
}

fn moved_pose(pose: &Pose, delta: &Vector6<f64>) -> Pose {
    let turn =
        UnitQuaternion::from_scaled_axis(delta.fixed_rows::<3>(0).into_owned()).to_rotation_matrix().into_inner();
    Pose { rotation: turn * pose.rotation, translation: turn * pose.translation + delta.fixed_rows::<3>(3) }
}

fn moved(state: &State, normal: &Normal, step: &(Intrinsics, Vec<Vector6<f64>>)) -> State {
    let mut next = state.clone();
    next.intrinsics += step.0;
    for (block, delta) in normal.blocks.iter().zip(&step.1) {
        next.poses[block.index] = moved_pose(&state.poses[block.index], delta);
    }
    next
}

/// Minimises over the free intrinsics and the poses of the used views.
pub fn minimise(
    views: &[View],
    used: &[bool],
    masks: &[Vec<bool>],
    start: State,
    free: &[bool; PARAMETERS],
    loss: Loss,
    max_iterations: usize,
) -> Adjusted {
    let mut state = start;
    let mut current = cost(views, used, masks, &state, loss);
    let (mut damping, mut growth) = (1e-4, 2.0);
    let mut normal = if current.is_finite() { linearise(views, used, masks, &state, loss) } else { None };
    let mut iterations = 0;
    let mut small = 0;
    while iterations < max_iterations {
        iterations += 1;
        let Some(at) = normal.as_ref() else { break };
        let trial = solve(at, damping, free).map(|step| moved(&state, at, &step));
        let trial_cost = trial.as_ref().map_or(f64::INFINITY, |t| cost(views, used, masks, t, loss));
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
                normal = linearise(views, used, masks, &state, loss);
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

/// The pose of one view alone, the camera held.
pub fn refine_pose(view: &View, state: &mut State, index: usize) {
    let alone = [view.clone()];
    let mask = [vec![true; view.pixels.len()]];
    let start = State { lens: state.lens, intrinsics: state.intrinsics, poses: vec![state.poses[index]] };
    let adjusted = minimise(&alone, &[true], &mask, start, &[false; PARAMETERS], Loss::Huber(2.0), 30);
    state.poses[index] = adjusted.state.poses[0];
}
