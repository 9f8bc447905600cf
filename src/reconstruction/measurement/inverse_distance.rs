//! A landmark as a ray from the keyframe that saw it first, and an inverse distance on it (Civera, Davison, Montiel 2008, section III).
//!
//! Inverse, because infinity is then a place like any other. Where the distance is not known it is eliminated from a measurement: where
//! the camera has moved, only what lies across the epipolar line counts in full.

use nalgebra::{Vector2, Vector3};

use super::{Correspondence, residual, scaled};
use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::map::{AssumedDistance, LandmarkId, Map, Observation};

/// Standard deviation of the inverse distance in shares of it. A narrow one is worse than none: together, many landmarks would
/// rather turn the camera than not lie on a sphere.
pub const SIGMA_SHARE: f64 = 2.0;
/// 99.9 % limit of chi-square with two degrees of freedom: several views must all agree, of poses that are not exact.
const CHI2_2D_999: f64 = 13.816;

/// A landmark on the ray from its first observer.
#[derive(Debug, Clone, Copy)]
pub struct Ray {
    pub centre: Vector3<f64>,
    /// Unit length, world axes.
    pub direction: Vector3<f64>,
    pub assumed: AssumedDistance,
}

impl Ray {
    /// `None` for a landmark whose distance is told.
    pub fn of(id: LandmarkId, map: &Map, readout_s: f64) -> Option<Self> {
        let landmark = map.landmark(id)?;
        let assumed = landmark.assumed?;
        let anchor = map.keyframe(*landmark.observers.first()?)?;
        Some(Self::from_anchor(&anchor.camera_from_world, &anchor.observation(id)?, readout_s, assumed))
    }

    /// Of what a keyframe at `anchor` saw, with next to nothing known of its distance but how far away the scene is.
    pub fn at_distance(anchor: &Se3<Camera, World>, seen: &Observation, readout_s: f64, distance: f64) -> Self {
        let assumed = AssumedDistance { inverse: 1.0 / distance, sigma: SIGMA_SHARE / distance };
        Self::from_anchor(anchor, seen, readout_s, assumed)
    }

    fn from_anchor(anchor: &Se3<Camera, World>, seen: &Observation, readout_s: f64, assumed: AssumedDistance) -> Self {
        let world_from_anchor = anchor.inverse();
        let direction = (world_from_anchor.rotation * seen.at_middle_row(readout_s).push(1.0)).normalize();
        Self { centre: world_from_anchor.translation, direction, assumed }
    }

    /// World coordinates at an inverse distance.
    fn at(&self, inverse: f64) -> Vector3<f64> {
        self.centre + self.direction / inverse
    }

    /// Where it is taken to be.
    pub fn point(&self) -> Vector3<f64> {
        self.at(self.assumed.inverse)
    }

    /// The pair for poses near `pose` with the distance eliminated: its point lies at the most likely distance there, where the pair is
    /// linearised, and it is weighted by the covariance of the innovation from the assumed one (an iterated Kalman
    /// update; Bar-Shalom, Li, Kirubarajan 2001, section 10.5.2). `None` behind the camera.
    pub fn eliminate(&self, pose: &Se3<Camera, World>, pair: &Correspondence) -> Option<Correspondence> {
        let AssumedDistance { inverse: mean, sigma } = self.assumed;
        let rotated = pose.rotation * self.direction;
        // Place on the plane z = 1 and its derivative by the inverse distance.
        let see = |inverse: f64| {
            let p = pose.transform(&self.at(inverse));
            let n = p.xy() / p.z;
            (p.z > 1e-6).then(|| (n, (n * rotated.z - rotated.xy()) / (p.z * inverse * inverse)))
        };
        let pixels = |v: &Vector2<f64>| scaled(&pair.sqrt_information, 1.0, v.x, v.y);
        let (mut inverse, (mut n, mut derivative)) = (mean, see(mean)?);
        for _ in 0..3 {
            let (e, j) = (pixels(&(n - pair.normalised)), pixels(&derivative));
            let gradient = j.dot(&e) + (inverse - mean) / (sigma * sigma);
            let step = gradient / (j.norm_squared() + 1.0 / (sigma * sigma));
            let next = (inverse - step).clamp(0.02 * mean, 10.0 * mean);
            // A step too far lies behind the camera.
            let Some(seen) = see(next) else { break };
            (inverse, (n, derivative)) = (next, seen);
        }
        let j = pixels(&derivative) * sigma;
        let normalised = pair.normalised - derivative * (mean - inverse);
        Some(Correspondence { point: self.at(inverse), normalised, ray: None, ..*pair }.whitened(&(j * j.transpose())))
    }

    /// Whether the observation lies where some likely distance puts it.
    pub fn agrees(&self, pose: &Se3<Camera, World>, seen: &Observation, camera: &CameraModel, readout_s: f64) -> bool {
        let pair = Correspondence::observed(self.point(), seen, camera, readout_s);
        let pair = Correspondence { ray: Some(*self), ..pair };
        residual(pose, &pair).is_some_and(|seen| seen.e.norm_squared() <= CHI2_2D_999)
    }
}
