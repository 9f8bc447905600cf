//! SUSAN corners with the 41x41 mask, in one pass or two.
//!
//! Purpose: the method's large mask. It finds the true corners where the 37-pixel mask answers to nearly every edge, and
//! is slow; so two passes: the small mask over the whole picture, the large one only where the small one answered.
//! Input: grey picture, [`CellGrid`] with the brightness threshold t of each cell (grey levels, rounded).
//! Output: corners at whole level-0 pixels in raster order; response = 1 - sd of the large mask.
//! Mask: the 1257 pixels within 20 of the nucleus; a perfect corner has sd 0.266 (along the axes) or 0.262 (diagonal),
//! an edge 0.52. Paper: Smith and Brady, SUSAN, IJCV 1997; the two passes are the method's own.
//! A corner is a pixel whose area is below g and the smallest within the suppression radius, of equals the first in raster
//! order. [`LargeSusanScheme`]: the single pass, and the method's two passes. The second of these starts at the pixels that the
//! small mask answered to and goes downhill from each, also over pixels that it did not answer to: what it finds is always a
//! corner of the single pass, but it misses those that lie in soft shades, which seven pixels do not see.
//! Cost: 0.06 us a pixel measured (AVX2, hard step): for 640x480 15 ms in a single pass; what two passes save is measured by
//! `tests/bench/susan.rs`. It deliberately does not do: corners within 20 pixels of the edge, texture (a large mask fails there).

mod counting;

use super::susan::{MASK_AREA, MASK_RADIUS, MAX_SUPPRESSION_PX, Similarity, SusanResponse, WHOLE, similar_counts};
use super::{CellGrid, Corner, CornerDetector};
use crate::image::GreyImage;
use counting::{HALF_WIDTHS, count_similar};
pub use counting::{LARGE_AREA, LARGE_RADIUS};

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
    #[error("susan_large.small_mask_below is {0}, must be above 0 and below 1 (a share of the mask)")]
    SmallMask(f32),
    #[error("susan_large.suppression_px is {0} px, must be 1 to {MAX_SUPPRESSION_PX} px")]
    Suppression(usize),
}

/// Where the large mask is laid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum LargeSusanScheme {
    /// On every pixel.
    SinglePass,
    /// Where the 37-pixel mask answers, and downhill from there: the method's two passes.
    #[default]
    SmallMask,
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
    pub scheme: LargeSusanScheme,
    /// The small mask answers where its salient degree (hard step, same t) is below this. 0.65 lets edges through (0.59).
    pub small_mask_below: f32,
}

impl Default for LargeSusanConfig {
    /// The study's g.
    fn default() -> Self {
        Self {
            response: SusanResponse::Step,
            geometric_threshold: 0.4,
            suppression_px: 5,
            scheme: LargeSusanScheme::SmallMask,
            small_mask_below: 0.65,
        }
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
    similarities: Vec<Option<(Similarity, Bound)>>,
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

impl FirstPassRows {
    /// Sets (difference, limit) of each pixel of row `y` by its threshold `t` (0 = none); where no corner is wanted,
    /// so that nothing can be left.
    fn fill(&mut self, t: &[u8], y: usize, cells: &CellGrid, rule: impl Fn(u8) -> Option<(u8, u8)>) {
        let mut last = (0, (u8::MAX, 0));
        for (x, &t) in t.iter().enumerate() {
            if last.0 != t {
                last = (t, rule(t).unwrap_or((u8::MAX, 0)));
            }
            let wanted = t != 0 && cells.index(x as f32, y as f32).is_some_and(|i| cells.cells[i].wanted);
            (self.difference[x], self.limit[x]) = if wanted { last.1 } else { (u8::MAX, 0) };
        }
    }
}

impl LargeSusanDetector {
    /// Fails when a value of `config` is out of its range.
    pub fn new(config: LargeSusanConfig) -> Result<Self, LargeSusanConfigError> {
        let is_share = |g: f32| g > 0.0 && g < 1.0;
        if !is_share(config.geometric_threshold) {
            return Err(LargeSusanConfigError::Geometric(config.geometric_threshold));
        }
        if !is_share(config.small_mask_below) {
            return Err(LargeSusanConfigError::SmallMask(config.small_mask_below));
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
                let config = &self.config;
                self.similarities[usize::from(t)].get_or_insert_with(|| {
                    let similarity = Similarity::new(config.response, t);
                    let bound = Bound::new(config, t, &similarity);
                    (similarity, bound)
                });
            }
        }
    }

    /// The pixels to start from: those of the wanted cells that the scheme's first pass leaves.
    fn first_pass(&mut self, image: &GreyImage, cells: &CellGrid) {
        self.starts.clear();
        let (width, r, scheme) = (image.width, LARGE_RADIUS, self.config.scheme);
        let rows = &mut self.rows;
        for row in [&mut rows.difference, &mut rows.limit, &mut rows.left] {
            row.clear();
            row.resize(width, 0);
        }
        // sd < g leaves count + 1 < g * 37, the nucleus being one.
        let small_limit = ((self.config.small_mask_below * MASK_AREA as f32).ceil() as u8).saturating_sub(2);
        let side = cells.cell_px.max(1);
        for y in r..image.height - r {
            if y == r || y % side == 0 {
                // Thresholds and wishes change only from one row of cells to the next.
                rows.fill(&self.t[y * width..(y + 1) * width], y, cells, |t| match scheme {
                    LargeSusanScheme::SinglePass => Some((0, 1)),
                    LargeSusanScheme::SmallMask => Some((t - 1, small_limit)),
                });
            }
            let FirstPassRows { difference, limit, left } = rows;
            let inner = r..width - r;
            match scheme {
                LargeSusanScheme::SinglePass => left.copy_from_slice(limit),
                LargeSusanScheme::SmallMask => {
                    let seven = std::array::from_fn(|i| image.row(y + i - MASK_RADIUS));
                    similar_counts(&seven, difference, limit, left);
                }
            }
            for (chunk, bytes) in left[inner].chunks(8).enumerate() {
                if bytes.iter().fold(0, |any, b| any | b) == 0 {
                    continue;
                }
                let first = y * width + r + 8 * chunk;
                self.starts.extend((first..).zip(bytes).filter(|(_, left)| **left != 0).map(|(at, _)| at as u32));
            }
        }
    }

    /// Area of the pixel at index `at`, measured when it is not known yet.
    fn area(&mut self, image: &GreyImage, at: usize) -> u16 {
        if self.areas[at] == UNKNOWN {
            let (x, y, r) = (at % image.width, at / image.width, LARGE_RADIUS);
            let reached = x >= r && y >= r && x + r < image.width && y + r < image.height;
            self.areas[at] = match &self.similarities[usize::from(self.t[at])] {
                Some((similarity, bound)) if reached => {
                    self.counts.measured += 1;
                    measure(image, (x, y), bound, similarity)
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

    /// The corners from the starts: measured all, then downhill from each that is the lowest of those near it.
    fn descend_from_starts(&mut self, image: &GreyImage) {
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
        found.sort_unstable();
        found.dedup();
        self.found = found;
        self.starts = starts;
    }

    /// Goes from pixel `at`, below g, to the smallest area of its neighbourhood, again and again.
    fn descend(&mut self, image: &GreyImage, mut at: usize) -> usize {
        let (width, r) = (image.width, self.config.suppression_px);
        loop {
            // All that is below g is at least LARGE_RADIUS > r pixels from the picture's edge. The nearest eight first: on
            // most of the way down one of them is smaller, and the others need not be measured.
            let mut best = at;
            for reach in [1, r] {
                let corner = at - reach * width - reach;
                for row in 0..=2 * reach {
                    for neighbour in corner + row * width..=corner + row * width + 2 * reach {
                        // Ascending indices are raster order.
                        if (self.area(image, neighbour), neighbour) < (self.areas[best], best) {
                            best = neighbour;
                        }
                    }
                }
                if best != at {
                    break;
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
        self.descend_from_starts(image);
        for &at in &self.found {
            let (x, y) = ((at as usize % image.width) as f32, (at as usize / image.width) as f32);
            if cells.index(x, y).is_some_and(|i| cells.cells[i].wanted) {
                let sd = f32::from(self.areas[at as usize]) / (LARGE_AREA * AREA_SCALE) as f32;
                out.push(Corner { x, y, response: 1.0 - sd });
            }
        }
    }
}

/// When a pixel is no corner.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Bound {
    /// With `count` or more pixels of its mask that differ by at most `difference`;
    difference: u8,
    count: u32,
    /// with an area times [`WHOLE`] of this or more. `None`: the count is the area.
    area: Option<u32>,
}

impl Bound {
    fn new(config: &LargeSusanConfig, t: u8, similarity: &Similarity) -> Self {
        let limit = f64::from(config.geometric_threshold) * f64::from(LARGE_AREA);
        match config.response {
            SusanResponse::Step => Self { difference: t.max(1) - 1, count: limit.ceil() as u32, area: None },
            SusanResponse::Exponential => {
                // The area is at least count * c(difference).
                let difference = (7 * u32::from(t) / 10) as u8;
                let c = f64::from(similarity.at_difference(difference)) / f64::from(WHOLE);
                let area = (limit * f64::from(WHOLE)).ceil() as u32;
                Self { difference, count: (limit / c).ceil() as u32, area: Some(area) }
            }
        }
    }
}

/// Area of one pixel times [`AREA_SCALE`], or [`LARGE`] where it is not below g. The mask lies in the picture.
fn measure(image: &GreyImage, (x, y): (usize, usize), bound: &Bound, similarity: &Similarity) -> u16 {
    let count = count_similar(image, (x, y), bound.difference);
    if count >= bound.count {
        return LARGE;
    }
    match bound.area {
        None => (count * AREA_SCALE) as u16,
        Some(limit) => exact_area(image, x, y, similarity, limit)
            .map_or(LARGE, |area| (area / (u32::from(WHOLE) / AREA_SCALE)) as u16),
    }
}

/// Sum of the similarities times [`WHOLE`]; `None` as soon as it reaches `limit`.
fn exact_area(image: &GreyImage, x: usize, y: usize, similarity: &Similarity, limit: u32) -> Option<u32> {
    let c = similarity.of_nucleus(image.at(x, y));
    let mut area = 0;
    for (r, half) in HALF_WIDTHS.iter().enumerate() {
        let row = &image.row(y + r - LARGE_RADIUS)[x - half..=x + half];
        area += row.iter().map(|&p| u32::from(c[usize::from(p)])).sum::<u32>();
        if area >= limit {
            return None;
        }
    }
    Some(area)
}

#[cfg(test)]
mod tests;
