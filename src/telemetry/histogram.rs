//! Latency histogram with fixed, log-linear buckets.
//!
//! 32 buckets to each doubling from 1 us on, so a percentile is exact to 3.2 %; values below 32 us are exact to 1 us, values above
//! 67 s land in the last bucket. 4.9 kB, one relaxed addition a value. Readers take snapshots and subtract them, so that
//! several of them can look at different intervals without resetting anything.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// log2 of the buckets in each doubling.
const SUB_BITS: u32 = 5;
const SUB: u64 = 1 << SUB_BITS;
/// Doublings above the exact range: 32 us * 2^21 = 67 s.
const DOUBLINGS: u64 = 21;
const BUCKETS: usize = (SUB * (DOUBLINGS + 1)) as usize;

/// The bucket of a value in microseconds.
fn bucket(us: u64) -> usize {
    if us < SUB {
        return us as usize;
    }
    let doubling = u64::from(us.ilog2() - SUB_BITS);
    let within = (us >> doubling) - SUB;
    usize::try_from((doubling + 1) * SUB + within).map_or(BUCKETS - 1, |b| b.min(BUCKETS - 1))
}

/// Middle of a bucket, us.
fn middle_us(bucket: usize) -> f64 {
    let b = bucket as u64;
    if b < SUB {
        return b as f64;
    }
    let doubling = b / SUB - 1;
    let low = (SUB + b % SUB) << doubling;
    low as f64 + 0.5 * ((1u64 << doubling) as f64 - 1.0)
}

/// Durations of one stage; written by any thread, read by any thread.
#[derive(Debug)]
pub struct Histogram {
    counts: [AtomicU64; BUCKETS],
}

impl Default for Histogram {
    fn default() -> Self {
        Self { counts: std::array::from_fn(|_| AtomicU64::new(0)) }
    }
}

impl Histogram {
    /// Adds one duration.
    pub fn record(&self, duration: Duration) {
        let us = u64::try_from(duration.as_micros()).unwrap_or(u64::MAX);
        if let Some(count) = self.counts.get(bucket(us)) {
            count.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Adds one duration in ns; a negative one (clocks that disagree) counts as zero.
    pub fn record_ns(&self, ns: i64) {
        self.record(Duration::from_nanos(u64::try_from(ns).unwrap_or(0)));
    }

    /// All counts as they are now.
    pub fn snapshot(&self) -> Snapshot {
        Snapshot { counts: self.counts.iter().map(|c| c.load(Ordering::Relaxed)).collect() }
    }
}

/// Counts at one moment, or between two.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Snapshot {
    counts: Vec<u64>,
}

/// The figures that are logged of an interval, ms; NaN where nothing was recorded.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Percentiles {
    pub count: u64,
    pub p50_ms: f64,
    pub p95_ms: f64,
    pub p99_ms: f64,
}

impl Snapshot {
    /// What was recorded since `earlier`, a snapshot of the same histogram (or an empty one).
    pub fn since(&self, earlier: &Snapshot) -> Snapshot {
        let before = earlier.counts.iter().copied().chain(std::iter::repeat(0));
        Snapshot { counts: self.counts.iter().zip(before).map(|(now, b)| now.saturating_sub(b)).collect() }
    }

    /// Values recorded.
    pub fn count(&self) -> u64 {
        self.counts.iter().sum()
    }

    /// The value, ms, that the fraction `p` of all values does not exceed; `None` when there are none.
    pub fn percentile_ms(&self, p: f64) -> Option<f64> {
        let count = self.count();
        if count == 0 {
            return None;
        }
        // Nearest rank: the smallest value with at least p * count values at or below it.
        let rank = ((p * count as f64).ceil() as u64).clamp(1, count);
        let mut seen = 0;
        for (bucket, n) in self.counts.iter().enumerate() {
            seen += n;
            if seen >= rank {
                return Some(middle_us(bucket) / 1000.0);
            }
        }
        None
    }

    /// Median and tails.
    pub fn percentiles(&self) -> Percentiles {
        let at = |p| self.percentile_ms(p).unwrap_or(f64::NAN);
        Percentiles { count: self.count(), p50_ms: at(0.50), p95_ms: at(0.95), p99_ms: at(0.99) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_lies_within_half_a_bucket_of_its_buckets_middle() {
        for us in (0..100_000).chain((100_000..67_000_000).step_by(9973)) {
            let error = (middle_us(bucket(us)) - us as f64).abs();
            assert!(error <= us as f64 / 64.0 + 1e-9, "{us} us: off by {error} us");
        }
    }

    #[test]
    fn buckets_ascend_and_the_last_takes_everything_beyond() {
        let mut last = 0;
        for us in 0..1_000_000 {
            let b = bucket(us);
            assert!(b == last || b == last + 1, "{us} us: bucket {b} after {last}");
            last = b;
        }
        assert_eq!(bucket(u64::MAX), BUCKETS - 1);
        assert_eq!(bucket(67_100_000), BUCKETS - 1);
    }

    #[test]
    fn percentiles_are_those_of_the_sorted_values() {
        let histogram = Histogram::default();
        for ms in 1..=1000u64 {
            histogram.record(Duration::from_millis(ms));
        }
        let all = histogram.snapshot().percentiles();
        for (p, figure) in [(500.0, all.p50_ms), (950.0, all.p95_ms), (990.0, all.p99_ms)] {
            assert!((figure / p - 1.0f64).abs() < 0.032, "{figure} ms for {p} ms");
        }
        assert_eq!(all.count, 1000);
    }

    #[test]
    fn an_interval_forgets_what_was_before_it() {
        let histogram = Histogram::default();
        for _ in 0..100 {
            histogram.record(Duration::from_secs(1));
        }
        let before = histogram.snapshot();
        histogram.record_ns(2_000_000);
        histogram.record_ns(-5);
        let since = histogram.snapshot().since(&before);
        assert_eq!(since.count(), 2);
        assert!(since.percentile_ms(1.0).is_some_and(|ms| (ms - 2.0).abs() < 0.07));
        assert_eq!(since.percentile_ms(0.0), Some(0.0));
        assert_eq!(histogram.snapshot().since(&histogram.snapshot()).percentile_ms(0.5), None);
    }
}
