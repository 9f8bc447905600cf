//! Bundle adjustment: keyframe poses and landmark positions together, landmarks eliminated by the Schur complement.
//!
//! Input: cameras (some held fixed), points, observations grouped by point; undistorted coordinates on z = 1. Output: the
//! same, moved to a minimum of `sum rho(|e|^2)` with Huber's rho. Levenberg-Marquardt; for damped normal equations
//! `[B E; Eᵀ C]` the reduced camera system is `S = B - E C⁻¹ Eᵀ` (Triggs et al. 2000, section 6.1), dense in f64, the 3x3
//! blocks of C inverted in closed form. Two passes: outliers are taken out between them. Sequential: same input, same bits.
//! Cost: for 10 free cameras and 1,500 points about 2 ms a step. Numbers that all pictures share (the
//! intrinsics) can be unknowns as well: a border of the reduced system. Not here: rolling shutter, gauge (hold at
//! least one camera fixed, or rely on the damping for the scale).

use nalgebra::{DMatrix, DVector, Matrix2, Matrix3, Matrix6, SMatrix, Vector2, Vector3, Vector6};

mod shared;
mod uncertainty;

pub use shared::{CALIBRATED_SHARED, Readout, SHARED, Shared, SharedJacobian, SharedMatrix, SharedVector};

use super::pose_optimisation::{accumulate, is_diagonal, jacobian_rows, scaled};
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};

/// A keyframe's pose in the problem.
#[derive(Debug, Clone, Copy)]
pub struct BundleCamera {
    pub camera_from_world: Se3<Camera, World>,
    pub fixed: bool,
}

/// One point seen by one camera.
#[derive(Debug, Clone, Copy)]
pub struct BundleObservation {
    /// Index into the cameras.
    pub camera: u32,
    /// Undistorted, plane z = 1, as it was seen.
    pub normalised: Vector2<f64>,
    /// How far a rolling shutter moved it, per second of readout time.
    pub displacement: Vector2<f64>,
    /// Pixels that steps on that plane count as there.
    pub pixel_scale: Matrix2<f64>,
    /// One over the standard deviation, 1/px.
    pub inv_sigma_px: f64,
}

type Matrix6xS = SMatrix<f64, 6, SHARED>;
type MatrixSx3 = SMatrix<f64, SHARED, 3>;

/// A bundle adjustment problem and, after [`adjust`](Self::adjust), its solution.
#[derive(Debug, Clone, Default)]
pub struct BundleProblem {
    pub cameras: Vec<BundleCamera>,
    /// World coordinates.
    pub points: Vec<Vector3<f64>>,
    /// `first[i]..first[i + 1]` are the observations of point i; one longer than `points`.
    pub first: Vec<u32>,
    pub observations: Vec<BundleObservation>,
    pub readout: Readout,
    /// `None`: the intrinsics are right as they are.
    pub shared: Option<Shared>,
    /// Set by the adjustment: false = judged an outlier.
    pub inlier: Vec<bool>,
    /// Set by the adjustment: covariance of each point with the cameras held fixed, map units squared.
    pub point_covariances: Vec<Matrix3<f64>>,
}

/// Options of [`BundleProblem::adjust`].
#[derive(Debug, Clone, Copy)]
pub struct BundleOptions {
    /// Levenberg-Marquardt steps in the first and the second pass, at the most.
    pub steps: [usize; 2],
    /// Huber's limit and the outlier limit, squared and sigma-scaled.
    pub outlier_chi2: f64,
    /// A step that lowers the cost by less than this share ends the pass.
    pub relative_gain: f64,
}

impl Default for BundleOptions {
    fn default() -> Self {
        Self { steps: [5, 5], outlier_chi2: super::pose_optimisation::CHI2_2D_95, relative_gain: 1e-3 }
    }
}

/// What an adjustment did.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct BundleReport {
    pub steps: usize,
    /// Robust cost before and after, sigma-scaled squares.
    pub initial_cost: f64,
    pub final_cost: f64,
    pub outliers: usize,
}

type Matrix6x3 = SMatrix<f64, 6, 3>;

/// Normal equations at one linearisation point.
#[derive(Default)]
struct System {
    /// Free cameras: own 6x6 block (upper triangle) and gradient.
    camera_h: Vec<Matrix6<f64>>,
    camera_g: Vec<Vector6<f64>>,
    point_h: Vec<Matrix3<f64>>,
    point_g: Vec<Vector3<f64>>,
    /// Camera-point block of each observation (zero for fixed cameras and outliers).
    cross: Vec<Matrix6x3>,
    /// The same between cameras and the readout time, it and the points, it and the shared numbers, and its own.
    camera_readout: Vec<Vector6<f64>>,
    readout_point: Vec<Vector3<f64>>,
    readout_shared: SharedVector,
    readout_h: f64,
    readout_g: f64,
    /// The same between cameras and shared numbers, shared numbers and points, and among the shared numbers.
    camera_shared: Vec<Matrix6xS>,
    shared_point: Vec<MatrixSx3>,
    shared_h: SharedMatrix,
    shared_g: SharedVector,
    cost: f64,
}

/// One step of everything.
struct Step {
    /// Stacked over the free cameras, then the readout time and the shared numbers if they are unknowns.
    cameras: DVector<f64>,
    points: Vec<Vector3<f64>>,
    /// Information of the readout time at the point where the step was made, everything else free, without its prior.
    readout_information: f64,
}

const FIXED: u32 = u32::MAX;

impl BundleProblem {
    /// Minimises in place.
    pub fn adjust(&mut self, options: &BundleOptions) -> BundleReport {
        self.inlier.clear();
        self.inlier.resize(self.observations.len(), true);
        let (slot, free) = self.slots();
        let mut report = BundleReport::default();
        for (pass, &steps) in options.steps.iter().enumerate() {
            let (done, before, after) = self.minimise(&slot, free, steps, options);
            report.steps += done;
            if pass == 0 {
                report.initial_cost = before;
            }
            report.final_cost = after;
            self.judge_outliers(options.outlier_chi2);
        }
        report.outliers = self.inlier.iter().filter(|ok| !**ok).count();
        self.fill_point_covariances();
        report
    }

    /// Index of each camera among the free ones (`FIXED` for the others), and how many are free.
    fn slots(&self) -> (Vec<u32>, usize) {
        let mut free = 0u32;
        let slot = self.cameras.iter().map(|c| {
            if c.fixed {
                return FIXED;
            }
            free += 1;
            free - 1
        });
        (slot.collect(), free as usize)
    }

    /// Residual of observation `k` of `point`, and the point in the camera's coordinates; `None` behind it.
    fn residual(&self, point: &Vector3<f64>, k: usize) -> Option<(Vector2<f64>, Vector3<f64>)> {
        let observation = &self.observations[k];
        let p = self.cameras[observation.camera as usize].camera_from_world.transform(point);
        if p.z < 1e-6 {
            return None;
        }
        let (iz, s) = (1.0 / p.z, observation.inv_sigma_px);
        let at_middle_row = observation.normalised - observation.displacement * self.readout.seconds;
        let seen = match &self.shared {
            Some(shared) if shared.in_new_pixels => {
                let seen = at_middle_row + shared.jacobians[k] * shared.without_focal();
                let scale = shared.focal_scale();
                let (x, y) = (scale * p.x * iz - seen.x, scale * p.y * iz - seen.y);
                return Some((scaled(&observation.pixel_scale, s, x, y), p));
            }
            Some(shared) => at_middle_row + shared.jacobians[k] * shared.change,
            None => at_middle_row,
        };
        Some((scaled(&observation.pixel_scale, s, p.x * iz - seen.x, p.y * iz - seen.y), p))
    }

    /// Focal length of the residuals in units of the `pixel_scale`s'; exactly 1 unless they are in new pixels.
    fn focal_scale(&self) -> f64 {
        self.shared.as_ref().filter(|s| s.in_new_pixels).map_or(1.0, Shared::focal_scale)
    }

    fn range(&self, point: usize) -> std::ops::Range<usize> {
        self.first[point] as usize..self.first[point + 1] as usize
    }

    fn prior_cost(&self) -> f64 {
        self.readout.prior_cost() + self.shared.as_ref().map_or(0.0, Shared::prior_cost)
    }

    fn cost(&self, delta2: f64) -> f64 {
        let mut cost = self.prior_cost();
        for (i, point) in self.points.iter().enumerate() {
            for k in self.range(i) {
                if self.inlier[k] {
                    cost += match self.residual(point, k) {
                        Some((e, _)) => huber(e.norm_squared(), delta2).0,
                        None => 100.0 * delta2,
                    };
                }
            }
        }
        cost
    }

    fn linearise(&self, slot: &[u32], free: usize, delta2: f64, system: &mut System) {
        system.camera_h.clear();
        system.camera_h.resize(free, Matrix6::zeros());
        system.camera_g.clear();
        system.camera_g.resize(free, Vector6::zeros());
        system.point_h.clear();
        system.point_g.clear();
        system.cross.clear();
        system.cross.resize(self.observations.len(), Matrix6x3::zeros());
        system.camera_shared.clear();
        system.shared_point.clear();
        system.shared_h = SharedMatrix::zeros();
        system.shared_g = SharedVector::zeros();
        system.cost = self.prior_cost();
        system.camera_readout.clear();
        system.camera_readout.resize(free, Vector6::zeros());
        system.readout_point.clear();
        system.readout_shared = SharedVector::zeros();
        (system.readout_h, system.readout_g) = (0.0, 0.0);
        let find_readout = self.readout.unknowns() > 0;
        if self.shared.is_some() {
            system.camera_shared.resize(free, Matrix6xS::zeros());
        }
        // Pixels that a step on the plane z = 1 is.
        let scale = self.focal_scale();
        let rotations: Vec<Matrix3<f64>> =
            self.cameras.iter().map(|c| *c.camera_from_world.rotation.to_rotation_matrix().matrix()).collect();
        for (i, point) in self.points.iter().enumerate() {
            let (mut h, mut g) = (Matrix3::zeros(), Vector3::zeros());
            let mut with_readout = Vector3::zeros();
            let mut with_shared = MatrixSx3::zeros();
            for k in self.range(i) {
                if !self.inlier[k] {
                    continue;
                }
                let o = &self.observations[k];
                let Some((e, p)) = self.residual(point, k) else {
                    system.cost += 100.0 * delta2;
                    continue;
                };
                let (rho, w) = huber(e.norm_squared(), delta2);
                system.cost += rho;
                let pixels = o.pixel_scale * o.inv_sigma_px;
                let (jx, jy) = jacobian_rows(&p, &(pixels * scale));
                // d e / d point = d e / d translation * R.
                let r = &rotations[o.camera as usize];
                let px = r.row(0) * jx[3] + r.row(1) * jx[4] + r.row(2) * jx[5];
                let py = r.row(0) * jy[3] + r.row(1) * jy[4] + r.row(2) * jy[5];
                for c in 0..3 {
                    for d in 0..=c {
                        h[(d, c)] += w * (px[d] * px[c] + py[d] * py[c]);
                    }
                    g[c] += w * (px[c] * e.x + py[c] * e.y);
                }
                let s = slot[o.camera as usize];
                // d e / d readout: as the shared numbers, the observation moves against it.
                let moved = pixels * o.displacement;
                if find_readout {
                    system.readout_h += moved.norm_squared() * w;
                    system.readout_g += moved.dot(&e) * w;
                    with_readout += (px * moved.x + py * moved.y).transpose() * w;
                    if s != FIXED {
                        system.camera_readout[s as usize] +=
                            (Vector6::from(jx) * moved.x + Vector6::from(jy) * moved.y) * w;
                    }
                }
                if let Some(shared) = &self.shared {
                    // d e / d shared: the observation moves, so the residual moves against it.
                    let d = &shared.jacobians[k];
                    let (x, y) = (d.row(0).transpose(), d.row(1).transpose());
                    let (mut dx, mut dy) = (x * -pixels.m11, y * -pixels.m22);
                    if !is_diagonal(&pixels) {
                        dx -= y * pixels.m12;
                        dy -= x * pixels.m21;
                    }
                    if shared.in_new_pixels {
                        dx[0] = pixels.m11 * scale * p.x / p.z + pixels.m12 * scale * p.y / p.z;
                        dy[0] = pixels.m22 * scale * p.y / p.z + pixels.m21 * scale * p.x / p.z;
                    }
                    system.readout_shared += (dx * moved.x + dy * moved.y) * w;
                    system.shared_h += (dx * dx.transpose() + dy * dy.transpose()) * w;
                    system.shared_g += (dx * e.x + dy * e.y) * w;
                    with_shared += (dx * px + dy * py) * w;
                    if s != FIXED {
                        let (jx, jy) = (Vector6::from(jx), Vector6::from(jy));
                        system.camera_shared[s as usize] += (jx * dx.transpose() + jy * dy.transpose()) * w;
                    }
                }
                if s != FIXED {
                    let s = s as usize;
                    accumulate(&mut system.camera_h[s], &jx, &jy, w);
                    let cross = &mut system.cross[k];
                    for row in 0..6 {
                        system.camera_g[s][row] += w * (jx[row] * e.x + jy[row] * e.y);
                        let (a, b) = (w * jx[row], w * jy[row]);
                        for c in 0..3 {
                            cross[(row, c)] = a * px[c] + b * py[c];
                        }
                    }
                }
            }
            h[(1, 0)] = h[(0, 1)];
            h[(2, 0)] = h[(0, 2)];
            h[(2, 1)] = h[(1, 2)];
            system.point_h.push(h);
            system.point_g.push(g);
            system.readout_point.push(with_readout);
            if self.shared.is_some() {
                system.shared_point.push(with_shared);
            }
        }
    }

    /// One pass of Levenberg-Marquardt: steps done, cost before, cost after.
    fn minimise(&mut self, slot: &[u32], free: usize, steps: usize, options: &BundleOptions) -> (usize, f64, f64) {
        let mut system = System::default();
        self.linearise(slot, free, options.outlier_chi2, &mut system);
        let initial = system.cost;
        let mut cost = initial;
        let mut lambda = 1e-4;
        let mut done = 0;
        while done < steps {
            done += 1;
            let Some(step) = self.solve(slot, free, &system, lambda) else {
                lambda *= 10.0;
                continue;
            };
            let (old_cameras, old_points) = (self.cameras.clone(), self.points.clone());
            let old_readout = self.readout.seconds;
            let old_change = self.shared.as_ref().map(|s| s.change);
            for (camera, &s) in self.cameras.iter_mut().zip(slot) {
                if s != FIXED {
                    let step = step.cameras.fixed_rows::<6>(6 * s as usize).into_owned();
                    camera.camera_from_world = camera.camera_from_world.perturb_left(&step);
                }
            }
            let at = 6 * free + self.readout.unknowns();
            if at > 6 * free {
                self.readout.seconds += step.cameras[6 * free];
                self.readout.found_information = step.readout_information;
            }
            if let Some(shared) = &mut self.shared {
                let mut change = shared.change.rows_mut(0, shared.active);
                change += step.cameras.rows(at, shared.active);
            }
            for (point, step) in self.points.iter_mut().zip(&step.points) {
                *point += step;
            }
            let candidate = self.cost(options.outlier_chi2);
            if candidate <= cost {
                let gain = cost - candidate;
                let enough = gain < options.relative_gain * cost;
                cost = candidate;
                lambda = (lambda * 0.1).max(1e-8);
                if enough || done == steps {
                    break;
                }
                self.linearise(slot, free, options.outlier_chi2, &mut system);
            } else {
                (self.cameras, self.points) = (old_cameras, old_points);
                self.readout.seconds = old_readout;
                if let (Some(shared), Some(old)) = (&mut self.shared, old_change) {
                    shared.change = old;
                }
                lambda = (lambda * 10.0).min(1e6);
            }
        }
        if self.shared.is_some() {
            self.linearise(slot, free, options.outlier_chi2, &mut system);
            let found = self.shared_information(slot, free, &system);
            if let (Some(shared), Some(found)) = (&mut self.shared, found) {
                shared.found_information = found;
            }
        }
        (done, initial, cost)
    }

    /// The reduced system of cameras (readout time, and shared numbers) at this damping, right-hand side, and the inverted point
    /// blocks. The prior of the shared numbers is left out, that of the readout time is in it.
    fn reduce(
        &self,
        slot: &[u32],
        free: usize,
        system: &System,
        lambda: f64,
    ) -> (DMatrix<f64>, DVector<f64>, Vec<Matrix3<f64>>) {
        let shared = self.shared.as_ref().map_or(0, |s| s.active);
        let readout = self.readout.unknowns();
        let at = 6 * free + readout;
        let size = at + shared;
        let mut s = DMatrix::<f64>::zeros(size, size);
        let mut g = DVector::<f64>::zeros(size);
        for (i, (h, gradient)) in system.camera_h.iter().zip(&system.camera_g).enumerate() {
            for c in 0..6 {
                for r in 0..=c {
                    s[(6 * i + r, 6 * i + c)] = h[(r, c)];
                }
                s[(6 * i + c, 6 * i + c)] += lambda * h[(c, c)] + 1e-9;
                g[6 * i + c] = -gradient[c];
            }
        }
        if readout > 0 {
            for (i, block) in system.camera_readout.iter().enumerate() {
                s.fixed_view_mut::<6, 1>(6 * i, 6 * free).copy_from(block);
            }
            let (information, pull) = self.readout.prior();
            s[(6 * free, 6 * free)] = system.readout_h + information;
            s.view_mut((6 * free, at), (1, shared)).copy_from(&system.readout_shared.rows(0, shared).transpose());
            g[6 * free] = pull - system.readout_g;
        }
        if shared > 0 {
            for (i, block) in system.camera_shared.iter().enumerate() {
                s.view_mut((6 * i, at), (6, shared)).copy_from(&block.columns(0, shared));
            }
            let own = system.shared_h.view((0, 0), (shared, shared));
            s.view_mut((at, at), (shared, shared)).copy_from(&own);
            g.rows_mut(at, shared).copy_from(&-system.shared_g.rows(0, shared));
        }
        let mut inverses = Vec::with_capacity(self.points.len());
        for i in 0..self.points.len() {
            let mut c = system.point_h[i];
            for d in 0..3 {
                c[(d, d)] += lambda * c[(d, d)] + 1e-9;
            }
            let inverse = c.try_inverse().unwrap_or_else(Matrix3::zeros);
            let rest = inverse * system.point_g[i];
            let range = self.range(i);
            for a in range.clone() {
                let sa = slot[self.observations[a].camera as usize];
                if sa == FIXED || !self.inlier[a] {
                    continue;
                }
                let y = system.cross[a] * inverse;
                let mut part = g.fixed_rows_mut::<6>(6 * sa as usize);
                part += system.cross[a] * rest;
                for b in range.clone() {
                    let sb = slot[self.observations[b].camera as usize];
                    // Upper triangle of blocks only.
                    if sb == FIXED || sb < sa || !self.inlier[b] {
                        continue;
                    }
                    let mut block = s.fixed_view_mut::<6, 6>(6 * sa as usize, 6 * sb as usize);
                    block -= y * system.cross[b].transpose();
                }
                if readout > 0 {
                    let mut border = s.fixed_view_mut::<6, 1>(6 * sa as usize, 6 * free);
                    border -= y * system.readout_point[i];
                }
                if shared > 0 {
                    let border = y * system.shared_point[i].transpose();
                    let mut block = s.view_mut((6 * sa as usize, at), (6, shared));
                    block -= border.columns(0, shared);
                }
            }
            if readout > 0 {
                let w = &system.readout_point[i];
                s[(6 * free, 6 * free)] -= w.dot(&(inverse * w));
                g[6 * free] += w.dot(&rest);
                if shared > 0 {
                    let border = (system.shared_point[i] * (inverse * w)).transpose();
                    let mut block = s.view_mut((6 * free, at), (1, shared));
                    block -= border.columns(0, shared);
                }
            }
            if shared > 0 {
                let w = &system.shared_point[i];
                let own = w * inverse * w.transpose();
                let mut block = s.view_mut((at, at), (shared, shared));
                block -= own.view((0, 0), (shared, shared));
                let mut part = g.rows_mut(at, shared);
                part += (w * rest).rows(0, shared);
            }
            inverses.push(inverse);
        }
        for c in 0..size {
            for r in 0..c {
                s[(c, r)] = s[(r, c)];
            }
        }
        (s, g, inverses)
    }

    /// One step at this damping; `None` if the reduced system is not positive definite.
    fn solve(&self, slot: &[u32], free: usize, system: &System, lambda: f64) -> Option<Step> {
        let (mut s, mut g, inverses) = self.reduce(slot, free, system, lambda);
        let readout = self.readout.unknowns();
        let at = 6 * free + readout;
        if let Some(shared) = &self.shared {
            for i in 0..shared.active {
                s[(at + i, at + i)] += shared.information[i];
                g[at + i] += shared.information[i] * (shared.expected[i] - shared.change[i]);
            }
        }
        let mut readout_information = 0.0;
        let cameras = if g.is_empty() {
            g
        } else {
            let factor = s.cholesky()?;
            if readout > 0 {
                // One over its variance, everything else free, without its prior.
                let mut unit = DVector::zeros(g.len());
                unit[6 * free] = 1.0;
                let variance = factor.solve(&unit)[6 * free];
                readout_information = (1.0 / variance - self.readout.prior().0).max(0.0);
            }
            factor.solve(&g)
        };
        if !cameras.iter().all(|v| v.is_finite()) {
            return None;
        }
        let change = self.shared.as_ref().map(|shared| {
            let mut change = SharedVector::zeros();
            change.rows_mut(0, shared.active).copy_from(&cameras.rows(at, shared.active));
            change
        });
        let mut points = Vec::with_capacity(self.points.len());
        for i in 0..self.points.len() {
            let mut rest = -system.point_g[i];
            for k in self.range(i) {
                let sk = slot[self.observations[k].camera as usize];
                if sk != FIXED && self.inlier[k] {
                    rest -= system.cross[k].transpose() * cameras.fixed_rows::<6>(6 * sk as usize);
                }
            }
            if readout > 0 {
                rest -= system.readout_point[i] * cameras[6 * free];
            }
            if let Some(change) = &change {
                rest -= system.shared_point[i].transpose() * change;
            }
            let step = inverses[i] * rest;
            points.push(if step.iter().all(|v| v.is_finite()) { step } else { Vector3::zeros() });
        }
        Some(Step { cameras, points, readout_information })
    }

    fn judge_outliers(&mut self, limit: f64) {
        for i in 0..self.points.len() {
            for k in self.range(i) {
                self.inlier[k] = self.residual(&self.points[i], k).is_some_and(|(e, _)| e.norm_squared() <= limit);
            }
        }
    }
}

/// Huber's robust cost and weight of a squared residual.
#[inline]
fn huber(e2: f64, delta2: f64) -> (f64, f64) {
    if e2 <= delta2 {
        (e2, 1.0)
    } else {
        let root = (e2 * delta2).sqrt();
        (2.0 * root - delta2, delta2 / root)
    }
}

#[cfg(test)]
mod tests;
