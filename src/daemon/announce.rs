//! What the service manager hears: readiness, and a line on how it goes (`systemctl status`).
//!
//! Ready means that whoever starts after the daemon finds it doing its work: a frame has come, or planners are being told that
//! none does (for [`ABSENT_FOR`], because a camera that is there needs some time to open). It is said once; what happens later is
//! a matter of health, not of starting.

use std::time::Duration;

use sd_notify::NotifyState;
use tracing::{info, warn};

use crate::messages::{Health, error};

/// So long must the absence of pictures have been published.
const ABSENT_FOR: Duration = Duration::from_secs(1);
/// The line is renewed no more often than this.
const STATUS_EVERY: Duration = Duration::from_secs(1);

/// What was said so far.
#[derive(Debug, Default)]
pub(super) struct Announcer {
    ready: bool,
    /// Since when it has been published that there are no pictures; time since the start.
    absent_since: Option<Duration>,
    line: String,
    line_at: Option<Duration>,
}

impl Announcer {
    /// A look at the health that was published `elapsed` after the start.
    pub(super) fn turn(&mut self, health: &Health, elapsed: Duration) {
        if self.becomes_ready(health, elapsed) {
            info!(after_ms = elapsed.as_millis() as u64, frames = health.frames_captured, "running");
            notify(&[NotifyState::Ready]);
        }
        if let Some(line) = self.new_line(health, elapsed) {
            notify(&[NotifyState::Status(&line)]);
        }
    }

    /// `true` once, when it is ready.
    fn becomes_ready(&mut self, health: &Health, elapsed: Duration) -> bool {
        let absent = health.errors & (error::NO_CAMERA | error::NO_FRAMES) != 0;
        self.absent_since = absent.then(|| self.absent_since.unwrap_or(elapsed));
        let told = self.absent_since.is_some_and(|since| elapsed.saturating_sub(since) >= ABSENT_FOR);
        let becomes = !self.ready && (health.frames_captured > 0 || told);
        self.ready |= becomes;
        becomes
    }

    /// The line, if it has changed and the last one is old enough.
    fn new_line(&mut self, health: &Health, elapsed: Duration) -> Option<String> {
        if self.line_at.is_some_and(|at| elapsed.saturating_sub(at) < STATUS_EVERY) {
            return None;
        }
        let faults: Vec<&str> = error::names(health.errors).collect();
        let faults = if faults.is_empty() { "no faults".into() } else { faults.join(" ") };
        let line = format!(
            "{}, {} landmarks in {} keyframes, {faults}",
            health.state().name(),
            health.landmarks,
            health.keyframes
        );
        if line == self.line {
            return None;
        }
        self.line_at = Some(elapsed);
        self.line.clone_from(&line);
        Some(line)
    }
}

/// Tells the service manager; without one it does nothing.
pub(super) fn notify(states: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(states) {
        warn!(%error, "service manager cannot be told");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn ready_is_said_once_with_the_first_frame() {
        let mut announcer = Announcer::default();
        let opening = Health { errors: error::NO_CAMERA, ..Health::default() };
        assert!(!announcer.becomes_ready(&opening, at(0)), "the camera may only need its time");
        assert!(!announcer.becomes_ready(&opening, at(900)));
        let flowing = Health { frames_captured: 1, ..Health::default() };
        assert!(announcer.becomes_ready(&flowing, at(950)));
        assert!(!announcer.becomes_ready(&flowing, at(1000)));
        assert!(!announcer.becomes_ready(&opening, at(9000)), "said already");
    }

    #[test]
    fn ready_is_said_without_a_camera_once_its_absence_stands() {
        let mut announcer = Announcer::default();
        let absent = Health { errors: error::NO_CAMERA, ..Health::default() };
        // Open and silent for a moment in between: not yet a fault, so counted anew.
        for (ms, health, ready) in [
            (100, absent, false),
            (1000, Health::default(), false),
            (1100, absent, false),
            (2000, absent, false),
            (2100, absent, true),
        ] {
            assert_eq!(announcer.becomes_ready(&health, at(ms)), ready, "{ms} ms");
        }
    }

    #[test]
    fn the_line_names_state_and_faults_and_is_not_repeated() {
        let mut announcer = Announcer::default();
        let absent = Health { errors: error::NO_CAMERA, ..Health::default() };
        let line = announcer.new_line(&absent, at(0)).expect("a first line");
        assert!(line.starts_with("INITIALIZING, 0 landmarks") && line.ends_with("NO_CAMERA"), "{line}");
        assert_eq!(announcer.new_line(&Health::default(), at(500)), None, "too soon");
        assert_eq!(announcer.new_line(&absent, at(1500)), None, "nothing new");
        assert!(announcer.new_line(&Health::default(), at(1600)).expect("news").ends_with("no faults"));
    }
}
