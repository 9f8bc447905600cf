//! How surely an adjustment knows what it found.
//!
//! Covariances are read off the normal equations at the solution, the observations' own sigmas being believed; how right these are, off the residuals.

use nalgebra::{DVector, Matrix3};

use super::globals::{GLOBALS, GlobalMatrix};
use super::normal_equations::{Adjustment, System};
use super::options::{GAUGE_DAMPING, KNOWN};
use super::problem::BundleProblem;
use crate::geometry::cholesky::DenseCholesky;
use crate::geometry::least_squares::{LeastSquares, Loss};
use crate::geometry::median;

/// Median of chi-square with two degrees of freedom.
const MEDIAN_CHI2_2D: f64 = 2.0 * std::f64::consts::LN_2;
/// Degrees of freedom that tell the noise, at the least.
const MIN_FREEDOM: f64 = 60.0;

impl<const W: usize> System<W> {
    /// Covariance of each point with cameras and floor held.
    pub(super) fn point_covariances(&self) -> Vec<Matrix3<f64>> {
        let unknown = Matrix3::from_element(f64::NAN);
        self.points.iter().map(|point| point.own.try_inverse().unwrap_or(unknown)).collect()
    }

    /// Covariance of the global parameters, the last unknowns of the reduced system, with cameras and points free.
    pub(super) fn global_covariance(&self) -> Option<GlobalMatrix> {
        let factor = GAUGE_DAMPING.into_iter().find_map(|damping| DenseCholesky::of(self.reduce(damping).matrix))?;
        let mut all = GlobalMatrix::zeros();
        all.fixed_view_mut::<W, W>(0, 0).copy_from(&factor.last_block_of_inverse::<W>()?);
        Some(all)
    }
}

impl BundleProblem {
    /// Sets what is told of the solution's uncertainty; each inlier counts in full.
    pub(super) fn fill_covariances<const W: usize>(&mut self) {
        let adjustment = Adjustment::<W>::new(self, Loss::Squared);
        let system = adjustment.linearise(&self.state);
        let all_held = (0..GLOBALS).all(|i| self.globals.is_held(i));
        let global = if all_held { None } else { system.global_covariance() };
        let points = system.point_covariances();
        (self.point_covariances, self.global_covariance) = (points, global);
    }

    /// Robust standard deviation of what is left of places, in supposed ones, each as if all others had been fitted without it: from the median
    /// square of the residuals and their degrees of freedom (a posteriori variance of unit weight). Of points that three cameras see, as two always agree
    /// about some. `None` where too little is left to tell it.
    pub fn noise(&self) -> Option<f64> {
        let (mut squared, mut points) = (Vec::new(), 0usize);
        let mut has_part = vec![false; self.fixed.len()];
        for (i, point) in self.state.points.iter().enumerate().filter(|(i, _)| self.range(*i).len() > 2) {
            points += 1;
            squared.extend(self.range(i).filter_map(|k| {
                has_part[self.observations[k].camera as usize] = true;
                Some(self.residual(&self.state, point, k)?.0.norm_squared())
            }));
        }
        let free = self.fixed.iter().zip(&has_part).filter(|(fixed, has_part)| !**fixed && **has_part).count();
        let residuals = 2.0 * squared.len() as f64;
        let left = residuals - 3.0 * points as f64 - 6.0 * free as f64;
        let middle = median(&mut squared).filter(|_| left >= MIN_FREEDOM)?;
        Some((middle / MEDIAN_CHI2_2D * residuals / left).sqrt())
    }

    /// Standard deviation of the direction of camera `index`'s translation, rad, everything else free but the intrinsics (the fixed
    /// cameras hold the place, the length of this translation holds the scale); `None` for a fixed camera or a singular problem.
    pub fn direction_sigma(&self, index: usize) -> Option<f64> {
        let adjustment = Adjustment::<1>::new(self, Loss::Squared);
        let at = adjustment.slot_of(index)? * 6;
        let mut s = adjustment.linearise(&self.state).reduce(0.0).matrix;
        let translation = self.state.poses[index].translation;
        let length = translation.norm();
        let along = translation / length;
        let known = KNOWN * s.diagonal().max();
        let mut block = s.fixed_view_mut::<3, 3>(at + 3, at + 3);
        block += along * along.transpose() * known;
        let unknowns = s.nrows();
        let factor = DenseCholesky::of(s)?;
        let column = |i: usize| {
            let unit = DVector::from_fn(unknowns, |row, _| f64::from(u8::from(row == at + 3 + i)));
            factor.solve(unit).fixed_rows::<3>(at + 3).into_owned()
        };
        let covariance = Matrix3::from_columns(&[0, 1, 2].map(column));
        let sigma = covariance.symmetric_eigenvalues().max().max(0.0).sqrt() / length;
        sigma.is_finite().then_some(sigma)
    }
}
