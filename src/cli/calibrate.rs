//! `cairn calibrate`: a camera's calibration from pictures or live, the board to print, and other programs' formats.
//!
//! `pictures` and `live` collect boards; `report` writes what they rest on.

mod live;
mod pictures;
mod report;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{SystemTime, UNIX_EPOCH};

use super::session::{self, SessionArgs};
use super::{CliError, exit_code};
use crate::atomic_file::write_atomically;
use crate::calibration::boards::Calibrated;
use crate::calibration::chessboard::Pattern;
use crate::calibration::foreign::{self, Format};
use crate::calibration::store::{self, CameraIdentity};
use crate::calibration::{CalibrationFile, Unsaid, pattern_sheet};
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
    /// Folder for pictures of corners, residuals and coverage [default: the output's name and "-report"]
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

pub fn run(args: &CalibrateArgs) -> Result<ExitCode, CliError> {
    if let Some(input) = &args.convert {
        return convert(args, input);
    }
    let (columns, rows) = args.print_pattern.unwrap_or(args.pattern);
    let pattern = Pattern::new(columns, rows, args.square).map_err(usage)?;
    if args.print_pattern.is_some() {
        let output = args.output.clone().unwrap_or_else(|| format!("board-{columns}x{rows}.svg").into());
        write_text(&output, &pattern_sheet::svg(&pattern))?;
        session::print(&format!("{} ({})\n", output.display(), pattern_sheet::paper(&pattern)))?;
        return Ok(ExitCode::SUCCESS);
    }
    if args.camera.is_some() {
        return live::run(args, &pattern);
    }
    if args.pictures.is_empty() {
        return Err(usage("nothing to calibrate from: give pictures, or --camera auto".into()));
    }
    pictures::run(args, &pattern)
}

fn usage(message: String) -> CliError {
    CliError::new(exit_code::USAGE, message)
}

fn write_text(path: &Path, text: &str) -> Result<(), CliError> {
    use std::io::Write;
    write_atomically(path, |out| out.write_all(text.as_bytes()))
        .map_err(|e| CliError::new(exit_code::CANNOT_CREATE, e.to_string()))
}

fn convert(args: &CalibrateArgs, input: &Path) -> Result<ExitCode, CliError> {
    let unsaid = Unsaid { size: args.size, lens: args.lens_model };
    let file = CalibrationFile::load_with(input, &unsaid).map_err(|e| {
        let code = if input.exists() { exit_code::DATA } else { exit_code::NO_INPUT };
        CliError::new(code, e.to_string())
    })?;
    if let Some(assumed) = &file.assumed {
        eprintln!("cairn: {assumed}");
    }
    let format = args.format.or_else(|| args.output.as_deref().and_then(format_of)).unwrap_or(Format::Cairn);
    let name = args.output.as_deref().map_or("the output".into(), |o| o.display().to_string());
    let text = encode(&file, format, &name)?;
    match &args.output {
        Some(output) => {
            write_text(output, &text)?;
            session::print(&format!("{}\n", output.display()))?;
        }
        None => session::print(&text)?,
    }
    Ok(ExitCode::SUCCESS)
}

/// What a file's name stands for.
fn format_of(path: &Path) -> Option<Format> {
    match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
        "toml" => Some(Format::Cairn),
        "xml" => Some(Format::OpencvXml),
        "yaml" | "yml" => Some(Format::Ros),
        "txt" => Some(Format::Tum),
        _ => None,
    }
}

fn encode(file: &CalibrationFile, format: Format, name: &str) -> Result<String, CliError> {
    match format {
        Format::Cairn => file.to_toml().map_err(|e| CliError::new(exit_code::FAILURE, e.to_string())),
        other => foreign::write(&file.camera, other, name).map_err(|e| CliError::new(exit_code::DATA, e.to_string())),
    }
}

/// The service's state. It sees neither this user's home nor what lies there.
const SERVICE_STATE: &str = "/var/lib/cairn";

/// Writes the calibration to where it was asked for and, for a camera with an identity, to where it is found again.
fn save(args: &CalibrateArgs, calibrated: &Calibrated, identity: Option<&CameraIdentity>) -> Result<(), CliError> {
    let unix_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
    let file = calibrated.file(identity, unix_s);
    if let Some(output) = &args.output {
        let format = args.format.or_else(|| format_of(output)).unwrap_or(Format::Cairn);
        write_text(output, &encode(&file, format, &output.display().to_string())?)?;
        session::print(&format!("wrote {}\n", output.display()))?;
    }
    if let Some(identity) = identity {
        match store::save(&store::state_folders(), identity, &file) {
            Ok(path) => {
                let shown = path.display();
                session::print(&format!("wrote {shown} (found by `cairn run` of this user for camera {identity})\n"))?;
                if Path::new(SERVICE_STATE).is_dir() && !path.starts_with(SERVICE_STATE) {
                    let name = identity.file_name((file.camera.width, file.camera.height));
                    session::print(&format!(
                        "the service is another user: `sudo install -D -m 0644 {shown} /etc/cairn/cameras/{name}`\n"
                    ))?;
                }
            }
            Err(error) if args.output.is_none() => {
                return Err(CliError::new(exit_code::CANNOT_CREATE, error.to_string()));
            }
            Err(error) => eprintln!("cairn: not kept for `cairn run`: {error}"),
        }
    }
    Ok(())
}

/// Folder of the report, if one is wanted.
fn report_folder(args: &CalibrateArgs) -> Option<PathBuf> {
    if args.no_report {
        return None;
    }
    args.report.clone().or_else(|| {
        let output = args.output.as_ref()?;
        let stem = output.file_stem()?.to_string_lossy().into_owned();
        Some(output.with_file_name(format!("{stem}-report")))
    })
}

#[cfg(test)]
mod tests;
