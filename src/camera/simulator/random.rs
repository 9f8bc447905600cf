//! Seeded random numbers of the simulator: (seed, stream) -> a sequence that never changes.
//!
//! Every part of the simulator draws from a stream of its own, so that a switch on one effect does not change what another one
//! draws. The generator is that of [`geometry::random`](crate::geometry::random).
//!
//! Deliberately not here: cryptographic quality, entropy from the system.

use crate::geometry::random;

/// A hash of small integers.
#[inline]
pub(super) fn mix(value: u64) -> u64 {
    random::Random::new(value).bits()
}

/// A stream of random numbers.
#[derive(Debug, Clone)]
pub(super) struct Random(random::Random);

impl Random {
    /// Stream `stream` of `seed`.
    pub(super) fn new(seed: u64, stream: u64) -> Self {
        Self(random::Random::new(mix(seed ^ mix(stream))))
    }

    #[inline]
    pub(super) fn next(&mut self) -> u64 {
        self.0.bits()
    }

    /// Uniform in [0, 1).
    #[inline]
    pub(super) fn unit(&mut self) -> f64 {
        self.0.unit()
    }

    /// Uniform in [low, high).
    #[inline]
    pub(super) fn range(&mut self, low: f64, high: f64) -> f64 {
        self.0.uniform(low, high)
    }

    /// Uniform in the logarithm: as many sizes between 1 and 2 as between 2 and 4.
    pub(super) fn log_range(&mut self, low: f64, high: f64) -> f64 {
        low * (high / low).powf(self.unit())
    }

    /// 0 .. n-1; 0 when n is 0.
    pub(super) fn index(&mut self, n: usize) -> usize {
        if n == 0 { 0 } else { (self.next() % n as u64) as usize }
    }

    /// True with probability `p`.
    pub(super) fn chance(&mut self, p: f64) -> bool {
        self.unit() < p
    }

    /// Standard normal.
    pub(super) fn normal(&mut self) -> f64 {
        self.0.normal()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_of_one_seed_differ_and_repeat() {
        let draw = |seed, stream| {
            let mut r = Random::new(seed, stream);
            (0..8).map(|_| r.next()).collect::<Vec<_>>()
        };
        assert_eq!(draw(7, 1), draw(7, 1));
        assert_ne!(draw(7, 1), draw(7, 2));
        assert_ne!(draw(7, 1), draw(8, 1));
    }

    #[test]
    fn normal_numbers_have_mean_zero_and_variance_one() {
        let seed = 3;
        let mut r = Random::new(seed, 0);
        let n = 20_000;
        let values: Vec<f64> = (0..n).map(|_| r.normal()).collect();
        let mean = values.iter().sum::<f64>() / n as f64;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n as f64;
        assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.05, "seed {seed}: mean {mean}, variance {variance}");
    }
}
