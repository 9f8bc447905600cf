//! The camera tried for real: opened as the daemon would, a second of pictures, and what is to be said of them.

use std::path::Path;
use std::time::{Duration, Instant};

use super::processes::Process;
use super::report::Report;
use crate::camera::v4l2::{V4l2Camera, V4l2Config};
use crate::camera::{FrameSource, Grab, SourceError};
use crate::daemon::within;
use crate::frame::RawFrame;

/// Time for the first picture: cameras need up to two seconds to wake up.
const FIRST: Duration = Duration::from_secs(4);
/// Time over which pictures are counted after the first.
const COUNTING: Duration = Duration::from_secs(1);

/// A camera that answers opens within a second.
const OPENING: Duration = Duration::from_secs(10);

/// What came of it.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    NotOpened(String),
    /// The driver is still opening it.
    Hangs,
    /// Open, and no picture.
    Silent,
    /// It went away while it was tried.
    Gone(String),
    Pictures {
        good: u32,
        unreadable: u32,
        seconds: f64,
        promised_hz: Option<f64>,
    },
}

/// Tries one camera, as the configuration wants it.
pub fn try_camera(config: &V4l2Config, device: &Path) -> Outcome {
    let config = V4l2Config { device: device.display().to_string(), ..config.clone() };
    let attempt = move || match V4l2Camera::open(&config) {
        Ok(mut camera) => try_source(&mut camera, FIRST, COUNTING),
        Err(error) => Outcome::NotOpened(error.to_string()),
    };
    // A driver may hang over it, and is then left behind.
    within(OPENING + FIRST + COUNTING, attempt).unwrap_or(Outcome::Hangs)
}

/// Counts pictures of an open source.
fn try_source(source: &mut dyn FrameSource, first: Duration, counting: Duration) -> Outcome {
    let promised_hz = source.description().rate_hz;
    let mut slot = RawFrame::default();
    let (mut good, mut unreadable) = (0, 0);
    let began = Instant::now();
    let mut counted_from: Option<Instant> = None;
    loop {
        let over = counted_from.map_or(began.elapsed() >= first, |from| from.elapsed() >= counting);
        if over {
            break;
        }
        match source.grab(&mut slot, Duration::from_millis(100)) {
            // The first one opens the count and is not part of it.
            Ok(Grab::Frame) if counted_from.is_none() => counted_from = Some(Instant::now()),
            Ok(Grab::Frame) => good += 1,
            Ok(Grab::Skipped { .. }) => unreadable += 1,
            Ok(Grab::TimedOut) => {}
            Ok(Grab::End) => break,
            Err(SourceError::Open { reason, .. } | SourceError::Gone { reason, .. }) => return Outcome::Gone(reason),
        }
    }
    match counted_from {
        Some(from) => Outcome::Pictures { good, unreadable, seconds: from.elapsed().as_secs_f64(), promised_hz },
        None if unreadable > 0 => {
            Outcome::Pictures { good, unreadable, seconds: began.elapsed().as_secs_f64(), promised_hz }
        }
        None => Outcome::Silent,
    }
}

/// Says what it means and what to do. `holders`: who has the device open, and whether some processes could not be looked into.
pub fn judge(report: &mut Report, device: &str, outcome: &Outcome, holders: &(Vec<Process>, bool)) {
    match outcome {
        Outcome::NotOpened(reason) if reason.contains("another program uses it") => {
            let (who, hidden) = holders;
            let mut names: Vec<String> = who.iter().map(|p| format!("{} (pid {})", p.name, p.pid)).collect();
            if names.is_empty() {
                names
                    .push(if *hidden { "a process of another user" } else { "a process that is not seen here" }.into());
            }
            let next = if *hidden && who.is_empty() {
                "see who uses it: `sudo cairn doctor`, then end that program; the daemon takes the camera within seconds"
            } else {
                "end the program that uses the camera; the daemon takes it within seconds"
            };
            report.bad(&format!("{device} is busy: used by {}", names.join(", ")), next);
        }
        Outcome::NotOpened(reason) if reason.contains("sends nothing usable") => {
            report
                .bad(reason, "another camera (GREY, YUYV or MJPEG), or camera.format = \"auto\" in the configuration");
        }
        Outcome::NotOpened(reason) if reason.contains("group 'video'") => {
            report.bad(reason, "let this user use cameras: `sudo usermod -aG video $USER`, then log in anew");
        }
        Outcome::NotOpened(reason) => {
            report.bad(reason, "the message above is the kernel's; `dmesg | tail` may say more")
        }
        Outcome::Hangs => report.bad(
            &format!("{device} does not answer: its driver has been opening it for {} s", OPENING.as_secs()),
            "plug the camera out and in again; `dmesg | tail` says what its driver waits for",
        ),
        Outcome::Silent => report.bad(
            &format!("{device} opens, but sends no picture within {} s", FIRST.as_secs()),
            "plug it in anew, into another port or without a hub; `dmesg | tail` says whether the USB bus is full",
        ),
        Outcome::Gone(reason) => {
            report.bad(
                &format!("{device} went away while it was tried: {reason}"),
                "look at cable, plug and power of the hub",
            );
        }
        Outcome::Pictures { good, unreadable, seconds, promised_hz } => {
            let rate = f64::from(*good) / seconds.max(1e-3);
            let line = format!("{device} sends {rate:.1} pictures a second");
            if *unreadable > 0 && unreadable * 10 >= *good {
                let next = "a bad cable or a full USB bus: another cable, another port, or a smaller picture";
                report.bad(&format!("{line}, and {unreadable} that cannot be read"), next);
            } else if promised_hz.is_some_and(|promised| rate < promised * 0.7) {
                report.good(&line);
                let promised = promised_hz.unwrap_or_default();
                report.note(&format!(
                    "{device} promised {promised:.0}: in poor light many cameras expose longer (camera.dynamic_rate = false), or \
                     the USB bus is full"
                ));
            } else {
                report.good(&line);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::SourceDescription;
    use crate::frame::Clock;

    /// Does the same at every grab.
    struct Same(SourceDescription, Result<Grab, ()>);

    impl FrameSource for Same {
        fn description(&self) -> &SourceDescription {
            &self.0
        }
        fn grab(&mut self, _: &mut RawFrame, _: Duration) -> Result<Grab, SourceError> {
            std::thread::sleep(Duration::from_millis(1));
            self.1.clone().map_err(|()| SourceError::Gone { path: "c".into(), reason: "unplugged".into() })
        }
    }

    fn tried(grab: Result<Grab, ()>) -> Outcome {
        let description = SourceDescription {
            name: "test".into(),
            size: None,
            rate_hz: Some(30.0),
            clock: Clock::Monotonic,
            camera: None,
            frames: None,
        };
        try_source(&mut Same(description, grab), Duration::from_millis(20), Duration::from_millis(30))
    }

    #[test]
    fn a_silent_a_broken_and_a_vanished_camera_are_told_apart() {
        assert_eq!(tried(Ok(Grab::TimedOut)), Outcome::Silent);
        assert_eq!(tried(Err(())), Outcome::Gone("unplugged".into()));
        assert!(matches!(tried(Ok(Grab::Frame)), Outcome::Pictures { good: 1.., unreadable: 0, .. }));
        let broken = tried(Ok(Grab::Skipped { reason: "short".into() }));
        assert!(matches!(broken, Outcome::Pictures { good: 0, unreadable: 1.., .. }), "{broken:?}");
    }

    #[test]
    fn every_outcome_has_a_line_and_a_next_step() {
        let pictures = |good, unreadable| Outcome::Pictures { good, unreadable, seconds: 1.0, promised_hz: Some(30.0) };
        let failed = |reason: &str| Outcome::NotOpened(format!("/dev/video0: {reason}"));
        let holder = Process { pid: 77, uid: 0, name: "cheese".into() };
        for (outcome, holders, problems, part) in [
            (failed("busy (another program uses it)"), (vec![holder], false), 1, "cheese (pid 77)"),
            (failed("busy (another program uses it)"), (vec![], true), 1, "sudo cairn doctor"),
            (
                failed("refused (may this user use it? cameras belong to the group 'video')"),
                (vec![], false),
                1,
                "usermod",
            ),
            (failed("X sends nothing usable: offered is NV12"), (vec![], false), 1, "another camera"),
            (failed("the bus is on fire"), (vec![], false), 1, "dmesg"),
            (Outcome::Hangs, (vec![], false), 1, "does not answer"),
            (Outcome::Silent, (vec![], false), 1, "no picture within 4 s"),
            (Outcome::Gone("no such device".into()), (vec![], false), 1, "went away"),
            (pictures(30, 0), (vec![], false), 0, "30.0 pictures"),
            (pictures(15, 0), (vec![], false), 0, "promised 30"),
            (pictures(20, 10), (vec![], false), 1, "10 that cannot be read"),
        ] {
            let mut report = Report::default();
            judge(&mut report, "/dev/video0", &outcome, &holders);
            let all = format!("{}{}", report.text, report.next.join("\n"));
            assert_eq!((report.problems, report.next.len()), (problems, problems), "{outcome:?}: {all}");
            assert!(all.contains(part), "{outcome:?}: {all}");
        }
    }
}
