//! What the base's wheels tell, beside where the base truly was.

use std::f64::consts::{PI, TAU};

use super::super::RECORDING_START_NS;
use super::*;
use crate::camera::FrameSource;
use crate::camera::simulator::Odometer;
use crate::motion::wheel::WheelMessage;

fn config(scenario: Scenario) -> SimulatorConfig {
    let mut config = quick(SimulatorConfig::ideal(scenario));
    config.texel_mm = 20.0;
    config.wheels.enabled = true;
    config
}

fn messages(odometer: &mut Odometer, seconds: f64) -> Vec<WheelMessage> {
    let mut all = Vec::new();
    while odometer.next_stamp_ns() <= RECORDING_START_NS + (seconds * 1e9) as i64 {
        all.extend(odometer.next_message());
    }
    all
}

/// Dead reckoning as the format defines it: (x, y, yaw) by constant twists, from the base's true start.
fn driven(simulator: &Simulator, messages: &[WheelMessage]) -> [f64; 3] {
    let [mut x, mut y, mut yaw] = simulator.trajectory().base_at_seconds(0.0).expect("driven");
    for pair in messages.windows(2) {
        let dt = (pair[1].timestamp_ns - pair[0].timestamp_ns) as f64 * 1e-9;
        let (way, turn) = (pair[1].linear_x_mps * dt, pair[1].angular_z_radps * dt);
        x += way * (yaw + 0.5 * turn).cos();
        y += way * (yaw + 0.5 * turn).sin();
        yaw += turn;
    }
    [x, y, yaw]
}

fn length(messages: &[WheelMessage]) -> f64 {
    messages.iter().map(|m| m.linear_x_mps * 0.02).sum()
}

#[test]
fn flawless_wheels_lead_to_the_true_place_within_their_ticks() {
    for (scenario, seconds) in [(Scenario::Square, 40.0), (Scenario::Corridor, 60.0), (Scenario::RoomTour, 30.0)] {
        let mut config = config(scenario);
        (config.wheels.noise_share, config.wheels.tick_mm) = (0.0, 0.01);
        let simulator = simulator(&config);
        let got = driven(&simulator, &messages(&mut simulator.odometer().expect("wheels"), seconds));
        let want = simulator.trajectory().base_at_seconds(seconds).expect("driven");
        let turned = (got[2] - want[2] + PI).rem_euclid(TAU) - PI;
        let off = (got[0] - want[0]).hypot(got[1] - want[1]);
        // The tour's base slides sideways in its corners, which no wheel sees.
        let limit = if scenario == Scenario::RoomTour { 0.05 } else { 0.005 };
        assert!(off < limit && turned.abs() < 1e-3, "{}: off by {off} m, {turned} rad", scenario.name());
    }
}

#[test]
fn a_larger_radius_counts_less_and_slip_counts_more() {
    let seconds = 20.0;
    let way = |spoil: fn(&mut SimulatorConfig)| {
        let mut config = config(Scenario::Corridor);
        config.wheels.noise_share = 0.0;
        spoil(&mut config);
        let simulator = simulator(&config);
        length(&messages(&mut simulator.odometer().expect("wheels"), seconds))
    };
    let truth = way(|_| {});
    let share = way(|c| c.wheels.radius_error = [0.02, 0.02]) / truth;
    assert!((share - 1.0 / 1.02).abs() < 1e-3, "{share}");
    let slipped = way(|c| c.wheels.slip = true) / truth;
    assert!((1.01..1.5).contains(&slipped), "{slipped}");
}

#[test]
fn bursts_of_slip_are_as_long_and_as_strong_as_promised() {
    let mut config = config(Scenario::Corridor);
    config.wheels.slip = true;
    for seed in 0..20 {
        config.seed = seed;
        let slips = simulator(&config).odometer().expect("wheels").slips(150.0);
        assert_eq!(slips.len(), 10, "seed {seed}");
        for slip in slips {
            let length = slip.end_s - slip.start_s;
            let strongest = slip.share[0].max(slip.share[1]);
            assert!((1.0..=4.0).contains(&length) && (0.3..=0.5).contains(&strongest), "seed {seed}: {slip:?}");
        }
    }
}

#[test]
fn late_stamps_and_lost_messages_come_as_configured_and_the_rest_is_the_same() {
    let whole = messages(&mut simulator(&config(Scenario::Square)).odometer().expect("wheels"), 20.0);
    let mut config = config(Scenario::Square);
    (config.wheels.delay_ms, config.wheels.loss_share) = (30.0, 0.1);
    let spoilt = messages(&mut simulator(&config).odometer().expect("wheels"), 20.0);
    let share = spoilt.len() as f64 / whole.len() as f64;
    assert!((0.85..0.95).contains(&share), "{share}");
    for m in &spoilt {
        let same = &whole[m.number as usize];
        assert_eq!(m.timestamp_ns, same.timestamp_ns + 30_000_000);
        assert_eq!((m.linear_x_mps, m.angular_z_radps), (same.linear_x_mps, same.angular_z_radps));
    }
}

#[test]
fn a_source_tells_what_has_happened_up_to_its_frame_and_a_hand_has_no_wheels() {
    let mut driven = simulator(&config(Scenario::Square));
    let mut count = 0;
    driven.wheels(RECORDING_START_NS + 100_000_000, &mut |m, fault| {
        count += 1;
        assert!(m.timestamp_ns <= RECORDING_START_NS + 100_000_000 && fault.is_none());
    });
    assert_eq!(count, 6, "0, 20, .. 100 ms");
    driven.wheels(RECORDING_START_NS + 119_000_000, &mut |_, _| panic!("told twice, or too early"));
    assert!(simulator(&config(Scenario::HandHeld)).odometer().is_none());
    let mut jerky = config(Scenario::Square);
    jerky.jerks.enabled = true;
    assert!(simulator(&jerky).odometer().is_none());
}

#[test]
fn the_camera_sits_on_the_base_where_it_is_told_and_a_base_alone_moves_no_picture() {
    let mut config = config(Scenario::Square);
    let plain = simulator(&config);
    config.wheels.enabled = false;
    let without = simulator(&config);
    config.wheels.enabled = true;
    (config.wheels.camera_m, config.wheels.camera_yaw_deg) = ([0.12, -0.05], 10.0);
    let moved = simulator(&config);
    for t in [0.0, 3.7, 9.2, 15.0] {
        let [a, b, c] = [&plain, &without, &moved].map(|s| s.trajectory().pose_at_seconds(t));
        assert_eq!(a, b);
        let [x, y, yaw] = moved.trajectory().base_at_seconds(t).expect("driven");
        assert_eq!([x, y], [a.translation.x, a.translation.y], "the plain camera is above the wheels");
        let (dx, dy) = (c.translation.x - x, c.translation.y - y);
        let (forward, left) = (dx * yaw.cos() + dy * yaw.sin(), dy * yaw.cos() - dx * yaw.sin());
        assert!((forward - 0.12).abs() < 1e-9 && (left + 0.05).abs() < 1e-9, "{forward} {left}");
        let turned = a.rotation.angle_to(&c.rotation).to_degrees();
        assert!((turned - 10.0).abs() < 0.1, "{turned} degrees");
    }
}
