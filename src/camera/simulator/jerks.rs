//! Jerks of the hand that holds the camera: quick, short, soon taken back.
//!
//! Input: a time of the movement, s. Output: what is added to position, m, and yaw, pitch, roll, rad. Each jerk goes out within
//! [`RISE_S`], is held for a moment and comes back as fast, along `6x⁵ - 15x⁴ + 10x³`: the minimum-jerk profile of a reaching hand
//! (Flash and Hogan, "The coordination of arm movements", J. Neuroscience 1985), whose peak speed is 15/8 of its mean. Turn and shift
//! belong together: the camera turns about the wrist.
//!
//! One jerk a period, each a pure function of seed and period. Cost: below 1 us.

use nalgebra::Vector3;

use super::random::{Random, mix};
use crate::camera::simulator_config::JerksConfig;

/// Time of the way out, and of the way back, s.
const RISE_S: f64 = 0.4;
/// Peak speed of the profile over its mean.
const PEAK: f64 = 15.0 / 8.0;
/// Size of the weakest jerk, the strongest is 1.
const WEAKEST: f64 = 0.4;

/// `6x⁵ - 15x⁴ + 10x³` on 0..1, constant outside: twice continuously differentiable.
pub(super) fn smooth(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * x * (10.0 + x * (6.0 * x - 15.0))
}

/// What a jerk adds.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shift {
    /// World axes, m.
    pub(super) position: Vector3<f64>,
    /// Yaw, pitch, roll, rad.
    pub(super) angles: Vector3<f64>,
}

/// All jerks of one movement.
#[derive(Debug, Clone)]
pub(super) struct Jerks {
    config: JerksConfig,
    seed: u64,
}

impl Jerks {
    /// `None`: the hand is calm.
    pub(super) fn new(config: &JerksConfig, seed: u64) -> Option<Self> {
        config.enabled.then(|| Self { config: config.clone(), seed: mix(seed ^ 0x3e4c) })
    }

    /// At time `t`; nothing before the end of the first half period.
    pub(super) fn at(&self, t: f64) -> Shift {
        let mut sum = Shift { position: Vector3::zeros(), angles: Vector3::zeros() };
        let period = self.config.period_s;
        let current = (t / period).floor() as i64;
        // One that begins late in its period ends in the next one.
        for k in [current - 1, current] {
            let Ok(stream) = u64::try_from(k) else { continue };
            let mut random = Random::new(self.seed, stream);
            let start = (k as f64 + random.range(0.5, 0.8)) * period;
            let hold_s = random.range(0.0, 0.2);
            let size = random.range(WEAKEST, 1.0);
            let share = size * (smooth((t - start) / RISE_S) - smooth((t - start - RISE_S - hold_s) / RISE_S));
            // Mostly to the sides and up and down; a hand rolls less.
            let axis = Vector3::new(random.normal(), 0.7 * random.normal(), 0.4 * random.normal());
            let way = Vector3::new(0.6 * random.normal(), random.normal(), 0.7 * random.normal());
            let unit = |v: Vector3<f64>| v.try_normalize(1e-9).unwrap_or_else(Vector3::x);
            sum.angles += unit(axis) * (share * self.config.turn_deg_s.to_radians() * RISE_S / PEAK);
            sum.position += unit(way) * (share * self.config.speed_m_s * RISE_S / PEAK);
        }
        sum
    }
}
