//! `cairn record`: a running daemon's pictures, poses and map into an MCAP file.

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use serde::Serialize;

use super::session::{self, ResultArgs, SessionArgs, StatusLine};
use super::{CliError, exit_code};
use crate::daemon;
use crate::messages::Endpoint;
use crate::share::{self, Heard, Origin, Plan, Queue, Recorder, ShareError, Topic, Written};
use crate::telemetry;

/// Record a running daemon into an MCAP file for Foxglove, Rerun or ROS 2, until interrupted
#[derive(Debug, clap::Args)]
pub struct RecordArgs {
    /// File to write, which must not exist; with --ring the name that all files begin with
    #[arg(value_name = "OUT.mcap")]
    pub out: PathBuf,
    /// End after so many seconds with a daemon
    #[arg(long, value_name = "SECONDS", value_parser = clap::value_parser!(u64).range(1..))]
    pub seconds: Option<u64>,
    /// End when the file has so many megabytes
    #[arg(long, value_name = "MB", value_parser = clap::value_parser!(u64).range(1..), conflicts_with = "ring")]
    pub max_size: Option<u64>,
    /// Keep only the last so many minutes, and write them to a file of their own when tracking is lost or the daemon gone, on SIGUSR1 and at the end
    #[arg(long, value_name = "MINUTES", value_parser = clap::value_parser!(u64).range(1..=1440))]
    pub ring: Option<u64>,
    #[command(flatten)]
    pub result: ResultArgs,
    #[command(flatten)]
    pub session: SessionArgs,
}

/// What a recording came to.
#[derive(Debug, Clone, Serialize)]
struct Summary {
    files: Vec<PathBuf>,
    mb: f64,
    seconds: f64,
    /// Why it ended: `stopped`, `seconds`, `max_size`.
    ended: &'static str,
    pictures: u64,
    /// Pictures that the camera lost or that the recorder was too slow for.
    pictures_missed: u64,
    pictures_unusable: u64,
    /// Messages for which the disk was too slow.
    dropped: u64,
    /// Runs of the daemon.
    daemons: u64,
    topics: Vec<TopicSummary>,
}

#[derive(Debug, Clone, Serialize)]
struct TopicSummary {
    topic: String,
    messages: u64,
}

impl From<ShareError> for CliError {
    fn from(error: ShareError) -> Self {
        match error {
            ShareError::Client(error) => error.into(),
            ShareError::Panicked => Self::new(exit_code::FAILURE, error.to_string()),
            _ => Self::new(exit_code::CANNOT_CREATE, error.to_string()),
        }
    }
}

pub fn run(args: &RecordArgs) -> Result<ExitCode, CliError> {
    let config = args.session.open_for_result(args.result.quiet)?;
    let stop = session::stop_flag()?;
    let keep = keep_flag()?;
    session::check_outputs([&Some(args.out.clone())])?;
    if args.out.extension().is_none_or(|extension| extension != "mcap") {
        let message = format!("{}: a recording's name ends in .mcap", args.out.display());
        return Err(CliError::new(exit_code::USAGE, message));
    }
    let endpoint = Endpoint::new(&config.prefix).and_then(Endpoint::with_environment)?;
    let origin =
        Origin { prefix: config.prefix.clone(), realtime_minus_monotonic_ns: session::realtime_minus_monotonic_ns() };
    let plan = Plan {
        out: args.out.clone(),
        origin,
        max_bytes: args.max_size.map(|mb| mb << 20),
        ring: args.ring.map(|minutes| Duration::from_secs(60 * minutes)),
    };
    let (queue, sink) = share::open(&plan)?;
    let writer = daemon::spawn("cairn-record", move || sink.serve())
        .map_err(|e| CliError::new(exit_code::FAILURE, e.to_string()))?;
    let mut line = StatusLine::new(args.result.quiet);
    let began = Instant::now();
    let is_over = || writer.is_finished();
    let heard = listen(args, endpoint, &plan, queue, &Flags { stop, keep, is_over: &is_over }, &mut line);
    line.clear();
    // The queue's end is gone by now: the rest is written and the file closed, whatever ended the listening.
    let written = end(writer)?;
    let (heard, by_time, seconds) = heard?;
    let ended = match (written.at_limit, by_time) {
        (true, _) => "max_size",
        (false, true) => "seconds",
        (false, false) => "stopped",
    };
    let summary = summarise(&plan, heard, &written, ended, seconds.unwrap_or_else(|| began.elapsed()));
    session::print(&if args.result.json { session::json(&summary)? } else { text(&summary) })?;
    telemetry::report_suppressed(true);
    Ok(ExitCode::SUCCESS)
}

struct Flags<'a> {
    stop: Arc<AtomicBool>,
    keep: Arc<AtomicBool>,
    /// Nobody writes any more.
    is_over: &'a dyn Fn() -> bool,
}

/// Set by SIGUSR1.
fn keep_flag() -> Result<Arc<AtomicBool>, CliError> {
    let keep = Arc::new(AtomicBool::new(false));
    signal_hook::flag::register(signal_hook::consts::SIGUSR1, keep.clone())
        .map_err(|e| CliError::new(exit_code::FAILURE, format!("cannot handle signals: {e}")))?;
    Ok(keep)
}

/// Until a signal, the time or the writing half ends it: what was heard, whether the time ended it, and how long a daemon was there.
fn listen(
    args: &RecordArgs,
    endpoint: Endpoint,
    plan: &Plan,
    queue: Queue,
    flags: &Flags<'_>,
    line: &mut StatusLine,
) -> Result<(Heard, bool, Option<Duration>), ShareError> {
    let mut recorder = Recorder::new(endpoint, plan.origin.realtime_minus_monotonic_ns, queue.clone())?;
    let (mut first, mut shown, mut connected) = (None::<Instant>, Instant::now(), None);
    while !flags.stop.load(Ordering::Relaxed) {
        if !recorder.step()? || (flags.is_over)() {
            break;
        }
        if flags.keep.swap(false, Ordering::Relaxed) {
            queue.event("KEPT");
        }
        if connected != Some(recorder.is_connected()) {
            connected = Some(recorder.is_connected());
            let prefix = &plan.origin.prefix;
            line.note(&match connected {
                Some(true) => format!("recording the daemon with prefix {prefix:?}"),
                _ => format!("waiting for a daemon with prefix {prefix:?}"),
            });
        }
        let heard = recorder.heard();
        if heard.daemons > 0 {
            let first = *first.get_or_insert_with(Instant::now);
            if args.seconds.is_some_and(|seconds| first.elapsed().as_secs() >= seconds) {
                return Ok((heard, true, Some(first.elapsed())));
            }
        }
        if shown.elapsed() >= Duration::from_millis(500) {
            shown = Instant::now();
            line.show(&format!(
                "{} pictures, {} missed, {} records dropped, {:.1} MB wait for the disk",
                heard.pictures,
                heard.missed,
                heard.dropped,
                queue.waiting() as f64 / f64::from(1 << 20)
            ));
        }
    }
    Ok((recorder.heard(), false, first.map(|first| first.elapsed())))
}

fn end(writer: JoinHandle<Result<Written, ShareError>>) -> Result<Written, ShareError> {
    writer.join().map_err(|_| ShareError::Panicked)?
}

fn summarise(plan: &Plan, heard: Heard, written: &Written, ended: &'static str, time: Duration) -> Summary {
    let topics = Topic::ALL.iter().zip(written.messages);
    Summary {
        files: written.files.clone(),
        mb: written.bytes as f64 / f64::from(1 << 20),
        seconds: time.as_secs_f64(),
        ended,
        pictures: heard.pictures,
        pictures_missed: heard.missed,
        pictures_unusable: heard.unusable,
        dropped: heard.dropped,
        daemons: heard.daemons,
        topics: topics
            .map(|(topic, messages)| TopicSummary { topic: topic.name(&plan.origin.prefix), messages })
            .collect(),
    }
}

fn text(s: &Summary) -> String {
    let mut text = format!("{} pictures in {:.1} s, {} missed\n", s.pictures, s.seconds, s.pictures_missed);
    let faults =
        [(s.pictures_unusable, "pictures of an unknown kind"), (s.dropped, "messages dropped, the disk was too slow")];
    for (count, what) in faults.iter().filter(|(count, _)| *count > 0) {
        text += &format!("{count} {what}\n");
    }
    for topic in &s.topics {
        text += &format!("  {:>8} {}\n", topic.messages, topic.topic);
    }
    for file in &s.files {
        text += &format!("wrote {}\n", file.display());
    }
    text + &format!("{:.1} MB\n", s.mb)
}
