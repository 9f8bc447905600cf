//! Small seeded generator for the random samples of robust estimation.
//!
//! Seed -> the same numbers on every machine. SplitMix64 (Steele, Lea, Flood: Fast splittable pseudorandom number
//! generators, OOPSLA 2014): one multiply-xor chain a number, about 1 ns. Not for anything secret.

/// Generator state; a copy continues with the same numbers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Random {
    state: u64,
}

impl Random {
    /// Any seed is as good as any other.
    pub fn new(seed: u64) -> Self {
        Self { state: seed }
    }

    /// 64 uniform bits.
    #[inline]
    pub fn bits(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.state;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Uniform in `0..count`; 0 for an empty range. The bias, `count / 2^64`, is far below what a sample can show.
    #[inline]
    pub fn below(&mut self, count: usize) -> usize {
        ((u128::from(self.bits()) * count as u128) >> 64) as usize
    }

    /// Uniform in [0, 1).
    #[inline]
    pub fn unit(&mut self) -> f64 {
        (self.bits() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Uniform in [low, high).
    #[inline]
    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// Standard normal (Box and Muller).
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.unit()).cos()
    }

    /// Fills `sample` with distinct numbers of `0..count`, every subset equally likely (Floyd's algorithm: exactly one
    /// draw a number, so no loop that might not end). `false`, and nothing drawn, when `count` is too small.
    #[inline]
    pub fn sample_distinct(&mut self, count: usize, sample: &mut [usize]) -> bool {
        let size = sample.len();
        if size > count {
            return false;
        }
        for i in 0..size {
            let top = count - size + i;
            let draw = self.below(top + 1);
            sample[i] = if sample[..i].contains(&draw) { top } else { draw };
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn splitmix64_gives_the_published_numbers() {
        let mut random = Random::new(1_234_567);
        assert_eq!(random.bits(), 6_457_827_717_110_365_317);
        assert_eq!(random.bits(), 3_203_168_211_198_807_973);
    }

    #[test]
    fn samples_are_distinct_and_every_subset_is_equally_likely() {
        let mut random = Random::new(5);
        let mut counts = [0u32; 10];
        for _ in 0..30_000 {
            let mut sample = [0; 3];
            assert!(random.sample_distinct(5, &mut sample));
            sample.sort_unstable();
            let [a, b, c] = sample;
            assert!(a < b && b < c && c < 5, "{sample:?}");
            // Index of {a, b, c} among the ten subsets, by the two numbers left out.
            let out: Vec<usize> = (0..5).filter(|i| !sample.contains(i)).collect();
            counts[out[0] * (9 - out[0]) / 2 + out[1] - out[0] - 1] += 1;
        }
        // 3,000 each, one sigma 52.
        assert!(counts.iter().filter(|c| (2_700..3_300).contains(*c)).count() == 10, "seed 5: {counts:?}");
    }

    #[test]
    fn too_few_data_give_no_sample() {
        let mut random = Random::new(1);
        assert!(!random.sample_distinct(4, &mut [0; 5]));
        let mut all = [0; 5];
        assert!(random.sample_distinct(5, &mut all));
        all.sort_unstable();
        assert_eq!(all, [0, 1, 2, 3, 4]);
    }

    #[test]
    fn normal_has_unit_variance() {
        let mut random = Random::new(77);
        let (mut sum, mut sum2) = (0.0, 0.0);
        for _ in 0..20_000 {
            let v = random.normal();
            sum += v;
            sum2 += v * v;
        }
        assert!((sum / 20_000.0).abs() < 0.03 && (sum2 / 20_000.0 - 1.0).abs() < 0.05, "seed 77: {sum} {sum2}");
    }
}
