//! What waits for one page: the newest message of each kind, and a short queue of what must not be overtaken.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::wire::{Bytes, KINDS, Kind};

/// Messages of a kind that may be under way to a page before it has said that it has dealt with one: enough to hide the way there and back, few
/// enough that a slow page shows a new picture and not the oldest.
pub const IN_FLIGHT: u32 = 2;
/// Answers, log lines and pictures of the two-picture chain that wait; the oldest give way.
const QUEUE: usize = 256;
/// And their bytes: of all pages together no more than the console may use.
const QUEUE_BYTES: usize = 4 << 20;

/// What the writer of a page is to do next.
#[derive(Debug)]
pub enum Next {
    Send(Bytes),
    Pong(Vec<u8>),
    /// Nothing came for the time given.
    Idle,
    Closed,
}

#[derive(Debug, Default)]
struct Waiting {
    newest: [Option<Bytes>; KINDS],
    queue: VecDeque<(Kind, Bytes)>,
    pong: Option<Vec<u8>>,
    in_flight: [u32; KINDS],
    closed: bool,
}

/// See module.
#[derive(Debug, Default)]
pub struct Outbox {
    waiting: Mutex<Waiting>,
    changed: Condvar,
    /// Bits of [`super::hub::demand`]: what the page shows.
    demand: AtomicU32,
    /// The page has said who it is.
    open: AtomicBool,
}

impl Outbox {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Replaces what waits of this kind, or queues it.
    pub fn put(&self, kind: Kind, message: Bytes) {
        let mut waiting = self.lock();
        if kind.is_newest_only() {
            waiting.newest[kind as usize] = Some(message);
        } else {
            waiting.queue.push_back((kind, message));
            // The newest goes, however large it is.
            while waiting.queue.len() > QUEUE || waiting.queue.len() > 1 && waiting.bytes() > QUEUE_BYTES {
                waiting.queue.pop_front();
            }
        }
        self.changed.notify_all();
    }

    /// Queues it once there is room, so that it displaces nothing and nothing soon displaces it: the pictures of one chain are more than the queue holds.
    /// False where the page has not read for so long, or has gone.
    pub fn put_in_turn(&self, kind: Kind, message: Bytes, patience: Duration) -> bool {
        let is_full = |w: &mut Waiting| !w.closed && !w.queue.is_empty() && w.bytes() + message.len() > QUEUE_BYTES / 2;
        let waited = self.changed.wait_timeout_while(self.lock(), patience, is_full);
        let (waiting, waited) = waited.unwrap_or_else(PoisonError::into_inner);
        if waited.timed_out() || waiting.closed {
            return false;
        }
        drop(waiting);
        self.put(kind, message);
        true
    }

    /// Queues it in place of all that waits of this kind.
    pub fn replace(&self, kind: Kind, message: Bytes) {
        self.lock().queue.retain(|(other, _)| *other != kind);
        self.put(kind, message);
    }

    /// The newest ping is answered.
    pub fn pong(&self, payload: Vec<u8>) {
        self.lock().pong = Some(payload);
        self.changed.notify_all();
    }

    /// The page has dealt with a message of this kind.
    pub fn seen(&self, kind: Kind) {
        let mut waiting = self.lock();
        let count = &mut waiting.in_flight[kind as usize];
        *count = count.saturating_sub(1);
        self.changed.notify_all();
    }

    pub fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }

    /// What to send, waiting up to `patience` for it.
    pub fn next(&self, patience: Duration) -> Next {
        let mut waiting = self.lock();
        for last in [false, true] {
            if waiting.closed {
                return Next::Closed;
            }
            if let Some(payload) = waiting.pong.take() {
                return Next::Pong(payload);
            }
            if let Some(message) = waiting.take() {
                self.changed.notify_all();
                return Next::Send(message);
            }
            if !last {
                let wait = self
                    .changed
                    .wait_timeout_while(waiting, patience, |w| !w.closed && w.pong.is_none() && !w.has_any());
                waiting = wait.unwrap_or_else(PoisonError::into_inner).0;
            }
        }
        Next::Idle
    }

    pub fn set_demand(&self, bits: u32) {
        self.demand.store(bits, Ordering::Relaxed);
    }

    /// What the page wants; nothing before it has said who it is.
    pub fn demand(&self) -> u32 {
        if self.is_open() { self.demand.load(Ordering::Relaxed) } else { 0 }
    }

    pub fn open(&self) {
        self.open.store(true, Ordering::Relaxed);
    }

    pub fn is_open(&self) -> bool {
        self.open.load(Ordering::Relaxed)
    }
}

impl Waiting {
    fn bytes(&self) -> usize {
        self.queue.iter().map(|(_, message)| message.len()).sum()
    }

    fn has_any(&self) -> bool {
        !self.queue.is_empty() || (0..KINDS).any(|k| self.newest[k].is_some() && self.may_go(k))
    }

    fn may_go(&self, kind: usize) -> bool {
        !Kind::ACKNOWLEDGED.iter().any(|k| *k as usize == kind) || self.in_flight[kind] < IN_FLIGHT
    }

    /// The queue first, then the small kinds: a picture must not hold up what says that the robot is lost.
    fn take(&mut self) -> Option<Bytes> {
        if let Some((_, message)) = self.queue.pop_front() {
            return Some(message);
        }
        let kind = (0..KINDS).find(|k| self.newest[*k].is_some() && self.may_go(*k))?;
        if Kind::ACKNOWLEDGED.iter().any(|k| *k as usize == kind) {
            self.in_flight[kind] += 1;
        }
        self.newest[kind].take()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SOON: Duration = Duration::from_millis(5);

    fn message(n: u8) -> Bytes {
        vec![n].into()
    }

    fn sent(outbox: &Outbox) -> Option<u8> {
        match outbox.next(SOON) {
            Next::Send(bytes) => bytes.first().copied(),
            _ => None,
        }
    }

    #[test]
    fn the_newest_picture_wins_and_no_more_are_under_way_than_the_page_draws() {
        let outbox = Outbox::default();
        for n in 0..100 {
            outbox.put(Kind::Frame, message(n));
        }
        assert_eq!(sent(&outbox), Some(99));
        outbox.put(Kind::Frame, message(100));
        assert_eq!(sent(&outbox), Some(100));
        for n in 101..110 {
            outbox.put(Kind::Frame, message(n));
            assert_eq!(sent(&outbox), None, "the page has drawn none so far");
        }
        outbox.put(Kind::State, message(7));
        assert_eq!(sent(&outbox), Some(7), "a picture holds nothing else up");
        outbox.seen(Kind::Frame);
        assert_eq!(sent(&outbox), Some(109));
        assert_eq!(sent(&outbox), None);
    }

    #[test]
    fn answers_keep_their_order_and_a_page_that_reads_none_costs_a_fixed_amount() {
        let outbox = Outbox::default();
        for n in 0..QUEUE + 10 {
            outbox.put(Kind::Reply, message(n as u8));
        }
        assert_eq!(sent(&outbox), Some(10));
        assert_eq!(sent(&outbox), Some(11));
        assert_eq!(outbox.lock().queue.len(), QUEUE - 2);
        for _ in 0..100 {
            outbox.replace(Kind::Log, message(1));
        }
        assert_eq!(outbox.lock().queue.len(), QUEUE - 1);
        for _ in 0..10 {
            outbox.put(Kind::Reply, vec![0; QUEUE_BYTES / 4].into());
        }
        assert!(outbox.lock().bytes() <= QUEUE_BYTES);
        outbox.close();
        assert!(matches!(outbox.next(SOON), Next::Closed));
    }

    #[test]
    fn a_page_that_reads_slowly_gets_all_that_is_put_in_turn_and_one_that_does_not_is_given_up() {
        let picture = |n: u8| Bytes::from(vec![n; QUEUE_BYTES / 3]);
        let outbox = Outbox::default();
        std::thread::scope(|scope| {
            let putting =
                scope.spawn(|| (0..8).all(|n| outbox.put_in_turn(Kind::Picture, picture(n), Duration::from_secs(20))));
            for n in 0..8 {
                std::thread::sleep(Duration::from_millis(5));
                let Next::Send(message) = outbox.next(Duration::from_secs(20)) else { panic!("nothing was sent") };
                assert_eq!(message[0], n);
            }
            assert!(putting.join().expect("no panic"));
        });
        assert!(outbox.put_in_turn(Kind::Picture, picture(1), SOON), "into an empty queue");
        assert!(!outbox.put_in_turn(Kind::Picture, picture(2), SOON), "nobody reads");
        assert_eq!(outbox.lock().queue.len(), 1);
        outbox.close();
        assert!(!outbox.put_in_turn(Kind::Picture, picture(3), Duration::from_secs(20)), "the page has gone");
    }
}
