//! The four motions of an essential matrix beside each other, from above: where each puts the second camera and the points, and how many of
//! these lie before both cameras.
//!
//! Input: places in the first camera's axes (right, down, forward). Output: one PNG of four panels with one scale: points before both
//! cameras blue, the others grey; cameras red, looking where their two sides open.

use std::path::Path;

use nalgebra::{Vector2, Vector3};

use super::axes::{Axes, Range};
use super::canvas::{Anchor, Area, Canvas, TextStyle};
use super::{PlotError, SpaceCamera, palette, save};

const PANEL_PX: (f32, f32) = (560.0, 420.0);
const GAP_PX: f32 = 16.0;
const HEADING_PX: f32 = 56.0;
/// Above a panel, for its name and figures.
const NAME_PX: f32 = 34.0;
/// Share of the points at each end that may lie outside.
const QUANTILE: f64 = 0.05;
const MARGIN: f64 = 0.1;

/// One of the four.
#[derive(Debug, Clone, PartialEq)]
pub struct MotionPanel {
    pub name: String,
    pub facts: String,
    /// The votes decide for it.
    pub is_chosen: bool,
    pub cameras: [SpaceCamera; 2],
    /// The matches' points, and whether they lie before both cameras.
    pub points: Vec<(Vector3<f64>, bool)>,
}

/// Draws all four.
pub fn write_motions(path: &Path, panels: &[MotionPanel; 4], heading: &str) -> Result<(), PlotError> {
    let (width, height) = (2.0 * PANEL_PX.0 + 3.0 * GAP_PX, HEADING_PX + 2.0 * (PANEL_PX.1 + NAME_PX + GAP_PX));
    let mut canvas = Canvas::new(width as u32, height as u32)?;
    canvas.text(heading, (GAP_PX, 36.0), TextStyle::new(23.0, palette::INK, Anchor::Left).bold());
    // One scale for all: that the points change sides is what there is to see.
    let extent = |k: usize| {
        let mut values: Vec<f64> = panels.iter().flat_map(|p| p.points.iter().map(move |(at, _)| at[k])).collect();
        values.retain(|v| v.is_finite());
        values.sort_unstable_by(f64::total_cmp);
        let skip = (values.len() as f64 * QUANTILE) as usize;
        let most = values.get(skip..values.len() - skip).unwrap_or_default().iter().copied();
        let cameras = panels.iter().flat_map(|p| p.cameras.iter().map(move |c| c.centre[k]));
        Range::of(most.chain(cameras)).unwrap_or(Range { min: -1.0, max: 1.0 }).padded(MARGIN, 2.0)
    };
    let (across, forward) = (extent(0), extent(2));
    for (i, panel) in panels.iter().enumerate() {
        let left = GAP_PX + (i % 2) as f32 * (PANEL_PX.0 + GAP_PX);
        let top = HEADING_PX + NAME_PX + (i / 2) as f32 * (PANEL_PX.1 + NAME_PX + GAP_PX);
        let area = Area { left, top, right: left + PANEL_PX.0, bottom: top + PANEL_PX.1 };
        let colour = if panel.is_chosen { palette::MATCH } else { palette::MUTED };
        let name = TextStyle::new(20.0, if panel.is_chosen { palette::START } else { palette::INK }, Anchor::Left);
        canvas.text(&panel.name, (left, top - 10.0), name.bold());
        canvas.text(&panel.facts, (area.right, top - 10.0), TextStyle::new(18.0, palette::MUTED, Anchor::Right));
        draw(&mut canvas, &Axes::equal(area, across, forward), panel);
        let frame = [(left, top), (area.right, top), (area.right, area.bottom), (left, area.bottom), (left, top)];
        canvas.line(&frame, if panel.is_chosen { 3.0 } else { 1.2 }, colour, 1.0, None);
    }
    save(path, &canvas)
}

fn draw(canvas: &mut Canvas, axes: &Axes, panel: &MotionPanel) {
    let reach = 0.09 * axes.y.width();
    canvas.clipped(&axes.area, |canvas| {
        for before in [false, true] {
            let (colour, opacity) = if before { (palette::POINT, 0.8) } else { (palette::FRAME, 0.7) };
            for (at, _) in panel.points.iter().filter(|(at, b)| *b == before && at.iter().all(|v| v.is_finite())) {
                canvas.disc(axes.place(at.x, at.z), 2.6, colour, opacity);
            }
        }
        for camera in panel.cameras.iter().filter(|c| c.centre.iter().all(|v| v.is_finite())) {
            let apex = axes.place(camera.centre.x, camera.centre.z);
            // Left and right side of the picture, as seen from above.
            let sides = [0, 1].map(|k| {
                let side = (camera.corners[k] + camera.corners[3 - k]) * 0.5;
                let flat = Vector2::new(side.x, side.z);
                let end = Vector2::new(camera.centre.x, camera.centre.z) + flat * (reach / flat.norm().max(1e-9));
                axes.place(end.x, end.y)
            });
            canvas.polygon(&[apex, sides[0], sides[1]], palette::CORNER, 0.18);
            canvas.line(&[sides[0], apex, sides[1]], 2.0, palette::CORNER, 1.0, None);
            let style = TextStyle::new(18.0, palette::CORNER, Anchor::Centre).bold();
            canvas.text(&camera.name, (apex.0, apex.1 + 22.0), style);
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_panels_are_drawn_and_the_chosen_one_has_a_green_frame() {
        let corners = [(-0.5, -0.4), (0.5, -0.4), (0.5, 0.4), (-0.5, 0.4)].map(|(a, b)| Vector3::new(a, b, 1.0));
        let camera = |name: &str, x: f64| SpaceCamera { name: name.into(), centre: Vector3::new(x, 0.0, 0.0), corners };
        let panel = |k: usize| MotionPanel {
            name: format!("P_{k}"),
            facts: String::new(),
            is_chosen: k == 2,
            cameras: [camera("A", 0.0), camera("B", if k == 3 { f64::NAN } else { 1.0 })],
            points: vec![(Vector3::new(0.0, 0.0, 4.0), k == 2), (Vector3::new(f64::NAN, 0.0, 1.0), true)],
        };
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("motions.png");
        write_motions(&path, &[panel(0), panel(1), panel(2), panel(3)], "four").unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut pixels).unwrap();
        let green = |p: &[u8]| p[1] > 150 && p[0] < 100 && p[2] < 100;
        let rows: Vec<_> =
            pixels.chunks(3 * info.width as usize).map(|row| row.chunks(3).filter(|p| green(p)).count()).collect();
        let upper: usize = rows[..info.height as usize / 2].iter().sum();
        let lower: usize = rows[info.height as usize / 2..].iter().sum();
        assert!(upper == 0 && lower > 3000, "{upper} {lower}");
    }
}
