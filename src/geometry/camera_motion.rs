//! How a camera moves, and what that does to the picture.

use nalgebra::{Vector2, Vector3};

use super::Se3;
use super::frames::Camera;

/// How a camera moves at the time of a frame, in its own axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraMotion {
    /// Rotation that takes camera coordinates at one time to those a second later (rad/s).
    pub turn: Vector3<f64>,
    /// The same for the translation (map units/s).
    pub shift: Vector3<f64>,
}

impl CameraMotion {
    /// The constant one that makes the motion `this camera from the previous one` in `dt` seconds.
    pub fn over(motion: &Se3<Camera, Camera>, dt: f64) -> Self {
        let twist = motion.log() / dt;
        Self { turn: twist.fixed_rows::<3>(0).into_owned(), shift: twist.fixed_rows::<3>(3).into_owned() }
    }

    /// Of a motion whose lengths say nothing: its turn alone.
    pub fn turned_only(self) -> Self {
        Self { shift: Vector3::zeros(), ..self }
    }

    /// Velocity of a point's image on the plane z = 1 (1/s); the point in camera coordinates.
    pub fn flow(&self, point: &Vector3<f64>) -> Vector2<f64> {
        let v = self.turn.cross(point) + self.shift;
        let iz = 1.0 / point.z;
        Vector2::new(v.x - point.x * iz * v.z, v.y - point.y * iz * v.z) * iz
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::UnitQuaternion;

    fn motion() -> Se3<Camera, Camera> {
        Se3::new(UnitQuaternion::from_scaled_axis(Vector3::new(0.01, -0.02, 0.015)), Vector3::new(0.02, -0.01, 0.03))
    }

    #[test]
    fn flow_is_the_derivative_of_the_projection() {
        let motion = CameraMotion::over(&motion(), 0.1);
        let point = Vector3::new(0.4, -0.3, 2.0);
        let at = |t: f64| {
            let p = UnitQuaternion::from_scaled_axis(motion.turn * t) * point + motion.shift * t;
            Vector2::new(p.x / p.z, p.y / p.z)
        };
        let numeric = (at(1e-5) - at(-1e-5)) / 2e-5;
        assert!((numeric - motion.flow(&point)).norm() < 1e-6);
    }
}
