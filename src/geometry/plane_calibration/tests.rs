//! Jacobians against differences, recovery without noise, honest deviations with it, and what bad views do.

use super::*;
use crate::geometry::random::Random;
use nalgebra::{Rotation3, Vector6};

const TRUTH: [f64; PARAMETERS] = [520.0, 522.5, 322.25, 238.5, -0.12, 0.05, 0.0008, -0.0006, 0.004];
const BROWN: LensKind = LensKind::RadialTangential;
const WIDE: LensKind = LensKind::KannalaBrandt;
/// 150 degrees across the diagonal.
const WIDE_TRUTH: [f64; PARAMETERS] = [300.5, 301.3, 323.25, 235.5, 0.03, -0.015, 0.004, -0.001, 0.0];
const SIZE: (u32, u32) = (640, 480);

fn board() -> Vec<Vector2<f64>> {
    (0..6).flat_map(|r| (0..9).map(move |c| Vector2::new(f64::from(c) * 0.025, f64::from(r) * 0.025))).collect()
}

/// A view whose points all lie in the picture.
fn view(random: &mut Random, noise_px: f64) -> View {
    let k = Intrinsics::from(TRUTH);
    for _ in 0..1000 {
        let rotation = Rotation3::from_euler_angles(
            random.uniform(-0.6, 0.6),
            random.uniform(-0.6, 0.6),
            random.uniform(-0.4, 0.4),
        );
        let middle = Vector3::new(0.1, 0.0625, 0.0);
        let place = Vector3::new(random.uniform(-0.14, 0.14), random.uniform(-0.1, 0.1), random.uniform(0.25, 0.5));
        let plane = board();
        let pixels: Vec<_> = plane
            .iter()
            .filter_map(|p| BROWN.project(&k, &(rotation * (Vector3::new(p.x, p.y, 0.0) - middle) + place)))
            .filter(|p| p.x > 4.0 && p.y > 4.0 && p.x < 635.0 && p.y < 475.0)
            .map(|p| p + Vector2::new(random.normal(), random.normal()) * noise_px)
            .collect();
        if pixels.len() == plane.len() {
            return View { plane, pixels, shear: Vec::new() };
        }
    }
    panic!("no view found");
}

fn views(seed: u64, count: usize, noise_px: f64) -> Vec<View> {
    let mut random = Random::new(seed);
    (0..count).map(|_| view(&mut random, noise_px)).collect()
}

#[test]
fn derivatives_are_those_of_differences() {
    let k = Intrinsics::from(TRUTH);
    let p = Vector3::new(0.21, -0.17, 0.6);
    let (_, by_camera, by_pose) = BROWN.project_jacobian(&k, &p).expect("in front");
    for i in 0..PARAMETERS {
        let h = 1e-6 * k[i].abs().max(1.0);
        let (mut up, mut down) = (k, k);
        up[i] += h;
        down[i] -= h;
        let numeric =
            (BROWN.project(&up, &p).expect("in front") - BROWN.project(&down, &p).expect("in front")) / (2.0 * h);
        for axis in 0..2 {
            let error = (by_camera[axis][i] - numeric[axis]).abs();
            assert!(
                error < 1e-5 * numeric.norm().max(1.0),
                "{}: {error}",
                LensKind::RadialTangential.parameter_names()[i]
            );
        }
    }
    for i in 0..6 {
        let moved = |h: f64| {
            let mut d = Vector6::zeros();
            d[i] = h;
            let p = Rotation3::from_scaled_axis(d.fixed_rows::<3>(0).into_owned()) * p + d.fixed_rows::<3>(3);
            BROWN.project(&k, &p).expect("in front")
        };
        let numeric = (moved(1e-6) - moved(-1e-6)) / 2e-6;
        for axis in 0..2 {
            assert!(
                (by_pose[axis][i] - numeric[axis]).abs() < 1e-4,
                "pose {i}: {} {}",
                by_pose[axis][i],
                numeric[axis]
            );
        }
    }
}

#[test]
fn exact_points_give_the_exact_camera() {
    for seed in 1..6 {
        let solved = calibrate(&views(seed, 6, 0.0), SIZE, Distortion::Full).expect("calibrated");
        for i in 0..PARAMETERS {
            let error = (solved.intrinsics[i] - TRUTH[i]).abs();
            assert!(
                error < 1e-4 * TRUTH[i].abs().max(1.0),
                "seed {seed}: {} off by {error}",
                LensKind::RadialTangential.parameter_names()[i]
            );
        }
        assert!(solved.rms_px < 1e-5, "seed {seed}: {}", solved.rms_px);
    }
}

/// Shares of one over seeds, as Markdown.
fn seeded(sets: &str, within: f64, focal_rms: f64) {
    println!("\n| seeded | focal length RMS % | all parameters within one sigma % |\n|---|---:|---:|");
    println!("| {sets} | {:.4} | {:.1} |", 100.0 * focal_rms, 100.0 * within);
}

#[test]
fn twenty_one_views_give_the_focal_length_within_a_thousandth_and_honest_deviations() {
    // Noise of 0.1 px a coordinate: what the detector has on rendered pictures at its worst.
    let (mut within, mut of, mut square) = (0u32, 0u32, 0.0);
    for seed in 0..100 {
        let solved = calibrate(&views(1000 + seed, 21, 0.1), SIZE, Distortion::Full).expect("calibrated");
        let sigmas = solved.sigmas();
        for i in 0..PARAMETERS {
            let inside = (solved.intrinsics[i] - TRUTH[i]).abs() < sigmas[i];
            within += u32::from(inside);
            of += 1;
        }
        square += ((solved.intrinsics[0] - TRUTH[0]) / TRUTH[0]).powi(2);
        assert!(solved.views.iter().all(|v| v.used), "seed {seed}: a good view was left out");
    }
    let share = f64::from(within) / f64::from(of);
    let rms = (square / 100.0f64).sqrt();
    seeded("100 sets of 21 views, 0.1 px of noise", share, rms);
    assert!(rms < 1e-3, "seeds 1000..1100: {rms}");
    assert!((0.60..0.76).contains(&share), "seeds 1000..1100: {share}");
}

/// A view of a wide-angle lens: the board anywhere in the picture, tilted against its own line of sight.
fn wide_view(random: &mut Random, noise_px: f64) -> View {
    let k = Intrinsics::from(WIDE_TRUTH);
    for _ in 0..1000 {
        let mut turn = |range: f64| {
            Rotation3::from_euler_angles(
                random.uniform(-range, range),
                random.uniform(-range, range),
                random.uniform(-0.4, 0.4),
            )
        };
        let (aside, tilt) = (turn(1.1), turn(0.6));
        let middle = Vector3::new(0.1, 0.0625, 0.0);
        let place = aside * Vector3::new(0.0, 0.0, random.uniform(0.12, 0.3));
        let plane = board();
        let pixels: Vec<_> = plane
            .iter()
            .filter_map(|p| WIDE.project(&k, &(aside * (tilt * (Vector3::new(p.x, p.y, 0.0) - middle)) + place)))
            .filter(|p| p.x > 4.0 && p.y > 4.0 && p.x < 635.0 && p.y < 475.0)
            .map(|p| p + Vector2::new(random.normal(), random.normal()) * noise_px)
            .collect();
        if pixels.len() == plane.len() {
            return View { plane, pixels, shear: Vec::new() };
        }
    }
    panic!("no view found");
}

fn wide_views(seed: u64, count: usize, noise_px: f64) -> Vec<View> {
    let mut random = Random::new(seed);
    (0..count).map(|_| wide_view(&mut random, noise_px)).collect()
}

#[test]
fn derivatives_of_kannala_brandt_are_those_of_differences_also_beyond_90_degrees() {
    let k = Intrinsics::from(WIDE_TRUTH);
    for p in [Vector3::new(0.21, -0.17, 0.6), Vector3::new(-1.1, 0.4, 0.3), Vector3::new(0.3, 0.5, -0.1)] {
        let (pixel, by_camera, by_pose) = WIDE.project_jacobian(&k, &p).expect("not at the camera");
        assert!((pixel - WIDE.project(&k, &p).expect("the same")).norm() < 1e-9);
        for i in 0..8 {
            let h = 1e-6 * k[i].abs().max(1.0);
            let (mut up, mut down) = (k, k);
            up[i] += h;
            down[i] -= h;
            let numeric = (WIDE.project(&up, &p).expect("there") - WIDE.project(&down, &p).expect("there")) / (2.0 * h);
            for axis in 0..2 {
                let error = (by_camera[axis][i] - numeric[axis]).abs();
                assert!(error < 1e-5 * numeric.norm().max(1.0), "{p} {}: {error}", WIDE.parameter_names()[i]);
            }
        }
        for i in 0..6 {
            let moved = |h: f64| {
                let mut d = Vector6::zeros();
                d[i] = h;
                let p = Rotation3::from_scaled_axis(d.fixed_rows::<3>(0).into_owned()) * p + d.fixed_rows::<3>(3);
                WIDE.project(&k, &p).expect("there")
            };
            let numeric = (moved(1e-6) - moved(-1e-6)) / 2e-6;
            for axis in 0..2 {
                assert!((by_pose[axis][i] - numeric[axis]).abs() < 1e-4, "{p} pose {i}: {numeric}");
            }
        }
    }
    let (axis, _, by_pose) = WIDE.project_jacobian(&k, &Vector3::new(0.0, 0.0, 2.0)).expect("on the axis");
    assert_eq!((axis.x, axis.y, by_pose[0][3]), (k[2], k[3], 0.5 * k[0]));
    assert!(WIDE.project(&k, &Vector3::zeros()).is_none());
}

#[test]
fn the_calibrations_lens_is_the_camera_models() {
    let k = Intrinsics::from(WIDE_TRUTH);
    let camera =
        crate::geometry::CameraModel::new(640, 480, k[0], k[1], k[2], k[3], WIDE.lens_model(&k)).expect("valid");
    for p in [Vector3::new(0.21, -0.17, 0.6), Vector3::new(-1.1, 0.4, 0.3), Vector3::new(1e-7, 0.0, 1.0)] {
        let off = camera.project(&p).expect("in front") - WIDE.project(&k, &p).expect("in front");
        assert!(off.norm() < 1e-9, "{p}: {off}");
    }
}

#[test]
fn exact_points_give_the_exact_wide_angle_camera() {
    for seed in 1..6 {
        let solved = calibrate(&wide_views(seed, 8, 0.0), SIZE, Distortion::KannalaBrandt).expect("calibrated");
        for i in 0..8 {
            let error = (solved.intrinsics[i] - WIDE_TRUTH[i]).abs();
            assert!(
                error < 1e-4 * WIDE_TRUTH[i].abs().max(1.0),
                "seed {seed}: {} off by {error}",
                WIDE.parameter_names()[i]
            );
        }
        assert!(solved.rms_px < 1e-5, "seed {seed}: {}", solved.rms_px);
        assert_eq!((solved.intrinsics[8], solved.covariance[(8, 8)]), (0.0, 0.0));
    }
}

#[test]
fn deviations_of_a_wide_angle_camera_are_honest() {
    let (mut within, mut of, mut square) = (0u32, 0u32, 0.0);
    for seed in 0..60 {
        let solved = calibrate(&wide_views(3000 + seed, 21, 0.1), SIZE, Distortion::KannalaBrandt).expect("calibrated");
        let sigmas = solved.sigmas();
        for i in 0..8 {
            let inside = (solved.intrinsics[i] - WIDE_TRUTH[i]).abs() < sigmas[i];
            within += u32::from(inside);
            of += 1;
        }
        square += ((solved.intrinsics[0] - WIDE_TRUTH[0]) / WIDE_TRUTH[0]).powi(2);
        assert!(solved.views.iter().all(|v| v.used), "seed {seed}: a good view was left out");
    }
    let share = f64::from(within) / f64::from(of);
    let rms = (square / 60.0f64).sqrt();
    seeded("wide-angle: 60 sets of 21 views, 0.1 px of noise", share, rms);
    assert!(rms < 1e-3, "seeds 3000..3060: {rms}");
    assert!((0.60..0.76).contains(&share), "seeds 3000..3060: {share}");
}

#[test]
fn every_wide_lens_from_80_to_190_degrees_is_found_from_its_start() {
    // The same scenes through lenses of other focal lengths: the views are drawn for the widest of the picture.
    for (seed, focal) in [(1, 600.0), (2, 450.0), (3, 300.0), (4, 220.0), (5, 150.0)] {
        let mut random = Random::new(seed);
        let mut truth = Intrinsics::from(WIDE_TRUTH);
        (truth[0], truth[1]) = (focal, 1.003 * focal);
        let mut views = Vec::new();
        for _ in 0..4000 {
            if views.len() == 12 {
                break;
            }
            let mut turn = |range: f64| {
                Rotation3::from_euler_angles(random.uniform(-range, range), random.uniform(-range, range), 0.0)
            };
            let (aside, tilt) = (turn(280.0 / focal), turn(0.6));
            let place = aside * Vector3::new(0.0, 0.0, random.uniform(0.12, 0.3) * focal / 300.0);
            let middle = Vector3::new(0.1, 0.0625, 0.0);
            let plane = board();
            let pixels: Vec<_> = plane
                .iter()
                .filter_map(|p| {
                    WIDE.project(&truth, &(aside * (tilt * (Vector3::new(p.x, p.y, 0.0) - middle)) + place))
                })
                .filter(|p| p.x > 4.0 && p.y > 4.0 && p.x < 635.0 && p.y < 475.0)
                .collect();
            if pixels.len() == plane.len() {
                views.push(View { plane, pixels, shear: Vec::new() });
            }
        }
        assert_eq!(views.len(), 12, "seed {seed}");
        let solved = calibrate(&views, SIZE, Distortion::KannalaBrandt).expect("calibrated");
        assert!(
            (solved.intrinsics[0] - focal).abs() < 1e-3 * focal,
            "seed {seed}: {} not {focal}",
            solved.intrinsics[0]
        );
    }
}

#[test]
fn views_that_do_not_fit_are_left_out_and_named() {
    for seed in 1..4 {
        let mut views = views(seed, 12, 0.1);
        // One view in another order, one of a bent board, one whose corners are a square off.
        views[2].pixels.reverse();
        views[2].pixels.swap(3, 40);
        for (p, q) in views[5].pixels.iter_mut().zip(board()) {
            p.y += 900.0 * (q.x - 0.1).powi(2);
        }
        views[8].pixels.rotate_left(3);
        let solved = calibrate(&views, SIZE, Distortion::Full).expect("calibrated");
        let left_out: Vec<usize> = (0..12).filter(|k| !solved.views[*k].used).collect();
        assert!(left_out.contains(&5) && left_out.contains(&8), "seed {seed}: {left_out:?}");
        for k in left_out {
            let rms_px = solved.views[k].rms_px;
            assert!(rms_px > 5.0 * solved.rms_px && rms_px.is_finite(), "seed {seed}, view {k}: {rms_px} px");
        }
        assert!((solved.intrinsics[0] - TRUTH[0]).abs() < 4.0 * solved.sigmas()[0], "seed {seed}: {solved:?}");
        assert!(solved.rms_px < 0.2, "seed {seed}: {}", solved.rms_px);
    }
}

#[test]
fn views_that_say_nothing_are_refused_or_admit_it() {
    let mut random = Random::new(3);
    assert!(matches!(calibrate(&views(1, 2, 0.1), SIZE, Distortion::Full), Err(PlaneCalibrationError::TooFewViews(2))));
    // A board that always faces the camera fixes no focal length.
    let facing: Vec<View> = (0..8)
        .map(|k| {
            let scale = 1500.0 + 100.0 * f64::from(k);
            let shift = Vector2::new(random.uniform(50.0, 150.0), random.uniform(50.0, 150.0));
            let noise = |r: &mut Random| Vector2::new(r.normal(), r.normal()) * 0.1;
            let plane = board();
            let pixels = plane.iter().map(|p| p * scale + shift + noise(&mut random)).collect();
            View { plane, pixels, shear: Vec::new() }
        })
        .collect();
    match calibrate(&facing, SIZE, Distortion::Full) {
        Ok(solved) => assert!(solved.sigmas()[0] > 0.02 * solved.intrinsics[0], "{:?}", solved.sigmas()),
        Err(error) => println!("refused: {error}"),
    }
}

/// Views of a board that moves, through a shutter that reads rows one after another. `speed`: of the corners, px/s, about. Velocities are
/// those that the frames before and after show, a thirtieth of a second apart, as noisy as they.
fn moving_views(seed: u64, count: usize, noise_px: f64, readout_s: f64, speed: f64) -> Vec<View> {
    let k = Intrinsics::from(TRUTH);
    let mut random = Random::new(seed);
    let delay = |row: f64| (row + 0.5) / 480.0 - 0.5;
    let mut views = Vec::new();
    while views.len() < count {
        let plane = board();
        let mut draw = |x: f64| Vector3::from_fn(|_, _| random.uniform(-x, x));
        let (turned, place) = (draw(0.5), draw(0.1) + Vector3::new(0.0, 0.0, 0.35));
        let (turning, sliding) = (draw(3.0 * speed / 520.0), draw(0.6 * speed / 520.0));
        let rotation = Rotation3::from_scaled_axis(turned);
        let middle = Vector3::new(0.1, 0.0625, 0.0);
        let at = |p: &Vector2<f64>, t: f64| {
            let p = Rotation3::from_scaled_axis(turning * t) * (rotation * (Vector3::new(p.x, p.y, 0.0) - middle));
            BROWN.project(&k, &(p + place + sliding * t))
        };
        // The row tells the time and the time the row.
        let seen = |p: &Vector2<f64>, t: f64| {
            let mut pixel = at(p, t)?;
            for _ in 0..4 {
                pixel = at(p, t + readout_s * delay(pixel.y))?;
            }
            Some(pixel)
        };
        let all: Option<Vec<_>> =
            plane.iter().map(|p| Some([seen(p, 0.0)?, seen(p, -1.0 / 30.0)?, seen(p, 1.0 / 30.0)?])).collect();
        let Some(all) = all else { continue };
        if !all.iter().flatten().all(|p| p.x > 4.0 && p.y > 4.0 && p.x < 635.0 && p.y < 475.0) {
            continue;
        }
        let mut noisy = |p: &Vector2<f64>| p + Vector2::new(random.normal(), random.normal()) * noise_px;
        let (mut pixels, mut shear) = (Vec::new(), Vec::new());
        for [now, before, after] in &all {
            let pixel = noisy(now);
            shear.push((noisy(after) - noisy(before)) * 15.0 * delay(pixel.y));
            pixels.push(pixel);
        }
        views.push(View { plane, pixels, shear });
    }
    views
}

/// Share of the errors within one deviation, the largest error of the camera in deviations, the same of the readout time, and the root mean
/// square error of the focal length, px.
fn honesty(readout_s: f64, speed: f64, blind: bool) -> [f64; 4] {
    let (mut within, mut of, mut worst, mut worst_readout, mut square) = (0, 0, 0.0f64, 0.0f64, 0.0);
    for seed in 0..60 {
        let mut views = moving_views(5000 + seed, 21, 0.05, readout_s, speed);
        if blind {
            views.iter_mut().for_each(|v| v.shear.clear());
        }
        let solved = calibrate(&views, SIZE, Distortion::Full).expect("calibrated");
        for (i, sigma) in solved.sigmas().into_iter().enumerate() {
            let off = ((solved.intrinsics[i] - TRUTH[i]) / sigma).abs();
            (within, of, worst) = (within + i32::from(off < 1.0), of + 1, worst.max(off));
        }
        square += (solved.intrinsics[0] - TRUTH[0]).powi(2) / 60.0;
        assert_eq!(solved.readout.is_some(), !blind);
        if let Some(readout) = solved.readout {
            worst_readout = worst_readout.max(((readout.seconds - readout_s) / readout.sigma_s).abs());
        }
    }
    let share = f64::from(within) / f64::from(of);
    let (told, of_readout) =
        if blind { (", not told", "–".to_string()) } else { ("", format!("{worst_readout:.1}")) };
    println!(
        "| {readout_s} s, {speed} px/s{told} | {:.1} | {worst:.1} | {of_readout} | {:.3} |",
        100.0 * share,
        square.sqrt()
    );
    [share, worst, worst_readout, square.sqrt()]
}

#[test]
fn a_shutter_that_bends_moving_boards_is_estimated_with_the_camera_and_deviations_stay_honest() {
    println!(
        "\n| 60 sets of 21 views: readout, speed of the board | within one sigma % | largest error, sigmas | of the readout, sigmas | focal length RMS px |"
    );
    println!("|---|---:|---:|---:|---:|");
    for (readout_s, speed) in [(0.02, 8.0), (0.03, 20.0), (0.0, 8.0), (-0.015, 8.0)] {
        let [share, worst, readout, _] = honesty(readout_s, speed, false);
        assert!((0.58..0.78).contains(&share), "seeds 5000..5060, {readout_s} s, {speed} px/s: {share}");
        assert!(worst < 5.0 && readout < 4.5, "seeds 5000..5060, {readout_s} s, {speed} px/s: {worst} {readout}");
    }
    // Boards that stand, and velocities that are nothing but noise: the camera is none the worse.
    let [share, worst, ..] = honesty(0.02, 0.0, false);
    assert!((0.58..0.78).contains(&share) && worst < 5.0, "seeds 5000..5060, standing: {share}");
    // Not told how the boards moved, the same pictures are far worse; that their views differ more than their corners' noise says so.
    let ([.., told], [share, .., not_told]) = (honesty(0.03, 20.0, false), honesty(0.03, 20.0, true));
    assert!(not_told > 3.0 * told, "seeds 5000..5060: {not_told} px, {told} px when told");
    assert!(share > 0.55, "seeds 5000..5060, not told: {share}");
}

#[test]
fn coefficients_that_are_not_asked_for_are_zero() {
    for (distortion, from) in [(Distortion::None, 4), (Distortion::Radial, 6), (Distortion::RadialTangential, 8)] {
        let solved = calibrate(&views(1, 12, 0.1), SIZE, distortion).expect("calibrated");
        assert!(solved.intrinsics.iter().skip(from).all(|k| *k == 0.0), "{distortion:?}: {:?}", solved.intrinsics);
    }
}
