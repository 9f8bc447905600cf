//! What `cairn calibrate` is asked.

use std::path::PathBuf;

use crate::calibration::export::Format;
use crate::cli::session::{QuietArgs, SessionArgs};
use crate::geometry::plane_calibration::{Distortion, LensKind};

/// Calibrate a camera with a chessboard: from pictures, or live; print the board; convert calibration files
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  cairn calibrate --print-pattern 9x6 --square 0.025 --output board.svg
  cairn calibrate --camera auto --pattern 9x6 --square 0.025
  cairn calibrate images/*.jpg --pattern 9x6 --square 0.025 --output camera.toml
  cairn calibrate images/*.jpg --distortion fisheye --output camera.toml
  cairn calibrate --convert camera.toml --format ros --output camera_info.yaml")]
pub struct CalibrateArgs {
    /// Pictures of the board (JPEG or PNG), all of one size
    #[arg(value_name = "PICTURE", conflicts_with_all = ["camera", "convert", "print_pattern"])]
    pub pictures: Vec<PathBuf>,
    /// Calibrate live: "auto", a device such as /dev/video0, or "simulator"
    #[arg(long, value_name = "DEVICE", conflicts_with_all = ["convert", "print_pattern"])]
    pub camera: Option<String>,
    /// Inner corners of the board, a row x a column
    #[arg(long, value_name = "COLUMNSxROWS", default_value = "9x6", value_parser = parse_pair)]
    pub pattern: (u32, u32),
    /// Side of a square, m
    #[arg(long, value_name = "METRES", default_value_t = 0.025)]
    pub square: f64,
    /// File to write; live without it: the state folder, where `cairn run` finds it by the camera's identity
    #[arg(long, short, value_name = "FILE")]
    pub output: Option<PathBuf>,
    /// Folder for pictures of corners, residuals and coverage [default: the output's name and "-report"; in the robot's build none]
    #[arg(long, value_name = "DIR")]
    pub report: Option<PathBuf>,
    /// Write no report
    #[arg(long, conflicts_with = "report")]
    pub no_report: bool,
    /// Distortion coefficients to estimate; "fisheye" for a wide-angle lens
    #[arg(long, value_enum, default_value = "full")]
    pub distortion: DistortionChoice,
    /// Live: give up after this time, s
    #[arg(long, default_value_t = 300, value_parser = clap::value_parser!(u64).range(5..=7200))]
    pub seconds: u64,
    /// Live on the simulator: do not wait for its clock
    #[arg(long)]
    pub lockstep: bool,
    /// Write a board of this size as SVG to print
    #[arg(long, value_name = "COLUMNSxROWS", value_parser = parse_pair, conflicts_with = "convert")]
    pub print_pattern: Option<(u32, u32)>,
    /// Calibration file to convert (any known format)
    #[arg(long, value_name = "FILE")]
    pub convert: Option<PathBuf>,
    /// Format of the output
    #[arg(long, value_enum)]
    pub format: Option<Format>,
    /// Picture size, for a file to convert that does not say it
    #[arg(long, value_name = "WIDTHxHEIGHT", value_parser = parse_pair)]
    pub size: Option<(u32, u32)>,
    /// Lens model of the coefficients, for a file to convert that does not say it
    #[arg(long, value_name = "radial_tangential|kannala_brandt", requires = "convert")]
    pub lens_model: Option<LensKind>,
    #[command(flatten)]
    pub quiet: QuietArgs,
    #[command(flatten)]
    pub session: SessionArgs,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum DistortionChoice {
    /// None
    None,
    /// k1 k2
    Radial,
    /// k1 k2 p1 p2
    RadialTangential,
    /// k1 k2 p1 p2 k3
    Full,
    /// k1 k2 k3 k4 of the wide-angle model (Kannala-Brandt; OpenCV's fisheye, equidistant of ROS and Kalibr)
    #[value(alias = "kannala-brandt")]
    Fisheye,
}

impl From<DistortionChoice> for Distortion {
    fn from(choice: DistortionChoice) -> Self {
        match choice {
            DistortionChoice::None => Self::None,
            DistortionChoice::Radial => Self::Radial,
            DistortionChoice::RadialTangential => Self::RadialTangential,
            DistortionChoice::Full => Self::Full,
            DistortionChoice::Fisheye => Self::KannalaBrandt,
        }
    }
}

fn parse_pair(text: &str) -> Result<(u32, u32), String> {
    let parsed = text.split_once('x').and_then(|(a, b)| Some((a.parse().ok()?, b.parse().ok()?)));
    parsed.ok_or_else(|| format!("`{text}` is not two whole numbers with an x between, as in 9x6"))
}
