//! The residual of a pair, its derivative, and a descent to the pose that a set of pairs wants.

use nalgebra::{Matrix2, Matrix6, Vector2, Vector3, Vector6};

use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::map::Observation;

/// 95 % limit of chi-square with two degrees of freedom.
pub const CHI2_2D_95: f64 = 5.991;

/// One landmark seen in the frame.
#[derive(Debug, Clone, Copy)]
pub struct PosePair {
    /// World coordinates, map units.
    pub point: Vector3<f64>,
    /// Undistorted observation on the plane z = 1.
    pub normalised: Vector2<f64>,
    /// Pixels that steps on that plane count as there.
    pub pixel_scale: Matrix2<f64>,
    /// One over the standard deviation, 1/px.
    pub inv_sigma_px: f64,
}

impl PosePair {
    /// What a keyframe saw of `point`, as its middle row's pose would have seen it, for a readout time in seconds.
    pub fn observed(point: Vector3<f64>, seen: &Observation, camera: &CameraModel, readout_s: f64) -> Self {
        Self {
            point,
            normalised: seen.at_middle_row(readout_s),
            pixel_scale: camera.pixel_scale(&seen.normalised),
            inv_sigma_px: seen.inv_sigma_px,
        }
    }
}

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

/// Residual (sigma-scaled, px) of a pair; `None` behind the camera.
#[inline]
pub(super) fn residual(pose: &Se3<Camera, World>, pair: &PosePair) -> Option<(Vector2<f64>, Vector3<f64>)> {
    let p = pose.transform(&pair.point);
    if p.z < 1e-6 {
        return None;
    }
    let iz = 1.0 / p.z;
    Some((scaled(&pair.pixel_scale, pair.inv_sigma_px, p.x * iz - pair.normalised.x, p.y * iz - pair.normalised.y), p))
}

/// A pinhole's scale: the short way then, with the same bits as the long one.
#[inline]
pub(crate) fn is_diagonal(scale: &Matrix2<f64>) -> bool {
    scale.m12 == 0.0 && scale.m21 == 0.0
}

/// A step on the plane z = 1 in pixels, times `factor`.
#[inline]
pub(crate) fn scaled(scale: &Matrix2<f64>, factor: f64, x: f64, y: f64) -> Vector2<f64> {
    let m = |v: f64| factor * v;
    if is_diagonal(scale) {
        return Vector2::new(m(scale.m11) * x, m(scale.m22) * y);
    }
    Vector2::new(m(scale.m11) * x + m(scale.m12) * y, m(scale.m21) * x + m(scale.m22) * y)
}

/// Rows of d e / d delta at camera point `p`: tangent `[rotation, translation]`, `p' = exp(w) p + v`.
#[inline]
pub(crate) fn jacobian_rows(p: &Vector3<f64>, scale: &Matrix2<f64>) -> ([f64; 6], [f64; 6]) {
    let iz = 1.0 / p.z;
    let (u, v) = (p.x * iz, p.y * iz);
    // d(u, v)/dp = iz [1 0 -u; 0 1 -v]; dp/dw = -[p]x, dp/dv = I.
    if is_diagonal(scale) {
        let (fx, fy) = (scale.m11, scale.m22);
        return (
            [-fx * u * v, fx * (1.0 + u * u), -fx * v, fx * iz, 0.0, -fx * u * iz],
            [-fy * (1.0 + v * v), fy * u * v, fy * u, 0.0, fy * iz, -fy * v * iz],
        );
    }
    let row = |a: f64, b: f64| {
        [
            -a * u * v - b * (1.0 + v * v),
            a * (1.0 + u * u) + b * u * v,
            -a * v + b * u,
            a * iz,
            b * iz,
            -a * u * iz - b * v * iz,
        ]
    };
    (row(scale.m11, scale.m12), row(scale.m21, scale.m22))
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

#[inline]
pub(crate) fn accumulate(h: &mut Matrix6<f64>, jx: &[f64; 6], jy: &[f64; 6], w: f64) {
    for c in 0..6 {
        let (a, b) = (w * jx[c], w * jy[c]);
        for r in 0..=c {
            h[(r, c)] += jx[r] * a + jy[r] * b;
        }
    }
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
