//! Map-free work on one picture: pyramid, corners, descriptors, frame-to-frame tracks. Knows no map.

pub mod alignment;
pub mod attributes;
pub mod config;
pub mod correlation;
pub mod descriptor;
mod dispatch;
pub mod fast;
pub mod gradients;
pub mod matching;
pub mod optical_flow;
pub mod patch_sampling;
mod repetition;
pub mod spread;
pub mod stage;
pub mod susan;
pub mod susan_large;
pub mod tags;
pub mod thumbnail;

pub use config::{DetectorKind, FeaturesConfig};
pub use stage::FeatureStage;

use std::sync::Arc;

use nalgebra::Vector2;

use crate::image::{GreyImage, Pyramid};

/// A corner of one picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Corner {
    /// Level-0 pixels, sub-pixel where the detector refines.
    pub x: f32,
    pub y: f32,
    /// Detector's own strength, larger is better; comparable within one detector only.
    pub response: f32,
}

/// One square of a [`CellGrid`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cell {
    /// Corners are wanted here; a detector skips the others.
    pub wanted: bool,
    /// Detection threshold of this cell, grey levels (FAST: brightness difference of the ring to the centre; SUSAN:
    /// brightness threshold t). Whoever asks adapts it from one detection to the next.
    pub threshold: f32,
}

/// Square cells over a picture: where corners are looked for, and how sensitively.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CellGrid {
    /// Side of a cell, pixels; the last column and row may be narrower. 0 only in an empty grid.
    pub cell_px: usize,
    pub columns: usize,
    pub rows: usize,
    /// `columns * rows` cells, row by row.
    pub cells: Vec<Cell>,
}

impl CellGrid {
    /// A grid over a `width` x `height` picture with every cell wanted at `threshold` (grey levels).
    pub fn new(width: usize, height: usize, cell_px: usize, threshold: f32) -> Self {
        let cell_px = cell_px.max(1);
        let (columns, rows) = (width.div_ceil(cell_px), height.div_ceil(cell_px));
        Self { cell_px, columns, rows, cells: vec![Cell { wanted: true, threshold }; columns * rows] }
    }

    /// Index of the cell that holds a level-0 pixel position; `None` outside the grid.
    pub fn index(&self, x: f32, y: f32) -> Option<usize> {
        // A pixel's centre is its integer coordinate, so pixel x covers [x - 0.5, x + 0.5).
        let (x, y) = (x + 0.5, y + 0.5);
        if !(x >= 0.0 && y >= 0.0) || self.cell_px == 0 {
            return None;
        }
        let (column, row) = (x as usize / self.cell_px, y as usize / self.cell_px);
        (column < self.columns && row < self.rows).then(|| row * self.columns + column)
    }
}

/// Finds corners in the wanted cells of a picture.
///
/// A detector keeps its scratch buffers between calls and allocates nothing once it has seen a picture of this size.
pub trait CornerDetector: std::fmt::Debug + Send {
    /// Clears `out` and fills it with the corners of every wanted cell of `cells` (which covers `image`), at that
    /// cell's threshold, after non-maximum suppression (across cell borders too: a corner must beat its neighbours
    /// in other cells). Order: raster (y, then x) of the pixel found, so that the result is deterministic.
    /// Positions may stay whole pixels. Pixels that the detector's mask cannot reach near the picture's edge give
    /// no corner; a picture smaller than the mask gives none at all.
    fn detect(&mut self, image: &GreyImage, cells: &CellGrid, out: &mut Vec<Corner>);
}

/// A point followed from frame to frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Track {
    /// Unique over the life of the feature stage; ascending in order of birth.
    pub id: u64,
    /// Level-0 pixel in this frame.
    pub position: Vector2<f32>,
    /// Frames since birth; 0 = detected in this frame.
    pub age: u32,
}

/// What the feature stage hands to reconstruction.
#[derive(Debug, Clone, Default)]
pub struct FrameFeatures {
    pub sequence: u64,
    /// Capture time, source's clock.
    pub timestamp_ns: i64,
    /// CLOCK_MONOTONIC of arrival.
    pub arrival_ns: i64,
    /// CLOCK_MONOTONIC when the decoded grey picture was ready.
    pub decoded_ns: i64,
    /// The picture; level 0 is the whole grey picture.
    pub pyramid: Arc<Pyramid>,
    /// Ascending id.
    pub tracks: Vec<Track>,
}

/// What flows back from reconstruction to the feature stage.
#[derive(Debug, Clone, Default)]
pub struct Feedback {
    /// Tracks to forget, ascending.
    pub forget: Vec<u64>,
}
