//! The command as far as it needs no camera: board to print, conversion, pictures of the simulator, live on the simulator.

use super::*;
use crate::calibration::load_camera;
use crate::camera::Pacing;
use crate::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use crate::image::GreyImage;
use clap::Parser;

#[derive(Parser)]
struct Line {
    #[command(flatten)]
    args: CalibrateArgs,
}

fn args(line: &str) -> CalibrateArgs {
    Line::try_parse_from(line.split_whitespace()).map(|l| l.args).expect("valid")
}

fn save_png(path: &Path, picture: &GreyImage) {
    let file = std::fs::File::create(path).expect("created");
    let mut encoder = png::Encoder::new(file, picture.width as u32, picture.height as u32);
    encoder.set_color(png::ColorType::Grayscale);
    let mut writer = encoder.write_header().expect("header");
    writer.write_image_data(&picture.data).expect("written");
}

#[test]
fn a_calibration_goes_through_every_format_and_back() {
    let dir = tempfile::tempdir().expect("folder");
    let at = |name: &str| dir.path().join(name).display().to_string();
    std::fs::write(at("a.txt"), "# size_px 640 480\n517.3 516.5 318.6 255.3 0.26 -0.95 -0.005 0.003 0.0\n")
        .expect("written");
    let original = load_camera(Path::new(&at("a.txt"))).expect("read");
    let steps = [
        ("a.txt", "cairn", "b.toml"),
        ("b.toml", "ros", "c.yaml"),
        ("c.yaml", "opencv", "d.yml"),
        ("d.yml", "opencv-xml", "e.xml"),
        ("e.xml", "kalibr", "f.yaml"),
        ("f.yaml", "euroc", "g.yaml"),
        ("g.yaml", "tum", "h.txt"),
    ];
    for (from, format, to) in steps {
        run(&args(&format!("x --convert {} --format {format} --output {}", at(from), at(to)))).expect("converted");
        assert_eq!(load_camera(Path::new(&at(to))).expect("read"), original, "{to}");
    }
    let error = run(&args("x --convert /no/such/file.yaml --format ros")).expect_err("missing");
    assert_eq!(error.code, exit_code::NO_INPUT);
}

#[test]
fn a_wide_angle_calibration_goes_through_every_format_that_can_hold_it_and_back() {
    let dir = tempfile::tempdir().expect("folder");
    let at = |name: &str| dir.path().join(name).display().to_string();
    let text = "width_px = 640\nheight_px = 480\nfx_px = 300.5\nfy_px = 301.25\ncx_px = 323.25\ncy_px = 235.5\n\
                lens_model = \"kannala_brandt\"\ndistortion = [0.03, -0.015, 0.004, -0.001]\n";
    std::fs::write(at("a.toml"), text).expect("written");
    let original = load_camera(Path::new(&at("a.toml"))).expect("read");
    assert!(original.lens.is_wide_angle());
    let steps = [
        ("a.toml", "ros", "b.yaml"),
        ("b.yaml", "opencv", "c.yml"),
        ("c.yml", "opencv-xml", "d.xml"),
        ("d.xml", "kalibr", "e.yaml"),
        ("e.yaml", "euroc", "f.yaml"),
        ("f.yaml", "cairn", "g.toml"),
    ];
    for (from, format, to) in steps {
        run(&args(&format!("x --convert {} --format {format} --output {}", at(from), at(to)))).expect("converted");
        assert_eq!(load_camera(Path::new(&at(to))).expect("read"), original, "{to}");
    }
    let error = run(&args(&format!("x --convert {} --format tum --output {}", at("a.toml"), at("h.txt"))));
    let error = error.expect_err("plain numbers cannot hold it");
    assert!(error.code == exit_code::DATA && error.message.contains("kannala_brandt"), "{error}");
    assert!(!Path::new(&at("h.txt")).exists());
}

#[test]
fn what_cannot_be_is_refused_with_a_reason() {
    assert_eq!(run(&args("x")).expect_err("nothing to do").code, exit_code::USAGE);
    let error = run(&args("x a.png --pattern 2x6")).expect_err("too small");
    assert!(error.message.contains("pattern 2x6"), "{error}");
    assert!(Line::try_parse_from(["x", "a.png", "--camera", "auto"]).is_err());
    assert!(Line::try_parse_from(["x", "--pattern", "9by6"]).is_err());
    let dir = tempfile::tempdir().expect("folder");
    let error = run(&args(&format!("x {}/none.png --output {0}/c.toml", dir.path().display()))).expect_err("missing");
    assert_eq!(error.code, exit_code::NO_INPUT, "{error}");
}

#[test]
fn pictures_of_the_simulators_board_give_its_camera_and_a_report() {
    let mut config = SimulatorConfig { scenario: Scenario::CalibrationSweep, ..SimulatorConfig::default() };
    config.chessboard.enabled = true;
    config.texel_mm = 4.0;
    config.rolling_shutter.enabled = false;
    config.motion_blur.enabled = false;
    let mut simulator = Simulator::new(&config, Pacing::LockStep).expect("simulator");
    let dir = tempfile::tempdir().expect("folder");
    let mut picture = GreyImage::default();
    let mut line = format!("x --square 0.03 --output {}", dir.path().join("camera.toml").display());
    for k in 0..14u64 {
        simulator.render(40 + k * 67, &mut picture);
        let path = dir.path().join(format!("{k:02}.png"));
        save_png(&path, &picture);
        line += &format!(" {}", path.display());
    }
    std::fs::write(dir.path().join("broken.png"), "no picture").expect("written");
    run(&args(&format!("{line} {}", dir.path().join("broken.png").display()))).expect("calibrated");
    let file = CalibrationFile::load(&dir.path().join("camera.toml")).expect("read");
    let truth = simulator.camera_model();
    let sigma = file.other["fx_sigma_px"].as_float().expect("number");
    assert!(sigma > 0.0 && sigma < 0.004 * truth.fx, "{sigma}");
    assert!((file.camera.fx - truth.fx).abs() < 5.0 * sigma + 0.2, "{} instead of {}", file.camera.fx, truth.fx);
    assert!(dir.path().join("camera-report/coverage.png").is_file());
    assert!(dir.path().join("camera-report/view-001.png").is_file());
    let error = run(&args(&format!("{line} --pattern 8x5"))).expect_err("another board");
    assert!(error.message.contains("9x6 inner corners was seen, 8x5 was asked for"), "{error}");
}
