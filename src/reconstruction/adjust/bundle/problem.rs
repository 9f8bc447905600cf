//! What a bundle adjustment is about: cameras, points, what was seen of them, and the residuals.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

use super::floor::HeldFloor;
use super::globals::{GlobalMatrix, GlobalVector, Globals, READOUT};
use super::lengths::KnownLength;
use super::targets::TargetCorner;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::reconstruction::measurement::{NEAREST, scaled};

/// One point seen by one camera.
#[derive(Debug, Clone, Copy)]
pub struct BundleObservation {
    /// Index into the cameras.
    pub camera: u32,
    /// Undistorted, plane z = 1, as it was seen.
    pub normalised: Vector2<f64>,
    /// How far a rolling shutter moved it, per second of readout time.
    pub displacement: Vector2<f64>,
    /// Square root of its information: standard deviations that a step on that plane counts as.
    pub sqrt_information: Matrix2<f64>,
}

/// What is adjusted.
#[derive(Debug, Clone, Default)]
pub struct BundleState {
    /// `camera_from_world` of each camera, then `target_from_world` of each target and `floor_from_world`.
    pub poses: Vec<Se3<Camera, World>>,
    /// World coordinates.
    pub points: Vec<Vector3<f64>>,
    pub globals: GlobalVector,
}

/// A bundle adjustment problem and, after [`adjust`](Self::adjust), its solution.
#[derive(Debug, Clone, Default)]
pub struct BundleProblem {
    pub state: BundleState,
    /// Which of the poses stay where they are.
    pub fixed: Vec<bool>,
    /// `first[i]..first[i + 1]` are the observations of point i; one longer than the points.
    pub first: Vec<u32>,
    pub observations: Vec<BundleObservation>,
    /// What the last observations, behind those of the points, have seen, one by one.
    pub corners: Vec<TargetCorner>,
    pub globals: Globals,
    /// What the wheels know of distances between cameras.
    pub lengths: Vec<KnownLength>,
    /// The floor that cameras drive on, where their height is known.
    pub floor: Option<HeldFloor>,
    /// Set by the adjustment: false = judged an outlier.
    pub inlier: Vec<bool>,
    /// Set by the adjustment: covariance of each point with cameras and floor held fixed, map units squared.
    pub point_covariances: Vec<Matrix3<f64>>,
    /// Set by the adjustment: covariance of the global parameters, everything else free, their priors in it (what is held, and what the
    /// problem does not have: no meaning); `None` where it cannot be told, or all are held.
    pub global_covariance: Option<GlobalMatrix>,
}

impl BundleProblem {
    /// Residual of observation `k` of `point` in standard deviations, and the point in the camera's coordinates; `None` behind it.
    pub(super) fn residual(
        &self,
        state: &BundleState,
        point: &Vector3<f64>,
        k: usize,
    ) -> Option<(Vector2<f64>, Vector3<f64>)> {
        let observation = &self.observations[k];
        let p = state.poses[observation.camera as usize].transform(point);
        if !(p.z > NEAREST) {
            return None;
        }
        let off = self.globals.through_new_lens(k, self.off(state, k, &p), &state.globals);
        Some((scaled(&observation.sqrt_information, off.x, off.y), p))
    }

    /// From where observation `k` was seen through the old lens to where `p` (in the camera's coordinates) is, on the plane z = 1.
    pub(super) fn off(&self, state: &BundleState, k: usize, p: &Vector3<f64>) -> Vector2<f64> {
        let observation = &self.observations[k];
        let at_middle_row = observation.normalised - observation.displacement * state.globals[READOUT];
        let iz = 1.0 / p.z;
        Vector2::new(p.x * iz - at_middle_row.x, p.y * iz - at_middle_row.y)
    }

    /// The observations of a point.
    pub fn range(&self, point: usize) -> std::ops::Range<usize> {
        self.first[point] as usize..self.first[point + 1] as usize
    }

    /// The inliers among them.
    pub fn inliers(&self, point: usize) -> impl Iterator<Item = usize> + '_ {
        self.range(point).filter(|&k| self.inlier[k])
    }

    /// The observations of targets' corners: those behind the points'.
    pub(super) fn seen_corners(&self) -> impl Iterator<Item = (usize, &TargetCorner)> + '_ {
        (self.observations.len() - self.corners.len()..).zip(&self.corners)
    }

    /// Where a corner is in the world.
    pub(super) fn corner(&self, state: &BundleState, corner: &TargetCorner) -> Vector3<f64> {
        corner.in_world(&state.poses[corner.target as usize])
    }
}
