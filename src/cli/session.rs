//! What `run`, `replay` and `demo` share: configuration, logs, signals, the wire, and how a run's end becomes an exit code.

use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use serde::Serialize;
use signal_hook::consts::{SIGINT, SIGTERM};

use super::{CliError, exit_code};
use crate::config::{self, Config, ConfigError};
use crate::daemon::{Desk, End, EndCause, Outlet, Status};
use crate::frame::{Clock, process_cpu_ns};
use crate::messages::Endpoint;
use crate::publish::{PublishError, Publisher};
use crate::telemetry::{self, LogFormat, Percentiles};

/// How a command that ends with a result tells it. The result is on stdout; on stderr are progress, on a terminal only, notes and the log.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct ResultArgs {
    /// Print the result as one JSON object
    #[arg(long)]
    pub json: bool,
    #[command(flatten)]
    pub quiet: QuietArgs,
}

/// `--quiet` alone, for commands whose result is files.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct QuietArgs {
    /// Nothing on stderr but errors: no progress (which only a terminal gets), no notes, no warnings
    #[arg(long, short)]
    pub quiet: bool,
}

/// Options of every command that runs the pipeline.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct SessionArgs {
    /// Configuration file [default: /etc/cairn/cairn.toml if it exists]
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// First part of the services' names
    #[arg(long, env = "CAIRN_PREFIX", value_name = "PREFIX")]
    pub prefix: Option<String>,
    /// Log level or directives, such as info or warn,cairn::daemon=debug [default: the configuration's; warn where the
    /// command ends with a result]
    #[arg(long, env = "CAIRN_LOG", value_name = "LEVEL")]
    pub log: Option<String>,
}

impl SessionArgs {
    /// The configuration with the command line's changes, and logging started as the daemon logs.
    pub fn open(&self) -> Result<Config, CliError> {
        let (config, origin) = self.read()?;
        Self::start_logging(config, &origin)
    }

    /// The same for a command that ends with a result: only warnings are logged unless more is asked for, as text wherever they go,
    /// because a person reads them.
    pub fn open_for_result(&self, quiet: QuietArgs) -> Result<Config, CliError> {
        let (mut config, origin) = self.read()?;
        if quiet.quiet {
            config.log.level = "error".into();
        } else if self.log.is_none() {
            config.log.level = "warn".into();
        }
        if config.log.format == LogFormat::Auto {
            config.log.format = LogFormat::Human;
        }
        Self::start_logging(config, &origin)
    }

    fn start_logging(config: Config, origin: &str) -> Result<Config, CliError> {
        telemetry::init(&config.log).map_err(|reason| CliError::new(exit_code::USAGE, format!("--log: {reason}")))?;
        tracing::info!(configuration = origin, prefix = config.prefix, version = env!("CARGO_PKG_VERSION"), "starting");
        Ok(config)
    }

    /// The configuration with the command line's changes, and where it came from.
    pub fn read(&self) -> Result<(Config, String), CliError> {
        let (mut config, origin) = config::find(self.config.as_deref()).map_err(|e| config_error(&e))?;
        if let Some(prefix) = &self.prefix {
            config.prefix.clone_from(prefix);
        }
        if let Some(level) = &self.log {
            config.log.level.clone_from(level);
        }
        config.validate().map_err(|e| CliError::new(exit_code::USAGE, format!("{}: {}", e.key, e.reason)))?;
        Ok((config, origin))
    }
}

/// A configuration that cannot be used.
pub fn config_error(error: &ConfigError) -> CliError {
    let code = match error {
        ConfigError::Read { .. } => exit_code::NO_INPUT,
        _ => exit_code::CONFIG,
    };
    CliError::new(code, error.to_string())
}

/// Set by SIGTERM and SIGINT; the second signal ends the process at once.
pub fn stop_flag() -> Result<Arc<AtomicBool>, CliError> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGTERM, SIGINT] {
        // In this order: the first signal finds the flag unset and sets it, the second finds it set.
        signal_hook::flag::register_conditional_shutdown(signal, 128 + signal, stop.clone())
            .and_then(|_| signal_hook::flag::register(signal, stop.clone()))
            .map_err(|e| CliError::new(exit_code::FAILURE, format!("cannot handle signals: {e}")))?;
    }
    Ok(stop)
}

/// The services of this run, one part for each thread that publishes.
pub fn open_wire(config: &Config, clock: Clock, size: Option<(u32, u32)>) -> Result<(Outlet, Desk), PublishError> {
    let endpoint = Endpoint::new(&config.prefix).and_then(Endpoint::with_environment)?;
    let publisher = Publisher::open(&endpoint, &config.publish.limits(size))?;
    let outlet = Outlet::new(publisher.poses, publisher.map, publisher.frames, &config.mount, clock)
        .with_graph(publisher.graph)
        .with_features(publisher.features)
        .with_obstacles(publisher.obstacles)
        .with_tags(publisher.tags)
        .with_encoded(publisher.encoded)
        .with_wheels(publisher.wheels);
    Ok((outlet, Desk { health: publisher.health, commands: publisher.commands }))
}

/// A wire that cannot be opened.
pub fn wire_error(error: &PublishError) -> CliError {
    let code = match error {
        PublishError::Endpoint(_) => exit_code::USAGE,
        _ => exit_code::UNAVAILABLE,
    };
    CliError::new(code, error.to_string())
}

/// What a run's end means to a script: nothing lost, or the first thing that was.
pub fn judge(end: &End) -> Result<(), CliError> {
    telemetry::report_suppressed(true);
    match &end.cause {
        EndCause::SourceEnded | EndCause::Stopped => {}
        EndCause::SourceFailed => {
            return Err(CliError::new(exit_code::DATA, "the source broke before its end; what was tracked is written"));
        }
        EndCause::Calibration(reason) => return Err(CliError::new(exit_code::CONFIG, reason.clone())),
        EndCause::Broken(reason) => return Err(CliError::new(exit_code::FAILURE, reason.clone())),
    }
    match end.written.failures.as_slice() {
        [] => Ok(()),
        failures => Err(CliError::new(exit_code::CANNOT_CREATE, failures.join("; "))),
    }
}

/// Fails before the work begins when an output's folder does not exist, or two outputs are one file.
pub fn check_outputs<'a>(outputs: impl IntoIterator<Item = &'a Option<PathBuf>>) -> Result<(), CliError> {
    let mut named: Vec<PathBuf> = Vec::new();
    for path in outputs.into_iter().flatten() {
        let folder = match path.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent,
            _ => Path::new("."),
        };
        if !folder.is_dir() {
            let message = format!("cannot write {}: there is no folder {}", path.display(), folder.display());
            return Err(CliError::new(exit_code::CANNOT_CREATE, message));
        }
        if path.is_dir() {
            return Err(CliError::new(
                exit_code::CANNOT_CREATE,
                format!("cannot write {}: is a folder", path.display()),
            ));
        }
        // Devices and pipes (`/dev/null`, `/dev/stdout`) may take several.
        let is_file = std::fs::metadata(path).map_or(true, |meta| meta.is_file());
        let folder = folder.canonicalize().unwrap_or_else(|_| folder.to_path_buf());
        let whole = path.canonicalize().unwrap_or_else(|_| folder.join(path.file_name().unwrap_or_default()));
        if is_file && named.contains(&whole) {
            let message = format!("cannot write {}: another output is the same file", path.display());
            return Err(CliError::new(exit_code::USAGE, message));
        }
        named.push(whole);
    }
    Ok(())
}

/// Writes to stdout. A reader that has gone (`| head`) wants no more and is no error.
pub fn print(text: &str) -> Result<(), CliError> {
    let mut out = io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() != io::ErrorKind::BrokenPipe => {
            Err(CliError::new(exit_code::CANNOT_CREATE, format!("cannot write to stdout: {e}")))
        }
        _ => Ok(()),
    }
}

/// A result as JSON, for stdout.
pub fn json(result: &impl Serialize) -> Result<String, CliError> {
    let text = serde_json::to_string_pretty(result)
        .map_err(|e| CliError::new(exit_code::FAILURE, format!("cannot print as JSON: {e}")))?;
    Ok(text + "\n")
}

/// What is said on stderr beside a result: progress, as one line on a terminal that is written over and over, and notes.
#[derive(Debug)]
pub struct StatusLine {
    quiet: bool,
    terminal: bool,
    shown: usize,
}

impl StatusLine {
    /// Shows no progress unless stderr is a terminal, and nothing at all where it is to be quiet.
    pub fn new(args: QuietArgs) -> Self {
        Self { quiet: args.quiet, terminal: io::stderr().is_terminal() && !args.quiet, shown: 0 }
    }

    /// A line that stays, on a terminal or not.
    pub fn note(&mut self, text: &str) {
        if !self.quiet {
            self.clear();
            telemetry::say(text);
        }
    }

    /// Replaces the line.
    pub fn show(&mut self, text: &str) {
        if self.terminal {
            let length = text.chars().count();
            // Blanks over what a longer line before left; a terminal that has gone is no fault of the run's.
            let _ = write!(io::stderr().lock(), "\r{text}{}", " ".repeat(self.shown.saturating_sub(length)));
            self.shown = length;
        }
    }

    /// Clears the line.
    pub fn clear(&mut self) {
        if self.shown > 0 {
            self.show("");
            let _ = write!(io::stderr().lock(), "\r");
            self.shown = 0;
        }
    }
}

/// Latencies of every stage over a whole run; none where the stage had nothing to do.
#[derive(Debug, Clone, Serialize)]
pub struct StageLatencies {
    pub decode: Option<Percentiles>,
    pub feature: Option<Percentiles>,
    pub queue: Option<Percentiles>,
    pub track: Option<Percentiles>,
    pub mapping: Option<Percentiles>,
    /// From arrival to the published pose; nothing in lock-step.
    pub latency: Option<Percentiles>,
}

impl StageLatencies {
    pub fn of(status: &Status) -> Self {
        let of = |h: &telemetry::Histogram| Some(h.snapshot().percentiles()).filter(|p| p.count > 0);
        Self {
            decode: of(&status.decode),
            feature: of(&status.feature),
            queue: of(&status.queue),
            track: of(&status.track),
            mapping: of(&status.mapping),
            latency: of(&status.latency),
        }
    }

    /// As a table, one line a stage.
    pub fn table(&self) -> String {
        let mut text = format!("  {:<10}{:>9}{:>9}{:>9}\n", "ms", "p50", "p95", "p99");
        let stages = [
            ("decode", self.decode),
            ("features", self.feature),
            ("queue", self.queue),
            ("track", self.track),
            ("mapping", self.mapping),
            ("end to end", self.latency),
        ];
        for (name, p) in stages.iter().filter_map(|(name, p)| p.map(|p| (name, p))) {
            text += &format!("  {name:<10}{:>9.2}{:>9.2}{:>9.2}\n", p.p50_ms, p.p95_ms, p.p99_ms);
        }
        text
    }
}

/// What the process used.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Resources {
    /// CPU time of all threads, ms a frame.
    pub cpu_ms_per_frame: f64,
    /// Largest resident memory of the process, MB; 0 where the system does not tell.
    pub peak_rss_mb: f64,
}

impl Resources {
    /// Of this process since it started; `cpu_before_ns`: CPU time that does not count.
    pub fn now(frames: u64, cpu_before_ns: i64) -> Self {
        let cpu_ms = (process_cpu_ns() - cpu_before_ns) as f64 * 1e-6;
        Self { cpu_ms_per_frame: cpu_ms / frames.max(1) as f64, peak_rss_mb: peak_rss_mb().unwrap_or(0.0) }
    }
}

/// VmHWM of /proc/self/status, MB.
fn peak_rss_mb() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kb: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kb / 1024.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::daemon::{FinalMap, Written};

    fn end(cause: EndCause, failures: &[&str]) -> End {
        let failures = failures.iter().map(ToString::to_string).collect();
        End { cause, map: FinalMap::default(), written: Written { failures, ..Written::default() } }
    }

    #[test]
    fn every_end_has_its_exit_code() {
        let code = |end: &End| judge(end).err().map(|e| e.code);
        assert_eq!(code(&end(EndCause::SourceEnded, &[])), None);
        assert_eq!(code(&end(EndCause::Stopped, &[])), None);
        assert_eq!(code(&end(EndCause::Stopped, &["disk full"])), Some(exit_code::CANNOT_CREATE));
        assert_eq!(code(&end(EndCause::SourceFailed, &[])), Some(exit_code::DATA));
        assert_eq!(code(&end(EndCause::Calibration("other size".into()), &[])), Some(exit_code::CONFIG));
        assert_eq!(code(&end(EndCause::Broken("panic".into()), &[])), Some(exit_code::FAILURE));
    }

    #[test]
    fn an_output_whose_folder_is_missing_is_refused_before_the_work() {
        let missing = Some(PathBuf::from("/nonexistent/folder/map.ply"));
        let error = check_outputs([&missing]).expect_err("refused");
        assert!(error.message.contains("/nonexistent/folder"), "{error}");
        assert!(check_outputs([&None, &Some("here.txt".into())]).is_ok());
        assert!(check_outputs([&Some("/tmp".into())]).is_err());
    }

    #[test]
    fn the_process_has_used_memory_and_time() {
        let used = Resources::now(1, 0);
        assert!(used.peak_rss_mb > 0.5, "{used:?}");
        assert!(used.cpu_ms_per_frame >= 0.0);
    }
}
