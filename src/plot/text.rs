//! Text as filled outlines.
//!
//! Input: a string and its size (em) in pixels. Output: a path whose origin is the baseline's left end, and its width.
//! Deliberately not here: scripts that need shaping; what the font lacks is drawn as its "missing" box.

use ab_glyph::{Font, FontRef, OutlineCurve};
use tiny_skia::{Path, PathBuilder};

use super::error::PlotError;

/// The two faces of every picture.
pub struct Fonts {
    regular: FontRef<'static>,
    bold: FontRef<'static>,
}

impl Fonts {
    pub fn load() -> Result<Self, PlotError> {
        let face =
            |bytes: &'static [u8]| FontRef::try_from_slice(bytes).map_err(|_| PlotError::Draw("the font is damaged"));
        Ok(Self { regular: face(dejavu::sans::regular())?, bold: face(dejavu::sans::bold())? })
    }

    /// Outline (none for blank text) and advance width of `text`.
    pub fn outline(&self, text: &str, size_px: f32, bold: bool) -> (Option<Path>, f32) {
        let font = if bold { &self.bold } else { &self.regular };
        let scale = size_px / font.units_per_em().unwrap_or(2048.0);
        let mut path = PathBuilder::new();
        let (mut x, mut previous) = (0.0_f32, None);
        for character in text.chars() {
            let glyph = font.glyph_id(character);
            x += previous.map_or(0.0, |p| scale * font.kern_unscaled(p, glyph));
            if let Some(outline) = font.outline(glyph) {
                append(&mut path, &outline.curves, x, scale);
            }
            x += scale * font.h_advance_unscaled(glyph);
            previous = Some(glyph);
        }
        (path.finish(), x)
    }
}

/// Curves come contour after contour; a new one begins where a curve does not start at the end of the last.
fn append(path: &mut PathBuilder, curves: &[OutlineCurve], x: f32, scale: f32) {
    let place = |p: &ab_glyph::Point| (x + scale * p.x, -scale * p.y);
    let mut at: Option<ab_glyph::Point> = None;
    for curve in curves {
        let (start, end) = match curve {
            OutlineCurve::Line(a, b) => (*a, *b),
            OutlineCurve::Quad(a, _, b) => (*a, *b),
            OutlineCurve::Cubic(a, _, _, b) => (*a, *b),
        };
        if at != Some(start) {
            if at.is_some() {
                path.close();
            }
            let (px, py) = place(&start);
            path.move_to(px, py);
        }
        let (ex, ey) = place(&end);
        match curve {
            OutlineCurve::Line(..) => path.line_to(ex, ey),
            OutlineCurve::Quad(_, c, _) => {
                let (cx, cy) = place(c);
                path.quad_to(cx, cy, ex, ey);
            }
            OutlineCurve::Cubic(_, c, d, _) => {
                let ((cx, cy), (dx, dy)) = (place(c), place(d));
                path.cubic_to(cx, cy, dx, dy, ex, ey);
            }
        }
        at = Some(end);
    }
    if at.is_some() {
        path.close();
    }
}
