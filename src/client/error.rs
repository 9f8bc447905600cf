//! Why a client cannot go on, and what to do about it.

use std::fmt;
use std::path::PathBuf;
use std::time::Duration;

use crate::messages::{EndpointError, effective_uid, user_name};

/// An error that waiting does not cure. A daemon that is not there is none, except for commands.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ClientError {
    /// The prefix or another name cannot be used.
    Endpoint(EndpointError),
    /// Daemon and planner were built with different versions of a message.
    VersionMismatch { service: String, ours: String, theirs: String },
    /// Daemon and planner were built with different versions of iceoryx2.
    IpcVersionMismatch { service: String },
    /// All places at this service are taken.
    TooManySubscribers { service: String, limit: usize },
    /// More slices are held than the service allows; drop some.
    TooManyHeld { service: String, limit: usize },
    /// The daemon's files belong to another user: nothing would ever arrive.
    OtherOwner { path: PathBuf, owner: u32 },
    /// Another process tells of the wheels already.
    SecondPublisher { service: String, pid: Option<u32> },
    /// No daemon took the command.
    NoDaemon { prefix: String },
    /// The daemon did not answer in time; it may still carry the command out.
    NoReply { prefix: String, waited: Duration },
    /// The path has more bytes than a command can carry.
    PathTooLong { bytes: usize, limit: usize },
    /// iceoryx2 failed in a way that has no better name here.
    Ipc { service: String, doing: &'static str, reason: String },
}

impl From<EndpointError> for ClientError {
    fn from(e: EndpointError) -> Self {
        Self::Endpoint(e)
    }
}

impl fmt::Display for ClientError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Endpoint(e) => e.fmt(f),
            Self::VersionMismatch { service, ours, theirs } => write!(
                f,
                "the daemon's {service} carries {theirs}, this program was built for {ours}: \
                 install the same version of both"
            ),
            Self::IpcVersionMismatch { service } => {
                write!(
                    f,
                    "the daemon's {service} was made by another version of iceoryx2: build both with the same one"
                )
            }
            Self::TooManySubscribers { service, limit } => write!(
                f,
                "{service} has its {limit} subscribers already: stop one of them (`iox2 service details {service}` lists them)"
            ),
            Self::TooManyHeld { service, limit } => {
                write!(f, "{limit} messages of {service} are held already: drop one before taking the next")
            }
            Self::OtherOwner { path, owner } => {
                let us = effective_uid().map_or("another user".into(), user_name);
                let owner = user_name(*owner);
                write!(
                    f,
                    "{} belongs to user {owner} and this process runs as {us}, so nothing would arrive: \
                     run both as the same user (for instance `sudo -u` it)",
                    path.display()
                )
            }
            Self::SecondPublisher { service, pid } => {
                let who = pid.map(|pid| format!(" (process {pid})")).unwrap_or_default();
                write!(
                    f,
                    "{service} has a publisher already{who}: only one driver may tell of the wheels, stop the other"
                )
            }
            Self::NoDaemon { prefix } => write!(f, "no daemon with prefix {prefix:?} takes commands: is it running?"),
            Self::NoReply { prefix, waited } => {
                let seconds = waited.as_secs_f64();
                write!(f, "the daemon with prefix {prefix:?} gave no reply in {seconds:.1} s; it may still do it")
            }
            Self::PathTooLong { bytes, limit } => write!(f, "the path has {bytes} bytes, a command carries {limit}"),
            Self::Ipc { service, doing, reason } => write!(f, "{service}: {doing} failed: {reason}"),
        }
    }
}

impl std::error::Error for ClientError {}
