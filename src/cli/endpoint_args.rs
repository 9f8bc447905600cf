//! Which daemon a subcommand talks to: the same options everywhere.

use super::{CliError, exit_code};
use crate::client::ClientError;
use crate::messages::{Endpoint, EndpointError};

/// Options of every subcommand that talks to a running daemon.
#[derive(Debug, Clone, clap::Args)]
pub struct EndpointArgs {
    /// First part of the services' names; a robot with two cameras runs two daemons with two prefixes
    #[arg(long, value_name = "PREFIX", env = "CAIRN_PREFIX", default_value = crate::messages::DEFAULT_PREFIX)]
    pub prefix: String,
}

impl EndpointArgs {
    /// The endpoint; CAIRN_IPC_ROOT and CAIRN_IPC_PREFIX are looked at.
    pub fn endpoint(&self) -> Result<Endpoint, CliError> {
        Endpoint::new(&self.prefix).and_then(Endpoint::with_environment).map_err(CliError::from)
    }
}

impl From<EndpointError> for CliError {
    fn from(e: EndpointError) -> Self {
        Self::new(exit_code::USAGE, e.to_string())
    }
}

impl From<ClientError> for CliError {
    fn from(e: ClientError) -> Self {
        let code = match e {
            ClientError::Endpoint(_) | ClientError::PathTooLong { .. } => exit_code::USAGE,
            _ => exit_code::UNAVAILABLE,
        };
        Self::new(code, e.to_string())
    }
}
