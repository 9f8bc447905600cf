//! Which place of one picture is which of another, where a place may have been described more than once.
//!
//! Input: descriptors of both pictures, each with where it was taken and how large a pixel of its scale is; a rule. Output:
//! pairs of indices with their distance, the nearest first, no two of them between the same two places.
//! A corner is found again at the scales beside its own, and may have two directions: its second nearest is then itself, and the
//! ratio test would refuse it for being found well. So the second nearest is the nearest *elsewhere* (as Lowe, IJCV 2004, 7.1, compares
//! with a neighbour that is known to be of another object), and mutual means: the nearest of the nearest is at the same place.
//! Of pairs between the same two places one is kept: a model must not count one agreement several times.
//! Cost: two sweeps of n m distances. It deliberately does not do: geometry (see `geometry::ransac`).

use super::Match;
use crate::features::descriptor::Descriptor;
use crate::features::dispatch::simd_kernel;
use crate::features::gradients::{GradientDescriptor, distances_squared};

/// Nearer than this many pixels of the coarser scale is the same place.
const SAME_PLACE_PX: f32 = 4.0;

/// What can be compared, one with many.
pub trait Comparable: Sized {
    /// Distances to all others, in their order and in the measure of [`Self::share`].
    fn distances(&self, others: &[Self], out: &mut [u32]);
    /// A share of a distance in the same measure.
    fn share(ratio: f32) -> f32;
    /// Distance as it is reported and limited.
    fn reported(distance: u32) -> f32;
}

impl Comparable for Descriptor {
    fn distances(&self, others: &[Self], out: &mut [u32]) {
        hamming_distances(self, others, out);
    }
    fn share(ratio: f32) -> f32 {
        ratio
    }
    fn reported(distance: u32) -> f32 {
        distance as f32
    }
}

impl Comparable for GradientDescriptor {
    fn distances(&self, others: &[Self], out: &mut [u32]) {
        distances_squared(self, others, out);
    }
    fn share(ratio: f32) -> f32 {
        ratio * ratio
    }
    fn reported(distance: u32) -> f32 {
        (distance as f32).sqrt()
    }
}

simd_kernel! {
    /// Hamming distances of one descriptor to all others.
    fn hamming_distances(of: &Descriptor, to: &[Descriptor], out: &mut [u32]) = hamming_body
}

#[inline(always)]
fn hamming_body(of: &Descriptor, to: &[Descriptor], out: &mut [u32]) {
    for (distance, other) in out.iter_mut().zip(to) {
        *distance = of.distance(other);
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
    fn is_at(&self, other: &Self) -> bool {
        let (dx, dy) = (self.at[0] - other.at[0], self.at[1] - other.at[1]);
        let reach = SAME_PLACE_PX * self.size_px.max(other.size_px);
        dx * dx + dy * dy <= reach * reach
    }
}

/// When two descriptors belong together.
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields)]
pub struct PlaceMatching {
    /// Largest distance, in the descriptor's measure.
    pub max_distance: f32,
    /// The nearest must be nearer than this share of the nearest elsewhere, in both directions; 1 = any.
    pub max_ratio: f32,
}

/// Of each descriptor: index of the nearest of the others, its distance, and the distance of the nearest elsewhere.
fn nearest<D: Comparable>(of: &[D], others: &[D], places: &[Place]) -> Vec<Option<(usize, u32, u32)>> {
    let mut row = vec![0; others.len()];
    of.iter()
        .map(|d| {
            d.distances(others, &mut row);
            // Of equally near ones the first.
            let (index, least) = row.iter().enumerate().min_by_key(|(_, distance)| **distance)?;
            let own = places.get(index)?;
            // Few are near enough to be asked where they are.
            let mut second = u32::MAX;
            for (distance, place) in row.iter().zip(places) {
                if *distance < second && !place.is_at(own) {
                    second = *distance;
                }
            }
            Some((index, *least, second))
        })
        .collect()
}

/// Matches; see the module. Descriptors without a place (a shorter slice) are left out.
pub fn match_places<D: Comparable>(
    (first, first_places): (&[D], &[Place]),
    (second, second_places): (&[D], &[Place]),
    rule: &PlaceMatching,
) -> Vec<Match> {
    let first = &first[..first.len().min(first_places.len())];
    let second = &second[..second.len().min(second_places.len())];
    let forward = nearest(first, second, second_places);
    let backward = nearest(second, first, first_places);
    let clear = |distance: u32, other: u32| {
        rule.max_ratio >= 1.0 || (distance as f32) < D::share(rule.max_ratio) * other as f32
    };
    let mut found: Vec<Match> = Vec::new();
    for (i, there) in forward.iter().enumerate() {
        let Some((j, distance, elsewhere)) = *there else { continue };
        let Some((back, _, elsewhere_back)) = backward[j] else { continue };
        let mutual = back == i || first_places[back].is_at(&first_places[i]);
        let near = D::reported(distance) <= rule.max_distance;
        if mutual && near && clear(distance, elsewhere) && clear(distance, elsewhere_back) {
            found.push(Match { first: i as u32, second: j as u32, distance: D::reported(distance) });
        }
    }
    // Stable: of equally near ones the first in index.
    found.sort_by(|a, b| a.distance.total_cmp(&b.distance));
    let mut kept: Vec<Match> = Vec::new();
    for m in found {
        let (p, q) = (&first_places[m.first as usize], &second_places[m.second as usize]);
        let again = |k: &Match| first_places[k.first as usize].is_at(p) && second_places[k.second as usize].is_at(q);
        if !kept.iter().any(again) {
            kept.push(m);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::random::Random;

    fn noise(random: &mut Random) -> Descriptor {
        Descriptor(std::array::from_fn(|_| (random.below(1 << 32) as u64) << 32 | random.below(1 << 32) as u64))
    }

    fn flipped(of: &Descriptor, bits: u32) -> Descriptor {
        let mut out = *of;
        for k in 0..bits {
            out.0[(k % 4) as usize] ^= 1 << (k / 4);
        }
        out
    }

    const RULE: PlaceMatching = PlaceMatching { max_distance: 80.0, max_ratio: 0.8 };

    #[test]
    fn a_place_described_at_two_scales_matches_once_and_its_twin_elsewhere_makes_it_ambiguous() {
        let mut random = Random::new(7);
        let truth: Vec<Descriptor> = (0..40).map(|_| noise(&mut random)).collect();
        let at = |i: usize, size_px: f32| Place { at: [30.0 * i as f32, 100.0], size_px };
        // Each place at two scales, with 10 and 14 bits of noise.
        let both: Vec<Descriptor> = truth.iter().map(|d| flipped(d, 10)).chain(truth.iter().map(|d| flipped(d, 14))).collect();
        let places: Vec<Place> = (0..40).map(|i| at(i, 1.0)).chain((0..40).map(|i| at(i, 1.2))).collect();
        let found = match_places((&both, &places), (&truth, &places[..40]), &RULE);
        assert_eq!(found.len(), 40, "seed 7");
        assert!(found.iter().all(|m| m.first == m.second && m.distance == 10.0));
        // The same at another place: neither is clear.
        let far: Vec<Place> = (0..40).map(|i| at(i, 1.0)).chain((0..40).map(|i| at(i + 100, 1.0))).collect();
        assert!(match_places((&both, &far), (&truth, &places[..40]), &RULE).is_empty());
    }

    #[test]
    fn far_ones_and_nothing_at_all_match_nothing() {
        let mut random = Random::new(8);
        let all: Vec<Descriptor> = (0..50).map(|_| noise(&mut random)).collect();
        let more: Vec<Descriptor> = (0..50).map(|_| noise(&mut random)).collect();
        let places = vec![Place { at: [0.0; 2], size_px: 1.0 }; 50];
        assert!(match_places((&all, &places), (&more, &places), &RULE).is_empty());
        assert!(match_places::<Descriptor>((&[], &[]), (&more, &places), &RULE).is_empty());
        assert!(match_places((&all, &places), (&more, &[]), &RULE).is_empty());
    }
}
