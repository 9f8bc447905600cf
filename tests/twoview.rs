//! `cairn twoview` and `cairn compare` through the binary: two simulated pictures to their true motion, and every kind of bad
//! input to an outcome with a name. Tests on recorded pairs are skipped with a message where those are not there (`CAIRN_DATA`).

#[path = "support/recordings.rs"]
mod recordings;

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::OnceLock;

use cairn::calibration::{load_camera, save_camera};
use cairn::camera::Pacing;
use cairn::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use cairn::geometry::Se3;
use cairn::geometry::frames::{First, Second};
use cairn::image::GreyImage;
use nalgebra::{Matrix3, Vector3};
use recordings::recording;
use serde_json::Value;

/// Pictures of one simulated drive and what is true of them.
struct Scene {
    folder: tempfile::TempDir,
    second_from_first: Se3<Second, First>,
}

impl Scene {
    /// Frames `a` and `b` (30 a second) of a scenario, as PGM, with the lens's calibration.
    fn new(scenario: Scenario, seed: u64, frames: [u64; 2]) -> Self {
        let mut config = SimulatorConfig { seed, ..SimulatorConfig::default() };
        config.scenario = scenario;
        config.motion_blur.enabled = false;
        config.rolling_shutter.enabled = false;
        Self::of(&config, frames)
    }

    fn of(config: &SimulatorConfig, [a, b]: [u64; 2]) -> Self {
        let mut simulator = Simulator::new(config, Pacing::LockStep).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let mut picture = GreyImage::default();
        for (name, frame) in [("a.pgm", a), ("b.pgm", b)] {
            simulator.render(frame, &mut picture);
            write_pgm(&folder.path().join(name), &picture);
        }
        save_camera(&folder.path().join("camera.toml"), simulator.camera_model()).unwrap();
        let pose = |frame: u64| simulator.trajectory().pose_at(simulator.timestamp_ns(frame));
        let second_from_first = (pose(b).inverse() * pose(a)).relabel();
        Self { folder, second_from_first }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Runs `twoview` on the two pictures with the camera and more arguments.
    fn run(&self, output: &str, more: &[&str]) -> (i32, Value, String) {
        let camera = self.path("camera.toml");
        let mut arguments = vec!["--camera", camera.to_str().unwrap()];
        arguments.extend(more);
        twoview(&self.path("a.pgm"), &self.path("b.pgm"), &self.path(output), &arguments)
    }
}

/// A drive past a desk, seconds apart.
fn moved() -> &'static Scene {
    static SCENE: OnceLock<Scene> = OnceLock::new();
    SCENE.get_or_init(|| Scene::new(Scenario::DeskOrbit, 1, [30, 60]))
}

fn turned() -> &'static Scene {
    static SCENE: OnceLock<Scene> = OnceLock::new();
    SCENE.get_or_init(|| Scene::new(Scenario::PureRotation, 1, [30, 50]))
}

fn write_pgm(path: &Path, picture: &GreyImage) {
    let mut bytes = format!("P5\n{} {}\n255\n", picture.width, picture.height).into_bytes();
    bytes.extend(&picture.data);
    std::fs::write(path, bytes).unwrap();
}

fn read_pgm(path: &Path) -> GreyImage {
    cairn::workbench::Picture::load(path).unwrap().grey
}

fn cairn(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_cairn")).args(arguments).stdin(Stdio::null()).output().unwrap()
}

/// Exit code, the JSON document (null if there is none) and what was printed.
fn twoview(a: &Path, b: &Path, output: &Path, more: &[&str]) -> (i32, Value, String) {
    let mut arguments = vec!["twoview", a.to_str().unwrap(), b.to_str().unwrap(), "--output", output.to_str().unwrap()];
    arguments.extend(more);
    let Output { status, stdout, stderr } = cairn(&arguments);
    let text = format!("{}{}", String::from_utf8_lossy(&stdout), String::from_utf8_lossy(&stderr));
    let code = status.code().unwrap_or_else(|| panic!("ended by a signal: {text}"));
    assert!(!text.contains("panicked") && !text.contains("NaN"), "{text}");
    // A number that is not finite would be no JSON.
    let document =
        std::fs::read(output.join("twoview.json")).map_or(Value::Null, |b| serde_json::from_slice(&b).unwrap());
    (code, document, text)
}

fn matrix(value: &Value) -> Matrix3<f64> {
    Matrix3::from_fn(|r, c| value[r][c].as_f64().unwrap())
}

fn vector(value: &Value) -> Vector3<f64> {
    Vector3::from_fn(|k, _| value[k].as_f64().unwrap())
}

fn outcome(document: &Value) -> &str {
    document["outcome"]["name"].as_str().unwrap_or("no document")
}

/// Angles of the rotation and of the direction that are left, degrees.
fn errors(document: &Value, truth: &Se3<Second, First>) -> (f64, f64) {
    let left = matrix(&document["R"]).transpose() * truth.rotation.to_rotation_matrix().matrix();
    let angle = (0.5 * (left.trace() - 1.0)).clamp(-1.0, 1.0).acos().to_degrees();
    (angle, vector(&document["t"]).angle(&truth.translation).to_degrees())
}

#[test]
fn two_simulated_pictures_give_their_true_motion_and_every_file() {
    let scene = moved();
    let (code, document, text) = scene.run("out", &[]);
    assert_eq!((code, outcome(&document)), (0, "reconstructed"), "{text}");
    let (rotation, direction) = errors(&document, &scene.second_from_first);
    assert!(rotation < 0.3 && direction < 1.5, "{rotation} {direction} degrees\n{text}");
    assert!((vector(&document["t"]).norm() - 1.0).abs() < 1e-9);
    assert!((matrix(&document["R"]).determinant() - 1.0).abs() < 1e-9);
    for file in [
        "corners_a.png",
        "corners_b.png",
        "attributes.png",
        "matches.png",
        "epipolar.png",
        "motions.png",
        "distances.png",
        "scene.png",
        "points.ply",
    ] {
        assert!(std::fs::metadata(scene.path("out").join(file)).is_ok_and(|m| m.len() > 200), "{file}");
    }
    for word in [
        "corners",
        "salient degree",
        "matches",
        "inliers",
        "singular values",
        "P_A",
        "P_D turned by",
        "one point says",
        "votes say",
        "adjustment",
        "triangulation",
    ] {
        assert!(text.contains(word), "{word}: {text}");
    }
}

/// What an independent program would check: x_Bᵀ F x_A = 0 for the inliers, E = [t]x R, points in front and on their rays.
#[test]
fn the_document_holds_together() {
    let (_, document, _) = moved().run("check", &["--guided"]);
    let (f, e) = (matrix(&document["F"]), matrix(&document["E"]));
    let (r, t) = (matrix(&document["R"]), vector(&document["t"]));
    let skew = Matrix3::new(0.0, -t.z, t.y, t.z, 0.0, -t.x, -t.y, t.x, 0.0);
    assert!((skew * r - e).norm() < 1e-9);
    // F and E are the same geometry: K of the simulated camera in between.
    let k = cairn::workbench::pose::intrinsics(&load_camera(&moved().path("camera.toml")).unwrap());
    let same = k.transpose() * f * k;
    let (same, e_unit) = (same / same.norm(), e / e.norm());
    assert!((same - e_unit).norm().min((same + e_unit).norm()) < 1e-9, "{same} {e_unit}");
    let place = |m: &Value, key: &str| Vector3::new(m[key][0].as_f64().unwrap(), m[key][1].as_f64().unwrap(), 1.0);
    let (mut inliers, mut points) = (0, 0);
    for m in document["matches"].as_array().unwrap() {
        let (a, b) = (place(m, "a_undistorted"), place(m, "b_undistorted"));
        let (l2, l1) = (f * a, f.transpose() * b);
        let sampson = b.dot(&l2).abs() / (l2.xy().norm_squared() + l1.xy().norm_squared()).sqrt();
        assert!((sampson - m["residual_px"].as_f64().unwrap()).abs() < 1e-6);
        if m["inlier"].as_bool().unwrap() {
            assert!(sampson < 2.0, "{m}");
        }
        inliers += u64::from(m["inlier"].as_bool().unwrap());
        if !m["point"].is_null() {
            let p = vector(&m["point"]);
            assert!(p.z > 0.0 && (r * p + t).z > 0.0, "{m}");
            points += 1;
        }
    }
    assert_eq!(document["counts"]["inliers"].as_u64().unwrap(), inliers);
    assert_eq!(document["counts"]["points"].as_u64().unwrap(), points);
    assert!(points > 50, "{points} points");
}

#[test]
fn the_same_seed_gives_the_same_numbers() {
    let without_times = |output: &str| {
        let (_, mut document, _) = moved().run(output, &["--seed", "7"]);
        document.as_object_mut().unwrap().remove("times_ms");
        document
    };
    assert_eq!(without_times("first"), without_times("second"));
}

#[test]
fn every_detector_and_matcher_ends_in_an_outcome() {
    let scene = Scene::new(Scenario::DeskOrbit, 2, [40, 46]);
    for (detector, matcher) in [
        ("fast", "descriptors"),
        ("fast", "attributes"),
        ("fast", "correlation"),
        ("fast", "flow"),
        ("susan", "descriptors"),
        ("susan", "attributes"),
        ("susan-study", "descriptors"),
        ("susan-41", "descriptors"),
    ] {
        let output = format!("{detector}-{matcher}");
        let more = ["--detector", detector, "--matcher", matcher, "--corners", "600", "--guided"];
        let (code, document, text) = scene.run(&output, &more);
        assert!([0, 3].contains(&code) && outcome(&document) != "no document", "{output}: {text}");
        // What needs contrast or a unique corner may find nothing here; the others must not.
        if ["fast", "susan"].contains(&detector) && matcher != "attributes" {
            assert_eq!(outcome(&document), "reconstructed", "{output}: {text}");
            let (rotation, direction) = errors(&document, &scene.second_from_first);
            assert!(rotation < 0.5 && direction < 10.0, "{output}: {rotation} {direction}\n{text}");
        }
    }
}

#[test]
fn without_a_camera_it_stops_after_f_and_says_why() {
    let scene = moved();
    let (code, document, text) = twoview(&scene.path("a.pgm"), &scene.path("b.pgm"), &scene.path("uncalibrated"), &[]);
    assert_eq!((code, outcome(&document)), (0, "fundamental_only"), "{text}");
    assert!(text.contains("without --camera") && document["R"].is_null() && !document["F"].is_null());
    assert!(document["pixels_of_F"].as_str().unwrap().contains("own"));
}

#[test]
fn turning_on_the_spot_is_told_with_and_without_a_camera() {
    let scene = turned();
    let (code, document, text) = scene.run("out", &[]);
    assert_eq!((code, outcome(&document)), (3, "pure_rotation"), "{text}");
    let angle = document["outcome"]["angle_deg"].as_f64().unwrap();
    let truth = scene.second_from_first.rotation.angle().to_degrees();
    assert!((angle - truth).abs() < 0.3, "{angle} {truth}");
    assert!(document["R"].is_null());
    let (code, document, text) = twoview(&scene.path("a.pgm"), &scene.path("b.pgm"), &scene.path("blind"), &[]);
    // What a lens does besides may look like depth to F alone; it must not look like certainty.
    assert!(code == 3 || document["fundamental"]["degeneracy"]["name"] != "none", "{text}");
}

/// A lens that bends lines and rows that are taken one after the other look like depth to F: it found an epipole in all three. In the last one
/// a repeated texture is matched by periods, along F's lines.
#[test]
fn a_turn_that_lens_and_shutter_bend_is_told_without_a_camera() {
    for (seed, frames) in [(1, [599, 607]), (3, [638, 642]), (5, [590, 594])] {
        let mut config = SimulatorConfig { seed, ..SimulatorConfig::default() };
        config.scenario = Scenario::Square;
        assert!(config.rolling_shutter.enabled);
        let scene = Scene::of(&config, frames);
        let moved = scene.second_from_first.translation.norm();
        let turned = scene.second_from_first.rotation.angle().to_degrees();
        assert!(moved < 1e-3 && turned > 4.0, "seed {seed}: {moved} m, {turned} degrees");
        let (code, document, text) = twoview(&scene.path("a.pgm"), &scene.path("b.pgm"), &scene.path("blind"), &[]);
        assert_eq!((code, outcome(&document)), (3, "pure_rotation"), "seed {seed}: {text}");
        assert!(text.contains("one of many"), "{text}");
    }
}

#[test]
fn the_least_and_the_largest_noise_that_can_be_asked_for_end_in_outcomes_without_a_camera() {
    let scene = moved();
    for sigma in ["0.05", "0.19", "20"] {
        let output = scene.path(&format!("sigma-{sigma}"));
        let (code, document, text) = twoview(&scene.path("a.pgm"), &scene.path("b.pgm"), &output, &["--sigma", sigma]);
        assert!(matches!(code, 0 | 3), "--sigma {sigma}: {code} {text}");
        assert!(!outcome(&document).is_empty(), "--sigma {sigma}: {text}");
    }
}

#[test]
fn pictures_that_show_nothing_or_the_same_are_outcomes_with_names() {
    let scene = moved();
    let camera = scene.path("camera.toml");
    let with = ["--camera", camera.to_str().unwrap()];
    let black = scene.path("black.pgm");
    write_pgm(&black, &GreyImage::new(640, 480));
    let a = scene.path("a.pgm");
    let other = Scene::new(Scenario::Corridor, 9, [10, 20]);
    for (name, first, second, expected) in [
        ("identical", &a, &a, &["identical_pictures"][..]),
        ("black", &black, &black, &["too_few_corners"]),
        ("half-black", &a, &black, &["too_few_corners"]),
        ("strangers", &a, &other.path("a.pgm"), &["no_model", "too_few_matches"]),
    ] {
        for (more, output) in [(&with[..], name.to_owned()), (&[], format!("{name}-blind"))] {
            let (code, document, text) = twoview(first, second, &scene.path(&output), more);
            assert_eq!(code, 3, "{output}: {text}");
            assert!(expected.contains(&outcome(&document)), "{output}: {text}");
            assert!(document["R"].is_null() && text.contains("outcome"), "{output}: {text}");
        }
    }
}

#[test]
fn pictures_of_two_sizes_work_with_two_cameras_and_not_with_one() {
    let scene = moved();
    let b = read_pgm(&scene.path("b.pgm"));
    // The left part of the second picture: the same lens, a narrower sensor.
    let width = 560;
    let rows = b.data.chunks_exact(b.width).flat_map(|row| row[..width].to_vec()).collect();
    write_pgm(&scene.path("narrow.pgm"), &GreyImage { width, height: b.height, data: rows });
    let camera = scene.path("camera.toml");
    let text = std::fs::read_to_string(&camera).unwrap().replace("width_px = 640", "width_px = 560");
    std::fs::write(scene.path("narrow.toml"), text).unwrap();
    let (camera, narrow) = (camera.to_str().unwrap().to_owned(), scene.path("narrow.toml"));
    let run = |output: &str, more: &[&str]| {
        twoview(&scene.path("a.pgm"), &scene.path("narrow.pgm"), &scene.path(output), more)
    };
    let (code, _, text) = run("one-camera", &["--camera", &camera]);
    assert_eq!(code, 78, "{text}");
    assert!(text.contains("640x480") && text.contains("560x480") && text.contains("narrow.pgm"), "{text}");
    let (code, document, text) = run("two-cameras", &["--camera", &camera, "--camera-b", narrow.to_str().unwrap()]);
    assert_eq!((code, outcome(&document)), (0, "reconstructed"), "{text}");
    let (rotation, direction) = errors(&document, &scene.second_from_first);
    assert!(rotation < 0.3 && direction < 1.5, "{rotation} {direction}\n{text}");
}

#[test]
fn wrong_files_are_errors_with_codes_of_their_own() {
    let scene = moved();
    let a = scene.path("a.pgm");
    let corrupt = scene.path("corrupt.png");
    std::fs::write(&corrupt, b"\x89PNG\r\n\x1a\n and then nothing").unwrap();
    let text = scene.path("text.toml");
    std::fs::write(&text, "width_px = 640\n").unwrap();
    let matrix = scene.path("zero.K");
    std::fs::write(&matrix, "0 0 320\n0 0 240\n0 0 1\n").unwrap();
    let missing = scene.path("missing.png");
    for (second, more, expected, word) in [
        (&corrupt, &[][..], 65, "corrupt.png"),
        (&missing, &[], 66, "missing.png"),
        (&a, &["--camera", missing.to_str().unwrap()], 66, "missing.png"),
        (&a, &["--camera", text.to_str().unwrap()], 78, "text.toml"),
        (&a, &["--camera", matrix.to_str().unwrap()], 78, "zero.K"),
        (&a, &["--sigma", "0"], 64, "sigma"),
    ] {
        let (code, _, message) = twoview(&a, second, &scene.path("never"), more);
        assert_eq!(code, expected, "{message}");
        assert!(message.contains(word), "{message}");
    }
}

#[test]
fn a_comparison_of_a_simulated_sequence_has_every_row_and_good_poses() {
    let folder = tempfile::tempdir().unwrap();
    let sequence = folder.path().join("sequence");
    let output = folder.path().join("compared");
    let simulated = cairn(&[
        "simulate",
        "--output",
        sequence.to_str().unwrap(),
        "--scenario",
        "desk_orbit",
        "--seconds",
        "1.5",
        "--rate",
        "6",
        "--without",
        "motion_blur,rolling_shutter",
    ]);
    assert!(simulated.status.success());
    let compared = cairn(&[
        "compare",
        sequence.to_str().unwrap(),
        "--output",
        output.to_str().unwrap(),
        "--detectors",
        "fast,susan",
        "--matchers",
        "descriptors,flow",
        "--step",
        "3",
        "--pairs",
        "2",
    ]);
    let table = String::from_utf8_lossy(&compared.stdout);
    assert!(compared.status.success(), "{}", String::from_utf8_lossy(&compared.stderr));
    assert_eq!(table.lines().filter(|l| l.starts_with("| fast") || l.starts_with("| susan")).count(), 4, "{table}");
    let document: Value = serde_json::from_slice(&std::fs::read(output.join("compare.json")).unwrap()).unwrap();
    assert_eq!(document["scores"].as_array().unwrap().len(), 8);
    let best = &document["summaries"][0];
    assert_eq!((&best["right"][0], &best["right"][1]), (&Value::from(2), &Value::from(2)), "{table}");
    for file in ["compare.md", "compare.png"] {
        assert!(output.join(file).is_file());
    }
    let nothing =
        cairn(&["compare", folder.path().join("compared").to_str().unwrap(), "--output", output.to_str().unwrap()]);
    assert_eq!(nothing.status.code(), Some(66));
}

fn data(name: &str) -> Option<PathBuf> {
    recording(&format!("two_view/{name}"))
}

/// `cairn compare` on a folder: the scores.
fn scores(folder: &Path, detectors: &str, matcher: &str, more: &[&str]) -> Vec<Value> {
    let output = tempfile::tempdir().unwrap();
    let mut arguments = vec!["compare", folder.to_str().unwrap(), "--output", output.path().to_str().unwrap()];
    arguments.extend(["--detectors", detectors, "--matchers", matcher]);
    arguments.extend(more);
    assert!(cairn(&arguments).status.success());
    let document: Value = serde_json::from_slice(&std::fs::read(output.path().join("compare.json")).unwrap()).unwrap();
    document["scores"].as_array().unwrap().clone()
}

#[test]
fn f_of_listed_matches_brings_annotated_points_onto_their_lines() {
    let Some(folder) = data("fundamental") else { return };
    let scores = scores(&folder, "fast", "descriptors", &[]);
    let of = |pair: &str| scores.iter().find(|s| s["pair"] == pair && s["detector"].is_null()).unwrap();
    for pair in ["booksh", "plant"] {
        let median = of(pair)["annotated_px"].as_f64().unwrap();
        assert!(median <= 0.7, "{pair}: {median} px");
    }
    for pair in ["box", "corr", "rotunda", "bonhall"] {
        assert_eq!(of(pair)["outcome"], "fundamental_only", "{pair}");
    }
}

#[test]
fn f_of_our_own_matches_brings_annotated_points_onto_their_lines() {
    let Some(folder) = data("fundamental") else { return };
    let scores = scores(&folder, "fast", "gradients", &[]);
    let of = |pair: &str| scores.iter().find(|s| s["pair"] == pair && s["detector"] == "fast").unwrap();
    for pair in ["booksh", "plant"] {
        let median = of(pair)["annotated_px"].as_f64().unwrap();
        assert!(median <= 0.7, "{pair}: {median} px");
    }
    for pair in ["box", "corr", "rotunda", "bonhall"] {
        assert_eq!(of(pair)["outcome"], "fundamental_only", "{pair}");
    }
}

/// Angles with the rows of the inliers' epipolar lines in both pictures, degrees, as `cairn twoview` wrote F: median of the signed
/// angles and of the absolute ones.
fn row_angles(document: &Value) -> (f64, f64) {
    let f = matrix(&document["F"]);
    let place = |m: &Value, key: &str| Vector3::new(m[key][0].as_f64().unwrap(), m[key][1].as_f64().unwrap(), 1.0);
    let mut signed: Vec<f64> = Vec::new();
    for m in document["matches"].as_array().unwrap().iter().filter(|m| m["inlier"] == true) {
        for line in [f * place(m, "a"), f.transpose() * place(m, "b")] {
            signed.push((-line.x * line.y.signum()).atan2(line.y.abs()).to_degrees());
        }
    }
    let median = |mut v: Vec<f64>| {
        v.sort_by(f64::total_cmp);
        v[v.len() / 2]
    };
    (median(signed.clone()), median(signed.iter().map(|a| a.abs()).collect()))
}

/// Middlebury's calibration of the pair, at a quarter of its size.
const MOTORCYCLE: [&str; 2] =
    ["994.978 0 311.193\n0 994.978 254.877\n0 0 1\n", "994.978 0 342.279\n0 994.978 254.877\n0 0 1\n"];

#[test]
fn epipolar_lines_of_a_rectified_pair_of_known_cameras_are_rows() {
    let Some(folder) = data("motorcycle") else { return };
    let place = tempfile::tempdir().unwrap();
    let cameras = ["a.K", "b.K"].map(|name| place.path().join(name));
    for (file, k) in cameras.iter().zip(MOTORCYCLE) {
        std::fs::write(file, k).unwrap();
    }
    let [a, b] = ["motorcycle_left.png", "motorcycle_right.png"].map(|name| folder.join(name));
    let more = ["--camera", cameras[0].to_str().unwrap(), "--camera-b", cameras[1].to_str().unwrap()];
    let (code, document, text) = twoview(&a, &b, &place.path().join("out"), &more);
    assert_eq!((code, outcome(&document)), (0, "reconstructed"), "{text}");
    let (tilt, angle) = row_angles(&document);
    println!("with cameras: tilt {tilt:.3}, median {angle:.3} degrees");
    assert!(tilt.abs() <= 0.1 && angle <= 0.1, "{tilt} {angle}\n{text}");
}

/// Without cameras F has two numbers more, and the pair's own pixels, which lie up to 0.1 px off their rows, would bend it by 0.2
/// degrees; as the F of one camera it stays straight, if that camera's focal length is one that cameras have.
#[test]
fn epipolar_lines_of_a_rectified_pair_of_unknown_cameras_are_rows() {
    let Some(folder) = data("motorcycle") else { return };
    for (matcher, more) in [
        ("flow", &[][..]),
        ("correlation", &[]),
        ("descriptors", &[]),
        ("descriptors", &["--guided"]),
        ("gradients", &[]),
        ("gradients", &["--guided"]),
    ] {
        for score in scores(&folder, "fast,susan", matcher, more) {
            let figure = |key: &str| score[key].as_f64().unwrap();
            let (tilt, angle) = (figure("row_tilt_deg"), figure("row_angle_deg"));
            println!("{} {matcher} {more:?}: tilt {tilt:.3}, median {angle:.3} degrees", score["detector"]);
            assert!(tilt.abs() <= 0.1 && angle <= 0.1, "{matcher} {more:?}: {score}");
        }
    }
}
