//! The last minutes, on disk, in short files; kept as one file when something happens.
//!
//! `OUT.mcap` names the ring: its folder is `OUT.ring`, with a file for every ten seconds, whole by itself; the oldest is removed when the rest
//! covers the minutes asked for. What is kept is `OUT-20261123T142517Z-LOST.mcap`, written beside it from the files of the ring: until ten seconds after
//! the event. A recorder that is killed leaves its ring; the next one with the same name goes on in it. Bounded: the ring by time and by the
//! disk's floor, what is kept by [`MAX_KEPT`] a run.

use std::collections::VecDeque;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime};

use tracing::{info, warn};

use super::ShareError;
use super::copy::copy;
use super::file::{McapFile, Origin};
use super::records::Record;
use super::room::free_bytes;

/// Length of one file of the ring.
const SEGMENT: Duration = Duration::from_secs(10);
/// So much of what follows an event is kept with it.
const AFTER: Duration = Duration::from_secs(10);
/// Files that one run keeps; more would fill a disk while nobody looks.
pub const MAX_KEPT: usize = 50;

/// A closed file of the ring.
struct Segment {
    path: PathBuf,
    closed: Instant,
}

/// See module.
pub struct Ring {
    out: PathBuf,
    folder: PathBuf,
    origin: Origin,
    length: Duration,
    /// Left free on the disk, bytes.
    floor: u64,
    segments: VecDeque<Segment>,
    current: Option<McapFile>,
    next_number: u64,
    /// The newest message: while nothing comes nothing grows old, or the ring of a robot that died at night would be empty in the morning.
    written: Instant,
    /// Nobody else writes into the folder as long as this is open.
    _lock: File,
    /// What is to be kept, and when.
    pending: Option<(String, Instant)>,
    kept: Vec<PathBuf>,
}

impl Ring {
    /// Makes or finds the folder; what another recorder left in it belongs to this ring.
    pub fn open(out: &Path, origin: &Origin, length: Duration, floor: u64) -> Result<Self, ShareError> {
        let folder = out.with_extension("ring");
        fs::create_dir_all(&folder).map_err(|e| ShareError::write(&folder, e))?;
        let lock = File::open(&folder).map_err(|e| ShareError::read(&folder, e))?;
        if lock.try_lock().is_err() {
            return Err(ShareError::write(&folder, "another recorder writes into this ring"));
        }
        let now = Instant::now();
        let mut left = Vec::new();
        for entry in fs::read_dir(&folder).map_err(|e| ShareError::read(&folder, e))?.flatten() {
            let path = entry.path();
            let number = path.file_stem().and_then(|stem| stem.to_str()).and_then(|stem| stem.parse::<u64>().ok());
            let age =
                entry.metadata().and_then(|m| m.modified()).ok().and_then(|t| t.elapsed().ok()).unwrap_or_default();
            let closed = now.checked_sub(age).unwrap_or(now);
            if let (Some(number), Some("mcap")) = (number, path.extension().and_then(|e| e.to_str())) {
                left.push((number, Segment { path, closed }));
            }
        }
        left.sort_by_key(|(number, _)| *number);
        let next_number = left.last().map_or(0, |(number, _)| number + 1);
        if !left.is_empty() {
            info!(folder = %folder.display(), files = left.len(), "ring of an earlier recorder taken over");
        }
        Ok(Self {
            out: out.to_owned(),
            folder,
            origin: origin.clone(),
            length,
            floor,
            segments: left.into_iter().map(|(_, segment)| segment).collect(),
            current: None,
            next_number,
            written: now,
            _lock: lock,
            pending: None,
            kept: Vec::new(),
        })
    }

    /// Appends one message.
    pub fn write(&mut self, record: &Record) -> Result<(), ShareError> {
        if self.current.as_ref().is_some_and(|file| file.age() >= SEGMENT) {
            self.close()?;
        }
        if self.current.is_none() {
            let path = self.folder.join(format!("{:08}.mcap", self.next_number));
            self.next_number += 1;
            self.current = Some(McapFile::create(&path, &self.origin)?);
        }
        self.written = Instant::now();
        self.current.as_mut().map_or(Ok(()), |file| file.write(record))
    }

    /// Something happened: the ring is kept, with what comes next. While one is to be kept another event changes nothing.
    pub fn event(&mut self, name: &str) {
        if self.pending.is_none() {
            info!(event = name, "event, the ring will be kept");
            self.pending = Some((name.to_owned(), Instant::now() + AFTER));
        }
    }

    /// Closes chunks, removes what is too old, keeps what is due. To be called several times a second.
    pub fn tend(&mut self) -> Result<(), ShareError> {
        if let Some(file) = &mut self.current {
            file.tend()?;
        }
        self.prune(self.length);
        if self.pending.as_ref().is_some_and(|(_, due)| Instant::now() >= *due)
            && let Some((name, _)) = self.pending.take()
        {
            self.keep(&name)?;
        }
        Ok(())
    }

    fn prune(&mut self, length: Duration) {
        let written = self.written;
        let old = |segment: &Segment| written.saturating_duration_since(segment.closed) > length;
        while self.segments.front().is_some_and(old) {
            self.drop_oldest();
        }
    }

    /// Makes room; `false` if there is nothing left to remove.
    pub fn drop_oldest(&mut self) -> bool {
        let Some(segment) = self.segments.pop_front() else { return false };
        if let Err(error) = fs::remove_file(&segment.path) {
            warn!(path = %segment.path.display(), %error, "file of the ring cannot be removed");
        }
        true
    }

    fn close(&mut self) -> Result<(), ShareError> {
        if let Some(file) = self.current.take() {
            let path = file.path().to_owned();
            file.finish()?;
            self.segments.push_back(Segment { path, closed: Instant::now() });
        }
        Ok(())
    }

    /// One file of all that the ring holds.
    fn keep(&mut self, name: &str) -> Result<(), ShareError> {
        self.close()?;
        if self.kept.len() >= MAX_KEPT {
            warn!(event = name, kept = self.kept.len(), "ring not kept, there are as many files of it as there may be");
            return Ok(());
        }
        let length = |segment: &Segment| fs::metadata(&segment.path).map_or(0, |m| m.len());
        let needed: u64 = self.segments.iter().map(length).sum();
        if let Some(free) = free_bytes(&self.out).filter(|free| *free < needed.saturating_add(self.floor)) {
            let (free_mb, needed_mb) = (free >> 20, needed >> 20);
            warn!(event = name, free_mb, needed_mb, "ring not kept, the disk has no room for a copy of it");
            return Ok(());
        }
        let stem = self.out.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
        let time = utc(SystemTime::now());
        let path = self.out.with_file_name(format!("{stem}-{time}-{name}.mcap"));
        let began = Instant::now();
        let mut file = McapFile::create(&path, &self.origin)?;
        for segment in &self.segments {
            // One that a killed recorder left may end early; all that is whole is taken.
            if let Err(reason) = copy(&segment.path, &mut file)? {
                warn!(path = %segment.path.display(), reason, "file of the ring is cut off");
            }
        }
        let bytes = file.finish()?;
        let took_ms = began.elapsed().as_millis() as u64;
        info!(path = %path.display(), mb = bytes >> 20, took_ms, event = name, "ring kept");
        self.kept.push(path);
        Ok(())
    }

    /// Keeps what is pending, or everything under `name`, and removes the ring.
    pub fn finish(mut self, name: &str) -> Result<Vec<PathBuf>, ShareError> {
        let name = self.pending.take().map_or_else(|| name.to_owned(), |(name, _)| name);
        if self.current.is_some() || !self.segments.is_empty() {
            let kept = self.kept.len();
            self.keep(&name)?;
            if self.kept.len() == kept {
                // Not kept: what there is stays where it is.
                let left: Vec<PathBuf> = self.segments.iter().map(|segment| segment.path.clone()).collect();
                return Ok(self.kept.into_iter().chain(left).collect());
            }
        }
        while self.drop_oldest() {}
        // It stays if somebody has put something into it.
        let _ = fs::remove_dir(&self.folder);
        Ok(self.kept)
    }
}

/// `20261123T142517Z`.
fn utc(time: SystemTime) -> String {
    let seconds = time.duration_since(SystemTime::UNIX_EPOCH).map_or(0, |t| t.as_secs());
    let (days, second) = (seconds / 86_400, seconds % 86_400);
    // Days since 0000-03-01, in eras of 400 years (146,097 days), years that begin in March.
    let z = days + 719_468;
    let (era, day_of_era) = (z / 146_097, z % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1_460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let from_march = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * from_march + 2) / 5 + 1;
    let month = if from_march < 10 { from_march + 3 } else { from_march - 9 };
    let year = era * 400 + year_of_era + u64::from(month <= 2);
    format!("{year:04}{month:02}{day:02}T{:02}{:02}{:02}Z", second / 3600, second / 60 % 60, second % 60)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_has_its_date() {
        for (seconds, text) in [
            (0, "19700101T000000Z"),
            (951_782_400, "20000229T000000Z"),
            (1_767_225_599, "20251231T235959Z"),
            (4_107_542_400, "21000301T000000Z"),
        ] {
            assert_eq!(utc(SystemTime::UNIX_EPOCH + Duration::from_secs(seconds)), text);
        }
    }
}
