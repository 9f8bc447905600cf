//! Targets of known size, such as printed tags: points that hang together rigidly, seen by cameras.
//!
//! A target's pose is one more pose of the state, behind the cameras': `target_from_world`, moved by left perturbations `[w, v]` as a camera's is. A
//! corner c on it lies at `X = R' (c - t)`, so a residual with the derivative g by X has, with `a = R g`, the derivatives `-(c x a)` by w and `-a` by
//! v. Its other derivatives are those of any point there. As the distances between the corners are known, it holds the scale, and the
//! cameras' distance to it, where a target is in view.

use nalgebra::{Matrix3, SVector, Vector3, Vector6};

use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};

/// A corner of a target.
#[derive(Debug, Clone, Copy)]
pub struct TargetCorner {
    /// Index of the target's pose.
    pub target: u32,
    /// In the target's coordinates, map units.
    pub place: Vector3<f64>,
}

impl TargetCorner {
    /// World coordinates, for this `target_from_world`.
    pub fn in_world(&self, pose: &Se3<Camera, World>) -> Vector3<f64> {
        pose.rotation.inverse() * (self.place - pose.translation)
    }

    /// Derivative by the target's pose of what has the derivative `by_point` by the corner's world coordinates; `rotation`: of the pose.
    pub(super) fn by_pose(&self, by_point: &SVector<f64, 3>, rotation: &Matrix3<f64>) -> Vector6<f64> {
        let along: Vector3<f64> = rotation * by_point;
        let turned = self.place.cross(&along);
        -Vector6::new(turned.x, turned.y, turned.z, along.x, along.y, along.z)
    }
}
