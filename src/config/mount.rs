//! `[mount]`: where the camera sits on the robot.
//!
//! `body_from_camera: Se3<Body, Camera>` maps optical camera axes (right, down, forward) to the robot's (REP-103: forward,
//! left, up). "Up" in the published world comes from here, not from gravity.

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use super::Invalid;
use crate::geometry::frames::{Body, Camera};
use crate::geometry::{Se3, ros_from_optical};

/// `[mount]` of the configuration.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct MountConfig {
    pub body_from_camera: BodyFromCamera,
}

/// The mount as a person measures it: by angles of the camera's body, or by the quaternion that a calibration gives.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct BodyFromCamera {
    /// The camera's optical centre in the body frame, m. Applied only once the map's scale is metric.
    pub translation_m: [f64; 3],
    /// Roll about forward, then pitch about left (positive: nose down), then yaw about up, of a camera that looks
    /// forward at 0 0 0; all about the body's fixed axes. Default 0 0 0.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rpy_deg: Option<[f64; 3]>,
    /// Or: rotation of the optical frame, `body_from_camera`, as x y z w.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quaternion_xyzw: Option<[f64; 4]>,
}

/// A quaternion written with three decimals still counts as one of length 1.
const LENGTH_TOLERANCE: f64 = 1e-2;

impl MountConfig {
    /// The values can be used.
    pub fn validate(&self) -> Result<(), Invalid> {
        let m = &self.body_from_camera;
        let key = |name: &str| format!("mount.body_from_camera.{name}");
        if m.translation_m.iter().any(|v| !v.is_finite() || v.abs() > 100.0) {
            return Err(Invalid::new(key("translation_m"), "must be three finite numbers within 100 m"));
        }
        if m.rpy_deg.is_some() && m.quaternion_xyzw.is_some() {
            return Err(Invalid::new(key("quaternion_xyzw"), "give either rpy_deg or quaternion_xyzw"));
        }
        if m.rpy_deg.is_some_and(|rpy| rpy.iter().any(|v| !v.is_finite() || v.abs() > 360.0)) {
            return Err(Invalid::new(key("rpy_deg"), "must be three finite numbers within 360 degrees"));
        }
        if let Some(q) = m.quaternion_xyzw {
            let length = q.iter().map(|v| v * v).sum::<f64>().sqrt();
            if !length.is_finite() || (length - 1.0).abs() > LENGTH_TOLERANCE {
                return Err(Invalid::new(key("quaternion_xyzw"), format!("must have length 1, has {length}")));
            }
        }
        Ok(())
    }

    /// The mount as a motion.
    pub fn body_from_camera(&self) -> Se3<Body, Camera> {
        let m = &self.body_from_camera;
        let rotation = match m.quaternion_xyzw {
            Some([x, y, z, w]) => UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)),
            None => {
                let [roll, pitch, yaw] = m.rpy_deg.unwrap_or_default().map(f64::to_radians);
                UnitQuaternion::from_euler_angles(roll, pitch, yaw) * ros_from_optical()
            }
        };
        Se3::new(rotation, Vector3::from(m.translation_m))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mount(rpy_deg: Option<[f64; 3]>, quaternion_xyzw: Option<[f64; 4]>) -> MountConfig {
        MountConfig { body_from_camera: BodyFromCamera { translation_m: [0.1, 0.0, 0.2], rpy_deg, quaternion_xyzw } }
    }

    /// Where the camera's optical axis points in the body.
    fn forward(config: &MountConfig) -> Vector3<f64> {
        config.body_from_camera().rotation * Vector3::z()
    }

    #[test]
    fn the_default_camera_looks_forward_and_is_upright() {
        let rotation = MountConfig::default().body_from_camera().rotation;
        assert!((rotation * Vector3::z() - Vector3::x()).norm() < 1e-12, "optical forward is body forward");
        assert!((rotation * Vector3::y() + Vector3::z()).norm() < 1e-12, "optical down is body down");
    }

    #[test]
    fn positive_pitch_looks_down_and_positive_yaw_looks_left() {
        assert!(forward(&mount(Some([0.0, 30.0, 0.0]), None)).z < -0.4);
        assert!((forward(&mount(Some([0.0, 0.0, 90.0]), None)) - Vector3::y()).norm() < 1e-12);
        let upside_down = mount(Some([180.0, 0.0, 0.0]), None);
        assert!((upside_down.body_from_camera().rotation * Vector3::y() - Vector3::z()).norm() < 1e-12);
    }

    #[test]
    fn the_quaternion_is_the_rotation_itself() {
        let q = ros_from_optical().coords;
        let config = mount(None, Some([q.x, q.y, q.z, q.w]));
        assert!(config.validate().is_ok());
        assert!(config.body_from_camera().rotation.angle_to(&ros_from_optical()) < 1e-12);
        assert_eq!(config.body_from_camera().translation, Vector3::new(0.1, 0.0, 0.2));
    }

    #[test]
    fn impossible_mounts_are_refused() {
        assert!(mount(None, Some([0.0, 0.0, 0.0, 2.0])).validate().is_err());
        assert!(mount(None, Some([f64::NAN, 0.0, 0.0, 1.0])).validate().is_err());
        assert!(mount(Some([0.0; 3]), Some([0.0, 0.0, 0.0, 1.0])).validate().is_err());
        assert!(mount(Some([f64::INFINITY, 0.0, 0.0]), None).validate().is_err());
    }
}
