//! A chessboard, and what of it was seen.

use nalgebra::Vector2;

/// Corners a side that a pattern may have.
pub const SIDE_RANGE: (u32, u32) = (3, 30);

/// A chessboard's size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pattern {
    /// Inner corners a row.
    pub columns: u32,
    /// Inner corners a column.
    pub rows: u32,
    /// Side of a square, m.
    pub square_m: f64,
}

impl Pattern {
    /// Checks the numbers; the error says what is allowed.
    pub fn new(columns: u32, rows: u32, square_m: f64) -> Result<Self, String> {
        let (low, high) = SIDE_RANGE;
        if !(low..=high).contains(&columns) || !(low..=high).contains(&rows) {
            return Err(format!("pattern {columns}x{rows}: must be {low} to {high} inner corners each way"));
        }
        if !(square_m > 1e-4 && square_m < 10.0) {
            return Err(format!("square {square_m} m: must lie between 0.0001 and 10 m"));
        }
        Ok(Self { columns, rows, square_m })
    }

    /// Number of inner corners.
    pub fn count(&self) -> usize {
        self.columns as usize * self.rows as usize
    }
}

/// One inner corner as seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoardCorner {
    /// From 0; along a row, and down.
    pub column: u32,
    pub row: u32,
    /// Where it is seen, level-0 pixels.
    pub pixel: Vector2<f64>,
}

/// A board in a picture.
#[derive(Debug, Clone, PartialEq)]
pub struct Board {
    /// Row by row; hidden ones are missing.
    pub corners: Vec<BoardCorner>,
    /// Every corner of the pattern is there.
    pub complete: bool,
    /// Shortest distance between neighbours, pixels.
    pub spacing_px: f64,
    /// Width of the edges' blur, one sigma, pixels.
    pub blur_px: f64,
}
