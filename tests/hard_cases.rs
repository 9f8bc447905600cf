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

fn keeps_its_promise(name: &str, seed: u64) {
    let case = cases(seed).into_iter().find(|c| c.name == name).expect("a case of this name");
    let folder = tempfile::tempdir().expect("a folder");
    let (features, reconstruction) = (FeaturesConfig::default(), ReconstructionConfig::default());
    let (result, run) = run_case(&case, false, &features, &reconstruction, folder.path()).expect("a run");
    println!("{}", table(std::slice::from_ref(&result)));
    assert!(result.missed.is_empty(), "{name}, seed {seed}: {}", result.missed.join("; "));
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
    ($($name:ident)*) => { $(#[test] fn $name() { keeps_its_promise(stringify!($name), SEED); })* };
}

hard_cases! {
    pure_rotation standing move_then_rotate move_then_stand turn_on_the_spot blackout exposure_jumps occluder low_texture shutter_and_blur
    fast_rotation low_rate low_rate_walk orbit tour wide_angle wide_angle_tour gloss people exposure_hunts jerks desk_sweep dropped_frames
}

/// Books behind the bars of a rack: where edges cross are corners that are none. With one limit for all cameras the map bends by 1.5 % of the way.
#[test]
fn crossing_edges_do_not_bend_the_map_of_a_desk() {
    keeps_its_promise("gloss", 900);
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
    println!(
        "\n| run at {rate_hz} Hz | frames | mean NEES | of the rotation | of the translation |\n|---|---:|---:|---:|---:|"
    );
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
                "| {} seed {seed} | {} | {:.1} | {:.1} | {:.1} |",
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
    println!(
        "\n| NEES of all runs | degrees of freedom | mean | honest from | honest to | frames | in their own 95 % interval % | above it % | below it % |"
    );
    println!("|---|---:|---:|---:|---:|---:|---:|---:|---:|");
    let of = |what, f: fn(&Nees) -> f64, d| {
        let c = Consistency::of(&errors.iter().map(f).collect::<Vec<_>>(), d).expect("judged frames");
        println!(
            "| {what} | {d} | {:.2} | {:.2} | {:.2} | {} | {:.0} | {:.0} | {:.0} |",
            c.mean,
            c.band[0],
            c.band[1],
            c.frames,
            c.inside_percent,
            c.above_percent,
            100.0 - c.inside_percent - c.above_percent
        );
        c
    };
    of("rotation", |n| n.rotation, 3);
    of("translation", |n| n.translation, 3);
    of("pose", |n| n.pose, 6)
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
    let pose = told(&errors_over(141..151, 15.0, 30.0));
    assert!(pose.is_honest(), "seeds 141 to 150: mean NEES {} outside of {:?}", pose.mean, pose.band);
}

/// What became of the scale at a turn on the spot, and of the errors behind it.
struct BehindTurn {
    /// The step behind the turn had its length from assumed distances.
    assumed: bool,
    /// Length of the way behind the turn, estimated over true, in units of the same before it.
    ratio: f64,
    /// Normalised errors squared of judged frames, a second apart: along the way since the turn (1 degree of freedom), and of the
    /// whole position (3).
    along: Vec<f64>,
    position: Vec<f64>,
}

/// Drives, turns on the spot between `turn_s`, drives on; errors of position since the turn, in the map's unit before it.
fn behind_turn(config: &SimulatorConfig, turn_s: [f64; 2], seconds: f64) -> Option<BehindTurn> {
    let what = Drive {
        simulator: config,
        steps: &[1],
        seconds,
        features: &FeaturesConfig::default(),
        reconstruction: &ReconstructionConfig::default(),
    };
    let folder = tempfile::tempdir().expect("a folder");
    let run = drive(&what, &folder.path().join("trajectory.txt")).expect("a run");
    let at = |s: f64| {
        let tracked = run.records.iter().filter(|r| r.is_tracking() && r.timestamp_ns as f64 * 1e-9 >= s);
        tracked.map(|r| Some((r.estimate.world_from_camera?, r.truth, r))).next().flatten()
    };
    let began_s = run.records.first()?.timestamp_ns as f64 * 1e-9;
    let way = |from_s: f64, to_s: f64| {
        let (a, b) = (at(began_s + from_s)?, at(began_s + to_s)?);
        Some((b.0.translation - a.0.translation).norm() / (b.1.translation - a.1.translation).norm())
    };
    let before = way(0.25 * turn_s[0], turn_s[0] - 0.1)?;
    let ratio = way(turn_s[1] + 0.8, seconds - 0.2)? / before;
    let (turn, turn_true, _) = at(began_s + 0.5 * (turn_s[0] + turn_s[1]))?;
    let (mut along, mut position) = (Vec::new(), Vec::new());
    let mut t = turn_s[1] + 1.0;
    while let Some((pose, truth, record)) = at(began_s + t) {
        // In the axes of the camera, where the covariance's translation is.
        let estimated = pose.rotation.inverse() * (pose.translation - turn.translation);
        let since = turn.rotation * turn_true.rotation.inverse() * (truth.translation - turn_true.translation) * before;
        let e = estimated - pose.rotation.inverse() * since;
        let p = record.estimate.covariance.fixed_view::<3, 3>(3, 3).into_owned();
        let d = estimated.normalize();
        along.push(d.dot(&e).powi(2) / d.dot(&(p * d)));
        position.push(e.dot(&p.cholesky()?.solve(&e)));
        t += 1.0;
    }
    Some(BehindTurn { assumed: run.counters.blind_turns > 0, ratio, along, position })
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// Turns of several seeds; the errors along the way behind those that left all known distances behind, and log of the scale's ratios.
fn behind_turns(seeds: std::ops::Range<u64>) -> (Vec<f64>, Vec<f64>) {
    let (mut along, mut ratios) = (Vec::new(), Vec::new());
    println!("\n| behind a turn | scale | of that before | NEES along the way (1) | of the position (3) |");
    println!("|---|---|---:|---:|---:|");
    for seed in seeds {
        for (scenario, turn_s, seconds) in
            [(Scenario::Square, [9.3, 12.4], 18.0), (Scenario::Corridor, [23.3, 28.6], 34.0)]
        {
            let config = SimulatorConfig { scenario, seed, rate_hz: 15.0, ..SimulatorConfig::default() };
            let Some(b) = behind_turn(&config, turn_s, seconds) else {
                println!("| {} seed {seed} | no pose | – | – | – |", scenario.name());
                continue;
            };
            println!(
                "| {} seed {seed} | {} | {:.2} | {:.2} | {:.1} |",
                scenario.name(),
                if b.assumed { "assumed" } else { "measured" },
                b.ratio,
                mean(&b.along),
                mean(&b.position)
            );
            if b.assumed {
                along.extend(b.along);
                ratios.push(b.ratio.ln());
            }
        }
    }
    (along, ratios)
}

#[test]
#[ignore = "minutes: the scale behind turns of many seeds"]
fn the_covariance_knows_that_the_scale_behind_a_turn_is_assumed() {
    let (along, ratios) = behind_turns(1..7);
    let rms = mean(&ratios.iter().map(|r| r * r).collect::<Vec<_>>()).sqrt();
    let nees = mean(&along);
    println!(
        "\n| turns at an assumed scale | logarithm of the scale off, RMS | mean NEES along the way |\n|---|---:|---:|\n| {} | {rms:.2} | {nees:.2} |",
        ratios.len()
    );
    assert!(ratios.len() >= 4, "seeds 1 to 6: only {} turns left all known distances behind", ratios.len());
    // One degree of freedom; all frames behind a turn share one error, so there are as many independent ones as turns.
    assert!(nees > 0.1 && nees < 3.0, "seeds 1 to 6: mean NEES along the way {nees} instead of about 1");
}
