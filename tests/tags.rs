//! Tags on the wall of the simulated room, through lens, noise and the whole reconstruction: what they say of the map's scale, beside the
//! scale that the true path has.

use cairn::camera::Pacing;
use cairn::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use cairn::features::{FeatureStage, FeaturesConfig, Feedback, FrameFeatures};
use cairn::geometry::alignment::align;
use cairn::geometry::frames::World;
use cairn::image::GreyImage;
use cairn::motion::scale::{ScaleMeasurement, ScaleSource};
use cairn::motion::tag::TagConfig;
use cairn::reconstruction::{InlineWorker, Reconstruction, ReconstructionConfig};

/// What the tags say at the end of `frames` pictures, and ln(metres per map unit) by the true path.
fn run(config: &SimulatorConfig, tag: &TagConfig, frames: u64) -> (Option<ScaleMeasurement>, f64) {
    let mut simulator = Simulator::new(config, Pacing::LockStep).expect("a room");
    let camera = simulator.camera_model().clone();
    let mut stage = FeatureStage::new(&FeaturesConfig::default());
    let worker = Box::new(InlineWorker::default());
    let mut reconstruction = Reconstruction::new(&ReconstructionConfig::default(), &camera, worker, true);
    reconstruction.look_for_tags(tag);
    let (mut features, mut feedback, mut picture) =
        (FrameFeatures::default(), Feedback::default(), GreyImage::new(0, 0));
    let (mut found, mut truth) = (Vec::new(), Vec::new());
    for sequence in 0..frames {
        simulator.render(sequence, &mut picture);
        stage.step_grey(&picture, &mut features);
        features.sequence = sequence;
        features.timestamp_ns = simulator.timestamp_ns(sequence);
        if let Some(pose) = reconstruction.track(&features).world_from_camera {
            found.push(pose.translation);
            truth.push(simulator.trajectory().pose_at(features.timestamp_ns).translation);
        }
        reconstruction.map(&features, &mut feedback);
        stage.feedback(&feedback);
    }
    let scale = align::<World, World>(&found, &truth, true).expect("tracked").to_from_from.scale;
    (reconstruction.scale_by_tags(), scale.ln())
}

fn room(seed: u64) -> SimulatorConfig {
    let mut config = SimulatorConfig { seed, ..SimulatorConfig::everything(Scenario::HandHeld) };
    config.tags.enabled = true;
    config
}

#[test]
fn tags_on_the_wall_say_how_long_a_map_unit_is() {
    for seed in 1..=3 {
        let tag = TagConfig { size_m: 0.15, size_sigma_m: 0.0, ids: vec![0, 1, 2] };
        let (told, truth) = run(&room(seed), &tag, 300);
        let told = told.expect("tags in view");
        let error = told.log_metres_per_unit - truth;
        eprintln!("seed {seed}: off by {:.3} %, sigma {:.3} %", 100.0 * error, 100.0 * told.sigma);
        assert_eq!(told.source, ScaleSource::Tag);
        assert!(
            error.abs() < 0.01 && error.abs() < 3.0 * told.sigma && told.sigma < 0.02,
            "seed {seed}: {error} {told:?}"
        );
    }
}

#[test]
fn without_a_size_in_the_configuration_nobody_looks() {
    let (told, _) = run(&room(1), &TagConfig::default(), 120);
    assert_eq!(told, None);
}
