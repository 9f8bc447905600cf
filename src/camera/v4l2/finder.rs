//! Opens the camera of a run, and the same one again after it was away, whatever its node is called then.
//!
//! Input: `[camera]`, and the identity that a stored calibration belongs to, if one was chosen by it. Output: an open
//! [`V4l2Camera`]. The first that is opened is remembered by its identity; later only a camera with that identity is opened,
//! because another lens would make nonsense of calibration and map. Of several alike (makers who number nothing) the one at the
//! same port is taken, else the one that `[camera]` names, else the one that works.
//!
//! Cost: opening every video node to ask what it is, and looking at sysfs; a millisecond for a few nodes.

use super::identity::identity;
use super::{Device, SourceError, V4l2Camera, V4l2Config, device_files};
use crate::calibration::store::CameraIdentity;
use std::path::{Path, PathBuf};

/// Finds one camera again and again.
pub struct Finder {
    config: V4l2Config,
    known: Option<CameraIdentity>,
    /// Where it was plugged in.
    bus: String,
}

impl Finder {
    /// `known`: only this camera will do, from the start.
    pub fn new(config: V4l2Config, known: Option<CameraIdentity>) -> Self {
        Self { config, known, bus: String::new() }
    }

    /// The camera, open and streaming.
    pub fn open(&mut self) -> Result<V4l2Camera, SourceError> {
        let camera = match self.known.clone() {
            None => V4l2Camera::open(&self.config)?,
            Some(known) => self.open_known(&known)?,
        };
        let found = identity(&camera.path, &camera.card);
        if self.known.is_none() {
            tracing::info!(camera = %found, "this camera will be looked for when it goes away");
        }
        (self.known, self.bus) = (Some(found), camera.bus.clone());
        Ok(camera)
    }

    fn open_known(&self, known: &CameraIdentity) -> Result<V4l2Camera, SourceError> {
        // Where a link such as /dev/v4l/by-path/... leads now.
        let named = std::fs::canonicalize(&self.config.device).ok();
        let mut reasons = Vec::new();
        let mut others = Vec::new();
        let mut same = Vec::new();
        for path in device_files() {
            match who(&path) {
                Ok(Some((it, bus))) if it == *known => same.push((bus, path)),
                Ok(Some((it, _))) => others.push(format!("{} is {it}", path.display())),
                Ok(None) => {}
                Err(e) => reasons.push(e.to_string()),
            }
        }
        likeliest_first(&mut same, &self.bus, named.as_deref());
        for (_, path) in &same {
            match V4l2Camera::open_device(path, &self.config) {
                Ok(camera) => return Ok(camera),
                Err(e) => reasons.push(e.to_string()),
            }
        }
        if same.is_empty() {
            others.sort();
            others.dedup();
            let other = if others.is_empty() { String::new() } else { format!(" ({})", others.join(", ")) };
            reasons.insert(0, format!("camera {known} is not there{other}"));
        }
        Err(SourceError::Open { path: self.config.device.clone(), reason: reasons.join("; ") })
    }
}

/// Orders cameras (port, node) that are alike: at the port of last time, then the one that was named, then by node.
fn likeliest_first(alike: &mut [(String, PathBuf)], bus: &str, named: Option<&Path>) {
    alike.sort_by_cached_key(|(at, path)| (at != bus, named != Some(path.as_path()), path.clone()));
}

/// Identity and port of a camera; `None` for what is no camera.
fn who(path: &PathBuf) -> Result<Option<(CameraIdentity, String)>, SourceError> {
    let failed = |e: std::io::Error| super::open_error(Path::new(path), &e);
    let device = Device::open(path).map_err(failed)?;
    let capability = device.capability().map_err(failed)?;
    Ok(capability.captures.then(|| (identity(path, &capability.card), capability.bus)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_two_cameras_alike_the_port_of_last_time_counts_and_before_there_is_one_the_configured_node() {
        let first = |bus: &str, named: Option<&str>| {
            let camera = |bus: &str, path: &str| (bus.to_string(), PathBuf::from(path));
            let mut alike = [camera("usb-2", "/dev/video2"), camera("usb-1", "/dev/video0")];
            likeliest_first(&mut alike, bus, named.map(Path::new));
            alike[0].1.display().to_string()
        };
        assert_eq!(first("", Some("/dev/video2")), "/dev/video2", "not the twin of another daemon");
        assert_eq!(first("", None), "/dev/video0");
        assert_eq!(first("usb-2", Some("/dev/video0")), "/dev/video2", "nodes are given anew, ports stay");
        assert_eq!(first("usb-9", Some("/dev/video2")), "/dev/video2");
    }
}
