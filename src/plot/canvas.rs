//! A white sheet to draw on: lines, discs, areas and text, anti-aliased, in pixels from the top left corner.
//!
//! Anything that is not finite is not drawn. Inside [`Canvas::clipped`] nothing is drawn outside a rectangle.

use tiny_skia::{
    Color, FillRule, FilterQuality, IntSize, LineCap, LineJoin, Mask, Paint, Path, PathBuilder, Pixmap, PixmapPaint,
    Rect, Stroke, StrokeDash, Transform,
};

use super::error::PlotError;
use super::palette;
use super::text::Fonts;
use crate::image::GreyImage;

/// Pixels, y down.
pub type Point = (f32, f32);

/// Where a text's position is in it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Anchor {
    Left,
    Centre,
    Right,
}

/// How a text looks.
#[derive(Debug, Clone, Copy)]
pub struct TextStyle {
    pub size_px: f32,
    pub colour: u32,
    pub bold: bool,
    pub anchor: Anchor,
}

impl TextStyle {
    pub fn new(size_px: f32, colour: u32, anchor: Anchor) -> Self {
        Self { size_px, colour, bold: false, anchor }
    }

    pub fn bold(self) -> Self {
        Self { bold: true, ..self }
    }
}

/// A rectangle in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Area {
    pub left: f32,
    pub top: f32,
    pub right: f32,
    pub bottom: f32,
}

impl Area {
    pub fn width(&self) -> f32 {
        self.right - self.left
    }

    pub fn height(&self) -> f32 {
        self.bottom - self.top
    }

    pub fn contains(&self, (x, y): Point) -> bool {
        (self.left..=self.right).contains(&x) && (self.top..=self.bottom).contains(&y)
    }

    fn rect(&self) -> Option<Rect> {
        Rect::from_ltrb(self.left, self.top, self.right, self.bottom)
    }
}

pub struct Canvas {
    pixels: Pixmap,
    fonts: Fonts,
    clip: Option<Mask>,
}

fn paint(colour: u32, opacity: f32) -> Paint<'static> {
    let [_, r, g, b] = colour.to_be_bytes();
    let mut paint = Paint { anti_alias: true, ..Paint::default() };
    let alpha = (opacity.clamp(0.0, 1.0) * 255.0).round() as u8;
    paint.set_color(Color::from_rgba8(r, g, b, alpha));
    paint
}

fn polyline(points: &[Point], close: bool) -> Option<Path> {
    let mut builder = PathBuilder::new();
    let mut finite = points.iter().filter(|(x, y)| x.is_finite() && y.is_finite());
    let (x, y) = finite.next()?;
    builder.move_to(*x, *y);
    for (x, y) in finite {
        builder.line_to(*x, *y);
    }
    if close {
        builder.close();
    }
    builder.finish()
}

impl Canvas {
    pub fn new(width: u32, height: u32) -> Result<Self, PlotError> {
        let mut pixels = Pixmap::new(width, height).ok_or(PlotError::Draw("the picture has no size"))?;
        let [_, r, g, b] = palette::PAPER.to_be_bytes();
        pixels.fill(Color::from_rgba8(r, g, b, 255));
        Ok(Self { pixels, fonts: Fonts::load()?, clip: None })
    }

    /// Draws with everything outside `area` left alone.
    pub fn clipped(&mut self, area: &Area, draw: impl FnOnce(&mut Self)) {
        let mask = Mask::new(self.pixels.width(), self.pixels.height()).zip(area.rect()).map(|(mut mask, rect)| {
            mask.fill_path(&PathBuilder::from_rect(rect), FillRule::Winding, false, Transform::identity());
            mask
        });
        let outer = std::mem::replace(&mut self.clip, mask);
        draw(self);
        self.clip = outer;
    }

    /// A grey picture with its top left pixel at (left, top); what does not fit is left out.
    pub fn grey(&mut self, picture: &GreyImage, left: usize, top: usize) {
        let (width, height) = (self.pixels.width() as usize, self.pixels.height() as usize);
        let data = self.pixels.data_mut();
        for y in 0..picture.height.min(height.saturating_sub(top)) {
            for (x, value) in picture.row(y).iter().enumerate().take(width.saturating_sub(left)) {
                let at = 4 * ((y + top) * width + x + left);
                data[at..at + 3].fill(*value);
                data[at + 3] = 255;
            }
        }
    }

    fn fill(&mut self, path: &Path, colour: u32, opacity: f32, transform: Transform) {
        self.pixels.fill_path(path, &paint(colour, opacity), FillRule::Winding, transform, self.clip.as_ref());
    }

    pub fn rectangle(&mut self, area: &Area, colour: u32, opacity: f32) {
        if let Some(rect) = area.rect() {
            self.fill(&PathBuilder::from_rect(rect), colour, opacity, Transform::identity());
        }
    }

    /// A grey picture, `zoom` pixels of the sheet a pixel of it, its top left border at (`left`, `top`).
    pub fn picture(&mut self, image: &GreyImage, (left, top): Point, zoom: f32) {
        let rgba = image.data.iter().flat_map(|g| [*g, *g, *g, 255]).collect();
        let size = IntSize::from_wh(image.width as u32, image.height as u32);
        if let Some(pixels) = size.and_then(|size| Pixmap::from_vec(rgba, size)) {
            // Whole pixels stay sharp; a reduced picture is averaged.
            let quality = if zoom >= 1.0 { FilterQuality::Nearest } else { FilterQuality::Bilinear };
            let paint = PixmapPaint { quality, ..PixmapPaint::default() };
            let place = Transform::from_row(zoom, 0.0, 0.0, zoom, left, top);
            self.pixels.draw_pixmap(0, 0, pixels.as_ref(), &paint, place, self.clip.as_ref());
        }
    }

    /// A circle's outline.
    pub fn circle(&mut self, (x, y): Point, radius: f32, width: f32, colour: u32, opacity: f32) {
        if let Some(path) = PathBuilder::from_circle(x, y, radius) {
            let stroke = Stroke { width, ..Stroke::default() };
            let paint = paint(colour, opacity);
            self.pixels.stroke_path(&path, &paint, &stroke, Transform::identity(), self.clip.as_ref());
        }
    }

    /// A line through `points` with round corners; `dash`: lengths of stroke and gap.
    pub fn line(&mut self, points: &[Point], width: f32, colour: u32, opacity: f32, dash: Option<[f32; 2]>) {
        let stroke = Stroke {
            width,
            line_cap: LineCap::Round,
            line_join: LineJoin::Round,
            dash: dash.and_then(|d| StrokeDash::new(d.to_vec(), 0.0)),
            ..Stroke::default()
        };
        if let Some(path) = polyline(points, false) {
            let paint = paint(colour, opacity);
            self.pixels.stroke_path(&path, &paint, &stroke, Transform::identity(), self.clip.as_ref());
        }
    }

    pub fn polygon(&mut self, points: &[Point], colour: u32, opacity: f32) {
        if let Some(path) = polyline(points, true) {
            self.fill(&path, colour, opacity, Transform::identity());
        }
    }

    pub fn disc(&mut self, (x, y): Point, radius: f32, colour: u32, opacity: f32) {
        if let Some(path) = PathBuilder::from_circle(x, y, radius) {
            self.fill(&path, colour, opacity, Transform::identity());
        }
    }

    /// Text whose baseline is at `y`; returns its width.
    pub fn text(&mut self, text: &str, (x, y): Point, style: TextStyle) -> f32 {
        self.place_text(text, style, |dx| Transform::from_translate(x + dx, y))
    }

    /// How wide a text would be.
    pub fn text_width(&self, text: &str, style: TextStyle) -> f32 {
        self.fonts.outline(text, style.size_px, style.bold).1
    }

    /// Text that reads upwards, its baseline at `x`.
    pub fn text_upwards(&mut self, text: &str, (x, y): Point, style: TextStyle) {
        self.place_text(text, style, |dx| Transform::from_row(0.0, -1.0, 1.0, 0.0, x, y - dx));
    }

    fn place_text(&mut self, text: &str, style: TextStyle, place: impl FnOnce(f32) -> Transform) -> f32 {
        let (path, width) = self.fonts.outline(text, style.size_px, style.bold);
        let shift = match style.anchor {
            Anchor::Left => 0.0,
            Anchor::Centre => -width / 2.0,
            Anchor::Right => -width,
        };
        if let Some(path) = path {
            self.fill(&path, style.colour, 1.0, place(shift));
        }
        width
    }

    /// Width, height and rows of RGB bytes. The paper is opaque, so nothing of transparency is left.
    pub fn rgb(&self) -> (u32, u32, Vec<u8>) {
        let rgb = self.pixels.data().chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
        (self.pixels.width(), self.pixels.height(), rgb)
    }
}
