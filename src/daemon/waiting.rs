//! Before there is a run: waits for the camera that says which calibration is meant, and tells planners so meanwhile.
//!
//! Input: a search that is tried again and again, in a thread of its own because a driver may hang over it. Output: what it found, or nothing
//! when the daemon is told to stop. Health is published at its rate with the bit NO_CAMERA, commands are refused as busy, the service manager sees a daemon that becomes ready and
//! lives: that a camera is missing is being reported, and is no reason to start it again.
//!
//! Not here: a camera that goes away later, which is the capture step's business.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use sd_notify::NotifyState;
use tracing::warn;

use super::announce::{Announcer, notify};
use super::background::{Background, Progress};
use super::health::HealthWatch;
use super::status::Status;
use super::supervisor::Desk;
use super::{DaemonError, TURN};
use crate::frame::{Clock, monotonic_ns};
use crate::messages::{CommandReply, reply_code};
use crate::telemetry::{RateLimiter, report_suppressed};

/// Commands that are refused in one turn at the most.
const COMMANDS_A_TURN: usize = 4;
/// The missing camera is mentioned in the log once in so long.
const REMINDER: Duration = Duration::from_secs(60);
/// A search that takes so long is mentioned, too.
const SLOW: Duration = Duration::from_secs(2);

/// Tries `find` every `pause` until it gives something; its error is why not. `each_turn` is called ten times a second. `None`: `stop` was set.
pub fn await_camera<T: Send + 'static>(
    desk: &mut Desk,
    stop: &AtomicBool,
    pause: Duration,
    mut find: impl FnMut() -> Result<T, String> + Send + 'static,
    each_turn: &mut dyn FnMut(),
) -> Result<Option<T>, DaemonError> {
    let mut search = Background::spawn("cairn-camera", move |()| Some(find())).map_err(DaemonError::Thread)?;
    // Of nothing but the missing camera.
    let status = Arc::new(Status::default());
    let mut watch = HealthWatch::new(status, Clock::Monotonic, Duration::MAX, monotonic_ns());
    let mut announcer = Announcer::default();
    let began = Instant::now();
    let mut faults = RateLimiter::default();
    let mut complaint: Option<(String, Instant)> = None;
    let mut tried: Option<Instant> = None;
    while !stop.load(Ordering::Relaxed) {
        each_turn();
        let mut wait = TURN;
        if tried.is_none_or(|at| at.elapsed() >= pause) {
            let asked = Instant::now();
            let reason = match search.ask(|| (), TURN) {
                Progress::Done(Ok(found)) => return Ok(Some(found)),
                Progress::Done(Err(reason)) => {
                    tried = Some(Instant::now());
                    Some(reason)
                }
                Progress::Pending(waited) => {
                    (waited > SLOW).then(|| "a camera does not answer while it is opened".into())
                }
                Progress::Dead => return Err(DaemonError::Search),
            };
            wait = TURN.saturating_sub(asked.elapsed());
            if let Some(reason) = reason {
                let known = complaint.as_ref().is_some_and(|(last, at)| *last == reason && at.elapsed() < REMINDER);
                if !known {
                    warn!(reason, "waiting for a camera");
                    complaint = Some((reason, Instant::now()));
                }
            }
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
        thread::sleep(wait);
    }
    Ok(None)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::client::Client;
    use crate::messages::{Endpoint, error};
    use crate::publish::{Limits, Publisher};

    #[test]
    fn health_goes_on_while_the_search_for_a_camera_hangs() {
        let endpoint = Endpoint::new(&format!("waiting-{}", std::process::id())).expect("prefix");
        let small = Limits { landmarks: 1, keyframes: 1, frame_bytes: 1 };
        let publisher = Publisher::open(&endpoint, &small).expect("services");
        let mut desk = Desk { health: publisher.health, commands: publisher.commands };
        let (answer, answered) = crossbeam::channel::bounded::<()>(1);
        let find = move || answered.recv().map_err(|e| e.to_string()).map(|()| 7);
        let mut health = Client::with_endpoint(endpoint).expect("client").health();
        let mut heard = 0;
        let found = await_camera(&mut desk, &AtomicBool::new(false), Duration::from_millis(1), find, &mut || {
            while let Ok(Some(message)) = health.try_next() {
                assert_eq!(message.errors, error::NO_CAMERA);
                heard += 1;
            }
            if heard == 5 {
                let _ = answer.try_send(());
            }
        });
        assert_eq!(found.expect("no fault"), Some(7));
        assert!(heard >= 5);
    }
}
