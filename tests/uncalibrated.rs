//! A camera that nobody has calibrated, on the simulator: the lens is found from the motion where the motion shows it, and where it
//! does not that is said.

use cairn::camera::Pacing;
use cairn::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use cairn::features::{FeatureStage, FeaturesConfig, Feedback, FrameFeatures};
use cairn::image::GreyImage;
use cairn::reconstruction::{
    FOUND_SIGMA, InlineWorker, LensEstimate, LensKnowledge, LensPrior, Reconstruction, ReconstructionConfig,
    guessed_camera,
};

/// A simulated webcam of this focal length (picture widths), 15 pictures a second.
fn webcam(scenario: Scenario, focal_widths: f64) -> SimulatorConfig {
    let mut config = SimulatorConfig::ideal(scenario);
    config.lens.focal_widths = focal_widths;
    config.lens.distortion = true;
    config.noise.enabled = true;
    config.rate_hz = 15.0;
    config.texel_mm = 4.0;
    config
}

/// What is said of the lens after so many seconds, begun with 60 degrees across and no other knowledge.
fn found(config: &SimulatorConfig, seconds: f64) -> LensEstimate {
    let mut simulator = Simulator::new(config, Pacing::LockStep).expect("simulator");
    let guess = guessed_camera(config.width, config.height, 60.0).expect("a camera");
    let worker = Box::new(InlineWorker::default());
    let mut reconstruction =
        Reconstruction::with_lens(&ReconstructionConfig::default(), &guess, LensPrior::UNKNOWN, worker, true);
    let mut stage = FeatureStage::new(&FeaturesConfig::default());
    let (mut features, mut feedback, mut picture) =
        (FrameFeatures::default(), Feedback::default(), GreyImage::new(0, 0));
    for sequence in 0..(seconds * config.rate_hz) as u64 {
        simulator.render(sequence, &mut picture);
        stage.step_grey(&picture, &mut features);
        features.sequence = sequence;
        features.timestamp_ns = simulator.timestamp_ns(sequence);
        let pose = reconstruction.track(&features);
        let said = reconstruction.lens().knowledge;
        reconstruction.map(&features, &mut feedback);
        stage.feedback(&feedback);
        assert!(pose.quality <= 0.5 || said != LensKnowledge::Guessed, "a guessed lens gives no good pose: {pose:?}");
    }
    reconstruction.finish();
    reconstruction.lens()
}

/// Error of the focal length as a share of it.
fn error(lens: &LensEstimate, focal_widths: f64) -> f64 {
    (lens.camera.focal_px() / (focal_widths * f64::from(lens.camera.width))).ln()
}

fn is_found_by_hand_held(focal_widths: f64) {
    let lens = found(&webcam(Scenario::HandHeld, focal_widths), 9.0);
    let off = error(&lens, focal_widths);
    println!("{focal_widths} widths: {off:+.3} off, sigma {:.3}, {:?}", lens.focal_sigma, lens.knowledge);
    assert_eq!(lens.knowledge, LensKnowledge::Estimated, "{lens:?}");
    assert!(off.abs() <= 0.03f64.max(lens.focal_sigma), "{focal_widths} widths: {off:+.3} off, {lens:?}");
}

#[test]
fn a_wide_lens_is_found_from_the_motion() {
    is_found_by_hand_held(0.6);
}

#[test]
fn a_usual_lens_is_found_from_the_motion() {
    is_found_by_hand_held(0.82);
}

#[test]
fn a_narrow_lens_is_found_from_the_motion() {
    is_found_by_hand_held(1.15);
}

/// Not found, said so, and right within two of the standard deviations that are said.
fn is_not_observable(scenario: Scenario, focal_widths: f64, seconds: f64) {
    let lens = found(&webcam(scenario, focal_widths), seconds);
    let off = error(&lens, focal_widths);
    println!("{scenario:?}: {off:+.3} off, sigma {:.3}, {:?}", lens.focal_sigma, lens.knowledge);
    assert_eq!(lens.knowledge, LensKnowledge::Guessed, "{scenario:?}: {lens:?}");
    assert!(
        lens.focal_sigma > FOUND_SIGMA && off.abs() < 2.0 * lens.focal_sigma,
        "{scenario:?}: {off:+.3} off, {lens:?}"
    );
}

#[test]
fn turning_on_the_spot_ends_with_a_stated_uncertainty() {
    is_not_observable(Scenario::PureRotation, 0.82, 5.0);
}

#[test]
fn driving_straight_ahead_without_turning_shows_no_focal_length() {
    is_not_observable(Scenario::Corridor, 0.82, 4.0);
}

#[test]
fn gliding_sideways_without_turning_shows_no_focal_length() {
    is_not_observable(Scenario::Sideways, 0.82, 5.0);
}

#[test]
fn standing_still_shows_nothing() {
    is_not_observable(Scenario::Standing, 1.0, 2.0);
}

#[test]
fn a_kept_estimate_is_where_the_next_start_begins() {
    let first = found(&webcam(Scenario::HandHeld, 0.6), 9.0);
    let centre = first.centre_sigma_px[0].max(first.centre_sigma_px[1]) / f64::from(first.camera.width);
    let prior = LensPrior::kept(first.focal_sigma, centre);
    let worker = Box::new(InlineWorker::default());
    let config = ReconstructionConfig::default();
    let next = Reconstruction::with_lens(&config, &first.camera, prior, worker, true).lens();
    assert_eq!((next.knowledge, &next.camera), (LensKnowledge::Estimated, &first.camera));
    assert!((next.focal_sigma - first.focal_sigma).abs() < 1e-12, "{} and {}", next.focal_sigma, first.focal_sigma);
}
