//! More matches once the epipolar geometry is known: what the ratio test had to refuse in the whole picture is often
//! the only one along a line.
//!
//! Input: the corners of both pictures, where they are without the lens's distortion, and F of those places. Output: pairs
//! - whose second corner lies within a band of the first one's epipolar line, mutual nearest among those by what the matcher compares
//!   (binary descriptors, histograms of gradients), with the ratio test among those ([`match_along_lines`]);
//! - or whose second place, a corner or not, has the patch that correlates best along the line ([`correlate_along_lines`]: the
//!   study's way).
//!
//! Cost: up to 2 n m line distances and a descriptor comparison for those within the band, one corner's candidates at a time in memory; 40 us
//! a corner for the correlation.
//! Deliberately not here: estimating F again (`super::two_view`), lines that a lens bends.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

use super::detect::{Corners, Keypoint};
use super::pairing::{Pair, gradients_of, pair_of};
use crate::features::Corner;
use crate::features::correlation::{CorrelationMatching, EpipolarCorrelator, EpipolarSearch};
use crate::features::gradients::LENGTH;

/// How a guided match is judged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Guidance {
    /// Half the width of the band, pixels.
    pub band_px: f64,
    /// Largest distance, in the measure of what is compared.
    pub max_distance: f64,
    /// The nearest must be nearer than this share of the distance of the nearest elsewhere.
    pub max_ratio: f64,
    /// Elsewhere is farther than this many pixels of the coarser scale.
    pub same_place_px: f64,
    /// Corners whose scales differ by more steps are not compared.
    pub max_scale_steps: usize,
}

impl Guidance {
    /// For binary descriptors: a distance is bits of 256.
    pub fn descriptors(band_px: f64) -> Self {
        Self { band_px, max_distance: 72.0, max_ratio: 0.9, same_place_px: 0.0, max_scale_steps: 6 }
    }

    /// For histograms of gradients: a distance is a share of a descriptor's length. A corner is found again at the scales beside its own,
    /// and its second nearest is then itself (see `features::matching::places`).
    pub fn gradients(band_px: f64) -> Self {
        Self { band_px, max_distance: 0.8, max_ratio: 0.9, same_place_px: 4.0, max_scale_steps: 6 }
    }
}

/// How unlike two keypoints are, and the direction of each that says so, radians.
pub type Unlikeness = (f64, [f32; 2]);

/// Distance of the binary descriptors of two keypoints.
pub fn descriptor_distance(corners: [&Corners; 2]) -> impl Fn(usize, usize) -> Option<Unlikeness> {
    move |i, j| {
        let (a, b) = (&corners[0].keypoints.get(i)?.descriptor, &corners[1].keypoints.get(j)?.descriptor);
        let (a, b) = (a.as_ref()?, b.as_ref()?);
        Some((f64::from(a.descriptor.distance(&b.descriptor)), [a.angle_rad, b.angle_rad]))
    }
}

/// Least distance of the histograms of gradients of two keypoints, each of which may have two.
pub fn gradient_distance(corners: [&Corners; 2]) -> impl Fn(usize, usize) -> Option<Unlikeness> {
    let all = corners.map(gradients_of);
    move |i, j| {
        let [a, b] = [all[0].get(i)?, all[1].get(j)?];
        let both = a.iter().flat_map(|p| b.iter().map(move |q| (p, q)));
        let each = both.map(|(p, q)| (p.descriptor.distance_squared(&q.descriptor), [p.turn_rad, q.turn_rad]));
        let (least, turns_rad) = each.min_by_key(|(squared, _)| *squared)?;
        Some((f64::from(least).sqrt() / f64::from(LENGTH), turns_rad))
    }
}

/// One corner's candidates of the other picture: the nearest, its distance, and that of the nearest elsewhere.
fn nearest(candidates: &[(usize, f64)], same: impl Fn(usize, usize) -> bool) -> Option<(usize, f64, f64)> {
    // Of equally near ones the first.
    let (index, least) = *candidates.iter().min_by(|a, b| a.1.total_cmp(&b.1))?;
    let elsewhere = candidates.iter().filter(|(k, _)| *k != index && !same(*k, index)).map(|(_, d)| *d);
    Some((index, least, elsewhere.fold(f64::INFINITY, f64::min)))
}

/// Matches along epipolar lines, by `distance` of the keypoints of both pictures. `ideal`: each corner's place without lens distortion,
/// pixels; `None` is left out.
pub fn match_along_lines(
    corners: [&Corners; 2],
    ideal: [&[Option<Vector2<f64>>]; 2],
    fundamental: &Matrix3<f64>,
    rule: &Guidance,
    distance: impl Fn(usize, usize) -> Option<Unlikeness>,
) -> Vec<Pair> {
    // Tilted views would show every place ten times over.
    let [first, second] = corners.map(|c| &c.keypoints[..c.plain_count()]);
    let line = |at: &Option<Vector2<f64>>| {
        let line = fundamental * at.as_ref()?.push(1.0);
        let norm = line.xy().norm();
        (norm > 0.0).then(|| line / norm)
    };
    let lines: Vec<Option<Vector3<f64>>> = ideal[0].iter().map(line).collect();
    // What corner j of the second picture is to corner i of the first, where it is a candidate.
    let candidate = |i: usize, j: usize| {
        let (line, to) = (lines.get(i)?.as_ref()?, ideal[1].get(j)?.as_ref()?);
        let off = (line.x * to.x + line.y * to.y + line.z).abs();
        let near = off <= rule.band_px && first[i].scale.abs_diff(second[j].scale) <= rule.max_scale_steps;
        near.then(|| distance(i, j)).flatten().map(|(unlike, _)| unlike)
    };
    let same = |all: &[Keypoint], i: usize, j: usize| {
        let (p, q) = (&all[i], &all[j]);
        (p.position - q.position).norm() <= rule.same_place_px * p.size_px.max(q.size_px)
    };
    let clear = |(_, least, elsewhere): &(usize, f64, f64)| {
        *least <= rule.max_distance && (elsewhere.is_infinite() || *least < rule.max_ratio * elsewhere)
    };
    // One corner's candidates at a time: all of them together would be gigabytes for many corners and wide bands. Of the second
    // picture's corners only those are asked that are somebody's nearest.
    let mut candidates = Vec::new();
    let mut backward = vec![None; second.len()];
    let mut pairs = Vec::new();
    for i in 0..first.len() {
        candidates.clear();
        candidates.extend((0..second.len()).filter_map(|j| Some((j, candidate(i, j)?))));
        let Some(there) = nearest(&candidates, |a, b| same(second, a, b)).filter(clear) else { continue };
        let back = *backward[there.0].get_or_insert_with(|| {
            candidates.clear();
            candidates.extend((0..first.len()).filter_map(|k| Some((k, candidate(k, there.0)?))));
            nearest(&candidates, |a, b| same(first, a, b))
        });
        if back.filter(clear).is_some_and(|back| back.0 == i) {
            let turns_rad = distance(i, there.0).map_or([0.0; 2], |(_, turns)| turns);
            pairs.push(pair_of(corners, [i, there.0], there.1, turns_rad));
        }
    }
    pairs
}

/// Matches by correlation along epipolar lines, of the first picture's corners at its own scale. `fundamental`: of the
/// pictures' own pixels.
pub fn correlate_along_lines(
    corners: [&Corners; 2],
    fundamental: &Matrix3<f64>,
    rule: &CorrelationMatching,
) -> Vec<Pair> {
    let [Some(first), Some(second)] = corners.map(|c| c.scales.first()) else { return Vec::new() };
    let Ok(mut correlator) = EpipolarCorrelator::new(*rule, EpipolarSearch::default()) else { return Vec::new() };
    let (of, places): (Vec<usize>, Vec<Corner>) = corners[0]
        .keypoints
        .iter()
        .enumerate()
        .filter(|(_, k)| k.scale == 0)
        .map(|(i, k)| (i, Corner { x: k.position.x as f32, y: k.position.y as f32, response: k.response }))
        .unzip();
    let mut found = Vec::new();
    correlator.match_lines(&first.image, &second.image, fundamental, &places, &mut found);
    found
        .iter()
        .map(|m| {
            let i = of[m.first as usize];
            Pair {
                a: corners[0].keypoints[i].position,
                b: m.position.cast::<f64>(),
                first: i,
                second: None,
                distance: f64::from(m.distance),
                size_px: [1.0; 2],
                map: Matrix2::identity(),
                polished: false,
            }
        })
        .collect()
}
