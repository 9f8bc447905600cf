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
    assert!(error < 0.001, "fx {} instead of {}", solution.camera.fx, truth.fx);
    let sigmas = solution.solved.sigmas();
    for (i, expected) in [truth.fx, truth.fy, truth.cx, truth.cy].into_iter().enumerate() {
        let off = (solution.solved.intrinsics[i] - expected) / sigmas[i];
        assert!(off.abs() < 4.0, "parameter {i}: {off:.1} of its deviations off");
    }
    let readout = solution.solved.readout.expect("the board moved");
    let off = (1e3 * readout.seconds - config.rolling_shutter.readout_ms) / (1e3 * readout.sigma_s);
    assert!(off.abs() < 4.0 && readout.sigma_s < 0.005, "{readout:?}: {off:.1} of its deviations off");
}

#[test]
fn a_plane_s_flow_is_measured_through_noise_and_noise_alone_is_no_movement() {
    let mut random = crate::geometry::random::Random::new(4);
    for speed in [0.0, 8.0] {
        let (mut off, mut moving) = (0.0f64, 0);
        for _ in 0..50 {
            let mut board = |t: f64| {
                let corners = (0..54u32).map(|n| {
                    let (column, row) = (n % 9, n / 9);
                    let (x, y) = (f64::from(column), f64::from(row));
                    let flow = Vector2::new(1.0 + 0.1 * y, 0.2 * x - 0.03 * x * y) * speed;
                    let noise = Vector2::new(random.normal(), random.normal()) * 0.1;
                    let pixel = Vector2::new(100.0 + 40.0 * x, 90.0 + 40.0 * y) + flow * t + noise;
                    BoardCorner { column, row, pixel }
                });
                Board { corners: corners.collect(), complete: true, spacing_px: 40.0, blur_px: 1.0 }
            };
            let [before, now, after] = [board(-1.0 / 30.0), board(0.0), board(1.0 / 30.0)];
            let found = velocities(&now, &before, &after, 2.0 / 30.0);
            moving += usize::from(!found.is_empty());
            for (v, c) in found.iter().zip(&now.corners) {
                let (x, y) = (f64::from(c.column), f64::from(c.row));
                off += (v - Vector2::new(1.0 + 0.1 * y, 0.2 * x - 0.03 * x * y) * speed).norm_squared();
            }
        }
        if speed == 0.0 {
            assert!(moving <= 1, "seed 4: {moving} of 50 boards that stand move");
        } else {
            // Single corners are 2.1 px/s off in each direction.
            let rms = (off / (50.0 * 108.0)).sqrt();
            assert!(moving == 50 && rms < 0.9, "seed 4: {moving} of 50 move, {rms:.2} px/s off");
        }
    }
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
