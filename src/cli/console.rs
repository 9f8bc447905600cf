//! `cairn console`: a web page that shows what the robot sees.

mod calibration;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use super::endpoint_args::EndpointArgs;
use super::{CliError, exit_code};
use crate::console::{Console, ConsoleError, LogChoice, Options, Token};
use crate::daemon::advice;
use crate::telemetry::{self, LogConfig};

/// Serve a web page that shows what the robot sees: video, map, health, log, and buttons
#[derive(Debug, Clone, clap::Args)]
pub struct ConsoleArgs {
    #[command(flatten)]
    pub endpoint: EndpointArgs,
    /// Where to listen; another address than this machine's own needs --token-file
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:7979")]
    pub listen: SocketAddr,
    /// File with a secret of 16 to 256 characters, which the page then asks for
    #[arg(long, value_name = "FILE")]
    pub token_file: Option<PathBuf>,
    /// Answer to this host name, too, such as robot.local; may be given several times
    #[arg(long, value_name = "NAME")]
    pub allow_host: Vec<String>,
    /// Unit whose journal the page shows
    #[arg(long, value_name = "UNIT", default_value = "cairn", conflicts_with = "log_file")]
    pub unit: String,
    /// File of JSON lines to show instead of the journal, as a daemon writes them to a stderr that is a file
    #[arg(long, value_name = "FILE")]
    pub log_file: Option<PathBuf>,
}

/// Runs the subcommand until a signal.
pub fn run(args: &ConsoleArgs) -> Result<ExitCode, CliError> {
    let failure = |message: String| CliError::new(exit_code::FAILURE, message);
    telemetry::init(&LogConfig::default()).map_err(failure)?;
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, stop.clone())
            .map_err(|e| failure(format!("signal {signal} cannot be caught: {e}")))?;
    }
    let token = args.token_file.as_deref().map(Token::load).transpose()?;
    let console = Console::listen(Options {
        listen: args.listen,
        token,
        names: args.allow_host.clone(),
        endpoint: args.endpoint.endpoint()?,
        log: args.log_file.clone().map_or_else(|| LogChoice::Unit(args.unit.clone()), LogChoice::File),
        advice,
        calibrator: Arc::new(calibration::Chessboards),
    })?;
    telemetry::say(&format!("the console is at http://{}/", console.address()));
    console.run(&stop);
    Ok(ExitCode::SUCCESS)
}

impl From<ConsoleError> for CliError {
    fn from(e: ConsoleError) -> Self {
        let code = match e {
            ConsoleError::NeedsToken(_) | ConsoleError::HostName(_) => exit_code::USAGE,
            ConsoleError::TokenFile { .. } => exit_code::NO_INPUT,
            ConsoleError::Listen { .. } => exit_code::UNAVAILABLE,
            ConsoleError::Assets(_) => exit_code::FAILURE,
        };
        Self::new(code, e.to_string())
    }
}
