//! Why there is no picture.

use crate::atomic_file::WriteError;

/// Why there is no picture.
#[derive(Debug, thiserror::Error)]
pub enum PlotError {
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error("cannot draw: {0}")]
    Draw(&'static str),
}
