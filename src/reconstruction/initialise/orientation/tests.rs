use super::*;
use crate::features::Track;
use crate::geometry::random::Random;

/// A calibrated lens.
const KNOWN: SupposedLens =
    SupposedLens { focal_px: 500.0, focal_sigma: 0.01, centre_sigma_px: 0.1, distortion_sigma: 0.02 };

fn camera() -> CameraModel {
    CameraModel::new(640, 480, 500.0, 500.0, 320.0, 240.0, [0.0; 5]).expect("a camera")
}

/// A room all around: points at distances of 2 to 6.
fn room(seed: u64) -> Vec<Vector3<f64>> {
    let mut random = Random::new(seed);
    let direction =
        |random: &mut Random| Vector3::new(random.normal(), 0.4 * random.normal(), random.normal()).normalize();
    (0..1500).map(|_| direction(&mut random) * random.uniform(2.0, 6.0)).collect()
}

/// What a camera sees that is turned and placed so in the room, with a third of a pixel as noise.
fn features(
    room: &[Vector3<f64>],
    random: &mut Random,
    sequence: u64,
    first_from_camera: &UnitQuaternion<f64>,
    position: Vector3<f64>,
) -> FrameFeatures {
    let camera = camera();
    let track = |(id, x): (usize, &Vector3<f64>)| {
        let pixel = camera.project(&(first_from_camera.inverse() * (x - position)))?;
        let noisy = pixel + Vector2::new(random.normal(), random.normal()) * 0.3;
        camera.contains(&noisy, 2.0).then(|| Track { id: id as u64, position: noisy.cast(), age: 1 })
    };
    FrameFeatures {
        sequence,
        timestamp_ns: sequence as i64 * 33_333_333,
        tracks: room.iter().enumerate().filter_map(track).collect(),
        ..FrameFeatures::default()
    }
}

fn yaw(angle: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_scaled_axis(Vector3::new(0.0, angle, 0.0))
}

/// Squared error in standard deviations: three degrees of freedom.
fn squared(e: &OrientationEstimate, truth: &UnitQuaternion<f64>) -> f64 {
    let error = (e.first_from_camera.inverse() * truth).scaled_axis();
    error.dot(&(e.covariance.try_inverse().expect("a covariance") * error))
}

#[test]
fn a_full_turn_on_the_spot_is_told_with_an_honest_covariance() {
    let (mut sum, mut outside, mut count, mut rates) = (0.0, 0, 0, 0.0);
    for seed in 0..8 {
        let (room, mut random, mut tracker) = (room(seed), Random::new(100 + seed), OrientationTracker::default());
        for i in 0..240u64 {
            let truth = yaw(i as f64 / 240.0 * std::f64::consts::TAU);
            let seen = features(&room, &mut random, i, &truth, Vector3::zeros());
            let told = tracker.step(&seen, &camera(), KNOWN).unwrap_or_else(|| panic!("seed {seed}, frame {i}"));
            if i == 0 {
                assert_eq!(told.first_from_camera, UnitQuaternion::identity());
                // Zeros would be read as unknown, and nobody could invert them.
                assert!(told.covariance.diagonal().min() > 0.0 && told.covariance.norm() < 1e-4);
                continue;
            }
            rates += told.angular_velocity.y * 8.0 / std::f64::consts::TAU;
            let off = squared(&told, &truth);
            (sum, count) = (sum + off, count + 1);
            outside += usize::from(off > 7.81); // 95 % of chi-square with three degrees of freedom
        }
        let truth = yaw(std::f64::consts::TAU * 239.0 / 240.0);
        let last = tracker.last.expect("told").0;
        assert!(last.first_from_camera.angle_to(&truth) < 0.03, "seed {seed}");
        let sigma = (last.covariance + last.by_lens * last.by_lens.transpose()).trace().sqrt();
        assert!(sigma < 0.15, "seed {seed}: {sigma}");
        assert_eq!(tracker.restarts, 0);
    }
    assert!((rates / f64::from(count) - 1.0).abs() < 0.01, "{} of the true rate", rates / f64::from(count));
    assert!(sum / f64::from(count) < 4.5, "mean {}", sum / f64::from(count));
    assert!(outside * 10 < count as usize, "{outside} of {count} outside");
}

#[test]
fn a_turn_in_an_arc_is_told_although_the_camera_moves() {
    let (mut outside, mut count) = (0, 0);
    for seed in 0..8 {
        let (room, mut random, mut tracker) = (room(seed), Random::new(100 + seed), OrientationTracker::default());
        for i in 0..120u64 {
            let angle = i as f64 * 0.015;
            let position = Vector3::new(1.0 - angle.cos(), 0.0, angle.sin()) * 0.5;
            let seen = features(&room, &mut random, i, &yaw(angle), position);
            let told = tracker.step(&seen, &camera(), KNOWN).unwrap_or_else(|| panic!("seed {seed}, frame {i}"));
            if i > 0 {
                outside += usize::from(squared(&told, &yaw(angle)) > 7.81);
                count += 1;
            }
        }
        assert!(tracker.last.expect("told").0.first_from_camera.angle_to(&yaw(119.0 * 0.015)) < 0.05, "seed {seed}");
    }
    assert!(outside * 10 < count, "{outside} of {count} outside");
}

#[test]
fn the_lens_adds_up_over_anchors_and_a_turn_back_takes_it_away() {
    let none = Vector3::zeros();
    let turn = |angle: f64| {
        let (second_from_first, by_lens) =
            (yaw(angle), Matrix3x4::from_columns(&[Vector3::new(0.0, 0.05 * angle, 0.0), none, none, none]));
        ViewTurn { second_from_first, covariance: Matrix3::zeros(), by_lens, state: TurnState::none() }
    };
    let known = Known::first(0).turned(1, &turn(0.4)).turned(2, &turn(0.4)).turned(3, &turn(0.4));
    assert!((known.by_lens.norm() - 0.06).abs() < 1e-12, "a twentieth of 1.2 rad, and not less by chance");
    let back = known.turned(4, &turn(-0.8));
    assert!((back.by_lens.norm() - 0.02).abs() < 1e-12);
    assert!(back.covariance.trace() > known.covariance.trace(), "noise does not go back");
}

#[test]
fn darkness_ends_it_and_what_comes_after_is_counted_as_unrelated() {
    let (room, mut random, mut tracker) = (room(2), Random::new(5), OrientationTracker::default());
    let mut see = |tracker: &mut OrientationTracker, i: u64, dark: bool| {
        let mut seen = features(&room, &mut random, i, &yaw(0.01 * i as f64), Vector3::zeros());
        if dark {
            seen.tracks.clear();
        }
        tracker.step(&seen, &camera(), KNOWN)
    };
    assert_eq!(see(&mut tracker, 0, true), None);
    assert!(see(&mut tracker, 1, false).is_some() && see(&mut tracker, 2, false).is_some());
    assert_eq!(tracker.restarts, 0, "nothing was told before");
    assert_eq!(see(&mut tracker, 3, true), None);
    let told = see(&mut tracker, 4, false).expect("light again");
    assert_eq!((told.first_from_camera, tracker.restarts), (UnitQuaternion::identity(), 1));
    assert!(told.angular_velocity.x.is_nan());
    // A map that begins at a frame with an orientation goes on from it; at another one it cannot.
    let known = see(&mut tracker, 5, false).expect("told").first_from_camera;
    assert_eq!((tracker.end(5 * 33_333_333), tracker.restarts), (Some(known), 1));
    assert!(see(&mut tracker, 6, false).is_some());
    assert_eq!((tracker.end(7 * 33_333_333), tracker.restarts), (None, 2));
    assert!(see(&mut tracker, 8, false).is_some());
    assert_eq!(tracker.restarts, 2);
}
