//! SUSAN corners with the 37-pixel mask.
//!
//! Purpose: the method's own detector (the daemon's alternative to FAST). A pixel whose USAN (the part of the mask
//! round it that is as bright as itself) is small is a corner: a straight edge leaves half of the mask, a right-angled
//! corner a quarter.
//! Input: grey picture, [`CellGrid`] with the brightness threshold t of each cell (grey levels, rounded to whole ones).
//! Output: corners at whole level-0 pixels in raster order; response = 1 - sd, sd = USAN area / mask area.
//! Paper: Smith and Brady, "SUSAN - a new approach to low level image processing", IJCV 1997; step and exponential
//! similarity, geometric threshold g, false corners told by the centre of gravity and by contiguity.
//! Cost: below 1 ms for 640x480 with AVX2. A vector pass bounds each pixel's area from below by counting neighbours
//! whose difference is at most a: the area is at least count * c(a). Only what that bound leaves gets its exact area.
//! It deliberately does not do: sub-pixel positions, scale, a limit on the number of corners.

mod usan;

use super::dispatch::simd_kernel;
use super::{Cell, CellGrid, Corner, CornerDetector};
use crate::image::GreyImage;
pub use usan::{MASK_AREA, MASK_RADIUS, Similarity, SusanResponse, Usan, WHOLE, usan};
use usan::{area_in_rows, is_contiguous};

/// Pixels counted at a time.
const BLOCK: usize = 32;

/// Largest suppression radius, pixels.
pub const MAX_SUPPRESSION_PX: usize = 16;

/// In a row of areas: not a corner.
const NO_CORNER: u16 = u16::MAX;

/// Why a [`SusanConfig`] cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SusanConfigError {
    #[error("susan.geometric_threshold is {0}, must be above 0 and below 1 (a share of the mask)")]
    Geometric(f32),
    #[error("susan.suppression_px is {0} px, must be 1 to {MAX_SUPPRESSION_PX} px")]
    Suppression(usize),
    #[error("susan.min_centroid_px is {0} px, must be 0 to {MASK_RADIUS} px")]
    Centroid(f32),
}

/// How SUSAN decides. The brightness threshold t comes with each cell of the grid.
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct SusanConfig {
    pub response: SusanResponse,
    /// g: a corner's salient degree is below it; share of the mask.
    pub geometric_threshold: f32,
    /// Half the side of the square in which only the smallest USAN stays a corner, pixels.
    pub suppression_px: usize,
    /// A corner's USAN has its centre of gravity at least this far from the nucleus, pixels; 0 = not asked.
    /// Noise and thin lines through the nucleus are near 0.
    pub min_centroid_px: f32,
    /// A corner's USAN reaches without a gap from the nucleus, towards its centre of gravity, to the mask's edge.
    pub contiguous: bool,
}

impl Default for SusanConfig {
    fn default() -> Self {
        Self {
            response: SusanResponse::Exponential,
            geometric_threshold: 0.5,
            suppression_px: 3,
            min_centroid_px: 0.0,
            contiguous: false,
        }
    }
}

impl SusanConfig {
    /// Brightness threshold of the preset [`Self::default`], grey levels.
    pub const DEFAULT_T: u8 = 20;
    /// Brightness threshold of the study's presets, grey levels.
    pub const STUDY_T: u8 = 90;

    /// The study's figures: hard step, g = 0.4, with t = 90.
    pub fn study() -> Self {
        Self { response: SusanResponse::Step, geometric_threshold: 0.4, ..Self::default() }
    }

    /// The study's figures for the smoothed response: g = 0.255, with t = 90.
    pub fn study_smoothed() -> Self {
        Self { geometric_threshold: 0.255, ..Self::default() }
    }
}

/// What the vector pass needs of one brightness threshold.
#[derive(Debug, Clone, Copy)]
struct Bound {
    /// Neighbours that differ by at most this are counted.
    difference: u8,
    /// A pixel with more than this many (the nucleus not counted) is no corner.
    count: u8,
}

/// SUSAN with the 37-pixel mask.
#[derive(Debug, Clone)]
pub struct SusanDetector {
    config: SusanConfig,
    /// A corner's area times [`WHOLE`] is below this.
    area_limit: u32,
    /// By threshold, filled when first needed.
    similarities: Vec<Option<(Similarity, Bound)>>,
    rows: Buffers,
}

/// Scratch rows.
#[derive(Debug, Clone, Default)]
struct Buffers {
    /// Areas of the last 2 r + 1 rows, by y modulo that; r more pixels on each side.
    areas: Vec<Vec<u16>>,
    /// Columns of those rows that are below g.
    points: Vec<Vec<u16>>,
    /// Brightness threshold of each pixel of the present row; 0 = not looked at.
    t: Vec<u8>,
    difference: Vec<u8>,
    limit: Vec<u8>,
    /// What the vector pass leaves of the row: not 0.
    left: Vec<u8>,
}

impl Default for SusanDetector {
    fn default() -> Self {
        Self::of_valid(SusanConfig::default())
    }
}

impl SusanDetector {
    /// Fails when a value is out of its range.
    pub fn new(config: SusanConfig) -> Result<Self, SusanConfigError> {
        let g = config.geometric_threshold;
        if !(g > 0.0 && g < 1.0) {
            return Err(SusanConfigError::Geometric(g));
        }
        if !(1..=MAX_SUPPRESSION_PX).contains(&config.suppression_px) {
            return Err(SusanConfigError::Suppression(config.suppression_px));
        }
        if !(0.0..=MASK_RADIUS as f32).contains(&config.min_centroid_px) {
            return Err(SusanConfigError::Centroid(config.min_centroid_px));
        }
        Ok(Self::of_valid(config))
    }

    fn of_valid(config: SusanConfig) -> Self {
        let g = config.geometric_threshold;
        let area_limit = (f64::from(g) * f64::from(MASK_AREA) * f64::from(WHOLE)).ceil() as u32;
        Self { config, area_limit, similarities: vec![None; 256], rows: Buffers::default() }
    }

    pub fn config(&self) -> &SusanConfig {
        &self.config
    }

    /// Corners of the whole picture at one brightness threshold, grey levels. Clears `out`.
    pub fn detect_all(&mut self, image: &GreyImage, t: u8, out: &mut Vec<Corner>) {
        let side = image.width.max(image.height);
        self.detect(image, &CellGrid::new(image.width, image.height, side, f32::from(t)), out);
    }

    /// Makes the table for `t` when it is not there yet.
    fn prepare(&mut self, t: u8) -> Bound {
        let (config, area_limit) = (&self.config, self.area_limit);
        self.similarities[usize::from(t)]
            .get_or_insert_with(|| {
                let similarity = Similarity::new(config.response, t);
                let bound = Bound::new(config.response, t, area_limit, &similarity);
                (similarity, bound)
            })
            .1
    }

    /// Sets the thresholds of row `y`: those of the pixel's own cell, where a wanted cell is within the suppression.
    fn fill_thresholds(&mut self, cells: &CellGrid, y: usize) {
        self.rows.t.fill(0);
        self.rows.difference.fill(u8::MAX);
        self.rows.limit.fill(0);
        let (width, side, spread) = (self.rows.t.len(), cells.cell_px, self.config.suppression_px);
        if side == 0 || y / side >= cells.rows {
            return;
        }
        // 1 where a wanted cell is near.
        let (first, last) = (y.saturating_sub(spread) / side, ((y + spread) / side).min(cells.rows - 1));
        for row in first..=last {
            for column in 0..cells.columns {
                if threshold_of(cells, column, row).is_some_and(|(wanted, _)| wanted) {
                    let begin = (column * side).saturating_sub(spread);
                    let end = ((column + 1) * side + spread).min(width);
                    if begin < end {
                        self.rows.t[begin..end].fill(1);
                    }
                }
            }
        }
        for column in 0..cells.columns.min(width.div_ceil(side)) {
            let range = column * side..((column + 1) * side).min(width);
            let Some((_, t)) = threshold_of(cells, column, y / side) else {
                self.rows.t[range].fill(0);
                continue;
            };
            let bound = self.prepare(t);
            for x in range {
                if self.rows.t[x] != 0 {
                    self.rows.t[x] = t;
                    self.rows.difference[x] = bound.difference;
                    self.rows.limit[x] = bound.count;
                }
            }
        }
    }

    /// Areas of row `y` where they are below g.
    fn measure_row(&mut self, image: &GreyImage, y: usize) {
        let b = &mut self.rows;
        let (at, pad) = (y % b.areas.len(), self.config.suppression_px);
        let rows = std::array::from_fn(|i| image.row(y + i - MASK_RADIUS));
        count_row(&rows, &b.difference, &b.limit, &mut b.left);
        for (chunk, bytes) in b.left.chunks_exact(8).enumerate() {
            let mut bits = u64::from_le_bytes(std::array::from_fn(|i| bytes[i]));
            while bits != 0 {
                let i = bits.trailing_zeros() as usize / 8;
                bits &= !(0xff << (8 * i));
                let x = 8 * chunk + i;
                let Some((similarity, _)) = &self.similarities[usize::from(b.t[x])] else { continue };
                let Some(area) = area_in_rows(&rows, x, similarity) else { continue };
                if u32::from(area) < self.area_limit && is_true(&self.config, image, x, y, similarity) {
                    b.areas[at][pad + x] = area;
                    b.points[at].push(x as u16);
                }
            }
        }
    }

    /// Appends the corners of row `y` that have the smallest area of their neighbourhood.
    fn suppress_row(&self, cells: &CellGrid, y: usize, out: &mut Vec<Corner>) {
        let (b, n, r) = (&self.rows, self.rows.areas.len(), self.config.suppression_px);
        for &x in &b.points[y % n] {
            let x = usize::from(x);
            let area = b.areas[y % n][r + x];
            let beaten = |row: usize| {
                // Rows y - r .. y + r are all in the buffer; of equals the first in raster order wins.
                let row_areas = &b.areas[(y + n + row - r) % n][x..=x + 2 * r];
                let (before, after) = row_areas.split_at(if row < r {
                    2 * r + 1
                } else if row > r {
                    0
                } else {
                    r
                });
                before.iter().any(|&a| a <= area) || after.iter().any(|&a| a < area)
            };
            if !beaten(r) && (0..=2 * r).filter(|&row| row != r).all(|row| !beaten(row)) {
                let (px, py) = (x as f32, y as f32);
                if cells.index(px, py).is_some_and(|i| cells.cells[i].wanted) {
                    let sd = f32::from(area) / (MASK_AREA as f32 * f32::from(WHOLE));
                    out.push(Corner { x: px, y: py, response: 1.0 - sd });
                }
            }
        }
    }
}

impl CornerDetector for SusanDetector {
    fn detect(&mut self, image: &GreyImage, cells: &CellGrid, out: &mut Vec<Corner>) {
        out.clear();
        let (width, height) = (image.width, image.height);
        if width <= 2 * MASK_RADIUS || height <= 2 * MASK_RADIUS || width > usize::from(u16::MAX) {
            return;
        }
        let r = self.config.suppression_px;
        self.rows.resize(width, r);
        let last = height - MASK_RADIUS;
        let side = cells.cell_px.max(1);
        let mut bands = None;
        // Past the last row nothing is measured, but the rows above it are finished.
        for y in MASK_RADIUS..last + r {
            self.rows.clear_row(y);
            if y < last {
                let now = [y.saturating_sub(r) / side, y / side, (y + r) / side];
                if bands != Some(now) {
                    self.fill_thresholds(cells, y);
                    bands = Some(now);
                }
                self.measure_row(image, y);
            }
            if y >= MASK_RADIUS + r {
                self.suppress_row(cells, y - r, out);
            }
        }
    }
}

impl Buffers {
    fn resize(&mut self, width: usize, r: usize) {
        self.areas.resize_with(2 * r + 1, Vec::new);
        self.points.resize_with(2 * r + 1, Vec::new);
        for (areas, points) in self.areas.iter_mut().zip(&mut self.points) {
            areas.clear();
            areas.resize(width + 2 * r, NO_CORNER);
            points.clear();
            points.reserve(width);
        }
        for row in [&mut self.t, &mut self.difference, &mut self.limit] {
            row.resize(width, 0);
        }
        self.left.clear();
        self.left.resize(width.next_multiple_of(8), 0);
    }

    fn clear_row(&mut self, y: usize) {
        let at = y % self.areas.len();
        self.areas[at].fill(NO_CORNER);
        self.points[at].clear();
    }
}

impl Bound {
    /// The best count: as many neighbours as still leave count * c(difference) below the limit.
    fn new(response: SusanResponse, t: u8, area_limit: u32, similarity: &Similarity) -> Self {
        let whole = u32::from(WHOLE);
        let difference = match response {
            SusanResponse::Step => t.max(1) - 1,
            // Measured: 0.7 t leaves the fewest pixels; c(0.7) = 0.89.
            SusanResponse::Exponential => (7 * u32::from(t) / 10) as u8,
        };
        let c = u32::from(similarity.at_difference(difference)).max(1);
        // whole + count * c <= area_limit - 1, the nucleus counting whole.
        let count = area_limit.saturating_sub(1 + whole) / c;
        Self { difference, count: count.min(MASK_AREA - 1) as u8 }
    }
}

/// (wanted, brightness threshold in whole grey levels, 1 to 255); `None` where the threshold is not a number.
fn threshold_of(cells: &CellGrid, column: usize, row: usize) -> Option<(bool, u8)> {
    let Cell { wanted, threshold } = *cells.cells.get(row * cells.columns + column)?;
    (!threshold.is_nan()).then(|| (wanted, threshold.round().clamp(1.0, 255.0) as u8))
}

/// Whether a small USAN is a corner's, by the paper's two questions as far as the configuration asks them.
fn is_true(config: &SusanConfig, image: &GreyImage, x: usize, y: usize, similarity: &Similarity) -> bool {
    if config.min_centroid_px <= 0.0 && !config.contiguous {
        return true;
    }
    let Some(usan) = usan(image, x, y, similarity) else { return false };
    let [cx, cy] = usan.centroid;
    let far = cx * cx + cy * cy >= config.min_centroid_px * config.min_centroid_px;
    far && (!config.contiguous || (cx, cy) == (0.0, 0.0) || is_contiguous(image, x, y, usan.centroid, similarity))
}

simd_kernel! {
    /// `left[x]` is not 0 where at most `limit[x]` of the 36 neighbours differ by at most `difference[x]`.
    fn count_row(rows: &[&[u8]; 7], difference: &[u8], limit: &[u8], left: &mut [u8]) = count_row_body
}

#[inline(always)]
fn count_row_body(rows: &[&[u8]; 7], difference: &[u8], limit: &[u8], left: &mut [u8]) {
    let end = limit.len() - MASK_RADIUS;
    let mut x = MASK_RADIUS;
    while x + BLOCK <= end {
        count_block::<BLOCK>(rows, x, difference, limit, left);
        x += BLOCK;
    }
    if x < end && end >= MASK_RADIUS + BLOCK {
        count_block::<BLOCK>(rows, end - BLOCK, difference, limit, left);
        x = end;
    }
    while x < end {
        count_block::<1>(rows, x, difference, limit, left);
        x += 1;
    }
}

#[inline(always)]
fn count_block<const N: usize>(rows: &[&[u8]; 7], x: usize, difference: &[u8], limit: &[u8], left: &mut [u8]) {
    let rows = rows.map(|row| &row[x - MASK_RADIUS..x + MASK_RADIUS + N]);
    let (difference, limit) = (window::<N>(difference, x), window::<N>(limit, x));
    let Some(left) = left[x..].first_chunk_mut::<N>() else { return };
    let at = |dx: usize, dy: usize| window::<N>(rows[dy], dx);
    let nucleus = at(3, 3);
    let (mut low, mut high) = ([0; N], [0; N]);
    for i in 0..N {
        low[i] = nucleus[i].saturating_sub(difference[i]);
        high[i] = nucleus[i].saturating_add(difference[i]);
    }
    // 1 where the neighbour lies in the band, that is where clamping does not change it.
    macro_rules! count {
        ($into:ident, $($dx:literal $dy:literal),*) => {
            for i in 0..N {
                let inside = |p: u8| u8::from(p.max(low[i]).min(high[i]) == p);
                $into[i] += 0 $( + inside(at($dx, $dy)[i]))*;
            }
        };
    }
    let mut count = [0u8; N];
    count!(count, 1 1, 2 1, 3 1, 4 1, 5 1, 1 2, 2 2, 3 2, 4 2, 5 2, 1 3, 2 3, 4 3, 5 3,
        1 4, 2 4, 3 4, 4 4, 5 4, 1 5, 2 5, 3 5, 4 5, 5 5);
    // Even areas are done here: the inner square alone has too many.
    let mut room = 0;
    for i in 0..N {
        room |= (limit[i] + 1).saturating_sub(count[i]);
    }
    if room != 0 {
        count!(count, 2 0, 3 0, 4 0, 0 2, 6 2, 0 3, 6 3, 0 4, 6 4, 2 6, 3 6, 4 6);
    }
    for i in 0..N {
        left[i] = (limit[i] + 1).saturating_sub(count[i]);
    }
}

/// `N` pixels of a row from `x` on.
#[inline(always)]
fn window<const N: usize>(row: &[u8], x: usize) -> &[u8; N] {
    row[x..].first_chunk().expect("callers stay inside the row")
}

#[cfg(test)]
mod tests;
