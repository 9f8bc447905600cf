//! Which keyframes keep their whole pictures, and which keep much of them.

use super::YOUNG_KEYFRAMES;
use super::epipolar::{MIN_SHARED, NEIGHBOURS};
use crate::map::view::Description;
use crate::map::{Keyframe, KeyframeId, LandmarkId, Map};

/// Whole pictures of keyframes: those of [`reduce_pictures`], and the newest's while the oldest of them is not yet reduced.
pub const WHOLE_PICTURES: usize = YOUNG_KEYFRAMES as usize + NEIGHBOURS + 1;
/// Pictures condensed at a keyframe, at the most: one is made, and of a map that was joined or loaded there may be many. A few milliseconds each.
const CONDENSED_AT_ONCE: usize = 2;

/// Reduces the pictures of all keyframes but the newest ones and those that the newest shares most with: of these alone free corners and
/// seeds are looked for anew, so that at most `YOUNG_KEYFRAMES` and [`NEIGHBOURS`] are whole.
pub fn reduce_pictures(map: &mut Map, newest: KeyframeId) {
    let mut around = Vec::new();
    map.covisible(newest, MIN_SHARED, NEIGHBOURS, &mut around);
    let is_old = |id: &KeyframeId| id.0 + YOUNG_KEYFRAMES <= newest.0 && around.iter().all(|a| a.0 != *id);
    let old: Vec<KeyframeId> = map.detailed().filter(is_old).collect();
    for id in old {
        map.reduce_picture(id);
    }
}

/// Condenses the oldest pictures beyond `most`, but none of the newest keyframes' nor of those that share a landmark with the newest. How many
/// landmarks that cost.
pub fn condense_pictures(
    map: &mut Map,
    newest: KeyframeId,
    most: usize,
    mut describe: impl FnMut(&Keyframe, &[LandmarkId]) -> Description,
) -> u64 {
    let over = map.detailed().len().saturating_sub(most).min(CONDENSED_AT_ONCE);
    if over == 0 {
        return 0;
    }
    let near = map.keyframe(newest).map(|k| k.covisible.iter().map(|c| c.0).collect::<Vec<_>>()).unwrap_or_default();
    let is_far = |id: &KeyframeId| id.0 + YOUNG_KEYFRAMES <= newest.0 && near.binary_search(id).is_err();
    let old: Vec<KeyframeId> = map.detailed().filter(is_far).take(over).collect();
    old.into_iter().map(|id| map.condense_picture(id, &mut describe) as u64).sum()
}
