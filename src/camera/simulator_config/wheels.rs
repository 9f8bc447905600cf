//! `[simulator.wheels]`: the base under the camera of a driven scenario, and what spoils its odometry.

use serde::{Deserialize, Serialize};

use super::{Scenario, SimulatorConfigError, within};

config! {
    /// A differential-drive base and its driver. Only where a base drives (`room_tour`, `square`, `corridor`, `three_rooms`, `look_alike`, without jerks of a hand).
    WheelsConfig {
        /// Tell of the wheels.
        enabled: bool = false,
        /// Messages a second, Hz, 5..=200; each is the mean over the time since the one before.
        rate_hz: f64 = 50.0,
        /// Distance of the wheels from each other, m, 0.05..=2.
        track_m: f64 = 0.23,
        /// Way that a wheel drives from one count of its encoder to the next, mm, 0.01..=20.
        tick_mm: f64 = 0.5,
        /// By what share the left and the right wheel's true radius exceeds what the driver supposes, no unit, -0.2..=0.2.
        radius_error: [f64; 2] = [0.0, 0.0],
        /// Standard deviation of a message's way of each wheel as a share of it: uneven ground, no unit, 0..=0.5.
        noise_share: f64 = 0.01,
        /// The wheels slip in bursts of 1 to 4 s: left, right or both turn 30 to 50 % in vain.
        slip: bool = false,
        /// Time from one burst to the next on average, s, 8..=1000.
        slip_period_s: f64 = 15.0,
        /// The driver's stamps are later than the motion by this time, ms, 0..=200.
        delay_ms: f64 = 0.0,
        /// Share of the messages that are lost on the way, no unit, 0..=0.5.
        loss_share: f64 = 0.0,
        /// Place of the camera on the base, forward and to the left of the middle between the wheels, m, -0.3..=0.3. Its height is 0.5 m, its
        /// pitch 0.04 rad upwards.
        camera_m: [f64; 2] = [0.0, 0.0],
        /// Angle by which the camera looks to the left of where the base drives, degrees, -30..=30.
        camera_yaw_deg: f64 = 0.0,
    }
}

impl Scenario {
    /// A base on wheels drives the camera.
    pub fn is_driven(self) -> bool {
        matches!(self, Self::RoomTour | Self::Square | Self::Corridor)
    }
}

impl WheelsConfig {
    pub(super) fn validate(&self) -> Result<(), SimulatorConfigError> {
        within("wheels.rate_hz", self.rate_hz, "Hz", 5.0, 200.0)?;
        within("wheels.track_m", self.track_m, "m", 0.05, 2.0)?;
        within("wheels.tick_mm", self.tick_mm, "mm", 0.01, 20.0)?;
        for error in self.radius_error {
            within("wheels.radius_error", error, "", -0.2, 0.2)?;
        }
        within("wheels.noise_share", self.noise_share, "", 0.0, 0.5)?;
        within("wheels.slip_period_s", self.slip_period_s, "s", 8.0, 1000.0)?;
        within("wheels.delay_ms", self.delay_ms, "ms", 0.0, 200.0)?;
        within("wheels.loss_share", self.loss_share, "", 0.0, 0.5)?;
        for offset in self.camera_m {
            within("wheels.camera_m", offset, "m", -0.3, 0.3)?;
        }
        within("wheels.camera_yaw_deg", self.camera_yaw_deg, "degrees", -30.0, 30.0)
    }
}
