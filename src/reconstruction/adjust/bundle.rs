//! Bundle adjustment: keyframe poses, landmark positions and global parameters together, landmarks eliminated by the Schur complement.
//!
//! Input: cameras (some held fixed), points, observations grouped by point; undistorted coordinates on z = 1. Output: the
//! same, moved to a minimum of `sum rho(|e|^2)` with Huber's rho. Levenberg-Marquardt; for damped normal equations
//! `[B E; Eᵀ C]` the reduced system is `S = B - E C⁻¹ Eᵀ` (Triggs et al. 2000, section 6.1), dense in f64, the 3x3
//! blocks of C inverted in closed form. B holds the cameras and what all observations share ([`Globals`]: a rolling shutter's readout time, the
//! intrinsics). Two passes: outliers are taken out between them. Sequential: same input, same bits.
//! Cost: for 10 free cameras and 1,500 points about 2 ms a step. Not here: gauge (hold at
//! least one camera fixed, or rely on the damping for the scale).

use crate::reconstruction::measurement::CHI2_2D_95;

mod globals;
mod normal_equations;
mod problem;
mod uncertainty;

pub use globals::{GLOBALS, Globals, INTRINSICS, IntrinsicsJacobian, IntrinsicsVector, READOUT, WITHOUT_DISTORTION};
use normal_equations::Adjustment;
pub use problem::{BundleObservation, BundleProblem, BundleState};

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

impl BundleProblem {
    /// Minimises in place.
    pub fn adjust(&mut self, options: &BundleOptions) {
        self.inlier.clear();
        self.inlier.resize(self.observations.len(), true);
        if self.globals.jacobians.is_empty() {
            self.adjust_with::<1>(options);
        } else {
            self.adjust_with::<GLOBALS>(options);
        }
    }

    fn adjust_with<const W: usize>(&mut self, options: &BundleOptions) {
        for steps in options.steps {
            self.state = self.minimise::<W>(steps, options);
            self.judge_outliers(options.outlier_chi2);
        }
        self.fill_covariances::<W>(options.outlier_chi2);
    }

    /// One pass of Levenberg-Marquardt.
    fn minimise<const W: usize>(&self, steps: usize, options: &BundleOptions) -> BundleState {
        let adjustment = Adjustment::<W>::new(self, options.outlier_chi2);
        let mut state = self.state.clone();
        let mut cost = adjustment.cost(&state);
        let mut system = adjustment.linearise(&state);
        let mut lambda = 1e-4;
        for done in 1..=steps {
            let Some(step) = system.solve(lambda) else {
                lambda *= 10.0;
                continue;
            };
            let trial = adjustment.step(&state, &step);
            let candidate = adjustment.cost(&trial);
            if candidate <= cost {
                let gain = cost - candidate;
                let enough = gain < options.relative_gain * cost;
                (state, cost) = (trial, candidate);
                lambda = (lambda * 0.1).max(1e-8);
                if enough || done == steps {
                    break;
                }
                system = adjustment.linearise(&state);
            } else {
                lambda = (lambda * 10.0).min(1e6);
            }
        }
        state
    }

    fn judge_outliers(&mut self, limit: f64) {
        for i in 0..self.state.points.len() {
            for k in self.range(i) {
                let residual = self.residual(&self.state, &self.state.points[i], k);
                self.inlier[k] = residual.is_some_and(|(e, _)| e.norm_squared() <= limit);
            }
        }
    }
}

#[cfg(test)]
mod tests;
