//! Why a map cannot be read from a file, or written to it.

use std::io;

/// Version of everything in a map file: front page, table and records. A reader refuses newer ones; it reads those since [`OLDEST_FORMAT`], and who
/// goes on in such a file makes it one of this version first. 1: no condensed pictures; 2: nothing is deflated.
pub const FORMAT: u32 = 3;
pub const OLDEST_FORMAT: u32 = 1;

/// Names the file.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {fault}")]
pub struct StoreError {
    pub path: String,
    pub fault: Fault,
}

/// What is wrong.
#[derive(Debug, thiserror::Error)]
pub enum Fault {
    #[error("cannot be read: {0}")]
    Read(io::Error),
    #[error("cannot be written: {0}")]
    Write(io::Error),
    /// Of another program; untouched.
    #[error("is no map of Cairn's; it is left as it is")]
    Foreign,
    /// Of another version of this program; untouched.
    #[error(
        "has version {0} of the map format, and this program reads versions {OLDEST_FORMAT} to {FORMAT} only; it is left as it is"
    )]
    Version(u32),
    /// Untouched.
    #[error("is broken: {0}; it is left as it is")]
    Broken(String),
    #[error("another process works with it")]
    Busy,
    #[error("exists already")]
    Exists,
    /// Somebody has moved or removed it meanwhile, put another file in its place, or gone on in it; all untouched.
    #[error("is another file now than the one that was opened, or gone; it is left as it is")]
    Replaced,
    /// A picture that is to be written waits in a spool, which does not give it.
    #[error("cannot be written, as a picture that waits in the spool cannot be read: {0}")]
    Spool(String),
    /// It went wrong once, and nothing more is tried.
    #[error("is not written any more: {0}")]
    GivenUp(String),
}

impl Fault {
    /// With the file's name.
    pub fn of(self, path: &std::path::Path) -> StoreError {
        StoreError { path: path.display().to_string(), fault: self }
    }

    /// What lies there is not what is to be written to.
    pub fn is_of_another_file(&self) -> bool {
        matches!(self, Self::Exists | Self::Replaced) || self.is_in_the_data()
    }

    /// There is no such file.
    pub fn is_missing(&self) -> bool {
        matches!(self, Self::Read(error) if error.kind() == io::ErrorKind::NotFound)
    }

    /// The file is there and whoever made it is at fault, not the system.
    pub fn is_in_the_data(&self) -> bool {
        matches!(self, Self::Foreign | Self::Version(_) | Self::Broken(_))
    }
}
