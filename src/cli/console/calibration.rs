//! The calibrations of the console: what `cairn calibrate` does with a camera, with the pictures that the console gets.

use std::time::{SystemTime, UNIX_EPOCH};

use crate::calibration::chessboard::{Board, BoardCorner, Pattern};
use crate::calibration::export::Format;
use crate::calibration::guide::{ENOUGH_VIEWS, Guide, MAX_VIEWS, Seen};
use crate::calibration::verdict::{
    self, COVERAGE, MAX_CENTRE_SIGMA, MAX_FOCAL_SIGMA, MIN_COVERED, TILT_DEG, coverage, precision,
};
use crate::cli::calibrate::encode;
use crate::console::calibration::{
    Board as Asked, Calibrator, Gauge, Glance, Guidance, Guided, Lens, Look, Need, Outcome, Picture, Value,
};
use crate::geometry::plane_calibration::Distortion;
use crate::image::GreyImage;

/// As of `cairn calibrate --square`. It says how long a metre is, and nothing of the camera.
const SUPPOSED_SQUARE_M: f64 = 0.025;

/// Calibrates with chessboards.
#[derive(Debug)]
pub struct Chessboards;

impl Calibrator for Chessboards {
    fn begin(&self, board: &Asked) -> Result<Box<dyn Guided>, String> {
        let pattern = Pattern::new(board.columns, board.rows, board.square_m.unwrap_or(SUPPOSED_SQUARE_M))?;
        let distortion = match board.lens {
            Lens::Full => Distortion::Full,
            Lens::Fisheye => Distortion::KannalaBrandt,
        };
        Ok(Box::new(Sitting {
            guide: Guide::new(pattern, distortion).without_pictures(),
            pattern,
            has_square: board.square_m.is_some(),
            size: (0, 0),
        }))
    }
}

/// A [`Guide`] and what it was asked for.
#[derive(Debug)]
struct Sitting {
    guide: Guide,
    pattern: Pattern,
    has_square: bool,
    size: (u32, u32),
}

impl Guided for Sitting {
    fn look(&mut self, picture: Picture) -> Glance {
        let Picture { sequence, time_ns, width, height, pixels, .. } = picture;
        self.size = (width as u32, height as u32);
        let seen = self.guide.step(&GreyImage { width, height, data: pixels }, time_ns);
        let look = match seen {
            Seen::NoBoard => Look::NoBoard,
            Seen::OtherSize(..) => Look::OtherBoard,
            Seen::Incomplete | Seen::Moving | Seen::Blurred => Look::Unfit,
            Seen::Known | Seen::Better(_) => Look::Known,
            Seen::Taken => Look::Taken,
        };
        let corners = self.guide.board().map(rows).unwrap_or_default();
        Glance { sequence, size: [width, height], look, advice: self.guide.advice(seen), corners }
    }

    fn guidance(&self) -> Guidance {
        let boards = || self.guide.views().iter().map(|view| &view.board);
        let (solution, views) = (self.guide.solution(), self.guide.views().len());
        let cells = match solution {
            Some(solved) => solved.verdict.cells.clone(),
            None => coverage(boards().flat_map(|b| &b.corners).map(|c| &c.pixel), self.size),
        };
        let needs = solution.map_or(&[][..], |solved| &solved.verdict.needs);
        let need = |need: &verdict::Need| Need { name: need.name(), missing: need.to_string(), advice: need.advice() };
        Guidance {
            views,
            enough: ENOUGH_VIEWS,
            most: MAX_VIEWS,
            grid: [COVERAGE.0, COVERAGE.1],
            gauges: self.gauges(&cells),
            cells,
            outlines: boards().filter_map(|board| outline(board, &self.pattern, self.size)).collect(),
            needs: needs.iter().map(need).collect(),
            solved: solution.is_some(),
        }
    }

    fn is_done(&self) -> bool {
        self.guide.is_done()
    }

    fn outcome(&self) -> Option<Outcome> {
        let calibrated = self.guide.solution()?;
        let (solved, camera) = (&calibrated.solved, &calibrated.camera);
        let sigmas = solved.sigmas();
        let value = |(i, name): (usize, &&'static str)| Value {
            name,
            value: solved.intrinsics[i],
            sigma: solved.free[i].then(|| sigmas[i]),
            unit: if i < 4 { "px" } else { "" },
        };
        let file_name = format!("camera-{}x{}.toml", camera.width, camera.height);
        Some(Outcome {
            values: solved.lens.parameter_names().iter().enumerate().map(value).collect(),
            good: calibrated.verdict.is_good(),
            words: calibrated.words().lines().map(|line| line.trim().to_owned()).collect(),
            file: encode(&calibrated.file(None, now_unix_s()), Format::Cairn, &file_name).ok()?,
            file_name,
        })
    }
}

impl Sitting {
    /// How far each thing that the verdict asks for has come.
    fn gauges(&self, cells: &[u32]) -> Vec<Gauge> {
        let views = self.guide.views().len();
        let solution = self.guide.solution();
        let covered = cells.iter().filter(|count| **count > 0).count() as f64 / cells.len().max(1) as f64;
        let unknown = || ("not known so far".to_owned(), 0.0);
        let tilt = |which: usize| {
            solution.map_or_else(unknown, |s| {
                let deg = s.verdict.tilt_deg[which];
                (format!("{deg:.0}° of {TILT_DEG:.0}°"), deg / TILT_DEG)
            })
        };
        let known = solution.map_or_else(unknown, |s| {
            let (focal, centre) = precision(&s.solved, (s.camera.width, s.camera.height));
            // The one that is farther from what is asked for.
            let (focal_of, centre_of) = (focal / MAX_FOCAL_SIGMA, centre / MAX_CENTRE_SIGMA);
            let (name, sigma, wanted) = if focal_of > centre_of {
                ("focal", focal, MAX_FOCAL_SIGMA)
            } else {
                ("centre", centre, MAX_CENTRE_SIGMA)
            };
            (format!("{name} ± {:.2} % of {:.2} %", 100.0 * sigma, 100.0 * wanted), wanted / sigma)
        });
        let covers = format!("{:.0} % of {:.0} %", 100.0 * covered, 100.0 * MIN_COVERED);
        let gauge = |(name, label, (text, share)): (_, _, (String, f64))| Gauge {
            name,
            label,
            text,
            share: Some(share.clamp(0.0, 1.0)),
        };
        let asked_for = [
            ("views", "Views", (format!("{views} of {ENOUGH_VIEWS}"), views as f64 / ENOUGH_VIEWS as f64)),
            ("coverage", "Picture covered", (covers, covered / MIN_COVERED)),
            ("sideways", "Turned sideways", tilt(0)),
            ("forward", "Tilted forward", tilt(1)),
            ("precision", "Precision", known),
        ];
        let mut gauges: Vec<Gauge> = asked_for.into_iter().map(gauge).collect();
        if let (true, Some([near, far])) = (self.has_square, self.distances_m()) {
            let text = format!("{near:.2} m to {far:.2} m");
            gauges.push(Gauge { name: "distance", label: "Distances", text, share: None });
        }
        gauges
    }

    /// Of the nearest and the farthest view's first corner.
    fn distances_m(&self) -> Option<[f64; 2]> {
        let views = self.guide.solution()?.solved.views.iter().filter(|view| view.used);
        let distances = views.map(|view| view.translation.norm());
        distances.fold(None, |range: Option<[f64; 2]>, d| {
            Some(range.map_or([d, d], |[near, far]| [near.min(d), far.max(d)]))
        })
    }
}

/// A board's corners for a page, row by row, to a tenth of a pixel.
fn rows(board: &Board) -> Vec<Vec<f32>> {
    let tenth = |v: f64| ((10.0 * v).round() / 10.0) as f32;
    let same_row = |a: &BoardCorner, b: &BoardCorner| a.row == b.row;
    let row = |corners: &[BoardCorner]| corners.iter().flat_map(|c| [tenth(c.pixel.x), tenth(c.pixel.y)]).collect();
    board.corners.chunk_by(same_row).map(row).collect()
}

/// The four outer corners of a whole board, going around, as shares of the picture.
fn outline(board: &Board, pattern: &Pattern, (width, height): (u32, u32)) -> Option<[f32; 8]> {
    let (columns, count) = (pattern.columns as usize, pattern.count());
    let mut shares = [0.0; 8];
    for (share, n) in shares.chunks_exact_mut(2).zip([0, columns - 1, count - 1, count - columns]) {
        let pixel = board.corners.get(n)?.pixel;
        let thousandth = |v: f64, length: u32| ((1000.0 * v / f64::from(length.max(1))).round() / 1000.0) as f32;
        share.copy_from_slice(&[thousandth(pixel.x, width), thousandth(pixel.y, height)]);
    }
    Some(shares)
}

fn now_unix_s() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs())
}

#[cfg(test)]
mod tests;
