//! Our calibration beside OpenCV's, on the same pictures in the same run, as Markdown. Skipped with a message where the pictures or OpenCV
//! are missing.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Mutex;
use std::time::Instant;

use cairn::calibration::boards::{BoardView, solve};
use cairn::calibration::chessboard::{Detector, Pattern, Sighting};
use cairn::camera::Pacing;
use cairn::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use cairn::frame::{PixelFormat, RawFrame};
use cairn::geometry::plane_calibration::{Distortion, View, calibrate};
use cairn::image::GreyImage;
use cairn::image::decode::Decoder;
use nalgebra::Vector2;

#[derive(Default)]
struct Peer {
    corners: Vec<Vec<Vector2<f64>>>,
    /// rms fx fy cx cy k1 k2 p1 p2 k3
    result: Vec<f64>,
    sigma: Vec<f64>,
    /// The same with other coefficients of distortion: rms fx fy cx cy k1 k2 p1 p2 k3.
    models: Vec<(String, Vec<f64>)>,
    time_ms: Vec<f64>,
}

/// `None`: no OpenCV.
fn peer(folder: &Path, size: &str, extension: &str) -> Option<Peer> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/opencv_chessboard.py");
    let output = Command::new("python3").arg(script).arg(folder).args([size, extension]).output().ok()?;
    if !output.status.success() {
        return None;
    }
    let mut peer = Peer::default();
    for line in String::from_utf8_lossy(&output.stdout).lines() {
        let mut words = line.split_whitespace();
        let kind = words.next().unwrap_or_default();
        let numbers = || words.clone().filter_map(|w| w.parse().ok()).collect::<Vec<f64>>();
        match kind {
            "picture" => peer.corners.push(Vec::new()),
            "c" => {
                let xy = numbers();
                peer.corners.last_mut()?.push(Vector2::new(xy[0], xy[1]));
            }
            "result" => peer.result = numbers(),
            "sigma" => peer.sigma = numbers(),
            "model" => peer.models.push((words.clone().next().unwrap_or_default().into(), numbers())),
            "time" => peer.time_ms = numbers(),
            _ => {}
        }
    }
    Some(peer)
}

/// One at a time, because times are compared.
static ALONE: Mutex<()> = Mutex::new(());

fn compare(set: &str, columns: u32, rows: u32, extension: &str) {
    let root = std::env::var_os("CAIRN_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let folder = root.join(set);
    let _alone = ALONE.lock();
    if !folder.is_dir() {
        println!("skipped: {} is not here", folder.display());
        return;
    }
    let Some(peer) = peer(&folder, &format!("{columns}x{rows}"), extension) else {
        println!("skipped: no python3 with OpenCV");
        return;
    };
    let mut files: Vec<PathBuf> = std::fs::read_dir(&folder)
        .unwrap()
        .flatten()
        .map(|e| e.path())
        .filter(|p| p.extension().is_some_and(|e| e == extension))
        .collect();
    files.sort();
    let pictures: Vec<GreyImage> = files
        .iter()
        .map(|path| {
            let data = std::fs::read(path).unwrap();
            let mut picture = GreyImage::default();
            let raw = RawFrame { format: PixelFormat::Jpeg, data, ..RawFrame::default() };
            Decoder::default().decode(&raw, &mut picture).unwrap();
            picture
        })
        .collect();
    let size = (pictures[0].width as u32, pictures[0].height as u32);

    // The peer's corners through our solver: the very same camera, whatever the lens model.
    let plane: Vec<Vector2<f64>> =
        (0..rows).flat_map(|r| (0..columns).map(move |c| Vector2::new(f64::from(c), f64::from(r)))).collect();
    let views: Vec<View> = (peer.corners.iter())
        .map(|pixels| View { plane: plane.clone(), pixels: pixels.clone(), shear: Vec::new() })
        .collect();
    let (wide, _) = fisheye_peer(&views, size).expect("OpenCV is here");
    let mut compared = Vec::new();
    println!("\n| OpenCV's corners through both solvers | fx fy cx cy within px | RMS px | OpenCV's RMS px |");
    println!("|---|---:|---:|---:|");
    for (name, theirs) in peer.models.iter().map(|(n, m)| (n.as_str(), m)).chain([("fisheye", &wide)]) {
        let distortion = match name {
            "none" => Distortion::None,
            "radial" => Distortion::Radial,
            "radial-tangential" => Distortion::RadialTangential,
            "full" => Distortion::Full,
            _ => Distortion::KannalaBrandt,
        };
        let same = calibrate(&views, size, distortion).unwrap();
        let (used, all) = (same.used_points(), views.iter().map(|v| v.pixels.len()).sum::<usize>());
        if used < all {
            // A lens model that does not fit makes outliers of good corners; OpenCV keeps them.
            println!("| {set}, {name} | {} of {all} corners do not fit the model | – | – |", all - used);
            continue;
        }
        let off = (0..4).map(|i| (same.intrinsics[i] - theirs[i + 1]).abs()).fold(0.0, f64::max);
        println!("| {set}, {name} | {off:.5} | {:.5} | {:.5} |", same.rms_px, theirs[0]);
        assert!(off < 0.01, "{set}, {name}: {off} px from OpenCV's on its own corners");
        assert!((same.rms_px / theirs[0] - 1.0).abs() < 1e-3, "{set}, {name}: RMS {} {}", same.rms_px, theirs[0]);
        compared.push(name);
    }
    assert!(["full", "fisheye"].iter().all(|name| compared.contains(name)), "{set}: only {compared:?} compared");

    // Our corners.
    let pattern = Pattern::new(columns, rows, 0.025).unwrap();
    let mut detector = Detector::default();
    let mut boards = Vec::new();
    let (mut detection_ms, mut solve_ms, mut ours) = (f64::INFINITY, f64::INFINITY, None);
    // The peer says its shortest time of three, too.
    for _ in 0..3 {
        let begin = Instant::now();
        boards.clear();
        for (path, picture) in files.iter().zip(&pictures) {
            if let Sighting::Board(board) = detector.detect(picture, &pattern) {
                assert!(board.complete, "{}", path.display());
                boards.push(BoardView::still(path.display().to_string(), board));
            }
        }
        let detected = Instant::now();
        ours = solve(&boards, &pattern, size, Distortion::Full).ok();
        detection_ms = detection_ms.min((detected - begin).as_secs_f64() * 1e3);
        solve_ms = solve_ms.min(detected.elapsed().as_secs_f64() * 1e3);
    }
    let ours = ours.expect("solved");
    assert!(boards.len() >= peer.corners.len(), "{set}: {} views, the peer has {}", boards.len(), peer.corners.len());
    let mut rows = String::new();
    for (i, name) in ["fx", "fy", "cx", "cy"].into_iter().enumerate() {
        let deviations = (ours.solved.intrinsics[i] - peer.result[i + 1]) / peer.sigma[i];
        rows += &format!(
            "| {set}, {name} | {:.3} | {:.3} | {deviations:+.2} |\n",
            ours.solved.intrinsics[i],
            peer.result[i + 1]
        );
        assert!(deviations.abs() < 2.0, "{set}: parameter {i} is {deviations} of the peer's sigmas off");
    }
    let (rms, peer_rms) = (ours.solved.rms_px, peer.result[0]);
    assert!(rms <= 1.01 * peer_rms, "{set}: RMS {rms} px, the peer has {peer_rms} px");
    let ratio = (detection_ms + solve_ms) / (peer.time_ms[0] + peer.time_ms[1]);
    println!(
        "\n| each with its own corners | pictures | views | OpenCV's views | RMS px | OpenCV's RMS px | detection ms | solving ms | OpenCV's detection ms | OpenCV's solving ms | share of OpenCV's time |"
    );
    println!("|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|");
    println!(
        "| {set} | {} | {} | {} | {rms:.4} | {peer_rms:.4} | {detection_ms:.0} | {solve_ms:.1} | {:.0} | {:.1} | {ratio:.2} |",
        files.len(),
        boards.len(),
        peer.corners.len(),
        peer.time_ms[0],
        peer.time_ms[1],
    );
    println!("\n| parameter | Cairn px | OpenCV px | difference, OpenCV's sigmas |\n|---|---:|---:|---:|\n{rows}");
}

#[test]
fn opencvs_own_set_is_calibrated_as_well_as_by_opencv() {
    compare("calib_opencv_left", 9, 6, "jpg");
}

#[test]
fn a_global_shutter_camera_is_calibrated_as_well_as_by_opencv() {
    compare("calib_camodocal", 12, 8, "png");
}

/// RMS fx fy cx cy k1 k2 k3 k4 and the time (ms) of OpenCV's fisheye module; `None`: no OpenCV.
fn fisheye_peer(views: &[View], (width, height): (u32, u32)) -> Option<(Vec<f64>, f64)> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/opencv_fisheye.py");
    let mut lines = String::new();
    for view in views {
        lines += "view\n";
        for (on, at) in view.plane.iter().zip(&view.pixels) {
            writeln!(lines, "c {} {} {:.17} {:.17}", on.x, on.y, at.x, at.y).unwrap();
        }
    }
    let mut child = Command::new("python3")
        .arg(script)
        .arg(format!("{width}x{height}"))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .ok()?;
    // It may have gone already: no OpenCV.
    let _ = child.stdin.take()?.write_all(lines.as_bytes());
    let output = child.wait_with_output().ok()?;
    if output.status.code() == Some(3) {
        return None;
    }
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stdout));
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let numbers = |kind: &str| -> Vec<f64> {
        let line = text.lines().find_map(|l| l.strip_prefix(kind)).unwrap_or_default();
        line.split_whitespace().filter_map(|w| w.parse().ok()).collect()
    };
    Some((numbers("result"), numbers("time")[0]))
}

#[test]
fn a_fisheye_is_calibrated_as_by_opencvs_fisheye_module_on_the_same_corners() {
    let _alone = ALONE.lock();
    let mut config = SimulatorConfig { scenario: Scenario::CalibrationSweep, ..SimulatorConfig::default() };
    config.lens.wide_angle.enabled = true;
    config.chessboard.enabled = true;
    config.texel_mm = 4.0;
    config.rolling_shutter.enabled = false;
    config.motion_blur.enabled = false;
    let mut simulator = Simulator::new(&config, Pacing::LockStep).unwrap();
    let pattern = Pattern::new(9, 6, 1.0).unwrap();
    let (mut detector, mut picture, mut boards) = (Detector::default(), GreyImage::default(), Vec::new());
    for k in 0..24 {
        simulator.render(40 + k * 67, &mut picture);
        if let Sighting::Board(board) = detector.detect(&picture, &pattern)
            && board.complete
        {
            boards.push(BoardView::still(k.to_string(), board));
        }
    }
    let size = (config.width, config.height);
    let seen: Vec<View> = (boards.iter().map(|view| &view.board.corners))
        .map(|corners| View {
            plane: corners.iter().map(|c| Vector2::new(f64::from(c.column), f64::from(c.row))).collect(),
            pixels: corners.iter().map(|c| c.pixel).collect(),
            shear: Vec::new(),
        })
        .collect();
    let Some((peer, peer_ms)) = fisheye_peer(&seen, size) else {
        println!("skipped: no python3 with OpenCV");
        return;
    };
    let begin = Instant::now();
    let ours = solve(&boards, &pattern, size, Distortion::KannalaBrandt).unwrap();
    let ms = begin.elapsed().as_secs_f64() * 1e3;
    let sigmas = ours.solved.sigmas();
    let used = |v: &cairn::geometry::plane_calibration::SolvedView| v.used && v.used_points.iter().all(|u| *u);
    assert!(ours.solved.views.iter().all(used), "left out corners that the peer has");
    println!("\n| wide-angle parameter | Cairn | OpenCV | difference, sigmas |\n|---|---:|---:|---:|");
    for (i, name) in ours.solved.lens.parameter_names().iter().enumerate() {
        let off = (ours.solved.intrinsics[i] - peer[i + 1]) / sigmas[i];
        println!("| {name} | {:.4} | {:.4} | {off:+.3} |", ours.solved.intrinsics[i], peer[i + 1]);
        assert!(off.abs() < 0.2, "{name}: {} instead of {}", ours.solved.intrinsics[i], peer[i + 1]);
    }
    let (rms, peer_rms) = (ours.solved.rms_px, peer[0]);
    println!("\n| wide-angle, the same corners | RMS px | OpenCV's RMS px | solving ms | OpenCV's solving ms |");
    println!(
        "|---|---:|---:|---:|---:|\n| {} views | {rms:.5} | {peer_rms:.5} | {ms:.1} | {peer_ms:.1} |",
        boards.len()
    );
    assert!(rms <= 1.001 * peer_rms, "RMS {rms} px, the peer has {peer_rms} px");
}
