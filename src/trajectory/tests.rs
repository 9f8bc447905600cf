use super::*;
use crate::map::{KeyframeId, MapId};
use crate::reconstruction::{PoseEstimate, TrackingState, TrajectoryEvent};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use std::path::PathBuf;

fn file(text: &str) -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("trajectory.txt");
    std::fs::write(&path, text).unwrap();
    (dir, path)
}

fn message_of(text: &str) -> String {
    let (_dir, path) = file(text);
    read_tum(&path).unwrap_err().to_string()
}

fn at(x: f64, yaw: f64) -> Se3<World, Camera> {
    Se3::new(UnitQuaternion::from_euler_angles(0.0, yaw, 0.1), Vector3::new(x, -2.0, 0.5))
}

/// Lines of a file as (timestamp text, x).
fn lines(path: &Path) -> Vec<(String, f64)> {
    let text = std::fs::read_to_string(path).unwrap();
    text.lines()
        .map(|l| {
            let fields: Vec<_> = l.split(' ').collect();
            assert_eq!(fields.len(), 8, "{l}");
            (fields[0].to_string(), fields[1].parse().unwrap())
        })
        .collect()
}

#[test]
fn comments_blank_lines_and_windows_line_ends_are_read() {
    let (_dir, path) = file("\u{feff}# head\r\n\r\n  \n2.5 1 2 3 0 0 0 1\r\n1.25\t4 5 6 0 0 0 -1  \n# tail");
    let poses = read_tum(&path).unwrap();
    assert_eq!(poses.iter().map(|p| p.timestamp_ns).collect::<Vec<_>>(), [1_250_000_000, 2_500_000_000]);
    assert_eq!(poses[1].world_from_camera.translation, Vector3::new(1.0, 2.0, 3.0));
}

#[test]
fn a_malformed_line_is_named_by_file_line_and_value() {
    let good = "# head\n1.0 0 0 0 0 0 0 1\n";
    for (line, expected) in [
        ("2.0 0 0 nan 0 0 0 1", "tz is nan"),
        ("2.0 inf 0 0 0 0 0 1", "tx is inf"),
        ("2.0 0 0 0 0 0 0", "missing qw"),
        ("2.0 0 0 0 0 0 0 1 7", "more than 8 values"),
        ("2.0 0 zero 0 0 0 0 1", "ty \"zero\" is not a number"),
        ("2,0 0 0 0 0 0 0 1", "timestamp \"2,0\""),
        ("1403636579763555584 0 0 0 0 0 0 1", "nanoseconds"),
        ("nan 0 0 0 0 0 0 1", "timestamp \"nan\""),
        ("2.0 0 0 0 0 0 0 0", "norm 0.0000"),
        ("2.0 0 0 0 1 1 1 1", "norm 2.0000"),
    ] {
        let message = message_of(&format!("{good}{line}\n"));
        assert!(message.contains("trajectory.txt, line 3: ") && message.contains(expected), "{line}: {message}");
    }
    let endless = message_of(&format!("{good}{}", "1".repeat(100_000)));
    assert!(endless.contains("line 3") && endless.contains("longer than"), "{endless}");
}

#[test]
fn a_file_that_is_empty_missing_or_no_text_is_an_error() {
    assert!(message_of("").contains("holds no poses"));
    assert!(message_of("# only a comment\n\n").contains("holds no poses"));
    let dir = tempfile::tempdir().unwrap();
    for path in [dir.path().to_path_buf(), dir.path().join("none.txt")] {
        assert!(matches!(read_tum(&path), Err(TrajectoryError::Read { .. })), "{}", path.display());
    }
    let binary = dir.path().join("binary");
    std::fs::write(&binary, [0xff, 0xfe, 0x00, 0x0a]).unwrap();
    assert!(read_tum(&binary).unwrap_err().to_string().contains("line 1: is not text"));
}

#[test]
fn frame_times_are_the_first_column() {
    let (_dir, path) = file("# timestamp filename\n0.033333 rgb/a b.jpg\n0.000000 rgb/0.jpg\n");
    assert_eq!(read_frame_times(&path).unwrap(), [0, 33_333_000]);
    let (_dir, path) = file("rgb/0.jpg 0.0\n");
    assert!(read_frame_times(&path).unwrap_err().to_string().contains("line 1: timestamp \"rgb/0.jpg\""));
}

#[test]
fn equal_poses_give_equal_bytes() {
    let pose = at(-1e-12, 0.3);
    let flipped = Se3::new(UnitQuaternion::new_unchecked(-pose.rotation.into_inner()), pose.translation);
    let (mut a, mut b) = (Vec::new(), Vec::new());
    write_tum_line(&mut a, 33_333_000, &pose).unwrap();
    write_tum_line(&mut b, 33_333_000, &flipped).unwrap();
    assert_eq!(a, b);
    assert!(a.starts_with(b"0.033333 0.000000000 -2.000000000 0.500000000 "), "{}", String::from_utf8_lossy(&a));
}

#[test]
fn what_is_written_is_read_back() {
    proptest!(ProptestConfig { rng_seed: RngSeed::Fixed(7), failure_persistence: None, cases: 64, ..Default::default() },
        |(values in proptest::collection::vec((any::<i64>(), -1e3..1e3_f64, -3.0..3.0_f64), 1..20))| {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.txt");
        let mut poses: Vec<_> =
            values.iter().map(|(t, x, yaw)| TumPose { timestamp_ns: *t, world_from_camera: at(*x, *yaw) }).collect();
        poses.sort_by_key(|p| p.timestamp_ns);
        write_tum(&path, &poses).unwrap();
        let back = read_tum(&path).unwrap();
        prop_assert_eq!(back.len(), poses.len());
        for (a, b) in back.iter().zip(&poses) {
            prop_assert_eq!(a.timestamp_ns, b.timestamp_ns);
            let error = a.world_from_camera.inverse() * b.world_from_camera;
            prop_assert!(error.translation.norm() < 2e-9 && error.rotation.angle() < 1e-8);
        }
    });
}

fn pose_event(timestamp_ns: i64, map: u32, keyframe: u32, x: f64) -> TrajectoryEvent {
    let keyframe_from_camera = Se3::new(UnitQuaternion::identity(), Vector3::new(x, 0.0, 0.0));
    TrajectoryEvent::Pose { timestamp_ns, map: MapId(map), keyframe: KeyframeId(keyframe), keyframe_from_camera }
}

fn removed(keyframe: u32, parent: u32, x: f64) -> TrajectoryEvent {
    TrajectoryEvent::KeyframeRemoved {
        map: MapId(0),
        keyframe: KeyframeId(keyframe),
        parent: KeyframeId(parent),
        parent_from_keyframe: Se3::new(UnitQuaternion::identity(), Vector3::new(x, 0.0, 0.0)),
    }
}

fn keyframe(id: u32, x: f64) -> (KeyframeId, Se3<World, Camera>) {
    (KeyframeId(id), Se3::new(UnitQuaternion::identity(), Vector3::new(x, 0.0, 0.0)))
}

const S: i64 = 1_000_000_000;

#[test]
fn frames_follow_their_keyframe_and_removed_keyframes_their_parent() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("t.txt");
    let mut spool = TrajectorySpool::create(dir.path()).unwrap();
    // Keyframe 3 goes to 2, 2 goes to 1: chains in any order; frame 0 was solved after frame 2.
    for event in [
        pose_event(2 * S, 0, 3, 0.25),
        removed(3, 2, 1.0),
        pose_event(3 * S, 0, 1, 0.5),
        pose_event(0, 0, 1, -0.5),
        removed(2, 1, 10.0),
    ] {
        spool.record(&event).unwrap();
    }
    let summary = spool.write_tum(&path, &[keyframe(1, 100.0)]).unwrap();
    assert_eq!(
        lines(&path),
        [("0.000000".into(), 99.5), ("2.000000".into(), 111.25), ("3.000000".into(), 100.5)],
        "world_from_1 * 1_from_2 * 2_from_3 * 3_from_camera"
    );
    assert_eq!(summary, TrajectorySummary { poses_written: 3, map: Some(MapId(0)), ..Default::default() });
    // Again, with what the map knows later.
    spool.record(&pose_event(4 * S, 0, 4, 0.0)).unwrap();
    spool.write_tum(&path, &[keyframe(1, 0.0), keyframe(4, 7.0)]).unwrap();
    assert_eq!(lines(&path).last().unwrap(), &("4.000000".to_string(), 7.0));
    assert_eq!(lines(&path).len(), 4);
}

#[test]
fn frames_between_two_keyframes_follow_both_but_for_what_was_seen_anew() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("t.txt");
    let mut spool = TrajectorySpool::create(dir.path()).unwrap();
    let made = |i: i64, keyframe| TrajectoryEvent::KeyframeMade { timestamp_ns: i * S, keyframe: KeyframeId(keyframe) };
    // Tracked by keyframe 1 to 4 and 8 m; keyframes 2 and 3 lie at 4.4 m and 8 m now.
    for event in [
        pose_event(0, 0, 1, 0.0),
        made(0, 1),
        pose_event(S, 0, 1, 1.0),
        pose_event(2 * S, 0, 1, 2.0),
        pose_event(4 * S, 0, 1, 4.0),
        made(4, 2),
        pose_event(6 * S, 0, 2, 2.0),
        pose_event(8 * S, 0, 2, 4.0),
        made(8, 3),
        pose_event(9 * S, 0, 3, 1.0),
    ] {
        spool.record(&event).unwrap();
    }
    let known = [keyframe(1, 0.0), keyframe(2, 4.4), keyframe(3, 8.0)];
    spool.write_tum(&path, &known).unwrap();
    let places = || lines(&path).iter().map(|line| line.1).collect::<Vec<_>>();
    let expected = [0.0, 1.1, 2.2, 4.4, 6.2, 8.0, 9.0];
    assert!(places().iter().zip(expected).all(|(x, e)| (x - e).abs() < 1e-6), "{:?}", places());
    // The frame of keyframe 2 is known anew, from elsewhere: it tells nothing of where that keyframe should be.
    spool.record(&pose_event(4 * S, 0, 3, -3.5)).unwrap();
    spool.write_tum(&path, &known).unwrap();
    let expected = [0.0, 1.0, 2.0, 4.5, 6.4, 8.0, 9.0];
    assert!(places().iter().zip(expected).all(|(x, e)| (x - e).abs() < 1e-6), "{:?}", places());
}

#[test]
fn only_the_largest_map_is_written_and_the_rest_is_counted() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("t.txt");
    let mut spool = TrajectorySpool::create(dir.path()).unwrap();
    for i in 0..5 {
        spool.record(&pose_event(i * S, 0, 1, 0.0)).unwrap();
    }
    for i in 5..25 {
        spool.record(&pose_event(i * S, 7, 2, 0.0)).unwrap();
    }
    spool.record(&pose_event(30 * S, 8, 3, 0.0)).unwrap();
    // A frame tracked first and solved better afterwards; one whose keyframe nobody knows; a loop of removals.
    spool.record(&pose_event(10 * S, 7, 2, 5.0)).unwrap();
    spool.record(&pose_event(40 * S, 7, 99, 0.0)).unwrap();
    spool.record(&pose_event(41 * S, 7, 50, 0.0)).unwrap();
    spool.record(&removed(50, 51, 0.0)).unwrap();
    spool.record(&removed(51, 50, 0.0)).unwrap();
    let summary = spool.write_tum(&path, &[keyframe(1, 0.0), keyframe(2, 0.0), keyframe(3, 0.0)]).unwrap();
    assert_eq!(
        summary,
        TrajectorySummary {
            poses_written: 20,
            map: Some(MapId(7)),
            other_maps: 2,
            poses_in_other_maps: 6,
            poses_replaced: 1,
            poses_unresolved: 2,
            events_lost: 0,
        }
    );
    assert_eq!(lines(&path)[5], ("10.000000".into(), 5.0), "the later solution counts");
}

#[test]
fn other_maps_stand_beside_the_largest_and_none_of_an_earlier_run_is_left() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("t.txt");
    let mut spool = TrajectorySpool::create(dir.path()).unwrap();
    for (map, keyframe, times) in [(0, 1, 0..5), (7, 2, 5..25), (8, 3, 30..32), (9, 4, 40..41)] {
        times.for_each(|i| spool.record(&pose_event(i * S, map, keyframe, 0.5)).unwrap());
    }
    spool.record(&TrajectoryEvent::MapJoined { map: MapId(8), into: MapId(9), scale: 3.0 }).unwrap();
    for stale in ["t.map2.txt", "t.map8.txt", "t.map0.txt"] {
        std::fs::write(dir.path().join(stale), format!("{}0 0 0 0 0 0 0 1\n", beside::MARK)).unwrap();
    }
    let known = [keyframe(1, 0.0), keyframe(2, 0.0), keyframe(3, 10.0), keyframe(4, 20.0)];
    let (summary, others) = spool.write_all_maps(&path, &known).unwrap();
    assert_eq!((summary.map, summary.other_maps, summary.poses_in_other_maps), (Some(MapId(7)), 2, 8));
    let files = others.files;
    assert!(others.failures.is_empty(), "{:?}", others.failures);
    assert_eq!(files, ["t.map0.txt", "t.map9.txt"].map(|name| dir.path().join(name)));
    assert_eq!([&path, &files[0], &files[1]].map(|path| read_tum(path).unwrap().len()), [20, 5, 3]);
    let along = |path: &Path| -> Vec<f64> {
        read_tum(path).unwrap().iter().map(|pose| pose.world_from_camera.translation.x).collect()
    };
    assert_eq!(along(&files[1]), [11.5, 11.5, 20.5], "in one unit");
    assert!(!dir.path().join("t.map2.txt").exists() && !dir.path().join("t.map8.txt").exists());
    let (_, beside_a_device) = spool.write_all_maps(Path::new("/dev/null"), &known).unwrap();
    assert!(beside_a_device.files.is_empty());
}

#[test]
fn what_somebody_else_has_put_beside_a_trajectory_stays_and_the_rest_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("t.txt");
    let mut spool = TrajectorySpool::create(dir.path()).unwrap();
    for (map, keyframe, times) in [(0, 1, 0..5), (7, 2, 5..25), (9, 3, 40..41)] {
        times.for_each(|i| spool.record(&pose_event(i * S, map, keyframe, 0.5)).unwrap());
    }
    let theirs = ["t.map0.txt", "t.map4.txt"].map(|name| dir.path().join(name));
    theirs.iter().for_each(|file| std::fs::write(file, "my notes on map 0\n").unwrap());
    let (summary, others) =
        spool.write_all_maps(&path, &[keyframe(1, 0.0), keyframe(2, 0.0), keyframe(3, 10.0)]).unwrap();
    assert_eq!((summary.poses_written, others.files), (20, vec![dir.path().join("t.map9.txt")]));
    let told: Vec<String> = others.failures.iter().map(TrajectoryError::to_string).collect();
    assert!(told.len() == 1 && told[0].contains("t.map0.txt"), "{told:?}");
    for file in theirs {
        assert_eq!(std::fs::read(file).unwrap(), b"my notes on map 0\n");
    }
}

#[test]
fn joined_maps_are_one_in_the_unit_of_the_last() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("t.txt");
    let mut spool = TrajectorySpool::create(dir.path()).unwrap();
    let joined = |map, into, scale| TrajectoryEvent::MapJoined { map: MapId(map), into: MapId(into), scale };
    for event in [
        pose_event(S, 0, 1, 0.5),
        removed(1, 2, 1.0),
        pose_event(2 * S, 1, 3, 0.5),
        joined(0, 1, 2.0),
        pose_event(3 * S, 1, 3, 0.5),
        pose_event(4 * S, 2, 4, 0.5),
        joined(1, 2, 10.0),
        pose_event(5 * S, 3, 5, 0.0),
        pose_event(6 * S, 2, 2, 0.5),
    ] {
        spool.record(&event).unwrap();
    }
    let summary = spool.write_tum(&path, &[keyframe(2, 0.0), keyframe(3, 100.0), keyframe(4, 200.0)]).unwrap();
    let x: Vec<f64> = lines(&path).iter().map(|l| l.1).collect();
    assert_eq!(x, [30.0, 105.0, 105.0, 200.5, 0.5], "20 (1 + 0.5); 100 + 10 * 0.5; ...");
    assert_eq!((summary.map, summary.other_maps, summary.poses_in_other_maps), (Some(MapId(2)), 1, 1));
}

#[test]
fn what_was_recorded_before_a_map_was_scaled_is_written_in_the_unit_of_the_end() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("t.txt");
    let mut spool = TrajectorySpool::create(dir.path()).unwrap();
    let scaled = |keyframe, scale| TrajectoryEvent::KeyframeScaled { keyframe: KeyframeId(keyframe), scale };
    for event in [
        pose_event(S, 0, 1, 0.5),
        // It becomes metric: another map, four times as long; then that one is refined.
        TrajectoryEvent::MapJoined { map: MapId(0), into: MapId(1), scale: 4.0 },
        pose_event(2 * S, 1, 1, 0.5),
        removed(7, 1, 0.25),
        scaled(1, 2.0),
        pose_event(3 * S, 1, 1, 0.5),
        scaled(1, 3.0),
        pose_event(4 * S, 1, 1, 0.5),
        scaled(9, 100.0),
    ] {
        spool.record(&event).unwrap();
    }
    let summary = spool.write_tum(&path, &[keyframe(1, 100.0)]).unwrap();
    let x: Vec<f64> = lines(&path).iter().map(|l| l.1).collect();
    assert_eq!(x, [112.0, 103.0, 101.5, 100.5], "0.5 times 4 * 2 * 3, 2 * 3, 3 and 1");
    assert_eq!((summary.map, summary.other_maps), (Some(MapId(1)), 0));
}

#[test]
fn what_was_recorded_before_a_loop_was_closed_is_in_the_unit_after_it() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("t.txt");
    let mut spool = TrajectorySpool::create(dir.path()).unwrap();
    let scaled = |keyframe, scale| TrajectoryEvent::KeyframeScaled { keyframe: KeyframeId(keyframe), scale };
    for event in [
        pose_event(S, 0, 1, 0.5),
        pose_event(2 * S, 0, 2, 0.5),
        scaled(1, 2.0),
        pose_event(3 * S, 0, 1, 0.5),
        removed(1, 2, 1.0),
        scaled(2, 10.0),
        pose_event(4 * S, 0, 2, 0.5),
        scaled(2, 3.0),
    ] {
        spool.record(&event).unwrap();
    }
    spool.write_tum(&path, &[keyframe(2, 100.0)]).unwrap();
    let x: Vec<f64> = lines(&path).iter().map(|l| l.1).collect();
    assert_eq!(x, [160.0, 115.0, 145.0, 101.5], "30 (1 + 2 * 0.5); 30 * 0.5; 30 (1 + 0.5); 3 * 0.5");
}

#[test]
fn keyframes_of_an_ended_map_keep_their_last_pose() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("t.txt");
    let mut spool = TrajectorySpool::create(dir.path()).unwrap();
    let (retired, pose) = keyframe(2, 20.0);
    for event in [
        pose_event(S, 0, 1, 0.5),
        pose_event(2 * S, 0, 2, 0.25),
        removed(1, 2, 1.0),
        TrajectoryEvent::KeyframeRetired { keyframe: retired, world_from_camera: pose },
        pose_event(3 * S, 1, 3, 0.0),
    ] {
        spool.record(&event).unwrap();
    }
    let summary = spool.write_tum(&path, &[keyframe(3, 0.0)]).unwrap();
    assert_eq!(lines(&path), [("1.000000".into(), 21.5), ("2.000000".into(), 20.25)]);
    assert_eq!((summary.map, summary.poses_in_other_maps, summary.poses_unresolved), (Some(MapId(0)), 1, 0));
}

#[test]
fn long_runs_stream_through_the_file() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("t.txt");
    let mut spool = TrajectorySpool::create(dir.path()).unwrap();
    const FRAMES: i64 = 10_000;
    for i in 0..FRAMES {
        spool.record(&pose_event(i * 33_333_000, 0, 1, i as f64)).unwrap();
    }
    let summary = spool.write_tum(&path, &[keyframe(1, 0.0)]).unwrap();
    assert_eq!(summary.poses_written, FRAMES as u64);
    for (i, (time, x)) in lines(&path).into_iter().enumerate() {
        assert_eq!((time, x), (format_timestamp(i as i64 * 33_333_000), i as f64));
    }
}

#[test]
fn nothing_is_left_behind_and_nothing_is_lost_when_the_output_cannot_be_written() {
    let dir = tempfile::tempdir().unwrap();
    let mut spool = TrajectorySpool::create(dir.path()).unwrap();
    spool.record(&pose_event(S, 0, 1, 0.0)).unwrap();
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0, "the temporary file has no name");
    let error = spool.write_tum(Path::new("/dev/full"), &[keyframe(1, 0.0)]).unwrap_err();
    assert!(error.to_string().contains("/dev/full") && error.to_string().contains("No space left"), "{error}");
    let path = dir.path().join("t.txt");
    assert_eq!(spool.write_tum(&path, &[keyframe(1, 0.0)]).unwrap().poses_written, 1);
    drop(spool);
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
    let missing = dir.path().join("missing");
    assert!(TrajectorySpool::create(&missing).unwrap_err().to_string().contains("missing"));
}

#[test]
fn a_run_without_poses_writes_an_empty_file_over_an_old_one() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("t.txt");
    std::fs::write(&path, "0 0 0 0 0 0 0 1\n").unwrap();
    let summary = TrajectorySpool::create(dir.path()).unwrap().write_tum(&path, &[]).unwrap();
    assert_eq!(summary, TrajectorySummary::default());
    assert_eq!(std::fs::read(&path).unwrap(), b"");
}

fn estimate(i: i64, map: u32, state: TrackingState, pose: Option<Se3<World, Camera>>) -> PoseEstimate {
    PoseEstimate {
        sequence: i as u64,
        timestamp_ns: i * S,
        state,
        world_from_camera: pose,
        odom_from_camera: pose.map(|pose| pose.relabel()),
        map: MapId(map),
        reset_counter: map,
        ..PoseEstimate::default()
    }
}

#[test]
fn the_live_trajectory_holds_what_was_published_and_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("live.txt");
    let mut live = LiveTrajectory::create(dir.path()).unwrap();
    live.record(&estimate(0, 0, TrackingState::Initializing, None)).unwrap();
    live.record(&estimate(1, 0, TrackingState::Tracking, Some(at(1.0, 0.2)))).unwrap();
    live.record(&estimate(2, 0, TrackingState::Lost, Some(at(2.0, 0.2)))).unwrap();
    live.record(&estimate(3, 1, TrackingState::Tracking, Some(at(3.0, 0.2)))).unwrap();
    live.record(&estimate(4, 1, TrackingState::Tracking, Some(at(4.0, 0.2)))).unwrap();
    let summary = live.write_tum(&path).unwrap();
    assert_eq!(lines(&path), [("3.000000".into(), 3.0), ("4.000000".into(), 4.0)]);
    assert_eq!((summary.map, summary.poses_in_other_maps), (Some(MapId(1)), 1));
    let mut expected = Vec::new();
    write_tum_line(&mut expected, 4 * S, &at(4.0, 0.2)).unwrap();
    assert!(std::fs::read(&path).unwrap().ends_with(&expected), "bit for bit the published pose");
}

#[test]
fn odometry_has_every_frame_with_its_state_and_says_where_it_begins_anew() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("odometry.txt");
    let mut log = OdometryLog::create(dir.path()).unwrap();
    log.record(&estimate(0, 0, TrackingState::Initializing, None)).unwrap();
    log.record(&estimate(1, 0, TrackingState::Tracking, Some(at(1.0, 0.2)))).unwrap();
    log.record(&estimate(2, 0, TrackingState::DeadReckoning, Some(at(2.0, 0.2)))).unwrap();
    log.record(&estimate(3, 1, TrackingState::Lost, None)).unwrap();
    for _ in 0..2 {
        assert_eq!(log.write(&path).unwrap(), OdometrySummary { frames_lost: 0 });
    }
    let text = std::fs::read_to_string(&path).unwrap();
    let told: Vec<&str> =
        text.lines().filter(|line| !line.starts_with("# axes") && !line.starts_with("# odom")).collect();
    assert_eq!(told.len(), 6, "{text}");
    assert_eq!(
        (told[0], told[4]),
        ("# reset counter 0, lengths in map units", "# reset counter 1, lengths in map units")
    );
    assert_eq!(told[1], "0.000000 nan nan nan nan nan nan nan INITIALIZING");
    assert!(told[2].starts_with("1.000000 1.0") && told[2].ends_with(" TRACKING"));
    assert!(told[3].starts_with("2.000000 2.0") && told[3].ends_with(" DEAD_RECKONING"));
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "nothing else is left in the folder");
    assert!(OdometryLog::create(&dir.path().join("none")).is_err());
}
