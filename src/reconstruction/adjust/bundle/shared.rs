//! Numbers that all pictures of a bundle adjustment share: the camera's, refined with poses and points.

use nalgebra::{SMatrix, SVector, Vector2};

/// Numbers that all pictures share and that an adjustment may refine (log focal length, principal point in px, k1 k2 p1 p2): see
/// [`Shared`].
pub const SHARED: usize = 7;
/// The first of them: all that is refined of a wide-angle lens.
pub const WITHOUT_DISTORTION: usize = 3;
pub type SharedVector = SVector<f64, SHARED>;
pub type SharedMatrix = SMatrix<f64, SHARED, SHARED>;
/// d normalised / d shared.
pub type SharedJacobian = SMatrix<f64, 2, SHARED>;

/// Intrinsics refined with the rest. Seen through the new lens, observation k lies at `normalised + jacobians[k] * change`, to first
/// order; the focal length, which may change by much, is taken as it is: with `s = exp(change[0])` the residual on the
/// old plane z = 1 is `s * (place - normalised) - jacobians[k] * (s - 1, change[1], ...)`. That is in pixels of the focal length
/// that is being found. In pixels of the old one every error shrinks as the focal length grows, which pulls it up by the mean squared
/// residual over its own information: some percent, for a small map.
#[derive(Debug, Clone)]
pub struct Shared {
    /// One for each observation.
    pub jacobians: Vec<SharedJacobian>,
    /// So many of the numbers, from the first on, are unknowns; the others stay.
    pub active: usize,
    /// Against the intrinsics that the observations were made with; moved by the adjustment.
    pub change: SharedVector,
    /// What `change` is expected to be, and one over the variance of that (infinite would be: held).
    pub expected: SharedVector,
    pub information: SharedVector,
    /// Set by the adjustment: information of `change`, everything else free, the prior left out.
    pub found_information: SharedMatrix,
}

impl Shared {
    pub(super) fn focal_scale(&self) -> f64 {
        self.change[0].exp()
    }

    /// What the observations' Jacobians are multiplied with.
    pub(super) fn moved(&self) -> SharedVector {
        let mut moved = self.change;
        moved[0] = self.focal_scale() - 1.0;
        moved
    }

    /// Minus the derivative of a residual on the plane z = 1, which is `off` through the old lens.
    pub(super) fn jacobian(&self, k: usize, off: &Vector2<f64>) -> SharedJacobian {
        let mut j = self.jacobians[k];
        let focal = (j.column(0) - off) * self.focal_scale();
        j.set_column(0, &focal);
        j
    }

    pub(super) fn prior_cost(&self) -> f64 {
        let off = self.change - self.expected;
        off.component_mul(&off).dot(&self.information)
    }
}
