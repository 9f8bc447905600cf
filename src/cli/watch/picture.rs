//! One picture of the running daemon's camera as a file, and its K: what `cairn twoview` starts from.

use std::fmt::Write as _;
use std::io::Write;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crate::atomic_file::write_atomically;
use crate::cli::{CliError, exit_code};
use crate::client::{Client, Frame, Subscription, Topic};
use crate::messages::{ENCODED_GREY, EncodedHeader, Health, LENS_RADIAL_TANGENTIAL};
use crate::share::compressed;

/// Health comes ten times a second.
const HEALTH_TIME: Duration = Duration::from_secs(3);

/// How soon a signal is noticed while nothing comes.
const NAP: Duration = Duration::from_millis(100);

/// What is asked for.
pub struct Wanted<'a> {
    /// Where the picture goes, and the lens's K.
    pub picture: &'a Path,
    pub camera: Option<&'a Path>,
    /// The daemon's.
    pub prefix: &'a str,
    pub timeout: Option<Duration>,
}

/// The next picture, until `stop` or the timeout.
pub fn take(wanted: &Wanted<'_>, client: &Client, out: &mut dyn Write, stop: &AtomicBool) -> Result<(), CliError> {
    let Wanted { picture: path, camera, prefix, timeout } = *wanted;
    let Some(frame) = next(client.frames(), timeout, stop)? else {
        if stop.load(Ordering::Relaxed) {
            return Err(interrupted());
        }
        let message = format!("no picture came from {prefix}/frame: is the daemon running, and the camera there?");
        return Err(CliError::new(exit_code::UNAVAILABLE, message));
    };
    let png = png(&frame).ok_or_else(|| CliError::new(exit_code::DATA, "the picture has no rows"))?;
    write(path, &png)?;
    let mut said = format!("{}: {} x {} px", path.display(), frame.header().width, frame.header().height);
    if let Some(camera) = camera {
        let health = next(client.health(), Some(HEALTH_TIME), stop)?;
        match health.as_ref().and_then(k) {
            Some(text) => {
                write(camera, text.as_bytes())?;
                let _ = write!(said, "; {}: K", camera.display());
            }
            None if stop.load(Ordering::Relaxed) => return Err(interrupted()),
            // That of an earlier picture would be taken for this one's.
            None => {
                if camera.symlink_metadata().is_ok_and(|about| about.is_file()) {
                    let _ = std::fs::remove_file(camera);
                }
                said += "; K is not known, or the lens is one that K alone does not describe";
            }
        }
    }
    // The files are there; whoever has closed stdout does not want to know.
    let _ = writeln!(out, "{said}");
    Ok(())
}

/// Whoever goes on with the files must see that they are not there.
fn interrupted() -> CliError {
    CliError::new(exit_code::FAILURE, "interrupted")
}

/// The next message; `None` after the timeout, or at the end.
fn next<T: Topic>(
    mut subscription: Subscription<T>,
    timeout: Option<Duration>,
    stop: &AtomicBool,
) -> Result<Option<T::Item>, CliError> {
    let began = Instant::now();
    while !stop.load(Ordering::Relaxed) && timeout.is_none_or(|timeout| began.elapsed() < timeout) {
        if let Some(item) = subscription.wait(NAP)? {
            return Ok(Some(item));
        }
    }
    Ok(None)
}

fn png(frame: &Frame) -> Option<Vec<u8>> {
    let h = frame.header();
    let header = EncodedHeader {
        width: h.width,
        height: h.height,
        stride: h.stride,
        format: ENCODED_GREY,
        ..EncodedHeader::default()
    };
    let mut png = Vec::new();
    compressed(&header, frame, &mut png)?;
    Some(png)
}

/// The nine numbers; `None` while no lens is known, and for a fisheye, whose pictures no K explains.
fn k(health: &Health) -> Option<String> {
    let ([fx, fy], [cx, cy]) = (health.focal_px, health.centre_px);
    let is_known = health.lens_model == LENS_RADIAL_TANGENTIAL && fx.is_finite();
    is_known.then(|| format!("{fx} 0 {cx}\n0 {fy} {cy}\n0 0 1\n"))
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), CliError> {
    write_atomically(path, |file| file.write_all(bytes))
        .map_err(|e| CliError::new(exit_code::CANNOT_CREATE, e.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::Endpoint;

    #[test]
    fn an_interrupted_picture_is_no_success() {
        let dir = tempfile::tempdir().expect("folder");
        let picture = dir.path().join("a.png");
        let prefix = format!("watch-picture-{}", std::process::id());
        let client = Client::with_endpoint(Endpoint::new(&prefix).expect("endpoint")).expect("client");
        let wanted = |timeout| Wanted { picture: &picture, camera: None, prefix: &prefix, timeout };
        let mut out = Vec::new();
        let told = take(&wanted(None), &client, &mut out, &AtomicBool::new(true)).expect_err("there is no picture");
        assert_eq!((told.code, told.message.as_str()), (exit_code::FAILURE, "interrupted"));
        let told = take(&wanted(Some(NAP)), &client, &mut out, &AtomicBool::new(false)).expect_err("nor is a daemon");
        assert_eq!(told.code, exit_code::UNAVAILABLE);
        assert!(out.is_empty() && !picture.exists());
    }

    #[test]
    fn k_is_told_of_a_lens_that_it_describes() {
        let mut health = Health { focal_px: [500.5, 501.0], centre_px: [320.0, 240.0], ..Health::default() };
        health.lens_model = LENS_RADIAL_TANGENTIAL;
        assert_eq!(k(&health).as_deref(), Some("500.5 0 320\n0 501 240\n0 0 1\n"));
        health.lens_model += 1;
        assert_eq!(k(&health), None);
        health.lens_model = LENS_RADIAL_TANGENTIAL;
        health.focal_px = [f32::NAN; 2];
        assert_eq!(k(&health), None);
    }
}
