//! Gradient histograms: 128 numbers that describe a corner's surroundings by which way their brightness grows.
//!
//! Purpose: to find a corner again in a picture from far elsewhere, where comparisons of brightness
//! ([`descriptor`](super::descriptor)) no longer agree.
//! Input: one scale of a grey picture ([`GradientMap`], made once) and a corner's place in it, pixels. Output: up to two
//! [`GradientDescriptor`]s, one for each direction in which most gradients point: a corner has two edges, and either may be the stronger.
//! Paper: Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004 (sections 5 and 6: histogram of directions,
//! 4x4 cells of 8 directions, clipped at 0.2); the square root of the L1-normalised numbers instead of themselves is Arandjelović and
//! Zisserman, "Three things everyone should know", CVPR 2012.
//! Cost: 15 ns a pixel for the map, 20 us a corner, 5 ns a comparison of two.
//! It deliberately does not do: finding corners and their scale, the frame path (fifty times a binary descriptor's cost).

use std::f32::consts::TAU;
use std::sync::LazyLock;

use wide::{i16x8, i32x4};

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
/// Distance of the places at which a patch is sampled, pixels: below the smoothing's sigma, so that nothing falls between them.
const STEP_PX: f32 = 1.5;
/// Positions nearer to the edge than this many pixels have no descriptor. Only the very corners of a turned patch may be cut off.
pub const BORDER: usize = 16;
/// One sigma of the smoothing, pixels.
const SMOOTHING_PX: f32 = 1.6;
/// Its weights: three sigmas to either side.
const TAPS: usize = 11;
/// Bins of the histogram that gives the patch its direction.
const TURNS: usize = 36;
/// One sigma of that histogram's window, pixels.
const TURN_SIGMA_PX: f32 = 4.0;
const TURN_RADIUS: i32 = 12;
const TURN_SIDE: usize = 2 * TURN_RADIUS as usize + 1;
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
            let row = |y: usize| y * width..(y + 1) * width;
            let [above, middle, below] = [y - 1, y, y + 1].map(|y| &smooth[row(y)]);
            gradients_of_row(above, middle, below, &mut size[row(y)], &mut angle[row(y)]);
        }
        Self { width, height, size, angle }
    }

    /// Descriptors of the surroundings of (`x`, `y`), the strongest direction's first; nothing within [`BORDER`] of the edge, where
    /// there is no gradient, and for positions that are not numbers.
    pub fn describe(&self, x: f32, y: f32) -> Vec<TurnedGradients> {
        let inside = |v: f32, size: usize| v >= BORDER as f32 && v + BORDER as f32 <= size as f32 - 1.0;
        match inside(x, self.width) && inside(y, self.height) {
            true => describe_in(self, x, y, &TABLES),
            false => Vec::new(),
        }
    }

    /// The one or two directions in which most gradients point, radians.
    #[inline(always)]
    fn turns(&self, x: f32, y: f32, tables: &Tables) -> Vec<f32> {
        let mut bins = [0.0f32; TURNS];
        let (cx, cy) = (x.round() as i32, y.round() as i32);
        for (dy, windows) in (-TURN_RADIUS..=TURN_RADIUS).zip(&tables.turn_window) {
            // A corner is `BORDER` from the edge, which is more.
            let begin = (cy + dy) as usize * self.width + (cx - TURN_RADIUS) as usize;
            let row = begin..begin + TURN_SIDE;
            for ((window, size), angle) in windows.iter().zip(&self.size[row.clone()]).zip(&self.angle[row]) {
                let at = angle * (TURNS as f32 / TAU);
                let low = at as usize;
                let share = at - low as f32;
                // It is at most `TURNS`, and comparing is cheaper than dividing.
                let low = if low >= TURNS { 0 } else { low };
                let high = if low + 1 == TURNS { 0 } else { low + 1 };
                bins[low] += window * size * (1.0 - share);
                bins[high] += window * size * share;
            }
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
    #[inline(always)]
    fn histograms(&self, x: f32, y: f32, turn: f32, tables: &Tables) -> Option<GradientDescriptor> {
        let (sin, cos) = turn.sin_cos();
        let mut sums = [0.0f32; NUMBERS];
        let (last_x, last_y) = (self.width as f32 - 1.0, self.height as f32 - 1.0);
        for sample in &tables.samples {
            let [u, v] = sample.offset_px;
            let (px, py) = (x + cos * u - sin * v + 0.5, y + sin * u + cos * v + 0.5);
            // Only the very corners of a turned patch lie outside.
            if !(px >= 0.0 && py >= 0.0 && px <= last_x && py <= last_y) {
                continue;
            }
            let i = py as usize * self.width + px as usize;
            let (size, angle) = (self.size[i], self.angle[i]);
            // Both are in 0..2 pi.
            let towards = if angle < turn { angle - turn + TAU } else { angle - turn } * (DIRECTIONS as f32 / TAU);
            let d = towards as usize;
            let share = towards - d as f32;
            let (low, high) = (d % DIRECTIONS, (d + 1) % DIRECTIONS);
            let (to_low, to_high) = (size * (1.0 - share), size * share);
            for (cell, weight) in &sample.cells[..sample.inside] {
                // Taken modulo its length, which it is below, an array is not asked for it.
                let cell = usize::from(*cell) * DIRECTIONS;
                sums[(cell + low) % NUMBERS] += weight * to_low;
                sums[(cell + high) % NUMBERS] += weight * to_high;
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

/// Where a patch is sampled, and which cells the gradient there counts in by how much.
struct Sample {
    /// From the patch's middle, along its own axes.
    offset_px: [f32; 2],
    /// The nearest four, with the patch's window; the first so many are inside of it.
    cells: [(u8, f32); 4],
    inside: usize,
}

/// What is the same for all patches.
struct Tables {
    samples: Vec<Sample>,
    turn_window: [[f32; TURN_SIDE]; TURN_SIDE],
}

static TABLES: LazyLock<Tables> = LazyLock::new(Tables::new);

impl Tables {
    fn new() -> Self {
        let turn_window = std::array::from_fn(|y| {
            std::array::from_fn(|x| {
                let (dx, dy) = (x as f32 - TURN_RADIUS as f32, y as f32 - TURN_RADIUS as f32);
                (-(dx * dx + dy * dy) / (2.0 * TURN_SIGMA_PX * TURN_SIGMA_PX)).exp()
            })
        });
        // The patch and half a cell around it, whose gradients count in the outermost cells as well.
        let half = 0.5 * CELLS as f32;
        let count = ((CELLS + 1) as f32 * CELL_PX / STEP_PX) as usize;
        let place = |i: usize| (i as f32 + 0.5) * STEP_PX / CELL_PX - half - 0.5;
        let sample = |u: f32, v: f32| {
            let window = (-(u * u + v * v) / (2.0 * half * half)).exp();
            let near = |at: f32| {
                let low = (at + half - 0.5).floor();
                let share = at + half - 0.5 - low;
                [(low as i32, 1.0 - share), (low as i32 + 1, share)]
            };
            let (across, down) = (near(u), near(v));
            let (mut cells, mut inside) = ([(0, 0.0); 4], 0);
            for k in 0..4 {
                let ((column, a), (row, b)) = (across[k % 2], down[k / 2]);
                if (0..CELLS as i32).contains(&column) && (0..CELLS as i32).contains(&row) {
                    cells[inside] = ((row * CELLS as i32 + column) as u8, window * a * b);
                    inside += 1;
                }
            }
            Sample { offset_px: [u * CELL_PX, v * CELL_PX], cells, inside }
        };
        let samples = (0..count * count).map(|i| sample(place(i % count), place(i / count))).collect();
        Self { samples, turn_window }
    }
}

simd_kernel! {
    fn describe_in(map: &GradientMap, x: f32, y: f32, tables: &Tables) -> Vec<TurnedGradients> = describe_body
}

#[inline(always)]
fn describe_body(map: &GradientMap, x: f32, y: f32, tables: &Tables) -> Vec<TurnedGradients> {
    let described = |turn| Some(TurnedGradients { descriptor: map.histograms(x, y, turn, tables)?, turn_rad: turn });
    map.turns(x, y, tables).into_iter().filter_map(described).collect()
}

simd_kernel! {
    /// Size and direction (radians from x towards y, 0 to 2 pi) of the gradients of a row between those above and below it.
    fn gradients_of_row(above: &[f32], row: &[f32], below: &[f32], size: &mut [f32], angle: &mut [f32]) = row_body
}

#[inline(always)]
fn row_body(above: &[f32], row: &[f32], below: &[f32], size: &mut [f32], angle: &mut [f32]) {
    let Some(inner) = row.len().checked_sub(2).filter(|n| *n > 0) else { return };
    let (above, below) = (&above[1..1 + inner], &below[1..1 + inner]);
    let (left, right) = (&row[..inner], &row[2..2 + inner]);
    let (size, angle) = (&mut size[1..1 + inner], &mut angle[1..1 + inner]);
    for x in 0..inner {
        let (gx, gy) = (0.5 * (right[x] - left[x]), 0.5 * (below[x] - above[x]));
        size[x] = (gx * gx + gy * gy).sqrt();
        angle[x] = direction(gx, gy);
    }
}

/// `atan2(y, x)` as 0 to 2 pi, to 2e-4 radians, without a branch: Abramowitz and Stegun 4.4.47 on the smaller over the larger.
#[inline(always)]
fn direction(x: f32, y: f32) -> f32 {
    let (ax, ay) = (x.abs(), y.abs());
    let (small, large) = (ax.min(ay), ax.max(ay));
    let t = small / large.max(f32::MIN_POSITIVE);
    let s = t * t;
    let octant = t * (0.999_866 + s * (-0.330_299_5 + s * (0.180_141 + s * (-0.085_133 + s * 0.020_835_1))));
    let quadrant = if ay > ax { 0.25 * TAU - octant } else { octant };
    let half = if x < 0.0 { 0.5 * TAU - quadrant } else { quadrant };
    if y < 0.0 { TAU - half } else { half }
}

/// The picture under a Gaussian of [`SMOOTHING_PX`]; its edge is repeated outwards.
fn smoothed(picture: &GreyImage) -> Vec<f32> {
    let (width, height) = (picture.width, picture.height);
    let radius = TAPS / 2;
    let mut taps = std::array::from_fn(|k| (-((k as f32 - radius as f32) / SMOOTHING_PX).powi(2) / 2.0).exp());
    let total: f32 = taps.iter().sum();
    taps.iter_mut().for_each(|t| *t /= total);
    let mut across = vec![0.0f32; width * height];
    let mut padded = vec![0.0f32; width + 2 * radius];
    for (y, to) in across.chunks_exact_mut(width.max(1)).enumerate() {
        let row = picture.row(y);
        for (x, p) in padded.iter_mut().enumerate() {
            *p = f32::from(row[x.saturating_sub(radius).min(width - 1)]);
        }
        weighted(&std::array::from_fn(|k| &padded[k..]), &taps, to);
    }
    let mut out = vec![0.0f32; width * height];
    for (y, to) in out.chunks_exact_mut(width.max(1)).enumerate() {
        let row = |k: usize| &across[(y + k).saturating_sub(radius).min(height - 1) * width..][..width];
        weighted(&std::array::from_fn(row), &taps, to);
    }
    out
}

simd_kernel! {
    /// The weighted sum of rows.
    fn weighted(rows: &[&[f32]; TAPS], taps: &[f32; TAPS], out: &mut [f32]) = weighted_body
}

#[inline(always)]
fn weighted_body(rows: &[&[f32]; TAPS], taps: &[f32; TAPS], out: &mut [f32]) {
    let rows = rows.map(|row| &row[..out.len()]);
    for (x, out) in out.iter_mut().enumerate() {
        *out = (0..TAPS).fold(0.0, |sum, k| sum + taps[k] * rows[k][x]);
    }
}

/// Descriptors whose numbers are as wide as what multiplies them, eight at a time, so that comparing two is half of the work:
/// |a - b|² = |a|² + |b|² - 2 a·b.
#[derive(Debug, Default)]
pub struct Widened {
    numbers: Vec<[i16x8; NUMBERS / 8]>,
    squares: Vec<i32>,
}

impl Widened {
    pub fn new(all: &[GradientDescriptor]) -> Self {
        let eight = |d: &GradientDescriptor, i: usize| i16x8::new(std::array::from_fn(|k| i16::from(d.0[8 * i + k])));
        let square = |d: &GradientDescriptor| d.0.iter().map(|v| i32::from(*v).pow(2)).sum();
        let numbers = all.iter().map(|d| std::array::from_fn(|i| eight(d, i))).collect();
        Self { numbers, squares: all.iter().map(square).collect() }
    }

    /// Squared distances of one to all others, in their order.
    pub fn distances_squared(&self, one: usize, to: &Self, out: &mut [u32]) {
        distances_squared(&self.numbers[one], self.squares[one], to, out);
    }
}

simd_kernel! {
    fn distances_squared(of: &[i16x8; NUMBERS / 8], square: i32, to: &Widened, out: &mut [u32]) = distances_body
}

#[inline(always)]
fn distances_body(of: &[i16x8; NUMBERS / 8], square: i32, to: &Widened, out: &mut [u32]) {
    for ((distance, other), other_square) in out.iter_mut().zip(&to.numbers).zip(&to.squares) {
        let product = of.iter().zip(other).fold(i32x4::ZERO, |sum, (a, b)| sum + a.dot(*b)).reduce_add();
        *distance = (square + other_square - 2 * product) as u32;
    }
}

#[cfg(test)]
mod tests;
