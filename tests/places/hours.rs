//! Hours in three rooms: what map, memory, file and time take, and where the robot takes itself to be.
//!
//! Lap after lap of some 60 m at ten pictures a second, the map's file kept as a daemon keeps it. Every twenty minutes is another day: other lamps,
//! and a third of the furniture elsewhere than on the first.

use cairn::camera::simulator::{Scenario, SimulatorConfig};
use cairn::frame::process_cpu_ns;
use cairn::map::MapSnapshot;
use cairn::places::store::MapFile;

use super::number;
use super::robot::{Robot, Standing, shown, simulator, webcam};

const HOURS_RATE_HZ: f64 = 10.0;
/// s of a row of the table, which is a day.
const DAY_S: usize = 1200;
/// s between two writes of the file, as the daemon's.
const WRITTEN_EVERY_S: usize = 4;

/// Of a day, and at its end.
struct Row {
    keyframes: usize,
    landmarks: usize,
    rss_mb: f64,
    file_mb: f64,
    /// Median and 99th percentile of the CPU time, ms: of a pose, and of what follows it at a keyframe.
    pose_ms: [f64; 2],
    keyframe_ms: [f64; 2],
    placed: f64,
    /// Median and most of what poses were off, cm; laid on the truth by all keyframes.
    off_cm: [f64; 2],
    /// The median, laid on the truth as the map of the first day was: what a goal is off that a planner has kept since then.
    off_since_cm: f64,
}

/// Median and 99th percentile.
fn quantiles(mut values: Vec<f64>) -> [f64; 2] {
    values.sort_by(f64::total_cmp);
    [0.5, 0.99].map(|share| values.get(((values.len() as f64 - 1.0) * share) as usize).copied().unwrap_or(f64::NAN))
}

fn rss_mb() -> f64 {
    let text = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches("kB").trim().parse::<f64>().unwrap() / 1024.0
}

/// CPU time: nothing else of this process works meanwhile, while the machine may.
fn ms(since_ns: i64) -> f64 {
    (process_cpu_ns() - since_ns) as f64 * 1e-6
}

/// Drives for a day.
fn day(
    robot: &mut Robot,
    (file, first): (&mut Option<MapFile>, &mut Option<Standing>),
    folder: &std::path::Path,
    seed: u64,
    day: u64,
    seconds: usize,
) -> Row {
    let mut config = SimulatorConfig { rate_hz: HOURS_RATE_HZ, ..webcam(Scenario::ThreeRooms, seed) };
    config.speed = [1.0, 1.15, 0.9][day as usize % 3];
    config.another_day.enabled = day > 0;
    config.another_day.seed = 1000 * seed + day;
    let mut simulator = simulator(&config);
    let path = folder.join("hours.map");
    let (mut pose_ms, mut keyframe_ms, mut poses) = (Vec::new(), Vec::new(), Vec::new());
    let frames = (seconds as f64 * HOURS_RATE_HZ) as u64;
    for frame in 0..frames {
        let (picture, truth) = shown(&mut simulator, frame);
        let timestamp_ns = robot.look(&picture);
        let began = process_cpu_ns();
        let estimate = robot.place();
        pose_ms.push(ms(began));
        let (began, before) = (process_cpu_ns(), robot.reconstruction.counters().keyframes_made);
        robot.map();
        if robot.reconstruction.counters().keyframes_made > before {
            keyframe_ms.push(ms(began));
            // Of hours of frames the keyframes' alone.
            robot.truths.insert(timestamp_ns, truth);
        }
        poses.extend(estimate.world_from_camera.map(|told| (told, truth)));
        if frame.is_multiple_of((WRITTEN_EVERY_S as f64 * HOURS_RATE_HZ) as u64) && robot.reconstruction.has_changes() {
            let changes = robot.reconstruction.take_changes(file.is_none());
            match file {
                Some(file) => _ = file.write(&changes).unwrap(),
                None => *file = Some(MapFile::create(&path, &changes).unwrap()),
            }
        }
    }
    let (standing, _) = robot.standing(true).unwrap();
    let first = first.get_or_insert(standing);
    let off_by = |standing: &Standing| -> Vec<f64> {
        let mut off: Vec<f64> = poses.iter().map(|(told, truth)| 100.0 * standing.error(told, truth).0).collect();
        off.sort_by(f64::total_cmp);
        off
    };
    let (off, since) = (off_by(&standing), off_by(first));
    let mut map = MapSnapshot::default();
    robot.reconstruction.snapshot(&mut map);
    Row {
        keyframes: robot.reconstruction.total_keyframes(),
        landmarks: map.landmarks.len(),
        rss_mb: rss_mb(),
        file_mb: std::fs::metadata(&path).unwrap().len() as f64 / 1e6,
        pose_ms: quantiles(pose_ms),
        keyframe_ms: quantiles(keyframe_ms),
        placed: poses.len() as f64 / frames as f64,
        off_cm: [off.get(off.len() / 2), off.last()].map(|v| v.copied().unwrap_or(f64::NAN)),
        off_since_cm: since.get(since.len() / 2).copied().unwrap_or(f64::NAN),
    }
}

#[test]
#[ignore = "a table of results; half an hour"]
fn hours() {
    let (days, seed) = (number("DAYS", 12), number("FIRST_SEED", 501) as u64);
    let folder = tempfile::tempdir().unwrap();
    let config = SimulatorConfig { rate_hz: HOURS_RATE_HZ, ..webcam(Scenario::ThreeRooms, seed) };
    let mut first = simulator(&config);
    shown(&mut first, 0);
    let mut robot = Robot::new(first.camera_model());
    robot.rate_hz = HOURS_RATE_HZ;
    robot.reconstruction.spool_pictures(folder.path());
    // What the simulator takes, of which each day makes one.
    let before_mb = rss_mb();
    drop(first);
    println!(
        "\n| hours | keyframes | landmarks | memory, MB | file, MB | pose ms, p50 and p99 | keyframe and adjustments ms, p50 and p99 | placed, % | off, cm: median, most | median in the first day's frame | loops | maps | turns to assumed scale |"
    );
    println!("|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|");
    let (mut file, mut first) = (None, None);
    for n in 0..days {
        let row = day(&mut robot, (&mut file, &mut first), folder.path(), seed, n as u64, number("DAY_S", DAY_S));
        let counters = robot.reconstruction.counters();
        println!(
            "| {:.2} | {} | {} | {:.0} | {:.1} | {:.2}, {:.2} | {:.1}, {:.1} | {:.2} | {:.1}, {:.1} | {:.1} | {} | {} | {} |",
            (n + 1) as f64 * number("DAY_S", DAY_S) as f64 / 3600.0,
            row.keyframes,
            row.landmarks,
            row.rss_mb - before_mb,
            row.file_mb,
            row.pose_ms[0],
            row.pose_ms[1],
            row.keyframe_ms[0],
            row.keyframe_ms[1],
            100.0 * row.placed,
            row.off_cm[0],
            row.off_cm[1],
            row.off_since_cm,
            counters.loops_closed,
            robot.reconstruction.maps(),
            counters.blind_turns,
        );
    }
    assert!(file.is_some_and(|file| file.close().is_ok()), "no file");
}
