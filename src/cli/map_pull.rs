//! `cairn map pull`: a map that another robot has stored, fetched through that one's bridge.
//!
//! It has its name once all of it has come, its checksum is that of the original, and it is verified as `cairn map info` does. Nothing is replaced.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use super::session::{self, SessionArgs};
use super::zenoh_args::ZenohArgs;
use super::{CliError, exit_code, map_file};
use crate::places::store::{Fault, StoreError, adopt};
use crate::share::maps::{PullError, Wanted, pull};

/// The longest time to wait for a robot, s: an hour.
const LONGEST_S: f64 = 3600.0;

/// Fetch a map that another robot has stored, through that one's bridge
#[derive(Debug, clap::Args)]
pub struct PullArgs {
    /// Whose map, and which, such as robot7:warehouse
    #[arg(value_name = "ROBOT:NAME")]
    wanted: Wanted,
    /// Keep it under this name [default: the same]
    #[arg(long = "as", value_name = "NAME", conflicts_with = "output")]
    name: Option<String>,
    /// Write this file instead; it must not exist
    #[arg(long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// How long to wait for network and robot, s
    #[arg(long, value_name = "SECONDS", default_value = "10", value_parser = seconds)]
    wait: Duration,
    /// Configuration file, which says where maps are kept [default: /etc/cairn/cairn.toml if it exists]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    #[command(flatten)]
    zenoh: ZenohArgs,
}

fn seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse::<f64>().ok().filter(|seconds| (0.0..=LONGEST_S).contains(seconds));
    seconds.map(Duration::from_secs_f64).ok_or_else(|| format!("0 to {LONGEST_S} s"))
}

enum Failed {
    Pull(PullError),
    Store(StoreError),
}

impl From<StoreError> for Failed {
    fn from(error: StoreError) -> Self {
        Self::Store(error)
    }
}

impl From<PullError> for CliError {
    fn from(error: PullError) -> Self {
        let code = match error {
            PullError::Network(error) => return error.into(),
            PullError::Refused { .. } => exit_code::NO_INPUT,
            PullError::Senseless { .. } => exit_code::DATA,
            PullError::Write(_) => exit_code::CANNOT_CREATE,
            PullError::Stopped => exit_code::FAILURE,
            _ => exit_code::UNAVAILABLE,
        };
        Self::new(code, error.to_string())
    }
}

impl PullArgs {
    /// Where it goes.
    fn path(&self) -> Result<PathBuf, CliError> {
        let cannot = |reason: String| CliError::new(exit_code::CANNOT_CREATE, reason);
        if let Some(path) = &self.output {
            let exists = path.symlink_metadata().is_ok();
            return if exists { Err(cannot(Fault::Exists.of(path).to_string())) } else { Ok(path.clone()) };
        }
        let session = SessionArgs { config: self.config.clone(), ..SessionArgs::default() };
        let folder = map_file::folder(&session.read()?.0.map);
        let folder = folder.ok_or_else(|| cannot("there is no folder for maps; name a file with --output".into()))?;
        let name = self.name.as_deref().unwrap_or(&self.wanted.map);
        let path = folder.file(name).map_err(|reason| CliError::new(exit_code::USAGE, reason))?;
        folder.new_file(&path).map_err(cannot)?;
        Ok(path)
    }
}

pub fn run(args: &PullArgs) -> Result<ExitCode, CliError> {
    let path = args.path()?;
    let stop = session::stop_flag()?;
    let (zenoh, mut bytes) = (args.zenoh.file(), 0);
    let contents = adopt(&path, |mut file| {
        let mut write = |piece: &[u8]| file.write_all(piece);
        let network = (args.zenoh.domain, zenoh.as_deref());
        bytes = pull(&args.wanted, network, args.wait, &stop, &mut write).map_err(Failed::Pull)?;
        Ok(())
    });
    let contents = contents.map_err(|failed| match failed {
        Failed::Pull(error) => error.into(),
        Failed::Store(StoreError { fault: Fault::Exists, path }) => {
            CliError::new(exit_code::CANNOT_CREATE, Fault::Exists.of(path.as_ref()).to_string())
        }
        // What has come is not kept, so nothing is left as it is.
        Failed::Store(error) => {
            CliError::new(map_file::error(&error).code, format!("what has come is no map that could be kept: {error}"))
        }
    })?;
    let (maps, keyframes) =
        (contents.saved.maps.len(), contents.saved.maps.iter().map(|m| m.map.keyframes.len()).sum::<usize>());
    let mb = bytes as f64 / 1e6;
    session::print(&format!("{}: {mb:.1} MB, {maps} maps with {keyframes} keyframes, verified\n", path.display()))?;
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_to_wait_may_be_none() {
        assert_eq!((seconds("0"), seconds("2.5")), (Ok(Duration::ZERO), Ok(Duration::from_millis(2500))));
        assert!(["-1", "NaN", "1e9", "x"].iter().all(|text| seconds(text).is_err()));
    }
}
