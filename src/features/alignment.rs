//! Sub-pixel alignment of a small patch: the kernel of frame-to-frame flow and of tracking against the map.
//!
//! In: a template of N x N grey values (8 x 8 unless said otherwise) with a border of one pixel, a picture (one pyramid
//! level) and a start in pixels of that level. Out: the position in the picture where the template's centre lies, with
//! a residual; or a named reason why there is none.
//!
//! Model: I(p + u) = a T(u) + b for all u of the patch, with gain a and bias b free (auto exposure), solved for p by the
//! inverse-compositional Gauss-Newton method (Baker & Matthews, Lucas-Kanade 20 Years On, IJCV 2004, section 3.2 and,
//! for the linear appearance, 4.3 "project out"). With g = grad T made orthogonal to the constant and to T,
//!
//! ```text
//! H = sum g gᵀ        S(u) = H⁻¹ g(u)        p <- p - (1 / a) sum S(u) I(p + u)
//! ```
//!
//! Gain and bias drop out of the sum, so a step is two dot products of the bilinear samples with the images S, which
//! belong to the template alone. Patch offsets u are symmetric: pixel (i, j) of the template lies at
//! (i - (N - 1) / 2, j - (N - 1) / 2), so for even N a centre with both coordinates at k + 0.5 samples whole pixels.
//!
//! Cost, 8 x 8: one iteration is 81 pixels converted, 64 bilinear samples, 192 multiply-adds; about 0.05 us on a
//! 2.6 GHz x86-64 with SSE2 only. Loops have fixed length over arrays, so that they vectorise on SSE2 and NEON.
//!
//! Does not: search beyond the basin of about half the patch, estimate a warp (the caller warps the template, see
//! [`warp_patch`]), or allocate.

use nalgebra::{Matrix2, Vector2};

use crate::image::GreyImage;

/// The usual template, 8 x 8.
pub type Template = PatchTemplate<8>;

/// Largest side of a template with its border.
const MAX_BORDERED: usize = 18;

/// Structure tensors with a smaller eigenvalue (grey²/px², mean over the patch) than this cannot be inverted in f32.
const SINGULAR_EIGENVALUE: f32 = 1e-3;

/// When to stop, and what to call a failure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlignOptions {
    /// Bound on the iterations.
    pub max_iterations: u32,
    /// A step below this ends the iteration, pixels of the level.
    pub convergence_px: f32,
    /// After `max_iterations`, a last step above this is [`AlignFailure::Diverged`], pixels of the level.
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
    /// Zero-mean sum of squared differences over the number of pixels, grey². Contains the gain.
    pub ssd: f32,
    /// Normalised cross-correlation, -1 to 1: free of gain and bias.
    pub ncc: f32,
    /// Gain a of the picture over the template.
    pub gain: f32,
    pub iterations: u32,
}

/// Why a template was not found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum AlignFailure {
    /// The patch would reach outside the picture.
    #[error("patch left the picture")]
    LeftPicture,
    /// Too far from the start, not converging, or the picture there is the template's negative.
    #[error("alignment diverged")]
    Diverged,
    /// The template has no gradient in some direction.
    #[error("template cannot be localised: structure tensor is singular")]
    Singular,
}

/// What of a patch does not depend on where it is looked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PatchTemplate<const N: usize> {
    /// Grey values minus their mean.
    pixels: [[f32; N]; N],
    /// S = H⁻¹ g, x and y.
    step_x: [[f32; N]; N],
    step_y: [[f32; N]; N],
    /// Sum of squares of `pixels`.
    energy: f32,
    /// H divided by N²: xx, xy, yy.
    tensor: [f32; 3],
    min_eigenvalue: f32,
}

impl<const N: usize> PatchTemplate<N> {
    const BORDERED: usize = N + 2;
    const RADIUS: f32 = (N as f32 - 1.0) / 2.0;

    /// The template around `center` (pixels of `image`); `None` where patch and border reach outside.
    #[inline]
    pub fn from_image(image: &GreyImage, center: Vector2<f32>) -> Option<Self> {
        const { assert!(N >= 4 && N + 2 <= MAX_BORDERED) }
        let mut buffer = [0.0f32; MAX_BORDERED * MAX_BORDERED];
        let bordered = &mut buffer[..Self::BORDERED * Self::BORDERED];
        let window = Window::new(image, center, Self::RADIUS + 1.0, Self::BORDERED)?;
        window.bilinear(bordered, Self::BORDERED);
        Some(Self::build(bordered))
    }

    /// The template of given pixels, row by row, border included: `A` = (N + 2)².
    #[inline]
    pub fn from_pixels<const A: usize>(pixels: &[f32; A]) -> Self {
        const { assert!(A == (N + 2) * (N + 2) && N >= 4 && N + 2 <= MAX_BORDERED) }
        Self::build(pixels)
    }

    fn build(bordered: &[f32]) -> Self {
        let side = Self::BORDERED;
        let area = (N * N) as f32;
        let mut pixels = [[0.0; N]; N];
        let mut gx = [[0.0; N]; N];
        let mut gy = [[0.0; N]; N];
        let mut sums = [[0.0; N]; 3];
        for j in 0..N {
            let above = &bordered[j * side + 1..][..N];
            let row = &bordered[(j + 1) * side..][..N + 2];
            let below = &bordered[(j + 2) * side + 1..][..N];
            for i in 0..N {
                pixels[j][i] = row[i + 1];
                gx[j][i] = 0.5 * (row[i + 2] - row[i]);
                gy[j][i] = 0.5 * (below[i] - above[i]);
                sums[0][i] += pixels[j][i];
                sums[1][i] += gx[j][i];
                sums[2][i] += gy[j][i];
            }
        }
        let [mean, mean_x, mean_y] = sums.map(|s| s.iter().sum::<f32>() / area);
        let mut sums = [[0.0; N]; 3];
        for j in 0..N {
            for i in 0..N {
                pixels[j][i] -= mean;
                gx[j][i] -= mean_x;
                gy[j][i] -= mean_y;
                sums[0][i] += pixels[j][i] * pixels[j][i];
                sums[1][i] += pixels[j][i] * gx[j][i];
                sums[2][i] += pixels[j][i] * gy[j][i];
            }
        }
        let [energy, along_x, along_y] = sums.map(|s| s.iter().sum::<f32>());
        let (along_x, along_y) = if energy > 0.0 { (along_x / energy, along_y / energy) } else { (0.0, 0.0) };
        let mut sums = [[0.0; N]; 3];
        for j in 0..N {
            for i in 0..N {
                gx[j][i] -= along_x * pixels[j][i];
                gy[j][i] -= along_y * pixels[j][i];
                sums[0][i] += gx[j][i] * gx[j][i];
                sums[1][i] += gx[j][i] * gy[j][i];
                sums[2][i] += gy[j][i] * gy[j][i];
            }
        }
        let tensor @ [xx, xy, yy] = sums.map(|s| s.iter().sum::<f32>() / area);
        let min_eigenvalue = 0.5 * (xx + yy - ((xx - yy) * (xx - yy) + 4.0 * xy * xy).sqrt());
        let determinant = area * (xx * yy - xy * xy);
        let (ixx, ixy, iyy) = if min_eigenvalue > SINGULAR_EIGENVALUE {
            (yy / determinant, -xy / determinant, xx / determinant)
        } else {
            (0.0, 0.0, 0.0)
        };
        for j in 0..N {
            for i in 0..N {
                let (x, y) = (gx[j][i], gy[j][i]);
                gx[j][i] = ixx * x + ixy * y;
                gy[j][i] = ixy * x + iyy * y;
            }
        }
        Self { pixels, step_x: gx, step_y: gy, energy, tensor, min_eigenvalue }
    }

    /// Smaller eigenvalue of the structure tensor, grey²/px², mean over the patch (Shi & Tomasi, Good Features to
    /// Track, CVPR 1994), after removing what a change of gain or bias could explain. The standard deviation of the
    /// position in the worst direction under pixel noise sigma is about sigma * sqrt(2 / (N² * this)) pixels.
    #[inline]
    pub fn min_eigenvalue(&self) -> f32 {
        self.min_eigenvalue
    }

    /// Structure tensor of the same: [xx, xy, yy], grey²/px², mean over the patch. Its inverse, times sigma² * 2 / N²,
    /// is the covariance of the position.
    #[inline]
    pub fn structure_tensor(&self) -> [f32; 3] {
        self.tensor
    }

    /// Variance of the grey values, grey².
    #[inline]
    pub fn variance(&self) -> f32 {
        self.energy / (N * N) as f32
    }

    /// Normalised cross-correlation with the picture at `position`, -1 to 1; `None` outside or where either is flat.
    pub fn ncc(&self, image: &GreyImage, position: Vector2<f32>) -> Option<f32> {
        let window = Window::new(image, position, Self::RADIUS, N)?;
        Some(self.score(&self.sample(&window)).1)
    }

    #[inline]
    fn sample(&self, window: &Window) -> [[f32; N]; N] {
        let mut patch = [[0.0; N]; N];
        window.bilinear_rows(&mut patch);
        patch
    }

    /// Zero-mean SSD per pixel, NCC and gain of a sampled patch.
    fn score(&self, patch: &[[f32; N]; N]) -> (f32, f32, f32) {
        let area = (N * N) as f32;
        let mut lanes = [0.0; N];
        for row in patch {
            for i in 0..N {
                lanes[i] += row[i];
            }
        }
        let mean = lanes.iter().sum::<f32>() / area;
        let mut sums = [[0.0; N]; 2];
        for j in 0..N {
            for i in 0..N {
                let v = patch[j][i] - mean;
                sums[0][i] += v * v;
                sums[1][i] += v * self.pixels[j][i];
            }
        }
        let [energy, product] = sums.map(|s| s.iter().sum::<f32>());
        let norm = (energy * self.energy).sqrt();
        let ncc = if norm > 0.0 { product / norm } else { 0.0 };
        let gain = if self.energy > 0.0 { product / self.energy } else { 0.0 };
        (((energy - 2.0 * product + self.energy) / area).max(0.0), ncc, gain)
    }
}

/// Finds `template` in `image` from `start` (pixels of `image`) on.
pub fn align<const N: usize>(
    template: &PatchTemplate<N>,
    image: &GreyImage,
    start: Vector2<f32>,
    options: &AlignOptions,
) -> Result<Aligned, AlignFailure> {
    if template.min_eigenvalue <= SINGULAR_EIGENVALUE || !template.min_eigenvalue.is_finite() {
        return Err(AlignFailure::Singular);
    }
    let max_shift_squared = options.max_shift_px * options.max_shift_px;
    let inverse_energy = 1.0 / template.energy;
    let mut position = start;
    let mut patch = [[0.0; N]; N];
    let mut step_squared = f32::INFINITY;
    let mut iterations = 0;
    while iterations < options.max_iterations {
        let window = Window::new(image, position, PatchTemplate::<N>::RADIUS, N).ok_or(AlignFailure::LeftPicture)?;
        window.bilinear_rows(&mut patch);
        let mut sums = [[0.0; N]; 3];
        for j in 0..N {
            for i in 0..N {
                sums[0][i] += template.step_x[j][i] * patch[j][i];
                sums[1][i] += template.step_y[j][i] * patch[j][i];
                sums[2][i] += template.pixels[j][i] * patch[j][i];
            }
        }
        let [x, y, product] = sums.map(|s| sum_lanes(&s));
        // Far from the solution the gain is not meaningful: bounded, it only shortens or lengthens the step.
        let gain = (product * inverse_energy).clamp(0.5, 2.0);
        let step = Vector2::new(x / gain, y / gain);
        position -= step;
        iterations += 1;
        step_squared = step.norm_squared();
        // Written so that NaN fails.
        if !((position - start).norm_squared() <= max_shift_squared) {
            return Err(AlignFailure::Diverged);
        }
        if step_squared < options.convergence_px * options.convergence_px {
            break;
        }
    }
    if !(step_squared <= options.accept_step_px * options.accept_step_px) {
        return Err(AlignFailure::Diverged);
    }
    let (ssd, ncc, gain) = template.score(&patch);
    if ncc <= 0.0 {
        return Err(AlignFailure::Diverged);
    }
    Ok(Aligned { position, ssd, ncc, gain, iterations })
}

/// Sum in a fixed order that the vector unit likes.
#[inline]
fn sum_lanes<const N: usize>(lanes: &[f32; N]) -> f32 {
    let mut four = [0.0; 4];
    for (i, v) in lanes.iter().enumerate() {
        four[i % 4] += v;
    }
    (four[0] + four[1]) + (four[2] + four[3])
}

/// Fills `out` (a square, row by row) with `source` seen through an affine map: pixel (i, j) of a side of S pixels is
/// `source` at `center + source_from_patch * (i - (S - 1) / 2, j - (S - 1) / 2)`, bilinear. With `A` = 100 this makes the
/// pixels of an 8 x 8 [`Template`]. False, with `out` unspecified, when a sample lies outside `source` or the map is not finite.
pub fn warp_patch<const A: usize>(
    source: &GreyImage,
    center: Vector2<f32>,
    source_from_patch: &Matrix2<f32>,
    out: &mut [f32; A],
) -> bool {
    let side = const {
        let side = A.isqrt();
        assert!(side * side == A && side >= 2);
        side
    };
    let radius = (side as f32 - 1.0) / 2.0;
    let m = source_from_patch;
    let reach = Vector2::new(m.m11.abs() + m.m12.abs(), m.m21.abs() + m.m22.abs()) * radius;
    let (low, high) = (center - reach, center + reach);
    // The last column and row need their right and lower neighbours.
    let inside = low.x >= 0.0
        && low.y >= 0.0
        && high.x < source.width as f32 - 1.0
        && high.y < source.height as f32 - 1.0
        && source.data.len() >= source.width * source.height;
    if !inside {
        return false;
    }
    let right = Vector2::new(m.m11, m.m21);
    let down = Vector2::new(m.m12, m.m22);
    let first = center - (right + down) * radius;
    for (j, row) in out.chunks_exact_mut(side).enumerate() {
        let start = first + down * j as f32;
        for (i, v) in row.iter_mut().enumerate() {
            let p = start + right * i as f32;
            // Rounding may put a sample a hair outside what was checked above.
            let x = (p.x.max(0.0) as usize).min(source.width - 2);
            let y = (p.y.max(0.0) as usize).min(source.height - 2);
            let (fx, fy) = (p.x - x as f32, p.y - y as f32);
            let upper = &source.data[y * source.width + x..][..2];
            let lower = &source.data[(y + 1) * source.width + x..][..2];
            let top = lerp(f32::from(upper[0]), f32::from(upper[1]), fx);
            let bottom = lerp(f32::from(lower[0]), f32::from(lower[1]), fx);
            *v = lerp(top, bottom, fy);
        }
    }
    true
}

#[inline(always)]
fn lerp(a: f32, b: f32, t: f32) -> f32 {
    a + t * (b - a)
}

/// A square of bilinear samples one pixel apart: all share the same two weights.
struct Window<'a> {
    /// From the first pixel needed on.
    data: &'a [u8],
    stride: usize,
    fx: f32,
    fy: f32,
}

impl<'a> Window<'a> {
    /// `side` samples each way, the first at `center - radius`; `None` outside, and for NaN.
    #[inline(always)]
    fn new(image: &'a GreyImage, center: Vector2<f32>, radius: f32, side: usize) -> Option<Self> {
        let (left, top) = (center.x - radius, center.y - radius);
        if !(left >= 0.0 && top >= 0.0) {
            return None;
        }
        let (x, y) = (left as usize, top as usize);
        if x.saturating_add(side) >= image.width || y.saturating_add(side) >= image.height {
            return None;
        }
        let data = image.data.get(y * image.width + x..)?;
        Some(Self { data, stride: image.width, fx: left - x as f32, fy: top - y as f32 })
    }

    /// One row of pixels, interpolated across.
    #[inline(always)]
    fn across<const N: usize>(&self, row: usize) -> [f32; N] {
        let pixels = &self.data[row * self.stride..][..N + 1];
        let mut out = [0.0; N];
        for i in 0..N {
            let (a, b) = (f32::from(pixels[i]), f32::from(pixels[i + 1]));
            out[i] = lerp(a, b, self.fx);
        }
        out
    }

    #[inline(always)]
    fn bilinear_rows<const N: usize>(&self, out: &mut [[f32; N]; N]) {
        let mut above = self.across::<N>(0);
        for (j, row) in out.iter_mut().enumerate() {
            let below = self.across::<N>(j + 1);
            for i in 0..N {
                row[i] = lerp(above[i], below[i], self.fy);
            }
            above = below;
        }
    }

    /// The same for a side that is no constant of the type: a template with its border.
    #[inline(always)]
    fn bilinear(&self, out: &mut [f32], side: usize) {
        let mut above = [0.0; MAX_BORDERED];
        for j in 0..=side {
            let pixels = &self.data[j * self.stride..][..side + 1];
            let mut below = [0.0; MAX_BORDERED];
            for i in 0..side {
                below[i] = lerp(f32::from(pixels[i]), f32::from(pixels[i + 1]), self.fx);
            }
            if j > 0 {
                for (i, v) in out[(j - 1) * side..j * side].iter_mut().enumerate() {
                    *v = lerp(above[i], below[i], self.fy);
                }
            }
            above = below;
        }
    }
}
