//! Bundle adjustment: keyframe poses and landmark positions together, landmarks eliminated by the Schur complement.
//!
//! Input: cameras (some held fixed), points, observations grouped by point; undistorted coordinates on z = 1. Output: the
//! same, moved to a minimum of `sum rho(|e|^2)` with Huber's rho. Levenberg-Marquardt; for damped normal equations
//! `[B E; Eᵀ C]` the reduced camera system is `S = B - E C⁻¹ Eᵀ` (Triggs et al. 2000, section 6.1), dense in f64, the 3x3
//! blocks of C inverted in closed form. Two passes: outliers are taken out between them. Sequential: same input, same bits.
//! Cost: for 10 free cameras and 1,500 points about 2 ms a step. Numbers that all pictures share (the
//! intrinsics, and a rolling shutter's readout time) can be unknowns as well: a border of the reduced system. Not here: gauge (hold at
//! least one camera fixed, or rely on the damping for the scale).

use nalgebra::{DVector, Vector3};

use crate::reconstruction::measurement::CHI2_2D_95;

mod normal_equations;
mod problem;
mod shared;
mod uncertainty;

use normal_equations::System;
pub use problem::{BundleCamera, BundleObservation, BundleProblem};
use problem::{FIXED, huber};
pub use shared::{SHARED, Shared, SharedJacobian, SharedMatrix, SharedVector, WITHOUT_DISTORTION};

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
        Self { steps: [5, 5], outlier_chi2: CHI2_2D_95, relative_gain: 1e-3 }
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

/// One step of everything.
struct Step {
    /// Stacked over the free cameras, then the readout time and the shared numbers if they are unknowns.
    cameras: DVector<f64>,
    points: Vec<Vector3<f64>>,
    /// Information of the readout time at the point where the step was made, everything else free, without its prior.
    readout_information: f64,
}

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

#[cfg(test)]
mod tests;
