//! From the boards that were seen to a camera.
//!
//! Input: boards of one [`Pattern`] in pictures of one size. Output: [`Calibrated`]: camera model, deviations, residuals, verdict; and as a
//! [`CalibrationFile`]. Boards need not be whole. When the full distortion folds inside the picture (corners near the middle
//! only), it is solved again without k3, and the verdict asks for what is missing if that does not help.

use nalgebra::Vector2;

use super::CalibrationFile;
use super::chessboard::{Board, Pattern};
use super::store::CameraIdentity;
use super::verdict::{Verdict, judge};
use crate::geometry::CameraModel;
use crate::geometry::plane_calibration::{
    Distortion, PARAMETER_NAMES, PARAMETERS, PlaneCalibration, PlaneCalibrationError, View, calibrate,
};

/// A board and the picture that it was seen in.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardView {
    /// The picture's name, for messages.
    pub name: String,
    pub board: Board,
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
        })
        .collect();
    let mut solved = calibrate(&plane, size, distortion)?;
    let mut camera = model(&solved, size)?;
    let mut without_k3 = false;
    if distortion == Distortion::Full && !covers(&camera) {
        let simpler = calibrate(&plane, size, Distortion::RadialTangential)?;
        let simpler_camera = model(&simpler, size)?;
        // Only where k3 says nothing; a wide lens that needs it may well fold in the last pixels of a corner.
        if covers(&simpler_camera) && simpler.rms_px < 1.01 * solved.rms_px {
            (solved, camera, without_k3) = (simpler, simpler_camera, true);
        }
    }
    let pixels = plane.iter().zip(&solved.views).filter(|(_, v)| v.used).flat_map(|(p, _)| &p.pixels);
    let verdict = judge(&solved, pixels, size, covers(&camera));
    Ok(Calibrated { camera, verdict, pattern: *pattern, without_k3, solved })
}

/// Can the picture be undistorted, but for the outermost 5 % of its diagonals?
fn covers(camera: &CameraModel) -> bool {
    let (w, h) = (f64::from(camera.width) - 1.0, f64::from(camera.height) - 1.0);
    [(0.05, 0.05), (0.95, 0.05), (0.05, 0.95), (0.95, 0.95)]
        .into_iter()
        .all(|(x, y)| camera.undistort(&Vector2::new(x * w, y * h)).is_some())
}

fn model(solved: &PlaneCalibration, (width, height): (u32, u32)) -> Result<CameraModel, PlaneCalibrationError> {
    let k = &solved.intrinsics;
    CameraModel::new(width, height, k[0], k[1], k[2], k[3], [k[4], k[5], k[6], k[7], k[8]])
        .map_err(|_| PlaneCalibrationError::NoFit(solved.rms_px))
}

impl Calibrated {
    /// The file: camera, deviations, residual, and what it was made from. `unix_s`: when.
    pub fn file(&self, identity: Option<&CameraIdentity>, unix_s: u64) -> CalibrationFile {
        let mut other = toml::Table::new();
        let sigmas = self.solved.sigmas();
        for i in 0..PARAMETERS {
            let unit = if i < 4 { "_sigma_px" } else { "_sigma" };
            other.insert(format!("{}{unit}", PARAMETER_NAMES[i]), sigmas[i].into());
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
        CalibrationFile { camera: self.camera.clone(), other }
    }

    /// The parameters with their deviations, one a line.
    pub fn table(&self) -> String {
        let sigmas = self.solved.sigmas();
        let mut text = String::new();
        for i in 0..PARAMETERS {
            let (value, sigma, name) = (self.solved.intrinsics[i], sigmas[i], PARAMETER_NAMES[i]);
            text += &match (i < 4, self.solved.free[i]) {
                (true, _) => format!("  {name}  {value:10.3} +- {sigma:.3} px\n"),
                (false, true) => format!("  {name}  {value:10.5} +- {sigma:.5}\n"),
                (false, false) => format!("  {name}  {value:10.5} (held)\n"),
            };
        }
        text
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
        if v.is_good() {
            text += "  the views constrain the camera well\n";
        }
        for need in &v.needs {
            text += &format!("  missing: {need}: {}\n", need.advice());
        }
        text
    }
}
