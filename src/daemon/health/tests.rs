use super::*;
use crate::reconstruction::PoseEstimate;

const MS: i64 = 1_000_000;

fn watch() -> (Arc<Status>, HealthWatch) {
    let status = Arc::new(Status::default());
    status.set_source_present(true);
    let watch = HealthWatch::new(status.clone(), Clock::Monotonic, Duration::from_secs(1), 0);
    (status, watch)
}

#[test]
fn health_says_which_lens_model_focal_length_and_principal_point_are_of() {
    use crate::geometry::{CameraModel, LensModel};
    use crate::reconstruction::LensEstimate;
    let (status, mut watch) = watch();
    for (lens, wire) in [
        (LensModel::KannalaBrandt([0.01, 0.0, 0.0, 0.0]), crate::messages::LENS_KANNALA_BRANDT),
        (LensModel::PINHOLE, crate::messages::LENS_RADIAL_TANGENTIAL),
    ] {
        let camera = CameraModel::new(640, 480, 300.0, 301.0, 320.0, 240.0, lens).expect("valid");
        let knowledge = LensKnowledge::Calibrated;
        status.set_lens(&LensEstimate { knowledge, camera, focal_sigma: 0.002, centre_sigma_px: [0.1, 0.2] });
        let health = watch.tick(MS);
        assert_eq!((health.lens_model, health.focal_px), (wire, [300.0, 301.0]));
    }
}

#[test]
fn a_dropped_frame_stands_for_one_second_and_no_longer() {
    let (status, mut watch) = watch();
    status.set_last_arrival_ns(3_000 * MS);
    status.dropped.add(3);
    assert_eq!(watch.tick(900 * MS).errors & error::DROPPED_FRAMES, 0);
    assert_eq!(watch.tick(1000 * MS).errors, error::DROPPED_FRAMES);
    assert_eq!(watch.tick(1900 * MS).errors, error::DROPPED_FRAMES);
    assert_eq!(watch.tick(2000 * MS).errors, 0);
    assert_eq!(watch.tick(2000 * MS).frames_dropped, 3);
}

#[test]
fn the_record_is_at_info_when_something_changed_and_once_a_minute_and_not_every_second() {
    let (_, mut watch) = watch();
    let mut told = Vec::new();
    for second in 1..=150 {
        // Faults from 20 s to 30 s, and one that comes and goes from 100 s on.
        let standing = (20..30).contains(&second) || (second >= 100 && second % 2 == 0);
        let faults = if standing { error::LOST } else { 0 };
        if watch.is_news(faults, second * SECOND_NS) {
            told.push(second);
        }
    }
    assert_eq!(told, [1, 20, 30, 90, 100, 111, 122, 133, 144]);
}

#[test]
fn a_camera_at_half_rate_and_one_that_loses_frames_are_told() {
    let (status, mut watch) = watch();
    status.set_nominal_rate_hz(30.0);
    let mut second = |n: i64, frames: u64, missed: u64| {
        status.captured.add(frames);
        status.missed.add(missed);
        status.set_last_arrival_ns(n * 1000 * MS);
        watch.tick(n * 1000 * MS).errors
    };
    assert_eq!(second(1, 10, 0), 0, "it may have come in the middle of the second");
    assert_eq!(second(2, 29, 0), 0);
    assert_eq!(second(3, 15, 0), error::LOW_RATE);
    assert_eq!(second(4, 24, 6), error::DROPPED_FRAMES);
    assert_eq!(second(5, 30, 0), 0);
}

#[test]
fn a_source_that_falls_silent_is_told_from_one_that_is_gone() {
    let (status, mut watch) = watch();
    status.set_last_arrival_ns(100 * MS);
    assert_eq!(watch.tick(500 * MS).errors, 0);
    assert_eq!(watch.tick(2500 * MS).errors, error::NO_FRAMES);
    assert_eq!(watch.tick(2500 * MS).frame_age_ns, 2400 * MS);
    status.set_source_present(false);
    assert_eq!(watch.tick(2600 * MS).errors, error::NO_CAMERA);
}

#[test]
fn a_stage_that_hangs_is_named_and_counted_from_its_last_beat() {
    let (status, mut watch) = watch();
    status.features.beat(1000 * MS);
    status.reconstruction.beat(1000 * MS);
    status.set_last_arrival_ns(3000 * MS);
    assert!(watch.all_alive(1900 * MS));
    status.reconstruction.beat(2400 * MS);
    let health = watch.tick(2500 * MS);
    assert!(!watch.all_alive(2500 * MS));
    assert_eq!(health.errors, error::STALLED_STAGE);
    assert_eq!(health.stages[stage::FEATURES].heartbeat_age_ns, 1500 * MS);
    assert_eq!(health.stages[stage::TRACKING].heartbeat_age_ns, 100 * MS);
    assert_eq!(health.stages[stage::CAPTURE].heartbeat_age_ns, UNKNOWN_NS);
    status.features.rest();
    assert_eq!(watch.tick(2600 * MS).errors, 0);
}

#[test]
fn rates_and_percentiles_are_those_of_the_last_second() {
    let (status, mut watch) = watch();
    for _ in 0..30 {
        status.processed.add(1);
        status.track.record(Duration::from_millis(4));
    }
    watch.tick(1000 * MS);
    let tracking = watch.tick(1100 * MS).stages[stage::TRACKING];
    assert_eq!((tracking.steps, tracking.rate_hz), (30, 30.0));
    assert!((tracking.p99_ms - 4.0).abs() < 0.13, "{tracking:?}");
    watch.tick(2000 * MS);
    let tracking = watch.tick(2000 * MS).stages[stage::TRACKING];
    assert_eq!((tracking.steps, tracking.rate_hz), (30, 0.0));
    assert!(tracking.p50_ms.is_nan());
}

#[test]
fn a_driver_that_dies_lies_or_is_late_is_told_each_by_its_fault() {
    let (status, mut watch) = watch();
    let (wheels, wire) = (status.wheels.clone(), error::WHEELS_SILENT | error::WHEELS_WRONG | error::WHEELS_LATE);
    let mut at = |ms: i64, heard: bool| {
        status.set_last_arrival_ns(ms * MS);
        if heard {
            status.set_wheels_heard_ns(ms * MS);
        }
        let health = watch.tick(ms * MS);
        (health.errors & wire, [health.wheel_messages, health.wheel_refused, health.wheel_missing, health.wheel_late])
    };
    assert_eq!(at(1000, false), (0, [0; 4]), "without a driver there is nothing to say");
    wheels.received.add(50);
    wheels.late.add(20);
    assert_eq!(at(2000, true), (0, [50, 0, 0, 20]), "late now and then is no fault");
    wheels.received.add(50);
    wheels.late.add(30);
    wheels.refuse(&crate::motion::wheel::WheelFault::SecondPublisher);
    assert_eq!(at(3000, true), (error::WHEELS_LATE | error::WHEELS_WRONG, [100, 1, 0, 50]));
    wheels.missing.add(1);
    assert_eq!(at(4000, true).0, error::WHEELS_LATE);
    assert_eq!(at(4999, false).0, error::WHEELS_LATE);
    assert_eq!(at(5001, false).0, error::WHEELS_SILENT);
    assert_eq!(at(6001, true).0, 0);
}

#[test]
fn a_map_that_cannot_be_stored_is_a_fault_for_as_long_as_it_cannot() {
    let (status, mut watch) = watch();
    for is_not in [false, true, false] {
        status.set_map_not_stored(is_not);
        assert_eq!(watch.tick(MS).errors & error::SAVE_FAILED != 0, is_not);
    }
}

#[test]
fn a_robot_whose_pictures_cannot_be_used_is_placed_by_nothing() {
    let (status, mut watch) = watch();
    for (state, then) in [
        (TrackingState::Tracking, TrackingState::Lost),
        (TrackingState::DeadReckoning, TrackingState::Lost),
        (TrackingState::Orientation, TrackingState::Initializing),
    ] {
        status.set_frame(&PoseEstimate { state, arrival_ns: 1000 * MS, ..PoseEstimate::default() }, 0);
        // Pictures go on coming, and none of them can be decoded.
        status.set_last_arrival_ns(3500 * MS);
        assert_eq!(watch.tick(1500 * MS).state, convert::state(state));
        assert_eq!(watch.tick(3500 * MS).state, convert::state(then), "{state:?}");
    }
}
