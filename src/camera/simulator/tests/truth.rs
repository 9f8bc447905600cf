//! The ground truth holds: known points of the world are found in the picture where the pose says.

use nalgebra::{Matrix2, Vector2, Vector3};

use super::*;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};

/// Refines a chessboard corner to sub-pixel: every gradient near it is perpendicular to the line to it
/// (Förstner and Gülch, 1987).
fn refine(picture: &GreyImage, start: Vector2<f64>, half: i32) -> Option<Vector2<f64>> {
    let value = |x: f64, y: f64| {
        let (i, j) = (x.floor() as usize, y.floor() as usize);
        let (a, b) = (x - x.floor(), y - y.floor());
        let at = |x, y| f64::from(picture.at(x, y));
        (1.0 - b) * ((1.0 - a) * at(i, j) + a * at(i + 1, j)) + b * ((1.0 - a) * at(i, j + 1) + a * at(i + 1, j + 1))
    };
    let mut corner = start;
    for _ in 0..20 {
        let (mut normal, mut right) = (Matrix2::zeros(), Vector2::zeros());
        for dy in -half..=half {
            for dx in -half..=half {
                let p = corner + Vector2::new(f64::from(dx), f64::from(dy));
                let inside =
                    p.x > 2.0 && p.y > 2.0 && p.x < picture.width as f64 - 3.0 && p.y < picture.height as f64 - 3.0;
                if !inside {
                    return None;
                }
                let gradient = Vector2::new(
                    0.5 * (value(p.x + 1.0, p.y) - value(p.x - 1.0, p.y)),
                    0.5 * (value(p.x, p.y + 1.0) - value(p.x, p.y - 1.0)),
                );
                let r2 = f64::from(dx * dx + dy * dy) / f64::from(half * half);
                let outer = gradient * gradient.transpose() * (-2.0 * r2).exp();
                normal += outer;
                right += outer * p;
            }
        }
        let next = normal.try_inverse()? * right;
        if !((next - start).norm() < f64::from(half)) {
            return None;
        }
        let moved = (next - corner).norm();
        corner = next;
        if moved < 1e-4 {
            break;
        }
    }
    Some(corner)
}

/// Where a point of the world should be seen.
type Predict<'a> = &'a dyn Fn(&Simulator, &Vector3<f64>) -> Option<Vector2<f64>>;

/// Errors, px, of the corners found in frame `sequence` against `predict`.
fn errors(simulator: &mut Simulator, sequence: u64, predict: Predict) -> Vec<f64> {
    let picture = picture(simulator, sequence);
    let board = simulator.chessboard().expect("a board").clone();
    let mut errors = Vec::new();
    for row in 0..board.rows {
        for column in 0..board.columns {
            let Some(expected) = predict(simulator, &board.corner(column, row)) else { continue };
            if expected.x < 12.0 || expected.y < 12.0 || expected.x > 627.0 || expected.y > 467.0 {
                continue;
            }
            if let Some(found) = refine(&picture, expected, 4) {
                errors.push((found - expected).norm());
            }
        }
    }
    errors
}

fn seen_from(simulator: &Simulator, pose: &Se3<World, Camera>, point: &Vector3<f64>) -> Option<Vector2<f64>> {
    simulator.camera_model().project(&pose.inverse().transform(point))
}

fn board_config() -> SimulatorConfig {
    let mut config = SimulatorConfig::ideal(Scenario::CalibrationSweep);
    config.chessboard.enabled = true;
    config.texel_mm = 12.0;
    config
}

fn mean_and_worst(errors: &[f64]) -> (f64, f64) {
    let mean = errors.iter().sum::<f64>() / errors.len().max(1) as f64;
    (mean, errors.iter().fold(0.0, |a, &b| f64::max(a, b)))
}

#[test]
fn chessboard_corners_are_where_the_ground_truth_says() {
    for distortion in [false, true] {
        let mut config = board_config();
        config.lens.distortion = distortion;
        let mut simulator = simulator(&config);
        let mut all = Vec::new();
        for sequence in (30..400).step_by(45) {
            let pose = simulator.trajectory().pose_at(simulator.timestamp_ns(sequence));
            all.extend(errors(&mut simulator, sequence, &|s, p| seen_from(s, &pose, p)));
        }
        let (mean, worst) = mean_and_worst(&all);
        assert!(all.len() > 300, "only {} corners were found", all.len());
        assert!(mean < 0.05 && worst < 0.2, "distortion {distortion}: mean {mean:.3} px, worst {worst:.3} px");
    }
}

#[test]
fn every_row_of_a_rolling_shutter_has_the_pose_of_its_own_time() {
    let mut config = board_config();
    config.speed = 4.0;
    config.rolling_shutter.enabled = true;
    config.rolling_shutter.readout_ms = 30.0;
    let mut simulator = simulator(&config);
    let (mut by_row, mut by_frame) = (Vec::new(), Vec::new());
    for sequence in (30..300).step_by(45) {
        let stamp = simulator.timestamp_ns(sequence);
        let time_of_row = |y: f64| stamp + (30e6 * (y - 239.5) / 480.0) as i64;
        by_row.extend(errors(&mut simulator, sequence, &|s, point| {
            // The row depends on the pose and the pose on the row: a fixed point, reached in a few steps.
            let mut pixel = Vector2::new(320.0, 239.5);
            for _ in 0..8 {
                pixel = seen_from(s, &s.trajectory().pose_at(time_of_row(pixel.y)), point)?;
            }
            Some(pixel)
        }));
        by_frame.extend(errors(&mut simulator, sequence, &|s, p| seen_from(s, &s.trajectory().pose_at(stamp), p)));
    }
    let (mean, worst) = mean_and_worst(&by_row);
    assert!(by_row.len() > 150, "only {} corners were found", by_row.len());
    assert!(mean < 0.06 && worst < 0.25, "mean {mean:.3} px, worst {worst:.3} px");
    // And the effect is there at all.
    assert!(mean_and_worst(&by_frame).0 > 1.0, "one pose explains all rows: {:?}", mean_and_worst(&by_frame));
}

#[test]
fn motion_blur_spreads_evenly_about_the_pose_of_the_timestamp() {
    let mut config = board_config();
    config.speed = 2.0;
    config.motion_blur.enabled = true;
    config.motion_blur.exposure_ms = 16.0;
    let mut blurred = simulator(&config);
    config.motion_blur.enabled = false;
    let mut sharp = simulator(&config);
    let mut all = Vec::new();
    let contrast = |p: &GreyImage| {
        let steps = p.data.windows(2).map(|w| (f64::from(w[0]) - f64::from(w[1])).powi(2));
        steps.sum::<f64>() / p.data.len() as f64
    };
    let (mut soft, mut hard) = (0.0, 0.0);
    for sequence in (30..300).step_by(45) {
        let pose = blurred.trajectory().pose_at(blurred.timestamp_ns(sequence));
        all.extend(errors(&mut blurred, sequence, &|s, p| seen_from(s, &pose, p)));
        soft += contrast(&picture(&mut blurred, sequence));
        hard += contrast(&picture(&mut sharp, sequence));
    }
    let (mean, worst) = mean_and_worst(&all);
    assert!(all.len() > 150, "only {} corners were found", all.len());
    assert!(mean < 0.12 && worst < 0.5, "mean {mean:.3} px, worst {worst:.3} px");
    assert!(soft < 0.8 * hard, "blurred {soft} is hardly softer than sharp {hard}");
}

#[test]
fn poses_answer_to_the_timestamps_of_the_frames() {
    let mut config = quick(SimulatorConfig::default());
    config.rate_hz = 29.97;
    let simulator = simulator(&config);
    for sequence in [0, 1, 7, 1000] {
        let stamp = simulator.timestamp_ns(sequence);
        let a = simulator.trajectory().pose_at(stamp);
        let b = simulator.trajectory().pose_at_seconds(sequence as f64 / 29.97);
        assert!((a.translation - b.translation).norm() < 1e-8);
        assert!(a.rotation.angle_to(&b.rotation) < 1e-7);
    }
    assert_eq!(simulator.timestamp_ns(0), super::super::RECORDING_START_NS);
}
