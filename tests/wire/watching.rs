//! `cairn watch` as a process of its own.

use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Stdio};

use cairn::cli::watch::{WatchArgs, run};
use clap::Parser;
use serde_json::Value;

use crate::support::{Place, Role, until};

const ARGUMENTS: &str = "CAIRN_TEST_WATCH";

#[derive(clap::Parser)]
struct Arguments {
    #[command(flatten)]
    watch: WatchArgs,
}

/// What the helper process runs.
pub fn watch() {
    let arguments = std::env::var(ARGUMENTS).unwrap_or_default();
    let arguments = Arguments::parse_from(std::iter::once("watch").chain(arguments.split_whitespace()));
    let code = match run(&arguments.watch) {
        Ok(_) => 0,
        Err(error) => {
            eprintln!("{error}");
            i32::from(error.code)
        }
    };
    std::process::exit(code);
}

/// A running `cairn watch`, killed when dropped.
struct Watch {
    child: Child,
    /// `None` once closed.
    out: Option<BufReader<std::process::ChildStdout>>,
    errors: BufReader<std::process::ChildStderr>,
}

impl Watch {
    fn start(place: &Place, arguments: &str) -> Self {
        let mut command = place.command(Role::Watch);
        command.env(ARGUMENTS, arguments).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().expect("watch");
        let mut out = BufReader::new(child.stdout.take().expect("stdout"));
        // The test harness says that it runs one test, after an empty line.
        let mut line = String::new();
        while !line.starts_with("running") {
            line.clear();
            assert_ne!(out.read_line(&mut line).expect("stdout"), 0, "ended early");
        }
        let errors = BufReader::new(child.stderr.take().expect("stderr"));
        Self { child, out: Some(out), errors }
    }

    /// The next line of stdout as JSON; `None` at the end.
    fn line(&mut self) -> Option<Value> {
        let mut line = String::new();
        let read = self.out.as_mut()?.read_line(&mut line).expect("stdout");
        (read > 0).then(|| serde_json::from_str(&line).unwrap_or_else(|e| panic!("{e}: {line:?}")))
    }

    /// Waits for a line on stderr.
    fn says(&mut self, what: &str) {
        let line = &mut String::new();
        self.errors.read_line(line).expect("stderr");
        assert!(line.contains(what), "{line}");
    }

    /// Waits for the end: exit code and what is left of stderr.
    fn end(mut self) -> (Option<i32>, String) {
        let mut code = None;
        until("watch has ended", || {
            code = self.child.try_wait().expect("wait");
            code.is_some()
        });
        let mut errors = String::new();
        self.errors.read_to_string(&mut errors).expect("stderr");
        (code.and_then(|code| code.code()), errors)
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn started_first_it_waits_and_then_prints_nothing_but_json() {
    let place = Place::new();
    let mut watch = Watch::start(&place, "--json --count 30 --timeout 10");
    watch.says("waiting for a daemon");
    let _daemon = place.spawn(Role::Publisher);
    let poses: Vec<Value> = std::iter::from_fn(|| watch.line()).collect();
    assert_eq!(poses.len(), 30);
    let sequences: Vec<u64> = poses.iter().filter_map(|p| p["sequence"].as_u64()).collect();
    let first = sequences[0];
    assert_eq!(sequences, (first..first + 30).collect::<Vec<_>>(), "none is lost");
    assert!(poses.iter().all(|p| p["state"] == "TRACKING" && p["latency_arrival_ns"].is_i64()));
    let (code, errors) = watch.end();
    assert_eq!(code, Some(0), "{errors}");
    assert!(errors.contains("connected"), "{errors}");
}

#[test]
fn it_survives_the_daemon() {
    let place = Place::new();
    let mut watch = Watch::start(&place, "--json");
    let mut runs = Vec::new();
    for _ in 0..2 {
        let daemon = place.spawn(Role::Publisher);
        let run = loop {
            let run = watch.line().expect("a pose")["run_id"].as_u64().expect("run");
            if !runs.contains(&run) {
                break run;
            }
        };
        runs.push(run);
        daemon.kill();
    }
}

#[test]
fn health_and_map_are_lines_too() {
    let place = Place::new();
    let _daemon = place.spawn(Role::Publisher);
    let health = Watch::start(&place, "--json --health --count 1 --timeout 10").line().expect("health");
    assert_eq!(health["version"], env!("CARGO_PKG_VERSION"));
    assert_eq!(health["errors"], serde_json::json!([]));
    let map = Watch::start(&place, "--json --map --count 1 --timeout 10").line().expect("map");
    assert_eq!((map["count"].as_u64(), map["total"].as_u64()), (Some(50), Some(50)));
}

#[test]
fn signals_and_broken_pipes_end_it_well() {
    let place = Place::new();
    for signal in ["-INT", "-TERM"] {
        let mut watch = Watch::start(&place, "--json");
        // From then on it listens to signals.
        watch.says("waiting for a daemon");
        let status = std::process::Command::new("kill").args([signal, &watch.child.id().to_string()]).status();
        assert!(status.expect("kill").success());
        assert_eq!(watch.end().0, Some(0), "{signal}");
    }
    let _daemon = place.spawn(Role::Publisher);
    let mut watch = Watch::start(&place, "--json");
    assert!(watch.line().is_some());
    watch.out = None;
    assert_eq!(watch.end().0, Some(0), "broken pipe");
}

#[test]
fn it_gives_up_when_told_to() {
    let place = Place::new();
    let (code, errors) = Watch::start(&place, "--timeout 0.3").end();
    assert_eq!(code, Some(69));
    assert!(errors.contains("robot/pose") && errors.contains("0.3 s"), "{errors}");
}
