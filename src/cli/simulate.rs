//! `cairn simulate`: writes a simulated drive as a recording that `cairn replay` reads, with ground truth.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, ValueEnum};

use super::session::{QuietArgs, StatusLine, print};
use super::{CliError, exit_code};
use crate::camera::Pacing;
use crate::camera::simulator::{Scenario, Simulator, SimulatorConfig};

/// Something that can be switched on or off.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
pub enum Effect {
    /// Lens distortion.
    Distortion,
    /// A wide-angle (Kannala-Brandt) lens of some 150 degrees across the diagonal.
    WideAngle,
    /// Darkening towards the corners.
    Vignetting,
    /// Automatic exposure.
    Exposure,
    /// Sudden jumps of the exposure.
    ExposureJumps,
    /// Sensor noise.
    Noise,
    /// Motion blur.
    MotionBlur,
    /// Rolling shutter.
    RollingShutter,
    /// Something that walks by and covers a part of the picture.
    Occluder,
    /// A covered lens for some frames.
    Blackout,
    /// Bare walls.
    LowTexture,
    /// A chessboard on the wall above the desk.
    Chessboard,
    /// Tags (AprilTag 36h11, 16 cm, numbers 1 to 4) on the walls of the room.
    Tags,
    /// Exposure that swings about what it should be.
    ExposureHunts,
    /// Exposure by time: brighter pictures are blurred more.
    ExposureTime,
    /// Jerks of the hand that holds the camera.
    Jerks,
    /// Lamps seen in polished surfaces.
    Gloss,
    /// People who walk through.
    People,
    /// The same place at another time: a third of the furniture moved, another light.
    AnotherDay,
    /// `odometry.txt` of the base's wheels; on from the start where a base drives the camera.
    Wheels,
    /// Wheels that slip in bursts of 1 to 4 s.
    WheelSlip,
}

impl Effect {
    fn switch(self, config: &mut SimulatorConfig, on: bool) {
        let key = match self {
            Self::Distortion => &mut config.lens.distortion,
            Self::WideAngle => &mut config.lens.wide_angle.enabled,
            Self::Vignetting => &mut config.vignetting.enabled,
            Self::Exposure => &mut config.exposure.automatic,
            Self::ExposureJumps => &mut config.exposure.jumps,
            Self::Noise => &mut config.noise.enabled,
            Self::MotionBlur => &mut config.motion_blur.enabled,
            Self::RollingShutter => &mut config.rolling_shutter.enabled,
            Self::Occluder => &mut config.occluder.enabled,
            Self::Blackout => &mut config.blackout.enabled,
            Self::LowTexture => &mut config.low_texture,
            Self::Chessboard => &mut config.chessboard.enabled,
            Self::Tags => &mut config.tags.enabled,
            Self::ExposureHunts => &mut config.exposure.hunts,
            Self::ExposureTime => &mut config.exposure.sets_time,
            Self::Jerks => &mut config.jerks.enabled,
            Self::Gloss => &mut config.gloss.enabled,
            Self::People => &mut config.people.enabled,
            Self::AnotherDay => &mut config.another_day.enabled,
            Self::Wheels => &mut config.wheels.enabled,
            Self::WheelSlip => &mut config.wheels.slip,
        };
        *key = on;
    }
}

/// Write a simulated drive through a textured room, with ground truth, as a recording (TUM RGB-D layout)
#[derive(Debug, Clone, Args)]
pub struct SimulateArgs {
    /// Folder to write; must be new or empty
    #[arg(long, value_name = "DIR")]
    pub output: PathBuf,
    /// Place and movement
    #[arg(long, value_enum, default_value = "room_tour")]
    pub scenario: Scenario,
    /// Length of the drive, s
    #[arg(long, default_value_t = 20.0)]
    pub seconds: f64,
    /// Seed of everything random: same seed and options, same bytes
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Picture size, pixels, 320x240 to 1280x720
    #[arg(long, value_name = "WIDTHxHEIGHT", default_value = "640x480", value_parser = parse_size)]
    pub size: (u32, u32),
    /// Frames per second, Hz
    #[arg(long, default_value_t = 30.0)]
    pub rate: f64,
    /// Factor on all speeds of the movement, 0.1 to 4
    #[arg(long, default_value_t = 1.0)]
    pub speed: f64,
    /// Start from a flawless camera instead of an ordinary webcam
    #[arg(long)]
    pub ideal: bool,
    /// Switch effects on, comma separated
    #[arg(long, value_enum, value_delimiter = ',', value_name = "EFFECT")]
    pub with: Vec<Effect>,
    /// Switch effects off, comma separated
    #[arg(long, value_enum, value_delimiter = ',', value_name = "EFFECT")]
    pub without: Vec<Effect>,
    /// Exposure time, ms
    #[arg(long, value_name = "MS")]
    pub exposure_ms: Option<f64>,
    /// Time from the first row to the last, ms
    #[arg(long, value_name = "MS")]
    pub readout_ms: Option<f64>,
    /// Darkness: from this second of the drive on, and for how long, s
    #[arg(long, value_name = "FROM:SECONDS", value_parser = parse_dark)]
    pub dark: Option<(f64, f64)>,
    /// By how much the true radius of the left and the right wheel exceeds what the driver supposes, percent
    #[arg(long, value_name = "LEFT,RIGHT", value_parser = parse_pair, allow_hyphen_values = true)]
    pub wheel_radius_error: Option<(f64, f64)>,
    /// Time by which the driver's stamps are later than the motion, ms
    #[arg(long, value_name = "MS")]
    pub wheel_delay_ms: Option<f64>,
    /// Wheel messages that are lost, percent
    #[arg(long, value_name = "PERCENT")]
    pub wheel_loss: Option<f64>,
    /// Place of the camera on the base, forward and to the left of the middle between the wheels, m
    #[arg(long, value_name = "X,Y", value_parser = parse_pair, allow_hyphen_values = true)]
    pub camera_on_base: Option<(f64, f64)>,
    /// Angle by which the camera looks to the left of where the base drives, degrees
    #[arg(long, value_name = "DEG", allow_hyphen_values = true)]
    pub camera_yaw_on_base: Option<f64>,
    #[command(flatten)]
    pub quiet: QuietArgs,
}

fn parse_pair(text: &str) -> Result<(f64, f64), String> {
    let parsed = text.split_once(',').and_then(|(a, b)| Some((a.trim().parse().ok()?, b.trim().parse().ok()?)));
    parsed.ok_or_else(|| format!("`{text}` is not two numbers, as in 0.1,-0.05"))
}

fn parse_dark(text: &str) -> Result<(f64, f64), String> {
    let parsed = text.split_once(':').and_then(|(a, b)| Some((a.trim().parse().ok()?, b.trim().parse().ok()?)));
    let possible = |(from, seconds): &(f64, f64)| (0.0..1e6).contains(from) && *seconds > 0.0 && *seconds < 1e6;
    parsed
        .filter(possible)
        .ok_or_else(|| format!("`{text}` is not FROM:SECONDS, as in 12:3, both in s and the second above 0"))
}

fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let parsed = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    parsed.ok_or_else(|| format!("`{text}` is not WIDTHxHEIGHT in pixels, as in 640x480"))
}

impl SimulateArgs {
    /// The simulator's configuration that these options stand for.
    fn config(&self) -> SimulatorConfig {
        let mut config = if self.ideal { SimulatorConfig::ideal(self.scenario) } else { SimulatorConfig::default() };
        config.scenario = self.scenario;
        config.seed = self.seed;
        (config.width, config.height) = self.size;
        config.rate_hz = self.rate;
        config.speed = self.speed;
        config.chessboard.enabled = self.scenario == Scenario::CalibrationSweep;
        config.wheels.enabled = self.scenario.is_driven();
        for effect in &self.with {
            effect.switch(&mut config, true);
        }
        for effect in &self.without {
            effect.switch(&mut config, false);
        }
        if let Some(ms) = self.exposure_ms {
            config.motion_blur.exposure_ms = ms;
        }
        if let Some(ms) = self.readout_ms {
            config.rolling_shutter.readout_ms = ms;
        }
        if let Some((from_s, seconds)) = self.dark {
            let blackout = &mut config.blackout;
            (blackout.enabled, blackout.start_s, blackout.period_s) = (true, from_s, 0.0);
            // A cast saturates; at least one frame is dark.
            blackout.frames = ((seconds * self.rate).round() as u32).max(1);
        }
        let wheels = &mut config.wheels;
        if let Some((left, right)) = self.wheel_radius_error {
            wheels.radius_error = [left * 1e-2, right * 1e-2];
        }
        wheels.delay_ms = self.wheel_delay_ms.unwrap_or(wheels.delay_ms);
        wheels.loss_share = self.wheel_loss.map_or(wheels.loss_share, |percent| percent * 1e-2);
        wheels.camera_m = self.camera_on_base.map_or(wheels.camera_m, |(x, y)| [x, y]);
        wheels.camera_yaw_deg = self.camera_yaw_on_base.unwrap_or(wheels.camera_yaw_deg);
        config
    }
}

/// Renders and writes; prints the folder on stdout.
pub fn run(args: &SimulateArgs) -> Result<ExitCode, CliError> {
    if !(args.seconds > 0.0 && args.seconds <= 36_000.0) {
        let message = format!("--seconds {} s: must lie above 0 and at most 36000", args.seconds);
        return Err(CliError::new(exit_code::USAGE, message));
    }
    let config = args.config();
    config.validate().map_err(|e| CliError::new(exit_code::USAGE, e.to_string()))?;
    if args.with.contains(&Effect::Wheels) && !config.scenario.is_driven() {
        let scenario = config.scenario.name();
        let message =
            format!("--with wheels: no base drives the camera of {scenario}; use room_tour, square or corridor");
        return Err(CliError::new(exit_code::USAGE, message));
    }
    let mut simulator =
        Simulator::new(&config, Pacing::LockStep).map_err(|e| CliError::new(exit_code::FAILURE, e.to_string()))?;
    let written = simulator
        .write_recording(&args.output, args.seconds)
        .map_err(|e| CliError::new(exit_code::CANNOT_CREATE, e.to_string()))?;
    let (scenario, seed) = (config.scenario.name(), config.seed);
    StatusLine::new(args.quiet).note(&format!("{} frames of scenario {scenario} (seed {seed})", written.frames));
    print(&format!("{}\n", args.output.display()))?;
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        args: SimulateArgs,
    }

    fn parse(line: &str) -> Result<SimulateArgs, clap::Error> {
        Line::try_parse_from(line.split_whitespace()).map(|l| l.args)
    }

    #[test]
    fn options_become_configuration() {
        let line = "x --output a --scenario fast_rotation --seed 9 --size 752x480 --with occluder,blackout \
                    --without noise --exposure-ms 12";
        let config = parse(line).unwrap().config();
        assert_eq!((config.scenario, config.seed, config.width), (Scenario::FastRotation, 9, 752));
        assert!(config.occluder.enabled && config.blackout.enabled && !config.noise.enabled);
        assert_eq!(config.motion_blur.exposure_ms, 12.0);
        assert!(config.validate().is_ok());
    }

    #[test]
    fn nonsense_is_refused_with_a_reason() {
        assert!(parse("x --output a --size 640").is_err());
        assert!(parse("x --output a --with fog").is_err());
        for dark in ["12", "12:", "a:3", "12:0", "-1:3", "12:NaN", "12:inf"] {
            assert!(parse(&format!("x --output a --dark={dark}")).is_err(), "{dark}");
        }
        let dark = parse("x --output a --rate 20 --dark 12:3").unwrap().config().blackout;
        assert!(dark.enabled && (dark.start_s, dark.frames, dark.period_s) == (12.0, 60, 0.0));
        let dir = tempfile::tempdir().unwrap();
        let mut args = parse(&format!("x --output {} --size 100x100", dir.path().display())).unwrap();
        let error = run(&args).unwrap_err();
        assert_eq!(error.code, exit_code::USAGE);
        assert!(error.message.contains("width = 100 px"), "{}", error.message);
        args.size = (640, 480);
        args.seconds = f64::NAN;
        assert_eq!(run(&args).unwrap_err().code, exit_code::USAGE);
    }

    #[test]
    fn a_folder_in_use_is_left_alone() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("mine.txt"), "keep").unwrap();
        let args = parse(&format!("x --output {} --size 320x240 --seconds 0.1", dir.path().display())).unwrap();
        let error = run(&args).unwrap_err();
        assert_eq!(error.code, exit_code::CANNOT_CREATE);
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
    }
}
