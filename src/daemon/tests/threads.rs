//! Threads that fail while others go on, and those that take long to end: what is known is written all the same.

use super::super::supervisor::{GIVE_UP, Run, attend};
use super::*;

/// An endless run whose threads `change` is done to, until `go_on` says no; a minute at the most.
fn attended(change: impl FnOnce(&mut Threads), mut go_on: impl FnMut(&Tick<'_>) -> bool) -> (End, tempfile::TempDir) {
    let folder = tempfile::tempdir().expect("folder");
    let parts = parts(0.0, Pacing::RealTime, folder.path(), untouched());
    let run = Run::of(&parts, Clock::Monotonic);
    let mut threads = start(parts).expect("threads");
    change(&mut threads);
    let end = attend(threads, &run, None, &AtomicBool::new(false), &mut |tick| {
        go_on(tick) && tick.elapsed < Duration::from_secs(60)
    });
    (end, folder)
}

/// Reconstruction ends, and this is what its thread does then.
fn and_then(threads: &mut Threads, last: impl FnOnce() + Send + 'static) {
    let idle = spawn("idle", || Err(String::new())).expect("thread");
    let own = std::mem::replace(&mut threads.reconstruction, idle);
    let ends = move || {
        let map = own.join().expect("ends");
        last();
        map
    };
    threads.reconstruction = spawn("reconstruction", ends).expect("thread");
}

#[test]
fn a_mapping_thread_that_panics_ends_the_run_as_broken_and_its_files_are_written() {
    let (hold, held) = bounded::<()>(1);
    let mut hold = Some(hold);
    let fault = move || {
        let _ = held.recv();
        panic!("on purpose");
    };
    let change = |threads: &mut Threads| threads.mapping = spawn("mapping", fault).expect("thread");
    let mut after = 0;
    let (end, _folder) = attended(change, |tick| {
        if tick.status.processed.get() >= 20 {
            (hold, after) = (None, after + 1);
        }
        after < 100
    });
    assert_eq!(end.cause, EndCause::Broken("the mapping stage panicked".into()));
    assert_eq!(end.written.files.len(), 5, "{:?}", end.written.failures);
}

#[test]
fn a_last_word_that_takes_long_is_waited_for_and_written() {
    let late = GIVE_UP + Duration::from_millis(500);
    let change = |threads: &mut Threads| and_then(threads, move || thread::sleep(late));
    let (end, _folder) = attended(change, |tick| tick.status.processed.get() < 20);
    assert_eq!(end.cause, EndCause::Stopped);
    assert_eq!(end.written.files.len(), 5, "{:?}", end.written.failures);
}

#[test]
fn what_needs_no_map_is_written_when_reconstruction_panics() {
    let change = |threads: &mut Threads| and_then(threads, || panic!("on purpose"));
    let (end, folder) = attended(change, |tick| tick.status.processed.get() < 20);
    assert_eq!(end.cause, EndCause::Broken("the reconstruction stage panicked".into()));
    assert_eq!(end.written.files, ["live.txt", "odometry.txt"].map(|name| folder.path().join(name)));
}

#[test]
fn a_time_that_goes_back_ends_the_map_before_its_first_frame() {
    let folder = tempfile::tempdir().expect("folder");
    let Parts { config, supply, calibration, outputs, status, .. } =
        parts(3.0, Pacing::LockStep, folder.path(), untouched());
    let Supply::Once(mut source) = supply else { panic!("a simulator") };
    let recorder = Recorder::new(&outputs, None, status.clone()).expect("recorder");
    let worker = Box::new(crate::reconstruction::InlineWorker::default());
    let link = RecorderLink::Inline(recorder);
    let mut step = ReconstructStep::new(&config.reconstruction, calibration, worker, true, None, link, status.clone());
    let mut feature = FeatureStep::new(&config.features, status.clone());
    let (mut slot, mut features, mut feedback) = (RawFrame::default(), FrameFeatures::default(), Feedback::default());
    let resets = [1000, 1033, 1066, 500, 533, 566].map(|ms| {
        assert_eq!(source.grab(&mut slot, TURN).expect("frame"), Grab::Frame);
        slot.timestamp_ns = ms * 1_000_000;
        assert!(feature.step(&slot, &mut features));
        step.step(&features, monotonic_ns(), &mut feedback).expect("placed or not");
        feature.feedback(&feedback);
        status.map_and_resets().1
    });
    assert_eq!(resets, [0, 0, 0, 1, 1, 1]);
}
