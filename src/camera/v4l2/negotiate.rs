//! Which of a camera's formats, sizes and rates is used.
//!
//! Input: what the camera offers and what the config wants. Output: choices, best first. Nearest size first, because a
//! calibration belongs to a size; then the rate; then the format that costs least: GREY, YUYV, motion JPEG. A camera lists for each
//! size the rates that its USB speed allows, so "uncompressed if the bandwidth allows" follows from the order: a camera
//! that sends 1280x720 as YUYV at 10 Hz and as motion JPEG at 30 Hz is asked for the latter. What several cameras on one
//! bus take from each other shows only when the stream starts; then the next choice is tried.
//!
//! Pure functions; cost: microseconds, once.

use super::{FormatPreference, V4l2Config};
use crate::image::decode::is_handled;
use std::fmt;

/// A rate within this factor of what is asked for is as good as it (29.97 for 30).
const RATE_TOLERANCE: f64 = 0.95;

/// Pixel formats that can be used, the cheapest first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum CameraFormat {
    Grey,
    Yuyv,
    Mjpeg,
}

impl CameraFormat {
    /// V4L2's four characters.
    pub const fn fourcc(self) -> u32 {
        u32::from_le_bytes(match self {
            Self::Grey => *b"GREY",
            Self::Yuyv => *b"YUYV",
            Self::Mjpeg => *b"MJPG",
        })
    }

    /// `None` for a format that is not ours.
    pub fn from_fourcc(fourcc: u32) -> Option<Self> {
        [Self::Grey, Self::Yuyv, Self::Mjpeg].into_iter().find(|f| f.fourcc() == fourcc)
    }

    /// Bytes a pixel, 0 for compressed.
    pub const fn bytes_per_pixel(self) -> u32 {
        match self {
            Self::Grey => 1,
            Self::Yuyv => 2,
            Self::Mjpeg => 0,
        }
    }
}

impl fmt::Display for CameraFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Grey => "GREY",
            Self::Yuyv => "YUYV",
            Self::Mjpeg => "MJPEG",
        })
    }
}

/// Time between frames as the driver writes it, `numerator / denominator` s.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Interval {
    pub numerator: u32,
    pub denominator: u32,
}

impl Interval {
    /// Frames a second; `None` if one of the two is 0.
    pub fn rate_hz(self) -> Option<f64> {
        (self.numerator > 0 && self.denominator > 0).then(|| f64::from(self.denominator) / f64::from(self.numerator))
    }

    /// The nearest interval in steps of a thousandth of a frame a second.
    pub fn of_rate(rate_hz: f64) -> Self {
        Self { numerator: 1000, denominator: (rate_hz * 1000.0).round().clamp(1.0, 4e9) as u32 }
    }
}

/// Rates of one format and size.
#[derive(Debug, Clone, PartialEq)]
pub enum Rates {
    /// The camera does not say.
    Unknown,
    Listed(Vec<Interval>),
    /// Any from the first to the second, Hz.
    Between(f64, f64),
}

/// One format and size that a camera can send.
#[derive(Debug, Clone, PartialEq)]
pub struct Offer {
    pub format: CameraFormat,
    pub width: u32,
    pub height: u32,
    pub rates: Rates,
}

/// What the camera is asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Choice {
    pub format: CameraFormat,
    pub width: u32,
    pub height: u32,
    pub interval: Interval,
    /// What `interval` stands for; the camera's answer may differ.
    pub rate_hz: f64,
}

impl fmt::Display for Choice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}x{} at {:.3} Hz", self.format, self.width, self.height, self.rate_hz)
    }
}

/// The usable offers with the best rate of each, best first.
pub fn ranked(offers: &[Offer], config: &V4l2Config) -> Vec<Choice> {
    let allowed = |format: CameraFormat| match config.format {
        FormatPreference::Auto => true,
        FormatPreference::Grey => format == CameraFormat::Grey,
        FormatPreference::Yuyv => format == CameraFormat::Yuyv,
        FormatPreference::Mjpeg => format == CameraFormat::Mjpeg,
    };
    let fits = |o: &&Offer| is_handled(o.width as usize, o.height as usize);
    let mut choices: Vec<Choice> = offers
        .iter()
        .filter(|o| allowed(o.format))
        .filter(fits)
        .map(|o| {
            let interval = best_interval(&o.rates, config.rate_hz);
            let rate_hz = interval.rate_hz().unwrap_or(config.rate_hz);
            Choice { format: o.format, width: o.width, height: o.height, interval, rate_hz }
        })
        .collect();
    // Stable, so that the camera's own order decides between equals.
    choices.sort_by(|a, b| {
        size_distance(a, config)
            .cmp(&size_distance(b, config))
            .then(rate_shortfall(a, config).total_cmp(&rate_shortfall(b, config)))
            .then(a.format.cmp(&b.format))
            .then((a.rate_hz - config.rate_hz).abs().total_cmp(&(b.rate_hz - config.rate_hz).abs()))
    });
    choices.dedup();
    choices
}

fn size_distance(choice: &Choice, config: &V4l2Config) -> u32 {
    choice.width.abs_diff(config.width_px) + choice.height.abs_diff(config.height_px)
}

/// Part of the wanted rate that is missing; 0 when it is reached.
fn rate_shortfall(choice: &Choice, config: &V4l2Config) -> f64 {
    if choice.rate_hz >= RATE_TOLERANCE * config.rate_hz { 0.0 } else { 1.0 - choice.rate_hz / config.rate_hz }
}

/// The listed interval whose rate is nearest to the wanted one, in ratio.
fn best_interval(rates: &Rates, wanted_hz: f64) -> Interval {
    match rates {
        Rates::Unknown => Interval::of_rate(wanted_hz),
        Rates::Between(low, high) => Interval::of_rate(wanted_hz.clamp(low.min(*high), high.max(*low))),
        Rates::Listed(intervals) => {
            let distance = |i: &Interval| i.rate_hz().map_or(f64::INFINITY, |r| (r / wanted_hz).ln().abs());
            let best = intervals.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
            best.copied().filter(|i| i.rate_hz().is_some()).unwrap_or_else(|| Interval::of_rate(wanted_hz))
        }
    }
}

/// Sizes in steps: the one nearest to `wanted` on one side of the picture.
pub fn nearest_step(wanted: u32, min: u32, max: u32, step: u32) -> u32 {
    let (max, step) = (max.max(min), step.max(1));
    let inside = wanted.clamp(min, max);
    let down = min + (inside - min) / step * step;
    let up = down.saturating_add(step);
    if up <= max && up - inside < inside - down { up } else { down }
}
