//! Who looks at the console, and what each newcomer is told at once.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::history::History;
use super::outbox::Outbox;
use super::wire::{self, Bytes, KINDS, Kind};

/// Pages at most; each costs two threads and what waits for it (a few pictures' bytes).
pub const MAX_PAGES: usize = 32;

/// What a page shows, as bits.
pub mod demand {
    pub const VIDEO: u32 = 1;
    pub const MAP: u32 = 2;
    pub const LOG: u32 = 4;
    pub const COVISIBLE: u32 = 8;
    pub const CALIBRATION: u32 = 16;
    pub const OBSTACLES: u32 = 32;
}

/// See module.
#[derive(Debug, Default)]
pub struct Hub {
    pages: Mutex<Vec<Arc<Outbox>>>,
    /// The newest of the kinds that a newcomer needs.
    last: Mutex<[Option<Bytes>; KINDS]>,
    pub history: Mutex<History>,
    /// The newest records of the daemon's log, as JSON.
    log: Mutex<VecDeque<serde_json::Value>>,
}

/// Records of the log that a newcomer gets.
const LOG: usize = 400;

/// What nobody can leave half done is usable after a panic elsewhere.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Hub {
    /// A page comes; `None` if there are too many.
    pub fn join(&self) -> Option<Arc<Outbox>> {
        let mut pages = lock(&self.pages);
        (pages.len() < MAX_PAGES).then(|| {
            let page = Arc::new(Outbox::default());
            pages.push(page.clone());
            page
        })
    }

    pub fn leave(&self, page: &Arc<Outbox>) {
        page.close();
        lock(&self.pages).retain(|other| !Arc::ptr_eq(other, page));
    }

    /// All that a page that has just said who it is must know.
    pub fn greet(&self, page: &Outbox) {
        page.put(Kind::History, wire::samples(Kind::History, lock(&self.history).samples()));
        self.replay(page, &[Kind::State, Kind::Keyframes, Kind::Ties, Kind::Map]);
    }

    /// The newest messages of these kinds, to a page that has missed them.
    pub fn replay(&self, page: &Outbox, kinds: &[Kind]) {
        let last = lock(&self.last);
        for kind in kinds {
            if let Some(message) = &last[*kind as usize] {
                page.put(*kind, message.clone());
            }
        }
    }

    /// To all pages that show `what` (0: to all), and to those that come later.
    pub fn tell(&self, kind: Kind, what: u32, message: &Bytes) {
        lock(&self.last)[kind as usize] = Some(message.clone());
        for page in lock(&self.pages).iter().filter(|page| page.is_open() && page.demand() & what == what) {
            page.put(kind, message.clone());
        }
    }

    /// Whether a page shows it.
    pub fn wants(&self, what: u32) -> bool {
        lock(&self.pages).iter().any(|page| page.demand() & what != 0)
    }

    /// New records of the log, to pages that show it.
    pub fn tell_log(&self, records: Vec<serde_json::Value>) {
        let message = wire::json(Kind::Log, &serde_json::json!({ "records": records }));
        let mut log = lock(&self.log);
        log.extend(records);
        let over = log.len().saturating_sub(LOG);
        log.drain(..over);
        for page in lock(&self.pages).iter().filter(|page| page.demand() & demand::LOG != 0) {
            page.put(Kind::Log, message.clone());
        }
    }

    /// The log so far, to a page that begins to show it.
    pub fn replay_log(&self, page: &Outbox) {
        let log = lock(&self.log);
        page.replace(Kind::Log, wire::json(Kind::Log, &serde_json::json!({ "replace": true, "records": *log })));
    }

    /// The log is read anew from its end, behind these records: what pages show of it comes again.
    pub fn begin_log(&self, records: Vec<serde_json::Value>) {
        let mut log = lock(&self.log);
        *log = records.into();
        let message = wire::json(Kind::Log, &serde_json::json!({ "replace": true, "records": *log }));
        for page in lock(&self.pages).iter().filter(|page| page.demand() & demand::LOG != 0) {
            page.replace(Kind::Log, message.clone());
        }
    }

    pub fn close_all(&self) {
        lock(&self.pages).iter().for_each(|page| page.close());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pages_are_counted_and_those_that_are_not_known_are_told_nothing() {
        let hub = Hub::default();
        let pages: Vec<_> = (0..MAX_PAGES).filter_map(|_| hub.join()).collect();
        assert_eq!(pages.len(), MAX_PAGES);
        assert!(hub.join().is_none());
        pages[0].set_demand(demand::VIDEO);
        assert!(!hub.wants(demand::VIDEO), "a page that gave no token wants nothing");
        pages[0].open();
        assert!(hub.wants(demand::VIDEO) && !hub.wants(demand::MAP));
        hub.leave(&pages[0]);
        assert!(hub.join().is_some());
    }
}
