//! Signs of life of one stage, and the question how long ago the last one was.

use std::sync::atomic::{AtomicI64, Ordering};
use std::time::Duration;

/// Beaten by a stage in every turn of its loop, also in one that only waited; watched by the supervisor.
#[derive(Debug)]
pub struct Heartbeat {
    stage: &'static str,
    /// CLOCK_MONOTONIC of the last beat, ns; `IDLE` while the stage is not under watch.
    last_ns: AtomicI64,
}

const IDLE: i64 = i64::MIN;

impl Heartbeat {
    /// Not under watch until the first beat.
    pub fn new(stage: &'static str) -> Self {
        Self { stage, last_ns: AtomicI64::new(IDLE) }
    }

    /// The stage's name, as logged.
    pub fn stage(&self) -> &'static str {
        self.stage
    }

    /// A turn of the stage's loop began at `now_ns` (CLOCK_MONOTONIC).
    pub fn beat(&self, now_ns: i64) {
        self.last_ns.store(now_ns, Ordering::Relaxed);
    }

    /// The stage has ended and is not to be watched any more.
    pub fn rest(&self) {
        self.last_ns.store(IDLE, Ordering::Relaxed);
    }

    /// Time since the last beat, ns; `None` while the stage is not under watch.
    pub fn age_ns(&self, now_ns: i64) -> Option<i64> {
        let last = self.last_ns.load(Ordering::Relaxed);
        (last != IDLE).then(|| now_ns.saturating_sub(last))
    }

    /// How long the stage has not beaten, if that is longer than `limit`.
    pub fn stalled(&self, now_ns: i64, limit: Duration) -> Option<Duration> {
        let silent = Duration::from_nanos(u64::try_from(self.age_ns(now_ns)?).unwrap_or(0));
        (silent > limit).then_some(silent)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stage_is_stalled_only_between_its_first_beat_and_its_rest() {
        let heart = Heartbeat::new("features");
        let limit = Duration::from_secs(1);
        assert_eq!(heart.stalled(10_000_000_000, limit), None, "never started");
        heart.beat(1_000_000_000);
        assert_eq!(heart.stalled(2_000_000_000, limit), None, "just in time");
        assert_eq!(heart.stalled(4_000_000_000, limit), Some(Duration::from_secs(3)));
        assert_eq!(heart.stalled(0, limit), None, "a beat after `now` was read");
        heart.rest();
        assert_eq!(heart.stalled(9_000_000_000, limit), None, "ended");
    }
}
