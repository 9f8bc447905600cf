//! The daemon with real threads and a simulated camera, without the wire: how runs end, and that every frame is accounted for.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use super::*;
use crate::camera::simulator::{Scenario, Simulator, SimulatorConfig};
use crate::camera::{FrameSource, Grab, Pacing, SourceDescription, SourceError};
use crate::frame::Clock;
use crate::geometry::CameraModel;

mod threads;

/// What happens to a frame on its way.
type Edit = Box<dyn FnMut(&mut RawFrame) -> Result<Grab, SourceError> + Send>;

/// A simulator whose frames pass through somebody's hands.
struct Edited {
    simulator: Simulator,
    edit: Edit,
}

impl FrameSource for Edited {
    fn description(&self) -> &SourceDescription {
        self.simulator.description()
    }

    fn grab(&mut self, slot: &mut RawFrame, timeout: Duration) -> Result<Grab, SourceError> {
        match self.simulator.grab(slot, timeout)? {
            Grab::Frame => (self.edit)(slot),
            other => Ok(other),
        }
    }
}

/// A small, quick camera; `seconds` at 30 Hz.
fn parts(seconds: f64, pacing: Pacing, folder: &Path, edit: Edit) -> Parts {
    let mut simulation = SimulatorConfig::ideal(Scenario::HandHeld);
    (simulation.width, simulation.height, simulation.duration_s, simulation.texel_mm) = (320, 240, seconds, 8.0);
    let simulator = Simulator::new(&simulation, pacing).expect("simulator");
    let calibration = Calibration::known(simulator.camera_model().clone(), "simulator".into());
    let file = |name: &str| Some(folder.join(name));
    Parts {
        config: Config::default(),
        supply: Supply::Once(Box::new(Edited { simulator, edit })),
        calibration,
        outlet: None,
        outputs: Outputs {
            trajectory: file("trajectory.txt"),
            live_trajectory: file("live.txt"),
            odometry: file("odometry.txt"),
            map: file("map.ply"),
            overview: file("overview.png"),
        },
        spool_folder: None,
        keep_lens: None,
        map_file: None,
        maps: None,
        status: Arc::new(Status::default()),
    }
}

fn untouched() -> Edit {
    Box::new(|_| Ok(Grab::Frame))
}

/// Runs with threads for a minute at the most.
fn run(parts: Parts) -> End {
    let stop = AtomicBool::new(false);
    supervise(parts, None, Clock::Recording, &stop, &mut |tick| tick.elapsed < Duration::from_secs(60)).expect("starts")
}

#[test]
fn a_run_ends_with_its_source_and_every_frame_is_accounted_for() {
    let folder = tempfile::tempdir().expect("folder");
    // As fast as the simulator renders: the ring has to drop some, or not.
    let parts = parts(3.0, Pacing::LockStep, folder.path(), untouched());
    let status = parts.status.clone();
    let end = run(parts);
    assert_eq!(end.cause, EndCause::SourceEnded);
    assert_eq!(status.captured.get(), 90);
    assert_eq!(status.processed.get() + status.dropped.get(), 90);
    assert_eq!(end.written.failures, Vec::<String>::new());
    assert_eq!(end.written.files.len(), 5);
    assert_eq!(status.records_lost.get(), 0);
}

#[test]
fn a_stop_ends_an_endless_run_cleanly_and_writes_its_files() {
    let folder = tempfile::tempdir().expect("folder");
    let parts = parts(0.0, Pacing::RealTime, folder.path(), untouched());
    let (status, stop) = (parts.status.clone(), AtomicBool::new(false));
    let end = supervise(parts, None, Clock::Monotonic, &stop, &mut |tick| {
        if tick.status.processed.get() >= 20 {
            stop.store(true, Ordering::Relaxed);
        }
        tick.elapsed < Duration::from_secs(60)
    })
    .expect("starts");
    assert_eq!(end.cause, EndCause::Stopped);
    assert!(status.processed.get() >= 20);
    assert_eq!(end.written.files.len(), 5, "{:?}", end.written.failures);
}

#[test]
fn a_stage_that_panics_ends_the_run_and_is_named() {
    let folder = tempfile::tempdir().expect("folder");
    let mut frames = 0;
    let edit: Edit = Box::new(move |_| {
        frames += 1;
        assert!(frames < 5, "the source's own fault, on purpose");
        Ok(Grab::Frame)
    });
    let end = run(parts(3.0, Pacing::LockStep, folder.path(), edit));
    assert_eq!(end.cause, EndCause::Broken("the capture stage panicked".into()));
}

#[test]
fn a_stage_that_hangs_is_left_behind_when_the_run_is_stopped() {
    let folder = tempfile::tempdir().expect("folder");
    let edit: Edit = Box::new(|_| {
        thread::sleep(Duration::from_secs(3600));
        Ok(Grab::Frame)
    });
    let parts = parts(3.0, Pacing::LockStep, folder.path(), edit);
    let stop = AtomicBool::new(false);
    let begun = Duration::from_millis(500);
    let end = supervise(parts, None, Clock::Recording, &stop, &mut |tick| tick.elapsed < begun).expect("starts");
    assert_eq!(end.cause, EndCause::Broken("the capture stage hangs".into()));
    assert_eq!(end.written.files.len(), 5, "what is known is written all the same: {:?}", end.written.failures);
}

#[test]
fn a_source_that_breaks_ends_the_run_and_what_was_tracked_is_written() {
    let folder = tempfile::tempdir().expect("folder");
    let mut frames = 0;
    let edit: Edit = Box::new(move |_| {
        frames += 1;
        match frames {
            30 => Err(SourceError::Gone { path: "simulator".into(), reason: "unplugged".into() }),
            _ => Ok(Grab::Frame),
        }
    });
    let end = run(parts(3.0, Pacing::LockStep, folder.path(), edit));
    assert_eq!(end.cause, EndCause::SourceFailed);
    assert_eq!(end.written.files.len(), 5);
}

#[test]
fn a_calibration_of_another_aspect_ends_the_run_and_names_both_sizes() {
    let folder = tempfile::tempdir().expect("folder");
    let mut parts = parts(1.0, Pacing::LockStep, folder.path(), untouched());
    let m = parts.calibration.model.clone();
    parts.calibration.model =
        crate::geometry::CameraModel::new(640, 360, m.fx, m.fy, m.cx, m.cy, m.lens).expect("model");
    let End { cause, written, .. } = run(parts);
    let EndCause::Calibration(reason) = cause else { panic!("{cause:?}") };
    assert!(reason.contains("640x360") && reason.contains("320x240"), "{reason}");
    assert_eq!(written.files.len(), 0, "no file of a run without a camera");
}

#[test]
fn a_calibration_of_twice_the_resolution_is_scaled() {
    let folder = tempfile::tempdir().expect("folder");
    let parts = parts(1.0, Pacing::LockStep, folder.path(), untouched());
    let twice = parts.calibration.model.scaled(640, 480).expect("same aspect");
    let calibration = Calibration::known(twice, "file".into());
    let fitted = calibration.fit(320, 240).expect("fits");
    assert!((fitted.fx - parts.calibration.model.fx).abs() < 1e-9);
    assert!((fitted.cx - parts.calibration.model.cx).abs() < 1e-9);
}

/// Lock-step over two seconds in which some frames are spoiled.
fn lockstep_run(folder: &Path) -> (End, Arc<Status>) {
    let mut frames = 0;
    let edit: Edit = Box::new(move |slot| {
        frames += 1;
        match frames {
            // Cut off; of another size; a time that goes back.
            11 => slot.data.truncate(1000),
            22 => (slot.width, slot.height, slot.stride) = (160, 120, 160),
            33 => slot.timestamp_ns -= 100_000_000,
            44 => return Ok(Grab::Skipped { reason: "cannot be read".into() }),
            _ => {}
        }
        Ok(Grab::Frame)
    });
    let parts = parts(2.0, Pacing::LockStep, folder, edit);
    let status = parts.status.clone();
    let end = lockstep::run(parts, &AtomicBool::new(false), &mut |_| true).expect("starts");
    (end, status)
}

#[test]
fn lockstep_skips_what_is_spoiled_and_counts_it() {
    let folder = tempfile::tempdir().expect("folder");
    let (end, status) = lockstep_run(folder.path());
    assert_eq!(end.cause, EndCause::SourceEnded);
    let counts = [&status.corrupt, &status.wrong_size, &status.bad_timestamps, &status.unreadable].map(|c| c.get());
    assert_eq!(counts, [1, 1, 1, 1]);
    assert_eq!((status.captured.get(), status.processed.get()), (59, 56));
}

#[test]
fn lockstep_takes_the_wheels_of_its_source_in_order_and_drops_none() {
    let folder = tempfile::tempdir().expect("folder");
    let mut parts = parts(1.0, Pacing::LockStep, folder.path(), untouched());
    let mut simulation = SimulatorConfig::ideal(Scenario::Square);
    (simulation.width, simulation.height, simulation.duration_s, simulation.texel_mm) = (320, 240, 1.0, 8.0);
    simulation.wheels.enabled = true;
    parts.supply = Supply::Once(Box::new(Simulator::new(&simulation, Pacing::LockStep).expect("simulator")));
    let status = parts.status.clone();
    lockstep::run(parts, &AtomicBool::new(false), &mut |_| true).expect("starts");
    // 50 Hz up to the last frame at 0.967 s.
    let w = &status.wheels;
    let counts = [&w.received, &w.late, &w.dropped, &w.gaps, &w.missing].map(|counter| counter.get());
    assert_eq!((counts, w.refused()), ([49, 0, 0, 0, 0], 0));
}

#[test]
fn a_lockstep_run_can_be_stopped() {
    let folder = tempfile::tempdir().expect("folder");
    let parts = parts(2.0, Pacing::LockStep, folder.path(), untouched());
    let end = lockstep::run(parts, &AtomicBool::new(false), &mut |status| status.captured.get() < 5).expect("starts");
    assert_eq!(end.cause, EndCause::Stopped);
}

/// Every second pixel of every second row.
fn halve(slot: &mut RawFrame) {
    let (w, h, stride) = (slot.width as usize, slot.height as usize, slot.stride as usize);
    slot.data = (0..h / 2)
        .flat_map(|y| (0..w / 2).map(move |x| (x, y)))
        .map(|(x, y)| slot.data[2 * y * stride + 2 * x])
        .collect();
    (slot.width, slot.height, slot.stride) = (slot.width / 2, slot.height / 2, slot.width / 2);
}

/// These frames, counted from one, come in half the size.
fn halving(which: std::ops::RangeInclusive<u32>) -> Edit {
    let mut frames = 0;
    Box::new(move |slot| {
        frames += 1;
        if which.contains(&frames) {
            halve(slot);
        }
        Ok(Grab::Frame)
    })
}

#[test]
fn a_camera_that_comes_back_with_another_size_begins_a_new_map_with_its_calibration_scaled() {
    let folder = tempfile::tempdir().expect("folder");
    let parts = parts(3.0, Pacing::LockStep, folder.path(), halving(31..=60));
    let (status, fx) = (parts.status.clone(), parts.calibration.model.fx);
    let mut lenses = Vec::new();
    let end = lockstep::run(parts, &AtomicBool::new(false), &mut |status| {
        let (_, [fx, ..]) = status.lens();
        if !fx.is_nan() && lenses.last().is_none_or(|last: &f32| (last / fx - 1.0).abs() > 0.3) {
            lenses.push(fx);
        }
        true
    })
    .expect("starts");
    assert_eq!(end.cause, EndCause::SourceEnded);
    assert_eq!((status.wrong_size.get(), status.processed.get()), (10, 80), "five are waited for each time");
    let relative: Vec<f64> = lenses.iter().map(|l| f64::from(*l) / fx).collect();
    assert!(
        relative.len() == 3 && (relative[1] - 0.5).abs() < 0.05 && (relative[2] - 1.0).abs() < 0.05,
        "{relative:?}"
    );
    let (map, resets) = status.map_and_resets();
    assert!(map == resets && resets >= 2, "map {map}, {resets} resets");
}

#[test]
fn a_size_that_the_calibration_is_not_for_is_told_and_the_map_goes_on_when_it_is_right_again() {
    let folder = tempfile::tempdir().expect("folder");
    let mut frames = 0;
    let edit: Edit = Box::new(move |slot| {
        frames += 1;
        if (46..=60).contains(&frames) {
            slot.data.truncate(320 * 180);
            slot.height = 180;
        }
        Ok(Grab::Frame)
    });
    let parts = parts(3.0, Pacing::LockStep, folder.path(), edit);
    let status = parts.status.clone();
    let mut refused: Vec<(bool, u64)> = Vec::new();
    let end = lockstep::run(parts, &AtomicBool::new(false), &mut |status| {
        if refused.last().is_none_or(|(last, _)| *last != status.calibration_refused()) {
            refused.push((status.calibration_refused(), status.captured.get()));
        }
        true
    })
    .expect("starts");
    assert_eq!(end.cause, EndCause::SourceEnded, "a camera may come back as it was");
    assert_eq!(refused, [(false, 0), (true, 51), (false, 66)], "five are waited for each time");
    assert_eq!((status.wrong_size.get(), status.processed.get()), (20, 70));
    assert_eq!(status.map_and_resets(), (0, 0));
}

#[test]
fn a_map_that_is_only_located_in_keeps_its_camera_when_another_size_comes() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("a.map");
    let plan = |saved, localise_only| {
        Some(MapPlan { path: path.clone(), file: None, saved, edition: None, localise_only, may_fail: false })
    };
    let go = |parts: Parts| lockstep::run(parts, &AtomicBool::new(false), &mut |_| true).expect("starts");
    go(Parts { map_file: plan(None, false), ..parts(3.0, Pacing::LockStep, folder.path(), untouched()) });
    let saved = crate::places::store::read(&path).expect("a map").saved;
    let localised = parts(3.0, Pacing::LockStep, folder.path(), halving(46..=60));
    let status = localised.status.clone();
    let end = go(Parts { map_file: plan(Some(saved), true), ..localised });
    assert_eq!(end.cause, EndCause::SourceEnded);
    assert_eq!((status.wrong_size.get(), status.processed.get()), (20, 70), "waited for until the right size is there");
    assert!(status.tracked.get() > 60, "{} of 70 frames located", status.tracked.get());
}

#[test]
fn a_calibration_that_is_kept_while_it_runs_comes_into_use_with_the_next_map() {
    let folder = tempfile::tempdir().expect("folder");
    let Parts { config, supply, calibration: known, outputs, status, .. } =
        parts(3.0, Pacing::LockStep, folder.path(), untouched());
    let Supply::Once(mut source) = supply else { panic!("a simulator") };
    let guessed = Calibration::guessed((320, 240), 90.0).expect("camera");
    let recorder = Recorder::new(&outputs, None, status.clone()).expect("recorder");
    let mut step = ReconstructStep::new(
        &config.reconstruction,
        guessed,
        Box::new(crate::reconstruction::InlineWorker::default()),
        true,
        None,
        RecorderLink::Inline(recorder),
        status.clone(),
    );
    let mut feature = FeatureStep::new(&config.features, status.clone());
    let (mut slot, mut features, mut feedback) = (RawFrame::default(), FrameFeatures::default(), Feedback::default());
    let mut turn = |step: &mut ReconstructStep| {
        assert_eq!(source.grab(&mut slot, TURN).expect("frame"), Grab::Frame);
        assert!(feature.step(&slot, &mut features));
        step.step(&features, monotonic_ns(), &mut feedback).expect("placed or not");
        feature.feedback(&feedback);
        let (knowledge, [fx, ..]) = status.lens();
        (knowledge == crate::reconstruction::LensKnowledge::Calibrated, fx, status.map_and_resets().1)
    };
    let (_, guessed_fx, _) = turn(&mut step);
    let (fx, reset) = (known.model.fx as f32, || Request::Reset { why: "a test" });
    // One of pictures that this camera does not send is put off for good, as it came for others.
    let CameraModel { fx: x, fy: y, cx, lens, .. } = known.model.clone();
    let wide = CameraModel::new(320, 180, x, y, cx, 90.0, lens).expect("camera");
    step.request(Request::Calibrated(Box::new(Calibration::known(wide, "another shape".into()))));
    step.request(reset());
    assert_eq!(turn(&mut step), (false, guessed_fx, 1));
    step.request(Request::Calibrated(Box::new(known)));
    assert_eq!(turn(&mut step), (false, guessed_fx, 1), "a map rests on the lens that it began with");
    step.request(reset());
    assert_eq!(turn(&mut step), (true, fx, 2));
    step.request(reset());
    assert_eq!(turn(&mut step), (true, fx, 3), "it stays");
    assert!(fx != guessed_fx && status.tracked.get() <= status.processed.get());
}

/// The faults that a supervisor would publish, looked at by its own eyes.
fn faults(status: &Arc<Status>) -> impl FnMut() -> u64 + use<> {
    let mut watch =
        health::HealthWatch::new(status.clone(), Clock::Monotonic, Duration::from_millis(500), monotonic_ns());
    move || watch.tick(monotonic_ns()).errors
}

#[test]
fn a_camera_whose_opening_hangs_is_an_absent_camera_and_no_stalled_stage_and_a_stop_does_not_wait_for_it() {
    let folder = tempfile::tempdir().expect("folder");
    let mut parts = parts(3.0, Pacing::RealTime, folder.path(), untouched());
    let open: Opener = Box::new(|| {
        thread::sleep(Duration::from_secs(3600));
        Err(SourceError::Open { path: "camera".into(), reason: "never".into() })
    });
    parts.supply = Supply::Camera { open, longest_pause: Duration::from_millis(100) };
    let (status, stop) = (parts.status.clone(), AtomicBool::new(false));
    let mut faults = faults(&status);
    // Turns of the stage: it lives, whatever the camera does.
    let (mut beats, mut last) = (0, 0);
    let end = supervise(parts, None, Clock::Monotonic, &stop, &mut |tick| {
        let now = monotonic_ns();
        let at = now - tick.status.capture.age_ns(now).unwrap_or(0);
        beats += u32::from(at > last + 50_000_000);
        last = last.max(at);
        let faults = faults();
        assert!(beats < 2 || faults & crate::messages::error::NO_CAMERA != 0, "{faults:#x}");
        beats < 12 && tick.elapsed < Duration::from_secs(60)
    })
    .expect("starts");
    assert_eq!(end.cause, EndCause::Stopped);
    assert!(beats >= 12, "the capture stage turned {beats} times");
}

#[test]
fn a_capture_stage_that_hangs_in_its_camera_is_a_stalled_stage() {
    let folder = tempfile::tempdir().expect("folder");
    let (hold, held) = crossbeam::channel::bounded::<()>(1);
    let mut frames = 0;
    let edit: Edit = Box::new(move |_| {
        frames += 1;
        if frames == 3 {
            let _ = held.recv();
        }
        Ok(Grab::Frame)
    });
    let parts = parts(3.0, Pacing::RealTime, folder.path(), edit);
    let (status, stop) = (parts.status.clone(), AtomicBool::new(false));
    let mut faults = faults(&status);
    let mut found = false;
    let mut hold = Some(hold);
    supervise(parts, None, Clock::Monotonic, &stop, &mut |tick| {
        found |= faults() & crate::messages::error::STALLED_STAGE != 0;
        if found {
            hold = None;
        }
        !found && tick.elapsed < Duration::from_secs(60)
    })
    .expect("starts");
    assert!(found);
}
