//! A landmark as a ray from the keyframe that saw it first, and an inverse distance on it (Civera, Davison, Montiel 2008, section III).
//!
//! Inverse, because infinity is then a place like any other. Where the distance is not known it is eliminated from a measurement: where
//! the camera has moved, only what lies across the epipolar line counts in full.

use nalgebra::Vector3;

use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::map::{AssumedDistance, LandmarkId, Map, Observation};

/// Standard deviation of the inverse distance in shares of it. A narrow one is worse than none: together, many landmarks would
/// rather turn the camera than not lie on a sphere.
pub const SIGMA_SHARE: f64 = 2.0;

/// A landmark on the ray from its first observer.
#[derive(Debug, Clone, Copy)]
pub struct Ray {
    pub centre: Vector3<f64>,
    /// Unit length, world axes.
    pub direction: Vector3<f64>,
    pub assumed: AssumedDistance,
}

impl Ray {
    /// `None` for a landmark whose distance is told. The ray begins at the first keyframe that is left of those that saw it.
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
    pub(super) fn at(&self, inverse: f64) -> Vector3<f64> {
        self.centre + self.direction / inverse
    }

    /// Where it is taken to be.
    pub fn point(&self) -> Vector3<f64> {
        self.at(self.assumed.inverse)
    }
}

/// More than two thirds of what a pose rests on is at assumed distances: the map hardly tells its position, and two views have to.
pub fn mostly_assumed(assumed: usize, landmarks: usize) -> bool {
    3 * assumed > 2 * landmarks
}
