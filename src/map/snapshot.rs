//! What the map shows the outside: landmarks and keyframes as plain values, for publishing, files and plots.

use nalgebra::{Matrix3, Vector3};

use super::{KeyframeId, LandmarkId, Map, MapId};
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::map::scale::MapScale;

/// A landmark as the outside sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LandmarkView {
    pub id: LandmarkId,
    pub position_world: Vector3<f64>,
    /// One sigma along the line of sight, map units; NaN = unknown.
    pub sigma: f32,
    /// Keyframes that observe it.
    pub observations: u32,
}

/// Standard deviation along the worst direction of a covariance; NaN, which is not known, where that is not finite.
pub fn largest_sigma(covariance: &Matrix3<f64>) -> f64 {
    if !covariance.iter().all(|v| v.is_finite()) {
        return f64::NAN;
    }
    covariance.symmetric_eigenvalues().max().max(0.0).sqrt()
}

/// A keyframe as the outside sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframeView {
    pub id: KeyframeId,
    pub timestamp_ns: i64,
    pub world_from_camera: Se3<World, Camera>,
}

/// What stands around the robot in a metric map, for pictures: world, m.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Around {
    /// Both ends of the stretches of the floor that are seen free.
    pub free: Vec<[Vector3<f64>; 2]>,
    pub in_the_way: Vec<Vector3<f64>>,
}

/// The current map; whoever fills it reuses the buffers.
#[derive(Debug, Clone, Default)]
pub struct MapSnapshot {
    pub map: MapId,
    /// Grows with every change of the map.
    pub revision: u64,
    /// What lengths are.
    pub scale: MapScale,
    /// Ascending id.
    pub landmarks: Vec<LandmarkView>,
    /// Ascending id.
    pub keyframes: Vec<KeyframeView>,
    /// Older landmarks and keyframes that were left out.
    pub left_out: [usize; 2],
    /// Nothing unless somebody fills it for a picture.
    pub around: Around,
}

impl MapSnapshot {
    /// Becomes what this map shows.
    pub fn fill(&mut self, id: MapId, map: &Map) {
        self.fill_newest(id, map, [usize::MAX; 2]);
    }

    /// The same with so many landmarks and keyframes at the most, the newest. Cost: 0.2 us for each of these landmarks.
    pub fn fill_newest(&mut self, id: MapId, map: &Map, most: [usize; 2]) {
        self.map = id;
        self.revision = map.revision;
        self.landmarks.clear();
        // Where the distance is assumed there is no place to publish.
        let placed = || map.landmarks.iter().filter(|(_, l)| l.assumed.is_none());
        self.left_out = [placed().count().saturating_sub(most[0]), map.keyframes.len().saturating_sub(most[1])];
        self.landmarks.extend(placed().skip(self.left_out[0]).map(|(id, l)| LandmarkView {
            id: LandmarkId(id),
            position_world: l.position,
            sigma: largest_sigma(&l.covariance) as f32,
            observations: l.observers.len() as u32,
        }));
        self.keyframes.clear();
        self.keyframes.extend(map.keyframes.iter().skip(self.left_out[1]).map(|(id, k)| KeyframeView {
            id: KeyframeId(id),
            timestamp_ns: k.timestamp_ns,
            world_from_camera: k.camera_from_world.inverse(),
        }));
    }

    /// Landmarks and keyframes of the map, those that were left out among them.
    pub fn totals(&self) -> [usize; 2] {
        [self.left_out[0] + self.landmarks.len(), self.left_out[1] + self.keyframes.len()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_place_is_not_published_as_a_perfectly_known_one() {
        assert!(largest_sigma(&Matrix3::from_element(f64::NAN)).is_nan());
        let known = Matrix3::from_diagonal(&Vector3::new(0.01, 0.25, 0.04));
        assert!((largest_sigma(&known) - 0.5).abs() < 1e-12);
    }
}
