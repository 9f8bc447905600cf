//! Trajectories as files: TUM text in and out, and the spools that a run streams its poses into.
//!
//! A TUM line is `timestamp tx ty tz qx qy qz qw` = world_from_camera, seconds and the map's unit. Input: such a file (`#`
//! comments and blank lines skipped, anything else malformed named by file and line). Output: poses in ascending time, with
//! exactly the nanoseconds that were in the text. Written with nine decimals and the timestamp's own digits
//! ([`format_timestamp`]), no header, whole or not at all ([`crate::atomic_file`]).
//! Cost: 1 us a line each way.
//!
//! Deliberately not here: poses between frames. One that was not estimated is not written.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::Path;

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use crate::atomic_file::{WriteError, write_atomically};
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};

pub mod beside;
mod between;
mod odometry;
mod record;
mod spool;
mod timestamp;

#[cfg(test)]
mod tests;

pub use odometry::{OdometryLog, OdometrySummary};
pub use spool::{LiveTrajectory, TrajectorySpool, TrajectorySummary};
pub use timestamp::{TimestampError, TimestampText, format_timestamp, parse_timestamp};

/// One line of a TUM file.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TumPose {
    /// Exactly the decimal seconds of the text.
    pub timestamp_ns: i64,
    /// In the file's own world frame and unit.
    pub world_from_camera: Se3<World, Camera>,
}

/// Why a trajectory cannot be read, spooled or written.
#[derive(Debug, thiserror::Error)]
pub enum TrajectoryError {
    #[error("cannot read {path}: {source}")]
    Read { path: String, source: io::Error },
    #[error("{path}, line {line}: {reason}")]
    Malformed { path: String, line: u64, reason: String },
    #[error("{path} holds no poses")]
    Empty { path: String },
    #[error(transparent)]
    Write(#[from] WriteError),
    /// Another map's trajectory would replace what somebody else has put there.
    #[error(
        "{path}: another map's trajectory belongs here, but this file is not one that cairn has written; it is left as it is"
    )]
    NotOurs { path: String },
    /// The temporary file of a spool cannot be made, written or read back.
    #[error("trajectory spool in {directory}: {source}")]
    Spool { directory: String, source: io::Error },
}

/// Longest line that is looked at; a longer one is malformed (and a file without line ends cannot fill the memory).
const MAX_LINE_BYTES: u64 = 4096;
/// A quaternion whose norm is further from 1 is a mistake in the file and not rounding.
const QUATERNION_NORM_TOLERANCE: f64 = 0.02;

/// Reads a TUM trajectory, sorted by time (stable, so lines of one timestamp keep their order).
pub fn read_tum(path: &Path) -> Result<Vec<TumPose>, TrajectoryError> {
    let mut poses = Vec::new();
    for_each_line(path, |text| {
        poses.push(parse_tum_line(text)?);
        Ok(())
    })?;
    if poses.is_empty() {
        return Err(TrajectoryError::Empty { path: path.display().to_string() });
    }
    poses.sort_by_key(|p| p.timestamp_ns);
    Ok(poses)
}

/// Timestamps of a list such as `rgb.txt` (`timestamp filename` a line), sorted; what follows the timestamp is not looked at.
pub fn read_frame_times(path: &Path) -> Result<Vec<i64>, TrajectoryError> {
    let mut times = Vec::new();
    for_each_line(path, |text| {
        times.push(parse_time_field(text.split_whitespace().next().unwrap_or_default())?);
        Ok(())
    })?;
    if times.is_empty() {
        return Err(TrajectoryError::Empty { path: path.display().to_string() });
    }
    times.sort_unstable();
    Ok(times)
}

/// Calls `each` with every line that is neither blank nor a comment; its error gets the file's name and the line's number.
fn for_each_line(path: &Path, mut each: impl FnMut(&str) -> Result<(), String>) -> Result<(), TrajectoryError> {
    let read_error = |source| TrajectoryError::Read { path: path.display().to_string(), source };
    let mut reader = BufReader::new(File::open(path).map_err(read_error)?);
    let mut bytes = Vec::new();
    let mut line = 0;
    loop {
        bytes.clear();
        if reader.by_ref().take(MAX_LINE_BYTES + 1).read_until(b'\n', &mut bytes).map_err(read_error)? == 0 {
            return Ok(());
        }
        line += 1;
        let malformed = |reason: String| TrajectoryError::Malformed { path: path.display().to_string(), line, reason };
        if bytes.len() as u64 > MAX_LINE_BYTES {
            return Err(malformed(format!("is longer than {MAX_LINE_BYTES} bytes")));
        }
        let text = std::str::from_utf8(&bytes).map_err(|_| malformed("is not text".into()))?;
        let text = text.trim_start_matches('\u{feff}').trim();
        if !text.is_empty() && !text.starts_with('#') {
            each(text).map_err(malformed)?;
        }
    }
}

fn parse_time_field(field: &str) -> Result<i64, String> {
    parse_timestamp(field).map_err(|e| format!("timestamp {field:?} {e}"))
}

fn parse_tum_line(text: &str) -> Result<TumPose, String> {
    const NAMES: [&str; 7] = ["tx", "ty", "tz", "qx", "qy", "qz", "qw"];
    let mut fields = text.split_whitespace();
    let timestamp_ns = parse_time_field(fields.next().unwrap_or_default())?;
    let mut values = [0.0_f64; 7];
    for (i, (value, name)) in values.iter_mut().zip(NAMES).enumerate() {
        let field = fields.next().ok_or_else(|| {
            format!("has {} values, expected 8: timestamp tx ty tz qx qy qz qw (missing {name})", i + 1)
        })?;
        *value = field.parse().map_err(|_| format!("{name} {field:?} is not a number"))?;
        if !value.is_finite() {
            return Err(format!("{name} is {field}, expected a finite number"));
        }
    }
    if fields.next().is_some() {
        return Err("has more than 8 values, expected timestamp tx ty tz qx qy qz qw".into());
    }
    let [tx, ty, tz, qx, qy, qz, qw] = values;
    let quaternion = Quaternion::new(qw, qx, qy, qz);
    let norm = quaternion.norm();
    if (norm - 1.0).abs() > QUATERNION_NORM_TOLERANCE {
        return Err(format!("quaternion has norm {norm:.4}, expected 1"));
    }
    let rotation = UnitQuaternion::new_normalize(quaternion);
    Ok(TumPose { timestamp_ns, world_from_camera: Se3::new(rotation, Vector3::new(tx, ty, tz)) })
}

/// One TUM line with its line end. The quaternion is written with `w >= 0`, so that equal poses give equal bytes.
pub fn write_tum_line(
    out: &mut impl Write,
    timestamp_ns: i64,
    world_from_camera: &Se3<World, Camera>,
) -> io::Result<()> {
    write!(out, "{}", TimestampText(timestamp_ns))?;
    write_pose_fields(out, world_from_camera)?;
    out.write_all(b"\n")
}

/// ` tx ty tz qx qy qz qw`
fn write_pose_fields<W>(out: &mut impl Write, pose: &Se3<W, Camera>) -> io::Result<()> {
    let (t, q) = (pose.translation, pose.rotation.coords);
    let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
    for value in [t.x, t.y, t.z, sign * q.x, sign * q.y, sign * q.z, sign * q.w] {
        write!(out, " {:.9}", without_negative_zero(value))?;
    }
    Ok(())
}

/// What would be printed as `-0.000000000` is zero.
fn without_negative_zero(value: f64) -> f64 {
    if value.abs() < 0.5e-9 { 0.0 } else { value }
}

/// Writes a trajectory, whole or not at all.
pub fn write_tum(path: &Path, poses: &[TumPose]) -> Result<(), TrajectoryError> {
    write_atomically(path, |out| {
        poses.iter().try_for_each(|p| write_tum_line(out, p.timestamp_ns, &p.world_from_camera))
    })?;
    Ok(())
}
