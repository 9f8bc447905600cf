//! When a frame becomes a keyframe, and what the map gains and loses by it.
//!
//! New landmarks come from seeds (tracks without depth): when the rays from their anchor keyframe and from the new one make
//! enough of an angle, the point is triangulated, its place in the new picture is refined against the anchor's template,
//! and it must reproject well into every keyframe that saw it.

mod after_rotation;
pub mod corners;
pub mod cull;
pub mod distance_prior;
pub mod epipolar;
#[cfg(test)]
mod growth_tests;
pub mod motion;
pub mod pictures;
pub mod point;
mod superseded;

use std::sync::Arc;

use nalgebra::{Vector2, Vector3};

use super::config::ReconstructionConfig;
use super::measurement::rolling_shutter::Shutter;
use super::track::association::{Bindings, Seed, Target};
use super::track::frame::QUICK_TURN_RAD;
use super::track::search::Match;
use super::track::template::{observe, refine_in};
use crate::features::thumbnail::thumbnail_of;
use crate::features::{Feedback, FrameFeatures};
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::image::Pyramid;
use crate::map::picture::KeyframePicture;
use crate::map::{Keyframe, KeyframeId, Landmark, LandmarkId, Map, MapId, Observation, TurnId};
use distance_prior::assume;
use point::{refine_point, reprojection_chi2};

/// What the decision looks at.
#[derive(Debug, Clone, Copy, Default)]
pub struct KeyframeInputs {
    /// Landmarks the frame's pose rests on.
    pub landmarks: usize,
    /// Landmarks of the reference keyframe.
    pub reference_landmarks: usize,
    /// Median angle between the rays to the frame's landmarks from here and from the reference keyframe, degrees.
    pub parallax_deg: f64,
    /// How far the camera has turned since the frame before; 0 if that is not known.
    pub turn_rad: f64,
}

/// In a quick turn every frame with less than this share of the landmarks that a frame may have becomes a keyframe. Without it errors over
/// 35 sequences are 12 % larger in the geometric mean, most in walks at 5 Hz.
const FEW_IN_QUICK_TURN: f64 = 0.55;

/// Whether a frame becomes a keyframe.
pub fn wants_keyframe(inputs: &KeyframeInputs, config: &ReconstructionConfig) -> bool {
    let expected = inputs.reference_landmarks.min(config.landmarks_per_frame) as f64;
    let landmarks = inputs.landmarks as f64;
    landmarks < config.keyframe_share * expected
        || inputs.parallax_deg > config.keyframe_parallax_deg
        || inputs.landmarks < 3 * config.min_landmarks && inputs.parallax_deg > config.min_parallax_deg
        || inputs.turn_rad > QUICK_TURN_RAD && landmarks < FEW_IN_QUICK_TURN * config.landmarks_per_frame as f64
}

/// What does not change while a keyframe is made.
#[derive(Clone, Copy)]
pub struct Lens<'a> {
    pub camera: &'a CameraModel,
    pub config: &'a ReconstructionConfig,
    pub shutter: &'a Shutter,
    /// Squared residual, in supposed standard deviations, beyond which a place is an outlier.
    pub outlier_chi2: f64,
}

/// A tracked frame on its way into the map.
pub struct NewKeyframe<'a> {
    pub features: &'a FrameFeatures,
    /// A copy of the frame's: that one goes back to its pool, which so never has to allocate on the path of a pose.
    pub picture: Arc<Pyramid>,
    pub camera_from_world: Se3<Camera, World>,
    pub map_id: MapId,
    /// Matches that agree with the pose, ascending landmark id.
    pub matches: &'a [Match],
    pub motion: Option<CameraMotion>,
    pub lens: Lens<'a>,
    /// The last turn that the scale of its pose came through.
    pub scale_from: Option<TurnId>,
    /// Its pose rests on assumed distances: nothing can be triangulated from it.
    pub unmeasured: bool,
    /// Distance at which corners without parallax become landmarks, map units; `None` where nothing tells one.
    pub assumed_distance: Option<f64>,
}

/// The newest keyframes are not culled, as the local adjustment still gains by them, and keep their whole pictures.
const YOUNG_KEYFRAMES: u32 = 12;
/// Radius within which a track and a found landmark are the same corner, px.
pub(super) const SAME_CORNER_PX: f32 = 2.0;
/// A track that has left its landmark's found place by more than this has drifted, px.
const DRIFTED_PX: f32 = 3.0;

pub(super) fn observe_match(camera: &CameraModel, m: &Match) -> Option<Observation> {
    let o = observe(camera, m.landmark, m.pixel, m.inv_sigma_px)?;
    Some(Observation { displacement: m.displacement, ..o })
}

/// Enters a frame into the map: keyframe, new landmarks, new seeds. Tracks that follow nothing useful go to `feedback`.
pub fn insert_keyframe(
    map: &mut Map,
    bindings: &mut Bindings,
    new: &NewKeyframe<'_>,
    feedback: &mut Feedback,
) -> KeyframeId {
    let observations = new.matches.iter().filter_map(|m| observe_match(new.lens.camera, m)).collect();
    let id = map.add_keyframe(Keyframe {
        sequence: new.features.sequence,
        timestamp_ns: new.features.timestamp_ns,
        map: new.map_id,
        camera_from_world: new.camera_from_world,
        motion: new.motion,
        picture: KeyframePicture::new(new.picture.clone()),
        thumbnail: thumbnail_of(&new.features.pyramid),
        scale_from: new.scale_from,
        observations,
        covisible: Vec::new(),
        corners: Vec::new(),
    });
    for track in &new.features.tracks {
        match bindings.get(track.id).copied() {
            Some(Target::Landmark(landmark)) if map.landmark(landmark).is_some() => {
                let drifted =
                    find(new.matches, landmark).is_some_and(|m| (m.pixel - track.position).norm() > DRIFTED_PX);
                if drifted {
                    bindings.remove(track.id);
                    feedback.forget.push(track.id);
                }
            }
            Some(Target::Seed(mut seed)) => match triangulate_seed(map, &seed, id, track.position, new) {
                SeedOutcome::Landmark(landmark) => bindings.set(track.id, Target::Landmark(landmark)),
                SeedOutcome::Waits => {
                    seed.add(id, track.position);
                    bindings.set(track.id, Target::Seed(seed));
                }
                SeedOutcome::Wrong => {
                    bindings.remove(track.id);
                    feedback.forget.push(track.id);
                }
                SeedOutcome::Orphan => bindings.set(track.id, Target::Seed(Seed::new(id, track.position))),
            },
            // Unbound, or its landmark is gone.
            _ => match new.matches.iter().find(|m| (m.pixel - track.position).norm() < SAME_CORNER_PX) {
                Some(m) if !is_bound(bindings, m.landmark) => bindings.set(track.id, Target::Landmark(m.landmark)),
                Some(_) => {
                    bindings.remove(track.id);
                    feedback.forget.push(track.id);
                }
                None => bindings.set(track.id, Target::Seed(Seed::new(id, track.position))),
            },
        }
    }
    id
}

/// Binds the tracks that follow a landmark of `keyframe` made since `first_new` to it.
pub(super) fn bind_new(
    map: &Map,
    bindings: &mut Bindings,
    features: &FrameFeatures,
    keyframe: KeyframeId,
    first_new: u32,
) {
    let Some(keyframe) = map.keyframe(keyframe) else { return };
    for (landmark, pixel) in keyframe.observations.pixels().filter(|o| o.0.0 >= first_new) {
        let near = features.tracks.iter().find(|t| (t.position - pixel).norm() < SAME_CORNER_PX);
        if let Some(track) = near.filter(|t| !matches!(bindings.get(t.id), Some(Target::Landmark(_)))) {
            bindings.set(track.id, Target::Landmark(landmark));
        }
    }
}

fn find(matches: &[Match], landmark: LandmarkId) -> Option<&Match> {
    matches.binary_search_by_key(&landmark, |m| m.landmark).ok().map(|i| &matches[i])
}

fn is_bound(bindings: &Bindings, landmark: LandmarkId) -> bool {
    bindings.iter().any(|(_, t)| matches!(t, Target::Landmark(l) if *l == landmark))
}

enum SeedOutcome {
    Landmark(LandmarkId),
    /// Not enough parallax yet.
    Waits,
    /// The rays do not meet, or the picture there is another.
    Wrong,
    /// Its anchor keyframe, or its picture, is gone.
    Orphan,
}

/// A keyframe is there and has its whole picture, so that a template of any place can be cut from it.
fn is_whole(map: &Map, id: KeyframeId) -> bool {
    map.keyframe(id).is_some_and(|k| k.picture.whole().is_some())
}

fn triangulate_seed(
    map: &mut Map,
    seed: &Seed,
    newest: KeyframeId,
    pixel: Vector2<f32>,
    new: &NewKeyframe<'_>,
) -> SeedOutcome {
    let Lens { camera, config, shutter, .. } = new.lens;
    let Some(&(anchor_id, anchor_pixel)) = seed.observations().iter().find(|(k, _)| is_whole(map, *k)) else {
        return SeedOutcome::Orphan;
    };
    let Some(anchor) = map.keyframe(anchor_id) else { return SeedOutcome::Orphan };
    let none = LandmarkId::default();
    let inv_sigma = 1.0 / config.sigma_px;
    let (Some(a), Some(b)) = (observe(camera, none, anchor_pixel, inv_sigma), observe(camera, none, pixel, inv_sigma))
    else {
        return SeedOutcome::Wrong;
    };
    let enough = |(_, angle): &(Vector3<f64>, f64)| *angle >= config.min_parallax_deg.to_radians();
    let met = triangulate(&anchor.camera_from_world, &a.normalised, &new.camera_from_world, &b.normalised);
    let (point, assumed) = match (met.filter(|met| enough(met) && !new.unmeasured), new.assumed_distance) {
        (Some((point, _)), _) => (point, None),
        (None, Some(distance)) if seed.count >= 2 => {
            let world_from_anchor = anchor.camera_from_world.inverse();
            let centre = world_from_anchor.translation;
            let moved = (centre - new.camera_from_world.inverse().translation).norm();
            if moved > distance * config.min_parallax_deg.to_radians() {
                // It waits because it is far, not because the camera turns on the spot.
                return SeedOutcome::Waits;
            }
            let ray = (world_from_anchor.rotation * a.normalised.push(1.0)).normalize();
            (centre + ray * distance, Some(distance))
        }
        (None, _) => return SeedOutcome::Waits,
    };
    // Refine the place in the new picture (and in those between) against the anchor's template.
    let displaced = |keyframe: &Keyframe, o: Observation| displaced(keyframe, o, &point, shutter);
    let readout_s = shutter.readout_s;
    let mut seen: Vec<(KeyframeId, Observation)> = vec![(anchor_id, displaced(anchor, a))];
    for &(id, pixel) in seed.observations().iter().chain(&[(newest, pixel)]) {
        let Some(keyframe) = map.keyframe(id).filter(|_| id != anchor_id) else { continue };
        match refine_in(anchor, &a, keyframe, &point, pixel, camera, config.sigma_px) {
            Some(o) => seen.push((id, displaced(keyframe, o))),
            None if id == newest => return SeedOutcome::Wrong,
            None => {}
        }
    }
    if let Some(distance) = assumed {
        return match assume(map, &seen, distance, camera, readout_s) {
            Some(landmark) => SeedOutcome::Landmark(map.add_landmark(landmark, &seen)),
            None => SeedOutcome::Wrong,
        };
    }
    let (first, last) = (seen[0].1.at_middle_row(readout_s), seen[seen.len() - 1].1.at_middle_row(readout_s));
    let Some(met) = triangulate(&anchor.camera_from_world, &first, &new.camera_from_world, &last) else {
        return SeedOutcome::Wrong;
    };
    if !enough(&met) {
        return SeedOutcome::Waits;
    }
    match made_of(map, &seen, &new.lens) {
        Some((landmark, seen)) => SeedOutcome::Landmark(map.add_landmark(landmark, &seen)),
        None => SeedOutcome::Wrong,
    }
}

/// What a keyframe saw of `point`, with what a rolling shutter did to it.
pub(super) fn displaced(keyframe: &Keyframe, o: Observation, point: &Vector3<f64>, shutter: &Shutter) -> Observation {
    let p = keyframe.camera_from_world.transform(point);
    Observation { displacement: shutter.displacement(keyframe.motion.as_ref(), &p, o.pixel.y), ..o }
}

/// The landmark that the observations, the anchor's first and the newest keyframe's last, make together, with those that agree;
/// `None` if these two do not, or do not meet at `min_parallax_deg`.
pub(super) fn made_of(
    map: &Map,
    seen: &[(KeyframeId, Observation)],
    lens: &Lens<'_>,
) -> Option<(Landmark, Vec<(KeyframeId, Observation)>)> {
    let Lens { camera, config, shutter, outlier_chi2 } = *lens;
    let readout_s = shutter.readout_s;
    let (&(anchor, first), &(newest, last)) = (seen.first()?, seen.last()?);
    let [anchor_pose, newest_pose] = [map.keyframe(anchor)?, map.keyframe(newest)?].map(|k| k.camera_from_world);
    let (first, last) = (first.at_middle_row(readout_s), last.at_middle_row(readout_s));
    let (mut point, angle) = triangulate(&anchor_pose, &first, &newest_pose, &last)?;
    if angle < config.min_parallax_deg.to_radians() {
        return None;
    }
    let covariance = refine_point(map, seen, camera, readout_s, &mut point)?;
    let agrees = |(k, o): &&(KeyframeId, Observation)| {
        map.keyframe(*k)
            .is_some_and(|k| reprojection_chi2(&k.camera_from_world, &point, o, camera, readout_s) <= outlier_chi2)
    };
    let seen: Vec<_> = seen.iter().filter(agrees).copied().collect();
    if seen.len() < 2 || seen[0].0 != anchor || seen.last().map(|s| s.0) != Some(newest) {
        return None;
    }
    Some((Landmark::new(point, covariance, newest), seen))
}

/// Midpoint of the two rays' closest approach, and the angle between the rays (rad); `None` behind either camera.
pub fn triangulate(
    first: &Se3<Camera, World>,
    n1: &Vector2<f64>,
    second: &Se3<Camera, World>,
    n2: &Vector2<f64>,
) -> Option<(Vector3<f64>, f64)> {
    let (w1, w2) = (first.inverse(), second.inverse());
    let d1 = (w1.rotation * Vector3::new(n1.x, n1.y, 1.0)).normalize();
    let d2 = (w2.rotation * Vector3::new(n2.x, n2.y, 1.0)).normalize();
    let base = w2.translation - w1.translation;
    let cosine = d1.dot(&d2);
    let sine2 = 1.0 - cosine * cosine;
    if sine2 < 1e-10 {
        return None;
    }
    let (b1, b2) = (base.dot(&d1), base.dot(&d2));
    let s1 = (b1 - cosine * b2) / sine2;
    let s2 = (cosine * b1 - b2) / sine2;
    if s1 <= 0.0 || s2 <= 0.0 {
        return None;
    }
    let point = 0.5 * (w1.translation + d1 * s1 + w2.translation + d2 * s2);
    Some((point, sine2.sqrt().atan2(cosine)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::UnitQuaternion;

    #[test]
    fn rays_meet_where_the_point_is_and_say_at_what_angle() {
        let first = Se3::identity();
        let second: Se3<Camera, World> =
            Se3::new(UnitQuaternion::from_scaled_axis(Vector3::new(0.02, -0.1, 0.05)), Vector3::new(-0.5, 0.1, 0.05));
        let point = Vector3::new(0.3, -0.2, 4.0);
        let see = |pose: &Se3<Camera, World>| {
            let p = pose.transform(&point);
            Vector2::new(p.x / p.z, p.y / p.z)
        };
        let (found, angle) = triangulate(&first, &see(&first), &second, &see(&second)).unwrap();
        assert!((found - point).norm() < 1e-9);
        let centre = second.inverse().translation;
        assert!((angle - point.angle(&(point - centre))).abs() < 1e-9);
    }

    #[test]
    fn parallel_rays_and_points_behind_give_none() {
        let first = Se3::identity();
        let second: Se3<Camera, World> = Se3::new(UnitQuaternion::identity(), Vector3::new(-0.5, 0.0, 0.0));
        let n = Vector2::new(0.1, 0.0);
        assert!(triangulate(&first, &n, &second, &n).is_none());
        // The rays diverge: they would meet behind the cameras.
        assert!(triangulate(&first, &n, &second, &Vector2::new(0.3, 0.0)).is_none());
        assert!(triangulate(&first, &n, &first, &n).is_none());
    }

    #[test]
    fn a_keyframe_is_wanted_when_landmarks_run_out_or_the_view_has_changed() {
        let config = ReconstructionConfig::default();
        let plenty = KeyframeInputs { landmarks: 150, reference_landmarks: 160, ..Default::default() };
        assert!(!wants_keyframe(&plenty, &config));
        assert!(wants_keyframe(&KeyframeInputs { landmarks: 80, ..plenty }, &config));
        assert!(wants_keyframe(&KeyframeInputs { parallax_deg: 10.0, ..plenty }, &config));
        let fewer = KeyframeInputs { reference_landmarks: 120, landmarks: 110, ..plenty };
        assert!(!wants_keyframe(&fewer, &config));
        assert!(wants_keyframe(&KeyframeInputs { turn_rad: 0.2, ..fewer }, &config), "a quick turn");
    }
}
