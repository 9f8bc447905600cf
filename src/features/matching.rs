//! Which corner of one picture is which of another, by binary descriptors.
//!
//! Purpose: descriptor matching for two views, relocalisation and loops.
//! Input: descriptors of both pictures; for the windowed kind also where each corner is expected. Output: pairs of indices
//! with their Hamming distance (bits), ascending in the first index.
//! A pair is kept when each is the other's nearest (mutual), the distance is small enough, and the second nearest is
//! clearly farther (Lowe's ratio, IJCV 2004). Of equally near ones the first counts as nearest and fails any ratio below 1.
//! Cost: 1.5 ns a comparison (AVX2), both directions in one sweep; brute force is n m comparisons, no index is kept.
//! It deliberately does not do: geometry (see `geometry::ransac`), a search structure for thousands of pictures.

use super::descriptor::Descriptor;
use super::dispatch::simd_kernel;

/// Two corners that are taken for the same.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Match {
    /// Index among the first picture's corners.
    pub first: u32,
    /// Index among the second picture's.
    pub second: u32,
    /// How unlike they are: bits for descriptors.
    pub distance: f32,
}

/// When two descriptors belong together.
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct DescriptorMatching {
    /// Largest distance, bits of 256.
    pub max_distance: u32,
    /// The nearest must be nearer than this share of the second nearest's distance, in both directions; 1 = any.
    pub max_ratio: f32,
}

impl Default for DescriptorMatching {
    fn default() -> Self {
        Self { max_distance: 64, max_ratio: 0.8 }
    }
}

/// The nearest and the second nearest seen so far.
#[derive(Debug, Clone, Copy)]
struct Nearest {
    distance: u16,
    second: u16,
    index: u32,
}

impl Nearest {
    const NONE: Self = Self { distance: u16::MAX, second: u16::MAX, index: u32::MAX };

    #[inline(always)]
    fn offer(&mut self, distance: u16, index: u32) {
        if distance < self.second {
            if distance < self.distance {
                *self = Self { distance, second: self.distance, index };
            } else {
                self.second = distance;
            }
        }
    }
}

/// Matches descriptors; keeps its scratch between calls.
#[derive(Debug, Clone, Default)]
pub struct DescriptorMatcher {
    rows: Vec<Nearest>,
    columns: Vec<Nearest>,
    grid: PointGrid,
    /// Candidates of one window.
    near: Vec<u32>,
}

impl DescriptorMatcher {
    pub fn new() -> Self {
        Self::default()
    }

    /// Every descriptor with every other. Clears `out`.
    pub fn match_all(
        &mut self,
        first: &[Descriptor],
        second: &[Descriptor],
        rule: &DescriptorMatching,
        out: &mut Vec<Match>,
    ) {
        self.start(first.len(), second.len());
        nearest_of_all(first, second, &mut self.rows, &mut self.columns);
        self.finish(rule, out);
    }

    /// Only descriptors within `radius_px` of where the first corner is expected in the second picture.
    ///
    /// `expected[i]`: pixel where `first[i]` should be (`None`: nowhere, it gets no match); `positions[j]`: pixel of
    /// `second[j]`. Missing or non-finite positions match nothing. Clears `out`.
    pub fn match_windows(
        &mut self,
        (first, expected): (&[Descriptor], &[Option<[f32; 2]>]),
        (second, positions): (&[Descriptor], &[[f32; 2]]),
        radius_px: f32,
        rule: &DescriptorMatching,
        out: &mut Vec<Match>,
    ) {
        self.start(first.len(), second.len());
        self.grid.fill(&positions[..positions.len().min(second.len())], radius_px);
        for (i, (descriptor, at)) in first.iter().zip(expected).enumerate() {
            let Some(at) = at else { continue };
            self.grid.within(*at, radius_px, &mut self.near);
            for &j in &self.near {
                let distance = descriptor.distance(&second[j as usize]) as u16;
                self.rows[i].offer(distance, j);
                self.columns[j as usize].offer(distance, i as u32);
            }
        }
        self.finish(rule, out);
    }

    fn start(&mut self, first: usize, second: usize) {
        for (nearest, n) in [(&mut self.rows, first), (&mut self.columns, second)] {
            nearest.clear();
            nearest.resize(n, Nearest::NONE);
        }
    }

    fn finish(&self, rule: &DescriptorMatching, out: &mut Vec<Match>) {
        out.clear();
        // Nothing is nearer than itself by a ratio of 1: then the ratio is not asked at all.
        let clear = |n: &Nearest| {
            rule.max_ratio >= 1.0
                || n.second == u16::MAX
                || f32::from(n.distance) < rule.max_ratio * f32::from(n.second)
        };
        for (i, row) in self.rows.iter().enumerate() {
            let Some(column) = self.columns.get(row.index as usize) else { continue };
            if column.index as usize == i && u32::from(row.distance) <= rule.max_distance && clear(row) && clear(column)
            {
                out.push(Match { first: i as u32, second: row.index, distance: f32::from(row.distance) });
            }
        }
    }
}

simd_kernel! {
    /// The nearest two of each descriptor, in both directions.
    fn nearest_of_all(
        first: &[Descriptor], second: &[Descriptor], rows: &mut [Nearest], columns: &mut [Nearest],
    ) = nearest_of_all_body
}

#[inline(always)]
fn nearest_of_all_body(first: &[Descriptor], second: &[Descriptor], rows: &mut [Nearest], columns: &mut [Nearest]) {
    for (i, (a, row)) in first.iter().zip(rows).enumerate() {
        for (j, (b, column)) in second.iter().zip(columns.iter_mut()).enumerate() {
            let distance = a.distance(b) as u16;
            row.offer(distance, j as u32);
            column.offer(distance, i as u32);
        }
    }
}

/// Positions sorted into square cells, to find those near a place without looking at all.
#[derive(Debug, Clone, Default)]
pub struct PointGrid {
    cell_px: f32,
    columns: usize,
    rows: usize,
    origin: [f32; 2],
    /// Where each cell's indices begin in `indices`; one entry more than cells.
    starts: Vec<u32>,
    indices: Vec<u32>,
    positions: Vec<[f32; 2]>,
}

impl PointGrid {
    /// Cells to a side at the most, whatever the spread of the positions.
    const MAX_CELLS: f32 = 256.0;

    /// Sorts `positions` (pixels) into cells of about `cell_px`. Non-finite positions are never found.
    pub fn fill(&mut self, positions: &[[f32; 2]], cell_px: f32) {
        self.positions.clear();
        self.positions.extend_from_slice(positions);
        let (mut low, mut high) = ([f32::MAX; 2], [f32::MIN; 2]);
        for p in positions.iter().filter(|p| is_finite(p)) {
            for k in 0..2 {
                low[k] = low[k].min(p[k]);
                high[k] = high[k].max(p[k]);
            }
        }
        let spread = (high[0] - low[0]).max(high[1] - low[1]).max(1.0);
        // An empty grid has a negative spread and keeps one cell.
        self.cell_px = if cell_px > 0.0 { cell_px } else { 1.0 }.max(spread / Self::MAX_CELLS);
        self.origin = if low[0] <= high[0] { low } else { [0.0; 2] };
        self.columns = ((high[0] - low[0]).max(0.0) / self.cell_px) as usize + 1;
        self.rows = ((high[1] - low[1]).max(0.0) / self.cell_px) as usize + 1;
        self.starts.clear();
        self.starts.resize(self.columns * self.rows + 1, 0);
        for p in positions.iter().filter(|p| is_finite(p)) {
            let cell = self.cell(p);
            self.starts[cell + 1] += 1;
        }
        for cell in 0..self.columns * self.rows {
            self.starts[cell + 1] += self.starts[cell];
        }
        self.indices.clear();
        self.indices.resize(self.starts[self.columns * self.rows] as usize, 0);
        // Backwards, so that each cell's indices ascend and `starts` ends where it began.
        for (i, p) in positions.iter().enumerate().rev().filter(|(_, p)| is_finite(p)) {
            let cell = self.cell(p) + 1;
            self.starts[cell] -= 1;
            self.indices[self.starts[cell] as usize] = i as u32;
        }
        // Now starts[cell + 1] is where the cell begins: shift by one.
        let total = self.indices.len() as u32;
        self.starts.remove(0);
        self.starts.push(total);
    }

    /// Sets `near` to the indices of the positions within `radius_px` of `at`, ascending.
    pub fn within(&self, at: [f32; 2], radius_px: f32, near: &mut Vec<u32>) {
        near.clear();
        if !is_finite(&at) || radius_px.is_nan() || radius_px < 0.0 || self.indices.is_empty() {
            return;
        }
        let range = |k: usize, count: usize| {
            let offset = at[k] - self.origin[k];
            // `as` stays within 0 and the largest number, whatever the float.
            let first = ((offset - radius_px) / self.cell_px) as usize;
            let last = ((offset + radius_px) / self.cell_px) as usize;
            if offset + radius_px < 0.0 { 0..0 } else { first..last.min(count - 1) + 1 }
        };
        let columns = range(0, self.columns);
        for row in range(1, self.rows) {
            for column in columns.clone() {
                let cell = row * self.columns + column;
                for &i in &self.indices[self.starts[cell] as usize..self.starts[cell + 1] as usize] {
                    let [x, y] = self.positions[i as usize];
                    let (dx, dy) = (x - at[0], y - at[1]);
                    if dx * dx + dy * dy <= radius_px * radius_px {
                        near.push(i);
                    }
                }
            }
        }
        near.sort_unstable();
    }

    fn cell(&self, p: &[f32; 2]) -> usize {
        let index = |k: usize, count: usize| (((p[k] - self.origin[k]) / self.cell_px) as usize).min(count - 1);
        index(1, self.rows) * self.columns + index(0, self.columns)
    }
}

fn is_finite(p: &[f32; 2]) -> bool {
    p[0].is_finite() && p[1].is_finite()
}

#[cfg(test)]
mod tests;
