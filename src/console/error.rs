//! Why the console cannot start.

use std::net::SocketAddr;
use std::path::PathBuf;

/// Each says what to do.
#[derive(Debug, thiserror::Error)]
pub enum ConsoleError {
    #[error("cannot listen on {address}: {reason}")]
    Listen { address: SocketAddr, reason: std::io::Error },
    #[error(
        "{0} can be reached from other machines, and whoever opens the page sees the camera and can drop the map: give --token-file with a secret"
    )]
    NeedsToken(SocketAddr),
    #[error("token file {path}: {reason}")]
    TokenFile { path: PathBuf, reason: String },
    #[error("--allow-host {0:?}: give a host's name without scheme, port or path, such as robot.local")]
    HostName(String),
    #[error("the page's parts cannot be unpacked: {0}")]
    Assets(std::io::Error),
}
