//! Before there is a run: waits for the camera that says which calibration is meant, and tells planners so meanwhile.
//!
//! Input: a search that is tried again and again. Output: what it found, or nothing when the daemon is told to stop. Health is
//! published at its rate with the bit NO_CAMERA, commands are refused as busy, the service manager sees a daemon that becomes ready and
//! lives: that a camera is missing is being reported, and is no reason to start it again.
//!
//! Not here: a camera that goes away later, which is the capture step's business.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use sd_notify::NotifyState;
use tracing::warn;

use super::TURN;
use super::announce::{Announcer, notify};
use super::health::HealthWatch;
use super::status::Status;
use super::supervisor::Desk;
use crate::frame::{Clock, monotonic_ns};
use crate::messages::{CommandReply, reply_code};
use crate::telemetry::{RateLimiter, report_suppressed};

/// Commands that are refused in one turn at the most.
const COMMANDS_A_TURN: usize = 4;
/// The missing camera is mentioned in the log once in so long.
const REMINDER: Duration = Duration::from_secs(60);

/// Tries `find` every `pause` until it gives something; its error is why not. `None`: `stop` was set.
pub fn await_camera<T>(
    desk: &mut Desk,
    stop: &AtomicBool,
    pause: Duration,
    find: &mut dyn FnMut() -> Result<T, String>,
) -> Option<T> {
    // Of nothing but the missing camera.
    let status = Arc::new(Status::default());
    let mut watch = HealthWatch::new(status, Clock::Monotonic, Duration::MAX, monotonic_ns());
    let mut announcer = Announcer::default();
    let began = Instant::now();
    let mut faults = RateLimiter::default();
    let mut complaint: Option<(String, Instant)> = None;
    let mut tried: Option<Instant> = None;
    while !stop.load(Ordering::Relaxed) {
        if tried.is_none_or(|at| at.elapsed() >= pause) {
            match find() {
                Ok(found) => return Some(found),
                Err(reason) => {
                    let known = complaint.as_ref().is_some_and(|(last, at)| *last == reason && at.elapsed() < REMINDER);
                    if !known {
                        warn!(reason, "waiting for a camera");
                        complaint = Some((reason, Instant::now()));
                    }
                }
            }
            tried = Some(Instant::now());
        }
        let now_ns = monotonic_ns();
        notify(&[NotifyState::Watchdog]);
        let health = watch.tick(now_ns);
        announcer.turn(&health, began.elapsed());
        report_suppressed(false);
        if let Err(error) = desk.health.publish(&health)
            && let Some(messages) = faults.event(now_ns)
        {
            warn!(messages, %error, "health cannot be sent");
        }
        for _ in 0..COMMANDS_A_TURN {
            let Ok(Some(request)) = desk.commands.receive() else { break };
            // A sender that has gone needs no answer.
            let _ = request.reply(CommandReply::new(reply_code::BUSY, "no camera has been found yet"));
        }
        thread::sleep(TURN);
    }
    None
}
