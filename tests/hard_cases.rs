//! The simulator suite's short form: every hard case keeps its promise, and the published covariance is honest.
//!
//! `cairn evaluate --simulator --long` runs the long form and writes a table. The covariance over many seeds:
//! `cargo test --release --test hard_cases -- --ignored --nocapture`.

use cairn::camera::simulator::{Scenario, SimulatorConfig};
use cairn::evaluation::simulated::cases::cases;
use cairn::evaluation::simulated::consistency::{self, Consistency, Nees};
use cairn::evaluation::simulated::drive::{Drive, drive};
use cairn::evaluation::simulated::{run_case, table};
use cairn::features::FeaturesConfig;
use cairn::reconstruction::{ReconstructionConfig, TrackingState};

const SEED: u64 = 3;

fn keeps_its_promise(name: &str) {
    let case = cases(SEED).into_iter().find(|c| c.name == name).expect("a case of this name");
    let folder = tempfile::tempdir().expect("a folder");
    let (features, reconstruction) = (FeaturesConfig::default(), ReconstructionConfig::default());
    let (result, run) = run_case(&case, false, &features, &reconstruction, folder.path()).expect("a run");
    println!("{}", table(std::slice::from_ref(&result)));
    assert!(result.missed.is_empty(), "{name}, seed {SEED}: {}", result.missed.join("; "));
    // Whatever happens: a pose, a finite covariance and the state belong together, and no pose is published without landmarks.
    for r in &run.records {
        let e = &r.estimate;
        let tracking = e.state == TrackingState::Tracking;
        assert_eq!(e.world_from_camera.is_some(), tracking, "{name}, frame {}", e.sequence);
        assert!(e.covariance.iter().all(|v| v.is_finite() == tracking), "{name}, frame {}", e.sequence);
        assert!(!tracking || e.covariance.cholesky().is_some() && e.landmarks >= 15, "{name}, frame {}", e.sequence);
    }
}

macro_rules! hard_cases {
    ($($name:ident)*) => { $(#[test] fn $name() { keeps_its_promise(stringify!($name)); })* };
}

hard_cases! {
    pure_rotation standing move_then_rotate move_then_stand turn_on_the_spot blackout exposure_jumps occluder low_texture shutter_and_blur
    fast_rotation low_rate low_rate_walk orbit tour wide_angle wide_angle_tour dropped_frames
}

#[test]
fn every_case_is_run_here() {
    let here = include_str!("hard_cases.rs");
    for case in cases(SEED) {
        assert!(here.split("hard_cases! {").nth(1).is_some_and(|list| list.contains(case.name)), "{}", case.name);
    }
}

/// Most of a lap around the table is missing; then the camera is back at a stretch that is mapped, some decimetres beside it.
#[test]
fn a_place_is_found_again_without_a_guess() {
    let config = SimulatorConfig { seed: SEED, ..SimulatorConfig::everything(Scenario::DeskOrbit) };
    let (before, jump, after) = (150, 660, 12);
    let steps: Vec<u64> = (0..before + after).map(|i| if i + 1 == before { jump } else { 1 }).collect();
    let what = Drive {
        simulator: &config,
        steps: &steps,
        seconds: (before + jump as usize + after) as f64 / config.rate_hz,
        features: &FeaturesConfig::default(),
        reconstruction: &ReconstructionConfig::default(),
    };
    let folder = tempfile::tempdir().expect("a folder");
    let run = drive(&what, &folder.path().join("trajectory.txt")).expect("a run");
    assert!(run.records[before - 1].is_tracking(), "mapped before the jump");
    let missed = run.records[before..].iter().position(|r| r.is_tracking());
    assert!(missed.is_some_and(|frames| frames <= 3), "seed {SEED}: found again after {missed:?} frames");
    assert_eq!(run.counters.resets, 0, "seed {SEED}: in the same map");
}

/// NEES of all judged frames of runs with every flaw on.
fn errors_over(seeds: std::ops::Range<u64>, seconds: f64, rate_hz: f64) -> Vec<Nees> {
    let folder = tempfile::tempdir().expect("a folder");
    let mut all = Vec::new();
    for seed in seeds {
        for scenario in [Scenario::HandHeld, Scenario::RoomTour, Scenario::DeskOrbit] {
            let config = SimulatorConfig { seed, rate_hz, ..SimulatorConfig::everything(scenario) };
            let what = Drive {
                simulator: &config,
                steps: &[1],
                seconds,
                features: &FeaturesConfig::default(),
                reconstruction: &ReconstructionConfig::default(),
            };
            let run = drive(&what, &folder.path().join("trajectory.txt")).expect("a run");
            let own = consistency::judge(&run.records);
            let mean = |f: fn(&Nees) -> f64| own.iter().map(f).sum::<f64>() / own.len().max(1) as f64;
            println!(
                "seed {seed} {:10} {rate_hz:4} Hz: {:3} frames, mean NEES {:6.1}, rotation {:6.1}, translation {:6.1}",
                scenario.name(),
                own.len(),
                mean(|n| n.pose),
                mean(|n| n.rotation),
                mean(|n| n.translation)
            );
            all.extend(own);
        }
    }
    all
}

fn told(errors: &[Nees]) -> Consistency {
    let of = |f: fn(&Nees) -> f64, d| {
        let c = Consistency::of(&errors.iter().map(f).collect::<Vec<_>>(), d).expect("judged frames");
        println!(
            "{d} degrees of freedom: mean NEES {:.2}, band {:.2} to {:.2}; {:.0} % of {} frames in their own 95 % interval, {:.0} % above",
            c.mean, c.band[0], c.band[1], c.inside_percent, c.frames, c.above_percent
        );
        c
    };
    of(|n| n.rotation, 3);
    of(|n| n.translation, 3);
    of(|n| n.pose, 6)
}

#[test]
fn the_covariance_is_of_the_errors_size() {
    let pose = told(&errors_over(41..42, 8.0, 10.0));
    assert!(pose.mean < 3.0 * 6.0 && pose.mean > 6.0 / 6.0, "seed 41: mean NEES {} instead of about 6", pose.mean);
}

/// Minutes; seeds that nothing was fitted on.
#[test]
#[ignore = "minutes: the covariance over many seeds"]
fn the_covariance_is_honest_over_many_seeds() {
    let pose = told(&errors_over(71..81, 15.0, 30.0));
    assert!(pose.is_honest(), "seeds 71 to 80: mean NEES {} outside of {:?}", pose.mean, pose.band);
}
