//! Where a calibration is written to: the file that was asked for, the place where `cairn run` finds it, the report's folder.

use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use super::args::CalibrateArgs;
use crate::atomic_file::write_atomically;
use crate::calibration::boards::Calibrated;
use crate::calibration::export::{self, Format};
use crate::calibration::store::{self, CameraIdentity};
use crate::calibration::{CalibrationError, CalibrationFile};
use crate::cli::session::{self, StatusLine};
use crate::cli::{CliError, exit_code};

pub fn write_text(path: &Path, text: &str) -> Result<(), CliError> {
    use std::io::Write;
    write_atomically(path, |out| out.write_all(text.as_bytes()))
        .map_err(|e| CliError::new(exit_code::CANNOT_CREATE, e.to_string()))
}

pub fn format_of(path: &Path) -> Option<Format> {
    match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
        "toml" => Some(Format::Cairn),
        "xml" => Some(Format::OpencvXml),
        "yaml" | "yml" => Some(Format::Ros),
        "txt" => Some(Format::Tum),
        _ => None,
    }
}

pub fn encode(file: &CalibrationFile, format: Format, name: &str) -> Result<String, CliError> {
    match format {
        Format::Cairn => file.to_toml().map_err(|e| CliError::new(exit_code::FAILURE, e.to_string())),
        other => export::write(&file.camera, other, name).map_err(|e| CliError::new(exit_code::DATA, e.to_string())),
    }
}

/// The service's state. It sees neither this user's home nor what lies there.
const SERVICE_STATE: &str = "/var/lib/cairn";

/// Writes the calibration to where it was asked for and, for a camera with an identity, to where it is found again.
pub fn save(args: &CalibrateArgs, calibrated: &Calibrated, identity: Option<&CameraIdentity>) -> Result<(), CliError> {
    let unix_s = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
    let file = calibrated.file(identity, unix_s);
    if let Some(output) = &args.output {
        let format = args.format.or_else(|| format_of(output)).unwrap_or(Format::Cairn);
        write_text(output, &encode(&file, format, &output.display().to_string())?)?;
        session::print(&format!("wrote {}\n", output.display()))?;
    }
    if let Some(identity) = identity {
        match keep(&store::state_folders(), identity, &file) {
            Ok(lines) => session::print(&lines.iter().map(|line| format!("{line}\n")).collect::<String>())?,
            Err(error) if args.output.is_none() => {
                return Err(CliError::new(exit_code::CANNOT_CREATE, error.to_string()));
            }
            Err(error) => StatusLine::new(args.quiet).note(&format!("cairn: not kept for `cairn run`: {error}")),
        }
    }
    Ok(())
}

/// Keeps a calibration where it is found by its camera's identity; what is to be said of that, a line each.
pub fn keep(
    folders: &[PathBuf],
    identity: &CameraIdentity,
    file: &CalibrationFile,
) -> Result<Vec<String>, CalibrationError> {
    let path = store::save(folders, identity, file)?;
    let shown = path.display();
    let mut lines = vec![format!("wrote {shown} (found by `cairn run` of this user for camera {identity})")];
    if Path::new(SERVICE_STATE).is_dir() && !path.starts_with(SERVICE_STATE) {
        let name = identity.file_name((file.camera.width, file.camera.height));
        lines.push(format!("the service is another user: `sudo install -D -m 0644 {shown} /etc/cairn/cameras/{name}`"));
    }
    Ok(lines)
}

/// Folder of the report, if one is wanted.
#[cfg(feature = "tools")]
pub fn report_folder(args: &CalibrateArgs) -> Option<PathBuf> {
    if args.no_report {
        return None;
    }
    args.report.clone().or_else(|| {
        let output = args.output.as_ref()?;
        let stem = output.file_stem()?.to_string_lossy().into_owned();
        Some(output.with_file_name(format!("{stem}-report")))
    })
}
