//! Pictures, as PNG: what a run mapped, how it compares with the truth, what two pictures gave, what a calibration rests on, and
//! charts.
//!
//! Input: a map and a trajectory, an evaluation's outcome, or a pair's corners, matches, lines and points. Output: one PNG, whole
//! or not at all. Equal lengths are equal in every orthogonal view of space. Text is DejaVu Sans from inside the binary: no system
//! font or graphics library is needed. The same input gives the same bytes. Cost: 50-150 ms and 10 MB a picture, at the end of a
//! run only.
//!
//! Deliberately not here: live views, interaction.

use std::io::{self, BufWriter};
use std::path::Path;

use crate::atomic_file::{WriteError, write_atomically};

mod axes;
mod calibration;
mod canvas;
mod chart;
mod comparison;
mod overview;
mod pair;
mod space;
mod text;

#[cfg(test)]
mod tests;

pub use calibration::{BoardCorner, write_coverage, write_view};
pub use chart::{Chart, write_chart};
pub use comparison::write_comparison;
pub use overview::write_overview;
pub use pair::{
    CornerMark, EpipolarMark, Link, MarkDirection, points_along, write_corners, write_epipolar_lines, write_links,
};
pub use space::{SpaceCamera, write_space};

/// What a length in a picture is called. Lengths without a metric scale are never called metres.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LengthUnit {
    #[default]
    MapUnits,
    Metres,
}

impl LengthUnit {
    fn name(self) -> &'static str {
        match self {
            Self::MapUnits => "map units",
            Self::Metres => "m",
        }
    }
}

/// Why there is no picture.
#[derive(Debug, thiserror::Error)]
pub enum PlotError {
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error("cannot draw: {0}")]
    Draw(&'static str),
}

/// Writes a finished canvas.
fn save(path: &Path, canvas: &canvas::Canvas) -> Result<(), PlotError> {
    let (width, height, rgb) = canvas.rgb();
    write_atomically(path, |out| {
        let mut encoder = png::Encoder::new(BufWriter::new(out), width, height);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header().map_err(io::Error::from)?;
        writer.write_image_data(&rgb).map_err(io::Error::from)?;
        writer.finish().map_err(io::Error::from)
    })?;
    Ok(())
}

/// Colours as `0xRRGGBB`.
mod palette {
    pub const PAPER: u32 = 0xffffff;
    pub const INK: u32 = 0x1f2933;
    pub const MUTED: u32 = 0x616e7c;
    pub const GRID: u32 = 0xe4e7eb;
    pub const FRAME: u32 = 0x9aa5b1;
    pub const TRUTH: u32 = 0xa3adb8;
    pub const ESTIMATE: u32 = 0x1d6fd8;
    pub const ROTATION: u32 = 0x8a3fc7;
    pub const LOST: u32 = 0xd64545;
    pub const LANDMARK: u32 = 0x2f4b6b;
    pub const KEYFRAME: u32 = 0xf08a24;
    pub const START: u32 = 0x199e5b;
    /// The method's colours: corners and cameras red, matches green, points blue.
    pub const CORNER: u32 = 0xe02020;
    pub const MATCH: u32 = 0x14b814;
    pub const OUTLIER: u32 = 0xe0a020;
    pub const POINT: u32 = 0x1d4fd8;
    /// Told apart by colour-blind eyes too (Okabe & Ito).
    pub const CATEGORIES: [u32; 7] = [0x0072b2, 0xe69f00, 0x009e73, 0xcc79a7, 0xd55e00, 0x56b4e9, 0xf0e442];

    /// From dark violet (0) over teal to yellow (1): ordered in lightness too, so it survives grey printing.
    pub fn sequential(t: f64) -> u32 {
        const STOPS: [(f64, f64, f64); 6] = [
            (68.0, 1.0, 84.0),
            (65.0, 68.0, 135.0),
            (42.0, 120.0, 142.0),
            (34.0, 168.0, 132.0),
            (122.0, 209.0, 81.0),
            (240.0, 215.0, 30.0),
        ];
        let at = if t.is_finite() { t.clamp(0.0, 1.0) } else { 0.0 } * (STOPS.len() - 1) as f64;
        let below = (at.floor() as usize).min(STOPS.len() - 2);
        let f = at - below as f64;
        let (a, b) = (STOPS[below], STOPS[below + 1]);
        let mix = |a: f64, b: f64| (a + f * (b - a)).round() as u32;
        mix(a.0, b.0) << 16 | mix(a.1, b.1) << 8 | mix(a.2, b.2)
    }
}
