//! Points of a picture sorted into square cells.
//!
//! Purpose: to find the points near a place without looking at all of them.
//! Input: positions in pixels, then places and radii in pixels. Output: indices, ascending.
//! Cost: two passes over the positions to fill it; a search looks at the cells that the circle touches.
//! It deliberately does not do: insertion or removal of single points.

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
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

        #[test]
        fn the_grid_finds_what_a_search_of_all_finds(
            points in prop::collection::vec((-50.0f32..700.0, -50.0f32..500.0), 0..60),
            at in (-200.0f32..900.0, -200.0f32..700.0), radius in 0.0f32..300.0, cell in 0.5f32..80.0,
        ) {
            let points: Vec<[f32; 2]> = points.into_iter().map(|(x, y)| [x, y]).collect();
            let at = [at.0, at.1];
            let mut grid = PointGrid::default();
            grid.fill(&points, cell);
            let mut near = Vec::new();
            grid.within(at, radius, &mut near);
            let plain: Vec<u32> = (0..points.len() as u32).filter(|&i| {
                let [x, y] = points[i as usize];
                (x - at[0]).powi(2) + (y - at[1]).powi(2) <= radius * radius
            }).collect();
            prop_assert_eq!(near, plain);
        }
    }
}
