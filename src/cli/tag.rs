//! `cairn tag`: a tag to print.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use super::error::{CliError, exit_code};
use super::session;
use crate::atomic_file::write_atomically;
use crate::motion::tag::sheet::Sheet;

/// Print an AprilTag (36h11) of a known size, which gives the map its scale in metres
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  cairn tag --print 7 --size 0.15
  cairn tag --print 7 --size 0.15 --output dock.svg")]
pub struct TagArgs {
    /// Number of the tag, 0 to 586
    #[arg(long, value_name = "ID")]
    pub print: u32,
    /// Side of its black square, m
    #[arg(long, value_name = "METRES")]
    pub size: f64,
    /// SVG to write [default: tag-ID.svg]
    #[arg(long, short, value_name = "FILE")]
    pub output: Option<PathBuf>,
}

pub fn run(args: &TagArgs) -> Result<ExitCode, CliError> {
    let sheet = Sheet::new(args.print, args.size).map_err(|e| CliError::new(exit_code::USAGE, e.to_string()))?;
    let output = args.output.clone().unwrap_or_else(|| format!("tag-{}.svg", args.print).into());
    write_atomically(&output, |out| out.write_all(sheet.svg().as_bytes()))
        .map_err(|e| CliError::new(exit_code::CANNOT_CREATE, e.to_string()))?;
    session::print(&format!("{} ({})\n", output.display(), sheet.paper()))?;
    Ok(ExitCode::SUCCESS)
}
