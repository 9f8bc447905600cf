//! Corners that look alike: a radiator's ribs, a fence, tiles.
//!
//! Where the picture moves quickly, a guess of where a track went can be wrong by half such a period, and then all tracks on the pattern step over
//! to the next rib together: every one of them correlates well, and what is behind looks like a motion of the camera. So they are told
//! when they are started, by their own picture, and followed last (`stage`).
//!
//! In: a picture, a corner of it, all corners found with it in raster order. Out: whether another one nearby has the same patch. Cost: some
//! 50 ns for each corner within reach. Allocates nothing. Not here: patterns between detected corners, or in cells that want no corner.

use nalgebra::Vector2;

use super::Corner;
use super::alignment::Template;
use crate::image::GreyImage;

/// Farther away than this a pattern's next period is no danger to a track, px.
const REACH_PX: f32 = 32.0;
/// Nearer than this it is the same corner, px.
const SAME_PX: f32 = 4.0;
/// Patches that correlate at least so well look alike; as a track's in two pictures must.
const ALIKE_NCC: f32 = 0.8;

/// Whether one of `corners` (raster order) near `position` looks the same in `image` as `template`, which was cut at `position`.
pub fn is_repeated(image: &GreyImage, template: &Template, position: Vector2<f32>, corners: &[Corner]) -> bool {
    let first = corners.partition_point(|c| c.y < position.y - REACH_PX);
    let near = corners[first..].iter().take_while(|c| c.y <= position.y + REACH_PX);
    near.map(|c| Vector2::new(c.x, c.y)).any(|other| {
        let distance = (other - position).norm();
        (SAME_PX..=REACH_PX).contains(&distance) && template.ncc(image, other).is_some_and(|ncc| ncc >= ALIKE_NCC)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::{CellGrid, CornerDetector, fast::FastDetector};

    /// Blocks of 6 px, `period` apart, whose brightness and height `shape` gives.
    fn share_repeated(period: usize, shape: impl Fn(usize) -> (u8, usize)) -> f64 {
        let mut picture = GreyImage::new(320, 240);
        for (i, pixel) in picture.data.iter_mut().enumerate() {
            let (x, y) = (i % 320, i / 320);
            let (brightness, height) = shape(x / period);
            *pixel = if x % period < 6 && (100..100 + height).contains(&y) { brightness } else { 60 };
        }
        let mut corners = Vec::new();
        FastDetector::new().detect(&picture, &CellGrid::new(320, 240, 32, 20.0), &mut corners);
        assert!(corners.len() > 20, "{} corners: the picture is too poor", corners.len());
        let repeated = corners.iter().filter(|c| {
            let position = Vector2::new(c.x, c.y);
            Template::from_image(&picture, position).is_some_and(|t| is_repeated(&picture, &t, position, &corners))
        });
        repeated.count() as f64 / corners.len() as f64
    }

    #[test]
    fn ribs_look_alike_and_what_is_farther_apart_is_no_danger() {
        assert!(share_repeated(18, |_| (160, 80)) > 0.8);
        assert!(share_repeated(40, |_| (160, 80)) < 0.2);
    }
}
