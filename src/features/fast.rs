//! FAST-9 corners: the segment test on a ring of 16 pixels, with non-maximum suppression.
//!
//! Purpose: the daemon's default detector. A pixel is a corner at threshold t when nine neighbouring pixels of the ring
//! (radius 3) are all brighter than the centre by more than t, or all darker by more than t.
//! Input: grey picture, a [`CellGrid`] that says where corners are wanted and at which threshold (grey levels).
//! Output: corners at whole level-0 pixels in raster order; response = the largest t at which the pixel still is a
//! corner (grey levels), which does not depend on the threshold asked for.
//! Paper: Rosten, Porter, Drummond, "Faster and better: a machine learning approach to corner detection", PAMI 2010;
//! not its decision tree: with vectors the whole test is cheaper than its branches. Over the arcs A of nine,
//! response + 1 = max(max_A min_A I - c, c - min_A max_A I), from a tree of minima and maxima shared between the arcs.
//! Cost: 0.09 to 0.19 ms for 640x480 with AVX2, by the share of pixels that pass the quick test.
//! It deliberately does not do: sub-pixel positions, scale, a limit on the number of corners.

use super::dispatch::simd_kernel;
use super::{CellGrid, Corner, CornerDetector};
use crate::image::GreyImage;

/// Radius of the ring, pixels; corners are at least this far from the picture's edge.
pub const RING_RADIUS: usize = 3;

/// Pixels scored at a time.
const BLOCK: usize = 32;

/// In a threshold row: no corner wanted here (no difference of bytes is above 255).
const UNWANTED: u8 = 255;

/// Seven rows of a picture, the centre's in the middle, all of one length.
type Rows<'a> = [&'a [u8]; 7];

/// FAST-9/16 with 3x3 non-maximum suppression.
#[derive(Debug, Clone, Default)]
pub struct FastDetector {
    /// Scores of the last three rows, by y modulo 3; 0 = no corner, otherwise response + 1.
    scores: [Vec<u8>; 3],
    /// Which blocks of those rows were scored at all; block k begins at pixel `RING_RADIUS + k * BLOCK`.
    scored: [Vec<bool>; 3],
    /// Threshold of each pixel's own cell, or [`UNWANTED`].
    own: Vec<u8>,
    /// Lowest threshold of the cells whose corners have this pixel as a neighbour.
    halo: Vec<u8>,
}

impl FastDetector {
    pub fn new() -> Self {
        Self::default()
    }

    /// Corners of the whole picture at one threshold, grey levels. Clears `out`.
    pub fn detect_all(&mut self, image: &GreyImage, threshold: u8, out: &mut Vec<Corner>) {
        let side = image.width.max(image.height);
        let cells = CellGrid::new(image.width, image.height, side, f32::from(threshold));
        self.detect(image, &cells, out);
    }

    /// Sets `own` for row `y`.
    fn fill_own(&mut self, cells: &CellGrid, y: usize) {
        let (picture, margin) = self.own.split_at_mut(self.halo.len());
        margin.fill(UNWANTED);
        fill_thresholds(cells, y, picture);
    }

    /// Sets `halo` for row `y`: each wanted cell's threshold, spread by one pixel to every side.
    fn fill_halo(&mut self, cells: &CellGrid, y: usize) {
        let width = self.halo.len();
        self.halo.fill(UNWANTED);
        if cells.cell_px == 0 {
            return;
        }
        let (first, last) = (y.saturating_sub(1) / cells.cell_px, (y + 1) / cells.cell_px);
        for row in first..=last.min(cells.rows.saturating_sub(1)) {
            for column in 0..cells.columns {
                let t = cell_threshold(cells, column, row);
                let begin = (column * cells.cell_px).saturating_sub(1);
                let end = ((column + 1) * cells.cell_px + 1).min(width);
                if t != UNWANTED && begin < end {
                    self.halo[begin..end].iter_mut().for_each(|h| *h = t.min(*h));
                }
            }
        }
    }

    /// Appends the corners of row `y`; scores of rows y - 1 .. y + 1 are in the ring buffer.
    fn suppress_row(&mut self, y: usize, out: &mut Vec<Corner>) {
        let s = &self.scores;
        let [above, row, below] = [&s[(y + 2) % 3], &s[y % 3], &s[(y + 1) % 3]];
        for (block, _) in self.scored[y % 3].iter().enumerate().filter(|(_, scored)| **scored) {
            // The buffers go on for a block past the picture's edge, where nothing is wanted.
            let x = RING_RADIUS + block * BLOCK;
            let mut kept = [0; BLOCK];
            keep_maxima([above, row, below].map(|s| window(s, x - 1)), window(&self.own, x), &mut kept);
            for (chunk, bytes) in kept.chunks_exact(8).enumerate() {
                let mut bits = u64::from_le_bytes(std::array::from_fn(|i| bytes[i]));
                while bits != 0 {
                    let i = bits.trailing_zeros() as usize / 8;
                    bits &= !(0xff << (8 * i));
                    let x = x + 8 * chunk + i;
                    out.push(Corner { x: x as f32, y: y as f32, response: f32::from(row[x] - 1) });
                }
            }
        }
    }
}

impl CornerDetector for FastDetector {
    fn detect(&mut self, image: &GreyImage, cells: &CellGrid, out: &mut Vec<Corner>) {
        out.clear();
        let (width, height) = (image.width, image.height);
        if width <= 2 * RING_RADIUS || height <= 2 * RING_RADIUS {
            return;
        }
        for buffer in self.scores.iter_mut().chain([&mut self.own]) {
            buffer.clear();
            buffer.resize(width + BLOCK, 0);
        }
        self.halo.resize(width, UNWANTED);
        for flags in &mut self.scored {
            flags.clear();
            flags.resize(width / BLOCK + 1, false);
        }
        let last = height - RING_RADIUS;
        // One row past the last that can hold corners: it scores nothing, so that its neighbour above can be finished.
        for y in RING_RADIUS..=last {
            let at = y % 3;
            self.scores[at].fill(0);
            self.scored[at].fill(false);
            if y < last {
                if y == RING_RADIUS || changes_at(cells, y, 1) {
                    self.fill_halo(cells, y);
                }
                let rows: Rows = std::array::from_fn(|i| image.row(y + i - RING_RADIUS));
                score_row(&rows, &self.halo, &mut self.scores[at], &mut self.scored[at]);
            }
            if y > RING_RADIUS {
                if y - 1 == RING_RADIUS || changes_at(cells, y - 1, 0) {
                    self.fill_own(cells, y - 1);
                }
                self.suppress_row(y - 1, out);
            }
        }
    }
}

/// Whether the thresholds of row `y` can differ from those of the row above, cells being spread by `spread` pixels.
fn changes_at(cells: &CellGrid, y: usize, spread: usize) -> bool {
    let side = cells.cell_px.max(1);
    (y.saturating_sub(spread)..=y + spread).any(|row| row % side == 0) || side <= 2
}

/// A cell's threshold as a byte, or [`UNWANTED`]. Differences are whole numbers, so `> t` and `> floor(t)` agree.
fn cell_threshold(cells: &CellGrid, column: usize, row: usize) -> u8 {
    match cells.cells.get(row * cells.columns + column) {
        Some(cell) if cell.wanted && !cell.threshold.is_nan() => cell.threshold.clamp(0.0, 255.0) as u8,
        _ => UNWANTED,
    }
}

/// Writes each pixel's own cell's threshold for row `y`; outside the grid nothing is wanted.
pub(super) fn fill_thresholds(cells: &CellGrid, y: usize, own: &mut [u8]) {
    own.fill(UNWANTED);
    if cells.cell_px == 0 || y / cells.cell_px >= cells.rows {
        return;
    }
    for (column, chunk) in own.chunks_mut(cells.cell_px).enumerate().take(cells.columns) {
        chunk.fill(cell_threshold(cells, column, y / cells.cell_px));
    }
}

simd_kernel! {
    /// Scores the pixels of a row that may be corners above `thresholds`; marks their blocks in `scored`.
    fn score_row(rows: &Rows, thresholds: &[u8], scores: &mut [u8], scored: &mut [bool]) = score_row_body
}

#[inline(always)]
fn score_row_body(rows: &Rows, thresholds: &[u8], scores: &mut [u8], scored: &mut [bool]) {
    let end = thresholds.len() - RING_RADIUS;
    let mut x = RING_RADIUS;
    while x + BLOCK <= end {
        scored[(x - RING_RADIUS) / BLOCK] |= score_block::<BLOCK>(rows, x, thresholds, scores);
        x += BLOCK;
    }
    if x < end && end >= RING_RADIUS + BLOCK {
        // The last block reaches back: scoring a pixel again gives the same.
        scored[(x - RING_RADIUS) / BLOCK] |= score_block::<BLOCK>(rows, end - BLOCK, thresholds, scores);
        x = end;
    }
    while x < end {
        scored[(x - RING_RADIUS) / BLOCK] |= score_block::<1>(rows, x, thresholds, scores);
        x += 1;
    }
}

/// Scores `N` pixels from `x` on when one of them passes the quick test; says whether it did.
#[inline(always)]
fn score_block<const N: usize>(rows: &Rows, x: usize, t: &[u8], scores: &mut [u8]) -> bool {
    // A loop, since `map` on arrays is not inlined here.
    let mut rows = *rows;
    for row in &mut rows {
        *row = &row[x - RING_RADIUS..x + RING_RADIUS + N];
    }
    let at = |dx: usize, dy: usize| window::<N>(rows[dy], dx);
    // Clockwise from above the centre, which is at (3, 3).
    let ring: [&[u8; N]; 16] = [
        at(3, 0),
        at(4, 0),
        at(5, 1),
        at(6, 2),
        at(6, 3),
        at(6, 4),
        at(5, 5),
        at(4, 6),
        at(3, 6),
        at(2, 6),
        at(1, 5),
        at(0, 4),
        at(0, 3),
        at(0, 2),
        at(1, 1),
        at(2, 0),
    ];
    let (centre, t) = (at(3, 3), window::<N>(t, x));
    // An arc of nine holds at least one of every two opposite pixels: four such pairs must agree.
    let mut excess = [0u8; N];
    for i in 0..N {
        let (mut least, mut most) = (255u8, 0u8);
        for k in [0, 2, 4, 6] {
            let (a, b) = (ring[k][i], ring[k + 8][i]);
            least = least.min(a.max(b));
            most = most.max(a.min(b));
        }
        let m = least.saturating_sub(centre[i]).max(centre[i].saturating_sub(most));
        excess[i] = m.saturating_sub(t[i]);
    }
    if excess.iter().fold(0, |a, e| a | e) == 0 {
        return false;
    }
    let Some(scores) = scores[x..].first_chunk_mut::<N>() else { return false };
    for i in 0..N {
        let p: [u8; 16] = std::array::from_fn(|k| ring[k][i]);
        let (bright, dark) = arc_extremes(&p);
        scores[i] = bright.saturating_sub(centre[i]).max(centre[i].saturating_sub(dark));
    }
    true
}

/// (max over the arcs of the arc's minimum, min over the arcs of the arc's maximum), arcs of nine on a ring of 16.
///
/// The arcs that begin at k - 1 and k share the eight pixels k .. k + 7, so they are looked at together (k odd).
#[inline(always)]
fn arc_extremes(p: &[u8; 16]) -> (u8, u8) {
    let odd = |k: usize| 2 * k + 1;
    let at = |k: usize| p[k % 16];
    let low2: [u8; 8] = std::array::from_fn(|k| at(odd(k)).min(at(odd(k) + 1)));
    let high2: [u8; 8] = std::array::from_fn(|k| at(odd(k)).max(at(odd(k) + 1)));
    let low4: [u8; 8] = std::array::from_fn(|k| low2[k].min(low2[(k + 1) % 8]));
    let high4: [u8; 8] = std::array::from_fn(|k| high2[k].max(high2[(k + 1) % 8]));
    let (mut bright, mut dark) = (0u8, 255u8);
    for k in 0..8 {
        let (before, after) = (at(odd(k) + 15), at(odd(k) + 8));
        bright = bright.max(low4[k].min(low4[(k + 2) % 8]).min(before.max(after)));
        dark = dark.min(high4[k].max(high4[(k + 2) % 8]).max(before.min(after)));
    }
    (bright, dark)
}

simd_kernel! {
    /// `kept[i]` is not 0 where the middle row's pixel i + 1 is above its threshold and its eight neighbours.
    /// Of equal neighbours the first in raster order wins.
    fn keep_maxima(rows: [&[u8; BLOCK + 2]; 3], thresholds: &[u8; BLOCK], kept: &mut [u8; BLOCK]) = keep_maxima_body
}

#[inline(always)]
fn keep_maxima_body(rows: [&[u8; BLOCK + 2]; 3], thresholds: &[u8; BLOCK], kept: &mut [u8; BLOCK]) {
    let [a, r, b] = rows;
    for i in 0..BLOCK {
        let before = a[i].max(a[i + 1]).max(a[i + 2]).max(r[i]);
        let after = r[i + 2].max(b[i]).max(b[i + 1]).max(b[i + 2]);
        // s >= after is s > after - 1, and s > 0 follows from s > threshold.
        kept[i] = r[i + 1].saturating_sub(before.max(after.saturating_sub(1)).max(thresholds[i]));
    }
}

/// `N` pixels of a row from `x` on.
#[inline(always)]
fn window<const N: usize>(row: &[u8], x: usize) -> &[u8; N] {
    row[x..].first_chunk().expect("callers stay inside the row")
}

#[cfg(test)]
mod tests;
