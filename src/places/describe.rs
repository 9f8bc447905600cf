//! What the index is told of a picture: binary descriptors of its strongest corners, spread over it.
//!
//! Corners and descriptors are those of coarser levels of the pyramid: a patch covers more of the scene there, is sharp in blurred pictures, too,
//! and 31 px of half the resolution are more of a place's own than of the full one's. Turned by their centre of brightness, as cameras roll.
//! Cost: a millisecond a keyframe at 640 x 480.

use crate::features::Corner;
use crate::features::descriptor::{Descriptor, Orientation, describe};
use crate::features::fast::FastDetector;
use crate::features::spread::Spread;
use crate::image::Pyramid;

use super::index::DESCRIPTORS;

/// Levels, and how many quarters of the corners are of each.
const QUARTERS: [(usize, usize); 2] = [(1, 3), (2, 1)];
/// Side of the cells over which they are spread, in the level's pixels.
const CELL_PX: usize = 32;
/// Brightness difference of a corner, grey levels; the strongest of each cell come first.
const THRESHOLD: u8 = 10;

/// Buffers, kept between pictures.
#[derive(Debug, Default)]
pub struct PlaceDescriber {
    detector: FastDetector,
    corners: Vec<Corner>,
    spread: Spread,
}

impl PlaceDescriber {
    /// As many as the index keeps. Clears `out`. Of a covered or even picture there is nothing to tell.
    pub fn describe(&mut self, pyramid: &Pyramid, out: &mut Vec<Descriptor>) {
        self.describe_strongest(pyramid, DESCRIPTORS, out);
    }

    /// At most so many of these: the strongest of each level.
    pub fn describe_strongest(&mut self, pyramid: &Pyramid, most: usize, out: &mut Vec<Descriptor>) {
        out.clear();
        for (level, quarters) in QUARTERS {
            let Some(image) = pyramid.levels.get(level) else { continue };
            self.detector.detect_all(image, THRESHOLD, &mut self.corners);
            let spread = self.spread.over_cells((image.width, image.height), CELL_PX, &mut self.corners);
            let described = spread.filter_map(|c| describe(image, c.x, c.y, Orientation::IntensityCentroid));
            out.extend(described.take(most * quarters / 4).map(|d| d.descriptor));
        }
    }
}
