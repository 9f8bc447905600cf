//! The floor under a camera of known height: cameras that keep one height above a plane, and landmarks that lie on it.
//!
//! The floor is one more pose of the state, behind the cameras' and beside the targets': `floor_from_world`, whose z is the height above it. With
//! `q = T_floor x` the residual of a landmark x is `q_z / s_p`, that of a camera with its centre c `(q_z - h) / s_h`. By left perturbations `[w, v]` of the floor
//! the derivative of `q_z` is `[q_y, -q_x, 0, 0, 0, 1]`, by x it is the floor's third row r, and by `[w, v]` of a camera `[0, -R_k r]`. Turning about the normal and
//! sliding along the plane move nothing. As a height is a length, it holds the scale, and upright what turns slowly. Cauchy's loss: what stands near
//! the floor is not on it, and sills are not carpets.

use nalgebra::{Matrix3, Vector1, Vector3, Vector6};

use super::normal_equations::Rows;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::geometry::least_squares::Loss;

/// Standard deviations at which a height begins to be doubted.
const LOSS: Loss = Loss::Cauchy(2.0);

/// A plane that cameras are driven over. Lengths in map units.
#[derive(Debug, Clone, Default)]
pub struct HeldFloor {
    /// Index of its pose.
    pub pose: u32,
    /// Of cameras above it, and how evenly they keep it, one sigma.
    pub height: f64,
    pub height_sigma: f64,
    /// Cameras that drive on it: their indices.
    pub cameras: Vec<u32>,
    /// How even it is, one sigma.
    pub evenness: f64,
    /// Of each point: it lies on the floor.
    pub carries: Vec<bool>,
}

/// A residual and its derivatives by the floor's pose and by what lies or drives there.
pub(super) struct HeightTerm<const N: usize> {
    pub residual: Rows<1>,
    pub weight: f64,
    pub by_floor: Rows<6>,
    pub by_other: Rows<N>,
}

fn by_floor(q: &Vector3<f64>) -> Vector6<f64> {
    Vector6::new(q.y, -q.x, 0.0, 0.0, 0.0, 1.0)
}

impl HeldFloor {
    fn of_point(&self, floor: &Se3<Camera, World>, point: &Vector3<f64>) -> f64 {
        floor.transform(point).z / self.evenness
    }

    fn of_camera(&self, floor: &Se3<Camera, World>, camera: &Se3<Camera, World>) -> f64 {
        (floor.transform(&camera.inverse().translation).z - self.height) / self.height_sigma
    }

    /// The term of a point on the floor; `rotation`: of the floor's pose.
    pub(super) fn point_term(&self, floor: &Se3<Camera, World>, rotation: &Matrix3<f64>, point: &Vector3<f64>) -> HeightTerm<3> {
        let by_point = rotation.row(2).transpose();
        HeightTerm::new(self.of_point(floor, point), self.evenness, by_floor(&floor.transform(point)), by_point)
    }

    /// The term of a camera above the floor; rotations: of both poses.
    pub(super) fn camera_term(
        &self,
        (floor, floor_rotation): (&Se3<Camera, World>, &Matrix3<f64>),
        (camera, rotation): (&Se3<Camera, World>, &Matrix3<f64>),
    ) -> HeightTerm<6> {
        let along = -(rotation * floor_rotation.row(2).transpose());
        let by_camera = Vector6::new(0.0, 0.0, 0.0, along.x, along.y, along.z);
        let q = floor.transform(&camera.inverse().translation);
        HeightTerm::new(self.of_camera(floor, camera), self.height_sigma, by_floor(&q), by_camera)
    }

    /// Of everything on the floor.
    pub(super) fn cost(&self, poses: &[Se3<Camera, World>], points: &[Vector3<f64>]) -> f64 {
        let floor = &poses[self.pose as usize];
        let of_points = points.iter().zip(&self.carries).filter(|(_, on)| **on).map(|(point, _)| self.of_point(floor, point));
        let of_cameras = self.cameras.iter().map(|camera| self.of_camera(floor, &poses[*camera as usize]));
        of_points.chain(of_cameras).map(|e| LOSS.evaluate(e * e).0).sum()
    }
}

impl<const N: usize> HeightTerm<N> {
    fn new(residual: f64, sigma: f64, by_floor: Vector6<f64>, by_other: nalgebra::SVector<f64, N>) -> Self {
        let none = Vector1::new(0.0);
        Self {
            residual: [Vector1::new(residual), none],
            weight: LOSS.evaluate(residual * residual).1,
            by_floor: [by_floor / sigma, Vector6::zeros()],
            by_other: [by_other / sigma, nalgebra::SVector::zeros()],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::random::Random;
    use nalgebra::UnitQuaternion;

    #[test]
    fn derivatives_of_heights_agree_with_numeric_differences() {
        let mut random = Random::new(23);
        let mut vector = || Vector3::from_fn(|_, _| random.normal());
        let mut pose = || Se3::<Camera, World>::new(UnitQuaternion::from_scaled_axis(vector()), vector());
        let (floor, camera, point) = (pose(), pose(), pose().translation);
        let held = HeldFloor { height: 0.5, height_sigma: 0.01, evenness: 0.02, ..HeldFloor::default() };
        let rotation = |pose: &Se3<Camera, World>| *pose.rotation.to_rotation_matrix().matrix();
        let of_point = held.point_term(&floor, &rotation(&floor), &point);
        let of_camera = held.camera_term((&floor, &rotation(&floor)), (&camera, &rotation(&camera)));
        let step = 1e-6;
        for i in 0..6 {
            let moved = |pose: &Se3<Camera, World>, sign: f64| {
                let mut delta = Vector6::zeros();
                delta[i] = sign * step;
                pose.perturb_left(&delta)
            };
            let slope = |at: &dyn Fn(f64) -> f64| (at(1.0) - at(-1.0)) / (2.0 * step);
            let pairs = [
                (slope(&|sign| held.of_point(&moved(&floor, sign), &point)), of_point.by_floor[0][i]),
                (slope(&|sign| held.of_camera(&moved(&floor, sign), &camera)), of_camera.by_floor[0][i]),
                (slope(&|sign| held.of_camera(&floor, &moved(&camera, sign))), of_camera.by_other[0][i]),
            ];
            for (numeric, analytic) in pairs {
                assert!((numeric - analytic).abs() < 1e-4, "{i}: {numeric} {analytic}");
            }
        }
        for i in 0..3 {
            let at = |sign: f64| {
                let mut moved = point;
                moved[i] += sign * step;
                held.of_point(&floor, &moved)
            };
            let numeric = (at(1.0) - at(-1.0)) / (2.0 * step);
            assert!((numeric - of_point.by_other[0][i]).abs() < 1e-4, "{i}: {numeric}");
        }
    }
}
