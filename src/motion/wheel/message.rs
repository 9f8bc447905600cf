//! One message of a base's driver, before anything of it is believed.

use std::fmt;

/// More time than this between two readings is missing data, and not standing, ns; so no reading is the mean over more.
pub const GAP_NS: i64 = 500_000_000;
/// Faster than this no robot drives that Cairn is for, m/s: a driver that sends mm/s passes it at 5 cm/s. A car's wheels stay below.
pub const MAX_SPEED_MPS: f64 = 50.0;
/// Nor does one turn faster, rad/s (three turns a second): a driver that sends degrees/s passes it in any quick turn.
pub const MAX_TURN_RADPS: f64 = 20.0;

/// Largest variance of a field: a speed that is not known to this is not measured.
fn most_variance(name: &str) -> f64 {
    let most = if name == "angular_z_radps" { MAX_TURN_RADPS } else { MAX_SPEED_MPS };
    most * most
}

/// What a driver says: the mean twist of the base over an interval, in the base frame at its start (REP-103: x forward, y left, yaw positive to
/// the left).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WheelMessage {
    /// For the log: the line of a file, or the sequence number on the wire.
    pub number: u64,
    /// Start of the interval, ns; `None`: where the message before ended.
    pub from_ns: Option<i64>,
    /// End of the interval, ns, in the clock of the pictures' timestamps.
    pub timestamp_ns: i64,
    /// m/s.
    pub linear_x_mps: f64,
    /// m/s.
    pub linear_y_mps: f64,
    /// rad/s.
    pub angular_z_radps: f64,
    /// Variances of the three, (m/s)^2, (m/s)^2, (rad/s)^2; NaN or 0 where the driver does not know.
    pub variance: [f64; 3],
}

/// Why a message is not believed; it is counted, named in the log, and nothing of it is used.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum WheelFault {
    /// NaN or infinite, by name.
    NotFinite {
        name: &'static str,
        value: f64,
    },
    Speed {
        name: &'static str,
        value_mps: f64,
    },
    TurnRate {
        value_radps: f64,
    },
    /// Negative, or above the square of what no robot's speed exceeds.
    Variance {
        name: &'static str,
        value: f64,
    },
    /// The interval ends where it starts or before, or is longer than a gap.
    Interval {
        length_ns: i64,
    },
    /// Time repeats or goes back behind the message before.
    GoesBack {
        by_ns: i64,
    },
    /// Ahead of messages that follow it.
    JumpsAhead {
        by_ns: i64,
    },
    /// The stamp is not of the pictures' clock.
    WrongClock {
        ahead_ns: i64,
    },
    /// There is a publisher already, and this is another one.
    SecondPublisher,
}

impl WheelFault {
    /// One word, for records that are searched.
    pub fn name(&self) -> &'static str {
        match self {
            Self::NotFinite { .. } => "not_finite",
            Self::Speed { .. } => "speed",
            Self::TurnRate { .. } => "turn_rate",
            Self::Variance { .. } => "variance",
            Self::Interval { .. } => "interval",
            Self::GoesBack { .. } => "goes_back",
            Self::JumpsAhead { .. } => "jumps_ahead",
            Self::WrongClock { .. } => "wrong_clock",
            Self::SecondPublisher => "second_publisher",
        }
    }
}

impl fmt::Display for WheelFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ms = |ns: &i64| *ns as f64 * 1e-6;
        match self {
            Self::NotFinite { name, value } => write!(f, "{name} is {value}, no finite number"),
            Self::Speed { name, value_mps } => {
                write!(f, "{name} {value_mps} m/s: faster than {MAX_SPEED_MPS} m/s; is it in another unit?")
            }
            Self::TurnRate { value_radps } => {
                write!(f, "angular_z_radps {value_radps} rad/s: faster than {MAX_TURN_RADPS} rad/s; is it in degrees?")
            }
            Self::Variance { name, value } => {
                write!(f, "variance of {name} is {value}: must lie in 0..={}, or be NaN", most_variance(name))
            }
            Self::Interval { length_ns } => {
                write!(f, "its interval lasts {:.3} ms: must be above 0 and at most 500 ms", ms(length_ns))
            }
            Self::GoesBack { by_ns: 0 } => write!(f, "its time repeats that of the one before"),
            Self::GoesBack { by_ns } => write!(f, "its time goes back {:.3} ms behind the one before", ms(by_ns)),
            Self::JumpsAhead { by_ns } => write!(f, "its time is {:.3} ms ahead of one that follows", ms(by_ns)),
            Self::WrongClock { ahead_ns } => {
                write!(f, "its time is {:.3} s ahead of the pictures' clock: is it another one?", ms(ahead_ns) * 1e-3)
            }
            Self::SecondPublisher => write!(f, "it comes from a second publisher while the first lives"),
        }
    }
}

impl WheelMessage {
    /// A reading whose driver knows no variances.
    pub fn new(number: u64, timestamp_ns: i64, [linear_x_mps, linear_y_mps, angular_z_radps]: [f64; 3]) -> Self {
        let variance = [f64::NAN; 3];
        Self { number, from_ns: None, timestamp_ns, linear_x_mps, linear_y_mps, angular_z_radps, variance }
    }

    /// What is wrong with the message by itself.
    pub fn fault(&self) -> Option<WheelFault> {
        const NAMES: [&str; 3] = ["linear_x_mps", "linear_y_mps", "angular_z_radps"];
        let values = [self.linear_x_mps, self.linear_y_mps, self.angular_z_radps];
        for (name, value) in NAMES.into_iter().zip(values) {
            if !value.is_finite() {
                return Some(WheelFault::NotFinite { name, value });
            }
        }
        for (name, value_mps) in NAMES.into_iter().zip(values).take(2) {
            if value_mps.abs() > MAX_SPEED_MPS {
                return Some(WheelFault::Speed { name, value_mps });
            }
        }
        if self.angular_z_radps.abs() > MAX_TURN_RADPS {
            return Some(WheelFault::TurnRate { value_radps: self.angular_z_radps });
        }
        let variances = NAMES.into_iter().zip(self.variance);
        for (name, value) in variances.filter(|(_, value)| !value.is_nan()) {
            if !(0.0..=most_variance(name)).contains(&value) {
                return Some(WheelFault::Variance { name, value });
            }
        }
        let length_ns = self.timestamp_ns.saturating_sub(self.from_ns?);
        (length_ns <= 0 || length_ns > GAP_NS).then_some(WheelFault::Interval { length_ns })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_fault_is_named_with_value_and_unit() {
        let good = WheelMessage::new(1, 0, [0.5, 0.0, 0.2]);
        assert_eq!(good.fault(), None);
        let cases: [(WheelMessage, &str, &str); 9] = [
            (WheelMessage { linear_x_mps: f64::NAN, ..good }, "not_finite", "linear_x_mps is NaN"),
            (WheelMessage { angular_z_radps: f64::INFINITY, ..good }, "not_finite", "angular_z_radps is inf"),
            (WheelMessage { linear_y_mps: -500.0, ..good }, "speed", "linear_y_mps -500 m/s"),
            (WheelMessage { angular_z_radps: 57.3, ..good }, "turn_rate", "57.3 rad/s"),
            (WheelMessage { variance: [1.0, -1.0, f64::NAN], ..good }, "variance", "linear_y_mps is -1"),
            (WheelMessage { variance: [2501.0, 0.0, 0.0], ..good }, "variance", "must lie in 0..=2500"),
            (WheelMessage { variance: [0.0, 0.0, f64::INFINITY], ..good }, "variance", "must lie in 0..=400"),
            (WheelMessage { from_ns: Some(0), ..good }, "interval", "0.000 ms"),
            (WheelMessage { from_ns: Some(-600_000_000), ..good }, "interval", "600.000 ms"),
        ];
        for (message, name, part) in cases {
            let fault = message.fault().unwrap_or_else(|| panic!("{message:?}"));
            assert_eq!(fault.name(), name);
            assert!(fault.to_string().contains(part), "{fault}");
        }
    }
}
