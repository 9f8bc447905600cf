//! What a bundle adjustment is about: cameras, points, what was seen of them, and the residuals.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

use super::shared::Shared;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::reconstruction::measurement::rolling_shutter::Readout;
use crate::reconstruction::measurement::scaled;

/// In the place of a fixed camera's index among the free ones.
pub(super) const FIXED: u32 = u32::MAX;

/// A keyframe's pose in the problem.
#[derive(Debug, Clone, Copy)]
pub struct BundleCamera {
    pub camera_from_world: Se3<Camera, World>,
    pub fixed: bool,
}

/// One point seen by one camera.
#[derive(Debug, Clone, Copy)]
pub struct BundleObservation {
    /// Index into the cameras.
    pub camera: u32,
    /// Undistorted, plane z = 1, as it was seen.
    pub normalised: Vector2<f64>,
    /// How far a rolling shutter moved it, per second of readout time.
    pub displacement: Vector2<f64>,
    /// Pixels that steps on that plane count as there.
    pub pixel_scale: Matrix2<f64>,
    /// One over the standard deviation, 1/px.
    pub inv_sigma_px: f64,
}

/// A bundle adjustment problem and, after [`adjust`](Self::adjust), its solution.
#[derive(Debug, Clone, Default)]
pub struct BundleProblem {
    pub cameras: Vec<BundleCamera>,
    /// World coordinates.
    pub points: Vec<Vector3<f64>>,
    /// `first[i]..first[i + 1]` are the observations of point i; one longer than `points`.
    pub first: Vec<u32>,
    pub observations: Vec<BundleObservation>,
    pub readout: Readout,
    /// `None`: the intrinsics are right as they are.
    pub shared: Option<Shared>,
    /// Set by the adjustment: false = judged an outlier.
    pub inlier: Vec<bool>,
    /// Set by the adjustment: covariance of each point with the cameras held fixed, map units squared.
    pub point_covariances: Vec<Matrix3<f64>>,
}

impl BundleProblem {
    /// Index of each camera among the free ones (`FIXED` for the others), and how many are free.
    pub(super) fn slots(&self) -> (Vec<u32>, usize) {
        let mut free = 0u32;
        let slot = self.cameras.iter().map(|c| {
            if c.fixed {
                return FIXED;
            }
            free += 1;
            free - 1
        });
        (slot.collect(), free as usize)
    }

    /// Residual of observation `k` of `point`, and the point in the camera's coordinates; `None` behind it.
    pub(super) fn residual(&self, point: &Vector3<f64>, k: usize) -> Option<(Vector2<f64>, Vector3<f64>)> {
        let observation = &self.observations[k];
        let p = self.cameras[observation.camera as usize].camera_from_world.transform(point);
        if p.z < 1e-6 {
            return None;
        }
        let mut off = self.off(k, &p);
        if let Some(shared) = &self.shared {
            off = off * shared.focal_scale() - shared.jacobians[k] * shared.moved();
        }
        Some((scaled(&observation.pixel_scale, observation.inv_sigma_px, off.x, off.y), p))
    }

    /// From where observation `k` was seen through the old lens to where `p` (in the camera's coordinates) is, on the plane z = 1.
    pub(super) fn off(&self, k: usize, p: &Vector3<f64>) -> Vector2<f64> {
        let observation = &self.observations[k];
        let at_middle_row = observation.normalised - observation.displacement * self.readout.seconds;
        let iz = 1.0 / p.z;
        Vector2::new(p.x * iz - at_middle_row.x, p.y * iz - at_middle_row.y)
    }

    /// Focal length of the residuals in units of the `pixel_scale`s'.
    pub(super) fn focal_scale(&self) -> f64 {
        self.shared.as_ref().map_or(1.0, Shared::focal_scale)
    }

    pub(super) fn range(&self, point: usize) -> std::ops::Range<usize> {
        self.first[point] as usize..self.first[point + 1] as usize
    }

    pub(super) fn prior_cost(&self) -> f64 {
        self.readout.prior_cost() + self.shared.as_ref().map_or(0.0, Shared::prior_cost)
    }
}

/// Huber's robust cost and weight of a squared residual.
#[inline]
pub(super) fn huber(e2: f64, delta2: f64) -> (f64, f64) {
    if e2 <= delta2 {
        (e2, 1.0)
    } else {
        let root = (e2 * delta2).sqrt();
        (2.0 * root - delta2, delta2 / root)
    }
}
