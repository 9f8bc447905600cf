//! The console's calibration before the simulator's board: all that a page sees, without a page.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::*;
use crate::calibration::CalibrationFile;
use crate::calibration::store::{self, CameraIdentity};
use crate::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use crate::camera::{FrameSource, Grab, Pacing};
use crate::console::calibration::{Action, Camera, Session};
use crate::frame::RawFrame;
use crate::geometry::CameraModel;
use crate::image::decode::Decoder;

/// A camera before a board of 9x6.
struct Sweep {
    source: Simulator,
    slot: RawFrame,
    decoder: Decoder,
    now: Instant,
}

impl Sweep {
    fn new() -> Self {
        let mut config = SimulatorConfig { scenario: Scenario::CalibrationSweep, ..SimulatorConfig::default() };
        (config.width, config.height) = (480, 360);
        config.chessboard.enabled = true;
        config.texel_mm = 4.0;
        config.speed = 0.1;
        config.rate_hz = 4.0;
        let source = Simulator::new(&config, Pacing::LockStep).expect("simulator");
        Self { source, slot: RawFrame::default(), decoder: Decoder::default(), now: Instant::now() }
    }

    fn truth(&self) -> CameraModel {
        self.source.camera_model().clone()
    }

    fn next(&mut self) -> (Picture, Instant) {
        assert_eq!(self.source.grab(&mut self.slot, Duration::ZERO).expect("frame"), Grab::Frame);
        let mut grey = GreyImage::default();
        self.decoder.decode(&self.slot, &mut grey).expect("decoded");
        self.now += Duration::from_millis(250);
        let GreyImage { width, height, data: pixels } = grey;
        let (sequence, time_ns) = (self.slot.sequence, self.slot.timestamp_ns);
        (Picture { run_id: 7, sequence, time_ns, width, height, pixels }, self.now)
    }
}

fn board(columns: u32, rows: u32, square_m: Option<f64>) -> Asked {
    Asked { columns, rows, square_m, lens: Lens::Full }
}

fn session() -> Session {
    Session::new(Arc::new(Chessboards))
}

/// Nobody asks for it.
fn unasked(_: &str) -> Result<String, String> {
    panic!("nothing is to be kept")
}

#[test]
fn a_guided_calibration_ends_with_the_true_camera_and_is_kept_for_it() {
    let dir = tempfile::tempdir().expect("folder");
    let mut sweep = Sweep::new();
    let mut session = session();
    session.obey(Action::Start { board: board(9, 6, Some(0.03)) }, 5, sweep.now, &unasked).expect("started");
    let camera = Camera { identity: "046d:0825:ABC".into(), device: "/dev/video3".into() };
    let (mut most_views, mut drawn, mut needs) = (0, 0, Vec::new());
    for n in 0..900 {
        let (picture, now) = sweep.next();
        session.look(picture);
        assert_eq!(session.nameless(), (n == 0).then_some(7), "its camera is asked for once");
        session.name(Some(camera.clone()));
        let told = session.told(now);
        if told.phase != "running" {
            break;
        }
        let (guidance, glance) = (told.guidance.expect("guidance"), told.glance.expect("glance"));
        assert!(guidance.views >= most_views, "views are lost");
        most_views = guidance.views;
        assert_eq!(guidance.outlines.len(), guidance.views);
        assert!(guidance.outlines.iter().flatten().all(|share| (0.0..=1.0).contains(share)), "{guidance:?}");
        drawn += usize::from(glance.corners.iter().map(Vec::len).collect::<Vec<_>>() == [18; 6]);
        needs.extend(guidance.needs.iter().map(|need| need.name));
        let sentence = told.sentence;
        let first = guidance.needs.first().map_or(sentence, |need| &need.advice);
        let fits = !matches!(glance.look, Look::Known | Look::Taken) || sentence == first;
        assert!(fits, "`{sentence}` is said where `{first}` is missing first");
        assert!(guidance.gauges.iter().all(|g| g.share.is_none_or(|s| (0.0..=1.0).contains(&s))), "{guidance:?}");
        assert_eq!(told.terminal, "cairn calibrate --camera /dev/video3 --pattern 9x6 --square 0.03");
    }
    let told = session.told(sweep.now);
    assert_eq!((told.phase, told.sentence, told.by), ("done", "done", 5));
    assert!(drawn > 30 && needs.contains(&"views"), "{drawn} whole boards were drawn; {needs:?} were asked for");
    let outcome = told.outcome.expect("outcome");
    assert!(outcome.good, "{:?}", outcome.words);
    let truth = sweep.truth();
    for (value, expected) in outcome.values.iter().zip([truth.fx, truth.fy, truth.cx, truth.cy]) {
        let off = (value.value - expected) / value.sigma.expect("estimated");
        assert!(off.abs() < 4.0, "{value:?} is {off:.1} of its deviations off {expected}");
    }
    assert!((outcome.values[0].value / truth.fx - 1.0).abs() < 0.001, "{:?}", outcome.values[0]);
    let file = dir.path().join(&outcome.file_name);
    std::fs::write(&file, &outcome.file).expect("written");
    let read = CalibrationFile::load(&file).expect("what is downloaded is a calibration");
    assert!((read.camera.fx - outcome.values[0].value).abs() < 1e-6);

    let identity = CameraIdentity::parse("046d:0825:ABC").expect("identity");
    // What the daemon does with what is handed over.
    let keep = |text: &str| {
        std::fs::write(&file, text).map_err(|e| e.to_string())?;
        let kept = store::adopt(&[dir.path().to_path_buf()], &identity, Some((480, 360)), &file);
        std::fs::remove_file(&file).expect("removed");
        kept.map(|(path, _)| format!("kept as {}", path.display())).map_err(|e| e.to_string())
    };
    let said = session.obey(Action::Save {}, 6, sweep.now, &keep).expect("saved");
    let (found, faults) = store::find(&[dir.path().to_path_buf()], &identity, (480, 360));
    let found = found.unwrap_or_else(|| panic!("not found: {faults:?}"));
    assert!(said.contains(&found.path.display().to_string()), "{said}");
    assert_eq!(found.camera, read.camera);
    assert_eq!(session.told(sweep.now).saved, Some(said.as_str()));
}

#[test]
fn what_there_is_can_be_taken_once_it_is_a_camera_and_is_no_good_one() {
    let mut sweep = Sweep::new();
    let mut session = session();
    session.obey(Action::Start { board: board(9, 6, None) }, 1, sweep.now, &unasked).expect("started");
    let (picture, now) = sweep.next();
    session.look(picture);
    let error = session.obey(Action::Finish {}, 2, now, &unasked).expect_err("nothing to calibrate from");
    assert!(error.contains("too few"), "{error}");
    for _ in 0..400 {
        let (picture, now) = sweep.next();
        session.look(picture);
        if session.told(now).guidance.is_some_and(|guidance| guidance.solved) {
            break;
        }
    }
    session.obey(Action::Finish {}, 3, sweep.now, &unasked).expect("taken");
    let told = session.told(sweep.now);
    let outcome = told.outcome.expect("outcome");
    assert!(!outcome.good && outcome.words.iter().any(|w| w.starts_with("missing: ")), "{:?}", outcome.words);
    assert!(
        !told.guidance.expect("guidance").gauges.iter().any(|g| g.name == "distance"),
        "nobody said how long a square is"
    );
    let error = session.obey(Action::Save {}, 4, sweep.now, &unasked).expect_err("whose camera?");
    assert!(error.contains("download"), "{error}");
    session.obey(Action::Cancel {}, 5, sweep.now, &unasked).expect("put away");
    assert_eq!(session.told(sweep.now).phase, "idle");
}

#[test]
fn another_board_is_told_apart_and_impossible_ones_are_refused() {
    let mut sweep = Sweep::new();
    let mut session = session();
    for (asked, reason) in [
        (board(2, 6, None), "pattern 2x6"),
        (board(9, 31, None), "3 to 30"),
        (board(0, u32::MAX, None), "3 to 30"),
        (board(9, 6, Some(0.0)), "square 0 m"),
        (board(9, 6, Some(-0.025)), "square -0.025 m"),
        (board(9, 6, Some(f64::NAN)), "0.0001 and 10 m"),
    ] {
        let error =
            session.obey(Action::Start { board: asked.clone() }, 1, sweep.now, &unasked).expect_err("impossible");
        assert!(error.contains(reason), "{asked:?}: {error}");
        assert_eq!(session.told(sweep.now).phase, "idle");
    }
    session.obey(Action::Start { board: board(8, 5, None) }, 2, sweep.now, &unasked).expect("started");
    let (picture, now) = sweep.next();
    session.look(picture);
    let told = session.told(now);
    assert!(told.sentence.contains("9x6 inner corners is seen, 8x5 was asked for"), "{}", told.sentence);
    assert_eq!(told.glance.map(|g| (g.look, g.corners.len())), Some((Look::OtherBoard, 0)));
}
