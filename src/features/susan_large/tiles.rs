//! A bound from below on the large mask's USAN area, cheap enough for every pixel.
//!
//! Purpose: to lay the large mask only where it can answer, without missing a pixel where it would.
//! Input: grey picture; per pixel the largest difference that still counts. Output: which pixels of a row may have a
//! small area.
//! Where all of a 4x4 window is between c - d and c + d, its 16 pixels are similar to a nucleus of grey level c. The
//! smallest and largest grey level of the window at every pixel cost a few vector operations; 64 windows lie side by
//! side in the mask (1024 of its 1257 pixels), so 16 times the number of windows within the band is at most the area.
//! Cost: 64 window comparisons a pixel, by vectors. It deliberately knows no thresholds and no corners.

use super::LARGE_RADIUS;
use crate::features::dispatch::simd_kernel;
use crate::image::GreyImage;

/// Side of a window, pixels.
const WINDOW: usize = 4;
/// Its pixels.
pub(super) const WINDOW_AREA: u32 = 16;

/// Windows side by side in the mask.
const WINDOWS: usize = 64;

/// The mask's bands of windows: first column of the first window and number of windows, for rows 4 k to 4 k + 3 from the
/// mask's upper left.
const BANDS: [[usize; 2]; 10] = {
    let mut bands = [[0; 2]; 10];
    let (mut n, mut band) = (0, 0);
    while band < 10 {
        // The row farthest from the nucleus decides how wide the mask is in all of them.
        let (top, bottom) = (WINDOW * band, WINDOW * band + WINDOW - 1);
        let farthest = if top < LARGE_RADIUS { LARGE_RADIUS - top } else { bottom - LARGE_RADIUS };
        let mut half = 0;
        while (half + 1) * (half + 1) + farthest * farthest <= LARGE_RADIUS * LARGE_RADIUS {
            half += 1;
        }
        // Windows begin at multiples of four from the nucleus, so that an edge through it cuts none.
        let left = LARGE_RADIUS - half / WINDOW * WINDOW;
        bands[band] = [left, (LARGE_RADIUS + half + 1 - left) / WINDOW];
        n += bands[band][1];
        band += 1;
    }
    assert!(n == WINDOWS);
    bands
};

/// What a row of blocks reaches over: the widest band and the block.
const REACH: usize = 2 * LARGE_RADIUS + BLOCK;

/// Pixels looked at together.
const BLOCK: usize = 32;

/// Smallest and largest grey level of the window that begins at each pixel.
#[derive(Debug, Clone, Default)]
pub(super) struct Windows {
    width: usize,
    least: Vec<u8>,
    most: Vec<u8>,
    /// One row's extremes across.
    across: [Vec<u8>; 2],
}

impl Windows {
    pub(super) fn fill(&mut self, image: &GreyImage) {
        let (width, n) = (image.width, image.data.len());
        self.width = width;
        for v in [&mut self.least, &mut self.most].into_iter().chain(&mut self.across) {
            v.resize(n, 0);
        }
        let [least_across, most_across] = &mut self.across;
        // A window that leaves the row or the picture is not used: the mask does not reach there.
        extremes(&image.data, 1, least_across, most_across);
        extremes_of(least_across, most_across, width, &mut self.least, &mut self.most);
    }

    /// `left[i]` is not 0 where fewer than `enough[i]` windows of the mask round pixel (x + i, `y`) are within
    /// `difference[i]` of it. `x` and `y` are at least [`LARGE_RADIUS`], and the masks lie in the picture.
    pub(super) fn bound_row(
        &self,
        image: &GreyImage,
        (x, y): (usize, usize),
        difference: &[u8],
        enough: &[u8],
        left: &mut [u8],
    ) {
        let n = left.len();
        let begin = (y - LARGE_RADIUS) * self.width + x - LARGE_RADIUS;
        let nuclei = &image.row(y)[x..x + n];
        let mut at = 0;
        while at < n {
            let m = BLOCK.min(n - at);
            let mut block = ([0; BLOCK], [0; BLOCK], [0; BLOCK], [0; BLOCK]);
            block.0[..m].copy_from_slice(&nuclei[at..at + m]);
            block.1[..m].copy_from_slice(&difference[at..at + m]);
            block.2[..m].copy_from_slice(&enough[at..at + m]);
            // Windows of the pixels past the row's end may lie past the arrays' end: then they are looked at one by one.
            let fits = begin + at + WINDOW * (BANDS.len() - 1) * self.width + REACH <= self.least.len();
            if fits {
                bound_block(&self.least[begin + at..], &self.most[begin + at..], self.width, &mut block);
            } else {
                block.3 = block.2;
            }
            left[at..at + m].copy_from_slice(&block.3[..m]);
            at += m;
        }
    }
}

/// Nuclei, differences, windows that are enough, windows that are missing.
type Block = ([u8; BLOCK], [u8; BLOCK], [u8; BLOCK], [u8; BLOCK]);

simd_kernel! {
    /// Counts the windows of 32 pixels. The arrays begin at the first pixel's mask's upper left.
    fn bound_block(least: &[u8], most: &[u8], stride: usize, block: &mut Block) = bound_block_body
}

#[inline(always)]
fn bound_block_body(least: &[u8], most: &[u8], stride: usize, block: &mut Block) {
    let (nuclei, difference, enough, missing) = block;
    let (mut low, mut high) = ([0; BLOCK], [0; BLOCK]);
    for i in 0..BLOCK {
        low[i] = nuclei[i].saturating_sub(difference[i]);
        high[i] = nuclei[i].saturating_add(difference[i]);
    }
    let mut count = [0u8; BLOCK];
    for (band, [left, windows]) in BANDS.into_iter().enumerate() {
        let at = WINDOW * band * stride;
        // One check a band, so that no window needs its own.
        let (Some(least), Some(most)) = (least[at..].first_chunk::<REACH>(), most[at..].first_chunk::<REACH>()) else {
            return;
        };
        for window in 0..windows {
            let dx = left + WINDOW * window;
            let (least, most) = (&least[dx..dx + BLOCK], &most[dx..dx + BLOCK]);
            for i in 0..BLOCK {
                // Both in the band: neither is changed by the limit it could pass.
                count[i] += u8::from(least[i].max(low[i]) == least[i]) & u8::from(most[i].min(high[i]) == most[i]);
            }
        }
        // Even areas are done after half of the bands.
        let mut missing = 0;
        for i in 0..BLOCK {
            missing |= enough[i].saturating_sub(count[i]);
        }
        if missing == 0 {
            break;
        }
    }
    for i in 0..BLOCK {
        missing[i] = enough[i].saturating_sub(count[i]);
    }
}

simd_kernel! {
    /// Smallest and largest of four values `stride` apart, beginning at each; what would need values past the end is
    /// left as it is.
    fn extremes(values: &[u8], stride: usize, least: &mut [u8], most: &mut [u8]) = extremes_body
}

#[inline(always)]
fn extremes_body(values: &[u8], stride: usize, least: &mut [u8], most: &mut [u8]) {
    extremes_of_body(values, values, stride, least, most);
}

simd_kernel! {
    /// The same of values that are extremes already.
    fn extremes_of(
        smallest: &[u8], largest: &[u8], stride: usize, least: &mut [u8], most: &mut [u8],
    ) = extremes_of_body
}

#[inline(always)]
fn extremes_of_body(smallest: &[u8], largest: &[u8], stride: usize, least: &mut [u8], most: &mut [u8]) {
    let n = smallest.len().saturating_sub((WINDOW - 1) * stride);
    for (values, to, is_least) in [(smallest, least, true), (largest, most, false)] {
        let [a, b, c, d] = [0, 1, 2, 3].map(|k| &values[(k * stride).min(values.len() - n)..][..n]);
        let to = &mut to[..n];
        for i in 0..n {
            to[i] = if is_least { a[i].min(b[i]).min(c[i].min(d[i])) } else { a[i].max(b[i]).max(c[i].max(d[i])) };
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

        #[test]
        fn the_bound_is_the_definition_and_never_above_the_area(
            seed in any::<u64>(), width in 42usize..120, height in 42usize..60, difference in 0u8..90, enough in 0u8..66,
        ) {
            let mut image = GreyImage::new(width, height);
            for (i, p) in image.data.iter_mut().enumerate() {
                let cell = (i % width / 9) as u64 * 7 + (i / width / 9) as u64 * 131 + seed % 1000;
                *p = (cell.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 57) as u8 + (i as u8).wrapping_mul(37) % 8;
            }
            let mut windows = Windows::default();
            windows.fill(&image);
            let n = width - 2 * LARGE_RADIUS;
            for y in LARGE_RADIUS..height - LARGE_RADIUS {
                let mut left = vec![99; n];
                windows.bound_row(&image, (LARGE_RADIUS, y), &vec![difference; n], &vec![enough; n], &mut left);
                for (i, left) in left.iter().enumerate() {
                    let nucleus = image.at(LARGE_RADIUS + i, y);
                    let similar = |px: usize, py: usize| image.at(px, py).abs_diff(nucleus) <= difference;
                    let offsets = BANDS.iter().enumerate().flat_map(|(band, &[left, windows])| {
                        (0..windows).map(move |window| (left + 4 * window, 4 * band))
                    });
                    let within = offsets.filter(|(dx, dy)| {
                        (0..16).all(|k| similar(i + dx + k % 4, y - LARGE_RADIUS + dy + k / 4))
                    }).count() as u8;
                    let area = (0..41 * 41).filter(|k| {
                        let (dx, dy) = ((k % 41) as i32 - 20, (k / 41) as i32 - 20);
                        dx * dx + dy * dy <= 400 && similar(i + k % 41, y - 20 + k / 41)
                    }).count();
                    prop_assert!(usize::from(within) * 16 <= area);
                    // At the picture's very end the bound may be given up, which leaves the pixel.
                    prop_assert!(*left == enough.saturating_sub(within) || *left == enough, "{left} {within} {enough}");
                }
            }
        }

        #[test]
        fn the_wide_kernels_agree_with_their_scalar_twins(
            values in prop::collection::vec(any::<u8>(), 40 * 80), other in prop::collection::vec(any::<u8>(), 40 * 80),
            nuclei in prop::array::uniform32(any::<u8>()), difference in 0u8..80, stride in 1usize..200,
        ) {
            let (mut a, mut b) = ((vec![0; 3200], vec![0; 3200]), (vec![0; 3200], vec![0; 3200]));
            extremes_of(&values, &other, stride, &mut a.0, &mut a.1);
            extremes_of_body(&values, &other, stride, &mut b.0, &mut b.1);
            prop_assert_eq!(&a, &b);
            extremes(&values, stride, &mut a.0, &mut a.1);
            extremes_body(&values, stride, &mut b.0, &mut b.1);
            prop_assert_eq!(&a, &b);
            let mut c: Block = (nuclei, [difference; 32], [60; 32], [0; 32]);
            let mut d = c;
            bound_block(&values, &other, 80, &mut c);
            bound_block_body(&values, &other, 80, &mut d);
            prop_assert_eq!(c, d);
        }
    }
}
