//! Wheel odometry over an interval: from readings to one planar motion with its covariance.
//!
//! Input: [`WheelReading`]s in order (mean twists of the base: m/s, rad/s) and an interval in their clock (ns). Output: the base's motion on
//! its plane over that interval, `start_from_end` (m, rad), and its covariance. Each reading is taken as a constant body twist over its own
//! interval, so that a reading is an arc (the exponential of SE(2)), and a part of a reading is a part of that arc:
//!
//! ```text
//! a = w dt     [dx, dy] = V(a) [vx, vy] dt     V(a) = | sin a / a       -(1 - cos a) / a |
//!                                                     | (1 - cos a) / a   sin a / a      |
//! T <- T exp(xi dt)        P <- F P F' + R Q R' (left-additive errors of x, y and yaw in the axes at the start)
//! ```
//!
//! Missing data is not standing: an interval with more than [`LONGEST_GAP_NS`] that no reading covers has no motion. A shorter hole within it
//! is bridged by the reading before, with the variance that this deserves. Readings shorter than `MERGED_NS` are merged, so that the store is
//! bounded in time whatever the driver's rate. Cost: 30 ns a reading. Not here: slip, scale, what the wheels have in common with a camera.

use std::collections::VecDeque;

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

use super::wheel::WheelReading;

/// A hole between readings that is longer is missing data, ns.
pub const LONGEST_GAP_NS: i64 = 500_000_000;
/// At either end of an interval no more than this is taken on trust, ns (a reading of a 50 Hz driver that is still on its way).
const OPEN_END_NS: i64 = 20_000_000;
/// Readings of drivers faster than 100 Hz are merged up to this length, ns.
const MERGED_NS: i64 = 10_000_000;
/// Readings kept: 82 s at the least (of a driver of just below 200 Hz, of which no two fit into `MERGED_NS`), 327 s at 50 Hz.
const READINGS: usize = 16_384;
/// Where the driver does not tell: standard deviation of a speed as a share of it and at rest (m/s; rad/s), and the time over which such errors
/// hang together, s. Encoders of small robots on a hard floor are good for some per cent of the way.
const SPEED_SHARE: f64 = 0.03;
const SPEED_FLOOR_MPS: f64 = 0.01;
const YAW_RATE_FLOOR_RADPS: f64 = 0.01;
const CORRELATED_S: f64 = 0.1;
/// Standard deviation of what a hole is bridged by, as a share of the speed, beside the reading's own.
const BRIDGE_SHARE: f64 = 0.5;
/// Faster than any robot that this is for; what claims it is not believed, m/s and rad/s.
const ABSURD_SPEED_MPS: f64 = 100.0;
const ABSURD_YAW_RATE_RADPS: f64 = 50.0;

/// A motion on the plane: the frame at its end in the axes at its start.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Planar {
    /// m, forward and left.
    pub translation: Vector2<f64>,
    /// rad, positive to the left.
    pub yaw: f64,
}

impl Planar {
    /// A constant twist over a time, s: an arc.
    fn arc(velocity: Vector2<f64>, yaw_rate: f64, dt: f64) -> Self {
        let a = yaw_rate * dt;
        let (sine, versine) = match a.abs() < 1e-4 {
            // Below, the next term of the series is under the rounding.
            true => (1.0 - a * a / 6.0, 0.5 * a),
            false => (a.sin() / a, (1.0 - a.cos()) / a),
        };
        Self { translation: Matrix2::new(sine, -versine, versine, sine) * velocity * dt, yaw: a }
    }

    /// `self`, then `next`.
    pub fn then(&self, next: &Self) -> Self {
        Self { translation: self.translation + rotated(self.yaw, &next.translation), yaw: self.yaw + next.yaw }
    }
}

fn rotated(yaw: f64, v: &Vector2<f64>) -> Vector2<f64> {
    let (sine, cosine) = yaw.sin_cos();
    Vector2::new(cosine * v.x - sine * v.y, sine * v.x + cosine * v.y)
}

/// What the wheels say of an interval.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Increment {
    pub motion: Planar,
    /// Of x, y (m^2) and yaw (rad^2), in the axes at the start.
    pub covariance: Matrix3<f64>,
    /// Length of the way, m: not the distance of its ends.
    pub way_m: f64,
}

/// The newest readings, in order.
#[derive(Debug, Clone, Default)]
pub struct WheelHistory {
    readings: VecDeque<WheelReading>,
}

impl WheelHistory {
    /// Takes a reading; `false`, and nothing taken, if it makes no sense: not finite, absurdly fast, of no length or longer than
    /// [`LONGEST_GAP_NS`], or not after the one before.
    pub fn add(&mut self, reading: &WheelReading) -> bool {
        let twist = [reading.linear_x_mps, reading.linear_y_mps, reading.angular_z_radps];
        let span = reading.timestamp_ns.saturating_sub(reading.from_ns);
        let sane = twist.iter().all(|v| v.is_finite())
            && Vector2::new(twist[0], twist[1]).norm() <= ABSURD_SPEED_MPS
            && twist[2].abs() <= ABSURD_YAW_RATE_RADPS;
        if !sane || !(1..=LONGEST_GAP_NS).contains(&span) {
            return false;
        }
        let mut reading = *reading;
        // Drivers of ROS say 0 where they do not know; nothing is known exactly.
        reading.variance = reading.variance.map(|told| if told > 0.0 && told.is_finite() { told } else { f64::NAN });
        if let Some(last) = self.readings.back_mut() {
            if reading.timestamp_ns <= last.timestamp_ns {
                return false;
            }
            reading.from_ns = reading.from_ns.max(last.timestamp_ns);
            if reading.from_ns == last.timestamp_ns && reading.timestamp_ns - last.from_ns <= MERGED_NS {
                merge(last, &reading);
                return true;
            }
        }
        if self.readings.capacity() < READINGS {
            // All at the first reading (1 MB), so that none later costs a pose its time.
            self.readings.reserve_exact(READINGS - self.readings.len());
        }
        if self.readings.len() == READINGS {
            self.readings.pop_front();
        }
        self.readings.push_back(reading);
        true
    }

    /// End of the newest reading, ns.
    pub fn newest_ns(&self) -> Option<i64> {
        self.readings.back().map(|r| r.timestamp_ns)
    }

    pub fn is_empty(&self) -> bool {
        self.readings.is_empty()
    }

    /// The motion from one time to another, ns, its yaw rates taken times `yaw_factor`; `None` where data is missing.
    pub fn integrate(&self, from_ns: i64, to_ns: i64, yaw_factor: f64) -> Option<Increment> {
        self.integrate_until(from_ns, to_ns, yaw_factor, OPEN_END_NS)
    }

    /// The same up to a time that the newest readings may not reach yet: the last one is supposed to hold for so long, ns, with the variance that this
    /// deserves; `None` where data is missing or the newest reading is older.
    pub fn integrate_until(&self, from_ns: i64, to_ns: i64, yaw_factor: f64, longest_ns: i64) -> Option<Increment> {
        let fresh = self.newest_ns().is_some_and(|newest| to_ns.saturating_sub(newest) <= longest_ns);
        if !fresh {
            return None;
        }
        let mut sum = Sum { yaw_factor, ..Sum::default() };
        let first = self.readings.partition_point(|r| r.timestamp_ns <= from_ns);
        let mut at = from_ns;
        let mut before = first.checked_sub(1).and_then(|i| self.readings.get(i));
        for reading in self.readings.range(first..) {
            if at >= to_ns {
                break;
            }
            let begin = reading.from_ns.max(at).min(to_ns);
            if begin > at {
                let longest = if before.is_none() || at == from_ns { OPEN_END_NS } else { LONGEST_GAP_NS };
                let missing = before.is_some_and(|before| reading.from_ns - before.timestamp_ns > LONGEST_GAP_NS);
                if missing || begin - at > longest {
                    return None;
                }
                sum.add(before.unwrap_or(reading), begin - at, BRIDGE_SHARE);
            }
            let end = reading.timestamp_ns.min(to_ns);
            if end > begin {
                sum.add(reading, end - begin, 0.0);
            }
            at = end.max(at);
            before = Some(reading);
        }
        if at < to_ns {
            sum.add(before?, to_ns - at, BRIDGE_SHARE);
        }
        Some(Increment { motion: sum.motion, covariance: sum.covariance, way_m: sum.way_m })
    }
}

/// `next` follows on from `into` without a gap: both become one, which moves as they do together (to second order of the turn).
fn merge(into: &mut WheelReading, next: &WheelReading) {
    let (a, b) = ((into.timestamp_ns - into.from_ns) as f64, (next.timestamp_ns - next.from_ns) as f64);
    let (wa, wb) = (a / (a + b), b / (a + b));
    into.linear_x_mps = wa * into.linear_x_mps + wb * next.linear_x_mps;
    into.linear_y_mps = wa * into.linear_y_mps + wb * next.linear_y_mps;
    into.angular_z_radps = wa * into.angular_z_radps + wb * next.angular_z_radps;
    for (mine, other) in into.variance.iter_mut().zip(next.variance) {
        *mine = wa * wa * *mine + wb * wb * other;
    }
    into.timestamp_ns = next.timestamp_ns;
}

/// The motion so far.
#[derive(Default)]
struct Sum {
    yaw_factor: f64,
    motion: Planar,
    covariance: Matrix3<f64>,
    way_m: f64,
}

impl Sum {
    /// `reading` for this long; `doubt`: standard deviation, as a share of the speed, beside its own.
    fn add(&mut self, reading: &WheelReading, span_ns: i64, doubt: f64) {
        let dt = span_ns as f64 * 1e-9;
        let velocity = Vector2::new(reading.linear_x_mps, reading.linear_y_mps);
        let yaw_rate = reading.angular_z_radps * self.yaw_factor;
        let step = Planar::arc(velocity, yaw_rate, dt);
        let speeds = [velocity.norm(), velocity.norm(), yaw_rate.abs()];
        let floors = [SPEED_FLOOR_MPS, SPEED_FLOOR_MPS, YAW_RATE_FLOOR_RADPS];
        let variance = Vector3::from_fn(|i, _| {
            let told = reading.variance[i];
            let own = match told.is_nan() {
                false => told * dt * dt,
                true => ((SPEED_SHARE * speeds[i]).powi(2) + floors[i] * floors[i]) * dt * dt.max(CORRELATED_S),
            };
            own + (doubt * speeds[i] * dt).powi(2)
        });
        let moved = rotated(self.motion.yaw, &step.translation);
        // d x / d yaw, d y / d yaw of what came before.
        let f = Matrix3::new(1.0, 0.0, -moved.y, 0.0, 1.0, moved.x, 0.0, 0.0, 1.0);
        let (sine, cosine) = self.motion.yaw.sin_cos();
        let g = Matrix3::new(cosine, -sine, -0.5 * moved.y, sine, cosine, 0.5 * moved.x, 0.0, 0.0, 1.0);
        self.covariance = f * self.covariance * f.transpose() + g * Matrix3::from_diagonal(&variance) * g.transpose();
        self.motion = self.motion.then(&step);
        self.way_m += velocity.norm() * dt;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn reading(from_ms: i64, to_ms: i64, x: f64, yaw: f64) -> WheelReading {
        WheelReading {
            from_ns: from_ms * MS,
            timestamp_ns: to_ms * MS,
            linear_x_mps: x,
            linear_y_mps: 0.0,
            angular_z_radps: yaw,
            variance: [f64::NAN; 3],
        }
    }

    fn steady(x: f64, yaw: f64, step_ms: i64, end_ms: i64) -> WheelHistory {
        let mut history = WheelHistory::default();
        (0..end_ms / step_ms).for_each(|i| assert!(history.add(&reading(i * step_ms, (i + 1) * step_ms, x, yaw))));
        history
    }

    #[test]
    fn an_arc_is_the_closed_form_also_between_readings() {
        let (v, w) = (0.5, 0.8);
        let history = steady(v, w, 20, 4000);
        for (from, to) in [(0, 4000), (7, 3111), (1005, 1013), (990, 1030)] {
            let found = history.integrate(from * MS, to * MS, 1.0).expect("covered");
            let a = w * (to - from) as f64 * 1e-3;
            let want = Vector2::new(a.sin(), 1.0 - a.cos()) * (v / w);
            assert!((found.motion.translation - want).norm() < 1e-12 && (found.motion.yaw - a).abs() < 1e-12);
            assert!((found.way_m - v * (to - from) as f64 * 1e-3).abs() < 1e-12);
        }
        let straight = steady(v, 0.0, 20, 1000).integrate(0, 1000 * MS, 1.0).expect("covered");
        assert!((straight.motion.translation - Vector2::new(0.5, 0.0)).norm() < 1e-12);
        let corrected = history.integrate(0, 1000 * MS, 1.1).expect("covered");
        assert!((corrected.motion.yaw - 0.88).abs() < 1e-12, "the factor is on the yaw rate");
    }

    #[test]
    fn two_parts_make_the_whole() {
        let history = steady(0.4, -0.6, 25, 3000);
        let part = |a: i64, b: i64| history.integrate(a * MS, b * MS, 1.0).expect("covered").motion;
        let (whole, halves) = (part(110, 2870), part(110, 1234).then(&part(1234, 2870)));
        assert!((whole.translation - halves.translation).norm() < 1e-12 && (whole.yaw - halves.yaw).abs() < 1e-12);
    }

    #[test]
    fn missing_data_is_not_standing() {
        let mut history = steady(1.0, 0.0, 50, 1000);
        assert!(history.integrate(500 * MS, 1015 * MS, 1.0).is_some(), "a reading may be on its way");
        assert!(history.integrate(500 * MS, 1200 * MS, 1.0).is_none());
        assert!(history.integrate(-100 * MS, 500 * MS, 1.0).is_none());
        assert!(history.integrate(5000 * MS, 5010 * MS, 1.0).is_none(), "a short time, long after the last reading");
        // A hole of 0.4 s is bridged, one of 0.6 s is not.
        assert!(history.add(&reading(1400, 1450, 1.0, 0.0)));
        let bridged = history.integrate(500 * MS, 1450 * MS, 1.0).expect("a short hole");
        assert!((bridged.motion.translation.x - 0.95).abs() < 1e-12);
        let sure = history.integrate(0, 950 * MS, 1.0).expect("covered");
        assert!(bridged.covariance[(0, 0)] > 10.0 * sure.covariance[(0, 0)], "and says that it was");
        assert!(history.add(&reading(2050, 2100, 1.0, 0.0)));
        assert!(history.integrate(1300 * MS, 2100 * MS, 1.0).is_none());
        assert!(history.integrate(1800 * MS, 1815 * MS, 1.0).is_none(), "a short time within what is missing");
    }

    #[test]
    fn the_newest_reading_may_hold_for_a_while_and_no_longer() {
        let history = steady(1.0, 0.0, 50, 1000);
        let until = |to: i64| history.integrate_until(900 * MS, to * MS, 1.0, 200 * MS);
        let ahead = until(1150).expect("held");
        assert!((ahead.motion.translation.x - 0.25).abs() < 1e-12);
        assert!(ahead.covariance[(0, 0)] > 10.0 * until(1000).expect("covered").covariance[(0, 0)], "and says so");
        assert!(until(1250).is_none(), "silent");
        let late = history.integrate_until(5000 * MS, 5100 * MS, 1.0, 200 * MS);
        assert!(late.is_none(), "an interval that is short and long after the last reading");
    }

    #[test]
    fn what_makes_no_sense_is_not_taken() {
        let mut history = steady(1.0, 0.0, 50, 1000);
        for bad in [
            reading(1000, 1050, f64::NAN, 0.0),
            reading(1000, 1050, 1.0, f64::INFINITY),
            reading(1000, 1050, 1e9, 0.0),
            reading(1000, 1050, 1.0, 1e3),
            reading(900, 950, 1.0, 0.0),
            reading(1050, 1050, 1.0, 0.0),
            reading(1000, 1600, 1.0, 0.0),
        ] {
            assert!(!history.add(&bad), "{bad:?}");
        }
        assert_eq!(history.newest_ns(), Some(1000 * MS));
    }

    #[test]
    fn a_fast_driver_fills_no_more_than_a_slow_one() {
        let (fast, slow) = (steady(0.7, 0.3, 1, 2000), steady(0.7, 0.3, 10, 2000));
        assert!(fast.readings.len() <= slow.readings.len() + 1);
        let (a, b) = (fast.integrate(0, 2000 * MS, 1.0), slow.integrate(0, 2000 * MS, 1.0));
        let (a, b) = (a.expect("covered").motion, b.expect("covered").motion);
        assert!((a.translation - b.translation).norm() < 1e-9 && (a.yaw - b.yaw).abs() < 1e-12);
    }

    #[test]
    fn a_variance_of_zero_is_one_that_is_not_known() {
        let drive = |variance: f64| {
            let mut history = WheelHistory::default();
            for i in 0..20 {
                let told = WheelReading { variance: [variance; 3], ..reading(i * 50, (i + 1) * 50, 0.5, 0.1) };
                assert!(history.add(&told));
            }
            history.integrate(0, 1000 * MS, 1.0).expect("covered").covariance
        };
        assert_eq!(drive(0.0), drive(f64::NAN));
        assert!(drive(0.0)[(0, 0)] > 1e-6 && drive(1e-12)[(0, 0)] < 1e-9, "what is told is believed");
    }

    #[test]
    fn covariance_is_that_of_noisy_readings() {
        use crate::geometry::random::Random;
        let sigma = [0.05, 0.02, 0.08];
        let mut random = Random::new(5);
        let (mut sum, n) = (Matrix3::zeros(), 2000);
        let drive = |noise: &mut dyn FnMut() -> f64| {
            let mut history = WheelHistory::default();
            for i in 0..40 {
                let mut r = reading(i * 50, (i + 1) * 50, 0.5 + sigma[0] * noise(), 0.4 + sigma[2] * noise());
                r.linear_y_mps = sigma[1] * noise();
                r.variance = sigma.map(|s| s * s);
                history.add(&r);
            }
            history.integrate(0, 2000 * MS, 1.0).expect("covered")
        };
        let truth = drive(&mut || 0.0);
        for _ in 0..n {
            let found = drive(&mut || random.normal());
            let e = found.motion.translation - truth.motion.translation;
            let e = Vector3::new(e.x, e.y, found.motion.yaw - truth.motion.yaw);
            sum += e * e.transpose() / f64::from(n);
        }
        for i in 0..3 {
            let ratio = sum[(i, i)] / truth.covariance[(i, i)];
            assert!((0.85..1.15).contains(&ratio), "entry {i}: sampled over told {ratio}");
        }
    }
}
