//! Movements: smooth, as fast as promised, clear of the furniture.

use super::super::{place, room};
use super::*;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};

fn pose(simulator: &Simulator, t: f64) -> Se3<World, Camera> {
    simulator.trajectory().pose_at_seconds(t)
}

fn with(scenario: Scenario, seed: u64) -> Simulator {
    let mut config = quick(SimulatorConfig::ideal(scenario));
    config.seed = seed;
    config.texel_mm = 20.0;
    config.chessboard.enabled = true;
    simulator(&config)
}

/// Speed, m/s, and turn rate, degrees/s, every 10 ms from `from` to `to`.
fn rates(simulator: &Simulator, from: f64, to: f64) -> Vec<(f64, f64)> {
    let n = ((to - from) / 0.01) as usize;
    let at = |i: usize| pose(simulator, from + 0.01 * i as f64);
    (0..n)
        .map(|i| {
            let (a, b) = (at(i), at(i + 1));
            ((b.translation - a.translation).norm() / 0.01, a.rotation.angle_to(&b.rotation).to_degrees() / 0.01)
        })
        .collect()
}

fn peaks(rates: &[(f64, f64)]) -> (f64, f64) {
    rates.iter().fold((0.0, 0.0), |p, r| (f64::max(p.0, r.0), f64::max(p.1, r.1)))
}

#[test]
fn every_movement_is_twice_continuously_differentiable() {
    for scenario in Scenario::ALL {
        let simulator = with(scenario, 2);
        let h = 1e-3;
        // Second differences of position and of the rotation's small angle; a jump of the acceleration stands out as a
        // difference that does not shrink with h. Largest honest jerk: the fast turns, 0.5 rad at 1.2 Hz: 220 rad/s³.
        let acceleration = |t: f64| {
            let (a, b, c) = (pose(&simulator, t - h), pose(&simulator, t), pose(&simulator, t + h));
            let linear = (a.translation - b.translation * 2.0 + c.translation) / (h * h);
            let before = (a.rotation.inverse() * b.rotation).scaled_axis();
            let after = (b.rotation.inverse() * c.rotation).scaled_axis();
            (linear, (after - before) / (h * h))
        };
        let mut last = acceleration(-0.5);
        for i in 1..40_000 {
            let t = -0.5 + f64::from(i) * h;
            let now = acceleration(t);
            let (linear, turn) = ((now.0 - last.0).norm(), (now.1 - last.1).norm());
            assert!(linear < 0.05 && turn < 1.5, "{} at {t:.3} s: jumps by {linear}, {turn}", scenario.name());
            last = now;
        }
    }
}

#[test]
fn movements_start_from_rest_at_frame_zero() {
    for scenario in Scenario::ALL {
        let simulator = with(scenario, 3);
        let (a, b) = (pose(&simulator, -1.0), pose(&simulator, 0.0));
        assert_eq!(a, b);
        assert!((pose(&simulator, 1e-3).translation - b.translation).norm() < 1e-8);
    }
}

#[test]
fn robots_drive_and_turn_at_a_robots_pace() {
    for seed in 1..4 {
        let simulator = with(Scenario::RoomTour, seed);
        let rates = rates(&simulator, 2.0, 80.0);
        let (speed, turn) = peaks(&rates);
        let slowest = rates.iter().fold(f64::MAX, |m, r| f64::min(m, r.0));
        assert!(slowest > 0.3 && speed < 0.5 && turn < 42.0, "seed {seed}: {slowest}..{speed} m/s, {turn} degrees/s");
        // A robot looks where it drives.
        for i in 0..78 {
            let t = 2.0 + f64::from(i);
            let way = pose(&simulator, t + 0.05).translation - pose(&simulator, t - 0.05).translation;
            let look = pose(&simulator, t).rotation * nalgebra::Vector3::z();
            assert!(way.normalize().dot(&look) > 0.95, "seed {seed}: drifts sideways at {t} s");
        }
    }
    for scenario in [Scenario::Square, Scenario::Corridor] {
        let (speed, turn) = peaks(&rates(&with(scenario, 1), 0.0, 90.0));
        assert!(speed < 0.6 && turn < 45.0 && speed > 0.3, "{}: {speed} m/s, {turn} degrees/s", scenario.name());
    }
}

#[test]
fn fast_rotation_peaks_between_200_and_300_degrees_a_second() {
    for seed in 1..6 {
        let (speed, turn) = peaks(&rates(&with(Scenario::FastRotation, seed), 0.0, 30.0));
        assert!((200.0..310.0).contains(&turn) && speed < 0.8, "seed {seed}: {speed} m/s, {turn} degrees/s");
    }
}

#[test]
fn pure_rotation_and_standing_do_not_move() {
    let turning = with(Scenario::PureRotation, 1);
    let standing = with(Scenario::Standing, 1);
    let stopped = with(Scenario::MoveThenStand, 1);
    let spinning = with(Scenario::MoveThenRotate, 1);
    for i in 0..100 {
        let t = f64::from(i) * 0.37;
        assert_eq!(pose(&turning, t).translation, pose(&turning, 0.0).translation);
        assert_eq!(pose(&standing, t), pose(&standing, 0.0));
        assert_eq!(pose(&stopped, 14.0 + t), pose(&stopped, 20.0));
        let on_the_spot = 13.0 + f64::from(i) * 0.1;
        assert_eq!(pose(&spinning, on_the_spot).translation, pose(&spinning, 13.0).translation);
    }
    assert!(peaks(&rates(&turning, 0.0, 20.0)).1 > 30.0);
    assert!(peaks(&rates(&spinning, 13.0, 23.0)).1 > 20.0);
    assert!(peaks(&rates(&stopped, 0.0, 9.0)).0 > 0.2);
}

#[test]
fn no_movement_runs_into_furniture() {
    // In every other room all that can be moved has been.
    for seed in 1..9 {
        let mut config = SimulatorConfig::ideal(Scenario::RoomTour);
        config.seed = seed;
        config.chessboard.enabled = true;
        config.another_day.enabled = seed % 2 == 0;
        (config.another_day.seed, config.another_day.moved_share) = (seed, 1.0);
        let plan = room::Plan {
            seed,
            texel_m: 0.1,
            rich: true,
            chessboard: &config.chessboard,
            tags: &config.tags,
            desk: &config.desk,
            another_day: &config.another_day,
        };
        for scenario in Scenario::ALL {
            let scene = place(scenario, &plan);
            let mut config = config.clone();
            config.scenario = scenario;
            let trajectory = super::super::Trajectory::new(&config, Some(0));
            for i in 0..900 {
                let p = trajectory.pose_at_seconds(f64::from(i) * 0.1).translation;
                for (low, high) in &scene.solids {
                    let gap = p.zip_zip_map(low, high, |p, l, h| f64::max(f64::max(l - p, p - h), 0.0)).norm();
                    assert!(
                        gap > 0.12,
                        "{} seed {seed}: {gap:.2} m from a box {low:?} .. {high:?} at {:.1} s",
                        scenario.name(),
                        f64::from(i) * 0.1
                    );
                }
            }
        }
    }
}

#[test]
fn the_tour_comes_back() {
    let simulator = with(Scenario::RoomTour, 1);
    let start = pose(&simulator, 5.0);
    let back = (150..400).map(|i| pose(&simulator, f64::from(i) * 0.1)).any(|p| {
        (p.translation - start.translation).norm() < 0.25 && p.rotation.angle_to(&start.rotation).to_degrees() < 12.0
    });
    assert!(back, "no revisit of the place and view of second 5 in 40 s");
}
