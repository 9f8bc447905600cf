//! Which camera a device file is: USB vendor, product and serial number from sysfs.
//!
//! Input: `/dev/videoN`, or a link to it. Output: a [`CameraIdentity`] that stays the same wherever the camera is plugged in. A
//! camera that is not on USB is known by its card's name.

use std::path::Path;

use crate::calibration::store::CameraIdentity;

/// Folders between a video device and its USB device: the interface, then the device; a few more for odd buses.
const MAX_STEPS: usize = 6;

/// The camera's identity; `card` is what the driver calls it.
pub fn identity(device: &Path, card: &str) -> CameraIdentity {
    let name = std::fs::canonicalize(device).ok();
    let name = name.as_deref().unwrap_or(device).file_name().map(|n| n.to_string_lossy().into_owned());
    let node = Path::new("/sys/class/video4linux").join(name.unwrap_or_default()).join("device");
    usb_identity(&node).unwrap_or_else(|| CameraIdentity::new(&format!("card:{card}"), None))
}

/// The identity of the USB device that a sysfs folder belongs to.
fn usb_identity(node: &Path) -> Option<CameraIdentity> {
    let mut folder = std::fs::canonicalize(node).ok()?;
    for _ in 0..MAX_STEPS {
        let read = |key: &str| std::fs::read_to_string(folder.join(key)).ok().map(|t| t.trim().to_string());
        if let (Some(vendor), Some(product)) = (read("idVendor"), read("idProduct")) {
            let serial = read("serial").filter(|s| !is_placeholder(s));
            return Some(CameraIdentity::new(&format!("{vendor}:{product}"), serial.as_deref()));
        }
        folder = folder.parent()?.to_path_buf();
    }
    None
}

/// Makers who number nothing write the same serial into every camera.
fn is_placeholder(serial: &str) -> bool {
    let digits = serial.chars().filter(char::is_ascii_alphanumeric);
    let meaningful = digits.clone().any(|c| c != '0');
    !meaningful || matches!(serial, "123456" | "12345678" | "SN0001" | "200901010001" | "01.00.00")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_is_known_by_the_usb_device_above_its_node() {
        let dir = tempfile::tempdir().expect("folder");
        let usb = dir.path().join("1-2");
        let node = usb.join("1-2:1.0/video4linux/video0");
        std::fs::create_dir_all(&node).expect("made");
        let write = |key: &str, value: &str| std::fs::write(usb.join(key), value).expect("written");
        assert_eq!(usb_identity(&node), None);
        write("idVendor", "046d\n");
        write("idProduct", "0825\n");
        assert_eq!(usb_identity(&node).expect("found").to_string(), "046d:0825");
        write("serial", "CC2F 3F90\n");
        assert_eq!(usb_identity(&node).expect("found").to_string(), "046d:0825:CC2F_3F90");
        write("serial", "00000000\n");
        assert_eq!(usb_identity(&node).expect("found").serial, None, "that is no serial number");
        assert_eq!(identity(Path::new("/dev/no-such-video"), "vivid").to_string(), "card:vivid");
    }
}
