//! Pictures of a calibration: the corners of one view with their residuals, and what all views cover.
//!
//! Residual arrows are drawn [`ARROW_SCALE`] times as long as they are; a tenth of a pixel would not be seen.

use std::path::Path;

use nalgebra::Vector2;

use super::canvas::{Anchor, Area, Canvas, TextStyle};
use super::{PlotError, palette, save};
use crate::image::GreyImage;

/// Length of an arrow, px of the picture a px of residual.
const ARROW_SCALE: f64 = 40.0;
const BAR: f32 = 28.0;

/// One corner of a view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoardCorner {
    pub pixel: Vector2<f64>,
    /// Seen minus predicted, pixels.
    pub residual: Vector2<f64>,
    /// It had a part in the solution.
    pub used: bool,
}

/// A view: the picture, its corners in their order, and a line of text above.
pub fn write_view(path: &Path, picture: &GreyImage, corners: &[BoardCorner], title: &str) -> Result<(), PlotError> {
    let mut canvas = Canvas::new(picture.width as u32, picture.height as u32 + BAR as u32)?;
    canvas.grey(picture, 0, BAR as usize);
    let place = |p: &Vector2<f64>| (p.x as f32 + 0.5, p.y as f32 + 0.5 + BAR);
    let path_points: Vec<_> = corners.iter().map(|c| place(&c.pixel)).collect();
    canvas.line(&path_points, 1.0, palette::ESTIMATE, 0.5, None);
    if let Some(first) = path_points.first() {
        canvas.disc(*first, 6.0, palette::START, 0.8);
    }
    for corner in corners {
        let colour = if corner.used { palette::KEYFRAME } else { palette::LOST };
        canvas.disc(place(&corner.pixel), 2.2, colour, 1.0);
        let tip = corner.pixel + corner.residual * ARROW_SCALE;
        canvas.line(&[place(&corner.pixel), place(&tip)], 1.5, palette::LOST, 1.0, None);
    }
    let style = TextStyle::new(13.0, palette::INK, Anchor::Left);
    canvas.text(&format!("{title}; residuals x{ARROW_SCALE:.0}"), (8.0, 19.0), style);
    save(path, &canvas)
}

/// What all views cover: corners coloured by residual over the coverage cells (row by row); lines of text below.
pub fn write_coverage(
    path: &Path,
    (width, height): (u32, u32),
    (columns, rows): (usize, usize),
    cells: &[u32],
    corners: &[BoardCorner],
    lines: &[String],
) -> Result<(), PlotError> {
    let below = 24.0 + 18.0 * lines.len() as f32;
    let mut canvas = Canvas::new(width, height + below as u32)?;
    let (w, h) = (width as f32, height as f32);
    let most = cells.iter().copied().max().unwrap_or(0).max(1) as f32;
    for (n, count) in cells.iter().enumerate() {
        let (column, row) = ((n % columns.max(1)) as f32, (n / columns.max(1)) as f32);
        let (dx, dy) = (w / columns.max(1) as f32, h / rows.max(1) as f32);
        let area = Area { left: column * dx, top: row * dy, right: (column + 1.0) * dx, bottom: (row + 1.0) * dy };
        if *count == 0 {
            canvas.rectangle(&area, palette::LOST, 0.18);
        } else {
            canvas.rectangle(&area, palette::START, 0.06 + 0.2 * *count as f32 / most);
        }
    }
    let mut norms: Vec<f64> = corners.iter().filter(|c| c.used).map(|c| c.residual.norm()).collect();
    norms.sort_by(f64::total_cmp);
    let full = norms.get(norms.len().saturating_sub(1) * 95 / 100).copied().unwrap_or(1.0).max(1e-6);
    for corner in corners.iter().filter(|c| c.used) {
        let place = (corner.pixel.x as f32 + 0.5, corner.pixel.y as f32 + 0.5);
        canvas.disc(place, 2.0, palette::sequential(corner.residual.norm() / full), 0.9);
    }
    let frame = [(0.5, 0.5), (w - 0.5, 0.5), (w - 0.5, h - 0.5), (0.5, h - 0.5), (0.5, 0.5)];
    canvas.line(&frame, 1.0, palette::FRAME, 1.0, None);
    let style = TextStyle::new(13.0, palette::INK, Anchor::Left);
    canvas.text(
        &format!("corners of all views; dark: exact, yellow: residual of {full:.2} px"),
        (8.0, h + 18.0),
        style,
    );
    for (n, line) in lines.iter().enumerate() {
        canvas.text(line, (8.0, h + 36.0 + 18.0 * n as f32), TextStyle::new(13.0, palette::MUTED, Anchor::Left));
    }
    save(path, &canvas)
}
