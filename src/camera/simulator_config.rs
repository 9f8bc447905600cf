//! `[simulator]`: what the simulated webcam shows, how it moves and what spoils its pictures.
//!
//! Every key has a default, so an empty table is a webcam of ordinary quality that tours a room. Unknown keys are
//! refused by serde, impossible values by [`SimulatorConfig::validate`]. A build without the simulator reads and checks it all the same: a
//! configuration file is right or wrong whichever build reads it.

use nalgebra::Vector2;
use serde::{Deserialize, Serialize};

use crate::geometry::{CameraModel, LensModel};

/// Which movement in which place. "World" has z up; speeds are those at `speed = 1`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
#[value(rename_all = "snake_case")]
pub enum Scenario {
    /// A robot, camera 0.5 m above the floor, drives laps around the room's table, about 10 m and 25 s each.
    #[default]
    RoomTour,
    /// Held in a hand before a desk: swaying by +-0.25 m in all directions, turning by some degrees.
    HandHeld,
    /// Carried around the table in the middle, looking at it; a lap takes 24 s.
    DeskOrbit,
    /// Turns about its optical centre from the first frame on; never moves.
    PureRotation,
    /// As `hand_held` for 10 s, then turns about its optical centre, then moves again, every 30 s.
    MoveThenRotate,
    /// Never moves at all.
    Standing,
    /// As `hand_held` for 10 s, then stands still for ever.
    MoveThenStand,
    /// Glides to and fro sideways, looking across the room.
    Sideways,
    /// As `hand_held` with bursts of fast turns, peaks of 200 to 300 degrees/s, from second 4 on.
    FastRotation,
    /// A robot drives a rectangle and turns on the spot at its corners.
    Square,
    /// A robot drives to and fro along a corridor of 14 m, turning on the spot at its ends.
    Corridor,
    /// The camera looks at the chessboard from many sides and distances: for calibration.
    CalibrationSweep,
    /// Held in a hand 0.4 to 1 m from a long cluttered desk, to and fro along it in 14 s: there low, near and looking ahead, back
    /// higher, farther and looking the other way.
    DeskSweep,
    /// A robot drives through three different rooms in a row, around the table of each, and back to where it began: 60 m.
    ThreeRooms,
    /// The same where the rooms look alike but for three things in each.
    LookAlike,
}

impl Scenario {
    /// All of them.
    pub const ALL: [Self; 15] = [
        Self::RoomTour,
        Self::HandHeld,
        Self::DeskOrbit,
        Self::PureRotation,
        Self::MoveThenRotate,
        Self::Standing,
        Self::MoveThenStand,
        Self::Sideways,
        Self::FastRotation,
        Self::Square,
        Self::Corridor,
        Self::CalibrationSweep,
        Self::DeskSweep,
        Self::ThreeRooms,
        Self::LookAlike,
    ];

    /// As written in the configuration.
    pub fn name(&self) -> &'static str {
        match self {
            Self::RoomTour => "room_tour",
            Self::HandHeld => "hand_held",
            Self::DeskOrbit => "desk_orbit",
            Self::PureRotation => "pure_rotation",
            Self::MoveThenRotate => "move_then_rotate",
            Self::Standing => "standing",
            Self::MoveThenStand => "move_then_stand",
            Self::Sideways => "sideways",
            Self::FastRotation => "fast_rotation",
            Self::Square => "square",
            Self::Corridor => "corridor",
            Self::CalibrationSweep => "calibration_sweep",
            Self::DeskSweep => "desk_sweep",
            Self::ThreeRooms => "three_rooms",
            Self::LookAlike => "look_alike",
        }
    }
}

macro_rules! config {
    ($(#[$doc:meta])* $name:ident { $($(#[$field_doc:meta])* $field:ident: $kind:ty = $default:expr,)* }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct $name { $($(#[$field_doc])* pub $field: $kind,)* }
        impl Default for $name {
            fn default() -> Self {
                Self { $($field: $default,)* }
            }
        }
    };
}

mod another_day;
mod tags;
mod wheels;
pub use another_day::AnotherDayConfig;
pub use tags::TagsConfig;
pub use wheels::WheelsConfig;

config! {
    /// The simulated webcam.
    SimulatorConfig {
        /// Place and movement.
        scenario: Scenario = Scenario::RoomTour,
        /// Seed of everything random, 0..=2^63-1. Same seed and configuration, same bytes.
        seed: u64 = 1,
        /// Picture width, px, 320..=1280.
        width: u32 = 640,
        /// Picture height, px, 240..=720.
        height: u32 = 480,
        /// Frames per second, Hz, 1..=120.
        rate_hz: f64 = 30.0,
        /// The source ends after this time, s; 0 = never.
        duration_s: f64 = 0.0,
        /// Factor on all speeds of the movement, 0.1..=4.
        speed: f64 = 1.0,
        /// Side of a texel of furniture, mm, 1..=20; walls are 1.5 times as coarse. Start-up time and memory grow with
        /// its inverse square (2 mm: about 45 MB).
        texel_mm: f64 = 2.0,
        /// Bare walls and pale furniture: few corners.
        low_texture: bool = false,
        /// Lens.
        lens: LensConfig = LensConfig::default(),
        /// Darkening towards the picture's corners.
        vignetting: VignettingConfig = VignettingConfig::default(),
        /// Exposure control.
        exposure: ExposureConfig = ExposureConfig::default(),
        /// Sensor noise.
        noise: NoiseConfig = NoiseConfig::default(),
        /// Blur by movement during the exposure.
        motion_blur: MotionBlurConfig = MotionBlurConfig::default(),
        /// Rows that are exposed one after another.
        rolling_shutter: RollingShutterConfig = RollingShutterConfig::default(),
        /// Something that walks through the picture close by.
        occluder: OccluderConfig = OccluderConfig::default(),
        /// A covered lens.
        blackout: BlackoutConfig = BlackoutConfig::default(),
        /// A chessboard on the wall above the desk of the room.
        chessboard: ChessboardConfig = ChessboardConfig::default(),
        /// Tags on the walls of the room.
        tags: TagsConfig = TagsConfig::default(),
        /// Jerks of the hand that holds the camera.
        jerks: JerksConfig = JerksConfig::default(),
        /// Lamps seen in polished surfaces.
        gloss: GlossConfig = GlossConfig::default(),
        /// People who walk through.
        people: PeopleConfig = PeopleConfig::default(),
        /// The base under the camera, where one drives it, and what its wheels tell.
        wheels: WheelsConfig = WheelsConfig::default(),
        /// What the desk of `desk_sweep` is like.
        desk: DeskConfig = DeskConfig::default(),
        /// The place as it is at another time.
        another_day: AnotherDayConfig = AnotherDayConfig::default(),
    }
}

config! {
    /// Focal length and distortion.
    LensConfig {
        /// Focal length in picture widths, no unit, 0.3..=3.
        focal_widths: f64 = 0.82,
        /// Apply `coefficients`; off: a perfect pinhole.
        distortion: bool = true,
        /// k1 k2 p1 p2 k3 (OpenCV's order), no unit; the lens must be one to one over the whole picture.
        coefficients: [f64; 5] = [-0.12, 0.05, 0.0008, -0.0006, 0.0],
        /// A wide-angle lens in the place of this one.
        wide_angle: WideAngleConfig = WideAngleConfig::default(),
    }
}

config! {
    /// A wide-angle (Kannala-Brandt) lens: some 150 degrees across the diagonal of a 4:3 picture.
    WideAngleConfig {
        enabled: bool = false,
        /// Focal length in picture widths, no unit, 0.3..=3.
        focal_widths: f64 = 0.47,
        /// k1 k2 k3 k4 (OpenCV's fisheye), no unit; no corner of the picture may be more than 85 degrees off the axis. With
        /// `lens.distortion` off they count as zero: an equidistant lens.
        coefficients: [f64; 4] = [0.03, -0.015, 0.004, -0.001],
    }
}

impl LensConfig {
    /// Focal length of the lens that is on, picture widths.
    pub fn active_focal_widths(&self) -> f64 {
        if self.wide_angle.enabled { self.wide_angle.focal_widths } else { self.focal_widths }
    }
}

config! {
    /// Darkening towards the corners.
    VignettingConfig {
        enabled: bool = true,
        /// Share of the light lost in the corners, 0..=0.9.
        corner_loss: f64 = 0.25,
    }
}

config! {
    /// Slow automatic exposure, sudden jumps, hunting.
    ExposureConfig {
        /// Follow the brightness of what the camera sees, with a lag of about a second.
        automatic: bool = true,
        /// Sudden changes, as when a lamp is switched on or the control overreacts.
        jumps: bool = false,
        /// Mean time between jumps, s, 0.5..=1000.
        jump_period_s: f64 = 4.0,
        /// Largest jump, exposure values (factors of two in light), 0..=4; it fades within about a second.
        jump_ev: f64 = 1.5,
        /// The control hunts: it corrects too much too late and swings about what it should be.
        hunts: bool = false,
        /// Time of one swing, s, 0.2..=10.
        hunt_period_s: f64 = 0.8,
        /// Swing to either side at the most, exposure values, 0..=2.
        hunt_ev: f64 = 0.7,
        /// The control sets the exposure time: where it brightens the picture it blurs it, too, up to the frame period; off: a gain.
        sets_time: bool = false,
    }
}

config! {
    /// Sensor noise.
    NoiseConfig {
        enabled: bool = true,
        /// Standard deviation in the dark, grey levels, 0..=30.
        read_sigma: f64 = 1.2,
        /// Standard deviation added in quadrature at full white, grey levels, 0..=30; grows with the root of the light.
        shot_sigma: f64 = 2.5,
    }
}

config! {
    /// Motion blur.
    MotionBlurConfig {
        enabled: bool = true,
        /// Exposure time, ms, 0.1..=100, at most the frame period.
        exposure_ms: f64 = 8.0,
        /// Largest number of moments averaged, 1..=64. A still part of the picture costs one, a streak of n pixels n/1.5.
        max_samples: u32 = 16,
    }
}

config! {
    /// Rolling shutter.
    RollingShutterConfig {
        enabled: bool = true,
        /// Time from the first row to the last, ms, 0.1..=100, at most the frame period.
        readout_ms: f64 = 20.0,
    }
}

config! {
    /// Something textured that passes close to the camera, from alternating sides.
    OccluderConfig {
        enabled: bool = false,
        /// Largest share of the picture that it covers, 0.05..=0.8.
        share: f64 = 0.3,
        /// Start of the first pass, s.
        start_s: f64 = 5.0,
        /// Time from the start of one pass to that of the next, s, at least 1.
        period_s: f64 = 8.0,
        /// Duration of a pass, s, 0.5..=`period_s`.
        pass_s: f64 = 4.0,
    }
}

config! {
    /// The lens is covered for some frames.
    BlackoutConfig {
        enabled: bool = false,
        /// Time of the first covered frame, s.
        start_s: f64 = 8.0,
        /// Number of covered frames, at least 1.
        frames: u32 = 20,
        /// Repeats after this time, s; 0 = once only.
        period_s: f64 = 0.0,
    }
}

config! {
    /// Jerks: the hand turns and shifts the camera within 0.4 s, and takes it back as fast.
    JerksConfig {
        enabled: bool = false,
        /// Time from jerk to jerk, s, 1..=1000; each comes at a random moment of its period.
        period_s: f64 = 2.0,
        /// Turn rate of the strongest jerk at its peak, degrees/s, 0..=300; the weakest has two fifths of it.
        turn_deg_s: f64 = 150.0,
        /// Speed of the strongest jerk at its peak, m/s, 0..=1.
        speed_m_s: f64 = 0.5,
    }
}

config! {
    /// Gloss of table tops, screens and framed pictures: each shows the lamps where a mirror would, so the highlight moves with the view.
    GlossConfig {
        enabled: bool = false,
        /// Light of a lamp's mirror image, multiples of white paper, 0..=4.
        strength: f64 = 1.2,
        /// Its radius (one sigma), degrees, 0.5..=20: the lamp's own size and the surface's roughness.
        spread_deg: f64 = 2.5,
    }
}

config! {
    /// People who pace the free lanes of the room or the corridor: nearer than some things, farther than others.
    PeopleConfig {
        enabled: bool = false,
        /// Until then each waits at the beginning of its lane, s.
        start_s: f64 = 3.0,
        /// Walking speed, m/s, 0.2..=2.
        walk_m_s: f64 = 1.1,
    }
}

config! {
    /// The desk of `desk_sweep`.
    DeskConfig {
        /// Its top is plain, with stretches on which nothing lies; off: papers and cups all over it.
        bare: bool = true,
        /// Thin things: pens, cables, rods of lamps, a wire basket.
        thin: bool = true,
        /// Repeated structure: keys, a row of equal bottles, pegboard on the wall.
        repeated: bool = true,
    }
}

config! {
    /// A flat chessboard of exact size. Only in the room, not in the corridor.
    ChessboardConfig {
        enabled: bool = false,
        /// Inner corners a row, 3..=20.
        columns: u32 = 9,
        /// Inner corners a column, 3..=20.
        rows: u32 = 6,
        /// Side of a square, m, 0.01..=0.1; the sheet (two squares more) must not exceed 0.8 m.
        square_m: f64 = 0.03,
    }
}

/// A value that cannot be.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("simulator.{key} = {value} {unit}: {reason}")]
pub struct SimulatorConfigError {
    /// Dotted key below `[simulator]`.
    pub key: &'static str,
    /// The offending value.
    pub value: String,
    /// Unit of the key; empty if it has none.
    pub unit: &'static str,
    /// What is allowed.
    pub reason: String,
}

fn within(key: &'static str, value: f64, unit: &'static str, low: f64, high: f64) -> Result<(), SimulatorConfigError> {
    if value >= low && value <= high {
        return Ok(());
    }
    let reason = format!("must lie between {low} and {high}");
    Err(SimulatorConfigError { key, value: value.to_string(), unit, reason })
}

impl SimulatorConfig {
    /// A webcam without any flaw: pinhole, constant exposure, no noise, global shutter, no blur.
    pub fn ideal(scenario: Scenario) -> Self {
        let mut c = Self { scenario, ..Self::default() };
        c.lens.distortion = false;
        c.vignetting.enabled = false;
        c.exposure.automatic = false;
        c.noise.enabled = false;
        c.motion_blur.enabled = false;
        c.rolling_shutter.enabled = false;
        c
    }

    /// Everything on that an ordinary day brings: the default's flaws, exposure jumps and somebody walking by.
    pub fn everything(scenario: Scenario) -> Self {
        let mut c = Self { scenario, ..Self::default() };
        c.exposure.jumps = true;
        c.occluder.enabled = true;
        c
    }

    /// Refuses impossible values with key, value, unit and reason.
    pub fn validate(&self) -> Result<(), SimulatorConfigError> {
        within("seed", self.seed as f64, "", 0.0, i64::MAX as f64)?;
        within("width", f64::from(self.width), "px", 320.0, 1280.0)?;
        within("height", f64::from(self.height), "px", 240.0, 720.0)?;
        within("rate_hz", self.rate_hz, "Hz", 1.0, 120.0)?;
        within("duration_s", self.duration_s, "s", 0.0, 1e7)?;
        within("speed", self.speed, "", 0.1, 4.0)?;
        within("texel_mm", self.texel_mm, "mm", 1.0, 20.0)?;
        within("lens.focal_widths", self.lens.focal_widths, "picture widths", 0.3, 3.0)?;
        within("lens.wide_angle.focal_widths", self.lens.wide_angle.focal_widths, "picture widths", 0.3, 3.0)?;
        within("vignetting.corner_loss", self.vignetting.corner_loss, "", 0.0, 0.9)?;
        within("exposure.jump_period_s", self.exposure.jump_period_s, "s", 0.5, 1000.0)?;
        within("exposure.jump_ev", self.exposure.jump_ev, "EV", 0.0, 4.0)?;
        within("exposure.hunt_period_s", self.exposure.hunt_period_s, "s", 0.2, 10.0)?;
        within("exposure.hunt_ev", self.exposure.hunt_ev, "EV", 0.0, 2.0)?;
        within("noise.read_sigma", self.noise.read_sigma, "grey levels", 0.0, 30.0)?;
        within("noise.shot_sigma", self.noise.shot_sigma, "grey levels", 0.0, 30.0)?;
        let period_ms = 1000.0 / self.rate_hz;
        within("motion_blur.max_samples", f64::from(self.motion_blur.max_samples), "", 1.0, 64.0)?;
        within("motion_blur.exposure_ms", self.motion_blur.exposure_ms, "ms", 0.1, 100.0)?;
        within("rolling_shutter.readout_ms", self.rolling_shutter.readout_ms, "ms", 0.1, 100.0)?;
        // A sensor cannot expose or read longer than until its next frame.
        for (on, key, ms) in [
            (self.motion_blur.enabled, "motion_blur.exposure_ms", self.motion_blur.exposure_ms),
            (self.rolling_shutter.enabled, "rolling_shutter.readout_ms", self.rolling_shutter.readout_ms),
        ] {
            if on && ms > period_ms {
                let reason = format!("longer than the frame period of {period_ms} ms (rate_hz = {} Hz)", self.rate_hz);
                return Err(SimulatorConfigError { key, value: ms.to_string(), unit: "ms", reason });
            }
        }
        within("occluder.share", self.occluder.share, "", 0.05, 0.8)?;
        within("occluder.start_s", self.occluder.start_s, "s", 0.0, 1e7)?;
        within("occluder.period_s", self.occluder.period_s, "s", 1.0, 1e7)?;
        within("occluder.pass_s", self.occluder.pass_s, "s", 0.5, self.occluder.period_s)?;
        within("blackout.start_s", self.blackout.start_s, "s", 0.0, 1e7)?;
        within("blackout.frames", f64::from(self.blackout.frames), "frames", 1.0, 1e6)?;
        within("blackout.period_s", self.blackout.period_s, "s", 0.0, 1e7)?;
        within("jerks.period_s", self.jerks.period_s, "s", 1.0, 1000.0)?;
        within("jerks.turn_deg_s", self.jerks.turn_deg_s, "degrees/s", 0.0, 300.0)?;
        within("jerks.speed_m_s", self.jerks.speed_m_s, "m/s", 0.0, 1.0)?;
        within("gloss.strength", self.gloss.strength, "times white", 0.0, 4.0)?;
        within("gloss.spread_deg", self.gloss.spread_deg, "degrees", 0.5, 20.0)?;
        within("people.start_s", self.people.start_s, "s", 0.0, 1e7)?;
        within("people.walk_m_s", self.people.walk_m_s, "m/s", 0.2, 2.0)?;
        self.wheels.validate()?;
        self.tags.validate()?;
        self.another_day.validate()?;
        let board = &self.chessboard;
        within("chessboard.columns", f64::from(board.columns), "inner corners", 3.0, 20.0)?;
        within("chessboard.rows", f64::from(board.rows), "inner corners", 3.0, 20.0)?;
        within("chessboard.square_m", board.square_m, "m", 0.01, 0.1)?;
        let sheet = f64::from(board.columns.max(board.rows) + 3) * board.square_m;
        if sheet > 0.8 {
            let reason = format!("the sheet would be {sheet:.2} m long, at most 0.8 m fit on the wall");
            let value = board.square_m.to_string();
            return Err(SimulatorConfigError { key: "chessboard.square_m", value, unit: "m", reason });
        }
        if self.scenario == Scenario::CalibrationSweep && !board.enabled {
            let reason = "the scenario calibration_sweep needs the chessboard".to_owned();
            let value = "false".to_owned();
            return Err(SimulatorConfigError { key: "chessboard.enabled", value, unit: "", reason });
        }
        self.camera_model().map(|_| ())
    }

    /// Intrinsics of the simulated camera. The pixels are not quite square and the centre is not quite in the middle.
    pub fn camera_model(&self) -> Result<CameraModel, SimulatorConfigError> {
        let (w, h) = (f64::from(self.width), f64::from(self.height));
        let fx = self.lens.active_focal_widths() * w;
        let (wide, distorts) = (&self.lens.wide_angle, self.lens.distortion);
        let (key, lens) = match wide.enabled {
            false => {
                let k = if distorts { self.lens.coefficients } else { [0.0; 5] };
                ("lens.coefficients", LensModel::RadialTangential(k))
            }
            true => {
                let k = if distorts { wide.coefficients } else { [0.0; 4] };
                ("lens.wide_angle.coefficients", LensModel::KannalaBrandt(k))
            }
        };
        let bad = |reason: String| SimulatorConfigError {
            key,
            value: format!("{:?}", lens.coefficients()),
            unit: "",
            reason,
        };
        if lens.coefficients().iter().any(|k| !k.is_finite()) {
            return Err(bad("must be finite numbers".to_owned()));
        }
        let (cx, cy) = (0.5 * (w - 1.0) + 0.006 * w, 0.5 * (h - 1.0) - 0.009 * h);
        let camera =
            CameraModel::new(self.width, self.height, fx, fx * 1.003, cx, cy, lens).map_err(|e| bad(e.to_string()))?;
        check_lens(&camera).map_err(bad)?;
        Ok(camera)
    }
}

/// Refuses a lens that is not one to one over the picture.
fn check_lens(camera: &CameraModel) -> Result<(), String> {
    let (w, h) = (f64::from(camera.width), f64::from(camera.height));
    for i in 0..=40 {
        let t = f64::from(i) / 40.0;
        for pixel in [
            Vector2::new(t * w - 0.5, -0.5),
            Vector2::new(t * w - 0.5, h - 0.5),
            Vector2::new(-0.5, t * h - 0.5),
            Vector2::new(w - 0.5, t * h - 0.5),
        ] {
            let back = camera.undistort(&pixel).and_then(|n| camera.distort(&n));
            if !back.is_some_and(|p| (p - pixel).norm() < 1e-6) {
                let what = match camera.lens.is_wide_angle() {
                    true => "folds over, or sees more than 85 degrees off its axis,",
                    false => "folds over",
                };
                return Err(format!("the lens {what} at pixel ({:.0}, {:.0})", pixel.x, pixel.y));
            }
        }
    }
    Ok(())
}
