//! SUSAN corners with the 37-pixel mask.
//!
//! Purpose: the method's own detector (the daemon's alternative to FAST). A pixel whose USAN (the part of the mask
//! round it that is as bright as itself) is small is a corner: a straight edge leaves half of the mask, a right-angled
//! corner a quarter.
//! Input: grey picture, [`CellGrid`] with the brightness threshold t of each cell (grey levels, rounded to whole ones).
//! Output: corners at whole level-0 pixels in raster order; what the response means: [`SusanStrength`].
//! Paper: Smith and Brady, "SUSAN - a new approach to low level image processing", IJCV 1997; step and exponential
//! similarity, geometric threshold g, false corners told by the centre of gravity and by contiguity.
//! Cost: 1.9 ms of thread time for 640x480 at t = 20, 1.4 ms at 25 (AVX2, loaded machine). A vector pass bounds each pixel's area from below by counting neighbours
//! whose difference is at most a: the area is at least count * c(a). Only what that bound leaves gets its exact area.
//! It deliberately does not do: sub-pixel positions, scale, a limit on the number of corners.

mod config;
mod kernels;
mod usan;

use super::{Cell, CellGrid, Corner, CornerDetector};
use crate::image::GreyImage;
pub use config::{MAX_SUPPRESSION_PX, SusanConfig, SusanConfigError, SusanStrength};
pub(super) use kernels::count_row as similar_counts;
use kernels::{count_row, smooth_row, smooth_strengths};
pub use usan::{MASK_AREA, MASK_RADIUS, Similarity, SusanResponse, Usan, WHOLE, usan};
use usan::{Mask, area_in_rows};

/// Masks gathered before they are summed up: a vector loaded right after its parts were stored would have to wait.
const BATCH: usize = 16;

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
    /// By threshold, filled when first needed: at most 256 of a kilobyte.
    similarities: Vec<Option<(Similarity, Bound)>>,
    smoothed: GreyImage,
    rows: Rows,
}

/// Scratch rows. Strengths have a margin on each side; 0 = no corner.
#[derive(Debug, Clone, Default)]
struct Rows {
    margin: usize,
    /// As measured, by y modulo 3.
    raw: [Vec<f32>; 3],
    /// Columns of those rows that are below g.
    raw_points: [Vec<u16>; 3],
    /// As compared, the last 2 r + 1 rows, by y modulo that.
    strengths: Vec<Vec<f32>>,
    points: Vec<Vec<u16>>,
    /// One row of averages.
    average: Vec<f32>,
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
    /// Fails when a value of `config` is out of its range.
    pub fn new(config: SusanConfig) -> Result<Self, SusanConfigError> {
        config.check()?;
        Ok(Self::of_valid(config))
    }

    fn of_valid(config: SusanConfig) -> Self {
        let limit = f64::from(config.geometric_threshold) * f64::from(MASK_AREA) * f64::from(WHOLE);
        Self {
            config,
            area_limit: limit.ceil() as u32,
            similarities: vec![None; 256],
            smoothed: GreyImage::default(),
            rows: Rows::default(),
        }
    }

    /// Corners of the whole picture at one brightness threshold, grey levels. Clears `out`.
    pub fn detect_all(&mut self, image: &GreyImage, t: u8, out: &mut Vec<Corner>) {
        let side = image.width.max(image.height);
        self.detect(image, &CellGrid::new(image.width, image.height, side, f32::from(t)), out);
    }

    /// How far from a wanted cell a pixel can still change its corners, pixels.
    fn reach(&self) -> usize {
        self.config.suppression_px + usize::from(self.config.strength == SusanStrength::Moment)
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

    /// Sets the thresholds of row `y`: those of the pixel's own cell, where a wanted cell is within reach.
    fn fill_thresholds(&mut self, cells: &CellGrid, y: usize) {
        self.rows.t.fill(0);
        self.rows.difference.fill(u8::MAX);
        self.rows.limit.fill(0);
        let (width, side, reach) = (self.rows.t.len(), cells.cell_px, self.reach());
        if side == 0 || y / side >= cells.rows {
            return;
        }
        // 1 where a wanted cell is near.
        let (first, last) = (y.saturating_sub(reach) / side, ((y + reach) / side).min(cells.rows - 1));
        for row in first..=last {
            for column in 0..cells.columns {
                if threshold_of(cells, column, row).is_some_and(|(wanted, _)| wanted) {
                    let begin = (column * side).saturating_sub(reach);
                    let end = ((column + 1) * side + reach).min(width);
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
        // Pixels beyond the last column of cells are in none.
        let covered = (cells.columns * side).min(width);
        self.rows.t[covered..].fill(0);
    }

    /// Measures the strengths of row `y` where the area is below g.
    fn measure_row(&mut self, image: &GreyImage, y: usize) {
        let Rows { margin, raw, raw_points, t, difference, limit, left, .. } = &mut self.rows;
        let (raw, points) = (&mut raw[y % 3][*margin..], &mut raw_points[y % 3]);
        let rows = std::array::from_fn(|i| image.row(y + i - MASK_RADIUS));
        count_row(&rows, difference, limit, left);
        let by_area = self.config.strength == SusanStrength::SalientDegree && !self.config.asks();
        let mut batch = [(0, 0, Mask::default()); BATCH];
        let mut n = 0;
        let mut finish = |batch: &[(usize, u16, Mask)]| {
            for (x, area, mask) in batch {
                if let Some(strength) = strength_of(&self.config, *area, mask) {
                    raw[*x] = strength;
                    points.push(*x as u16);
                }
            }
        };
        for (chunk, bytes) in left.chunks_exact(8).enumerate() {
            let mut bits = u64::from_le_bytes(std::array::from_fn(|i| bytes[i]));
            while bits != 0 {
                let i = bits.trailing_zeros() as usize / 8;
                bits &= !(0xff << (8 * i));
                let x = 8 * chunk + i;
                let Some((similarity, _)) = &self.similarities[usize::from(t[x])] else { continue };
                let Some(area) = area_in_rows(&rows, x, similarity) else { continue };
                if u32::from(area) >= self.area_limit {
                    continue;
                }
                let (to_x, to_area, mask) = &mut batch[n];
                (*to_x, *to_area) = (x, area);
                if by_area || mask.gather(&rows, x, similarity) {
                    n += 1;
                }
                if n == BATCH {
                    finish(&batch);
                    n = 0;
                }
            }
        }
        finish(&batch[..n]);
    }

    /// Moves row `y` of measured strengths on, averaged or as it is.
    fn pass_row(&mut self, y: usize) {
        let b = &mut self.rows;
        let at = y % b.strengths.len();
        let (to, points) = (&mut b.strengths[at], &mut b.points[at]);
        to.fill(0.0);
        points.clone_from(&b.raw_points[y % 3]);
        if points.is_empty() {
            return;
        }
        let rows = [&b.raw[(y + 2) % 3], &b.raw[y % 3], &b.raw[(y + 1) % 3]];
        if self.config.strength == SusanStrength::Moment {
            let width = b.t.len();
            smooth_strengths(rows.map(|row| &row[b.margin - 1..]), &mut b.average[..width]);
            for &x in points.iter() {
                to[b.margin + usize::from(x)] = b.average[usize::from(x)];
            }
        } else {
            to.copy_from_slice(rows[1]);
        }
    }

    /// Appends the corners of row `y`: the strongest of their neighbourhood; of equals the first in raster order.
    fn suppress_row(&self, cells: &CellGrid, y: usize, out: &mut Vec<Corner>) {
        let (b, n, r) = (&self.rows, self.rows.strengths.len(), self.config.suppression_px);
        for &x in &b.points[y % n] {
            let x = usize::from(x);
            let response = b.strengths[y % n][b.margin + x];
            let left = b.margin + x - r;
            // Rows y - r .. y + r are all in the buffer.
            let window = |row: usize| &b.strengths[(y + n + row - r) % n][left..=left + 2 * r];
            // The nearest neighbours decide most often.
            let near = |row: usize| window(row)[r - 1].max(window(row)[r]).max(window(row)[r + 1]);
            if near(r).max(near(r - 1)).max(near(r + 1)) > response {
                continue;
            }
            let below = |strengths: &[f32]| strengths.iter().all(|&s| s < response);
            let not_above = |strengths: &[f32]| strengths.iter().all(|&s| s <= response);
            let wins = (0..r).all(|row| below(window(row)))
                && below(&window(r)[..r])
                && not_above(&window(r)[r..])
                && (r + 1..=2 * r).all(|row| not_above(window(row)));
            let (x, y) = (x as f32, y as f32);
            if wins && cells.index(x, y).is_some_and(|i| cells.cells[i].wanted) {
                out.push(Corner { x, y, response });
            }
        }
    }

    fn detect_in(&mut self, image: &GreyImage, cells: &CellGrid, out: &mut Vec<Corner>) {
        let (r, reach, last) = (self.config.suppression_px, self.reach(), image.height - MASK_RADIUS);
        let side = cells.cell_px.max(1);
        let mut bands = None;
        // Past the last row nothing is measured, but the rows above it are finished.
        for y in MASK_RADIUS..=last + r {
            let raw = y % 3;
            self.rows.raw[raw].fill(0.0);
            self.rows.raw_points[raw].clear();
            if y < last {
                let now = [y.saturating_sub(reach) / side, y / side, (y + reach) / side];
                if bands != Some(now) {
                    self.fill_thresholds(cells, y);
                    bands = Some(now);
                }
                self.measure_row(image, y);
            }
            // One row later its neighbours are measured, r rows after that compared.
            if y > MASK_RADIUS {
                self.pass_row(y - 1);
            }
            if y > MASK_RADIUS + r {
                self.suppress_row(cells, y - 1 - r, out);
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
        self.rows.resize(width, self.config.suppression_px);
        if !self.config.smooth {
            self.detect_in(image, cells, out);
            return;
        }
        let mut smoothed = std::mem::take(&mut self.smoothed);
        smoothed.resize(width, height);
        for (y, to) in smoothed.data.chunks_exact_mut(width).enumerate() {
            let (above, below) = (y.saturating_sub(1), (y + 1).min(height - 1));
            smooth_row(image.row(above), image.row(y), image.row(below), to);
        }
        self.detect_in(&smoothed, cells, out);
        self.smoothed = smoothed;
    }
}

impl Rows {
    fn resize(&mut self, width: usize, r: usize) {
        self.margin = r.max(1);
        let wide = width + 2 * self.margin;
        self.strengths.resize_with(2 * r + 1, Vec::new);
        self.points.resize_with(2 * r + 1, Vec::new);
        for row in self.strengths.iter_mut().chain(&mut self.raw) {
            row.clear();
            row.resize(wide, 0.0);
        }
        for points in self.points.iter_mut().chain(&mut self.raw_points) {
            points.clear();
            points.reserve(width);
        }
        self.average.resize(width, 0.0);
        for row in [&mut self.t, &mut self.difference, &mut self.limit] {
            row.resize(width, 0);
        }
        self.left.clear();
        self.left.resize(width.next_multiple_of(8), 0);
    }
}

impl Bound {
    /// As many neighbours as still can leave an area below the limit: count * c(difference) is the least they add.
    fn new(response: SusanResponse, t: u8, area_limit: u32, similarity: &Similarity) -> Self {
        let difference = match response {
            SusanResponse::Step => t.max(1) - 1,
            // Measured: 0.7 t leaves the fewest pixels; c(0.7 t) = 0.89.
            SusanResponse::Exponential => (7 * u32::from(t) / 10) as u8,
        };
        let c = u32::from(similarity.at_difference(difference)).max(1);
        // The nucleus counts whole: WHOLE + count * c <= area_limit - 1.
        let count = area_limit.saturating_sub(1 + u32::from(WHOLE)) / c;
        Self { difference, count: count.min(MASK_AREA - 1) as u8 }
    }
}

/// (wanted, brightness threshold in whole grey levels, 1 to 255); `None` where the threshold is not a number.
fn threshold_of(cells: &CellGrid, column: usize, row: usize) -> Option<(bool, u8)> {
    let Cell { wanted, threshold } = *cells.cells.get(row * cells.columns + column)?;
    (!threshold.is_nan()).then(|| (wanted, threshold.round().clamp(1.0, 255.0) as u8))
}

/// The strength of a pixel whose area is below g; `None` where the paper's questions, as far as the configuration asks
/// them, tell a false corner.
fn strength_of(config: &SusanConfig, area: u16, mask: &Mask) -> Option<f32> {
    let by_area = 1.0 - f32::from(area) / (MASK_AREA as f32 * f32::from(WHOLE));
    if config.strength == SusanStrength::SalientDegree && !config.asks() {
        return Some(by_area);
    }
    let (centroid @ [cx, cy], contrast) = mask.first_moments(area);
    let distance = (cx * cx + cy * cy).sqrt();
    let told =
        || (config.contiguous && !mask.is_contiguous(centroid)) || (config.reject_edges && mask.is_edge(centroid));
    if distance < config.min_centroid_px || (distance > 0.0 && told()) {
        return None;
    }
    let strength = match config.strength {
        SusanStrength::SalientDegree => by_area,
        SusanStrength::Moment => contrast * distance,
    };
    (strength > 0.0).then_some(strength)
}

#[cfg(test)]
mod tests;
