//! A trajectory against the truth: where it went, and how far off it was when.
//!
//! Left: the truth seen along its thinnest direction, and the estimate over it, coloured by its error; under it the share of
//! all frames whose error is below a value (it ends at the coverage, not at 100 %). Right, over time: the three coordinates
//! of both, the position error and the rotation error. Frames without a pose are shaded.

use std::path::Path;

use nalgebra::Vector3;

use super::axes::{Axes, Range, TICK_TEXT_PX, ticks};
use super::canvas::{Anchor, Area, Canvas, TextStyle};
use super::{PlotError, palette, save};

const WIDTH: u32 = 1800;
const HEIGHT: u32 = 1160;
const AXIS_NAMES: [&str; 3] = ["x (m)", "y (m)", "z (m)"];
/// Lengths below this are drawn as if they had it: a camera that stands still.
const SMALLEST_EXTENT_M: f64 = 0.02;

/// A frame that should have a pose, and where the camera truly was.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ComparedFrame {
    pub timestamp_ns: i64,
    /// m.
    pub truth: Vector3<f64>,
    /// It has one.
    pub covered: bool,
}

/// A pose in the truth's world and unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ComparedPose {
    pub timestamp_ns: i64,
    /// m.
    pub position: Vector3<f64>,
    pub position_error_m: f64,
    pub rotation_error_deg: f64,
}

/// Of the errors of all poses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ErrorRange {
    pub rmse: f64,
    pub max: f64,
}

/// A trajectory and its truth, both in ascending time.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Comparison {
    /// What stands under the title: names and values.
    pub facts: Vec<(&'static str, String)>,
    pub frames: Vec<ComparedFrame>,
    /// None where there are no errors.
    pub poses: Vec<ComparedPose>,
    pub position_m: Option<ErrorRange>,
    pub rotation_deg: Option<ErrorRange>,
    /// Why there are no errors.
    pub without_errors: String,
}

/// Draws `comparison` to `path`.
pub fn write_comparison(path: &Path, comparison: &Comparison, title: &str) -> Result<(), PlotError> {
    let mut canvas = Canvas::new(WIDTH, HEIGHT)?;
    heading(&mut canvas, &comparison.facts, title);
    seen_from_above(&mut canvas, comparison);
    share_below(&mut canvas, comparison);
    over_time(&mut canvas, comparison);
    save(path, &canvas)
}

fn heading(canvas: &mut Canvas, facts: &[(&str, String)], title: &str) {
    canvas.text(title, (44.0, 62.0), TextStyle::new(36.0, palette::INK, Anchor::Left).bold());
    let mut x = 44.0;
    for (name, value) in facts {
        x += canvas.text(name, (x, 104.0), TextStyle::new(23.0, palette::MUTED, Anchor::Left)) + 9.0;
        x += canvas.text(value, (x, 104.0), TextStyle::new(23.0, palette::INK, Anchor::Left).bold()) + 34.0;
    }
}

/// Position errors are drawn in millimetres, and in metres where there are metres of them: factor and name.
fn error_unit(comparison: &Comparison) -> (f64, &'static str) {
    match comparison.position_m {
        Some(ate) if ate.max >= 2.0 => (1.0, "m"),
        _ => (1e3, "mm"),
    }
}

/// Runs of neighbouring frames: the truth's indices from the last frame with a pose to the next one.
fn gaps(comparison: &Comparison) -> Vec<(f64, f64)> {
    let mut gaps: Vec<(f64, f64)> = Vec::new();
    let frames = &comparison.frames;
    let mut open = false;
    for (i, frame) in frames.iter().enumerate() {
        if !frame.covered {
            let from = i.checked_sub(1).and_then(|j| frames.get(j)).unwrap_or(frame);
            let to = frames.get(i + 1).unwrap_or(frame);
            let (from, to) = (seconds(comparison, from.timestamp_ns), seconds(comparison, to.timestamp_ns));
            match gaps.last_mut().filter(|_| open) {
                Some(last) => last.1 = to,
                None => gaps.push((from, to)),
            }
        }
        open = !frame.covered;
    }
    gaps
}

fn seconds(comparison: &Comparison, timestamp_ns: i64) -> f64 {
    let start = comparison.frames.first().map_or(0, |e| e.timestamp_ns);
    timestamp_ns.saturating_sub(start) as f64 * 1e-9
}

/// The samples in runs that no frame without a pose interrupts: a line is drawn through each, and none across a gap.
fn runs<'a>(comparison: &'a Comparison, gaps: &[(f64, f64)]) -> Vec<&'a [ComparedPose]> {
    comparison
        .poses
        .chunk_by(|a, b| {
            let (a, b) = (seconds(comparison, a.timestamp_ns), seconds(comparison, b.timestamp_ns));
            !gaps.iter().any(|(from, to)| *from < b - 1e-9 && *to > a + 1e-9)
        })
        .collect()
}

fn seen_from_above(canvas: &mut Canvas, comparison: &Comparison) {
    let area = Area { left: 140.0, top: 190.0, right: 800.0, bottom: 770.0 };
    let extent = |i: usize| Range::of(comparison.frames.iter().map(|e| e.truth[i]));
    let width = |i: usize| extent(i).map_or(0.0, |r| r.width());
    // The axis with the least extent is the one looked along.
    let away = (0..3).min_by(|a, b| width(*a).total_cmp(&width(*b))).unwrap_or(2);
    let (across, up) = match away {
        0 => (1, 2),
        1 => (0, 2),
        _ => (0, 1),
    };
    let range = |i: usize| {
        let estimate = comparison.poses.iter().map(|s| s.position[i]);
        Range::of(comparison.frames.iter().map(|e| e.truth[i]).chain(estimate))
            .unwrap_or(Range { min: 0.0, max: 1.0 })
            .padded(0.06, SMALLEST_EXTENT_M)
    };
    let axes = Axes::equal(area, range(across), range(up));
    axes.draw(canvas, (AXIS_NAMES[across], AXIS_NAMES[up]), (90.0, 90.0), true);

    let worst = comparison.position_m.map_or(1.0, |a| a.max).max(1e-9);
    let runs = runs(comparison, &gaps(comparison));
    canvas.clipped(&area, |canvas| {
        let truth: Vec<_> = comparison.frames.iter().map(|e| axes.place(e.truth[across], e.truth[up])).collect();
        canvas.line(&truth, 6.0, palette::TRUTH, 0.75, None);
        for run in &runs {
            let place = |s: &ComparedPose| axes.place(s.position[across], s.position[up]);
            for pair in run.windows(2) {
                let colour = palette::sequential(pair[1].position_error_m / worst);
                canvas.line(&[place(&pair[0]), place(&pair[1])], 2.8, colour, 1.0, None);
            }
        }
        for (end, colour) in [(comparison.frames.first(), palette::START), (comparison.frames.last(), palette::LOST)] {
            if let Some(frame) = end {
                let at = axes.place(frame.truth[across], frame.truth[up]);
                canvas.disc(at, 10.0, palette::PAPER, 1.0);
                canvas.disc(at, 7.5, colour, 1.0);
            }
        }
    });
    axes.frame(canvas);
    legend(canvas, &area);
    if comparison.position_m.is_some() {
        colour_bar(canvas, &area, worst, error_unit(comparison));
    } else {
        let middle = ((area.left + area.right) / 2.0, area.top + 40.0);
        canvas.text(&comparison.without_errors, middle, TextStyle::new(18.0, palette::LOST, Anchor::Centre));
    }
}

/// The distribution of the position error over all frames that should have a pose.
fn share_below(canvas: &mut Canvas, comparison: &Comparison) {
    let area = Area { left: 140.0, top: 872.0, right: 800.0, bottom: 1060.0 };
    let (factor, unit) = error_unit(comparison);
    let mut errors: Vec<f64> = comparison.poses.iter().map(|s| factor * s.position_error_m).collect();
    errors.sort_unstable_by(f64::total_cmp);
    let worst = errors.last().copied().unwrap_or(1.0).max(1e-6);
    let axes = Axes { area, x: Range { min: 0.0, max: 1.04 * worst }, y: Range { min: 0.0, max: 104.0 } };
    axes.draw(canvas, (&format!("position error below ({unit})"), "frames (%)"), (90.0, 48.0), true);
    let share = |n: usize| 100.0 * n as f64 / comparison.frames.len().max(1) as f64;
    let mut curve = vec![axes.place(0.0, 0.0)];
    for (i, error) in errors.iter().enumerate() {
        curve.extend([axes.place(*error, share(i)), axes.place(*error, share(i + 1))]);
    }
    curve.push(axes.place(axes.x.max, share(errors.len())));
    let mut filled = curve.clone();
    filled.push((area.right, area.bottom));
    canvas.clipped(&area, |canvas| {
        canvas.polygon(&filled, palette::ESTIMATE, 0.14);
        canvas.line(&curve, 2.2, palette::ESTIMATE, 1.0, None);
    });
    axes.frame(canvas);
}

fn legend(canvas: &mut Canvas, area: &Area) {
    let y = area.top - 22.0;
    let style = TextStyle::new(TICK_TEXT_PX, palette::INK, Anchor::Left);
    let mut x = area.left;
    canvas.line(&[(x, y - 7.0), (x + 34.0, y - 7.0)], 6.0, palette::TRUTH, 0.75, None);
    x += 44.0;
    x += canvas.text("ground truth", (x, y), style) + 26.0;
    let steps = 12;
    for i in 0..steps {
        let at = |i: i32| (x + 34.0 * i as f32 / steps as f32, y - 7.0);
        let colour = palette::sequential(f64::from(i) / f64::from(steps - 1));
        canvas.line(&[at(i), at(i + 1)], 2.8, colour, 1.0, None);
    }
    x += 44.0;
    x += canvas.text("estimate", (x, y), style) + 26.0;
    for (name, colour) in [("start", palette::START), ("end", palette::LOST)] {
        canvas.disc((x + 7.0, y - 7.0), 7.5, colour, 1.0);
        x += 22.0;
        x += canvas.text(name, (x, y), style) + 22.0;
    }
}

fn colour_bar(canvas: &mut Canvas, area: &Area, worst: f64, (factor, unit): (f64, &str)) {
    let (left, right) = (area.right + 18.0, area.right + 38.0);
    let steps = area.height() as i32;
    for i in 0..steps {
        let bottom = area.bottom - i as f32;
        let strip = Area { left, top: bottom - 1.5, right, bottom };
        canvas.rectangle(&strip, palette::sequential(f64::from(i) / f64::from(steps - 1)), 1.0);
    }
    let axes = Axes { area: *area, x: Range { min: 0.0, max: 1.0 }, y: Range { min: 0.0, max: factor * worst } };
    for (value, text) in ticks(&axes.y, 8.0) {
        let (_, y) = axes.place(0.0, value);
        canvas.line(&[(right, y), (right + 6.0, y)], 1.0, palette::MUTED, 1.0, None);
        let style = TextStyle::new(TICK_TEXT_PX, palette::MUTED, Anchor::Left);
        canvas.text(&text, (right + 11.0, y + 0.36 * TICK_TEXT_PX), style);
    }
    let style = TextStyle::new(TICK_TEXT_PX, palette::MUTED, Anchor::Centre);
    canvas.text(&format!("error ({unit})"), ((left + right) / 2.0 + 8.0, area.top - 22.0), style);
}

fn over_time(canvas: &mut Canvas, comparison: &Comparison) {
    const ROWS: usize = 5;
    const GAP_PX: f32 = 16.0;
    const ROW_SPACING_PX: (f32, f32) = (100.0, 48.0);
    let whole = Area { left: 1066.0, top: 190.0, right: 1736.0, bottom: 1060.0 };
    let height = (whole.height() - GAP_PX * (ROWS - 1) as f32) / ROWS as f32;
    let time = Range::of(comparison.frames.iter().map(|e| seconds(comparison, e.timestamp_ns)))
        .unwrap_or(Range { min: 0.0, max: 1.0 })
        .padded(0.0, 0.1);
    let gaps = gaps(comparison);
    let runs = runs(comparison, &gaps);
    let row = |i: usize| {
        let top = whole.top + i as f32 * (height + GAP_PX);
        Area { top, bottom: top + height, ..whole }
    };
    let shade = |canvas: &mut Canvas, axes: &Axes| {
        for (from, to) in &gaps {
            let ((left, _), (right, _)) = (axes.place(*from, 0.0), axes.place(*to, 0.0));
            let lost = Area { left, right: right.max(left + 1.5), ..axes.area };
            canvas.rectangle(&lost, palette::LOST, 0.16);
        }
    };

    for (i, name) in AXIS_NAMES.iter().enumerate() {
        let truth = comparison.frames.iter().map(|e| e.truth[i]);
        let range = Range::of(truth.chain(comparison.poses.iter().map(|s| s.position[i])));
        let range = range.unwrap_or(Range { min: 0.0, max: 1.0 }).padded(0.1, SMALLEST_EXTENT_M);
        let axes = Axes { area: row(i), x: time, y: range };
        axes.draw(canvas, ("", name), ROW_SPACING_PX, false);
        canvas.clipped(&axes.area, |canvas| {
            shade(canvas, &axes);
            let place = |t: i64, v: f64| axes.place(seconds(comparison, t), v);
            let truth: Vec<_> = comparison.frames.iter().map(|e| place(e.timestamp_ns, e.truth[i])).collect();
            canvas.line(&truth, 5.0, palette::TRUTH, 0.75, None);
            for run in &runs {
                let line: Vec<_> = run.iter().map(|s| place(s.timestamp_ns, s.position[i])).collect();
                canvas.line(&line, 2.0, palette::ESTIMATE, 1.0, None);
            }
        });
        axes.frame(canvas);
    }
    type Value = fn(&ComparedPose) -> f64;
    let (metres, unit) = error_unit(comparison);
    let position_name = format!("error ({unit})");
    let position: Value = |s| s.position_error_m;
    let rotation: Value = |s| s.rotation_error_deg;
    let errors = [
        (position_name.as_str(), position, palette::ESTIMATE, comparison.position_m, metres),
        ("rotation (°)", rotation, palette::ROTATION, comparison.rotation_deg, 1.0),
    ];
    for (i, (name, value, colour, statistics, factor)) in errors.into_iter().enumerate() {
        let top = statistics.map_or(1.0, |s: ErrorRange| factor * s.max).max(1e-6);
        let axes = Axes { area: row(3 + i), x: time, y: Range { min: 0.0, max: 1.12 * top } };
        axes.draw(canvas, ("time (s)", name), ROW_SPACING_PX, i == 1);
        canvas.clipped(&axes.area, |canvas| {
            shade(canvas, &axes);
            for run in &runs {
                let line: Vec<_> =
                    run.iter().map(|s| axes.place(seconds(comparison, s.timestamp_ns), factor * value(s))).collect();
                if let (Some(first), Some(last)) = (line.first(), line.last()) {
                    let mut filled = line.clone();
                    filled.extend([(last.0, axes.area.bottom), (first.0, axes.area.bottom)]);
                    canvas.polygon(&filled, colour, 0.14);
                }
                canvas.line(&line, 2.0, colour, 1.0, None);
            }
        });
        if let Some(statistics) = statistics {
            let (_, y) = axes.place(0.0, factor * statistics.rmse);
            canvas.line(&[(axes.area.left, y), (axes.area.right, y)], 1.6, palette::INK, 0.7, Some([8.0, 6.0]));
            let style = TextStyle::new(15.0, palette::INK, Anchor::Left);
            canvas.text("RMSE", (axes.area.right + 6.0, y + 5.0), style);
        }
        axes.frame(canvas);
    }

    // What the colours mean, over the first row.
    let y = whole.top - 22.0;
    let style = TextStyle::new(TICK_TEXT_PX, palette::INK, Anchor::Left);
    let mut x = whole.left;
    for (name, width, colour) in
        [("ground truth", 5.0, palette::TRUTH), ("estimate, aligned by one Sim(3)", 2.0, palette::ESTIMATE)]
    {
        canvas.line(&[(x, y - 7.0), (x + 34.0, y - 7.0)], width, colour, 1.0, None);
        x += 44.0;
        x += canvas.text(name, (x, y), style) + 22.0;
    }
    if !gaps.is_empty() {
        canvas.rectangle(&Area { left: x, top: y - 16.0, right: x + 24.0, bottom: y + 2.0 }, palette::LOST, 0.3);
        canvas.text("no pose", (x + 32.0, y), style);
    }
}
