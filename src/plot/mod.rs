//! Pictures, as PNG: what a run mapped, how it compares with the truth, what two pictures gave, what a calibration rests on, and
//! charts.
//!
//! Input: a map and a trajectory, a trajectory beside its truth, or a pair's corners, matches, lines and points. Output: one PNG, whole
//! or not at all. Equal lengths are equal in every orthogonal view of space. Text is DejaVu Sans from inside the binary: no system
//! font or graphics library is needed. The same input gives the same bytes. Cost: 50-150 ms and 10 MB a picture, at the end of a
//! run only.
//!
//! Deliberately not here: live views, interaction.

use std::io::{self, BufWriter};
use std::path::Path;

use crate::atomic_file::write_atomically;

mod axes;
mod calibration;
mod canvas;
mod chart;
mod comparison;
mod error;
mod motions;
mod overview;
mod pair;
mod palette;
mod space;
mod text;

#[cfg(test)]
mod tests;

pub use calibration::{BoardCorner, write_coverage, write_view};
pub use chart::{Chart, write_chart};
pub use comparison::{ComparedFrame, ComparedPose, Comparison, ErrorRange, write_comparison};
pub use error::PlotError;
pub use motions::{MotionPanel, write_motions};
pub use overview::write_overview;
pub use pair::{
    AttributeMark, CornerMark, EpipolarMark, Link, MarkDirection, points_along, write_attributes, write_corners,
    write_distances, write_epipolar_lines, write_links,
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
