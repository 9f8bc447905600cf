//! Why a recording cannot begin or go on.

use crate::client::ClientError;

/// See module.
#[derive(Debug, thiserror::Error)]
pub enum ShareError {
    #[error("{path}: exists already, and no recording is overwritten; name another file")]
    Exists { path: String },
    #[error("{path}: cannot be written: {reason}")]
    Write { path: String, reason: String },
    #[error("{path}: cannot be read: {reason}")]
    Read { path: String, reason: String },
    /// The file is closed and whole.
    #[error("{path}: {free_mb} MB are left on the disk, {floor_mb} MB are kept free: the recording ends here")]
    DiskFull { path: String, free_mb: u64, floor_mb: u64 },
    #[error("the writing thread panicked")]
    Panicked,
    /// The daemon cannot be heard, and waiting would not cure it. What was recorded is whole.
    #[error(transparent)]
    Client(#[from] ClientError),
}

impl ShareError {
    pub(super) fn write(path: &std::path::Path, reason: impl ToString) -> Self {
        Self::Write { path: path.display().to_string(), reason: reason.to_string() }
    }

    pub(super) fn read(path: &std::path::Path, reason: impl ToString) -> Self {
        Self::Read { path: path.display().to_string(), reason: reason.to_string() }
    }
}
