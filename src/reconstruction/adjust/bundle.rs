//! Bundle adjustment: keyframe poses, landmark positions and global parameters together, landmarks eliminated by the Schur complement.
//!
//! Input: cameras (some held fixed), points, observations grouped by point; undistorted coordinates on z = 1. Output: the
//! same, moved to a minimum of `sum rho(|e|^2)` with Huber's rho. Levenberg-Marquardt; for damped normal equations
//! `[B E; Eᵀ C]` the reduced system is `S = B - E C⁻¹ Eᵀ` (Triggs et al. 2000, section 6.1), dense in f64, the 3x3
//! blocks of C inverted in closed form. B holds the cameras and what all observations share ([`Globals`]: a rolling shutter's readout time, the
//! intrinsics). Two passes: outliers are taken out between them. Sequential: same input, same bits.
//! Cost: for 10 free cameras and 1,500 points about 2 ms a step. Not here: gauge (hold at
//! least one camera fixed, or rely on the damping for the scale).

use crate::geometry::least_squares::{LmOptions, minimise};
use crate::reconstruction::measurement::CHI2_2D_95;

mod globals;
mod normal_equations;
mod problem;
mod uncertainty;

pub use globals::{GLOBALS, Globals, INTRINSICS, IntrinsicsJacobian, IntrinsicsVector, READOUT, WITHOUT_DISTORTION};
use normal_equations::Adjustment;
pub use problem::{BundleObservation, BundleProblem};

// What the adjustment takes as given.

/// Passes; outliers are judged after each.
const PASSES: usize = 2;
/// Damping at the start of each pass, as a share of the diagonal: a map is near its minimum, so that nearly whole steps pay, and the few
/// that a pass has are not spent on finding that out.
const INITIAL_DAMPING: f64 = 1e-4;
/// Added to every pivot, squared standard deviations per squared unit (rad, map units): what no observation holds stays where it is. The
/// information of one pixel on one unit of the map is some 1e5.
const LEAST_PIVOT: f64 = 1e-9;
/// Price of an observation behind its camera in squared outlier limits: a step that does this is no gain.
const BEHIND_CAMERA: f64 = 100.0;
/// Relative damping that holds what nothing holds (the scale, a point that one camera sees) while the rest is marginalised:
/// far below what any of it costs, far above the loss of digits. The first at which the system is positive definite.
const GAUGE_DAMPING: [f64; 3] = [1e-9, 1e-7, 1e-5];
/// Information on what is taken as known, in shares of the largest there is: far above any, far below the loss of digits.
const KNOWN: f64 = 1e6;

/// Options of [`BundleProblem::adjust`].
#[derive(Debug, Clone, Copy)]
pub struct BundleOptions {
    /// Levenberg-Marquardt steps in each pass, at the most. A number and not a time, so that a replay gives the same bits.
    pub steps: usize,
    /// Huber's limit and the outlier limit, squared and sigma-scaled.
    pub outlier_chi2: f64,
    /// A step that lowers the cost by less than this share ends the pass: the next keyframe's adjustment goes on from there.
    pub relative_gain: f64,
}

impl Default for BundleOptions {
    fn default() -> Self {
        Self { steps: 5, outlier_chi2: CHI2_2D_95, relative_gain: 1e-3 }
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
        for _ in 0..PASSES {
            let lm = LmOptions {
                max_iterations: options.steps,
                relative_cost: options.relative_gain,
                step_norm: 0.0,
                initial_damping: INITIAL_DAMPING,
            };
            let start = std::mem::take(&mut self.state);
            let (state, _) = minimise(&Adjustment::<W>::new(self, options.outlier_chi2), start, &lm);
            self.state = state;
            self.judge_outliers(options.outlier_chi2);
        }
        self.fill_covariances::<W>(options.outlier_chi2);
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
