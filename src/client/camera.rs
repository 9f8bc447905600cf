//! The daemon's camera: which it is, its exposure, gain and focus, and its calibration.

use std::fs::OpenOptions;
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use super::commander::with_path;
use super::{Client, ClientError};
use crate::messages::services::topic;
use crate::messages::{CameraControl, Command, CommandReply, command_kind};

impl Client {
    /// What the camera offers of exposure, gain and focus, and how each is now. The error in the inner result is a refusal: a recording and a simulated
    /// camera have none of them.
    pub fn camera_controls(&self, timeout: Duration) -> Result<Result<Vec<CameraControl>, CommandReply>, ClientError> {
        let reply = self.command(Command::new(command_kind::CAMERA_CONTROLS), timeout)?;
        // Lines of a newer daemon that are none to us are left out.
        let controls = || reply.message().lines().filter_map(|line| line.parse().ok()).collect();
        Ok(if reply.is_ok() { Ok(controls()) } else { Err(reply) })
    }

    /// Sets the control of this name to a value in its unit, or has the camera decide (`None`). It holds until the camera is opened anew.
    pub fn set_camera(
        &self,
        control: &str,
        value: Option<f64>,
        timeout: Duration,
    ) -> Result<CommandReply, ClientError> {
        let text = match value {
            Some(value) => format!("{control} {value}"),
            None => format!("{control} auto"),
        };
        self.command(with_path(command_kind::SET_CAMERA, &text)?, timeout)
    }

    /// Which camera it is: its identity, as calibrations are found by, and its device file. The error in the inner result is a refusal: a recording and a
    /// simulated camera have no identity.
    pub fn camera_identity(&self, timeout: Duration) -> Result<Result<(String, String), CommandReply>, ClientError> {
        let reply = self.command(Command::new(command_kind::CAMERA_IDENTITY), timeout)?;
        let (identity, device) = reply.message().split_once(' ').unwrap_or((reply.message(), ""));
        Ok(if reply.is_ok() { Ok((identity.into(), device.into())) } else { Err(reply) })
    }

    /// Has the daemon keep a calibration (the text of a file in our TOML) for its camera, from its next reset or start on. The text crosses in a file of
    /// shared memory's folder, as it is longer than a command; it is removed again.
    pub fn keep_calibration(&self, toml: &str, timeout: Duration) -> Result<CommandReply, ClientError> {
        let file = HandedOver::write(toml).map_err(|error| ClientError::Ipc {
            service: topic::COMMAND.into(),
            doing: "handing a calibration over in /dev/shm",
            reason: error.to_string(),
        })?;
        self.command(with_path(command_kind::KEEP_CALIBRATION, &file.path)?, timeout)
    }
}

/// What daemon and client share whatever folders each of them is shut out from: their messages cross it.
const HANDED_OVER_IN: &str = "/dev/shm";

/// A file for the daemon alone, removed when it is dropped.
struct HandedOver {
    path: String,
}

impl HandedOver {
    fn write(text: &str) -> std::io::Result<Self> {
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let number = COUNT.fetch_add(1, Ordering::Relaxed);
        let path = format!("{HANDED_OVER_IN}/cairn-calibration-{}-{number}.toml", std::process::id());
        // Never through a link or into a file that somebody else has put there.
        let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&path)?;
        let handed_over = Self { path };
        file.write_all(text.as_bytes())?;
        Ok(handed_over)
    }
}

impl Drop for HandedOver {
    fn drop(&mut self) {
        // It lies in memory until the next start of the machine at the worst.
        let _ = std::fs::remove_file(&self.path);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    #[test]
    fn what_is_handed_over_is_gone_afterwards() {
        let file = HandedOver::write("fx_px = 500.0").expect("written");
        let path = file.path.clone();
        assert_eq!(std::fs::read_to_string(&path).expect("read"), "fx_px = 500.0");
        let other = HandedOver::write("").expect("a second one beside it");
        assert_ne!(other.path, path);
        drop(file);
        assert!(!Path::new(&path).exists() && Path::new(&other.path).exists());
    }
}
