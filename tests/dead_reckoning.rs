//! Darkness in a drive, through the binary: the wheels carry the pose on, and vision takes up again. Judged by `--odometry` against the simulator's truth.

use std::path::Path;
use std::process::{Command, Stdio};

use cairn::geometry::Se3;
use cairn::geometry::frames::{Camera, World};
use cairn::trajectory::{TumPose, parse_timestamp, read_tum};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

/// Start and length of the darkness, s.
const DARK: (f64, f64) = (13.0, 3.0);

fn cairn() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cairn"));
    command.env("CAIRN_PREFIX", format!("test-dark-{}", std::process::id()));
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command
}

/// A frame of an `--odometry` file.
struct OdomFrame {
    timestamp_ns: i64,
    /// Which stretch of poses that are related, by the comments.
    part: usize,
    odom_from_camera: Option<Se3<World, Camera>>,
    state: String,
}

fn read_odometry(path: &Path) -> Vec<OdomFrame> {
    let (mut part, mut frames) = (0, Vec::new());
    for line in std::fs::read_to_string(path).unwrap().lines() {
        if line.starts_with('#') {
            part += usize::from(line.starts_with("# reset counter"));
            continue;
        }
        let fields: Vec<&str> = line.split(' ').collect();
        assert_eq!(fields.len(), 9, "{line}");
        let n: Vec<f64> = fields[1..8].iter().map(|f| f.parse().unwrap()).collect();
        let pose = n.iter().all(|v| v.is_finite()).then(|| {
            let rotation = UnitQuaternion::new_normalize(Quaternion::new(n[6], n[3], n[4], n[5]));
            Se3::new(rotation, Vector3::new(n[0], n[1], n[2]))
        });
        let timestamp_ns = parse_timestamp(fields[0]).unwrap();
        frames.push(OdomFrame { timestamp_ns, part, odom_from_camera: pose, state: fields[8].into() });
    }
    frames
}

fn truth_at(truth: &[TumPose], timestamp_ns: i64) -> Se3<World, Camera> {
    truth.iter().min_by_key(|p| (p.timestamp_ns - timestamp_ns).abs()).unwrap().world_from_camera
}

#[test]
fn three_seconds_of_darkness_in_a_drive_are_bridged_by_the_wheels() {
    let dir = tempfile::tempdir().unwrap();
    let (drive, odometry, trajectory) =
        (dir.path().join("drive"), dir.path().join("odom.txt"), dir.path().join("t.txt"));
    let dark = format!("{}:{}", DARK.0, DARK.1);
    let simulate =
        ["simulate", "--seed", "31", "--seconds", "18", "--size", "320x240", "--rate", "20", "--dark", &dark];
    assert!(cairn().args(simulate).arg("--output").arg(&drive).status().unwrap().success());
    let mut replay = cairn();
    replay
        .arg("replay")
        .arg(&drive)
        .args(["--lockstep", "--odometry"])
        .arg(&odometry)
        .arg("--trajectory")
        .arg(&trajectory);
    assert!(replay.status().unwrap().success());

    let truth = read_tum(&drive.join("groundtruth.txt")).unwrap();
    let frames = read_odometry(&odometry);
    let first_ns = frames[0].timestamp_ns;
    let seconds = |f: &OdomFrame| (f.timestamp_ns - first_ns) as f64 * 1e-9;
    let is_dark = |f: &OdomFrame| (DARK.0 - 1e-3..DARK.0 + DARK.1 - 1e-3).contains(&seconds(f));
    let begin = frames.iter().position(is_dark).unwrap();
    let end = frames.iter().rposition(is_dark).unwrap();
    for f in &frames[begin..=end] {
        assert_eq!(f.state, "DEAD_RECKONING", "at {:.2} s", seconds(f));
    }
    let again = frames[end + 1..].iter().position(|f| f.state == "TRACKING").expect("vision takes up again");
    assert!(again <= 15, "after {again} frames");
    assert!(frames[begin - 1..].iter().all(|f| f.part == frames[end].part), "odom is one, before and after");

    // How far off the wheels have carried it, as a share of the way in the dark.
    let pose = |i: usize| frames[i].odom_from_camera.expect("a pose");
    let there = |i: usize| truth_at(&truth, frames[i].timestamp_ns);
    let way: f64 = (begin..=end).map(|i| (there(i).translation - there(i - 1).translation).norm()).sum();
    let moved = pose(begin - 1).inverse() * pose(end);
    let driven = there(begin - 1).inverse() * there(end);
    let off = (moved.translation - driven.translation).norm() / way;
    assert!(way > 0.5 && off <= 0.05, "{:.1} % of {way:.2} m", 100.0 * off);
    for i in begin..frames.len() {
        if let (Some(a), Some(b)) = (frames[i - 1].odom_from_camera, frames[i].odom_from_camera) {
            let step = (a.translation - b.translation).norm();
            let true_step = (there(i).translation - there(i - 1).translation).norm();
            assert!((step - true_step).abs() < 0.03, "odom jumps by {step:.3} m at {:.2} s", seconds(&frames[i]));
        }
    }
    let in_the_dark = |p: &&TumPose| frames[begin..=end].iter().any(|f| f.timestamp_ns == p.timestamp_ns);
    let written = read_tum(&trajectory).unwrap();
    assert_eq!(written.iter().filter(in_the_dark).count(), 0, "no such pose is in a trajectory");

    // Wheels that fall silent in the dark carry nothing on.
    let file = drive.join("odometry.txt");
    let silent_s = first_ns as f64 * 1e-9 + DARK.0 + 1.0;
    let heard = std::fs::read_to_string(&file).unwrap();
    let until = |line: &&str| line.split(' ').next().and_then(|t| t.parse::<f64>().ok()).is_none_or(|t| t < silent_s);
    std::fs::write(&file, heard.lines().filter(until).collect::<Vec<_>>().join("\n")).unwrap();
    assert!(
        cairn().arg("replay").arg(&drive).args(["--lockstep", "--odometry"]).arg(&odometry).status().unwrap().success()
    );
    let frames = read_odometry(&odometry);
    let late = frames.iter().filter(|f| (DARK.0 + 1.3..DARK.0 + DARK.1 - 0.1).contains(&seconds(f)));
    let states: Vec<&str> = late.map(|f| f.state.as_str()).collect();
    assert!(states.len() > 20 && states.iter().all(|s| *s == "LOST"), "{states:?}");
}

#[test]
fn outputs_of_a_replay_are_refused_before_the_work() {
    let dir = tempfile::tempdir().unwrap();
    let same = dir.path().join("same.txt");
    let run = |arguments: &[&std::ffi::OsStr]| {
        let output = cairn().args(["replay", "nowhere"]).args(arguments).stderr(Stdio::piped()).output().unwrap();
        assert!(!output.status.success());
        String::from_utf8_lossy(&output.stderr).into_owned()
    };
    let twice = run(&["--odometry".as_ref(), same.as_os_str(), "--trajectory".as_ref(), same.as_os_str()]);
    assert!(twice.contains("another output is the same file"), "{twice}");
    let missing = dir.path().join("missing/odom.txt");
    let missing = run(&["--odometry".as_ref(), missing.as_os_str()]);
    assert!(missing.contains("there is no folder"), "{missing}");
    let folder = run(&["--odometry".as_ref(), dir.path().as_os_str()]);
    assert!(folder.contains("is a folder"), "{folder}");
}
