//! Points and cameras in perspective: what two pictures gave, as one looks at it.
//!
//! Input: points in the first camera's axes (right, down, forward), cameras with their field of view. Output: one PNG: points
//! blue (far ones paler), cameras red, a floor and two walls with numbers so that places can be read off. Nothing that is
//! not finite is drawn; a few points far out do not shrink the rest, their number is written.
//!
//! The scene is seen from behind, above and to the left of the first camera, in weak perspective.

use std::path::Path;

use nalgebra::{Rotation3, Vector2, Vector3};

use super::axes::{Range, ticks};
use super::canvas::{Anchor, Canvas, Point, TextStyle};
use super::{PlotError, palette, save};

const WIDTH: u32 = 1400;
const HEIGHT: u32 = 1050;
const HEADING_PX: f32 = 110.0;
const MARGIN_PX: f32 = 90.0;
/// Share of the points beyond each end of an axis that may lie outside the box.
const QUANTILE: f64 = 0.03;
/// The scene is seen from so many times its size away.
const DISTANCE: f64 = 3.2;
/// Turn about the vertical, and looking down, radians.
const AZIMUTH: f64 = 0.55;
const ELEVATION: f64 = 0.42;
/// About so many numbers an axis.
const TICKS: f64 = 6.0;
/// Between an axis and its numbers, and between these and its name.
const TEXT_GAP_PX: f64 = 9.0;

/// A camera to draw.
#[derive(Debug, Clone, PartialEq)]
pub struct SpaceCamera {
    pub name: String,
    /// Its centre, and the directions through the corners of its picture (top left, clockwise), in the scene's axes.
    pub centre: Vector3<f64>,
    pub corners: [Vector3<f64>; 4],
}

/// Scene to sheet.
struct Projection {
    centre: Vector3<f64>,
    /// Half the box's diagonal.
    radius: f64,
    turn: Rotation3<f64>,
    /// Sheet pixels a unit at the centre, and where the centre is.
    scale: f64,
    middle: Vector2<f64>,
}

impl Projection {
    fn new(ranges: &[Range; 3]) -> Self {
        let centre = Vector3::from_fn(|k, _| ranges[k].centre());
        let radius = 0.5 * Vector3::from_fn(|k, _| ranges[k].width()).norm();
        // Onto axes right, down, away from the eye.
        let turn = Rotation3::from_axis_angle(&Vector3::x_axis(), ELEVATION)
            * Rotation3::from_axis_angle(&Vector3::y_axis(), -AZIMUTH);
        let mut projection = Self { centre, radius, turn, scale: 1.0, middle: Vector2::zeros() };
        // The corners of the box fill the sheet.
        let corners: Vec<Vector2<f64>> = (0..8)
            .map(|i| Vector3::from_fn(|k, _| if i >> k & 1 == 0 { ranges[k].min } else { ranges[k].max }))
            .map(|p| projection.plane(&p))
            .collect();
        let low = corners.iter().fold(corners[0], |a, b| a.inf(b));
        let high = corners.iter().fold(corners[0], |a, b| a.sup(b));
        let room = Vector2::new(
            f64::from(WIDTH as f32 - 2.0 * MARGIN_PX),
            f64::from(HEIGHT as f32 - HEADING_PX - 1.6 * MARGIN_PX),
        );
        let size = high - low;
        projection.scale = (room.x / size.x).min(room.y / size.y);
        let sheet_middle = Vector2::new(
            f64::from(WIDTH) / 2.0,
            f64::from(HEADING_PX) + (f64::from(HEIGHT) - f64::from(HEADING_PX)) / 2.0 - 20.0,
        );
        projection.middle = sheet_middle - (low + high) * 0.5 * projection.scale;
        projection
    }

    /// In units of the scene, before scaling.
    fn plane(&self, p: &Vector3<f64>) -> Vector2<f64> {
        let q = self.turn * (p - self.centre);
        let eye = DISTANCE * self.radius;
        q.xy() * (eye / (eye + q.z).max(0.1 * eye))
    }

    fn place(&self, p: &Vector3<f64>) -> Point {
        let at = self.plane(p) * self.scale + self.middle;
        (at.x as f32, at.y as f32)
    }

    /// How far from the eye, -1 (near) to 1 (far).
    fn depth(&self, p: &Vector3<f64>) -> f64 {
        ((self.turn * (p - self.centre)).z / self.radius).clamp(-1.0, 1.0)
    }
}

fn finite(p: &Vector3<f64>) -> bool {
    p.iter().all(|v| v.is_finite())
}

/// The box that most points and all cameras are in.
fn ranges(points: &[Vector3<f64>], cameras: &[SpaceCamera]) -> [Range; 3] {
    let each = [0, 1, 2].map(|k| {
        let mut values: Vec<f64> = points.iter().map(|p| p[k]).collect();
        values.sort_unstable_by(f64::total_cmp);
        let skip = (values.len() as f64 * QUANTILE) as usize;
        let most = values.get(skip..values.len() - skip).unwrap_or_default().iter().copied();
        let centres = cameras.iter().map(|c| c.centre[k]);
        Range::of(most.chain(centres)).unwrap_or(Range { min: -1.0, max: 1.0 })
    });
    // No side so thin that nothing can be read.
    let longest = each.iter().map(Range::width).fold(1e-9, f64::max);
    each.map(|r| r.padded(0.06, 0.25 * longest))
}

/// Draws points and cameras. `unit` is what a length of 1 is called.
pub fn write_space(
    path: &Path,
    points: &[Vector3<f64>],
    cameras: &[SpaceCamera],
    unit: &str,
    heading: &str,
    facts: &str,
) -> Result<(), PlotError> {
    let points: Vec<Vector3<f64>> = points.iter().copied().filter(finite).collect();
    let cameras: Vec<SpaceCamera> =
        cameras.iter().filter(|c| finite(&c.centre) && c.corners.iter().all(finite)).cloned().collect();
    let ranges = ranges(&points, &cameras);
    let projection = Projection::new(&ranges);
    let mut canvas = Canvas::new(WIDTH, HEIGHT)?;
    grid(&mut canvas, &projection, &ranges, unit);

    let inside = |p: &Vector3<f64>| (0..3).all(|k| (ranges[k].min..=ranges[k].max).contains(&p[k]));
    let mut shown: Vec<&Vector3<f64>> = points.iter().filter(|p| inside(p)).collect();
    // Far ones first, so that near ones cover them.
    shown.sort_by(|a, b| projection.depth(b).total_cmp(&projection.depth(a)));
    let radius = (60.0 / (shown.len() as f32 + 1.0).sqrt()).clamp(3.4, 6.0);
    for p in &shown {
        let near = (0.5 - 0.5 * projection.depth(p)) as f32;
        let at = projection.place(p);
        canvas.disc(at, radius + 0.8, palette::PAPER, 0.5);
        canvas.disc(at, radius, palette::POINT, 0.45 + 0.55 * near);
    }
    frusta(&mut canvas, &projection, &cameras);

    canvas.text(heading, (44.0, 54.0), TextStyle::new(30.0, palette::INK, Anchor::Left).bold());
    let outside = points.len() - shown.len();
    let far = if outside > 0 { format!(", {outside} of them outside this box") } else { String::new() };
    let count = format!("{} points{far}; {facts}", points.len());
    canvas.text(&count, (44.0, 88.0), TextStyle::new(20.0, palette::MUTED, Anchor::Left));
    save(path, &canvas)
}

/// Floor, back wall and side wall, with the numbers of the three axes along their outer edges.
fn grid(canvas: &mut Canvas, projection: &Projection, [x, y, z]: &[Range; 3], unit: &str) {
    // The floor is where y (down) is largest; the walls are the far ones: largest z, and the side away from the eye.
    let (floor, back, side) = (y.max, z.max, x.max);
    let mut line = |a: Vector3<f64>, b: Vector3<f64>, width: f32, colour: u32| {
        canvas.line(&[projection.place(&a), projection.place(&b)], width, colour, 1.0, None);
    };
    for (v, _) in ticks(x, TICKS) {
        line(Vector3::new(v, floor, z.min), Vector3::new(v, floor, back), 1.0, palette::GRID);
        line(Vector3::new(v, y.min, back), Vector3::new(v, floor, back), 1.0, palette::GRID);
    }
    for (v, _) in ticks(z, TICKS) {
        line(Vector3::new(x.min, floor, v), Vector3::new(x.max, floor, v), 1.0, palette::GRID);
        line(Vector3::new(side, y.min, v), Vector3::new(side, floor, v), 1.0, palette::GRID);
    }
    for (v, _) in ticks(y, TICKS) {
        line(Vector3::new(x.min, v, back), Vector3::new(x.max, v, back), 1.0, palette::GRID);
        line(Vector3::new(side, v, z.min), Vector3::new(side, v, back), 1.0, palette::GRID);
    }
    for (a, b) in [
        (Vector3::new(x.min, floor, z.min), Vector3::new(x.max, floor, z.min)),
        (Vector3::new(x.min, floor, z.min), Vector3::new(x.min, floor, back)),
        (Vector3::new(x.min, floor, back), Vector3::new(x.min, y.min, back)),
        (Vector3::new(x.min, floor, back), Vector3::new(x.max, floor, back)),
        (Vector3::new(x.max, floor, z.min), Vector3::new(x.max, floor, back)),
        (Vector3::new(x.max, floor, back), Vector3::new(x.max, y.min, back)),
    ] {
        line(a, b, 1.5, palette::FRAME);
    }
    for text in axis_texts(canvas, projection, [x, y, z], unit) {
        text.draw(canvas);
    }
}

/// A text of an axis and the room that it takes on the sheet.
struct AxisText {
    text: String,
    style: TextStyle,
    upwards: bool,
    centre: Vector2<f64>,
    /// Half its width and height, px.
    half: Vector2<f64>,
}

impl AxisText {
    fn new(canvas: &Canvas, text: String, style: TextStyle, upwards: bool) -> Self {
        // Capitals and digits are 0.73 of the size high.
        let half = Vector2::new(f64::from(canvas.text_width(&text, style)), 0.73 * f64::from(style.size_px)) * 0.5;
        let half = if upwards { half.yx() } else { half };
        Self { text, style, upwards, centre: Vector2::zeros(), half }
    }

    /// How far it reaches from its centre in a direction.
    fn reach(&self, direction: &Vector2<f64>) -> f64 {
        direction.abs().dot(&self.half)
    }

    fn draw(&self, canvas: &mut Canvas) {
        let (x, y) = (self.centre.x as f32, self.centre.y as f32);
        if self.upwards {
            canvas.text_upwards(&self.text, (x + self.half.x as f32, y), self.style);
        } else {
            canvas.text(&self.text, (x, y + self.half.y as f32), self.style);
        }
    }
}

/// Numbers and names of the three axes: outside their edges, the name outside the numbers.
fn axis_texts(canvas: &Canvas, projection: &Projection, [x, y, z]: [&Range; 3], unit: &str) -> Vec<AxisText> {
    let number = TextStyle::new(16.0, palette::MUTED, Anchor::Centre);
    let label = TextStyle::new(19.0, palette::INK, Anchor::Centre);
    let (floor, back) = (y.max, z.max);
    let sheet = |p: Vector3<f64>| {
        let (px, py) = projection.place(&p);
        Vector2::new(f64::from(px), f64::from(py))
    };
    let middle = sheet(Vector3::new(x.centre(), y.centre(), z.centre()));
    let up = Range { min: -y.max, max: -y.min };
    type Edge<'a> = (String, bool, &'a Range, Box<dyn Fn(f64) -> Vector3<f64> + 'a>);
    let edges: [Edge<'_>; 3] = [
        (format!("right ({unit})"), false, x, Box::new(|v| Vector3::new(v, floor, z.min))),
        ("forward".into(), false, z, Box::new(|v| Vector3::new(x.min, floor, v))),
        ("up".into(), true, &up, Box::new(|v| Vector3::new(x.min, -v, back))),
    ];
    let mut texts = Vec::new();
    for (name, upwards, range, at) in edges {
        let along = sheet(at(range.max)) - sheet(at(range.min));
        let across = Vector2::new(-along.y, along.x).try_normalize(1e-9).unwrap_or(Vector2::y());
        let centre = sheet(at(range.centre()));
        let outwards = if across.dot(&(centre - middle)) < 0.0 { -across } else { across };
        let mut numbers_end = 0.0f64;
        for (v, text) in ticks(range, TICKS) {
            let mut text = AxisText::new(canvas, text, number, false);
            let reach = text.reach(&outwards);
            text.centre = sheet(at(v)) + outwards * (TEXT_GAP_PX + reach);
            numbers_end = numbers_end.max(TEXT_GAP_PX + 2.0 * reach);
            texts.push(text);
        }
        let mut name = AxisText::new(canvas, name, label, upwards);
        name.centre = centre + outwards * (numbers_end + TEXT_GAP_PX + name.reach(&outwards));
        texts.push(name);
    }
    texts
}

/// Cameras as open pyramids with their names, and the line between the first two.
fn frusta(canvas: &mut Canvas, projection: &Projection, cameras: &[SpaceCamera]) {
    // As deep as a third of the baseline, within what can be seen.
    let baseline = match cameras {
        [a, b, ..] => (b.centre - a.centre).norm(),
        _ => projection.radius,
    };
    let depth = (0.45 * baseline).clamp(0.05 * projection.radius, 0.2 * projection.radius);
    if let [a, b, ..] = cameras {
        let ends = [projection.place(&a.centre), projection.place(&b.centre)];
        canvas.line(&ends, 2.0, palette::CORNER, 0.7, Some([6.0, 5.0]));
    }
    for camera in cameras {
        let apex = projection.place(&camera.centre);
        let base = camera.corners.map(|d| projection.place(&(camera.centre + d * depth)));
        canvas.polygon(&base, palette::CORNER, 0.16);
        for i in 0..4 {
            canvas.line(&[apex, base[i]], 2.0, palette::CORNER, 1.0, None);
            canvas.line(&[base[i], base[(i + 1) % 4]], 2.0, palette::CORNER, 1.0, None);
        }
        canvas.disc(apex, 5.0, palette::CORNER, 1.0);
        let style = TextStyle::new(22.0, palette::CORNER, Anchor::Centre).bold();
        canvas.text(&camera.name, (apex.0, apex.1 + 28.0), style);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(x: f64) -> SpaceCamera {
        let corners = [(-0.5, -0.4), (0.5, -0.4), (0.5, 0.4), (-0.5, 0.4)].map(|(a, b)| Vector3::new(a, b, 1.0));
        SpaceCamera { name: "A".into(), centre: Vector3::new(x, 0.0, 0.0), corners }
    }

    #[test]
    fn right_is_right_up_is_up_and_far_is_far() {
        let ranges = [Range { min: -2.0, max: 2.0 }, Range { min: -1.0, max: 1.0 }, Range { min: 0.0, max: 6.0 }];
        let p = Projection::new(&ranges);
        let centre = p.place(&Vector3::new(0.0, 0.0, 3.0));
        assert!(p.place(&Vector3::new(1.0, 0.0, 3.0)).0 > centre.0);
        assert!(p.place(&Vector3::new(0.0, -1.0, 3.0)).1 < centre.1);
        // Seen from above, what is farther stands higher.
        assert!(p.place(&Vector3::new(0.0, 0.0, 4.0)).1 < centre.1);
        assert!(p.depth(&Vector3::new(0.0, 0.0, 5.0)) > p.depth(&Vector3::new(0.0, 0.0, 1.0)));
        for i in 0..8 {
            let corner = Vector3::from_fn(|k, _| if i >> k & 1 == 0 { ranges[k].min } else { ranges[k].max });
            let (x, y) = p.place(&corner);
            assert!((40.0..1360.0).contains(&x) && (90.0..1040.0).contains(&y), "{x} {y}");
        }
    }

    #[test]
    fn no_text_of_the_axes_lies_over_another() {
        let canvas = Canvas::new(WIDTH, HEIGHT).unwrap();
        for [right, up, forward] in [
            [2.5, 1.8, 6.0],
            [12.0, 8.0, 37.0],
            [1.0, 1.0, 1.0],
            [40.0, 10.0, 10.0],
            [0.02, 0.01, 0.03],
            [3e7, 3e7, 1e8],
        ] {
            let range = |width: f64| Range { min: -0.71 * width, max: 0.29 * width };
            let ranges = [range(right), range(up), range(forward)];
            let [x, y, z] = &ranges;
            let texts = axis_texts(&canvas, &Projection::new(&ranges), [x, y, z], "baselines");
            assert!(texts.len() >= 9, "{} texts", texts.len());
            for (i, a) in texts.iter().enumerate() {
                for b in &texts[..i] {
                    let apart = (a.centre - b.centre).abs() - a.half - b.half;
                    assert!(
                        apart.max() > 0.0,
                        "{} lies over {} in a box of {right} x {up} x {forward}",
                        a.text,
                        b.text
                    );
                }
                let (low, high) = (a.centre - a.half, a.centre + a.half);
                let inside = low.min() > 0.0 && high.x < f64::from(WIDTH) && high.y < f64::from(HEIGHT);
                assert!(inside, "{} leaves the sheet in a box of {right} x {up} x {forward}", a.text);
            }
        }
    }

    #[test]
    fn nothing_and_nonsense_still_give_a_picture() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("space.png");
        write_space(&path, &[], &[], "baselines", "empty", "").unwrap();
        let wild = [Vector3::new(f64::NAN, 0.0, 1.0), Vector3::new(1e300, 0.0, 1.0), Vector3::new(0.0, 0.0, 5.0)];
        write_space(&path, &wild, &[camera(0.0), camera(f64::INFINITY)], "baselines", "wild", "").unwrap();
        write_space(&path, &[Vector3::zeros(); 3], &[camera(0.0), camera(0.0)], "baselines", "one place", "").unwrap();
        assert!(std::fs::read(&path).unwrap().len() > 1000);
    }
}
