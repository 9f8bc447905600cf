//! The second pass of the bounded scheme: the large mask is laid only where it can still decide something.
//!
//! Purpose: the single pass's corners without measuring every pixel that the first pass leaves. Most of those lie beside
//! a corner or along an edge that leads to one, and are beaten by it whatever their own area is.
//! Input: a bound from below on the area of every pixel. Output: indices of the pixels whose area is below g and the
//! smallest within the suppression radius, of equals the first: exactly those, whatever the order of measuring.
//! Method: the most promising first (ascending bound). A pixel is not measured where a neighbour's measured area is below
//! its bound already: it cannot be the smallest. A pixel that is the smallest of what was measured is a corner only once
//! those skipped neighbours are measured too whose bound leaves them a chance.
//! Cost: a pixel measured is also written to the smallest areas of its neighbourhood, a few vector operations a row.

use super::{LARGE, LargeSusanDetector, UNKNOWN};
use crate::features::dispatch::simd_kernel;
use crate::image::GreyImage;

/// Bounds are sorted by this many of their leading bits.
const KEY_BITS: u32 = 8;

impl LargeSusanDetector {
    /// Sets `found` from `starts`, in raster order.
    pub(super) fn lowest_by_bounds(&mut self, image: &GreyImage) {
        self.order_starts();
        self.low.clear();
        self.low.resize(image.data.len(), LARGE);
        let (width, r) = (image.width, self.config.suppression_px);
        for k in 0..self.order.len() {
            let at = self.order[k] as usize;
            if self.low[at] < self.bounds[at] {
                continue;
            }
            let area = self.area(image, at);
            if area < LARGE {
                // Starts are at least LARGE_RADIUS > r pixels from the picture's edge.
                lower(&mut self.low[at - r * width - r..], width, 2 * r + 1, area);
            }
        }
        for k in 0..self.starts.len() {
            let at = self.starts[k] as usize;
            if self.areas[at] < LARGE
                && self.areas[at] == self.low[at]
                && self.is_lowest(width, at)
                && self.beats_unmeasured(image, at)
            {
                self.found.push(at as u32);
            }
        }
    }

    /// Sets `order` to `starts` by ascending bound (its leading bits), of equals the first in raster order.
    fn order_starts(&mut self) {
        let key = |at: u32| usize::from(self.bounds[at as usize] >> (u16::BITS - KEY_BITS));
        let mut begins = [0; (1 << KEY_BITS) + 1];
        for &at in &self.starts {
            begins[key(at) + 1] += 1;
        }
        for k in 0..1 << KEY_BITS {
            begins[k + 1] += begins[k];
        }
        self.order.clear();
        self.order.resize(self.starts.len(), 0);
        for &at in &self.starts {
            let place = &mut begins[key(at)];
            self.order[*place] = at;
            *place += 1;
        }
    }

    /// Whether `at`, the lowest of what is measured, stays so when the neighbours that could be lower are measured.
    fn beats_unmeasured(&mut self, image: &GreyImage, at: usize) -> bool {
        let (width, r, area) = (image.width, self.config.suppression_px, self.areas[at]);
        let first = at - r * width - r;
        for row in 0..=2 * r {
            for i in first + row * width..=first + row * width + 2 * r {
                // Pixels outside the wanted cells have no bound, so they are measured here.
                if self.areas[i] == UNKNOWN && self.bounds[i] <= area && (self.area(image, i), i) < (area, at) {
                    return false;
                }
            }
        }
        true
    }
}

simd_kernel! {
    /// Lowers a square of `side` x `side` areas to `area` where they are above it; rows are `stride` apart.
    fn lower(low: &mut [u16], stride: usize, side: usize, area: u16) = lower_body
}

#[inline(always)]
fn lower_body(low: &mut [u16], stride: usize, side: usize, area: u16) {
    for row in low.chunks_mut(stride).take(side) {
        for low in &mut row[..side] {
            *low = area.min(*low);
        }
    }
}

simd_kernel! {
    /// Sets the bounds to what the windows found add to the area at least (`window` each), and the areas to [`LARGE`] where
    /// no window is missing, to [`UNKNOWN`] elsewhere.
    pub(super) fn record_bounds(
        left: &[u8], limit: &[u8], window: u16, areas: &mut [u16], bounds: &mut [u16],
    ) = record_bounds_body
}

const _: () = assert!(LARGE == UNKNOWN - 1);

#[inline(always)]
fn record_bounds_body(left: &[u8], limit: &[u8], window: u16, areas: &mut [u16], bounds: &mut [u16]) {
    let n = left.len();
    let (limit, areas, bounds) = (&limit[..n], &mut areas[..n], &mut bounds[..n]);
    for i in 0..n {
        // A limit of 0: no corner is wanted here, and the pixel may still be asked for as a neighbour.
        areas[i] = UNKNOWN - u16::from(u8::from(left[i] == 0) & u8::from(limit[i] != 0));
        bounds[i] = u16::from(limit[i] - left[i]) * window;
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]

        #[test]
        fn the_wide_kernels_agree_with_their_scalar_twins(
            values in prop::collection::vec(any::<u16>(), 50 * 44), area in any::<u16>(), side in 1usize..20,
            windows in prop::collection::vec((0u8..64, 0u8..64), 60),
        ) {
            let (mut a, mut b) = (values.clone(), values.clone());
            lower(&mut a, 50, side, area);
            lower_body(&mut b, 50, side, area);
            prop_assert_eq!(&a, &b);
            let limit: Vec<u8> = windows.iter().map(|w| w.0.max(w.1)).collect();
            let left: Vec<u8> = windows.iter().map(|w| w.0.min(w.1)).collect();
            let (mut c, mut d) = (values.clone(), values);
            record_bounds(&left, &limit, 512, &mut a, &mut c);
            record_bounds_body(&left, &limit, 512, &mut b, &mut d);
            prop_assert_eq!((a, c), (b, d));
        }
    }
}
