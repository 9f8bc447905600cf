//! Which keyframes were made in this run, and how many ago.
//!
//! Keyframes of maps that are merged have numbers above all that the run had given until then, and the run goes on above these. So numbers
//! are in the order of time within one run only, and whoever wants keyframes that were made lately asks here. Where nothing was merged,
//! one keyframe is as many later than another as its number is greater, those that are gone counted.

use std::ops::Range;

use super::{KeyframeId, Map};

/// Numbers that are not this run's; none by default.
#[derive(Debug, Clone, Default)]
pub struct Numbers {
    /// Ascending.
    merged: Vec<Range<u32>>,
    /// What was there when this run loaded the map has numbers below.
    loaded_below: u32,
}

impl Numbers {
    /// It is of a map that was merged.
    pub fn is_merged(&self, id: KeyframeId) -> bool {
        self.merged.iter().any(|range| range.contains(&id.0))
    }

    /// It was made in this run.
    pub fn is_new(&self, id: KeyframeId) -> bool {
        id.0 >= self.loaded_below && !self.is_merged(id)
    }

    /// All that have numbers below are another run's.
    pub fn load_below(&mut self, next: u32) {
        self.loaded_below = next;
    }

    /// How many keyframes of this run before `newest` it was made (0: not before); one of a merged map longer ago than any.
    pub fn since(&self, id: KeyframeId, newest: KeyframeId) -> u32 {
        if self.is_merged(id) {
            return u32::MAX;
        }
        let between = self.merged.iter().filter(|range| id.0 < range.start && range.end <= newest.0);
        newest.0.saturating_sub(id.0) - between.map(|range| range.end - range.start).sum::<u32>()
    }

    /// This run's numbers below `end`, descending, those of keyframes that are gone among them.
    pub fn below(&self, end: u32) -> impl Iterator<Item = u32> {
        let from = |i: usize| i.checked_sub(1).map_or(0, |i| self.merged[i].end);
        let to = move |i: usize| self.merged.get(i).map_or(end, |range| range.start.min(end));
        (0..=self.merged.len()).rev().flat_map(move |i| (from(i)..to(i)).rev())
    }

    /// The same of a map whose numbers went on from this one's, or before it.
    pub(super) fn absorb(&mut self, other: Self) {
        if other.merged.len() > self.merged.len() {
            self.merged = other.merged;
        }
        // Beside a merged map's, which are known as such, too much counts as loaded.
        self.loaded_below = self.loaded_below.max(other.loaded_below);
    }
}

impl Map {
    /// The numbers up to these are those of maps that are to be merged: this run's go on from there.
    pub fn leave_numbers(&mut self, next_keyframe: u32, next_landmark: u32) {
        let next = self.keyframes.next_id();
        if next < next_keyframe {
            self.numbers.merged.push(next..next_keyframe);
        }
        self.skip_ids_to(next_keyframe, next_landmark);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_a_merge_numbers_count_keyframes() {
        let numbers = Numbers::default();
        let since = |id, newest| numbers.since(KeyframeId(id), KeyframeId(newest));
        assert_eq!([since(3, 9), since(9, 9), since(11, 9)], [6, 0, 0]);
        assert!(!numbers.is_merged(KeyframeId(0)));
        assert_eq!(numbers.below(4).collect::<Vec<_>>(), [3, 2, 1, 0]);
        assert_eq!(numbers.below(0).count(), 0);
    }

    #[test]
    fn keyframes_of_merged_maps_are_counted_as_none_of_this_run() {
        let mut map = Map::default();
        map.skip_ids_to(5, 0);
        map.leave_numbers(1000, 70);
        map.leave_numbers(1010, 90);
        map.skip_ids_to(1013, 0);
        map.leave_numbers(2000, 100);
        let numbers = &map.successor().numbers;
        let since = |id, newest| numbers.since(KeyframeId(id), KeyframeId(newest));
        // 4, 1010, 1011, 1012, 2000, one after the other.
        assert_eq!(
            [since(1012, 2000), since(1010, 2000), since(4, 2000), since(4, 1010), since(2, 4)],
            [1, 3, 4, 1, 2]
        );
        assert_eq!([since(5, 2000), since(1009, 1010), since(1999, 2000)], [u32::MAX; 3]);
        assert_eq!(
            [4, 5, 1009, 1010, 1012, 1013, 1999, 2000].map(|id| numbers.is_merged(KeyframeId(id))),
            [false, true, true, false, false, true, true, false]
        );
        assert_eq!(numbers.below(2001).take(6).collect::<Vec<_>>(), [2000, 1012, 1011, 1010, 4, 3]);
        assert_eq!(numbers.below(1011).collect::<Vec<_>>(), [1010, 4, 3, 2, 1, 0]);
        assert_eq!((map.keyframes.next_id(), map.landmarks.next_id()), (2000, 100));
    }

    #[test]
    fn the_newest_keyframe_is_one_of_this_run() {
        let frame = || super::super::examples::keyframe(Default::default(), crate::geometry::Se3::identity());
        let mut map = Map::default();
        let own = map.add_keyframe(frame());
        let mut other = Map::default();
        other.skip_ids_to(10, 0);
        other.add_keyframe(frame());
        map.leave_numbers(other.keyframes.next_id(), 0);
        map.absorb(other);
        assert_eq!((map.newest(), map.keyframes.len()), (Some(own), 2));
        let next = map.add_keyframe(frame());
        assert_eq!((map.newest(), next), (Some(next), KeyframeId(11)));
        assert_eq!(map.numbers.since(own, next), 1);
    }
}
