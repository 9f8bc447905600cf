//! Mip-mapped grey textures and their filtered look-up.
//!
//! Input: a painted picture of a flat face (texels) and, per pixel of the camera, a place in it with the footprint that
//! the pixel covers there. Output: the mean of the texture over that footprint, 0..255 as `f32`.
//!
//! Trilinear mip-mapping (Williams, "Pyramidal parametrics", SIGGRAPH 1983) with one to four look-ups along the longer
//! axis of the footprint (after Heckbert's elliptical footprint, 1989): a floor seen at a flat angle stays sharp across
//! and does not shimmer along. Texel (i, j) of level 0 covers [i, i+1) x [j, j+1), so its centre is at i + 0.5.
//!
//! Cost: one look-up of one level about 2 ns a pixel in groups of 16. The loops over fixed groups are written for the
//! autovectoriser (SSE2 and NEON, no intrinsics). Deliberately not here: colour, compression, wrap-around.

/// Adding this to a small positive `f32` rounds it and leaves it in the low mantissa bits: a conversion to integer that
/// vectorises on every machine.
const ROUND: f32 = 8_388_608.0;
const ROUND_BITS: u32 = 0x4b00_0000;
/// Largest side, texels.
pub(super) const MAX_SIDE: usize = 16_000;

/// One level: every texel plus a border of one replicated texel all round.
#[derive(Debug, Clone, PartialEq)]
struct Level {
    /// Size without the border, texels.
    max_u: f32,
    max_v: f32,
    stride: usize,
    data: Vec<u8>,
}

impl Level {
    fn new(width: usize, height: usize, texels: &[u8]) -> Self {
        let stride = width + 2;
        let mut data = Vec::with_capacity(stride * (height + 2));
        for y in 0..height + 2 {
            let row = &texels[y.saturating_sub(1).min(height - 1) * width..][..width];
            data.push(row[0]);
            data.extend_from_slice(row);
            data.push(row[width - 1]);
        }
        Self { max_u: width as f32, max_v: height as f32, stride, data }
    }

    /// Adds `weight` times the bilinear value at level-0 coordinates (u, v) to `sum`; `scale` = 2^-level.
    #[inline(always)]
    fn add<const N: usize>(&self, u: &[f32; N], v: &[f32; N], scale: f32, weight: f32, sum: &mut [f32; N]) {
        let (mut column, mut row, mut fu, mut fv) = ([0u32; N], [0u32; N], [0.0f32; N], [0.0f32; N]);
        for i in 0..N {
            // With its border the level starts one texel earlier; its centres are at half texels.
            let pu = clamp(u[i] * scale, self.max_u);
            let pv = clamp(v[i] * scale, self.max_v);
            let (ru, rv) = (pu + ROUND, pv + ROUND);
            column[i] = ru.to_bits() - ROUND_BITS;
            row[i] = rv.to_bits() - ROUND_BITS;
            // Rounding makes them -0.5..0.5 of the next texel's centre, 0..1 of the one before.
            fu[i] = pu - (ru - ROUND) + 0.5;
            fv[i] = pv - (rv - ROUND) + 0.5;
        }
        let mut texels = [0u32; N];
        for i in 0..N {
            let at = row[i] as usize * self.stride + column[i] as usize;
            // The clamps above keep both rows inside; a texture that broke that would show black, not crash.
            if let (Some(&[a, b]), Some(&[c, d])) =
                (self.data.get(at..at + 2), self.data.get(at + self.stride..at + self.stride + 2))
            {
                texels[i] = u32::from_le_bytes([a, b, c, d]);
            }
        }
        for i in 0..N {
            let t = texels[i];
            let (a, b) = ((t & 255) as i32 as f32, ((t >> 8) & 255) as i32 as f32);
            let (c, d) = (((t >> 16) & 255) as i32 as f32, (t >> 24) as i32 as f32);
            let (top, bottom) = (a + (b - a) * fu[i], c + (d - c) * fu[i]);
            sum[i] += weight * (top + (bottom - top) * fv[i]);
        }
    }
}

/// What one pixel covers of a texture.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Footprint {
    /// Mip level and the share of the next coarser one, 0..1.
    level: usize,
    coarser: f32,
    /// Look-ups along the longer axis: 1, 2 or 4.
    taps: u32,
    /// Texels between them.
    step: [f32; 2],
}

/// A grey picture with its mip levels.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Texture {
    levels: Vec<Level>,
}

impl Texture {
    /// From `width * height` texels. Sides are 1 to [`MAX_SIDE`].
    pub(super) fn new(width: usize, height: usize, texels: Vec<u8>) -> Self {
        debug_assert!(width >= 1 && height >= 1 && width <= MAX_SIDE && height <= MAX_SIDE);
        debug_assert_eq!(texels.len(), width * height);
        let mut levels = vec![Level::new(width, height, &texels)];
        let (mut width, mut height, mut texels) = (width, height, texels);
        while width > 1 || height > 1 {
            (width, height, texels) = half(width, height, &texels);
            levels.push(Level::new(width, height, &texels));
        }
        Self { levels }
    }

    /// Memory, bytes.
    pub(super) fn bytes(&self) -> usize {
        self.levels.iter().map(|l| l.data.len()).sum()
    }

    /// The footprint of a pixel whose step right moves (m00, m10) texels in (u, v) and whose step down moves (m01, m11).
    #[inline]
    pub(super) fn footprint(&self, m00: f32, m01: f32, m10: f32, m11: f32) -> Footprint {
        // Axes of the ellipse: eigenvalues of M Mᵀ are the squared half axes.
        let p = m00 * m00 + m01 * m01;
        let q = m00 * m10 + m01 * m11;
        let r = m10 * m10 + m11 * m11;
        let (mean, half_difference) = (0.5 * (p + r), 0.5 * (p - r));
        let root = (half_difference * half_difference + q * q).sqrt();
        let major2 = (mean + root).max(1e-12);
        let minor2 = (mean - root).max(1e-12);
        let ratio2 = major2 / minor2;
        // The look-ups' own blur (`side`) and their spread together have the variance of the whole footprint. One
        // look-up more doubles the reach: where their number changes both sides have the same blur, so no seam shows.
        let (taps, side2) = if ratio2 <= 1.3 {
            (1, major2)
        } else if ratio2 <= 4.8 {
            (2, minor2.max(major2 * 0.21))
        } else {
            (4, minor2.max(major2 * 0.05))
        };
        let step = if taps == 1 {
            [0.0; 2]
        } else {
            let length = ((major2 - side2).max(0.0) / (taps * taps - 1) as f32).sqrt();
            let axis = if half_difference >= 0.0 { [half_difference + root, q] } else { [q, root - half_difference] };
            let norm = (axis[0] * axis[0] + axis[1] * axis[1]).sqrt().max(1e-20);
            [axis[0] / norm * length, axis[1] / norm * length]
        };
        let lod = (0.5 * log2(side2)).clamp(0.0, (self.levels.len() - 1) as f32);
        let level = lod as usize;
        // Two levels are mixed only around the middle between them: half of the look-ups need one.
        let coarser = (2.0 * (lod - level as f32) - 0.5).clamp(0.0, 1.0);
        if coarser > 0.99 {
            Footprint { level: level + 1, coarser: 0.0, taps, step }
        } else {
            Footprint { level, coarser, taps, step }
        }
    }

    /// Filtered values at level-0 coordinates (u, v), 0..255.
    #[inline(always)]
    pub(super) fn sample<const N: usize>(&self, u: &[f32; N], v: &[f32; N], footprint: &Footprint) -> [f32; N] {
        let mut sum = [0.0; N];
        let fine = &self.levels[footprint.level.min(self.levels.len() - 1)];
        let coarse = &self.levels[(footprint.level + 1).min(self.levels.len() - 1)];
        let scale = 1.0 / (1u64 << footprint.level.min(31)) as f32;
        let weight = 1.0 / footprint.taps.max(1) as f32;
        let (mut uk, mut vk) = (*u, *v);
        for k in 0..footprint.taps {
            if footprint.taps > 1 {
                let along = k as f32 - 0.5 * (footprint.taps - 1) as f32;
                for i in 0..N {
                    uk[i] = u[i] + along * footprint.step[0];
                    vk[i] = v[i] + along * footprint.step[1];
                }
            }
            fine.add(&uk, &vk, scale, weight * (1.0 - footprint.coarser), &mut sum);
            if footprint.coarser > 0.01 {
                coarse.add(&uk, &vk, 0.5 * scale, weight * footprint.coarser, &mut sum);
            }
        }
        sum
    }
}

/// The next coarser level: means of 2x2 texels, the last row or column repeated where the side is odd.
fn half(width: usize, height: usize, texels: &[u8]) -> (usize, usize, Vec<u8>) {
    let (w, h) = (width.div_ceil(2), height.div_ceil(2));
    let mut out = Vec::with_capacity(w * h);
    for y in 0..h {
        let top = &texels[2 * y * width..][..width];
        let bottom = &texels[(2 * y + 1).min(height - 1) * width..][..width];
        for x in 0..w {
            let (a, b) = (2 * x, (2 * x + 1).min(width - 1));
            // Alternate rounding, or dozens of levels would drift bright.
            let bias = 1 + ((x + y) as u32 & 1);
            let sum = u32::from(top[a]) + u32::from(top[b]) + u32::from(bottom[a]) + u32::from(bottom[b]);
            out.push(((sum + bias) >> 2) as u8);
        }
    }
    (w, h, out)
}

/// 0..=max, NaN to 0; compiles to two instructions, unlike `f32::clamp`.
#[inline(always)]
fn clamp(x: f32, max: f32) -> f32 {
    let x = if x > 0.0 { x } else { 0.0 };
    if x < max { x } else { max }
}

/// Base-2 logarithm of a positive number, error below 0.01: enough for a mip level.
#[inline]
fn log2(x: f32) -> f32 {
    let bits = x.to_bits();
    let exponent = ((bits >> 23) as i32 - 127) as f32;
    let m = f32::from_bits((bits & 0x007f_ffff) | 0x3f80_0000) - 1.0;
    exponent + m * (1.3465 - 0.3465 * m)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(texture: &Texture, u: f32, v: f32, footprint: &Footprint) -> f32 {
        texture.sample(&[u], &[v], footprint)[0]
    }

    #[test]
    fn a_look_up_at_a_texel_centre_gives_that_texel() {
        let texels: Vec<u8> = (0..35).map(|i| (i * 7) as u8).collect();
        let texture = Texture::new(7, 5, texels.clone());
        let sharp = texture.footprint(0.5, 0.0, 0.0, 0.5);
        for (i, &t) in texels.iter().enumerate() {
            let value = one(&texture, (i % 7) as f32 + 0.5, (i / 7) as f32 + 0.5, &sharp);
            assert!((value - f32::from(t)).abs() < 0.05, "texel {i}: {value} is not {t}");
        }
    }

    #[test]
    fn an_edge_keeps_its_place_in_every_level() {
        // Left half dark, right half bright, edge at u = 64: halfway between the two values at every blur.
        let texture = Texture::new(128, 128, (0..128 * 128).map(|i| if i % 128 < 64 { 40 } else { 200 }).collect());
        for size in [1.0f32, 2.0, 3.0, 5.0, 11.0, 16.0] {
            let footprint = texture.footprint(size, 0.0, 0.0, size);
            let value = one(&texture, 64.0, 60.0, &footprint);
            assert!((value - 120.0).abs() < 1.5, "footprint {size}: {value}");
        }
    }

    #[test]
    fn a_long_footprint_averages_along_and_not_across() {
        // Stripes 4 texels wide that change along u only.
        let texture = Texture::new(256, 256, (0..256 * 256).map(|i| if (i / 4) % 2 == 0 { 0 } else { 255 }).collect());
        let across = texture.footprint(1.0, 0.0, 0.0, 8.0);
        let along = texture.footprint(8.0, 0.0, 0.0, 1.0);
        let contrast = |f: &Footprint| {
            let values: Vec<f32> = (0..32).map(|i| one(&texture, 100.0 + i as f32 * 0.5, 128.0, f)).collect();
            values.iter().fold(0.0f32, |a, &b| a.max(b)) - values.iter().fold(255.0f32, |a, &b| a.min(b))
        };
        assert!(contrast(&across) > 150.0, "{}", contrast(&across));
        assert!(contrast(&along) < 60.0, "{}", contrast(&along));
    }

    #[test]
    fn coordinates_outside_or_not_finite_do_not_crash() {
        let texture = Texture::new(9, 4, vec![77; 36]);
        let footprint = texture.footprint(1.0, 0.0, 0.0, 1.0);
        for u in [-1e9, 1e9, f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            assert!((one(&texture, u, u, &footprint) - 77.0).abs() < 0.1);
        }
    }

    #[test]
    fn log2_is_close() {
        for i in 1..2000 {
            let x = i as f32 * 0.037;
            assert!((log2(x) - x.log2()).abs() < 0.012, "log2({x})");
        }
    }
}
