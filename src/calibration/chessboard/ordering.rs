//! Rows and columns of a board from the cells of a grid.
//!
//! Input: a [`Grid`] with its corners and the level's saddle map. Output: a [`Fit`]: a full rectangle of places, some perhaps empty.
//! - Rims beyond the pattern's size that are mostly empty are cut off: something beside the board looked like a corner.
//! - Rims beyond it that are not empty make it another board, even where the pattern would be a part of it.
//! - Empty cells, and whole rows that are missing at the rim, are looked for where their neighbours predict them, with a weaker
//!   test: the two-fold pattern of the right colouring must be there, all four sectors on their side.
//! - The first corner: columns go right of rows as seen from the front (a board is never seen from behind); among the turns that are left, the
//!   one whose first corner has its outer square black; among those the one nearest to the picture's upper left.

use nalgebra::Vector2;

use super::grid::Grid;
use super::profile::{XCorner, margin, two_fold};
use super::saddle::SaddleMap;
use super::{Pattern, SIDE_RANGE};
use crate::geometry::median;

/// A rim with a smaller share of corners may be cut off.
const RIM_SHARE: f64 = 0.6;
/// A rim that was predicted is taken if so large a share of it is there.
const NEW_RIM_SHARE: f64 = 0.7;
/// A rim beyond the pattern's size needs so many corners that the picture can show.
const MIN_BEYOND: usize = 4;
/// Margin between bright and dark sectors of a new rim's corners, as a share of their neighbours': the median.
const MIN_CLEARNESS: f64 = 0.4;
/// Nearer to the picture's border a corner cannot be told, level pixels.
const RIM_MARGIN_PX: f64 = 4.0;
/// Share of the cells that a board needs.
const MIN_SHARE: f64 = 0.75;
/// Distance of a corner from where its neighbours put it, in sides of a square.
pub const MAX_MISFIT: f64 = 0.25;
/// Fewer corners are no board.
const MIN_FOUND: usize = 9;
/// Median distance of the corners from where their neighbours put them, in sides of a square, that a grid of at least so many corners
/// may have. Boards, blurred and tilted ones too, stay below 0.095. In 7000 grids that random noise happened to
/// contain the least was 0.157 of those with 40 corners or more, 0.103 from 16 corners, 0.062 below.
const MAX_MEDIAN_MISFIT: [(usize, f64); 3] = [(40, 0.145), (16, 0.1), (0, 0.06)];
/// Least margin between bright and dark sectors of a predicted corner, as a share of the others' contrast.
const MIN_MARGIN: f64 = 0.04;
/// Two-fold amplitude of a predicted corner, as a share of the others' contrast.
const MIN_AMPLITUDE: f64 = 0.08;

/// A cell and its corner, level pixels.
type Place = ((i32, i32), Vector2<f64>);

/// A rectangle of places in level pixels, row by row.
#[derive(Debug, Clone)]
pub struct Fit {
    pub columns: usize,
    pub rows: usize,
    pub places: Vec<Option<Vector2<f64>>>,
    /// A rim beyond the pattern was cut off that had corners: perhaps the board goes on there.
    pub cut: bool,
}

impl Fit {
    pub fn place(&self, column: usize, row: usize) -> Option<Vector2<f64>> {
        if column >= self.columns { None } else { *self.places.get(row * self.columns + column)? }
    }

    pub fn found(&self) -> usize {
        self.places.iter().flatten().count()
    }

    pub fn size(&self) -> (u32, u32) {
        (self.columns as u32, self.rows as u32)
    }

    /// Has the pattern's size (holes allowed).
    pub fn is_pattern(&self, pattern: &Pattern) -> bool {
        self.size() == (pattern.columns, pattern.rows)
    }

    /// The pattern could be a part of it, and it has more corners.
    pub fn goes_beyond(&self, pattern: &Pattern) -> bool {
        let [own, wanted] = [(self.columns, self.rows), (pattern.columns as usize, pattern.rows as usize)];
        let [own, wanted] = [own, wanted].map(|(a, b)| sides(a, b));
        own != wanted && own[0] >= wanted[0] && own[1] >= wanted[1] && self.found() > pattern.count()
    }

    pub fn is_whole(&self, pattern: &Pattern) -> bool {
        self.is_pattern(pattern) && self.found() == pattern.count()
    }

    /// The pattern before other sizes, then the one with more corners.
    pub fn better_than(&self, other: Option<&Fit>, pattern: &Pattern) -> bool {
        let rank = |fit: &Fit| (fit.is_pattern(pattern), fit.found());
        other.is_none_or(|other| rank(self) > rank(other))
    }
}

/// Cells of a rectangle while it is being completed.
struct Sheet<'a> {
    low: (i32, i32),
    high: (i32, i32),
    grid: &'a Grid,
    corners: &'a [XCorner],
    /// Places that were predicted and found.
    extra: Vec<((i32, i32), Vector2<f64>)>,
    /// Cells whose corner does not stand in line with its neighbours.
    dropped: Vec<(i32, i32)>,
    /// See [`Fit::cut`].
    cut: bool,
}

impl Sheet<'_> {
    fn place(&self, cell: (i32, i32)) -> Option<Vector2<f64>> {
        let inside = cell.0 >= self.low.0 && cell.0 <= self.high.0 && cell.1 >= self.low.1 && cell.1 <= self.high.1;
        if !inside {
            return None;
        }
        let found = if self.dropped.contains(&cell) { None } else { self.grid.get(cell) };
        let found = found.and_then(|n| self.corners.get(n)).map(|c| c.at);
        found.or_else(|| self.extra.iter().find(|(c, _)| *c == cell).map(|(_, at)| *at))
    }

    /// Columns and rows of the rectangle.
    fn size(&self) -> [usize; 2] {
        [(self.high.0 - self.low.0 + 1) as usize, (self.high.1 - self.low.1 + 1) as usize]
    }

    /// Cells of a rim: side 0 left, 1 right, 2 top, 3 bottom; `out` cells farther out.
    fn rim(&self, side: usize, out: i32) -> Vec<(i32, i32)> {
        let (l, h) = (self.low, self.high);
        match side {
            0 => (l.1..=h.1).map(|j| (l.0 - out, j)).collect(),
            1 => (l.1..=h.1).map(|j| (h.0 + out, j)).collect(),
            2 => (l.0..=h.0).map(|i| (i, l.1 - out)).collect(),
            _ => (l.0..=h.0).map(|i| (i, h.1 + out)).collect(),
        }
    }

    fn share(&self, side: usize) -> f64 {
        let rim = self.rim(side, 0);
        rim.iter().filter(|c| self.place(**c).is_some()).count() as f64 / rim.len().max(1) as f64
    }

    fn move_side(&mut self, side: usize, by: i32) {
        match side {
            0 => self.low.0 -= by,
            1 => self.high.0 += by,
            2 => self.low.1 -= by,
            _ => self.high.1 += by,
        }
    }

    /// Expected direction of the bright sectors in a cell, by the nearest cell's colouring.
    fn expected_bright(&self, cell: (i32, i32), from: (i32, i32)) -> Option<f64> {
        let corner = self.corners.get(self.grid.get(from)?)?;
        let odd = ((cell.0 - from.0) + (cell.1 - from.1)).rem_euclid(2) == 1;
        Some(if odd { corner.bright + std::f64::consts::FRAC_PI_2 } else { corner.bright })
    }
}

/// The rectangle that a grid stands for, in the pattern's order if its size fits. `None`: too many holes.
pub fn fit(grid: Grid, map: &SaddleMap, corners: &[XCorner], pattern: &Pattern) -> Option<Fit> {
    let low = (grid.filled.iter().map(|c| c.0).min()?, grid.filled.iter().map(|c| c.1).min()?);
    let high = (grid.filled.iter().map(|c| c.0).max()?, grid.filled.iter().map(|c| c.1).max()?);
    let mut sheet = Sheet { low, high, grid: &grid, corners, extra: Vec::new(), dropped: Vec::new(), cut: false };
    trim(&mut sheet, pattern);
    straighten(&mut sheet);
    let contrast = {
        let mut all: Vec<f32> =
            grid.filled.iter().filter_map(|c| corners.get(grid.get(*c)?)).map(|c| c.contrast).collect();
        all.sort_by(f32::total_cmp);
        f64::from(*all.get(all.len() / 2)?)
    };
    complete(&mut sheet, map, contrast, pattern);
    let size = sheet.size();
    let total = size[0] * size[1];
    let found = (sheet.low.1..=sheet.high.1)
        .flat_map(|j| (sheet.low.0..=sheet.high.0).map(move |i| (i, j)))
        .filter(|c| sheet.place(*c).is_some())
        .count();
    if (found as f64) < MIN_SHARE * total as f64 || size.iter().any(|n| *n < 3) || found < MIN_FOUND {
        return None;
    }
    let limit = MAX_MEDIAN_MISFIT.iter().find(|(least, _)| found >= *least)?.1;
    if median_misfit(&sheet)? > limit {
        return None;
    }
    order(&sheet, pattern)
}

fn median_misfit(sheet: &Sheet) -> Option<f64> {
    let cells = (sheet.low.1..=sheet.high.1).flat_map(|j| (sheet.low.0..=sheet.high.0).map(move |i| (i, j)));
    let mut all: Vec<f64> = cells.filter_map(|cell| Some(misfit(&|c| sheet.place(c), cell)?.0)).collect();
    median(&mut all)
}

/// Longer and shorter side.
fn sides(a: usize, b: usize) -> [usize; 2] {
    [a.max(b), a.min(b)]
}

fn trim(sheet: &mut Sheet, pattern: &Pattern) {
    let wanted = sides(pattern.columns as usize, pattern.rows as usize);
    for _ in 0..4 * SIDE_RANGE.1 {
        let size = sheet.size();
        let have = sides(size[0], size[1]);
        // Which axis is too long: the longer one against the longer, the shorter against the shorter.
        let axis_too_long = |axis: usize| {
            let rank = usize::from(size[axis] < size[1 - axis]);
            have[rank] > wanted[rank] || size[axis] > wanted[0]
        };
        let weakest = (0..4)
            .filter(|side| axis_too_long(side / 2) || sheet.share(*side) < 0.35)
            .map(|side| (sheet.share(side), side))
            .min_by(|a, b| a.0.total_cmp(&b.0));
        match weakest {
            Some((share, side)) if share < RIM_SHARE && size[side / 2] > 2 => {
                sheet.cut |= axis_too_long(side / 2) && share * size[1 - side / 2] as f64 > 1.5;
                sheet.move_side(side, -1);
            }
            _ => return,
        }
    }
}

/// How far a cell's corner stands from where its neighbours put it, in sides of a square: the median of what straight lines and
/// parallelograms through it say; and where that is. `None` with fewer than two of them.
pub fn misfit(place: &impl Fn((i32, i32)) -> Option<Vector2<f64>>, (i, j): (i32, i32)) -> Option<(f64, Vector2<f64>)> {
    let here = place((i, j))?;
    let mut said: Vec<(f64, Vector2<f64>)> = Vec::new();
    let mut say =
        |predicted: Vector2<f64>, side: f64| said.push(((predicted - here).norm() / side.max(1.0), predicted));
    for (di, dj) in [(1, 0), (0, 1)] {
        let at = |n: i32| place((i + n * di, j + n * dj));
        if let (Some(a), Some(b)) = (at(-1), at(1)) {
            say(0.5 * (a + b), 0.5 * (b - a).norm());
        }
        for sign in [1, -1] {
            if let (Some(a), Some(b), None) = (at(sign), at(2 * sign), at(-sign)) {
                say(2.0 * a - b, (b - a).norm());
            }
        }
    }
    for (di, dj) in [(1, 1), (1, -1), (-1, 1), (-1, -1)] {
        if let (Some(a), Some(b), Some(c)) = (place((i + di, j)), place((i, j + dj)), place((i + di, j + dj))) {
            say(a + b - c, 0.5 * ((a - c).norm() + (b - c).norm()));
        }
    }
    if said.len() < 2 {
        return None;
    }
    said.sort_by(|a, b| a.0.total_cmp(&b.0));
    let middle = |axis: usize| {
        let mut values: Vec<f64> = said.iter().map(|(_, p)| p[axis]).collect();
        median(&mut values)
    };
    Some((said[said.len() / 2].0, Vector2::new(middle(0)?, middle(1)?)))
}

/// Drops corners that are out of line, the worst first.
fn straighten(sheet: &mut Sheet) {
    for _ in 0..sheet.grid.filled.len() / 4 {
        let worst = sheet
            .grid
            .filled
            .iter()
            .filter_map(|cell| Some((misfit(&|c| sheet.place(c), *cell)?.0, *cell)))
            .max_by(|a, b| a.0.total_cmp(&b.0));
        match worst {
            Some((off, cell)) if off > MAX_MISFIT => sheet.dropped.push(cell),
            _ => return,
        }
    }
}

/// Fills holes, then adds rims that are missing. A rim beyond the pattern's size is added, too, if corners stand there: then the
/// board is a larger one, of which the pattern would be a part.
fn complete(sheet: &mut Sheet, map: &SaddleMap, contrast: f64, pattern: &Pattern) {
    let wanted = sides(pattern.columns as usize, pattern.rows as usize);
    fill_holes(sheet, map, contrast);
    for _ in 0..2 * SIDE_RANGE.1 {
        let size = sheet.size();
        let belongs = |axis: usize| {
            let mut grown = size;
            grown[axis] += 1;
            let grown = sides(grown[0], grown[1]);
            grown[0] <= wanted[0] && grown[1] <= wanted[1]
        };
        // Rims of the pattern first; the most corners among those.
        let mut best: Option<((bool, usize), usize, Vec<Place>)> = None;
        for side in (0..4).filter(|side| size[side / 2] < SIDE_RANGE.1 as usize) {
            let belongs = belongs(side / 2);
            let Some(found) = next_rim(sheet, map, contrast, side, belongs) else { continue };
            let rank = (belongs, found.len());
            if best.as_ref().is_none_or(|(r, ..)| rank > *r) {
                best = Some((rank, side, found));
            }
        }
        let Some((_, side, found)) = best else { return };
        sheet.move_side(side, 1);
        sheet.extra.extend(found);
        fill_holes(sheet, map, contrast);
    }
}

/// The corners of the next rim on a side, if enough of them are there. Of one that `belongs` to the pattern all count; of one
/// beyond it those that the picture can show, because a larger board reaches out of it more easily. They must be about as clear as the
/// corners beside them: where a board ends on something dark, its outer squares' ends look like faint corners.
fn next_rim(sheet: &Sheet, map: &SaddleMap, contrast: f64, side: usize, belongs: bool) -> Option<Vec<Place>> {
    let inward = [(1, 0), (-1, 0), (0, 1), (0, -1)][side];
    let (mut found, mut seen, mut clearness) = (Vec::new(), 0, Vec::new());
    for cell in sheet.rim(side, 1) {
        let from = (cell.0 + inward.0, cell.1 + inward.1);
        let Some((predicted, square)) = predict(sheet, cell, &[from]) else { continue };
        let inside = |at: f64, size: usize| at > RIM_MARGIN_PX && at < size as f64 - 1.0 - RIM_MARGIN_PX;
        seen += usize::from(inside(predicted.x, map.width) && inside(predicted.y, map.height));
        let Some(at) = look(sheet, map, contrast, cell, &[from]) else { continue };
        found.push((cell, at));
        let clear = |at| {
            let radius = ring_radius(square);
            margin(map, at, radius, two_fold(map, at, radius)?.1).filter(|m| *m > 0.0)
        };
        if let Some(inner) = sheet.place(from).and_then(clear) {
            clearness.push(clear(at).unwrap_or(0.0) / inner);
        }
    }
    let of = if belongs { sheet.rim(side, 1).len() } else { seen.max(MIN_BEYOND) };
    let is_clear = median(&mut clearness).is_none_or(|c| c > MIN_CLEARNESS);
    (found.len() as f64 >= NEW_RIM_SHARE * of as f64 && !found.is_empty() && is_clear).then_some(found)
}

/// Radius of the circle that tells a corner where a square has the side `square`, level pixels.
fn ring_radius(square: f64) -> f32 {
    (0.3 * square).clamp(2.0, 4.0) as f32
}

fn fill_holes(sheet: &mut Sheet, map: &SaddleMap, contrast: f64) {
    for _ in 0..3 {
        let mut found = Vec::new();
        for j in sheet.low.1..=sheet.high.1 {
            for i in sheet.low.0..=sheet.high.0 {
                if sheet.place((i, j)).is_none() {
                    let around = [(i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)];
                    found.extend(look(sheet, map, contrast, (i, j), &around).map(|at| ((i, j), at)));
                }
            }
        }
        if found.is_empty() {
            return;
        }
        sheet.extra.extend(found);
    }
}

/// Where the corner of an empty cell should stand by what its neighbours `from` say, and the side of a square there.
fn predict(sheet: &Sheet, cell: (i32, i32), from: &[(i32, i32)]) -> Option<(Vector2<f64>, f64)> {
    let place = |c| sheet.place(c);
    let (mut sum, mut count, mut side) = (Vector2::zeros(), 0.0, f64::INFINITY);
    for start in from {
        let step = (cell.0 - start.0, cell.1 - start.1);
        if let (Some(here), Some(predicted)) = (place(*start), Grid::predict(&place, *start, step)) {
            sum += predicted;
            count += 1.0;
            side = side.min((predicted - here).norm());
        }
    }
    (count > 0.0 && side > 3.0 && side.is_finite()).then(|| (sum / count, side))
}

/// The corner of an empty cell, by what its neighbours `from` predict and the saddle map shows.
fn look(sheet: &Sheet, map: &SaddleMap, contrast: f64, cell: (i32, i32), from: &[(i32, i32)]) -> Option<Vector2<f64>> {
    let (predicted, side) = predict(sheet, cell, from)?;
    // Expected colouring: of a neighbour, else of any cell.
    let bright = match from.iter().find_map(|start| sheet.expected_bright(cell, *start)) {
        Some(bright) => bright,
        None => sheet.expected_bright(cell, nearest_known(sheet, cell)?)?,
    };
    let reach = (0.22 * side).clamp(1.0, 8.0);
    let (x0, x1) = ((predicted.x - reach).ceil().max(0.0) as usize, (predicted.x + reach).floor().max(0.0) as usize);
    let (y0, y1) = ((predicted.y - reach).ceil().max(0.0) as usize, (predicted.y + reach).floor().max(0.0) as usize);
    let mut best = (0.0f32, 0, 0);
    for y in y0..=y1 {
        for x in x0..=x1 {
            let s = map.saddle(x, y);
            if s > best.0 {
                best = (s, x, y);
            }
        }
    }
    if best.0 <= 0.0 {
        return None;
    }
    let at = map.peak(best.1, best.2);
    let radius = ring_radius(side);
    let (amplitude, phase) = two_fold(map, at, radius)?;
    let agrees = (2.0 * (phase - bright)).cos() > 0.4;
    let clear = margin(map, at, radius, phase)? > MIN_MARGIN * contrast;
    (agrees && clear && amplitude > MIN_AMPLITUDE * contrast).then_some(at)
}

fn nearest_known(sheet: &Sheet, cell: (i32, i32)) -> Option<(i32, i32)> {
    let distance = |c: &(i32, i32)| (c.0 - cell.0).abs() + (c.1 - cell.1).abs();
    sheet.grid.filled.iter().min_by_key(|c| (distance(c), c.0, c.1)).copied()
}

/// A rectangle of places, each with its bright direction if that is known.
#[derive(Clone)]
struct Cells {
    columns: usize,
    rows: usize,
    at: Vec<Option<(Vector2<f64>, Option<f64>)>>,
}

impl Cells {
    fn new(sheet: &Sheet) -> Self {
        let [columns, rows] = sheet.size();
        let cells = (sheet.low.1..=sheet.high.1).flat_map(|j| (sheet.low.0..=sheet.high.0).map(move |i| (i, j)));
        let bright = |cell| sheet.grid.get(cell).and_then(|n| sheet.corners.get(n)).map(|c| c.bright);
        let at = cells.map(|cell| sheet.place(cell).map(|at| (at, bright(cell)))).collect();
        Self { columns, rows, at }
    }

    fn get(&self, column: usize, row: usize) -> Option<Vector2<f64>> {
        if column >= self.columns { None } else { self.at.get(row * self.columns + column)?.map(|(at, _)| at) }
    }

    /// Positive if rows lie clockwise of columns in the picture, as for a board seen from the front.
    fn turning(&self) -> f64 {
        let mut sum = 0.0;
        for (r, c) in (0..self.rows).flat_map(|r| (0..self.columns).map(move |c| (r, c))) {
            if let (Some(o), Some(a), Some(b)) = (self.get(c, r), self.get(c + 1, r), self.get(c, r + 1)) {
                sum += (a - o).perp(&(b - o)).signum();
            }
        }
        sum
    }

    fn mirrored(mut self) -> Self {
        self.at.chunks_mut(self.columns.max(1)).for_each(<[_]>::reverse);
        self
    }

    /// By a quarter turn: what were rows become columns.
    fn turned(&self) -> Self {
        let (columns, rows) = (self.rows, self.columns);
        let at = (0..rows).flat_map(|r| (0..columns).map(move |c| (c, r)));
        let at = at.map(|(c, r)| self.at[c * self.columns + (self.columns - 1 - r)]).collect();
        Self { columns, rows, at }
    }

    /// Positive if the squares on the diagonal of the first corner are bright.
    fn colour(&self) -> f64 {
        let mut sum = 0.0;
        for (r, c) in (0..self.rows).flat_map(|r| (0..self.columns).map(move |c| (r, c))) {
            let Some((at, Some(bright))) = self.at[r * self.columns + c] else { continue };
            let before = |p: Option<Vector2<f64>>| p.map(|p| at - p);
            let after = |p: Option<Vector2<f64>>| p.map(|p| p - at);
            let u = after(self.get(c + 1, r)).or_else(|| before(self.get(c.checked_sub(1)?, r)));
            let v = after(self.get(c, r + 1)).or_else(|| before(self.get(c, r.checked_sub(1)?)));
            if let (Some(u), Some(v)) = (u, v) {
                let diagonal = u / u.norm() + v / v.norm();
                let agreement = (2.0 * (bright - diagonal.y.atan2(diagonal.x))).cos();
                sum += if (r + c) % 2 == 0 { agreement } else { -agreement };
            }
        }
        sum
    }
}

/// Turns the rectangle so that it fits the pattern, its colours and its handedness.
fn order(sheet: &Sheet, pattern: &Pattern) -> Option<Fit> {
    let mut cells = Cells::new(sheet);
    if cells.turning() < 0.0 {
        cells = cells.mirrored();
    }
    // Fits the pattern, first square black, nearness of the first corner to the picture's corner.
    let mut best: Option<(bool, bool, f64, Cells)> = None;
    for _ in 0..4 {
        let fits = (cells.columns, cells.rows) == (pattern.columns as usize, pattern.rows as usize);
        let black = cells.colour() <= 0.0;
        let first = cells.at.iter().flatten().next().map_or(f64::INFINITY, |(p, _)| p.x + p.y);
        if best
            .as_ref()
            .is_none_or(|(f, b, d, _)| (fits, black) > (*f, *b) || ((fits, black) == (*f, *b) && first < *d))
        {
            best = Some((fits, black, first, cells.clone()));
        }
        cells = cells.turned();
    }
    let (_, _, _, cells) = best?;
    let places = cells.at.iter().map(|cell| cell.map(|(at, _)| at)).collect();
    Some(Fit { columns: cells.columns, rows: cells.rows, places, cut: sheet.cut })
}
