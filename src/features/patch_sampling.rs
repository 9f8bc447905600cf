//! Sub-pixel samples of a picture by cubic B-splines.
//!
//! In: a grey picture, positions in its pixels. Out: samples in fixed point, (grey - 128) * 128, or grey values.
//!
//! A sample is the sum of 4 x 4 pixels weighted by the cubic B-spline (Unser, Splines: A Perfect Fit, IEEE Signal
//! Processing Magazine 1999) **without** the usual prefilter, that is of a slightly blurred picture. The blur (variance
//! 1/3 px²) is the same wherever between the pixels the sample lies. That of bilinear interpolation, f (1 - f), is not, and
//! it pulls an alignment towards positions where template and picture are blurred alike: with 8 x 8 patches the
//! median error without noise was 0.024 to 0.040 px by bilinear and 0.006 px by this; with noise 0.060 and 0.054.
//!
//! Cost: 8 x 8 samples one pixel apart about 0.04 us at 2.6 GHz with SSE2 only. 16-bit integers, eight lanes at a
//! time through `wide`, which has a scalar form of every operation: results are the same on every machine.
//!
//! Does not: extrapolate. A sample whose 4 x 4 pixels are not all in the picture does not exist.

use nalgebra::{Matrix2, Vector2};
use wide::{i16x8, u8x16};

use super::dispatch::simd_kernel;
use crate::image::{Crop, GreyImage};

/// A sample is (grey value - `OFFSET`) * `SCALE`.
pub const OFFSET: f32 = 128.0;
pub const SCALE: f32 = 128.0;
/// No sample's magnitude exceeds this: 128 * 128, and 4 for rounding down four times.
pub const MAX_SAMPLE: i32 = 16_388;

/// Cubic B-spline weights of the pixels at -1, 0, 1 and 2 for a position `t` in [0, 1).
#[inline(always)]
pub const fn spline_weights(t: f32) -> [f32; 4] {
    let s = 1.0 - t;
    let (w0, w3) = (s * s * s * (1.0 / 6.0), t * t * t * (1.0 / 6.0));
    let w1 = 2.0 / 3.0 - t * t * (1.0 - 0.5 * t);
    [w0, w1, 1.0 - w0 - w1 - w3, w3]
}

/// Steps a pixel that a [`Window`] can be placed at.
const PHASES: usize = 256;

/// Weights of each phase, times 256 (across) and times 32768 (down): whole numbers whose sum is exactly that.
static WEIGHTS: [[[i16; 4]; 2]; PHASES] = {
    let mut table = [[[0; 4]; 2]; PHASES];
    let mut phase = 0;
    while phase < PHASES {
        let w = spline_weights(phase as f32 / PHASES as f32);
        let mut k = 0;
        while k < 2 {
            let one = if k == 0 { 256 } else { 32768 };
            let w0 = (w[0] * one as f32 + 0.5) as i32;
            let w1 = (w[1] * one as f32 + 0.5) as i32;
            let w3 = (w[3] * one as f32 + 0.5) as i32;
            table[phase][k] = [w0 as i16, w1 as i16, (one - w0 - w1 - w3) as i16, w3 as i16];
            k += 1;
        }
        phase += 1;
    }
    table
};

/// A rectangle of samples one pixel apart: all share the same weights.
pub struct Window<'a> {
    /// From the first pixel needed on: one before and one above the first sample.
    data: &'a [u8],
    stride: usize,
    across: [i16; 4],
    down: [i16; 4],
    /// Where the first sample really lies: the place asked for to the nearest 1 / 256 px.
    pub first: Vector2<f32>,
}

impl<'a> Window<'a> {
    /// `side` samples each way, the first at `first` (pixels of `image`); `None` outside, and for NaN.
    #[inline(always)]
    pub fn new(image: &'a GreyImage, first: Vector2<f32>, side: usize) -> Option<Self> {
        // Pictures are far smaller than 2^23 / 256 pixels; beyond that, and for NaN, the conversion saturates or gives zero.
        let steps = first.map(|v| (v * PHASES as f32 + 0.5) as i32);
        let (x, y) = (steps.x >> 8, steps.y >> 8);
        let reach = side as i32 + 1;
        if x < 1 || y < 1 || x + reach >= image.width as i32 || y + reach >= image.height as i32 {
            return None;
        }
        let stride = image.width;
        let data = image.data.get((y as usize - 1) * stride + x as usize - 1..)?;
        // One check for the whole rectangle, so that no access to its rows can fail.
        let data = data.get(..(side + 2) * stride + side + 3)?;
        let [across, _] = WEIGHTS[(steps.x & 255) as usize];
        let [_, down] = WEIGHTS[(steps.y & 255) as usize];
        Some(Self { data, stride, across, down, first: steps.map(|v| v as f32 * (1.0 / PHASES as f32)) })
    }

    /// Hands the samples of eight columns from `column` on to `sink(row, samples)`, `rows` times.
    #[inline(always)]
    pub fn strip(&self, column: usize, rows: usize, mut sink: impl FnMut(usize, i16x8)) {
        let across = self.across.map(i16x8::splat);
        let down = self.down.map(i16x8::splat);
        let mut pixels = &self.data[column..];
        let mut next = || {
            let sum = row_across(pixels, &across);
            pixels = pixels.get(self.stride..).unwrap_or_default();
            sum
        };
        let mut last = [next(), next(), next()];
        for row in 0..rows {
            let new = next();
            let sum = (last[0].mul_keep_high(down[0]) + last[1].mul_keep_high(down[1]))
                + (last[2].mul_keep_high(down[2]) + new.mul_keep_high(down[3]));
            sink(row, sum);
            last = [last[1], last[2], new];
        }
    }
}

/// Eight samples across one row of pixels: (grey - 128) * 256. The sum of unsigned products reaches 65,280: it wraps
/// in 16 bits, and the subtraction of 128 * 256 brings it back into range.
#[inline(always)]
fn row_across(pixels: &[u8], weights: &[i16x8; 4]) -> i16x8 {
    let pixels = &pixels[..11];
    let tap = |k: usize| {
        let mut eight = [0; 16];
        eight[..8].copy_from_slice(&pixels[k..k + 8]);
        i16x8::from_u8x16_low(u8x16::new(eight)) * weights[k]
    };
    ((tap(0) + tap(1)) + (tap(2) + tap(3))) + i16x8::splat(i16::MIN)
}

/// Side of a warped patch: an 8 x 8 template with its border.
const SIDE: usize = 10;
const AREA: usize = SIDE * SIDE;
/// Samples, and as many more as fill the vectors.
const PADDED: usize = AREA.next_multiple_of(8);

/// Column and row of each sample.
static STEPS: [[f32; PADDED]; 2] = {
    let mut steps = [[0.0; PADDED]; 2];
    let mut k = 0;
    while k < AREA {
        (steps[0][k], steps[1][k]) = ((k % SIDE) as f32, (k / SIDE) as f32);
        k += 1;
    }
    steps
};

/// Fills `out` (10 x 10, row by row: the pixels of an 8 x 8 template with its border) with `source` (a picture, or what is left of it)
/// seen through an affine map: pixel (i, j) is the grey value of `source` at `center + source_from_patch * (i - 4.5, j - 4.5)`.
/// False, with `out` unspecified, when a sample lies outside `source` or the map is not finite.
pub fn warp_patch(
    source: &Crop<'_>,
    center: Vector2<f32>,
    source_from_patch: &Matrix2<f32>,
    out: &mut [f32; AREA],
) -> bool {
    let radius = (SIDE as f32 - 1.0) / 2.0;
    let m = source_from_patch;
    let reach = Vector2::new(m.m11.abs() + m.m12.abs(), m.m21.abs() + m.m22.abs()) * radius;
    let (low, high) = (center - reach, center + reach);
    let (right_end, bottom_end) = (source.left + source.width, source.top + source.height);
    let inside = low.x >= source.left as f32 + 1.0
        && low.y >= source.top as f32 + 1.0
        && high.x < right_end as f32 - 2.0
        && high.y < bottom_end as f32 - 2.0
        && source.data.len() >= source.width * source.height;
    let (right, down) = (Vector2::new(m.m11, m.m21), Vector2::new(m.m12, m.m22));
    inside && warp_inside(source, center - (right + down) * radius, right, down, out)
}

simd_kernel! {
    /// [`warp_patch`] from its first sample on, one column being `right` and one row `down`.
    fn warp_inside(
        source: &Crop<'_>, first: Vector2<f32>, right: Vector2<f32>, down: Vector2<f32>, out: &mut [f32; AREA],
    ) -> bool = warp_inside_body
}

/// In three passes, so that all but the second go eight samples at a time: weights; the 4 x 4 pixels of each sample, a row of four in one
/// word; their sum.
#[inline(always)]
fn warp_inside_body(
    source: &Crop<'_>,
    first: Vector2<f32>,
    right: Vector2<f32>,
    down: Vector2<f32>,
    out: &mut [f32; AREA],
) -> bool {
    let width = source.width;
    let [columns, rows] = &STEPS;
    let mut begin = [0i32; PADDED];
    let (mut across, mut along) = ([[0.0f32; PADDED]; 4], [[0.0f32; PADDED]; 4]);
    // Rounding may put a sample a hair outside what was checked.
    let lowest = Vector2::new(source.left as f32 + 1.0, source.top as f32 + 1.0);
    let highest = lowest + Vector2::new(width as f32 - 4.0, source.height as f32 - 4.0);
    for k in 0..PADDED {
        let x = (first.x + down.x * rows[k]) + right.x * columns[k];
        let y = (first.y + down.y * rows[k]) + right.y * columns[k];
        let whole_x = floor(x).max(lowest.x).min(highest.x);
        let whole_y = floor(y).max(lowest.y).min(highest.y);
        begin[k] = to_i32(whole_y - lowest.y) * width as i32 + to_i32(whole_x - lowest.x);
        let (wx, wy) = (spline_weights(x - whole_x), spline_weights(y - whole_y));
        for t in 0..4 {
            (across[t][k], along[t][k]) = (wx[t], wy[t]);
        }
    }
    let mut taps = [[0u32; PADDED]; 4];
    for k in 0..AREA {
        let begin = begin[k] as usize;
        let Some(pixels) = source.data.get(begin..begin + 3 * width + 4) else { return false };
        for (r, taps) in taps.iter_mut().enumerate() {
            let four = &pixels[r * width..][..4];
            taps[k] = u32::from_le_bytes([four[0], four[1], four[2], four[3]]);
        }
    }
    for k in 0..AREA {
        let mut sums = [0.0f32; 4];
        for (taps, weights) in taps.iter().zip(&along) {
            for (c, sum) in sums.iter_mut().enumerate() {
                *sum += weights[k] * (taps[k] >> (8 * c) & 255) as i32 as f32;
            }
        }
        out[k] = (across[0][k] * sums[0] + across[1][k] * sums[1]) + (across[2][k] * sums[2] + across[3][k] * sums[3]);
    }
    true
}

/// 2^23: from here on floats are whole numbers.
const WHOLE: f32 = 8_388_608.0;

/// A whole number below 2^22; a conversion by `as` saturates and does not become a vector.
#[inline(always)]
fn to_i32(v: f32) -> i32 {
    (v + WHOLE).to_bits() as i32 - WHOLE.to_bits() as i32
}

/// Largest whole number that is not above `v`, for 0 <= v < 2^22.
#[inline(always)]
fn floor(v: f32) -> f32 {
    let nearest = (v + WHOLE) - WHOLE;
    if nearest > v { nearest - 1.0 } else { nearest }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(width: usize, height: usize, mut seed: u32) -> GreyImage {
        let mut image = GreyImage::new(width, height);
        for v in &mut image.data {
            seed = seed.wrapping_mul(1664525).wrapping_add(1013904223);
            *v = (seed >> 24) as u8;
        }
        image
    }

    /// The defining sum in f64.
    fn reference(image: &GreyImage, p: Vector2<f64>) -> f64 {
        let spline = |t: f64| match t.abs() {
            t if t < 1.0 => 2.0 / 3.0 - t * t + 0.5 * t * t * t,
            t if t < 2.0 => (2.0 - t).powi(3) / 6.0,
            _ => 0.0,
        };
        let mut sum = 0.0;
        for y in 0..image.height {
            for x in 0..image.width {
                sum += spline(p.x - x as f64) * spline(p.y - y as f64) * f64::from(image.at(x, y));
            }
        }
        sum
    }

    #[test]
    fn integer_samples_equal_the_spline_sum() {
        for (seed, image) in [(1, noise(24, 22, 1)), (2, GreyImage { data: vec![255; 24 * 22], ..noise(24, 22, 2) })] {
            for (fx, fy) in [(0.0, 0.0), (0.5, 0.5), (0.13, 0.97), (0.999, 0.31)] {
                let asked = Vector2::new(3.0 + fx, 4.0 + fy);
                let window = Window::new(&image, asked, 8).unwrap();
                let first = window.first;
                assert!((first - asked).amax() <= 0.5 / 256.0);
                window.strip(0, 8, |j, samples| {
                    for (i, v) in samples.to_array().into_iter().enumerate() {
                        let p = first + Vector2::new(i as f32, j as f32);
                        let grey = f64::from(f32::from(v) / SCALE + OFFSET);
                        let error = (grey - reference(&image, p.cast())).abs();
                        // Weights across are whole multiples of 1 / 256, so off by up to 1 / 512 each.
                        assert!(error < 1.0, "seed {seed}: {error} at {p}");
                        assert!(i32::from(v).abs() <= MAX_SAMPLE);
                    }
                });
            }
        }
    }

    #[test]
    fn warped_patch_equals_the_spline_sum_through_the_map() {
        let image = noise(40, 40, 3);
        let m = Matrix2::new(0.9, 0.3, -0.25, 1.2);
        let center = Vector2::new(20.3, 19.1);
        let mut out = [0.0; 100];
        assert!(warp_patch(&image.whole(), center, &m, &mut out));
        for j in 0..10 {
            for i in 0..10 {
                let p = center + m * Vector2::new(i as f32 - 4.5, j as f32 - 4.5);
                let error = (f64::from(out[j * 10 + i]) - reference(&image, p.cast())).abs();
                assert!(error < 1e-2, "{error} at {i}, {j}");
            }
        }
    }

    #[test]
    fn both_machine_codes_warp_alike() {
        let image = noise(40, 40, 5);
        let (first, right, down) = (Vector2::new(9.3, 8.2), Vector2::new(1.3, -0.4), Vector2::new(0.6, 0.9));
        let (mut one, mut other) = ([0.0; AREA], [0.0; AREA]);
        assert!(warp_inside(&image.whole(), first, right, down, &mut one));
        assert!(warp_inside_body(&image.whole(), first, right, down, &mut other));
        assert_eq!(one, other);
    }

    #[test]
    fn nothing_outside_the_picture_is_sampled() {
        let image = noise(30, 20, 4);
        let mut out = [0.0; 100];
        for (x, y, inside) in [
            (5.5, 5.5, true),
            (5.4, 9.0, false),
            (9.0, 5.4, false),
            (23.4, 13.4, true),
            (23.6, 9.0, false),
            (9.0, 13.6, false),
            (f32::NAN, 9.0, false),
            (9.0, f32::INFINITY, false),
            (-1e30, 9.0, false),
        ] {
            let center = Vector2::new(x, y);
            assert_eq!(warp_patch(&image.whole(), center, &Matrix2::identity(), &mut out), inside, "{center}");
            assert_eq!(Window::new(&image, center - Vector2::new(4.5, 4.5), 10).is_some(), inside, "{center}");
        }
        assert!(!warp_patch(&image.whole(), Vector2::new(15.0, 10.0), &Matrix2::from_element(f32::NAN), &mut out));
        assert!(!warp_patch(&GreyImage::new(2, 2).whole(), Vector2::new(1.0, 1.0), &Matrix2::identity(), &mut out));
    }
}
