//! Geometry: pure functions on nalgebra types (faer solves what is large). No threads, IO, clock, logging, configuration or unseeded randomness.
//!
//! # Frames
//! Camera axes: x right, y down, z forward. Robot and world axes on the wire are REP-103: x forward, y left, z up.
//! [`ros_from_optical`] relates the two. Pixel (0, 0) is the centre of the first pixel.
//!
//! # Two views
//! The first camera is `[I | 0]`, the second `[R | t]` = `second_from_first`; `x2ᵀ F x1 = 0`, `E = [t]x R`.

pub mod alignment;
pub mod camera_model;
pub mod camera_motion;
pub mod cholesky;
mod displaced;
pub mod epipolar;
pub mod essential;
pub mod five_point;
pub mod fundamental;
pub mod homography;
pub mod homography_decomposition;
pub mod least_squares;
pub mod lens_model;
pub mod null_space;
pub mod one_camera;
pub mod p3p;
pub mod planar_pose;
pub mod plane_calibration;
pub mod pnp;
pub mod point_set;
pub mod polynomial;
pub mod pose_graph;
pub mod random;
pub mod ransac;
pub mod rotation;
pub mod se3;
pub mod sim3;
mod statistics;
#[cfg(test)]
pub(crate) mod synthetic;
pub mod triangulation;
pub mod two_view;
pub mod unknown_turn;

pub use camera_model::{CameraModel, CameraModelError};
pub use lens_model::LensModel;
pub use se3::Se3;
pub use statistics::{SIGMA_OVER_MEDIAN, median};

/// Marker types of the coordinate frames that a [`Se3`] maps between.
pub mod frames {
    /// The map's frame: that of the first keyframe's camera when the map was started, optical axes.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub struct World;
    /// The smooth odometry frame: never jumps within one reset counter.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub struct Odom;
    /// The camera's optical frame.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub struct Camera;
    /// The robot's body.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub struct Body;
    /// A keyframe's camera (the anchor that a relative pose refers to).
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub struct Keyframe;
    /// First camera of a pair.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub struct First;
    /// Second camera of a pair.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub struct Second;
}

/// Rotation that takes optical axes (right, down, forward) to REP-103 axes (forward, left, up).
pub fn ros_from_optical() -> nalgebra::UnitQuaternion<f64> {
    let m = nalgebra::Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
    nalgebra::UnitQuaternion::from_rotation_matrix(&nalgebra::Rotation3::from_matrix_unchecked(m))
}
