//! The side that has the maps.
//!
//! Input: queries, as Zenoh's threads put them into a bounded queue. Output: offers and pieces. A file that is offered stays open, so that it is the same
//! one until it was fetched; [`MOST_HELD`] at a time. It is read without a lock, which could keep a daemon from its map: whether it has changed since
//! is seen by its size and time, and by the checksum.

use std::fs::{File, Metadata};
use std::os::unix::fs::{FileExt, MetadataExt};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::time::{Duration, Instant};

use tracing::{info, warn};
use xxhash_rust::xxh3::Xxh3;
use zenoh::Wait;
use zenoh::query::{Parameters, Query};

use super::offer::{MAP, MOST_BYTES, OFFSET, Offer, PIECE, VERSION};
use crate::share::bridge::reason;

/// Requests that wait.
const QUEUE: usize = 8;
/// How late the end is noticed.
const TURN: Duration = Duration::from_millis(100);
/// Files that are offered at a time.
const MOST_HELD: usize = 4;
/// A file of which so long no piece was asked for is offered no more: whoever fetches tries again for as long at the most.
const IDLE: Duration = Duration::from_secs(60);

/// Where the maps are.
pub trait Shelf: Send {
    /// The file of this name, which nobody need check before. The error is a sentence for whoever asks.
    fn open(&mut self, name: &str) -> Result<File, String>;
}

/// Where queries go. `Q`: what is answered.
#[derive(Clone)]
pub struct Requests<Q = Query> {
    queue: SyncSender<Request<Q>>,
    dropped: Arc<AtomicU64>,
}

/// `key`: of the answer; that of the query may be a pattern.
struct Request<Q = Query> {
    query: Q,
    key: String,
}

impl<Q> Requests<Q> {
    fn new() -> (Self, Receiver<Request<Q>>) {
        let (queue, requests) = sync_channel(QUEUE);
        (Self { queue, dropped: Arc::default() }, requests)
    }

    /// Never waits: a request that finds the queue full is dropped. A refusal would end what whoever asked is fetching; without an answer
    /// he asks again.
    pub fn push(&self, query: Q, key: &str) {
        // At the end, when nobody takes them any more, it is neither full nor worth a word.
        if let Err(TrySendError::Full(_)) = self.queue.try_send(Request { query, key: key.into() }) {
            let dropped = self.dropped.fetch_add(1, Ordering::Relaxed) + 1;
            warn!(dropped, "too many requests for maps at once, one is not answered");
        }
    }
}

fn refuse(query: &Query, reason: &str) {
    // Whoever asked may have gone.
    let _ = query.reply_err(reason).wait();
}

/// A file at one time.
#[derive(Debug, PartialEq, Eq)]
struct State {
    bytes: u64,
    modified: (i64, i64),
}

impl State {
    fn of(about: &Metadata) -> Self {
        Self { bytes: about.len(), modified: (about.mtime(), about.mtime_nsec()) }
    }
}

struct Held {
    name: String,
    offer: Offer,
    file: File,
    state: State,
    used: Instant,
    is_done: bool,
}

/// See module.
pub struct Giver {
    shelf: Box<dyn Shelf>,
    requests: Receiver<Request>,
    held: Vec<Held>,
    offers: u64,
}

impl Giver {
    pub fn new(shelf: Box<dyn Shelf>) -> (Self, Requests) {
        let (sender, requests) = Requests::new();
        (Self { shelf, requests, held: Vec::new(), offers: 0 }, sender)
    }

    /// Until it is told to stop, or nobody can ask any more.
    pub fn serve(mut self, stop: &AtomicBool) {
        while !stop.load(Ordering::Relaxed) {
            self.held.retain(|held| held.used.elapsed() <= IDLE);
            match self.requests.recv_timeout(TURN) {
                Ok(Request { query, key }) => self.reply(&query, key),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    fn reply(&mut self, query: &Query, key: String) {
        match self.answer(query.parameters(), Instant::now()) {
            Ok(bytes) => {
                if let Err(error) = query.reply(key, bytes).wait() {
                    warn!(error = reason(&error), "answer of a map not sent");
                }
            }
            Err(reason) => refuse(query, &reason),
        }
    }

    fn answer(&mut self, asked: &Parameters<'_>, now: Instant) -> Result<Vec<u8>, String> {
        let name = asked.get(MAP).ok_or("no map is named")?;
        match (asked.get(VERSION), asked.get(OFFSET)) {
            (None, None) => self.offer(name, now).map(|offer| offer.to_text().into_bytes()),
            (Some(version), Some(offset)) => {
                let offset = offset.parse().map_err(|_| "where the piece begins is no number")?;
                self.piece(name, version, offset, now)
            }
            _ => Err("a piece has a version and an offset".into()),
        }
    }

    fn offer(&mut self, name: &str, now: Instant) -> Result<Offer, String> {
        self.held.retain(|held| now.saturating_duration_since(held.used) <= IDLE);
        if self.held.len() >= MOST_HELD {
            let done = self.held.iter().position(|held| held.is_done);
            let done = done.ok_or_else(|| format!("{MOST_HELD} maps are being fetched; try again in a minute"))?;
            self.held.remove(done);
        }
        let file = self.shelf.open(name)?;
        let failed = |e: std::io::Error| format!("the map {name} cannot be read: {e}");
        let state = State::of(&file.metadata().map_err(failed)?);
        if !(1..=MOST_BYTES).contains(&state.bytes) {
            return Err(format!("the map {name} has {} bytes, 1 to {MOST_BYTES} are given", state.bytes));
        }
        let checksum = checksum(&file, state.bytes).map_err(failed)?;
        self.offers += 1;
        let offer = Offer { bytes: state.bytes, checksum, version: self.offers.to_string() };
        info!(map = name, bytes = offer.bytes, "map asked for over Zenoh");
        self.held.push(Held {
            name: name.into(),
            offer: offer.clone(),
            file,
            state,
            used: now.max(Instant::now()),
            is_done: false,
        });
        Ok(offer)
    }

    fn piece(&mut self, name: &str, version: &str, offset: u64, now: Instant) -> Result<Vec<u8>, String> {
        let held = self.held.iter().position(|held| held.name == name && held.offer.version == version);
        let index = held.ok_or("it is offered no more; ask again")?;
        let held = &mut self.held[index];
        let failed = |e: std::io::Error| format!("the map {name} cannot be read: {e}");
        if State::of(&held.file.metadata().map_err(failed)?) != held.state {
            self.held.remove(index);
            return Err(format!("the map {name} has changed since; ask again"));
        }
        let bytes = held.offer.piece(offset);
        if bytes == 0 {
            return Err(format!("there is nothing at byte {offset}"));
        }
        // At most PIECE.
        let mut piece = vec![0; usize::try_from(bytes).unwrap_or_default()];
        held.file.read_exact_at(&mut piece, offset).map_err(failed)?;
        held.used = now;
        held.is_done |= offset + bytes == held.offer.bytes;
        Ok(piece)
    }
}

fn checksum(file: &File, bytes: u64) -> std::io::Result<u128> {
    let (mut sum, mut piece, mut at) = (Xxh3::new(), vec![0; PIECE as usize], 0);
    while at < bytes {
        let wanted = usize::try_from((bytes - at).min(PIECE)).unwrap_or_default();
        file.read_exact_at(&mut piece[..wanted], at)?;
        sum.update(&piece[..wanted]);
        at += wanted as u64;
    }
    Ok(sum.digest128())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::PathBuf;

    struct Folder(PathBuf);

    impl Shelf for Folder {
        fn open(&mut self, name: &str) -> Result<File, String> {
            File::open(self.0.join(name)).map_err(|_| format!("there is no map {name}"))
        }
    }

    fn giver(contents: &[u8]) -> (tempfile::TempDir, Giver) {
        let folder = tempfile::tempdir().expect("folder");
        std::fs::write(folder.path().join("attic"), contents).expect("written");
        let giver = Giver::new(Box::new(Folder(folder.path().into()))).0;
        (folder, giver)
    }

    fn ask(giver: &mut Giver, text: &str, now: Instant) -> Result<Vec<u8>, String> {
        giver.answer(&Parameters::from(text), now)
    }

    fn offered(giver: &mut Giver, now: Instant) -> Offer {
        let text = ask(giver, "map=attic", now).expect("an offer");
        Offer::of_text(std::str::from_utf8(&text).expect("text")).expect("an offer")
    }

    #[test]
    fn a_request_that_finds_the_queue_full_is_dropped_and_counted() {
        let (requests, queue) = Requests::new();
        // Whoever has another end of it counts on.
        let other = requests.clone();
        let dropped = || other.dropped.load(Ordering::Relaxed);
        (0..QUEUE).for_each(|i| requests.push(i, "key"));
        assert_eq!(dropped(), 0);
        requests.push(QUEUE, "key");
        other.push(QUEUE, "key");
        assert_eq!(dropped(), 2);
        // There is room again, and what waited is what came first.
        assert_eq!(queue.recv().map(|request| request.query), Ok(0));
        requests.push(100, "key");
        let waiting: Vec<usize> = queue.try_iter().map(|request| request.query).collect();
        assert_eq!((waiting, dropped()), ((1..QUEUE).chain([100]).collect(), 2));
    }

    #[test]
    fn pieces_make_the_file_that_was_offered() {
        let contents: Vec<u8> = (0..2 * PIECE + 5).map(|i| (i * i / 7) as u8).collect();
        let (folder, mut giver) = giver(&contents);
        let now = Instant::now();
        let offer = offered(&mut giver, now);
        assert_eq!(offer.checksum, xxhash_rust::xxh3::xxh3_128(&contents));
        // Another file of this name is none of what was offered.
        std::fs::remove_file(folder.path().join("attic")).expect("removed");
        let mut fetched = Vec::new();
        while (fetched.len() as u64) < offer.bytes {
            let asked = format!("map=attic;version={};offset={}", offer.version, fetched.len());
            fetched.extend(ask(&mut giver, &asked, now).expect("a piece"));
        }
        assert!(fetched == contents);
        for wrong in ["", "map=attic;version=1", "map=attic;version=1;offset=x", "map=cellar;version=1;offset=0"] {
            assert!(ask(&mut giver, wrong, now).is_err(), "{wrong}");
        }
        let end = format!("map=attic;version=1;offset={}", offer.bytes);
        assert!(ask(&mut giver, &end, now).is_err_and(|e| e.contains("nothing at byte")));
        assert!(ask(&mut giver, "map=cellar", now).is_err_and(|e| e == "there is no map cellar"));
    }

    #[test]
    fn what_has_changed_or_was_left_is_given_no_more() {
        let (folder, mut giver) = giver(b"map");
        let now = Instant::now();
        offered(&mut giver, now);
        std::fs::write(folder.path().join("attic"), "longer").expect("written");
        let piece = "map=attic;version=1;offset=0";
        assert!(ask(&mut giver, piece, now).is_err_and(|e| e.contains("has changed")));
        assert!(ask(&mut giver, piece, now).is_err_and(|e| e.contains("offered no more")));
        for _ in 0..MOST_HELD {
            offered(&mut giver, now);
        }
        assert!(ask(&mut giver, "map=attic", now).is_err_and(|e| e.contains("are being fetched")));
        // One that was fetched makes room, and those that nobody fetches do in time.
        assert_eq!(ask(&mut giver, "map=attic;version=4;offset=0", now).expect("a piece"), b"longer");
        offered(&mut giver, now);
        assert!(ask(&mut giver, "map=attic", now).is_err());
        offered(&mut giver, now + IDLE + TURN);
        assert_eq!(giver.held.len(), 1);
    }
}
