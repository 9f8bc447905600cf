//! Keeps a storm of equal faults to one log record a second, without losing its count.

/// Decides which of many equal events are logged. One thread's own; time comes from the caller.
#[derive(Debug, Clone, Default)]
pub struct RateLimiter {
    /// End of the silence that the last record began, ns.
    quiet_until_ns: Option<i64>,
    /// Events since the last record.
    held: u64,
}

/// Silence after a record, ns.
const QUIET_NS: i64 = 1_000_000_000;

impl RateLimiter {
    /// An event at `now_ns` (CLOCK_MONOTONIC). `Some(n)`: log now, for `n` events (this one and those held back before it).
    pub fn event(&mut self, now_ns: i64) -> Option<u64> {
        self.held += 1;
        self.due(now_ns)
    }

    /// To be called now and then: `Some(n)` when `n` held events are due, although no new one came.
    pub fn due(&mut self, now_ns: i64) -> Option<u64> {
        if self.held == 0 || self.quiet_until_ns.is_some_and(|end| now_ns < end) {
            return None;
        }
        self.quiet_until_ns = Some(now_ns.saturating_add(QUIET_NS));
        Some(std::mem::take(&mut self.held))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_storm_becomes_one_record_a_second_and_no_event_is_lost() {
        let mut limiter = RateLimiter::default();
        let (mut records, mut events) = (0, 0);
        // 30 faults a second for ten seconds.
        for i in 0..300 {
            if let Some(n) = limiter.event(i * 33_333_333) {
                records += 1;
                events += n;
            }
        }
        assert_eq!(limiter.event(0), None, "an early clock stays quiet");
        let rest = limiter.due(20_000_000_000).expect("the rest is due");
        assert_eq!(events + rest, 301);
        assert_eq!(records, 10);
        assert_eq!(limiter.due(40_000_000_000), None);
    }

    #[test]
    fn the_first_event_is_logged_at_once() {
        assert_eq!(RateLimiter::default().event(5), Some(1));
    }
}
