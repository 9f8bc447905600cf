//! Why a calibration cannot be read or written.

/// Why a calibration cannot be read or written.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CalibrationError {
    /// The file cannot be opened, read or written.
    #[error("{path}: {reason}")]
    File { path: String, reason: String },
    /// The text is not of the format.
    #[error("{path}:{line}: {reason}")]
    Syntax { path: String, line: usize, reason: String },
    /// A key that must be there is not.
    #[error("{path}: {key} is missing: {reason}")]
    Missing { path: String, key: String, reason: String },
    /// A value is impossible.
    #[error("{path}:{line}: {key} = {value}{}: {reason}", if unit.is_empty() { String::new() } else { format!(" {unit}") })]
    Value { path: String, line: usize, key: String, value: String, unit: &'static str, reason: String },
}
