//! Decoding of a [`RawFrame`](crate::frame::RawFrame) into grey.

use super::GreyImage;
use crate::frame::RawFrame;

/// Why a frame could not be turned into a grey picture.
#[derive(Debug, thiserror::Error)]
pub enum DecodeError {
    /// The bytes are not a whole picture of the stated format.
    #[error("{format} picture of {bytes} bytes cannot be decoded: {reason}")]
    Corrupt { format: &'static str, bytes: usize, reason: String },
}

/// Decodes with buffers kept between frames.
#[derive(Debug, Default)]
pub struct Decoder {}

impl Decoder {
    /// Decodes `frame` into `out` (resized to fit).
    pub fn decode(&mut self, _frame: &RawFrame, _out: &mut GreyImage) -> Result<(), DecodeError> {
        Ok(())
    }
}
