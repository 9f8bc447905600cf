//! Landmarks whose distance is not known yet.
//!
//! A camera that turns on the spot sees no parallax, so what comes into view cannot be triangulated; yet its direction is known
//! at once, and that is all that a turn needs. Corners that two keyframes have seen without the camera having moved between them
//! become landmarks on the ray from the keyframe that saw them first, at the distance that the scene has had so far, with a
//! deviation in inverse distance that says next to nothing (inverse, because infinity is then a place like any other: Civera,
//! Davison, Montiel 2008, section III). Tracking eliminates the distance: where the camera has moved, only what lies across the
//! epipolar line counts in full. The motion that follows the turn is found by two views (`after_rotation`), and the first keyframe
//! from which they are seen under enough parallax triangulates them; from then on they are landmarks like all others.
//!
//! Until then no adjustment moves them (what it would make of the distance is the noise of the poses), and they are not
//! published: a planner wants places. Not here: how far the scale is off after the whole view has changed so. Nothing that the
//! camera sees tells that.

use nalgebra::Vector3;

use super::point::{observations_of, refine_point, reprojection_chi2};
use crate::geometry::CameraModel;
use crate::map::{KeyframeId, Landmark, LandmarkId, Map, Observation};
use crate::reconstruction::measurement::inverse_distance::{Ray, SIGMA_SHARE, mostly_assumed};
use crate::reconstruction::measurement::{CHI2_2D_95, middle_distance};
use crate::reconstruction::track::search::Match;

/// A distance is told by parallax once its standard deviation is below this share of it (a degree of parallax gives 0.13).
const TOLD_SHARE: f64 = 0.2;
/// A keyframe that sees landmarks at assumed distances and fewer others than this stays where it was tracked.
const HELD_BELOW: usize = 30;

/// Median distance of the matches' landmarks from `centre`.
pub fn distance_to_assume(matches: &[Match], centre: &Vector3<f64>) -> Option<f64> {
    let mut distances: Vec<f64> = matches.iter().map(|m| (m.point - centre).norm()).collect();
    middle_distance(&mut distances)
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
    let (newest, _) = others.last().filter(|_| agree)?;
    let landmark = Landmark::new(ray.point(), along * along.transpose(), *newest);
    Some(Landmark { assumed: Some(ray.assumed), ..landmark })
}

/// Triangulates the landmarks at assumed distances that the newest keyframe sees under enough parallax.
pub fn triangulate_assumed(map: &mut Map, newest: KeyframeId, camera: &CameraModel, readout_s: f64, min_parallax: f64) {
    let Some(keyframe) = map.keyframe(newest) else { return };
    let here = keyframe.centre();
    let ids: Vec<LandmarkId> = keyframe.observations.landmarks().collect();
    for id in ids {
        let Some(ray) = Ray::of(id, map, readout_s) else { continue };
        let Some(landmark) = map.landmark(id) else { continue };
        let mut point = landmark.position;
        if (point - here).angle(&(point - ray.centre)) < min_parallax {
            continue;
        }
        let seen = observations_of(map, id);
        let Some(covariance) = refine_point(map, &seen, camera, readout_s, &mut point) else { continue };
        let distance2 = (point - ray.centre).norm_squared();
        let told = ray.direction.dot(&(covariance * ray.direction)) < TOLD_SHARE * TOLD_SHARE * distance2;
        let ahead = (point - ray.centre).dot(&ray.direction) > 0.0;
        // Keyframes in between may still be placed badly.
        let fits = [seen.first(), seen.last()].into_iter().flatten().all(|(k, o)| {
            let pose = map.keyframe(*k).map(|k| k.camera_from_world);
            pose.is_some_and(|pose| reprojection_chi2(&pose, &point, o, camera, readout_s) <= CHI2_2D_95)
        });
        if told && ahead && fits {
            map.measure_landmark(id, point, covariance);
        }
    }
}

/// Whether so much of what a keyframe sees is at assumed distances that an adjustment, which leaves that out, cannot place it.
pub fn is_held(map: &Map, keyframe: KeyframeId) -> bool {
    let (assumed, all) = assumed_among(map, keyframe);
    assumed > 0 && all - assumed < HELD_BELOW
}

/// A keyframe whose place rests on assumed distances.
pub fn is_blind(map: &Map, keyframe: KeyframeId) -> bool {
    let (assumed, all) = assumed_among(map, keyframe);
    mostly_assumed(assumed, all) || is_held(map, keyframe)
}

/// The keyframe from which a landmark's distance is assumed; `None` if that is told.
pub fn ray_begins(map: &Map, landmark: LandmarkId) -> Option<KeyframeId> {
    map.landmark(landmark).filter(|l| l.assumed.is_some())?.observers.first().copied()
}

/// Keyframes from which the distances of what one sees are assumed: while these are not told, the way since then rests on them.
pub fn rays_begin(map: &Map, keyframe: KeyframeId) -> impl Iterator<Item = KeyframeId> {
    let seen = map.keyframe(keyframe).map(|k| k.observations.landmarks());
    seen.into_iter().flatten().filter_map(|id| ray_begins(map, id))
}

/// Landmarks at assumed distances that a keyframe sees, and all that it sees.
pub fn assumed_among(map: &Map, keyframe: KeyframeId) -> (usize, usize) {
    let Some(keyframe) = map.keyframe(keyframe) else { return (0, 0) };
    let is_assumed = |id: &LandmarkId| map.landmark(*id).is_some_and(|l| l.assumed.is_some());
    (keyframe.observations.landmarks().filter(is_assumed).count(), keyframe.observations.len())
}
