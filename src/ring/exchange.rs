//! Three slots, three owners, one atomic byte: the lock-free heart of the frame ring.
//!
//! The byte names the slot in the middle and whether it was finished since the consumer last looked (`FRESH`). Either
//! end trades its own slot for the middle one by a single exchange, so at every moment the three indices (producer's,
//! middle, consumer's) are a permutation of 0, 1, 2 and no two ends ever hold the same slot.
//!
//! `SYNC POINT`: both exchanges are `AcqRel`. The producer's release pairs with the consumer's acquire (the consumer sees the slot
//! whole); the consumer's release pairs with the producer's acquire (the producer writes only after the reading ended).
//!
//! Every primitive comes from `super::atomics`, which a model checker's test replaces by its own.

use super::atomics::{Arc, AtomicBool, AtomicU8, AtomicU64, Ordering, UnsafeCell};

/// Set in the byte when the middle slot was finished and not yet taken.
const FRESH: u8 = 4;
/// The bits of the byte that are a slot's index.
const INDEX: u8 = 3;

#[derive(Debug)]
struct Shared<S> {
    slots: [UnsafeCell<S>; 3],
    middle: AtomicU8,
    dropped: AtomicU64,
    closed: AtomicBool,
    abandoned: AtomicBool,
}

// SAFETY: a slot is reached only by the end that holds its index, indices change hands by the AcqRel exchanges of
// `middle` only, and each end is a single value that needs `&mut` for it; so a slot has one user at a time, and sharing
// the structure between two threads only moves slots between them: `S: Send` is enough.
unsafe impl<S: Send> Sync for Shared<S> {}

/// The writing end's half of the exchange.
#[derive(Debug)]
pub struct Producer<S> {
    shared: Arc<Shared<S>>,
    index: u8,
}

/// The reading end's half of the exchange.
#[derive(Debug)]
pub struct Consumer<S> {
    shared: Arc<Shared<S>>,
    index: u8,
}

/// The three slots and the only pair of ends.
pub fn exchange<S>(mut make: impl FnMut() -> S) -> (Producer<S>, Consumer<S>) {
    let shared = Arc::new(Shared {
        slots: [UnsafeCell::new(make()), UnsafeCell::new(make()), UnsafeCell::new(make())],
        middle: AtomicU8::new(1),
        dropped: AtomicU64::new(0),
        closed: AtomicBool::new(false),
        abandoned: AtomicBool::new(false),
    });
    (Producer { shared: shared.clone(), index: 0 }, Consumer { shared, index: 2 })
}

impl<S> Producer<S> {
    /// Writes into the slot that this end holds.
    pub fn write<R>(&mut self, write: impl FnOnce(&mut S) -> R) -> R {
        self.shared.slots[usize::from(self.index)].with_mut(|slot| {
            // SAFETY: this end holds the slot's index, and `&mut self` makes this the only use of it.
            write(unsafe { &mut *slot })
        })
    }

    /// Trades the written slot for the middle one; `true` if that one was finished and never taken.
    pub fn publish(&mut self) -> bool {
        // SYNC POINT: releases the written slot to `Consumer::advance`, acquires what the consumer last gave back.
        let before = self.shared.middle.swap(self.index | FRESH, Ordering::AcqRel);
        self.index = before & INDEX;
        let replaced = before & FRESH != 0;
        if replaced {
            // A statistic: its order against anything else does not matter. Only this end adds to it.
            self.shared.dropped.fetch_add(1, Ordering::Relaxed);
        }
        replaced
    }

    /// Says that nothing will be published any more.
    pub fn close(&mut self) {
        // SYNC POINT: whoever sees `closed` sees every publication before it.
        self.shared.closed.store(true, Ordering::Release);
    }

    /// Slots overwritten unread.
    pub fn dropped(&self) -> u64 {
        self.shared.dropped.load(Ordering::Relaxed)
    }

    /// The reading end was dropped.
    pub fn is_abandoned(&self) -> bool {
        self.shared.abandoned.load(Ordering::Relaxed)
    }
}

impl<S> Consumer<S> {
    /// Trades the slot just read for the middle one if that is newer.
    pub fn advance(&mut self) -> bool {
        // Only this end clears FRESH, so once seen it stays until the exchange below; the exchange itself orders the data.
        if self.shared.middle.load(Ordering::Relaxed) & FRESH == 0 {
            return false;
        }
        // SYNC POINT: acquires the slot of `Producer::publish`, releases the slot that was read.
        self.index = self.shared.middle.swap(self.index, Ordering::AcqRel) & INDEX;
        true
    }

    /// Reads the slot that this end holds.
    pub fn read<R>(&mut self, read: impl FnOnce(&S) -> R) -> R {
        self.shared.slots[usize::from(self.index)].with(|slot| {
            // SAFETY: this end holds the slot's index, so the producer does not write it.
            read(unsafe { &*slot })
        })
    }

    /// Slots overwritten unread.
    pub fn dropped(&self) -> u64 {
        self.shared.dropped.load(Ordering::Relaxed)
    }

    /// The writing end has said its last.
    pub fn is_closed(&self) -> bool {
        // SYNC POINT: pairs with `Producer::close`.
        self.shared.closed.load(Ordering::Acquire)
    }
}

impl<S> Drop for Consumer<S> {
    fn drop(&mut self) {
        self.shared.abandoned.store(true, Ordering::Relaxed);
    }
}
