//! The writing half of a recorder, and the bounded queue before it.
//!
//! The queue takes what the disk has not: [`QUEUE_BYTES`], some ten seconds to a minute. When it is full what comes next is dropped and counted, so
//! that a slow disk costs records and never memory, and nobody else anything. A disk with less than [`FLOOR_BYTES`] left ends the recording with its
//! file whole (a ring gives its oldest files first).

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, TrySendError, bounded};
use tracing::{info, warn};

use super::ShareError;
use super::file::{McapFile, Origin};
use super::records::{Record, Topic};
use super::ring::Ring;
use super::room::free_bytes;

/// Records that wait for the disk, bytes.
pub const QUEUE_BYTES: usize = 64 << 20;
/// And their number: a minute of what a daemon sends, pictures left out.
const QUEUE_RECORDS: usize = 16_384;
/// Left free on the disk for everybody else, bytes.
pub const FLOOR_BYTES: u64 = 64 << 20;
/// How often the files are looked after while nothing comes.
const TURN: Duration = Duration::from_millis(100);
/// How often the disk's room and the file's length are looked at.
const LOOK_EVERY: Duration = Duration::from_secs(1);

/// The sending end of the queue.
#[derive(Debug, Clone)]
pub struct Queue {
    records: Sender<Record>,
    /// Beside the records: when these are too many, one is to be heard the more.
    events: Sender<String>,
    waiting: Arc<AtomicUsize>,
    limit: usize,
}

/// What became of a record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Queued {
    Waits,
    /// There is no room: the disk is too slow.
    Dropped,
    /// Nobody writes any more.
    Closed,
}

impl Queue {
    /// Never waits.
    pub fn push(&self, record: Record) -> Queued {
        let bytes = record.data.len();
        if self.waiting.fetch_add(bytes, Ordering::Relaxed) + bytes <= self.limit {
            match self.records.try_send(record) {
                Ok(()) => return Queued::Waits,
                Err(TrySendError::Full(_)) => {}
                Err(TrySendError::Disconnected(_)) => return Queued::Closed,
            }
        }
        self.waiting.fetch_sub(bytes, Ordering::Relaxed);
        Queued::Dropped
    }

    /// Something happened that a ring is kept for.
    pub fn event(&self, name: &str) {
        // One that waits already stands for this one.
        let _ = self.events.try_send(name.into());
    }

    /// Bytes that wait.
    pub fn waiting(&self) -> usize {
        self.waiting.load(Ordering::Relaxed)
    }
}

/// What is written, and when it ends by itself.
#[derive(Debug, Clone)]
pub struct Plan {
    pub out: PathBuf,
    pub origin: Origin,
    /// The recording ends when its file is longer, bytes.
    pub max_bytes: Option<u64>,
    /// Keep the last so much in a ring instead.
    pub ring: Option<Duration>,
}

/// What was written.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Written {
    pub files: Vec<PathBuf>,
    pub bytes: u64,
    /// Messages by topic, in [`Topic::ALL`]'s order; of a ring all that went through it.
    pub messages: [u64; Topic::ALL.len()],
    /// The file grew as long as it may.
    pub at_limit: bool,
}

enum Target {
    File(Box<McapFile>),
    Ring(Box<Ring>),
}

/// The writing half, without its thread.
pub struct Sink {
    plan: Plan,
    target: Target,
    records: Receiver<Record>,
    events: Receiver<String>,
    waiting: Arc<AtomicUsize>,
    messages: [u64; Topic::ALL.len()],
    looked: Instant,
    floor: u64,
}

/// Makes the file (or finds the ring), and the queue before it.
pub fn open(plan: &Plan) -> Result<(Queue, Sink), ShareError> {
    open_with(plan, QUEUE_BYTES, FLOOR_BYTES)
}

fn open_with(plan: &Plan, limit: usize, floor: u64) -> Result<(Queue, Sink), ShareError> {
    let target = match plan.ring {
        Some(length) => Target::Ring(Box::new(Ring::open(&plan.out, &plan.origin, length, floor)?)),
        None => Target::File(Box::new(McapFile::create(&plan.out, &plan.origin)?)),
    };
    let (records, queue) = bounded(QUEUE_RECORDS);
    let (events, heard) = bounded(1);
    let waiting = Arc::new(AtomicUsize::new(0));
    let sink = Sink {
        plan: plan.clone(),
        target,
        records: queue,
        events: heard,
        waiting: waiting.clone(),
        messages: [0; Topic::ALL.len()],
        looked: Instant::now(),
        floor,
    };
    Ok((Queue { records, events, waiting, limit }, sink))
}

impl Sink {
    /// Writes until the queue's other end is gone and all is written, or until it cannot go on.
    pub fn serve(mut self) -> Result<Written, ShareError> {
        let outcome = self.write_all();
        let closed = self.close(if outcome.is_ok() { "STOPPED" } else { "FAILED" });
        // What ended the recording says more than what followed from it.
        let at_limit = outcome?;
        closed.map(|written| Written { at_limit, ..written })
    }

    /// `true`: as long as it may get.
    fn write_all(&mut self) -> Result<bool, ShareError> {
        loop {
            let record = self.records.recv_timeout(TURN);
            if let (Target::Ring(ring), Ok(name)) = (&mut self.target, self.events.try_recv()) {
                ring.event(&name);
            }
            match record {
                Ok(record) => {
                    self.waiting.fetch_sub(record.data.len(), Ordering::Relaxed);
                    self.write(&record)?;
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return Ok(false),
            }
            match &mut self.target {
                Target::File(file) => file.tend()?,
                Target::Ring(ring) => ring.tend()?,
            }
            if self.looked.elapsed() >= LOOK_EVERY {
                self.looked = Instant::now();
                self.look_for_room()?;
                if let (Target::File(file), Some(limit)) = (&self.target, self.plan.max_bytes)
                    && file.bytes() >= limit
                {
                    info!(path = %file.path().display(), mb = file.bytes() >> 20, "recording as long as it may get");
                    return Ok(true);
                }
            }
        }
    }

    fn write(&mut self, record: &Record) -> Result<(), ShareError> {
        if let Some(index) = Topic::ALL.iter().position(|topic| *topic == record.topic) {
            self.messages[index] += 1;
        }
        match &mut self.target {
            Target::File(file) => file.write(record),
            Target::Ring(ring) => ring.write(record),
        }
    }

    fn look_for_room(&mut self) -> Result<(), ShareError> {
        while let Some(free) = free_bytes(&self.plan.out).filter(|free| *free < self.floor) {
            let made_room = match &mut self.target {
                Target::Ring(ring) => ring.drop_oldest(),
                Target::File(_) => false,
            };
            if !made_room {
                return Err(ShareError::DiskFull {
                    path: self.plan.out.display().to_string(),
                    free_mb: free >> 20,
                    floor_mb: self.floor >> 20,
                });
            }
            warn!(free_mb = free >> 20, "disk nearly full, the ring gives its oldest file");
        }
        Ok(())
    }

    fn close(self, name: &str) -> Result<Written, ShareError> {
        let (files, bytes) = match self.target {
            Target::File(file) => {
                let path = file.path().to_owned();
                let bytes = file.finish()?;
                (vec![path], bytes)
            }
            Target::Ring(ring) => {
                let files = ring.finish(name)?;
                let length = |path: &PathBuf| std::fs::metadata(path).map_or(0, |m| m.len());
                let bytes = files.iter().map(length).sum();
                (files, bytes)
            }
        };
        Ok(Written { files, bytes, messages: self.messages, at_limit: false })
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn plan(folder: &Path, ring: Option<Duration>) -> Plan {
        let origin = Origin { prefix: "robot".into(), realtime_minus_monotonic_ns: 7 };
        Plan { out: folder.join("out.mcap"), origin, max_bytes: None, ring }
    }

    fn record(bytes: usize, time_ns: i64) -> Record {
        Record { topic: Topic::Image, time_ns, data: vec![1; bytes] }
    }

    #[test]
    fn a_disk_that_is_too_slow_costs_records_and_no_memory() {
        let folder = tempfile::tempdir().expect("folder");
        let (queue, sink) = open_with(&plan(folder.path(), None), 1000, 0).expect("open");
        let fates: Vec<Queued> = (0..5).map(|i| queue.push(record(300, i))).collect();
        assert_eq!(fates, [Queued::Waits, Queued::Waits, Queued::Waits, Queued::Dropped, Queued::Dropped]);
        assert_eq!(queue.waiting(), 900);
        drop(queue);
        let written = sink.serve().expect("written");
        assert_eq!(written.messages[0], 3);
    }

    #[test]
    fn a_full_disk_ends_the_recording_with_its_file_whole() {
        let folder = tempfile::tempdir().expect("folder");
        let (queue, sink) = open_with(&plan(folder.path(), None), QUEUE_BYTES, u64::MAX).expect("open");
        assert_eq!(queue.push(record(300, 1)), Queued::Waits);
        // The sender lives: only the disk ends this.
        let error = sink.serve().expect_err("full").to_string();
        assert!(error.contains("out.mcap") && error.contains("MB"), "{error}");
        assert_eq!(queue.push(record(300, 2)), Queued::Closed);
        let bytes = std::fs::read(folder.path().join("out.mcap")).expect("file");
        let messages = mcap::MessageStream::new(&bytes).expect("whole").map(|m| m.expect("message").log_time);
        assert_eq!(messages.collect::<Vec<_>>(), [1]);
        assert!(mcap::Summary::read(&bytes).expect("summary").is_some(), "it has its summary");
    }

    #[test]
    fn a_ring_is_kept_as_one_file_and_goes() {
        let folder = tempfile::tempdir().expect("folder");
        let plan = plan(folder.path(), Some(Duration::from_secs(60)));
        let (queue, sink) = open_with(&plan, QUEUE_BYTES, 0).expect("open");
        (0..20).for_each(|i| assert_eq!(queue.push(record(100_000, i)), Queued::Waits));
        queue.event("LOST");
        drop(queue);
        let written = sink.serve().expect("written");
        assert_eq!(written.files.len(), 1, "{written:?}");
        let name = written.files[0].file_name().expect("name").to_string_lossy().into_owned();
        assert!(name.starts_with("out-20") && name.ends_with("Z-LOST.mcap"), "{name}");
        let bytes = std::fs::read(&written.files[0]).expect("file");
        assert_eq!(mcap::MessageStream::new(&bytes).expect("whole").count(), 20);
        assert!(!folder.path().join("out.ring").exists());
    }

    #[test]
    fn the_ring_of_a_killed_recorder_is_gone_on_with() {
        let folder = tempfile::tempdir().expect("folder");
        let plan = plan(folder.path(), Some(Duration::from_secs(60)));
        std::fs::create_dir(folder.path().join("out.ring")).expect("folder");
        let left = folder.path().join("out.ring/00000004.mcap");
        let mut file = McapFile::create(&left, &plan.origin).expect("file");
        file.write(&record(2 << 20, 5)).expect("written, and flushed as a chunk");
        // Killed: no summary.
        std::mem::forget(file);
        let (queue, sink) = open_with(&plan, QUEUE_BYTES, 0).expect("open");
        assert_eq!(queue.push(record(10, 6)), Queued::Waits);
        drop(queue);
        let written = sink.serve().expect("written");
        let bytes = std::fs::read(&written.files[0]).expect("file");
        let times: Vec<u64> =
            mcap::MessageStream::new(&bytes).expect("whole").map(|m| m.expect("message").log_time).collect();
        assert_eq!(times, [5, 6]);
        // Readers take the whole file to begin where the first of its chunks does.
        let summary = mcap::Summary::read(&bytes).expect("read").expect("there is one");
        assert_eq!(summary.chunk_indexes.iter().map(|chunk| chunk.message_start_time).min(), Some(5));
    }
}
