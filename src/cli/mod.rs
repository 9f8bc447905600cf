//! One file a subcommand: `Args` (clap) and `run(&Args) -> Result<ExitCode, CliError>`. Results on stdout, all else on stderr.

pub mod calibrate;
mod camera_calibration;
pub mod command;
pub mod compare;
pub mod demo;
pub mod doctor;
pub mod endpoint_args;
pub mod evaluate;
mod reload;
pub mod replay;
pub mod run;
mod session;
pub mod simulate;
pub mod twoview;
pub mod watch;

use std::fmt;
use std::process::ExitCode;

/// Exit codes (sysexits.h where one fits).
pub mod exit_code {
    /// Something failed that no other code names; also a replay in which no frame was tracked.
    pub const FAILURE: u8 = 1;
    /// The two pictures give no model or no pose: an outcome with a name, on stdout and in `twoview.json`.
    pub const NO_MODEL: u8 = 3;
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

/// Monocular SLAM for small robots: one webcam in, pose and sparse map out, in shared memory
#[derive(Debug, clap::Parser)]
#[command(name = "cairn", version)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    Run(run::RunArgs),
    Demo(demo::DemoArgs),
    Replay(replay::ReplayArgs),
    Watch(watch::WatchArgs),
    Calibrate(calibrate::CalibrateArgs),
    Doctor(doctor::DoctorArgs),
    Evaluate(evaluate::EvaluateArgs),
    Simulate(simulate::SimulateArgs),
    #[command(name = "twoview")]
    TwoView(twoview::TwoViewArgs),
    Compare(compare::CompareArgs),
    #[command(name = "command")]
    Send(command::CommandArgs),
}

/// Carries out the subcommand.
pub fn run(arguments: &Arguments) -> Result<ExitCode, CliError> {
    match &arguments.command {
        Command::Run(args) => run::run(args),
        Command::Demo(args) => demo::run(args),
        Command::Replay(args) => replay::run(args),
        Command::Watch(args) => watch::run(args),
        Command::Calibrate(args) => calibrate::run(args),
        Command::Doctor(args) => doctor::run(args),
        Command::Evaluate(args) => evaluate::run(args),
        Command::Simulate(args) => simulate::run(args),
        Command::TwoView(args) => twoview::run(args),
        Command::Compare(args) => compare::run(args),
        Command::Send(args) => command::run(args),
    }
}
