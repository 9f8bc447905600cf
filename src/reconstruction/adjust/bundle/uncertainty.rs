//! How surely an adjustment knows what it found.
//!
//! Everything is read off the normal equations at the solution; the observations' own sigmas are believed.

use nalgebra::{DMatrix, Matrix3, Vector3};

use super::{BundleOptions, BundleProblem, FIXED, SharedMatrix, System};
use crate::reconstruction::measurement::jacobian_rows;

/// Relative damping that holds what nothing holds (the scale, a point that one camera sees) while information is marginalised:
/// far below what any of it costs, far above the loss of digits.
const GAUGE_DAMPING: [f64; 3] = [1e-9, 1e-7, 1e-5];

impl BundleProblem {
    /// Information of the shared numbers with cameras, points and readout time free (Schur complement), without their prior.
    pub(super) fn shared_information(&self, slot: &[u32], free: usize, system: &System) -> Option<SharedMatrix> {
        GAUGE_DAMPING.iter().find_map(|&damping| self.shared_information_at(slot, free, system, damping))
    }

    fn shared_information_at(&self, slot: &[u32], free: usize, system: &System, damping: f64) -> Option<SharedMatrix> {
        let (s, _, _) = self.reduce(slot, free, system, damping);
        let at = 6 * free + self.readout.unknowns();
        let active = s.nrows() - at;
        let mut own = s.view((at, at), (active, active)).into_owned();
        if at > 0 {
            let cross = s.view((0, at), (at, active)).into_owned();
            let solved = s.view((0, 0), (at, at)).into_owned().cholesky()?.solve(&cross);
            own -= cross.transpose() * solved;
        }
        if !(own.diagonal().min() >= 0.0 && own.clone().symmetric_eigenvalues().min() > -1e-6 * own.diagonal().max()) {
            return None;
        }
        let mut all = SharedMatrix::zeros();
        all.view_mut((0, 0), (active, active)).copy_from(&own);
        Some(all)
    }

    /// Standard deviation of the direction of camera `index`'s translation, rad, everything else free (the fixed cameras hold
    /// the place, the length of this translation holds the scale); `None` for a fixed camera or a singular problem.
    pub fn direction_sigma(&self, index: usize) -> Option<f64> {
        let (slot, free) = self.slots();
        let at = *slot.get(index).filter(|&&s| s != FIXED)? as usize * 6;
        let mut system = System::default();
        self.linearise(&slot, free, BundleOptions::default().outlier_chi2, &mut system);
        let (mut s, _, _) = self.reduce(&slot, free, &system, 0.0);
        let translation = self.cameras[index].camera_from_world.translation;
        let length = translation.norm();
        let along = translation / length;
        // Infinitely sure of the length: far above any information, far below the loss of digits.
        let sure = 1e6 * s.diagonal().max();
        for r in 0..3 {
            for c in 0..3 {
                s[(at + 3 + r, at + 3 + c)] += sure * along[r] * along[c];
            }
        }
        let mut unit = DMatrix::zeros(s.nrows(), 3);
        unit.fixed_view_mut::<3, 3>(at + 3, 0).fill_with_identity();
        let covariance: Matrix3<f64> = s.cholesky()?.solve(&unit).fixed_view::<3, 3>(at + 3, 0).into_owned();
        let sigma = covariance.symmetric_eigenvalues().max().max(0.0).sqrt() / length;
        sigma.is_finite().then_some(sigma)
    }

    pub(super) fn fill_point_covariances(&mut self) {
        self.point_covariances.clear();
        let focal_scale = self.focal_scale();
        for (i, point) in self.points.iter().enumerate() {
            let mut h = Matrix3::zeros();
            for k in self.range(i).filter(|&k| self.inlier[k]) {
                let o = &self.observations[k];
                let Some((_, p)) = self.residual(point, k) else { continue };
                let (jx, jy) = jacobian_rows(&p, &(o.pixel_scale * focal_scale * o.inv_sigma_px));
                let r = self.cameras[o.camera as usize].camera_from_world.rotation.to_rotation_matrix();
                let x = r.matrix().transpose() * Vector3::new(jx[3], jx[4], jx[5]);
                let y = r.matrix().transpose() * Vector3::new(jy[3], jy[4], jy[5]);
                h += x * x.transpose() + y * y.transpose();
            }
            self.point_covariances.push(h.try_inverse().unwrap_or_else(|| Matrix3::from_element(f64::NAN)));
        }
    }
}
