//! Rigid motions for planners that have no library for them: compose, invert, apply.

use super::pose::{Pose, rotation_matrix};

/// `a_from_b`: maps coordinates in `b` to coordinates in `a`, `x_a = R(orientation) * x_b + position`. It is also the place of
/// `b` in `a`. Name it after both frames, and neighbours cancel: `map_from_odom * odom_from_body`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Transform {
    /// Origin of `b` in `a`; unit of the map.
    pub position: [f64; 3],
    /// Unit quaternion (x, y, z, w), the axes of `b` in `a`.
    pub orientation: [f64; 4],
}

impl Default for Transform {
    fn default() -> Self {
        Self::IDENTITY
    }
}

impl Transform {
    /// Both frames coincide.
    pub const IDENTITY: Self = Self { position: [0.0; 3], orientation: [0.0, 0.0, 0.0, 1.0] };

    /// A place on level ground: `yaw_rad` counter-clockwise from above.
    pub fn level(x: f64, y: f64, yaw_rad: f64) -> Self {
        let (sin, cos) = (0.5 * yaw_rad).sin_cos();
        Self { position: [x, y, 0.0], orientation: [0.0, 0.0, sin, cos] }
    }

    /// `b_from_a`.
    pub fn inverse(&self) -> Self {
        let [x, y, z, w] = self.orientation;
        let back = Self { position: [0.0; 3], orientation: [-x, -y, -z, w] };
        Self { position: back.rotate(&self.position).map(|v| -v), ..back }
    }

    /// Of a point in `b`: the same point in `a`.
    pub fn apply(&self, point: &[f64; 3]) -> [f64; 3] {
        let [x, y, z] = self.rotate(point);
        [x + self.position[0], y + self.position[1], z + self.position[2]]
    }

    /// Of a direction or velocity in `b`: the same one in `a`.
    pub fn rotate(&self, [x, y, z]: &[f64; 3]) -> [f64; 3] {
        rotation_matrix(&self.orientation).map(|[a, b, c]| a * x + b * y + c * z)
    }

    /// Angle about the vertical, counter-clockwise from above, rad in (-pi, pi].
    pub fn yaw_rad(&self) -> f64 {
        let [x, y, z, w] = self.orientation;
        (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z))
    }

    /// Homogeneous 4x4 matrix, rows first.
    pub fn matrix(&self) -> [[f64; 4]; 4] {
        let [r0, r1, r2] = rotation_matrix(&self.orientation);
        let [x, y, z] = self.position;
        let row = |[a, b, c]: [f64; 3], t| [a, b, c, t];
        [row(r0, x), row(r1, y), row(r2, z), [0.0, 0.0, 0.0, 1.0]]
    }
}

impl core::ops::Mul for Transform {
    type Output = Self;

    /// `a_from_b * b_from_c = a_from_c`.
    fn mul(self, other: Self) -> Self {
        let [x1, y1, z1, w1] = self.orientation;
        let [x2, y2, z2, w2] = other.orientation;
        Self {
            position: self.apply(&other.position),
            orientation: [
                w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
                w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
                w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
                w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            ],
        }
    }
}

impl Pose {
    fn has_position(&self) -> bool {
        self.is_tracking() || self.is_dead_reckoned()
    }

    /// Place of the body in the map, `map_from_body`; `None` unless tracking or dead reckoning.
    pub fn map_from_body(&self) -> Option<Transform> {
        self.has_position().then_some(Transform { position: self.position, orientation: self.orientation })
    }

    /// Place of the body in odom, `odom_from_body`; `None` unless tracking or dead reckoning.
    pub fn odom_from_body(&self) -> Option<Transform> {
        self.has_position().then_some(Transform { position: self.odom_position, orientation: self.odom_orientation })
    }

    /// Heading: the body's angle about the vertical in odom, counter-clockwise from above, rad in (-pi, pi]; `None` where no orientation is
    /// known. It goes on from before the first map into it.
    pub fn heading_rad(&self) -> Option<f64> {
        let turned = Transform { position: [0.0; 3], orientation: self.odom_orientation };
        self.has_orientation().then(|| turned.yaw_rad())
    }

    /// `map_from_odom`, which REP-105 wants as the parent of `odom_from_body`: moves only when the map is corrected.
    pub fn map_from_odom(&self) -> Option<Transform> {
        Some(self.map_from_body()? * self.odom_from_body()?.inverse())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::STATE_TRACKING;

    #[track_caller]
    fn close<const N: usize>(got: [f64; N], want: [f64; N]) {
        for (g, w) in got.iter().zip(&want) {
            assert!((g - w).abs() < 1e-12, "{got:?} is not {want:?}");
        }
    }

    fn somewhere() -> Transform {
        Transform { position: [1.0, -2.0, 3.0], orientation: [0.1, -0.5, 0.7, 0.5] }
    }

    #[test]
    fn what_is_ahead_of_a_robot_that_looks_left_is_to_the_left() {
        let map_from_body = Transform::level(1.0, 2.0, std::f64::consts::FRAC_PI_2);
        close(map_from_body.apply(&[3.0, 0.0, 0.5]), [1.0, 5.0, 0.5]);
        assert!((map_from_body.yaw_rad() - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
        close(map_from_body.inverse().apply(&[1.0, 5.0, 0.5]), [3.0, 0.0, 0.5]);
    }

    #[test]
    fn products_and_inverses_agree_with_points() {
        let (a, b) = (somewhere(), Transform::level(4.0, 5.0, -0.8));
        let point = [0.3, 0.2, -0.1];
        close((a * b).apply(&point), a.apply(&b.apply(&point)));
        let nothing = a * a.inverse();
        close(nothing.position, [0.0; 3]);
        close(nothing.orientation, [0.0, 0.0, 0.0, 1.0]);
        let m = a.matrix();
        let [x, y, z] = point;
        close([0, 1, 2].map(|i| m[i][0] * x + m[i][1] * y + m[i][2] * z + m[i][3]), a.apply(&point));
    }

    #[test]
    fn map_from_odom_joins_the_two_poses_and_a_lost_robot_has_neither() {
        let (map, odom) = (somewhere(), Transform::level(7.0, 8.0, 0.3));
        let mut pose = Pose {
            position: map.position,
            orientation: map.orientation,
            odom_position: odom.position,
            odom_orientation: odom.orientation,
            state: STATE_TRACKING,
            ..Pose::default()
        };
        let joined = pose.map_from_odom().expect("tracked") * odom;
        close(joined.position, map.position);
        close(joined.orientation, map.orientation);
        pose.state = crate::messages::STATE_LOST;
        assert_eq!((pose.map_from_body(), pose.odom_from_body(), pose.map_from_odom()), (None, None, None));
        assert_eq!(pose.heading_rad(), None);
        pose.state = crate::messages::STATE_ORIENTATION;
        assert_eq!((pose.map_from_body(), pose.odom_from_body()), (None, None), "no position, no place");
        assert!((pose.heading_rad().expect("heading") - 0.3).abs() < 1e-12);
    }
}
