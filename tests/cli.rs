//! The binary as a user meets it: exit codes, messages, signals, two daemons.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

fn cairn(prefix: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cairn"));
    command.env("CAIRN_PREFIX", format!("test-cli-{prefix}-{}", std::process::id())).stdin(Stdio::null());
    command
}

fn fails(prefix: &str, arguments: &[&str], code: i32, words: &[&str]) {
    let Output { status, stderr, .. } = cairn(prefix).args(arguments).output().unwrap();
    let message = String::from_utf8_lossy(&stderr);
    assert_eq!(status.code(), Some(code), "{arguments:?}: {message}");
    for word in words {
        assert!(message.contains(word), "{arguments:?} does not say {word}: {message}");
    }
}

fn path(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// A daemon on the simulator, ended when dropped.
struct Daemon(Child);

impl Daemon {
    fn start(prefix: &str, config: &Path) -> Self {
        Self(cairn(prefix).args(["run", "--config", path(config)]).stderr(Stdio::null()).spawn().unwrap())
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

const SIMULATOR: &str = "[daemon]\nsource = \"simulator\"\n[simulator]\nwidth = 320\nheight = 240\ntexel_mm = 5.0\n";

/// `count` lines that `watch --json` receives.
fn watch(prefix: &str, count: &str) -> Vec<String> {
    let mut child = cairn(prefix)
        .args(["watch", "--json", "--timeout", "60", "--count", count])
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let lines = BufReader::new(child.stdout.take().unwrap()).lines().map(|l| l.unwrap()).collect();
    assert!(child.wait().unwrap().success());
    lines
}

#[test]
fn wrong_configurations_are_refused_by_file_line_and_key() {
    let dir = tempfile::tempdir().unwrap();
    for (text, words) in [
        ("[daemon]\nsorce = \"camera\"\n", ["typo.toml:2", "sorce"]),
        ("[features]\ncell_px = 3\n", ["typo.toml:2", "cell_px"]),
        ("[reconstruction]\nsigma_px = \"wide\"\n", ["typo.toml:2", "sigma_px"]),
    ] {
        let file = dir.path().join("typo.toml");
        std::fs::write(&file, text).unwrap();
        fails("config", &["run", "--config", path(&file)], 78, &words);
    }
}

#[test]
fn inputs_that_are_not_there_are_named() {
    let dir = tempfile::tempdir().unwrap();
    fails("input", &["replay", "/no/such/recording"], 66, &["/no/such/recording"]);
    fails("input", &["replay", path(dir.path())], 66, &["empty"]);
    fails("input", &["evaluate", "/no/such/estimate", path(dir.path())], 66, &["/no/such/"]);
    fails("input", &["run", "--config", "/no/such/config.toml"], 66, &["/no/such/config.toml"]);
    fails("input", &["no-such-command"], 64, &["no-such-command"]);
}

#[test]
fn a_demo_run_by_a_script_tells_its_result_and_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let config = dir.path().join("cairn.toml");
    std::fs::write(&config, SIMULATOR).unwrap();
    let folder = dir.path().join("demo");
    let demo = ["demo", "--seconds", "4", "--config", path(&config), "--output", path(&folder)];
    let Output { stdout, stderr, .. } = cairn("demo").args(demo).output().unwrap();
    let (stdout, stderr) = (String::from_utf8_lossy(&stdout), String::from_utf8_lossy(&stderr));
    assert!(stdout.contains("poses published") && stdout.contains("summary.json"), "{stdout}");
    // A slow machine may have warnings, as text; progress is for terminals.
    let told = stderr.contains('\r') || stderr.contains("INFO") || stderr.lines().any(|line| line.starts_with('{'));
    assert!(!told, "{stderr}");

    let Output { stdout, stderr, status } = cairn("demo").args(demo).args(["--json", "--quiet"]).output().unwrap();
    let summary: serde_json::Value = serde_json::from_slice(&stdout).unwrap();
    assert!(summary["frames"].as_u64().unwrap() > 0, "{summary}");
    assert_eq!(summary["files"].as_array().unwrap().len(), 6, "{summary}");
    assert_eq!(std::fs::read(folder.join("summary.json")).unwrap(), stdout);
    assert!(!status.success() || stderr.is_empty(), "{}", String::from_utf8_lossy(&stderr));
}

#[test]
fn a_second_daemon_is_refused_a_watcher_receives_and_sigterm_ends_within_a_second() {
    let dir = tempfile::tempdir().unwrap();
    let config = dir.path().join("cairn.toml");
    std::fs::write(&config, SIMULATOR).unwrap();
    let mut daemon = Daemon::start("two", &config);
    for line in watch("two", "10") {
        assert!(line.starts_with('{') && line.contains("\"sequence\":") && line.ends_with('}'), "{line}");
    }
    fails("two", &["run", "--config", path(&config)], 69, &["test-cli-two"]);

    let begin = Instant::now();
    let pid = daemon.0.id().to_string();
    assert!(Command::new("kill").args(["-TERM", &pid]).status().unwrap().success());
    let status = loop {
        match daemon.0.try_wait().unwrap() {
            Some(status) => break status,
            None if begin.elapsed() > Duration::from_secs(10) => panic!("still running 10 s after SIGTERM"),
            None => std::thread::sleep(Duration::from_millis(5)),
        }
    };
    assert_eq!(status.code(), Some(0));
    assert!(begin.elapsed() < Duration::from_secs(1), "{:?}", begin.elapsed());
}
