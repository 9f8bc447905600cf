//! Axes: a plot's area, its ranges, and the grid with round numbers.

use super::canvas::{Anchor, Area, Canvas, Point, TextStyle};
use super::palette;

pub const TICK_TEXT_PX: f32 = 19.0;
pub const LABEL_TEXT_PX: f32 = 21.0;

/// A closed interval of values with a positive width.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range {
    pub min: f64,
    pub max: f64,
}

impl Range {
    /// The values' extent; not finite ones are passed over. `None` if nothing is left.
    pub fn of(values: impl Iterator<Item = f64>) -> Option<Self> {
        let mut range: Option<Self> = None;
        for v in values.filter(|v| v.is_finite()) {
            range = Some(range.map_or(Self { min: v, max: v }, |r| Self { min: r.min.min(v), max: r.max.max(v) }));
        }
        range
    }

    pub fn width(&self) -> f64 {
        self.max - self.min
    }

    pub fn centre(&self) -> f64 {
        self.min + self.width() / 2.0
    }

    /// Wider by `share` of the width on each side, and at least `smallest` wide.
    pub fn padded(&self, share: f64, smallest: f64) -> Self {
        self.widened((self.width() * (1.0 + 2.0 * share)).max(smallest))
    }

    /// The same centre with another width.
    pub fn widened(&self, width: f64) -> Self {
        Self { min: self.centre() - width / 2.0, max: self.centre() + width / 2.0 }
    }
}

/// Maps values to pixels; y grows upwards on paper.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Axes {
    pub area: Area,
    pub x: Range,
    pub y: Range,
}

impl Axes {
    /// One unit is equally long in both directions: the range that has room to spare is widened.
    pub fn equal(area: Area, x: Range, y: Range) -> Self {
        let unit_per_px = (x.width() / f64::from(area.width())).max(y.width() / f64::from(area.height()));
        Self {
            area,
            x: x.widened(unit_per_px * f64::from(area.width())),
            y: y.widened(unit_per_px * f64::from(area.height())),
        }
    }

    pub fn place(&self, x: f64, y: f64) -> Point {
        let fraction = |v: f64, r: &Range| ((v - r.min) / r.width()) as f32;
        let a = &self.area;
        (a.left + fraction(x, &self.x) * a.width(), a.bottom - fraction(y, &self.y) * a.height())
    }

    /// Grid and the numbers outside it, about `spacing_px` apart (across, up); `x_numbers`: whether the horizontal axis has any.
    pub fn draw(&self, canvas: &mut Canvas, labels: (&str, &str), spacing_px: (f32, f32), x_numbers: bool) {
        let a = self.area;
        let (x_label, y_label) = labels;
        let numbers = TextStyle::new(TICK_TEXT_PX, palette::MUTED, Anchor::Centre);
        let label = TextStyle::new(LABEL_TEXT_PX, palette::INK, Anchor::Centre);
        let x_ticks = ticks(&self.x, f64::from(a.width() / spacing_px.0));
        let y_ticks = ticks(&self.y, f64::from(a.height() / spacing_px.1));
        for (value, text) in x_ticks {
            let (x, _) = self.place(value, self.y.min);
            canvas.line(&[(x, a.top), (x, a.bottom)], 1.0, palette::GRID, 1.0, None);
            if x_numbers {
                canvas.text(&text, (x, a.bottom + 1.35 * TICK_TEXT_PX), numbers);
            }
        }
        for (value, text) in y_ticks {
            let (_, y) = self.place(self.x.min, value);
            canvas.line(&[(a.left, y), (a.right, y)], 1.0, palette::GRID, 1.0, None);
            let style = TextStyle { anchor: Anchor::Right, ..numbers };
            canvas.text(&text, (a.left - 9.0, y + 0.36 * TICK_TEXT_PX), style);
        }
        if x_numbers {
            canvas.text(x_label, ((a.left + a.right) / 2.0, a.bottom + 1.55 * TICK_TEXT_PX + LABEL_TEXT_PX), label);
        }
        canvas.text_upwards(y_label, (a.left - 82.0, (a.top + a.bottom) / 2.0), label);
    }

    /// The frame, to be drawn over the data.
    pub fn frame(&self, canvas: &mut Canvas) {
        let a = self.area;
        let corners = [(a.left, a.top), (a.right, a.top), (a.right, a.bottom), (a.left, a.bottom), (a.left, a.top)];
        canvas.line(&corners, 1.5, palette::FRAME, 1.0, None);
    }
}

/// Round values (1, 2 or 5 times a power of ten apart) in a range, about `wanted` of them, with their texts.
pub fn ticks(range: &Range, wanted: f64) -> Vec<(f64, String)> {
    const MOST: usize = 50;
    let rough = range.width() / wanted.clamp(1.5, 20.0);
    if !(rough.is_finite() && rough > 0.0) {
        return Vec::new();
    }
    let power = rough.log10().floor();
    let unit = 10_f64.powf(power);
    // The round number nearest in ratio: the bounds are the geometric means of neighbours.
    let factor = match rough / unit {
        r if r < 2.0_f64.sqrt() => 1.0,
        r if r < 10.0_f64.sqrt() => 2.0,
        r if r < 50.0_f64.sqrt() => 5.0,
        _ => 10.0,
    };
    let step = factor * unit;
    let decimals = (-(step * 1.001).log10().floor()).clamp(0.0, 12.0) as usize;
    let first = (range.min / step - 1e-9).ceil();
    (0..MOST)
        .map(|i| (first + i as f64) * step)
        .take_while(|v| *v <= range.max + 1e-9 * step)
        .map(|v| if v.abs() < 1e-9 * step { 0.0 } else { v })
        .map(|v| (v, if v.abs() >= 1e6 || decimals > 5 { format!("{v:.1e}") } else { format!("{v:.decimals$}") }))
        .collect()
}
