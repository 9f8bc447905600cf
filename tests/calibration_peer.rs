//! Our calibration beside OpenCV's, on the same pictures in the same run. Skipped with a message where the pictures or OpenCV are missing.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
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
            "time" => peer.time_ms = numbers(),
            _ => {}
        }
    }
    Some(peer)
}

fn compare(set: &str, columns: u32, rows: u32, extension: &str) {
    let root = std::env::var_os("CAIRN_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let folder = root.join(set);
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

    // The peer's corners through our solver: the very same camera.
    let plane: Vec<Vector2<f64>> =
        (0..rows).flat_map(|r| (0..columns).map(move |c| Vector2::new(f64::from(c), f64::from(r)))).collect();
    let views: Vec<View> = peer
        .corners
        .iter()
        .map(|pixels| View { plane: plane.clone(), pixels: pixels.clone(), shear: Vec::new() })
        .collect();
    let same = calibrate(&views, size, Distortion::Full).unwrap();
    for i in 0..4 {
        let off = (same.intrinsics[i] - peer.result[i + 1]).abs();
        assert!(off < 0.01, "{set}: parameter {i} differs by {off} px from the peer's on its own corners");
    }
    assert!((same.rms_px / peer.result[0] - 1.0).abs() < 1e-3, "{set}: {} {}", same.rms_px, peer.result[0]);

    // Our corners.
    let pattern = Pattern::new(columns, rows, 0.025).unwrap();
    let mut detector = Detector::default();
    let begin = Instant::now();
    let mut boards = Vec::new();
    for (path, picture) in files.iter().zip(&pictures) {
        if let Sighting::Board(board) = detector.detect(picture, &pattern) {
            assert!(board.complete, "{}", path.display());
            boards.push(BoardView::still(path.display().to_string(), board));
        }
    }
    let detected = Instant::now();
    let ours = solve(&boards, &pattern, size, Distortion::Full).unwrap();
    let solved = Instant::now();
    assert!(boards.len() >= peer.corners.len(), "{set}: {} views, the peer has {}", boards.len(), peer.corners.len());
    let mut text = String::new();
    for i in 0..4 {
        let deviations = (ours.solved.intrinsics[i] - peer.result[i + 1]) / peer.sigma[i];
        text += &format!(" {:.3} ({deviations:+.2} of its sigmas)", ours.solved.intrinsics[i]);
        assert!(deviations.abs() < 2.0, "{set}: parameter {i} is {deviations} of the peer's sigmas off");
    }
    let (rms, peer_rms) = (ours.solved.rms_px, peer.result[0]);
    assert!(rms <= 1.01 * peer_rms, "{set}: RMS {rms} px, the peer has {peer_rms} px");
    let ms = |a: Instant, b: Instant| (b - a).as_secs_f64() * 1e3;
    println!(
        "{set}: {} of {} views, peer {};{text}; RMS {rms:.4}, peer {peer_rms:.4} px; detection {:.0} + solve {:.1} ms, peer {:.0} + {:.1} ms",
        boards.len(),
        files.len(),
        peer.corners.len(),
        ms(begin, detected),
        ms(detected, solved),
        peer.time_ms[0],
        peer.time_ms[1],
    );
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
fn fisheye_peer(boards: &[BoardView], (width, height): (u32, u32)) -> Option<(Vec<f64>, f64)> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/opencv_fisheye.py");
    let mut lines = String::new();
    for view in boards {
        lines += "view\n";
        for c in &view.board.corners {
            writeln!(lines, "c {} {} {:.17} {:.17}", c.column, c.row, c.pixel.x, c.pixel.y).unwrap();
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
    let Some((peer, peer_ms)) = fisheye_peer(&boards, size) else {
        println!("skipped: no python3 with OpenCV");
        return;
    };
    let begin = Instant::now();
    let ours = solve(&boards, &pattern, size, Distortion::KannalaBrandt).unwrap();
    let ms = begin.elapsed().as_secs_f64() * 1e3;
    let sigmas = ours.solved.sigmas();
    let used = |v: &cairn::geometry::plane_calibration::SolvedView| v.used && v.used_points.iter().all(|u| *u);
    assert!(ours.solved.views.iter().all(used), "left out corners that the peer has");
    let mut text = String::new();
    for (i, name) in ours.solved.lens.parameter_names().iter().enumerate() {
        let off = (ours.solved.intrinsics[i] - peer[i + 1]) / sigmas[i];
        text += &format!(" {name} {:.4} ({off:+.3} sigma)", ours.solved.intrinsics[i]);
        assert!(off.abs() < 0.2, "{name}: {} instead of {}", ours.solved.intrinsics[i], peer[i + 1]);
    }
    let (rms, peer_rms) = (ours.solved.rms_px, peer[0]);
    println!(
        "{} views;{text}; RMS {rms:.5}, peer {peer_rms:.5} px; solve {ms:.1} ms, peer {peer_ms:.1} ms",
        boards.len()
    );
    assert!(rms <= 1.001 * peer_rms, "RMS {rms} px, the peer has {peer_rms} px");
}
