//! An MCAP recording as a [`FrameSource`]: a file, or a rosbag2 folder of them, whoever wrote it.
//!
//! Input: a topic of sensor_msgs/Image (mono8, mono16, bgr8, rgb8, bgra8, rgba8, yuv422_yuy2, yuv422, bayer_*) or CompressedImage (JPEG, PNG) in CDR, and a
//! CameraInfo beside it. Output: pictures unchanged where the decoder takes them (grey, YUYV, JPEG, PNG), colour as BT.601 luma like that of a PNG;
//! times are the headers' stamps to the nanosecond (where the first is zero: the log times), so a lock-step replay equals that of the same
//! pictures in a folder, byte for byte.
//!
//! Frames come in the order of the file, which is that of recording. Files are read in pieces, once for a survey if they have no summary and
//! once for the pictures, LZ4 and Zstandard alike; memory holds one record. A file that is cut off gives what is before the cut, with a warning;
//! damage inside is an error when it is reached.
//!
//! Skipped with a reason: what a folder's recording skips, and a message that is not what its topic says. Not here: sqlite3 bags, ROS 1,
//! other messages than pictures, the first CameraInfo and the twists of one topic (`wheels`).

mod bayer;
mod picture;
mod records;
mod stream;
mod survey;
mod wheels;

use std::path::{Path, PathBuf};
use std::time::Duration;

use tracing::info;

use super::recording::{OwnCalibration, Pacer, Pacing};
use super::{FrameSource, Grab, SourceDescription, SourceError};
use crate::frame::{Clock, RawFrame, monotonic_ns};
use crate::geometry::CameraModel;
use crate::image::decode::picture_size;
use crate::motion::wheel::{WheelFault, WheelMessage};
use picture::Kind;
use stream::Stream;
use wheels::{PictureTimes, Wheels};

/// Pictures that the rate is found from.
const RATE_PICTURES: usize = 31;

/// An open recording.
#[derive(Debug)]
pub struct Bag {
    description: SourceDescription,
    stream: Stream,
    kind: Kind,
    /// The headers' stamps are all zero.
    by_log_time: bool,
    pacer: Option<Pacer>,
    last_timestamp_ns: Option<i64>,
    /// Message that was read and is not due yet.
    held: Option<(Option<i64>, u64)>,
    message: Vec<u8>,
    next: u64,
    wheels: Option<Wheels>,
}

/// Topics that are asked for by name; what is not is found where it is plain.
#[derive(Debug, Clone, Copy, Default)]
pub struct Asked<'a> {
    pub pictures: Option<&'a str>,
    pub wheels: Option<&'a str>,
}

/// The MCAP files of `path`: itself, or those of a rosbag2 folder; `None` if it is neither.
pub fn files(path: &Path) -> Option<Vec<PathBuf>> {
    if !path.is_dir() {
        return path.is_file().then(|| vec![path.to_owned()]);
    }
    let entries = std::fs::read_dir(path).ok()?.flatten().map(|entry| entry.path());
    let mut found: Vec<PathBuf> = entries.filter(|p| p.extension().is_some_and(|e| e == "mcap")).collect();
    // name_2 before name_10.
    found.sort_by_key(|p| (p.as_os_str().len(), p.clone()));
    (!found.is_empty()).then_some(found)
}

impl Bag {
    /// Opens a file or folder. `asked`: where the pictures are, and the wheels, if there are several.
    pub fn open(path: &Path, pacing: Pacing, own: OwnCalibration, asked: Asked<'_>) -> Result<Self, SourceError> {
        let failed = |path: &Path, reason: String| SourceError::Open { path: path.display().to_string(), reason };
        let files = files(path).ok_or_else(|| failed(path, "is neither a file nor a folder with MCAP files".into()))?;
        let topics = survey::survey(&files).map_err(|(file, reason)| failed(&file, reason))?;
        let (pictures, kind) = survey::choose(&topics, asked.pictures).map_err(|reason| failed(path, reason))?;
        let info = survey::camera_info(&topics, &pictures.name).filter(|_| own == OwnCalibration::Read);
        let camera = match info {
            Some(info) => {
                let wrong = |reason| failed(path, format!("{}: {reason}", info.name));
                first_camera(&files, &info.name, survey::is_rectified(&pictures.name)).map_err(wrong)?
            }
            None => None,
        };
        let beginning = Beginning::read(&files, &pictures.name, kind).map_err(|reason| failed(path, reason))?;
        let wheels = Wheels::open(&files, &topics, asked.wheels, beginning.times)
            .map_err(|reason| failed(path, reason))?
            .map(|(wheels, topic)| {
                info!(topic, "wheel odometry of the recording");
                wheels
            });
        let description = SourceDescription {
            name: format!("recording {} {}", path.display(), pictures.name),
            size: beginning.size,
            rate_hz: beginning.interval_ns.map(|ns| 1e9 / ns as f64),
            clock: Clock::Recording,
            camera,
            frames: Some(pictures.messages),
        };
        Ok(Self {
            description,
            stream: Stream::new(files, &pictures.name),
            kind,
            by_log_time: beginning.times.by_log_time,
            pacer: (pacing == Pacing::RealTime).then(|| Pacer::new(beginning.interval_ns)),
            last_timestamp_ns: None,
            held: None,
            message: Vec::new(),
            next: 0,
            wheels,
        })
    }

    /// Time and number of the next message, whose bytes are in `self.message`; no time if it has none that can be read. `None` at the end.
    fn next_message(&mut self) -> Result<Option<(Option<i64>, u64)>, SourceError> {
        if self.held.is_some() {
            return Ok(self.held);
        }
        let Some(log_time_ns) = self.stream.next(&mut self.message)? else { return Ok(None) };
        let number = self.next;
        self.next += 1;
        let stamp = if self.by_log_time { Some(log_time_ns) } else { picture::read_stamp(&self.message).ok() };
        self.held = Some((stamp, number));
        Ok(self.held)
    }
}

impl FrameSource for Bag {
    fn description(&self) -> &SourceDescription {
        &self.description
    }

    fn grab(&mut self, slot: &mut RawFrame, timeout: Duration) -> Result<Grab, SourceError> {
        let Some((stamp, number)) = self.next_message()? else { return Ok(Grab::End) };
        let Some(timestamp_ns) = stamp else {
            self.held = None;
            return Ok(Grab::Skipped { reason: format!("message {number}: has no header that can be read") });
        };
        if let Some(last) = self.last_timestamp_ns
            && timestamp_ns <= last
        {
            self.held = None;
            let how = if timestamp_ns == last { "repeats the" } else { "goes back behind the" };
            return Ok(Grab::Skipped {
                reason: format!("message {number}: timestamp {timestamp_ns} ns {how} one before"),
            });
        }
        if let Some(pacer) = &mut self.pacer {
            let now = monotonic_ns();
            let wait_ns = pacer.due_ns(timestamp_ns, now) - now;
            if wait_ns > 0 {
                let wait = Duration::from_nanos(wait_ns.unsigned_abs());
                std::thread::sleep(wait.min(timeout));
                if wait > timeout {
                    return Ok(Grab::TimedOut);
                }
            }
            pacer.gave(timestamp_ns, monotonic_ns());
        }
        self.held = None;
        self.last_timestamp_ns = Some(timestamp_ns);
        if let Err(reason) = picture::read(self.kind, &self.message, slot) {
            return Ok(Grab::Skipped { reason: format!("message {number}: {reason}") });
        }
        slot.sequence = number;
        slot.timestamp_ns = timestamp_ns;
        slot.arrival_ns = monotonic_ns();
        Ok(Grab::Frame)
    }

    fn wheels(&mut self, until_ns: i64, to: &mut dyn FnMut(&WheelMessage, Option<WheelFault>)) {
        if let Some(wheels) = &mut self.wheels {
            wheels.give(until_ns, to);
        }
    }
}

/// The first message of a calibration's topic, of pictures that are rectified or not.
fn first_camera(files: &[PathBuf], topic: &str, rectified: bool) -> Result<Option<CameraModel>, String> {
    let mut message = Vec::new();
    match Stream::new(files.to_vec(), topic).next(&mut message) {
        Ok(Some(_)) => picture::camera_info(&message, rectified),
        Ok(None) => Ok(None),
        Err(error) => Err(error.to_string()),
    }
}

/// What the first pictures tell.
struct Beginning {
    size: Option<(u32, u32)>,
    interval_ns: Option<i64>,
    times: PictureTimes,
}

impl Beginning {
    fn read(files: &[PathBuf], topic: &str, kind: Kind) -> Result<Self, String> {
        let (mut message, mut slot) = (Vec::new(), RawFrame::default());
        let mut stream = Stream::new(files.to_vec(), topic);
        let (mut size, mut stamps, mut log_times, mut above) = (None, Vec::new(), Vec::new(), Vec::new());
        while log_times.len() < RATE_PICTURES
            && let Some(log_time_ns) = stream.next(&mut message).map_err(|e| e.to_string())?
        {
            if size.is_none() && picture::read(kind, &message, &mut slot).is_ok() {
                size = picture_size(&slot.data).or(Some((slot.width, slot.height)));
            }
            if let Ok(stamp) = picture::read_stamp(&message) {
                stamps.push(stamp);
                above.push(stamp.saturating_sub(log_time_ns));
            }
            log_times.push(log_time_ns);
        }
        let by_log_time = stamps.first().is_none_or(|first| *first == 0);
        let above_log_ns = if by_log_time { 0 } else { middle(&mut above).unwrap_or(0) };
        let times = if by_log_time { log_times } else { stamps };
        let mut steps: Vec<i64> =
            times.windows(2).map(|w| w[1].saturating_sub(w[0])).filter(|step| *step > 0).collect();
        let first_ns = times.first().copied().unwrap_or(i64::MIN);
        let times = PictureTimes { by_log_time, first_ns, above_log_ns };
        Ok(Self { size, interval_ns: middle(&mut steps), times })
    }
}

fn middle(values: &mut [i64]) -> Option<i64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable(middle).1)
}

#[cfg(test)]
mod tests;
