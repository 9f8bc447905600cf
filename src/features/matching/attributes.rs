//! Which corner of one picture is which of another, by the three attributes that the study keeps of a corner.
//!
//! Input: attributes of both pictures' corners; for the windowed kind also where each corner is expected (pixels). Output:
//! [`Match`]es whose distance is 0 (alike) to 1 (all three at their thresholds), ascending in the first index.
//! Two corners may match when grey level, salient degree and direction each differ by no more than a threshold of its own:
//! angles on the circle, axes modulo half a turn, an axis never with a direction. Of those that may, the nearest counts by
//!
//! ```text
//! d² = ((dG / max_grey)² + (dSD / max_salient_degree)² + (dDC / max_direction_rad)²) / 3
//! ```
//!
//! and only if each is the other's nearest and the second nearest is clearly farther.
//! Three numbers tell few corners apart: of a hundred corners in a picture nearly all have a double somewhere. A window
//! about the expected place, or few and strong corners, is what makes this matcher useful; it is there as the study's way.
//! Measured (strongest 300 SUSAN corners, similarity at t = 20 to 30; right within 2 px or by the inliers of a robust F):
//! over the whole picture 3 % right on graffiti, 44 % on a rectified stereo pair, and on a video's frames 5 apart a model in
//! 2 of 8 pairs; in windows of 40 px 34 %, 49 % and 7 of 8 pairs with 72 % inliers. Narrower thresholds give fewer matches
//! and few more right ones.
//! Cost: 2 ns a comparison; n m comparisons without windows.
//! It deliberately does not do: weighting of the attributes by more than their thresholds, geometry.

use super::Match;
use super::nearest::{self, Nearest};
use crate::features::attributes::Attributes;

/// When two corners' attributes belong together.
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct AttributeMatching {
    /// Largest difference of the nuclei, grey levels.
    pub max_grey: f32,
    /// Largest difference of the salient degrees, share of the mask.
    pub max_salient_degree: f32,
    /// Largest angle between the directions (or axes), radians.
    pub max_direction_rad: f32,
    /// The nearest must be nearer than this share of the second nearest's distance, in both directions; 1 = any.
    pub max_ratio: f32,
}

impl Default for AttributeMatching {
    fn default() -> Self {
        Self { max_grey: 20.0, max_salient_degree: 0.1, max_direction_rad: 0.4, max_ratio: 0.7 }
    }
}

impl AttributeMatching {
    /// Distance of two corners, 0 to 1; `None` where one attribute differs by more than its threshold, or the directions
    /// are of two kinds.
    #[inline]
    pub fn distance(&self, a: &Attributes, b: &Attributes) -> Option<f32> {
        let differences = [
            (f32::from(a.grey.abs_diff(b.grey)), self.max_grey),
            ((a.salient_degree - b.salient_degree).abs(), self.max_salient_degree),
            (a.direction.difference_rad(&b.direction)?, self.max_direction_rad),
        ];
        let mut sum = 0.0;
        for (difference, max) in differences {
            // Written so that NaN fails; with a threshold of 0 nothing but 0 is left, which is no distance.
            if !(difference <= max) {
                return None;
            }
            sum += if difference > 0.0 { (difference / max) * (difference / max) } else { 0.0 };
        }
        Some((sum * (1.0 / 3.0)).sqrt())
    }
}

/// Every corner with every other. Clears `out`.
pub fn match_attributes(first: &[Attributes], second: &[Attributes], rule: &AttributeMatching, out: &mut Vec<Match>) {
    let (mut rows, mut columns) = nothing_seen(first, second);
    for (i, (a, row)) in first.iter().zip(&mut rows).enumerate() {
        for (j, (b, column)) in second.iter().zip(&mut columns).enumerate() {
            offer(rule.distance(a, b), (i, j), row, column);
        }
    }
    finish(&rows, &columns, rule, out);
}

type Seen = Vec<Nearest<f32>>;

fn nothing_seen(first: &[Attributes], second: &[Attributes]) -> (Seen, Seen) {
    let seen = |n| vec![Nearest::none(f32::INFINITY); n];
    (seen(first.len()), seen(second.len()))
}

#[inline(always)]
fn offer(distance: Option<f32>, (i, j): (usize, usize), row: &mut Nearest<f32>, column: &mut Nearest<f32>) {
    if let Some(distance) = distance {
        row.offer(distance, j as u32);
        column.offer(distance, i as u32);
    }
}

fn finish(rows: &[Nearest<f32>], columns: &[Nearest<f32>], rule: &AttributeMatching, out: &mut Vec<Match>) {
    out.clear();
    let clear = |n: &Nearest<f32>| rule.max_ratio >= 1.0 || n.distance < rule.max_ratio * n.second;
    let pairs = nearest::mutual(rows, columns).filter(|(_, row, column)| clear(row) && clear(column));
    out.extend(pairs.map(|(first, row, _)| Match { first, second: row.index, distance: row.distance }));
}

#[cfg(test)]
mod tests;
