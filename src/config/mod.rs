//! The configuration file: typed, validated, one struct a room.
//!
//! - In: TOML text and the name to call it by in messages. Out: a [`Config`] in which every value is usable, or one
//!   [`ConfigError`] that names file, line, key, value, unit and reason. [`parse`] is a pure function.
//! - A key that nobody knows is an error, because a typo that is silently ignored runs a robot with the default. Units
//!   stand in the keys' names (`_px`, `_ms`, `_hz`, `_m`, `_deg`), so a wrong unit is an unknown key, and the message says which is meant.
//! - A missing key has its default; an empty file is a complete configuration. `config/cairn.toml` shows every key.
//! - A file is right or wrong whichever build reads it (`[simulator]` is checked where there is no simulator); but the robot's build refuses
//!   to run on the simulator or to draw an overview, by the key that asks for it.
//! - The rooms own their structs and what values they can use (`validate`); this room knows the file.

mod error;
mod mount;

use std::path::{Path, PathBuf};

pub use error::{ConfigError, Invalid};
pub use mount::{BodyFromCamera, MountConfig};

use crate::camera::simulator_config::SimulatorConfig;
use crate::camera::v4l2::V4l2Config;
use crate::features::FeaturesConfig;
use crate::geometry::plane_calibration::LensKind;
use crate::motion::floor::ScaleConfig;
use crate::motion::obstacles::ObstaclesConfig;
use crate::motion::tag::TagConfig;
use crate::motion::wheel_scale::WheelConfig;
use crate::publish::Limits;
use crate::reconstruction::ReconstructionConfig;
use crate::telemetry::LogConfig;

/// Where the daemon looks when no file is named.
pub const SYSTEM_FILE: &str = "/etc/cairn/cairn.toml";

/// Everything that can be configured.
#[derive(Debug, Clone, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// First part of every service name; robots with two cameras give each instance its own.
    pub prefix: String,
    pub daemon: DaemonConfig,
    pub camera: V4l2Config,
    pub simulator: SimulatorConfig,
    pub calibration: CalibrationConfig,
    pub features: FeaturesConfig,
    pub reconstruction: ReconstructionConfig,
    pub scale: ScaleConfig,
    pub tag: TagConfig,
    pub wheel: WheelConfig,
    pub map: MapConfig,
    pub mount: MountConfig,
    pub obstacles: ObstaclesConfig,
    pub publish: PublishConfig,
    pub output: OutputConfig,
    pub log: LogConfig,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            prefix: "cairn".into(),
            daemon: DaemonConfig::default(),
            camera: V4l2Config::default(),
            simulator: SimulatorConfig::default(),
            calibration: CalibrationConfig::default(),
            features: FeaturesConfig::default(),
            reconstruction: ReconstructionConfig::default(),
            scale: ScaleConfig::default(),
            tag: TagConfig::default(),
            wheel: WheelConfig::default(),
            map: MapConfig::default(),
            mount: MountConfig::default(),
            obstacles: ObstaclesConfig::default(),
            publish: PublishConfig::default(),
            output: OutputConfig::default(),
            log: LogConfig::default(),
        }
    }
}

/// What `cairn run` takes its frames from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum SourceKind {
    /// The webcam of `[camera]`.
    #[default]
    Camera,
    /// The rendered room of `[simulator]`.
    Simulator,
}

/// `[daemon]`: how the stages are wired.
#[derive(Debug, Clone, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct DaemonConfig {
    pub source: SourceKind,
    /// Frames that may wait between the feature and the reconstruction thread.
    pub queue_frames: usize,
    /// A stage that shows no sign of life for so long is reported as stalled.
    pub stall_after_ms: u64,
    /// Longest pause between two attempts to open a camera that is absent.
    pub camera_retry_ms: u64,
}

impl Default for DaemonConfig {
    fn default() -> Self {
        Self { source: SourceKind::Camera, queue_frames: 2, stall_after_ms: 1000, camera_retry_ms: 500 }
    }
}

/// `[calibration]`: the camera's lens.
#[derive(Debug, Clone, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct CalibrationConfig {
    /// Our TOML, or a YAML with `width height fx fy cx cy distortion`; relative to where the daemon is started.
    pub file: PathBuf,
    /// `radial_tangential` or `kannala_brandt`: the lens model of a file that has coefficients and does not say it (as OpenCV's functions
    /// write it). Empty: four such coefficients are taken for k1 k2 p1 p2 of a pinhole, with a warning.
    pub lens_model: String,
    /// Start as if there were no calibration, whatever there is: the lens is estimated from the motion.
    pub ignore: bool,
    /// Angle of view across the longer side that a camera without a calibration is supposed to have, degrees. 20.0..=120.0.
    pub supposed_view_deg: f64,
    /// Keep what the motion has shown about an uncalibrated lens for the next start.
    pub keep_estimate: bool,
}

impl Default for CalibrationConfig {
    fn default() -> Self {
        Self {
            file: PathBuf::new(),
            lens_model: String::new(),
            ignore: false,
            supposed_view_deg: 60.0,
            keep_estimate: true,
        }
    }
}

impl CalibrationConfig {
    /// Neither named nor ignored: the calibration is whichever was stored for the camera at hand.
    pub fn is_found_by_identity(&self) -> bool {
        !self.ignore && self.file.as_os_str().is_empty()
    }

    /// Lens model of a file that does not say it; `None` where there is no such word.
    pub fn unsaid_lens(&self) -> Option<LensKind> {
        self.lens_model.parse().ok()
    }
}

/// `[publish]`: memory that is reserved for messages.
#[derive(Debug, Clone, PartialEq, Eq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct PublishConfig {
    /// Landmarks in a map message at the most.
    pub max_landmarks: usize,
    /// Keyframes in a keyframes message at the most.
    pub max_keyframes: usize,
    /// Picture that can be shared at the least.
    pub max_frame_bytes: usize,
}

impl Default for PublishConfig {
    fn default() -> Self {
        let Limits { landmarks, keyframes, frame_bytes } = Limits::default();
        Self { max_landmarks: landmarks, max_keyframes: keyframes, max_frame_bytes: frame_bytes }
    }
}

impl PublishConfig {
    /// As the wire takes them, for pictures of this size if it is known.
    pub fn limits(&self, size: Option<(u32, u32)>) -> Limits {
        let picture = size.map_or(0, |(width, height)| width as usize * height as usize);
        let frame_bytes = self.max_frame_bytes.max(picture);
        Limits { landmarks: self.max_landmarks, keyframes: self.max_keyframes, frame_bytes }
    }

    fn validate(&self) -> Result<(), Invalid> {
        if !(100..=1_000_000).contains(&self.max_landmarks) {
            return Err(Invalid::new("publish.max_landmarks", "must be 100 to 1000000"));
        }
        if !(10..=100_000).contains(&self.max_keyframes) {
            return Err(Invalid::new("publish.max_keyframes", "must be 10 to 100000"));
        }
        if !(76_800..=2_304_000).contains(&self.max_frame_bytes) {
            return Err(Invalid::new("publish.max_frame_bytes", "must be 76800 (320x240) to 2304000 (1920x1200)"));
        }
        Ok(())
    }
}

/// `[map]`: the map that outlasts the run.
#[derive(Debug, Clone, PartialEq, Eq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct MapConfig {
    /// Map file, made if it is missing, relative to where the daemon is started. `auto`: the camera's own in `directory`; `off` or empty:
    /// the map ends with the run.
    pub file: PathBuf,
    /// Only locate in it: neither map nor file changes.
    pub localise: bool,
    /// Where commands find and store maps by name; empty: `maps` in the state directory.
    pub directory: PathBuf,
}

impl Default for MapConfig {
    fn default() -> Self {
        Self { file: "auto".into(), localise: false, directory: PathBuf::new() }
    }
}

/// What `[map] file` asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MapChoice<'a> {
    Off,
    /// By camera.
    Auto,
    Named(&'a std::path::Path),
}

impl MapConfig {
    pub fn choice(&self) -> MapChoice<'_> {
        match self.file.to_str() {
            Some("" | "off") => MapChoice::Off,
            Some("auto") => MapChoice::Auto,
            _ => MapChoice::Named(&self.file),
        }
    }
}

/// `[output]`: files written when the daemon ends. An empty path writes nothing.
#[derive(Debug, Clone, Default, PartialEq, Eq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct OutputConfig {
    /// TUM trajectory, every tracked frame as the map knows it at the end.
    pub trajectory: PathBuf,
    /// TUM trajectory, every map pose as it was published.
    pub live_trajectory: PathBuf,
    /// Landmarks and keyframes as PLY.
    pub map: PathBuf,
    /// Picture of map and trajectory from above, PNG.
    pub overview: PathBuf,
}

impl Config {
    /// Checks everything that the types alone cannot.
    pub fn validate(&self) -> Result<(), Invalid> {
        let name_ok = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.' | '/');
        if self.prefix.is_empty() || self.prefix.len() > 64 || !self.prefix.chars().all(name_ok) {
            return Err(Invalid::new("prefix", "must be 1 to 64 letters, digits, '-', '_', '.' or '/'"));
        }
        let d = &self.daemon;
        if !(1..=2).contains(&d.queue_frames) {
            return Err(Invalid::new("daemon.queue_frames", "must be 1 or 2"));
        }
        if !(100..=60_000).contains(&d.stall_after_ms) {
            return Err(Invalid::new("daemon.stall_after_ms", "must be 100 to 60000"));
        }
        if !(100..=60_000).contains(&d.camera_retry_ms) {
            return Err(Invalid::new("daemon.camera_retry_ms", "must be 100 to 60000"));
        }
        if !self.calibration.lens_model.is_empty() {
            let parsed = self.calibration.lens_model.parse::<LensKind>();
            parsed.map_err(|reason| Invalid::new("calibration.lens_model", reason))?;
        }
        if !(20.0..=120.0).contains(&self.calibration.supposed_view_deg) {
            return Err(Invalid::new("calibration.supposed_view_deg", "must be 20 to 120 degrees"));
        }
        let in_room = |room: &str, key: &str, reason: String| Invalid::new(format!("{room}.{key}"), reason);
        self.features.validate().map_err(|(key, _, reason)| in_room("features", key, reason))?;
        self.reconstruction.validate().map_err(|(key, _, reason)| in_room("reconstruction", key, reason))?;
        self.scale.validate().map_err(|(key, reason)| in_room("scale", key, reason))?;
        self.tag.validate().map_err(|(key, reason)| in_room("tag", key, reason))?;
        self.obstacles.validate().map_err(|(key, reason)| in_room("obstacles", key, reason))?;
        self.wheel.validate().map_err(|(key, reason)| in_room("wheel", key, reason))?;
        self.camera.validate().map_err(|(key, reason)| in_room("camera", key, reason))?;
        self.simulator.validate().map_err(|e| in_room("simulator", e.key, e.reason))?;
        self.publish.validate()?;
        if self.map.localise && !matches!(self.map.choice(), MapChoice::Named(_)) {
            return Err(Invalid::new("map.localise", "needs a map to be located in: map.file names none"));
        }
        self.refuse_what_is_not_built()?;
        self.log.filter().map_err(|reason| Invalid::new("log.level", reason))?;
        self.mount.validate()
    }
}

impl Config {
    /// One file serves both builds: the robot's reads and checks every key, and refuses only to do what it cannot.
    fn refuse_what_is_not_built(&self) -> Result<(), Invalid> {
        if cfg!(feature = "tools") {
            return Ok(());
        }
        if self.daemon.source == SourceKind::Simulator {
            return Err(Invalid::new("daemon.source", "this build, the robot's, has no simulator; cairn-tools has"));
        }
        if !self.output.overview.as_os_str().is_empty() {
            return Err(Invalid::new(
                "output.overview",
                "this build, the robot's, draws no pictures; cairn-tools does",
            ));
        }
        Ok(())
    }
}

/// A configuration from TOML text; `file` is only for messages.
pub fn parse(text: &str, file: &str) -> Result<Config, ConfigError> {
    let config: Config = toml::from_str(text).map_err(|e| error::from_toml(&e, text, file))?;
    config.validate().map_err(|invalid| error::from_invalid(invalid, text, file))?;
    Ok(config)
}

/// Reads and parses `path`.
pub fn load(path: &Path) -> Result<Config, ConfigError> {
    let file = path.display().to_string();
    let text =
        std::fs::read_to_string(path).map_err(|e| ConfigError::Read { file: file.clone(), reason: e.to_string() })?;
    parse(&text, &file)
}

/// The configuration of `path`, else of [`SYSTEM_FILE`] if that exists, else the defaults; and which of them, for the log.
pub fn find(path: Option<&Path>) -> Result<(Config, String), ConfigError> {
    if let Some(path) = path {
        return Ok((load(path)?, path.display().to_string()));
    }
    let system = Path::new(SYSTEM_FILE);
    if system.exists() {
        return Ok((load(system)?, SYSTEM_FILE.into()));
    }
    Ok((Config::default(), "defaults".into()))
}

#[cfg(test)]
mod tests;
