//! Rendered boards through a wide-angle lens and a pinhole: the camera, its deviations, and which model is recommended.

use super::*;
use crate::calibration::chessboard::{Detector, Sighting};
use crate::camera::Pacing;
use crate::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use crate::image::GreyImage;

/// Boards of a sweep, and the camera that saw them.
fn sweep(wide: bool, count: u64) -> (Vec<BoardView>, CameraModel) {
    let mut config = SimulatorConfig { scenario: Scenario::CalibrationSweep, ..SimulatorConfig::default() };
    config.lens.wide_angle.enabled = wide;
    config.chessboard.enabled = true;
    config.texel_mm = 4.0;
    config.rolling_shutter.enabled = false;
    config.motion_blur.enabled = false;
    let mut simulator = Simulator::new(&config, Pacing::LockStep).expect("simulator");
    let (mut detector, mut picture, mut views) = (Detector::default(), GreyImage::default(), Vec::new());
    for k in 0..count {
        simulator.render(40 + k * 67, &mut picture);
        if let Sighting::Board(board) = detector.detect(&picture, &pattern()) {
            views.push(BoardView::still(format!("view {k}"), board));
        }
    }
    (views, simulator.camera_model().clone())
}

fn pattern() -> Pattern {
    Pattern::new(9, 6, 0.03).expect("valid")
}

#[test]
fn rendered_boards_through_a_lens_of_150_degrees_give_its_parameters_within_their_deviations() {
    let (views, truth) = sweep(true, 30);
    let size = (truth.width, truth.height);
    let corner = truth.undistort(&Vector2::zeros()).expect("less than 85 degrees off the axis");
    assert!(corner.norm().atan().to_degrees() > 74.0, "the diagonal sees some 150 degrees");
    let solved = solve(&views, &pattern(), size, Distortion::KannalaBrandt).expect("calibrated");
    println!("{} views\n{}{}", views.len(), solved.table(), solved.words());
    let sigmas = solved.solved.sigmas();
    let mut expected = vec![truth.fx, truth.fy, truth.cx, truth.cy];
    expected.extend(truth.lens.coefficients());
    let mut sum = 0.0;
    for (i, name) in solved.solved.lens.parameter_names().iter().enumerate() {
        let off = (solved.solved.intrinsics[i] - expected[i]) / sigmas[i];
        assert!(off.abs() < 3.5, "{name}: {off:.2} of its deviations off");
        sum += off * off;
    }
    assert!(sum < 8.0 * 3.0, "all together: {sum:.1} for 8 parameters");
    assert!(solved.solved.rms_px < 0.15, "{}", solved.solved.rms_px);
    assert!(sigmas[0] < 0.002 * truth.fx, "fx +- {}", sigmas[0]);
    let file = solved.file(None, 1);
    assert!(file.other.contains_key("k4_sigma") && file.camera.lens.is_wide_angle());
    let read = CalibrationFile::parse(&file.to_toml().expect("text"), "x.toml", true).expect("read again");
    assert_eq!(read, file);
}

#[test]
fn the_report_names_the_wide_angle_model_where_a_pinhole_does_not_fit_and_only_there() {
    let (views, truth) = sweep(true, 20);
    let size = (truth.width, truth.height);
    match solve(&views, &pattern(), size, Distortion::Full) {
        Ok(pinhole) => {
            println!("{}{}", pinhole.table(), pinhole.words());
            assert!(pinhole.wide_angle_rms_px.is_some_and(|rms| rms < 0.15), "{:?}", pinhole.wide_angle_rms_px);
            assert!(pinhole.words().contains("--distortion fisheye"), "{}", pinhole.words());
            assert!(!pinhole.camera.lens.is_wide_angle(), "nothing is switched silently");
        }
        Err(error) => assert!(error.to_string().contains("--distortion fisheye"), "{error}"),
    }
    let (views, truth) = sweep(false, 20);
    let pinhole = solve(&views, &pattern(), (truth.width, truth.height), Distortion::Full).expect("calibrated");
    assert_eq!(pinhole.wide_angle_rms_px, None, "{}", pinhole.words());
}

#[test]
fn a_view_that_was_left_out_says_why() {
    let (mut views, truth) = sweep(false, 20);
    // One view with its corners in disorder, and one of which too little was seen.
    let count = views[3].board.corners.len();
    for i in 0..count {
        let other = views[7].board.corners[(i * 5) % views[7].board.corners.len()].pixel;
        views[3].board.corners[i].pixel = other;
    }
    views[5].board.corners.truncate(6);
    let solved = solve(&views, &pattern(), (truth.width, truth.height), Distortion::Full).expect("calibrated");
    let words: Vec<String> = solved.solved.views.iter().map(|view| solved.view_words(view)).collect();
    assert!(words[3].starts_with("left out: it does not fit the other views, "), "{}", words[3]);
    assert_eq!(words[5], "left out: 6 corners are too few, 8 are needed");
    assert!(words[0].ends_with(" px RMS") && !words[0].contains("left out"), "{}", words[0]);
    assert!(words.iter().all(|w| !w.contains("inf") && !w.contains("NaN")), "{words:?}");
}
