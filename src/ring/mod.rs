//! The frame ring: how a capture thread hands slots to a feature thread without ever waiting for it.
//!
//! - In: slots of any type, written in place by one producer. Out: the newest finished slot, read in place by one consumer.
//! - Newest wins: a finished slot that was not taken when the next one is finished is recycled, and counted. There is
//!   nothing to be gained from a longer queue, because the consumer only ever wants the newest picture; so the ring has
//!   exactly three slots (being written, newest finished, being read), all made before the first frame.
//! - A slot that is being read is never recycled: it changes hands only by the consumer's own exchange.
//! - Single producer and single consumer hold by construction: [`frame_ring`] makes the only pair.
//! - Cost: one atomic exchange a frame on either side, and a wake-up; no locks around slots, no allocation.
//!   Neither end ever waits for the other, except in [`Consumer::wait`], whose wait is bounded.
//! - It knows no images, and it has no opinion on what a slot is: a `RawFrame` in the daemon, an integer in a test.
//!
//! The exchange itself is in `exchange`; `tests/ring_model.rs` compiles that same file against loom and walks through
//! every interleaving of both threads.

mod atomics;
mod exchange;

use std::time::{Duration, Instant};

use crossbeam::sync::{Parker, Unparker};

/// What a bounded wait for a slot came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wait {
    /// A newer slot is there; [`Consumer::read`] shows it.
    Ready,
    /// Nothing new within the timeout.
    TimedOut,
    /// The producer is gone and its last slot has been taken.
    Closed,
}

/// The writing end.
#[derive(Debug)]
pub struct Producer<S> {
    exchange: exchange::Producer<S>,
    consumer: Unparker,
}

/// The reading end.
#[derive(Debug)]
pub struct Consumer<S> {
    exchange: exchange::Consumer<S>,
    parker: Parker,
}

/// A ring of three slots from `make`, and its only two ends.
pub fn frame_ring<S>(make: impl FnMut() -> S) -> (Producer<S>, Consumer<S>) {
    let (producer, consumer) = exchange::exchange(make);
    let parker = Parker::new();
    let unparker = parker.unparker().clone();
    (Producer { exchange: producer, consumer: unparker }, Consumer { exchange: consumer, parker })
}

impl<S> Producer<S> {
    /// Writes into the slot that this end holds. What an earlier call wrote without publishing it is still there, and
    /// after a publication the slot is one that was used before.
    pub fn write<R>(&mut self, write: impl FnOnce(&mut S) -> R) -> R {
        self.exchange.write(write)
    }

    /// Makes the written slot the newest and takes another one. `true`: the slot published before had not been read and
    /// is dropped.
    pub fn publish(&mut self) -> bool {
        let replaced = self.exchange.publish();
        self.consumer.unpark();
        replaced
    }

    /// Slots that were overwritten unread since the start.
    pub fn dropped(&self) -> u64 {
        self.exchange.dropped()
    }

    /// The reading end no longer exists.
    pub fn is_abandoned(&self) -> bool {
        self.exchange.is_abandoned()
    }
}

impl<S> Drop for Producer<S> {
    fn drop(&mut self) {
        self.exchange.close();
        self.consumer.unpark();
    }
}

impl<S> Consumer<S> {
    /// Waits at most `timeout` for a slot newer than the one being read, and takes it in its place.
    pub fn wait(&mut self, timeout: Duration) -> Wait {
        let deadline = Instant::now() + timeout;
        loop {
            // Closed is read first: a slot published before the end of the producer is then seen by the exchange.
            let closed = self.exchange.is_closed();
            if self.exchange.advance() {
                return Wait::Ready;
            }
            if closed {
                return Wait::Closed;
            }
            // A wake-up token left by a publication that was already taken makes one round more, never a lost wake-up.
            if Instant::now() >= deadline {
                return Wait::TimedOut;
            }
            self.parker.park_deadline(deadline);
        }
    }

    /// Reads the slot that this end holds: the one that the last [`Wait::Ready`] spoke of, or an unwritten one before that.
    pub fn read<R>(&mut self, read: impl FnOnce(&S) -> R) -> R {
        self.exchange.read(read)
    }

    /// Slots that were overwritten unread since the start.
    pub fn dropped(&self) -> u64 {
        self.exchange.dropped()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A slot that shows a torn write: every word holds the same number.
    struct Words([u64; 512]);

    #[test]
    fn newest_wins_and_the_others_are_counted() {
        let (mut producer, mut consumer) = frame_ring(|| 0u32);
        assert_eq!(consumer.wait(Duration::ZERO), Wait::TimedOut);
        for i in 1..=5 {
            producer.write(|slot| *slot = i);
            assert_eq!(producer.publish(), i > 1);
        }
        assert_eq!(consumer.wait(Duration::ZERO), Wait::Ready);
        assert_eq!(consumer.read(|slot| *slot), 5);
        assert_eq!((producer.dropped(), consumer.dropped()), (4, 4));
        assert_eq!(consumer.wait(Duration::ZERO), Wait::TimedOut);
        assert_eq!(consumer.read(|slot| *slot), 5, "the slot stays readable until the next one is taken");
    }

    #[test]
    fn the_last_slot_is_delivered_before_closed() {
        let (mut producer, mut consumer) = frame_ring(|| 0u32);
        producer.write(|slot| *slot = 7);
        producer.publish();
        drop(producer);
        assert_eq!(consumer.wait(Duration::ZERO), Wait::Ready);
        assert_eq!(consumer.read(|slot| *slot), 7);
        assert_eq!(consumer.wait(Duration::from_secs(5)), Wait::Closed);
    }

    #[test]
    fn the_producer_learns_that_nobody_reads_any_more() {
        let (producer, consumer) = frame_ring(|| 0u32);
        assert!(!producer.is_abandoned());
        drop(consumer);
        assert!(producer.is_abandoned());
    }

    #[test]
    fn slots_are_made_once() {
        let mut made = 0;
        let (mut producer, mut consumer) = frame_ring(|| made += 1);
        for _ in 0..100 {
            producer.publish();
            consumer.wait(Duration::ZERO);
        }
        drop((producer, consumer));
        assert_eq!(made, 3);
    }

    #[test]
    fn a_hundred_thousand_slots_between_two_threads_none_torn_none_out_of_order_none_uncounted() {
        const COUNT: u64 = 100_000;
        let (mut producer, mut consumer) = frame_ring(|| Words([0; 512]));
        let writer = std::thread::spawn(move || {
            for i in 1..=COUNT {
                producer.write(|slot| slot.0.fill(i));
                producer.publish();
            }
        });
        let (mut last, mut taken) = (0, 0);
        loop {
            match consumer.wait(Duration::from_secs(20)) {
                Wait::Ready => {
                    let (first, whole) = consumer.read(|slot| (slot.0[0], slot.0.iter().all(|w| *w == slot.0[0])));
                    assert!(whole, "slot {first} is torn");
                    assert!(first > last, "slot {first} after {last}");
                    last = first;
                    taken += 1;
                }
                Wait::Closed => break,
                Wait::TimedOut => panic!("no slot for 20 s after slot {last}"),
            }
        }
        writer.join().expect("writer");
        assert_eq!(last, COUNT, "the newest slot is never lost");
        assert_eq!(taken + consumer.dropped(), COUNT, "every slot was either taken or counted as dropped");
    }
}
