//! Corners of a picture that may be known again without a track between: where they are, and what they look like.
//!
//! Input: a pyramid, and places that are taken. Output: corners spread over the picture, each with its upright binary descriptor.
//! Cost: 0.7 ms at 640x480. Not here: matching them (`epipolar`, `initialise`).

use nalgebra::Vector2;

use crate::features::Corner;
use crate::features::alignment::Template;
use crate::features::descriptor::{Orientation, describe_at_level};
use crate::features::fast::FastDetector;
use crate::features::spread::Spread;
use crate::geometry::CameraModel;
use crate::image::Pyramid;
use crate::map::FreeCorner;

/// Corners of a picture, at the most, spread over cells of this side (px).
const CORNERS: usize = 500;
pub const CELL_PX: usize = 24;
/// Brightness difference of a corner, grey levels, and the smaller eigenvalue of its structure tensor, grey²/px²: an edge would be found
/// anywhere along itself, and so also where a pose that is wrong puts it. (At 8, as of tracks, two of four walks at 5 Hz were bent by
/// it in a turn; at 60 quick recordings run out of corners.)
const THRESHOLD: u8 = 10;
const MIN_EIGENVALUE: f32 = 30.0;
/// A corner this close to a landmark's place is that landmark, px.
pub const SAME_CORNER_PX: f32 = 4.0;
/// Finds corners; keeps its buffers.
#[derive(Debug, Default)]
pub struct CornerFinder {
    detector: FastDetector,
    corners: Vec<Corner>,
    spread: Spread,
}

impl CornerFinder {
    /// Corners of a picture but for those at places that are `taken`, level-0 px.
    pub fn find(
        &mut self,
        pyramid: &Pyramid,
        camera: &CameraModel,
        taken: impl Iterator<Item = Vector2<f32>>,
    ) -> Vec<FreeCorner> {
        let Some(image) = pyramid.levels.first() else { return Vec::new() };
        self.detector.detect_all(image, THRESHOLD, &mut self.corners);
        let spread = self.spread.over_cells((image.width, image.height), CELL_PX, &mut self.corners);
        // From top to bottom, so that few are compared with a corner.
        let mut taken: Vec<Vector2<f32>> = taken.collect();
        taken.sort_by(|a, b| a.y.total_cmp(&b.y));
        let is_taken = |pixel: &Vector2<f32>| {
            let first = taken.partition_point(|t| t.y <= pixel.y - SAME_CORNER_PX);
            let mut beside = taken[first..].iter().take_while(|t| t.y < pixel.y + SAME_CORNER_PX);
            beside.any(|t| (t - pixel).norm() < SAME_CORNER_PX)
        };
        let free = spread.filter_map(|corner| {
            let pixel = Vector2::new(corner.x, corner.y);
            if is_taken(&pixel) || Template::eigenvalues_at(image, pixel)?[0] < MIN_EIGENVALUE {
                return None;
            }
            let normalised = camera.undistort(&pixel.cast())?;
            let described = describe_at_level(pyramid, 0, pixel.x, pixel.y, Orientation::Upright)?;
            Some(FreeCorner { pixel, normalised, descriptor: described.descriptor })
        });
        free.take(CORNERS).collect()
    }
}
