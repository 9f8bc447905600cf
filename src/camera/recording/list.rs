//! The lists of recorded sequences: which pictures at which times.
//!
//! | layout | list | a line | pictures | calibration |
//! |---|---|---|---|---|
//! | TUM RGB-D | `rgb.txt` | `1305031102.175304 rgb/1305031102.175304.png`, seconds | beside the list | `camera.yaml` |
//! | EuRoC / ASL | `mav0/cam0/data.csv` | `1403636579763555584,1403636579763555584.png`, ns | in `data/` | `sensor.yaml` |
//!
//! Lines that are blank or begin with `#` are comments. Anything else that is not of the form is an error with file and
//! line: half a list would be a shorter recording that nobody notices. Timestamps are read digit by digit, never through a
//! floating-point number, and kept as text too. Cost: 0.2 us a line.

use super::super::SourceError;
use crate::trajectory::parse_timestamp;
use std::io::Read;
use std::path::{Path, PathBuf};

/// A list of a day at 30 Hz has 2.6 million lines of 50 bytes.
const MAX_LIST_BYTES: u64 = 256 << 20;

/// One line of a list.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ListedFrame {
    /// The recording's own time, ns, exactly as listed.
    pub timestamp_ns: i64,
    /// As it stands in the list (seconds in the TUM layout, ns in EuRoC's).
    pub timestamp_text: Box<str>,
    /// Relative to [`Sequence::folder`].
    pub file: Box<str>,
}

/// What a recording's folder holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Sequence {
    /// Where the pictures' names start from.
    pub folder: PathBuf,
    /// Never empty; in the list's order, which need not be that of time.
    pub frames: Vec<ListedFrame>,
    /// Only if the file is there.
    pub calibration: Option<PathBuf>,
    /// Wheel odometry (TUM layout only), if the file is there.
    pub odometry: Option<PathBuf>,
}

/// Finds out the layout of a folder and reads its list.
pub fn read(folder: &Path) -> Result<Sequence, SourceError> {
    let failed = |reason: String| SourceError::Open { path: folder.display().to_string(), reason };
    let metadata = std::fs::metadata(folder).map_err(|e| failed(e.to_string()))?;
    if !metadata.is_dir() {
        return Err(failed("is not a folder with rgb.txt or mav0/cam0/data.csv in it, nor an MCAP file".into()));
    }
    let existing = |path: PathBuf| path.exists().then_some(path);
    if let Some(list) = existing(folder.join("rgb.txt")) {
        let frames = read_list(&list, parse_tum_line)?;
        let calibration = existing(folder.join("camera.yaml"));
        let odometry = existing(folder.join("odometry.txt"));
        return Ok(Sequence { folder: folder.into(), frames, calibration, odometry });
    }
    for camera in [folder.join("mav0/cam0"), folder.join("cam0"), folder.into()] {
        if let Some(list) = existing(camera.join("data.csv")) {
            let frames = read_list(&list, parse_asl_line)?;
            let calibration = existing(camera.join("sensor.yaml"));
            return Ok(Sequence { folder: camera.join("data"), frames, calibration, odometry: None });
        }
    }
    let is_empty = std::fs::read_dir(folder).map_err(|e| failed(e.to_string()))?.next().is_none();
    Err(failed(if is_empty {
        "the folder is empty".into()
    } else {
        "is no recording: neither rgb.txt (TUM RGB-D layout) nor mav0/cam0/data.csv (EuRoC layout) nor an MCAP file is in it".into()
    }))
}

fn read_list(path: &Path, parse: fn(&str) -> Result<ListedFrame, String>) -> Result<Vec<ListedFrame>, SourceError> {
    let name = path.display().to_string();
    let failed = |place: &str, reason: String| SourceError::Open { path: place.into(), reason };
    let text = contents(path)?;
    let mut frames = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        frames.push(parse(line).map_err(|reason| failed(&format!("{name}:{}", index + 1), reason))?);
    }
    if frames.is_empty() {
        return Err(failed(&name, "lists no frames".into()));
    }
    Ok(frames)
}

/// A list's text, without a byte order mark; an error names the file.
pub(super) fn contents(path: &Path) -> Result<String, SourceError> {
    let failed = |reason: String| SourceError::Open { path: path.display().to_string(), reason };
    if !path.is_file() {
        return Err(failed("is not a file".into()));
    }
    let mut bytes = Vec::new();
    std::fs::File::open(path)
        .and_then(|f| f.take(MAX_LIST_BYTES + 1).read_to_end(&mut bytes))
        .map_err(|e| failed(e.to_string()))?;
    if bytes.len() as u64 > MAX_LIST_BYTES {
        return Err(failed(format!("is longer than {MAX_LIST_BYTES} bytes")));
    }
    let text = String::from_utf8(bytes).map_err(|_| failed("is not UTF-8 text".into()))?;
    Ok(match text.strip_prefix('\u{feff}') {
        Some(rest) => rest.to_owned(),
        None => text,
    })
}

/// `timestamp filename`, seconds.
pub(super) fn parse_tum_line(line: &str) -> Result<ListedFrame, String> {
    let mut fields = line.split_whitespace();
    let (Some(time), Some(file), None) = (fields.next(), fields.next(), fields.next()) else {
        return Err(format!("must be 'timestamp filename', not {}", shortened(line)));
    };
    let timestamp_ns = parse_timestamp(time).map_err(|e| format!("timestamp {} {e}", shortened(time)))?;
    Ok(ListedFrame { timestamp_ns, timestamp_text: time.into(), file: file.into() })
}

/// `timestamp,filename`, ns.
pub(super) fn parse_asl_line(line: &str) -> Result<ListedFrame, String> {
    let fields = line.split_once(',').map(|(time, file)| (time.trim(), file.trim()));
    let Some((time, file)) = fields.filter(|(_, file)| !file.is_empty() && !file.contains(',')) else {
        return Err(format!("must be 'timestamp,filename', not {}", shortened(line)));
    };
    let timestamp_ns =
        time.parse().map_err(|_| format!("timestamp {} is not a whole number of ns", shortened(time)))?;
    Ok(ListedFrame { timestamp_ns, timestamp_text: time.into(), file: file.into() })
}

/// Quoted, and not endless.
pub(super) fn shortened(text: &str) -> String {
    if text.chars().count() <= 80 {
        format!("{text:?}")
    } else {
        format!("{:?}", text.chars().take(77).chain("...".chars()).collect::<String>())
    }
}
