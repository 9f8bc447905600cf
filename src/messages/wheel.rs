//! What a base's wheels say: the one service that the daemon reads and somebody else writes.

use iceoryx2::prelude::ZeroCopySend;

use super::UNKNOWN_NS;

/// The mean twist of the base over an interval, in the base frame at its start (REP-103: x forward, y left, yaw positive to the left).
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("cairn.WheelOdometry.v1")]
pub struct WheelOdometry {
    /// Counts the driver's messages, so that lost ones are seen; a driver that starts anew may begin anywhere.
    pub sequence: u64,
    /// CLOCK_MONOTONIC at the end of the interval, ns.
    pub timestamp_ns: i64,
    /// CLOCK_MONOTONIC at its start, ns, at most 0.5 s before; [`UNKNOWN_NS`]: where the message before ended.
    pub interval_start_ns: i64,
    /// Forward, m/s.
    pub linear_x_mps: f64,
    /// To the left, m/s; 0 of a base that cannot.
    pub linear_y_mps: f64,
    /// Turn to the left, rad/s.
    pub angular_z_radps: f64,
    /// Variances of the three, (m/s)^2, (m/s)^2, (rad/s)^2; NaN or 0 where the driver does not know.
    pub variance: [f64; 3],
    /// Zero.
    pub reserved: [u8; 24],
}

layout!(WheelOdometry, "cairn.WheelOdometry.v1", 96, {
    sequence @ 0, timestamp_ns @ 8, interval_start_ns @ 16, linear_x_mps @ 24, linear_y_mps @ 32, angular_z_radps @ 40,
    variance @ 48, reserved @ 72,
});

impl Default for WheelOdometry {
    /// Nothing is known.
    fn default() -> Self {
        Self {
            sequence: 0,
            timestamp_ns: UNKNOWN_NS,
            interval_start_ns: UNKNOWN_NS,
            linear_x_mps: f64::NAN,
            linear_y_mps: f64::NAN,
            angular_z_radps: f64::NAN,
            variance: [f64::NAN; 3],
            reserved: [0; 24],
        }
    }
}
