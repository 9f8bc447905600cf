//! How far it is from one keyframe to another along what holds a map together.
//!
//! What a map can have drifted by between two of its places is a matter of the way between them, not of all that was driven meanwhile:
//! laps that are tied to each other drift no further. The way here is the shortest one over the links of the map: keyframes that share
//! landmarks, that follow one another in one map, or that ended a loop which was closed. Where none leads there, maps that were joined are
//! taken to follow one another, too.
//!
//! Input: the map, pairs of keyframes that closed loops. Output: a length, map units. Dijkstra's algorithm; cost: a millisecond for each 1,000
//! keyframes that are nearer than the other end.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

use super::loops::{followed, following};
use crate::map::{KeyframeId, Map};

/// Keyframes that share fewer landmarks do not hold each other.
const HELD: u32 = 15;

/// The shortest way between two keyframes; `None` if none leads there.
pub fn shortest_way(map: &Map, closed: &[(KeyframeId, KeyframeId)], from: KeyframeId, to: KeyframeId) -> Option<f64> {
    let driven = |id: KeyframeId| [followed(map, id), following(map, id)].into_iter().flatten();
    let beside = |id: KeyframeId| {
        let numbered = [map.keyframes.last_before(id.0), map.keyframes.ids_from(id.0 + 1).next()];
        numbered.into_iter().flatten().map(KeyframeId)
    };
    let way = way_over(map, closed, (from, to), driven);
    way.or_else(|| way_over(map, closed, (from, to), |id| driven(id).chain(beside(id))))
}

/// `beside`: the keyframes that one follows and is followed by.
fn way_over<N: Iterator<Item = KeyframeId>>(
    map: &Map,
    closed: &[(KeyframeId, KeyframeId)],
    (from, to): (KeyframeId, KeyframeId),
    beside: impl Fn(KeyframeId) -> N,
) -> Option<f64> {
    let mut tied: BTreeMap<KeyframeId, Vec<KeyframeId>> = BTreeMap::new();
    for &(a, b) in closed {
        tied.entry(a).or_default().push(b);
        tied.entry(b).or_default().push(a);
    }
    // Lengths are not negative, so their bits have their order.
    let mut reached: BTreeMap<KeyframeId, f64> = BTreeMap::new();
    let mut next = BinaryHeap::from([Reverse((0_u64, from))]);
    while let Some(Reverse((bits, at))) = next.pop() {
        if reached.contains_key(&at) {
            continue;
        }
        let length = f64::from_bits(bits);
        if at == to {
            return Some(length);
        }
        reached.insert(at, length);
        let Some(keyframe) = map.keyframe(at) else { continue };
        let here = keyframe.centre();
        let held = keyframe.covisible.iter().filter(|c| c.1 >= HELD).map(|c| c.0);
        let links = held.chain(beside(at));
        let links = links.chain(tied.get(&at).into_iter().flatten().copied());
        for neighbour in links.filter(|n| !reached.contains_key(n)) {
            let Some(step) = map.keyframe(neighbour).map(|k| (k.centre() - here).norm()) else { continue };
            if step.is_finite() {
                next.push(Reverse(((length + step).to_bits(), neighbour)));
            }
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Se3;
    use crate::map::{Keyframe, MapId, examples};
    use nalgebra::{UnitQuaternion, Vector3};

    /// Keyframes around a square of side 10, one a unit, and a unit short of the start.
    fn lap() -> Map {
        let mut map = Map::default();
        for i in 0..40 {
            let (side, along) = (i / 10, f64::from(i % 10));
            let at = match side {
                0 => [along, 0.0],
                1 => [10.0, along],
                2 => [10.0 - along, 10.0],
                _ => [0.0, 10.0 - along],
            };
            let pose = Se3::new(UnitQuaternion::identity(), -Vector3::new(at[0], 0.0, at[1]));
            map.add_keyframe(Keyframe { sequence: i as u64, ..examples::keyframe(Default::default(), pose) });
        }
        map
    }

    #[test]
    fn maps_that_were_joined_follow_one_another_only_where_nothing_else_leads_there() {
        let mut map = lap();
        // The second half was made in another map.
        let second: Vec<Keyframe> = (20..40).filter_map(|id| map.remove_keyframe(KeyframeId(id))).collect();
        second.into_iter().for_each(|k| {
            map.add_keyframe(Keyframe { map: MapId(1), ..k });
        });
        let way = |closed: &[(KeyframeId, KeyframeId)]| shortest_way(&map, closed, KeyframeId(19), KeyframeId(40));
        assert!((way(&[]).expect("as they lie") - 1.0).abs() < 1e-12);
        // The other ends, 0 and 59, were seen to be near each other.
        assert!((way(&[(KeyframeId(0), KeyframeId(59))]).expect("round the lap") - 39.0).abs() < 1e-12);
    }

    #[test]
    fn the_way_is_what_was_driven_until_a_loop_ties_its_ends() {
        let map = lap();
        let way = |closed: &[(KeyframeId, KeyframeId)], from, to| {
            shortest_way(&map, closed, KeyframeId(from), KeyframeId(to)).expect("a way")
        };
        assert!((way(&[], 0, 39) - 39.0).abs() < 1e-12);
        let tied = [(KeyframeId(0), KeyframeId(39))];
        assert!((way(&tied, 0, 39) - 1.0).abs() < 1e-12);
        assert!((way(&tied, 2, 35) - 7.0).abs() < 1e-12, "through the tie, and not around");
        assert_eq!(way(&tied, 7, 7), 0.0);
        assert_eq!(shortest_way(&map, &[], KeyframeId(0), KeyframeId(99)), None, "no such keyframe");
    }
}
