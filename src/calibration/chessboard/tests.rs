//! Boards of the simulator against the truth, spoilt in the ways of webcams; the recorded sets; what is no board.

use super::*;
use crate::camera::Pacing;
use crate::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use crate::frame::{PixelFormat, RawFrame};
use crate::geometry::random::Random;
use crate::image::decode::Decoder;
use nalgebra::Vector2;

/// Pictures of the board and where its corners are in them, row by row; at (-1, -1) if a lens does not see them.
fn pictures(frames: &[u64]) -> Vec<(GreyImage, Vec<Vector2<f64>>)> {
    pictures_through(SimulatorConfig::default(), frames)
}

fn pictures_through(mut config: SimulatorConfig, frames: &[u64]) -> Vec<(GreyImage, Vec<Vector2<f64>>)> {
    config.scenario = Scenario::CalibrationSweep;
    config.chessboard.enabled = true;
    config.texel_mm = 4.0;
    config.rolling_shutter.enabled = false;
    config.motion_blur.enabled = false;
    let mut simulator = Simulator::new(&config, Pacing::LockStep).expect("simulator");
    let board = simulator.chessboard().expect("enabled").clone();
    let camera = simulator.camera_model().clone();
    let mut all = Vec::new();
    for frame in frames {
        let mut picture = GreyImage::default();
        simulator.render(*frame, &mut picture);
        let pose = simulator.trajectory().pose_at(simulator.timestamp_ns(*frame)).inverse();
        let cells = (0..board.rows).flat_map(|r| (0..board.columns).map(move |c| (c, r)));
        let project = |(c, r)| camera.project(&pose.transform(&board.corner(c, r))).unwrap_or(Vector2::repeat(-1.0));
        all.push((picture, cells.map(project).collect()));
    }
    all
}

fn pattern() -> Pattern {
    Pattern::new(9, 6, 0.03).expect("valid")
}

/// Root mean square distance to the truth, pixels; the board may be turned by half a turn.
fn error(board: &Board, truth: &[Vector2<f64>]) -> f64 {
    let at = |turned: bool| {
        let of = |c: &BoardCorner| {
            let n = (c.row * 9 + c.column) as usize;
            if turned { truth[53 - n] } else { truth[n] }
        };
        let sum: f64 = board.corners.iter().map(|c| (c.pixel - of(c)).norm_squared()).sum();
        (sum / board.corners.len() as f64).sqrt()
    };
    at(false).min(at(true))
}

const FRAMES: [u64; 6] = [30, 120, 210, 300, 400, 500];

#[test]
fn corners_are_where_the_truth_says_to_a_tenth_of_a_pixel() {
    let mut detector = Detector::default();
    for ((picture, truth), frame) in pictures(&FRAMES).iter().zip(FRAMES) {
        let board = detector.detect(picture, &pattern()).board().expect("seen");
        assert!(board.complete, "frame {frame}");
        let rms = error(&board, truth);
        assert!(rms < 0.1, "frame {frame}: {rms} px");
        assert_eq!(detector.detect(picture, &pattern()), Sighting::Board(board), "the same again");
    }
}

#[test]
fn a_board_whose_rows_a_wide_angle_lens_bends_is_found_whole_up_to_the_pictures_rim() {
    let mut config = SimulatorConfig::default();
    config.lens.wide_angle.enabled = true;
    let frames: Vec<u64> = (0..16).map(|k| 30 + k * 61).collect();
    let mut detector = Detector::default();
    let (mut whole, mut farthest) = (0, 0.0f64);
    for ((picture, truth), frame) in pictures_through(config, &frames).iter().zip(&frames) {
        let inside = |p: &Vector2<f64>| p.x > 8.0 && p.y > 8.0 && p.x < 631.0 && p.y < 471.0;
        if !truth.iter().all(inside) {
            continue;
        }
        whole += 1;
        let board = detector.detect(picture, &pattern()).board().unwrap_or_else(|| panic!("frame {frame}: not seen"));
        assert!(board.complete, "frame {frame}: {} corners", board.corners.len());
        let rms = error(&board, truth);
        assert!(rms < 0.15, "frame {frame}: {rms} px");
        farthest = truth.iter().map(|p| (p - Vector2::new(320.0, 240.0)).norm()).fold(farthest, f64::max);
    }
    println!("{whole} whole boards, corners up to {farthest:.0} px from the middle");
    assert!(whole >= 8 && farthest > 300.0, "{whole} whole boards, corners up to {farthest} px from the middle");
}

/// Binomial blur of five taps, `rounds` times: sigma = sqrt(rounds).
fn blurred(picture: &GreyImage, rounds: usize) -> GreyImage {
    let mut out = picture.clone();
    let (w, h) = (out.width as isize, out.height as isize);
    for _ in 0..rounds {
        for (dx, dy) in [(1, 0), (0, 1)] {
            let from = out.clone();
            for y in 0..h {
                for x in 0..w {
                    let at = |k: isize| {
                        let (x, y) = ((x + k * dx).clamp(0, w - 1), (y + k * dy).clamp(0, h - 1));
                        u32::from(from.at(x as usize, y as usize))
                    };
                    let sum = at(-2) + at(2) + 4 * (at(-1) + at(1)) + 6 * at(0);
                    out.data[(y * w + x) as usize] = ((sum + 8) / 16) as u8;
                }
            }
        }
    }
    out
}

#[test]
fn blur_darkness_noise_and_uneven_light_leave_the_board_to_be_found() {
    let mut random = Random::new(7);
    let mut detector = Detector::default();
    for (picture, truth) in pictures(&FRAMES[..3]) {
        let mut noisy = |scale: f64, sigma: f64, slope: f64| {
            let mut out = picture.clone();
            for (n, v) in out.data.iter_mut().enumerate() {
                let light = 1.0 - slope * (n % picture.width) as f64 / picture.width as f64;
                *v = (f64::from(*v) * scale * light + sigma * random.normal()).clamp(0.0, 255.0) as u8;
            }
            out
        };
        let spoilt = [
            ("blur", blurred(&picture, 9), 0.4),
            ("dark", noisy(0.15, 2.0, 0.0), 0.5),
            ("noise", noisy(1.0, 15.0, 0.0), 0.5),
            ("uneven light", noisy(1.0, 1.0, 0.9), 0.3),
        ];
        for (what, picture, limit_px) in spoilt {
            let board = detector.detect(&picture, &pattern()).board();
            let board = board.unwrap_or_else(|| panic!("seed 7, {what}: not seen"));
            assert!(board.complete, "seed 7, {what}: {} corners", board.corners.len());
            let rms = error(&board, &truth);
            assert!(rms < limit_px, "seed 7, {what}: {rms} px");
        }
    }
}

#[test]
fn a_hidden_corner_does_not_hide_the_board_and_small_boards_are_seen() {
    let mut detector = Detector::default();
    for (mut picture, truth) in pictures(&FRAMES[..2]) {
        let mut small = GreyImage::default();
        halve(&picture, &mut small);
        let board = detector.detect(&small, &pattern()).board().expect("seen at half the size");
        assert!(board.complete);
        // A finger on two corners.
        for hidden in [truth[12], truth[13]] {
            for y in -14i32..=14 {
                for x in -14i32..=14 {
                    let at = (hidden.y as i32 + y) * picture.width as i32 + hidden.x as i32 + x;
                    picture.data[at as usize] = 150;
                }
            }
        }
        let board = detector.detect(&picture, &pattern()).board().expect("seen with corners hidden");
        assert!(!board.complete && board.corners.len() >= 44, "{}", board.corners.len());
        assert!(error(&board, &truth) < 0.5, "{}", error(&board, &truth));
    }
}

#[test]
fn another_size_is_named_and_no_board_is_none() {
    let mut detector = Detector::default();
    let (picture, _) = pictures(&FRAMES[..1]).remove(0);
    for (columns, rows) in [(8, 5), (10, 7), (9, 7), (7, 7)] {
        let other = Pattern::new(columns, rows, 0.03).expect("valid");
        assert_eq!(detector.detect(&picture, &other), Sighting::OtherSize(9, 6), "{columns}x{rows}");
    }
    assert!(detector.detect(&picture, &Pattern::new(6, 9, 0.03).expect("valid")).board().is_some(), "turned");
    for (seed, (width, height)) in
        (0..).zip([(640, 480), (640, 480), (640, 480), (640, 480), (640, 480), (640, 480), (1, 1), (7, 300), (64, 64)])
    {
        let mut random = Random::new(seed);
        let data = (0..width * height).map(|_| random.bits() as u8).collect();
        let noise = GreyImage { width, height, data };
        assert_eq!(detector.detect(&noise, &pattern()), Sighting::Nothing, "seed {seed}: {width}x{height}");
        assert_eq!(detector.detect(&blurred(&noise, 3), &pattern()), Sighting::Nothing, "seed {seed}, blurred");
        assert_eq!(detector.detect(&GreyImage::new(width, height), &pattern()), Sighting::Nothing);
    }
}

/// Name, size, and pictures with their names.
type RecordedSet = (&'static str, (u32, u32), Vec<(String, GreyImage)>);

/// The recorded sets that are here.
fn recorded_sets() -> Vec<RecordedSet> {
    let root = std::env::var_os("CAIRN_DATA").map_or_else(
        || std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        std::path::PathBuf::from,
    );
    let mut sets = Vec::new();
    for (set, size, extension) in [("calib_opencv_left", (9, 6), "jpg"), ("calib_camodocal", (12, 8), "png")] {
        let Ok(folder) = std::fs::read_dir(root.join(set)) else {
            println!("skipped: {} is not here", root.join(set).display());
            continue;
        };
        let mut pictures = Vec::new();
        for path in folder.flatten().map(|e| e.path()).filter(|p| p.extension().is_some_and(|e| e == extension)) {
            let data = std::fs::read(&path).expect("read");
            let raw = RawFrame { format: PixelFormat::Jpeg, data, ..RawFrame::default() };
            let mut picture = GreyImage::default();
            Decoder::default().decode(&raw, &mut picture).expect("decoded");
            pictures.push((path.display().to_string(), picture));
        }
        sets.push((set, size, pictures));
    }
    sets
}

#[test]
fn the_recorded_sets_are_seen_whole_in_either_order_of_their_sides() {
    let mut detector = Detector::default();
    for (_, (columns, rows), pictures) in recorded_sets() {
        for (columns, rows) in [(columns, rows), (rows, columns)] {
            let pattern = Pattern::new(columns, rows, 0.025).expect("valid");
            for (name, picture) in &pictures {
                let board = detector.detect(picture, &pattern).board();
                assert!(board.is_some_and(|b| b.complete), "{name} as {columns}x{rows}");
            }
        }
    }
}

#[test]
fn recorded_boards_are_told_from_other_sizes() {
    let mut detector = Detector::default();
    for (set, (columns, rows), pictures) in recorded_sets() {
        let (mut named, mut taken, mut of) = (0, Vec::new(), 0);
        for (dc, dr) in (-2..=2).flat_map(|dc| (-2..=2).map(move |dr| (dc, dr))).filter(|d| *d != (0, 0)) {
            let (c, r) = (columns.saturating_add_signed(dc), rows.saturating_add_signed(dr));
            for pattern in [(c, r), (r, c)].map(|(c, r)| Pattern::new(c, r, 0.025).expect("valid")) {
                for (name, picture) in &pictures {
                    let seen = detector.detect(picture, &pattern);
                    named += usize::from(seen == Sighting::OtherSize(columns, rows));
                    if let Sighting::Board(_) = seen {
                        taken.push(format!("{name} as {}x{}", pattern.columns, pattern.rows));
                    }
                    of += 1;
                }
            }
        }
        println!("{set}: its size was named in {named} of {of}; taken all the same: {taken:#?}");
        assert!(named as f64 > 0.97 * f64::from(of), "{set}: its size was named in {named} of {of}");
        // A rim so thin or faint that the level on which the rest is whole does not show it.
        assert!(100 * taken.len() < of as usize, "{set}: {taken:#?}");
    }
}

#[test]
fn a_simulated_board_is_never_taken_for_one_of_another_size() {
    let mut wide = SimulatorConfig::default();
    wide.lens.wide_angle.enabled = true;
    let frames: Vec<u64> = (0..8).map(|k| 30 + k * 83).collect();
    let mut detector = Detector::default();
    for (lens, config) in [("usual", SimulatorConfig::default()), ("wide", wide)] {
        for ((picture, truth), frame) in pictures_through(config, &frames).iter().zip(&frames) {
            let inside = |p: &Vector2<f64>| p.x > 8.0 && p.y > 8.0 && p.x < 631.0 && p.y < 471.0;
            if !truth.iter().all(inside) {
                continue;
            }
            for (columns, rows) in [(8, 6), (9, 5), (8, 5), (6, 8), (7, 6), (10, 6), (9, 7), (6, 6), (10, 7)] {
                let other = Pattern::new(columns, rows, 0.03).expect("valid");
                let seen = detector.detect(picture, &other);
                assert_eq!(seen, Sighting::OtherSize(9, 6), "{lens} lens, frame {frame} as {columns}x{rows}");
            }
        }
    }
}

#[test]
fn patterns_that_cannot_be_are_refused() {
    assert!(Pattern::new(2, 6, 0.03).is_err() && Pattern::new(9, 31, 0.03).is_err());
    assert!(Pattern::new(9, 6, 0.0).is_err() && Pattern::new(9, 6, f64::NAN).is_err());
}
