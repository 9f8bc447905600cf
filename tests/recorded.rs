//! Recorded sequences, lock-step, through the binary: coverage and error that must not be lost again, and the same bytes twice.
//! Skipped with a message where the recordings are not there (`CAIRN_DATA`).

#[path = "support/recordings.rs"]
mod recordings;

use std::path::Path;
use std::process::{Command, Stdio};

use recordings::recording;

fn cairn() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cairn"));
    command.env("CAIRN_PREFIX", format!("test-recorded-{}", std::process::id()));
    command.stdin(Stdio::null()).stderr(Stdio::null());
    command
}

/// Replays and evaluates: coverage in percent, ATE RMSE in m. The trajectory lies in `output`.
fn replay(recording: &Path, output: &Path) -> (f64, f64) {
    let trajectory = output.join("trajectory.txt");
    let status = cairn()
        .arg("replay")
        .arg(recording)
        .arg("--lockstep")
        .arg("--trajectory")
        .arg(&trajectory)
        .stdout(Stdio::null())
        .status();
    assert!(status.unwrap().success());
    let evaluated = cairn().arg("evaluate").arg(&trajectory).arg(recording).arg("--json").output().unwrap();
    assert!(evaluated.status.success());
    let figures: serde_json::Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    let coverage = figures["coverage_percent"].as_f64().unwrap();
    (coverage, figures["ate_m"]["rmse"].as_f64().unwrap())
}

#[test]
fn a_hand_held_kinect_is_tracked_to_a_centimetre() {
    let Some(recording) = recording("tum_fr1_xyz") else { return };
    let output = tempfile::tempdir().unwrap();
    let (coverage, error) = replay(&recording, output.path());
    assert!(coverage >= 99.5 && error <= 0.0095, "coverage {coverage} %, ATE {error} m");
}

#[test]
fn a_kitchen_with_guessed_intrinsics_is_tracked_throughout() {
    let Some(recording) = recording("7scenes_redkitchen") else { return };
    let output = tempfile::tempdir().unwrap();
    let (coverage, error) = replay(&recording, output.path());
    assert!(coverage >= 98.0 && error <= 0.09, "coverage {coverage} %, ATE {error} m");
}

#[test]
fn short_sequences_are_tracked_and_two_runs_write_the_same_bytes() {
    for (name, limit) in [("uzh_parking", 0.05), ("new_tsukuba", 0.0075)] {
        let Some(recording) = recording(name) else { return };
        let (a, b) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let (coverage, error) = replay(&recording, a.path());
        assert!(coverage >= 97.0 && error <= limit, "{name}: coverage {coverage} %, ATE {error} m");
        replay(&recording, b.path());
        let read = |dir: &tempfile::TempDir| std::fs::read(dir.path().join("trajectory.txt")).unwrap();
        assert_eq!(read(&a), read(&b), "{name}");
    }
}
