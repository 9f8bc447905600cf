//! Every dialect, what is refused and what the message says, and files that come back as they went out.

use super::*;
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

const PLAIN: &str = "\
# pinhole + radial-tangential
width: 640
height: 480
fx: 517.306408
fy: 516.469215
cx: 318.64304
cy: 255.313989
distortion: [0.262383, -0.953104, -0.005358, 0.002628, 1.163314]
fps: none given (30 nominal)
note: \"free text: with [brackets, and colons\"
more: free: text: that is: no YAML
intrinsics: as in the paper
";

const EUROC: &str = "\
# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
         0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
        -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,
         0.0, 0.0, 0.0, 1.0]

# Camera specific definitions.
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
";

const KALIBR: &str = "\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.29, 0.08, 0.0002, 0.00002]
  distortion_model: radtan
  intrinsics: [460.5, 459.25, 365.0, 247.5]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  intrinsics: [1, 1, 1, 1]
";

const ROS: &str = "\
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [438.783367, 0.0, 305.593336, 0.0, 437.302876, 243.738352, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.361976, 0.110510, 0.001014, 0.000505, 0.000000]
";

const OPENCV: &str = "\
%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.3450000000000000e+02, 0., 3.3568643204394891e+02, 0.,
       5.3450000000000000e+02, 2.4062500000000000e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -2.9589439552724328e-01, 1.0354662043042675e-01, 0., 0., 0. ]
";

const OURS: &str = "\
width_px = 640
height_px = 480.0
fx_px = 525
fy_px = 525.5
cx_px = 319.5
cy_px = 239.5
distortion = [0.1, 0, 0, 0, -0.25]
sigma_fx_px = 0.25
[residual]
rms_px = 0.125
";

const OURS_WIDE: &str = "\
width_px = 640
height_px = 480
fx_px = 300.5
fy_px = 301.25
cx_px = 323.25
cy_px = 235.5
lens_model = \"kannala_brandt\"
k1 = 0.03
k2 = -0.015
k3 = 0.004
k4 = -0.001
rms_px = 0.125
";

fn yaml(text: &str) -> Result<CameraModel, CalibrationError> {
    CalibrationFile::parse(text, "camera.yaml", false).map(|f| f.camera)
}

fn ours(text: &str) -> Result<CalibrationFile, CalibrationError> {
    CalibrationFile::parse(text, "camera.toml", true)
}

fn numbers(c: &CameraModel) -> ([u32; 2], [f64; 4], [f64; 5]) {
    let LensModel::RadialTangential(distortion) = c.lens else { panic!("{:?} is no pinhole's", c.lens) };
    ([c.width, c.height], [c.fx, c.fy, c.cx, c.cy], distortion)
}

#[test]
fn a_sequences_camera_yaml_with_free_text_is_read() {
    let k = [0.262383, -0.953104, -0.005358, 0.002628, 1.163314];
    let expected = ([640, 480], [517.306408, 516.469215, 318.64304, 255.313989], k);
    assert_eq!(numbers(&yaml(PLAIN).expect("valid")), expected);
    assert_eq!(numbers(&yaml(&PLAIN.replace('\n', "\r\n")).expect("valid")), expected);
    let block = PLAIN.replace(
        "distortion: [0.262383, -0.953104, -0.005358, 0.002628, 1.163314]",
        "distortion:\n  - 0.262383\n  - -0.953104 # k2\n  - -0.005358\n  - 0.002628\n  - 1.163314",
    );
    assert_eq!(numbers(&yaml(&block).expect("valid")), expected);
}

#[test]
fn an_asl_sensor_yaml_is_read() {
    let k = [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0];
    assert_eq!(numbers(&yaml(EUROC).expect("valid")), ([752, 480], [458.654, 457.296, 367.215, 248.375], k));
}

#[test]
fn kalibrs_first_camera_is_read() {
    let k = [-0.29, 0.08, 0.0002, 0.00002, 0.0];
    assert_eq!(numbers(&yaml(KALIBR).expect("valid")), ([752, 480], [460.5, 459.25, 365.0, 247.5], k));
}

#[test]
fn ros_and_opencv_files_are_read() {
    let k = [-0.361976, 0.110510, 0.001014, 0.000505, 0.0];
    assert_eq!(numbers(&yaml(ROS).expect("valid")), ([640, 480], [438.783367, 437.302876, 305.593336, 243.738352], k));
    let opencv = yaml(OPENCV).expect("valid");
    assert_eq!((opencv.fx, opencv.cy), (534.5, 240.625));
    assert_eq!(opencv.lens.coefficients()[1], 1.0354662043042675e-01);
}

#[test]
fn our_toml_is_read_and_keeps_what_it_does_not_know() {
    let file = ours(OURS).expect("valid");
    assert_eq!(numbers(&file.camera), ([640, 480], [525.0, 525.5, 319.5, 239.5], [0.1, 0.0, 0.0, 0.0, -0.25]));
    assert_eq!(file.other["sigma_fx_px"].as_float(), Some(0.25));
    assert_eq!(file.other["residual"]["rms_px"].as_float(), Some(0.125));
    assert_eq!(file.other.len(), 2);
}

#[test]
fn a_wide_angle_lens_of_our_toml_is_read_by_name_or_as_a_list() {
    let k = [0.03, -0.015, 0.004, -0.001];
    let file = ours(OURS_WIDE).expect("valid");
    assert_eq!((file.camera.lens, file.camera.fx), (LensModel::KannalaBrandt(k), 300.5));
    let mut lines: Vec<&str> = OURS_WIDE.lines().filter(|l| !l.starts_with('k')).collect();
    lines.push("distortion = [0.03, -0.015, 0.004, -0.001]");
    assert_eq!(ours(&lines.join("\n")).expect("valid").camera, file.camera);
    assert_eq!(ours(&file.to_toml().expect("text")).expect("read again"), file);
    let plain = PLAIN.replace("0.262383, -0.953104, -0.005358, 0.002628, 1.163314", "0.03, -0.015, 0.004, -0.001");
    for model in ["lens_model: kannala_brandt", "distortion_model: equidistant"] {
        assert_eq!(yaml(&format!("{plain}{model}\n")).expect("valid").lens, LensModel::KannalaBrandt(k));
    }
    assert!(!yaml(&format!("{plain}distortion_model: as in the paper\n")).expect("free text").lens.is_wide_angle());
}

#[test]
fn mistakes_about_the_lens_model_name_file_line_and_key() {
    for (text, from, to, expected) in [
        (
            OURS_WIDE,
            "\"kannala_brandt\"",
            "\"fov\"",
            "camera.toml:7: lens_model = \"fov\": must be \"radial_tangential\" or",
        ),
        (OURS_WIDE, "\"kannala_brandt\"", "4", "camera.toml:7: lens_model = 4: must be"),
        (OURS_WIDE, "lens_model = \"kannala_brandt\"\n", "", "camera.toml:10: k4 = -0.001: is of lens_model"),
        (OURS_WIDE, "k4 = -0.001\n", "", "camera.toml: k4 is missing: lens_model = \"kannala_brandt\" needs"),
        (OURS_WIDE, "k4 = -0.001\n", "p1 = 0.1\n", "camera.toml:11: p1 = 0.1: is not of lens_model"),
        (OURS_WIDE, "k4 = -0.001\n", "k4 = \"a\"\n", "camera.toml:11: k4 = \"a\": must be a number"),
        (OURS_WIDE, "k4 = -0.001\n", "k4 = nan\n", "must be finite numbers"),
        (
            OURS_WIDE,
            "k4 = -0.001\n",
            "k4 = 0.1\ndistortion = [0.03, -0.015, 0.004, -0.001]\n",
            "camera.toml:11: k4 = 0.1: differs",
        ),
        (
            OURS,
            "distortion =",
            "lens_model = \"kannala_brandt\"\ndistortion =",
            "camera.toml:8: distortion = [0.1, 0, 0, 0, -0.25]: must be four numbers",
        ),
    ] {
        let message = ours(&text.replace(from, to)).expect_err(to).to_string();
        assert!(message.contains(expected), "{to}: {message}");
    }
    let message = yaml(&format!("{PLAIN}lens_model: fov\n")).expect_err("unknown").to_string();
    assert!(message.contains("camera.yaml:13: lens_model = fov: is not handled"), "{message}");
}

#[test]
fn a_saved_calibration_reads_back_bit_for_bit() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let path = dir.path().join("camera.toml");
    let file = ours(OURS).expect("valid");
    file.save(&path).expect("saved");
    assert_eq!(CalibrationFile::load(&path).expect("read"), file);
    save_camera(&path, &yaml(PLAIN).expect("valid")).expect("saved over");
    assert_eq!(load_camera(&path).expect("read"), yaml(PLAIN).expect("valid"));
    assert_eq!(std::fs::read_dir(dir.path()).expect("listed").count(), 1, "no temporary file is left");
}

#[test]
fn a_failed_save_names_the_file() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let path = dir.path().join("missing/camera.toml");
    let message = save_camera(&path, &yaml(PLAIN).expect("valid")).expect_err("no such folder").to_string();
    assert!(message.contains("missing/camera.toml"), "{message}");
}

#[test]
fn a_missing_file_and_a_folder_are_named() {
    let dir = tempfile::tempdir().expect("temporary folder");
    for path in [dir.path().join("none.yaml"), dir.path().to_path_buf()] {
        let message = load_camera(&path).expect_err("not a file").to_string();
        assert!(message.starts_with(&path.display().to_string()), "{message}");
    }
}

#[test]
fn impossible_values_are_refused_with_file_line_key_value_unit_and_reason() {
    let cases = [
        ("fx: 517.306408", "fx: 0", "camera.yaml:4: fx = 0 px: must be greater than 0"),
        ("fx: 517.306408", "fx: -517", "fx = -517 px: must be greater than 0"),
        ("fx: 517.306408", "fx: .nan", "fx = .nan: must be a number"),
        ("fx: 517.306408", "fx: nan", "fx = nan px: must be a finite number"),
        ("fx: 517.306408", "fx: 2.8", "is it in mm"),
        ("fy: 516.469215", "fy: 1e9", "fy = 1e9 px: must be from 0.1 to 20 times"),
        ("fx: 517.306408", "fx: [1, 2]", "fx = [1, 2] px: must be one number"),
        ("cx: 318.64304", "cx: 700", "camera.yaml:6: cx = 700 px: must be inside the picture, 0 to 640"),
        ("cy: 255.313989\n", "", "cy is missing: width, height, fx"),
        ("width: 640", "width: 640.5", "width = 640.5 px: must be a whole number"),
        ("width: 640", "width: 0", "must be a whole number from 1"),
        ("height: 480", "height: 99999", "height = 99999 px"),
        ("1.163314]", "inf]", "must be finite numbers"),
        ("0.002628, 1.163314]", "]", "must be four or five numbers"),
        ("1.163314]", "1.163314, 0.5]", "beyond k3"),
        ("distortion: [", "distortion: no [", "camera.yaml:8: distortion = no ["),
        ("1.163314]", "1.163314", "camera.yaml:8: list is not closed"),
        ("fx: 517.306408", "fx 517.306408", "camera.yaml:4: is neither 'key: value' nor a comment"),
        ("cy: 255.313989", "cy: 255.313989\nfx: 500", "fx = 517.306408: stands again on line 8"),
    ];
    for (from, to, expected) in cases {
        // Free text after the list would close it.
        let text: String = PLAIN.lines().take(8).map(|l| format!("{l}\n")).collect();
        let message = yaml(&text.replace(from, to)).expect_err(to).to_string();
        assert!(message.contains(expected) && message.starts_with("camera.yaml"), "{to}: {message}");
    }
}

#[test]
fn toml_mistakes_name_their_line() {
    for (from, to, expected) in [
        ("fx_px = 525\n", "fx_px = \"525\"\n", "camera.toml:3: fx_px = \"525\" px: must be a number"),
        ("fx_px = 525\n", "fx_px = inf\n", "fx_px = inf px: must be a finite number"),
        ("fx_px = 525\n", "", "camera.toml: fx_px is missing"),
        ("fx_px = 525\n", "fx_px = \n", "camera.toml:3: "),
        ("[0.1, 0, 0, 0, -0.25]", "[0.1]", "camera.toml:7: distortion = [0.1]: must be four or five numbers"),
        ("[0.1, 0, 0, 0, -0.25]", "[0.1, \"a\"]", "must be a list of numbers"),
    ] {
        let message = ours(&OURS.replace(from, to)).expect_err(to).to_string();
        assert!(message.contains(expected), "{to}: {message}");
    }
}

#[test]
fn other_lens_models_are_refused_by_name() {
    for (text, from, to, expected) in [
        (EUROC, "radial-tangential", "double-sphere", "distortion_model = double-sphere: is not handled"),
        (EUROC, "pinhole", "omni", "camera_model = omni"),
        (ROS, "plumb_bob", "rational_polynomial", "distortion_model = rational_polynomial"),
        (ROS, "[438.783367, 0.0,", "[438.783367, 0.5,", "skew is not handled"),
        (EUROC, "[752, 480]", "[752]", "resolution = [752] px: must be 2 numbers, not 1"),
        (EUROC, "458.654", "-458.654", "intrinsics[0] = -458.654 px: must be greater than 0"),
    ] {
        let message = yaml(&text.replace(from, to)).expect_err(to).to_string();
        assert!(message.contains(expected), "{message}");
    }
}

#[test]
fn the_calibrations_of_the_sequences_are_read() {
    let root = std::env::var_os("CAIRN_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), std::path::PathBuf::from);
    for name in ["tum_fr1_xyz", "7scenes_redkitchen", "visp_rbt", "new_tsukuba", "uzh_parking"] {
        let path = root.join(name).join("camera.yaml");
        if !path.is_file() {
            println!("skipped: {} is not here", path.display());
            continue;
        }
        let camera = load_camera(&path).expect("valid");
        assert_eq!((camera.width, camera.height), (640, 480));
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2_000, rng_seed: RngSeed::Fixed(3), failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_camera_goes_out_and_comes_back(
        width in 16u32..4_000, height in 16u32..4_000, f in 0.2f64..10.0, c in 0.0f64..1.0, k in prop::array::uniform5(-2.0f64..2.0),
    ) {
        let side = f64::from(width.max(height));
        let camera = CameraModel::new(width, height, f * side, f * side * 1.01, c * f64::from(width), c * f64::from(height), k);
        let mut file = CalibrationFile { camera: camera.expect("valid"), other: toml::Table::new(), assumed: None };
        prop_assert_eq!(&ours(&file.to_toml().expect("serialisable")).expect("valid"), &file);
        let c = &file.camera;
        let wide = LensModel::KannalaBrandt([k[0], k[1], k[2], k[3]]);
        file.camera = CameraModel::new(width, height, c.fx, c.fy, c.cx, c.cy, wide).expect("valid");
        prop_assert_eq!(&ours(&file.to_toml().expect("serialisable")).expect("valid"), &file);
    }

    #[test]
    fn damaged_text_is_read_or_refused_but_never_panics(
        which in 0usize..7, at in 0usize..700, cut in 0usize..40, put in "[\\[\\]:,.# \n\t'\"!|>e0-9é-]{0,12}",
    ) {
        let (text, is_toml) = [(PLAIN, false), (EUROC, false), (KALIBR, false), (ROS, false), (OPENCV, false), (OURS, true), (OURS_WIDE, true)][which];
        let chars: Vec<char> = text.chars().collect();
        let at = at.min(chars.len());
        let after = (at + cut).min(chars.len());
        let damaged: String = chars[..at].iter().copied().chain(put.chars()).chain(chars[after..].iter().copied()).collect();
        if let Ok(file) = CalibrationFile::parse(&damaged, "x", is_toml) {
            prop_assert!(file.camera.fx > 0.0 && file.camera.lens.coefficients().iter().all(|k| k.is_finite()));
        }
    }
}
