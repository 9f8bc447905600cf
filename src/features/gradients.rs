//! Gradient histograms: 128 numbers that describe a corner's surroundings by which way their brightness grows.
//!
//! Purpose: to find a corner again in a picture from far elsewhere, where comparisons of brightness
//! ([`descriptor`](super::descriptor)) no longer agree.
//! Input: one scale of a grey picture ([`GradientMap`], made once) and a corner's place in it, pixels. Output: up to two
//! [`GradientDescriptor`]s, one for each direction in which most gradients point: a corner has two edges, and either may be the stronger.
//! Paper: Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004 (sections 5 and 6: histogram of directions,
//! 4x4 cells of 8 directions, clipped at 0.2); the square root of the L1-normalised numbers instead of themselves is Arandjelović and
//! Zisserman, "Three things everyone should know", CVPR 2012.
//! Cost: 4 ns a pixel for the map, 5 us a corner, 5 ns a comparison of two.
//! It deliberately does not do: finding corners and their scale, the frame path (ten times a binary descriptor's cost).

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
/// Such places to a side: of the patch and half a cell around it.
const SAMPLES: usize = ((CELLS + 1) as f32 * CELL_PX / STEP_PX) as usize;
/// Positions nearer to the edge than this many pixels have no descriptor. Only the very corners of a turned patch may be cut off.
pub const BORDER: usize = 16;
/// One sigma of the smoothing, pixels.
const SMOOTHING_PX: f32 = 1.6;
/// Its weights: three sigmas to either side.
const TAPS: usize = 11;
/// Bins of the histogram that gives the patch its direction.
const TURNS: usize = 36;
/// With room beyond the last, as a power of two, which a number need not be divided by to stay below.
const BINS: usize = 64;
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
    /// Grey levels a pixel; radians from x towards y, 0 to 2 pi.
    gradients: Vec<[f32; 2]>,
    smoother: Smoother,
}

impl GradientMap {
    pub fn new(picture: &GreyImage) -> Self {
        let mut map = Self::default();
        map.fill(picture);
        map
    }

    /// The same of another picture, in the memory that it has.
    pub fn fill(&mut self, picture: &GreyImage) {
        let (width, height) = (picture.width, picture.height);
        (self.width, self.height) = (width, height);
        // What there is of a larger picture beyond stays unused.
        if self.gradients.len() < width * height {
            self.gradients = vec![[0.0; 2]; width * height];
        }
        let smooth = self.smoother.smoothed(picture);
        let rows = self.gradients[..width * height].chunks_exact_mut(width.max(1));
        for (y, gradients) in rows.enumerate() {
            let row = |y: usize| &smooth[y * width..(y + 1) * width];
            // None at the edge.
            match y > 0 && y + 1 < height {
                true => gradients_of_row(row(y - 1), row(y), row(y + 1), gradients),
                false => gradients.fill([0.0; 2]),
            }
        }
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
        let mut bins = [0.0f32; BINS];
        let (cx, cy) = (x.round() as i32, y.round() as i32);
        for (dy, windows) in (-TURN_RADIUS..=TURN_RADIUS).zip(&tables.turn_window) {
            // A corner is `BORDER` from the edge, which is more.
            let begin = (cy + dy) as usize * self.width + (cx - TURN_RADIUS) as usize;
            let row = &self.gradients[begin..begin + TURN_SIDE];
            for (window, [size, angle]) in windows.iter().zip(row) {
                let at = angle * (TURNS as f32 / TAU);
                // Half of a direction is shared out alike, whichever is the nearest below.
                let low = nearest((at - 0.5).max(0.0));
                let strength = window * size;
                let to_high = strength * (at - low as f32);
                bins[low as usize % BINS] += strength - to_high;
                bins[(low as usize + 1) % BINS] += to_high;
            }
        }
        // A full turn is none.
        let (one_turn, beyond) = bins.split_at(TURNS);
        let mut bins: [f32; TURNS] = std::array::from_fn(|k| one_turn[k] + if k < 2 { beyond[k] } else { 0.0 });
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
        let mut cells = [[[0.0f32; DIRECTIONS]; CELLS]; CELLS];
        for v in 0..SAMPLES {
            let mut columns = [[0.0f32; DIRECTIONS]; CELLS];
            let (sizes, towards) = self.gradients_along([x, y], [sin, cos], turn, v, tables);
            for (u, (size, towards)) in sizes.into_iter().zip(towards).enumerate() {
                // A gradient's share of a direction falls from one to nothing at the next one, to either side.
                let mut shares = [0.0; DIRECTIONS];
                for (k, share) in shares.iter_mut().enumerate() {
                    let apart = (towards - k as f32).abs();
                    *share = size * (1.0 - apart.min(DIRECTIONS as f32 - apart)).max(0.0);
                }
                for (cell, weight) in &tables.cells[u] {
                    add(&mut columns[*cell % CELLS], *weight, &shares);
                }
            }
            for (cell, weight) in &tables.cells[v] {
                cells[*cell].iter_mut().zip(&columns).for_each(|(to, from)| add(to, *weight, from));
            }
        }
        let sums = cells.as_flattened().as_flattened();
        let length = sums.iter().map(|s| s * s).sum::<f32>().sqrt();
        if !(length > 0.0 && length.is_finite()) {
            return None;
        }
        let mut clipped = [0.0f32; NUMBERS];
        clipped.iter_mut().zip(sums).for_each(|(to, s)| *to = s.min(CLIP * length));
        let total: f32 = clipped.iter().sum();
        Some(GradientDescriptor(clipped.map(|s| (LENGTH * (s / total).sqrt()).round().min(255.0) as u8)))
    }

    /// Size and direction (in directions of a histogram from the patch's own) of the gradients at one row of a turned patch's samples.
    #[inline(always)]
    fn gradients_along(
        &self,
        [x, y]: [f32; 2],
        [sin, cos]: [f32; 2],
        turn: f32,
        row: usize,
        tables: &Tables,
    ) -> ([f32; SAMPLES], [f32; SAMPLES]) {
        let v = tables.offset_px[row];
        let (last_x, last_y) = (self.width as f32 - 1.0, self.height as f32 - 1.0);
        let (mut places, mut inside) = ([0u32; SAMPLES], [0.0f32; SAMPLES]);
        for k in 0..SAMPLES {
            let u = tables.offset_px[k];
            let (px, py) = (x + cos * u - sin * v, y + sin * u + cos * v);
            // Only the very corners of a turned patch lie outside.
            let is_inside = px >= 0.0 && py >= 0.0 && px <= last_x && py <= last_y;
            places[k] = nearest(py.clamp(0.0, last_y)) * self.width as u32 + nearest(px.clamp(0.0, last_x));
            inside[k] = if is_inside { 1.0 } else { 0.0 };
        }
        let (mut sizes, mut towards) = ([0.0; SAMPLES], [0.0; SAMPLES]);
        for k in 0..SAMPLES {
            [sizes[k], towards[k]] = self.gradients[places[k] as usize];
        }
        for k in 0..SAMPLES {
            sizes[k] *= inside[k];
            // Both angles are in 0..2 pi.
            let from = towards[k] - turn;
            towards[k] = (if from < 0.0 { from + TAU } else { from }) * (DIRECTIONS as f32 / TAU);
        }
        (sizes, towards)
    }
}

/// The nearest whole number of one in 0..2^23, halves to the even one: the language's conversion saturates, which takes ten times as long.
#[inline(always)]
fn nearest(v: f32) -> u32 {
    const MANTISSA: u32 = 1 << (f32::MANTISSA_DIGITS - 1);
    (v + MANTISSA as f32).to_bits() & (MANTISSA - 1)
}

/// `to += weight * from`.
#[inline(always)]
fn add(to: &mut [f32; DIRECTIONS], weight: f32, from: &[f32; DIRECTIONS]) {
    to.iter_mut().zip(from).for_each(|(to, from)| *to += weight * from);
}

/// What is the same for all patches, along either of their axes.
struct Tables {
    /// Where a patch is sampled, from its middle.
    offset_px: [f32; SAMPLES],
    /// Two cells that the gradient there counts in and by how much, with the patch's window: the nearest ones; one that there is not by nothing.
    cells: [[(usize, f32); 2]; SAMPLES],
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
        let half = 0.5 * CELLS as f32;
        // In cells. The patch and half a cell around it, whose gradients count in the outermost cells as well.
        let place = |k: usize| (k as f32 + 0.5) * STEP_PX / CELL_PX - half - 0.5;
        let cells = |k: usize| {
            let window = (-place(k).powi(2) / (2.0 * half * half)).exp();
            let at = place(k) + half - 0.5;
            let share = at - at.floor();
            [(at.floor(), 1.0 - share), (at.floor() + 1.0, share)].map(|(cell, share)| {
                let is_inside = (0.0..CELLS as f32).contains(&cell);
                if is_inside { (cell as usize, window * share) } else { (0, 0.0) }
            })
        };
        Self { offset_px: std::array::from_fn(|k| place(k) * CELL_PX), cells: std::array::from_fn(cells), turn_window }
    }
}

simd_kernel! {
    fn describe_in(map: &GradientMap, x: f32, y: f32, tables: &Tables) -> Vec<TurnedGradients> = describe_body
}

#[inline(always)]
fn describe_body(map: &GradientMap, x: f32, y: f32, tables: &Tables) -> Vec<TurnedGradients> {
    let mut described = Vec::new();
    // A closure would be compiled without the wider registers.
    for turn_rad in map.turns(x, y, tables) {
        if let Some(descriptor) = map.histograms(x, y, turn_rad, tables) {
            described.push(TurnedGradients { descriptor, turn_rad });
        }
    }
    described
}

simd_kernel! {
    /// Size and direction (radians from x towards y, 0 to 2 pi) of the gradients of a row between those above and below it.
    fn gradients_of_row(above: &[f32], row: &[f32], below: &[f32], gradients: &mut [[f32; 2]]) = row_body
}

#[inline(always)]
fn row_body(above: &[f32], row: &[f32], below: &[f32], gradients: &mut [[f32; 2]]) {
    let Some(inner) = row.len().checked_sub(2).filter(|n| *n > 0) else { return gradients.fill([0.0; 2]) };
    let (above, below) = (&above[1..1 + inner], &below[1..1 + inner]);
    let (left, right) = (&row[..inner], &row[2..2 + inner]);
    gradients[0] = [0.0; 2];
    gradients[1 + inner] = [0.0; 2];
    let gradients = &mut gradients[1..1 + inner];
    for x in 0..inner {
        let (gx, gy) = (0.5 * (right[x] - left[x]), 0.5 * (below[x] - above[x]));
        gradients[x] = [(gx * gx + gy * gy).sqrt(), direction(gx, gy)];
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

/// The picture under a Gaussian of [`SMOOTHING_PX`], and memory to make it in.
#[derive(Debug, Clone, Default)]
struct Smoother {
    padded: Vec<f32>,
    across: Vec<f32>,
    smoothed: Vec<f32>,
}

impl Smoother {
    /// Its edge is repeated outwards.
    fn smoothed(&mut self, picture: &GreyImage) -> &[f32] {
        let (width, height) = (picture.width, picture.height);
        let radius = TAPS / 2;
        let mut taps = std::array::from_fn(|k| (-((k as f32 - radius as f32) / SMOOTHING_PX).powi(2) / 2.0).exp());
        let total: f32 = taps.iter().sum();
        taps.iter_mut().for_each(|t| *t /= total);
        let Self { padded, across, smoothed } = self;
        for (buffer, size) in [(&mut *across, width * height), (&mut *smoothed, width * height)] {
            buffer.resize(size.max(buffer.len()), 0.0);
        }
        padded.resize(width + 2 * radius, 0.0);
        let (across, smoothed) = (&mut across[..width * height], &mut smoothed[..width * height]);
        for (y, to) in across.chunks_exact_mut(width.max(1)).enumerate() {
            let row = picture.row(y);
            let (Some(first), Some(last)) = (row.first(), row.last()) else { break };
            padded[..radius].fill(f32::from(*first));
            padded[radius..radius + width].iter_mut().zip(row).for_each(|(p, grey)| *p = f32::from(*grey));
            padded[radius + width..].fill(f32::from(*last));
            weighted(&std::array::from_fn(|k| &padded[k..]), &taps, to);
        }
        for (y, to) in smoothed.chunks_exact_mut(width.max(1)).enumerate() {
            let row = |k: usize| &across[(y + k).saturating_sub(radius).min(height - 1) * width..][..width];
            weighted(&std::array::from_fn(row), &taps, to);
        }
        smoothed
    }
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
