//! SUSAN corners with the 41x41 mask, in one pass or two.
//!
//! Purpose: the method's large mask. It finds the true corners where the 37-pixel mask answers to nearly every edge, and
//! is slow; so two passes: the small mask over the whole picture, the large one only where the small one answered.
//! Input: grey picture, [`CellGrid`] with the brightness threshold t of each cell (grey levels, rounded).
//! Output: corners at whole level-0 pixels in raster order; response = 1 - sd of the large mask.
//! Mask: the 1257 pixels within 20 of the nucleus; a perfect corner has sd 0.266 (along the axes) or 0.262 (diagonal),
//! an edge 0.52. Paper: Smith and Brady, SUSAN, IJCV 1997; the two passes are the method's own.
//! Both schemes look for the same thing: a pixel whose area is below g and the smallest within the suppression radius, of
//! equals the first in raster order. The second pass starts at the pixels that the first answered to and goes downhill
//! from each, to pixels that the first did not answer to as well; so what it finds is always a corner of the single pass.
//! It can miss one that has no answering pixel on any way down to it.
//! Cost: 0.08 us a pixel measured (AVX2); single pass 20 ms for 640x480, two passes 1 to 2 ms.
//! It deliberately does not do: corners within 20 pixels of the edge, texture (a large mask fails there).

use super::dispatch::simd_kernel;
use super::susan::{MASK_AREA, MASK_RADIUS, MAX_SUPPRESSION_PX, Similarity, SusanResponse, WHOLE, similar_counts};
use super::{CellGrid, Corner, CornerDetector};
use crate::image::GreyImage;

/// Radius of the large mask, pixels; corners are at least this far from the picture's edge.
pub const LARGE_RADIUS: usize = 20;

/// Pixels of the large mask, the nucleus with them.
pub const LARGE_AREA: u32 = 1257;

/// Rows and columns of the large mask.
const SIDE: usize = 2 * LARGE_RADIUS + 1;

/// A row of the mask padded to whole vectors.
const LANES: usize = 48;

/// Areas are kept in 1 / 32 pixel: 1257 of them fit 16 bits.
const AREA_SCALE: u32 = 32;

/// Not measured yet.
const UNKNOWN: u16 = u16::MAX;
/// Measured, at or above g.
const LARGE: u16 = u16::MAX - 1;

/// Why a [`LargeSusanConfig`] cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LargeSusanConfigError {
    #[error("susan_large.geometric_threshold is {0}, must be above 0 and below 1 (a share of the mask)")]
    Geometric(f32),
    #[error("susan_large.first_pass is {0}, must be above 0 and below 1 (a share of the mask)")]
    FirstPass(f32),
    #[error("susan_large.suppression_px is {0} px, must be 1 to {MAX_SUPPRESSION_PX} px")]
    Suppression(usize),
}

/// How the large mask decides.
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct LargeSusanConfig {
    pub response: SusanResponse,
    /// g: a corner's salient degree is below it; share of the mask.
    pub geometric_threshold: f32,
    /// Half the side of the square in which only the smallest USAN stays a corner, pixels.
    pub suppression_px: usize,
    /// Two passes: the large mask only where the small one's salient degree (hard step, same t) is below this; without it
    /// one pass. 0.65 lets edges through (0.59), as the method's first pass does.
    pub first_pass: Option<f32>,
}

impl Default for LargeSusanConfig {
    /// The study's g, two passes.
    fn default() -> Self {
        Self { response: SusanResponse::Step, geometric_threshold: 0.4, suppression_px: 5, first_pass: Some(0.65) }
    }
}

/// What a detection did, to compare the schemes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LargeSusanCounts {
    /// Pixels that the first pass answered to; all that the mask reaches in a single pass.
    pub answered: usize,
    /// Pixels that the large mask was laid on.
    pub measured: usize,
}

/// SUSAN with the 41x41 mask.
#[derive(Debug, Clone)]
pub struct LargeSusanDetector {
    config: LargeSusanConfig,
    /// By threshold, filled when first needed.
    similarities: Vec<Option<Similarity>>,
    /// Area of each pixel times [`AREA_SCALE`], or [`LARGE`], or [`UNKNOWN`].
    areas: Vec<u16>,
    /// Brightness threshold of each pixel's cell; 0 = none.
    t: Vec<u8>,
    /// Pixels to start from, as indices.
    starts: Vec<u32>,
    found: Vec<u32>,
    rows: FirstPassRows,
    counts: LargeSusanCounts,
}

/// Scratch rows of the first pass.
#[derive(Debug, Clone, Default)]
struct FirstPassRows {
    difference: Vec<u8>,
    limit: Vec<u8>,
    left: Vec<u8>,
}

impl LargeSusanDetector {
    /// Fails when a value of `config` is out of its range.
    pub fn new(config: LargeSusanConfig) -> Result<Self, LargeSusanConfigError> {
        let is_share = |g: f32| g > 0.0 && g < 1.0;
        if !is_share(config.geometric_threshold) {
            return Err(LargeSusanConfigError::Geometric(config.geometric_threshold));
        }
        if let Some(g) = config.first_pass.filter(|g| !is_share(*g)) {
            return Err(LargeSusanConfigError::FirstPass(g));
        }
        if !(1..=MAX_SUPPRESSION_PX).contains(&config.suppression_px) {
            return Err(LargeSusanConfigError::Suppression(config.suppression_px));
        }
        Ok(Self {
            config,
            similarities: vec![None; 256],
            areas: Vec::new(),
            t: Vec::new(),
            starts: Vec::new(),
            found: Vec::new(),
            rows: FirstPassRows::default(),
            counts: LargeSusanCounts::default(),
        })
    }

    pub fn config(&self) -> &LargeSusanConfig {
        &self.config
    }

    /// What the last detection did.
    pub fn counts(&self) -> LargeSusanCounts {
        self.counts
    }

    /// Corners of the whole picture at one brightness threshold, grey levels. Clears `out`.
    pub fn detect_all(&mut self, image: &GreyImage, t: u8, out: &mut Vec<Corner>) {
        let side = image.width.max(image.height);
        self.detect(image, &CellGrid::new(image.width, image.height, side, f32::from(t)), out);
    }

    /// Thresholds of all pixels, and the similarities that they need.
    fn fill_thresholds(&mut self, image: &GreyImage, cells: &CellGrid) {
        self.t.clear();
        self.t.resize(image.data.len(), 0);
        if cells.cell_px == 0 {
            return;
        }
        for (y, row) in self.t.chunks_exact_mut(image.width).enumerate() {
            let first = y / cells.cell_px * cells.columns;
            for (column, pixels) in row.chunks_mut(cells.cell_px).enumerate().take(cells.columns) {
                let Some(t) = cells.cells.get(first + column).map(|c| c.threshold).filter(|t| !t.is_nan()) else {
                    continue;
                };
                let t = t.round().clamp(1.0, 255.0) as u8;
                pixels.fill(t);
                self.similarities[usize::from(t)].get_or_insert_with(|| Similarity::new(self.config.response, t));
            }
        }
    }

    /// The pixels to start from: all of the wanted cells, or those that the small mask answers to.
    fn first_pass(&mut self, image: &GreyImage, cells: &CellGrid) {
        self.starts.clear();
        let (width, r) = (image.width, LARGE_RADIUS);
        let rows = &mut self.rows;
        rows.difference.resize(width, 0);
        rows.limit.resize(width, 0);
        rows.left.clear();
        rows.left.resize(width, 0);
        // sd < g leaves count + 1 < g * 37, the nucleus being one.
        let limit = self.config.first_pass.map(|g| ((g * MASK_AREA as f32).ceil() as u8).saturating_sub(2));
        for y in r..image.height - r {
            let t = &self.t[y * width..(y + 1) * width];
            if let Some(limit) = limit {
                for x in 0..width {
                    // Where there is no threshold, everything is similar and nothing is left.
                    rows.difference[x] = t[x].wrapping_sub(1);
                    rows.limit[x] = if t[x] == 0 { 0 } else { limit };
                }
                let seven = std::array::from_fn(|i| image.row(y + i - MASK_RADIUS));
                similar_counts(&seven, &rows.difference, &rows.limit, &mut rows.left);
            } else {
                rows.left.iter_mut().zip(t).for_each(|(left, t)| *left = *t);
            }
            for x in (r..width - r).filter(|&x| rows.left[x] != 0) {
                if cells.index(x as f32, y as f32).is_some_and(|i| cells.cells[i].wanted) {
                    self.starts.push((y * width + x) as u32);
                }
            }
        }
    }

    /// Area of the pixel at index `at`, measured when it is not known yet.
    fn area(&mut self, image: &GreyImage, at: usize) -> u16 {
        if self.areas[at] == UNKNOWN {
            let (x, y, r) = (at % image.width, at / image.width, LARGE_RADIUS);
            let reached = x >= r && y >= r && x + r < image.width && y + r < image.height;
            self.areas[at] = match &self.similarities[usize::from(self.t[at])] {
                Some(similarity) if reached => {
                    self.counts.measured += 1;
                    measure(image, (x, y), self.t[at], &self.config, similarity)
                }
                _ => LARGE,
            };
        }
        self.areas[at]
    }

    /// Whether `at`, an index, is below g and smaller than all that is measured in its neighbourhood.
    fn is_lowest(&self, width: usize, at: usize) -> bool {
        let (r, area) = (self.config.suppression_px, self.areas[at]);
        // Starts are at least LARGE_RADIUS > r pixels from the picture's edge.
        area < LARGE
            && (0..=2 * r).all(|row| {
                let begin = at - r * width - r + row * width;
                let areas = self.areas[begin..=begin + 2 * r].iter().zip(begin..);
                areas.fold(true, |lowest, (&other, i)| lowest & !((other < area) | ((other == area) & (i < at))))
            })
    }

    /// Goes from pixel `at`, below g, to the smallest area of its neighbourhood, again and again.
    fn descend(&mut self, image: &GreyImage, mut at: usize) -> usize {
        let (width, r) = (image.width, self.config.suppression_px);
        loop {
            // All that is below g is at least LARGE_RADIUS > r pixels from the picture's edge.
            let (mut best, mut best_area) = (at, self.areas[at]);
            let corner = at - r * width - r;
            for row in 0..=2 * r {
                for neighbour in corner + row * width..=corner + row * width + 2 * r {
                    let area = self.area(image, neighbour);
                    // Ascending indices are raster order.
                    if area < best_area || (area == best_area && neighbour < best) {
                        (best, best_area) = (neighbour, area);
                    }
                }
            }
            if best == at {
                return at;
            }
            // (area, index) falls with every step, so this ends.
            at = best;
        }
    }
}

impl CornerDetector for LargeSusanDetector {
    fn detect(&mut self, image: &GreyImage, cells: &CellGrid, out: &mut Vec<Corner>) {
        out.clear();
        self.counts = LargeSusanCounts::default();
        if image.width <= 2 * LARGE_RADIUS || image.height <= 2 * LARGE_RADIUS {
            return;
        }
        self.fill_thresholds(image, cells);
        self.areas.clear();
        self.areas.resize(image.data.len(), UNKNOWN);
        self.first_pass(image, cells);
        self.counts.answered = self.starts.len();
        self.found.clear();
        let starts = std::mem::take(&mut self.starts);
        for &at in &starts {
            self.area(image, at as usize);
        }
        // So far only starts are measured: one with a smaller start as neighbour leaves the way down to that.
        let mut found = std::mem::take(&mut self.found);
        found.extend(starts.iter().filter(|&&at| self.is_lowest(image.width, at as usize)));
        for at in &mut found {
            *at = self.descend(image, *at as usize) as u32;
        }
        self.found = found;
        self.starts = starts;
        self.found.sort_unstable();
        self.found.dedup();
        for &at in &self.found {
            let (x, y) = ((at as usize % image.width) as f32, (at as usize / image.width) as f32);
            if cells.index(x, y).is_some_and(|i| cells.cells[i].wanted) {
                let sd = f32::from(self.areas[at as usize]) / (LARGE_AREA * AREA_SCALE) as f32;
                out.push(Corner { x, y, response: 1.0 - sd });
            }
        }
    }
}

/// Area of one pixel times [`AREA_SCALE`], or [`LARGE`] where it is not below g.
fn measure(
    image: &GreyImage,
    (x, y): (usize, usize),
    t: u8,
    config: &LargeSusanConfig,
    similarity: &Similarity,
) -> u16 {
    let limit = config.geometric_threshold * LARGE_AREA as f32;
    let within = |area: f32| if area < limit { (area * AREA_SCALE as f32) as u16 } else { LARGE };
    match config.response {
        SusanResponse::Step => within(count_similar(image, x, y, t - 1) as f32),
        SusanResponse::Exponential => {
            // The area is at least count * c; most pixels are done with by that.
            let difference = (7 * u32::from(t) / 10) as u8;
            let c = f32::from(similarity.at_difference(difference)) / f32::from(WHOLE);
            if count_similar(image, x, y, difference) as f32 * c >= limit {
                return LARGE;
            }
            within(exact_area(image, x, y, similarity))
        }
    }
}

/// Half the width of the large mask's rows, top to bottom.
const HALF_WIDTHS: [usize; SIDE] = {
    let mut half = [0; SIDE];
    let mut row = 0;
    while row < SIDE {
        let dy = row.abs_diff(LARGE_RADIUS);
        while (half[row] + 1) * (half[row] + 1) + dy * dy <= LARGE_RADIUS * LARGE_RADIUS {
            half[row] += 1;
        }
        row += 1;
    }
    half
};

/// 1 inside the mask, by row and lane.
const INSIDE: [[u8; LANES]; SIDE] = {
    let mut inside = [[0; LANES]; SIDE];
    let mut row = 0;
    while row < SIDE {
        let mut lane = LARGE_RADIUS - HALF_WIDTHS[row];
        while lane <= LARGE_RADIUS + HALF_WIDTHS[row] {
            inside[row][lane] = 1;
            lane += 1;
        }
        row += 1;
    }
    inside
};

/// Pixels of the large mask round (`x`, `y`) that differ from the nucleus by at most `difference`, the nucleus too.
/// The mask lies in the picture.
fn count_similar(image: &GreyImage, x: usize, y: usize, difference: u8) -> u32 {
    let begin = (y - LARGE_RADIUS) * image.width + x - LARGE_RADIUS;
    // The vectors reach a few pixels beyond the mask: at the end of the picture's last row there are none.
    let end = begin + (SIDE - 1) * image.width + LANES;
    match image.data.get(begin..end) {
        Some(pixels) => count_in_vectors(pixels, image.width, difference),
        None => {
            let nucleus = image.at(x, y);
            let row = |r: usize| &image.row(y + r - LARGE_RADIUS)[x - HALF_WIDTHS[r]..=x + HALF_WIDTHS[r]];
            (0..SIDE).map(|r| row(r).iter().filter(|p| p.abs_diff(nucleus) <= difference).count() as u32).sum()
        }
    }
}

simd_kernel! {
    /// As [`count_similar`]; `pixels` begins at the mask's upper left, rows are `stride` apart.
    fn count_in_vectors(pixels: &[u8], stride: usize, difference: u8) -> u32 = count_in_vectors_body
}

#[inline(always)]
fn count_in_vectors_body(pixels: &[u8], stride: usize, difference: u8) -> u32 {
    let nucleus = pixels[LARGE_RADIUS * stride + LARGE_RADIUS];
    let (low, high) = (nucleus.saturating_sub(difference), nucleus.saturating_add(difference));
    // 41 rows: a byte a lane is enough.
    let mut count = [0u8; LANES];
    for (r, inside) in INSIDE.iter().enumerate() {
        let Some(row) = pixels[r * stride..].first_chunk::<LANES>() else { return 0 };
        for i in 0..LANES {
            count[i] += u8::from(row[i].max(low).min(high) == row[i]) & inside[i];
        }
    }
    count.iter().map(|&c| u32::from(c)).sum()
}

/// Sum of the similarities, pixels.
fn exact_area(image: &GreyImage, x: usize, y: usize, similarity: &Similarity) -> f32 {
    let nucleus = image.at(x, y);
    let row_sum = |(r, half): (usize, &usize)| {
        let row = &image.row(y + r - LARGE_RADIUS)[x - half..=x + half];
        row.iter().map(|p| u32::from(similarity.at_difference(p.abs_diff(nucleus)))).sum::<u32>()
    };
    HALF_WIDTHS.iter().enumerate().map(row_sum).sum::<u32>() as f32 / f32::from(WHOLE)
}

#[cfg(test)]
mod tests;
