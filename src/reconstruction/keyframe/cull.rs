//! What a map loses at a keyframe: landmarks that are rarely found, keyframes that say what others say, and where it is too large those
//! that are needed least.
//!
//! Cost: what was touched since the last keyframe, what the newest shares landmarks with, and a few keyframes here and there: it
//! does not grow with the map.

use super::YOUNG_KEYFRAMES;
use super::pictures::{is_old, nearest};
use super::superseded;
use crate::geometry::frames::Keyframe as KeyframeFrame;
use crate::geometry::{CameraModel, Se3};
use crate::map::picture::Detail;
use crate::map::{KeyframeId, Landmark, LandmarkId, Map, MapId};
use crate::reconstruction::config::ReconstructionConfig;
use crate::reconstruction::types::TrajectoryEvent;

/// Of a map that is too large, as one that was joined may be, so many keyframes go with each new one: what it was joined by is needed yet.
const MOST_AT_ONCE: usize = 2;
/// Keyframes that are compared with newer ones of the same place, at a keyframe: all in turn. 0.2 ms each.
const COMPARED: usize = 8;
/// Keyframes that are looked at for one to go. Half a millisecond.
const LOOKED_AT: usize = 48;

/// Landmarks that are rarely found, or disagree, where they are looked for go. What was not looked for since the last keyframe was judged before.
pub fn cull_landmarks(map: &mut Map) -> u64 {
    let touched = map.take_touched_landmarks();
    let is_doomed = |l: &Landmark| l.sought >= 10 && 4 * l.found < l.sought;
    let doomed: Vec<LandmarkId> = touched.into_iter().filter(|id| map.landmark(*id).is_some_and(is_doomed)).collect();
    for &id in &doomed {
        map.remove_landmark(id);
    }
    doomed.len() as u64
}

/// Removes keyframes around `newest` whose landmarks are nearly all seen by three others, and one at the most of those that what newer ones of the same
/// place see makes up for; none that something else rests on (`held`, ascending).
pub fn cull_keyframes(
    (map, map_id): (&mut Map, MapId),
    newest: KeyframeId,
    (camera, held): (&CameraModel, &[KeyframeId]),
    config: &ReconstructionConfig,
    events: &mut Vec<TrajectoryEvent>,
) -> u64 {
    let is_redundant = |(redundant, total): (f64, f64)| redundant > config.redundant_share * total;
    let mut around = Vec::new();
    map.covisible(newest, 1, usize::MAX, &mut around);
    around.retain(|(id, _)| map.numbers.since(*id, newest) >= YOUNG_KEYFRAMES && held.binary_search(id).is_err());
    let all = around.len();
    around.retain(|(id, _)| {
        let is_spared = seen_enough(map, *id).is_some_and(is_redundant) && spared(map, *id).is_some_and(is_redundant);
        !(is_spared && remove((map, map_id), *id, events))
    });
    let mut culled = all - around.len();
    // Some of them at each keyframe, others at the next.
    let apart = around.len().div_ceil(COMPARED).max(1);
    let mut compared = around.iter().skip(newest.0 as usize % apart).step_by(apart).map(|a| a.0);
    let superseded = compared.find(|id| spared_or_made_up_for(map, camera, *id, newest).is_some_and(is_redundant));
    culled += usize::from(superseded.is_some_and(|id| remove((map, map_id), id, events)));
    culled as u64
}

fn is_seen_enough(landmark: &Landmark) -> bool {
    landmark.observers.len() >= 4
}

/// How many of a keyframe's landmarks three others see at the least, and how many there are; `None` where it has none.
fn seen_enough(map: &Map, id: KeyframeId) -> Option<(f64, f64)> {
    let observations = &map.keyframe(id)?.observations;
    let enough = observations.landmarks().filter(|l| map.landmark(*l).is_some_and(is_seen_enough)).count();
    (!observations.is_empty()).then_some((enough as f64, observations.len() as f64))
}

/// The same of those that another one shows as well: the others could not be found again, however many see them. Where nothing is condensed these are
/// none.
fn spared(map: &Map, id: KeyframeId) -> Option<(f64, f64)> {
    let total = map.keyframe(id)?.observations.len();
    (total > 0).then(|| ((total - needed(map, id).len()) as f64, total as f64))
}

/// The same with those that newer keyframes make up for.
fn spared_or_made_up_for(map: &Map, camera: &CameraModel, id: KeyframeId, newest: KeyframeId) -> Option<(f64, f64)> {
    let (needed, total) = (needed(map, id), map.keyframe(id)?.observations.len());
    let made_up = superseded::made_up_for(map, camera, id, newest, &needed);
    (total > 0).then(|| ((total - needed.len() + made_up) as f64, total as f64))
}

/// Landmarks of a keyframe that three others do not see, or none of them shows; ascending.
fn needed(map: &Map, id: KeyframeId) -> Vec<LandmarkId> {
    let is_spared = |seen: LandmarkId| {
        let shows = |k: &KeyframeId| map.keyframe(*k).is_some_and(|k| k.picture.detail(seen.0) > Detail::None);
        let landmark = map.landmark(seen).filter(|l| is_seen_enough(l));
        landmark.is_some_and(|l| l.observers.iter().any(|k| *k != id && shows(k)))
    };
    let seen = map.keyframe(id).map(|k| k.observations.landmarks());
    seen.into_iter().flatten().filter(|l| !is_spared(*l)).collect()
}

/// Where a map holds more than `max_keyframes`, removes of a few keyframes, one here and one there all over the map and others each time (`turn`
/// counts), those that are needed least; none that is young or among those that share most with `newest`, and those that something else rests on
/// (`held`, ascending) only where there are no others. So a map is thinned where it is densest: a building evenly, and where all of it is one room there.
pub fn thin_out(
    (map, map_id): (&mut Map, MapId),
    newest: KeyframeId,
    (max_keyframes, held): (usize, &[KeyframeId]),
    turn: &mut u32,
    events: &mut Vec<TrajectoryEvent>,
) -> u64 {
    let over = map.keyframes.len().saturating_sub(max_keyframes).min(MOST_AT_ONCE);
    if over == 0 {
        return 0;
    }
    let near = nearest(map, newest);
    let apart = map.keyframes.len().div_ceil(LOOKED_AT).max(1);
    let looked = map.keyframes.ids().skip(*turn as usize % apart).step_by(apart).map(KeyframeId);
    *turn = turn.wrapping_add(1);
    let mut ranked: Vec<(bool, f64, KeyframeId)> = looked
        .filter(|id| is_old(map, *id, newest, &near))
        .map(|id| {
            // One that sees nothing is of no use to anybody.
            let needed = spared(map, id).map_or(0.0, |(spared, total)| (total - spared) / total);
            (held.binary_search(&id).is_ok(), needed, id)
        })
        .collect();
    ranked.sort_unstable_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2)));
    let mut gone = 0;
    for (_, _, id) in ranked {
        if gone < over && remove((map, map_id), id, events) {
            gone += 1;
        }
    }
    gone as u64
}

/// Removes a keyframe and hangs the trajectory that refers to it on its most covisible neighbour; on the one before or after it where it has none.
fn remove((map, map_id): (&mut Map, MapId), id: KeyframeId, events: &mut Vec<TrajectoryEvent>) -> bool {
    let mut strongest = Vec::new();
    map.covisible(id, 1, 1, &mut strongest);
    let beside = || map.keyframes.last_before(id.0).or_else(|| map.keyframes.ids_from(id.0.saturating_add(1)).next());
    let Some(parent) = strongest.first().map(|s| s.0).or_else(|| beside().map(KeyframeId)) else { return false };
    let (Some(k), Some(p)) = (map.keyframe(id), map.keyframe(parent)) else { return false };
    let parent_from_keyframe: Se3<KeyframeFrame, KeyframeFrame> =
        (p.camera_from_world * k.camera_from_world.inverse()).relabel();
    events.push(TrajectoryEvent::KeyframeRemoved { map: map_id, keyframe: id, parent, parent_from_keyframe });
    map.remove_keyframe(id).is_some()
}

#[cfg(test)]
mod tests {
    use crate::map::examples;
    use std::sync::Arc;

    use nalgebra::{Matrix2, Vector2, Vector3};

    use super::*;
    use crate::geometry::random::Random;
    use crate::image::{GreyImage, Pyramid};
    use crate::map::view::{DESCRIBED_LEVELS, Description};
    use crate::map::{Keyframe, Observation};

    #[test]
    fn a_keyframe_is_spared_for_the_landmarks_that_others_see_and_show() {
        let mut random = Random::new(11);
        let mut image = GreyImage::new(320, 240);
        image.data.iter_mut().for_each(|v| *v = random.below(256) as u8);
        let mut pyramid = Pyramid::new(5);
        pyramid.build(&image);
        let pyramid = Arc::new(pyramid);
        let mut map = Map::default();
        let ids = [0; 7].map(|_| map.add_keyframe(examples::keyframe(pyramid.clone(), Se3::identity())));
        let [own, a, b, c, whole @ ..] = ids;
        let seen_by = |(others, count): (&[KeyframeId], usize)| vec![others.to_vec(); count];
        // Three condensed ones have better to show than what they share with the own one; the last 100 it does not see.
        let [wa, wb, wc] = whole;
        let seen = [
            (&[own, wa, wb, wc][..], 8),
            (&[own, a, b, c][..], 8),
            (&[own, a][..], 12),
            (&[a, b, c, wa, wb, wc][..], 100),
        ];
        for observers in seen.into_iter().flat_map(seen_by) {
            let observation = Observation {
                landmark: LandmarkId(0),
                pixel: Vector2::new(random.uniform(20.0, 300.0) as f32, random.uniform(20.0, 220.0) as f32),
                normalised: Vector2::zeros(),
                displacement: Vector2::zeros(),
                inv_sigma_px: 1.0,
                normalised_from_pixel: Matrix2::identity(),
            };
            let landmark = examples::landmark(Vector3::z(), own);
            map.add_landmark(landmark, &observers.into_iter().map(|k| (k, observation)).collect::<Vec<_>>());
        }
        assert_eq!(seen_enough(&map, own), Some((16.0, 28.0)));
        assert_eq!(spared(&map, own), Some((16.0, 28.0)), "all are shown by others yet");
        for id in [a, b, c] {
            let nothing = |_: &Keyframe, l: &[LandmarkId]| Description {
                landmarks: vec![[None; DESCRIBED_LEVELS]; l.len()],
                place: Vec::new(),
            };
            assert_eq!(map.condense_picture(id, &examples::lens(), nothing), 0);
        }
        // Of what four keyframes see it alone shows eight; what only two see counts neither way.
        assert_eq!(seen_enough(&map, own), Some((16.0, 28.0)));
        assert_eq!(spared(&map, own), Some((8.0, 28.0)));
        assert_eq!(map.landmarks.len(), 128);
        // With it all goes that nothing shows any more.
        map.remove_keyframe(own);
        assert_eq!(map.landmarks.len(), 108);
        map.check_consistency().expect("consistent");
    }

    #[test]
    fn what_something_rests_on_is_never_redundant() {
        let camera = CameraModel::new(320, 240, 300.0, 300.0, 159.5, 119.5, [0.0; 5]).expect("a camera");
        let stays = |is_held: bool| {
            let mut map = Map::default();
            let mut pyramid = Pyramid::new(5);
            pyramid.build(&GreyImage::new(320, 240));
            let pyramid = Arc::new(pyramid);
            // All see the same, so that the old ones say nothing of their own.
            let all: Vec<KeyframeId> = (0..YOUNG_KEYFRAMES + 4)
                .map(|_| map.add_keyframe(examples::keyframe(pyramid.clone(), Se3::identity())))
                .collect();
            for i in 0..20 {
                let observation = Observation {
                    landmark: LandmarkId(0),
                    pixel: Vector2::new(20.0 + 10.0 * i as f32, 120.0),
                    normalised: Vector2::zeros(),
                    displacement: Vector2::zeros(),
                    inv_sigma_px: 1.0,
                    normalised_from_pixel: Matrix2::identity(),
                };
                let seen: Vec<_> = all.iter().map(|id| (*id, observation)).collect();
                map.add_landmark(examples::landmark(Vector3::z(), all[0]), &seen);
            }
            let (newest, held) = (all[all.len() - 1], if is_held { vec![all[1]] } else { vec![] });
            let (config, mut events) = (ReconstructionConfig::default(), Vec::new());
            let gone = cull_keyframes((&mut map, MapId(0)), newest, (&camera, &held), &config, &mut events);
            assert_eq!(gone, if is_held { 3 } else { 4 });
            map.keyframe(all[1]).is_some()
        };
        assert!(stays(true) && !stays(false));
    }
}
