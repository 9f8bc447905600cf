//! Pictures of a pair: corners with their directions and what else is kept of them, matches as lines from one picture to the other, epipolar
//! lines, how far the points are.
//!
//! Input: grey pictures and places in their pixels (pixel (0, 0) is the centre of the first one). Output: one PNG each;
//! small pictures are enlarged by whole factors, so that a corner can be seen at its pixel. Corners are red, matches green
//! (those that are no inliers thin and orange, beneath), an epipolar line has the colour of its point.

use std::path::Path;

use nalgebra::{Vector2, Vector3};

use super::canvas::{Anchor, Area, Canvas, Point, TextStyle};
use super::{PlotError, palette, save};
use crate::image::GreyImage;

/// A picture is enlarged until it is about this wide.
const COMFORTABLE_PX: f32 = 1000.0;
/// Above the pictures.
const HEADING_PX: f32 = 44.0;
const GAP_PX: f32 = 8.0;

/// Which way a corner points; radians from x (right) towards y (down).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum MarkDirection {
    /// One way: drawn as a hand from the corner.
    Towards(f64),
    /// Both ways alike: drawn through the corner.
    Axis(f64),
}

/// A corner to draw.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CornerMark {
    pub at: Vector2<f64>,
    /// Radius of its circle, pixels of the picture.
    pub radius_px: f64,
    pub direction: Option<MarkDirection>,
}

/// A corner with what is kept of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AttributeMark {
    pub at: Vector2<f64>,
    pub salient_degree: f64,
    pub direction: Option<MarkDirection>,
}

/// A match to draw.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Link {
    pub a: Vector2<f64>,
    pub b: Vector2<f64>,
    pub inlier: bool,
}

/// A match whose epipolar lines are drawn.
#[derive(Debug, Clone, PartialEq)]
pub struct EpipolarMark {
    pub a: Vector2<f64>,
    pub b: Vector2<f64>,
    /// The line of `b` in the first picture and of `a` in the second, as points along them (bent by a lens's distortion).
    pub line_in_a: Vec<Vector2<f64>>,
    pub line_in_b: Vec<Vector2<f64>>,
}

/// Two pictures beside each other (or one) on a sheet.
struct Sheet {
    canvas: Canvas,
    zoom: f32,
    /// Where each picture's top left border is.
    origins: Vec<Point>,
    areas: Vec<Area>,
}

impl Sheet {
    fn new(pictures: &[&GreyImage], heading: &str) -> Result<Self, PlotError> {
        let widest = pictures.iter().map(|p| p.width).max().unwrap_or(1).max(1);
        let zoom = (COMFORTABLE_PX / widest as f32).round().clamp(1.0, 4.0);
        let size = |p: &GreyImage| (p.width as f32 * zoom, p.height as f32 * zoom);
        let height = pictures.iter().map(|p| size(p).1).fold(1.0, f32::max) + HEADING_PX;
        let gaps = GAP_PX * (pictures.len().saturating_sub(1)) as f32;
        let width = pictures.iter().map(|p| size(p).0).sum::<f32>() + gaps;
        let mut canvas = Canvas::new(width.max(360.0) as u32, height as u32)?;
        let (mut origins, mut areas) = (vec![], vec![]);
        let mut left = 0.0;
        for picture in pictures {
            let (w, h) = size(picture);
            canvas.picture(picture, (left, HEADING_PX), zoom);
            origins.push((left, HEADING_PX));
            areas.push(Area { left, top: HEADING_PX, right: left + w, bottom: HEADING_PX + h });
            left += w + GAP_PX;
        }
        canvas.text(heading, (12.0, 29.0), TextStyle::new(21.0, palette::INK, Anchor::Left).bold());
        Ok(Self { canvas, zoom, origins, areas })
    }

    /// A pixel of picture `k` on the sheet: its centre is half a pixel inside its border.
    fn place(&self, k: usize, p: &Vector2<f64>) -> Point {
        let (left, top) = self.origins[k];
        (left + (p.x as f32 + 0.5) * self.zoom, top + (p.y as f32 + 0.5) * self.zoom)
    }
}

/// Draws one picture's corners, with their directions.
pub fn write_corners(path: &Path, picture: &GreyImage, corners: &[CornerMark], heading: &str) -> Result<(), PlotError> {
    let mut sheet = Sheet::new(&[picture], heading)?;
    for corner in corners {
        let (x, y) = sheet.place(0, &corner.at);
        let radius = (corner.radius_px as f32 * sheet.zoom).max(2.5);
        sheet.canvas.circle((x, y), radius, 1.2, palette::CORNER, 0.9);
        hand(&mut sheet.canvas, (x, y), corner.direction, 1.9 * radius, palette::CORNER);
    }
    save(path, &sheet.canvas)
}

/// From the corner where it points, or through it.
fn hand(canvas: &mut Canvas, (x, y): Point, direction: Option<MarkDirection>, length: f32, colour: u32) {
    let (angle, both) = match direction {
        Some(MarkDirection::Towards(angle)) => (angle as f32, false),
        Some(MarkDirection::Axis(angle)) => (angle as f32, true),
        None => return,
    };
    let (dx, dy) = (length * angle.cos(), length * angle.sin());
    let from = if both { (x - dx, y - dy) } else { (x, y) };
    canvas.line(&[from, (x + dx, y + dy)], 1.2, colour, 0.9, None);
}

/// Draws what is kept of the corners of both pictures: salient degree as colour, direction as a hand, the grey level beneath.
pub fn write_attributes(
    path: &Path,
    pictures: [&GreyImage; 2],
    marks: [&[AttributeMark]; 2],
    heading: &str,
) -> Result<(), PlotError> {
    let mut sheet = Sheet::new(&pictures, heading)?;
    let ends = ends(marks.iter().flat_map(|of| of.iter().map(|m| m.salient_degree)));
    for (k, of) in marks.iter().enumerate() {
        for mark in of.iter() {
            let colour = palette::sequential((mark.salient_degree - ends.0) / (ends.1 - ends.0));
            let at = sheet.place(k, &mark.at);
            hand(&mut sheet.canvas, at, mark.direction, 9.0, colour);
            sheet.canvas.disc(at, 3.6, palette::INK, 0.6);
            sheet.canvas.disc(at, 2.8, colour, 1.0);
        }
    }
    legend(&mut sheet, "salient degree", [format!("{:.2}", ends.0), format!("{:.2}", ends.1)]);
    save(path, &sheet.canvas)
}

/// Draws a picture's points by how far they are: near ones yellow, far ones violet.
pub fn write_distances(
    path: &Path,
    picture: &GreyImage,
    points: &[(Vector2<f64>, f64)],
    unit: &str,
    heading: &str,
) -> Result<(), PlotError> {
    let mut sheet = Sheet::new(&[picture], heading)?;
    // Of a few far ones the rest would all be near.
    let (low, high) = ends(points.iter().map(|(_, distance)| distance.ln()));
    for (at, distance) in points {
        let at = sheet.place(0, at);
        sheet.canvas.disc(at, 5.0, palette::INK, 0.6);
        sheet.canvas.disc(at, 4.0, palette::sequential((high - distance.ln()) / (high - low)), 1.0);
    }
    legend(&mut sheet, unit, [high, low].map(|end| format!("{:.1}", end.exp())));
    save(path, &sheet.canvas)
}

/// What holds all but a twentieth of finite values at either end, and has a width.
fn ends(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let mut sorted: Vec<f64> = values.filter(|v| v.is_finite()).collect();
    sorted.sort_unstable_by(f64::total_cmp);
    let at = |share: f64| sorted.get((share * sorted.len().saturating_sub(1) as f64) as usize).copied();
    let (low, high) = (at(0.05).unwrap_or(0.0), at(0.95).unwrap_or(1.0));
    (low, high.max(low + 1e-6))
}

/// The scale of colours, right in the heading: its name and what its two ends mean.
fn legend(sheet: &mut Sheet, name: &str, ends: [String; 2]) {
    const STEPS: usize = 60;
    let right = sheet.areas.last().map_or(360.0, |area| area.right) - 12.0;
    let style = TextStyle::new(17.0, palette::MUTED, Anchor::Right);
    let canvas = &mut sheet.canvas;
    let high = right - canvas.text(&ends[1], (right, 28.0), style) - 8.0;
    for i in 0..STEPS {
        let left = high - (STEPS - i) as f32 * 2.0;
        let area = Area { left, top: 14.0, right: left + 2.0, bottom: 30.0 };
        canvas.rectangle(&area, palette::sequential(i as f64 / (STEPS - 1) as f64), 1.0);
    }
    canvas.text(&format!("{name} {}", ends[0]), (high - 2.0 * STEPS as f32 - 8.0, 28.0), style);
}

/// Draws both pictures side by side with a line for each match.
pub fn write_links(path: &Path, pictures: [&GreyImage; 2], links: &[Link], heading: &str) -> Result<(), PlotError> {
    let mut sheet = Sheet::new(&pictures, heading)?;
    let count = links.iter().filter(|l| l.inlier).count();
    // Fainter the more there are, so that single ones can still be followed.
    let opacity = (150.0 / (count as f32 + 1.0)).sqrt().clamp(0.25, 0.9);
    for inliers in [false, true] {
        for link in links.iter().filter(|l| l.inlier == inliers) {
            let ends = [sheet.place(0, &link.a), sheet.place(1, &link.b)];
            let (width, colour, opacity) =
                if inliers { (1.6, palette::MATCH, opacity) } else { (0.9, palette::OUTLIER, 0.45) };
            sheet.canvas.line(&ends, width, colour, opacity, None);
        }
    }
    for link in links.iter().filter(|l| l.inlier) {
        for end in [sheet.place(0, &link.a), sheet.place(1, &link.b)] {
            sheet.canvas.disc(end, 2.2, palette::MATCH, 1.0);
        }
    }
    save(path, &sheet.canvas)
}

/// Draws matches and the epipolar lines that they should lie on, in both pictures.
pub fn write_epipolar_lines(
    path: &Path,
    pictures: [&GreyImage; 2],
    marks: &[EpipolarMark],
    heading: &str,
) -> Result<(), PlotError> {
    let mut sheet = Sheet::new(&pictures, heading)?;
    for (i, mark) in marks.iter().enumerate() {
        let colour = palette::CATEGORIES[i % palette::CATEGORIES.len()];
        for (k, at, line) in [(0, &mark.a, &mark.line_in_a), (1, &mark.b, &mark.line_in_b)] {
            let points: Vec<Point> = line.iter().map(|p| sheet.place(k, p)).collect();
            let (point, area) = (sheet.place(k, at), sheet.areas[k]);
            sheet.canvas.clipped(&area, |canvas| {
                canvas.line(&points, 1.4, colour, 0.9, None);
                canvas.disc(point, 6.0, palette::PAPER, 0.9);
                canvas.disc(point, 4.2, colour, 1.0);
            });
        }
    }
    save(path, &sheet.canvas)
}

/// `count` points along the line `lᵀ (x, y, 1) = 0` within a box; none when it passes outside.
pub fn points_along(line: &Vector3<f64>, low: Vector2<f64>, high: Vector2<f64>, count: usize) -> Vec<Vector2<f64>> {
    let mut ends: Vec<Vector2<f64>> = Vec::new();
    let mut add = |x: f64, y: f64| {
        let inside = (low.x - 1e-9..=high.x + 1e-9).contains(&x) && (low.y - 1e-9..=high.y + 1e-9).contains(&y);
        if inside && ends.iter().all(|e| (e - Vector2::new(x, y)).norm() > 1e-6) {
            ends.push(Vector2::new(x, y));
        }
    };
    for x in [low.x, high.x] {
        add(x, -(line.x * x + line.z) / line.y);
    }
    for y in [low.y, high.y] {
        add(-(line.y * y + line.z) / line.x, y);
    }
    let [a, b, ..] = ends[..] else { return Vec::new() };
    (0..count.max(2)).map(|i| a + (b - a) * (i as f64 / (count.max(2) - 1) as f64)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_followed_through_the_picture_and_not_beside_it() {
        let (low, high) = (Vector2::new(-0.5, -0.5), Vector2::new(639.5, 479.5));
        let through = points_along(&Vector3::new(0.0, 1.0, -100.0), low, high, 5);
        assert_eq!(through.len(), 5);
        assert!(through.iter().all(|p| (p.y - 100.0).abs() < 1e-9) && (through[4].x - through[0].x).abs() > 639.0);
        let slanted = points_along(&Vector3::new(1.0, -1.0, 0.0), low, high, 3);
        assert!(slanted.iter().all(|p| (p.x - p.y).abs() < 1e-9) && slanted.len() == 3);
        assert!(points_along(&Vector3::new(0.0, 1.0, 100.0), low, high, 5).is_empty());
        assert!(points_along(&Vector3::zeros(), low, high, 5).is_empty());
    }

    #[test]
    fn marks_land_on_the_pixels_they_stand_for() {
        let mut picture = GreyImage::new(300, 200);
        picture.data.fill(255);
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("links.png");
        let link = |x: f64, inlier| Link { a: Vector2::new(x, 100.0), b: Vector2::new(x, 100.0), inlier };
        write_links(&path, [&picture, &picture], &[link(50.0, true), link(150.0, false)], "two").unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut pixels).unwrap();
        // Enlarged three times, 44 px of heading.
        let at = |x: usize, y: usize| {
            let i = (y * info.width as usize + x) * 3;
            [pixels[i], pixels[i + 1], pixels[i + 2]]
        };
        let [r, g, b] = at(151, 44 + 301);
        assert!(g > 150 && r < 100 && b < 100, "{r} {g} {b}");
        assert_eq!(at(151, 44 + 280), [255, 255, 255]);
    }
}
