//! A webcam by Video4Linux2 as a [`FrameSource`].
//!
//! Input: a capture device with single-planar streaming (what USB webcams are). Output: GREY in the slot for cameras that
//! give GREY or YUYV (its luma is picked out while copying from the driver's buffer: the only copy), or the JPEG's bytes for
//! motion JPEG. Timestamps are the driver's where they count CLOCK_MONOTONIC, which is when the frame's first data came
//! (uvcvideo); else the moment of arrival.
//!
//! The rooms: [`negotiate`] ranks what a camera offers, [`device`] and [`queue`] speak to the kernel (the only `unsafe`), [`capture`] decides
//! what a buffer means, behind a trait of three functions so that its tests need no camera; [`controls`] sets focus, exposure and
//! the like, and [`adjust`] what somebody asks for while it streams; [`finder`] finds a camera again that was away.
//!
//! A camera that is unplugged is [`SourceError::Gone`]; the caller opens another `V4l2Camera` when it likes. Dropping
//! one stops the stream and gives the buffers back.
//!
//! # Tried on
//! In a virtual machine on the kernel's own drivers, by `tests/vm/run` (its results: `tests/results/faults.md`): vivid with each injected
//! error, unbound and bound; uvcvideo with a USB camera in software (motion JPEG, YUYV, controls, unplugged while it streams, other
//! node numbers, broken and missing frames). By hand: v4l2loopback (whose first frame is number 0 whatever was written before, so
//! that one gap shows), vivid's 35 ms of lead, a process stopped for two seconds. *Not tried:* a camera of glass and plastic; the
//! way back to the next format when the USB bus is full; ARM.
//!
//! Cost: 0.03 ms of copying a frame of 640x480; nothing is allocated per frame once the slot has grown.
//!
//! Deliberately not here: multi-planar devices, raw Bayer sensors, other pixel formats, an exposure control of our own.

pub mod adjust;
pub mod capture;
mod config;
pub mod controls;
pub mod device;
pub mod finder;
pub mod identity;
pub mod negotiate;
pub mod queue;

pub use config::{FormatPreference, PowerLine, V4l2Config};
pub use finder::Finder;

use super::controls::{Control, ControlError, ControlState, Setting};
use super::{FrameSource, Grab, SourceDescription, SourceError};
use crate::calibration::store::CameraIdentity;
use crate::frame::{Clock, PixelFormat, RawFrame};
use capture::{Capture, Layout};
use device::{CallError, Device};
use negotiate::{CameraFormat, Choice, Offer, ranked};
use queue::MmapQueue;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Formats that are tried before a camera is given up.
const MAX_ATTEMPTS: usize = 6;

/// A capture device of this machine.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraInfo {
    pub path: PathBuf,
    /// The maker's name of it.
    pub card: String,
    pub driver: String,
    /// Where it is plugged in.
    pub bus: String,
    /// What it can send that we can use: size and rates. Empty if nothing.
    pub offers: Vec<Offer>,
}

impl CameraInfo {
    /// Size of the pictures that it will send when it is asked for what the config wants: that of the best choice, px.
    pub fn picture_size(&self, config: &V4l2Config) -> (u32, u32) {
        ranked(&self.offers, config).first().map_or((config.width_px, config.height_px), |c| (c.width, c.height))
    }
}

/// Every capture device that can be opened, by number, and for the others why not. `wanted`: the size that is asked for, where a
/// camera has a range of them.
pub fn list_cameras(wanted: &V4l2Config) -> Vec<Result<CameraInfo, SourceError>> {
    device_files().iter().filter_map(|path| inspect(path, wanted).transpose()).collect()
}

/// Of all cameras those that the configuration means, in the order in which they are tried: the one that it names, or with `auto` every one
/// that sends something usable.
pub fn meant<'a>(config: &V4l2Config, cameras: impl Iterator<Item = &'a CameraInfo>) -> Vec<&'a CameraInfo> {
    let named = std::fs::canonicalize(&config.device).unwrap_or_else(|_| config.device.clone().into());
    cameras.filter(|c| if config.device == "auto" { !c.offers.is_empty() } else { c.path == named }).collect()
}

/// `/dev/videoN` by number.
fn device_files() -> Vec<PathBuf> {
    let number = |path: &PathBuf| path.file_name()?.to_str()?.strip_prefix("video")?.parse::<u32>().ok();
    let Ok(entries) = std::fs::read_dir("/dev") else { return Vec::new() };
    let mut files: Vec<(u32, PathBuf)> =
        entries.flatten().map(|e| e.path()).filter_map(|path| Some((number(&path)?, path))).collect();
    files.sort();
    files.into_iter().map(|(_, path)| path).collect()
}

/// `None` for a device that is no camera (a codec, metadata, an output).
fn inspect(path: &Path, wanted: &V4l2Config) -> Result<Option<CameraInfo>, SourceError> {
    let failed = |e: io::Error| open_error(path, &e);
    let device = Device::open(path).map_err(failed)?;
    let capability = device.capability().map_err(failed)?;
    if !capability.captures {
        return Ok(None);
    }
    let offers = device.offers(wanted.width_px, wanted.height_px);
    let device::Capability { card, driver, bus, .. } = capability;
    Ok(Some(CameraInfo { path: path.into(), card, driver, bus, offers }))
}

fn open_error(path: &Path, error: &io::Error) -> SourceError {
    SourceError::Open { path: path.display().to_string(), reason: format!("{error}{}", hint(error)) }
}

/// What to do about it.
fn hint(error: &io::Error) -> &'static str {
    match error.raw_os_error() {
        Some(libc::EACCES | libc::EPERM) => " (may this user use it? cameras belong to the group 'video')",
        Some(libc::EBUSY) => " (another program uses it)",
        Some(libc::ENOTTY) => " (this is no Video4Linux device)",
        Some(libc::ENOSPC) => " (the usb bus has no bandwidth left for it)",
        _ => "",
    }
}

/// An open camera, streaming.
pub struct V4l2Camera {
    description: SourceDescription,
    capture: Capture<MmapQueue>,
    lock: controls::Lock,
    path: PathBuf,
    card: String,
    bus: String,
}

impl V4l2Camera {
    /// Which camera it is, wherever it is plugged in.
    pub fn identity(&self) -> CameraIdentity {
        identity::identity(&self.path, &self.card)
    }

    /// Its node.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Opens the camera that the config names, or the first one that works.
    pub fn open(config: &V4l2Config) -> Result<Self, SourceError> {
        let invalid = |(key, reason): (&str, String)| SourceError::Open {
            path: config.device.clone(),
            reason: format!("camera.{key} {reason}"),
        };
        config.validate().map_err(invalid)?;
        if config.device != "auto" {
            return Self::open_device(Path::new(&config.device), config);
        }
        let mut reasons = Vec::new();
        for path in device_files() {
            match inspect(&path, config) {
                Ok(Some(_)) => match Self::open_device(&path, config) {
                    Ok(camera) => {
                        if !reasons.is_empty() {
                            tracing::warn!(reason = reasons.join("; "), taken = %path.display(), "cameras passed over");
                        }
                        return Ok(camera);
                    }
                    Err(e) => reasons.push(e.to_string()),
                },
                Ok(None) => {}
                Err(e) => reasons.push(e.to_string()),
            }
        }
        if reasons.is_empty() {
            reasons.push("there is no camera: no /dev/video* that captures".into());
        }
        Err(SourceError::Open { path: "auto".into(), reason: reasons.join("; ") })
    }

    fn open_device(path: &Path, config: &V4l2Config) -> Result<Self, SourceError> {
        let failed = |e: io::Error| open_error(path, &e);
        let unusable = |reason: String| SourceError::Open { path: path.display().to_string(), reason };
        let device = Device::open(path).map_err(failed)?;
        let capability = device.capability().map_err(failed)?;
        if !capability.captures {
            return Err(unusable(format!("{} does not capture video by streaming", capability.card)));
        }
        let offers = device.offers(config.width_px, config.height_px);
        let choices = ranked(&offers, config);
        if choices.is_empty() {
            return Err(unusable(format!(
                "{} sends nothing usable: needed is {}, offered is {}",
                capability.card,
                match config.format {
                    FormatPreference::Auto => "GREY, YUYV or MJPEG".into(),
                    one => format!("{one:?}").to_uppercase(),
                },
                device.format_names()
            )));
        }
        let mut device = Some(device);
        let mut failure = String::new();
        for choice in choices.iter().take(MAX_ATTEMPTS) {
            // A failed stream may leave a driver holding buffers; a fresh descriptor does not.
            let fresh = match device.take() {
                Some(device) => device,
                None => Device::open(path).map_err(failed)?,
            };
            match start(fresh, choice, config) {
                Ok((queue, layout, rate_hz)) => {
                    return Ok(Self::describe(path, &capability, choice, config, queue, layout, rate_hz));
                }
                Err(e) => {
                    failure = format!("{choice}: {e}{}", hint(&e.error));
                    // Only if the USB bus has no room for this format may the next one, which needs less, do better.
                    if e.error.raw_os_error() != Some(libc::ENOSPC) {
                        break;
                    }
                    tracing::warn!(device = %path.display(), format = %choice, "no usb bandwidth for this format");
                }
            }
        }
        Err(unusable(failure))
    }

    fn describe(
        path: &Path,
        capability: &device::Capability,
        choice: &Choice,
        config: &V4l2Config,
        queue: MmapQueue,
        layout: Layout,
        rate_hz: Option<f64>,
    ) -> Self {
        let (width, height) = (layout.width, layout.height);
        if (width, height) != (config.width_px, config.height_px) {
            tracing::warn!(device = %path.display(), width_px = width, height_px = height, "camera sends another size than asked");
        }
        let rate = rate_hz.map_or("unknown".into(), |r| format!("{r:.3}"));
        let card = &capability.card;
        let name = format!("{card} at {}, {} {width}x{height}, {rate} Hz", path.display(), choice.format);
        let description = SourceDescription {
            name,
            size: Some((width, height)),
            rate_hz,
            clock: Clock::Monotonic,
            camera: None,
            frames: None,
        };
        Self {
            description,
            capture: Capture::new(queue, layout, path.display().to_string()),
            lock: controls::Lock::new(config),
            path: path.into(),
            card: card.clone(),
            bus: capability.bus.clone(),
        }
    }
}

/// Sets format, controls and rate and starts the stream; also what was granted.
fn start(device: Device, choice: &Choice, config: &V4l2Config) -> Result<(MmapQueue, Layout, Option<f64>), CallError> {
    // First the format, which a driver refuses while another process streams: controls are the device's and not the descriptor's, so
    // setting them on somebody else's camera would undo its focus and its locked exposure.
    let granted = device.set_format(choice)?;
    controls::prepare(&device, config);
    let rate_hz = device.set_rate(choice);
    let format = match choice.format {
        CameraFormat::Grey => PixelFormat::Grey,
        CameraFormat::Yuyv => PixelFormat::Yuyv,
        CameraFormat::Mjpeg => PixelFormat::Jpeg,
    };
    let layout = Layout { format, width: granted.width, height: granted.height, stride: granted.stride };
    Ok((MmapQueue::start(device, config.buffers)?, layout, rate_hz))
}

impl FrameSource for V4l2Camera {
    fn description(&self) -> &SourceDescription {
        &self.description
    }

    fn device(&self) -> Option<super::Device> {
        Some(super::Device { identity: self.identity(), path: self.path.clone() })
    }

    fn grab(&mut self, slot: &mut RawFrame, timeout: Duration) -> Result<Grab, SourceError> {
        let grab = self.capture.grab(slot, timeout)?;
        if grab == Grab::Frame {
            self.lock.frame(self.capture.queue().device(), slot.arrival_ns);
        }
        Ok(grab)
    }

    fn controls(&mut self) -> Result<Vec<ControlState>, ControlError> {
        let offered = adjust::offered(self.capture.queue().device())?;
        if offered.is_empty() { Err(ControlError::NoControls(self.card.clone())) } else { Ok(offered) }
    }

    fn set_control(&mut self, control: Control, to: Setting) -> Result<ControlState, ControlError> {
        let set = adjust::set(self.capture.queue().device(), control, to)?;
        self.lock.give_up();
        Ok(set)
    }
}

#[cfg(test)]
mod tests;
