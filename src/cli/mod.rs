//! One file a subcommand: `Args` (clap) and `run(&Args) -> Result<ExitCode, CliError>`. Results on stdout, all else on stderr.

#[cfg(feature = "bridge")]
pub mod bridge;
mod builds;
pub mod calibrate;
mod camera_calibration;
mod camera_command;
pub mod command;
#[cfg(feature = "tools")]
pub mod compare;
#[cfg(feature = "tools")]
pub mod console;
#[cfg(feature = "tools")]
pub mod demo;
pub mod doctor;
pub mod endpoint_args;
mod error;
#[cfg(feature = "tools")]
pub mod evaluate;
#[cfg(feature = "bridge")]
pub mod fleet;
#[cfg(feature = "bridge")]
mod fleet_plot;
pub mod map;
mod map_daemon;
mod map_file;
#[cfg(feature = "bridge")]
mod map_pull;
#[cfg(feature = "bridge")]
mod map_shelf;
pub mod record;
mod reload;
pub mod replay;
pub mod run;
mod session;
#[cfg(feature = "tools")]
pub mod simulate;
pub mod tag;
#[cfg(feature = "tools")]
pub mod twoview;
mod utc;
pub mod watch;
#[cfg(feature = "bridge")]
mod zenoh_args;

use std::process::ExitCode;

pub use builds::{BRIDGE_COMMANDS, TOOLS_COMMANDS, elsewhere};
pub use error::{CliError, exit_code};

/// Monocular SLAM for small robots: one webcam in, pose and sparse map out, in shared memory
#[derive(Debug, clap::Parser)]
#[command(name = "cairn", version)]
#[command(after_help = builds::OTHER_BUILDS)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    Run(run::RunArgs),
    #[cfg(feature = "tools")]
    Demo(demo::DemoArgs),
    Replay(replay::ReplayArgs),
    Record(record::RecordArgs),
    #[cfg(feature = "bridge")]
    Bridge(bridge::BridgeArgs),
    #[cfg(feature = "bridge")]
    Fleet(fleet::FleetArgs),
    Watch(watch::WatchArgs),
    Calibrate(calibrate::CalibrateArgs),
    Doctor(doctor::DoctorArgs),
    #[cfg(feature = "tools")]
    Evaluate(evaluate::EvaluateArgs),
    #[cfg(feature = "tools")]
    Simulate(simulate::SimulateArgs),
    #[cfg(feature = "tools")]
    #[command(name = "twoview")]
    TwoView(twoview::TwoViewArgs),
    #[cfg(feature = "tools")]
    Compare(compare::CompareArgs),
    #[cfg(feature = "tools")]
    Console(console::ConsoleArgs),
    Tag(tag::TagArgs),
    Map(map::MapArgs),
    #[command(name = "command")]
    Send(command::CommandArgs),
}

/// Carries out the subcommand.
pub fn run(arguments: &Arguments) -> Result<ExitCode, CliError> {
    match &arguments.command {
        Command::Run(args) => run::run(args),
        #[cfg(feature = "tools")]
        Command::Demo(args) => demo::run(args),
        Command::Replay(args) => replay::run(args),
        Command::Record(args) => record::run(args),
        #[cfg(feature = "bridge")]
        Command::Bridge(args) => bridge::run(args),
        #[cfg(feature = "bridge")]
        Command::Fleet(args) => fleet::run(args),
        Command::Watch(args) => watch::run(args),
        Command::Calibrate(args) => calibrate::run(args),
        Command::Doctor(args) => doctor::run(args),
        #[cfg(feature = "tools")]
        Command::Evaluate(args) => evaluate::run(args),
        #[cfg(feature = "tools")]
        Command::Simulate(args) => simulate::run(args),
        #[cfg(feature = "tools")]
        Command::TwoView(args) => twoview::run(args),
        #[cfg(feature = "tools")]
        Command::Compare(args) => compare::run(args),
        #[cfg(feature = "tools")]
        Command::Console(args) => console::run(args),
        Command::Tag(args) => tag::run(args),
        Command::Map(args) => map::run(args),
        Command::Send(args) => command::run(args),
    }
}

#[cfg(test)]
mod tests {
    use super::builds::needs_tools;
    use super::*;
    use clap::{CommandFactory, Parser};

    /// The commands that the robot's build has; so it is said in `src/lib.rs`.
    const ROBOT_COMMANDS: [&str; 9] =
        ["calibrate", "command", "doctor", "map", "record", "replay", "run", "tag", "watch"];

    #[test]
    fn each_build_has_the_commands_that_its_package_promises() {
        let command = Arguments::command();
        let mut have: Vec<&str> = command.get_subcommands().map(clap::Command::get_name).collect();
        have.sort_unstable();
        let mut promised = ROBOT_COMMANDS.to_vec();
        if cfg!(feature = "tools") {
            promised.extend(TOOLS_COMMANDS);
        }
        if cfg!(feature = "bridge") {
            promised.extend(BRIDGE_COMMANDS);
        }
        promised.sort_unstable();
        assert_eq!(have, promised);
    }

    #[test]
    fn a_command_of_the_other_build_is_answered_with_where_it_is() {
        let answer = |words: &[&str]| Arguments::try_parse_from(words).err().and_then(|e| elsewhere(&e));
        for name in TOOLS_COMMANDS {
            let text = answer(&["cairn", name, "--seconds", "3"]).unwrap_or_default();
            let sentence = text.contains("not in this build") && text.ends_with(&format!(": `cairn-tools {name}`"));
            assert_eq!(sentence, !cfg!(feature = "tools"), "{name}: {text}");
        }
        for name in BRIDGE_COMMANDS {
            let text = answer(&["cairn", name, "--robot", "r"]).unwrap_or_default();
            let sentence = text.contains("not in this build") && text.ends_with(&format!(": `cairn-bridge {name}`"));
            assert_eq!(sentence, !cfg!(feature = "bridge"), "{name}: {text}");
        }
        let pull = answer(&["cairn", "map", "pull", "r:attic"]).unwrap_or_default();
        assert_eq!(pull.ends_with(": `cairn-bridge map pull`"), !cfg!(feature = "bridge"), "{pull}");
        assert_eq!((answer(&["cairn", "dmeo"]), answer(&["cairn", "pull"])), (None, None));
        assert_eq!(needs_tools("`--overview`").is_err(), !cfg!(feature = "tools"));
    }
}
