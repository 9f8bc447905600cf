//! Model check of the frame ring: loom runs both threads through every interleaving that the memory model allows.
//!
//! The file under test is the daemon's own `src/ring/exchange.rs`, compiled here against loom's primitives instead of
//! the standard library's. That needs no special flags, so the check is part of the ordinary test run.

mod atomics {
    pub use loom::cell::UnsafeCell;
    pub use loom::sync::Arc;
    pub use loom::sync::atomic::{AtomicBool, AtomicU8, AtomicU64, Ordering};
}
#[path = "../src/ring/exchange.rs"]
#[expect(dead_code, reason = "the daemon uses all of it, the models only what can race")]
mod exchange;

use loom::thread;

/// A slot of two words, which a torn or early read would show different.
type Slot = (u64, u64);

/// Runs `model` through all interleavings with at most five preemptions. That is enough to see both orderings of the
/// exchange fail when they are weakened (the producer's release needs three, the consumer's needs five).
fn check(model: impl Fn() + Sync + Send + 'static) {
    let mut builder = loom::model::Builder::new();
    builder.preemption_bound = Some(5);
    builder.check(model);
}

#[test]
fn no_slot_is_read_while_it_is_written_and_the_newest_arrives() {
    check(|| {
        let (mut producer, mut consumer) = exchange::exchange(|| (0, 0));
        let writer = thread::spawn(move || {
            // The fourth is the first that can be written into a slot that the consumer has read and given back.
            for i in 1..=4 {
                producer.write(|slot: &mut Slot| *slot = (i, i));
                producer.publish();
            }
        });
        let (mut last, mut taken) = (0, 0);
        for _ in 0..2 {
            if consumer.advance() {
                taken += 1;
                consumer.read(|slot| {
                    assert_eq!(slot.0, slot.1, "torn");
                    assert!(slot.0 > last, "out of order");
                    last = slot.0;
                });
            }
        }
        writer.join().expect("writer");
        if consumer.advance() {
            taken += 1;
            last = consumer.read(|slot| slot.0);
        }
        assert_eq!(last, 4, "the newest slot is never lost");
        assert_eq!(taken + consumer.dropped(), 4, "taken or counted");
    });
}

#[test]
fn a_slot_being_read_is_never_recycled() {
    check(|| {
        let (mut producer, mut consumer) = exchange::exchange(|| (0, 0));
        producer.write(|slot: &mut Slot| *slot = (1, 1));
        producer.publish();
        let writer = thread::spawn(move || {
            for i in 2..=4 {
                producer.write(|slot| *slot = (i, i));
                producer.publish();
            }
        });
        assert!(consumer.advance());
        // The reading takes its time: loom may run the whole writer inside it.
        consumer.read(|slot| {
            let first = slot.0;
            thread::yield_now();
            assert_eq!((first, first), *slot, "the slot changed under the reader");
        });
        writer.join().expect("writer");
    });
}

#[test]
fn a_slot_published_before_the_end_is_seen_with_the_end() {
    check(|| {
        let (mut producer, mut consumer) = exchange::exchange(|| (0, 0));
        let writer = thread::spawn(move || {
            producer.write(|slot: &mut Slot| *slot = (9, 9));
            producer.publish();
            producer.close();
        });
        if consumer.is_closed() {
            assert!(consumer.advance(), "closed, but the last slot is not there");
            assert_eq!(consumer.read(|slot| *slot), (9, 9));
        }
        writer.join().expect("writer");
    });
}

#[test]
fn a_sleeping_consumer_is_woken_by_every_publication() {
    // The daemon's wait: look, then sleep until the wake-up token that follows every publication. A lost wake-up would
    // leave the consumer asleep for ever, which loom reports as a deadlock.
    check(|| {
        let (mut producer, mut consumer) = exchange::exchange(|| (0, 0));
        let token = atomics::Arc::new(loom::sync::Notify::new());
        let wake = token.clone();
        let writer = thread::spawn(move || {
            for i in 1..=2 {
                producer.write(|slot: &mut Slot| *slot = (i, i));
                producer.publish();
                wake.notify();
            }
            producer.close();
            wake.notify();
        });
        let mut last = 0;
        loop {
            let closed = consumer.is_closed();
            if consumer.advance() {
                last = consumer.read(|slot| slot.0);
            } else if closed {
                break;
            } else {
                token.wait();
            }
        }
        assert_eq!(last, 2);
        writer.join().expect("writer");
    });
}
