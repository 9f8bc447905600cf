//! Which keyframes keep their whole pictures, and which keep much of them.

use super::YOUNG_KEYFRAMES;
use super::epipolar::{MIN_SHARED, NEIGHBOURS};
use crate::geometry::CameraModel;
use crate::map::view::Description;
use crate::map::{Keyframe, KeyframeId, LandmarkId, Map};

/// Whole pictures of keyframes: those of [`reduce_pictures`], and the newest's while the oldest of them is not yet reduced.
pub const WHOLE_PICTURES: usize = YOUNG_KEYFRAMES as usize + NEIGHBOURS + 1;
/// Pictures condensed at a keyframe, at the most: one is made, and of a map that was joined or loaded there may be many. A few milliseconds each.
const CONDENSED_AT_ONCE: usize = 2;

/// The keyframes that share most with the newest; of these alone, and of the young ones, free corners and seeds are looked for anew.
pub(super) fn nearest(map: &Map, newest: KeyframeId) -> Vec<KeyframeId> {
    let mut around = Vec::new();
    map.covisible(newest, MIN_SHARED, NEIGHBOURS, &mut around);
    around.into_iter().map(|a| a.0).collect()
}

/// Neither young nor one of the `nearest`.
pub(super) fn is_old(map: &Map, id: KeyframeId, newest: KeyframeId, nearest: &[KeyframeId]) -> bool {
    map.numbers.since(id, newest) >= YOUNG_KEYFRAMES && !nearest.contains(&id)
}

/// Reduces the pictures of all keyframes but the newest ones and those that the newest shares most with, so that at most `YOUNG_KEYFRAMES` and
/// [`NEIGHBOURS`] are whole.
pub fn reduce_pictures(map: &mut Map, newest: KeyframeId) {
    let nearest = nearest(map, newest);
    let old: Vec<KeyframeId> = map.detailed().filter(|id| is_old(map, *id, newest, &nearest)).collect();
    for id in old {
        map.reduce_picture(id);
    }
}

/// Condenses pictures beyond `most`, those first that share the fewest landmarks with the newest keyframe (ties: the oldest), but none that
/// [`reduce_pictures`] leaves whole. Which these are, and how many landmarks it cost.
pub fn condense_pictures(
    map: &mut Map,
    newest: KeyframeId,
    (most, camera): (usize, &CameraModel),
    mut describe: impl FnMut(&Keyframe, &[LandmarkId]) -> Description,
) -> (Vec<KeyframeId>, u64) {
    let over = map.detailed().len().saturating_sub(most).min(CONDENSED_AT_ONCE);
    if over == 0 {
        return (Vec::new(), 0);
    }
    let nearest = nearest(map, newest);
    let covisible = map.keyframe(newest).map(|k| k.covisible.as_slice()).unwrap_or_default();
    let shared = |id: KeyframeId| covisible.binary_search_by_key(&id, |c| c.0).map_or(0, |i| covisible[i].1);
    let old = map.detailed().filter(|id| is_old(map, *id, newest, &nearest));
    let mut ranked: Vec<(u32, KeyframeId)> = old.map(|id| (shared(id), id)).collect();
    ranked.sort_unstable();
    let condensed: Vec<KeyframeId> = ranked.into_iter().take(over).map(|(_, id)| id).collect();
    let gone = condensed.iter().map(|id| map.condense_picture(*id, camera, &mut describe) as u64).sum();
    (condensed, gone)
}
