//! From single corners to the grid that they stand in.
//!
//! Input: [`XCorner`]s. Output: [`Grid`]s, each a set of integer cells with a corner. A seed takes its nearest
//! opposite-coloured neighbours along its two edges; from then on every next place is predicted from the cells before it (length
//! ratios go on as they were) and beside it, and taken if a fitting corner stands within 0.3 of a square's side.
//!
//! Cost: cells x corners distance tests, below 0.2 ms for a board of 100 among 300 corners. Every loop is bounded by the grid's side.

use nalgebra::Vector2;

use super::profile::XCorner;
use super::{Pattern, SIDE_RANGE};

/// A grid may reach so many cells from its seed.
const REACH: i32 = SIDE_RANGE.1 as i32 + 2;
const SIDE: usize = 2 * REACH as usize + 1;
/// Seeds that are tried.
const MAX_SEEDS: usize = 400;
/// A grid of fewer corners is an accident.
const MIN_CORNERS: usize = 8;
/// A neighbour stands so near to its predicted place, in sides of a square.
const TOLERANCE: f64 = 0.3;
/// Directions of the four neighbours.
pub const STEPS: [(i32, i32); 4] = [(1, 0), (0, 1), (-1, 0), (0, -1)];

/// Corners by cell (i, j), relative to the seed.
#[derive(Debug, Clone)]
pub struct Grid {
    cells: Vec<Option<u32>>,
    /// Filled cells in the order in which they were found.
    pub filled: Vec<(i32, i32)>,
}

impl Grid {
    fn new() -> Self {
        Self { cells: vec![None; SIDE * SIDE], filled: Vec::new() }
    }

    fn index((i, j): (i32, i32)) -> Option<usize> {
        (i.abs() <= REACH && j.abs() <= REACH).then(|| (j + REACH) as usize * SIDE + (i + REACH) as usize)
    }

    /// Number of the corner in a cell.
    pub fn get(&self, cell: (i32, i32)) -> Option<usize> {
        self.cells[Self::index(cell)?].map(|n| n as usize)
    }

    fn put(&mut self, cell: (i32, i32), corner: usize) {
        if let Some(index) = Self::index(cell) {
            self.cells[index] = Some(corner as u32);
            self.filled.push(cell);
        }
    }

    /// Where the corner of an empty cell should be, seen from the cell before it: the mean of what the cells behind and beside say.
    pub fn predict(
        place: &impl Fn((i32, i32)) -> Option<Vector2<f64>>,
        from: (i32, i32),
        (di, dj): (i32, i32),
    ) -> Option<Vector2<f64>> {
        let here = place(from)?;
        let back = |n: i32| place((from.0 - n * di, from.1 - n * dj));
        let mut sum = Vector2::zeros();
        let mut count = 0.0;
        if let Some(one) = back(1) {
            let step = here - one;
            // Perspective: lengths go on shrinking or growing.
            let ratio = back(2).map_or(1.0, |two| (step.norm() / (one - two).norm()).clamp(0.7, 1.4));
            sum += here + step * ratio;
            count += 1.0;
        }
        for side in [(dj, di), (-dj, -di)] {
            let beside = (from.0 + side.0, from.1 + side.1);
            if let (Some(a), Some(b)) = (place(beside), place((beside.0 + di, beside.1 + dj))) {
                sum += here + (b - a);
                count += 1.0;
            }
        }
        (count > 0.0).then(|| sum / count)
    }
}

/// Every grid in the corners, largest first, disjoint. Stops early at one of the pattern's size.
pub fn grow_all(corners: &[XCorner], pattern: &Pattern) -> Vec<Grid> {
    let mut used = vec![false; corners.len()];
    let mut grids: Vec<Grid> = Vec::new();
    for seed in 0..corners.len().min(MAX_SEEDS) {
        if used[seed] {
            continue;
        }
        let Some(grid) = grow(corners, &used, seed) else { continue };
        for cell in &grid.filled {
            if let Some(n) = grid.get(*cell) {
                used[n] = true;
            }
        }
        let whole = grid.filled.len() >= pattern.count();
        grids.push(grid);
        if whole {
            break;
        }
    }
    grids.sort_by_key(|grid| std::cmp::Reverse(grid.filled.len()));
    grids
}

/// The nearest unused corner of opposite colouring along a direction.
fn along(corners: &[XCorner], used: &[bool], from: usize, direction: f64) -> Option<usize> {
    let c = &corners[from];
    let d = Vector2::new(direction.cos(), direction.sin());
    let mut best: Option<(f64, usize)> = None;
    for (n, q) in corners.iter().enumerate() {
        let v = q.at - c.at;
        let forward = v.dot(&d);
        if n == from || used[n] || forward <= 2.0 {
            continue;
        }
        let sideways = v.perp(&d).abs();
        if sideways > 0.22 * forward || c.agreement(q.bright) > -0.4 || !q.has_edge(v.y.atan2(v.x), 0.35) {
            continue;
        }
        // A corner off the line must be clearly nearer.
        let distance = forward + 3.0 * sideways;
        if best.is_none_or(|(b, _)| distance < b) {
            best = Some((distance, n));
        }
    }
    best.map(|(_, n)| n)
}

fn grow(corners: &[XCorner], used: &[bool], seed: usize) -> Option<Grid> {
    let mut taken = used.to_vec();
    let mut grid = Grid::new();
    let [first, second] = corners[seed].edges;
    let pi = std::f64::consts::PI;
    taken[seed] = true;
    grid.put((0, 0), seed);
    let mut axes = [false; 2];
    for (axis, (step, direction)) in
        [((1, 0), first), ((-1, 0), first + pi), ((0, 1), second), ((0, -1), second + pi)].into_iter().enumerate()
    {
        if let Some(n) = along(corners, &taken, seed, direction) {
            taken[n] = true;
            grid.put(step, n);
            axes[axis / 2] = true;
        }
    }
    if axes != [true; 2] {
        return None;
    }
    // Cells are appended while this goes on; each is visited once, and again when the grid has grown around it.
    for _ in 0..SIDE {
        let before = grid.filled.len();
        let mut at = 0;
        while at < grid.filled.len() {
            let from = grid.filled[at];
            at += 1;
            for step in STEPS {
                extend(corners, &mut taken, &mut grid, from, step);
            }
        }
        if grid.filled.len() == before {
            break;
        }
    }
    (grid.filled.len() >= MIN_CORNERS).then_some(grid)
}

fn extend(corners: &[XCorner], taken: &mut [bool], grid: &mut Grid, from: (i32, i32), step: (i32, i32)) -> Option<()> {
    let target = (from.0 + step.0, from.1 + step.1);
    Grid::index(target)?;
    if grid.get(target).is_some() {
        return None;
    }
    let place = |cell| grid.get(cell).map(|n: usize| corners[n].at);
    let here = corners[grid.get(from)?];
    let predicted = Grid::predict(&place, from, step)?;
    let side = (predicted - here.at).norm();
    if side < 2.0 {
        return None;
    }
    let mut best: Option<(f64, usize)> = None;
    for (n, q) in corners.iter().enumerate() {
        let off = (q.at - predicted).norm();
        if taken[n] || off > TOLERANCE * side || best.is_some_and(|(b, _)| off >= b) {
            continue;
        }
        let v = q.at - here.at;
        if here.agreement(q.bright) < -0.4 && q.has_edge(v.y.atan2(v.x), 0.4) {
            best = Some((off, n));
        }
    }
    let (_, n) = best?;
    taken[n] = true;
    grid.put(target, n);
    Some(())
}
