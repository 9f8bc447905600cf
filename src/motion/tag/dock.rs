//! `[tag.dock]`: a tag as the origin of the map, as a person says where it hangs.

use nalgebra::{UnitQuaternion, Vector3};

use crate::features::tags::FAMILY_SIZE;
use crate::geometry::Se3;
use crate::geometry::frames::{Body, World};

/// Farther from the map's origin than this nobody measures where a tag hangs, m.
const MOST_M: f64 = 1000.0;

/// Where a tag is in the map. Its axes are those of a robot that looks straight at it: x into the tag, y to the left, z up; its origin is the middle of
/// its black square. At zero the map's x axis is where a robot at its dock looks.
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct DockConfig {
    /// The published map is the one in which the dock is where these keys say, once the map is metric and the dock was seen.
    pub enabled: bool,
    /// Number of the tag.
    pub id: u16,
    /// Its middle in the map, m.
    pub translation_m: [f64; 3],
    /// Roll about x, then pitch about y, then yaw about z, all about the map's fixed axes, degrees.
    pub rpy_deg: [f64; 3],
}

impl Default for DockConfig {
    fn default() -> Self {
        Self { enabled: false, id: 0, translation_m: [0.0; 3], rpy_deg: [0.0; 3] }
    }
}

impl DockConfig {
    /// First value out of its range: key, and what is allowed. `is_looked_for`: tags of this number are.
    pub(super) fn validate(&self, is_looked_for: bool) -> Result<(), (&'static str, String)> {
        // Written so that NaN fails.
        if !self.translation_m.iter().all(|v| v.abs() <= MOST_M) {
            return Err((
                "dock.translation_m",
                format!("must be three finite numbers within {MOST_M} m, not {:?}", self.translation_m),
            ));
        }
        if !self.rpy_deg.iter().all(|v| v.abs() <= 360.0) {
            return Err((
                "dock.rpy_deg",
                format!("must be three finite numbers within 360 degrees, not {:?}", self.rpy_deg),
            ));
        }
        if self.id >= FAMILY_SIZE {
            return Err((
                "dock.id",
                format!("the family 36h11 has the tags 0 to {}, not {}", FAMILY_SIZE - 1, self.id),
            ));
        }
        if self.enabled && !is_looked_for {
            return Err(("dock.id", format!("tag {} is not looked for: give size_m, and the number in ids", self.id)));
        }
        Ok(())
    }

    /// The same as a motion: the tag in the published map.
    pub fn map_from_dock(&self) -> Se3<World, Body> {
        let [roll, pitch, yaw] = self.rpy_deg.map(f64::to_radians);
        Se3::new(UnitQuaternion::from_euler_angles(roll, pitch, yaw), Vector3::from(self.translation_m))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dock_that_cannot_be_is_named() {
        let key = |dock: DockConfig| dock.validate(true).map_err(|(key, _)| key);
        let dock = DockConfig { enabled: true, id: 7, ..DockConfig::default() };
        assert_eq!(key(dock), Ok(()));
        assert_eq!(key(DockConfig { id: 587, enabled: false, ..dock }), Err("dock.id"));
        assert_eq!(dock.validate(false).map_err(|(key, _)| key), Err("dock.id"), "nobody looks for it");
        for wrong in [f64::NAN, f64::INFINITY, 2000.0] {
            assert_eq!(key(DockConfig { translation_m: [0.0, wrong, 0.0], ..dock }), Err("dock.translation_m"));
            assert_eq!(key(DockConfig { rpy_deg: [0.0, 0.0, wrong], ..dock }), Err("dock.rpy_deg"));
        }
    }

    #[test]
    fn a_dock_with_a_yaw_of_90_degrees_is_looked_at_along_y() {
        let dock = DockConfig { translation_m: [1.0, 2.0, 0.3], rpy_deg: [0.0, 0.0, 90.0], ..DockConfig::default() };
        let before_it = dock.map_from_dock().transform(&Vector3::new(-0.5, 0.0, 0.0));
        assert!((before_it - Vector3::new(1.0, 1.5, 0.3)).norm() < 1e-12, "{before_it}");
    }
}
