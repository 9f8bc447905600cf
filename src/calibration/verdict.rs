//! Whether a set of views constrains a camera, in words.
//!
//! Input: a solved calibration, the pixels that its corners cover, the picture's size. Output: [`Needs`](Need), each naming a view that is
//! missing; none means that the set is good. The thresholds are those of practice: corners in the outer 15 % at
//! each side (distortion is largest there), tilts of 15 degrees about both axes (without tilt focal length and distance cannot be told apart),
//! ten views, a focal length known to 0.2 %.

use std::fmt;

use nalgebra::Vector2;

use crate::geometry::plane_calibration::PlaneCalibration;

/// Views of a good set.
pub const GOOD_VIEWS: usize = 10;
/// Cells of the coverage map.
pub const COVERAGE: (usize, usize) = (8, 6);
/// The outer share of the picture that corners must reach.
const RIM_SHARE: f64 = 0.15;
/// Degrees of tilt that are asked for, to either side together, and at the largest.
pub const TILT_DEG: f64 = 15.0;
/// Share of the coverage cells with corners.
pub const MIN_COVERED: f64 = 0.55;
/// Standard deviation of a focal length as a share of it, and of the principal point as a share of the longer side.
pub const MAX_FOCAL_SIGMA: f64 = 0.002;
pub const MAX_CENTRE_SIGMA: f64 = 0.003;

/// Something that more or other views would bring.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Need {
    /// So many views at least.
    MoreViews(usize),
    /// No corner near a side of the picture.
    Left,
    Right,
    Top,
    Bottom,
    /// Too little of the picture is covered, percent.
    Coverage(f64),
    /// The board was never turned about its vertical (left or right side nearer), degrees at the most.
    TurnSideways(f64),
    /// The board was never turned about its horizontal (top or bottom nearer), degrees at the most.
    TiltForward(f64),
    /// A focal length or the principal point is not known well enough, percent.
    Precision(f64),
    /// The distortion folds inside the picture.
    Distortion,
}

impl Need {
    /// One word for it.
    pub fn name(&self) -> &'static str {
        match self {
            Self::MoreViews(_) => "views",
            Self::Left => "left",
            Self::Right => "right",
            Self::Top => "top",
            Self::Bottom => "bottom",
            Self::Coverage(_) => "coverage",
            Self::TurnSideways(_) => "sideways",
            Self::TiltForward(_) => "forward",
            Self::Precision(_) => "precision",
            Self::Distortion => "distortion",
        }
    }

    /// What to do, for somebody who holds the board.
    pub fn advice(&self) -> String {
        match self {
            Self::MoreViews(1) => "one more view, from another side".into(),
            Self::MoreViews(n) => format!("{n} more views, each from another side"),
            Self::Left => "bring the board to the left edge of the picture".into(),
            Self::Right => "bring the board to the right edge of the picture".into(),
            Self::Top => "bring the board to the top edge of the picture".into(),
            Self::Bottom => "bring the board to the bottom edge of the picture".into(),
            Self::Coverage(_) => "bring the board to the corners of the picture, or nearer".into(),
            Self::TurnSideways(_) => "tilt the board: its left or right side nearer to the camera".into(),
            Self::TiltForward(_) => "tilt the board: its upper or lower side nearer to the camera".into(),
            Self::Precision(_) => "more views, tilted, near and filling the picture".into(),
            Self::Distortion => {
                "bring the board to the corners of the picture: the distortion there is not known".into()
            }
        }
    }
}

impl fmt::Display for Need {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::MoreViews(n) => {
                write!(f, "{} views are too few, {GOOD_VIEWS} make a set", GOOD_VIEWS.saturating_sub(*n))
            }
            Self::Left => write!(f, "no view has corners near the left edge"),
            Self::Right => write!(f, "no view has corners near the right edge"),
            Self::Top => write!(f, "no view has corners near the top edge"),
            Self::Bottom => write!(f, "no view has corners near the bottom edge"),
            Self::Coverage(percent) => write!(f, "only {percent:.0} % of the picture was covered"),
            Self::TurnSideways(deg) => {
                write!(f, "the board was turned sideways (left or right side nearer) by {deg:.0} degrees at the most")
            }
            Self::TiltForward(deg) => {
                write!(f, "the board was tilted (upper or lower side nearer) by {deg:.0} degrees at the most")
            }
            Self::Precision(percent) => write!(f, "focal length or principal point are known to {percent:.2} % only"),
            Self::Distortion => write!(f, "the distortion is not one to one up to the corners of the picture"),
        }
    }
}

/// How much of the picture the corners cover, and how the board was held.
#[derive(Debug, Clone, PartialEq)]
pub struct Verdict {
    pub needs: Vec<Need>,
    /// Corners in each cell, row by row.
    pub cells: Vec<u32>,
    /// Share of the cells with corners, percent.
    pub covered_percent: f64,
    /// Largest tilt sideways and forward, degrees.
    pub tilt_deg: [f64; 2],
}

impl Verdict {
    pub fn is_good(&self) -> bool {
        self.needs.is_empty()
    }
}

/// Corners in each cell of the [`COVERAGE`] map, row by row.
pub fn coverage<'a>(pixels: impl Iterator<Item = &'a Vector2<f64>>, (width, height): (u32, u32)) -> Vec<u32> {
    let (columns, rows) = COVERAGE;
    let mut cells = vec![0u32; columns * rows];
    let cell = |at: f64, length: u32, count: usize| {
        ((at / f64::from(length.max(1)) * count as f64).max(0.0) as usize).min(count - 1)
    };
    for p in pixels {
        cells[cell(p.y, height, rows) * columns + cell(p.x, width, columns)] += 1;
    }
    cells
}

/// How surely a camera is known: the larger standard deviation of its focal lengths as a share of them, and of the principal point as a
/// share of the longer side.
pub fn precision(solved: &PlaneCalibration, (width, height): (u32, u32)) -> (f64, f64) {
    let sigmas = solved.sigmas();
    let focal = (sigmas[0] / solved.intrinsics[0]).max(sigmas[1] / solved.intrinsics[1]);
    (focal, sigmas[2].max(sigmas[3]) / f64::from(width.max(height)))
}

/// Judges. `pixels`: the corners of the used views; `covers`: can every pixel be undistorted?
pub fn judge<'a>(
    solved: &PlaneCalibration,
    pixels: impl Iterator<Item = &'a Vector2<f64>>,
    (width, height): (u32, u32),
    covers: bool,
) -> Verdict {
    let (w, h) = (f64::from(width), f64::from(height));
    let (mut low, mut high) = (Vector2::new(w, h), Vector2::new(0.0, 0.0));
    let cells = coverage(pixels.inspect(|p| (low, high) = (low.inf(p), high.sup(p))), (width, height));
    let covered = cells.iter().filter(|c| **c > 0).count() as f64 / cells.len() as f64;
    let mut tilt = [0.0f64; 2];
    let mut used = 0;
    for view in solved.views.iter().filter(|v| v.used) {
        let normal = view.rotation.column(2);
        used += 1;
        tilt[0] = tilt[0].max(normal.x.atan2(normal.z).abs().to_degrees());
        tilt[1] = tilt[1].max(normal.y.atan2(normal.z).abs().to_degrees());
    }
    let (focal, centre) = precision(solved, (width, height));
    let all = [
        (used < GOOD_VIEWS, Need::MoreViews(GOOD_VIEWS.saturating_sub(used))),
        (tilt[0] < TILT_DEG, Need::TurnSideways(tilt[0])),
        (tilt[1] < TILT_DEG, Need::TiltForward(tilt[1])),
        (low.x > RIM_SHARE * w, Need::Left),
        (high.x < (1.0 - RIM_SHARE) * w, Need::Right),
        (low.y > RIM_SHARE * h, Need::Top),
        (high.y < (1.0 - RIM_SHARE) * h, Need::Bottom),
        (covered < MIN_COVERED, Need::Coverage(100.0 * covered)),
        (!covers, Need::Distortion),
        (focal > MAX_FOCAL_SIGMA || centre > MAX_CENTRE_SIGMA, Need::Precision(100.0 * focal.max(centre))),
    ];
    let needs = all.into_iter().filter(|(missing, _)| *missing).map(|(_, need)| need).collect();
    Verdict { needs, cells, covered_percent: 100.0 * covered, tilt_deg: tilt }
}
