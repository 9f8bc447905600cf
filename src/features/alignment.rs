//! Sub-pixel alignment of a small patch: the kernel of frame-to-frame flow and of tracking against the map.
//!
//! In: a template of N x N grey values (8 x 8 unless said otherwise) with a border of one pixel, a picture (one pyramid
//! level) and a start in pixels of that level. Out: the position in the picture where the template's centre lies, and
//! how alike the two are; or `None`.
//!
//! Model: I(p + u) = a T(u) + b for all u of the patch, with gain a and bias b free (auto exposure), solved for p by the
//! inverse-compositional Gauss-Newton method (Baker & Matthews, Lucas-Kanade 20 Years On, IJCV 2004, section 3.2; gain
//! and bias are projected out as in their part 3, CMU-RI-TR-03-35). With g = grad T made orthogonal to the constant and to T,
//!
//! ```text
//! H = sum g gᵀ        S(u) = H⁻¹ g(u)        p <- p - (1 / a) sum S(u) I(p + u)
//! ```
//!
//! Gain and bias drop out of the sum, so a step is two dot products of the samples with the images S, which belong to
//! the template alone. Patch offsets u are symmetric: pixel (i, j) of the template lies at (i - (N - 1) / 2,
//! j - (N - 1) / 2), so that a patch's centre is the point that it stands for under rotation too. Samples are those of
//! [`patch_sampling`](super::patch_sampling), on both sides.
//!
//! Cost, 8 x 8: see the figures there; a step is 64 samples and 192 multiply-adds in 16 bits.
//!
//! Does not: search beyond the basin of about half the patch, estimate a warp (the caller warps the template, see
//! [`warp_patch`](super::patch_sampling::warp_patch)), or allocate.

mod structure;

use nalgebra::Vector2;
use wide::{f32x8, i16x8, i32x4, i32x8};

use super::patch_sampling::{MAX_SAMPLE, OFFSET, SCALE, Window};
use crate::image::GreyImage;
use structure::{Structure, sum_lanes};

/// The usual template, 8 x 8.
pub type Template = PatchTemplate<8>;

/// Structure tensors with a smaller eigenvalue (grey²/px², mean over the patch) than this cannot be inverted in f32.
const SINGULAR_EIGENVALUE: f32 = 1e-3;

/// Bound of the sum of magnitudes of 16-bit numbers that samples are multiplied with: with one half per entry for
/// rounding (128 for 16 x 16), every partial sum of such products stays below 2^31.
const MAX_SUM_OF_MAGNITUDES: f32 = 130_000.0;
const _: () = assert!((MAX_SUM_OF_MAGNITUDES as i64 + 128) * (MAX_SAMPLE as i64) < 1 << 31);

/// When to stop, and what is not found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlignOptions {
    /// Bound on the iterations.
    pub max_iterations: u32,
    /// A step below this ends the iteration, pixels of the level.
    pub convergence_px: f32,
    /// After `max_iterations`, a last step above this has not converged, pixels of the level.
    pub accept_step_px: f32,
    /// Farthest that the result may lie from the start, pixels of the level.
    pub max_shift_px: f32,
}

impl Default for AlignOptions {
    fn default() -> Self {
        Self { max_iterations: 12, convergence_px: 0.01, accept_step_px: 0.05, max_shift_px: 5.0 }
    }
}

/// Where a template lies in a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Aligned {
    /// The template's centre, pixels of the level.
    pub position: Vector2<f32>,
    /// Normalised cross-correlation, -1 to 1: free of gain and bias.
    pub ncc: f32,
}

/// What of a patch does not depend on where it is looked for. `N` is 8 or 16.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PatchTemplate<const N: usize> {
    /// S = H⁻¹ g, x and y, and the grey values minus their mean, each times a scale, rounded.
    step_x: [[i16; N]; N],
    step_y: [[i16; N]; N],
    pixels: [[i16; N]; N],
    /// Pixels, pixels and grey² of one unit of the products of samples with the above.
    unit: [f32; 3],
    /// Products of the above with the template's own samples: what rounding leaves of zero, of zero, and the energy.
    own: [i32; 3],
    /// The point that the template stands for, from the centre of its samples: below 1 / 512 px.
    offset: Vector2<f32>,
    /// Sum of squares of the grey values minus their mean, grey².
    energy: f32,
}

impl<const N: usize> PatchTemplate<N> {
    const BORDERED: usize = N + 2;
    const RADIUS: f32 = (N as f32 - 1.0) / 2.0;

    /// The template around `center` (pixels of `image`); `None` where patch and border, with the one or two pixels
    /// more that sampling needs, reach outside.
    #[inline]
    pub fn from_image(image: &GreyImage, center: Vector2<f32>) -> Option<Self> {
        let mut buffer = Self::buffer();
        let first = Self::sample_bordered(image, center, buffer.as_flattened_mut().as_flattened_mut())?;
        let mut template = Self::build(buffer.as_flattened().as_flattened());
        template.offset = center - first.map(|v| v + Self::RADIUS + 1.0);
        Some(template)
    }

    /// Eigenvalues of the structure tensor around `center`, the smaller one first, grey²/px², mean over the patch (Shi & Tomasi,
    /// Good Features to Track, CVPR 1994), after removing what a change of gain or bias could explain; `None` where there is no
    /// template. The standard deviation of a template's position in the worst direction under pixel noise sigma is about
    /// sigma * sqrt(2 / (N² * the smaller one)) pixels.
    #[inline]
    pub fn eigenvalues_at(image: &GreyImage, center: Vector2<f32>) -> Option<[f32; 2]> {
        let mut buffer = Self::buffer();
        Self::sample_bordered(image, center, buffer.as_flattened_mut().as_flattened_mut())?;
        Some(Structure::of(buffer.as_flattened().as_flattened(), N).eigenvalues)
    }

    /// Room for (N + 2)² values and more: 2 N².
    #[inline]
    fn buffer() -> [[[f32; N]; N]; 2] {
        const { assert!(2 * N * N >= (N + 2) * (N + 2)) }
        [[[0.0; N]; N]; 2]
    }

    /// Grey values around `center` with a border of one, row by row, into `buffer`; where the first of them lies.
    #[inline]
    fn sample_bordered(image: &GreyImage, center: Vector2<f32>, buffer: &mut [f32]) -> Option<Vector2<f32>> {
        let side = Self::BORDERED;
        let window = Window::new(image, center.map(|v| v - Self::RADIUS - 1.0), side)?;
        // Strips of eight columns; the last overlaps the one before it.
        for strip in 0..side.div_ceil(8) {
            let column = (strip * 8).min(side - 8);
            window.strip(column, side, |row, samples| {
                let grey = to_f32(samples) * f32x8::splat(1.0 / SCALE) + f32x8::splat(OFFSET);
                buffer[row * side + column..][..8].copy_from_slice(&grey.to_array());
            });
        }
        Some(window.first)
    }

    /// The template of given grey values, row by row, border included: `A` = (N + 2)².
    #[inline]
    pub fn from_pixels<const A: usize>(pixels: &[f32; A]) -> Self {
        const { assert!(A == (N + 2) * (N + 2)) }
        Self::build(pixels)
    }

    fn build(bordered: &[f32]) -> Self {
        const { assert!(N == 8 || N == 16) }
        let side = Self::BORDERED;
        let area = (N * N) as f32;
        let Structure {
            mean,
            mean_gradient: [mean_x, mean_y],
            along: [along_x, along_y],
            energy,
            tensor,
            eigenvalues: [smaller, _],
        } = Structure::of(bordered, N);
        let [xx, xy, yy] = tensor;
        let mut template = Self {
            step_x: [[0; N]; N],
            step_y: [[0; N]; N],
            pixels: [[0; N]; N],
            unit: [0.0; 3],
            own: [0; 3],
            offset: Vector2::zeros(),
            energy,
        };
        // Written so that NaN fails.
        if !(smaller > SINGULAR_EIGENVALUE && energy > 0.0 && (xx + yy).is_finite()) {
            return template;
        }
        let determinant = area * (xx * yy - xy * xy);
        let inverse = [yy / determinant, -xy / determinant, xx / determinant];
        // The sum of S squared is the diagonal of H⁻¹, so by Cauchy-Schwarz these scales keep the sum of magnitudes
        // within what a product can take, and each entry within 130,000 / sqrt(N²) <= 16,250.
        let scales = [inverse[0], inverse[2], energy].map(|squares| MAX_SUM_OF_MAGNITUDES / (area * squares).sqrt());
        // S = inverse * (gradient - mean gradient - along * (T - mean)), written out as a combination of the three.
        let combine = |a: f32, b: f32, scale: f32| {
            let c = -(a * along_x + b * along_y);
            let d = -(a * mean_x + b * mean_y + c * mean);
            [c, a, b, d].map(|v| f32x8::splat(v * scale))
        };
        let combinations = [
            combine(inverse[0], inverse[1], scales[0]),
            combine(inverse[1], inverse[2], scales[1]),
            [scales[2], 0.0, 0.0, -mean * scales[2]].map(f32x8::splat),
        ];
        // Grey value (less the offset, for precision) and gradient of eight pixels from (column, row) on.
        let at = |column: usize, row: usize| {
            let load = |i: usize, j: usize| {
                let eight = &bordered[(row + j) * side + column + i..][..8];
                f32x8::new(std::array::from_fn(|k| eight[k]))
            };
            let half = f32x8::splat(0.5);
            let grey = load(1, 1) - f32x8::splat(OFFSET);
            (grey, (load(2, 1) - load(0, 1)) * half, (load(1, 2) - load(1, 0)) * half)
        };
        let mut own = [i32x4::ZERO; 3];
        for row in 0..N {
            for column in (0..N).step_by(8) {
                let (t, x, y) = at(column, row);
                let samples = to_i16(t * f32x8::splat(SCALE));
                let images = [&mut template.step_x, &mut template.step_y, &mut template.pixels];
                for ((image, [c, a, b, d]), own) in images.into_iter().zip(&combinations).zip(&mut own) {
                    let eight = to_i16((t * *c + x * *a) + (y * *b + *d));
                    image[row][column..column + 8].copy_from_slice(&eight.to_array());
                    *own += eight.dot(samples);
                }
            }
        }
        template.own = own.map(|v| v.reduce_add());
        template.unit = scales.map(|scale| 1.0 / (scale * SCALE));
        template
    }

    /// Normalised cross-correlation with the picture at `position`, -1 to 1; `None` outside, 0 where either is flat.
    pub fn ncc(&self, image: &GreyImage, position: Vector2<f32>) -> Option<f32> {
        let mut patch = [[0; N]; N];
        self.products(image, position - self.offset, &mut patch)?;
        Some(self.score(&patch))
    }

    /// Samples `patch` around `center`; returns where that really is and the products of the samples with the two step
    /// images and the template, each minus the template's own.
    #[inline(always)]
    fn products(
        &self,
        image: &GreyImage,
        center: Vector2<f32>,
        patch: &mut [[i16; N]; N],
    ) -> Option<(Vector2<f32>, [f32; 3])> {
        let window = Window::new(image, center.map(|v| v - Self::RADIUS), N)?;
        let mut sums = [i32x4::ZERO; 3];
        for column in (0..N).step_by(8) {
            window.strip(column, N, |row, samples| {
                sums[0] += samples.dot(eight(&self.step_x[row], column));
                sums[1] += samples.dot(eight(&self.step_y[row], column));
                sums[2] += samples.dot(eight(&self.pixels[row], column));
                patch[row][column..column + 8].copy_from_slice(&samples.to_array());
            });
        }
        let mut out = [0.0; 3];
        for k in 0..3 {
            // Each is below 2^31, their difference need not be.
            out[k] = (sums[k].reduce_add() as f32 - self.own[k] as f32) * self.unit[k];
        }
        Some((window.first.map(|v| v + Self::RADIUS), out))
    }

    /// NCC of a sampled patch.
    #[inline(always)]
    fn score(&self, patch: &[[i16; N]; N]) -> f32 {
        let area = (N * N) as f32;
        let mut sums = [f32x8::ZERO; 3];
        for (row, pixels) in patch.iter().zip(&self.pixels) {
            for column in (0..N).step_by(8) {
                let v = to_f32(eight(row, column));
                sums[0] += v;
                sums[1] += v * v;
                sums[2] += v * to_f32(eight(pixels, column));
            }
        }
        let [sum, squares, product] = sums.map(sum_lanes);
        let energy = (squares - sum * sum / area).max(0.0) * (1.0 / (SCALE * SCALE));
        let product = product * self.unit[2];
        let norm = (energy * self.energy).sqrt();
        if norm > 0.0 { product / norm } else { 0.0 }
    }
}

/// Finds `template` in `image` from `start` (pixels of `image`) on; `None` where it has no gradient in some direction,
/// would reach outside, does not converge near the start, or the picture there is its negative.
pub fn align<const N: usize>(
    template: &PatchTemplate<N>,
    image: &GreyImage,
    start: Vector2<f32>,
    options: &AlignOptions,
) -> Option<Aligned> {
    if template.unit[0] == 0.0 {
        return None;
    }
    let max_shift_squared = options.max_shift_px * options.max_shift_px;
    let inverse_energy = 1.0 / template.energy;
    let start = start - template.offset;
    let mut position = start;
    let mut patch = [[0; N]; N];
    let mut step_squared = f32::INFINITY;
    for _ in 0..options.max_iterations {
        let (sampled, [x, y, product]) = template.products(image, position, &mut patch)?;
        // Far from the solution the gain is not meaningful: bounded, it only shortens or lengthens the step.
        let gain = (1.0 + product * inverse_energy).clamp(0.5, 2.0);
        let step = Vector2::new(x, y) / gain;
        position = sampled - step;
        step_squared = step.norm_squared();
        // Written so that NaN fails, here and below.
        if !((position - start).norm_squared() <= max_shift_squared) {
            return None;
        }
        if step_squared < options.convergence_px * options.convergence_px {
            break;
        }
    }
    if !(step_squared <= options.accept_step_px * options.accept_step_px) {
        return None;
    }
    let ncc = template.score(&patch);
    (ncc > 0.0).then(|| Aligned { position: position + template.offset, ncc })
}

/// Eight lanes of a row.
#[inline(always)]
fn eight(row: &[i16], column: usize) -> i16x8 {
    let eight = &row[column..column + 8];
    i16x8::new(std::array::from_fn(|k| eight[k]))
}

#[inline(always)]
fn to_f32(v: i16x8) -> f32x8 {
    f32x8::from_i32x8(i32x8::from_i16x8(v))
}

/// To the nearest whole number; what lies outside 16 bits saturates.
#[inline(always)]
fn to_i16(v: f32x8) -> i16x8 {
    i16x8::from_i32x8_saturate(v.fast_round_int())
}
