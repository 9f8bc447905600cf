//! Parameters that every observation of a bundle adjustment shares: the shutter's readout time and the camera's intrinsics.
//!
//! They are the last columns of one problem: the readout time first, so that a problem without intrinsics is the same with a width of one
//! in place of [`GLOBALS`]. Each has a prior, an infinitely sure one holds it.

use nalgebra::{SMatrix, SVector, Vector2};

/// Readout time (s), then the intrinsics.
pub const GLOBALS: usize = 1 + INTRINSICS;
pub const READOUT: usize = 0;
/// Log focal length, principal point (px), k1 k2 p1 p2: changes of those that the observations were made with.
pub const INTRINSICS: usize = 7;
/// The first of them: all that is refined of a wide-angle lens.
pub const WITHOUT_DISTORTION: usize = 3;

pub type GlobalVector = SVector<f64, GLOBALS>;
pub type GlobalMatrix = SMatrix<f64, GLOBALS, GLOBALS>;
pub type IntrinsicsVector = SVector<f64, INTRINSICS>;
/// d normalised / d intrinsics.
pub type IntrinsicsJacobian = SMatrix<f64, 2, INTRINSICS>;

/// What an adjustment is told of the global parameters.
///
/// Seen through the new lens, observation k lies at `normalised + jacobians[k] * change`, to first order; the focal length, which may change
/// by much, is taken as it is: with `s = exp(change[0])` the residual on the old plane z = 1 is `s * off - jacobians[k] * (s - 1, change[1], ...)`,
/// `off` being the projection less the observation. That is in pixels of the focal length that is being found. In pixels of the old one
/// every error shrinks as the focal length grows, which pulls it up by the mean squared residual over its own information: some
/// percent, for a small map.
#[derive(Debug, Clone)]
pub struct Globals {
    /// Mean of the prior, and one over its variance (infinite: held).
    pub expected: GlobalVector,
    pub information: GlobalVector,
    /// One for each observation; none at all: the intrinsics are right as they are.
    pub jacobians: Vec<IntrinsicsJacobian>,
}

impl Default for Globals {
    /// Everything is held.
    fn default() -> Self {
        let information = GlobalVector::from_element(f64::INFINITY);
        Self { expected: GlobalVector::zeros(), information, jacobians: Vec::new() }
    }
}

impl Globals {
    pub fn is_held(&self, parameter: usize) -> bool {
        self.information[parameter].is_infinite()
    }

    /// Gradient of the prior's cost (half of it, as of every squared residual) and its second derivative; one where a parameter is held.
    pub(super) fn prior(&self, parameter: usize, value: f64) -> (f64, f64) {
        match self.information[parameter] {
            information if information.is_finite() => (information * (value - self.expected[parameter]), information),
            _ => (0.0, 1.0),
        }
    }

    pub(super) fn prior_cost(&self, values: &GlobalVector) -> f64 {
        (0..GLOBALS).map(|i| self.prior(i, values[i]).0 * (values[i] - self.expected[i])).sum()
    }

    /// Residual on the plane z = 1 of observation `k`, which is `off` through the old lens.
    pub(super) fn through_new_lens(&self, k: usize, off: Vector2<f64>, values: &GlobalVector) -> Vector2<f64> {
        let Some(jacobian) = self.jacobians.get(k) else { return off };
        let scale = focal_scale(values);
        let mut moved: IntrinsicsVector = values.fixed_rows::<INTRINSICS>(1).into_owned();
        moved[0] = scale - 1.0;
        off * scale - jacobian * moved
    }

    /// d residual / d globals on the plane z = 1 of observation `k`, which is `off` through the old lens and was displaced by the
    /// shutter by `displacement` per second of readout.
    pub(super) fn jacobian<const W: usize>(
        &self,
        k: usize,
        off: &Vector2<f64>,
        displacement: &Vector2<f64>,
        values: &GlobalVector,
    ) -> SMatrix<f64, 2, W> {
        let scale = focal_scale(values);
        let mut all = SMatrix::<f64, 2, W>::zeros();
        for parameter in (0..W).filter(|&i| !self.is_held(i)) {
            let column = match (parameter, self.jacobians.get(k)) {
                (READOUT, _) => displacement * scale,
                (1, Some(jacobian)) => (off - jacobian.column(0)) * scale,
                (_, Some(jacobian)) => -jacobian.column(parameter - 1),
                (_, None) => continue,
            };
            all.set_column(parameter, &column);
        }
        all
    }
}

/// Focal length of the residuals in units of that which observations were made with.
pub(super) fn focal_scale(values: &GlobalVector) -> f64 {
    if values[1] == 0.0 { 1.0 } else { values[1].exp() }
}
