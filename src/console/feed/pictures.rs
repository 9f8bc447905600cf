//! The camera's pictures and what was found in them: subscribed only while a page shows them or a calibration runs, encoded once for all.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use jpeg_encoder::{ColorType, Encoder};
use tracing::warn;

use super::source::{LOOK, Source, pause, wait};
use crate::client::{ClientError, FeatureLists, Features, Frame};
use crate::console::calibration::{Picture, Tray};
use crate::console::hub::{Hub, demand};
use crate::console::picture::{Grey, grey};
use crate::console::wire::{self, Bytes, Kind};

/// Pictures a second at most: enough to drive by, and a third less than a webcam's to encode.
const RATE_HZ: f64 = 20.0;
/// Of 100; grey 640x480 becomes some 40 kB.
const QUALITY: u8 = 70;
/// How soon the end of a demand is noticed.
const NAP: Duration = Duration::from_millis(100);

/// Until `stop`.
pub fn run(hub: &Hub, source: &Source, tray: &Tray, stop: &AtomicBool) {
    while !stop.load(Ordering::Relaxed) {
        if !is_wanted(hub, tray) {
            wait(stop, NAP);
        } else if let Err(error) = show(hub, source, tray, stop) {
            warn!(%error, "console: no pictures");
            pause(stop);
        }
    }
}

/// Somebody looks, or a calibration runs.
fn is_wanted(hub: &Hub, tray: &Tray) -> bool {
    hub.wants(demand::VIDEO) || tray.is_open()
}

/// While it is wanted.
fn show(hub: &Hub, source: &Source, tray: &Tray, stop: &AtomicBool) -> Result<(), ClientError> {
    let client = source.client()?;
    let (mut frames, mut found) = (client.frames().polled(LOOK), client.features().polled(LOOK));
    let mut jpeg = Vec::new();
    let pause = Duration::from_secs_f64(1.0 / RATE_HZ);
    // Nothing is encoded sooner after the last than this; a tenth less, as a camera's frames do not come by our clock.
    let mut next = Instant::now();
    while !stop.load(Ordering::Relaxed) && is_wanted(hub, tray) {
        let Some(frame) = frames.wait(NAP)? else { continue };
        let features = of_frame(&mut found, frame.header().sequence)?;
        let now = Instant::now();
        if now < next {
            continue;
        }
        next = now.max(next + pause).min(now + pause) - pause / 10;
        // Before it is encoded, so that both take place at a time.
        if tray.is_asked()
            && let Some(grey) = grey(&frame)
        {
            tray.give(|| copy(&frame, grey));
        }
        if !hub.wants(demand::VIDEO) {
            continue;
        }
        if let Some(message) = encode(&frame, features, &mut jpeg) {
            hub.tell(Kind::Frame, demand::VIDEO, &message);
        }
    }
    Ok(())
}

fn copy(frame: &Frame, grey: Grey<'_>) -> Picture {
    let h = frame.header();
    Picture {
        run_id: h.run_id,
        sequence: h.sequence,
        time_ns: h.timestamp_ns,
        width: grey.width.into(),
        height: grey.height.into(),
        pixels: grey.pixels.into_owned(),
    }
}

/// What was found in the frame of this number; it was sent before the picture. `None` if that of a later one came already.
fn of_frame(found: &mut FeatureLists, sequence: u64) -> Result<Option<Features>, ClientError> {
    while let Some(features) = found.try_next()? {
        if features.header().sequence >= sequence {
            return Ok(Some(features).filter(|f| f.header().sequence == sequence));
        }
    }
    Ok(None)
}

/// `None` for a picture that JPEG has no size for.
fn encode(frame: &Frame, features: Option<Features>, jpeg: &mut Vec<u8>) -> Option<Bytes> {
    let h = frame.header();
    let Grey { width, height, pixels } = grey(frame)?;
    jpeg.clear();
    Encoder::new(&mut *jpeg, QUALITY).encode(&pixels, width, height, ColorType::Luma).ok()?;
    Some(wire::frame(
        h.sequence,
        h.arrival_ns as f64 * 1e-9,
        (h.width, h.height),
        features.as_deref().unwrap_or_default(),
        jpeg,
    ))
}
