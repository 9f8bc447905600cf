//! Wheel odometry: what the base's driver tells of its motion.
//!
//! In: a driver's messages ([`WheelMessage`]), from a recording's `odometry.txt`, the simulator or the wire. Each is judged by itself and against
//! the one before ([`WheelFault`]), and what is believed waits in a bounded queue ([`WheelQueue`]) until the frame comes that it belongs to. Out:
//! [`WheelReading`]s in the order of time, before the first frame that is not earlier than they.

mod message;
mod queue;

pub use message::{GAP_NS, MAX_SPEED_MPS, MAX_TURN_RADPS, WheelFault, WheelMessage};
pub use queue::{CAPACITY, WheelCounts, WheelQueue};

/// Mean twist of the base over an interval, in the base frame (REP-103: x forward, y left, yaw positive to the left) at its start.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WheelReading {
    /// Start of the interval, ns, in the clock of the pictures' timestamps; readings without a gap follow on from the one before.
    pub from_ns: i64,
    /// End of the interval, ns.
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
