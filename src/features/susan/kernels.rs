//! The vector loops of SUSAN: counting similar neighbours, smoothing.
//!
//! Input and output: rows of pixels. Cost: below 0.2 ms a 640x480 picture for the counting (AVX2).
//! They deliberately know no configuration and no cells: per pixel they get a difference and a limit.

use super::usan::MASK_RADIUS;
use crate::features::dispatch::simd_kernel;

/// Pixels counted at a time.
const BLOCK: usize = 32;

simd_kernel! {
    /// `left[x]` is not 0 where at most `limit[x]` (up to 36) of the 36 neighbours differ by at most `difference[x]`.
    pub(in crate::features) fn count_row(rows: &[&[u8]; 7], difference: &[u8], limit: &[u8], left: &mut [u8]) = count_row_body
}

#[inline(always)]
pub(super) fn count_row_body(rows: &[&[u8]; 7], difference: &[u8], limit: &[u8], left: &mut [u8]) {
    let end = limit.len() - MASK_RADIUS;
    let mut x = MASK_RADIUS;
    while x + BLOCK <= end {
        count_block::<BLOCK>(rows, x, difference, limit, left);
        x += BLOCK;
    }
    if x < end && end >= MASK_RADIUS + BLOCK {
        // The last block reaches back: counting a pixel again gives the same.
        count_block::<BLOCK>(rows, end - BLOCK, difference, limit, left);
        x = end;
    }
    while x < end {
        count_block::<1>(rows, x, difference, limit, left);
        x += 1;
    }
}

#[inline(always)]
fn count_block<const N: usize>(rows: &[&[u8]; 7], x: usize, difference: &[u8], limit: &[u8], left: &mut [u8]) {
    let rows = rows.map(|row| &row[x - MASK_RADIUS..x + MASK_RADIUS + N]);
    let (difference, limit) = (window::<N>(difference, x), window::<N>(limit, x));
    let Some(left) = left[x..].first_chunk_mut::<N>() else { return };
    let at = |dx: usize, dy: usize| window::<N>(rows[dy], dx);
    let nucleus = at(3, 3);
    let (mut low, mut high) = ([0; N], [0; N]);
    for i in 0..N {
        low[i] = nucleus[i].saturating_sub(difference[i]);
        high[i] = nucleus[i].saturating_add(difference[i]);
    }
    // 1 where the neighbour lies in the band, that is where clamping does not change it.
    macro_rules! count {
        ($into:ident, $($dx:literal $dy:literal),*) => {
            for i in 0..N {
                let inside = |p: u8| u8::from(p.max(low[i]).min(high[i]) == p);
                $into[i] += 0 $( + inside(at($dx, $dy)[i]))*;
            }
        };
    }
    let mut count = [0u8; N];
    count!(count, 1 1, 2 1, 3 1, 4 1, 5 1, 1 2, 2 2, 3 2, 4 2, 5 2, 1 3, 2 3, 4 3, 5 3,
        1 4, 2 4, 3 4, 4 4, 5 4, 1 5, 2 5, 3 5, 4 5, 5 5);
    // Even areas are done here: the inner square alone has too many.
    let mut room = 0;
    for i in 0..N {
        room |= (limit[i] + 1).saturating_sub(count[i]);
    }
    if room != 0 {
        count!(count, 2 0, 3 0, 4 0, 0 2, 6 2, 0 3, 6 3, 0 4, 6 4, 2 6, 3 6, 4 6);
    }
    for i in 0..N {
        left[i] = (limit[i] + 1).saturating_sub(count[i]);
    }
}

simd_kernel! {
    /// The middle row smoothed by [1 2 1] / 4 both ways; its first and last pixel are copied.
    pub(super) fn smooth_row(above: &[u8], row: &[u8], below: &[u8], to: &mut [u8]) = smooth_row_body
}

#[inline(always)]
pub(super) fn smooth_row_body(above: &[u8], row: &[u8], below: &[u8], to: &mut [u8]) {
    let n = to.len();
    if n < 3 {
        to.copy_from_slice(row);
        return;
    }
    let (above, row, below) = (&above[..n], &row[..n], &below[..n]);
    to[0] = row[0];
    to[n - 1] = row[n - 1];
    let inner = &mut to[1..n - 1];
    for (i, to) in inner.iter_mut().enumerate() {
        let down = |x: usize| u16::from(above[x]) + 2 * u16::from(row[x]) + u16::from(below[x]);
        *to = ((down(i) + 2 * down(i + 1) + down(i + 2) + 8) >> 4) as u8;
    }
}

simd_kernel! {
    /// The middle row's inner values smoothed by [1 2 1] / 4 both ways: `to[i]` belongs to `rows[1][i + 1]`.
    pub(super) fn smooth_strengths(rows: [&[f32]; 3], to: &mut [f32]) = smooth_strengths_body
}

#[inline(always)]
pub(super) fn smooth_strengths_body(rows: [&[f32]; 3], to: &mut [f32]) {
    let n = to.len();
    let [above, row, below] = rows.map(|row| &row[..n + 2]);
    for (i, to) in to.iter_mut().enumerate() {
        let down = |x: usize| above[x] + 2.0 * row[x] + below[x];
        *to = (down(i) + 2.0 * down(i + 1) + down(i + 2)) * (1.0 / 16.0);
    }
}

/// `N` pixels of a row from `x` on.
#[inline(always)]
fn window<const N: usize>(row: &[u8], x: usize) -> &[u8; N] {
    row[x..].first_chunk().expect("callers stay inside the row")
}
