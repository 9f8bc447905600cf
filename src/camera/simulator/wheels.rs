//! The base's wheels: what their encoders count while the camera is driven along its trajectory, and what the driver makes of it.
//!
//! Input: the base's true place at any time ([`Trajectory::base_at_seconds`]). Output: one [`WheelMessage`] a period of the driver (REP-103 base
//! frame: the middle between the wheels on the floor, x forward), the mean twist since the message before.
//!
//! Kinematic differential drive: on a stretch of the way with mid-heading the wheels roll `forward -+ track / 2 * turn`. A wheel of a larger radius
//! than the driver supposes counts less; one that slips by `s` counts `1 / (1 - s)` of its way over ground (the slip ratio of a driven wheel); the
//! count is whole ticks, whose remainder is kept. What a wheel cannot see is what it slides sideways: `room_tour`'s base does in its corners.
//!
//! A message is a pure function of configuration and number, whichever of them are lost. Deliberately not here: forces, tyres, casters.

use std::f64::consts::{PI, TAU};

use super::Trajectory;
use super::random::{Random, mix};
use crate::camera::simulator_config::{SimulatorConfig, WheelsConfig};
use crate::motion::wheel::WheelMessage;

/// Stretches of the way that a message is summed over: 4 ms each at 50 Hz.
const STRETCHES: u32 = 5;
/// Length of a burst of slip, s, and the share of a wheel's turning that is in vain.
const BURST_S: [f64; 2] = [1.0, 4.0];
const SLIP_SHARE: [f64; 2] = [0.3, 0.5];
/// Before this time nothing slips, s: a start from rest.
const CALM_S: f64 = 3.0;

/// One burst of slip.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Slip {
    /// After frame 0, s.
    pub start_s: f64,
    pub end_s: f64,
    /// Share of the left and the right wheel's turning that is in vain; 0 for one that grips.
    pub share: [f64; 2],
}

/// The driver of the base.
#[derive(Debug, Clone)]
pub struct Odometer {
    config: WheelsConfig,
    seed: u64,
    trajectory: Trajectory,
    random: Random,
    /// Number of the next message.
    next: u64,
    /// Counted of each wheel's way, m, and what the driver has told of it, ticks.
    ways_m: [f64; 2],
    told: [f64; 2],
}

impl Odometer {
    /// `None`: nothing is told of wheels, or no base drives this scenario.
    pub(super) fn new(config: &SimulatorConfig, trajectory: &Trajectory) -> Option<Self> {
        let driven = config.wheels.enabled && trajectory.base_at_seconds(0.0).is_some();
        driven.then(|| Self {
            config: config.wheels.clone(),
            seed: mix(config.seed ^ 0x51e5),
            trajectory: trajectory.clone(),
            random: Random::new(config.seed, 0x0d03),
            next: 0,
            ways_m: [0.0; 2],
            told: [0.0; 2],
        })
    }

    /// The stamp of the next message, ns in the clock of the frames.
    pub fn next_stamp_ns(&self) -> i64 {
        let seconds = self.next as f64 / self.config.rate_hz + self.config.delay_ms * 1e-3;
        self.trajectory.start_ns() + (seconds * 1e9).round() as i64
    }

    /// The next message; `None` if it is lost on the way.
    pub fn next_message(&mut self) -> Option<WheelMessage> {
        let (number, timestamp_ns) = (self.next, self.next_stamp_ns());
        let period_s = 1.0 / self.config.rate_hz;
        let end_s = number as f64 * period_s;
        // Always as many draws, so that no effect moves another one's.
        let (noise, lost) = ([self.random.normal(), self.random.normal()], self.random.chance(self.config.loss_share));
        let ways = self.counted_m(end_s - period_s, end_s);
        let tick_m = self.config.tick_mm * 1e-3;
        let mut told_m = [0.0; 2];
        for i in 0..2 {
            self.ways_m[i] += ways[i] * (1.0 + self.config.noise_share * noise[i]);
            let ticks = (self.ways_m[i] / tick_m).floor();
            told_m[i] = (ticks - self.told[i]) * tick_m;
            self.told[i] = ticks;
        }
        self.next += 1;
        let [left, right] = told_m;
        let twist = [0.5 * (left + right) / period_s, 0.0, (right - left) / (self.config.track_m * period_s)];
        (!lost).then(|| WheelMessage::new(number, timestamp_ns, twist))
    }

    /// Way of both wheels as their encoders see it, m.
    fn counted_m(&self, from_s: f64, to_s: f64) -> [f64; 2] {
        let mut sums = [0.0; 2];
        let step = (to_s - from_s) / f64::from(STRETCHES);
        for k in 0..STRETCHES {
            let (a, b) = (from_s + step * f64::from(k), from_s + step * f64::from(k + 1));
            let (Some(from), Some(to)) = (self.trajectory.base_at_seconds(a), self.trajectory.base_at_seconds(b))
            else {
                continue;
            };
            let turn = (to[2] - from[2] + PI).rem_euclid(TAU) - PI;
            let (sin, cos) = (from[2] + 0.5 * turn).sin_cos();
            let forward = (to[0] - from[0]) * cos + (to[1] - from[1]) * sin;
            let side = 0.5 * self.config.track_m * turn;
            let slip = self.slip_at(0.5 * (a + b)).map_or([0.0; 2], |slip| slip.share);
            for (i, way) in [forward - side, forward + side].into_iter().enumerate() {
                sums[i] += way / ((1.0 - slip[i]) * (1.0 + self.config.radius_error[i]));
            }
        }
        sums
    }

    fn slip_at(&self, seconds: f64) -> Option<Slip> {
        let slip = self.slip((seconds / self.config.slip_period_s).floor() as i64)?;
        (slip.start_s..slip.end_s).contains(&seconds).then_some(slip)
    }

    /// The burst of a period: one in each, at a random moment, which ends before the period does.
    fn slip(&self, period: i64) -> Option<Slip> {
        let stream = u64::try_from(period).ok().filter(|_| self.config.slip)?;
        let mut random = Random::new(self.seed, stream);
        let length_s = random.range(BURST_S[0], BURST_S[1]);
        let period_s = self.config.slip_period_s;
        let start_s = period as f64 * period_s + random.range(CALM_S, period_s - length_s);
        let share = random.range(SLIP_SHARE[0], SLIP_SHARE[1]);
        let share = [[share, share], [share, 0.0], [0.0, share]][random.index(3)];
        Some(Slip { start_s, end_s: start_s + length_s, share })
    }

    /// All bursts that begin within so many seconds, for who judges.
    pub fn slips(&self, seconds: f64) -> Vec<Slip> {
        let periods = (seconds / self.config.slip_period_s).ceil().clamp(0.0, 1e6) as i64;
        (0..periods).filter_map(|k| self.slip(k)).filter(|slip| slip.start_s < seconds).collect()
    }
}
