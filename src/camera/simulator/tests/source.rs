//! The simulator as a source of frames, its configuration, and the recordings that it writes.

use std::time::Duration;

use super::super::{RECORDING_START_NS, SimulatorConfigError};
use super::*;
use crate::calibration::file::load_camera;
use crate::camera::{FrameSource, Grab};
use crate::frame::{Clock, PixelFormat, RawFrame};
use crate::trajectory::{parse_timestamp, read_tum};

#[test]
fn lock_step_gives_every_frame_and_then_the_end() {
    let mut config = quick(SimulatorConfig::default());
    config.duration_s = 0.2;
    let mut simulator = simulator(&config);
    let description = simulator.description().clone();
    assert_eq!(
        (description.clock, description.frames, description.size),
        (Clock::Recording, Some(6), Some((320, 240)))
    );
    let mut slot = RawFrame::default();
    for k in 0..6 {
        assert_eq!(simulator.grab(&mut slot, Duration::ZERO).unwrap(), Grab::Frame);
        assert_eq!((slot.sequence, slot.format, slot.stride), (k, PixelFormat::Grey, 320));
        assert_eq!(slot.timestamp_ns, RECORDING_START_NS + (k as f64 * 1e9 / 30.0).round() as i64);
        let expected = picture(&mut simulator, k);
        assert_eq!(slot.data, expected.data, "frame {k}");
    }
    assert_eq!(simulator.grab(&mut slot, Duration::ZERO).unwrap(), Grab::End);
}

#[test]
fn real_time_waits_for_the_frame_and_skips_what_it_missed() {
    let mut config = quick(SimulatorConfig::default());
    config.rate_hz = 20.0;
    let mut simulator = Simulator::new(&config, Pacing::RealTime).unwrap();
    assert_eq!(simulator.description().clock, Clock::Monotonic);
    let mut slot = RawFrame::default();
    let long = Duration::from_secs(5);
    assert_eq!(simulator.grab(&mut slot, long).unwrap(), Grab::Frame);
    let start = simulator.trajectory().start_ns();
    let mut last = slot.sequence;
    // Falls behind by eight periods: at least seven frames are missing then, and the stamps stay on schedule.
    std::thread::sleep(Duration::from_millis(400));
    assert_eq!(simulator.grab(&mut slot, long).unwrap(), Grab::Frame);
    assert!(slot.sequence >= last + 7, "sequence {} after {last}", slot.sequence);
    for _ in 0..3 {
        assert_eq!(slot.timestamp_ns, start + slot.sequence as i64 * 50_000_000);
        assert!(slot.arrival_ns >= slot.timestamp_ns, "handed over before its time");
        last = slot.sequence;
        assert_eq!(simulator.grab(&mut slot, long).unwrap(), Grab::Frame);
        assert!(slot.sequence > last);
    }
}

#[test]
fn real_time_gives_up_waiting_after_the_timeout() {
    let mut config = quick(SimulatorConfig::default());
    config.rate_hz = 1.0;
    let mut simulator = Simulator::new(&config, Pacing::RealTime).unwrap();
    let mut slot = RawFrame::default();
    assert_eq!(simulator.grab(&mut slot, Duration::from_secs(5)).unwrap(), Grab::Frame);
    assert_eq!(simulator.grab(&mut slot, Duration::from_millis(1)).unwrap(), Grab::TimedOut);
    assert_eq!(slot.sequence, 0);
}

#[test]
fn impossible_values_are_refused_by_key_value_and_unit() {
    type Spoil = fn(&mut SimulatorConfig);
    let cases: [(&str, Spoil); 20] = [
        ("width = 100 px", |c| c.width = 100),
        ("height = 1080 px", |c| c.height = 1080),
        ("rate_hz = NaN Hz", |c| c.rate_hz = f64::NAN),
        ("duration_s = -1 s", |c| c.duration_s = -1.0),
        ("speed = 0 ", |c| c.speed = 0.0),
        ("texel_mm = 0.1 mm", |c| c.texel_mm = 0.1),
        ("lens.coefficients", |c| c.lens.coefficients = [-1.5, 0.0, 0.0, 0.0, 0.0]),
        ("vignetting.corner_loss = 1.5", |c| c.vignetting.corner_loss = 1.5),
        ("noise.read_sigma = inf grey levels", |c| c.noise.read_sigma = f64::INFINITY),
        ("motion_blur.exposure_ms = 40 ms", |c| c.motion_blur.exposure_ms = 40.0),
        ("rolling_shutter.readout_ms = 34 ms", |c| c.rolling_shutter.readout_ms = 34.0),
        ("occluder.share = 0.95", |c| c.occluder.share = 0.95),
        ("chessboard.square_m = 0.1 m", |c| c.chessboard.square_m = 0.1),
        ("exposure.hunt_period_s = 0.1 s", |c| c.exposure.hunt_period_s = 0.1),
        ("exposure.hunt_ev = 3 EV", |c| c.exposure.hunt_ev = 3.0),
        ("jerks.period_s = 0.5 s", |c| c.jerks.period_s = 0.5),
        ("jerks.turn_deg_s = 400 degrees/s", |c| c.jerks.turn_deg_s = 400.0),
        ("gloss.spread_deg = 0 degrees", |c| c.gloss.spread_deg = 0.0),
        ("people.walk_m_s = NaN m/s", |c| c.people.walk_m_s = f64::NAN),
        ("chessboard.enabled = false", |c| c.scenario = Scenario::CalibrationSweep),
    ];
    for (text, spoil) in cases {
        let mut config = SimulatorConfig::default();
        spoil(&mut config);
        let error: SimulatorConfigError = config.validate().expect_err(text);
        assert!(error.to_string().contains(text), "`{error}` does not name `{text}`");
        let refused = Simulator::new(&config, Pacing::LockStep).expect_err(text).to_string();
        assert!(refused.contains(text) && refused.starts_with("simulator: "), "{refused}");
    }
}

#[test]
fn configuration_reads_toml_and_refuses_unknown_keys() {
    let config: SimulatorConfig = toml::from_str("").unwrap();
    assert_eq!(config, SimulatorConfig::default());
    let config: SimulatorConfig =
        toml::from_str("scenario = \"fast_rotation\"\nseed = 7\n[motion_blur]\nexposure_ms = 12.0").unwrap();
    assert_eq!((config.scenario, config.seed, config.motion_blur.exposure_ms), (Scenario::FastRotation, 7, 12.0));
    let again: SimulatorConfig = toml::from_str(&toml::to_string(&config).unwrap()).unwrap();
    assert_eq!(again, config);
    for text in ["sead = 7", "[motion_blur]\nexposure_s = 1.0", "scenario = \"moon\""] {
        assert!(toml::from_str::<SimulatorConfig>(text).is_err(), "{text} was accepted");
    }
    for scenario in Scenario::ALL {
        let text = format!("scenario = \"{}\"", scenario.name());
        assert_eq!(toml::from_str::<SimulatorConfig>(&text).unwrap().scenario, scenario);
    }
}

#[test]
fn a_written_recording_is_what_was_rendered() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("drive");
    let config = quick(SimulatorConfig::default());
    let mut simulator = simulator(&config);
    let written = simulator.write_recording(&path, 0.1).unwrap();
    assert_eq!(written.frames, 3);
    let list = std::fs::read_to_string(path.join("rgb.txt")).unwrap();
    let truth = read_tum(&path.join("groundtruth.txt")).unwrap();
    assert_eq!((list.lines().count(), truth.len()), (4, 3));
    for (k, (entry, truth)) in list.lines().skip(1).zip(&truth).enumerate() {
        let (stamp, file) = entry.split_once(' ').unwrap();
        let timestamp_ns = parse_timestamp(stamp).unwrap();
        assert_eq!((timestamp_ns, truth.timestamp_ns), (simulator.timestamp_ns(k as u64), timestamp_ns));
        let decoder = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(path.join(file)).unwrap()));
        let mut reader = decoder.read_info().unwrap();
        let mut bytes = vec![0; 320 * 240];
        reader.next_frame(&mut bytes).unwrap();
        assert_eq!(bytes, picture(&mut simulator, k as u64).data);
        let (a, b) = (truth.world_from_camera, simulator.trajectory().pose_at(timestamp_ns));
        assert!((a.translation - b.translation).norm() < 1e-8 && a.rotation.angle_to(&b.rotation) < 1e-7);
    }
    assert_eq!(&load_camera(&path.join("camera.yaml")).unwrap(), simulator.camera_model());
    assert!(simulator.write_recording(&path, 0.1).is_err(), "an older recording was overwritten");
}

#[test]
fn odd_sizes_are_rendered_to_the_last_pixel() {
    for (width, height) in [(321, 241), (500, 375), (1280, 720)] {
        let mut config = quick(SimulatorConfig::ideal(Scenario::Standing));
        (config.width, config.height) = (width, height);
        let picture = picture(&mut simulator(&config), 0);
        assert_eq!(picture.data.len(), (width * height) as usize);
        let last = picture.row(height as usize - 1);
        assert!(last.iter().any(|&v| v > 20), "{width}x{height}: the last row is empty");
    }
}
