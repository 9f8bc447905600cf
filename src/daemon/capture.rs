//! The capture step: one frame from whatever source there is into a slot, or a reason why not.
//!
//! A camera that is absent or goes away is looked for again, at growing intervals; one that is open and gives no good frame is
//! opened anew, because a stuck stream does not heal by itself; a recording or a simulator that fails has ended. Cameras are opened and closed
//! in a thread of their own, because a driver may hang over it: the stage lives on, and what is told is the camera's fault. Frame numbers go on
//! across all that. What the driver lost shows as a gap of its numbers and is counted. Every fault is counted, logged at once and then once a second at most.

use std::sync::Arc;
use std::time::Duration;

use tracing::{info, warn};

use super::background::TURN;
use super::background::{Background, Progress};
use super::camera_commands::CameraOrder;
use super::status::Status;
use super::timestamps::{TimestampGate, Verdict};
use super::wheels::WheelIntake;
use crate::camera::{FrameSource, Grab, SourceError};
use crate::frame::{Clock, RawFrame, monotonic_ns};
use crate::publish::{CameraView, EncodedPublisher, convert};
use crate::telemetry::RateLimiter;

/// Opens a source again after it was lost.
pub type Opener = Box<dyn FnMut() -> Result<Box<dyn FrameSource>, SourceError> + Send>;

/// Where frames come from.
pub enum Supply {
    /// An open source that ends when it fails: a recording, a simulator.
    Once(Box<dyn FrameSource>),
    /// A camera, which may be absent now and then; `longest_pause` between attempts to open it.
    Camera { open: Opener, longest_pause: Duration },
}

/// What one step came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Captured {
    /// The slot holds a good frame. Its time is later than the last one's, or has gone back for good.
    Frame,
    /// No good frame this time.
    Nothing,
    /// There is no source at the moment; nothing is to be done for so long.
    Absent(Duration),
    /// No frame will come any more. `failed`: the source broke before its end.
    End { failed: bool },
}

/// First pause after a failed attempt to open the camera; doubled every time.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
/// A camera that gives no good frame for so long is opened anew, ns; doubled every time that this does not help.
const FIRST_PATIENCE_NS: i64 = 3_000_000_000;
const LONGEST_PATIENCE_NS: i64 = 24_000_000_000;
/// An absent camera is mentioned in the log once in so many ns.
const REMINDER_NS: i64 = 60_000_000_000;
/// A camera that takes so long to open is mentioned, too.
const SLOW_OPENING: Duration = Duration::from_secs(2);

/// What the opening thread is told.
enum Order {
    Close(Box<dyn FrameSource>),
    Open,
}

type Opened = Result<Box<dyn FrameSource>, SourceError>;

/// The capture stage without its thread.
pub struct CaptureStep {
    source: Option<Box<dyn FrameSource>>,
    /// Opens and closes; `None` for a source without a way back.
    opener: Option<Background<Order, Opened>>,
    /// So long the stage waits for it in one step.
    opening_turn: Duration,
    longest_pause: Duration,
    pause: Duration,
    /// The last fault that kept the camera closed, and when it was logged.
    complaint: Option<(String, i64)>,
    gate: TimestampGate,
    /// CLOCK_MONOTONIC of the last good frame, or of the opening.
    quiet_since_ns: i64,
    patience_ns: i64,
    /// Our number of the source's frame 0, and of the next frame.
    first_number: u64,
    next_number: u64,
    unreadable: RateLimiter,
    bad_times: RateLimiter,
    unsent: RateLimiter,
    /// For recorders; `None` where nothing is published.
    encoded: Option<EncodedPublisher>,
    /// For what the source tells of wheels; `None`: nobody asks.
    wheels: Option<WheelIntake>,
    status: Arc<Status>,
}

impl CaptureStep {
    /// An error is a thread that cannot be started.
    pub fn new(supply: Supply, status: Arc<Status>) -> std::io::Result<Self> {
        let (source, opener, longest_pause) = match supply {
            Supply::Once(source) => (Some(source), None, Duration::ZERO),
            Supply::Camera { mut open, longest_pause } => {
                let work = move |order| match order {
                    Order::Close(source) => {
                        drop(source);
                        None
                    }
                    Order::Open => Some(open()),
                };
                (None, Some(Background::spawn("cairn-camera", work)?), longest_pause)
            }
        };
        status.set_source_present(source.is_some());
        Ok(Self {
            source,
            opener,
            opening_turn: TURN,
            longest_pause,
            pause: FIRST_PAUSE,
            complaint: None,
            gate: TimestampGate::default(),
            quiet_since_ns: monotonic_ns(),
            patience_ns: FIRST_PATIENCE_NS,
            first_number: 0,
            next_number: 0,
            unreadable: RateLimiter::default(),
            bad_times: RateLimiter::default(),
            unsent: RateLimiter::default(),
            encoded: None,
            wheels: None,
            status,
        })
    }

    /// With a service for recorders, which get every good frame as it came.
    pub fn sharing(mut self, encoded: Option<EncodedPublisher>) -> Self {
        self.encoded = encoded;
        self
    }

    /// With a queue for the wheel odometry that a source brings.
    pub fn with_wheels(mut self, wheels: WheelIntake) -> Self {
        self.wheels = Some(wheels);
        self
    }

    /// Waits at most `timeout` for a frame.
    pub fn step(&mut self, slot: &mut RawFrame, timeout: Duration) -> Captured {
        let Some(source) = self.source.as_mut() else { return self.try_open() };
        match source.grab(slot, timeout) {
            Ok(Grab::Frame) => self.judge(slot),
            Ok(Grab::TimedOut) => self.mind_silence(),
            Ok(Grab::Skipped { reason }) => {
                self.status.unreadable.add(1);
                // Its number is gone with it: what is counted here was not lost by the driver as well.
                self.next_number = self.next_number.saturating_add(1);
                if let Some(frames) = self.unreadable.event(monotonic_ns()) {
                    warn!(frames, reason, "frame cannot be read, skipped");
                }
                self.mind_silence()
            }
            Ok(Grab::End) => {
                info!(frames = self.status.captured.get(), "source has ended");
                Captured::End { failed: false }
            }
            Err(error) => self.lose(&error),
        }
    }

    /// Carries out what somebody asks of the camera.
    pub fn obey(&mut self, order: CameraOrder) {
        order.carry_out(self.source.as_deref_mut());
    }

    fn judge(&mut self, slot: &mut RawFrame) -> Captured {
        self.status.captured.add(1);
        self.status.set_last_arrival_ns(slot.arrival_ns);
        (self.quiet_since_ns, self.patience_ns) = (monotonic_ns(), FIRST_PATIENCE_NS);
        slot.sequence = slot.sequence.saturating_add(self.first_number);
        let missed = slot.sequence.saturating_sub(self.next_number);
        self.next_number = slot.sequence.saturating_add(1);
        let clock = self.source.as_ref().map(|s| s.description().clock);
        if clock == Some(Clock::Monotonic) {
            self.status.missed.add(missed);
            self.status.capture_delay.record_ns(slot.arrival_ns.saturating_sub(slot.timestamp_ns));
        }
        match self.gate.judge(slot.timestamp_ns) {
            Verdict::Accept => {
                self.take_wheels(slot.timestamp_ns);
                self.share(slot);
                Captured::Frame
            }
            Verdict::AcceptNewTimeline => {
                self.share(slot);
                warn!(timestamp_ns = slot.timestamp_ns, "time went back for good, starting over");
                Captured::Frame
            }
            Verdict::Drop(fault) => {
                self.status.bad_timestamps.add(1);
                if let Some(frames) = self.bad_times.event(monotonic_ns()) {
                    let (sequence, timestamp_ns) = (slot.sequence, slot.timestamp_ns);
                    warn!(
                        frames,
                        fault = fault.name(),
                        sequence,
                        timestamp_ns,
                        "timestamp not believed, frame dropped"
                    );
                }
                Captured::Nothing
            }
        }
    }

    /// What the source tells of wheels up to this frame, before the frame goes on its way.
    fn take_wheels(&mut self, until_ns: i64) {
        let (Some(source), Some(wheels)) = (self.source.as_mut(), self.wheels.as_mut()) else { return };
        source.wheels(until_ns, &mut |message, fault| {
            wheels.take("source", message, fault);
        });
    }

    /// The frame as it came, if anybody records.
    fn share(&mut self, frame: &RawFrame) {
        let Some(encoded) = self.encoded.as_mut().filter(|encoded| encoded.is_wanted()) else { return };
        if let Some(mount) = self.status.found_mount() {
            encoded.describe_mount(&mount);
        }
        let (pinhole_px, distortion) = self.status.exact_lens();
        let camera = CameraView {
            pinhole_px,
            distortion,
            intrinsics: convert::intrinsics(self.status.lens().0),
            lens_model: convert::lens_model(self.status.lens_is_wide_angle()),
        };
        if let Err(error) = encoded.publish(frame, &camera) {
            self.status.publish_failures.add(1);
            if let Some(messages) = self.unsent.event(monotonic_ns()) {
                warn!(messages, %error, "message cannot be sent");
            }
        }
    }

    /// No good frame this time. A camera that has given none for long is opened anew.
    fn mind_silence(&mut self) -> Captured {
        let silent_ns = monotonic_ns() - self.quiet_since_ns;
        if self.opener.is_none() || silent_ns < self.patience_ns {
            return Captured::Nothing;
        }
        warn!(silent_ms = silent_ns / 1_000_000, "camera gives no good frame, opened anew");
        self.patience_ns = (self.patience_ns * 2).min(LONGEST_PATIENCE_NS);
        // Closed first: a device is used once. For planners it is there meanwhile, and silent.
        self.close();
        self.try_open()
    }

    fn close(&mut self) {
        if let (Some(source), Some(opener)) = (self.source.take(), &self.opener) {
            opener.tell(Order::Close(source));
        }
    }

    fn lose(&mut self, error: &SourceError) -> Captured {
        self.status.set_source_present(false);
        if self.opener.is_none() {
            self.source = None;
            warn!(%error, "source failed");
            return Captured::End { failed: true };
        }
        self.close();
        self.patience_ns = FIRST_PATIENCE_NS;
        warn!(%error, "camera lost, looking for it");
        self.complaint = Some((error.to_string(), monotonic_ns()));
        self.pause = FIRST_PAUSE;
        Captured::Absent(self.pause)
    }

    fn try_open(&mut self) -> Captured {
        let Some(opener) = self.opener.as_mut() else { return Captured::End { failed: true } };
        match opener.ask(|| Order::Open, self.opening_turn) {
            Progress::Done(Ok(source)) => {
                let d = source.description();
                let (width, height) = d.size.unwrap_or_default();
                info!(name = d.name, width, height, rate_hz = d.rate_hz, "camera open");
                self.status.set_nominal_rate_hz(d.rate_hz.unwrap_or(0.0));
                self.source = Some(source);
                self.status.set_source_present(true);
                self.gate.expect_pause();
                self.first_number = self.next_number;
                self.quiet_since_ns = monotonic_ns();
                self.complaint = None;
                self.pause = FIRST_PAUSE;
                Captured::Nothing
            }
            Progress::Done(Err(error)) => {
                self.status.set_source_present(false);
                self.patience_ns = FIRST_PATIENCE_NS;
                let text = error.to_string();
                if self.is_news(&text) {
                    warn!(%error, "camera cannot be opened, will be tried again");
                }
                let pause = self.pause;
                self.pause = (pause * 2).min(self.longest_pause);
                Captured::Absent(pause)
            }
            Progress::Pending(waited) => {
                if waited > SLOW_OPENING && self.is_news("no answer") {
                    warn!(waited_ms = waited.as_millis() as u64, "camera does not answer while it is opened");
                }
                Captured::Nothing
            }
            // The panic is in the log.
            Progress::Dead => Captured::End { failed: true },
        }
    }

    /// Whether this complaint is another one than the last, or that one is long ago.
    fn is_news(&mut self, text: &str) -> bool {
        let now = monotonic_ns();
        let known = self.complaint.as_ref().is_some_and(|(last, at)| last == text && now - at < REMINDER_NS);
        if !known {
            self.complaint = Some((text.into(), now));
        }
        !known
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::SourceDescription;

    #[test]
    fn numbers_go_on_and_a_pause_is_no_jump_when_a_camera_comes_back() {
        let mut attempts = 0;
        let open: Opener = Box::new(move || {
            attempts += 1;
            match attempts {
                1 => Ok(script(&[Ok((Grab::Frame, 1)), Ok((Grab::Frame, 2)), Err(())])),
                _ => Ok(script(&[Ok((Grab::Frame, 60_000_000_000)), Ok((Grab::Frame, 60_033_000_000))])),
            }
        });
        let status = Arc::new(Status::default());
        let mut step = step(Supply::Camera { open, longest_pause: Duration::from_secs(1) }, &status);
        let mut slot = RawFrame::default();
        let mut numbers = Vec::new();
        for _ in 0..7 {
            if step.step(&mut slot, Duration::ZERO) == Captured::Frame {
                numbers.push(slot.sequence);
            }
        }
        assert_eq!(numbers, [0, 1, 2, 3]);
        assert_eq!(status.bad_timestamps.get(), 0);
    }

    /// Waits for the opening thread however busy the machine is.
    fn step(supply: Supply, status: &Arc<Status>) -> CaptureStep {
        let mut step = CaptureStep::new(supply, status.clone()).expect("thread");
        step.opening_turn = Duration::from_secs(60);
        step
    }

    /// A source that follows a script of outcomes.
    struct Script {
        description: SourceDescription,
        outcomes: Vec<Result<(Grab, i64), ()>>,
        at: usize,
        frames: u64,
    }

    fn script(outcomes: &[Result<(Grab, i64), ()>]) -> Box<dyn FrameSource> {
        let description = SourceDescription {
            name: "script".into(),
            size: None,
            rate_hz: None,
            clock: Clock::Monotonic,
            camera: None,
            frames: None,
        };
        Box::new(Script { description, outcomes: outcomes.to_vec(), at: 0, frames: 0 })
    }

    impl FrameSource for Script {
        fn description(&self) -> &SourceDescription {
            &self.description
        }
        fn grab(&mut self, slot: &mut RawFrame, _timeout: Duration) -> Result<Grab, SourceError> {
            let outcome = self.outcomes.get(self.at).cloned().unwrap_or(Ok((Grab::End, 0)));
            self.at += 1;
            match outcome {
                Ok((grab, timestamp_ns)) => {
                    slot.timestamp_ns = timestamp_ns;
                    slot.sequence = self.frames;
                    // A driver numbers broken frames like good ones.
                    self.frames += u64::from(grab != Grab::TimedOut);
                    Ok(grab)
                }
                Err(()) => Err(SourceError::Gone { path: "script".into(), reason: "unplugged".into() }),
            }
        }
    }

    fn run(step: &mut CaptureStep, steps: usize) -> Vec<Captured> {
        let mut slot = RawFrame::default();
        (0..steps).map(|_| step.step(&mut slot, Duration::ZERO)).collect()
    }

    #[test]
    fn faults_are_skipped_and_counted_each_in_its_own_place() {
        let status = Arc::new(Status::default());
        let skipped = Grab::Skipped { reason: "truncated".into() };
        let source = script(&[
            Ok((Grab::Frame, 10)),
            Ok((skipped, 0)),
            Ok((Grab::TimedOut, 0)),
            Ok((Grab::Frame, 10)),
            Ok((Grab::Frame, 20)),
        ]);
        let mut step = step(Supply::Once(source), &status);
        let end = Captured::End { failed: false };
        let nothing = Captured::Nothing;
        assert_eq!(run(&mut step, 6), [Captured::Frame, nothing, nothing, nothing, Captured::Frame, end]);
        assert_eq!(status.captured.get(), 3);
        assert_eq!(status.unreadable.get(), 1);
        assert_eq!(status.missed.get(), 0, "the unreadable one is not lost as well");
        assert_eq!(status.bad_timestamps.get(), 1);
    }

    #[test]
    fn a_source_without_a_way_back_ends_when_it_breaks() {
        let source = script(&[Ok((Grab::Frame, 1)), Err(())]);
        let mut step = step(Supply::Once(source), &Arc::default());
        assert_eq!(
            run(&mut step, 3),
            [Captured::Frame, Captured::End { failed: true }, Captured::End { failed: true }]
        );
    }

    #[test]
    fn a_camera_that_is_absent_is_looked_for_at_growing_intervals_and_found_again() {
        let status = Arc::new(Status::default());
        let mut attempts = 0;
        let open: Opener = Box::new(move || {
            attempts += 1;
            match attempts {
                // Found at the first attempt, lost at its second frame; then absent five times.
                1 => Ok(script(&[Ok((Grab::Frame, 1)), Err(())])),
                2..=6 => Err(SourceError::Open { path: "/dev/video0".into(), reason: "no such device".into() }),
                _ => Ok(script(&[Ok((Grab::Frame, 2))])),
            }
        });
        let longest_pause = Duration::from_millis(500);
        let mut step = step(Supply::Camera { open, longest_pause }, &status);
        assert!(!status.source_present());
        let ms = |ms| Captured::Absent(Duration::from_millis(ms));
        assert_eq!(run(&mut step, 2), [Captured::Nothing, Captured::Frame]);
        assert!(status.source_present());
        assert_eq!(run(&mut step, 6), [ms(100), ms(100), ms(200), ms(400), ms(500), ms(500)]);
        assert!(!status.source_present());
        assert_eq!(run(&mut step, 2), [Captured::Nothing, Captured::Frame]);
        assert!(status.source_present());
    }

    #[test]
    fn a_camera_that_hangs_while_it_is_opened_keeps_nobody_waiting() {
        let (answer, answered) = crossbeam::channel::bounded::<()>(1);
        let open: Opener = Box::new(move || {
            let _ = answered.recv();
            Ok(script(&[Ok((Grab::Frame, 1))]))
        });
        let status = Arc::new(Status::default());
        let mut step = step(Supply::Camera { open, longest_pause: Duration::from_secs(1) }, &status);
        step.opening_turn = Duration::from_millis(1);
        assert_eq!(run(&mut step, 20), [Captured::Nothing; 20]);
        assert!(!status.source_present(), "a camera that does not open is not there");
        answer.send(()).expect("still asked, once");
        step.opening_turn = Duration::from_secs(60);
        assert_eq!(run(&mut step, 2), [Captured::Nothing, Captured::Frame]);
    }
}
