use super::*;
use crate::geometry::random::Random;

/// Corners of a world along a way: a keyframe sees some hundred of them, the next one most of the same.
struct World {
    corners: Vec<Descriptor>,
    /// How easily noise turns each bit of a corner over: comparisons of nearly equal grey levels, and clear ones.
    doubtful: Vec<Descriptor>,
}

impl World {
    fn new(random: &mut Random, corners: usize) -> Self {
        let mut descriptor = || Descriptor(std::array::from_fn(|_| random.bits()));
        let corners: Vec<_> = (0..corners).map(|_| descriptor()).collect();
        // One bit in four.
        let doubtful = corners.iter().map(|_| (descriptor(), descriptor()));
        let doubtful = doubtful.map(|(a, b)| Descriptor(std::array::from_fn(|k| a.0[k] & b.0[k]))).collect();
        Self { corners, doubtful }
    }

    /// What is seen at a place: `share` of the corners there, a third of the doubtful bits turned over, and corners that are nowhere else.
    fn seen(&self, random: &mut Random, place: usize, share: f64) -> Vec<Descriptor> {
        let mut seen = Vec::new();
        for i in 0..DESCRIPTORS {
            if random.unit() > share {
                seen.push(Descriptor(std::array::from_fn(|_| random.bits())));
                continue;
            }
            let corner = (20 * place + i) % self.corners.len();
            let (mut bits, doubtful) = (self.corners[corner], self.doubtful[corner]);
            for bit in 0..BITS as u16 {
                if has(&doubtful, bit) && random.below(3) == 0 {
                    bits.0[usize::from(bit) / 64] ^= 1 << (bit % 64);
                }
            }
            seen.push(bits);
        }
        seen
    }
}

/// An index of `places` keyframes along a way, and the world.
fn along(places: usize, seed: u64) -> (PlaceIndex, World, Random) {
    let mut random = Random::new(seed);
    let world = World::new(&mut random, 20 * places);
    let mut index = PlaceIndex::default();
    for place in 0..places {
        let seen = world.seen(&mut random, place, 0.7);
        index.add(KeyframeId(place as u32), &seen);
    }
    (index, world, random)
}

fn asked(index: &mut PlaceIndex, seen: &[Descriptor]) -> Vec<Candidate> {
    let mut out = Vec::new();
    index.query(seen, 3, |_| true, &mut out);
    out
}

#[test]
fn a_place_is_found_again_by_a_third_of_its_corners() {
    let (mut index, world, mut random) = along(300, 1);
    let mut found = 0;
    for place in (0..300).step_by(3) {
        let seen = world.seen(&mut random, place, 0.35);
        let best = asked(&mut index, &seen);
        found += usize::from(best.first().is_some_and(|c| (c.keyframe.0 as usize).abs_diff(place) <= 3));
    }
    assert!(found >= 97, "{found} of 100");
}

#[test]
fn an_unknown_place_is_like_no_other() {
    let (mut index, world, mut random) = along(300, 2);
    let elsewhere = World::new(&mut random, 4000);
    for place in 0..20 {
        let known = world.seen(&mut random, 10 * place, 0.35);
        let known = asked(&mut index, &known)[0].score;
        let unknown = elsewhere.seen(&mut random, 5 * place, 0.7);
        let unknown = asked(&mut index, &unknown).first().map_or(0.0, |c| c.score);
        assert!(5.0 * unknown < known, "{unknown} and {known}");
    }
}

#[test]
fn who_is_not_eligible_or_was_removed_is_not_found_and_its_memory_is_freed() {
    let (mut index, world, mut random) = along(200, 3);
    let seen = world.seen(&mut random, 100, 0.7);
    let mut out = Vec::new();
    index.query(&seen, 10, |id| id.0 > 110, &mut out);
    assert!(out.iter().all(|c| c.keyframe.0 > 110));
    let before = index.bytes();
    (98..103).for_each(|id| index.remove(KeyframeId(id)));
    index.query(&seen, 200, |_| true, &mut out);
    assert!(!out.is_empty() && out.iter().all(|c| !(98..103).contains(&c.keyframe.0)));
    // As one goes another comes, for a long time.
    for id in 200..2000u32 {
        let seen = world.seen(&mut random, id as usize, 0.7);
        index.add(KeyframeId(id), &seen);
        let oldest = index.keyframes().next().expect("one");
        index.remove(oldest);
    }
    assert_eq!(index.len(), 195);
    assert!(index.bytes() < 2 * before, "{before} bytes, then {}", index.bytes());
    assert!(index.dead < 40 * DESCRIPTORS, "{} entries of nobody", index.dead);
    let entries: u32 = index.slots.iter().map(|s| s.entries).sum();
    let held: usize = index.nodes.iter().map(|n| if let Node::Leaf(l) = n { l.slots.len() } else { 0 }).sum();
    assert_eq!(entries as usize, held);
}

#[test]
fn equal_descriptors_are_bounded_and_counted() {
    let mut index = PlaceIndex::default();
    let wall = [Descriptor([5; 4]); DESCRIPTORS];
    (0..20).for_each(|id| index.add(KeyframeId(id), &wall));
    assert_eq!(index.crowded_out(), 20 * DESCRIPTORS as u64 - CROWDED as u64);
    let newest = asked(&mut index, &wall);
    assert_eq!(newest.iter().map(|c| c.keyframe.0).collect::<Vec<_>>(), [18, 19]);
    (0..20).for_each(|id| index.remove(KeyframeId(id)));
    assert!(index.is_empty() && asked(&mut index, &wall).is_empty());
    assert!(asked(&mut PlaceIndex::default(), &wall).is_empty());
}

#[test]
fn the_same_calls_give_the_same_answers() {
    let run = || {
        let (mut index, world, mut random) = along(120, 4);
        (0..30).for_each(|id| index.remove(KeyframeId(3 * id)));
        let seen = world.seen(&mut random, 60, 0.4);
        asked(&mut index, &seen)
    };
    assert_eq!(run(), run());
}
