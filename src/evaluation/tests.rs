use super::association::associate;
use super::metrics::angle_deg;
use super::*;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::trajectory::{read_tum, write_tum};
use nalgebra::{UnitQuaternion, Vector3};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use std::path::PathBuf;

const FRAME_NS: i64 = 33_333_000;

fn pose(timestamp_ns: i64, rotation: UnitQuaternion<f64>, position: Vector3<f64>) -> TumPose {
    TumPose { timestamp_ns, world_from_camera: Se3::new(rotation, position) }
}

/// A winding path with turning camera, `n` frames at 30 Hz, about 3 m a turn.
fn winding(n: usize) -> Vec<TumPose> {
    let at = |i: usize| {
        let a = 0.03 * i as f64;
        let rotation = UnitQuaternion::from_euler_angles(0.2 * a.sin(), 0.4 * a, 0.1 * (1.7 * a).cos());
        pose(i as i64 * FRAME_NS, rotation, Vector3::new(a.cos(), 0.3 * (2.0 * a).sin(), 0.8 * a.sin() + 0.1 * a))
    };
    (0..n).map(at).collect()
}

/// What a monocular system would make of `truth`: another world, another unit.
fn in_other_world(truth: &[TumPose], scale: f64, rotation: UnitQuaternion<f64>, shift: Vector3<f64>) -> Vec<TumPose> {
    let moved = |p: &TumPose| {
        let w = p.world_from_camera;
        pose(p.timestamp_ns, rotation * w.rotation, scale * (rotation * w.translation) + shift)
    };
    truth.iter().map(moved).collect()
}

fn reference(ground_truth: Vec<TumPose>, frames: Option<Vec<i64>>) -> Reference {
    let frames_path = frames.is_some().then(|| PathBuf::from("rgb.txt"));
    let ground_truth_path = PathBuf::from("groundtruth.txt");
    Reference { ground_truth_path, ground_truth, frames_path, frames, notes: Vec::new() }
}

fn times(poses: &[TumPose]) -> Vec<i64> {
    poses.iter().map(|p| p.timestamp_ns).collect()
}

fn any_rotation() -> impl Strategy<Value = UnitQuaternion<f64>> {
    (-3.1..3.1_f64, -1.5..1.5_f64, -3.1..3.1_f64).prop_map(|(r, p, y)| UnitQuaternion::from_euler_angles(r, p, y))
}

fn seeded(cases: u32) -> ProptestConfig {
    ProptestConfig { cases, rng_seed: RngSeed::Fixed(5), failure_persistence: None, ..Default::default() }
}

#[test]
fn a_perfect_estimate_in_any_world_and_unit_has_no_error() {
    proptest!(seeded(40), |(rotation in any_rotation(), scale in 0.01..100.0_f64, shift in -50.0..50.0_f64, n in 4..300_usize)| {
        let truth = winding(n);
        let estimate = in_other_world(&truth, scale, rotation, Vector3::new(shift, -shift, 1.0));
        let figures = evaluate(&estimate, &reference(truth.clone(), Some(times(&truth)))).unwrap().figures;
        prop_assert_eq!(figures.coverage_percent, 100.0);
        prop_assert!(figures.ate_m.unwrap().max < 1e-9, "{:?}", figures.ate_m);
        prop_assert!(figures.rotation_deg.unwrap().max < 1e-5, "{:?}", figures.rotation_deg);
        prop_assert!((figures.alignment.unwrap().scale * scale - 1.0).abs() < 1e-9);
        if let Some(relative) = figures.relative {
            prop_assert!(relative.translation_percent.max < 1e-6);
        }
    });
}

#[test]
fn the_alignment_is_the_best_one() {
    // Umeyama's result is a minimum: no small change of the seven parameters makes the error smaller.
    proptest!(seeded(30), |(noise in 0.001..0.3_f64, axis in 0..7_usize, sign in prop::bool::ANY)| {
        let truth = winding(120);
        let mut estimate = in_other_world(&truth, 2.0, UnitQuaternion::from_euler_angles(1.0, 0.5, -2.0), Vector3::x());
        for (i, p) in estimate.iter_mut().enumerate() {
            let a = i as f64;
            p.world_from_camera.translation += noise * Vector3::new((7.1 * a).sin(), (5.3 * a).cos(), (3.7 * a).sin());
        }
        let pairs = associate(&truth, &estimate, None).pairs;
        let best = alignment::align(&pairs).unwrap().truth_from_estimate;
        let cost = |a: &alignment::TruthFromEstimate| absolute_errors(&pairs, a).iter().map(|s| s.position_error_m.powi(2)).sum::<f64>();
        let step = if sign { 1e-3 } else { -1e-3 };
        let mut other = best;
        match axis {
            0..=2 => other.translation[axis] += step,
            3..=5 => {
                let mut w = Vector3::zeros();
                w[axis - 3] = step;
                other.rotation = UnitQuaternion::from_scaled_axis(w) * best.rotation;
            }
            _ => other.scale *= 1.0 + step,
        }
        prop_assert!(cost(&other) > cost(&best));
    });
}

#[test]
fn without_a_scale_the_error_is_that_of_the_estimates_own_metres() {
    let truth = winding(200);
    let rotation = UnitQuaternion::from_euler_angles(0.3, -0.5, 2.0);
    let estimate = in_other_world(&truth, 1.02, rotation, Vector3::new(3.0, -2.0, 1.0));
    let outcome = evaluate(&estimate, &reference(truth.clone(), Some(times(&truth)))).unwrap();
    assert!(outcome.figures.ate_m.unwrap().max < 1e-9, "with a scale it is perfect");
    let metric = outcome.metric.unwrap();
    assert!((metric.scale - 1.0 / 1.02).abs() < 1e-9, "{}", metric.scale);
    // Laid mean upon mean, each position is off by 2 % of its distance from the mean.
    let mean = truth.iter().map(|p| p.world_from_camera.translation).sum::<Vector3<f64>>() / 200.0;
    let spread = truth.iter().map(|p| (p.world_from_camera.translation - mean).norm_squared()).sum::<f64>() / 200.0;
    assert!((metric.ate_m.rmse - 0.02 * spread.sqrt()).abs() < 1e-9, "{}", metric.ate_m.rmse);
    let percent = metric.relative.unwrap().translation_percent.mean;
    // Of the straight way between the ends of a metre of a winding path, which is a little shorter.
    assert!((1.7..2.0).contains(&percent), "{percent} %");
}

#[test]
fn mirrored_positions_are_not_aligned_by_a_reflection() {
    let truth = winding(100);
    let mut estimate = truth.clone();
    for p in &mut estimate {
        p.world_from_camera.translation.z *= -1.0;
    }
    let figures = evaluate(&estimate, &reference(truth, None)).unwrap().figures;
    assert!(figures.ate_m.unwrap().rmse > 0.1, "{:?}", figures.ate_m);
}

#[test]
fn on_a_straight_line_the_orientations_choose_the_roll_and_the_error_stays_the_smallest() {
    proptest!(seeded(40), |(rotation in any_rotation(), scale in 0.1..10.0_f64, noise in 0.0..0.05_f64)| {
        let truth: Vec<_> = (0..100)
            .map(|i| {
                let a = 0.1 * i as f64;
                let turn = UnitQuaternion::from_euler_angles(0.3 * a.sin(), 0.1, 0.2 * a.cos());
                pose(i * FRAME_NS, turn, Vector3::new(0.15 * i as f64, 0.0, 0.0))
            })
            .collect();
        let mut noisy = truth.clone();
        for (i, p) in noisy.iter_mut().enumerate() {
            p.world_from_camera.translation += noise * Vector3::new(0.0, (7.0 * i as f64).sin(), (9.0 * i as f64).cos());
        }
        let estimate = in_other_world(&noisy, scale, rotation, Vector3::y());
        let outcome = evaluate(&estimate, &reference(truth.clone(), None)).unwrap();
        let (ate, angle) = (outcome.figures.ate_m.unwrap(), outcome.figures.rotation_deg.unwrap());
        // The noise is across the line, so it is what remains, but for a little that tilting the line takes away.
        let across = |a: &TumPose| a.world_from_camera.translation.yz().norm_squared();
        let remaining = (noisy.iter().map(across).sum::<f64>() / 100.0).sqrt();
        prop_assert!(ate.rmse <= remaining + 1e-9 && ate.rmse >= 0.9 * remaining, "{ate:?} {remaining}");
        prop_assert!(angle.rmse < 1e-4 + 10.0 * noise, "{angle:?}");
        prop_assert!(outcome.figures.notes.iter().any(|n| n.contains("straight line")), "{:?}", outcome.figures.notes);
    });
}

#[test]
fn a_line_run_backwards_is_turned_round() {
    let truth: Vec<_> =
        (0..10).map(|i| pose(i * FRAME_NS, UnitQuaternion::identity(), Vector3::x() * i as f64)).collect();
    let turn = UnitQuaternion::from_euler_angles(0.0, 0.0, std::f64::consts::PI);
    let figures =
        evaluate(&in_other_world(&truth, 1.0, turn, Vector3::zeros()), &reference(truth, None)).unwrap().figures;
    assert!(figures.ate_m.unwrap().max < 1e-12 && figures.rotation_deg.unwrap().max < 1e-6, "{figures:?}");
}

#[test]
fn what_cannot_be_aligned_has_coverage_and_a_reason_but_no_error() {
    let truth = winding(50);
    let still: Vec<_> = truth.iter().map(|p| pose(p.timestamp_ns, UnitQuaternion::identity(), Vector3::x())).collect();
    for (estimate, ground_truth, coverage, reason) in [
        (vec![], truth.clone(), 0.0, "0 poses"),
        (truth[..2].to_vec(), truth.clone(), 4.0, "2 poses"),
        (still.clone(), truth.clone(), 100.0, "the estimate stands still"),
        (truth.clone(), still.clone(), 100.0, "the ground truth stands still"),
    ] {
        let reference = reference(ground_truth, Some(times(&truth)));
        let outcome = evaluate(&estimate, &reference).unwrap();
        let figures = outcome.figures;
        assert_eq!(figures.coverage_percent, coverage, "{reason}");
        assert!(figures.ate_m.is_none() && figures.rotation_deg.is_none() && figures.relative.is_none(), "{reason}");
        assert!(figures.notes.iter().any(|n| n.contains(reason)), "{:?}", figures.notes);
        assert!(outcome.samples.is_empty());
    }
}

#[test]
fn coverage_counts_every_frame_that_has_ground_truth() {
    // Ground truth at 100 Hz from 0 to 1 s; frames every 50 ms from -0.1 s to 1.2 s; poses from the seventh frame on,
    // but for three.
    const MS: i64 = 1_000_000;
    let still =
        |t: i64| pose(t, UnitQuaternion::identity(), Vector3::new(t as f64 * 1e-9, (t as f64 * 1e-8).sin(), 0.0));
    let truth: Vec<_> = (0..=100).map(|i| still(i * 10 * MS)).collect();
    let frames: Vec<_> = (-2..=24).map(|i| i * 50 * MS).collect();
    let mut estimate: Vec<_> = frames.iter().skip(6).map(|t| still(*t)).collect();
    estimate.drain(4..7);
    let figures = evaluate(&estimate, &reference(truth.clone(), Some(frames.clone()))).unwrap().figures;
    assert_eq!((figures.expected, figures.frames_without_truth), (21, 6), "0..1 s has ground truth");
    assert_eq!(figures.covered, 21 - 4 - 3);
    assert_eq!((figures.longest_gap, figures.poses_without_truth), (3, 4));
    assert!((figures.first_pose_after_s.unwrap() - 0.2).abs() < 1e-12);

    // Stray and doubled poses raise nothing.
    estimate.push(still(512 * MS));
    estimate.push(still(700 * MS + 400_000));
    estimate.sort_by_key(|p| p.timestamp_ns);
    let with_strays = evaluate(&estimate, &reference(truth, Some(frames))).unwrap().figures;
    assert_eq!((with_strays.covered, with_strays.poses_without_frame), (figures.covered, 2));
}

#[test]
fn ground_truth_21_ms_away_does_not_count_and_20_ms_does() {
    const MS: i64 = 1_000_000;
    let truth = winding(2).into_iter().map(|mut p| {
        p.timestamp_ns = if p.timestamp_ns == 0 { 0 } else { 1000 * MS };
        p
    });
    let truth: Vec<_> = truth.collect();
    let association = associate(&truth, &[], Some(&[-21 * MS, -20 * MS, 20 * MS, 21 * MS, 980 * MS]));
    assert_eq!((association.expected.len(), association.frames_without_truth), (3, 2));
}

#[test]
fn without_frames_the_samples_are_the_basis_and_it_is_said() {
    let dir = tempfile::tempdir().unwrap();
    let truth = winding(60);
    let path = dir.path().join("groundtruth.txt");
    write_tum(&path, &truth).unwrap();
    let found = Reference::open(&path, None).unwrap();
    let figures = evaluate(&truth[30..], &found).unwrap().figures;
    assert_eq!(figures.coverage_basis, CoverageBasis::GroundTruthSamples);
    assert_eq!((figures.expected, figures.covered), (60, 30), "samples are 33 ms apart");
    assert!(figures.notes.iter().any(|n| n.contains("no rgb.txt")), "{:?}", figures.notes);
}

#[test]
fn the_frames_beside_a_ground_truth_file_are_used_and_named() {
    let dir = tempfile::tempdir().unwrap();
    let truth = winding(60);
    let path = dir.path().join("groundtruth.txt");
    write_tum(&path, &truth).unwrap();
    std::fs::write(dir.path().join("rgb.txt"), "# t name\n0.000000 a.png\n0.033333 b.png\n0.066666 c.png\n").unwrap();
    for (place, noted) in [(path.as_path(), true), (dir.path(), false)] {
        let found = Reference::open(place, None).unwrap();
        let figures = evaluate(&truth[..2], &found).unwrap().figures;
        assert_eq!((figures.expected, figures.covered, figures.coverage_basis), (3, 2, CoverageBasis::Frames));
        assert_eq!(figures.notes.iter().any(|n| n.contains("rgb.txt")), noted, "{:?}", figures.notes);
    }
    // Frames of another recording: an error, not 0 %.
    std::fs::write(dir.path().join("rgb.txt"), "1305031102.175304 a.png\n").unwrap();
    let error = evaluate(&truth, &Reference::open(dir.path(), None).unwrap()).unwrap_err().to_string();
    assert!(error.contains("rgb.txt") && error.contains("belong together"), "{error}");
}

#[test]
fn statistics_are_those_of_the_textbook() {
    let s = metrics::statistics(&[3.0, 1.0, 2.0, 10.0]).unwrap();
    assert_eq!((s.rmse, s.mean, s.median, s.max), (28.5_f64.sqrt(), 4.0, 2.5, 10.0));
    assert_eq!(metrics::statistics(&[5.0]).unwrap().median, 5.0);
    assert_eq!(metrics::statistics(&[]), None);
    for degrees in [1e-7, 0.5, 90.0, 179.9] {
        let q = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), f64::to_radians(degrees));
        assert!((angle_deg(&q) / degrees - 1.0).abs() < 1e-9, "{degrees}");
        assert!((angle_deg(&UnitQuaternion::new_unchecked(-q.into_inner())) / degrees - 1.0).abs() < 1e-9);
    }
}

#[test]
fn relative_error_of_a_wrong_scale_is_that_share_of_the_path() {
    // Straight for 10 m in steps of 10 cm; the second half is 5 % too long: 1 m segments there are 5 cm off once the
    // scale of the first half is fitted.
    let truth: Vec<_> =
        (0..=100).map(|i| pose(i * FRAME_NS, UnitQuaternion::identity(), Vector3::x() * (0.1 * i as f64))).collect();
    let samples: Vec<_> = truth
        .iter()
        .map(|p| {
            let x = p.world_from_camera.translation.x;
            let stretched = if x > 5.0 { 5.0 + 1.05 * (x - 5.0) } else { x };
            let estimate: Se3<World, Camera> = Se3::new(UnitQuaternion::identity(), Vector3::x() * stretched);
            Sample {
                timestamp_ns: p.timestamp_ns,
                truth: p.world_from_camera,
                estimate,
                position_error_m: 0.0,
                rotation_error_deg: 0.0,
            }
        })
        .collect();
    let segments = relative_errors(&samples);
    // 91 starts have a full metre, one more has 0.9 m left.
    assert_eq!(segments.len(), 92);
    assert!(segments[..40].iter().all(|s| s.translation_error_m < 1e-12 && (s.length_m - 1.0).abs() < 1e-9));
    assert!(segments[51..90].iter().all(|s| (s.translation_error_m - 0.05).abs() < 1e-9));
}

/// The data folder, or `None` with a message.
fn data() -> Option<PathBuf> {
    let folder = std::env::var_os("CAIRN_DATA")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let found = folder.join("tum_fr1_xyz/groundtruth.txt").is_file();
    if !found {
        println!("skipped: no tum_fr1_xyz in {}", folder.display());
    }
    found.then_some(folder)
}

/// A bad estimate of every frame of `tum_fr1_xyz` but some: scaled, turned, drifting, jittering, without randomness.
fn bad_estimate(reference: &Reference) -> Vec<TumPose> {
    let frames = reference.frames.as_deref().unwrap_or_default();
    let truth: Vec<_> = associate(&reference.ground_truth, &frames_as_poses(frames), Some(frames)).pairs;
    let turn = UnitQuaternion::from_euler_angles(2.0, -0.7, 0.4);
    truth
        .iter()
        .enumerate()
        .filter(|(i, _)| *i >= 12 && i % 50 != 7 && !(300..330).contains(i))
        .map(|(i, pair)| {
            let a = i as f64;
            let jitter = Vector3::new((12.9898 * a).sin(), (78.233 * a).sin(), (37.719 * a).sin());
            let drift = Vector3::new(0.03 * (a / 800.0), 0.02 * (a / 300.0).sin(), -0.01);
            let spin = UnitQuaternion::from_scaled_axis(0.01 * jitter.yzx() + Vector3::new(0.0, 0.02 * a / 800.0, 0.0));
            let position = pair.truth.translation + 0.004 * jitter + drift;
            pose(
                pair.timestamp_ns,
                turn * pair.truth.rotation * spin,
                0.37 * (turn * position) + Vector3::new(1.0, 2.0, 3.0),
            )
        })
        .collect()
}

fn frames_as_poses(frames: &[i64]) -> Vec<TumPose> {
    frames.iter().map(|t| pose(*t, UnitQuaternion::identity(), Vector3::zeros())).collect()
}

/// The independent judge's figures for [`bad_estimate`]: evo 1.38.1, `--t_max_diff 0.02`;
/// `evo_ape tum groundtruth.txt bad.txt -as`, the same with `-r angle_deg`, and
/// `evo_rpe tum groundtruth.txt bad.txt -as -d 1 -u m --all_pairs --pairs_from_reference` (and `-r angle_deg`).
/// Without a scale the first and the last of these with `-a` in the place of `-as`.
#[test]
fn the_figures_are_those_of_evo_on_a_noisy_trajectory() {
    let Some(folder) = data() else { return };
    let reference = Reference::open(&folder.join("tum_fr1_xyz"), None).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let path = std::env::var_os("CAIRN_WRITE_BAD_ESTIMATE").map_or_else(|| dir.path().join("bad.txt"), PathBuf::from);
    write_tum(&path, &bad_estimate(&reference)).unwrap();
    let Outcome { figures, metric, .. } = evaluate(&read_tum(&path).unwrap(), &reference).unwrap();
    assert_eq!((figures.expected, figures.covered, figures.matched_poses), (796, 740, 740));
    let evo = [
        (
            figures.ate_m.unwrap(),
            [0.011113563216685064, 0.010251165768034826, 0.009884980902282861, 0.02483312696520448],
        ),
        (
            figures.rotation_deg.unwrap(),
            [1.4513459652654903, 1.3774682605823885, 1.3623959864496547, 2.418683592923425],
        ),
    ];
    let relative = figures.relative.unwrap();
    assert_eq!(relative.segments, 605);
    let evo_relative = [
        (relative.translation_percent, [0.9492839897395333, 0.8952896742019, 0.8810315990161391, 2.0909894412423875]),
        (relative.rotation_deg_per_m, [1.0480107653672988, 0.9845654418958223, 1.0257978406758517, 1.783117316507788]),
    ];
    let metric = metric.unwrap();
    let evo_metric = [
        (metric.ate_m, [0.11369231016591005, 0.10130039407619933, 0.09528862775956365, 0.23828232316979212]),
        (
            metric.relative.unwrap().translation_percent,
            [12.001280970582323, 9.565528518659937, 7.561748415513717, 23.749554264193753],
        ),
    ];
    for (ours, theirs) in evo.into_iter().chain(evo_relative).chain(evo_metric) {
        for (a, b) in [ours.rmse, ours.mean, ours.median, ours.max].into_iter().zip(theirs) {
            assert!((a - b).abs() < 1e-9, "{a} {b}");
        }
    }
    assert!((figures.alignment.unwrap().scale - 2.702978761465621).abs() < 1e-9);
    assert!((metric.scale - 2.702978761465621).abs() < 1e-9);
}
