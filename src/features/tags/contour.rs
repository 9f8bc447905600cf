//! Quadrilaterals among the outlines of dark regions.
//!
//! An outline runs along the cracks between pixels, the dark ones on its right, so that what is dark touches at sides only and what is
//! bright at corners as well: a tag's border never runs into the next thing across its white rim. Corners of an outline: the
//! point farthest from its middle, the one farthest from that, the one farthest beside the line of the two, and the one farthest outside of the
//! triangle of the three; the outline must then run along the four sides. Every crack is walked once, so the cost is bounded by the picture's texture.

use nalgebra::Vector2;

use super::binary::{DARK, Mask};

/// The crack above a dark pixel was walked.
const WALKED: u8 = 2;
/// Least width and height of an outline, px: a tag of 8 cells with less than 2 px a cell cannot be read.
const LEAST_SIDE_PX: i32 = 14;
/// Longest outline that is kept, cracks: a tag that fills a picture of 4096 px.
const LONGEST: usize = 16_384;
/// How far an outline may leave a side, px, and as a share of the side (lenses bend it).
const OFF_SIDE_PX: f64 = 2.0;
const OFF_SIDE_SHARE: f64 = 0.06;

/// A crack's end, px of the mask; (0, 0) is a pixel's outer corner.
type Vertex = Vector2<i32>;

/// Right, down, left, up.
const STEPS: [[i32; 2]; 4] = [[1, 0], [0, 1], [-1, 0], [0, -1]];

/// Calls `found` with the corners, clockwise as seen, px (0, 0 is a pixel's centre), of everything that looks like a quadrilateral.
pub fn quadrilaterals(mask: &mut Mask, outline: &mut Vec<Vertex>, mut found: impl FnMut([Vector2<f64>; 4])) {
    for y in 1..mask.rows.saturating_sub(1) {
        for x in 1..mask.stride - 1 {
            let here = y * mask.stride + x;
            if mask.pixels[here] != DARK || mask.pixels[here - mask.stride] & DARK != 0 {
                continue;
            }
            if walk(mask, Vector2::new(x as i32, y as i32), outline)
                && let Some(corners) = corners(outline)
            {
                // A vertex is half a pixel before its pixel's centre, and the mask has a rim.
                found(corners.map(|c| c.map(|v| f64::from(v) - 1.5)));
            }
        }
    }
}

/// Walks the outline that begins with the crack above this pixel; false if nothing came of it.
fn walk(mask: &mut Mask, start: Vertex, outline: &mut Vec<Vertex>) -> bool {
    outline.clear();
    let stride = mask.stride as i32;
    let (mut at, mut heading) = (start, 0);
    let mut whole = true;
    // Twice the area, positive where the inside is on the right.
    let mut area = 0i64;
    // No crack is walked twice.
    for _ in 0..4 * mask.pixels.len() {
        if outline.len() < LONGEST {
            outline.push(at);
        } else {
            whole = false;
        }
        if heading == 0 {
            mask.pixels[(at.y * stride + at.x) as usize] |= WALKED;
        }
        let [dx, dy] = STEPS[heading];
        let next = at + Vector2::new(dx, dy);
        area += i64::from(at.x) * i64::from(next.y) - i64::from(next.x) * i64::from(at.y);
        at = next;
        // The pixels beyond the vertex, on the right and on the left.
        let (rx, ry) = ((dx - dy - 1) / 2, (dy + dx - 1) / 2);
        let (lx, ly) = ((dx + dy - 1) / 2, (dy - dx - 1) / 2);
        let dark = |x: i32, y: i32| mask.pixels[((at.y + y) * stride + at.x + x) as usize] & DARK != 0;
        if !dark(rx, ry) {
            heading = (heading + 1) % 4;
        } else if dark(lx, ly) {
            heading = (heading + 3) % 4;
        }
        if at == start && heading == 0 {
            break;
        }
    }
    whole && area > 0
}

fn corners(outline: &[Vertex]) -> Option<[Vertex; 4]> {
    let (mut low, mut high, mut sum) = (outline[0], outline[0], Vector2::<i64>::zeros());
    for v in outline {
        (low, high) = (low.inf(v), high.sup(v));
        sum += v.map(i64::from);
    }
    if outline.len() < 4 * LEAST_SIDE_PX as usize || (high - low).min() < LEAST_SIDE_PX {
        return None;
    }
    let n = outline.len();
    let farthest = |distance: &dyn Fn(&Vertex) -> i64| {
        let mut best = (i64::MIN, 0);
        for (i, v) in outline.iter().enumerate() {
            best = best.max((distance(v), n - i));
        }
        (best.0, n - best.1)
    };
    let squared = |v: Vector2<i64>| v.x * v.x + v.y * v.y;
    // Cross product of b - a and v - a: positive to the right of a -> b, as pictures have y down.
    let beside = |a: usize, b: usize, v: &Vertex| {
        let (d, e) = ((outline[b] - outline[a]).map(i64::from), (v - outline[a]).map(i64::from));
        d.x * e.y - d.y * e.x
    };
    let scale = n as i64;
    let (_, first) = farthest(&|v| squared(v.map(i64::from) * scale - sum));
    let (_, second) = farthest(&|v| squared((v - outline[first]).map(i64::from)));
    let (_, third) = farthest(&|v| beside(first, second, v).abs());
    let mut triangle = [first, second, third];
    triangle.sort_unstable();
    // Along the outline the inside is on the right: what is outside of a side of the triangle is on its left.
    let [a, b, c] = triangle;
    let outside = |from: usize, to: usize, v: &Vertex| {
        let side = (outline[to] - outline[from]).map(f64::from).norm().max(1.0);
        (-beside(from, to, v) as f64 / side * 16.0) as i64
    };
    let (_, fourth) = farthest(&|v| outside(a, b, v).max(outside(b, c, v)).max(outside(c, a, v)));
    let mut found = [a, b, c, fourth];
    found.sort_unstable();
    for i in 0..4 {
        let (from, to) = (found[i], found[(i + 1) % 4]);
        let side = (outline[to] - outline[from]).map(f64::from).norm();
        if side < 0.5 * f64::from(LEAST_SIDE_PX) || beside(from, to, &outline[found[(i + 2) % 4]]) <= 0 {
            return None;
        }
        let allowed = (OFF_SIDE_PX + OFF_SIDE_SHARE * side) * side;
        let steps = (to + n - from) % n;
        if (0..steps).any(|k| beside(from, to, &outline[(from + k) % n]).abs() as f64 > allowed) {
            return None;
        }
    }
    Some(found.map(|i| outline[i]))
}
