//! From the boards that were seen to a camera.
//!
//! Input: boards of one [`Pattern`] in pictures of one size. Output: [`Calibrated`]: camera model, deviations, residuals, verdict; and as a
//! [`CalibrationFile`]. Boards need not be whole. When the full distortion folds inside the picture (corners near the middle
//! only), it is solved again without k3, and the verdict asks for what is missing if that does not help. Beside the full pinhole model the
//! wide-angle one is tried, too, and where it is clearly the better one the words say so; which one is taken is for the user to choose.

use nalgebra::Vector2;

use super::CalibrationFile;
use super::chessboard::{Board, Pattern};
use super::store::CameraIdentity;
use super::verdict::{Verdict, judge};
use crate::geometry::CameraModel;
use crate::geometry::plane_calibration::{
    Distortion, MIN_POINTS, PlaneCalibration, PlaneCalibrationError, Readout, SolvedView, View, calibrate,
};

/// The picture must be one to one but for its outermost 5 %.
const BORDER: f64 = 0.05;
/// The wide-angle model is recommended if its noise is below this share of the pinhole's, and by so much, px; or if so many times more
/// corners fit it.
const WIDE_NOISE_SHARE: f64 = 0.75;
const WIDE_NOISE_PX: f64 = 0.02;
const WIDE_MORE_CORNERS: f64 = 1.1;

/// A board and the picture that it was seen in.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardView {
    /// The picture's name, for messages.
    pub name: String,
    pub board: Board,
    /// How fast each corner moved when the picture was taken, px/s; empty if nobody knows.
    pub velocity: Vec<Vector2<f64>>,
}

impl BoardView {
    /// In a picture that says nothing of movement.
    pub fn still(name: String, board: Board) -> Self {
        Self { name, board, velocity: Vec::new() }
    }

    /// What a rolling shutter does to the corners, px per second of readout time: rows below the middle one are later.
    fn shear(&self, height: u32) -> Vec<Vector2<f64>> {
        let delay = |row_px: f64| (row_px + 0.5) / f64::from(height.max(1)) - 0.5;
        self.board.corners.iter().zip(&self.velocity).map(|(c, v)| v * delay(c.pixel.y)).collect()
    }
}

/// A camera and how well it is known.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibrated {
    pub camera: CameraModel,
    pub solved: PlaneCalibration,
    pub verdict: Verdict,
    pub pattern: Pattern,
    /// k3 was asked for and had to be left out.
    pub without_k3: bool,
    /// The wide-angle model was not asked for and fits clearly better: its residual, px RMS.
    pub wide_angle_rms_px: Option<f64>,
}

/// Solves for the camera.
pub fn solve(
    views: &[BoardView],
    pattern: &Pattern,
    size: (u32, u32),
    distortion: Distortion,
) -> Result<Calibrated, PlaneCalibrationError> {
    let plane: Vec<View> = views
        .iter()
        .map(|view| View {
            plane: view
                .board
                .corners
                .iter()
                .map(|c| Vector2::new(f64::from(c.column), f64::from(c.row)) * pattern.square_m)
                .collect(),
            pixels: view.board.corners.iter().map(|c| c.pixel).collect(),
            shear: view.shear(size.1),
        })
        .collect();
    let wide = match distortion {
        Distortion::Full => calibrate(&plane, size, Distortion::KannalaBrandt).ok(),
        _ => None,
    };
    let mut solved = match calibrate(&plane, size, distortion) {
        Ok(solved) => solved,
        Err(PlaneCalibrationError::TooFewViews(n)) => return Err(PlaneCalibrationError::TooFewViews(n)),
        Err(error) => return Err(wide.map_or(error, |wide| PlaneCalibrationError::NoPinhole(wide.rms_px))),
    };
    let mut camera = model(&solved, size)?;
    let mut without_k3 = false;
    if distortion == Distortion::Full && !camera.covers(BORDER) {
        let simpler = calibrate(&plane, size, Distortion::RadialTangential)?;
        let simpler_camera = model(&simpler, size)?;
        // Only where k3 says nothing; a wide lens that needs it may well fold in the last pixels of a corner.
        if simpler_camera.covers(BORDER) && simpler.rms_px < 1.01 * solved.rms_px {
            (solved, camera, without_k3) = (simpler, simpler_camera, true);
        }
    }
    let pixels = plane.iter().zip(&solved.views).filter(|(_, v)| v.used).flat_map(|(p, _)| &p.pixels);
    let verdict = judge(&solved, pixels, size, camera.covers(BORDER));
    let wide_angle_rms_px = wide.filter(|wide| is_better(wide, &solved)).map(|wide| wide.rms_px);
    Ok(Calibrated { camera, verdict, pattern: *pattern, without_k3, wide_angle_rms_px, solved })
}

/// Is the wide-angle camera clearly the better one? A pinhole may only look good because it left corners out.
fn is_better(wide: &PlaneCalibration, pinhole: &PlaneCalibration) -> bool {
    let less_noise =
        wide.sigma_px < WIDE_NOISE_SHARE * pinhole.sigma_px && wide.sigma_px + WIDE_NOISE_PX < pinhole.sigma_px;
    let corners = |c: &PlaneCalibration| c.used_points() as f64;
    let more_corners =
        corners(wide) > WIDE_MORE_CORNERS * corners(pinhole) && wide.sigma_px < WIDE_MORE_CORNERS * pinhole.sigma_px;
    (less_noise && corners(wide) > 0.98 * corners(pinhole)) || more_corners
}

fn model(solved: &PlaneCalibration, (width, height): (u32, u32)) -> Result<CameraModel, PlaneCalibrationError> {
    let k = &solved.intrinsics;
    CameraModel::new(width, height, k[0], k[1], k[2], k[3], solved.lens_model())
        .map_err(|_| PlaneCalibrationError::NoFit(solved.rms_px))
}

impl Calibrated {
    /// The file: camera, deviations, residual, and what it was made from. `unix_s`: when.
    pub fn file(&self, identity: Option<&CameraIdentity>, unix_s: u64) -> CalibrationFile {
        let mut other = toml::Table::new();
        let sigmas = self.solved.sigmas();
        for (i, name) in self.solved.lens.parameter_names().iter().enumerate() {
            let unit = if i < 4 { "_sigma_px" } else { "_sigma" };
            other.insert(format!("{name}{unit}"), sigmas[i].into());
        }
        if let Some(readout) = self.solved.readout.filter(Readout::is_shown) {
            other.insert("readout_ms".into(), (1e3 * readout.seconds).into());
            other.insert("readout_sigma_ms".into(), (1e3 * readout.sigma_s).into());
        }
        other.insert("rms_px".into(), self.solved.rms_px.into());
        other.insert("corner_sigma_px".into(), self.solved.sigma_px.into());
        let used = self.solved.views.iter().filter(|v| v.used);
        other.insert("views".into(), (used.clone().count() as i64).into());
        other.insert("corners".into(), (used.map(|v| v.residuals.len()).sum::<usize>() as i64).into());
        other.insert("pattern".into(), format!("{}x{}", self.pattern.columns, self.pattern.rows).into());
        other.insert("square_m".into(), self.pattern.square_m.into());
        other.insert("coverage_percent".into(), self.verdict.covered_percent.into());
        let needs: Vec<toml::Value> = self.verdict.needs.iter().map(|n| n.to_string().into()).collect();
        other.insert("missing".into(), needs.into());
        other.insert("calibrated_unix_s".into(), i64::try_from(unix_s).unwrap_or(i64::MAX).into());
        if let Some(identity) = identity {
            other.insert("camera".into(), identity.to_string().into());
        }
        CalibrationFile { camera: self.camera.clone(), other, assumed: None }
    }

    /// The parameters with their deviations, one a line.
    pub fn table(&self) -> String {
        let sigmas = self.solved.sigmas();
        let mut text = String::new();
        for (i, name) in self.solved.lens.parameter_names().iter().enumerate() {
            let (value, sigma) = (self.solved.intrinsics[i], sigmas[i]);
            text += &match (i < 4, self.solved.free[i]) {
                (true, _) => format!("  {name}  {value:10.3} +- {sigma:.3} px\n"),
                (false, true) => format!("  {name}  {value:10.5} +- {sigma:.5}\n"),
                (false, false) => format!("  {name}  {value:10.5} (held)\n"),
            };
        }
        text
    }

    /// A view in words: its residual, or why it was left out.
    pub fn view_words(&self, view: &SolvedView) -> String {
        if view.used && view.used_points.contains(&true) {
            return format!("{:.3} px RMS", view.rms_px);
        }
        match view.residuals.len() {
            n if n < MIN_POINTS => format!("left out: {n} corners are too few, {MIN_POINTS} are needed"),
            _ if !view.rms_px.is_finite() => {
                "left out: its corners fix no pose of a board in front of the camera".into()
            }
            _ => format!(
                "left out: it does not fit the other views, {:.3} px RMS where all of them have {:.3} px",
                view.rms_px, self.solved.rms_px
            ),
        }
    }

    /// Quality in words, one statement a line.
    pub fn words(&self) -> String {
        let v = &self.verdict;
        let mut text = format!(
            "  residual {:.3} px RMS; {:.0} % of the picture covered; turned up to {:.0} degrees sideways, {:.0} forward\n",
            self.solved.rms_px, v.covered_percent, v.tilt_deg[0], v.tilt_deg[1]
        );
        if self.without_k3 {
            text += "  k3 was left out: with it the distortion folded inside the picture\n";
        }
        if let Some(rms_px) = self.wide_angle_rms_px {
            text += &format!(
                "  a wide-angle lens model fits these views clearly better ({rms_px:.3} px RMS): calibrate with --distortion fisheye\n"
            );
        }
        if let Some(readout) = self.solved.readout.filter(Readout::is_shown) {
            text += &format!(
                "  the shutter's readout takes {:.1} +- {:.1} ms, as the moving board shows it\n",
                1e3 * readout.seconds,
                1e3 * readout.sigma_s
            );
        }
        if v.is_good() {
            text += "  the views constrain the camera well\n";
        }
        for need in &v.needs {
            text += &format!("  missing: {need}: {}\n", need.advice());
        }
        text
    }
}

#[cfg(all(test, feature = "tools"))]
mod tests;
