//! The listening half of a recorder: a subscriber like any other.
//!
//! Input: the daemon's services. Output: [`Record`]s into the queue of the writing half. A daemon that stops, dies or starts anew meanwhile is waited
//! for; gaps in the numbers of pictures are counted and said. Raw pictures become PNG here (lossless), compressed ones are written as they came.

use std::time::{Duration, Instant};

use tracing::{info, warn};

use super::ShareError;
use super::events::Events;
use super::picture::compressed;
use super::records::{Converter, Record};
use super::sink::{Queue, Queued};
use crate::client::{
    Client, Encodeds, Graphs, Healths, Keyframes, Map, ObstacleScans, Poses, Subscription, TagLists, Topic,
    WheelReports, monotonic_ns,
};
use crate::messages::services::{MAX_WHEEL_PUBLISHERS, WHEEL};
use crate::messages::{EncodedHeader, Endpoint, Health, Pose};

/// Longest sleep: how late a signal is noticed while nothing comes.
pub const TURN: Duration = Duration::from_millis(50);
/// Between two looks for pictures: of six that wait for a reader none is lost at 200 a second, with room for a busy machine.
const LOOK_EVERY: Duration = Duration::from_millis(20);
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
    graph: Graphs,
    tags: TagLists,
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
    events: Events,
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
            // A recording is in no hurry, so the daemon need not wake anybody: not by a picture, which comes before the pose that it is for.
            encoded: client.encoded().polled(LOOK_EVERY),
            poses: client.poses().polled(TURN),
            map: client.map().polled(TURN),
            keyframes: client.keyframes().polled(TURN),
            graph: client.graph().polled(TURN),
            tags: client.tags().polled(TURN),
            health: client.health().polled(TURN),
            obstacles: client.obstacles().polled(TURN),
            wheels: None,
            client,
            converter: Converter::new(&prefix, realtime_minus_monotonic_ns),
            realtime_minus_monotonic_ns,
            queue,
            heard: Heard::default(),
            last_picture: None,
            last_run: None,
            events: Events::default(),
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
        self.take_map()?;
        let (mut poses, mut healths) = (Vec::new(), Vec::new());
        drain(&mut self.poses, |pose| poses.push(pose))?;
        drain(&mut self.health, |health| healths.push(health))?;
        for pose in poses {
            self.note_pose(&pose);
            self.converter.pose(&pose, &mut self.records);
        }
        if let Some(event) = self.events.look(self.poses.is_connected(), Instant::now()) {
            self.queue.event(event.name());
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

    /// The map, with what is sent just before it.
    fn take_map(&mut self) -> Result<(), ShareError> {
        let Self { converter, records, events, .. } = self;
        drain(&mut self.graph, |graph| converter.graph(graph.header(), &graph, records))?;
        drain(&mut self.tags, |tags| converter.tags(&tags, records))?;
        drain(&mut self.map, |map| converter.map(map.header(), &map, records))?;
        drain(&mut self.keyframes, |k| {
            events.keyframes(k.header());
            converter.keyframes(k.header(), &k, records);
        })
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
        if let Some((format, data)) = compressed(header, data, &mut self.png) {
            self.converter.picture(header, format, data, &mut self.records);
            return;
        }
        self.heard.unusable += 1;
        if self.is_news() {
            warn!(format = header.format, sequence = header.sequence, "picture of an unknown kind, not recorded");
        }
    }

    fn note_pose(&mut self, pose: &Pose) {
        let same_run = self.last_run.replace(pose.run_id) == Some(pose.run_id);
        if !same_run {
            self.heard.daemons += 1;
            info!(run_id = pose.run_id, daemons = self.heard.daemons, "recording a daemon");
        }
        if let Some(event) = self.events.pose(pose) {
            self.queue.event(event.name());
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
