//! Which keyframes keep their whole pictures.

use super::YOUNG_KEYFRAMES;
use super::epipolar::{MIN_SHARED, NEIGHBOURS};
use crate::map::{KeyframeId, Map};

/// Whole pictures of keyframes: those of [`reduce_pictures`], and the newest's while the oldest of them is not yet reduced.
pub const WHOLE_PICTURES: usize = YOUNG_KEYFRAMES as usize + NEIGHBOURS + 1;

/// Reduces the pictures of all keyframes but the newest ones and those that the newest shares most with: of these alone free corners and
/// seeds are looked for anew, so that at most `YOUNG_KEYFRAMES` and [`NEIGHBOURS`] are whole.
pub fn reduce_pictures(map: &mut Map, newest: KeyframeId) {
    let mut around = Vec::new();
    map.covisible(newest, MIN_SHARED, NEIGHBOURS, &mut around);
    let ids = map.keyframes.iter().map(|(id, _)| KeyframeId(id));
    let old =
        ids.filter(|id| id.0 + YOUNG_KEYFRAMES <= newest.0 && around.iter().all(|a| a.0 != *id)).collect::<Vec<_>>();
    for id in old {
        map.reduce_picture(id);
    }
}
