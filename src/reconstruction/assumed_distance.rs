//! Landmarks whose distance is not known yet.
//!
//! A camera that turns on the spot sees no parallax, so what comes into view cannot be triangulated; yet its direction is known
//! at once, and that is all that a turn needs. When the map's landmarks run out of the picture, corners without parallax
//! become landmarks on the ray from the keyframe that saw them first, at the distance that the scene has had so far, with a
//! deviation in inverse distance that says next to nothing (inverse, because infinity is then a place like any other: Civera,
//! Davison, Montiel 2008, section III). Tracking eliminates the distance: where the camera has moved, only what lies across the
//! epipolar line counts in full. The motion that follows the turn is found by two views (`after_turn`), and the first keyframe
//! from which they are seen under enough parallax triangulates them; from then on they are landmarks like all others.
//!
//! Until then no adjustment moves them (what it would make of the distance is the noise of the poses), and they are not
//! published: a planner wants places. Not here: how far the scale is off after the whole view has changed so. Nothing that the
//! camera sees tells that.

use nalgebra::{Matrix2, Vector2, Vector3};

use super::free_rotation::median;
use super::point::{refine_point, reprojection_chi2};
use super::pose_optimisation::{CHI2_2D_95, PosePair, scaled};
use super::search::Match;
use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::map::{AssumedDistance, KeyframeId, Landmark, LandmarkId, Map, Observation};

/// A keyframe with fewer matches than this makes landmarks at an assumed distance, and in a quick turn seeds hold a frame's pose, too.
pub const FEW_MATCHES: usize = 60;
/// Standard deviation of the inverse distance in shares of it. A narrow one is worse than none: together, many landmarks would
/// rather turn the camera than not lie on a sphere.
const SIGMA_SHARE: f64 = 2.0;
/// 99.9 % limit of chi-square with two degrees of freedom: several views must all agree, of poses that are not exact.
const CHI2_2D_999: f64 = 13.816;
/// A distance is told by parallax once its standard deviation is below this share of it (a degree of parallax gives 0.13).
const TOLD_SHARE: f64 = 0.2;
/// A keyframe that sees landmarks at assumed distances and fewer others than this stays where it was tracked.
const HELD_BELOW: usize = 30;

/// A landmark on the ray from its first observer.
#[derive(Debug, Clone, Copy)]
pub struct Ray {
    centre: Vector3<f64>,
    /// Unit length, world axes.
    direction: Vector3<f64>,
    assumed: AssumedDistance,
}

impl Ray {
    /// `None` for a landmark whose distance is told.
    pub fn of(id: LandmarkId, map: &Map, readout_s: f64) -> Option<Self> {
        let landmark = map.landmark(id)?;
        let assumed = landmark.assumed?;
        let anchor = map.keyframe(*landmark.observers.first()?)?;
        Some(Self::from_anchor(&anchor.camera_from_world, anchor.observation(id)?, readout_s, assumed))
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
    pub fn assumed(&self) -> Vector3<f64> {
        self.at(self.assumed.inverse)
    }

    /// The pair for poses near `pose` with the distance eliminated: its point lies at the most likely distance there, where the pair is
    /// linearised, and it is weighted by the covariance of the innovation from the assumed one (an iterated Kalman
    /// update; Bar-Shalom, Li, Kirubarajan 2001, section 10.5.2). `None` behind the camera.
    pub fn eliminate(&self, pose: &Se3<Camera, World>, pair: &PosePair) -> Option<PosePair> {
        let AssumedDistance { inverse: mean, sigma } = self.assumed;
        let rotated = pose.rotation * self.direction;
        // Place on the plane z = 1 and its derivative by the inverse distance.
        let see = |inverse: f64| {
            let p = pose.transform(&self.at(inverse));
            let n = p.xy() / p.z;
            (p.z > 1e-6).then(|| (n, (n * rotated.z - rotated.xy()) / (p.z * inverse * inverse)))
        };
        let pixels = |v: &Vector2<f64>| scaled(&pair.pixel_scale, pair.inv_sigma_px, v.x, v.y);
        let mut inverse = mean;
        for _ in 0..3 {
            let (n, derivative) = see(inverse)?;
            let (e, j) = (pixels(&(n - pair.normalised)), pixels(&derivative));
            let gradient = j.dot(&e) + (inverse - mean) / (sigma * sigma);
            let step = gradient / (j.norm_squared() + 1.0 / (sigma * sigma));
            inverse = (inverse - step).clamp(0.02 * mean, 10.0 * mean);
        }
        let (_, derivative) = see(inverse)?;
        let j = pixels(&derivative) * sigma;
        let whitening = (Matrix2::identity() + j * j.transpose()).cholesky()?.l().try_inverse()?;
        let normalised = pair.normalised - derivative * (mean - inverse);
        let pixel_scale = whitening * pair.pixel_scale;
        Some(PosePair { point: self.at(inverse), normalised, pixel_scale, ..*pair })
    }

    /// Whether the observation lies where some likely distance puts it.
    fn agrees(&self, pose: &Se3<Camera, World>, seen: &Observation, camera: &CameraModel, readout_s: f64) -> bool {
        let pair = PosePair::observed(self.assumed(), seen, camera, readout_s);
        self.eliminate(pose, &pair).is_some_and(|pair| {
            let p = pose.transform(&pair.point);
            let e = p.xy() / p.z - pair.normalised;
            scaled(&pair.pixel_scale, pair.inv_sigma_px, e.x, e.y).norm_squared() <= CHI2_2D_999
        })
    }
}

/// Median distance of the matches' landmarks from `centre`, if these are too few to go on with.
pub fn distance_to_assume(matches: &[Match], centre: &Vector3<f64>) -> Option<f64> {
    if matches.len() >= FEW_MATCHES {
        return None;
    }
    let distances: Vec<f64> = matches.iter().map(|m| (m.point - centre).norm()).collect();
    let median = median(&distances);
    (median.is_finite() && median > 1e-6).then_some(median)
}

/// A landmark at `distance` on the ray of its first observation; `None` if the others cannot have seen it anywhere there.
pub fn assume(
    map: &Map,
    seen: &[(KeyframeId, Observation)],
    distance: f64,
    camera: &CameraModel,
    readout_s: f64,
) -> Option<Landmark> {
    let (&(anchor, first), others) = seen.split_first()?;
    let ray = Ray::at_distance(&map.keyframe(anchor)?.camera_from_world, &first, readout_s, distance);
    let agree = others
        .iter()
        .all(|(k, o)| map.keyframe(*k).is_some_and(|k| ray.agrees(&k.camera_from_world, o, camera, readout_s)));
    let along = ray.direction * (SIGMA_SHARE * distance);
    (agree && !others.is_empty()).then(|| Landmark {
        position: ray.assumed(),
        covariance: along * along.transpose(),
        observers: Vec::new(),
        created_by: others.last().map_or(anchor, |o| o.0),
        assumed: Some(ray.assumed),
        sought: 1,
        found: 1,
        disagreed: 0,
    })
}

/// Triangulates the landmarks at assumed distances that the newest keyframe sees under enough parallax.
pub fn triangulate_assumed(map: &mut Map, newest: KeyframeId, camera: &CameraModel, readout_s: f64, min_parallax: f64) {
    let Some(keyframe) = map.keyframe(newest) else { return };
    let here = keyframe.centre();
    let ids: Vec<LandmarkId> = keyframe.observations.iter().map(|o| o.landmark).collect();
    for id in ids {
        let Some(ray) = Ray::of(id, map, readout_s) else { continue };
        let Some(landmark) = map.landmark(id) else { continue };
        let mut point = landmark.position;
        if (point - here).angle(&(point - ray.centre)) < min_parallax {
            continue;
        }
        let seen: Vec<(KeyframeId, Observation)> =
            landmark.observers.iter().filter_map(|&k| Some((k, *map.keyframe(k)?.observation(id)?))).collect();
        let Some(covariance) = refine_point(map, &seen, camera, readout_s, &mut point) else { continue };
        let distance2 = (point - ray.centre).norm_squared();
        let told = ray.direction.dot(&(covariance * ray.direction)) < TOLD_SHARE * TOLD_SHARE * distance2;
        let ahead = (point - ray.centre).dot(&ray.direction) > 0.0;
        // Keyframes in between may still be placed badly.
        let fits = [seen.first(), seen.last()].into_iter().flatten().all(|(k, o)| {
            let pose = map.keyframe(*k).map(|k| k.camera_from_world);
            pose.is_some_and(|pose| reprojection_chi2(&pose, &point, o, camera, readout_s) <= CHI2_2D_95)
        });
        if let Some(landmark) = map.landmarks.get_mut(id.0).filter(|_| told && ahead && fits) {
            (landmark.position, landmark.covariance, landmark.assumed) = (point, covariance, None);
        }
    }
}

/// Whether so much of what a keyframe sees is at assumed distances that an adjustment, which leaves that out, cannot place it.
pub fn is_held(map: &Map, keyframe: KeyframeId) -> bool {
    let (assumed, all) = assumed_among(map, keyframe);
    assumed > 0 && all - assumed < HELD_BELOW
}

/// Whether so much of what a frame's pose rests on is at assumed distances that only two views can tell its motion.
pub fn mostly_assumed(assumed: usize, landmarks: usize) -> bool {
    3 * assumed > 2 * landmarks
}

/// Landmarks at assumed distances that a keyframe sees, and all that it sees.
pub fn assumed_among(map: &Map, keyframe: KeyframeId) -> (usize, usize) {
    let Some(keyframe) = map.keyframe(keyframe) else { return (0, 0) };
    let is_assumed = |o: &&Observation| map.landmark(o.landmark).is_some_and(|l| l.assumed.is_some());
    (keyframe.observations.iter().filter(is_assumed).count(), keyframe.observations.len())
}
