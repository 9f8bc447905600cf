//! What a keyframe shows that newer ones of the same place show as well, by other landmarks.
//!
//! Where robots live furniture is moved, and lamps come on. What then stands at a place makes landmarks of its own, and the old ones are found no more;
//! yet nothing says of one of them that it is gone: it may be hidden, or others nearby were looked for instead. But a keyframe of another time need not
//! stay for them where as much was seen there since.
//!
//! Input: the map, a keyframe, which of its landmarks are needed so far. Output: how many of them newer keyframes make up for, part of the picture by
//! part. Cost: 0.2 ms. It deliberately does not do: removing anything (see [`cull`](super::cull)).

use nalgebra::Vector3;

use super::YOUNG_KEYFRAMES;
use super::epipolar::{MIN_SHARED, median_distance};
use crate::geometry::CameraModel;
use crate::map::{KeyframeId, Landmark, LandmarkId, Map};

/// Another time: so many keyframes of this run later at the least, and so many seconds (clocks of different boots differ by anything).
const LATER_KEYFRAMES: u32 = 30;
const LATER_S: f64 = 60.0;
/// The same place: no farther away than this share of the distance at which the keyframe sees its landmarks, in the median.
const NEAR_SHARE: f64 = 0.3;
/// Keyframes that are asked, those that share most; so many of them see a landmark that makes up for one.
const ASKED: usize = 12;
const LEAST_OBSERVERS: usize = 2;
/// From there a landmark looks as from here: the lines of sight are at most 15 degrees apart, and the distances as different.
const ALIKE_COSINE: f64 = 0.966;
const ALIKE_DISTANCE: f64 = 1.5;

/// How many of the landmarks of a keyframe that are `needed` (ascending) others make up for that were seen from there at another time since. `newest`:
/// the map's newest keyframe.
pub fn made_up_for(
    map: &Map,
    camera: &CameraModel,
    id: KeyframeId,
    newest: KeyframeId,
    needed: &[LandmarkId],
) -> usize {
    let Some((keyframe, distance)) = map.keyframe(id).and_then(|k| Some((k, median_distance(map, k)?))) else {
        return 0;
    };
    let centre = keyframe.centre();
    let mut around = Vec::new();
    map.covisible(id, MIN_SHARED, usize::MAX, &mut around);
    let asked = around.iter().filter(|a| is_later(map, id, a.0, newest)).filter_map(|a| map.keyframe(a.0));
    let same_unit = asked.filter(|k| k.scale_from == keyframe.scale_from).map(|k| (k, k.centre()));
    let near = same_unit.filter(|(_, there)| (there - centre).norm() <= NEAR_SHARE * distance).take(ASKED);
    let mut seen: Vec<LandmarkId> = Vec::new();
    for (other, there) in near {
        let makes_up = |l: &Landmark| is_proven(l) && looks_alike(&l.position, &centre, &there);
        let not_own = other.observations.landmarks().filter(|l| !keyframe.observations.contains(*l));
        seen.extend(not_own.filter(|l| map.landmark(*l).is_some_and(makes_up)));
    }
    seen.sort_unstable();
    let (mut others, mut own) = ([0usize; CameraModel::PARTS], [0usize; CameraModel::PARTS]);
    for same in seen.chunk_by(|a, b| a == b).filter(|same| same.len() >= LEAST_OBSERVERS) {
        let position = map.landmark(same[0]).map(|l| keyframe.camera_from_world.transform(&l.position));
        let pixel = position.and_then(|p| camera.project(&p)).filter(|p| camera.contains(p, 0.0));
        pixel.into_iter().for_each(|pixel| others[camera.part_of(&pixel)] += 1);
    }
    for (_, pixel) in keyframe.observations.pixels().filter(|(l, _)| needed.binary_search(l).is_ok()) {
        own[camera.part_of(&pixel.cast())] += 1;
    }
    own.iter().zip(others).map(|(own, others)| (*own).min(others)).sum()
}

/// `other` shows the same place at another time since, and was not made just now: what it sees was adjusted.
fn is_later(map: &Map, id: KeyframeId, other: KeyframeId, newest: KeyframeId) -> bool {
    let Some((k, o)) = map.keyframe(id).zip(map.keyframe(other)) else { return false };
    let apart_s = 1e-9 * k.timestamp_ns.abs_diff(o.timestamp_ns) as f64;
    let in_order = !map.numbers.is_new(id) || other > id && map.numbers.since(id, other) >= LATER_KEYFRAMES;
    map.numbers.is_new(other) && in_order && apart_s >= LATER_S && map.numbers.since(other, newest) >= YOUNG_KEYFRAMES
}

/// Its place rests on what was seen alone, and it was found in most of the frames that looked for it.
fn is_proven(landmark: &Landmark) -> bool {
    landmark.assumed.is_none() && 2 * landmark.found >= landmark.sought
}

fn looks_alike(position: &Vector3<f64>, from: &Vector3<f64>, other: &Vector3<f64>) -> bool {
    let (here, there) = (position - from, position - other);
    let (near, far) = (here.norm().min(there.norm()), here.norm().max(there.norm()));
    here.dot(&there) >= ALIKE_COSINE * near * far && far <= ALIKE_DISTANCE * near
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix2, UnitQuaternion, Vector2};

    use std::sync::Arc;

    use super::super::cull::cull_keyframes;
    use super::*;
    use crate::geometry::Se3;
    use crate::geometry::random::Random;
    use crate::map::{Keyframe, MapId, Observation, examples};
    use crate::reconstruction::config::ReconstructionConfig;

    /// An old keyframe that sees 100 landmarks alone, and newer ones that are `moved` and see so many others in its picture, all over or left of its middle;
    /// 20 all of them see.
    fn place(moved: Vector3<f64>, newer: usize, after_s: i64, others: usize, is_left: bool) -> Place {
        let (lens, mut random, mut map) = (examples::lens(), Random::new(3), Map::default());
        let keyframe = |map: &mut Map, at: Vector3<f64>, s: i64| {
            let camera_from_world = Se3::new(UnitQuaternion::identity(), -at);
            let picture = Arc::new(crate::image::Pyramid::new(1));
            let blank = examples::keyframe(picture, camera_from_world);
            map.add_keyframe(Keyframe { timestamp_ns: s * 1_000_000_000, ..blank })
        };
        let old = keyframe(&mut map, Vector3::zeros(), 0);
        // Elsewhere, meanwhile.
        (0..LATER_KEYFRAMES).for_each(|_| _ = keyframe(&mut map, Vector3::x() * 100.0, 0));
        let newer: Vec<KeyframeId> = (0..newer).map(|_| keyframe(&mut map, moved, after_s)).collect();
        let mut see = |map: &mut Map, observers: &[KeyframeId], width: f64| {
            let (pixel, depth) = (Vector2::new(random.uniform(1.0, width), random.uniform(1.0, 478.0)), 3.0);
            let position = lens.undistort(&pixel).expect("in the picture").push(1.0) * depth;
            let seen = |k: &KeyframeId| {
                let pixel = lens.project(&(position - map.keyframe(*k)?.centre()))?;
                let observation = Observation {
                    landmark: LandmarkId(0),
                    pixel: pixel.cast(),
                    normalised: Vector2::zeros(),
                    displacement: Vector2::zeros(),
                    inv_sigma_px: 1.0,
                    normalised_from_pixel: Matrix2::identity(),
                };
                Some((*k, observation))
            };
            let seen: Vec<_> = observers.iter().filter_map(seen).collect();
            map.add_landmark(examples::landmark(position, observers[0]), &seen)
        };
        let own: Vec<LandmarkId> = (0..100).map(|_| see(&mut map, &[old], 638.0)).collect();
        (0..others).for_each(|_| _ = see(&mut map, &newer, if is_left { 319.0 } else { 638.0 }));
        // What all see is how they know that it is the same place.
        let young = (0..YOUNG_KEYFRAMES).map(|_| keyframe(&mut map, moved, after_s)).last();
        let newest = young.expect("the newest");
        let all: Vec<KeyframeId> = newer.iter().copied().chain([old, newest]).collect();
        (0..20).for_each(|_| _ = see(&mut map, &all, 638.0));
        Place { map, lens, old, newest, own }
    }

    struct Place {
        map: Map,
        lens: CameraModel,
        old: KeyframeId,
        newest: KeyframeId,
        own: Vec<LandmarkId>,
    }

    fn of_100(moved: Vector3<f64>, newer: usize, after_s: i64, others: usize, is_left: bool) -> usize {
        let Place { map, lens, old, newest, own } = place(moved, newer, after_s, others, is_left);
        made_up_for(&map, &lens, old, newest, &own)
    }

    #[test]
    fn a_keyframe_of_another_time_goes_unless_something_rests_on_it() {
        let config = ReconstructionConfig::default();
        for (held, others, gone) in [(false, 600, true), (true, 600, false), (false, 40, false)] {
            let Place { mut map, lens, old, newest, .. } = place(Vector3::new(0.1, 0.0, 0.0), 3, 100, others, false);
            let (held, mut events) = (if held { vec![old] } else { Vec::new() }, Vec::new());
            let culled = cull_keyframes((&mut map, MapId(0)), newest, (&lens, &held), &config, &mut events);
            assert_eq!((culled, map.keyframe(old).is_none()), (u64::from(gone), gone), "{held:?}, {others}");
            map.check_consistency().expect("consistent");
        }
    }

    #[test]
    fn what_another_run_left_supersedes_nothing_and_may_be_superseded() {
        let Place { mut map, lens, old, newest, own } = place(Vector3::zeros(), 3, 100, 300, false);
        let newer = KeyframeId(newest.0 - YOUNG_KEYFRAMES);
        for (loaded_below, enough) in [(0, true), (old.0 + 1, true), (newer.0 - 2, true), (newer.0 + 1, false)] {
            map.numbers.load_below(loaded_below);
            assert_eq!(made_up_for(&map, &lens, old, newest, &own) > 90, enough, "{loaded_below}");
        }
    }

    #[test]
    fn what_was_seen_at_another_time_from_there_makes_up_for_what_was() {
        let here = Vector3::new(0.1, 0.0, 0.0);
        assert_eq!(of_100(here, 3, 100, 0, false), 0);
        assert!((30..=40).contains(&of_100(here, 3, 100, 40, false)));
        assert!(of_100(here, 3, 100, 300, false) > 95);
        let half = of_100(here, 3, 100, 600, true);
        assert!((40..=60).contains(&half), "there alone where others are: {half}");
    }

    #[test]
    fn a_landmark_looks_alike_from_nearby() {
        let (from, position) = (Vector3::zeros(), Vector3::new(0.0, 0.0, 3.0));
        let from_there = |x: f64, z: f64| looks_alike(&position, &from, &Vector3::new(x, 0.0, z));
        assert!(from_there(0.0, 0.0) && from_there(0.7, 0.0) && from_there(0.0, 0.9) && from_there(0.0, -1.4));
        assert!(!from_there(0.9, 0.0), "from another side it looks otherwise");
        assert!(!from_there(0.0, 1.1) && !from_there(0.0, -1.6), "from elsewhere it is too large, or too small");
    }

    #[test]
    fn nothing_makes_up_for_what_nobody_came_back_to_look_at() {
        let here = Vector3::new(0.1, 0.0, 0.0);
        assert_eq!(of_100(here, 3, 50, 300, false), 0, "a minute has not passed");
        assert_eq!(of_100(here, 1, 100, 300, false), 0, "one keyframe is none");
        assert_eq!(of_100(Vector3::x(), 3, 100, 300, false), 0, "it is another place");
    }
}
