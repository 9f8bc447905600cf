//! What stands in a quadrilateral: reads its cells and finds the code.
//!
//! A tag has 8 x 8 cells: a black border of one cell and 6 x 6 cells of data inside; around it is a white rim of a cell. Rim and border
//! each say how bright white and black are, as a plane over the tag (light falls off); a cell is white above the middle of the two.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::codes::CODES;
use super::edges::bilinear;
use crate::geometry::homography::apply;
use crate::image::GreyImage;

/// Cells across a tag, its border included.
pub const CELLS: usize = 8;
/// Cells that may be misread. Any two codes differ in 11: up to 5 could be told, but what is no tag would be read as one more often.
pub const MOST_WRONG: u32 = 2;
/// White less black at the middle of a tag at the least, grey levels.
const LEAST_CONTRAST: f64 = 20.0;
/// Cells of 28 of the border and of 32 of the rim that may look like the other (specular light, a finger).
const MOST_WRONG_BORDER: usize = 2;
const MOST_WRONG_RIM: usize = 5;
/// Cells of the rim that must lie in the picture: those beside three of the four sides.
const LEAST_RIM: usize = 22;

/// Which tag, and how it lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Reading {
    pub id: u16,
    /// Cells that were misread.
    pub wrong: u32,
    /// Corner that is the tag's upper left one.
    pub first_corner: usize,
}

/// Homography from the unit square (corners clockwise from (0, 0), y down) to a quadrilateral (Heckbert 1989); `None` for a degenerate one.
pub(super) fn from_square(q: &[Vector2<f64>; 4]) -> Option<Matrix3<f64>> {
    let (d1, d2, s) = (q[1] - q[2], q[3] - q[2], q[0] - q[1] + q[2] - q[3]);
    let determinant = d1.perp(&d2);
    if !(determinant.abs() > 1e-9) {
        return None;
    }
    let (g, h) = (s.perp(&d2) / determinant, d1.perp(&s) / determinant);
    let (a, b) = (q[1] - q[0] + q[1] * g, q[3] - q[0] + q[3] * h);
    Some(Matrix3::new(a.x, b.x, q[0].x, a.y, b.y, q[0].y, g, h, 1.0))
}

/// Brightness as a plane over a tag: value = p . (u, v, 1), least squares.
fn plane(samples: &[(Vector2<f64>, f64)]) -> Option<Vector3<f64>> {
    let (mut hessian, mut gradient) = (Matrix3::zeros(), Vector3::zeros());
    for (at, value) in samples {
        let row = at.push(1.0);
        hessian += row * row.transpose();
        gradient += row * *value;
    }
    Some(nalgebra::Cholesky::new(hessian)?.solve(&gradient))
}

/// Mean brightness of a cell (numbers from -1, the rim, to 8) and its middle in the unit square.
fn cell(image: &GreyImage, h: &Matrix3<f64>, column: i32, row: i32) -> Option<(Vector2<f64>, f64)> {
    // Readings off a cell's middle, in cells.
    const AROUND: [[f64; 2]; 5] = [[0.0, 0.0], [0.2, 0.2], [-0.2, 0.2], [0.2, -0.2], [-0.2, -0.2]];
    let middle = Vector2::new(f64::from(column) + 0.5, f64::from(row) + 0.5);
    let mut sum = 0.0;
    for [u, v] in AROUND {
        sum += bilinear(image, &apply(h, &((middle + Vector2::new(u, v)) / CELLS as f64)))?;
    }
    Some((middle / CELLS as f64, sum / AROUND.len() as f64))
}

/// Cells of the ring of this many cells a side that begins at (first, first).
fn ring(first: i32, side: i32) -> impl Iterator<Item = (i32, i32)> {
    let last = first + side - 1;
    (0..side - 1).flat_map(move |i| [(first + i, first), (last, first + i), (last - i, last), (first, last - i)])
}

/// The same 6 x 6 cells seen by somebody who has turned by a quarter: the upper right one comes first.
fn quarter_turn(code: u64) -> u64 {
    let mut turned = 0;
    for row in 0..6 {
        for column in 0..6 {
            // Row by row of the turned tag: its columns are the rows, from the right.
            turned = turned << 1 | code >> (35 - (column * 6 + 5 - row)) & 1;
        }
    }
    turned
}

/// Number and misread cells of the nearest code; `None` where none is near.
fn nearest(code: u64) -> Option<(u16, u32)> {
    let distances = CODES.iter().enumerate().map(|(id, c)| ((c ^ code).count_ones(), id as u16));
    distances.min().filter(|(wrong, _)| *wrong <= MOST_WRONG).map(|(wrong, id)| (id, wrong))
}

/// Reads the quadrilateral with these corners, clockwise as seen, px.
pub fn read(image: &GreyImage, corners: &[Vector2<f64>; 4]) -> Option<Reading> {
    let h = from_square(corners)?;
    let mut border = [(Vector2::zeros(), 0.0); 28];
    for (sample, (column, row)) in border.iter_mut().zip(ring(0, 8)) {
        *sample = cell(image, &h, column, row)?;
    }
    // The rim without its corners, where something else may be near.
    let places = ring(-1, 10).filter(|(c, r)| (0..8).contains(c) || (0..8).contains(r));
    let (mut rim, mut seen) = ([(Vector2::zeros(), 0.0); 32], 0);
    for sample in places.filter_map(|(column, row)| cell(image, &h, column, row)) {
        rim[seen] = sample;
        seen += 1;
    }
    let rim = &rim[..seen];
    let (black, white) = (plane(&border)?, plane(rim)?);
    let (middle, contrast) = ((black + white) / 2.0, white - black);
    let is_white = |(at, value): &(Vector2<f64>, f64)| *value > middle.dot(&at.push(1.0));
    if seen < LEAST_RIM
        || !(contrast.dot(&Vector3::new(0.5, 0.5, 1.0)) >= LEAST_CONTRAST)
        || border.iter().filter(|s| is_white(s)).count() > MOST_WRONG_BORDER
        || rim.iter().filter(|s| !is_white(s)).count() > MOST_WRONG_RIM
    {
        return None;
    }
    let mut code = 0;
    for row in 1..7 {
        for column in 1..7 {
            code = code << 1 | u64::from(is_white(&cell(image, &h, column, row)?));
        }
    }
    for first_corner in 0..4 {
        if let Some((id, wrong)) = nearest(code) {
            return Some(Reading { id, wrong, first_corner });
        }
        code = quarter_turn(code);
    }
    None
}

/// Whether a cell of tag `id` is white; column and row from 0 to 7, the border included.
pub fn is_white(id: u16, column: usize, row: usize) -> bool {
    let inside = (1..7).contains(&column) && (1..7).contains(&row);
    inside && CODES[usize::from(id)] >> (35 - ((row - 1) * 6 + column - 1)) & 1 == 1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_two_codes_in_any_orientation_differ_in_eleven_cells() {
        for (i, &a) in CODES.iter().enumerate() {
            let mut turned = a;
            for turns in 0..4 {
                for (j, &b) in CODES.iter().enumerate() {
                    assert!(
                        (i, 0) == (j, turns) || (turned ^ b).count_ones() >= 11,
                        "{i} turned {turns} times and {j}"
                    );
                }
                turned = quarter_turn(turned);
            }
            assert_eq!(turned, a, "four quarters are a whole");
        }
    }

    #[test]
    fn the_square_maps_onto_the_quadrilateral() {
        let q = [[10.0, 12.0], [50.0, 9.0], [55.0, 60.0], [5.0, 45.0]].map(Vector2::from);
        let h = from_square(&q).expect("regular");
        for (corner, at) in q.iter().zip([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) {
            assert!((apply(&h, &Vector2::from(at)) - corner).norm() < 1e-9);
        }
    }
}
