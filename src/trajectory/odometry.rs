//! The smooth pose of every frame with its state, as text: where a robot believed to be, seen or not.
//!
//! Input: frames' outcomes as they come. Output: a file of lines `timestamp tx ty tz qx qy qz qw STATE`, the first eight as in a TUM trajectory: the
//! camera's pose in odom (axes of the camera: right, down, forward), seconds and the unit that the comments name. A frame without a pose has
//! `nan` seven times. A comment line says where poses become unrelated to those before (another reset counter) and what lengths are from there on.
//!
//! While it lasts the text is in a file without a name in the output's folder, so memory does not grow and nothing is left behind; its size is
//! bounded as that of the other spools. Cost: 2 us a frame.

use std::fs::File;
use std::io::{self, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::Path;

use super::spool::MAX_SPOOL_BYTES;
use super::{TimestampText, TrajectoryError, write_pose_fields};
use crate::atomic_file::{create_unique, write_atomically};
use crate::reconstruction::{PoseEstimate, TrackingState};

const HEADER: &str = "# odom_from_camera of every frame, as it was published: timestamp tx ty tz qx qy qz qw state\n\
                      # axes of the camera (x right, y down, z forward); DEAD_RECKONING: by the wheels alone; nan: no pose\n";

/// See module.
#[derive(Debug)]
pub struct OdometryLog {
    text: BufWriter<File>,
    directory: String,
    bytes: u64,
    lost: u64,
    line: Vec<u8>,
    /// Reset counter of the line before, and whether lengths were metres.
    part: Option<(u32, bool)>,
}

/// What writing it came to.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct OdometrySummary {
    /// Frames that could not be recorded (disk full, file at its limit).
    pub frames_lost: u64,
}

impl OdometryLog {
    /// `directory`: where the temporary file goes; choose the output's own folder.
    pub fn create(directory: &Path) -> Result<Self, TrajectoryError> {
        let directory = if directory.as_os_str().is_empty() { Path::new(".") } else { directory };
        let failed = |source| TrajectoryError::Spool { directory: directory.display().to_string(), source };
        let (file, path) = create_unique(directory, ".odometry", true).map_err(failed)?;
        std::fs::remove_file(path).map_err(failed)?;
        let text = BufWriter::with_capacity(1 << 16, file);
        let directory = directory.display().to_string();
        Ok(Self { text, directory, bytes: 0, lost: 0, line: Vec::with_capacity(256), part: None })
    }

    /// Takes one frame's outcome. An error means that it was lost (it is counted); recording may go on.
    pub fn record(&mut self, estimate: &PoseEstimate) -> Result<(), TrajectoryError> {
        self.line.clear();
        let part = (estimate.reset_counter, estimate.scale.is_metric());
        let outcome = write_frame(&mut self.line, estimate, self.part != Some(part));
        self.part = Some(part);
        let full = self.bytes + self.line.len() as u64 > MAX_SPOOL_BYTES;
        let outcome = match full {
            true => Err(io::Error::other(format!("limit of {MAX_SPOOL_BYTES} bytes reached"))),
            false => outcome.and_then(|()| self.text.write_all(&self.line)),
        };
        match &outcome {
            Ok(()) => self.bytes += self.line.len() as u64,
            Err(_) => self.lost += 1,
        }
        outcome.map_err(|source| TrajectoryError::Spool { directory: self.directory.clone(), source })
    }

    /// Writes all of it, whole or not at all.
    pub fn write(&mut self, path: &Path) -> Result<OdometrySummary, TrajectoryError> {
        let directory = self.directory.clone();
        let failed = |source| TrajectoryError::Spool { directory: directory.clone(), source };
        self.text.flush().map_err(failed)?;
        let file = self.text.get_mut();
        file.seek(SeekFrom::Start(0)).map_err(failed)?;
        write_atomically(path, |out| {
            out.write_all(HEADER.as_bytes())?;
            io::copy(&mut file.take(self.bytes), out).map(drop)
        })?;
        self.text.get_mut().seek(SeekFrom::End(0)).map_err(failed)?;
        Ok(OdometrySummary { frames_lost: self.lost })
    }
}

fn write_frame(out: &mut Vec<u8>, estimate: &PoseEstimate, begins: bool) -> io::Result<()> {
    if begins {
        let unit = if estimate.scale.is_metric() { "metres" } else { "map units" };
        writeln!(out, "# reset counter {}, lengths in {unit}", estimate.reset_counter)?;
    }
    write!(out, "{}", TimestampText(estimate.timestamp_ns))?;
    match &estimate.odom_from_camera {
        Some(pose) if pose.is_finite() => write_pose_fields(out, pose)?,
        _ => out.write_all(b" nan nan nan nan nan nan nan")?,
    }
    writeln!(out, " {}", state_word(estimate.state))
}

/// As on the wire.
fn state_word(state: TrackingState) -> &'static str {
    match state {
        TrackingState::Initializing => "INITIALIZING",
        TrackingState::Orientation => "ORIENTATION",
        TrackingState::Tracking => "TRACKING",
        TrackingState::Lost => "LOST",
        TrackingState::DeadReckoning => "DEAD_RECKONING",
    }
}
