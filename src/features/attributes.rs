//! What the method keeps of each corner: grey level, salient degree, direction.
//!
//! Purpose: what corners can be compared by and drawn with.
//! Input: grey picture, a corner's pixel, the similarity it was detected with. Output: [`Attributes`].
//! The direction has two cases. The USAN lies to one side: from the nucleus to its centre of gravity, an angle. It lies
//! on both sides alike (noise, or a thin line through the nucleus): the principal axis of its second moments,
//! (1/2) atan2(2 mu_xy, mu_xx - mu_yy), known up to half a turn. Paper: Smith and Brady, SUSAN, IJCV 1997 (edge direction).
//! Cost: one USAN with its moments a corner.
//! It deliberately does not do: the 41x41 mask (the small one measures the corner itself, not its surroundings).

use std::f32::consts::{PI, TAU};

use super::Corner;
use super::susan::{Similarity, Usan, usan};
use crate::image::GreyImage;

/// A centre of gravity nearer to the nucleus than this is a symmetric USAN's, pixels. A right-angled corner's is 1.7
/// away, a straight edge's 1.2, a line's 0.
pub const SYMMETRIC_BELOW_PX: f32 = 0.5;

/// An axis is told where the second moments along and across it differ by at least this share of their sum.
const LEAST_ANISOTROPY: f32 = 0.1;

/// Where a corner points.
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "snake_case", tag = "kind", content = "angle_rad")]
pub enum Direction {
    /// From the nucleus to the USAN's centre of gravity; radians from x (right) towards y (down), above -pi up to pi.
    Towards(f32),
    /// Along a symmetric USAN; radians from x towards y, 0 up to pi: the opposite way is the same axis.
    Axis(f32),
    /// A symmetric USAN that is as long as wide: a speck.
    Undefined,
}

impl Direction {
    /// Angle between two directions of the same kind, radians: 0 to pi, for axes 0 to pi / 2; 0 for two undefined ones.
    /// `None` where the kinds differ: an axis is not a direction.
    pub fn difference_rad(&self, other: &Self) -> Option<f32> {
        let on_circle = |a: f32, b: f32, turn: f32| {
            let d = (a - b).rem_euclid(turn);
            d.min(turn - d)
        };
        match (self, other) {
            (Self::Towards(a), Self::Towards(b)) => Some(on_circle(*a, *b, TAU)),
            (Self::Axis(a), Self::Axis(b)) => Some(on_circle(*a, *b, PI)),
            (Self::Undefined, Self::Undefined) => Some(0.0),
            _ => None,
        }
    }
}

/// What is kept of a corner.
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize, serde::Serialize)]
pub struct Attributes {
    /// Grey level of the nucleus.
    pub grey: u8,
    /// USAN area / mask area, 0..1.
    pub salient_degree: f32,
    pub direction: Direction,
}

impl From<&Usan> for Attributes {
    fn from(usan: &Usan) -> Self {
        Self { grey: usan.grey, salient_degree: usan.salient_degree, direction: direction(usan) }
    }
}

/// Attributes of the corner at the nearest whole pixel; `None` where the mask leaves the picture.
pub fn attributes(image: &GreyImage, corner: &Corner, similarity: &Similarity) -> Option<Attributes> {
    let (x, y) = (corner.x.round(), corner.y.round());
    if !(x >= 0.0 && y >= 0.0) {
        return None;
    }
    // `as` keeps what is too large at the largest number, which lies outside any picture.
    Some(Attributes::from(&usan(image, x as usize, y as usize, similarity)?))
}

fn direction(usan: &Usan) -> Direction {
    let [cx, cy] = usan.centroid;
    if cx * cx + cy * cy >= SYMMETRIC_BELOW_PX * SYMMETRIC_BELOW_PX {
        return Direction::Towards(cy.atan2(cx));
    }
    // About the nucleus: a symmetric USAN's centre of gravity hardly differs from it.
    let [xx, xy, yy] = usan.moments;
    let (sum, difference) = (xx + yy, (xx - yy).hypot(2.0 * xy));
    if difference <= LEAST_ANISOTROPY * sum {
        return Direction::Undefined;
    }
    let axis = (0.5 * (2.0 * xy).atan2(xx - yy)).rem_euclid(PI);
    // The remainder of a tiny negative angle can round up to the whole.
    Direction::Axis(if axis < PI { axis } else { 0.0 })
}

#[cfg(test)]
mod tests;
