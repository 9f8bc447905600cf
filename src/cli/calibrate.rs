//! `cairn calibrate`: a camera's calibration from pictures or live, the board to print, and other programs' formats.
//!
//! `pictures` and `live` collect boards; `report` writes what they rest on.

mod args;
mod live;
mod output;
mod pictures;
#[cfg(feature = "tools")]
mod report;

use std::path::Path;
use std::process::ExitCode;

pub use args::CalibrateArgs;
#[cfg(feature = "tools")]
pub(super) use live::before_board;
pub(super) use output::encode;
use output::{format_of, write_text};

use super::builds::needs_tools;
use super::session::{self, StatusLine};
use super::{CliError, exit_code};
use crate::calibration::chessboard::Pattern;
use crate::calibration::export::Format;
use crate::calibration::{CalibrationFile, Unsaid, pattern_sheet};

pub fn run(args: &CalibrateArgs) -> Result<ExitCode, CliError> {
    if args.report.is_some() {
        needs_tools("`--report`, a report in pictures,")?;
    }
    if let Some(input) = &args.convert {
        return convert(args, input);
    }
    let (columns, rows) = args.print_pattern.unwrap_or(args.pattern);
    let pattern = Pattern::new(columns, rows, args.square).map_err(usage)?;
    if args.print_pattern.is_some() {
        let output = args.output.clone().unwrap_or_else(|| format!("board-{columns}x{rows}.svg").into());
        write_text(&output, &pattern_sheet::svg(&pattern))?;
        session::print(&format!("{} ({})\n", output.display(), pattern_sheet::paper(&pattern)))?;
        return Ok(ExitCode::SUCCESS);
    }
    if args.camera.is_some() {
        return live::run(args, &pattern);
    }
    if args.pictures.is_empty() {
        return Err(usage("nothing to calibrate from: give pictures, or --camera auto".into()));
    }
    pictures::run(args, &pattern)
}

fn usage(message: String) -> CliError {
    CliError::new(exit_code::USAGE, message)
}

fn convert(args: &CalibrateArgs, input: &Path) -> Result<ExitCode, CliError> {
    let unsaid = Unsaid { size: args.size, lens: args.lens_model };
    let file = CalibrationFile::load_with(input, &unsaid).map_err(|e| {
        let code = if input.exists() { exit_code::DATA } else { exit_code::NO_INPUT };
        CliError::new(code, e.to_string())
    })?;
    if let Some(assumed) = &file.assumed {
        StatusLine::new(args.quiet).note(&format!("cairn: {assumed}"));
    }
    let format = args.format.or_else(|| args.output.as_deref().and_then(format_of)).unwrap_or(Format::Cairn);
    let name = args.output.as_deref().map_or("the output".into(), |o| o.display().to_string());
    let text = encode(&file, format, &name)?;
    match &args.output {
        Some(output) => {
            write_text(output, &text)?;
            session::print(&format!("{}\n", output.display()))?;
        }
        None => session::print(&text)?,
    }
    Ok(ExitCode::SUCCESS)
}

/// What a file's name stands for.
#[cfg(all(test, feature = "tools"))]
mod tests;
