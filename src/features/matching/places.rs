//! Which corner of one picture is which of another, by descriptors of either kind, where a corner may have been described more than once.
//!
//! Input: descriptors of both pictures, each with where it was taken and how large a pixel of its scale is; a rule. Output:
//! pairs of indices with their distance, the nearest first, no two of them between the same two corners.
//! A corner is found again at the scales beside its own and in tilted views, and may have two directions: its second nearest is then itself, and the
//! ratio test would refuse it for being found well. So the second nearest is the nearest *elsewhere* (as Lowe, IJCV 2004, 7.1, compares
//! with a neighbour that is known to be of another object), and mutual means: the nearest of the nearest is at the same place.
//! Of pairs between the same two corners one is kept: a model must not count one agreement several times.
//! Cost: n m distances, and n more for each that is asked back. It deliberately does not do: geometry (see `geometry::ransac`).

use super::Match;
use crate::features::descriptor::Descriptor;
use crate::features::dispatch::simd_kernel;
use crate::features::gradients::{self, GradientDescriptor, Widened};

/// Nearer than this many pixels of the coarser scale is the same place: half a patch of either descriptor is the same picture there.
const SAME_PLACE_PX: f32 = 4.0;
/// Pairs whose ends are both nearer than this, in the same unit, are one corner found twice.
pub const SAME_CORNER_PX: f32 = 1.5;

/// What can be compared.
pub trait Comparable: Sized {
    /// What a [`Match::distance`] of 1 is.
    const UNIT: f32;

    /// Many, in the form in which they are compared fastest.
    type Many;

    fn many(all: &[Self]) -> Self::Many;

    /// Squared distances of one of `own` to all of `others`, in their order.
    fn distances_squared(own: &Self::Many, one: usize, others: &Self::Many, out: &mut [u32]);
}

/// Distances are shares of a descriptor's length.
impl Comparable for GradientDescriptor {
    const UNIT: f32 = gradients::LENGTH;

    type Many = Widened;

    fn many(all: &[Self]) -> Widened {
        Widened::new(all)
    }

    fn distances_squared(own: &Widened, one: usize, others: &Widened, out: &mut [u32]) {
        own.distances_squared(one, others, out);
    }
}

/// Distances are bits.
impl Comparable for Descriptor {
    const UNIT: f32 = 1.0;

    type Many = Vec<Self>;

    fn many(all: &[Self]) -> Vec<Self> {
        all.to_vec()
    }

    fn distances_squared(own: &Vec<Self>, one: usize, others: &Vec<Self>, out: &mut [u32]) {
        bits_squared(&own[one], others, out);
    }
}

simd_kernel! {
    fn bits_squared(of: &Descriptor, to: &[Descriptor], out: &mut [u32]) = bits_squared_body
}

#[inline(always)]
fn bits_squared_body(of: &Descriptor, to: &[Descriptor], out: &mut [u32]) {
    for (squared, other) in out.iter_mut().zip(to) {
        let bits = of.distance(other);
        *squared = bits * bits;
    }
}

/// Where a descriptor was taken.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Pixels of the picture.
    pub at: [f32; 2],
    /// Pixels of the picture a pixel of the scale.
    pub size_px: f32,
}

impl Place {
    /// Nearer than so many pixels of the coarser scale of both.
    pub fn is_within(&self, other: &Self, limit_px: f32) -> bool {
        let (dx, dy) = (self.at[0] - other.at[0], self.at[1] - other.at[1]);
        let reach = limit_px * self.size_px.max(other.size_px);
        dx * dx + dy * dy <= reach * reach
    }
}

/// When two descriptors belong together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaceMatching {
    /// Largest distance, in [`Comparable::UNIT`]s.
    pub max_distance: f32,
    /// The nearest must be nearer than this share of the nearest elsewhere, in both directions; 1 = any. Between 0.8 and 0.9 it makes
    /// little difference.
    pub max_ratio: f32,
    /// Nearer than this is no nearer: so much noise alone makes of one patch. Along a plain edge everything is alike to within less, and which
    /// of it is nearest is chance.
    pub noise: f32,
}

impl Default for PlaceMatching {
    fn default() -> Self {
        Self { max_distance: 0.8, max_ratio: 0.85, noise: 0.15 }
    }
}

/// So many distances are looked at together.
const LOOKED_AT: usize = 16;

simd_kernel! {
    /// The least of each so many distances.
    fn least_of(row: &[u32], out: &mut [u32]) = least_body
}

#[inline(always)]
fn least_body(row: &[u32], out: &mut [u32]) {
    let (whole, rest) = row.as_chunks::<LOOKED_AT>();
    for (least, distances) in out.iter_mut().zip(whole) {
        *least = distances.iter().fold(u32::MAX, |least, d| least.min(*d));
    }
    if let (Some(least), true) = (out.get_mut(whole.len()), !rest.is_empty()) {
        *least = rest.iter().fold(u32::MAX, |least, d| least.min(*d));
    }
}

/// Index of the nearest of the others, its squared distance, and that of the nearest elsewhere, of all distances.
/// `each` is memory to work in.
fn nearest(row: &[u32], places: &[Place], each: &mut Vec<u32>) -> Option<(usize, u32, u32)> {
    each.resize(row.len().div_ceil(LOOKED_AT), 0);
    least_of(row, each);
    let least = *each.iter().min()?;
    // Of equally near ones the first.
    let index = row.iter().position(|distance| *distance == least)?;
    let own = places.get(index)?;
    // Few are near enough to be asked where they are.
    let mut second = u32::MAX;
    for (k, distances) in row.chunks(LOOKED_AT).enumerate() {
        if each[k] >= second {
            continue;
        }
        for (distance, place) in distances.iter().zip(&places[k * LOOKED_AT..]) {
            if *distance < second && !place.is_within(own, SAME_PLACE_PX) {
                second = *distance;
            }
        }
    }
    Some((index, least, second))
}

/// Matches; see the module. Descriptors without a place (a shorter slice) are left out.
pub fn match_places<D: Comparable>(
    (first, first_places): (&[D], &[Place]),
    (second, second_places): (&[D], &[Place]),
    rule: &PlaceMatching,
) -> Vec<Match> {
    let first = &first[..first.len().min(first_places.len())];
    let second = &second[..second.len().min(second_places.len())];
    let clear = |distance: u32, other: u32| {
        let distance = (distance as f32).max((rule.noise * D::UNIT).powi(2));
        rule.max_ratio >= 1.0 || distance < rule.max_ratio * rule.max_ratio * other as f32
    };
    let mut found: Vec<Match> = Vec::new();
    let (mut row, mut column, mut each) = (vec![0; second.len()], vec![0; first.len()], Vec::new());
    let mut backward: Vec<Option<Option<(usize, u32, u32)>>> = vec![None; second.len()];
    let (first, second) = (D::many(first), D::many(second));
    for i in 0..column.len() {
        D::distances_squared(&first, i, &second, &mut row);
        let Some((j, distance, elsewhere)) = nearest(&row, second_places, &mut each) else { continue };
        let share = (distance as f32).sqrt() / D::UNIT;
        if share > rule.max_distance || !clear(distance, elsewhere) {
            continue;
        }
        // Asked back only where it matters.
        let back = *backward[j].get_or_insert_with(|| {
            D::distances_squared(&second, j, &first, &mut column);
            nearest(&column, first_places, &mut each)
        });
        let Some((back, _, elsewhere_back)) = back else { continue };
        let mutual = back == i || first_places[back].is_within(&first_places[i], SAME_PLACE_PX);
        if mutual && clear(distance, elsewhere_back) {
            found.push(Match { first: i as u32, second: j as u32, distance: share });
        }
    }
    // Stable: of equally near ones the first in index.
    found.sort_by(|a, b| a.distance.total_cmp(&b.distance));
    let mut kept: Vec<Match> = Vec::new();
    for m in found {
        let (p, q) = (&first_places[m.first as usize], &second_places[m.second as usize]);
        let again = |k: &Match| {
            first_places[k.first as usize].is_within(p, SAME_CORNER_PX)
                && second_places[k.second as usize].is_within(q, SAME_CORNER_PX)
        };
        if !kept.iter().any(again) {
            kept.push(m);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::gradients::NUMBERS;
    use crate::geometry::random::Random;

    fn stranger(random: &mut Random) -> GradientDescriptor {
        GradientDescriptor(std::array::from_fn::<u8, NUMBERS, _>(|_| random.below(91) as u8))
    }

    /// Every number moved by `by`.
    fn moved(of: &GradientDescriptor, by: u8) -> GradientDescriptor {
        GradientDescriptor(of.0.map(|v| v + by))
    }

    #[test]
    fn a_corner_described_at_two_scales_matches_once_and_its_twin_elsewhere_makes_it_ambiguous() {
        let mut random = Random::new(7);
        let truth: Vec<GradientDescriptor> = (0..40).map(|_| stranger(&mut random)).collect();
        let at = |i: usize, size_px: f32| Place { at: [30.0 * i as f32, 100.0], size_px };
        let both: Vec<_> = truth.iter().map(|d| moved(d, 10)).chain(truth.iter().map(|d| moved(d, 11))).collect();
        let places: Vec<Place> = (0..40).map(|i| at(i, 1.0)).chain((0..40).map(|i| at(i, 1.2))).collect();
        let rule = PlaceMatching::default();
        let found = match_places((&both, &places), (&truth, &places[..40]), &rule);
        assert_eq!(found.len(), 40, "seed 7");
        assert!(found.iter().all(|m| m.first == m.second && m.distance < 0.3), "{found:?}");
        // The same at another place: neither is clear.
        let far: Vec<Place> = (0..40).map(|i| at(i, 1.0)).chain((0..40).map(|i| at(i + 100, 1.0))).collect();
        assert!(match_places((&both, &far), (&truth, &places[..40]), &rule).is_empty());
    }

    #[test]
    fn along_a_plain_edge_nothing_matches_however_near_it_is() {
        // A few bits of 256 apart, each at its own place: the nearest is nearest by chance.
        let edge = |i: usize| Descriptor([0, 0, 0, (1 << (i % 5)) - 1]);
        let all: Vec<Descriptor> = (0..30).map(edge).collect();
        let places: Vec<Place> = (0..30).map(|i| Place { at: [50.0 * i as f32, 0.0], size_px: 1.0 }).collect();
        let rule = PlaceMatching { max_distance: 80.0, max_ratio: 0.8, noise: 8.0 };
        assert!(match_places((&all[..5], &places[..5]), (&all[..5], &places[..5]), &rule).is_empty());
        // Corners that are far from each other do, and their distance is in bits.
        let corner = |i: usize| Descriptor(std::array::from_fn(|k| if k == i { u64::MAX } else { 0 }));
        let all: Vec<Descriptor> = (0..4).map(corner).collect();
        let found = match_places((&all, &places[..4]), (&all, &places[..4]), &rule);
        assert!(found.len() == 4 && found.iter().all(|m| m.first == m.second && m.distance == 0.0), "{found:?}");
    }

    #[test]
    fn strangers_and_nothing_at_all_match_nothing() {
        let mut random = Random::new(8);
        let all: Vec<_> = (0..50).map(|_| stranger(&mut random)).collect();
        let more: Vec<_> = (0..50).map(|_| stranger(&mut random)).collect();
        let places: Vec<Place> = (0..50).map(|i| Place { at: [50.0 * i as f32, 0.0], size_px: 1.0 }).collect();
        let rule = PlaceMatching::default();
        assert!(match_places((&all, &places), (&more, &places), &rule).is_empty(), "seed 8");
        assert!(match_places::<GradientDescriptor>((&[], &[]), (&more, &places), &rule).is_empty());
        assert!(match_places((&all, &places), (&more, &[]), &rule).is_empty());
    }

    #[test]
    fn the_nearest_and_the_nearest_elsewhere_are_those_of_a_plain_search() {
        let (mut random, mut each) = (crate::geometry::random::Random::new(5), Vec::new());
        for length in [0, 1, 2, 15, 16, 17, 32, 100, 6000] {
            // Few distances, so that many are equal; few places, so that many are the same.
            let row: Vec<u32> = (0..length).map(|_| random.below(40) as u32).collect();
            let places: Vec<Place> =
                (0..length).map(|_| Place { at: [10.0 * random.below(9) as f32, 0.0], size_px: 1.0 }).collect();
            let least = row.iter().copied().min();
            let index = row.iter().position(|d| Some(*d) == least);
            let elsewhere = |i: usize| {
                let others = row.iter().zip(&places).filter(|(_, p)| !p.is_within(&places[i], SAME_PLACE_PX));
                others.map(|(d, _)| *d).min().unwrap_or(u32::MAX)
            };
            let plain = index.zip(least).map(|(i, least)| (i, least, elsewhere(i)));
            assert_eq!(super::nearest(&row, &places, &mut each), plain, "{length}");
        }
    }
}
