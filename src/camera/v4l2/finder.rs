//! Opens the camera of a run, and the same one again after it was away, whatever its node is called then.
//!
//! Input: `[camera]`. Output: an open [`V4l2Camera`]. Which one:
//! - At first the one that `device` names; with `auto` the first that can be opened, so one that another program uses is passed over.
//! - Later only the camera that was opened first, by its identity, because another lens would make nonsense of calibration and map.
//! - Of several alike (makers who number nothing) the one at the same port is taken. With `auto` else any of them; where a device is named
//!   one of them at another port only if the name leads there.
//! - A name below `/dev/v4l/by-path` is a port: only what is plugged in there will do.
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
    pub fn new(config: V4l2Config) -> Self {
        Self { config, known: None, bus: String::new() }
    }

    /// The camera, open and streaming.
    pub fn open(&mut self) -> Result<V4l2Camera, SourceError> {
        let camera = match self.known.clone() {
            None => V4l2Camera::open(&self.config)?,
            Some(known) => self.open_known(&known)?,
        };
        let found = camera.identity();
        if self.known.is_none() {
            tracing::info!(camera = %found, "this camera will be looked for when it goes away");
        }
        (self.known, self.bus) = (Some(found), camera.bus.clone());
        Ok(camera)
    }

    fn open_known(&self, known: &CameraIdentity) -> Result<V4l2Camera, SourceError> {
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
        let absent = same.is_empty();
        for (at, path) in usable(same, &self.bus, known.serial.is_some(), &Naming::of(&self.config.device)) {
            match path {
                Ok(path) => match V4l2Camera::open_device(&path, &self.config) {
                    Ok(camera) => return Ok(camera),
                    Err(e) => reasons.push(e.to_string()),
                },
                Err(path) => {
                    reasons.push(format!("{} at {at} is one like it, but not the one that is named", path.display()))
                }
            }
        }
        if absent {
            others.sort();
            others.dedup();
            let other = if others.is_empty() { String::new() } else { format!(" ({})", others.join(", ")) };
            reasons.insert(0, format!("camera {known} is not there{other}"));
        }
        Err(SourceError::Open { path: self.config.device.clone(), reason: reasons.join("; ") })
    }
}

/// How the configuration names its camera.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Naming {
    /// `auto`.
    Any,
    /// By its port; the node that the name leads to now.
    Port(Option<PathBuf>),
    /// By a node, or by what it is; the same.
    Node(Option<PathBuf>),
}

impl Naming {
    fn of(device: &str) -> Self {
        let leads_to = std::fs::canonicalize(device).ok();
        match device {
            "auto" => Self::Any,
            _ if device.contains("/by-path/") => Self::Port(leads_to),
            _ => Self::Node(leads_to),
        }
    }

    fn leads_to(&self, path: &Path) -> bool {
        matches!(self, Self::Port(Some(to)) | Self::Node(Some(to)) if to == path)
    }
}

/// Of cameras (port, node) that have the right identity those that will do, the likeliest first: at the port `bus` of last time, then the one
/// that was named, then by node. `numbered`: no other camera has this identity. An error is a node that is passed over.
fn usable(
    mut alike: Vec<(String, PathBuf)>,
    bus: &str,
    numbered: bool,
    naming: &Naming,
) -> Vec<(String, Result<PathBuf, PathBuf>)> {
    alike.sort_by_cached_key(|(at, path)| (at != bus, !naming.leads_to(path), path.clone()));
    let will_do = |at: &str, path: &Path| match naming {
        Naming::Any => true,
        Naming::Port(_) => naming.leads_to(path),
        Naming::Node(_) => numbered || at == bus || naming.leads_to(path),
    };
    alike.into_iter().map(|(at, path)| if will_do(&at, &path) { (at, Ok(path)) } else { (at, Err(path)) }).collect()
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

    const PORT: &str = "/dev/v4l/by-path/pci-0000:00:14.0-usb-0:1:1.0-video-index0";

    /// Nodes that are tried for one of two cameras alike, at usb-1 (/dev/video0) and usb-2 (/dev/video2), seen last at `bus`.
    fn tried(bus: &str, numbered: bool, naming: Naming) -> Vec<String> {
        let camera = |bus: &str, path: &str| (bus.to_string(), PathBuf::from(path));
        let alike = vec![camera("usb-2", "/dev/video2"), camera("usb-1", "/dev/video0")];
        let usable = usable(alike, bus, numbered, &naming).into_iter();
        usable.filter_map(|(_, path)| Some(path.ok()?.display().to_string())).collect()
    }

    fn to(path: &str) -> Option<PathBuf> {
        Some(path.into())
    }

    #[test]
    fn of_cameras_alike_the_port_of_last_time_comes_first_then_the_one_that_is_named() {
        assert_eq!(tried("usb-2", false, Naming::Any), ["/dev/video2", "/dev/video0"]);
        assert_eq!(tried("usb-9", false, Naming::Any), ["/dev/video0", "/dev/video2"], "moved to another port");
        assert_eq!(tried("usb-9", true, Naming::Node(to("/dev/video2"))), ["/dev/video2", "/dev/video0"]);
        assert_eq!(tried("usb-2", true, Naming::Node(to("/dev/video0"))), ["/dev/video2", "/dev/video0"], "ports stay");
    }

    #[test]
    fn a_camera_that_is_named_is_not_replaced_by_its_twin() {
        assert_eq!(tried("usb-2", false, Naming::Node(to("/dev/video2"))), ["/dev/video2"]);
        assert_eq!(tried("usb-9", false, Naming::Node(None)), [""; 0], "it is away, and these may be anybody's");
        assert_eq!(tried("usb-1", false, Naming::Node(None)), ["/dev/video0"], "at its port under another number");
        assert_eq!(
            tried("usb-9", false, Naming::Node(to("/dev/video0"))),
            ["/dev/video0"],
            "it is what the name leads to"
        );
    }

    #[test]
    fn a_port_that_is_named_is_the_only_one_even_for_a_camera_with_a_number() {
        assert_eq!(tried("usb-1", true, Naming::Port(None)), [""; 0]);
        assert_eq!(tried("usb-1", true, Naming::Port(to("/dev/video2"))), ["/dev/video2"]);
        assert_eq!((Naming::of("auto"), Naming::of(PORT)), (Naming::Any, Naming::Port(None)));
        assert_eq!(Naming::of("/dev/no-such-video"), Naming::Node(None));
    }
}
