//! Why messages cannot be sent.

use std::path::PathBuf;

use crate::messages::{EndpointError, Squatter, user_name};

/// Opening the services, or sending, failed.
#[derive(Debug, thiserror::Error)]
pub enum PublishError {
    /// Another daemon holds the prefix.
    #[error(
        "a daemon with prefix {prefix:?} is already running{}: stop it, or choose another prefix (--prefix, CAIRN_PREFIX)",
        .pid.map(|pid| format!(" (process {pid})")).unwrap_or_default()
    )]
    AlreadyRunning { prefix: String, pid: Option<u32> },
    /// iceoryx2's files belong to another user.
    #[error(
        "{} belongs to user {}: run the daemon as that user, or give it an iceoryx2 root of its own",
        .path.display(), user_name(*.owner)
    )]
    OtherOwner { path: PathBuf, owner: u32 },
    /// Something lies in the place of a file of iceoryx2's.
    #[error("{0}")]
    Squatted(Squatter),
    /// Somebody made the service with another type or other queues and still holds it.
    #[error("{service} exists in another shape ({reason}), held by process {}: stop what holds it, \
             probably a planner or daemon of another version", .pids.iter().map(u32::to_string).collect::<Vec<_>>().join(", "))]
    Incompatible { service: String, reason: String, pids: Vec<u32> },
    /// Messages would not fit, and the kernel answers that with SIGBUS.
    #[error(
        "/dev/shm has {free_mb} MB free and messages may need {needed_mb} MB: make room, or lower [publish] limits"
    )]
    NoRoom { free_mb: u64, needed_mb: u64 },
    /// A picture does not fit into the memory reserved for it.
    #[error(
        "picture of {bytes} bytes exceeds the {limit} bytes that were reserved at start and is not sent: \
         raise publish.max_frame_bytes to {bytes}, or start the daemon again with this camera plugged in"
    )]
    FrameTooLarge { bytes: usize, limit: usize },
    /// A name that cannot be used.
    #[error(transparent)]
    Endpoint(#[from] EndpointError),
    /// iceoryx2 failed in a way that has no better name here.
    #[error("{service}: {doing} failed: {reason}")]
    Ipc { service: String, doing: &'static str, reason: String },
}
