//! The guide on the simulator: the same chain as with a camera.

use super::*;
use crate::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use crate::camera::{FrameSource, Grab, Pacing};
use crate::frame::RawFrame;
use crate::image::decode::Decoder;
use std::time::Duration;

fn sweep() -> SimulatorConfig {
    let mut config = SimulatorConfig { scenario: Scenario::CalibrationSweep, ..SimulatorConfig::default() };
    (config.width, config.height) = (480, 360);
    config.chessboard.enabled = true;
    config.texel_mm = 4.0;
    config.speed = 0.1;
    config.rate_hz = 4.0;
    config
}

#[test]
fn a_sweep_before_the_simulated_board_ends_by_itself_with_the_true_camera() {
    ends_with_the_true_camera(&sweep(), Distortion::RadialTangential);
}

#[test]
fn a_sweep_with_a_wide_angle_lens_ends_by_itself_with_the_true_camera() {
    let mut config = sweep();
    config.lens.wide_angle.enabled = true;
    ends_with_the_true_camera(&config, Distortion::KannalaBrandt);
}

fn ends_with_the_true_camera(config: &SimulatorConfig, distortion: Distortion) {
    let mut source = Simulator::new(config, Pacing::LockStep).expect("simulator");
    let truth = source.camera_model().clone();
    let pattern = Pattern::new(9, 6, 0.03).expect("valid");
    let mut guide = Guide::new(pattern, distortion);
    let (mut slot, mut picture, mut decoder) = (RawFrame::default(), GreyImage::default(), Decoder::default());
    let mut frames = 0;
    while frames < 900 && !guide.is_done() {
        assert_eq!(source.grab(&mut slot, Duration::ZERO).expect("frame"), Grab::Frame);
        decoder.decode(&slot, &mut picture).expect("decoded");
        guide.step(&picture, slot.timestamp_ns);
        frames += 1;
    }
    let solution = guide.solution().expect("solved");
    println!("{frames} frames, {}\n{}{}", guide.progress(), solution.table(), solution.words());
    assert!(guide.is_done(), "{}", solution.words());
    let error = (solution.camera.fx / truth.fx - 1.0).abs();
    assert!(error < 0.005, "fx {} instead of {}", solution.camera.fx, truth.fx);
}

#[test]
fn a_wrong_board_is_told_apart_from_none() {
    let mut source = Simulator::new(&sweep(), Pacing::LockStep).expect("simulator");
    let mut picture = GreyImage::default();
    source.render(0, &mut picture);
    let mut guide = Guide::new(Pattern::new(8, 5, 0.03).expect("valid"), Distortion::Full);
    let seen = guide.step(&picture, 0);
    assert_eq!(seen, Seen::OtherSize(9, 6));
    assert!(guide.advice(seen).contains("9x6 inner corners is seen, 8x5 was asked for"), "{}", guide.advice(seen));
    let grey = GreyImage { width: 640, height: 480, data: vec![90; 640 * 480] };
    assert_eq!(guide.step(&grey, 0), Seen::NoBoard);
}
