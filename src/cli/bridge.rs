//! `cairn bridge`: a running daemon's poses, map and pictures to ROS 2, over Zenoh.

use std::process::ExitCode;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;

use super::map_shelf::MapShelf;
use super::session::{self, SessionArgs};
use super::zenoh_args::ZenohArgs;
use super::{CliError, exit_code, map_file};
use crate::daemon;
use crate::messages::Endpoint;
use crate::share::bridge::{Bridge, BridgeError, Network, Rate, Rates, Robot};
use crate::share::maps::Giver;
use crate::telemetry;

/// Bridge a running daemon to ROS 2 over Zenoh, as a node of rmw_zenoh's, until interrupted
#[derive(Debug, clap::Args)]
pub struct BridgeArgs {
    /// Namespace of its topics; / for none [default: the prefix]
    #[arg(long, value_name = "NAME")]
    pub robot: Option<String>,
    /// Send a topic at most so often, such as odom=10; 0 leaves it out; may be given several times
    #[arg(long, value_name = "TOPIC=HZ")]
    pub rate: Vec<String>,
    /// tf and tf_static in the robot's namespace, as Nav2's launch files for several robots have them
    #[arg(long)]
    pub namespaced_tf: bool,
    /// Only send: no reset, no save, no initial pose from the network, and no stored map to it
    #[arg(long)]
    pub no_commands: bool,
    #[command(flatten)]
    pub zenoh: ZenohArgs,
    #[command(flatten)]
    pub session: SessionArgs,
}

impl From<BridgeError> for CliError {
    fn from(error: BridgeError) -> Self {
        let code = match error {
            BridgeError::Client(error) => return error.into(),
            BridgeError::Name { .. } | BridgeError::Rate { .. } => exit_code::USAGE,
            BridgeError::Configuration { .. } => exit_code::CONFIG,
            BridgeError::Open { .. } => exit_code::UNAVAILABLE,
            BridgeError::Declare { .. } => exit_code::FAILURE,
        };
        Self::new(code, error.to_string())
    }
}

pub fn run(args: &BridgeArgs) -> Result<ExitCode, CliError> {
    let config = args.session.open()?;
    let stop = session::stop_flag()?;
    let robot = match &args.robot {
        Some(name) => Robot::new(name)?,
        None => Robot::of_prefix(&config.prefix)?,
    };
    let rates: Vec<Rate> = args.rate.iter().map(|text| text.parse()).collect::<Result<_, BridgeError>>()?;
    let network = Network {
        domain: args.zenoh.domain,
        robot,
        own_tf: args.namespaced_tf,
        takes_commands: !args.no_commands,
        file: args.zenoh.file(),
    };
    let endpoint = Endpoint::new(&config.prefix).and_then(Endpoint::with_environment)?;
    let offset_ns = session::realtime_minus_monotonic_ns();
    let shelf = map_file::folder(&config.map).filter(|_| network.takes_commands);
    let shelf = shelf.map(|folder| MapShelf::open(folder, endpoint.clone())).transpose()?;
    let (giver, requests) = shelf.map(|shelf| Giver::new(Box::new(shelf))).unzip();
    let (mut bridge, commands) = Bridge::open(endpoint, &network, Rates::new(&rates), offset_ns, requests)?;
    let mut helpers: Vec<JoinHandle<()>> = Vec::new();
    let failed = |e: daemon::DaemonError| CliError::new(exit_code::FAILURE, e.to_string());
    if let Some(commands) = commands {
        let over = stop.clone();
        helpers.push(daemon::spawn("cairn-bridge", move || commands.serve(&over)).map_err(failed)?);
    }
    if let Some(giver) = giver {
        let over = stop.clone();
        helpers.push(daemon::spawn("cairn-maps", move || giver.serve(&over)).map_err(failed)?);
    }
    let outcome = loop {
        if stop.load(Ordering::Relaxed) {
            break Ok(());
        }
        if let Err(error) = bridge.step() {
            break Err(error);
        }
    };
    // Whatever ended it: the node leaves the network at once, and a command that is under way is waited for.
    bridge.close();
    stop.store(true, Ordering::Relaxed);
    let panicked = helpers.into_iter().map(JoinHandle::join).filter(Result::is_err).count();
    telemetry::report_suppressed(true);
    outcome?;
    if panicked > 0 {
        return Err(CliError::new(exit_code::FAILURE, "the thread for commands, or that for maps, panicked"));
    }
    Ok(ExitCode::SUCCESS)
}
