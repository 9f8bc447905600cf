//! One picture of the plane: what a calibration is made from.

use nalgebra::Vector2;

/// One picture of the plane.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct View {
    /// Points of the plane, its unit.
    pub plane: Vec<Vector2<f64>>,
    /// Where each is seen, pixels.
    pub pixels: Vec<Vector2<f64>>,
    /// How far a rolling shutter moved each, pixels per second of readout time: its velocity times the share of the readout by which its
    /// row is later than the middle one. Empty: nothing moved, or nobody knows.
    pub shear: Vec<Vector2<f64>>,
}

impl View {
    pub(super) fn shear_of(&self, point: usize) -> Vector2<f64> {
        self.shear.get(point).copied().unwrap_or_default()
    }
}
