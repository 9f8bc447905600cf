//! The floor under a driven camera: cameras that keep height and tilt above a plane, and landmarks that lie on it.
//!
//! The floor is one more pose of the state, behind the cameras' and beside the targets': `floor_from_world` (rotation R, third row r), whose z is the height
//! above it. Residuals, with `q = T_floor x`: of a landmark x on it `q_z / s`; of a camera with its centre x `(q_z - h) / s_h`, and of its tilt
//! `[b1 b2]' u / s_t` with the floor's normal `u = R_k r` in its axes and b1, b2 across the one that it should be. By left perturbations `[w, v]` of
//! the floor `dq_z = [q_y, -q_x, 0, 0, 0, 1]`, by x it is r, by those of camera k `[0, -R_k r]`; `d(b'u)` is `u x b` by the camera's w and `-e_z x (R R_k' b)` by the
//! floor's. Turning about the normal and sliding along the plane move nothing.
//!
//! A height is a length, so it holds the scale; and it parts rising from nodding, which look alike before a distant wall. Robots on wheels: Zheng and
//! Liu, "Visual-Odometric Localization and Mapping for Ground Vehicles Using SE(2)-XYZ Constraints", ICRA 2019. Cauchy's loss: what stands near the
//! floor is not on it, and there are sills.

use nalgebra::{Matrix3, SVector, Unit, Vector1, Vector2, Vector3, Vector6};

use super::options::LOSS_BESIDE_PICTURE;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::motion::floor::plane::basis;

/// A plane that cameras are driven over. Lengths in map units.
#[derive(Debug, Clone)]
pub struct HeldFloor {
    /// Index of its pose.
    pub pose: u32,
    /// Of cameras above it, and how evenly they keep it, one sigma.
    pub height: f64,
    pub height_sigma: f64,
    /// Cameras that drive on it: their indices.
    pub cameras: Vec<u32>,
    /// The floor's normal in the cameras' axes, and how steadily cameras keep that, one sigma, rad.
    pub up_camera: Unit<Vector3<f64>>,
    pub tilt_sigma: f64,
    /// How even it is, one sigma.
    pub evenness: f64,
    /// Of each point: it lies on the floor.
    pub on_floor: Vec<bool>,
    /// Points on it that stay where they are: where their pictures have them.
    pub around: Vec<Vector3<f64>>,
}

/// Derivatives of a residual's two rows (a place's x and y) by N unknowns; a height has one row, the other is zero.
pub(super) type Rows<const N: usize> = [SVector<f64, N>; 2];

/// Residuals and their derivatives by the floor's pose and by what lies or drives there.
pub(super) struct FloorTerm<const N: usize> {
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
    pub(super) fn point_term(
        &self,
        floor: &Se3<Camera, World>,
        rotation: &Matrix3<f64>,
        point: &Vector3<f64>,
    ) -> FloorTerm<3> {
        let by_point = rotation.row(2).transpose();
        FloorTerm::new(self.of_point(floor, point), self.evenness, by_floor(&floor.transform(point)), by_point)
    }

    /// The term of a camera above the floor; rotations: of both poses.
    pub(super) fn camera_term(
        &self,
        (floor, floor_rotation): (&Se3<Camera, World>, &Matrix3<f64>),
        (camera, rotation): (&Se3<Camera, World>, &Matrix3<f64>),
    ) -> FloorTerm<6> {
        let along = -(rotation * floor_rotation.row(2).transpose());
        let by_camera = Vector6::new(0.0, 0.0, 0.0, along.x, along.y, along.z);
        let q = floor.transform(&camera.inverse().translation);
        FloorTerm::new(self.of_camera(floor, camera), self.height_sigma, by_floor(&q), by_camera)
    }

    fn tilt(&self, floor: &Se3<Camera, World>, camera: &Se3<Camera, World>) -> Vector2<f64> {
        let (b1, b2) = basis(&self.up_camera);
        let up = camera.rotation * (floor.rotation.inverse() * Vector3::z());
        Vector2::new(b1.dot(&up), b2.dot(&up)) / self.tilt_sigma
    }

    /// The term of a camera's tilt against the floor; rotations: of both poses.
    pub(super) fn tilt_term(
        &self,
        (floor, floor_rotation): (&Se3<Camera, World>, &Matrix3<f64>),
        (camera, rotation): (&Se3<Camera, World>, &Matrix3<f64>),
    ) -> FloorTerm<6> {
        let residual = self.tilt(floor, camera);
        let up = rotation * floor_rotation.row(2).transpose();
        let (b1, b2) = basis(&self.up_camera);
        let turn = |w: Vector3<f64>| Vector6::new(w.x, w.y, w.z, 0.0, 0.0, 0.0) / self.tilt_sigma;
        let by_camera = |b: &Vector3<f64>| turn(up.cross(b));
        let by_floor = |b: &Vector3<f64>| turn(-Vector3::z().cross(&(floor_rotation * rotation.tr_mul(b))));
        FloorTerm {
            residual: [Vector1::new(residual.x), Vector1::new(residual.y)],
            weight: LOSS_BESIDE_PICTURE.evaluate(residual.norm_squared()).1,
            by_floor: [by_floor(&b1), by_floor(&b2)],
            by_other: [by_camera(&b1), by_camera(&b2)],
        }
    }

    /// Of everything on the floor.
    pub(super) fn cost(&self, poses: &[Se3<Camera, World>], points: &[Vector3<f64>]) -> f64 {
        let floor = &poses[self.pose as usize];
        let on = points.iter().zip(&self.on_floor).filter(|(_, on)| **on).map(|(point, _)| point);
        let of_points = on.chain(&self.around).map(|point| self.of_point(floor, point));
        let cameras = || self.cameras.iter().map(|camera| &poses[*camera as usize]);
        let heights = of_points.chain(cameras().map(|camera| self.of_camera(floor, camera))).map(|e| e * e);
        let tilts = cameras().map(|camera| self.tilt(floor, camera).norm_squared());
        heights.chain(tilts).map(|squared| LOSS_BESIDE_PICTURE.evaluate(squared).0).sum()
    }
}

impl<const N: usize> FloorTerm<N> {
    fn new(residual: f64, sigma: f64, by_floor: Vector6<f64>, by_other: SVector<f64, N>) -> Self {
        let none = Vector1::new(0.0);
        Self {
            residual: [Vector1::new(residual), none],
            weight: LOSS_BESIDE_PICTURE.evaluate(residual * residual).1,
            by_floor: [by_floor / sigma, Vector6::zeros()],
            by_other: [by_other / sigma, SVector::zeros()],
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
        let [turns, places] = [[vector(), vector()], [vector(), vector()]];
        let pose = |i: usize| Se3::<Camera, World>::new(UnitQuaternion::from_scaled_axis(turns[i]), places[i]);
        let (floor, camera, point) = (pose(0), pose(1), vector());
        let held = HeldFloor {
            pose: 0,
            height: 0.5,
            height_sigma: 0.01,
            cameras: Vec::new(),
            up_camera: Unit::new_normalize(vector()),
            tilt_sigma: 0.01,
            evenness: 0.02,
            on_floor: Vec::new(),
            around: Vec::new(),
        };
        let rotation = |pose: &Se3<Camera, World>| *pose.rotation.to_rotation_matrix().matrix();
        let of_point = held.point_term(&floor, &rotation(&floor), &point);
        let of_tilt = held.tilt_term((&floor, &rotation(&floor)), (&camera, &rotation(&camera)));
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
            let tilts = [0, 1].map(|axis| {
                let by_floor = slope(&|sign| held.tilt(&moved(&floor, sign), &camera)[axis]);
                let by_camera = slope(&|sign| held.tilt(&floor, &moved(&camera, sign))[axis]);
                [(by_floor, of_tilt.by_floor[axis][i]), (by_camera, of_tilt.by_other[axis][i])]
            });
            for (numeric, analytic) in pairs.into_iter().chain(tilts.into_iter().flatten()) {
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
