//! The logic of a camera without one: a queue that gives what a script says, and offers as cameras list them.

use super::capture::{BufferQueue, Filled, QueueError};
use super::negotiate::{Interval, Rates, nearest_step};
use super::*;
use crate::frame::monotonic_ns;
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use std::collections::VecDeque;

/// What the fake driver does next.
enum Next {
    /// Fills a buffer.
    Fill(Filled, Vec<u8>),
    Nothing,
    Fail(QueueError),
}

/// Two buffers, filled as scripted. Panics when a buffer is read or given back that is not out, as a driver would err.
struct FakeQueue {
    script: VecDeque<Next>,
    buffers: [Vec<u8>; 2],
    out: Vec<u32>,
    requeue_fails: bool,
}

impl BufferQueue for FakeQueue {
    fn dequeue(&mut self, _timeout: Duration) -> Result<Option<Filled>, QueueError> {
        match self.script.pop_front() {
            None | Some(Next::Nothing) => Ok(None),
            Some(Next::Fail(e)) => Err(e),
            Some(Next::Fill(filled, bytes)) => {
                assert!(!self.out.contains(&filled.index), "buffer {} is out already", filled.index);
                self.buffers[filled.index as usize] = bytes;
                self.out.push(filled.index);
                Ok(Some(filled))
            }
        }
    }

    fn bytes(&self, index: u32) -> &[u8] {
        assert!(self.out.contains(&index), "buffer {index} is the driver's");
        &self.buffers[index as usize]
    }

    fn requeue(&mut self, index: u32) -> Result<(), QueueError> {
        let at = self.out.iter().position(|i| *i == index).expect("given back once");
        self.out.remove(at);
        if self.requeue_fails { Err(QueueError::Gone("QBUF: No such device".into())) } else { Ok(()) }
    }
}

const YUYV_4X2: Layout = Layout { format: PixelFormat::Yuyv, width: 4, height: 2, stride: 10 };
const MJPEG: Layout = Layout { format: PixelFormat::Jpeg, width: 640, height: 480, stride: 0 };
const NO_WAIT: Duration = Duration::ZERO;

fn capture(layout: Layout, script: Vec<Next>) -> Capture<FakeQueue> {
    let queue = FakeQueue { script: script.into(), buffers: [vec![], vec![]], out: vec![], requeue_fails: false };
    Capture::new(queue, layout, "/dev/video9".into())
}

/// A good YUYV frame of 4x2 with luma `first`, `first + 1`, ... and rows of 10 bytes.
fn yuyv(sequence: u32, timestamp_ns: i64, first: u8) -> Next {
    let bytes: Vec<u8> =
        (0..20u8).map(|i| if i % 10 < 8 && i % 2 == 0 { first + (i / 10) * 4 + i % 10 / 2 } else { 0x80 }).collect();
    let filled =
        Filled { index: sequence % 2, bytes_used: 20, sequence, timestamp_ns: Some(timestamp_ns), corrupt: false };
    Next::Fill(filled, bytes)
}

fn jpeg(sequence: u32, bytes: &[u8], bytes_used: usize) -> Next {
    let now = monotonic_ns() + i64::from(sequence);
    let filled = Filled { index: sequence % 2, bytes_used, sequence, timestamp_ns: Some(now), corrupt: false };
    Next::Fill(filled, bytes.to_vec())
}

fn grab(capture: &mut Capture<FakeQueue>, slot: &mut RawFrame) -> Grab {
    capture.grab(slot, NO_WAIT).expect("still there")
}

fn skipped(grab: Grab) -> String {
    match grab {
        Grab::Skipped { reason } => reason,
        other => panic!("{other:?} is not skipped"),
    }
}

#[test]
fn yuyv_becomes_grey_in_the_slot_with_the_drivers_time() {
    let now = monotonic_ns();
    let mut camera = capture(YUYV_4X2, vec![yuyv(7, now, 10), yuyv(8, now + 33_000_000, 50)]);
    let mut slot = RawFrame::default();
    assert_eq!(grab(&mut camera, &mut slot), Grab::Frame);
    assert_eq!((slot.format, slot.width, slot.height, slot.stride), (PixelFormat::Grey, 4, 2, 4));
    assert_eq!(slot.data, [10, 11, 12, 13, 14, 15, 16, 17]);
    assert_eq!((slot.sequence, slot.timestamp_ns), (0, now));
    assert!(slot.arrival_ns >= now);
    let buffer = slot.data.as_ptr();
    assert_eq!(grab(&mut camera, &mut slot), Grab::Frame);
    // Ahead of now, as vivid's are: kept.
    assert_eq!((slot.sequence, slot.timestamp_ns, slot.data[0]), (1, now + 33_000_000, 50));
    assert_eq!(slot.data.as_ptr(), buffer, "the slot's buffer is used again");
}

#[test]
fn a_jpegs_bytes_are_copied_as_far_as_they_are_used() {
    let picture = [0xff, 0xd8, 0xff, 0xe0, 1, 2, 3, 0, 0, 0];
    let mut camera = capture(MJPEG, vec![jpeg(0, &picture, 7), jpeg(1, &[0; 10], 10)]);
    let mut slot = RawFrame::default();
    assert_eq!(grab(&mut camera, &mut slot), Grab::Frame);
    assert_eq!((slot.format, slot.width, &slot.data[..]), (PixelFormat::Jpeg, 0, &picture[..7]));
    assert!(skipped(grab(&mut camera, &mut slot)).contains("10 bytes that are no JPEG"));
}

#[test]
fn a_timeout_leaves_the_slot_alone() {
    let mut camera = capture(YUYV_4X2, vec![Next::Nothing, yuyv(0, monotonic_ns(), 1)]);
    let mut slot = RawFrame { data: vec![9; 3], ..RawFrame::default() };
    assert_eq!(grab(&mut camera, &mut slot), Grab::TimedOut);
    assert_eq!(slot.data, [9; 3]);
    assert_eq!(grab(&mut camera, &mut slot), Grab::Frame);
    assert_eq!(grab(&mut camera, &mut slot), Grab::TimedOut);
}

#[test]
fn broken_empty_short_and_impossible_buffers_are_skipped_and_given_back() {
    let now = monotonic_ns();
    let with = |sequence: u32, bytes_used: usize, corrupt: bool, length: usize| {
        let index = sequence % 2;
        Next::Fill(
            Filled { index, bytes_used, sequence, timestamp_ns: Some(now + i64::from(sequence)), corrupt },
            vec![1; length],
        )
    };
    let script = vec![
        with(0, 20, true, 20),
        with(1, 0, false, 20),
        with(2, 17, false, 20),
        with(3, 21, false, 20),
        yuyv(4, now + 4, 30),
    ];
    let mut camera = capture(YUYV_4X2, script);
    let mut slot = RawFrame::default();
    for expected in [
        "frame 0: the driver says that its data is broken",
        "is empty",
        "17 bytes are too few",
        "21 bytes of a buffer that has 20",
    ] {
        let reason = skipped(grab(&mut camera, &mut slot));
        assert!(reason.contains(expected), "{reason}");
    }
    assert_eq!(grab(&mut camera, &mut slot), Grab::Frame);
    assert_eq!((slot.sequence, slot.data[0]), (4, 30));
}

#[test]
fn lost_frames_show_as_gaps_also_when_the_number_wraps() {
    let now = monotonic_ns();
    let numbers = [u32::MAX - 1, u32::MAX, 0, 5, 5, 5, 900_000, 2, 3];
    // Gap of 4 counted; a number that stands still, leaps or goes back is a driver that does not count.
    let expected = [0, 1, 2, 7, 8, 9, 10, 11, 12];
    let script = numbers
        .iter()
        .enumerate()
        .map(|(i, n)| {
            let Next::Fill(filled, bytes) = yuyv(i as u32, now + i as i64, 1) else { unreachable!() };
            Next::Fill(Filled { sequence: *n, ..filled }, bytes)
        })
        .collect();
    let mut camera = capture(YUYV_4X2, script);
    let mut slot = RawFrame::default();
    for number in expected {
        assert_eq!((grab(&mut camera, &mut slot), slot.sequence), (Grab::Frame, number));
    }
}

#[test]
fn timestamps_of_another_clock_give_way_to_the_arrival() {
    let now = monotonic_ns();
    for wrong in [
        None,
        Some(0),
        Some(-5),
        Some(now + 10_000_000_000),
        Some(now - 3_600_000_000_000),
        Some(i64::MIN),
        Some(i64::MAX),
    ] {
        let Next::Fill(filled, bytes) = yuyv(0, 0, 1) else { unreachable!() };
        let mut camera = capture(YUYV_4X2, vec![Next::Fill(Filled { timestamp_ns: wrong, ..filled }, bytes)]);
        let mut slot = RawFrame::default();
        assert_eq!(grab(&mut camera, &mut slot), Grab::Frame);
        assert_eq!(slot.timestamp_ns, slot.arrival_ns, "{wrong:?}");
    }
    // A process that was stopped for five seconds finds frames that are five seconds old.
    let mut camera = capture(YUYV_4X2, vec![yuyv(0, now - 5_000_000_000, 1)]);
    let mut slot = RawFrame::default();
    assert_eq!(grab(&mut camera, &mut slot), Grab::Frame);
    assert_eq!(slot.timestamp_ns, now - 5_000_000_000);
}

#[test]
fn a_timestamp_that_does_not_advance_is_skipped() {
    let now = monotonic_ns();
    let mut camera =
        capture(YUYV_4X2, vec![yuyv(0, now, 1), yuyv(1, now, 1), yuyv(2, now - 1, 1), yuyv(3, now + 1, 1)]);
    let mut slot = RawFrame::default();
    assert_eq!(grab(&mut camera, &mut slot), Grab::Frame);
    assert!(skipped(grab(&mut camera, &mut slot)).contains("does not advance"));
    assert!(skipped(grab(&mut camera, &mut slot)).contains("does not advance"));
    assert_eq!((grab(&mut camera, &mut slot), slot.sequence), (Grab::Frame, 3));
}

fn gone(result: Result<Grab, SourceError>) -> String {
    match result {
        Err(SourceError::Gone { path, reason }) => {
            assert_eq!(path, "/dev/video9");
            reason
        }
        other => panic!("{other:?} is not gone"),
    }
}

#[test]
fn an_unplugged_camera_is_gone_and_stays_gone() {
    let unplugged = Next::Fail(QueueError::Gone("it was unplugged".into()));
    let mut camera = capture(YUYV_4X2, vec![unplugged, yuyv(0, monotonic_ns(), 1)]);
    let mut slot = RawFrame::default();
    for _ in 0..3 {
        assert_eq!(gone(camera.grab(&mut slot, NO_WAIT)), "it was unplugged");
    }
}

#[test]
fn a_camera_that_goes_while_a_buffer_is_given_back_still_hands_over_the_frame() {
    let now = monotonic_ns();
    let queue = FakeQueue {
        script: vec![yuyv(0, now, 1), yuyv(1, now + 1, 1)].into(),
        buffers: [vec![], vec![]],
        out: vec![],
        requeue_fails: true,
    };
    let mut camera = Capture::new(queue, YUYV_4X2, "/dev/video9".into());
    let mut slot = RawFrame::default();
    assert_eq!(grab(&mut camera, &mut slot), Grab::Frame);
    assert!(gone(camera.grab(&mut slot, NO_WAIT)).contains("No such device"));
}

#[test]
fn passing_errors_are_skipped_but_lasting_ones_mean_that_it_is_gone() {
    let now = monotonic_ns();
    let trouble = || Next::Fail(QueueError::Trouble("DQBUF: Input/output error".into()));
    let mut script: Vec<Next> = (0..29).map(|_| trouble()).collect();
    script.push(yuyv(0, now, 1));
    script.extend((0..30).map(|_| trouble()));
    let mut camera = capture(YUYV_4X2, script);
    let mut slot = RawFrame::default();
    for _ in 0..29 {
        assert!(skipped(grab(&mut camera, &mut slot)).contains("Input/output"));
    }
    assert_eq!(grab(&mut camera, &mut slot), Grab::Frame);
    for _ in 0..29 {
        skipped(grab(&mut camera, &mut slot));
    }
    assert!(gone(camera.grab(&mut slot, NO_WAIT)).contains("30 errors in a row, the last: DQBUF"));
}

fn offer(format: CameraFormat, width: u32, height: u32, rates: &[u32]) -> Offer {
    let intervals = rates.iter().map(|r| Interval { numerator: 1, denominator: *r }).collect();
    Offer { format, width, height, rates: Rates::Listed(intervals) }
}

/// What a common USB 2 webcam lists.
fn webcam() -> Vec<Offer> {
    use CameraFormat::{Mjpeg, Yuyv};
    vec![
        offer(Yuyv, 640, 480, &[30, 24, 15]),
        offer(Yuyv, 320, 240, &[30]),
        offer(Yuyv, 1280, 720, &[10, 5]),
        offer(Yuyv, 1920, 1080, &[5]),
        offer(Yuyv, 2304, 1536, &[2]),
        offer(Mjpeg, 640, 480, &[30, 15]),
        offer(Mjpeg, 1280, 720, &[60, 30]),
        offer(Mjpeg, 1920, 1080, &[30]),
    ]
}

fn asked(width_px: u32, height_px: u32, rate_hz: f64) -> V4l2Config {
    V4l2Config { width_px, height_px, rate_hz, ..V4l2Config::default() }
}

fn first(offers: &[Offer], config: &V4l2Config) -> (CameraFormat, u32, u32, f64) {
    let c = ranked(offers, config)[0];
    (c.format, c.width, c.height, c.rate_hz)
}

#[test]
fn uncompressed_is_chosen_where_the_bandwidth_lets_it_reach_the_rate() {
    use CameraFormat::{Grey, Mjpeg, Yuyv};
    assert_eq!(first(&webcam(), &asked(640, 480, 30.0)), (Yuyv, 640, 480, 30.0));
    assert_eq!(first(&webcam(), &asked(1280, 720, 30.0)), (Mjpeg, 1280, 720, 30.0));
    assert_eq!(first(&webcam(), &asked(1280, 720, 10.0)), (Yuyv, 1280, 720, 10.0));
    assert_eq!(first(&webcam(), &asked(1920, 1080, 60.0)), (Mjpeg, 1920, 1080, 30.0));
    let mut with_grey = webcam();
    with_grey.push(offer(Grey, 640, 480, &[30]));
    assert_eq!(first(&with_grey, &asked(640, 480, 30.0)), (Grey, 640, 480, 30.0));
}

#[test]
fn the_nearest_size_and_rate_are_chosen_and_too_large_pictures_never() {
    use CameraFormat::{Mjpeg, Yuyv};
    assert_eq!(first(&webcam(), &asked(720, 480, 25.0)), (Yuyv, 640, 480, 24.0));
    assert_eq!(first(&webcam(), &asked(1900, 1200, 30.0)), (Mjpeg, 1920, 1080, 30.0));
    assert!(ranked(&webcam(), &asked(640, 480, 30.0)).iter().all(|c| c.width <= 1920));
    let ntsc = Interval { numerator: 1001, denominator: 30_000 };
    let offers = [Offer { format: Yuyv, width: 640, height: 480, rates: Rates::Listed(vec![ntsc]) }];
    let choice = ranked(&offers, &asked(640, 480, 30.0))[0];
    assert_eq!(choice.interval, ntsc, "the driver's own fraction is asked for");
}

#[test]
fn a_wanted_format_is_kept_to_even_if_it_is_slower_or_missing() {
    let mut config = asked(1280, 720, 30.0);
    config.format = FormatPreference::Yuyv;
    assert_eq!(first(&webcam(), &config), (CameraFormat::Yuyv, 1280, 720, 10.0));
    config.format = FormatPreference::Grey;
    assert!(ranked(&webcam(), &config).is_empty());
}

#[test]
fn the_second_choice_needs_less_bandwidth() {
    let choices = ranked(&webcam(), &asked(640, 480, 30.0));
    assert_eq!((choices[1].format, choices[1].width), (CameraFormat::Mjpeg, 640));
}

#[test]
fn rates_that_are_a_range_unknown_or_nonsense_still_give_an_interval() {
    let with = |rates: Rates| [Offer { format: CameraFormat::Grey, width: 640, height: 480, rates }];
    let config = asked(640, 480, 30.0);
    assert_eq!(ranked(&with(Rates::Unknown), &config)[0].rate_hz, 30.0);
    assert_eq!(ranked(&with(Rates::Between(1.0, 15.0)), &config)[0].rate_hz, 15.0);
    assert_eq!(ranked(&with(Rates::Between(60.0, 50.0)), &config)[0].rate_hz, 50.0);
    let zero = Interval { numerator: 0, denominator: 0 };
    assert_eq!(ranked(&with(Rates::Listed(vec![zero])), &config)[0].rate_hz, 30.0);
}

#[test]
fn keys_are_checked_with_their_ranges_and_unknown_ones_refused() {
    assert_eq!(V4l2Config::default().validate(), Ok(()));
    for (text, key) in [
        ("device = \"\"", "device"),
        ("device = \"a\\u0000b\"", "device"),
        ("width_px = 0", "width_px"),
        ("height_px = 5000", "height_px"),
        ("rate_hz = 0.0", "rate_hz"),
        ("rate_hz = nan", "rate_hz"),
        ("buffers = 1", "buffers"),
    ] {
        let config: V4l2Config = toml::from_str(text).expect("well-formed");
        assert_eq!(config.validate().expect_err(text).0, key);
    }
    assert!(toml::from_str::<V4l2Config>("width = 640").is_err());
    assert!(toml::from_str::<V4l2Config>("format = \"rgb\"").is_err());
    let written = toml::to_string(&V4l2Config::default()).expect("serialisable");
    assert_eq!(toml::from_str::<V4l2Config>(&written).expect("reads back"), V4l2Config::default());
}

fn open_error(device: &str) -> String {
    match V4l2Camera::open(&V4l2Config { device: device.into(), ..V4l2Config::default() }) {
        Ok(_) => panic!("{device} is no camera"),
        Err(e) => e.to_string(),
    }
}

#[test]
fn what_is_no_camera_is_named_with_the_reason() {
    assert_eq!(open_error("/dev/video-none"), "/dev/video-none: No such file or directory (os error 2)");
    assert!(open_error("/etc/passwd").contains("/etc/passwd: is not a device file"));
    assert!(open_error("/dev/null").contains("this is no Video4Linux device"));
    assert!(open_error("").contains("camera.device must be"));
    if device_files().is_empty() {
        assert!(open_error("auto").contains("there is no camera"));
        assert!(list_cameras(&V4l2Config::default()).is_empty());
    }
}

#[test]
fn a_calibration_is_looked_for_at_the_size_that_the_camera_will_send() {
    let offer = |width, height| Offer { format: CameraFormat::Mjpeg, width, height, rates: Rates::Unknown };
    let camera = |offers| CameraInfo {
        path: "/dev/video0".into(),
        card: "wide".into(),
        driver: "uvcvideo".into(),
        bus: "usb-1".into(),
        offers,
    };
    let config = V4l2Config::default();
    let wide = camera(vec![offer(1280, 720), offer(640, 360)]);
    assert_eq!(wide.picture_size(&config), (640, 360), "it has no 640x480");
    assert_eq!(camera(vec![offer(1280, 720), offer(640, 480)]).picture_size(&config), (640, 480));
    assert_eq!(camera(vec![]).picture_size(&config), (640, 480));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 1_000, rng_seed: RngSeed::Fixed(8), failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn the_nearest_step_is_a_step_inside_the_range(wanted: u32, min in 0u32..5_000, span in 0u32..5_000, step in 0u32..70) {
        let max = min + span;
        let got = nearest_step(wanted, min, max, step);
        prop_assert!((min..=max).contains(&got));
        prop_assert_eq!((got - min) % step.max(1), 0);
        let steps = (0..=span / step.max(1)).map(|k| min + k * step.max(1));
        prop_assert_eq!(steps.map(|s| s.abs_diff(wanted)).min(), Some(got.abs_diff(wanted)));
    }

    #[test]
    fn no_buffer_panics_or_is_kept(
        used in 0usize..60, length in 0usize..60, sequence: u32, timestamp: Option<i64>, corrupt: bool, grey: bool,
        width in 1u32..12, height in 1u32..6, stride in 0u32..30,
    ) {
        let layout = Layout { format: if grey { PixelFormat::Grey } else { PixelFormat::Yuyv }, width, height, stride };
        let filled = Filled { index: 0, bytes_used: used, sequence, timestamp_ns: timestamp, corrupt };
        let mut camera = capture(layout, vec![Next::Fill(filled, vec![3; length]), yuyv(0, 1, 1), Next::Nothing]);
        let mut slot = RawFrame::default();
        for _ in 0..3 {
            // The fake queue panics on a buffer that was not given back.
            let _ = grab(&mut camera, &mut slot);
        }
    }
}
