//! How a camera sits on the base of a robot, and what its wheels have wrong.

use nalgebra::{UnitQuaternion, Vector2, Vector3};

use crate::geometry::ros_from_optical;
use crate::motion::planar::Planar;

/// Unknowns of the robot: rotation about forward, left and up, lever x and y, yaw rate factor, time offset.
pub const ROBOT: usize = 7;

/// What is known of the robot, or taken for known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Robot {
    /// Camera's axes (optical) to the base's (REP-103).
    pub base_from_camera: UnitQuaternion<f64>,
    /// The camera before and left of the base's origin, m.
    pub lever_m: Vector2<f64>,
    /// True yaw rate over the wheels'.
    pub yaw_factor: f64,
    /// What is added to the time of a picture for that of the wheels, s.
    pub time_offset_s: f64,
    /// Standard deviations: rotation about the base's forward, left and up (rad), lever (m), factor, offset (s).
    pub sigma: [f64; ROBOT],
}

impl Robot {
    /// Nothing is known but that a camera more likely looks forward than anywhere else.
    pub fn unknown() -> Self {
        Self {
            base_from_camera: ros_from_optical(),
            lever_m: Vector2::zeros(),
            yaw_factor: 1.0,
            time_offset_s: 0.0,
            sigma: [2.0, 2.0, 2.0, 1.0, 1.0, 0.05, 0.05],
        }
    }

    /// The mount is given.
    pub fn mounted(base_from_camera: UnitQuaternion<f64>, lever_m: Vector2<f64>) -> Self {
        let given = [1e-4, 1e-4, 1e-4, 1e-4, 1e-4];
        let mut robot = Self { base_from_camera, lever_m, ..Self::unknown() };
        robot.sigma[..5].copy_from_slice(&given);
        robot
    }

    /// The camera's mount was found to a radian's fraction.
    pub(super) fn knows_rotation(&self) -> bool {
        self.sigma[..3].iter().all(|s| *s < 0.2)
    }

    /// The camera's motion that a base's motion makes, in the base's axes, m.
    pub fn step_of(&self, base: &Planar) -> Vector3<f64> {
        swing(base.yaw, &self.lever_m) + base.translation.push(0.0)
    }
}

/// `(Rz(yaw) - I) p`
pub(super) fn swing(yaw: f64, p: &Vector2<f64>) -> Vector3<f64> {
    let (s, c) = yaw.sin_cos();
    Vector3::new((c - 1.0) * p.x - s * p.y, s * p.x + (c - 1.0) * p.y, 0.0)
}
