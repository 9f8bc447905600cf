//! Lengths of steps between cameras that something beside the picture knows: the wheels.
//!
//! With `T_ab = T_a T_b⁻¹` the motion between two cameras, t its translation and u its direction, the residual is `e = (|t| - L) / s`. What
//! wheels say of direction and turn is far below what the picture says of both, so their length alone is taken: it holds the scale, which the
//! picture lets drift. By left perturbations `[w, v]` of either pose `de/dv_a = u'/s`, `de/dv_b = -u' R_ab / s`; rotations have no part in it
//! (`u' [t]x = 0`). Cauchy's loss: a wheel that slips now is not known to do so until later.

use nalgebra::{Matrix6, Vector3, Vector6};

use super::options::LOSS_BESIDE_PICTURE;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};

/// The distance of two cameras' centres.
#[derive(Debug, Clone, Copy)]
pub struct KnownLength {
    /// Indices into the cameras.
    pub cameras: [u32; 2],
    /// Map units, and its standard deviation.
    pub length: f64,
    pub sigma: f64,
}

/// Its part of the normal equations.
pub(super) struct LengthTerm {
    pub own: [Matrix6<f64>; 2],
    /// First camera's rows, second camera's columns.
    pub cross: Matrix6<f64>,
    pub gradient: [Vector6<f64>; 2],
}

impl KnownLength {
    /// Residual, standard deviations, and its derivatives by both poses; `None` where the cameras are in one place, or nothing is told: one NaN
    /// would spoil all that is adjusted with it.
    fn linearised(&self, poses: &[Se3<Camera, World>]) -> Option<(f64, [Vector6<f64>; 2])> {
        let [a, b] = self.cameras.map(|camera| poses[camera as usize]);
        let between = a * b.inverse();
        let length = between.translation.norm();
        let told = self.length.is_finite() && self.sigma > 0.0 && self.sigma.is_finite();
        if !(told && length > 1e-9) {
            return None;
        }
        let along = between.translation / length;
        let row = |v: Vector3<f64>| Vector6::new(0.0, 0.0, 0.0, v.x, v.y, v.z) / self.sigma;
        Some(((length - self.length) / self.sigma, [row(along), row(-(between.rotation.inverse() * along))]))
    }

    pub(super) fn cost(&self, poses: &[Se3<Camera, World>]) -> f64 {
        self.linearised(poses).map_or(0.0, |(e, _)| LOSS_BESIDE_PICTURE.evaluate(e * e).0)
    }

    pub(super) fn term(&self, poses: &[Se3<Camera, World>]) -> Option<LengthTerm> {
        let (e, [a, b]) = self.linearised(poses)?;
        let (_, weight) = LOSS_BESIDE_PICTURE.evaluate(e * e);
        Some(LengthTerm {
            own: [a * a.transpose() * weight, b * b.transpose() * weight],
            cross: a * b.transpose() * weight,
            gradient: [a * (e * weight), b * (e * weight)],
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::random::Random;
    use nalgebra::UnitQuaternion;

    #[test]
    fn a_length_without_a_finite_sigma_has_no_part_in_an_adjustment() {
        let poses = [Se3::identity(), Se3::new(UnitQuaternion::identity(), Vector3::new(0.7, 0.0, 0.0))];
        for (length, sigma) in [(0.7, 0.0), (0.7, f64::NAN), (0.7, f64::INFINITY), (f64::NAN, 0.1), (0.7, -0.1)] {
            let known = KnownLength { cameras: [0, 1], length, sigma };
            assert!(known.term(&poses).is_none() && known.cost(&poses) == 0.0, "{length} {sigma}");
        }
    }

    #[test]
    fn jacobian_of_a_length_agrees_with_numeric_differences() {
        let mut random = Random::new(17);
        let mut pose = || {
            let mut v = || Vector3::new(random.normal(), random.normal(), random.normal());
            Se3::new(UnitQuaternion::from_scaled_axis(v()), v())
        };
        let poses = [pose(), pose()];
        let known = KnownLength { cameras: [0, 1], length: 0.7, sigma: 0.05 };
        let (_, rows) = known.linearised(&poses).expect("apart");
        for (camera, row) in rows.iter().enumerate() {
            for i in 0..6 {
                let at = |sign: f64| {
                    let mut moved = poses;
                    let mut delta = Vector6::zeros();
                    delta[i] = sign * 1e-6;
                    moved[camera] = moved[camera].perturb_left(&delta);
                    known.linearised(&moved).expect("apart").0
                };
                let numeric = (at(1.0) - at(-1.0)) / 2e-6;
                assert!((numeric - row[i]).abs() < 1e-5, "camera {camera}, {i}: {numeric}, {}", row[i]);
            }
        }
    }
}
