//! Where a tag's four edges lie, to a fraction of a pixel.
//!
//! Along each edge, away from its ends, the picture is read across it; the edge is where the brightness changes, as the mean of
//! the places weighted by the square of the change. Lines through these points meet in the corners, so a corner rests on two whole edges
//! and not on its own few pixels. Lines are fitted on whatever plane the caller maps the pixels to: a lens bends them in the picture.

use nalgebra::Vector2;

use crate::image::GreyImage;

/// Points on an edge, at the most.
pub const EDGE_POINTS: usize = 24;
/// Share of an edge at each end that is left out: the other edge blurs it.
const END_SHARE: f64 = 0.1;
/// How far beside the edge it is looked for, px, and as a share of a cell (the next cell has edges of its own).
const REACH_PX: f64 = 3.0;
const REACH_CELLS: f64 = 0.75;
/// Distance of readings across the edge, px; a change is taken over twice as much to both sides.
const STEP_PX: f64 = 0.25;
const HALF_CHANGE_PX: f64 = 0.75;
/// A smaller change across the edge is none, grey levels.
const LEAST_CHANGE: f64 = 8.0;
/// Points that leave their line by more than this many times the median are left out.
const OUTLIER_MEDIANS: f64 = 4.0;

/// Points found on one edge, px; the first `count` count.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edge {
    pub points: [Vector2<f64>; EDGE_POINTS],
    pub count: usize,
}

/// Grey value between pixels; `None` outside.
#[inline]
pub fn bilinear(image: &GreyImage, at: &Vector2<f64>) -> Option<f64> {
    // Written so that NaN fails.
    if !(at.x >= 0.0 && at.y >= 0.0 && at.x < (image.width - 1) as f64 && at.y < (image.height - 1) as f64) {
        return None;
    }
    let (x, y) = (at.x as usize, at.y as usize);
    let (u, v) = (at.x - x as f64, at.y - y as f64);
    let value = |x, y| f64::from(image.at(x, y));
    let upper = value(x, y) * (1.0 - u) + value(x + 1, y) * u;
    let lower = value(x, y + 1) * (1.0 - u) + value(x + 1, y + 1) * u;
    Some(upper * (1.0 - v) + lower * v)
}

/// Points on the edge between two corners of a quadrilateral (clockwise as seen, dark inside).
pub fn edge_points(image: &GreyImage, from: &Vector2<f64>, to: &Vector2<f64>) -> Edge {
    let mut edge = Edge { points: [Vector2::zeros(); EDGE_POINTS], count: 0 };
    let along = to - from;
    let length = along.norm();
    if !(length > 1.0) {
        return edge;
    }
    // Outwards: to the left of a clockwise edge, y being down.
    let normal = Vector2::new(along.y, -along.x) / length;
    let points = ((length * (1.0 - 2.0 * END_SHARE)) as usize).clamp(6, EDGE_POINTS);
    let span = reach_steps(length);
    for i in 0..points {
        let share = END_SHARE + (1.0 - 2.0 * END_SHARE) * (i as f64 + 0.5) / points as f64;
        let middle = from + along * share;
        if let Some(off) = crossing(image, &middle, &normal, span) {
            edge.points[edge.count] = middle + normal * off;
            edge.count += 1;
        }
    }
    edge
}

/// How far along `normal`, px, the picture turns from dark to bright near a place: the mean of up to so many steps to both sides, weighted by the square
/// of the change.
pub fn crossing(image: &GreyImage, middle: &Vector2<f64>, normal: &Vector2<f64>, steps: i32) -> Option<f64> {
    let (mut weights, mut sum) = (0.0, 0.0);
    for k in -steps..=steps {
        let s = f64::from(k) * STEP_PX;
        let outer = bilinear(image, &(middle + normal * (s + HALF_CHANGE_PX)));
        let inner = bilinear(image, &(middle + normal * (s - HALF_CHANGE_PX)));
        let Some((outer, inner)) = outer.zip(inner) else { continue };
        let change = outer - inner;
        if change > LEAST_CHANGE {
            weights += change * change;
            sum += change * change * s;
        }
    }
    (weights > 0.0).then(|| sum / weights)
}

/// Steps to both sides in which an edge is looked for, on a tag with sides of this length, px.
pub fn reach_steps(length: f64) -> i32 {
    (REACH_PX.min(REACH_CELLS * length / 8.0).max(1.0) / STEP_PX) as i32
}

/// A line: `normal . x = offset`.
struct Line {
    normal: Vector2<f64>,
    offset: f64,
}

/// Total least squares; `None` for fewer than four points.
fn fit(points: &[Vector2<f64>]) -> Option<Line> {
    if points.len() < 4 {
        return None;
    }
    let mean = points.iter().sum::<Vector2<f64>>() / points.len() as f64;
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for p in points {
        let d = p - mean;
        (xx, xy, yy) = (xx + d.x * d.x, xy + d.x * d.y, yy + d.y * d.y);
    }
    // Direction of most spread; the normal is across it.
    let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
    let normal = Vector2::new(-angle.sin(), angle.cos());
    angle.is_finite().then(|| Line { offset: normal.dot(&mean), normal })
}

impl Edge {
    /// Moves its points.
    pub fn shift(&mut self, by: &Vector2<f64>) {
        self.points[..self.count].iter_mut().for_each(|point| *point += by);
    }

    /// The line through its points as `map` places them, without those that leave it.
    fn line(&self, map: &impl Fn(&Vector2<f64>) -> Option<Vector2<f64>>) -> Option<Line> {
        let mut mapped = [Vector2::zeros(); EDGE_POINTS];
        let mut n = 0;
        for p in self.points[..self.count].iter().filter_map(map) {
            mapped[n] = p;
            n += 1;
        }
        let line = fit(&mapped[..n])?;
        let off = |p: &Vector2<f64>| (line.normal.dot(p) - line.offset).abs();
        let mut sorted = [0.0; EDGE_POINTS];
        for (s, p) in sorted.iter_mut().zip(&mapped[..n]) {
            *s = off(p);
        }
        sorted[..n].sort_unstable_by(f64::total_cmp);
        let limit = OUTLIER_MEDIANS * sorted[n / 2];
        let mut kept = [Vector2::zeros(); EDGE_POINTS];
        let mut count = 0;
        for p in mapped[..n].iter().filter(|p| off(p) <= limit) {
            kept[count] = *p;
            count += 1;
        }
        // Too few are left only where hardly two agree.
        fit(&kept[..count])
    }
}

/// Corners where the lines of four edges meet, on the plane that `map` places pixels on; edge i runs from corner i to the next.
pub fn corners(edges: &[Edge; 4], map: &impl Fn(&Vector2<f64>) -> Option<Vector2<f64>>) -> Option<[Vector2<f64>; 4]> {
    let mut lines = [const { None }; 4];
    for (line, edge) in lines.iter_mut().zip(edges) {
        *line = Some(edge.line(map)?);
    }
    let mut found = [Vector2::zeros(); 4];
    for (i, corner) in found.iter_mut().enumerate() {
        let (a, b) = (lines[(i + 3) % 4].as_ref()?, lines[i].as_ref()?);
        let determinant = a.normal.perp(&b.normal);
        // Sides that meet at less than 6 degrees meet nowhere in particular.
        if !(determinant.abs() > 0.1) {
            return None;
        }
        *corner =
            Vector2::new(a.offset * b.normal.y - b.offset * a.normal.y, a.normal.x * b.offset - b.normal.x * a.offset)
                / determinant;
    }
    Some(found)
}
