use nalgebra::{Matrix3, Unit, UnitQuaternion, Vector3};

use super::plane::{Driven, FloorPoint, NoFloor, Scatter, UpPrior, find_floor};
use super::*;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::geometry::random::Random;
use crate::geometry::ros_from_optical;

/// Height of the camera, map units.
const HEIGHT: f64 = 0.7;
const PITCH_RAD: f64 = 0.1;
const ROLL_RAD: f64 = 0.03;

/// A camera at a place (x forward, y left, z up of the floor), pitched and rolled.
fn camera(at: [f64; 3]) -> Se3<Camera, World> {
    let mount = UnitQuaternion::from_euler_angles(ROLL_RAD, PITCH_RAD, 0.0) * ros_from_optical();
    Se3::<World, Camera>::new(mount, Vector3::from(at)).inverse()
}

/// A straight way of 4 units.
fn driven() -> Vec<Se3<Camera, World>> {
    (0..20).map(|i| camera([0.2 * f64::from(i), 0.0, HEIGHT])).collect()
}

fn prior() -> UpPrior {
    // The mount says nothing of roll and pitch.
    let up_camera = Unit::new_normalize(ros_from_optical().inverse() * Vector3::z());
    UpPrior { up_camera, sigma_rad: 0.15 }
}

fn floor_of(points: &[FloorPoint], cameras: &[Se3<Camera, World>], seed: u64) -> Result<Plane, NoFloor> {
    let found = find_floor(points, cameras, &prior(), seed)?;
    found.driven_over(&Driven::FIRST).map(|()| found.plane)
}

/// Landmarks on a level rectangle, with noise of this standard deviation.
fn sheet(random: &mut Random, x: [f64; 2], y: [f64; 2], z: f64, count: usize, sigma: f64) -> Vec<FloorPoint> {
    let mut point = || {
        let at = Vector3::new(random.uniform(x[0], x[1]), random.uniform(y[0], y[1]), z);
        let noise = Vector3::new(random.normal(), random.normal(), random.normal()) * sigma;
        FloorPoint { position: at + noise, covariance: Matrix3::identity() * sigma * sigma }
    };
    (0..count).map(|_| point()).collect()
}

fn walls(random: &mut Random) -> Vec<FloorPoint> {
    let mut wall = sheet(random, [0.0, 6.0], [0.0, 2.0], 0.0, 200, 0.01);
    for point in &mut wall {
        // Stood up at the left side.
        point.position = Vector3::new(point.position.x, 1.5, point.position.y);
    }
    wall
}

#[test]
fn a_floor_that_is_driven_over_tells_height_and_tilt_within_what_it_says() {
    let mut inside = 0;
    for seed in 0..20 {
        let mut random = Random::new(seed);
        let mut points = sheet(&mut random, [1.0, 6.0], [-1.0, 1.0], 0.0, 150, 0.01);
        points.extend(walls(&mut random));
        let plane = floor_of(&points, &driven(), seed).unwrap_or_else(|e| panic!("seed {seed}: {e:?}"));
        let error = (plane.height / HEIGHT).ln();
        assert!(error.abs() < 0.015, "seed {seed}: {error}");
        assert!(plane.sigma > 0.001 && plane.sigma < 0.02, "seed {seed}: sigma {}", plane.sigma);
        inside += usize::from(error.abs() < 2.0 * plane.sigma);
        let (roll, pitch) = roll_pitch(&plane.up_camera);
        assert!((roll - ROLL_RAD).abs() < 0.01 && (pitch - PITCH_RAD).abs() < 0.01, "seed {seed}: {roll} {pitch}");
    }
    assert!(inside >= 17, "{inside} of 20 within two sigmas");
}

/// Skirting boards, feet of furniture: a third of what lies down there.
#[test]
fn low_things_do_not_lift_a_floor() {
    let sigma = 0.02 * HEIGHT;
    let error = |seed: u64| {
        let mut random = Random::new(seed);
        let mut points = sheet(&mut random, [1.0, 6.0], [-1.0, 1.0], 0.0, 100, sigma);
        for _ in 0..50 {
            let z = random.uniform(0.02, 0.14) * HEIGHT;
            points.extend(sheet(&mut random, [1.0, 6.0], [-1.0, 1.0], z, 1, sigma));
        }
        let plane = floor_of(&points, &driven(), seed).expect("a floor");
        assert!((0.1..0.5).contains(&plane.scatter.things) && plane.scatter.mistakes < 0.1, "{:?}", plane.scatter);
        (plane.height / HEIGHT).ln()
    };
    let errors: Vec<f64> = (0..20).map(error).collect();
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    assert!(mean.abs() < 0.003, "on average {mean} too high");
    assert!(errors.iter().all(|error| error.abs() < 0.015), "{errors:?}");
}

/// A third of what is down there lies a little beneath what the rest lies on: rugs, or low tops, with the floor under them.
#[test]
fn what_has_a_floor_closely_beneath_it_is_none() {
    for seed in 0..10 {
        let mut random = Random::new(seed);
        let mut points = sheet(&mut random, [1.0, 6.0], [-1.0, 1.0], 0.0, 100, 0.01 * HEIGHT);
        points.extend(sheet(&mut random, [1.0, 6.0], [-1.0, 1.0], -0.1 * HEIGHT, 50, 0.01 * HEIGHT));
        let found = floor_of(&points, &driven(), seed);
        assert!(!found.is_ok_and(|plane| plane.height < 1.05 * HEIGHT), "seed {seed}");
    }
}

#[test]
fn what_is_no_floor_is_refused_for_its_reason() {
    let mut random = Random::new(7);
    let floor = sheet(&mut random, [1.0, 6.0], [-1.0, 1.0], 0.0, 150, 0.01);
    // Beside the way, half as high as the camera, with no floor in sight.
    let table = sheet(&mut random, [1.0, 6.0], [0.8, 2.0], 0.35, 150, 0.01);
    let found = floor_of(&table, &driven(), 1);
    assert!(matches!(found, Err(NoFloor::NotDrivenOver(_))), "a table: {found:?}");
    // Two benches, one on either side: the way is between them.
    let mut benches = table.clone();
    benches.extend(sheet(&mut random, [1.0, 6.0], [-2.0, -0.8], 0.35, 150, 0.01));
    let found = floor_of(&benches, &driven(), 1);
    assert!(matches!(found, Err(NoFloor::NotDrivenOver(_))), "benches: {found:?}");
    // Flown over a table, with the floor below it.
    let mut over = sheet(&mut random, [1.0, 6.0], [-1.0, 1.0], 0.35, 150, 0.01);
    over.extend(sheet(&mut random, [1.0, 6.0], [-2.0, 2.0], 0.0, 60, 0.01));
    let found = floor_of(&over, &driven(), 1);
    assert!(!found.as_ref().is_ok_and(|p| (p.height / 0.35 - 1.0).abs() < 0.2), "a table above a floor: {found:?}");
    let carried: Vec<_> =
        (0..20).map(|i| camera([0.2 * f64::from(i), 0.0, HEIGHT + 0.15 * (f64::from(i)).sin()])).collect();
    let found = floor_of(&floor, &carried, 1);
    assert!(matches!(found, Err(NoFloor::NotParallel(_))), "carried: {found:?}");
    let standing = vec![camera([0.0, 0.0, HEIGHT]); 20];
    let found = floor_of(&floor, &standing, 1);
    assert!(matches!(found, Err(NoFloor::FewMetres)), "standing: {found:?}");
    let found = floor_of(&walls(&mut random), &driven(), 1);
    assert!(found.is_err(), "a wall: {found:?}");
    let found = floor_of(&floor[..10], &driven(), 1);
    assert!(matches!(found, Err(NoFloor::FewLandmarks)), "{found:?}");
}

#[test]
fn a_floor_carries_who_stands_on_it() {
    let mut random = Random::new(3);
    let points = sheet(&mut random, [1.0, 6.0], [-1.0, 1.0], 0.0, 150, 0.01);
    let plane = floor_of(&points, &driven(), 5).expect("a floor");
    assert!(plane.carries(&Vector3::new(2.0, 1.0, HEIGHT)));
    // Lifted over a sofa, driven up a step, nowhere.
    for z in [2.0 * HEIGHT, 1.15 * HEIGHT, 0.8 * HEIGHT, f64::NAN] {
        assert!(!plane.carries(&Vector3::new(2.0, 1.0, z)), "{z}");
    }
}

#[test]
fn the_same_question_has_the_same_answer() {
    let mut random = Random::new(3);
    let points = sheet(&mut random, [1.0, 6.0], [-1.0, 1.0], 0.0, 150, 0.01);
    assert_eq!(floor_of(&points, &driven(), 5), floor_of(&points, &driven(), 5));
}

#[test]
fn impossible_heights_are_refused() {
    let with = |camera_height_m, camera_height_sigma_m| ScaleConfig { camera_height_m, camera_height_sigma_m };
    assert!(ScaleConfig::default().validate().is_ok() && !ScaleConfig::default().is_on());
    assert!(with(0.2, 0.003).validate().is_ok());
    for (height, sigma) in [(0.01, 0.001), (5.0, 0.003), (f64::NAN, 0.003), (0.2, 0.05), (0.2, f64::NAN), (0.2, 0.0)] {
        assert!(with(height, sigma).validate().is_err(), "{height} {sigma}");
    }
}

#[test]
fn axes_on_the_floor_are_below_the_camera_and_a_floor_follows_the_map() {
    let up_camera = -Vector3::y_axis();
    for normal in [Vector3::z(), -Vector3::z(), -Vector3::y(), Vector3::new(0.2, -0.9, 0.3).normalize()] {
        let plane = Plane {
            normal,
            offset: -0.3,
            height: 0.5,
            sigma: 0.01,
            up_camera,
            landmarks: 20,
            scatter: Scatter::default(),
        };
        let camera = normal * 0.2 + plane::basis(&Unit::new_normalize(normal)).0 * 3.0;
        let on_it = plane.floor_from_world(&camera).transform(&camera);
        assert!((on_it - Vector3::new(0.0, 0.0, 0.5)).norm() < 1e-12, "{normal:?}: {on_it:?}");
        let motion = Sim3::new(1.3, UnitQuaternion::from_euler_angles(0.2, -0.4, 1.0), Vector3::new(1.0, 2.0, -3.0));
        let mut moved = plane;
        moved.follow(&motion);
        assert!((moved.height_of(&motion.transform(&camera)) - 1.3 * 0.5).abs() < 1e-12, "{normal:?}");
        assert!((moved.height - 0.65).abs() < 1e-12 && moved.carries(&motion.transform(&camera)));
    }
}
