//! Maps on disk, through the binary: written while it runs, whole after `kill -9`, the same bytes twice, and good to be located in.
//! `CAIRN_BINARY` names another build of the program.

#[path = "support/recordings.rs"]
mod recordings;

use std::ffi::OsString;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use recordings::recording;
use serde_json::Value;

fn cairn() -> Command {
    let binary = std::env::var_os("CAIRN_BINARY").unwrap_or_else(|| OsString::from(env!("CARGO_BIN_EXE_cairn")));
    let mut command = Command::new(binary);
    command.env("CAIRN_PREFIX", format!("test-maps-{}", std::process::id()));
    command.stdin(Stdio::null()).stderr(Stdio::null()).stdout(Stdio::null());
    command
}

/// A hand-held camera at a desk, 8 s at 30 Hz, as a recording.
fn simulated(folder: &Path) -> PathBuf {
    let recording = folder.join("recording");
    let size = ["--scenario", "hand_held", "--size", "320x240", "--seconds", "8"];
    let status = cairn().args(["simulate", "--output"]).arg(&recording).args(size).status().unwrap();
    assert!(status.success());
    recording
}

/// A lock-step replay; both trajectories lie beside `map` under `name`.
fn replay(recording: &Path, map: &Path, name: &str, more: &[&str]) -> [Vec<u8>; 2] {
    let files = ["end", "live"].map(|which| map.with_file_name(format!("{name}-{which}.txt")));
    let mut command = cairn();
    command.arg("replay").arg(recording).arg("--lockstep").args(more).arg("--map-file").arg(map);
    command.arg("--trajectory").arg(&files[0]).arg("--live-trajectory").arg(&files[1]);
    assert!(command.status().unwrap().success(), "{name}");
    files.map(|file| std::fs::read(file).unwrap())
}

fn info(map: &Path) -> Value {
    info_by(cairn().args(["map", "info", "--json"]).arg(map))
}

fn info_by(command: &mut Command) -> Value {
    let output = command.stdout(Stdio::piped()).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{command:?}");
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Positions by timestamp text.
fn positions(tum: &[u8]) -> Vec<(String, [f64; 3])> {
    let line = |line: &str| {
        let mut words = line.split(' ');
        let time = words.next()?.to_owned();
        let mut number = || words.next()?.parse().ok();
        Some((time, [number()?, number()?, number()?]))
    };
    String::from_utf8_lossy(tum).lines().filter_map(line).collect()
}

/// Root mean square distance of the same times' positions, as they stand, and of the first from their mean.
fn apart(a: &[u8], b: &[u8]) -> (f64, f64) {
    let (a, b) = (positions(a), positions(b));
    let pairs: Vec<_> = a.iter().filter_map(|(t, p)| Some((p, &b.iter().find(|(other, _)| other == t)?.1))).collect();
    assert!(pairs.len() > 50, "{}", pairs.len());
    let n = pairs.len() as f64;
    let square = |a: &[f64; 3], b: &[f64; 3]| (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>();
    let mean: [f64; 3] = std::array::from_fn(|i| pairs.iter().map(|(p, _)| p[i]).sum::<f64>() / n);
    let (error, size): (f64, f64) =
        pairs.iter().fold((0.0, 0.0), |(error, size), (p, q)| (error + square(p, q), size + square(p, &mean)));
    ((error / n).sqrt(), (size / n).sqrt())
}

#[test]
fn a_map_is_made_gone_on_with_and_located_in_and_every_run_is_the_same_twice() {
    let dir = tempfile::tempdir().unwrap();
    let recording = simulated(dir.path());
    let map = dir.path().join("a.map");
    let made = replay(&recording, &map, "made", &[]);
    // With a file the run is what it is without one.
    let without = dir.path().join("without.txt");
    let mut command = cairn();
    command.arg("replay").arg(&recording).arg("--lockstep").arg("--trajectory").arg(&without);
    assert!(command.status().unwrap().success());
    assert!(std::fs::read(&without).unwrap() == made[0]);
    let told = info(&map);
    assert_eq!(told["maps"][0]["id"], 0);
    assert!(told["maps"][0]["keyframes"].as_u64() >= Some(4) && told["camera"]["width"] == 320, "{told}");

    let bytes = std::fs::read(&map).unwrap();
    let located = replay(&recording, &map, "located", &["--localise"]);
    assert!(std::fs::read(&map).unwrap() == bytes, "only to be located in");
    assert!(located == replay(&recording, &map, "again", &["--localise"]));
    for trajectory in &located {
        // In the frame and the unit of the map: as they stand, without alignment.
        let (error, size) = apart(&made[0], trajectory);
        assert!(error < 0.05 * size, "{error} of {size} map units");
    }

    let copy = dir.path().join("b.map");
    std::fs::copy(&map, &copy).unwrap();
    let went_on = replay(&recording, &map, "on", &[]);
    assert!(went_on == replay(&recording, &copy, "on-again", &[]));
    let (error, size) = apart(&made[0], &went_on[0]);
    assert!(error < 0.05 * size, "{error} of {size} map units");
    let (first, second) = (told["maps"][0]["frames"].as_u64(), info(&map)["maps"][0]["frames"].as_u64());
    assert!(second > first, "{second:?} {first:?}");
    exports(&map, dir.path());
}

/// Two recordings one after the other, `gap_s` apart, as one.
fn cut_together(folder: &Path, parts: [&Path; 2], gap_s: f64) -> PathBuf {
    let recording = folder.join("cut");
    std::fs::create_dir_all(recording.join("rgb")).unwrap();
    std::fs::copy(parts[0].join("camera.yaml"), recording.join("camera.yaml")).unwrap();
    let (mut list, mut shift, mut last) = (String::new(), None, 0.0);
    for (number, part) in parts.into_iter().enumerate() {
        for line in std::fs::read_to_string(part.join("rgb.txt")).unwrap().lines().filter(|line| !line.starts_with('#'))
        {
            let (time, picture) = line.split_once(' ').unwrap();
            let time: f64 = time.parse().unwrap();
            let shift = *shift.get_or_insert(if number == 0 { 0.0 } else { last + gap_s - time });
            let name = format!("rgb/{number}-{}", Path::new(picture).file_name().unwrap().display());
            std::fs::copy(part.join(picture), recording.join(&name)).unwrap();
            last = time + shift;
            list += &format!("{last:.6} {name}\n");
        }
        shift = None;
    }
    std::fs::write(recording.join("rgb.txt"), list).unwrap();
    recording
}

#[test]
fn maps_that_were_not_joined_have_a_trajectory_each() {
    let dir = tempfile::tempdir().unwrap();
    let room = |name: &str, scenario: &str, seconds: &str| {
        let recording = dir.path().join(name);
        let size = ["--scenario", scenario, "--size", "320x240", "--seconds", seconds];
        assert!(cairn().args(["simulate", "--output"]).arg(&recording).args(size).status().unwrap().success());
        recording
    };
    let cut = cut_together(dir.path(), [&room("one", "hand_held", "5"), &room("other", "desk_orbit", "4")], 0.5);
    let path = dir.path().join("t.txt");
    let of_an_earlier_run = dir.path().join("t.map77.txt");
    let marked = format!("{}0 0 0 0 0 0 0 1\n", cairn::trajectory::beside::MARK);
    std::fs::write(&of_an_earlier_run, marked).unwrap();
    let somebodys = dir.path().join("t.map78.txt");
    std::fs::write(&somebodys, "notes").unwrap();
    let replayed = || {
        let mut command = cairn();
        command.arg("replay").arg(&cut).args(["--lockstep", "--json", "--trajectory"]).arg(&path);
        let output = command.stdout(Stdio::piped()).output().unwrap();
        assert!(output.status.success());
        let told: Value = serde_json::from_slice(&output.stdout).unwrap();
        let files: Vec<PathBuf> =
            told["files"].as_array().unwrap().iter().map(|f| f.as_str().unwrap().into()).collect();
        let contents: Vec<Vec<u8>> = files.iter().map(|file| std::fs::read(file).unwrap()).collect();
        (told, files, contents)
    };
    let (told, files, contents) = replayed();
    assert!(files.len() >= 2 && files[0] == path, "{files:?}");
    assert_eq!(told["other_maps"], files.len() - 1);
    assert!(
        !of_an_earlier_run.exists() && somebodys.exists(),
        "it is not of this run, and the other is nobody's of ours"
    );
    let poses: Vec<usize> = contents.iter().map(|content| positions(content).len()).collect();
    assert_eq!((told["in_trajectory"].as_u64(), told["in_other_maps"].as_u64()), {
        (Some(poses[0] as u64), Some(poses[1..].iter().sum::<usize>() as u64))
    });
    assert!(poses[1..].iter().all(|n| *n <= poses[0] && *n > 0), "{poses:?}");
    // No time is in two of them.
    let mut times: Vec<String> = contents.iter().flat_map(|content| positions(content)).map(|(time, _)| time).collect();
    times.sort_unstable();
    let total = times.len();
    times.dedup();
    assert_eq!(times.len(), total);
    assert!(replayed().2 == contents, "the same twice");

    // A file of both: each room is located in its own map, whichever was tracked in last.
    let map = dir.path().join("rooms.map");
    replay(&cut, &map, "made", &[]);
    assert_eq!(info(&map)["maps"].as_array().map(Vec::len), Some(2));
    let bytes = std::fs::read(&map).unwrap();
    for (room, frames) in [("one", 150), ("other", 120)] {
        let [located, _] = replay(&dir.path().join(room), &map, room, &["--localise"]);
        let located = positions(&located).len();
        assert!(10 * located >= 8 * frames, "room {room}: {located} of {frames} frames");
    }
    assert!(std::fs::read(&map).unwrap() == bytes, "only to be located in");
}

fn exports(map: &Path, folder: &Path) {
    let files = ["m.ply", "m.tum", "model"].map(|name| folder.join(name));
    let mut command = cairn();
    command.args(["map", "export"]).arg(map).arg("--ply").arg(&files[0]).arg("--tum").arg(&files[1]);
    assert!(command.arg("--colmap").arg(&files[2]).status().unwrap().success());
    assert!(std::fs::read(&files[0]).unwrap().starts_with(b"ply\n"));
    let keyframes = info(map)["maps"][0]["keyframes"].as_u64().unwrap() as usize;
    assert_eq!(positions(&std::fs::read(&files[1]).unwrap()).len(), keyframes);
    let images = std::fs::read_to_string(files[2].join("images.txt")).unwrap();
    assert_eq!(images.lines().count(), 2 * keyframes);
    let cameras = std::fs::read_to_string(files[2].join("cameras.txt")).unwrap();
    assert!(cameras.starts_with("1 FULL_OPENCV 320 240 "), "{cameras}");
    // Every observation names a point, and that point names the observation.
    let points = std::fs::read_to_string(files[2].join("points3D.txt")).unwrap();
    let first = points.lines().next().unwrap();
    let words: Vec<&str> = first.split(' ').collect();
    let (point, image, place) = (words[0], words[8], words[9].parse::<usize>().unwrap());
    let at = images.lines().position(|line| line.split(' ').next() == Some(image) && line.ends_with(".png")).unwrap();
    let seen: Vec<&str> = images.lines().nth(at + 1).unwrap().split_whitespace().collect();
    assert_eq!(seen[3 * place + 2], point);
}

#[test]
fn what_is_wrong_with_a_map_file_is_said_and_the_file_left_as_it_is() {
    let dir = tempfile::tempdir().unwrap();
    let recording = simulated(dir.path());
    let map = dir.path().join("a.map");
    let fails = |arguments: &[&str], code: i32, words: &[&str]| {
        let mut command = cairn();
        command.args(arguments).current_dir(dir.path()).stderr(Stdio::piped());
        let output = command.output().unwrap();
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{arguments:?}: {message}");
        assert!(words.iter().all(|word| message.contains(word)), "{arguments:?}: {message}");
        assert!(!message.contains("panic"), "{message}");
    };
    fails(&["replay", "recording", "--localise"], 64, &["--map-file"]);
    fails(&["replay", "recording", "--lockstep", "--map-file", "a.map", "--localise"], 66, &["a.map", "no such file"]);
    fails(&["replay", "recording", "--lockstep", "--map-file", "none/a.map"], 73, &["none"]);
    fails(&["map", "info", "a.map"], 66, &["a.map"]);
    fails(&["map", "export", "a.map"], 64, &["--ply"]);
    replay(&recording, &map, "made", &[]);
    let bytes = std::fs::read(&map).unwrap();
    // The same pictures, another calibration: both are named.
    let yaml = std::fs::read_to_string(recording.join("camera.yaml")).unwrap();
    let other = yaml.lines().map(|line| if line.trim_start().starts_with("fx") { "fx: 123.5" } else { line });
    std::fs::write(dir.path().join("other.yaml"), other.collect::<Vec<_>>().join("\n")).unwrap();
    let words = ["a.map", "another camera", "fx 123.5"];
    let replayed = ["replay", "recording", "--lockstep", "--map-file", "a.map", "--camera", "other.yaml"];
    fails(&replayed, 78, &words);
    assert!(std::fs::read(&map).unwrap() == bytes);
    let cut = &bytes[..bytes.len() / 2];
    for (name, content) in [("cut.map", cut), ("foreign.map", b"[daemon]\nsource = 1\n")] {
        std::fs::write(dir.path().join(name), content).unwrap();
        fails(&["map", "info", name], 4, &[name]);
        fails(&["map", "export", name, "--ply", "x.ply"], 4, &[name]);
        fails(&["replay", "recording", "--lockstep", "--map-file", name], 4, &[name]);
        fails(&["replay", "recording", "--lockstep", "--map-file", name, "--localise"], 4, &[name]);
        assert!(std::fs::read(dir.path().join(name)).unwrap() == content, "{name}");
    }
}

#[test]
fn kill_9_at_any_moment_leaves_a_whole_map_that_lacks_seconds() {
    let (_, at_work, most_lost) = killed(20);
    println!("{at_work} of 20 killed at work, at the most {most_lost:.2} s lost");
    assert!(at_work >= 15, "only {at_work} of 20 were killed at work");
}

/// `TRIALS` says how many.
#[test]
#[ignore = "a table of results"]
fn kills() {
    let kills = std::env::var("TRIALS").map_or(200, |text| text.parse().expect("TRIALS is a number"));
    let (files, at_work, most_lost) = killed(kills);
    println!("\n| kill -9 of a replay that writes | killed at work | a whole file after it | most that was lost, s |");
    println!("|---|---:|---:|---:|\n| {kills} times | {at_work} | {files} | {most_lost:.2} |");
}

/// Kills a replay so often at seeded moments, on a new file and on one that is gone on with by turns. How often there was a file (whole each
/// time), how many were at work, and the longest time that was lost, s.
fn killed(kills: u64) -> (u32, u32, f64) {
    /// Frames of the recording's time: 5 s.
    const MOST_LOST: f64 = 5.0;
    let dir = tempfile::tempdir().unwrap();
    let recording = simulated(dir.path());
    let frames = std::fs::read_to_string(recording.join("rgb.txt")).unwrap();
    let times: Vec<f64> = frames
        .lines()
        .filter_map(|line| line.split(' ').next()?.parse().ok())
        .filter(|t: &f64| t.is_finite())
        .collect();
    let (mut state, mut killed_at_work, mut most_lost) = (0x9E37_79B9_7F4A_7C15u64, 0, 0.0f64);
    let mut files = 0;
    for kill in 0..kills {
        let map = dir.path().join(format!("{}.map", kill / 4));
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        // After so many frames, and then some.
        let frame = (state >> 33) % (times.len() as u64 - 10) + 2;
        let mut child = cairn()
            .arg("replay")
            .arg(&recording)
            .args(["--lockstep", "--log", "cairn::daemon=debug", "--map-file"])
            .arg(&map)
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let (mut seen, mut ended) = (0, true);
        for line in BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok) {
            let number = line.split_once("sequence=").and_then(|(_, rest)| rest.split(' ').next()?.parse::<u64>().ok());
            // Sequence numbers begin at 0.
            seen = seen.max(number.map_or(0, |n| n + 1));
            if seen >= frame {
                std::thread::sleep(Duration::from_micros(state % 20_000));
                child.kill().unwrap();
                ended = false;
                break;
            }
        }
        child.wait().unwrap();
        killed_at_work += u32::from(!ended);
        if !map.exists() {
            assert!(seen < 3, "kill {kill}: no file after {seen} frames");
            continue;
        }
        let told = info(&map);
        files += 1;
        let newest: f64 = told["newest_frame_s"].as_str().unwrap().parse().unwrap();
        let lost = times[(seen as usize).min(times.len()) - 1] - newest;
        assert!(lost <= MOST_LOST, "kill {kill}: {lost} s are lost");
        most_lost = most_lost.max(lost);
    }
    (files, killed_at_work, most_lost)
}

/// A daemon, killed at the end.
struct Daemon(std::process::Child);

impl Drop for Daemon {
    fn drop(&mut self) {
        // Our own child.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn a_running_daemon_stores_lists_loads_and_begins_maps() {
    const PATIENCE: Duration = Duration::from_secs(60);
    let dir = tempfile::tempdir().unwrap();
    let prefix = format!("test-named-maps-{}", std::process::id());
    let command = |arguments: &[&str]| {
        let mut command = cairn();
        command.env("CAIRN_PREFIX", &prefix).current_dir(dir.path()).args(arguments);
        command
    };
    let answer = |arguments: &[&str]| {
        let output = command(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).output().unwrap();
        let text = [output.stdout, output.stderr].map(|bytes| String::from_utf8(bytes).unwrap()).concat();
        (output.status.code(), text)
    };
    let until = |what: &str, arguments: &[&str], is: &dyn Fn(Option<i32>, &str) -> bool| {
        let start = std::time::Instant::now();
        loop {
            let (code, text) = answer(arguments);
            if is(code, &text) {
                return text;
            }
            assert!(start.elapsed() < PATIENCE, "{what}: {code:?} {text}");
            std::thread::sleep(Duration::from_millis(200));
        }
    };
    assert_eq!(answer(&["map", "list"]).0, Some(69), "no daemon");
    let _daemon = Daemon(command(&["demo", "--seconds", "300", "--output", "demo"]).spawn().unwrap());
    until("a daemon", &["map", "list"], &|code, text| code == Some(0) && text.contains("no maps yet"));
    until("a map", &["map", "save", "attic"], &|code, text| code == Some(0) && text.contains("attic.map"));
    let file = dir.path().join("demo/maps/attic.map");
    assert!(info(&file)["maps"][0]["keyframes"].as_u64() > Some(1));
    for (arguments, code, word) in [
        (&["map", "save", "attic"][..], 1, "already"),
        (&["map", "save"], 1, "no file"),
        (&["map", "load", "cellar"], 1, "cellar.map"),
        (&["map", "load", "../attic"], 64, "no name"),
        (&["map", "save", "/tmp/attic"], 64, "no name"),
        (&["map", "new", ".attic"], 64, "no name"),
        (&["map", "merge", "../attic"], 64, "no name"),
        (&["map", "merge", "cellar"], 1, "cellar.map"),
        (&["map", "merge", "attic"], 1, "already"),
    ] {
        let (got, text) = answer(arguments);
        assert!(got == Some(code) && text.contains(word), "{arguments:?}: {got:?} {text}");
    }
    // Broken, and foreign: refused, left as it is, and the daemon goes on.
    std::fs::write(dir.path().join("demo/maps/broken.map"), "no map").unwrap();
    assert_eq!([answer(&["map", "load", "broken"]).0, answer(&["map", "merge", "broken"]).0], [Some(1); 2]);
    let resets = || -> (u64, u64) {
        let text = answer(&["watch", "--health", "--json", "--count", "1", "--timeout", "20"]).1;
        let health: Value = serde_json::from_str(text.lines().next().unwrap()).unwrap();
        (health["reset_counter"].as_u64().unwrap(), health["map_id"].as_u64().unwrap())
    };
    let before = resets();
    let (code, text) = answer(&["map", "load", "attic"]);
    assert!(code == Some(0), "{text}");
    let listed = || -> Vec<(String, bool)> {
        let maps: Value = serde_json::from_str(&answer(&["map", "list", "--json"]).1).unwrap();
        let map = |m: &Value| (m["name"].as_str().unwrap().to_owned(), m["current"].as_bool().unwrap());
        maps.as_array().unwrap().iter().map(map).collect()
    };
    assert_eq!(listed(), [("attic".into(), true), ("broken".into(), false)]);
    until("another map and a reset", &["map", "list"], &|_, _| resets().0 > before.0 && resets().1 > before.1);
    // The daemon holds it, so it is asked, and leaves no copy behind.
    let told = info_by(&mut command(&["map", "info", "--json", "demo/maps/attic.map"]));
    assert!(told["file"].as_str().unwrap().ends_with("attic.map") && told["maps"][0]["keyframes"].as_u64() > Some(1));
    assert_eq!(answer(&["map", "export", "--tum", "keyframes.txt"]).0, Some(0));
    assert!(!positions(&std::fs::read(dir.path().join("keyframes.txt")).unwrap()).is_empty());
    let left = |folder: &str| std::fs::read_dir(dir.path().join(folder)).unwrap().count();
    assert_eq!((left("demo/maps"), left("demo/maps/copies")), (3, 0), "attic, broken, and the copies' folder");
    let elsewhere = format!("{prefix}-other");
    let mut foreign = command(&["map", "info", "demo/maps/attic.map"]);
    assert_eq!(foreign.env("CAIRN_PREFIX", elsewhere).status().unwrap().code(), Some(69), "not that daemon's");

    assert_eq!(answer(&["map", "localise", "on"]).0, Some(0));
    assert_eq!(answer(&["map", "new", "cellar"]).0, Some(1), "only located in");
    assert!(answer(&["map", "merge", "attic"]).1.contains("only located in"));
    assert_eq!(answer(&["map", "localise", "off"]).0, Some(0));
    assert_eq!(answer(&["map", "new", "cellar"]).0, Some(0));
    assert_eq!(answer(&["map", "save"]).0, Some(0));
    assert_eq!(listed(), [("attic".into(), false), ("broken".into(), false), ("cellar".into(), true)]);
    // Once the new map has begun, the old one can become a part of it; its file stays as it is.
    let bytes = std::fs::read(&file).unwrap();
    let told = until("a map to merge with", &["map", "merge", "attic"], &|code, _| code == Some(0));
    assert!(told.contains("beside the present map"), "{told}");
    assert!(answer(&["map", "merge", "attic"]).1.contains("already"));
    assert_eq!(std::fs::read(&file).unwrap(), bytes);
    assert!(info(&file)["maps"][0]["keyframes"].as_u64() > Some(1), "whole, and nobody's now");
}

/// Frames located, and the error of the live trajectory when located against the mapping run's own (ATE RMSE, m).
fn located_as_well(name: &str) {
    let Some(recording) = recording(name) else { return };
    let dir = tempfile::tempdir().unwrap();
    let map = dir.path().join("a.map");
    let made = replay(&recording, &map, "made", &[]);
    let located = replay(&recording, &map, "located", &["--localise"]);
    let error = |which: &str| {
        let file = dir.path().join(which);
        let output = cairn().arg("evaluate").arg(file).arg(&recording).arg("--json").stdout(Stdio::piped()).output();
        let figures: Value = serde_json::from_slice(&output.unwrap().stdout).unwrap();
        (figures["ate_m"]["rmse"].as_f64().unwrap(), figures["coverage_percent"].as_f64().unwrap())
    };
    let ((mapping, _), (locating, coverage)) = (error("made-live.txt"), error("located-live.txt"));
    println!("{name}: {coverage} % located, live error {locating} m of {mapping} m when it was mapped");
    assert!(coverage >= 95.0 && locating <= 1.2 * mapping, "{name}: {coverage} %, {locating} m of {mapping} m");
    let (apart, size) = apart(&made[0], &located[1]);
    assert!(apart < 0.05 * size, "{name}: {apart} of {size} map units");
}

#[test]
fn a_recording_is_located_in_its_own_map_as_finely_as_it_was_mapped() {
    located_as_well("new_tsukuba");
    located_as_well("tum_fr1_xyz");
}

/// Some pictures of a recording, with everything else of it.
fn part(recording: &Path, name: &str, frames: std::ops::Range<usize>) -> PathBuf {
    let part = recording.with_file_name(name);
    std::fs::create_dir(&part).unwrap();
    for entry in std::fs::read_dir(recording).unwrap().map(|entry| entry.unwrap()) {
        if entry.file_name() != "rgb.txt" {
            std::os::unix::fs::symlink(entry.path(), part.join(entry.file_name())).unwrap();
        }
    }
    let all = std::fs::read_to_string(recording.join("rgb.txt")).unwrap();
    let lines: Vec<&str> = all.lines().filter(|line| !line.starts_with('#')).collect();
    std::fs::write(part.join("rgb.txt"), lines[frames].join("\n") + "\n").unwrap();
    part
}

/// The wheels have told nothing of the way before the turn yet in this run, and tell how long it is behind it. (By their word alone, mixed with the
/// stored one, the map was 1.06 and 3.05 times as long as it is.)
#[test]
fn a_robot_that_turns_on_the_spot_soon_after_it_has_started_in_its_map_keeps_its_metres() {
    let dir = tempfile::tempdir().unwrap();
    for seed in ["91", "97"] {
        let recording = dir.path().join(seed);
        let drive = ["--scenario", "corridor", "--seconds", "44", "--rate", "12", "--size", "320x240", "--seed", seed];
        assert!(cairn().args(["simulate", "--output"]).arg(&recording).args(drive).status().unwrap().success());
        let map = dir.path().join(format!("{seed}.map"));
        // It turns from second 22 on.
        let days = [("first", 0..264), ("second", 254..528)];
        for (day, frames) in days {
            replay(&part(&recording, &format!("{day}-{seed}"), frames), &map, &format!("{day}-{seed}"), &[]);
        }
        let trajectory = map.with_file_name(format!("second-{seed}-end.txt"));
        let output =
            cairn().arg("evaluate").arg(&trajectory).arg(&recording).arg("--json").stdout(Stdio::piped()).output();
        let told: Value = serde_json::from_slice(&output.unwrap().stdout).unwrap();
        let scale = told["alignment"]["scale"].as_f64().unwrap();
        println!("seed {seed}: a metre of the estimate is {scale:.4} m");
        assert!((scale - 1.0).abs() < 0.022, "seed {seed}: {scale}, beyond two of the sigmas that are told");
    }
}
