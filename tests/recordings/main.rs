//! `cairn record` and `cairn replay` of MCAP files, through the binary: nothing differs from a folder, nothing is lost by a signal, and what is cut
//! off, damaged or foreign is told.

mod ring;
mod wheels;

use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use cairn::ros::standard::{self, CompressedImage, Header, Time};
use cairn::ros::{Bytes, Message};
use cairn::trajectory::parse_timestamp;

fn cairn(prefix: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cairn"));
    command.env("CAIRN_PREFIX", format!("test-recordings-{prefix}-{}", std::process::id())).stdin(Stdio::null());
    command
}

/// A small simulated drive as a folder; its pictures with their times, ns.
fn folder(out: &Path) -> Vec<(i64, PathBuf)> {
    let simulated = cairn("simulate")
        .args(["simulate", "--scenario", "hand_held", "--seconds", "3", "--size", "320x240", "--output"])
        .arg(out)
        .output()
        .unwrap();
    assert!(simulated.status.success(), "{}", String::from_utf8_lossy(&simulated.stderr));
    let list = fs::read_to_string(out.join("rgb.txt")).unwrap();
    let lines = list.lines().filter(|line| !line.starts_with('#')).map(|line| line.split_once(' ').unwrap());
    lines.map(|(time, file)| (parse_timestamp(time).unwrap(), out.join(file.trim()))).collect()
}

/// The pictures as CompressedImages in an MCAP file, with chunks so small that there are many.
fn bag(out: &Path, pictures: &[(i64, PathBuf)]) {
    bag_with_wheels(out, pictures, &[]);
}

/// And a base's Odometry: times (ns), and forward, left, yaw (m/s, m/s, rad/s). Its pose is nonsense, as it is not to be used.
fn bag_with_wheels(out: &Path, pictures: &[(i64, PathBuf)], wheels: &[(i64, [f64; 3])]) {
    let options = mcap::WriteOptions::new().chunk_size(Some(100_000)).compression_threads(0);
    let mut writer = options.create(BufWriter::new(File::create(out).unwrap())).unwrap();
    let schema = mcap::Schema {
        id: 1,
        name: CompressedImage::NAME.into(),
        encoding: "ros2msg".into(),
        data: Cow::Owned(CompressedImage::schema().into_bytes()),
    };
    let channel = Arc::new(mcap::Channel {
        id: 1,
        topic: "/cam/image_raw/compressed".into(),
        schema: Some(Arc::new(schema)),
        message_encoding: "cdr".into(),
        metadata: BTreeMap::new(),
    });
    for (number, (time_ns, file)) in pictures.iter().enumerate() {
        let bytes = fs::read(file).unwrap();
        let header = Header { stamp: Time::from_ns(*time_ns), frame_id: "camera" };
        let message = CompressedImage { header, format: "png", data: Bytes(&bytes) };
        let time = 1_700_000_000_000_000_000 + *time_ns as u64;
        let (sequence, data) = (number as u32, Cow::Owned(message.to_cdr()));
        let channel = channel.clone();
        writer.write(&mcap::Message { channel, sequence, log_time: time, publish_time: time, data }).unwrap();
    }
    let schema = mcap::Schema {
        id: 2,
        name: standard::Odometry::NAME.into(),
        encoding: "ros2msg".into(),
        data: Cow::Owned(standard::Odometry::schema().into_bytes()),
    };
    let channel = Arc::new(mcap::Channel {
        id: 2,
        topic: "/base/odom".into(),
        schema: Some(Arc::new(schema)),
        message_encoding: "cdr".into(),
        metadata: BTreeMap::new(),
    });
    for (number, (time_ns, [x, y, yaw])) in wheels.iter().enumerate() {
        let vector = |x, y, z| standard::Vector3 { x, y, z };
        let nowhere = standard::Pose { position: [9.0; 3].into(), orientation: [0.0, 0.0, 0.0, 1.0].into() };
        let message = standard::Odometry {
            header: Header { stamp: Time::from_ns(*time_ns), frame_id: "odom" },
            child_frame_id: "base_link",
            pose: standard::PoseWithCovariance { pose: nowhere, covariance: [1.0; 36] },
            twist: standard::TwistWithCovariance {
                twist: standard::Twist { linear: vector(*x, *y, 0.0), angular: vector(0.0, 0.0, *yaw) },
                covariance: [0.0; 36],
            },
        };
        let time = 1_700_000_000_000_000_000 + *time_ns as u64;
        let (sequence, data) = (number as u32, Cow::Owned(message.to_cdr()));
        let channel = channel.clone();
        writer.write(&mcap::Message { channel, sequence, log_time: time, publish_time: time, data }).unwrap();
    }
    writer.finish().unwrap();
}

/// Trajectory, poses as published, and map of a lock-step replay, as they were written.
fn replay(recording: &Path, camera: &Path) -> [Vec<u8>; 3] {
    let out = tempfile::tempdir().unwrap();
    let file = |name: &str| out.path().join(name);
    let output = cairn("replay")
        .args(["replay", "--lockstep", "--quiet", "--camera"])
        .arg(camera)
        .args(["--trajectory".as_ref(), file("t").as_os_str(), "--live-trajectory".as_ref(), file("l").as_os_str()])
        .args(["--map".as_ref(), file("m").as_os_str(), recording.as_os_str()])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}: {}", recording.display(), String::from_utf8_lossy(&output.stderr));
    ["t", "l", "m"].map(|name| fs::read(file(name)).unwrap())
}

#[test]
fn pictures_in_a_file_are_replayed_to_the_same_bytes_as_in_a_folder() {
    let dir = tempfile::tempdir().unwrap();
    let pictures = folder(&dir.path().join("folder"));
    let camera = dir.path().join("folder/camera.yaml");
    let want = replay(&dir.path().join("folder"), &camera);
    assert!(want[0].iter().filter(|byte| **byte == b'\n').count() > 30, "too little is tracked to compare");

    let file = dir.path().join("one.mcap");
    bag(&file, &pictures);
    assert!(replay(&file, &camera) == want, "a file differs from the folder");

    // As rosbag2 splits: a folder of files, of which the tenth comes after the second.
    let split = dir.path().join("split");
    fs::create_dir(&split).unwrap();
    let (a, rest) = pictures.split_at(30);
    let (b, c) = rest.split_at(30);
    for (number, part) in [(0, a), (2, b), (10, c)] {
        bag(&split.join(format!("split_{number}.mcap")), part);
    }
    assert!(replay(&split, &camera) == want, "a folder of files differs");

    // A killed recorder's file: no summary, and the last chunk is half there. What is before the cut equals the same pictures.
    let whole = fs::read(&file).unwrap();
    let cut = dir.path().join("cut.mcap");
    fs::write(&cut, &whole[..whole.len() * 3 / 4]).unwrap();
    let got = String::from_utf8(replay(&cut, &camera)[1].clone()).unwrap();
    let full = String::from_utf8(want[1].clone()).unwrap();
    let lines = got.lines().count();
    assert!(lines > 20 && lines < full.lines().count(), "{lines} poses before the cut");
    assert!(full.starts_with(&got), "poses before the cut differ");
}

/// Exit code and message of a command that must fail.
fn fails(arguments: &[&str], code: i32, words: &[&str]) {
    let Output { status, stderr, .. } = cairn("fails").args(arguments).output().unwrap();
    let message = String::from_utf8_lossy(&stderr);
    assert_eq!(status.code(), Some(code), "{arguments:?}: {message}");
    for word in words {
        assert!(message.contains(word), "{arguments:?} does not say {word}: {message}");
    }
}

#[test]
fn what_is_no_recording_is_told_by_file_and_reason() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    fs::write(path("text.mcap"), "not at all").unwrap();
    fails(&["replay", &path("text.mcap")], 66, &["text.mcap", "no MCAP file"]);
    fs::write(path("empty.mcap"), "").unwrap();
    fails(&["replay", &path("empty.mcap")], 66, &["empty.mcap", "no MCAP file"]);
    bag(Path::new(&path("none.mcap")), &[]);
    fails(&["replay", &path("none.mcap")], 66, &["none.mcap", "no pictures"]);
    fails(&["replay", &path("gone.mcap")], 66, &["gone.mcap"]);
    fails(&["record", &path("out.bag")], 64, &["out.bag", ".mcap"]);
    fails(&["record", &path("none.mcap"), "--seconds", "1"], 73, &["none.mcap", "exists"]);
    fails(&["record", "/no/such/folder/out.mcap"], 73, &["/no/such/folder"]);
    fails(&["record", &path("a.mcap"), "--ring", "5", "--max-size", "5"], 64, &["--ring"]);
}

#[test]
fn no_damage_makes_it_panic() {
    let dir = tempfile::tempdir().unwrap();
    let pictures = folder(&dir.path().join("folder"));
    let file = dir.path().join("whole.mcap");
    bag(&file, &pictures[..6]);
    let whole = fs::read(&file).unwrap();
    let broken = dir.path().join("broken.mcap");
    // In this process, through the source itself: hundreds of damages at a millisecond each.
    let mut state = 7_u64;
    let mut random = move |below: usize| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as usize % below
    };
    let mut frames = 0;
    for round in 0..400 {
        let mut bytes = whole.clone();
        if round % 4 == 0 {
            bytes.truncate(random(whole.len()));
        }
        for _ in 0..1 + round % 5 {
            // The beginning and the end hold the structure; lengths are broken there.
            let (end, at) = (bytes.len(), random(bytes.len().max(1)));
            let at = [at, at % 400, end.saturating_sub(1 + at % 900)][round % 3];
            if let Some(byte) = bytes.get_mut(at) {
                *byte = random(256) as u8;
            }
        }
        fs::write(&broken, &bytes).unwrap();
        frames += grab_all(&broken);
    }
    assert!(frames > 400, "only {frames} frames came of files with a single wrong byte");
}

fn grab_all(file: &Path) -> usize {
    use cairn::camera::recording::OwnCalibration;
    use cairn::camera::{Asked, Bag, FrameSource, Grab, Pacing};
    let Ok(mut bag) = Bag::open(file, Pacing::LockStep, OwnCalibration::Read, Asked::default()) else { return 0 };
    let mut slot = cairn::frame::RawFrame::default();
    let mut frames = 0;
    for _ in 0..100 {
        match bag.grab(&mut slot, Duration::ZERO) {
            Ok(Grab::Frame) => frames += 1,
            Ok(Grab::End) | Err(_) => return frames,
            Ok(_) => {}
        }
    }
    panic!("no end after 100 of 6 messages");
}

/// A process that is ended when dropped.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Running {
    fn signal(&self, name: &str) {
        assert!(Command::new("kill").args([name, &self.0.id().to_string()]).status().unwrap().success());
    }

    fn ends(&mut self) -> Option<i32> {
        let begin = Instant::now();
        while begin.elapsed() < Duration::from_secs(30) {
            if let Some(status) = self.0.try_wait().unwrap() {
                return status.code();
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        panic!("still running after 30 s");
    }
}

const SIMULATOR: &str = "[daemon]\nsource = \"simulator\"\n[simulator]\nwidth = 320\nheight = 240\ntexel_mm = 5.0\n";

fn daemon(prefix: &str, config: &Path) -> Running {
    Running(cairn(prefix).args(["run", "--config"]).arg(config).stderr(Stdio::null()).spawn().unwrap())
}

fn recorder(prefix: &str, out: &Path, more: &[&str]) -> Running {
    let mut command = cairn(prefix);
    command.arg("record").arg(out).args(more).stdout(Stdio::null()).stderr(Stdio::null());
    Running(command.spawn().unwrap())
}

/// Waits until a file is at least so long.
fn grown(path: &Path, bytes: u64) {
    let begin = Instant::now();
    while fs::metadata(path).map_or(0, |m| m.len()) < bytes {
        assert!(begin.elapsed() < Duration::from_secs(60), "{} does not grow", path.display());
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Messages by topic, below the prefix; every one is looked at.
fn counts(path: &Path) -> BTreeMap<String, usize> {
    let bytes = fs::read(path).unwrap();
    let mut counts = BTreeMap::new();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let name = message.channel.topic.clone();
        let short = if name.matches('/').count() > 1 { name.splitn(3, '/').nth(2).unwrap().to_owned() } else { name };
        *counts.entry(short).or_default() += 1;
    }
    counts
}

#[test]
fn either_signal_closes_the_file_and_a_killed_recorder_leaves_its_chunks() {
    let dir = tempfile::tempdir().unwrap();
    let config = dir.path().join("cairn.toml");
    fs::write(&config, SIMULATOR).unwrap();
    let file = |name: &str| dir.path().join(name);
    // First the recorder, then the daemon: the order does not matter.
    let mut recorders = [recorder("signals", &file("int.mcap"), &[]), recorder("signals", &file("killed.mcap"), &[])];
    let mut running = daemon("signals", &config);
    grown(&file("int.mcap"), 1 << 20);
    grown(&file("killed.mcap"), 1 << 20);
    recorders[1].signal("-KILL");
    recorders[1].ends();
    // The daemon is killed and another one comes: the recording goes on with it.
    running.0.kill().unwrap();
    running.0.wait().unwrap();
    let length = fs::metadata(file("int.mcap")).unwrap().len();
    let running = daemon("signals", &config);
    grown(&file("int.mcap"), length + (1 << 20));
    recorders[0].signal("-INT");
    assert_eq!(recorders[0].ends(), Some(0));
    let mut by_term = recorder("signals", &file("term.mcap"), &[]);
    grown(&file("term.mcap"), 1 << 20);
    by_term.signal("-TERM");
    assert_eq!(by_term.ends(), Some(0));
    drop(running);

    for name in ["int.mcap", "term.mcap"] {
        let bytes = fs::read(file(name)).unwrap();
        let summary = mcap::Summary::read(&bytes).unwrap().expect("a summary");
        assert!(summary.chunk_indexes.len() > 1 && summary.stats.is_some(), "{name}");
        let counts = counts(&file(name));
        let want = "camera_info image/compressed image/header pose health /diagnostics map points graph tags";
        for topic in want.split(' ') {
            assert!(counts.get(topic).is_some_and(|n| *n > 0), "{name}: no {topic}: {counts:?}");
        }
        assert_eq!(counts["image/compressed"], counts["image/header"]);
        assert_eq!(counts["map"], counts["points"]);
    }
    // Two daemons are in the one that went on.
    let runs: BTreeSet<Vec<u8>> = mcap::MessageStream::new(&fs::read(file("int.mcap")).unwrap())
        .unwrap()
        .map(|message| message.unwrap())
        .filter(|message| message.channel.topic.ends_with("/pose"))
        .map(|message| message.data[4..12].to_vec())
        .collect();
    assert_eq!(runs.len(), 2, "runs of the daemon");
    // The killed one has no end, and is replayed nevertheless.
    let bytes = fs::read(file("killed.mcap")).unwrap();
    assert!(mcap::Summary::read(&bytes).is_err());
    let replayed = cairn("signals").args(["replay", "--lockstep", "--json"]).arg(file("killed.mcap")).output().unwrap();
    let told: serde_json::Value = serde_json::from_slice(&replayed.stdout).unwrap_or_default();
    assert!(told["frames"].as_u64().is_some_and(|frames| frames > 5), "{}", String::from_utf8_lossy(&replayed.stderr));
}

#[test]
fn a_recording_ends_at_its_limits_and_a_ring_is_kept_when_asked_for() {
    let dir = tempfile::tempdir().unwrap();
    let config = dir.path().join("cairn.toml");
    fs::write(&config, SIMULATOR).unwrap();
    let _daemon = daemon("limits", &config);
    let file = |name: &str| dir.path().join(name);
    let mut ring = recorder("limits", &file("ring.mcap"), &["--ring", "1"]);
    let recorded =
        cairn("limits").arg("record").arg(file("size.mcap")).args(["--max-size", "1", "--json"]).output().unwrap();
    let told: serde_json::Value = serde_json::from_slice(&recorded.stdout).unwrap();
    assert_eq!(told["ended"], "max_size", "{told}");
    let length = fs::metadata(file("size.mcap")).unwrap().len();
    assert!((1 << 20..8 << 20).contains(&length), "{length} bytes");
    let recorded =
        cairn("limits").arg("record").arg(file("time.mcap")).args(["--seconds", "1", "--json"]).output().unwrap();
    let told: serde_json::Value = serde_json::from_slice(&recorded.stdout).unwrap();
    assert_eq!(told["ended"], "seconds", "{told}");
    assert!(told["pictures"].as_u64().is_some_and(|n| n > 0), "{told}");
    ring.signal("-USR1");
    ring.signal("-TERM");
    assert_eq!(ring.ends(), Some(0));
    let names = fs::read_dir(dir.path()).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let kept: Vec<String> = names.filter(|name| name.starts_with("ring")).collect();
    assert_eq!(kept.len(), 1, "{kept:?}: the ring itself is gone");
    assert!(kept[0].ends_with("Z-KEPT.mcap") || kept[0].ends_with("Z-STOPPED.mcap"), "{kept:?}");
    assert!(counts(&file(&kept[0]))["image/compressed"] > 0);
}

/// What a driver on the wire tells is in the recording, and its replay believes every reading of it.
#[test]
fn the_layout_for_foxglove_shows_topics_that_are_recorded() {
    let layout: serde_json::Value = serde_json::from_str(
        &fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/config/foxglove.json")).unwrap(),
    )
    .unwrap();
    let recorded: BTreeSet<String> = cairn::share::Topic::ALL.iter().map(|topic| topic.name("cairn")).collect();
    let text = layout.to_string();
    let shown: BTreeSet<&str> =
        text.split('"').filter(|word| word.starts_with('/')).map(|word| word.split('.').next().unwrap()).collect();
    assert!(shown.len() >= 5, "{shown:?}");
    for topic in shown {
        assert!(recorded.contains(topic), "{topic} is not among {recorded:?}");
    }
}
