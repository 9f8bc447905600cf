//! Bars side by side: the same rows measured in several ways.
//!
//! Input: rows with a name and a group, and a value (or none) for each of a few columns. Output: one PNG; a column has its
//! own scale from zero, its best row is bold. Rows of one group have one colour.

use std::path::Path;

use super::canvas::{Anchor, Area, Canvas, TextStyle};
use super::{PlotError, palette, save};

const ROW_PX: f32 = 34.0;
const NAME_PX: f32 = 330.0;
const COLUMN_PX: f32 = 290.0;
const TOP_PX: f32 = 128.0;

/// What is drawn.
#[derive(Debug, Clone, PartialEq)]
pub struct Chart {
    pub heading: String,
    /// Below the heading.
    pub note: String,
    /// Name of each column, and whether more is better.
    pub columns: Vec<(String, bool)>,
    /// Name, group and values of each row.
    pub rows: Vec<(String, usize, Vec<Option<f64>>)>,
}

/// Draws the chart.
pub fn write_chart(path: &Path, chart: &Chart) -> Result<(), PlotError> {
    let columns = chart.columns.len();
    let width = NAME_PX + COLUMN_PX * columns as f32 + 40.0;
    let height = TOP_PX + ROW_PX * chart.rows.len() as f32 + 30.0;
    let mut canvas = Canvas::new(width as u32, height as u32)?;
    canvas.text(&chart.heading, (28.0, 46.0), TextStyle::new(28.0, palette::INK, Anchor::Left).bold());
    canvas.text(&chart.note, (28.0, 76.0), TextStyle::new(17.0, palette::MUTED, Anchor::Left));
    for (i, (name, group, _)) in chart.rows.iter().enumerate() {
        let y = TOP_PX + ROW_PX * i as f32;
        if i > 0 && chart.rows[i - 1].1 != *group {
            canvas.line(&[(28.0, y), (width - 20.0, y)], 1.0, palette::GRID, 1.0, None);
        }
        canvas.text(name, (28.0, y + 0.68 * ROW_PX), TextStyle::new(18.0, palette::INK, Anchor::Left));
    }
    for (k, (name, more_is_better)) in chart.columns.iter().enumerate() {
        let left = NAME_PX + COLUMN_PX * k as f32;
        canvas.text(name, (left, TOP_PX - 14.0), TextStyle::new(17.0, palette::INK, Anchor::Left).bold());
        let values =
            |row: &(String, usize, Vec<Option<f64>>)| row.2.get(k).copied().flatten().filter(|v| v.is_finite());
        let all: Vec<f64> = chart.rows.iter().filter_map(values).collect();
        let largest = all.iter().copied().fold(0.0, f64::max);
        let best = all.iter().copied().fold(None, |best: Option<f64>, v| {
            Some(best.map_or(v, |b| if *more_is_better { b.max(v) } else { b.min(v) }))
        });
        for (i, row) in chart.rows.iter().enumerate() {
            let y = TOP_PX + ROW_PX * i as f32;
            let Some(value) = values(row) else {
                canvas.text("–", (left + 6.0, y + 0.68 * ROW_PX), TextStyle::new(17.0, palette::MUTED, Anchor::Left));
                continue;
            };
            let share = if largest > 0.0 { (value / largest).max(0.0) as f32 } else { 0.0 };
            let bar = Area {
                left,
                top: y + 0.2 * ROW_PX,
                right: left + 1.0 + share * (COLUMN_PX - 100.0),
                bottom: y + 0.8 * ROW_PX,
            };
            canvas.rectangle(&bar, palette::CATEGORIES[row.1 % palette::CATEGORIES.len()], 0.85);
            let text = if value.abs() >= 100.0 { format!("{value:.0}") } else { format!("{value:.2}") };
            let style = TextStyle::new(17.0, palette::INK, Anchor::Left);
            let style = if best == Some(value) { style.bold() } else { style };
            canvas.text(&text, (bar.right + 8.0, y + 0.68 * ROW_PX), style);
        }
    }
    save(path, &canvas)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_without_values_and_charts_without_rows_are_drawn() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("chart.png");
        let mut chart = Chart {
            heading: "h".into(),
            note: "n".into(),
            columns: vec![("a".into(), true), ("b".into(), false)],
            rows: vec![
                ("x".into(), 0, vec![Some(1.0), None]),
                ("y".into(), 9, vec![Some(f64::NAN), Some(0.0)]),
                ("z".into(), 9, vec![]),
            ],
        };
        write_chart(&path, &chart).unwrap();
        assert!(std::fs::read(&path).unwrap().len() > 500);
        chart.rows.clear();
        write_chart(&path, &chart).unwrap();
    }
}
