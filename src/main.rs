//! The `cairn` command: arguments in, exit code out. What the subcommands do is in `cairn::cli`.

use std::process::ExitCode;

use cairn::cli::{self, exit_code};
use cairn::telemetry;
use clap::Parser;

fn main() -> ExitCode {
    let arguments = match cli::Arguments::try_parse() {
        Ok(arguments) => arguments,
        Err(error) => {
            if let Some(sentence) = cli::elsewhere(&error) {
                telemetry::say_error(&format!("cairn: {sentence}"));
                return ExitCode::from(exit_code::USAGE);
            }
            // Help and version are no errors; a terminal that has gone needs neither.
            let _ = error.print();
            return if error.use_stderr() { ExitCode::from(exit_code::USAGE) } else { ExitCode::SUCCESS };
        }
    };
    telemetry::log_panics();
    match cli::run(&arguments) {
        Ok(code) => code,
        Err(error) => {
            telemetry::say_error(&format!("cairn: {error}"));
            ExitCode::from(error.code)
        }
    }
}
