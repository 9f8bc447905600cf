//! The hard cases: what a robot's day brings, each with the figures that it must reach.
//!
//! Short forms run in CI, long ones by `cairn evaluate --simulator --long`. The limits are the same for both unless a case says
//! otherwise; they are what the system promises, not what it happens to reach.

use crate::camera::simulator::{Scenario, SimulatorConfig};

/// What must come out of a case.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Expectation {
    /// No frame may get a pose: there is no depth in it.
    NoPose,
    Poses(Limits),
}

/// Limits of one case.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Frames with a pose in the trajectory at the least, % of all.
    pub coverage_percent: f64,
    /// ATE RMSE after Sim(3) at the most, % of the truth's path.
    pub ate_percent: f64,
    /// Maps begun anew at the most.
    pub resets: u64,
    /// Frames in a row without a pose at the most, once there was one.
    pub gap_frames: u64,
}

/// One case.
#[derive(Debug, Clone)]
pub struct Case {
    pub name: &'static str,
    /// In words, for the table's reader.
    pub what: &'static str,
    pub config: SimulatorConfig,
    /// See [`super::drive::Drive::steps`].
    pub steps: &'static [u64],
    pub short_s: f64,
    pub long_s: f64,
    pub expectation: Expectation,
    /// From this time on the camera stands still, s: drift is measured there.
    pub stands_from_s: Option<f64>,
}

fn limits(coverage_percent: f64, ate_percent: f64, resets: u64, gap_frames: u64) -> Expectation {
    Expectation::Poses(Limits { coverage_percent, ate_percent, resets, gap_frames })
}

/// A webcam with an ordinary day's flaws but for exposure jumps and people walking by.
fn webcam(scenario: Scenario, seed: u64) -> SimulatorConfig {
    SimulatorConfig { scenario, seed, ..SimulatorConfig::default() }
}

/// A dim room and a hand that jerks every two seconds.
fn jerky(c: &mut SimulatorConfig) {
    c.jerks.enabled = true;
    c.motion_blur.exposure_ms = 30.0;
    // A peak of 150 degrees/s streaks by some 40 px.
    c.motion_blur.max_samples = 32;
}

/// All cases; `seed` draws room and movement.
pub fn cases(seed: u64) -> Vec<Case> {
    let plain = |name, what, scenario, short_s, long_s, expectation| Case {
        name,
        what,
        config: webcam(scenario, seed),
        steps: &[1],
        short_s,
        long_s,
        expectation,
        stands_from_s: None,
    };
    let mut all = vec![
        plain(
            "pure_rotation",
            "turns on the spot from the first frame on",
            Scenario::PureRotation,
            4.0,
            60.0,
            Expectation::NoPose,
        ),
        plain("standing", "never moves", Scenario::Standing, 3.0, 60.0, Expectation::NoPose),
        plain(
            "move_then_rotate",
            "moves, then only turns, then moves again",
            Scenario::MoveThenRotate,
            15.0,
            60.0,
            limits(97.0, 1.0, 0, 5),
        ),
        plain(
            "move_then_stand",
            "moves for 10 s, then stands",
            Scenario::MoveThenStand,
            18.0,
            613.0,
            limits(97.0, 1.0, 0, 5),
        ),
    ];
    if let Some(stand) = all.last_mut() {
        stand.stands_from_s = Some(13.0);
    }
    all.push(plain(
        "turn_on_the_spot",
        "drives, turns by 90 degrees on the spot, drives on",
        Scenario::Square,
        15.0,
        60.0,
        limits(90.0, 10.0, 0, 15),
    ));
    for case in all.iter_mut().skip(2) {
        // Long stretches in which little happens.
        case.config.rate_hz = 15.0;
    }
    let mut add = |name, what, scenario, short_s, long_s, expectation, edit: &dyn Fn(&mut SimulatorConfig)| {
        let mut case = plain(name, what, scenario, short_s, long_s, expectation);
        edit(&mut case.config);
        all.push(case);
    };
    add("blackout", "lens covered for 20 frames", Scenario::HandHeld, 7.0, 40.0, limits(85.0, 1.0, 0, 30), &|c| {
        c.blackout.enabled = true;
        c.blackout.start_s = 4.0;
        c.blackout.period_s = 8.0;
    });
    add(
        "exposure_jumps",
        "up to 2 EV, every second or so",
        Scenario::RoomTour,
        7.0,
        60.0,
        limits(95.0, 1.0, 0, 10),
        &|c| {
            c.exposure.jumps = true;
            c.exposure.jump_period_s = 1.2;
            c.exposure.jump_ev = 2.0;
        },
    );
    add(
        "occluder",
        "something covers 30 % of the picture",
        Scenario::HandHeld,
        7.0,
        60.0,
        limits(95.0, 1.0, 0, 10),
        &|c| {
            c.occluder.enabled = true;
            c.occluder.start_s = 3.0;
            c.occluder.period_s = 5.0;
        },
    );
    add("low_texture", "bare walls, pale furniture", Scenario::HandHeld, 7.0, 60.0, limits(90.0, 2.0, 0, 10), &|c| {
        c.low_texture = true;
    });
    add(
        "shutter_and_blur",
        "30 ms of readout, 20 ms of exposure, twice the speed",
        Scenario::HandHeld,
        6.0,
        60.0,
        limits(90.0, 1.5, 0, 15),
        &|c| {
            c.speed = 2.0;
            c.rolling_shutter.readout_ms = 30.0;
            c.motion_blur.exposure_ms = 20.0;
        },
    );
    add(
        "fast_rotation",
        "bursts of 200 to 300 degrees a second, blurred",
        Scenario::FastRotation,
        8.0,
        60.0,
        limits(85.0, 2.0, 0, 30),
        &|c| {
            c.motion_blur.exposure_ms = 12.0;
        },
    );
    add(
        "low_rate",
        "6 frames a second, hand-held, twice the speed",
        Scenario::HandHeld,
        20.0,
        60.0,
        limits(85.0, 1.5, 0, 15),
        &|c| {
            c.rate_hz = 6.0;
            c.speed = 2.0;
        },
    );
    add(
        "low_rate_walk",
        "5 frames a second, a walk with turns of 13 degrees a frame",
        Scenario::RoomTour,
        25.0,
        75.0,
        limits(80.0, 2.0, 0, 15),
        &|c| {
            c.rate_hz = 5.0;
            c.speed = 2.0;
        },
    );
    add("orbit", "around a table, revisiting", Scenario::DeskOrbit, 5.0, 60.0, limits(95.0, 1.0, 0, 10), &|_| {});
    add("tour", "laps of a room, revisiting", Scenario::RoomTour, 5.0, 90.0, limits(95.0, 1.0, 0, 10), &|_| {});
    add(
        "wide_angle",
        "a fisheye of 150 degrees across the diagonal, hand-held",
        Scenario::HandHeld,
        7.0,
        60.0,
        limits(95.0, 1.0, 0, 10),
        &|c| c.lens.wide_angle.enabled = true,
    );
    add(
        "wide_angle_tour",
        "laps of a room through the same lens",
        Scenario::RoomTour,
        5.0,
        90.0,
        limits(95.0, 1.0, 0, 10),
        &|c| c.lens.wide_angle.enabled = true,
    );
    add(
        "gloss",
        "screen, pictures and table tops reflect the lamps",
        Scenario::DeskSweep,
        8.0,
        48.0,
        limits(95.0, 1.0, 0, 10),
        &|c| c.gloss.enabled = true,
    );
    add(
        "people",
        "two people pace to and fro from second 3 on",
        Scenario::HandHeld,
        9.0,
        60.0,
        limits(95.0, 0.3, 0, 10),
        &|c| c.people.enabled = true,
    );
    add(
        "exposure_hunts",
        "exposure swings by up to 0.7 EV, 0.8 s a swing",
        Scenario::HandHeld,
        7.0,
        60.0,
        limits(95.0, 0.3, 0, 10),
        &|c| c.exposure.hunts = true,
    );
    add(
        "jerks",
        "30 ms of exposure, jerks of 60 to 150 degrees/s",
        Scenario::HandHeld,
        10.0,
        60.0,
        limits(90.0, 1.5, 0, 15),
        &jerky,
    );
    add(
        "desk_sweep",
        "to and fro along a cluttered desk, jerks of up to 190 degrees/s, up to 33 ms of exposure, gloss",
        Scenario::DeskSweep,
        12.5,
        60.0,
        limits(85.0, 1.0, 1, 60),
        &|c| {
            // Half of the frames as fast as `tum_fr1_desk` (0.5 m/s, 33 degrees/s), the jerks a third faster than its quickest.
            c.speed = 1.3;
            c.jerks.enabled = true;
            c.gloss.enabled = true;
            c.exposure.hunts = true;
            c.exposure.sets_time = true;
            c.motion_blur.exposure_ms = 30.0;
            c.motion_blur.max_samples = 32;
        },
    );
    let mut dropped = plain(
        "dropped_frames",
        "two to four of five frames are missing",
        Scenario::DeskOrbit,
        12.0,
        60.0,
        limits(85.0, 1.5, 0, 15),
    );
    dropped.steps = &[3, 4, 5, 4, 3, 5];
    all.push(dropped);
    all
}
