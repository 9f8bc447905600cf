use super::Se3;
use super::frames::{First, Second};
use nalgebra::{Vector2, Vector3};
pub struct TwoViewOptions {
    pub seed: u64,
}
impl TwoViewOptions {
    pub fn new(_f: f64) -> Self {
        Self { seed: 0 }
    }
}
pub struct TwoView {
    pub second_from_first: Se3<Second, First>,
    pub points: Vec<Option<Vector3<f64>>>,
}
pub fn reconstruct_two_views(_a: &[Vector2<f64>], _b: &[Vector2<f64>], _o: &TwoViewOptions) -> Result<TwoView, ()> {
    Err(())
}
