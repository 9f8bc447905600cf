//! By what two robots see that they are in one map: keyframes that both have, as one has fetched the other's map, or joined it to its own.
//!
//! The time of a keyframe's capture, in ns of its machine's clock since that one's start, is its name; where it is published says how the published map
//! lies on those that others publish. A robot tells of the map's first keyframe, and of the few whose hashed names are the smallest: maps
//! that have much in common have some of these in common, whichever keyframes each of them has dropped since (Broder 1997, "On the resemblance and
//! containment of documents": of `k` told ones, `k |A and B| / |A or B|` in the mean). Told of metric maps alone.

use std::fmt::Write as _;

use crate::messages::{Keyframe, KeyframesHeader, Scale, Transform};

/// Keyframes that are told of, at some 40 bytes each.
pub const MOST_ANCHORS: usize = 12;

/// See module.
#[derive(Debug, Clone, PartialEq)]
pub struct Anchors {
    /// As in the health: of another map they say nothing.
    pub map_id: u32,
    /// The first keyframe first.
    places: Vec<(i64, Transform)>,
}

impl Anchors {
    /// `None`: there are none yet.
    pub fn of(header: &KeyframesHeader, keyframes: &[Keyframe]) -> Option<Self> {
        if keyframes.is_empty() || Scale::from_wire(header.scale) != Scale::Metric {
            return None;
        }
        // The message leaves out the oldest of a map that is too large for it.
        let first = keyframes.first().filter(|_| header.total == header.count);
        let mut sketch: Vec<(u64, &Keyframe)> = keyframes.iter().map(|k| (hash(k.timestamp_ns), k)).collect();
        let most = MOST_ANCHORS.min(sketch.len());
        sketch.select_nth_unstable_by_key(most - 1, |s| s.0);
        sketch.truncate(most);
        sketch.sort_unstable_by_key(|s| s.0);
        let others = sketch.iter().map(|s| s.1).filter(|k| first.is_none_or(|f| f.timestamp_ns != k.timestamp_ns));
        let place = |k: &Keyframe| (k.timestamp_ns, Transform { position: k.position, orientation: k.orientation });
        let places = first.into_iter().chain(others).take(MOST_ANCHORS).map(place).collect();
        Some(Self { map_id: header.map_id, places })
    }

    /// Of each its name and where it is in the published map (x and y, m, and yaw, rad), parted by commas.
    pub fn text(&self) -> String {
        let mut text = String::new();
        for (timestamp_ns, place) in &self.places {
            let [x, y, _] = place.position;
            let comma = if text.is_empty() { "" } else { "," };
            // Writing into a text cannot fail.
            let _ = write!(text, "{comma}{timestamp_ns:x} {x:.3} {y:.3} {:.4}", place.yaw_rad());
        }
        text
    }
}

/// The last steps of splitmix64 (Steele, Lea, Flood 2014): the same on all machines, for ever.
fn hash(timestamp_ns: i64) -> u64 {
    let x = timestamp_ns.cast_unsigned();
    let x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ (x >> 31)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::messages::{SCALE_ESTIMATED, SCALE_METRIC};

    fn keyframes(timestamps: impl Iterator<Item = i64>, x: f64) -> Vec<Keyframe> {
        let Transform { position, orientation } = Transform::level(x, -1.0, 0.5);
        timestamps.map(|timestamp_ns| Keyframe { timestamp_ns, position, orientation, ..Keyframe::default() }).collect()
    }

    fn header(count: usize) -> KeyframesHeader {
        let count = u32::try_from(count).expect("few");
        KeyframesHeader { count, total: count, map_id: 3, scale: SCALE_METRIC, ..KeyframesHeader::default() }
    }

    #[test]
    fn a_map_is_known_by_its_first_keyframe_wherever_that_is_published() {
        let two = keyframes([0x1234, 0x2000].into_iter(), 2.0);
        let anchors = Anchors::of(&header(2), &two).expect("two");
        assert_eq!((anchors.map_id, anchors.text().as_str()), (3, "1234 2.000 -1.000 0.5000,2000 2.000 -1.000 0.5000"));
        // Not metres; nothing there.
        assert_eq!(Anchors::of(&KeyframesHeader { scale: SCALE_ESTIMATED, ..header(2) }, &two), None);
        assert_eq!(Anchors::of(&KeyframesHeader { count: 0, total: 0, ..header(0) }, &[]), None);
        // Which is the first is not known where the oldest are left out.
        let many = keyframes((1..200).map(|i| i * 1_000_000_007), 0.0);
        let names = |header: &KeyframesHeader, of: &[Keyframe]| -> Vec<i64> {
            Anchors::of(header, of).expect("some").places.iter().map(|p| p.0).collect()
        };
        let (whole, cut) = (names(&header(199), &many), names(&KeyframesHeader { total: 300, ..header(199) }, &many));
        assert_eq!((whole.len(), whole[0], cut.len()), (MOST_ANCHORS, 1_000_000_007, MOST_ANCHORS));
        assert!(!cut.contains(&1_000_000_007) && whole[1..] == cut[..MOST_ANCHORS - 1]);
    }

    #[test]
    fn maps_that_have_a_third_in_common_have_anchors_in_common() {
        let mut without = 0;
        for trial in 0..200 {
            // What was fetched, some of it dropped on both sides, and what each has added.
            let at = |robot: i64, i: i64| trial * 1_000_000_000_000 + robot * 7_777_777_777 + i * 333_333_333;
            let own = |robot: i64| {
                let shared = (0..100).filter(move |i| (i + robot) % 5 > 0).map(move |i| at(0, i));
                keyframes(shared.chain((100..140).map(move |i| at(robot, i))), 0.0)
            };
            let names = |robot| -> BTreeSet<i64> {
                let keyframes = own(robot);
                let cut = KeyframesHeader { total: 1000, ..header(keyframes.len()) };
                Anchors::of(&cut, &keyframes).expect("some").places.iter().map(|p| p.0).collect()
            };
            without += usize::from(names(1).is_disjoint(&names(2)));
        }
        // 60 of 180 are in both: (2/3)^12 of the pairs have none in common, one or two.
        assert!(without <= 6, "{without} of 200");
    }
}
