//! The robots of a fleet from above, as SVG: one panel for each frame that several may have. Pure; the same rows give the same text.
//!
//! Rows hold strangers' words, of letters, digits, `_` and `/` alone ([`crate::share::fleet`]), so nothing needs escaping.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use crate::share::fleet::{Place, Row};

/// A panel's side and margin, px.
const SIDE: f64 = 720.0;
const MARGIN: f64 = 40.0;
/// A frame with one robot that stands is shown with so much around it, m.
const LEAST_SPAN_M: f64 = 2.0;
/// Lines of the grid across a panel, about.
const GRID_LINES: f64 = 8.0;
/// How the frames of docks begin.
const DOCK: &str = "dock_";
/// Dark enough for white paper, told apart by who sees no red or green (Okabe and Ito, 2008).
const COLOURS: [&str; 7] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000"];

struct Drawn<'a> {
    row: &'a Row,
    place: Place,
}

/// From metres to pixels: x to the right, y upwards.
struct View {
    low: [f64; 2],
    px_a_metre: f64,
    top: f64,
}

impl View {
    fn of(robots: &[Drawn], top: f64) -> Self {
        let (mut low, mut high) = ([f64::MAX; 2], [f64::MIN; 2]);
        for robot in robots {
            for point in robot.row.trail.iter().chain([&[robot.place.x_m, robot.place.y_m]]) {
                for axis in 0..2 {
                    low[axis] = low[axis].min(point[axis]);
                    high[axis] = high[axis].max(point[axis]);
                }
            }
        }
        let span = (high[0] - low[0]).max(high[1] - low[1]).max(LEAST_SPAN_M);
        let low = std::array::from_fn(|axis| (low[axis] + high[axis] - span) / 2.0);
        Self { low, px_a_metre: (SIDE - 2.0 * MARGIN) / span, top }
    }

    fn px(&self, [x, y]: [f64; 2]) -> (f64, f64) {
        let across = MARGIN + (x - self.low[0]) * self.px_a_metre;
        (across, self.top + SIDE - MARGIN - (y - self.low[1]) * self.px_a_metre)
    }
}

/// 1, 2 or 5 times a power of ten, m.
fn grid_step(span: f64) -> f64 {
    let wanted = span / GRID_LINES;
    let power = 10f64.powf(wanted.log10().floor());
    let factor = [1.0, 2.0, 5.0].into_iter().find(|factor| factor * power >= wanted).unwrap_or(10.0);
    factor * power
}

/// The picture. Robots without a frame that others have are named below it: whose map is its own alone is in none; a dock is one that others may come to.
pub fn svg(rows: &[Row]) -> String {
    let mut frames: BTreeMap<&str, Vec<Drawn>> = BTreeMap::new();
    let mut left_out: Vec<&str> = Vec::new();
    for row in rows {
        match (row.map_frame.as_deref(), row.place) {
            (Some(frame), Some(place)) => frames.entry(frame).or_default().push(Drawn { row, place }),
            _ => left_out.push(&row.name),
        }
    }
    frames.retain(|frame, robots| {
        let is_drawn = robots.len() > 1 || frame.starts_with(DOCK);
        if !is_drawn {
            left_out.extend(robots.iter().map(|robot| robot.row.name.as_str()));
        }
        is_drawn
    });
    left_out.sort_unstable();
    let height = frames.len() as f64 * SIDE + 2.0 * MARGIN;
    // Writing into a text cannot fail, here and below.
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{SIDE}\" height=\"{height}\" font-family=\"sans-serif\" font-size=\"12\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n"
    );
    for (i, (frame, robots)) in frames.iter().enumerate() {
        panel(&mut out, frame, robots, i as f64 * SIDE);
    }
    if !left_out.is_empty() {
        let names = left_out.join(", ");
        let _ = writeln!(
            out,
            "<text x=\"{MARGIN}\" y=\"{}\">not drawn, in no frame that others have: {names}</text>",
            height - MARGIN
        );
    }
    out + "</svg>\n"
}

fn panel(out: &mut String, frame: &str, robots: &[Drawn], top: f64) {
    let view = View::of(robots, top);
    let span = (SIDE - 2.0 * MARGIN) / view.px_a_metre;
    let step = grid_step(span);
    let _ = writeln!(
        out,
        "<text x=\"{MARGIN}\" y=\"{}\" font-weight=\"bold\">{frame}: {} robots, a square is {step} m</text>",
        top + MARGIN / 2.0,
        robots.len()
    );
    for axis in 0..2 {
        let first = (view.low[axis] / step).ceil() as i64;
        let last = ((view.low[axis] + span) / step).floor() as i64;
        for line in first..=last {
            let at = line as f64 * step;
            let end = |along: f64| if axis == 0 { [at, view.low[1] + along] } else { [view.low[0] + along, at] };
            let ((x1, y1), (x2, y2)) = (view.px(end(0.0)), view.px(end(span)));
            let colour = if line == 0 { "#888" } else { "#ddd" };
            let _ = writeln!(
                out,
                "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"{colour}\"/>"
            );
        }
    }
    for (i, robot) in robots.iter().enumerate() {
        let colour = COLOURS[i % COLOURS.len()];
        let points: Vec<String> =
            robot.row.trail.iter().map(|point| view.px(*point)).map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
        let _ = writeln!(
            out,
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.5\"/>",
            points.join(" ")
        );
        let Place { x_m, y_m, yaw_rad } = robot.place;
        let (x, y) = view.px([x_m, y_m]);
        // Turned as y is upwards.
        let _ = writeln!(
            out,
            "<path transform=\"translate({x:.1} {y:.1}) rotate({:.1})\" d=\"M 10 0 L -6 6 L -6 -6 Z\" fill=\"{colour}\"/>",
            -yaw_rad.to_degrees()
        );
        let _ = writeln!(
            out,
            "<text x=\"{:.1}\" y=\"{:.1}\" fill=\"{colour}\">{}</text>",
            x + 10.0,
            y - 8.0,
            robot.row.name
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::fleet::tests::row;
    use crate::share::fleet::Presence;

    fn at(name: &str, frame: &str, x_m: f64, y_m: f64) -> Row {
        let place = Some(Place { x_m, y_m, yaw_rad: std::f64::consts::FRAC_PI_2 });
        Row { map_frame: Some(frame.into()), place, trail: vec![[0.0, 0.0], [x_m, y_m]], ..row(name, Presence::Here) }
    }

    #[test]
    fn robots_of_one_dock_are_in_one_panel_and_others_are_named() {
        let rows = [
            at("a", "dock_36h11_5", 8.0, 0.0),
            at("b", "dock_36h11_5", 0.0, 4.0),
            at("c", "dock_36h11_6", 0.0, 0.0),
            row("d", Presence::Here),
            at("e", "map_1f", 0.0, 0.0),
            at("f", "map_20", 0.0, 0.0),
            at("g", "map_20", 1.0, 0.0),
        ];
        let text = svg(&rows);
        assert!(text.contains("dock_36h11_5: 2 robots, a square is 1 m") && text.contains("dock_36h11_6: 1 robots"));
        assert!(text.contains("not drawn, in no frame that others have: d, e</text>"), "{text}");
        assert!(text.contains("map_20: 2 robots") && !text.contains("map_1f"), "{text}");
        // 80 px a metre around the middle of 0 to 8 and 0 to 4: a is at the right border, in the middle but two metres low.
        assert!(text.contains("translate(680.0 520.0) rotate(-90.0)"), "{text}");
        assert!(text.contains("translate(40.0 200.0)"), "{text}");
        assert_eq!(text.matches("<polyline").count(), 5);
        assert!(svg(&[]).ends_with("</svg>\n"));
    }

    #[test]
    fn a_grid_has_round_steps() {
        assert_eq!([2.0, 8.0, 9.0, 100.0].map(grid_step), [0.5, 1.0, 2.0, 20.0]);
    }
}
