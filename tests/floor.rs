//! The camera's height above the floor, on the simulator without threads: the map becomes metric, of the right scale, and never by something that is no floor.

use cairn::camera::Pacing;
use cairn::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use cairn::features::{FeatureStage, FeaturesConfig, Feedback, FrameFeatures};
use cairn::geometry::alignment::align;
use cairn::geometry::frames::World;
use cairn::image::GreyImage;
use cairn::map::scale::MapScale;
use cairn::motion::floor::{ScaleConfig, roll_pitch};
use cairn::motion::hand_eye::Robot;
use cairn::reconstruction::{InlineWorker, Reconstruction, ReconstructionConfig, TrackingState};

struct Driven {
    /// Of the camera until the map became metric, and in all, m.
    until_metric_m: Option<f64>,
    way_m: f64,
    /// Standard deviation of the scale at the end, a share.
    sigma: f64,
    /// By what share the lengths published since the map became metric are wrong.
    scale_error: f64,
    /// As found at the end, degrees; and landmarks on the floor.
    roll_pitch_deg: Option<(f64, f64)>,
    /// Keyframes that told a floor, and that told none, by reason.
    told: usize,
    refused: std::collections::BTreeMap<String, usize>,
    see_ms: f64,
}

/// Lock-step over so many seconds; the camera's height is said to be `height_m`.
fn drive(config: &SimulatorConfig, seconds: f64, height_m: f64) -> Driven {
    let mut simulator = Simulator::new(config, Pacing::LockStep).unwrap();
    let camera = simulator.camera_model().clone();
    let mut stage = FeatureStage::new(&FeaturesConfig::default());
    let worker = Box::new(InlineWorker::default());
    let mut reconstruction = Reconstruction::new(&ReconstructionConfig::default(), &camera, worker, true);
    let scale = ScaleConfig { camera_height_m: height_m, ..ScaleConfig::default() };
    assert!(scale.validate().is_ok());
    reconstruction.look_for_floor(&scale, &Robot::unknown());
    let (mut features, mut feedback, mut picture) =
        (FrameFeatures::default(), Feedback::default(), GreyImage::new(0, 0));
    let (mut events, mut until_metric_m, mut way_m) = (Vec::new(), None, 0.0);
    let (mut from, mut to): (Vec<nalgebra::Vector3<f64>>, Vec<nalgebra::Vector3<f64>>) = (Vec::new(), Vec::new());
    let (mut last, mut told, mut refused, mut see_ms) = (None, 0, std::collections::BTreeMap::new(), 0.0f64);
    for sequence in 0..(seconds * config.rate_hz) as u64 {
        simulator.render(sequence, &mut picture);
        stage.step_grey(&picture, &mut features);
        features.sequence = sequence;
        features.timestamp_ns = simulator.timestamp_ns(sequence);
        let place = simulator.trajectory().pose_at(features.timestamp_ns).translation;
        way_m += last.replace(place).map_or(0.0, |last: nalgebra::Vector3<f64>| (place - last).norm());
        let estimate = reconstruction.track(&features);
        if let (TrackingState::Tracking, MapScale::Metric { .. }, Some(pose)) =
            (estimate.state, estimate.scale, estimate.world_from_camera)
        {
            from.push(pose.translation);
            to.push(place);
        }
        let begun = std::time::Instant::now();
        reconstruction.map(&features, &mut feedback);
        see_ms = see_ms.max(begun.elapsed().as_secs_f64() * 1e3);
        stage.feedback(&feedback);
        reconstruction.take_trajectory_events(&mut events);
        events.clear();
        if estimate.keyframe {
            match reconstruction.no_floor() {
                None => told += 1,
                Some(reason) => *refused.entry(format!("{reason:?}").split('(').next().unwrap_or("").to_owned()).or_insert(0) += 1,
            }
            if std::env::var_os("FLOOR_VERBOSE").is_some() {
                println!("{sequence} way {way_m:.2} {:?} {:?}", reconstruction.no_floor(), reconstruction.floor());
            }
        }
        if reconstruction.scale().is_metric() {
            until_metric_m.get_or_insert(way_m);
        }
    }
    let scaled = align::<World, World>(&from, &to, true);
    let sigma = match reconstruction.scale() {
        MapScale::Metric { sigma, .. } => sigma,
        MapScale::Unknown => f64::INFINITY,
    };
    Driven {
        until_metric_m,
        way_m,
        sigma,
        scale_error: scaled.map_or(f64::NAN, |a| a.to_from_from.scale - 1.0),
        roll_pitch_deg: reconstruction.floor().map(|plane| {
            let (roll, pitch) = roll_pitch(&plane.up_camera);
            (roll.to_degrees(), pitch.to_degrees())
        }),
        told,
        refused,
        see_ms,
    }
}

fn room(scenario: Scenario, seed: u64) -> SimulatorConfig {
    SimulatorConfig { seed, rate_hz: 12.0, width: 320, height: 240, scenario, ..Default::default() }
}

fn judge(config: &SimulatorConfig, seconds: f64, height_m: f64) -> Driven {
    let driven = drive(config, seconds, height_m);
    let Driven { until_metric_m, way_m, sigma, scale_error, roll_pitch_deg, told, refused, see_ms } = &driven;
    println!(
        "{} {}: {way_m:.1} m, metric after {until_metric_m:.1?} m, scale {:.2} % off, sigma {:.2} %, roll and pitch {roll_pitch_deg:.2?}, {told} told {refused:?} {see_ms:.1} ms",
        config.scenario.name(),
        config.seed,
        100.0 * scale_error,
        100.0 * sigma,
    );
    driven
}

/// Height of the simulator's camera on a driven base, m.
const HEIGHT_M: f64 = 0.5;

#[test]
#[ignore = "the long form, which prints its figures"]
fn table() {
    let word = |name: &str, or: &str| std::env::var(name).unwrap_or_else(|_| or.into());
    let seconds: f64 = word("SECONDS", "25").parse().unwrap();
    let seeds: Vec<u64> = word("SEEDS", "1,2,3").split(',').map(|s| s.parse().unwrap()).collect();
    for name in word("SCENARIOS", "room_tour,square,corridor").split(',') {
        let scenario = Scenario::ALL.into_iter().find(|s| s.name() == name).unwrap();
        for seed in &seeds {
            let mut config = room(scenario, *seed);
            if word("SIZE", "small") == "large" {
                (config.width, config.height, config.rate_hz) = (640, 480, 20.0);
            }
            judge(&config, seconds, HEIGHT_M);
        }
    }
}
