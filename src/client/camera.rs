//! Exposure, gain and focus of the daemon's camera.

use std::time::Duration;

use super::commander::with_path;
use super::{Client, ClientError};
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
}
