//! More matches once the epipolar geometry is known: what the ratio test had to refuse in the whole picture is often
//! the only one along a line.
//!
//! Input: the corners of both pictures, where they are without the lens's distortion, and F of those places. Output: pairs
//! - whose second corner lies within a band of the first one's epipolar line, mutual nearest by their descriptors among those,
//!   with the ratio test among those ([`match_along_lines`]);
//! - or whose second place, a corner or not, has the patch that correlates best along the line ([`correlate_along_lines`]: the
//!   study's way).
//!
//! Cost: n m line distances and a descriptor comparison for the few within the band; 40 us a corner for the correlation.
//! Deliberately not here: estimating F again (`super::two_view`), lines that a lens bends.

use nalgebra::{Matrix3, Vector2};

use super::detect::Corners;
use super::pairing::Pair;
use crate::features::Corner;
use crate::features::correlation::{CorrelationMatching, EpipolarCorrelator, EpipolarSearch};

/// How a guided match is judged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Guidance {
    /// Half the width of the band, pixels.
    pub band_px: f64,
    /// Largest distance, bits of 256.
    pub max_distance: u32,
    /// The nearest must be nearer than this share of the second nearest's distance.
    pub max_ratio: f64,
    /// Corners whose scales differ by more steps are not compared.
    pub max_scale_steps: usize,
}

impl Default for Guidance {
    fn default() -> Self {
        Self { band_px: 3.0, max_distance: 72, max_ratio: 0.9, max_scale_steps: 6 }
    }
}

/// Matches along epipolar lines. `ideal`: each corner's place without distortion, pixels; `None` is left out.
pub fn match_along_lines(
    corners: [&Corners; 2],
    ideal: [&[Option<Vector2<f64>>]; 2],
    fundamental: &Matrix3<f64>,
    rule: &Guidance,
) -> Vec<Pair> {
    let [first, second] = corners.map(|c| c.keypoints.as_slice());
    // Nearest and second nearest distance, and whose the nearest is.
    let mut rows = vec![(u32::MAX, u32::MAX, usize::MAX); first.len()];
    let mut columns = vec![(u32::MAX, u32::MAX, usize::MAX); second.len()];
    let offer = |best: &mut (u32, u32, usize), distance: u32, index: usize| {
        if distance < best.0 {
            *best = (distance, best.0, index);
        } else if distance < best.1 {
            best.1 = distance;
        }
    };
    for (i, (p, at)) in first.iter().zip(ideal[0]).enumerate() {
        let (Some(descriptor), Some(at)) = (&p.descriptor, at) else { continue };
        let line = fundamental * at.push(1.0);
        let norm = line.xy().norm();
        if !(norm > 0.0) {
            continue;
        }
        let line = line / norm;
        for (j, (q, to)) in second.iter().zip(ideal[1]).enumerate() {
            let (Some(other), Some(to)) = (&q.descriptor, to) else { continue };
            let off = (line.x * to.x + line.y * to.y + line.z).abs();
            if off > rule.band_px || p.scale.abs_diff(q.scale) > rule.max_scale_steps {
                continue;
            }
            let distance = descriptor.distance(other);
            offer(&mut rows[i], distance, j);
            offer(&mut columns[j], distance, i);
        }
    }
    let clear = |best: &(u32, u32, usize)| {
        best.0 <= rule.max_distance && (best.1 == u32::MAX || f64::from(best.0) < rule.max_ratio * f64::from(best.1))
    };
    let mut pairs = Vec::new();
    for (i, row) in rows.iter().enumerate() {
        let Some(column) = columns.get(row.2) else { continue };
        if column.2 == i && clear(row) && clear(column) {
            let (p, q) = (&first[i], &second[row.2]);
            pairs.push(Pair {
                a: p.position,
                b: q.position,
                first: i,
                second: Some(row.2),
                distance: f64::from(row.0),
                size_px: [p.size_px, q.size_px],
            });
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
            }
        })
        .collect()
}
