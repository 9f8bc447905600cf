//! Patches of mean 0 and length 1, and their products.
//!
//! Input: grey pictures, patch centres at whole pixels. Output: normalised patches in 16 bits, products in 1 / [`ONE`].
//! A row of a patch is padded with zeros to whole vectors, so that a patch times the pixels of a picture needs no mask.
//! Cost: 13 ns a product of two normalised 15x15 patches, 20 ns with a picture's pixels (AVX2).

use crate::features::dispatch::simd_kernel;
use crate::image::GreyImage;

/// Length of a normalised patch. A pixel's magnitude is below it, and any sum of products below 2^30.
const LENGTH: f32 = 30_000.0;

/// Product of a patch with itself.
pub(super) const ONE: f32 = LENGTH * LENGTH;

/// Pixels a vector.
pub(super) const LANES: usize = 16;

/// Pixels a row of a patch takes.
pub(super) fn padded_side(radius: usize) -> usize {
    (2 * radius + 1).next_multiple_of(LANES)
}

/// Pixels a patch takes.
pub(super) fn padded_area(radius: usize) -> usize {
    (2 * radius + 1) * padded_side(radius)
}

/// Writes the normalised patch round (`x`, `y`) to `to` ([`padded_area`] long). False where it leaves the picture or its
/// standard deviation is below `min_contrast` grey levels; `to` is unspecified then.
pub(super) fn normalise(
    image: &GreyImage,
    (x, y): (usize, usize),
    radius: usize,
    min_contrast: f32,
    to: &mut [i16],
) -> bool {
    if x < radius || y < radius || x + radius >= image.width || y + radius >= image.height {
        return false;
    }
    let side = 2 * radius + 1;
    let rows = || (y - radius..=y + radius).map(|row| &image.row(row)[x - radius..=x + radius]);
    let (mut sum, mut squares) = (0u32, 0u32);
    for row in rows() {
        for &p in row {
            sum += u32::from(p);
            squares += u32::from(p) * u32::from(p);
        }
    }
    let area = (side * side) as f32;
    let Some(scale) = scale_of(sum, squares, area, min_contrast) else { return false };
    let mean = sum as f32 / area;
    for (row, to) in rows().zip(to.chunks_exact_mut(padded_side(radius))) {
        for (p, to) in row.iter().zip(&mut *to) {
            *to = ((f32::from(*p) - mean) * scale * LENGTH).round() as i16;
        }
        to[side..].fill(0);
    }
    true
}

/// 1 / length of a patch less its mean; `None` where it is flat.
#[inline(always)]
fn scale_of(sum: u32, squares: u32, area: f32, min_contrast: f32) -> Option<f32> {
    // Whole numbers below 2^53: exact in f64.
    let energy = (f64::from(squares) - f64::from(sum) * f64::from(sum) / f64::from(area)) as f32;
    (energy > 0.0 && energy >= min_contrast * min_contrast * area).then(|| 1.0 / energy.sqrt())
}

/// Product of two normalised patches.
#[inline(always)]
pub(super) fn product(a: &[i16], b: &[i16]) -> i32 {
    let mut sum = 0;
    for (a, b) in a.chunks_exact(LANES).zip(b.chunks_exact(LANES)) {
        for k in 0..LANES {
            sum += i32::from(a[k]) * i32::from(b[k]);
        }
    }
    sum
}

/// A picture in which a patch is looked for: pixels with room behind them, and sums for the mean and length of any patch.
#[derive(Debug, Clone, Default)]
pub(super) struct Ground {
    pub width: usize,
    pub height: usize,
    /// The picture, then zeros for the last vector.
    pixels: Vec<u8>,
    /// Sums of all pixels above and left, (width + 1) x (height + 1), modulo 2^32: a patch's own sum is below that.
    sums: Vec<u32>,
    squares: Vec<u32>,
}

impl Ground {
    pub fn fill(&mut self, image: &GreyImage) {
        (self.width, self.height) = (image.width, image.height);
        self.pixels.clear();
        self.pixels.extend_from_slice(&image.data);
        self.pixels.resize(image.data.len() + 2 * LANES, 0);
        let stride = image.width + 1;
        for sums in [&mut self.sums, &mut self.squares] {
            sums.clear();
            sums.resize(stride * (image.height + 1), 0);
        }
        for y in 0..image.height {
            let (mut sum, mut squares) = (0u32, 0u32);
            for (x, &p) in image.row(y).iter().enumerate() {
                sum = sum.wrapping_add(u32::from(p));
                squares = squares.wrapping_add(u32::from(p) * u32::from(p));
                let at = (y + 1) * stride + x + 1;
                self.sums[at] = self.sums[at - stride].wrapping_add(sum);
                self.squares[at] = self.squares[at - stride].wrapping_add(squares);
            }
        }
    }

    /// Whether the patch round (`x`, `y`) lies in the picture.
    pub fn holds(&self, x: i32, y: i32, radius: usize) -> bool {
        let inside = |v: i32, size: usize| v >= radius as i32 && v < size as i32 - radius as i32;
        inside(x, self.width) && inside(y, self.height)
    }

    /// Mean and 1 / length of the patch round a pixel; `None` where it is flat.
    #[inline(always)]
    fn statistics(&self, (x, y): (usize, usize), radius: usize, min_contrast: f32) -> Option<(f32, f32)> {
        let stride = self.width + 1;
        let (top, bottom) = ((y - radius) * stride, (y + radius + 1) * stride);
        let (left, right) = (x - radius, x + radius + 1);
        let of = |sums: &[u32]| {
            sums[bottom + right]
                .wrapping_sub(sums[bottom + left])
                .wrapping_sub(sums[top + right])
                .wrapping_add(sums[top + left])
        };
        let area = ((2 * radius + 1) * (2 * radius + 1)) as f32;
        let sum = of(&self.sums);
        Some((sum as f32 / area, scale_of(sum, of(&self.squares), area, min_contrast)?))
    }
}

simd_kernel! {
    /// NCC of `template` with the patches round `places`; -1 where they are flat. All lie in the picture
    /// ([`Ground::holds`]). `ncc` is as long as `places`.
    pub(super) fn correlate(
        template: &[i16], radius: usize, min_contrast: f32, ground: &Ground, places: &[[u32; 2]], ncc: &mut [f32],
    ) = correlate_body
}

#[inline(always)]
pub(super) fn correlate_body(
    template: &[i16],
    radius: usize,
    min_contrast: f32,
    ground: &Ground,
    places: &[[u32; 2]],
    ncc: &mut [f32],
) {
    // Rounding leaves a sum that is not quite zero, which the mean would multiply.
    let rest: i32 = template.iter().map(|&t| i32::from(t)).sum();
    let vectors = padded_side(radius) / LANES;
    for ([x, y], ncc) in places.iter().zip(ncc) {
        let (x, y) = (*x as usize, *y as usize);
        let Some((mean, scale)) = ground.statistics((x, y), radius, min_contrast) else {
            *ncc = -1.0;
            continue;
        };
        let mut at = (y - radius) * ground.width + x - radius;
        let mut sum = 0;
        for row in template.chunks_exact(vectors * LANES) {
            for (v, t) in row.chunks_exact(LANES).enumerate() {
                let Some(pixels) = ground.pixels[at + v * LANES..].first_chunk::<LANES>() else { break };
                for k in 0..LANES {
                    sum += i32::from(t[k]) * i32::from(pixels[k]);
                }
            }
            at += ground.width;
        }
        *ncc = (sum as f32 - rest as f32 * mean) * scale * (1.0 / LENGTH);
    }
}
