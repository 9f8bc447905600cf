//! Why a picture is not decoded, and which sizes are.

/// Widest picture that is decoded, pixels.
pub const MAX_WIDTH: usize = 1920;
/// Highest picture that is decoded, pixels.
pub const MAX_HEIGHT: usize = 1200;

/// Why a frame could not be turned into a grey picture.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// The bytes are not a whole picture of the stated format.
    #[error("{format} picture of {bytes} bytes cannot be decoded: {reason}")]
    Corrupt { format: &'static str, bytes: usize, reason: String },
    /// The header states a size that is not handled.
    #[error(
        "{format} picture of {width}x{height} px is refused: sizes from 1x1 to {MAX_WIDTH}x{MAX_HEIGHT} px are handled"
    )]
    Size { format: &'static str, width: usize, height: usize },
}

/// Refuses a size before anything is allocated for it.
pub(super) fn check_size(format: &'static str, width: usize, height: usize) -> Result<(), DecodeError> {
    if (1..=MAX_WIDTH).contains(&width) && (1..=MAX_HEIGHT).contains(&height) {
        Ok(())
    } else {
        Err(DecodeError::Size { format, width, height })
    }
}
