//! Frames from anywhere through one door, [`FrameSource`].

pub mod bag;
pub mod controls;
pub mod recording;
#[cfg(feature = "tools")]
pub mod simulator;
pub mod simulator_config;
#[cfg(target_os = "linux")]
pub mod v4l2;

pub use bag::{Asked, Bag};
pub use recording::{Pacing, Recording};

use std::path::PathBuf;

use crate::calibration::store::CameraIdentity;
use crate::frame::{Clock, RawFrame};
use crate::geometry::CameraModel;
use crate::motion::wheel::{WheelFault, WheelMessage};
use controls::{Control, ControlError, ControlState, Setting};

/// What a source says of itself once it is open.
#[derive(Debug, Clone)]
pub struct SourceDescription {
    /// For logs: device and card, folder, or simulator scene and seed.
    pub name: String,
    /// Picture size if it is known before the first frame.
    pub size: Option<(u32, u32)>,
    /// Nominal frame rate, Hz, if known.
    pub rate_hz: Option<f64>,
    /// What `RawFrame::timestamp_ns` counts from.
    pub clock: Clock,
    /// The source's own calibration, if it brings one.
    pub camera: Option<CameraModel>,
    /// Number of frames, if finite and known.
    pub frames: Option<u64>,
}

/// A camera that is plugged in.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Device {
    /// As its calibrations are found by.
    pub identity: CameraIdentity,
    pub path: PathBuf,
}

/// Outcome of one [`FrameSource::grab`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Grab {
    /// `slot` holds a frame.
    Frame,
    /// Nothing came within the timeout; call again.
    TimedOut,
    /// One frame was unreadable and is skipped (counted, logged); the source goes on.
    Skipped { reason: String },
    /// The source has ended and will give no more frames.
    End,
}

/// Why a source cannot be opened or cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    #[error("{path}: {reason}")]
    Open { path: String, reason: String },
    #[error("camera {path} is gone: {reason}")]
    Gone { path: String, reason: String },
}

/// Camera, recording or simulator.
pub trait FrameSource: Send {
    /// Constant after opening.
    fn description(&self) -> &SourceDescription;

    /// Waits at most `timeout` for the next frame and copies it into `slot`, whose buffer is reused.
    /// A paced source sleeps until the frame is due; a lock-step source never waits.
    fn grab(&mut self, slot: &mut RawFrame, timeout: std::time::Duration) -> Result<Grab, SourceError>;

    /// Wheel odometry that the source brings with its frames, up to a frame's timestamp, each message once; with it what the source itself knows to
    /// be wrong with it. A camera has none.
    fn wheels(&mut self, _until_ns: i64, _to: &mut dyn FnMut(&WheelMessage, Option<WheelFault>)) {}

    /// Which camera it is; `None`: it is none, but a recording or a simulator.
    fn device(&self) -> Option<Device> {
        None
    }

    /// What of exposure, gain and focus can be set. A recording and a simulator have nothing of it.
    fn controls(&mut self) -> Result<Vec<ControlState>, ControlError> {
        Err(ControlError::NoControls(self.description().name.clone()))
    }

    /// Sets one, between two frames; what it is then. It holds until the source is opened anew.
    fn set_control(&mut self, _control: Control, _to: Setting) -> Result<ControlState, ControlError> {
        Err(ControlError::NoControls(self.description().name.clone()))
    }
}
