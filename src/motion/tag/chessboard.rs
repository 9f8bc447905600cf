//! The calibration's chessboard as one large tag.
//!
//! A board's inner corners and the camera -> the four corners of the largest square in their middle that is whole squares wide, from the homography that all
//! of them fit on the undistorted plane: each is as sure as many corners are. From there on it is a tag of that size.

use nalgebra::Vector2;

use super::edge_length::CORNERS;
use crate::calibration::chessboard::{Detector, Pattern};
use crate::geometry::CameraModel;
use crate::geometry::homography::{apply, dlt};
use crate::image::GreyImage;

/// `[tag.chessboard]`: a board of known squares beside the tags, or in their place.
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct ChessboardConfig {
    /// Side of its squares, m. 0 (none is looked for) or 0.005..=1.0.
    pub square_m: f64,
    /// Standard deviation of that, m. 0.0..=0.1, and less than a tenth of the square.
    pub square_sigma_m: f64,
    /// Inner corners a row and a column, 3..=30, one number odd and one even.
    pub columns: u32,
    pub rows: u32,
}

impl Default for ChessboardConfig {
    fn default() -> Self {
        Self { square_m: 0.0, square_sigma_m: 0.0001, columns: 9, rows: 6 }
    }
}

impl ChessboardConfig {
    /// Whether it is looked for.
    pub fn is_on(&self) -> bool {
        self.square_m > 0.0
    }

    /// First value out of its range: key, and what is allowed.
    pub(super) fn validate(&self) -> Result<(), (&'static str, String)> {
        let square = self.square_m;
        // Written so that NaN fails.
        if !(square == 0.0 || (0.005..=1.0).contains(&square)) {
            return Err(("chessboard.square_m", "must be 0 (no board) or 0.005 to 1.0 m".into()));
        }
        if !((0.0..=0.1).contains(&self.square_sigma_m) && (square == 0.0 || self.square_sigma_m < 0.1 * square)) {
            let allowed = "must be 0 to 0.1 m, and less than a tenth of square_m";
            return Err(("chessboard.square_sigma_m", allowed.into()));
        }
        if self.is_on() {
            self.pattern().map_err(|reason| ("chessboard.columns", reason))?;
        }
        if (self.columns + self.rows).is_multiple_of(2) {
            let (columns, rows) = (self.columns, self.rows);
            let reason =
                format!("a board of {columns} by {rows} looks the same upside down: one number must be odd, one even");
            return Err(("chessboard.columns", reason));
        }
        Ok(())
    }

    fn pattern(&self) -> Result<Pattern, String> {
        Pattern::new(self.columns, self.rows, self.square_m)
    }

    /// Squares along the side of the tag that stands for it.
    fn squares(&self) -> f64 {
        f64::from(self.columns.min(self.rows)) - 1.0
    }

    /// Side of that tag and its standard deviation, m.
    pub(super) fn size(&self) -> (f64, f64) {
        (self.squares() * self.square_m, self.squares() * self.square_sigma_m)
    }
}

/// Finds the board.
#[derive(Debug)]
pub(super) struct Finder {
    config: ChessboardConfig,
    pattern: Pattern,
    detector: Detector,
}

impl Finder {
    /// `None` where none is to be looked for.
    pub(super) fn new(config: &ChessboardConfig) -> Option<Self> {
        let pattern = config.pattern().ok().filter(|_| config.is_on())?;
        Some(Self { config: *config, pattern, detector: Detector::default() })
    }

    /// Corners of the tag that stands for the board, px; `None`: not all of its corners are in the picture.
    pub(super) fn find(&mut self, image: &GreyImage, camera: &CameraModel) -> Option<[Vector2<f64>; 4]> {
        let board = self.detector.detect(image, &self.pattern).board().filter(|board| board.complete)?;
        let middle = Vector2::new(f64::from(self.pattern.columns - 1), f64::from(self.pattern.rows - 1)) / 2.0;
        let squares = self.config.squares();
        let (mut places, mut seen) = (Vec::new(), Vec::new());
        for corner in &board.corners {
            places.push((Vector2::new(f64::from(corner.column), f64::from(corner.row)) - middle) / squares);
            seen.push(camera.undistort(&corner.pixel)?);
        }
        let homography = dlt(&places, &seen)?;
        let mut pixels = [Vector2::zeros(); 4];
        for (pixel, corner) in pixels.iter_mut().zip(CORNERS) {
            *pixel = camera.distort(&apply(&homography, &Vector2::from(corner)))?;
        }
        Some(pixels)
    }
}
