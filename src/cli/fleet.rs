//! `cairn fleet`: the robots of a Zenoh network, and how they are. Listens, and sends nothing.

use std::fmt::Write as _;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::fleet_plot::svg;
use super::zenoh_args::ZenohArgs;
use super::{CliError, exit_code, session};
use crate::atomic_file::write_atomically;
use crate::daemon::advice;
use crate::share::fleet::{Level, Listener, Listing, Presence, Row};

/// How soon a signal is noticed.
const NAP: Duration = Duration::from_millis(100);
/// How often it is looked for news; robots tell something once a second.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// The longest time to wait: a day.
const LONGEST_S: f64 = 86_400.0;

/// List the robots whose bridges are on a Zenoh network, again whenever something changes, until interrupted
#[derive(Debug, clap::Args)]
pub struct FleetArgs {
    /// One JSON object a listing and line
    #[arg(long)]
    pub json: bool,
    /// Listen for so long, print one listing and end; with exit code 69 if nobody is on the network
    #[arg(long, value_name = "SECONDS", value_parser = seconds)]
    pub timeout: Option<Duration>,
    /// Draw where the robots are whose maps are in the frame of the same dock, or the same map, again with every listing and once a second (SVG)
    #[arg(long, value_name = "OUT.svg")]
    pub plot: Option<PathBuf>,
    #[command(flatten)]
    pub zenoh: ZenohArgs,
}

fn seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse::<f64>().ok().filter(|seconds| *seconds > 0.0 && *seconds <= LONGEST_S);
    seconds.map(Duration::from_secs_f64).ok_or_else(|| format!("more than 0 s, and at most {LONGEST_S} s"))
}

pub fn run(args: &FleetArgs) -> Result<ExitCode, CliError> {
    session::check_outputs([&args.plot])?;
    let stop = session::stop_flag()?;
    let listener = Listener::open(args.zenoh.domain, args.zenoh.file().as_deref(), args.plot.is_some())?;
    let outcome = match args.timeout {
        Some(timeout) => once(&listener, args, timeout, &stop),
        None => follow(&listener, args, &stop),
    };
    listener.close();
    outcome.map(|()| ExitCode::SUCCESS)
}

/// Until then, or until it is told to stop.
fn wait(end: Instant, stop: &AtomicBool) {
    while !stop.load(Ordering::Relaxed) && Instant::now() < end {
        std::thread::sleep(NAP.min(end.saturating_duration_since(Instant::now())));
    }
}

fn draw(path: Option<&Path>, listing: &Listing) -> Result<(), CliError> {
    let Some(path) = path else { return Ok(()) };
    let drawn = write_atomically(path, |out| out.write_all(svg(&listing.robots).as_bytes()));
    drawn.map_err(|e| CliError::new(exit_code::CANNOT_CREATE, e.to_string()))
}

fn once(listener: &Listener, args: &FleetArgs, timeout: Duration, stop: &AtomicBool) -> Result<(), CliError> {
    wait(Instant::now() + timeout, stop);
    let listing = listener.listing();
    draw(args.plot.as_deref(), &listing)?;
    put(&mut std::io::stdout().lock(), &written(&listing, args.json)?)?;
    if listing.is_connected {
        return Ok(());
    }
    let message = format!("no Zenoh router at {} within {} s", listener.endpoints(), timeout.as_secs_f64());
    Err(CliError::new(exit_code::UNAVAILABLE, message))
}

fn follow(listener: &Listener, args: &FleetArgs, stop: &AtomicBool) -> Result<(), CliError> {
    let mut told: Option<Listing> = None;
    loop {
        wait(Instant::now() + LOOK_EVERY, stop);
        if stop.load(Ordering::Relaxed) {
            return Ok(());
        }
        let listing = listener.listing();
        draw(args.plot.as_deref(), &listing)?;
        let now = Some(listing.timeless());
        if told != now {
            told = now;
            if !put(&mut std::io::stdout().lock(), &written(&listing, args.json)?)? {
                return Ok(());
            }
        }
    }
}

/// Whether anybody reads it still.
fn put(out: &mut dyn Write, text: &str) -> Result<bool, CliError> {
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Ok(()) => Ok(true),
        Err(e) if e.kind() == ErrorKind::BrokenPipe => Ok(false),
        Err(e) => Err(CliError::new(exit_code::CANNOT_CREATE, format!("standard output: {e}"))),
    }
}

fn written(listing: &Listing, json: bool) -> Result<String, CliError> {
    if !json {
        return Ok(table(listing));
    }
    let text = serde_json::to_string(listing);
    text.map(|text| text + "\n").map_err(|e| CliError::new(exit_code::FAILURE, format!("cannot print as JSON: {e}")))
}

/// For a person: a line a robot, its faults with what to do below it, and what is wrong with the whole.
fn table(listing: &Listing) -> String {
    let mut text = format!("robots in domain {}: {}\n", listing.domain, listing.robots.len());
    let width = listing.robots.iter().map(|row| row.name.len()).max().unwrap_or(0);
    for row in &listing.robots {
        let (state, scale, health) = (state(row), scale(row), health(row));
        let heard = row.heard_s_ago.map_or("never heard".into(), |seconds| format!("heard {seconds:.0} s ago"));
        let was = row.last_state.as_ref().map(|state| format!(", was {state}")).unwrap_or_default();
        let name = &row.name;
        // Writing into a text cannot fail.
        let _ = writeln!(text, "  {name:<width$}  {state:<22}  {scale:<16}  {health:<8}  {heard}{was}");
        if let Some(frame) = &row.map_frame {
            let _ = writeln!(text, "      its map is in the frame {frame}");
        }
        for fault in &row.faults {
            let _ = writeln!(text, "      {fault}: {}", advice(fault));
        }
        if let Some(problem) = &row.problem {
            let _ = writeln!(text, "      {problem}");
        }
    }
    for notice in &listing.notices {
        let _ = writeln!(text, "  ! {notice}");
    }
    text + "\n"
}

fn state(row: &Row) -> &str {
    match row.presence {
        Presence::Here => row.state.as_deref().unwrap_or("not understood"),
        Presence::New => "has said nothing so far",
        Presence::Silent => "says nothing",
        Presence::Gone => "gone",
        Presence::Unseen => "not seen, no router",
    }
}

fn scale(row: &Row) -> &str {
    match row.scale.as_deref() {
        Some("METRIC") => "metres",
        Some("ESTIMATED") => "metres, estimated",
        Some("UNKNOWN") => "map units",
        Some(other) => other,
        None => "-",
    }
}

fn health(row: &Row) -> &'static str {
    match row.health {
        Some(Level::Ok) => "ok",
        Some(Level::Warning) => "warning",
        Some(Level::Error) => "error",
        Some(Level::Unknown) => "unknown",
        None => "-",
    }
}

#[cfg(test)]
pub mod tests {
    use super::*;

    pub fn row(name: &str, presence: Presence) -> Row {
        Row {
            name: name.into(),
            session: "ab".into(),
            presence,
            is_name_shared: false,
            state: None,
            scale: None,
            health: None,
            faults: Vec::new(),
            map_frame: None,
            place: None,
            trail: Vec::new(),
            last_state: None,
            heard_s_ago: None,
            problem: None,
        }
    }

    #[test]
    fn a_person_reads_how_each_robot_is_and_a_script_the_same() {
        let lost = Row {
            state: Some("LOST".into()),
            scale: Some("METRIC".into()),
            health: Some(Level::Error),
            faults: vec!["LOST".into()],
            heard_s_ago: Some(0.4),
            ..row("r1", Presence::Here)
        };
        let gone = Row { last_state: Some("TRACKING".into()), heard_s_ago: Some(12.0), ..row("r2", Presence::Gone) };
        let notices = vec!["something".to_owned()];
        let listing = Listing { domain: 3, has_router: true, is_connected: true, robots: vec![lost, gone], notices };
        let text = written(&listing, false).expect("text");
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[0], "robots in domain 3: 2");
        assert!(
            ["r1", "LOST", "metres", "error", "heard 0 s ago"].iter().all(|word| lines[1].contains(word)),
            "{text}"
        );
        assert_eq!(lines[2], format!("      LOST: {}", advice("LOST")));
        assert!(lines[3].contains("gone") && lines[3].ends_with("heard 12 s ago, was TRACKING"), "{text}");
        assert_eq!(lines[4], "  ! something");
        let json = written(&listing, true).expect("json");
        let value: serde_json::Value = serde_json::from_str(&json).expect("one object");
        assert_eq!((json.lines().count(), value["robots"][1]["presence"].as_str()), (1, Some("gone")));
        assert!(value["robots"][1]["state"].is_null());
    }

    #[test]
    fn a_time_to_listen_is_some_seconds() {
        assert_eq!(seconds("2.5"), Ok(Duration::from_millis(2500)));
        assert!(["0", "-1", "NaN", "inf", "1e9", "x"].iter().all(|text| seconds(text).is_err()));
    }
}
