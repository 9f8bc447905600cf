//! Bundle adjustment: keyframe poses, landmark positions, targets of known size, the floor and global parameters together, landmarks eliminated by the Schur
//! complement.
//!
//! Input: cameras (some held fixed), points, observations grouped by point; undistorted coordinates on z = 1. Output: the
//! same, moved to a minimum of `sum rho(|e|^2)` with Cauchy's rho (or Huber's: `loss`). Levenberg-Marquardt; for damped normal equations
//! `[B E; Eᵀ C]` the reduced system is `S = B - E C⁻¹ Eᵀ` (Triggs et al. 2000, section 6.1), dense in f64, the 3x3
//! blocks of C inverted in closed form. B holds the cameras, the targets and what all observations share ([`Globals`]: a rolling shutter's readout time, the
//! intrinsics). Two passes: outliers are taken out between them. Sequential: same input, same bits.
//! Cost: for 10 free cameras and 1,500 points about 2 ms a step. Not here: gauge (hold at
//! least one camera fixed, or rely on the damping for the scale).

use crate::geometry::least_squares::{LmOptions, Loss, minimise};
use crate::reconstruction::measurement::CHI2_2D_95;

mod floor;
mod globals;
mod lengths;
mod normal_equations;
mod options;
mod problem;
mod targets;
mod uncertainty;

pub use floor::HeldFloor;
pub use globals::{GLOBALS, Globals, INTRINSICS, IntrinsicsJacobian, IntrinsicsVector, READOUT, WITHOUT_DISTORTION};
pub use lengths::KnownLength;
use normal_equations::Adjustment;
pub use options::BundleOptions;
use options::{LEAST_NOISE, LOSS_SCALE, PASSES};
pub use problem::{BundleObservation, BundleProblem};
pub use targets::TargetCorner;

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
            // A map is near its minimum, so that nearly whole steps pay: the usual damping at the start.
            let lm = LmOptions {
                max_iterations: options.steps,
                relative_cost: options.relative_gain,
                step_norm: 0.0,
                ..LmOptions::default()
            };
            let loss = self.loss(options);
            let start = std::mem::take(&mut self.state);
            let (state, _) = minimise(&Adjustment::<W>::new(self, loss), start, &lm);
            self.state = state;
            self.judge_outliers(options.outlier_chi2);
        }
        self.fill_covariances::<W>();
    }

    /// What a residual costs: Cauchy's loss, as wide as what is left of places; Huber's where that is not told or the lens is a guess. Corners that are none, as
    /// where an edge crosses another one behind it, slide by less than any outlier limit that the others need, and together they bend a map.
    fn loss(&self, options: &BundleOptions) -> Loss {
        let noise = self.noise().filter(|_| options.is_lens_known).map(|noise| noise.clamp(LEAST_NOISE, 1.0));
        noise.map_or(Loss::Huber(options.outlier_chi2.sqrt()), |noise| Loss::Cauchy(LOSS_SCALE * noise))
    }

    fn judge_outliers(&mut self, limit: f64) {
        for i in 0..self.state.points.len() {
            for k in self.range(i) {
                let residual = self.residual(&self.state, &self.state.points[i], k);
                self.inlier[k] = residual.is_some_and(|(e, _)| e.norm_squared() <= limit);
            }
        }
        let seen =
            self.seen_corners().map(|(k, corner)| self.residual(&self.state, &self.corner(&self.state, corner), k));
        // Corners of targets have a standard deviation of their own.
        let judged: Vec<bool> = seen.map(|seen| seen.is_some_and(|(e, _)| e.norm_squared() <= CHI2_2D_95)).collect();
        let begin = self.inlier.len() - judged.len();
        self.inlier[begin..].copy_from_slice(&judged);
    }
}

#[cfg(test)]
mod tests;
