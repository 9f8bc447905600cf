//! `cairn command`: tells a running daemon to do something and prints what became of it.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use super::endpoint_args::EndpointArgs;
use super::{CliError, camera_command, exit_code};
use crate::calibration::CalibrationFile;
use crate::client::Client;
use crate::messages::{CommandReply, Transform, reply_code};

/// Tell a running daemon to reset, to save its trajectory or map, where the robot is, how its camera is to expose and focus, or its calibration
#[derive(Debug, Clone, clap::Args)]
pub struct CommandArgs {
    #[command(flatten)]
    pub endpoint: EndpointArgs,
    /// Seconds to wait for the daemon's answer
    #[arg(long, value_name = "SECONDS", default_value = "30", value_parser = clap::value_parser!(u64).range(1..=3600))]
    pub timeout: u64,
    #[command(subcommand)]
    pub action: Action,
}

/// What the daemon is to do.
#[derive(Debug, Clone, clap::Subcommand)]
pub enum Action {
    /// Drop the map and start over
    Reset,
    /// Write the trajectory so far (TUM format), as the daemon's user
    SaveTrajectory {
        /// File to write
        path: PathBuf,
    },
    /// Write the sparse map (PLY), as the daemon's user
    SaveMap {
        /// File to write
        path: PathBuf,
    },
    /// Say where the robot is now: poses and map are published accordingly from then on
    SetPose {
        /// Forward, map units
        #[arg(allow_negative_numbers = true)]
        x: f64,
        /// To the left, map units
        #[arg(allow_negative_numbers = true)]
        y: f64,
        /// Angle about the vertical, counter-clockwise from above, degrees
        #[arg(allow_negative_numbers = true)]
        yaw: f64,
    },
    /// Show or set exposure, gain and focus of its camera
    Camera(camera_command::CameraArgs),
    /// Have it keep a calibration for its camera, in use from the next reset or start on
    KeepCalibration {
        /// Calibration file of any format that `[calibration] file` takes
        path: PathBuf,
    },
}

/// Runs the subcommand.
pub fn run(args: &CommandArgs) -> Result<ExitCode, CliError> {
    let client = Client::with_endpoint(args.endpoint.endpoint()?)?;
    let timeout = Duration::from_secs(args.timeout);
    let reply = match &args.action {
        Action::Reset => client.reset(timeout)?,
        Action::SaveTrajectory { path } => client.save_trajectory(&absolute(path)?, timeout)?,
        Action::SaveMap { path } => client.save_map(&absolute(path)?, timeout)?,
        Action::KeepCalibration { path } => {
            let code = if path.is_file() { exit_code::DATA } else { exit_code::NO_INPUT };
            let file = CalibrationFile::load(path).map_err(|e| CliError::new(code, e.to_string()))?;
            let text =
                file.to_toml().map_err(|e| CliError::new(exit_code::DATA, format!("{}: {e}", path.display())))?;
            client.keep_calibration(&text, timeout)?
        }
        Action::Camera(camera) => match camera_command::run(camera, &client, timeout)? {
            Some(reply) => reply,
            None => return Ok(ExitCode::SUCCESS),
        },
        Action::SetPose { x, y, yaw } => client.set_pose(&Transform::level(*x, *y, yaw.to_radians()), timeout)?,
    };
    outcome(&reply)
}

/// What a daemon's answer means to a script; its sentence on stdout if it is done.
pub(super) fn outcome(reply: &CommandReply) -> Result<ExitCode, CliError> {
    let message = if reply.message().is_empty() { "done" } else { reply.message() };
    let code = match reply.code {
        reply_code::OK => {
            // Whoever closed stdout does not want to know.
            let _ = writeln!(std::io::stdout().lock(), "{message}");
            return Ok(ExitCode::SUCCESS);
        }
        reply_code::UNSUPPORTED | reply_code::BUSY => exit_code::UNAVAILABLE,
        reply_code::INVALID => exit_code::USAGE,
        _ => exit_code::FAILURE,
    };
    Err(CliError::new(code, format!("the daemon answered: {}", reply.message())))
}

/// The daemon has another working folder, so the path is made absolute here.
fn absolute(path: &Path) -> Result<String, CliError> {
    let absolute =
        std::path::absolute(path).map_err(|e| CliError::new(exit_code::USAGE, format!("{}: {e}", path.display())))?;
    absolute
        .into_os_string()
        .into_string()
        .map_err(|p| CliError::new(exit_code::USAGE, format!("{}: not UTF-8", p.display())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refusals_of_the_daemon_become_exit_codes() {
        let code = |reply| outcome(&CommandReply::new(reply, "why")).expect_err("refused").code;
        assert_eq!(code(reply_code::UNSUPPORTED), exit_code::UNAVAILABLE);
        assert_eq!(code(reply_code::INVALID), exit_code::USAGE);
        assert_eq!(code(reply_code::FAILED), exit_code::FAILURE);
        assert_eq!(code(4711), exit_code::FAILURE);
        assert!(outcome(&CommandReply::default()).is_ok());
    }

    #[test]
    fn paths_are_made_absolute_for_a_daemon_elsewhere() {
        let path = absolute(Path::new("map.ply")).expect("path");
        assert!(path.starts_with('/') && path.ends_with("/map.ply"), "{path}");
    }
}
