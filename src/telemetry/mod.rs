//! What the daemon says about itself: structured logs, counters, latency histograms, heartbeats.
//!
//! - Logs go out by `tracing`: human text on a terminal, fields of the journal where stderr is connected to it (a service), one JSON
//!   object a line elsewhere (pipes, files). The facts of a record are its fields; its message is a constant that can be
//!   searched for. `EVENTS.md` beside this file lists the warnings and errors, with what to do.
//! - Everything a stage touches per frame ([`Counter`], [`Histogram`], [`Heartbeat`]) is a relaxed atomic of fixed size:
//!   a few nanoseconds, no lock, no allocation. The supervisor reads them once a second.
//! - A fault that repeats is logged through a [`RateLimiter`]: at once the first time, then once a second with a count. Whatever
//!   storms all the same is held back and counted ([`report_suppressed`]).
//!
//! It spawns no thread and knows no stage: stages name themselves.

mod heartbeat;
mod histogram;
mod journal;
mod rate_limiter;
mod storm;

use std::io::{IsTerminal, Write};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

use tracing_subscriber::fmt::MakeWriter;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, Registry, reload};

pub use heartbeat::Heartbeat;
pub use histogram::{Histogram, Percentiles, Snapshot};
pub use rate_limiter::RateLimiter;
pub use storm::report_suppressed;

/// How log records look.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum LogFormat {
    /// Human on a terminal, the journal where stderr is connected to it, JSON elsewhere.
    #[default]
    Auto,
    /// Text for a person.
    Human,
    /// One JSON object a line.
    Json,
    /// Fields of systemd's journal.
    Journal,
}

/// `[log]` of the configuration.
#[derive(Debug, Clone, PartialEq, Eq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct LogConfig {
    /// `error`, `warn`, `info`, `debug`, `trace`, or directives such as `info,cairn::daemon=debug`.
    pub level: String,
    pub format: LogFormat,
}

impl Default for LogConfig {
    fn default() -> Self {
        Self { level: "info".into(), format: LogFormat::Auto }
    }
}

impl LogConfig {
    /// The directives as a filter, or why they are none.
    pub fn filter(&self) -> Result<EnvFilter, String> {
        // A word without `=` that is no level would name a target, and silence everything else.
        for word in self.level.split(',').map(str::trim).filter(|w| !w.contains(['=', '['])) {
            if word.is_empty() || word.parse::<tracing_subscriber::filter::LevelFilter>().is_err() {
                return Err(format!("`{word}` is no level: one of off, error, warn, info, debug, trace"));
            }
        }
        // iceoryx2 speaks of its shared-memory segments at info: of use to its own developers only. A directive given
        // by the user comes later and wins. Zenoh warns at each attempt to connect, of which the bridge says the first.
        EnvFilter::try_new(format!("iceoryx2=warn,zenoh=error,{}", self.level)).map_err(|e| e.to_string())
    }
}

/// Changes the filter of the running process.
static FILTER: OnceLock<reload::Handle<EnvFilter, Registry>> = OnceLock::new();

/// Starts logging for this process. Later calls change nothing (tests start several daemons in one process).
pub fn init(config: &LogConfig) -> Result<(), String> {
    let (filter, handle) = reload::Layer::new(config.filter()?);
    let terminal = std::io::stderr().is_terminal();
    let (format, why) = match config.format {
        LogFormat::Auto if terminal => (LogFormat::Human, None),
        LogFormat::Auto if journal::is_stderr() => (LogFormat::Journal, None),
        LogFormat::Auto => (LogFormat::Json, None),
        LogFormat::Journal if journal::layer().is_err() => (LogFormat::Json, journal::layer().err()),
        format => (format, None),
    };
    let guard = storm::StormGuard { information: format == LogFormat::Journal };
    let registry = tracing_subscriber::registry().with(filter).with(guard);
    let json = || {
        let layer = tracing_subscriber::fmt::layer().json().flatten_event(true).with_current_span(false);
        layer.with_span_list(false).log_internal_errors(false).with_writer(Stderr)
    };
    // A record that cannot be written (stderr closed, no journal) is lost; it must neither panic nor end the robot's daemon.
    let outcome = match (format, journal::layer()) {
        (LogFormat::Journal, Ok(layer)) => registry.with(layer).try_init(),
        (LogFormat::Human, _) => {
            let layer = tracing_subscriber::fmt::layer().with_ansi(terminal).with_target(false);
            registry.with(layer.log_internal_errors(false).with_writer(Stderr)).try_init()
        }
        _ => registry.with(json()).try_init(),
    };
    // `Err` means that a subscriber is there already, which is what was wanted.
    if outcome.is_ok() {
        let _ = FILTER.set(handle);
    }
    if let Some(error) = why {
        tracing::warn!(%error, "no journal, JSON on stderr instead");
    }
    Ok(())
}

/// Another level from now on, for a process that logs already.
pub fn set_level(config: &LogConfig) -> Result<(), String> {
    let filter = config.filter()?;
    let handle = FILTER.get().ok_or("logging was not started by this program")?;
    handle.reload(filter).map_err(|e| e.to_string())
}

thread_local! {
    /// What runs on this thread may panic, and whoever called it deals with that.
    static CONTAINED: std::cell::Cell<bool> = const { std::cell::Cell::new(false) };
}

/// What `work` gives, or what its panic said, of which nobody else hears. For code of others that is given bytes of unknown origin.
pub fn contained<T>(work: impl FnOnce() -> T) -> Result<T, String> {
    let before = CONTAINED.replace(true);
    let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(work));
    CONTAINED.set(before);
    outcome.map_err(|payload| panic_message(&*payload).to_owned())
}

fn panic_message(payload: &(dyn std::any::Any + Send)) -> &str {
    let text = payload.downcast_ref::<&str>().copied();
    text.or_else(|| payload.downcast_ref::<String>().map(String::as_str)).unwrap_or("")
}

/// Makes a panic a record like any other, with thread and place as fields.
pub fn log_panics() {
    let before = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        if CONTAINED.get() {
            return;
        }
        if !tracing::enabled!(tracing::Level::ERROR) {
            return before(info);
        }
        let message = panic_message(info.payload());
        let place = info.location().map(ToString::to_string).unwrap_or_default();
        let thread = std::thread::current().name().unwrap_or("").to_owned();
        let backtrace = std::backtrace::Backtrace::capture();
        tracing::error!(thread, place, reason = message, %backtrace, "panic");
    }));
}

/// Standard error without its panics.
struct Stderr;

impl<'a> MakeWriter<'a> for Stderr {
    type Writer = std::io::StderrLock<'static>;
    fn make_writer(&'a self) -> Self::Writer {
        std::io::stderr().lock()
    }
}

/// Writes a line to stderr for a person at a terminal; a closed stderr is no fault of the program's.
pub fn say(line: &str) {
    let _ = writeln!(std::io::stderr().lock(), "{line}");
}

/// The same for the reason why the program ends. In the journal it is an error, which a line of text is not by itself.
pub fn say_error(line: &str) {
    // systemd takes a number in angle brackets off a line's head for its priority.
    let priority = if journal::is_stderr() { "<3>" } else { "" };
    say(&format!("{priority}{line}"));
}

/// Counts events; relaxed, because nothing is ordered by a statistic.
#[derive(Debug, Default)]
pub struct Counter(AtomicU64);

impl Counter {
    /// `n` events more.
    pub fn add(&self, n: u64) {
        self.0.fetch_add(n, Ordering::Relaxed);
    }

    /// Takes the count from elsewhere (a counter that another room keeps).
    pub fn set(&self, n: u64) {
        self.0.store(n, Ordering::Relaxed);
    }

    /// Events so far.
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_level_that_is_none_is_refused_with_the_reason() {
        for (level, part) in
            [("info,cairn::daemon=loud", "expected one of"), ("inof", "`inof` is no level"), ("", "``")]
        {
            let config = LogConfig { level: level.into(), ..Default::default() };
            let reason = config.filter().expect_err("refused");
            assert!(reason.contains(part), "{level}: {reason}");
        }
        let config = LogConfig { level: "warn,cairn::daemon=debug".into(), ..Default::default() };
        assert!(config.filter().is_ok());
    }

    /// Messages of `warn!` and `error!` in a source: the last string of each call.
    fn messages(source: &str) -> Vec<String> {
        let code = source.split("#[cfg(test)]").next().unwrap_or(source);
        let mut found = Vec::new();
        for call in ["warn!(", "error!("] {
            for (at, _) in code.match_indices(call) {
                let Some(end) = code[at..].find(");") else { continue };
                let Some(text) = code[at..at + end].trim_end().strip_suffix('"') else { continue };
                let Some(begin) = text.rfind('"') else { continue };
                found.push(text[begin + 1..].to_owned());
            }
        }
        found
    }

    #[test]
    fn every_warning_and_error_is_listed_with_what_to_do() {
        let mut folders = vec![std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src")];
        let (listed, mut count) = (include_str!("EVENTS.md"), 0);
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).expect("folder") {
                let path = entry.expect("entry").path();
                if path.is_dir() {
                    folders.push(path);
                } else if path.extension().is_some_and(|e| e == "rs") {
                    for message in messages(&std::fs::read_to_string(&path).expect("source")) {
                        count += 1;
                        assert!(
                            listed.contains(&format!("`{message}`")),
                            "{}: `{message}` is not in EVENTS.md",
                            path.display()
                        );
                    }
                }
            }
        }
        assert!(count > 20, "only {count} found");
        for fault in crate::messages::error::names((1 << 16) - 1) {
            assert!(listed.contains(&format!("| {fault} |")), "{fault}");
        }
    }

    #[test]
    fn starting_twice_is_harmless() {
        let config = LogConfig { level: "error".into(), ..Default::default() };
        assert_eq!(init(&config), Ok(()));
        assert_eq!(init(&config), Ok(()));
    }
}
