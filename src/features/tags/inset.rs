//! How far a tag's edges are found on the dark side of where they are.
//!
//! A camera blurs light and then bends its values (gamma, whites that are clipped): the middle of an edge as brightness has it lies towards the dark, by
//! 0.25 to 0.7 px, on each side of a tag, which seems smaller by twice as much. The border tells by how much: its inner edge, beside the white cells of the
//! data, goes the other way. With the inset d the tag of 8 cells c measures `8 c - 2 d` and its border `c - 2 d`, so d is what the border lacks
//! of an eighth of the tag, times 4/7.

use nalgebra::{Matrix3, Vector2};

use super::decode::{CELLS, from_square, is_white};
use super::edges::{crossing, reach_steps};
use crate::geometry::homography::apply;
use crate::image::GreyImage;

/// Borders that are narrower, px, are not measured: one edge of theirs blurs the other.
const LEAST_CELL_PX: f64 = 4.0;
/// Nor are wider ones, px: over so large a tag a lens that bends makes the border another eighth than the rest by as much, and the inset is a small
/// share of it.
const MOST_CELL_PX: f64 = 14.0;
/// Fewer measurements say nothing: two white cells' worth.
const LEAST_COUNT: usize = 6;
/// Places along a white cell where its border is measured, away from its neighbours.
const PLACES: [f64; 3] = [0.3, 0.5, 0.7];
const MOST_COUNT: usize = 4 * 6 * PLACES.len();
/// What is measured is believed between these, px.
const LEAST_PX: f64 = -0.5;
const MOST_PX: f64 = 1.0;

/// The inset of tag `id` with these corners as printed, px; `None` where its border is too narrow or too wide to tell.
pub fn inset_px(image: &GreyImage, corners: &[Vector2<f64>; 4], id: u16) -> Option<f64> {
    let h = from_square(corners)?;
    let (mut found, mut count) = ([0.0; MOST_COUNT], 0);
    for side in 0..4 {
        let (from, to) = (corners[side], corners[(side + 1) % 4]);
        let length = (to - from).norm();
        let normal = Vector2::new(to.y - from.y, from.x - to.x) / length;
        for cell in 1..CELLS - 1 {
            let (last, inner) = (CELLS - 1, CELLS - 2);
            let (column, row) = [(cell, 1), (inner, cell), (last - cell, inner), (1, last - cell)][side];
            if !is_white(id, column, row) {
                continue;
            }
            for place in PLACES {
                let along = (cell as f64 + place) / CELLS as f64;
                if let Some(inset) = at(image, &h, side, along, &normal, reach_steps(length)) {
                    found[count] = inset;
                    count += 1;
                }
            }
        }
    }
    let found = &mut found[..count];
    found.sort_unstable_by(f64::total_cmp);
    let middle = (count >= LEAST_COUNT).then(|| 0.5 * (found[(count - 1) / 2] + found[count / 2]))?;
    (LEAST_PX..=MOST_PX).contains(&middle).then_some(middle)
}

/// What the border says at one place along a side.
fn at(image: &GreyImage, h: &Matrix3<f64>, side: usize, along: f64, normal: &Vector2<f64>, steps: i32) -> Option<f64> {
    let cell = 1.0 / CELLS as f64;
    // Places on the unit square: u to the right, v down.
    let place = |deep: f64| match side {
        0 => Vector2::new(along, deep),
        1 => Vector2::new(1.0 - deep, along),
        2 => Vector2::new(1.0 - along, 1.0 - deep),
        _ => Vector2::new(deep, 1.0 - along),
    };
    let outer = apply(h, &place(0.0));
    // Across the side in the picture, which across the tag is not.
    let eighth = (outer - apply(h, &place(cell))).dot(normal);
    if !(LEAST_CELL_PX..=MOST_CELL_PX).contains(&eighth) {
        return None;
    }
    let inner = outer - normal * eighth;
    // The same scan both times: bright is outwards, and then inwards.
    let border = eighth + crossing(image, &outer, normal, steps)? + crossing(image, &inner, &-normal, steps)?;
    Some((eighth - border) * 4.0 / 7.0)
}
