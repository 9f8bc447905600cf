//! Jacobians against differences, recovery without noise, honest deviations with it, and what bad views do.

use super::*;
use crate::geometry::random::Random;
use nalgebra::{Rotation3, Vector6};

const TRUTH: [f64; PARAMETERS] = [520.0, 522.5, 322.25, 238.5, -0.12, 0.05, 0.0008, -0.0006, 0.004];
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
            .filter_map(|p| adjust::project(&k, &(rotation * (Vector3::new(p.x, p.y, 0.0) - middle) + place)))
            .filter(|p| p.x > 4.0 && p.y > 4.0 && p.x < 635.0 && p.y < 475.0)
            .map(|p| p + Vector2::new(random.normal(), random.normal()) * noise_px)
            .collect();
        if pixels.len() == plane.len() {
            return View { plane, pixels };
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
    let (_, by_camera, by_pose) = adjust::project_jacobian(&k, &p).expect("in front");
    for i in 0..PARAMETERS {
        let h = 1e-6 * k[i].abs().max(1.0);
        let (mut up, mut down) = (k, k);
        up[i] += h;
        down[i] -= h;
        let numeric =
            (adjust::project(&up, &p).expect("in front") - adjust::project(&down, &p).expect("in front")) / (2.0 * h);
        for axis in 0..2 {
            let error = (by_camera[axis][i] - numeric[axis]).abs();
            assert!(error < 1e-5 * numeric.norm().max(1.0), "{}: {error}", PARAMETER_NAMES[i]);
        }
    }
    for i in 0..6 {
        let moved = |h: f64| {
            let mut d = Vector6::zeros();
            d[i] = h;
            let p = Rotation3::from_scaled_axis(d.fixed_rows::<3>(0).into_owned()) * p + d.fixed_rows::<3>(3);
            adjust::project(&k, &p).expect("in front")
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
            assert!(error < 1e-4 * TRUTH[i].abs().max(1.0), "seed {seed}: {} off by {error}", PARAMETER_NAMES[i]);
        }
        assert!(solved.rms_px < 1e-5, "seed {seed}: {}", solved.rms_px);
    }
}

#[test]
fn twenty_one_views_give_the_focal_length_within_a_thousandth_and_honest_deviations() {
    // Noise of 0.1 px a coordinate: what the detector has on rendered pictures at its worst.
    let (mut within, mut of, mut square) = (0u32, 0u32, 0.0);
    let mut each = [0usize; PARAMETERS];
    for seed in 0..100 {
        let solved = calibrate(&views(1000 + seed, 21, 0.1), SIZE, Distortion::Full).expect("calibrated");
        let sigmas = solved.sigmas();
        for i in 0..PARAMETERS {
            let inside = (solved.intrinsics[i] - TRUTH[i]).abs() < sigmas[i];
            each[i] += usize::from(inside);
            within += u32::from(inside);
            of += 1;
        }
        square += ((solved.intrinsics[0] - TRUTH[0]) / TRUTH[0]).powi(2);
        assert!(solved.views.iter().all(|v| v.used), "seed {seed}: a good view was left out");
    }
    let share = f64::from(within) / f64::from(of);
    let rms = (square / 100.0f64).sqrt();
    println!("focal length RMS {:.4} %, within one sigma {:.1} %, by parameter {each:?}", 100.0 * rms, 100.0 * share);
    assert!(rms < 1e-3, "seeds 1000..1100: {rms}");
    assert!((0.60..0.76).contains(&share), "seeds 1000..1100: {share}");
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
            View { plane, pixels }
        })
        .collect();
    match calibrate(&facing, SIZE, Distortion::Full) {
        Ok(solved) => assert!(solved.sigmas()[0] > 0.02 * solved.intrinsics[0], "{:?}", solved.sigmas()),
        Err(error) => println!("refused: {error}"),
    }
}
