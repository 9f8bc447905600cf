//! Which corner of one picture is which of another, by binary descriptors.
//!
//! Input: descriptors of both pictures. Output: pairs of indices with their Hamming distance (bits), ascending in the first index.
//! A pair is kept when each is the other's nearest (mutual), the distance is small enough, and the second nearest is
//! clearly farther (Lowe's ratio, IJCV 2004). Of equally near ones the first counts as nearest and fails any ratio below 1.
//! Cost: 1.5 ns a comparison (AVX2), both directions in one sweep; brute force is n m comparisons, no index is kept.
//! It deliberately does not do: geometry (see `geometry::ransac`), a search structure for thousands of pictures.

use super::Match;
use super::nearest::{self, Nearest};
use crate::features::descriptor::Descriptor;
use crate::features::dispatch::simd_kernel;

/// When two descriptors belong together.
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct DescriptorMatching {
    /// Largest distance, bits of 256.
    pub max_distance: u32,
    /// The nearest must be nearer than this share of the second nearest's distance, in both directions; 1 = any.
    pub max_ratio: f32,
}

impl Default for DescriptorMatching {
    fn default() -> Self {
        Self { max_distance: 64, max_ratio: 0.8 }
    }
}

/// Matches descriptors; keeps its scratch between calls.
#[derive(Debug, Clone, Default)]
pub struct DescriptorMatcher {
    rows: Vec<Nearest<u16>>,
    columns: Vec<Nearest<u16>>,
}

impl DescriptorMatcher {
    /// Every descriptor with every other. Clears `out`.
    pub fn match_all(
        &mut self,
        first: &[Descriptor],
        second: &[Descriptor],
        rule: &DescriptorMatching,
        out: &mut Vec<Match>,
    ) {
        self.start(first.len(), second.len());
        nearest_of_all(first, second, &mut self.rows, &mut self.columns);
        self.finish(rule, out);
    }

    fn start(&mut self, first: usize, second: usize) {
        nearest::start(&mut self.rows, first, u16::MAX);
        nearest::start(&mut self.columns, second, u16::MAX);
    }

    fn finish(&self, rule: &DescriptorMatching, out: &mut Vec<Match>) {
        out.clear();
        // Nothing is nearer than itself by a ratio of 1: then the ratio is not asked at all.
        let clear = |n: &Nearest<u16>| {
            rule.max_ratio >= 1.0
                || n.second == u16::MAX
                || f32::from(n.distance) < rule.max_ratio * f32::from(n.second)
        };
        for (first, row, column) in nearest::mutual(&self.rows, &self.columns) {
            if u32::from(row.distance) <= rule.max_distance && clear(row) && clear(column) {
                out.push(Match { first, second: row.index, distance: f32::from(row.distance) });
            }
        }
    }
}

simd_kernel! {
    /// Indices of those of `all` that differ from `one` by at most `max_bits`, ascending. Clears `out`.
    pub fn all_within(one: &Descriptor, all: &[Descriptor], max_bits: u32, out: &mut Vec<u32>) = all_within_body
}

#[inline(always)]
fn all_within_body(one: &Descriptor, all: &[Descriptor], max_bits: u32, out: &mut Vec<u32>) {
    out.clear();
    for (i, other) in all.iter().enumerate() {
        if one.distance(other) <= max_bits {
            out.push(i as u32);
        }
    }
}

simd_kernel! {
    /// The nearest two of each descriptor, in both directions.
    fn nearest_of_all(
        first: &[Descriptor], second: &[Descriptor], rows: &mut [Nearest<u16>], columns: &mut [Nearest<u16>],
    ) = nearest_of_all_body
}

#[inline(always)]
fn nearest_of_all_body(
    first: &[Descriptor],
    second: &[Descriptor],
    rows: &mut [Nearest<u16>],
    columns: &mut [Nearest<u16>],
) {
    for (i, (a, row)) in first.iter().zip(rows).enumerate() {
        for (j, (b, column)) in second.iter().zip(columns.iter_mut()).enumerate() {
            let distance = a.distance(b) as u16;
            row.offer(distance, j as u32);
            column.offer(distance, i as u32);
        }
    }
}

#[cfg(test)]
mod tests;
