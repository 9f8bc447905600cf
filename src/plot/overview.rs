//! A run's map and path in two views of one scale: from above, and from the side or from behind.
//!
//! Drawn in the axes of the first keyframe's camera (its right, forward and up; "up" is the camera's, not gravity's). The
//! views stand beside or above each other, whichever shows the scene larger. Landmarks are faint dots, so that density
//! shows; where obstacles are known, what is in the way is red and what is seen free around the robot's last place is green; the path goes from dark to bright in time; keyframes point the way they look.

use std::path::Path;

use nalgebra::Vector3;

use super::axes::{Axes, Range, TICK_TEXT_PX};
use super::canvas::{Anchor, Area, Canvas, Point, TextStyle};
use super::{LengthUnit, PlotError, palette, save};
use crate::map::{Around, MapSnapshot};
use crate::trajectory::TumPose;

const WIDTH: u32 = 1800;
/// Of the picture, and of the views' part of it; between them the scene decides.
const MAX_HEIGHT: f32 = 1320.0;
const MIN_HEIGHT: f32 = 420.0;
/// A path is drawn through at most about this many points.
const MAX_PATH_POINTS: usize = 20_000;
/// Landmarks beyond these quantiles do not widen the view.
const QUANTILE: f64 = 0.02;

/// A direction of the first keyframe's camera as it is drawn.
#[derive(Clone, Copy)]
enum Direction {
    Right,
    Forward,
    Left,
    Up,
}

impl Direction {
    fn of(self, p: &Vector3<f64>) -> f64 {
        match self {
            Self::Right => p.x,
            Self::Forward => p.z,
            Self::Left => -p.x,
            Self::Up => -p.y,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Right => "right",
            Self::Forward => "forward",
            Self::Left => "left",
            Self::Up => "up",
        }
    }
}

/// One view of space: what is drawn to the right and what upwards.
#[derive(Clone, Copy)]
struct View {
    name: &'static str,
    horizontal: Direction,
    vertical: Direction,
}

const ABOVE_FACING_UP: View = View { name: "from above", horizontal: Direction::Right, vertical: Direction::Forward };
const ABOVE_FACING_RIGHT: View = View { name: "from above", horizontal: Direction::Forward, vertical: Direction::Left };
const SIDE: View = View { name: "from the side", horizontal: Direction::Forward, vertical: Direction::Up };
const BEHIND: View = View { name: "from behind", horizontal: Direction::Right, vertical: Direction::Up };
/// Pairs of views and whether they stand above each other (sharing the horizontal axis) or side by side.
const LAYOUTS: [(View, View, bool); 4] = [
    (ABOVE_FACING_UP, SIDE, false),
    (ABOVE_FACING_RIGHT, SIDE, false),
    (ABOVE_FACING_RIGHT, SIDE, true),
    (ABOVE_FACING_UP, BEHIND, true),
];

/// Two areas and the length that a pixel has in both.
struct Layout {
    views: [(View, Area); 2],
    unit_per_px: f64,
    stacked: bool,
    height_px: f32,
}

impl Layout {
    const LEFT_PX: f32 = 150.0;
    const TOP_PX: f32 = 190.0;
    const RIGHT_PX: f32 = WIDTH as f32 - 48.0;
    const BOTTOM_MARGIN_PX: f32 = 92.0;
    const GAP_PX: f32 = 34.0;
    /// Between views side by side, where the second one's numbers and name stand.
    const WIDE_GAP_PX: f32 = 140.0;

    /// The arrangement in which the scene is largest, and no taller a picture than it needs.
    fn best(scene: &Scene) -> Self {
        let candidates = LAYOUTS.map(|(first, second, stacked)| Self::fit(scene, first, second, stacked));
        let [mut best, others @ ..] = candidates;
        for other in others {
            // Strictly better by a margin: the order is one of preference.
            if other.unit_per_px < 0.9 * best.unit_per_px {
                best = other;
            }
        }
        best
    }

    fn fit(scene: &Scene, first: View, second: View, stacked: bool) -> Self {
        let sizes = [first, second].map(|v| (scene.range(v.horizontal).width(), scene.range(v.vertical).width()));
        let (width, height) = (Self::RIGHT_PX - Self::LEFT_PX, MAX_HEIGHT - Self::TOP_PX - Self::BOTTOM_MARGIN_PX);
        let [(w1, h1), (w2, h2)] = sizes;
        // A view is never narrower or flatter than this share of the sum of both.
        let share = |a: f64, b: f64| (a / (a + b)).clamp(0.25, 0.75) as f32;
        let unit_per = |size: f64, px: f32| size / f64::from(px);
        let (areas, unit_per_px, used) = if stacked {
            let room = height - Self::GAP_PX;
            let split = share(h1, h2);
            let coarsest =
                unit_per(w1.max(w2), width).max(unit_per(h1, room * split)).max(unit_per(h2, room * (1.0 - split)));
            let used = ((h1 / coarsest) as f32 / split).max((h2 / coarsest) as f32 / (1.0 - split));
            let used = used.clamp(MIN_HEIGHT, room);
            let middle = Self::TOP_PX + used * split;
            let whole = Area {
                left: Self::LEFT_PX,
                top: Self::TOP_PX,
                right: Self::RIGHT_PX,
                bottom: Self::TOP_PX + used + Self::GAP_PX,
            };
            (
                [Area { bottom: middle, ..whole }, Area { top: middle + Self::GAP_PX, ..whole }],
                coarsest,
                used + Self::GAP_PX,
            )
        } else {
            let room = width - Self::WIDE_GAP_PX;
            let split = share(w1, w2);
            let coarsest =
                unit_per(w1, room * split).max(unit_per(w2, room * (1.0 - split))).max(unit_per(h1.max(h2), height));
            let used = ((h1.max(h2) / coarsest) as f32).clamp(MIN_HEIGHT, height);
            let middle = Self::LEFT_PX + room * split;
            let whole =
                Area { left: Self::LEFT_PX, top: Self::TOP_PX, right: Self::RIGHT_PX, bottom: Self::TOP_PX + used };
            ([Area { right: middle, ..whole }, Area { left: middle + Self::WIDE_GAP_PX, ..whole }], coarsest, used)
        };
        let [a, b] = areas;
        Self {
            views: [(first, a), (second, b)],
            unit_per_px,
            stacked,
            height_px: Self::TOP_PX + used + Self::BOTTOM_MARGIN_PX,
        }
    }
}

/// Draws the map and the `trajectory` (ascending time; may be empty, then the keyframes make the path) to `path`.
pub fn write_overview(
    path: &Path,
    map: &MapSnapshot,
    trajectory: &[TumPose],
    unit: LengthUnit,
    title: &str,
) -> Result<(), PlotError> {
    let scene = Scene::new(map, trajectory);
    let layout = Layout::best(&scene);
    let mut canvas = Canvas::new(WIDTH, layout.height_px.ceil() as u32)?;
    let mut outside = 0;
    for (i, (view, area)) in layout.views.into_iter().enumerate() {
        let range = |d: Direction, px: f32| scene.range(d).widened(layout.unit_per_px * f64::from(px));
        let axes = Axes { area, x: range(view.horizontal, area.width()), y: range(view.vertical, area.height()) };
        let label = |d: Direction| format!("{} ({})", d.name(), unit.name());
        let numbered = i == 1 || !layout.stacked;
        let labels = (label(view.horizontal), label(view.vertical));
        axes.draw(&mut canvas, (&labels.0, &labels.1), (90.0, 90.0), numbered);
        outside = outside.max(scene.draw(&mut canvas, &axes, view));
        axes.frame(&mut canvas);
        let place = (area.left + 16.0, area.top + 32.0);
        let behind =
            Area { left: area.left + 8.0, top: area.top + 8.0, right: area.left + 190.0, bottom: area.top + 42.0 };
        canvas.rectangle(&behind, palette::PAPER, 0.85);
        canvas.text(view.name, place, TextStyle::new(22.0, palette::INK, Anchor::Left).bold());
    }
    scene.heading(&mut canvas, unit, title, outside);
    legend(&mut canvas, Layout::LEFT_PX, Layout::TOP_PX - 22.0);
    save(path, &canvas)
}

/// What is drawn, with everything that is not finite left out.
struct Scene {
    landmarks: Vec<Vector3<f64>>,
    /// Centre, and the direction that it looks in.
    keyframes: Vec<(Vector3<f64>, Vector3<f64>)>,
    /// Pieces of path, each point with its share of the time; a piece ends where a frame is missing.
    path: Vec<Vec<(Vector3<f64>, f64)>>,
    path_length: f64,
    poses: usize,
    around: Around,
}

fn finite(p: &Vector3<f64>) -> bool {
    p.iter().all(|v| v.is_finite())
}

impl Scene {
    fn new(map: &MapSnapshot, trajectory: &[TumPose]) -> Self {
        let mut keyframes: Vec<_> = map.keyframes.iter().filter(|k| k.world_from_camera.is_finite()).collect();
        keyframes.sort_by_key(|k| (k.timestamp_ns, k.id));
        let stops: Vec<(i64, Vector3<f64>)> = match trajectory.is_empty() {
            true => keyframes.iter().map(|k| (k.timestamp_ns, k.world_from_camera.translation)).collect(),
            false => trajectory.iter().map(|p| (p.timestamp_ns, p.world_from_camera.translation)).collect(),
        };
        let stops: Vec<_> = stops.into_iter().filter(|(_, p)| finite(p)).collect();
        let time = |i: usize| stops.get(i).map_or(0, |s| s.0);
        let (start, end) = (time(0), time(stops.len().saturating_sub(1)));
        let span = (end.saturating_sub(start) as f64).max(1.0);
        // A line across frames without a pose would be invented. Keyframes are far apart by nature.
        let mut steps: Vec<i64> = stops.windows(2).map(|w| w[1].0.saturating_sub(w[0].0)).collect();
        steps.sort_unstable();
        let usual = steps.get(steps.len() / 2).copied().unwrap_or(0);
        let longest = if trajectory.is_empty() { i64::MAX } else { usual.saturating_mul(5) };
        let mut path: Vec<Vec<(Vector3<f64>, f64)>> = Vec::new();
        let mut path_length = 0.0;
        for piece in stops.chunk_by(|a, b| b.0.saturating_sub(a.0) <= longest) {
            path_length += piece.windows(2).map(|w| (w[1].1 - w[0].1).norm()).sum::<f64>();
            let every = stops.len() / MAX_PATH_POINTS + 1;
            let mut points: Vec<_> = piece.iter().step_by(every).collect();
            points.extend(piece.last().filter(|_| (piece.len() - 1) % every != 0));
            path.push(points.into_iter().map(|(t, p)| (*p, (t - start) as f64 / span)).collect());
        }
        Self {
            landmarks: map.landmarks.iter().map(|l| l.position_world).filter(finite).collect(),
            keyframes: keyframes
                .iter()
                .map(|k| (k.world_from_camera.translation, k.world_from_camera.rotation * Vector3::z()))
                .collect(),
            path,
            path_length,
            poses: trajectory.len(),
            around: map.around.clone(),
        }
    }

    /// What the view must show in a direction: the whole path, and the landmarks but for a few far out.
    fn range(&self, direction: Direction) -> Range {
        let mut values: Vec<f64> = self.landmarks.iter().map(|p| direction.of(p)).collect();
        values.sort_unstable_by(f64::total_cmp);
        let skip = (values.len() as f64 * QUANTILE) as usize;
        let most = values.get(skip..values.len() - skip).unwrap_or_default().iter().copied();
        let cameras = self.path.iter().flatten().map(|(p, _)| direction.of(p));
        let keyframes = self.keyframes.iter().map(|(p, _)| direction.of(p));
        let range = Range::of(most.chain(cameras).chain(keyframes)).unwrap_or(Range { min: -1.0, max: 1.0 });
        range.padded(0.06, 1e-6 + 1e-6 * range.centre().abs())
    }

    /// Draws one view; returns the number of landmarks outside it.
    fn draw(&self, canvas: &mut Canvas, axes: &Axes, view: View) -> usize {
        let View { horizontal, vertical, .. } = view;
        let place = |p: &Vector3<f64>| axes.place(horizontal.of(p), vertical.of(p));
        let dots: Vec<Point> = self.landmarks.iter().map(place).filter(|p| axes.area.contains(*p)).collect();
        // Fainter the more there are, so that density still shows.
        let opacity = (900.0 / (dots.len() as f32 + 1.0)).sqrt().clamp(0.10, 0.6);
        canvas.clipped(&axes.area, |canvas| {
            self.surroundings(canvas, &place);
            for dot in &dots {
                canvas.disc(*dot, 2.4, palette::LANDMARK, opacity);
            }
            for (centre, looks) in &self.keyframes {
                wedge(canvas, place(centre), (horizontal.of(looks) as f32, -vertical.of(looks) as f32));
            }
            for piece in &self.path {
                let line: Vec<_> = piece.iter().map(|(p, _)| place(p)).collect();
                canvas.line(&line, 7.0, palette::PAPER, 0.8, None);
            }
            for piece in &self.path {
                for pair in piece.windows(2) {
                    let colour = palette::sequential(0.92 * pair[1].1);
                    canvas.line(&[place(&pair[0].0), place(&pair[1].0)], 3.4, colour, 1.0, None);
                }
            }
            let first = self.path.first().and_then(|p| p.first());
            let last = self.path.last().and_then(|p| p.last());
            for (end, colour) in [(first, palette::START), (last, palette::LOST)] {
                if let Some((p, _)) = end {
                    canvas.disc(place(p), 10.5, palette::PAPER, 1.0);
                    canvas.disc(place(p), 8.0, colour, 1.0);
                }
            }
        });
        self.landmarks.len() - dots.len()
    }

    /// Stretches that are seen free, and what is in the way, around the robot at the end.
    fn surroundings(&self, canvas: &mut Canvas, place: &impl Fn(&Vector3<f64>) -> Point) {
        for [from, to] in self.around.free.iter().filter(|ends| ends.iter().all(finite)) {
            canvas.line(&[place(from), place(to)], 3.0, palette::START, 0.3, None);
        }
        for thing in self.around.in_the_way.iter().filter(|p| finite(p)) {
            canvas.disc(place(thing), 3.6, palette::LOST, 0.8);
        }
    }

    fn heading(&self, canvas: &mut Canvas, unit: LengthUnit, title: &str, outside: usize) {
        canvas.text(title, (44.0, 62.0), TextStyle::new(36.0, palette::INK, Anchor::Left).bold());
        let counted = |n: usize, what: &str| (n.to_string(), format!("{what}{}", if n == 1 { "" } else { "s" }));
        let mut facts = vec![counted(self.landmarks.len(), "landmark"), counted(self.keyframes.len(), "keyframe")];
        if self.poses > 0 {
            facts.push(counted(self.poses, "pose"));
        }
        facts.push((format!("{:.2}", self.path_length), format!("{} of path", unit.name())));
        if outside > 0 {
            facts.push((outside.to_string(), "far landmarks outside the view".to_string()));
        }
        let mut x = 44.0;
        for (value, name) in facts {
            x += canvas.text(&value, (x, 104.0), TextStyle::new(23.0, palette::INK, Anchor::Left).bold()) + 8.0;
            x += canvas.text(&name, (x, 104.0), TextStyle::new(23.0, palette::MUTED, Anchor::Left)) + 30.0;
        }
        let note = TextStyle::new(19.0, palette::MUTED, Anchor::Right);
        let right = WIDTH as f32 - 48.0;
        canvas.text("axes of the first keyframe's camera", (right, 40.0), note);
        if unit == LengthUnit::MapUnits {
            canvas.text("map units: one camera alone knows no metres", (right, 66.0), note);
        }
    }
}

/// A small open triangle at the camera, opening in the direction that it looks in (pixels, y down).
fn wedge(canvas: &mut Canvas, at: Point, looks: (f32, f32)) {
    const LENGTH_PX: f32 = 17.0;
    let length = looks.0.hypot(looks.1);
    // Looking out of the paper: a dot says more than a wedge of a random direction.
    if length < 0.2 {
        canvas.disc(at, 4.0, palette::KEYFRAME, 1.0);
        return;
    }
    let (dx, dy) = (LENGTH_PX * looks.0, LENGTH_PX * looks.1);
    let (nx, ny) = (-LENGTH_PX * 0.5 * looks.1 / length, LENGTH_PX * 0.5 * looks.0 / length);
    let corners = [at, (at.0 + dx + nx, at.1 + dy + ny), (at.0 + dx - nx, at.1 + dy - ny)];
    canvas.polygon(&corners, palette::KEYFRAME, 0.28);
    let outline = [corners[0], corners[1], corners[2], corners[0]];
    canvas.line(&outline, 1.6, palette::KEYFRAME, 1.0, None);
}

fn legend(canvas: &mut Canvas, left: f32, y: f32) {
    let style = TextStyle::new(TICK_TEXT_PX, palette::INK, Anchor::Left);
    let mut x = left;
    for i in 0..3 {
        let (dx, dy) = [(4.0, -10.0), (12.0, -3.0), (19.0, -12.0)][i];
        canvas.disc((x + dx, y + dy), 2.6, palette::LANDMARK, 0.7);
    }
    x += 30.0;
    x += canvas.text("landmarks", (x, y), style) + 26.0;
    wedge(canvas, (x + 2.0, y - 7.0), (1.0, 0.0));
    x += 30.0;
    x += canvas.text("keyframes", (x, y), style) + 26.0;
    const STEPS: i32 = 14;
    for i in 0..STEPS {
        let at = |i: i32| (x + 40.0 * i as f32 / STEPS as f32, y - 7.0);
        let colour = palette::sequential(0.92 * f64::from(i) / f64::from(STEPS - 1));
        canvas.line(&[at(i), at(i + 1)], 3.4, colour, 1.0, None);
    }
    x += 50.0;
    x += canvas.text("camera path, dark to bright in time", (x, y), style) + 26.0;
    for (name, colour) in [("start", palette::START), ("end", palette::LOST)] {
        canvas.disc((x + 8.0, y - 7.0), 8.0, colour, 1.0);
        x += 24.0;
        x += canvas.text(name, (x, y), style) + 22.0;
    }
}
