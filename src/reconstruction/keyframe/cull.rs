//! What a map loses at a keyframe: landmarks that did not prove themselves, keyframes that say what others say, and where it is too large those
//! that are needed least.
//!
//! Cost: what was touched since the last keyframe, what the newest shares landmarks with, and a few keyframes here and there: it
//! does not grow with the map.

use super::YOUNG_KEYFRAMES;
use crate::geometry::Se3;
use crate::geometry::frames::Keyframe as KeyframeFrame;
use crate::map::picture::Detail;
use crate::map::{KeyframeId, Landmark, LandmarkId, Map, MapId, Observation};
use crate::reconstruction::config::ReconstructionConfig;
use crate::reconstruction::types::TrajectoryEvent;

/// Of a map that is too large, as one that was joined may be, so many keyframes go with each new one: what it was joined by is needed yet.
const MOST_AT_ONCE: usize = 2;
/// Keyframes that are looked at for one to go. Half a millisecond.
const LOOKED_AT: usize = 48;

/// Landmarks that were made lately and did not prove themselves, and those that disagree all the time, go.
pub fn cull_landmarks(map: &mut Map, newest: KeyframeId) -> u64 {
    let age = |l: &Landmark| newest.0.saturating_sub(l.created_by.0);
    // What nothing has touched since was judged before, but for its age.
    let touched = map.take_touched_landmarks(|l| age(l) < 6);
    let is_doomed = |l: &Landmark| {
        let rarely_found = l.sought >= 10 && 4 * l.found < l.sought;
        let not_confirmed = (3..6).contains(&age(l)) && l.observers.len() < 3 && 2 * l.found < l.sought;
        rarely_found || not_confirmed || l.disagreed >= 8
    };
    let doomed: Vec<LandmarkId> = touched.into_iter().filter(|id| map.landmark(*id).is_some_and(is_doomed)).collect();
    for &id in &doomed {
        map.remove_landmark(id);
    }
    doomed.len() as u64
}

/// Removes keyframes around `newest` whose landmarks are nearly all seen by three others.
pub fn cull_keyframes(
    (map, map_id): (&mut Map, MapId),
    newest: KeyframeId,
    config: &ReconstructionConfig,
    events: &mut Vec<TrajectoryEvent>,
) -> u64 {
    let mut culled = 0;
    let mut around = Vec::new();
    map.covisible(newest, 1, usize::MAX, &mut around);
    for (id, _) in around {
        if id.0 + YOUNG_KEYFRAMES > newest.0 {
            continue;
        }
        let is_redundant = |(redundant, total): (f64, f64)| redundant > config.redundant_share * total;
        if redundant_of(map, id).is_some_and(is_redundant)
            && redundant_with_views(map, id).is_some_and(is_redundant)
            && remove((map, map_id), id, events)
        {
            culled += 1;
        }
    }
    culled
}

/// How many of a keyframe's landmarks three others see at the least, and how many there are; `None` where it has none.
fn redundant_of(map: &Map, id: KeyframeId) -> Option<(f64, f64)> {
    let observations = &map.keyframe(id)?.observations;
    let seen_enough = |o: &&Observation| map.landmark(o.landmark).is_some_and(|l| l.observers.len() >= 4);
    let redundant = observations.iter().filter(seen_enough).count();
    (!observations.is_empty()).then_some((redundant as f64, observations.len() as f64))
}

/// The same where what a condensed keyframe alone shows is needed: with it the landmark could not be found again, however many see it.
fn redundant_with_views(map: &Map, id: KeyframeId) -> Option<(f64, f64)> {
    let (redundant, total) = redundant_of(map, id)?;
    let is_condensed = map.keyframe(id)?.picture.is_condensed();
    Some((if is_condensed { redundant - only_shown(map, id) } else { redundant }, total))
}

/// Where a map holds more than `max_keyframes`, removes of a few keyframes, one here and one there all over the map and others each time (`turn`
/// counts), those that are needed least; none that is young or shares a landmark with `newest`. So a large map is thinned where it is densest, and
/// never where the robot is.
pub fn thin_out(
    (map, map_id): (&mut Map, MapId),
    newest: KeyframeId,
    max_keyframes: usize,
    turn: &mut u32,
    events: &mut Vec<TrajectoryEvent>,
) -> u64 {
    let over = map.keyframes.len().saturating_sub(max_keyframes).min(MOST_AT_ONCE);
    if over == 0 {
        return 0;
    }
    let near: Vec<KeyframeId> =
        map.keyframe(newest).into_iter().flat_map(|k| k.covisible.iter().map(|c| c.0)).collect();
    let is_far = |id: &KeyframeId| id.0 + YOUNG_KEYFRAMES <= newest.0 && near.binary_search(id).is_err();
    let apart = map.keyframes.len().div_ceil(LOOKED_AT).max(1);
    let looked: Vec<KeyframeId> =
        map.keyframes.ids().skip(*turn as usize % apart).step_by(apart).map(KeyframeId).collect();
    *turn = turn.wrapping_add(1);
    let needed = |id: KeyframeId| {
        let (redundant, total) = redundant_with_views(map, id)?;
        Some(((total - redundant) / total, id))
    };
    let mut ranked: Vec<(f64, KeyframeId)> = looked.into_iter().filter(is_far).filter_map(needed).collect();
    ranked.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let mut gone = 0;
    for (_, id) in ranked {
        if gone < over && remove((map, map_id), id, events) {
            gone += 1;
        }
    }
    gone as u64
}

/// How many of a keyframe's landmarks no other one shows, so that nothing could find them again.
fn only_shown(map: &Map, id: KeyframeId) -> f64 {
    let Some(keyframe) = map.keyframe(id) else { return 0.0 };
    let shows = |k: &KeyframeId, landmark: LandmarkId| {
        map.keyframe(*k).is_some_and(|k| k.picture.detail(landmark.0) > Detail::None)
    };
    let only = |o: &&Observation| {
        let others = map.landmark(o.landmark).into_iter().flat_map(|l| &l.observers).filter(|k| **k != id);
        shows(&id, o.landmark) && !others.into_iter().any(|k| shows(k, o.landmark))
    };
    keyframe.observations.iter().filter(only).count() as f64
}

/// Removes a keyframe and hangs the trajectory that refers to it on its most covisible neighbour.
fn remove((map, map_id): (&mut Map, MapId), id: KeyframeId, events: &mut Vec<TrajectoryEvent>) -> bool {
    let mut strongest = Vec::new();
    map.covisible(id, 1, 1, &mut strongest);
    let Some(&(parent, _)) = strongest.first() else { return false };
    let (Some(k), Some(p)) = (map.keyframe(id), map.keyframe(parent)) else { return false };
    let parent_from_keyframe: Se3<KeyframeFrame, KeyframeFrame> =
        (p.camera_from_world * k.camera_from_world.inverse()).relabel();
    events.push(TrajectoryEvent::KeyframeRemoved { map: map_id, keyframe: id, parent, parent_from_keyframe });
    map.remove_keyframe(id).is_some()
}
