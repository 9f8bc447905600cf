//! Gradient histograms: 128 numbers that describe a corner's surroundings by which way their brightness grows.
//!
//! Purpose: to find a corner again in a picture from far elsewhere, where comparisons of brightness
//! ([`descriptor`](super::descriptor)) no longer agree.
//! Input: one scale of a grey picture ([`GradientMap`], made once) and a corner's place in it, pixels. Output: up to two
//! [`GradientDescriptor`]s, one for each direction in which most gradients point: a corner has two edges, and either may be the stronger.
//! Paper: Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004 (sections 5 and 6: histogram of directions,
//! 4x4 cells of 8 directions, clipped at 0.2); the square root of the L1-normalised numbers instead of themselves is Arandjelović and
//! Zisserman, "Three things everyone should know", CVPR 2012.
//! Cost: 15 ns a pixel for the map, 20 us a corner, 10 ns a comparison of two.
//! It deliberately does not do: finding corners and their scale, the frame path (fifty times a binary descriptor's cost).

use std::f32::consts::TAU;

use super::dispatch::simd_kernel;
use crate::image::GreyImage;

/// Numbers of a descriptor: cells times directions.
pub const NUMBERS: usize = CELLS * CELLS * DIRECTIONS;
/// Cells of the patch to a side.
const CELLS: usize = 4;
/// Directions of a cell's histogram.
const DIRECTIONS: usize = 8;
/// Side of a cell, pixels. Lowe's is three sigma of the smoothing, 4.8; between that and 6 it makes little difference.
const CELL_PX: f32 = 6.0;
/// Half the patch's diagonal with half a cell around it, pixels.
const RADIUS: i32 = 21;
/// Positions nearer to the edge than this many pixels have no descriptor. Only the very corners of a turned patch may be cut off.
pub const BORDER: usize = 16;
/// One sigma of the smoothing, pixels.
const SMOOTHING_PX: f32 = 1.6;
/// Bins of the histogram that gives the patch its direction.
const TURNS: usize = 36;
/// One sigma of that histogram's window, pixels.
const TURN_SIGMA_PX: f32 = 4.0;
/// A direction this strong beside the strongest is one, too.
const SECOND_TURN: f32 = 0.8;
/// Largest share of the descriptor's length that a single number may have.
const CLIP: f32 = 0.2;
/// Length of a descriptor as whole numbers.
pub const LENGTH: f32 = 512.0;

/// See the module.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GradientDescriptor(pub [u8; NUMBERS]);

impl GradientDescriptor {
    /// Squared distance; the length of a descriptor is [`LENGTH`].
    #[inline(always)]
    pub fn distance_squared(&self, other: &Self) -> u32 {
        let mut sum = 0i32;
        for k in 0..NUMBERS {
            let d = i32::from(i16::from(self.0[k]) - i16::from(other.0[k]));
            sum += d * d;
        }
        sum as u32
    }
}

/// A descriptor and the direction that its patch was turned by, radians from x towards y.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TurnedGradients {
    pub descriptor: GradientDescriptor,
    pub turn_rad: f32,
}

/// Size and direction of the gradient at every pixel of a smoothed picture.
#[derive(Debug, Clone, Default)]
pub struct GradientMap {
    width: usize,
    height: usize,
    /// Grey levels a pixel.
    size: Vec<f32>,
    /// Radians from x towards y, 0 to 2 pi.
    angle: Vec<f32>,
}

impl GradientMap {
    pub fn new(picture: &GreyImage) -> Self {
        let (width, height) = (picture.width, picture.height);
        let smooth = smoothed(picture);
        let (mut size, mut angle) = (vec![0.0; width * height], vec![0.0; width * height]);
        for y in 1..height.saturating_sub(1) {
            for x in 1..width.saturating_sub(1) {
                let i = y * width + x;
                let gx = 0.5 * (smooth[i + 1] - smooth[i - 1]);
                let gy = 0.5 * (smooth[i + width] - smooth[i - width]);
                size[i] = gx.hypot(gy);
                angle[i] = gy.atan2(gx).rem_euclid(TAU);
            }
        }
        Self { width, height, size, angle }
    }

    /// Descriptors of the surroundings of (`x`, `y`), the strongest direction's first; nothing within [`BORDER`] of the edge, where
    /// there is no gradient, and for positions that are not numbers.
    pub fn describe(&self, x: f32, y: f32) -> Vec<TurnedGradients> {
        let inside = |v: f32, size: usize| v >= BORDER as f32 && v + BORDER as f32 <= size as f32 - 1.0;
        if !inside(x, self.width) || !inside(y, self.height) {
            return Vec::new();
        }
        let described = |turn| Some(TurnedGradients { descriptor: self.histograms(x, y, turn)?, turn_rad: turn });
        self.turns(x, y).into_iter().filter_map(described).collect()
    }

    /// Pixels around a place up to a radius: offset from it, size and angle of the gradient.
    fn around(&self, x: f32, y: f32, radius: i32) -> impl Iterator<Item = ([f32; 2], f32, f32)> {
        let (cx, cy) = (x.round() as i32, y.round() as i32);
        let rows = (cy - radius).max(0)..=(cy + radius).min(self.height as i32 - 1);
        let columns = (cx - radius).max(0)..=(cx + radius).min(self.width as i32 - 1);
        rows.flat_map(move |py| {
            columns.clone().map(move |px| {
                let i = py as usize * self.width + px as usize;
                ([px as f32 - x, py as f32 - y], self.size[i], self.angle[i])
            })
        })
    }

    /// The one or two directions in which most gradients point, radians.
    fn turns(&self, x: f32, y: f32) -> Vec<f32> {
        let mut bins = [0.0f32; TURNS];
        for ([dx, dy], size, angle) in self.around(x, y, (3.0 * TURN_SIGMA_PX) as i32) {
            let window = (-(dx * dx + dy * dy) / (2.0 * TURN_SIGMA_PX * TURN_SIGMA_PX)).exp();
            let at = angle * (TURNS as f32 / TAU);
            let (low, share) = (at.floor(), at - at.floor());
            bins[low as usize % TURNS] += window * size * (1.0 - share);
            bins[(low as usize + 1) % TURNS] += window * size * share;
        }
        for _ in 0..2 {
            let from = bins;
            for k in 0..TURNS {
                let near = |by: usize| from[(k + by) % TURNS] + from[(k + TURNS - by) % TURNS];
                bins[k] = (6.0 * from[k] + 4.0 * near(1) + near(2)) / 16.0;
            }
        }
        let mut peaks: Vec<(f32, f32)> = Vec::new();
        for k in 0..TURNS {
            let (left, middle, right) = (bins[(k + TURNS - 1) % TURNS], bins[k], bins[(k + 1) % TURNS]);
            if middle > left && middle >= right {
                let top = 0.5 * (left - right) / (left - 2.0 * middle + right);
                peaks.push((middle, ((k as f32 + top) * (TAU / TURNS as f32)).rem_euclid(TAU)));
            }
        }
        peaks.sort_by(|a, b| b.0.total_cmp(&a.0));
        let strongest = peaks.first().map_or(0.0, |p| p.0);
        peaks.retain(|p| p.0 >= SECOND_TURN * strongest);
        peaks.into_iter().take(2).map(|p| p.1).collect()
    }

    /// The cells' histograms of the patch turned by `turn`, each gradient shared out between the nearest cells and directions.
    fn histograms(&self, x: f32, y: f32, turn: f32) -> Option<GradientDescriptor> {
        let (sin, cos) = turn.sin_cos();
        let mut sums = [0.0f32; NUMBERS];
        let half = 0.5 * CELLS as f32;
        for ([dx, dy], size, angle) in self.around(x, y, RADIUS) {
            // In cells, along the patch's own axes, from its middle.
            let (u, v) = ((cos * dx + sin * dy) / CELL_PX, (cos * dy - sin * dx) / CELL_PX);
            let (across, down) = (u + half - 0.5, v + half - 0.5);
            let last = CELLS as f32;
            if !(across > -1.0 && across < last && down > -1.0 && down < last) {
                continue;
            }
            let weight = size * (-(u * u + v * v) / (2.0 * half * half)).exp();
            let towards = (angle - turn).rem_euclid(TAU) * (DIRECTIONS as f32 / TAU);
            let split = |at: f32| (at.floor(), at - at.floor());
            let ((c, cs), (r, rs), (d, ds)) = (split(across), split(down), split(towards));
            for (row, row_share) in [(r as i32, 1.0 - rs), (r as i32 + 1, rs)] {
                for (column, column_share) in [(c as i32, 1.0 - cs), (c as i32 + 1, cs)] {
                    let cells = 0..CELLS as i32;
                    if !cells.contains(&row) || !cells.contains(&column) {
                        continue;
                    }
                    let cell = (row as usize * CELLS + column as usize) * DIRECTIONS;
                    let share = weight * row_share * column_share;
                    sums[cell + d as usize % DIRECTIONS] += share * (1.0 - ds);
                    sums[cell + (d as usize + 1) % DIRECTIONS] += share * ds;
                }
            }
        }
        let length = sums.iter().map(|s| s * s).sum::<f32>().sqrt();
        if !(length > 0.0 && length.is_finite()) {
            return None;
        }
        sums.iter_mut().for_each(|s| *s = s.min(CLIP * length));
        let total: f32 = sums.iter().sum();
        Some(GradientDescriptor(sums.map(|s| (LENGTH * (s / total).sqrt()).round().min(255.0) as u8)))
    }
}

/// The picture under a Gaussian of [`SMOOTHING_PX`]; its edge is repeated outwards.
fn smoothed(picture: &GreyImage) -> Vec<f32> {
    let (width, height) = (picture.width, picture.height);
    let radius = (3.0 * SMOOTHING_PX).ceil() as usize;
    let weight = |k: usize| (-((k as f32 - radius as f32) / SMOOTHING_PX).powi(2) / 2.0).exp();
    let mut taps: Vec<f32> = (0..=2 * radius).map(weight).collect();
    let total: f32 = taps.iter().sum();
    taps.iter_mut().for_each(|t| *t /= total);
    let mut across = vec![0.0f32; width * height];
    let mut padded = vec![0.0f32; width + 2 * radius];
    for (y, to) in across.chunks_exact_mut(width.max(1)).enumerate() {
        let row = picture.row(y);
        for (x, p) in padded.iter_mut().enumerate() {
            *p = f32::from(row[x.saturating_sub(radius).min(width - 1)]);
        }
        for (k, tap) in taps.iter().enumerate() {
            to.iter_mut().zip(&padded[k..]).for_each(|(t, p)| *t += tap * p);
        }
    }
    let mut out = vec![0.0f32; width * height];
    for (y, to) in out.chunks_exact_mut(width.max(1)).enumerate() {
        for (k, tap) in taps.iter().enumerate() {
            let from = (y + k).saturating_sub(radius).min(height - 1) * width;
            to.iter_mut().zip(&across[from..from + width]).for_each(|(t, p)| *t += tap * p);
        }
    }
    out
}

simd_kernel! {
    /// Squared distances of one descriptor to all others, in their order.
    pub fn distances_squared(of: &GradientDescriptor, to: &[GradientDescriptor], out: &mut [u32]) = distances_body
}

#[inline(always)]
fn distances_body(of: &GradientDescriptor, to: &[GradientDescriptor], out: &mut [u32]) {
    for (distance, other) in out.iter_mut().zip(to) {
        *distance = of.distance_squared(other);
    }
}

#[cfg(test)]
mod tests;
