//! Which webcam, and how it is asked to send.

/// `[camera]`: which webcam, and how it is asked to send.
#[derive(Debug, Clone, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct V4l2Config {
    /// Device file, such as `/dev/video0` or better `/dev/v4l/by-id/...` (a camera) or `by-path/...` (a port), or `auto`: the first camera
    /// that works and is free.
    pub device: String,
    /// Picture size to ask for, px; the nearest that the camera has is used. 160 to 1920 by 120 to 1200.
    pub width_px: u32,
    pub height_px: u32,
    /// Frame rate to ask for, Hz; the nearest that the camera has is used. 1 to 240.
    pub rate_hz: f64,
    /// `auto` (uncompressed where that reaches size and rate, else motion JPEG), `grey`, `yuyv` or `mjpeg`.
    pub format: FormatPreference,
    /// Buffers that the driver fills in turn. 2 to 16; 4 bridge a pause of three frames.
    pub buffers: u32,
    /// Whether the camera may focus by itself. Every change of focus changes the calibration, so: false.
    pub autofocus: bool,
    /// Position of a lens that does not focus by itself, in the camera's own steps; -1: as it is.
    pub focus: i32,
    /// Whether the camera may lower its rate to expose longer in the dark. Longer exposure blurs, so: false.
    pub dynamic_rate: bool,
    /// What lamps flicker with.
    pub power_line: PowerLine,
    /// Fixed time of exposure, ms; 0: the camera decides.
    pub exposure_ms: f64,
    /// So long after the first frame exposure, gain and white balance stay as they are by then, s; 0: never.
    pub lock_after_s: f64,
    /// When locked, exposure is no longer than this, ms, and gain makes up for it as far as it goes; 0: no limit.
    pub exposure_limit_ms: f64,
}

impl Default for V4l2Config {
    fn default() -> Self {
        Self {
            device: "auto".into(),
            width_px: 640,
            height_px: 480,
            rate_hz: 30.0,
            format: FormatPreference::Auto,
            buffers: 4,
            autofocus: false,
            focus: -1,
            dynamic_rate: false,
            power_line: PowerLine::Keep,
            exposure_ms: 0.0,
            lock_after_s: 0.0,
            exposure_limit_ms: 0.0,
        }
    }
}

/// Which of the camera's formats is used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FormatPreference {
    #[default]
    Auto,
    Grey,
    Yuyv,
    Mjpeg,
}

impl V4l2Config {
    /// Checks what the types cannot. The error is the key and what it must be.
    pub fn validate(&self) -> Result<(), (&'static str, String)> {
        let wrong = |key, must: &str| Err((key, must.to_string()));
        if self.device.is_empty() || self.device.contains('\0') {
            return wrong("device", "must be \"auto\" or a device file such as \"/dev/video0\"");
        }
        if !(160..=1920).contains(&self.width_px) {
            return wrong("width_px", "must be 160 to 1920");
        }
        if !(120..=1200).contains(&self.height_px) {
            return wrong("height_px", "must be 120 to 1200");
        }
        if !(1.0..=240.0).contains(&self.rate_hz) {
            return wrong("rate_hz", "must be 1 to 240");
        }
        if !(2..=16).contains(&self.buffers) {
            return wrong("buffers", "must be 2 to 16");
        }
        if !(-1..=100_000).contains(&self.focus) {
            return wrong("focus", "must be -1 (as it is) to 100000");
        }
        if self.focus >= 0 && self.autofocus {
            return wrong("focus", "must be -1 with autofocus = true");
        }
        for (key, value) in [("exposure_ms", self.exposure_ms), ("exposure_limit_ms", self.exposure_limit_ms)] {
            if value != 0.0 && !(0.1..=1000.0).contains(&value) {
                return wrong(key, "must be 0.1 to 1000 ms, or 0");
            }
        }
        if !(0.0..=600.0).contains(&self.lock_after_s) {
            return wrong("lock_after_s", "must be 0 to 600");
        }
        if self.exposure_limit_ms > 0.0 && self.lock_after_s == 0.0 {
            return wrong("exposure_limit_ms", "must be 0 unless lock_after_s says when");
        }
        if self.exposure_ms > 0.0 && self.lock_after_s > 0.0 {
            return wrong("exposure_ms", "must be 0 with lock_after_s");
        }
        Ok(())
    }
}

/// What lamps flicker with; exposure is then a multiple of their period.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PowerLine {
    /// As the camera has it.
    #[default]
    Keep,
    Off,
    #[serde(rename = "50hz")]
    Hz50,
    #[serde(rename = "60hz")]
    Hz60,
    Auto,
}
