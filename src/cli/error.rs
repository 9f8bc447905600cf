//! How a subcommand fails: a message and an exit code.

use std::fmt;

/// Exit codes (sysexits.h where one fits).
pub mod exit_code {
    /// Something failed that no other code names; also a replay in which no frame was tracked.
    pub const FAILURE: u8 = 1;
    /// The two pictures give no model or no pose: an outcome with a name, on stdout and in `twoview.json`.
    pub const NO_MODEL: u8 = 3;
    /// A map file that is broken, cut off, of another program or of another version of the format; it is left as it is.
    pub const BROKEN_MAP: u8 = 4;
    /// The command line is wrong (EX_USAGE).
    pub const USAGE: u8 = 64;
    /// Input data is malformed (EX_DATAERR).
    pub const DATA: u8 = 65;
    /// An input does not exist or cannot be read (EX_NOINPUT).
    pub const NO_INPUT: u8 = 66;
    /// Another daemon has this prefix, or a service is missing (EX_UNAVAILABLE).
    pub const UNAVAILABLE: u8 = 69;
    /// An output file cannot be written (EX_CANTCREAT).
    pub const CANNOT_CREATE: u8 = 73;
    /// The configuration is wrong (EX_CONFIG).
    pub const CONFIG: u8 = 78;
}

/// A failed subcommand: one message for a person, one code for a script.
#[derive(Debug)]
pub struct CliError {
    pub code: u8,
    pub message: String,
}

impl CliError {
    pub fn new(code: u8, message: impl Into<String>) -> Self {
        Self { code, message: message.into() }
    }
}

impl fmt::Display for CliError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}
impl std::error::Error for CliError {}
