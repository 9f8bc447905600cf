use super::*;
use crate::evaluation::suite::{ReplaySummary, RunStatus, SuiteResult};
use crate::geometry::Se3;
use crate::trajectory::{TumPose, write_tum};
use clap::Parser;
use nalgebra::{UnitQuaternion, Vector3};
use std::fs;
use std::path::PathBuf;

#[derive(Parser)]
struct Line {
    #[command(flatten)]
    args: EvaluateArgs,
}

fn parse(words: &[&str]) -> Result<EvaluateArgs, clap::Error> {
    Line::try_parse_from(std::iter::once(&"evaluate").chain(words)).map(|l| l.args)
}

fn path_of(n: i64) -> Vec<TumPose> {
    let at = |i: i64| {
        let a = 0.1 * i as f64;
        let position = Vector3::new(a.cos(), 0.2 * (3.0 * a).sin(), 0.5 * a);
        TumPose { timestamp_ns: i * 50_000_000, world_from_camera: Se3::new(UnitQuaternion::identity(), position) }
    };
    (0..n).map(at).collect()
}

/// A sequence's folder without pictures.
fn sequence(parent: &Path, name: &str) -> PathBuf {
    let folder = parent.join(name);
    fs::create_dir(&folder).unwrap();
    let truth = path_of(60);
    write_tum(&folder.join("groundtruth.txt"), &truth).unwrap();
    let frames: String = (0..60).map(|i| format!("{:.6} rgb/{i}.png\n", 0.05 * i as f64)).collect();
    fs::write(folder.join("rgb.txt"), frames).unwrap();
    folder
}

#[test]
fn the_command_line_is_either_two_files_or_a_suite() {
    assert!(parse(&["a.txt", "b.txt", "--plot", "c.png", "--json"]).is_ok());
    let suite = parse(&["--suite", "x", "y", "--output", "o", "--", "--config", "c.toml"]).unwrap();
    assert_eq!(suite.suite, [PathBuf::from("x"), PathBuf::from("y")]);
    assert_eq!(suite.replay_options, ["--config", "c.toml"]);
    assert!(!suite.real_time && parse(&["--suite", "x", "--real-time"]).unwrap().real_time);
    let hard = parse(&["--simulator", "--first-seed", "101", "--seeds", "5"]).unwrap();
    assert_eq!((hard.first_seed, hard.seeds), (101, 5));
    let default = parse(&["--simulator"]).unwrap();
    assert_eq!((default.first_seed, default.seeds), (3, 1), "the room that the cases were developed with");
    for wrong in [
        &["a.txt"][..],
        &[],
        &["a.txt", "b.txt", "--suite", "x"],
        &["--suite"],
        &["--suite", "x", "--timeout", "0"],
        &["--simulator", "--real-time"],
        &["--suite", "x", "--first-seed", "5"],
    ] {
        assert!(parse(wrong).is_err(), "{wrong:?}");
    }
}

#[test]
fn one_trajectory_gets_figures_and_a_picture_beside_it() {
    let dir = tempfile::tempdir().unwrap();
    let folder = sequence(dir.path(), "a");
    let estimate = dir.path().join("run.txt");
    write_tum(&estimate, &path_of(60)[5..]).unwrap();
    let args = parse(&[estimate.to_str().unwrap(), folder.to_str().unwrap()]).unwrap();
    run(&args).unwrap();
    assert!(fs::read(dir.path().join("run.png")).unwrap().starts_with(b"\x89PNG"));
}

#[test]
fn wrong_input_has_a_message_and_a_code() {
    let dir = tempfile::tempdir().unwrap();
    let folder = sequence(dir.path(), "a");
    let file = |name: &str, text: &str| {
        let path = dir.path().join(name);
        fs::write(&path, text).unwrap();
        path.display().to_string()
    };
    let (empty, broken) = (file("empty.txt", ""), file("broken.txt", "0.0 1 2 3 0 0 0 1\n0.1 1 nan 3 0 0 0 1\n"));
    let other_time = file("other.txt", "99.0 1 2 3 0 0 0 1\n99.1 1 2 4 0 0 0 1\n99.2 1 3 3 0 0 0 1\n");
    let good = file("good.txt", "0.0 1 2 3 0 0 0 1\n0.05 1 2 4 0 0 0 1\n0.1 1 3 3 0 0 0 1\n");
    let folder = folder.display().to_string();
    let missing = dir.path().join("missing.txt").display().to_string();
    let unwritable = dir.path().join("no/such.png").display().to_string();
    for (words, code, text) in [
        (vec![&empty, &folder], exit_code::DATA, "empty.txt holds no poses"),
        (vec![&broken, &folder], exit_code::DATA, "broken.txt, line 2: ty is nan"),
        (vec![&missing, &folder], exit_code::NO_INPUT, "missing.txt"),
        (vec![&good, &missing], exit_code::NO_INPUT, "missing.txt"),
        (vec![&other_time, &folder], exit_code::FAILURE, "no pose of"),
    ] {
        let words: Vec<_> = words.into_iter().map(String::as_str).collect();
        let error = run(&parse(&words).unwrap()).unwrap_err();
        assert_eq!(error.code, code, "{error}");
        assert!(error.message.contains(text), "{error}");
    }
    let error = run(&parse(&[&good, &folder, "--plot", &unwritable]).unwrap()).unwrap_err();
    assert_eq!((error.code, error.message.contains("such.png")), (exit_code::CANNOT_CREATE, true), "{error}");
}

/// A replay made of shell: `$1` is the folder; copies its `fake.txt`, or does as its `fate` says.
const FAKE_REPLAY: &str = r#"
folder=$1; shift
while [ $# -gt 0 ]; do
  case $1 in
    --lockstep) lockstep=1; shift;;
    --trajectory) trajectory=$2; shift 2;;
    --live-trajectory) live=$2; shift 2;;
    --json) json=1; shift;;
    --prefix) prefix=$2; shift 2;;
    *) echo "unknown option $1"; exit 64;;
  esac
done
[ "$lockstep$json" = 11 ] && [ "$prefix" = robot ] || exit 64
case $(cat "$folder/fate" 2>/dev/null) in
  hangs) exec sleep 1000;;
  fails) echo "first line" >&2; echo "camera.yaml: fx is negative" >&2; exit 78;;
  nothing) echo '{"frames":60,"tracked":0}'; : > "$trajectory"; exit 1;;
esac
cp "$folder/fake.txt" "$trajectory"; cp "$folder/fake.txt" "$live"
echo '{"frames":60,"tracked":50,"resets":1,"unheard_of":[1],"stages":{"decode":{"count":0,"p50_ms":null},
  "feature":{"count":60,"p50_ms":0.75,"p95_ms":1.5,"p99_ms":3},"track":{"p50_ms":0.5,"p95_ms":1,"p99_ms":3}}}'
"#;

fn options(dir: &Path, seconds: u64) -> SuiteOptions {
    let script = dir.join("replay.sh");
    fs::write(&script, FAKE_REPLAY).unwrap();
    SuiteOptions {
        program: "/bin/sh".into(),
        leading_arguments: vec![script.into()],
        lockstep: true,
        more_arguments: vec!["--prefix".into(), "robot".into()],
        output: dir.join("out"),
        limit: Duration::from_secs(seconds),
        machine: "test machine".into(),
    }
}

#[test]
fn a_suite_has_a_row_for_every_sequence_whatever_becomes_of_it() {
    let dir = tempfile::tempdir().unwrap();
    let folders = ["good", "broken", "still"].map(|name| sequence(dir.path(), name));
    write_tum(&folders[0].join("fake.txt"), &path_of(60)[10..]).unwrap();
    fs::write(folders[1].join("fate"), "fails").unwrap();
    fs::write(folders[2].join("fate"), "nothing").unwrap();
    // Left over from an earlier run: must not be taken for this one's.
    fs::create_dir(dir.path().join("out")).unwrap();
    write_tum(&dir.path().join("out/still.txt"), &path_of(60)).unwrap();

    let mut lines = Vec::new();
    let result = suite::run_suite(&folders, &options(dir.path(), 60), |l| lines.push(l.to_string())).unwrap();
    let [good, broken, still] = &result.sequences[..] else { panic!("{result:?}") };
    assert_eq!(good.status, RunStatus::Tracked);
    let figures = good.evaluation.as_ref().unwrap();
    assert_eq!((figures.expected, figures.covered), (60, 50));
    assert!(figures.ate_m.unwrap().rmse < 1e-8 && good.live.is_some() && good.outcome.is_some());
    assert_eq!((good.replay.resets, good.replay.loops), (Some(1), None));
    assert!(good.peak_rss_mb.unwrap() > 0.0 && good.cpu_ms_per_frame.unwrap() >= 0.0);
    assert!(matches!(&broken.status, RunStatus::Failed(r) if r.contains("78") && r.contains("fx is negative")));
    assert_eq!(still.status, RunStatus::NoPose);
    assert_eq!(still.evaluation.as_ref().unwrap().coverage_percent, 0.0);
    assert!(!result.is_complete());
    assert_eq!(lines.len(), 6, "{lines:?}");

    let table = fs::read_to_string(dir.path().join("out/table.md")).unwrap();
    let rows: Vec<_> = table.lines().filter(|l| l.starts_with('|')).collect();
    assert_eq!(rows.len(), 5);
    assert!(rows.iter().all(|r| r.matches('|').count() == rows[0].matches('|').count()), "{table}");
    assert!(rows[2].starts_with("| good | 60 | 83.3 | 0.0000 | 83.3 |") && rows[2].contains("1.25 / 2.50"), "{table}");
    assert!(rows[3].starts_with("| broken (failed) |") && rows[4].starts_with("| still (no pose) |"), "{table}");
    assert!(table.contains("test machine") && table.contains("broken: failed: "), "{table}");
    let json: serde_json::Value =
        serde_json::from_slice(&fs::read(dir.path().join("out/results.json")).unwrap()).unwrap();
    assert_eq!(json["sequences"][0]["status"], "tracked");
    assert_eq!(json["sequences"][1]["status"], "failed");
}

/// The replay made of shell refuses what is not in lock-step.
#[test]
fn at_the_cameras_pace_replays_are_not_in_lock_step_and_the_table_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let folder = sequence(dir.path(), "a");
    write_tum(&folder.join("fake.txt"), &path_of(60)).unwrap();
    for lockstep in [true, false] {
        let options = SuiteOptions { lockstep, ..options(dir.path(), 60) };
        let result = suite::run_suite(std::slice::from_ref(&folder), &options, |_| ()).unwrap();
        assert_eq!(result.is_complete(), lockstep, "{result:?}");
        assert_eq!(suite::table(&result).contains("Lock-step"), lockstep);
        assert_eq!(suite::table(&result).contains("At the camera's pace"), !lockstep);
    }
}

#[test]
fn the_hard_cases_are_run_in_the_rooms_that_are_asked_for() {
    let dir = tempfile::tempdir().unwrap();
    let output = dir.path().to_str().unwrap();
    let words = ["--simulator", "--case", "standing", "--first-seed", "7", "--seeds", "2", "--output", output];
    run(&parse(&words).unwrap()).unwrap();
    let table = fs::read_to_string(dir.path().join("simulator.md")).unwrap();
    let seeds: Vec<_> = table.lines().skip(2).filter_map(|row| row.split(" | ").nth(1)).collect();
    assert_eq!(seeds, ["7", "8"], "{table}");
}

#[test]
fn a_replay_that_hangs_is_ended_and_reported() {
    let dir = tempfile::tempdir().unwrap();
    let folder = sequence(dir.path(), "a");
    fs::write(folder.join("fate"), "hangs").unwrap();
    let result = suite::run_suite(&[folder], &options(dir.path(), 0), |_| ()).unwrap();
    assert!(matches!(&result.sequences[0].status, RunStatus::Failed(r) if r.contains("did not end")), "{result:?}");
}

#[test]
fn what_is_wrong_with_a_suite_is_said_before_the_first_replay() {
    let dir = tempfile::tempdir().unwrap();
    let good = sequence(dir.path(), "good");
    let bad = dir.path().join("none");
    let mut lines = 0;
    let error = suite::run_suite(&[good.clone(), bad], &options(dir.path(), 9), |_| lines += 1).unwrap_err();
    assert!(error.to_string().contains("none: no such folder") && lines == 0, "{error}");
    fs::write(good.join("groundtruth.txt"), "0.0 1 2\n").unwrap();
    let error = suite::run_suite(&[good], &options(dir.path(), 9), |_| lines += 1).unwrap_err();
    assert!(error.to_string().contains("groundtruth.txt, line 1") && lines == 0, "{error}");
}

#[test]
fn two_folders_of_one_name_keep_their_results_apart() {
    let dir = tempfile::tempdir().unwrap();
    let folders = ["x", "y"].map(|parent| {
        fs::create_dir(dir.path().join(parent)).unwrap();
        let folder = sequence(&dir.path().join(parent), "rgbd");
        write_tum(&folder.join("fake.txt"), &path_of(60)).unwrap();
        folder
    });
    let result: SuiteResult = suite::run_suite(&folders, &options(dir.path(), 60), |_| ()).unwrap();
    assert_eq!(result.sequences.iter().map(|s| s.name.as_str()).collect::<Vec<_>>(), ["rgbd", "rgbd-2"]);
    assert!(dir.path().join("out/rgbd-2.txt").is_file() && result.is_complete());
}

#[test]
fn an_unknown_summary_is_no_summary() {
    assert_eq!(serde_json::from_str::<ReplaySummary>("{}").unwrap(), ReplaySummary::default());
    assert!(!suite::machine_name().is_empty());
}
