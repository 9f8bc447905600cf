//! The feature step: one captured frame into decoded picture, pyramid and tracks, or a counted reason why not.
//!
//! A picture of another size than the ones before is skipped, as a broken one may claim any size; several in a row, all of the same size, are a
//! camera that sends another size now (opened anew, another mode): they are passed on, and the reconstruction step begins anew with them.

use std::sync::Arc;
use std::time::Duration;

use tracing::warn;

use super::status::Status;
use crate::features::{FeatureStage, FeaturesConfig, Feedback, FrameFeatures};
use crate::frame::{PixelFormat, RawFrame, monotonic_ns};
use crate::image::decode::picture_size;
use crate::telemetry::RateLimiter;

/// So many pictures of another size in a row are the camera's new size.
const NEW_SIZE_AFTER: u32 = 5;

/// The feature stage without its thread.
pub struct FeatureStep {
    stage: FeatureStage,
    /// Size of the pictures, which all must have: a camera's calibration holds for one size.
    size: Option<(u32, u32)>,
    /// Another size, and how many pictures in a row had it.
    other: Option<((u32, u32), u32)>,
    corrupt: RateLimiter,
    wrong_size: RateLimiter,
    status: Arc<Status>,
}

impl FeatureStep {
    pub fn new(config: &FeaturesConfig, status: Arc<Status>) -> Self {
        Self {
            stage: FeatureStage::new(config),
            size: None,
            other: None,
            corrupt: RateLimiter::default(),
            wrong_size: RateLimiter::default(),
            status,
        }
    }

    /// Fills `out` from `frame`; `false` if the frame is skipped.
    pub fn step(&mut self, frame: &RawFrame, out: &mut FrameFeatures) -> bool {
        let begin_ns = monotonic_ns();
        let size = stated_size(frame);
        if let (Some(size), Some(before)) = (size, self.size)
            && size != before
            && !self.is_here_to_stay(size)
        {
            self.status.wrong_size.add(1);
            if let Some(frames) = self.wrong_size.event(begin_ns) {
                let ((width, height), (width_before, height_before)) = (size, before);
                let sequence = frame.sequence;
                warn!(frames, sequence, width, height, width_before, height_before, "picture of another size, skipped");
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
        if let (Some((width, height)), Some(before)) = (size, self.size)
            && (width, height) != before
        {
            let (width_before, height_before) = before;
            warn!(width, height, width_before, height_before, "camera sends another size now, a new map begins");
        }
        self.size = size.or(self.size);
        self.other = None;
        self.status.decode.record(nanoseconds(out.decoded_ns - begin_ns));
        self.status.feature.record(nanoseconds(monotonic_ns() - out.decoded_ns));
        true
    }

    /// Notes a picture of another size; `true` if it is not the first of them.
    fn is_here_to_stay(&mut self, size: (u32, u32)) -> bool {
        let before = self.other.filter(|(other, _)| *other == size).map_or(0, |(_, count)| count);
        self.other = Some((size, before + 1));
        before >= NEW_SIZE_AFTER
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
