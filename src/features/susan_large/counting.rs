//! The large mask, and counting its similar pixels round one pixel.
//!
//! Input: grey picture, pixel, largest difference that still counts. Output: pixels of the mask (the nucleus too) that differ
//! from the nucleus by no more. The mask lies in the picture.
//! Cost: about 1200 instructions, 0.06 us (AVX2).
//! It deliberately knows no thresholds and no corners.

use crate::features::dispatch::simd_kernel;
use crate::image::GreyImage;

/// Radius of the large mask, pixels; corners are at least this far from the picture's edge.
pub const LARGE_RADIUS: usize = 20;

/// Pixels of the large mask, the nucleus with them.
pub const LARGE_AREA: u32 = 1257;

/// Rows and columns of the large mask.
pub(super) const SIDE: usize = 2 * LARGE_RADIUS + 1;

/// Half the width of the large mask's rows, top to bottom.
pub(super) const HALF_WIDTHS: [usize; SIDE] = {
    let mut half = [0; SIDE];
    let mut row = 0;
    while row < SIDE {
        let dy = row.abs_diff(LARGE_RADIUS);
        while (half[row] + 1) * (half[row] + 1) + dy * dy <= LARGE_RADIUS * LARGE_RADIUS {
            half[row] += 1;
        }
        row += 1;
    }
    half
};

/// A row of the mask in whole vectors.
pub(super) const LANES: usize = 48;

/// 1 inside the mask, by row and lane.
pub(super) const INSIDE: [[u8; LANES]; SIDE] = {
    let mut inside = [[0; LANES]; SIDE];
    let mut row = 0;
    while row < SIDE {
        let mut lane = LARGE_RADIUS - HALF_WIDTHS[row];
        while lane <= LARGE_RADIUS + HALF_WIDTHS[row] {
            inside[row][lane] = 1;
            lane += 1;
        }
        row += 1;
    }
    inside
};

/// See the module.
pub(super) fn count_similar(image: &GreyImage, (x, y): (usize, usize), difference: u8) -> u32 {
    let begin = (y - LARGE_RADIUS) * image.width + x - LARGE_RADIUS;
    // The vectors reach a few pixels beyond the mask: at the end of the picture's last row there are none.
    let end = begin + (SIDE - 1) * image.width + LANES;
    match image.data.get(begin..end) {
        Some(pixels) => count_in_vectors(pixels, image.width, difference),
        None => {
            let nucleus = image.at(x, y);
            let row = |r: usize| &image.row(y + r - LARGE_RADIUS)[x - HALF_WIDTHS[r]..=x + HALF_WIDTHS[r]];
            (0..SIDE).map(|r| row(r).iter().filter(|p| p.abs_diff(nucleus) <= difference).count() as u32).sum()
        }
    }
}

simd_kernel! {
    /// As [`count_similar`]; `pixels` begins at the mask's upper left, rows are `stride` apart.
    pub(super) fn count_in_vectors(pixels: &[u8], stride: usize, difference: u8) -> u32 = count_in_vectors_body
}

#[inline(always)]
pub(super) fn count_in_vectors_body(pixels: &[u8], stride: usize, difference: u8) -> u32 {
    let nucleus = pixels[LARGE_RADIUS * stride + LARGE_RADIUS];
    let (low, high) = (nucleus.saturating_sub(difference), nucleus.saturating_add(difference));
    // 41 rows: a byte a lane is enough.
    let mut count = [0u8; LANES];
    for (r, inside) in INSIDE.iter().enumerate() {
        let Some(row) = pixels[r * stride..].first_chunk::<LANES>() else { return 0 };
        for i in 0..LANES {
            count[i] += u8::from(row[i].max(low).min(high) == row[i]) & inside[i];
        }
    }
    count.iter().map(|&c| u32::from(c)).sum()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

        #[test]
        fn counts_are_the_definition_and_the_wide_kernel_agrees(
            data in prop::collection::vec(0u8..60, 50 * 44), difference in any::<u8>(), x in 20usize..30, y in 20usize..24,
        ) {
            let image = GreyImage { width: 50, height: 44, data };
            let nucleus = image.at(x, y);
            let mut plain = 0;
            for dy in -20..=20i32 {
                for dx in -20..=20i32 {
                    let p = image.at((x as i32 + dx) as usize, (y as i32 + dy) as usize);
                    plain += u32::from(dx * dx + dy * dy <= 400 && p.abs_diff(nucleus) <= difference);
                }
            }
            prop_assert_eq!(count_similar(&image, (x, y), difference), plain);
            if let Some(pixels) = image.data.get((y - 20) * 50 + x - 20..).filter(|p| p.len() >= 40 * 50 + LANES) {
                let twin = count_in_vectors_body(pixels, 50, difference);
                prop_assert_eq!(count_in_vectors(pixels, 50, difference), twin);
            }
        }
    }
}
