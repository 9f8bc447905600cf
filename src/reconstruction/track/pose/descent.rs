//! The residual of a pair, its derivative, and a descent to the pose that a set of pairs wants.

use nalgebra::{Matrix6, Vector6};

use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::reconstruction::measurement::{CHI2_2D_95, PosePair, accumulate, jacobian_rows, residual};

/// Options of [`optimise_pose`](super::optimise_pose).
#[derive(Debug, Clone, Copy)]
pub struct PoseOptions {
    /// Rounds of optimisation, outliers judged anew after each.
    pub rounds: usize,
    /// Gauss-Newton steps a round at the most.
    pub steps: usize,
    /// Limit of the squared, sigma-scaled residual above which a pair is an outlier.
    pub outlier_chi2: f64,
    /// The first round uses this many times the limit and a Cauchy weight: a poor start must not throw good pairs out.
    pub first_round_relaxation: f64,
    /// Pairs with leverage are judged by what the others make of them (`most_contradicted`). Not where distances are eliminated:
    /// such pairs agree with every way of the camera, and would contradict the few that know it.
    pub leverage: bool,
}

impl Default for PoseOptions {
    fn default() -> Self {
        Self { rounds: 3, steps: 6, outlier_chi2: CHI2_2D_95, first_round_relaxation: 4.0, leverage: true }
    }
}

/// Gauss-Newton steps with Levenberg damping over the current inliers.
pub(super) fn descend(
    start: &Se3<Camera, World>,
    pairs: &[PosePair],
    inlier: &[bool],
    options: &PoseOptions,
    relaxed: bool,
) -> Option<Se3<Camera, World>> {
    let mut pose = *start;
    let mut lambda = 1e-6;
    let (mut h, mut g, mut cost) = linearise(&pose, pairs, inlier, options.outlier_chi2, relaxed);
    for _ in 0..options.steps {
        let mut damped = h;
        for i in 0..6 {
            damped[(i, i)] += lambda * h[(i, i)].max(1e-12);
        }
        let step: Vector6<f64> = damped.cholesky()?.solve(&-g);
        if !step.iter().all(|v| v.is_finite()) {
            return None;
        }
        let candidate = pose.perturb_left(&step);
        let (h2, g2, cost2) = linearise(&candidate, pairs, inlier, options.outlier_chi2, relaxed);
        if cost2 <= cost {
            let gain = cost - cost2;
            (pose, h, g) = (candidate, h2, g2);
            let done = gain < 1e-6 * cost || step.norm_squared() < 1e-16;
            cost = cost2;
            lambda = (lambda * 0.1).max(1e-9);
            if done {
                break;
            }
        } else {
            lambda = (lambda * 100.0).max(1e-4);
        }
    }
    Some(pose)
}

pub(super) fn mirror(h: &mut Matrix6<f64>) {
    for c in 0..6 {
        for r in 0..c {
            h[(c, r)] = h[(r, c)];
        }
    }
}

/// Normal equations over the current inliers; Cauchy weights when `relaxed`, Huber's else.
fn linearise(
    pose: &Se3<Camera, World>,
    pairs: &[PosePair],
    inlier: &[bool],
    delta2: f64,
    relaxed: bool,
) -> (Matrix6<f64>, Vector6<f64>, f64) {
    let (mut h, mut g, mut cost) = (Matrix6::zeros(), Vector6::zeros(), 0.0);
    for (pair, _) in pairs.iter().zip(inlier).filter(|(_, ok)| **ok) {
        let Some((e, p)) = residual(pose, pair) else {
            cost += 100.0 * delta2; // behind the camera: a constant price, so that a step that does this is no gain
            continue;
        };
        let e2 = e.norm_squared();
        let w;
        if relaxed {
            cost += delta2 * (1.0 + e2 / delta2).ln();
            w = 1.0 / (1.0 + e2 / delta2);
        } else if e2 <= delta2 {
            cost += e2;
            w = 1.0;
        } else {
            let root = (e2 * delta2).sqrt();
            cost += 2.0 * root - delta2;
            w = delta2 / root;
        }
        let s = pair.inv_sigma_px;
        let (jx, jy) = jacobian_rows(&p, &(pair.pixel_scale * s));
        accumulate(&mut h, &jx, &jy, w);
        for i in 0..6 {
            g[i] += w * (jx[i] * e.x + jy[i] * e.y);
        }
    }
    mirror(&mut h);
    (h, g, cost)
}
