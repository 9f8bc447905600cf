//! The listening half of a recorder: a subscriber like any other.
//!
//! Input: the daemon's services. Output: [`Record`]s into the queue of the writing half. A daemon that stops, dies or starts anew meanwhile is waited
//! for; gaps in the numbers of pictures are counted and said. Raw pictures become PNG here (lossless), compressed ones are written as they came.

use std::time::{Duration, Instant};

use tracing::{info, warn};

use super::ShareError;
use super::records::{Converter, Record};
use super::sink::{Queue, Queued};
use crate::client::{
    Client, Encodeds, Healths, Keyframes, Map, ObstacleScans, Poses, Subscription, Topic, WheelReports, monotonic_ns,
};
use crate::messages::services::{MAX_WHEEL_PUBLISHERS, WHEEL};
use crate::messages::{
    ENCODED_GREY, ENCODED_JPEG, ENCODED_PNG, ENCODED_YUYV, EncodedHeader, Endpoint, Health, Pose, State,
};

/// Longest sleep: how late a signal is noticed while nothing comes.
pub const TURN: Duration = Duration::from_millis(50);
/// Both clocks may come apart so far, by a time server's nudges, before it is worth a word, ns.
const CLOCK_STEP_NS: i64 = 500_000_000;
/// Readings of the wheels taken in one turn: as many as the queues of all drivers hold that there may be.
const WHEEL_READINGS_A_TURN: usize = MAX_WHEEL_PUBLISHERS * WHEEL.buffer;
/// Pictures that are taken in a row, before everything else is looked after: making a PNG may take as long as the camera for a picture.
const PICTURES_A_TURN: usize = 4;
/// What repeats is said once in so long.
const SAY_EVERY: Duration = Duration::from_secs(1);

/// What was heard.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Heard {
    pub pictures: u64,
    /// Pictures that the camera or its driver lost, or that this recorder was too slow for.
    pub missed: u64,
    /// Pictures of a kind that is not known here, or whose rows are not there.
    pub unusable: u64,
    /// Records for which the disk was too slow.
    pub dropped: u64,
    pub daemons: u64,
}

/// Subscriptions, and what must be remembered between two messages.
pub struct Recorder {
    encoded: Encodeds,
    poses: Poses,
    map: Map,
    keyframes: Keyframes,
    health: Healths,
    obstacles: ObstacleScans,
    /// While a daemon is there: a driver would take this reader for one.
    wheels: Option<WheelReports>,
    client: Client,
    converter: Converter,
    realtime_minus_monotonic_ns: i64,
    queue: Queue,
    heard: Heard,
    /// Run and number of the last picture.
    last_picture: Option<(u64, u64)>,
    last_run: Option<u64>,
    last_state: Option<State>,
    has_stepped: bool,
    said: Option<Instant>,
    records: Vec<Record>,
    png: Vec<u8>,
}

impl Recorder {
    /// Subscribes. The daemon need not run yet.
    pub fn new(endpoint: Endpoint, realtime_minus_monotonic_ns: i64, queue: Queue) -> Result<Self, ShareError> {
        let prefix = endpoint.prefix().to_owned();
        let client = Client::with_endpoint(endpoint)?;
        Ok(Self {
            encoded: client.encoded(),
            poses: client.poses(),
            map: client.map(),
            keyframes: client.keyframes(),
            health: client.health(),
            obstacles: client.obstacles(),
            wheels: None,
            client,
            converter: Converter::new(&prefix, realtime_minus_monotonic_ns),
            realtime_minus_monotonic_ns,
            queue,
            heard: Heard::default(),
            last_picture: None,
            last_run: None,
            last_state: None,
            has_stepped: false,
            said: None,
            records: Vec::new(),
            png: Vec::new(),
        })
    }

    pub fn heard(&self) -> Heard {
        self.heard
    }

    pub fn is_connected(&self) -> bool {
        self.poses.is_connected()
    }

    /// Waits for the next picture for 50 ms at most, and takes everything that has come. `false`: nobody writes any more.
    pub fn step(&mut self) -> Result<bool, ShareError> {
        let mut picture = self.encoded.wait(TURN)?;
        let mut taken = 0;
        while let Some(slice) = picture.take() {
            self.picture(slice.header(), &slice);
            drop(slice);
            if !self.hand_over() {
                return Ok(false);
            }
            taken += 1;
            if taken < PICTURES_A_TURN {
                picture = self.encoded.try_next()?;
            }
        }
        let Self { converter, records, .. } = self;
        let mut poses = Vec::new();
        drain(&mut self.poses, |pose| poses.push(pose))?;
        drain(&mut self.map, |map| converter.map(map.header(), &map, records))?;
        drain(&mut self.keyframes, |k| converter.keyframes(k.header(), &k, records))?;
        let mut healths = Vec::new();
        drain(&mut self.health, |health| healths.push(health))?;
        for pose in poses {
            self.note_pose(&pose);
            self.converter.pose(&pose, &mut self.records);
        }
        for health in healths {
            self.note_clock(&health);
            self.converter.health(&health, &mut self.records);
        }
        self.take_wheels()?;
        let Self { converter, records, .. } = self;
        drain(&mut self.obstacles, |obstacles| converter.obstacles(&obstacles, records))?;
        Ok(self.hand_over())
    }

    fn take_wheels(&mut self) -> Result<(), ShareError> {
        // Beside a replay nobody hears the driver, and it must not take this reader for somebody.
        if !self.poses.is_connected() || !self.converter.is_live() {
            self.wheels = None;
            return Ok(());
        }
        let wheels = self.wheels.get_or_insert_with(|| self.client.wheel_reports(TURN));
        let Self { converter, records, .. } = self;
        // A driver that sends without end holds nobody here.
        for _ in 0..WHEEL_READINGS_A_TURN {
            let Some(wheel) = wheels.try_next()? else { break };
            converter.wheel(&wheel, monotonic_ns(), records);
        }
        Ok(())
    }

    fn picture(&mut self, header: &EncodedHeader, data: &[u8]) {
        self.heard.pictures += 1;
        if let Some((run, sequence)) = self.last_picture
            && run == header.run_id
        {
            let missed = header.sequence.saturating_sub(sequence + 1);
            self.heard.missed += missed;
            if missed > 0 && self.is_news() {
                warn!(
                    missed,
                    missed_total = self.heard.missed,
                    sequence = header.sequence,
                    "pictures missing in the recording"
                );
            }
        }
        self.last_picture = Some((header.run_id, header.sequence));
        match header.format {
            ENCODED_JPEG => self.converter.picture(header, "jpeg", data, &mut self.records),
            ENCODED_PNG => self.converter.picture(header, "png", data, &mut self.records),
            ENCODED_GREY | ENCODED_YUYV if png(header, data, &mut self.png).is_some() => {
                self.converter.picture(header, "png", &self.png, &mut self.records);
            }
            format => {
                self.heard.unusable += 1;
                if self.is_news() {
                    warn!(format, sequence = header.sequence, "picture of an unknown kind, not recorded");
                }
            }
        }
    }

    fn note_pose(&mut self, pose: &Pose) {
        let same_run = self.last_run.replace(pose.run_id) == Some(pose.run_id);
        if !same_run {
            self.heard.daemons += 1;
            info!(run_id = pose.run_id, daemons = self.heard.daemons, "recording a daemon");
        }
        let before = self.last_state.replace(pose.state());
        // A map that is young is given up at once: its end is told as INITIALIZING or ORIENTATION.
        if same_run && before == Some(State::Tracking) && pose.state() != State::Tracking {
            self.queue.event("LOST");
        }
    }

    /// One offset holds for the recording; if somebody sets the time of day meanwhile, times go on as before.
    fn note_clock(&mut self, health: &Health) {
        let step_ns = health.realtime_minus_monotonic_ns.saturating_sub(self.realtime_minus_monotonic_ns);
        if step_ns.saturating_abs() > CLOCK_STEP_NS && !self.has_stepped {
            self.has_stepped = true;
            warn!(step_s = step_ns as f64 * 1e-9, "time of day was set, the recording's times go on as before");
        }
    }

    /// `false`: nobody writes any more.
    fn hand_over(&mut self) -> bool {
        let dropped_before = self.heard.dropped;
        for record in self.records.drain(..) {
            match self.queue.push(record) {
                Queued::Waits => {}
                Queued::Dropped => self.heard.dropped += 1,
                Queued::Closed => return false,
            }
        }
        if self.heard.dropped > dropped_before && self.is_news() {
            warn!(dropped_total = self.heard.dropped, "disk too slow, records dropped");
        }
        true
    }

    fn is_news(&mut self) -> bool {
        let known = self.said.is_some_and(|at| at.elapsed() < SAY_EVERY);
        if !known {
            self.said = Some(Instant::now());
        }
        !known
    }
}

/// All that has come.
fn drain<T: Topic>(subscription: &mut Subscription<T>, mut take: impl FnMut(T::Item)) -> Result<(), ShareError> {
    while let Some(item) = subscription.try_next()? {
        take(item);
    }
    Ok(())
}

/// Rows of grey, or the luma of YUYV, as a PNG file; `None` if they are not there.
fn png(header: &EncodedHeader, data: &[u8], out: &mut Vec<u8>) -> Option<()> {
    let (width, height, stride) = (header.width as usize, header.height as usize, header.stride as usize);
    let bytes_a_pixel = if header.format == ENCODED_YUYV { 2 } else { 1 };
    let row = bytes_a_pixel * width;
    if width == 0 || stride < row || data.len() < stride.checked_mul(height.checked_sub(1)?)?.checked_add(row)? {
        return None;
    }
    out.clear();
    let mut encoder = ::png::Encoder::new(&mut *out, header.width, header.height);
    encoder.set_color(::png::ColorType::Grayscale);
    encoder.set_depth(::png::BitDepth::Eight);
    encoder.set_compression(::png::Compression::Fast);
    let mut writer = encoder.write_header().ok()?;
    if bytes_a_pixel == 1 && stride == width {
        writer.write_image_data(&data[..width * height]).ok()?;
    } else {
        let rows = data.chunks(stride).take(height).flat_map(|line| line[..row].iter().step_by(bytes_a_pixel));
        let rows: Vec<u8> = rows.copied().collect();
        writer.write_image_data(&rows).ok()?;
    }
    writer.finish().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_of_grey_come_back_from_their_png() {
        let header = EncodedHeader { width: 5, height: 3, stride: 8, ..EncodedHeader::default() };
        let data: Vec<u8> = (0..3 * 8 - 3).collect();
        let mut file = Vec::new();
        assert_eq!(png(&header, &data, &mut file), Some(()));
        let raw =
            crate::frame::RawFrame { format: crate::frame::PixelFormat::Png, data: file.clone(), ..Default::default() };
        let mut grey = crate::image::GreyImage::default();
        crate::image::decode::Decoder::default().decode(&raw, &mut grey).expect("PNG");
        assert_eq!(grey.data, [0, 1, 2, 3, 4, 8, 9, 10, 11, 12, 16, 17, 18, 19, 20]);
        let yuyv = EncodedHeader { width: 4, height: 2, stride: 8, format: ENCODED_YUYV, ..header };
        assert_eq!(png(&yuyv, &data[..16], &mut file), Some(()));
        let raw = crate::frame::RawFrame { data: file.clone(), ..raw };
        crate::image::decode::Decoder::default().decode(&raw, &mut grey).expect("PNG");
        assert_eq!(grey.data, [0, 2, 4, 6, 8, 10, 12, 14]);
        for wrong in [
            EncodedHeader { height: 4, ..header },
            EncodedHeader { stride: 4, ..header },
            EncodedHeader { width: 0, ..header },
            EncodedHeader { height: 0, ..header },
        ] {
            assert_eq!(png(&wrong, &data, &mut file), None);
        }
    }
}
