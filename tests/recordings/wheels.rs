//! What the base's wheels tell, in a recording: beside the pictures of a folder, in a file, on the wire.

use super::*;

#[test]
fn wheels_on_the_wire_come_back_in_a_replay_of_the_recording() {
    let dir = tempfile::tempdir().unwrap();
    let config = dir.path().join("cairn.toml");
    fs::write(&config, SIMULATOR).unwrap();
    let file = dir.path().join("wheels.mcap");
    let prefix = format!("test-recordings-driven-{}", std::process::id());
    let endpoint = cairn::messages::Endpoint::new(&prefix).unwrap();
    let mut wheels = cairn::client::Client::with_endpoint(endpoint).unwrap().wheels();
    let running = daemon("driven", &config);
    let mut recorder = recorder("driven", &file, &[]);
    let begin = Instant::now();
    let mut drive = |until: &dyn Fn(bool) -> bool| {
        while !until(wheels.is_connected()) {
            assert!(begin.elapsed() < Duration::from_secs(60), "the driver hears of nobody's coming or going");
            wheels.send(0.25, 0.0, 0.125).unwrap();
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    let recorded = || fs::metadata(&file).map_or(0, |m| m.len());
    drive(&|_| recorded() > 3 << 20);
    // The daemon is killed. A recorder that goes on listening must not pass for one with the driver.
    drop(running);
    drive(&|is_connected| !is_connected);
    assert!(recorder.0.try_wait().unwrap().is_none(), "the recorder waits for the next daemon");
    recorder.signal("-INT");
    assert_eq!(recorder.ends(), Some(0));
    let counts = counts(&file);
    let readings = counts.get("wheel").copied().unwrap_or_default();
    assert!(readings > 50 && counts["wheel/twist"] == readings, "{counts:?}");
    // Nothing is known of obstacles before the scale is metric, and that is told.
    assert!(counts["obstacles"] > 3 && !counts.contains_key("scan"), "{counts:?}");
    let output = cairn("driven").args(["replay", "--lockstep", "--json"]).arg(&file).output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {told}"));
    let wheels = &summary["wheels"];
    // Readings before the first picture and after the last, until the daemon's death was noticed, are nobody's.
    let believed = wheels["readings"].as_u64().unwrap_or_default();
    assert!(believed > 50 && 2 * believed > readings as u64, "{readings} recorded: {wheels} {told}");
    assert_eq!((wheels["absurd"].as_u64(), wheels["out_of_order"].as_u64()), (Some(0), Some(0)), "{wheels} {told}");
}

/// The summary of a lock-step replay, and its trajectory.
fn replayed(folder: &Path) -> (serde_json::Value, Vec<u8>, String) {
    let trajectory = folder.with_extension("txt");
    let mut command = cairn("wheels");
    command.arg("replay").arg(folder).args(["--lockstep", "--json", "--trajectory"]).arg(&trajectory);
    let output = command.output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    let summary = serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {told}"));
    (summary, fs::read(trajectory).unwrap_or_default(), told)
}

#[test]
fn odometry_beside_the_pictures_is_read_judged_and_named_by_its_line() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("drive");
    let simulated = cairn("wheels")
        .args([
            "simulate",
            "--scenario",
            "square",
            "--seconds",
            "1.2",
            "--size",
            "320x240",
            "--wheel-loss",
            "5",
            "--output",
        ])
        .arg(&out)
        .output()
        .unwrap();
    assert!(simulated.status.success(), "{}", String::from_utf8_lossy(&simulated.stderr));
    let file = out.join("odometry.txt");
    let told = fs::read_to_string(&file).unwrap();
    let lines: Vec<&str> = told.lines().filter(|line| !line.starts_with('#')).collect();
    assert!((45..62).contains(&lines.len()), "{} lines of 1.2 s at 50 Hz, some lost", lines.len());
    let (summary, trajectory, _) = replayed(&out);
    let until_last_frame =
        lines.iter().filter(|line| parse_timestamp(&line[..line.find(' ').unwrap()]).unwrap() <= 1_001_166_666_667);
    assert_eq!(summary["wheels"]["readings"], until_last_frame.count());
    let (_, again, _) = replayed(&out);
    assert_eq!(trajectory, again, "the same files, the same bytes");

    // What cannot be is left out and named; the rest is used.
    let spoilt = told.replacen(lines[20], &format!("{} nan 0 0", lines[20].split(' ').next().unwrap()), 1);
    fs::write(&file, spoilt).unwrap();
    let (summary, _, log) = replayed(&out);
    assert_eq!(summary["wheels"]["absurd"], 1);
    assert!(log.contains("wheel reading not believed") && log.contains("linear_x_mps is NaN"), "{log}");

    fs::write(&file, "1000.0 1 2\n").unwrap();
    let output = cairn("wheels").arg("replay").arg(&out).args(["--lockstep", "--json"]).output().unwrap();
    let log = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && log.contains("odometry.txt:1: has 3 values"), "{log}");

    fs::remove_file(&file).unwrap();
    let (summary, _, _) = replayed(&out);
    assert!(summary.get("wheels").is_none(), "without it nothing is said of it");
}

#[test]
fn wheels_in_a_file_are_replayed_to_the_same_bytes_as_beside_a_folder() {
    let dir = tempfile::tempdir().unwrap();
    let (out, file) = (dir.path().join("drive"), dir.path().join("drive.mcap"));
    let arguments = ["simulate", "--scenario", "square", "--seconds", "2", "--size", "320x240", "--output"];
    assert!(cairn("bag-wheels").args(arguments).arg(&out).output().unwrap().status.success());
    let list = fs::read_to_string(out.join("rgb.txt")).unwrap();
    let lines = list.lines().filter(|line| !line.starts_with('#')).map(|line| line.split_once(' ').unwrap());
    let pictures: Vec<_> = lines.map(|(t, f)| (parse_timestamp(t).unwrap(), out.join(f.trim()))).collect();
    let told = fs::read_to_string(out.join("odometry.txt")).unwrap();
    let wheels: Vec<(i64, [f64; 3])> = told
        .lines()
        .filter(|line| !line.starts_with('#'))
        .map(|line| {
            let fields: Vec<&str> = line.split_whitespace().collect();
            let number = |i: usize| fields[i].parse::<f64>().unwrap();
            (parse_timestamp(fields[0]).unwrap(), [number(1), number(2), number(3)])
        })
        .collect();
    bag_with_wheels(&file, &pictures, &wheels);
    let replayed = |recording: &Path, more: &[&str]| {
        let trajectory = dir.path().join("t.txt");
        let mut command = cairn("bag-wheels");
        command.arg("replay").arg(recording).args(["--lockstep", "--json", "--camera"]).arg(out.join("camera.yaml"));
        let output = command.arg("--trajectory").arg(&trajectory).args(more).output().unwrap();
        let log = String::from_utf8_lossy(&output.stderr).into_owned();
        let summary: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
        (summary["wheels"].clone(), fs::read(trajectory).unwrap_or_default(), log)
    };
    let (readings, want, _) = replayed(&out, &[]);
    assert!(readings["readings"].as_u64().unwrap() > 80, "{readings}");
    for more in [&[][..], &["--wheel-topic", "/base/odom"]] {
        let (of_file, got, log) = replayed(&file, more);
        assert_eq!(of_file, readings, "{log}");
        assert!(got == want, "a file differs from the folder");
    }
    let (_, _, log) = replayed(&file, &["--wheel-topic", "/cam/image_raw/compressed"]);
    assert!(log.contains("--wheel-topic /cam") && log.contains("/base/odom (nav_msgs/msg/Odometry"), "{log}");
    let (_, _, log) = replayed(&out, &["--wheel-topic", "/base/odom"]);
    assert!(log.contains("only an MCAP file has topics"), "{log}");
}
