//! The feature step: one captured frame into decoded picture, pyramid and tracks, or a counted reason why not.

use std::sync::Arc;
use std::time::Duration;

use tracing::warn;

use super::status::Status;
use crate::features::{FeatureStage, FeaturesConfig, Feedback, FrameFeatures};
use crate::frame::{PixelFormat, RawFrame, monotonic_ns};
use crate::image::decode::picture_size;
use crate::telemetry::RateLimiter;

/// The feature stage without its thread.
pub struct FeatureStep {
    stage: FeatureStage,
    /// Size of the first picture, which all others must have: a camera's calibration holds for one size.
    size: Option<(u32, u32)>,
    corrupt: RateLimiter,
    wrong_size: RateLimiter,
    status: Arc<Status>,
}

impl FeatureStep {
    pub fn new(config: &FeaturesConfig, status: Arc<Status>) -> Self {
        Self {
            stage: FeatureStage::new(config),
            size: None,
            corrupt: RateLimiter::default(),
            wrong_size: RateLimiter::default(),
            status,
        }
    }

    /// Fills `out` from `frame`; `false` if the frame is skipped.
    pub fn step(&mut self, frame: &RawFrame, out: &mut FrameFeatures) -> bool {
        let begin_ns = monotonic_ns();
        let size = stated_size(frame);
        if let (Some(size), Some(first)) = (size, self.size)
            && size != first
        {
            self.status.wrong_size.add(1);
            if let Some(frames) = self.wrong_size.event(begin_ns) {
                let ((width, height), (first_width, first_height)) = (size, first);
                let sequence = frame.sequence;
                warn!(
                    frames,
                    sequence,
                    width,
                    height,
                    first_width,
                    first_height,
                    "picture of another size than the first, skipped"
                );
            }
            return false;
        }
        if let Err(error) = self.stage.step(frame, out) {
            self.status.corrupt.add(1);
            if let Some(frames) = self.corrupt.event(begin_ns) {
                warn!(frames, sequence = frame.sequence, %error, "frame cannot be decoded, skipped");
            }
            return false;
        }
        self.size = self.size.or(size);
        self.status.decode.record(nanoseconds(out.decoded_ns - begin_ns));
        self.status.feature.record(nanoseconds(monotonic_ns() - out.decoded_ns));
        true
    }

    /// Takes reconstruction's feedback.
    pub fn feedback(&mut self, feedback: &Feedback) {
        self.stage.feedback(feedback);
    }
}

/// The size that the frame says it has, before it is decoded.
fn stated_size(frame: &RawFrame) -> Option<(u32, u32)> {
    match frame.format {
        PixelFormat::Grey | PixelFormat::Yuyv => Some((frame.width, frame.height)),
        PixelFormat::Jpeg | PixelFormat::Png => picture_size(&frame.data),
    }
}

fn nanoseconds(ns: i64) -> Duration {
    Duration::from_nanos(u64::try_from(ns).unwrap_or(0))
}
