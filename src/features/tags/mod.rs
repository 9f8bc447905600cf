//! AprilTags of the family 36h11 in a grey picture, with their corners to a fraction of a pixel.
//!
//! Grey picture -> [`Tag`]s: number, misread cells, corners clockwise as printed from the upper left one, level-0 pixels (pixel (0, 0) is a
//! pixel's centre). The family: Wang & Olson, AprilTag 2 (2016); Olson, AprilTag (2011).
//! 1. `binary`: what is dark beside its surroundings. 2. `contour`: outlines of dark regions that are quadrilaterals.
//! 3. `edges`: where the brightness changes across the four sides. 4. `decode`: cells, code, orientation. 5. `inset`: by how much the camera's tone curve
//!    moves all edges towards the dark, which is undone.
//!
//! Needs all of a tag and its white rim in the picture, at least about 2 px a cell. A lens may bend the sides by a few percent: whoever has the camera asks
//! for the corners on an undistorted plane ([`Tag::corners_on`]).
//!
//! # Why our own
//! Measured in the 99 frames of a board of 12 tags, partly hidden (`visp_rbt`, 640 x 480, one core of a busy machine), beside the
//! crates that there are and OpenCV 5.0, each at its defaults but one thread:
//!
//! | | crates more | builds in (one core) | tags found | a frame, median |
//! |---|---:|---:|---:|---:|
//! | this | 0 | | 880 | 2.8 ms |
//! | `apriltag` 0.4, binding to the C library 3.2 | 7 | 40 s | 881 | 21.5 ms; at half resolution 880 and 9.3 ms |
//! | `kornia-apriltag` 0.2 | 148 | 478 s | 870 | 5.7 ms |
//! | `aprilgrid` 0.8, for calibration boards with small squares at the tags' corners | 176 | 568 s | 0 | 10.8 ms |
//! | OpenCV's `aruco`, four ways of refining corners | | | 868 to 870 | 21 to 57 ms |
//!
//! Corners triangulated under the true poses reproject with a median of 0.25 px here, 0.26 px with the binding, 0.26 px with `kornia-apriltag`
//! and 0.27 to 0.47 px with OpenCV.
//!
//! The binding would do by its detections. It links whatever `libapriltag` a machine has, by declarations made for version 3.2; it calls `exit` and
//! `assert`, which end a daemon; its detector cannot move between threads; and two misread cells cost it 37 MB of tables.

mod binary;
mod codes;
mod contour;
mod decode;
mod edges;
mod inset;

use nalgebra::Vector2;

use crate::image::GreyImage;
use binary::Mask;
pub use decode::{CELLS, is_white};
pub use edges::Edge;

/// Tags of the family; they are numbered from 0.
pub const FAMILY_SIZE: u16 = codes::CODES.len() as u16;

/// How far a corner may lie from where the outline had it, px, and as a share of the longest side.
const MOVED_PX: f64 = 4.0;
const MOVED_SHARE: f64 = 0.1;

/// Standard deviation of an inset that is not known, px: what gamma makes of a sharp edge. And of one that was measured.
pub const UNKNOWN_INSET_PX: f64 = 0.25;
pub const KNOWN_INSET_PX: f64 = 0.04;

/// A tag in a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tag {
    pub id: u16,
    /// Cells that were misread (0 to 2).
    pub wrong: u32,
    /// Outer corners of the black border, px: upper left, upper right, lower right, lower left as printed.
    pub corners: [Vector2<f64>; 4],
    /// How far edges were found on the dark side, px, which is undone; `None`: it cannot be told, the tag may seem smaller by twice
    /// [`UNKNOWN_INSET_PX`].
    pub inset_px: Option<f64>,
    /// What the corners rest on: edge i runs from corner i to the next.
    pub edges: [Edge; 4],
}

impl Tag {
    /// The corners on the plane that `map` places pixels on, where the tag's edges are straight.
    pub fn corners_on(&self, map: impl Fn(&Vector2<f64>) -> Option<Vector2<f64>>) -> Option<[Vector2<f64>; 4]> {
        edges::corners(&self.edges, &map)
    }
}

/// Finds tags. Holds nothing but memory to work in.
#[derive(Debug, Default)]
pub struct TagDetector {
    mask: Mask,
    outline: Vec<Vector2<i32>>,
}

impl TagDetector {
    /// All tags of the picture, by number, then from the top; a number that is there twice comes twice.
    pub fn detect(&mut self, image: &GreyImage, out: &mut Vec<Tag>) {
        out.clear();
        self.mask.fill(image);
        contour::quadrilaterals(&mut self.mask, &mut self.outline, |corners| out.extend(tag_at(image, &corners)));
        out.sort_by_key(|tag| tag.id);
    }
}

/// The tag whose outline has these corners.
fn tag_at(image: &GreyImage, outline: &[Vector2<f64>; 4]) -> Option<Tag> {
    let side = (0..4).map(|i| (outline[(i + 1) % 4] - outline[i]).norm()).fold(0.0, f64::max);
    let (mut corners, mut edges) = (*outline, None);
    // The second time from where the first has found the edges: the mean of a stretch that is off to one side is, too.
    for _ in 0..2 {
        let found: [Edge; 4] = std::array::from_fn(|i| edges::edge_points(image, &corners[i], &corners[(i + 1) % 4]));
        corners = edges::corners(&found, &|p| Some(*p))?;
        edges = Some(found);
    }
    let limit = MOVED_PX + MOVED_SHARE * side;
    if corners.iter().zip(outline).any(|(c, o)| !((c - o).norm() <= limit)) {
        return None;
    }
    let reading = decode::read(image, &corners)?;
    corners.rotate_left(reading.first_corner);
    let mut edges = edges?;
    edges.rotate_left(reading.first_corner);
    let inset_px = inset::inset_px(image, &corners, reading.id);
    if let Some(inset_px) = inset_px {
        for (i, edge) in edges.iter_mut().enumerate() {
            let along = corners[(i + 1) % 4] - corners[i];
            edge.shift(&(Vector2::new(along.y, -along.x) / along.norm() * inset_px));
        }
        corners = edges::corners(&edges, &|p| Some(*p))?;
    }
    Some(Tag { id: reading.id, wrong: reading.wrong, corners, inset_px, edges })
}

#[cfg(test)]
mod tests;
