//! A recorded sequence as a [`FrameSource`].
//!
//! Input: a folder in one of two layouts (see [`list`]): TUM RGB-D (`rgb.txt`, `camera.yaml` beside it) or EuRoC / ASL
//! (`mav0/cam0/data.csv`, `sensor.yaml`; the folders `mav0` and `cam0` themselves will do). Output: the picture files' bytes,
//! unchanged, straight into the slot; timestamps exactly as listed, ns of the recording's own clock.
//!
//! # Pacing
//! *Lock-step* gives the next frame whenever it is asked. *Real time* gives a frame when as much time has passed since
//! the first one as their timestamps say, on CLOCK_MONOTONIC. After a stall (a frame handed over later than a frame's
//! interval after it was due) the rest is played that much later: a camera does not send in a burst what was missed.
//! A jump forward of more than 2 s is played as 2 s.
//!
//! # What is skipped, with a reason
//! A timestamp that repeats or goes back; a picture that is missing, unreadable, empty, longer than 32 MiB or neither JPEG nor
//! PNG. A list that is missing, empty or malformed is an error when opening. A picture that is broken inside is found by the
//! decoder.
//!
//! Cost: one read of a file (0.1 ms for 130 kB in the page cache). Nothing is read ahead and nothing is allocated per
//! frame once the slot has grown, but for the path. Wheel odometry beside the list (`odometry.txt`, see `odometry`) is read whole when opening.
//! Not here: ground truth, IMU, stereo, decoding.

pub mod list;
mod odometry;

use super::{FrameSource, Grab, SourceDescription, SourceError};
use crate::calibration;
use crate::frame::{Clock, PixelFormat, RawFrame, monotonic_ns};
use crate::image::decode::{picture_size, sniff};
use crate::motion::wheel::{WheelFault, WheelMessage};
use list::{ListedFrame, Sequence};
use odometry::Odometry;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Longest picture file that is read: 1920x1200 with 16 bits and alpha, uncompressed, is 18 MB.
pub(super) const MAX_PICTURE_BYTES: u64 = 32 << 20;
/// Longest time that is waited for the next frame, whatever the timestamps say.
const MAX_GAP_NS: i64 = 2_000_000_000;

/// When frames are given.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pacing {
    /// Whenever one is asked for; never waits.
    LockStep,
    /// When it is due.
    RealTime,
}

/// Whether a recording's own calibration is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OwnCalibration {
    /// Read it; one that is there but wrong is an error.
    Read,
    /// Another one is used, so it does not matter.
    Ignore,
}

/// An open recording.
#[derive(Debug)]
pub struct Recording {
    description: SourceDescription,
    sequence: Sequence,
    /// Indices of the frames in the order of time, the first of equal timestamps first.
    by_time: Vec<u32>,
    /// Index of the frame that comes next.
    next: usize,
    /// Timestamp of the last frame that was given or unreadable in its turn.
    last_timestamp_ns: Option<i64>,
    /// `None` in lock-step.
    pacer: Option<Pacer>,
    odometry: Odometry,
    /// Kept for its capacity.
    path: PathBuf,
}

impl Recording {
    /// Opens a folder and reads its list and calibration, no picture but the first.
    pub fn open(folder: &Path, pacing: Pacing) -> Result<Self, SourceError> {
        Self::open_with(folder, pacing, OwnCalibration::Read)
    }

    /// [`Recording::open`], with or without the recording's own calibration.
    pub fn open_with(folder: &Path, pacing: Pacing, own: OwnCalibration) -> Result<Self, SourceError> {
        let sequence = list::read(folder)?;
        let camera = match (&sequence.calibration, own) {
            (Some(file), OwnCalibration::Read) => {
                let wrong = |e| SourceError::Open { path: folder.display().to_string(), reason: format!("{e}") };
                Some(calibration::load_camera(file).map_err(wrong)?)
            }
            _ => None,
        };
        let interval_ns = median_interval_ns(&sequence.frames);
        let mut first = RawFrame::default();
        let size = sequence
            .frames
            .first()
            .and_then(|f| read_picture(&sequence.folder.join(&*f.file), &mut first).ok())
            .and_then(|()| picture_size(&first.data));
        let description = SourceDescription {
            name: format!("recording {}", folder.display()),
            size,
            rate_hz: interval_ns.map(|ns| 1e9 / ns as f64),
            clock: Clock::Recording,
            camera,
            frames: Some(sequence.frames.len() as u64),
        };
        let mut by_time: Vec<u32> = (0..sequence.frames.len() as u32).collect();
        by_time.sort_by_key(|i| sequence.frames[*i as usize].timestamp_ns);
        let pacer = (pacing == Pacing::RealTime).then(|| Pacer::new(interval_ns));
        let stamps = || sequence.frames.iter().map(|frame| frame.timestamp_ns);
        let odometry = match (&sequence.odometry, stamps().min(), stamps().max()) {
            (Some(file), Some(first), Some(last)) => Odometry::read(file, (first, last))?,
            _ => Odometry::default(),
        };
        let (last_timestamp_ns, path) = (None, PathBuf::new());
        Ok(Self { description, sequence, by_time, next: 0, last_timestamp_ns, pacer, odometry, path })
    }

    /// Every frame of the list, in the list's order, those that will be skipped too.
    pub fn frames(&self) -> &[ListedFrame] {
        &self.sequence.frames
    }

    /// A frame's timestamp in the very characters of the list. (`trajectory::format_timestamp` gives the same for lists
    /// with six or nine decimals, which is all that are usual.)
    pub fn timestamp_text(&self, timestamp_ns: i64) -> Option<&str> {
        let frame = |i: &u32| self.sequence.frames.get(*i as usize);
        let at = self.by_time.partition_point(|i| frame(i).is_some_and(|f| f.timestamp_ns < timestamp_ns));
        let found = self.by_time.get(at).and_then(frame).filter(|f| f.timestamp_ns == timestamp_ns)?;
        Some(&found.timestamp_text)
    }
}

impl FrameSource for Recording {
    fn description(&self) -> &SourceDescription {
        &self.description
    }

    fn grab(&mut self, slot: &mut RawFrame, timeout: Duration) -> Result<Grab, SourceError> {
        let Some(frame) = self.sequence.frames.get(self.next) else { return Ok(Grab::End) };
        if let Some(last) = self.last_timestamp_ns
            && frame.timestamp_ns <= last
        {
            self.next += 1;
            let how = if frame.timestamp_ns == last { "repeats the" } else { "goes back behind the" };
            let reason = format!("{}: timestamp {} s {how} one before", frame.file, frame.timestamp_text);
            return Ok(Grab::Skipped { reason });
        }
        if let Some(pacer) = &mut self.pacer {
            let now = monotonic_ns();
            let wait_ns = pacer.due_ns(frame.timestamp_ns, now) - now;
            if wait_ns > 0 {
                let wait = Duration::from_nanos(wait_ns.unsigned_abs());
                std::thread::sleep(wait.min(timeout));
                if wait > timeout {
                    return Ok(Grab::TimedOut);
                }
            }
            pacer.gave(frame.timestamp_ns, monotonic_ns());
        }
        let sequence = self.next as u64;
        self.next += 1;
        self.last_timestamp_ns = Some(frame.timestamp_ns);
        self.path.clear();
        self.path.push(&self.sequence.folder);
        self.path.push(&*frame.file);
        if let Err(reason) = read_picture(&self.path, slot) {
            return Ok(Grab::Skipped { reason: format!("{}: {reason}", self.path.display()) });
        }
        slot.sequence = sequence;
        slot.timestamp_ns = frame.timestamp_ns;
        slot.arrival_ns = monotonic_ns();
        Ok(Grab::Frame)
    }

    fn wheels(&mut self, until_ns: i64, to: &mut dyn FnMut(&WheelMessage, Option<WheelFault>)) {
        self.odometry.give(until_ns, to);
    }
}

/// A picture file's bytes into the slot, with the format that they begin with.
fn read_picture(path: &Path, slot: &mut RawFrame) -> Result<(), String> {
    slot.data.clear();
    // Looked at before opening: opening a pipe would wait for somebody to write to it.
    let metadata = std::fs::metadata(path).map_err(|e| e.to_string())?;
    if !metadata.is_file() {
        return Err("is not a file".into());
    }
    if metadata.len() > MAX_PICTURE_BYTES {
        return Err(format!("{} bytes are more than the {MAX_PICTURE_BYTES} that a picture may have", metadata.len()));
    }
    slot.data.reserve(metadata.len() as usize);
    File::open(path)
        .and_then(|file| file.take(MAX_PICTURE_BYTES).read_to_end(&mut slot.data))
        .map_err(|e| e.to_string())?;
    slot.format = sniff(&slot.data).ok_or_else(|| match slot.data.get(..8) {
        Some(begin) => format!("neither JPEG nor PNG, begins with {begin:02x?}"),
        None => format!("is no picture, {} bytes", slot.data.len()),
    })?;
    debug_assert!(matches!(slot.format, PixelFormat::Jpeg | PixelFormat::Png));
    (slot.width, slot.height, slot.stride) = (0, 0, 0);
    Ok(())
}

/// Median of the steps forward, ns.
fn median_interval_ns(frames: &[ListedFrame]) -> Option<i64> {
    let mut steps: Vec<i64> = frames
        .windows(2)
        .filter_map(|w| w[1].timestamp_ns.checked_sub(w[0].timestamp_ns))
        .filter(|step| *step > 0)
        .collect();
    let middle = steps.len() / 2;
    (!steps.is_empty()).then(|| *steps.select_nth_unstable(middle).1)
}

/// The schedule of real-time playing: which moment a timestamp stands for. Knows no clock.
#[derive(Debug)]
pub(super) struct Pacer {
    /// Lateness that is made up for; beyond it the schedule moves, ns.
    tolerance_ns: i64,
    /// Timestamp and due moment of the last frame that was given.
    last: Option<(i64, i64)>,
}

impl Pacer {
    pub fn new(interval_ns: Option<i64>) -> Self {
        // An interval, but neither so short that jitter moves the schedule nor so long that a stall goes unnoticed.
        Self { tolerance_ns: interval_ns.unwrap_or(0).clamp(10_000_000, 200_000_000), last: None }
    }

    /// When the next frame is due, CLOCK_MONOTONIC ns.
    pub fn due_ns(&self, timestamp_ns: i64, now_ns: i64) -> i64 {
        match self.last {
            None => now_ns,
            Some((timestamp, due)) => due + timestamp_ns.saturating_sub(timestamp).clamp(0, MAX_GAP_NS),
        }
    }

    /// The next frame was given at `now_ns`.
    pub fn gave(&mut self, timestamp_ns: i64, now_ns: i64) {
        let due = self.due_ns(timestamp_ns, now_ns);
        let stalled = now_ns - due > self.tolerance_ns;
        self.last = Some((timestamp_ns, if stalled { now_ns } else { due }));
    }
}

#[cfg(test)]
mod tests;
