//! The service and the daemons that run: systemd's word about the unit, and other users' daemons.

use std::collections::HashMap;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use super::processes::Process;
use super::report::Report;
use crate::daemon::advice;
use crate::messages::{Endpoint, Health, error};

/// systemctl answers at once, or there is no systemd that could.
const PATIENCE: Duration = Duration::from_secs(3);
/// What is asked about the unit.
const PROPERTIES: &str = "LoadState,UnitFileState,ActiveState,SubState,Result,ExecMainStatus,NRestarts,StatusText";

/// What systemd says of `cairn.service`; `None` where it cannot be asked.
pub fn unit() -> Option<String> {
    let mut child = Command::new("systemctl")
        .args(["show", "cairn.service", "--property", PROPERTIES])
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .ok()?;
    let began = Instant::now();
    loop {
        match child.try_wait() {
            Ok(Some(status)) if status.success() => break,
            Ok(None) if began.elapsed() < PATIENCE => std::thread::sleep(Duration::from_millis(20)),
            _ => {
                // Our own child, and of no more use.
                let _ = child.kill();
                let _ = child.wait();
                return None;
            }
        }
    }
    // A few lines: they fit into the pipe, so the child did not wait for this.
    std::io::read_to_string(child.stdout.take()?).ok()
}

/// One line on the unit, and what to do.
pub fn judge_unit(report: &mut Report, text: Option<&str>) {
    let Some(text) = text else { return report.note("systemd cannot be asked here") };
    let properties: HashMap<&str, &str> = text.lines().filter_map(|line| line.split_once('=')).collect();
    let of = |key: &str| properties.get(key).copied().unwrap_or("");
    let restarts = of("NRestarts").parse::<u32>().unwrap_or(0);
    match (of("LoadState"), of("ActiveState"), of("SubState")) {
        ("not-found" | "", ..) => report.note("cairn.service is not installed"),
        ("masked", ..) => report.bad("cairn.service is masked", "`sudo systemctl unmask cairn`"),
        (_, "active" | "reloading", _) => {
            report.good(&format!("cairn.service runs: {}", of("StatusText")));
            if restarts > 0 {
                report.note(&format!("it was restarted {restarts} times: `journalctl -u cairn -p warning`"));
            }
            if of("UnitFileState") == "disabled" {
                report.note("it does not start at boot: `sudo systemctl enable cairn`");
            }
        }
        (_, "activating", "auto-restart" | "auto-restart-queued") => {
            let (why, next) = meaning(of("Result"), of("ExecMainStatus"));
            report.bad(&format!("cairn.service ends again and again ({restarts} restarts): {why}"), next);
        }
        (_, "activating", _) => report.note("cairn.service is starting"),
        (_, "failed", _) => {
            let (why, next) = meaning(of("Result"), of("ExecMainStatus"));
            report.bad(&format!("cairn.service has failed: {why}"), next);
        }
        (_, active, _) => {
            report.note(&format!("cairn.service is {active}"));
            report.next.push("start the service: `sudo systemctl start cairn` (`enable --now`: at every boot)".into());
        }
    }
}

/// What ended the service, and what to do: systemd's `Result` and the exit code.
fn meaning(result: &str, status: &str) -> (String, &'static str) {
    let text = |why: &str| why.to_owned();
    match (result, status) {
        ("exit-code", "78") => (
            text("its configuration or calibration is wrong (exit code 78)"),
            "`journalctl -u cairn -n 20` names file and key; then `sudo systemctl restart cairn`",
        ),
        ("exit-code", "69") => (
            text(
                "a service it needs is taken (exit code 69): another daemon has this prefix, or another user the files",
            ),
            "end the other daemon, or give one of them another prefix",
        ),
        ("exit-code", "73") => {
            (text("a file cannot be written (exit code 73)"), "look at [output] of the configuration")
        }
        ("exit-code", "203") => {
            (text("/usr/bin/cairn cannot be executed"), "install the package anew, for this architecture")
        }
        ("exit-code", "217") => (text("there is no user cairn"), "`sudo systemd-sysusers cairn.conf`"),
        ("exit-code", "226") => (
            text("a folder of its is missing, /tmp/iceoryx2 most likely"),
            "`sudo systemd-tmpfiles --create cairn.conf`",
        ),
        ("watchdog", _) => {
            (text("a stage hung and the watchdog ended it"), "`journalctl -u cairn FAULT=STALLED_STAGE`")
        }
        ("oom-kill", _) => {
            (text("the machine ran out of memory"), "lower reconstruction.max_keyframes, or end what else runs")
        }
        ("signal" | "core-dump", signal) => (
            format!("it was ended by signal {signal}{}", if signal == "7" { ": /dev/shm was full" } else { "" }),
            "`journalctl -u cairn -n 50`; `df /dev/shm`",
        ),
        ("timeout", _) => (text("it did not start or stop in time"), "`journalctl -u cairn -n 50`"),
        (result, status) => (format!("{result}, status {status}"), "`journalctl -u cairn -n 50`"),
    }
}

/// Daemons that run, and whether this user can hear them.
pub fn daemons(report: &mut Report, running: &[Process], us: Option<u32>, name_of: &dyn Fn(u32) -> String) {
    for daemon in running {
        let (pid, owner) = (daemon.pid, name_of(daemon.uid));
        if Some(daemon.uid) == us {
            report.good(&format!("a daemon of this user runs (pid {pid})"));
            continue;
        }
        report.note(&format!(
            "a daemon runs as user {owner} (pid {pid}); this user cannot hear it, only {owner} can: `sudo -u {owner} cairn watch`"
        ));
    }
}

/// What the daemon itself reports, if it can be heard within a second.
pub fn reported(report: &mut Report, endpoint: &Endpoint) -> bool {
    let Ok(client) = crate::client::Client::with_endpoint(endpoint.clone()) else { return false };
    let mut health = client.health();
    let heard = client.wait_for_daemon(Duration::ZERO).unwrap_or(false);
    let Some(health) = heard.then(|| health.wait(Duration::from_secs(1)).ok().flatten()).flatten() else {
        return false;
    };
    judge_health(report, &health);
    true
}

/// Faults that stand, with what to do.
pub fn judge_health(report: &mut Report, health: &Health) {
    let state = health.state().name();
    if health.errors == 0 {
        return report.good(&format!("the daemon reports {state} and no fault"));
    }
    // With these it works, if not as well as it could; or it is the view's fault and not the machine's.
    let passing = error::UNCALIBRATED
        | error::LOW_FEATURES
        | error::LOST
        | error::LOW_RATE
        | error::DROPPED_FRAMES
        | error::SCALE_ASSUMED
        | error::WHEELS_SILENT
        | error::WHEELS_LATE
        | error::MAPPING_LATE;
    for (faults, fails) in [(health.errors & !passing, true), (health.errors & passing, false)] {
        for fault in error::names(faults) {
            let line = format!("the daemon reports {fault} ({state})");
            if fails { report.bad(&line, advice(fault)) } else { report.warn(&line, advice(fault)) }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn judged(text: Option<&str>) -> (Report, String) {
        let mut report = Report::default();
        judge_unit(&mut report, text);
        let all = format!("{}\n{}", report.text, report.next.join("\n"));
        (report, all)
    }

    #[test]
    fn every_state_of_the_unit_is_told_and_only_faults_count() {
        let show = |load: &str, active: &str, sub: &str, result: &str, status: &str| {
            format!(
                "LoadState={load}\nActiveState={active}\nSubState={sub}\nResult={result}\nExecMainStatus={status}\n\
                 NRestarts=3\nUnitFileState=disabled\nStatusText=TRACKING, a = b\n"
            )
        };
        let cases = [
            (show("not-found", "inactive", "dead", "success", "0"), 0, "not installed"),
            (show("loaded", "active", "running", "success", "0"), 0, "TRACKING, a = b"),
            (show("loaded", "active", "running", "success", "0"), 0, "restarted 3 times"),
            (show("loaded", "inactive", "dead", "success", "0"), 0, "systemctl start cairn"),
            (show("loaded", "failed", "failed", "exit-code", "78"), 1, "configuration or calibration"),
            (show("loaded", "failed", "failed", "exit-code", "226"), 1, "systemd-tmpfiles --create"),
            (show("loaded", "activating", "auto-restart", "watchdog", "6"), 1, "STALLED_STAGE"),
            (show("loaded", "activating", "auto-restart", "signal", "7"), 1, "/dev/shm was full"),
            (show("loaded", "failed", "failed", "something-new", "1"), 1, "something-new"),
            (show("masked", "inactive", "dead", "success", "0"), 1, "unmask"),
        ];
        for (text, problems, part) in cases {
            let (report, all) = judged(Some(&text));
            assert_eq!(report.problems, problems, "{text}\n{all}");
            assert!(all.contains(part), "{part}: {all}");
        }
        assert_eq!(judged(None).0.problems, 0, "a machine without systemd is none with a fault");
    }

    #[test]
    fn a_daemon_of_another_user_is_named_with_the_way_to_hear_it() {
        let mut report = Report::default();
        let daemon = |pid, uid| Process { pid, uid, name: "cairn".into() };
        daemons(&mut report, &[daemon(7, 990), daemon(8, 1000)], Some(1000), &|uid| format!("u{uid}"));
        assert!(report.text.contains("user u990 (pid 7)") && report.text.contains("sudo -u u990"), "{}", report.text);
        assert!(report.text.contains("of this user runs (pid 8)"), "{}", report.text);
    }

    #[test]
    fn what_the_daemon_reports_comes_with_advice() {
        let mut report = Report::default();
        judge_health(&mut report, &Health { errors: error::NO_FRAMES | error::SAVE_FAILED, ..Health::default() });
        assert_eq!((report.problems, report.next.len()), (2, 2));
        assert!(report.text.contains("NO_FRAMES") && report.next[0].contains("plug it in anew"));
    }

    #[test]
    fn what_does_not_keep_it_from_working_is_a_warning_with_advice() {
        for fault in [error::UNCALIBRATED, error::LOW_FEATURES, error::LOST, error::LOW_RATE] {
            let mut report = Report::default();
            judge_health(&mut report, &Health { errors: fault, ..Health::default() });
            assert_eq!((report.problems, report.next.len()), (0, 1), "{}", report.text);
            assert!(report.text.contains("  warn  the daemon reports"), "{}", report.text);
        }
    }
}
