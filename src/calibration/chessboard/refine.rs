//! Corners to a fraction of a pixel.
//!
//! Input: the picture and a [`Fit`] on some pyramid level. Output: a [`Board`] in level-0 pixels. Along an edge that runs
//! through the corner p, the gradient g at q is perpendicular to q - p; so p minimises `sum w (g . (q - p))²` (Förstner & Gülch,
//! ISPRS Intercommission 1987), solved anew with the window moved to p until it stays. The weight falls to zero at
//! the window's rim, so that nothing jumps when pixels enter it, and the window is a share of the square's side, so that
//! no other corner is in it.
//!
//! Cost: 4 us a corner with a window of 15 pixels.

use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

use super::ordering::{Fit, MAX_MISFIT, misfit};
use super::{Board, BoardCorner, Pattern};
use crate::image::GreyImage;

/// Radius of the window as a share of the square's side, and its bounds, pixels.
const WINDOW_SHARE: f64 = 0.45;
const WINDOW_RANGE: (f64, f64) = (3.0, 12.0);
/// Steps at the most; four are usual.
const MAX_STEPS: usize = 12;
/// A step below this ends it, pixels.
const SMALL_STEP: f64 = 2e-3;

/// Refines every corner. `None`: fewer than three quarters of them hold.
pub fn refine(picture: &GreyImage, fit: &Fit, level: usize, pattern: &Pattern) -> Option<Board> {
    let scale = (1u32 << level) as f64;
    let base = |at: Vector2<f64>| at.map(|v| (v + 0.5) * scale - 0.5);
    let mut corners = Vec::with_capacity(pattern.count());
    let (mut spacing_px, mut slope) = (f64::INFINITY, Vec::new());
    for row in 0..fit.rows {
        for column in 0..fit.columns {
            let Some(at) = fit.place(column, row).map(base) else { continue };
            let neighbours = [
                fit.place(column + 1, row),
                column.checked_sub(1).and_then(|c| fit.place(c, row)),
                fit.place(column, row + 1),
                row.checked_sub(1).and_then(|r| fit.place(column, r)),
            ];
            let side = neighbours.into_iter().flatten().map(|n| (base(n) - at).norm()).fold(f64::INFINITY, f64::min);
            if !side.is_finite() {
                continue;
            }
            spacing_px = spacing_px.min(side);

            let radius = (WINDOW_SHARE * side).clamp(WINDOW_RANGE.0, WINDOW_RANGE.1);
            let reach = (0.3 * side).max(1.5);
            // A wide window holds more edge and less noise; a narrow one holds where the picture is smeared.
            let found = [1.0, 0.7]
                .into_iter()
                .find_map(|share| settle(picture, at, (share * radius).max(2.5), reach))
                .or_else(|| quadratic(picture, at, (0.45 * side).clamp(2.0, 8.0), reach).map(|p| (p, 0.0)));
            let Some((pixel, width)) = found else { continue };
            slope.push(width);
            corners.push(BoardCorner { column: column as u32, row: row as u32, pixel });
        }
    }
    straighten(picture, &mut corners);
    if (corners.len() as f64) < 0.75 * pattern.count() as f64 {
        return None;
    }
    slope.sort_by(f64::total_cmp);
    let blur_px = slope.get(slope.len() / 2).copied().unwrap_or(0.0);
    Some(Board { complete: corners.len() == pattern.count(), corners, spacing_px, blur_px })
}

/// Looks again for corners that ended out of line with their neighbours, where those put them, with a narrow window; drops what
/// is still out of line. The worst first.
fn straighten(picture: &GreyImage, corners: &mut Vec<BoardCorner>) {
    let mut tried: Vec<(u32, u32)> = Vec::new();
    for _ in 0..corners.len() / 2 {
        let place =
            |(i, j): (i32, i32)| corners.iter().find(|c| (c.column as i32, c.row as i32) == (i, j)).map(|c| c.pixel);
        let worst = corners
            .iter()
            .enumerate()
            .filter_map(|(n, c)| Some((misfit(&place, (c.column as i32, c.row as i32))?, n)))
            .max_by(|a, b| a.0.0.total_cmp(&b.0.0));
        let Some(((off, predicted), n)) = worst else { return };
        if off <= MAX_MISFIT {
            return;
        }
        let corner = corners[n];
        let side = (corner.pixel - predicted).norm() / off;
        let again = (!tried.contains(&(corner.column, corner.row)))
            .then(|| {
                let reach = (0.2 * side).max(1.0);
                settle(picture, predicted, (0.3 * side).clamp(2.5, 8.0), reach)
                    .map(|(p, _)| p)
                    .or_else(|| quadratic(picture, predicted, (0.4 * side).clamp(2.0, 8.0), reach))
            })
            .flatten();
        tried.push((corner.column, corner.row));
        match again {
            Some(pixel) => corners[n].pixel = pixel,
            None => drop(corners.remove(n)),
        }
    }
}

/// The corner near `start`, if it stays within `reach`; and the width of its edges, one sigma, pixels.
fn settle(picture: &GreyImage, start: Vector2<f64>, radius: f64, reach: f64) -> Option<(Vector2<f64>, f64)> {
    let mut at = start;
    let mut width = 0.0;
    for _ in 0..MAX_STEPS {
        let (next, w) = step(picture, at, radius)?;
        let moved = (next - at).norm();
        if !((next - start).norm() <= reach) {
            return None;
        }
        (at, width) = (next, w);
        if moved < SMALL_STEP {
            break;
        }
    }
    Some((at, width))
}

/// Saddle of the quadratic that fits the grey values best: for what is so blurred or so small that there are no edges left.
fn quadratic(picture: &GreyImage, start: Vector2<f64>, radius: f64, reach: f64) -> Option<Vector2<f64>> {
    let mut at = start;
    for _ in 0..4 {
        let (x0, x1, y0, y1) = window(picture, at, radius)?;
        let (mut a, mut b) = (SMatrix::<f64, 6, 6>::zeros(), SVector::<f64, 6>::zeros());
        for y in y0..=y1 {
            let dy = y as f64 - at.y;
            for (x, value) in picture.row(y).iter().enumerate().take(x1 + 1).skip(x0) {
                let dx = x as f64 - at.x;
                let weight = 1.0 - (dx * dx + dy * dy) / (radius * radius);
                if weight > 0.0 {
                    let row = SVector::from([1.0, dx, dy, dx * dx, dx * dy, dy * dy]);
                    a += row * row.transpose() * weight;
                    b += row * (weight * f64::from(*value));
                }
            }
        }
        let c = a.cholesky()?.solve(&b);
        let (xx, xy, yy) = (2.0 * c[3], c[4], 2.0 * c[5]);
        let det = xx * yy - xy * xy;
        if !(det < 0.0) {
            return None;
        }
        let move_by = Vector2::new(-(yy * c[1] - xy * c[2]), -(xx * c[2] - xy * c[1])) / det;
        at += move_by;
        if !((at - start).norm() <= reach) {
            return None;
        }
        if move_by.norm() < 0.01 {
            break;
        }
    }
    Some(at)
}

/// Pixels around a place whose neighbours are all in the picture: x from and to, y from and to.
fn window(picture: &GreyImage, at: Vector2<f64>, radius: f64) -> Option<(usize, usize, usize, usize)> {
    let low = |v: f64| (v - radius).ceil().max(1.0) as usize;
    let high = |v: f64, size: usize| (v + radius).floor().min(size as f64 - 2.0).max(0.0) as usize;
    let (x0, x1, y0, y1) = (low(at.x), high(at.x, picture.width), low(at.y), high(at.y, picture.height));
    (x1 >= x0 + 2 && y1 >= y0 + 2).then_some((x0, x1, y0, y1))
}

fn step(picture: &GreyImage, at: Vector2<f64>, radius: f64) -> Option<(Vector2<f64>, f64)> {
    let (x0, x1, y0, y1) = window(picture, at, radius)?;
    let inverse = 1.0 / (radius * radius);
    let (mut a, mut b, mut c, mut u, mut v) = (0.0f64, 0.0f64, 0.0f64, 0.0f64, 0.0f64);
    let (mut darkest, mut brightest, mut steepest) = (255u8, 0u8, 0.0f64);
    for y in y0..=y1 {
        let dy = y as f64 - at.y;
        let (up, mid, down) = (picture.row(y - 1), picture.row(y), picture.row(y + 1));
        for x in x0..=x1 {
            let dx = x as f64 - at.x;
            let inside = 1.0 - (dx * dx + dy * dy) * inverse;
            if inside <= 0.0 {
                continue;
            }
            let gx = f64::from(i16::from(mid[x + 1]) - i16::from(mid[x - 1]));
            let gy = f64::from(i16::from(down[x]) - i16::from(up[x]));
            let weight = inside * inside;
            let (xx, xy, yy) = (weight * gx * gx, weight * gx * gy, weight * gy * gy);
            a += xx;
            b += xy;
            c += yy;
            u += xx * dx + xy * dy;
            v += xy * dx + yy * dy;
            darkest = darkest.min(mid[x]);
            brightest = brightest.max(mid[x]);
            steepest = steepest.max(gx * gx + gy * gy);
        }
    }
    let matrix = Matrix2::new(a, b, b, c);
    let det = matrix.determinant();
    // One edge alone fixes no corner.
    if !(det > 1e-3 * (a + c) * (a + c)) {
        return None;
    }
    let delta = Vector2::new(c * u - b * v, a * v - b * u) / det;
    // An edge of height C blurred by sigma has slope C / (sigma sqrt(2 pi)); the differences span two pixels.
    let height = f64::from(brightest.saturating_sub(darkest));
    let width = if steepest > 0.0 { height / (0.5 * steepest.sqrt() * (std::f64::consts::TAU).sqrt()) } else { 0.0 };
    Some((at + delta, width))
}
