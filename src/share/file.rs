//! One MCAP file in the writing.
//!
//! Input: [`Record`]s. Output: a file whose chunks (at most 1 MB or a second) are each complete in the kernel's hands before the next begins, so that
//! a process that is killed leaves everything but the last second; every five seconds the disk is asked to keep it, for a power cut. Index and
//! summary come with [`McapFile::finish`].
//!
//! Compression: LZ4. Nearly all bytes are JPEGs or PNGs, of which neither LZ4 nor Zstandard makes less, and poses and health pay for LZ4's time.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{BufWriter, ErrorKind};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use mcap::records::{MessageHeader, Metadata};
use mcap::{Compression, WriteOptions, Writer};

use super::ShareError;
use super::records::{Record, Topic};

/// A chunk is closed once it is longer, bytes.
const CHUNK_BYTES: u64 = 1 << 20;
/// And when it is as old: what a killed recorder loses at most.
const CHUNK_AGE: Duration = Duration::from_secs(1);
/// The disk is asked to keep what it has: what a power cut takes at most.
const SYNC_EVERY: Duration = Duration::from_secs(5);

/// What stands in every file beside its messages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Origin {
    /// Of the daemon's services.
    pub prefix: String,
    /// CLOCK_REALTIME minus CLOCK_MONOTONIC that all times of the recording have in them, ns.
    pub realtime_minus_monotonic_ns: i64,
}

/// See module.
pub struct McapFile {
    path: PathBuf,
    prefix: String,
    writer: Writer<BufWriter<File>>,
    /// The same file, wherever it is moved meanwhile.
    file: File,
    channels: [u16; Topic::ALL.len()],
    /// Messages by topic, in [`Topic::ALL`]'s order.
    messages: [u64; Topic::ALL.len()],
    /// Bytes of messages since the last flush.
    pending: u64,
    flushed: Instant,
    synced: Instant,
    made: Instant,
}

impl McapFile {
    /// Makes a file that must not exist, with all topics in it.
    pub fn create(path: &Path, origin: &Origin) -> Result<Self, ShareError> {
        let file = OpenOptions::new().write(true).create_new(true).open(path).map_err(|e| match e.kind() {
            ErrorKind::AlreadyExists => ShareError::Exists { path: path.display().to_string() },
            _ => ShareError::write(path, e),
        })?;
        let own = file.try_clone().map_err(|e| ShareError::write(path, e))?;
        let failed = |e: mcap::McapError| ShareError::write(path, reason(&e));
        let mut writer = WriteOptions::new()
            .profile("ros2")
            .library(concat!("cairn ", env!("CARGO_PKG_VERSION")))
            .compression(Some(Compression::Lz4))
            .compression_threads(0)
            .chunk_size(Some(CHUNK_BYTES))
            // A chunk comes whole, with its length, and is not patched afterwards: whenever the process dies, no reader meets a lie.
            .disable_seeking(true)
            .create(BufWriter::new(file))
            .map_err(failed)?;
        let metadata = BTreeMap::from([
            ("prefix".to_owned(), origin.prefix.clone()),
            ("realtime_minus_monotonic_ns".to_owned(), origin.realtime_minus_monotonic_ns.to_string()),
            ("version".to_owned(), env!("CARGO_PKG_VERSION").to_owned()),
        ]);
        // First, as it ends a chunk: one without a message begins in 1970, and so does the whole file to readers that look at chunks.
        writer.write_metadata(&Metadata { name: "cairn".into(), metadata }).map_err(failed)?;
        let mut channels = [0; Topic::ALL.len()];
        for (id, topic) in channels.iter_mut().zip(Topic::ALL) {
            let (name, definition) = topic.schema();
            let schema = writer.add_schema(name, "ros2msg", definition.as_bytes()).map_err(failed)?;
            *id = writer.add_channel(schema, &topic.name(&origin.prefix), "cdr", &BTreeMap::new()).map_err(failed)?;
        }
        let (path, now) = (path.to_owned(), Instant::now());
        let messages = [0; Topic::ALL.len()];
        let prefix = origin.prefix.clone();
        Ok(Self {
            path,
            prefix,
            writer,
            file: own,
            channels,
            messages,
            pending: 0,
            flushed: now,
            synced: now,
            made: now,
        })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Of the daemon's services.
    pub fn prefix(&self) -> &str {
        &self.prefix
    }

    /// How long ago it was made.
    pub fn age(&self) -> Duration {
        self.made.elapsed()
    }

    /// Appends one message.
    pub fn write(&mut self, record: &Record) -> Result<(), ShareError> {
        let index = Topic::ALL.iter().position(|topic| *topic == record.topic).unwrap_or(0);
        let time = u64::try_from(record.time_ns).unwrap_or(0);
        let header = MessageHeader {
            channel_id: self.channels[index],
            sequence: u32::try_from(self.messages[index] & u64::from(u32::MAX)).unwrap_or(0),
            log_time: time,
            publish_time: time,
        };
        self.messages[index] += 1;
        self.pending += record.data.len() as u64;
        let written = self.writer.write_to_known_channel(&header, &record.data);
        written.map_err(|e| ShareError::write(&self.path, reason(&e)))?;
        if self.pending >= CHUNK_BYTES { self.flush() } else { Ok(()) }
    }

    /// Closes a chunk that is old enough. To be called several times a second.
    pub fn tend(&mut self) -> Result<(), ShareError> {
        if self.pending > 0 && self.flushed.elapsed() >= CHUNK_AGE {
            self.flush()?;
        }
        if self.synced.elapsed() >= SYNC_EVERY {
            self.synced = Instant::now();
            self.file.sync_data().map_err(|e| ShareError::write(&self.path, e))?;
        }
        Ok(())
    }

    fn flush(&mut self) -> Result<(), ShareError> {
        (self.pending, self.flushed) = (0, Instant::now());
        self.writer.flush().map_err(|e| ShareError::write(&self.path, reason(&e)))
    }

    /// Bytes of the file so far.
    pub fn bytes(&self) -> u64 {
        self.file.metadata().map_or(0, |m| m.len())
    }

    /// Writes index and summary, and waits for the disk; the bytes of the whole file.
    pub fn finish(mut self) -> Result<u64, ShareError> {
        let path = self.path.clone();
        let failed = |e: std::io::Error| ShareError::write(&path, e);
        self.writer.finish().map_err(|e| ShareError::write(&path, reason(&e)))?;
        let file = self.writer.into_inner().into_inner().map_err(|e| failed(e.into_error()))?;
        file.sync_all().map_err(failed)?;
        file.metadata().map(|m| m.len()).map_err(failed)
    }
}

/// What the system says, not that it said something.
pub fn reason(error: &mcap::McapError) -> String {
    match error {
        mcap::McapError::Io(e) => e.to_string(),
        mcap::McapError::Parse(e) => format!("a record cannot be parsed ({e})"),
        e => e.to_string(),
    }
}
