//! How the daemon is, at a steady rate whatever else has stalled.

use iceoryx2::prelude::ZeroCopySend;

use super::{
    CLOCK_MONOTONIC, Clock, INTRINSICS_CALIBRATED, Intrinsics, LENS_RADIAL_TANGENTIAL, LensModel, STATE_INITIALIZING,
    State, UNKNOWN_NS,
};

/// Bits of [`Health::errors`]; a bit stands as long as its fault lasts.
pub mod error {
    /// No camera is there, or it cannot be opened.
    pub const NO_CAMERA: u64 = 1 << 0;
    /// The source is open and gives no frames.
    pub const NO_FRAMES: u64 = 1 << 1;
    /// No keypoint was found in the last frame: black, white, covered or badly out of focus.
    pub const NO_FEATURES: u64 = 1 << 2;
    /// So few keypoints or landmarks that tracking may be lost soon.
    pub const LOW_FEATURES: u64 = 1 << 3;
    /// Frames were dropped lately because the pipeline could not keep up, or were lost by the camera's driver.
    pub const DROPPED_FRAMES: u64 = 1 << 4;
    /// Frames lately could not be decoded.
    pub const CORRUPT_FRAMES: u64 = 1 << 5;
    /// Calibration is missing, is of another picture size, or does not fit what is seen.
    pub const BAD_CALIBRATION: u64 = 1 << 6;
    /// Frames lately had a time that repeats, goes back or jumps.
    pub const BAD_TIMESTAMP: u64 = 1 << 7;
    /// A stage has shown no sign of life for longer than its limit; see [`super::StageHealth::heartbeat_age_ns`].
    pub const STALLED_STAGE: u64 = 1 << 8;
    /// Map adjustments come later than configured.
    pub const MAPPING_LATE: u64 = 1 << 9;
    /// There was a map and tracking is lost.
    pub const LOST: u64 = 1 << 10;
    /// A file could not be written (trajectory, map).
    pub const SAVE_FAILED: u64 = 1 << 11;
    /// Messages lately could not be sent.
    pub const PUBLISH_FAILED: u64 = 1 << 12;
    /// The lens is a guess: nobody calibrated the camera, and its motion has not shown the focal length so far.
    pub const UNCALIBRATED: u64 = 1 << 13;
    /// The camera lately gave less than three quarters of the rate that it said it would.
    pub const LOW_RATE: u64 = 1 << 14;
    /// A turn on the spot has left everything behind whose distance was known: lengths since then are those of an assumed one,
    /// and may be off by a factor from those before.
    pub const SCALE_ASSUMED: u64 = 1 << 15;

    /// The base's driver has told of its wheels and has fallen silent, for a second at least.
    pub const WHEELS_SILENT: u64 = 1 << 16;
    /// Wheel messages lately were not believed: no number, an absurd speed, another clock, time that goes back, a second publisher.
    pub const WHEELS_WRONG: u64 = 1 << 17;
    /// Wheel messages lately were lost, or most of them came after the frame that they belong to.
    pub const WHEELS_LATE: u64 = 1 << 18;

    const NAMES: [(u64, &str); 19] = [
        (NO_CAMERA, "NO_CAMERA"),
        (NO_FRAMES, "NO_FRAMES"),
        (NO_FEATURES, "NO_FEATURES"),
        (LOW_FEATURES, "LOW_FEATURES"),
        (DROPPED_FRAMES, "DROPPED_FRAMES"),
        (CORRUPT_FRAMES, "CORRUPT_FRAMES"),
        (BAD_CALIBRATION, "BAD_CALIBRATION"),
        (BAD_TIMESTAMP, "BAD_TIMESTAMP"),
        (STALLED_STAGE, "STALLED_STAGE"),
        (MAPPING_LATE, "MAPPING_LATE"),
        (LOST, "LOST"),
        (SAVE_FAILED, "SAVE_FAILED"),
        (PUBLISH_FAILED, "PUBLISH_FAILED"),
        (UNCALIBRATED, "UNCALIBRATED"),
        (LOW_RATE, "LOW_RATE"),
        (SCALE_ASSUMED, "SCALE_ASSUMED"),
        (WHEELS_SILENT, "WHEELS_SILENT"),
        (WHEELS_WRONG, "WHEELS_WRONG"),
        (WHEELS_LATE, "WHEELS_LATE"),
    ];

    /// Names of the bits that are set; bits of a newer daemon together are `UNKNOWN`.
    pub fn names(errors: u64) -> impl Iterator<Item = &'static str> {
        crate::messages::bit_names(&NAMES, errors)
    }
}

/// Bits of `map_mode`: how the current map is used.
pub mod map_mode {
    /// The map does not grow: the robot is only located in it.
    pub const LOCALISATION_ONLY: u8 = 1 << 0;
    /// The current map is that of the map file, or has been joined to it: places in it are those of earlier runs.
    pub const STORED: u8 = 1 << 1;

    /// The map is told in the frame of the configuration's dock, a tag that has been seen.
    pub const DOCK_FRAME: u8 = 1 << 2;

    const NAMES: [(u8, &str); 3] =
        [(LOCALISATION_ONLY, "LOCALISATION_ONLY"), (STORED, "STORED"), (DOCK_FRAME, "DOCK_FRAME")];

    /// Names of the bits that are set; bits of a newer daemon together are `UNKNOWN`.
    pub fn names(mode: u8) -> impl Iterator<Item = &'static str> {
        crate::messages::bit_names(&NAMES, mode)
    }
}

/// Index into [`Health::stages`].
pub mod stage {
    /// Frames from the source into the ring.
    pub const CAPTURE: usize = 0;
    /// Decoding, pyramid, corners, tracks.
    pub const FEATURES: usize = 1;
    /// Pose of the frame.
    pub const TRACKING: usize = 2;
    /// Keyframes, landmarks, adjustment.
    pub const MAPPING: usize = 3;
    /// Messages into shared memory.
    pub const PUBLISHING: usize = 4;
    /// A whole frame, from its arrival to its published pose.
    pub const END_TO_END: usize = 5;
    /// Names by index.
    pub const NAMES: [&str; super::STAGES] = ["capture", "features", "tracking", "mapping", "publishing", "end_to_end"];
}

/// Number of stages.
pub const STAGES: usize = 6;

/// One stage of the pipeline over the last interval between two health messages (or longer, as the daemon chooses).
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("cairn.StageHealth.v1")]
pub struct StageHealth {
    /// Steps since the start.
    pub steps: u64,
    /// Time since the stage's last sign of life, ns; [`UNKNOWN_NS`] if it is not under watch.
    pub heartbeat_age_ns: i64,
    /// Median duration of a step, ms; NaN if there was none.
    pub p50_ms: f32,
    /// 95 of 100 steps were not longer, ms; NaN if there was none.
    pub p95_ms: f32,
    /// 99 of 100 steps were not longer, ms; NaN if there was none.
    pub p99_ms: f32,
    /// Steps a second; NaN = unknown.
    pub rate_hz: f32,
}

layout!(StageHealth, "cairn.StageHealth.v1", 32, {
    steps @ 0, heartbeat_age_ns @ 8, p50_ms @ 16, p95_ms @ 20, p99_ms @ 24, rate_hz @ 28,
});

impl Default for StageHealth {
    fn default() -> Self {
        let nan = f32::NAN;
        Self { steps: 0, heartbeat_age_ns: UNKNOWN_NS, p50_ms: nan, p95_ms: nan, p99_ms: nan, rate_hz: nan }
    }
}

/// The daemon's health. Counters count from its start.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("cairn.Health.v3")]
pub struct Health {
    /// Another value at every start of the daemon.
    pub run_id: u64,
    /// Counts health messages of this run.
    pub sequence: u64,
    /// CLOCK_MONOTONIC when this message was sent, ns.
    pub published_ns: i64,
    /// Time since the start, ns.
    pub uptime_ns: i64,
    /// CLOCK_REALTIME minus CLOCK_MONOTONIC, ns: add it to a monotonic time to get the time of day.
    pub realtime_minus_monotonic_ns: i64,
    /// Faults that stand now: bits of [`error`].
    pub errors: u64,
    /// Frames that arrived from the source.
    pub frames_captured: u64,
    /// Frames never looked at: a later one was there already, or the camera's driver lost them.
    pub frames_dropped: u64,
    /// Frames that could not be decoded.
    pub frames_corrupt: u64,
    /// Frames with a pose.
    pub frames_tracked: u64,
    /// Keyframes made.
    pub keyframes_made: u64,
    /// Landmarks made.
    pub landmarks_made: u64,
    /// Map adjustments merged.
    pub adjustments: u64,
    /// Map adjustments that came later than configured.
    pub adjustments_late: u64,
    /// Resets and re-initialisations.
    pub resets: u64,
    /// Times that a lost robot was found again in its map.
    pub relocalisations: u64,
    /// Maps that were recognised and joined to the current one.
    pub maps_joined: u64,
    /// Loops closed: places of the current map that were recognised after drift, and corrected.
    pub loops_closed: u64,
    /// Time since the last frame arrived, ns; [`UNKNOWN_NS`] if there was none.
    pub frame_age_ns: i64,
    /// Time since the last frame with a pose arrived, ns; [`UNKNOWN_NS`] if there was none.
    pub pose_age_ns: i64,
    /// By [`stage`].
    pub stages: [StageHealth; STAGES],
    /// Keyframes in the current map.
    pub keyframes: u32,
    /// Landmarks in the current map.
    pub landmarks: u32,
    /// Maps that are kept, the current one among them.
    pub maps: u32,
    /// As in [`super::Pose::reset_counter`].
    pub reset_counter: u32,
    /// As in [`super::Pose::map_id`].
    pub map_id: u32,
    /// As in [`super::Pose::map_revision`].
    pub map_revision: u32,
    /// Process id of the daemon.
    pub pid: u32,
    /// As in [`super::Pose::state`], of the last frame; lost, too, when pictures have stopped coming while tracking, and initializing
    /// when they have while only the orientation was known.
    pub state: u8,
    /// [`super::CLOCK_MONOTONIC`] or [`super::CLOCK_RECORDING`]: what the source's times count from.
    pub clock: u8,
    /// [`super::INTRINSICS_CALIBRATED`], [`super::INTRINSICS_ESTIMATED`], [`super::INTRINSICS_GUESSED`]: where focal length and
    /// principal point come from.
    pub intrinsics: u8,
    /// [`super::LENS_RADIAL_TANGENTIAL`], [`super::LENS_KANNALA_BRANDT`]: which lens model focal length and principal point are of.
    pub lens_model: u8,
    /// Version of the daemon, UTF-8, zero-padded.
    pub version: [u8; 32],
    /// Focal lengths fx and fy in use, px; NaN before the first frame.
    pub focal_px: [f32; 2],
    /// Principal point in use, px; NaN before the first frame.
    pub centre_px: [f32; 2],
    /// Standard deviation of the focal length, as a share of it; NaN before the first frame.
    pub focal_sigma: f32,
    /// Standard deviation of the principal point, the larger of both coordinates, px; NaN before the first frame.
    pub centre_sigma_px: f32,
    /// How far the map pose was moved when `map_revision` grew last, map units; NaN if it never did.
    pub correction_distance: f32,
    /// How far it was turned then, rad.
    pub correction_rad: f32,
    /// Bits of [`map_mode`]: how the current map is used.
    pub map_mode: u8,
    /// Zero.
    pub reserved: [u8; 15],
    /// Time for which the wheels alone told the pose (STATE_DEAD_RECKONING), since the start, ns; 0, as the next, where they never did.
    pub blind_ns: u64,
    /// And the way, m.
    pub blind_m: f64,
    /// Messages of the base's driver that were believed; 0, as the three that follow, where nothing tells of wheels.
    pub wheel_messages: u64,
    /// Messages of a driver that were not: no number, an absurd speed, another clock, time that goes back, a second publisher.
    pub wheel_refused: u64,
    /// Messages of the driver that were lost on the way, or dropped because no frame asked for them.
    pub wheel_missing: u64,
    /// Messages of the driver that came after the frame that they belong to; they count from the next one on.
    pub wheel_late: u64,
}

layout!(Health, "cairn.Health.v3", 512, {
    run_id @ 0, sequence @ 8, published_ns @ 16, uptime_ns @ 24, realtime_minus_monotonic_ns @ 32, errors @ 40,
    frames_captured @ 48, frames_dropped @ 56, frames_corrupt @ 64, frames_tracked @ 72, keyframes_made @ 80,
    landmarks_made @ 88, adjustments @ 96, adjustments_late @ 104, resets @ 112, relocalisations @ 120, maps_joined @ 128,
    loops_closed @ 136, frame_age_ns @ 144, pose_age_ns @ 152, stages @ 160, keyframes @ 352, landmarks @ 356, maps @ 360,
    reset_counter @ 364, map_id @ 368, map_revision @ 372, pid @ 376, state @ 380, clock @ 381, intrinsics @ 382,
    lens_model @ 383, version @ 384, focal_px @ 416, centre_px @ 424, focal_sigma @ 432, centre_sigma_px @ 436,
    correction_distance @ 440, correction_rad @ 444, map_mode @ 448, reserved @ 449,
    blind_ns @ 464, blind_m @ 472,
    wheel_messages @ 480, wheel_refused @ 488, wheel_missing @ 496, wheel_late @ 504,
});

impl Default for Health {
    /// Nothing has happened yet.
    fn default() -> Self {
        Self {
            run_id: 0,
            sequence: 0,
            published_ns: 0,
            uptime_ns: 0,
            realtime_minus_monotonic_ns: 0,
            errors: 0,
            frames_captured: 0,
            frames_dropped: 0,
            frames_corrupt: 0,
            frames_tracked: 0,
            keyframes_made: 0,
            landmarks_made: 0,
            adjustments: 0,
            adjustments_late: 0,
            resets: 0,
            relocalisations: 0,
            maps_joined: 0,
            loops_closed: 0,
            frame_age_ns: UNKNOWN_NS,
            pose_age_ns: UNKNOWN_NS,
            stages: [StageHealth::default(); STAGES],
            keyframes: 0,
            landmarks: 0,
            maps: 0,
            reset_counter: 0,
            map_id: 0,
            map_revision: 0,
            pid: 0,
            state: STATE_INITIALIZING,
            clock: CLOCK_MONOTONIC,
            intrinsics: INTRINSICS_CALIBRATED,
            lens_model: LENS_RADIAL_TANGENTIAL,
            version: [0; 32],
            focal_px: [f32::NAN; 2],
            centre_px: [f32::NAN; 2],
            focal_sigma: f32::NAN,
            centre_sigma_px: f32::NAN,
            correction_distance: f32::NAN,
            correction_rad: f32::NAN,
            map_mode: 0,
            reserved: [0; 15],
            blind_ns: 0,
            blind_m: 0.0,
            wheel_messages: 0,
            wheel_refused: 0,
            wheel_missing: 0,
            wheel_late: 0,
        }
    }
}

impl Health {
    /// `state` as a type.
    pub fn state(&self) -> State {
        State::from_wire(self.state)
    }

    /// `clock` as a type.
    pub fn clock(&self) -> Clock {
        Clock::from_wire(self.clock)
    }

    /// `intrinsics` as a type.
    pub fn intrinsics(&self) -> Intrinsics {
        Intrinsics::from_wire(self.intrinsics)
    }

    /// `lens_model` as a type.
    pub fn lens_model(&self) -> LensModel {
        LensModel::from_wire(self.lens_model)
    }

    /// Version of the daemon.
    pub fn version(&self) -> &str {
        let bytes = self.version.split(|b| *b == 0).next().unwrap_or_default();
        core::str::from_utf8(bytes).unwrap_or_default()
    }

    /// Sets [`Health::version`]; what does not fit is cut off.
    pub fn set_version(&mut self, version: &str) {
        self.version = super::command::padded(version);
    }

    /// How long ago this message was sent, ns; `now_ns` is CLOCK_MONOTONIC.
    pub fn age_ns(&self, now_ns: i64) -> i64 {
        now_ns.saturating_sub(self.published_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_named_and_unknown_bits_do_not_vanish() {
        let names: Vec<_> = error::names(error::LOST | error::NO_CAMERA | 1 << 60).collect();
        assert_eq!(names, ["NO_CAMERA", "LOST", "UNKNOWN"]);
        assert_eq!(error::names(0).count(), 0);
    }

    #[test]
    fn a_version_that_is_too_long_is_cut_at_a_character() {
        let mut health = Health::default();
        health.set_version("0.1.0");
        assert_eq!(health.version(), "0.1.0");
        health.set_version(&"é".repeat(40));
        assert_eq!(health.version(), "é".repeat(16));
    }
}
