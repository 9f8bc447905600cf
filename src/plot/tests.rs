use super::axes::{Axes, Range, ticks};
use super::canvas::Area;
use super::*;
use crate::geometry::Se3;
use crate::map::{KeyframeId, KeyframeView, LandmarkId, LandmarkView, MapId, MapSnapshot};
use crate::trajectory::TumPose;
use nalgebra::{UnitQuaternion, Vector3};
use std::path::PathBuf;

/// Where a picture goes: kept for a look when `CAIRN_KEEP_PICTURES` names a folder.
fn place(dir: &tempfile::TempDir, name: &str) -> PathBuf {
    std::env::var_os("CAIRN_KEEP_PICTURES").map_or_else(|| dir.path().to_path_buf(), PathBuf::from).join(name)
}

fn picture_size(path: &Path) -> (u32, u32) {
    let decoder = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(path).unwrap()));
    let mut reader = decoder.read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    (info.width, info.height)
}

fn noise(i: usize, k: usize) -> f64 {
    // A cheap hash, the same everywhere: splitmix64's finaliser.
    let mut z = (i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (k as u64).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64 - 0.5
}

fn drive(n: usize) -> Vec<TumPose> {
    (0..n)
        .map(|i| {
            let a = 6.0 * i as f64 / n as f64;
            let turn = UnitQuaternion::from_euler_angles(0.0, 0.9 * (1.1 * a).sin(), 0.0);
            let position = Vector3::new(1.4 * (a.cos() - 1.0), 0.08 * (5.0 * a).sin(), 1.2 * a.sin() + 0.35 * a);
            TumPose { timestamp_ns: i as i64 * 33_333_000, world_from_camera: Se3::new(turn, position) }
        })
        .collect()
}

/// A room's walls around [`drive`], with a few landmarks far out.
fn room() -> (MapSnapshot, Vec<TumPose>) {
    let trajectory = drive(900);
    let landmark = |i: usize| {
        let (u, v, w) = (noise(i, 1), noise(i, 2), noise(i, 3));
        let position_world = match i % 5 {
            0 => Vector3::new(-4.5 + 0.05 * w, 2.0 * v, 6.0 * u + 2.0),
            1 => Vector3::new(2.5 + 0.05 * w, 2.0 * v, 6.0 * u + 2.0),
            2 => Vector3::new(7.0 * u - 1.0, 2.0 * v, 5.5 + 0.3 * w),
            3 => Vector3::new(1.5 * (u * 9.0).sin(), 0.9 + 0.04 * w, 4.0 * v + 2.0),
            _ if i % 250 == 4 => Vector3::new(60.0 * u, 40.0 * v, 90.0 * w),
            _ => Vector3::new(1.2 * u - 2.0, 0.5 * v + 0.4, 1.0 * w + 3.6),
        };
        LandmarkView { id: LandmarkId(i as u32), position_world, sigma: 0.02, observations: 3 }
    };
    let keyframe = |(i, p): (usize, &TumPose)| KeyframeView {
        id: KeyframeId(i as u32),
        timestamp_ns: p.timestamp_ns,
        world_from_camera: p.world_from_camera,
    };
    let map = MapSnapshot {
        map: MapId(0),
        scale: Default::default(),
        revision: 1,
        landmarks: (0..3000).map(landmark).collect(),
        keyframes: trajectory.iter().step_by(25).enumerate().map(keyframe).collect(),
        around: Default::default(),
        left_out: [0; 2],
    };
    (map, trajectory)
}

fn compared(truth: &[TumPose], has_pose: impl Fn(usize) -> bool) -> Comparison {
    let frame = |(i, p): (usize, &TumPose)| ComparedFrame {
        timestamp_ns: p.timestamp_ns,
        truth: p.world_from_camera.translation,
        covered: has_pose(i),
    };
    let pose = |(i, p): (usize, &TumPose)| {
        let jitter = 0.004 * Vector3::new(noise(i, 1), noise(i, 2), noise(i, 3));
        let drift = Vector3::new(0.02, 0.01, -0.01) * (i as f64 / 300.0).sin();
        ComparedPose {
            timestamp_ns: p.timestamp_ns,
            position: p.world_from_camera.translation + jitter + drift,
            position_error_m: (jitter + drift).norm(),
            rotation_error_deg: (2.0 * jitter + 0.3 * drift).norm().to_degrees(),
        }
    };
    let poses: Vec<_> = truth.iter().enumerate().filter(|(i, _)| has_pose(*i)).map(pose).collect();
    let range = |value: fn(&ComparedPose) -> f64| {
        let max = poses.iter().map(value).reduce(f64::max)?;
        let squares: f64 = poses.iter().map(|p| value(p) * value(p)).sum();
        Some(ErrorRange { rmse: (squares / poses.len() as f64).sqrt(), max })
    };
    Comparison {
        facts: vec![("ATE RMSE", "19.04 mm".into()), ("coverage", "93.1 % of 900 frames".into())],
        frames: truth.iter().enumerate().map(frame).collect(),
        position_m: range(|p| p.position_error_m),
        rotation_deg: range(|p| p.rotation_error_deg),
        without_errors: "no errors: no pose has ground truth".into(),
        poses,
    }
}

#[test]
fn an_overview_is_a_picture_and_the_same_one_every_time() {
    let dir = tempfile::tempdir().unwrap();
    let (map, trajectory) = room();
    let (a, b) = (place(&dir, "overview.png"), dir.path().join("again.png"));
    write_overview(&a, &map, &trajectory, LengthUnit::MapUnits, "A room, seeded").unwrap();
    write_overview(&b, &map, &trajectory, LengthUnit::MapUnits, "A room, seeded").unwrap();
    assert_eq!(picture_size(&a).0, 1800);
    assert_eq!(std::fs::read(&a).unwrap(), std::fs::read(&b).unwrap());
}

#[test]
fn a_comparison_is_a_picture() {
    let dir = tempfile::tempdir().unwrap();
    let path = place(&dir, "comparison.png");
    let comparison = compared(&drive(900), |i| i > 20 && !(400..440).contains(&i) && i != 700);
    write_comparison(&path, &comparison, "drive, seeded").unwrap();
    assert_eq!(picture_size(&path), (1800, 1160));
}

#[test]
fn nothing_to_draw_is_drawn_without_complaint() {
    let dir = tempfile::tempdir().unwrap();
    let path = place(&dir, "nothing.png");
    write_overview(&path, &MapSnapshot::default(), &[], LengthUnit::Metres, "").unwrap();
    // Not finite, all in one place, one keyframe only.
    let bad = Se3::new(UnitQuaternion::identity(), Vector3::new(f64::NAN, 0.0, f64::INFINITY));
    let mut map = MapSnapshot::default();
    for (id, world_from_camera) in [(1, bad), (2, Se3::identity())] {
        map.keyframes.push(KeyframeView { id: KeyframeId(id), timestamp_ns: i64::MAX, world_from_camera });
    }
    for x in [f64::NAN, 0.0, 0.0, 1e300] {
        let position_world = Vector3::new(x, 0.0, 0.0);
        map.landmarks.push(LandmarkView { id: LandmarkId(0), position_world, sigma: f32::NAN, observations: 0 });
    }
    write_overview(&path, &map, &[], LengthUnit::MapUnits, "bad").unwrap();
    assert_eq!(picture_size(&path).0, 1800);

    let comparison = compared(&drive(50), |_| false);
    write_comparison(&place(&dir, "no-estimate.png"), &comparison, "no poses at all").unwrap();
}

#[test]
fn a_full_disk_is_a_named_error() {
    let (map, trajectory) = room();
    let error = write_overview(Path::new("/dev/full"), &map, &trajectory, LengthUnit::MapUnits, "").unwrap_err();
    assert!(error.to_string().contains("/dev/full"), "{error}");
}

#[test]
fn equal_lengths_are_equal_in_both_directions() {
    let area = Area { left: 10.0, top: 20.0, right: 410.0, bottom: 220.0 };
    for (x, y) in [((0.0, 1.0), (0.0, 5.0)), ((-3.0, 9.0), (2.0, 2.5))] {
        let range = |(min, max)| Range { min, max };
        let axes = Axes::equal(area, range(x), range(y));
        let (a, b, c) = (axes.place(0.0, 0.0), axes.place(1.0, 0.0), axes.place(0.0, 1.0));
        assert!(((b.0 - a.0) - (a.1 - c.1)).abs() < 1e-3, "{a:?} {b:?} {c:?}");
        assert!(area.contains(axes.place(x.0, y.0)) && area.contains(axes.place(x.1, y.1)));
    }
}

#[test]
fn ticks_are_round_few_and_inside() {
    let texts = |min, max, n| ticks(&Range { min, max }, n).into_iter().map(|t| t.1).collect::<Vec<_>>();
    assert_eq!(texts(0.0, 1.0, 5.0), ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]);
    assert_eq!(texts(-30.0, 45.0, 4.0), ["-20", "0", "20", "40"]);
    assert_eq!(texts(0.0012, 0.0028, 3.0), ["0.0015", "0.0020", "0.0025"]);
    for (min, max) in [(0.0, 0.0), (f64::NAN, 1.0), (0.0, f64::INFINITY), (1e300, 1.0000001e300)] {
        assert!(ticks(&Range { min, max }, 5.0).len() < 50);
    }
}
