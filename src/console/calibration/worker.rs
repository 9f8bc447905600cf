//! The thread that looks for the board.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender, bounded};
use crossbeam::select;
use tracing::info;

use super::guided::{Calibrator, Camera};
use super::session::{Action, Session};
use super::tray::Tray;
use crate::console::feed::Source;
use crate::console::hub::{Hub, demand};
use crate::console::outbox::Outbox;
use crate::console::wire::{self, Kind};

/// Pictures a second at most: a hand is still for half a second at least when it holds still.
const RATE_HZ: f64 = 10.0;
/// Rest after a picture at the longest, however long it took (a solution takes longest): frames more than half a second apart tell nothing of movement.
const LONGEST_REST: Duration = Duration::from_millis(250);
/// How soon the end is noticed, and how often pages hear of one that waits for pictures.
const NAP: Duration = Duration::from_millis(200);
/// Orders that wait.
const WAITING: usize = 4;
/// Health comes ten times a second, and a camera's name in the next turn of the daemon.
const DAEMON_TIME: Duration = Duration::from_secs(1);
/// A slow disk takes seconds to have a file.
const KEEPING_TIME: Duration = Duration::from_secs(10);

/// An order of a page, with its number.
pub type Asked = (Arc<Outbox>, u32, Action);

/// Where orders and pictures come in.
#[derive(Debug)]
pub struct Desk {
    pub tray: Tray,
    pub orders: Sender<Asked>,
    received: Receiver<Asked>,
}

impl Default for Desk {
    fn default() -> Self {
        let (orders, received) = bounded(WAITING);
        Self { tray: Tray::default(), orders, received }
    }
}

/// What tells a page of its order: number, command for a terminal, what became of it.
pub type Answer = fn(&Outbox, u32, &str, Result<String, String>);

/// Until `stop`.
pub fn run(
    hub: &Hub,
    source: &Source,
    desk: &Desk,
    calibrator: &Arc<dyn Calibrator>,
    answer: Answer,
    stop: &AtomicBool,
) {
    let mut session = Session::new(calibrator.clone());
    let tell = |session: &Session| {
        desk.tray.set_open(session.is_running());
        let told = session.told(Instant::now());
        hub.tell(Kind::Calibration, demand::CALIBRATION, &wire::json(Kind::Calibration, &told));
    };
    tell(&session);
    // When the next picture is looked at.
    let mut next = Instant::now();
    while !stop.load(Ordering::Relaxed) {
        let mut patience = NAP;
        if session.is_running() && !desk.tray.is_asked() {
            match next.checked_duration_since(Instant::now()) {
                Some(rest) => patience = patience.min(rest),
                None => desk.tray.ask(),
            }
        }
        select! {
            recv(desk.received) -> asked => {
                let Ok((page, id, action)) = asked else { return };
                let done = session.guarded(|s| s.obey(action, id, Instant::now(), &|file| keep(source, file))).unwrap_or_else(Err);
                info!(ok = done.is_ok(), said = done.as_ref().unwrap_or_else(|e| e), "console: calibration");
                tell(&session);
                answer(&page, id, &session.told(Instant::now()).terminal, done);
            }
            recv(desk.tray.pictures()) -> picture => {
                let (Ok(picture), begun) = (picture, Instant::now()) else { return };
                // What panics has told why in the session.
                let _ = session.guarded(|session| {
                    session.look(picture);
                    if let Some(run_id) = session.nameless() {
                        session.name(camera(source, run_id));
                    }
                });
                session.wait(Instant::now());
                let took = begun.elapsed();
                next = begun + Duration::from_secs_f64(1.0 / RATE_HZ).max(took + took.min(LONGEST_REST));
                tell(&session);
            }
            default(patience) => {
                // Seconds pass on the page, too.
                let ended = session.guarded(|s| s.turn(Instant::now())).unwrap_or(true);
                if ended || (session.is_running() && desk.tray.is_asked()) {
                    tell(&session);
                }
            }
        }
    }
    desk.tray.set_open(false);
}

/// The camera of the daemon whose pictures they are; `None`: it has none, but a recording or a simulator.
fn camera(source: &Source, run_id: u64) -> Option<Camera> {
    let client = source.client().ok()?;
    let health = client.health().wait(DAEMON_TIME).ok()??;
    let (identity, device) = client.camera_identity(DAEMON_TIME).ok()?.ok().filter(|_| health.run_id == run_id)?;
    Some(Camera { identity, device })
}

/// Has the daemon keep a calibration for its camera.
fn keep(source: &Source, file: &str) -> Result<String, String> {
    let client = source.client().map_err(|e| e.to_string())?;
    let reply = client.keep_calibration(file, KEEPING_TIME).map_err(|e| e.to_string())?;
    if reply.is_ok() { Ok(reply.message().into()) } else { Err(reply.message().into()) }
}
