//! Why a picture is not decoded, and which sizes are.

/// Longer side of the largest picture that is decoded, pixels.
pub const MAX_LONGER: usize = 1920;
/// Its shorter side.
pub const MAX_SHORTER: usize = 1200;

/// Why a frame could not be turned into a grey picture.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// The bytes are not a whole picture of the stated format.
    #[error("{format} picture of {bytes} bytes cannot be decoded: {reason}")]
    Corrupt { format: &'static str, bytes: usize, reason: String },
    /// The header states a size that is not handled.
    #[error(
        "{format} picture of {width}x{height} px is refused: sizes from 1x1 to {MAX_LONGER}x{MAX_SHORTER} px, lying \
         or upright, are handled"
    )]
    Size { format: &'static str, width: usize, height: usize },
}

/// Whether a picture of this size is decoded: a camera may be mounted on its side, and a telephone films upright.
pub const fn is_handled(width: usize, height: usize) -> bool {
    let (longer, shorter) = if width > height { (width, height) } else { (height, width) };
    shorter >= 1 && longer <= MAX_LONGER && shorter <= MAX_SHORTER
}

/// Refuses a size before anything is allocated for it.
pub(super) fn check_size(format: &'static str, width: usize, height: usize) -> Result<(), DecodeError> {
    if is_handled(width, height) { Ok(()) } else { Err(DecodeError::Size { format, width, height }) }
}
