//! `cairn watch`: a planner that prints. Waits for a daemon, survives its restarts, ends on a signal or a broken pipe.

mod obstacles;
mod picture;
mod render;
mod tags;

use std::io::{ErrorKind, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::endpoint_args::EndpointArgs;
use super::{CliError, exit_code};
use crate::client::{Client, Subscription, Topic};
use render::Render;

/// How soon a signal is noticed while nothing comes.
const NAP: Duration = Duration::from_millis(100);

/// Print poses as they come: one line a message, until interrupted
#[derive(Debug, Clone, clap::Args)]
pub struct WatchArgs {
    #[command(flatten)]
    pub endpoint: EndpointArgs,
    /// One JSON object a line on stdout, keys as on the wire, unknown values null; everything else goes to stderr
    #[arg(long)]
    pub json: bool,
    /// End after this many lines
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub count: Option<u64>,
    /// Give up, with exit code 69, when nothing has come for this many seconds
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub timeout: Option<Duration>,
    /// The daemon's health instead of poses
    #[arg(long, conflicts_with = "map")]
    pub health: bool,
    /// What each map message says of itself (not its landmarks) instead of poses
    #[arg(long)]
    pub map: bool,
    /// What stands around the robot, and where the floor is seen free, instead of poses
    #[arg(long, conflicts_with_all = ["map", "health"])]
    pub obstacles: bool,
    /// Where the map's tags are, with every map, instead of poses
    #[arg(long, conflicts_with_all = ["map", "health", "obstacles"])]
    pub tags: bool,
    /// Write the next picture of the camera (PNG) and end, instead of poses
    #[arg(long, value_name = "OUT.png", conflicts_with_all = ["map", "health", "obstacles", "tags", "json", "count"])]
    pub picture: Option<PathBuf>,
    /// The daemon's K at that moment, as `cairn twoview --camera` reads it (what the lens distorts is not in it)
    #[arg(long, value_name = "OUT.txt", requires = "picture")]
    pub camera: Option<PathBuf>,
}

fn seconds(text: &str) -> Result<Duration, String> {
    let seconds: f64 = text.parse().map_err(|_| "not a number of seconds".to_string())?;
    match Duration::try_from_secs_f64(seconds) {
        Ok(duration) if !duration.is_zero() => Ok(duration),
        _ => Err("must be more than 0 s".into()),
    }
}

/// Runs the subcommand in this process, on its stdout and signals.
pub fn run(args: &WatchArgs) -> Result<ExitCode, CliError> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, stop.clone())
            .map_err(|e| CliError::new(exit_code::FAILURE, format!("signal {signal} cannot be caught: {e}")))?;
    }
    watch(args, &mut std::io::stdout().lock(), &stop)?;
    Ok(ExitCode::SUCCESS)
}

/// Prints to `out` until `stop`, the wanted number of lines, or the end of `out`.
fn watch(args: &WatchArgs, out: &mut dyn Write, stop: &AtomicBool) -> Result<(), CliError> {
    let client = Client::with_endpoint(args.endpoint.endpoint()?)?;
    if let Some(picture) = &args.picture {
        let (camera, prefix) = (args.camera.as_deref(), args.endpoint.prefix.as_str());
        picture::take(&picture::Wanted { picture, camera, prefix, timeout: args.timeout }, &client, out, stop)
    } else if args.health {
        follow(client.health(), args, out, stop)
    } else if args.obstacles {
        follow(client.obstacles(), args, out, stop)
    } else if args.tags {
        follow(client.tags(), args, out, stop)
    } else if args.map {
        follow(client.map(), args, out, stop)
    } else {
        follow(client.poses(), args, out, stop)
    }
}

fn follow<T: Topic>(
    mut subscription: Subscription<T>,
    args: &WatchArgs,
    out: &mut dyn Write,
    stop: &AtomicBool,
) -> Result<(), CliError>
where
    T::Item: Render,
{
    let prefix = &args.endpoint.prefix;
    let mut lines = 0;
    let mut heard = Instant::now();
    let mut connected = None;
    while !stop.load(Ordering::Relaxed) {
        let item = subscription.wait(NAP)?;
        // Only what stays so is worth a line: the first message may come with the connection.
        if connected != Some(subscription.is_connected()) {
            connected = Some(subscription.is_connected());
            match connected {
                Some(true) => say(&format!("connected to the daemon with prefix {prefix:?}")),
                _ => say(&format!("waiting for a daemon with prefix {prefix:?}")),
            }
        }
        if let Some(item) = item {
            heard = Instant::now();
            let line = if args.json { item.json() } else { item.text() };
            match writeln!(out, "{line}").and_then(|()| out.flush()) {
                Ok(()) => {}
                // Whoever read has seen enough.
                Err(e) if e.kind() == ErrorKind::BrokenPipe => return Ok(()),
                Err(e) => return Err(CliError::new(exit_code::CANNOT_CREATE, format!("standard output: {e}"))),
            }
            lines += 1;
            if args.count.is_some_and(|count| lines >= count) {
                return Ok(());
            }
        } else if let Some(timeout) = args.timeout
            && heard.elapsed() >= timeout
        {
            let message = format!("nothing came from {prefix}/{} for {} s", T::NAME, timeout.as_secs_f64());
            return Err(CliError::new(exit_code::UNAVAILABLE, message));
        }
    }
    Ok(())
}

/// A line for a person; a closed stderr is no fault of this program's.
fn say(line: &str) {
    let _ = writeln!(std::io::stderr().lock(), "cairn watch: {line}");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_timeout_that_is_none_is_refused() {
        assert_eq!(seconds("2.5"), Ok(Duration::from_millis(2500)));
        for bad in ["", "soon", "0", "-1", "NaN", "inf", "1e300"] {
            assert!(seconds(bad).is_err(), "{bad}");
        }
    }
}
