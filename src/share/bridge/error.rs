//! Why there is no bridge, or none any more.

use crate::client::ClientError;

/// See module.
#[derive(Debug, thiserror::Error)]
pub enum BridgeError {
    #[error("`{name}` is no name of ROS 2: letters, digits and _ between slashes, no digit first")]
    Name { name: String },
    #[error("`{text}`: a rate is TOPIC=HZ, with 0 to 1000 Hz and one of {topics}")]
    Rate { text: String, topics: String },
    /// A file of Zenoh's that cannot be read or is none.
    #[error("{path}: no configuration of Zenoh: {reason}")]
    Configuration { path: String, reason: String },
    #[error("Zenoh cannot begin: {reason}")]
    Open { reason: String },
    #[error("Zenoh: {what} cannot be declared: {reason}")]
    Declare { what: String, reason: String },
    /// The daemon cannot be heard, and waiting would not cure it.
    #[error(transparent)]
    Client(#[from] ClientError),
}

/// Zenoh's reason without the place in its sources that it ends with (` at FILE.rs:LINE.`).
pub(in crate::share) fn reason(error: &zenoh::Error) -> String {
    let text = error.to_string();
    let end = text.find(" at ").filter(|at| text[*at..].contains(".rs:")).unwrap_or(text.len());
    text[..end].to_owned()
}
