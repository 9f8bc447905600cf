//! What a base has told and no frame has asked for yet.
//!
//! One thread fills it ([`WheelQueue::push`]), another empties it up to a frame's timestamp ([`WheelQueue::take`]). Readings come out in the order
//! of time, whatever went in. Bounded: when it is full, the oldest reading is dropped and counted; the next one then does not follow on, which its
//! start says.
//!
//! # Intervals
//! A reading with a start of its own keeps it, but for what the one before has told already: whoever braked in a hole did not stand in it.
//! One without starts where the one before ended, so that it is taken to hold for a hole of up to [`GAP_NS`] (a lost message) as well; after a longer
//! one nothing is supposed of the time between, and it only begins anew.
//!
//! Cost: a lock and some 20 ns a reading; nothing at all without readings but one lock a frame.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::{GAP_NS, WheelFault, WheelMessage, WheelReading};
use crate::telemetry::Counter;

/// Readings that wait at most: 40 s at 100 Hz, while no frame comes.
pub const CAPACITY: usize = 4096;

/// What has become of a driver's messages, since the start.
#[derive(Debug, Default)]
pub struct WheelCounts {
    /// Believed.
    pub received: Counter,
    /// Believed, but a frame after it had been tracked already: it counts from the next frame on.
    pub late: Counter,
    /// Not believed: time repeats or goes back.
    pub out_of_order: Counter,
    /// Sent by the driver, by its numbers, and never arrived.
    pub missing: Counter,
    /// Stretches of more than [`GAP_NS`] without a reading.
    pub gaps: Counter,
    /// Oldest readings that were dropped because no frame asked for them.
    pub dropped: Counter,
    /// Not believed: no finite number, a speed, variance or interval that cannot be.
    pub absurd: Counter,
    /// Not believed: the stamp is not of the pictures' clock.
    pub wrong_clock: Counter,
    /// Not believed: from a second publisher.
    pub second_publisher: Counter,
}

impl WheelCounts {
    /// Messages that were not believed.
    pub fn refused(&self) -> u64 {
        [&self.out_of_order, &self.absurd, &self.wrong_clock, &self.second_publisher].map(Counter::get).iter().sum()
    }

    /// Counts a message that is not believed.
    pub fn refuse(&self, fault: &WheelFault) {
        let counter = match fault {
            WheelFault::GoesBack { .. } | WheelFault::JumpsAhead { .. } => &self.out_of_order,
            WheelFault::WrongClock { .. } => &self.wrong_clock,
            WheelFault::SecondPublisher => &self.second_publisher,
            _ => &self.absurd,
        };
        counter.add(1);
    }
}

/// See module.
#[derive(Debug, Default)]
pub struct WheelQueue {
    state: Mutex<State>,
    counts: Arc<WheelCounts>,
}

#[derive(Debug, Default)]
struct State {
    waiting: VecDeque<WheelReading>,
    /// Stamp of the last message that was believed, ns.
    last_ns: Option<i64>,
    /// Timestamp of the last frame that asked, ns.
    asked_ns: Option<i64>,
}

impl WheelQueue {
    /// With counters that somebody else reads.
    pub fn new(counts: Arc<WheelCounts>) -> Self {
        Self { state: Mutex::default(), counts }
    }

    pub fn counts(&self) -> &WheelCounts {
        &self.counts
    }

    /// Takes a message in, or says (and counts) why it is not believed.
    pub fn push(&self, message: &WheelMessage) -> Result<(), WheelFault> {
        let mut state = self.state();
        let fault = message.fault().or_else(|| {
            let last = state.last_ns.filter(|last| message.timestamp_ns <= *last)?;
            Some(WheelFault::GoesBack { by_ns: last.saturating_sub(message.timestamp_ns) })
        });
        if let Some(fault) = fault {
            self.counts.refuse(&fault);
            return Err(fault);
        }
        let before = state.last_ns.replace(message.timestamp_ns);
        let follows = before.filter(|before| message.timestamp_ns.saturating_sub(*before) <= GAP_NS);
        self.counts.gaps.add(u64::from(before.is_some() && follows.is_none()));
        self.counts.received.add(1);
        // Without a start there is nothing that it is the mean of: the next one starts here.
        let own = message.from_ns.map(|from| before.map_or(from, |before| from.max(before)));
        let Some(from_ns) = own.or(follows) else { return Ok(()) };
        if state.asked_ns.is_some_and(|asked| message.timestamp_ns <= asked) {
            self.counts.late.add(1);
        }
        if state.waiting.capacity() < CAPACITY {
            // All at the first reading: who fills the queue later may be on the way to a pose.
            state.waiting.reserve_exact(CAPACITY);
        }
        if state.waiting.len() >= CAPACITY {
            state.waiting.pop_front();
            self.counts.dropped.add(1);
        }
        let &WheelMessage { timestamp_ns, linear_x_mps, linear_y_mps, angular_z_radps, variance, .. } = message;
        let reading = WheelReading { from_ns, timestamp_ns, linear_x_mps, linear_y_mps, angular_z_radps, variance };
        state.waiting.push_back(reading);
        Ok(())
    }

    /// Hands out, in order, what ended up to `until_ns`, a frame's timestamp.
    pub fn take(&self, until_ns: i64, mut give: impl FnMut(&WheelReading)) {
        self.state().asked_ns = Some(until_ns);
        // One by one, so that who fills the queue waits for no reading's use; no more than there can be, however fast it is filled.
        for _ in 0..CAPACITY {
            let next = {
                let mut state = self.state();
                let due = state.waiting.front().is_some_and(|reading| reading.timestamp_ns <= until_ns);
                if due { state.waiting.pop_front() } else { None }
            };
            let Some(reading) = next else { return };
            give(&reading);
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        // Nothing is ever half done while it is held.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn at(ms: i64) -> WheelMessage {
        WheelMessage::new(0, ms * MS, [ms as f64 * 1e-3, 0.0, 0.0])
    }

    /// Intervals that come out up to `ms`, ms.
    fn taken(queue: &WheelQueue, ms: i64) -> Vec<(i64, i64)> {
        let mut all = Vec::new();
        queue.take(ms * MS, |r| all.push((r.from_ns / MS, r.timestamp_ns / MS)));
        all
    }

    #[test]
    fn readings_follow_on_and_come_with_the_first_frame_that_is_not_earlier() {
        let queue = WheelQueue::default();
        for ms in [0, 20, 40, 60] {
            queue.push(&at(ms)).expect("believed");
        }
        assert_eq!(taken(&queue, 40), [(0, 20), (20, 40)], "the first one only begins");
        assert_eq!(taken(&queue, 59), []);
        assert_eq!(taken(&queue, 1000), [(40, 60)]);
        assert_eq!((queue.counts().received.get(), queue.counts().late.get()), (4, 0));
    }

    #[test]
    fn a_lost_message_is_bridged_and_a_gap_is_missing_data_and_not_standing() {
        let queue = WheelQueue::default();
        for message in [at(0), at(500), at(1001), at(1100)] {
            queue.push(&message).expect("believed");
        }
        let own_start = WheelMessage { from_ns: Some(1980 * MS), ..at(2000) };
        let hole_before = WheelMessage { from_ns: Some(2030 * MS), ..at(2040) };
        queue.push(&own_start).expect("believed");
        queue.push(&hole_before).expect("believed");
        let overlaps = WheelMessage { from_ns: Some(2010 * MS), ..at(2050) };
        queue.push(&overlaps).expect("believed");
        assert_eq!(taken(&queue, 9000), [(0, 500), (1001, 1100), (1980, 2000), (2030, 2040), (2040, 2050)]);
        assert_eq!(queue.counts().gaps.get(), 2);
    }

    #[test]
    fn what_goes_back_is_refused_and_what_is_late_comes_with_the_next_frame() {
        let queue = WheelQueue::default();
        queue.push(&at(0)).expect("believed");
        queue.push(&at(20)).expect("believed");
        assert_eq!(queue.push(&at(20)), Err(WheelFault::GoesBack { by_ns: 0 }));
        assert_eq!(queue.push(&at(10)), Err(WheelFault::GoesBack { by_ns: 10 * MS }));
        assert_eq!(taken(&queue, 50), [(0, 20)]);
        queue.push(&at(40)).expect("late, but in order");
        assert_eq!(taken(&queue, 83), [(20, 40)]);
        assert_eq!((queue.counts().late.get(), queue.counts().out_of_order.get()), (1, 2));
    }

    #[test]
    fn nonsense_is_counted_and_changes_nothing() {
        let queue = WheelQueue::default();
        queue.push(&at(0)).expect("believed");
        assert!(queue.push(&WheelMessage { linear_x_mps: f64::NAN, ..at(9_000_000) }).is_err());
        queue.push(&at(20)).expect("the bad one's time is not believed either");
        assert_eq!(taken(&queue, 20), [(0, 20)]);
        assert_eq!((queue.counts().absurd.get(), queue.counts().refused()), (1, 1));
    }

    #[test]
    fn a_queue_that_nobody_empties_drops_its_oldest() {
        let queue = WheelQueue::default();
        for k in 0..=CAPACITY as i64 + 2 {
            queue.push(&at(10 * k)).expect("believed");
        }
        assert_eq!(queue.counts().dropped.get(), 2);
        assert_eq!(taken(&queue, i64::MAX / MS).first(), Some(&(20, 30)), "it does not follow on from anything");
    }
}
