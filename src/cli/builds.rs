//! What the robot's build leaves out, and how it says so.

use clap::error::{ContextKind, ContextValue};

use super::error::{CliError, exit_code};

/// Commands that only the whole build has; the robot's answers them with where they are.
pub const TOOLS_COMMANDS: [&str; 6] = ["compare", "console", "demo", "evaluate", "simulate", "twoview"];

/// Commands that only the build with Zenoh has.
pub const BRIDGE_COMMANDS: [&str; 2] = ["bridge", "fleet"];

/// The same of `cairn map`.
const MAP_PULL: &str = "map pull";

/// Below the help: what other packages have.
pub const OTHER_BUILDS: &str = match (cfg!(feature = "tools"), cfg!(feature = "bridge")) {
    (false, false) => {
        "In the package cairn-tools, as commands of `cairn-tools`: compare, console, demo, evaluate, simulate, twoview.\n\
         In the package cairn-bridge, as commands of `cairn-bridge`: bridge, fleet, map pull."
    }
    (true, false) => "In the package cairn-bridge, as commands of `cairn-bridge`: bridge, fleet, map pull.",
    (false, true) => {
        "In the package cairn-tools, as commands of `cairn-tools`: compare, console, demo, evaluate, simulate, twoview."
    }
    (true, true) => "",
};

/// The sentence for something that this build leaves out.
pub fn not_in_this_build(what: &str) -> String {
    format!("{what} is not in this build, the robot's; cairn-tools has it")
}

/// Refuses what only the whole build can do.
pub fn needs_tools(what: &str) -> Result<(), CliError> {
    if cfg!(feature = "tools") { Ok(()) } else { Err(CliError::new(exit_code::USAGE, not_in_this_build(what))) }
}

/// The sentence for a command line that asks for a command of another build; `None` if it is wrong in another way.
pub fn elsewhere(error: &clap::Error) -> Option<String> {
    let ContextValue::String(asked) = error.get(ContextKind::InvalidSubcommand)? else { return None };
    let asked = match error.get(ContextKind::Usage) {
        // It is that of the command above.
        Some(ContextValue::StyledStr(usage)) if asked == "pull" && usage.to_string().contains(" map ") => MAP_PULL,
        _ => asked.as_str(),
    };
    let what = format!("`cairn {asked}`");
    if !cfg!(feature = "tools") && TOOLS_COMMANDS.contains(&asked) {
        return Some(format!("{}: `cairn-tools {asked}`", not_in_this_build(&what)));
    }
    let bridge = !cfg!(feature = "bridge") && (BRIDGE_COMMANDS.contains(&asked) || asked == MAP_PULL);
    bridge.then(|| format!("{what} is not in this build; the package cairn-bridge has it: `cairn-bridge {asked}`"))
}
