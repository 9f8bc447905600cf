//! Map-free work on one picture: pyramid, corners, descriptors, frame-to-frame tracks. Knows no map.

use std::sync::Arc;

use nalgebra::Vector2;

use crate::frame::RawFrame;
use crate::image::Pyramid;
use crate::image::decode::DecodeError;

/// A corner of one picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Corner {
    /// Level-0 pixels, sub-pixel where the detector refines.
    pub x: f32,
    pub y: f32,
    /// Detector's own strength, larger is better; comparable within one detector only.
    pub response: f32,
}

/// Which corner detector the feature thread uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DetectorKind {
    /// FAST-9 segment test with non-maximum suppression.
    #[default]
    Fast,
    /// SUSAN, 37-pixel mask, exponential response (METHOD section 2).
    Susan,
}

/// `[features]` of the configuration.
#[derive(Debug, Clone, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct FeaturesConfig {
    pub detector: DetectorKind,
}

impl Default for FeaturesConfig {
    fn default() -> Self {
        Self { detector: DetectorKind::Fast }
    }
}

/// A point followed from frame to frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Track {
    /// Unique over the life of the feature stage; ascending in order of birth.
    pub id: u64,
    /// Level-0 pixel in this frame.
    pub position: Vector2<f32>,
    /// Frames since birth; 0 = detected in this frame.
    pub age: u32,
}

/// What the feature stage hands to reconstruction.
#[derive(Debug, Clone, Default)]
pub struct FrameFeatures {
    pub sequence: u64,
    /// Capture time, source's clock.
    pub timestamp_ns: i64,
    /// CLOCK_MONOTONIC of arrival.
    pub arrival_ns: i64,
    /// CLOCK_MONOTONIC when the decoded grey picture was ready.
    pub decoded_ns: i64,
    /// The picture; level 0 is the whole grey picture.
    pub pyramid: Arc<Pyramid>,
    /// Ascending id.
    pub tracks: Vec<Track>,
}

/// What flows back from reconstruction to the feature stage.
#[derive(Debug, Clone, Default)]
pub struct Feedback {
    /// Frame that this feedback results from.
    pub sequence: u64,
    /// Tracks to forget, ascending.
    pub forget: Vec<u64>,
}

/// The feature thread's work as a plain step.
#[derive(Debug)]
pub struct FeatureStage {}

impl FeatureStage {
    pub fn new(_config: &FeaturesConfig) -> Self {
        Self {}
    }

    /// Decodes `frame` and fills `out`. A corrupt picture is an error and leaves the stage as it was.
    pub fn step(&mut self, _frame: &RawFrame, _out: &mut FrameFeatures) -> Result<(), DecodeError> {
        Ok(())
    }

    /// Takes reconstruction's feedback; applied from the next [`step`](Self::step) on.
    pub fn feedback(&mut self, _feedback: &Feedback) {}
}
