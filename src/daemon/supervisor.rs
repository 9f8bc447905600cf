//! The supervisor: publishes health whatever has stalled, feeds the service manager's watchdog, carries out commands,
//! sees signals, joins the threads and has the files written. It runs in the calling thread.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender, TryRecvError, bounded};
use sd_notify::NotifyState;
use tracing::{error, info, warn};

use super::announce::{Announcer, notify};
use super::camera_commands::CameraDesk;
use super::health::HealthWatch;
use super::map_folder::MapFolder;
use super::recorder::{FinalMap, Outputs, Recorder, SaveKind, Written};
use super::request::{CopyTo, MapRequest, Request};
use super::status::Status;
use super::{DaemonError, Parts, TURN, Threads, start};
use crate::frame::{Clock, monotonic_ns};
use crate::messages::{Command, CommandReply, Health, command_kind, reply_code};
use crate::publish::{self, CommandServer, HealthPublisher, convert};
use crate::telemetry::{RateLimiter, report_suppressed};

/// The supervisor's part of the wire.
pub struct Desk {
    pub health: HealthPublisher,
    pub commands: CommandServer,
}

/// Why a run ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum EndCause {
    /// A recording or simulation came to its end.
    SourceEnded,
    /// The source broke and cannot be opened again.
    SourceFailed,
    /// A signal, or the caller.
    Stopped,
    /// The calibration does not belong to the pictures.
    Calibration(String),
    /// A stage panicked, or did not end when it was told to.
    Broken(String),
}

/// How a run ended, and what is left of it.
#[derive(Debug)]
pub struct End {
    pub cause: EndCause,
    pub map: FinalMap,
    pub written: Written,
}

/// A look at the run, ten times a second.
pub struct Tick<'a> {
    pub status: &'a Status,
    pub elapsed: Duration,
}

/// A stage that has not ended so long after it was told to is given up.
pub(super) const GIVE_UP: Duration = Duration::from_secs(3);
/// The same of the one that has map and trajectory: without its last word they cannot be written.
const LAST_WORD: Duration = Duration::from_secs(8);
/// And of those who write what was handed to them; the unit gives 30 s in all.
const WRITTEN: Duration = Duration::from_secs(23);
/// A save that has not answered after this long is reported as failed.
const SAVE_TIMEOUT: Duration = Duration::from_secs(30);

/// Runs everything until the source ends, `stop` is set, or `go_on` says no.
pub fn supervise(
    parts: Parts,
    desk: Option<Desk>,
    clock: Clock,
    stop: &AtomicBool,
    go_on: &mut dyn FnMut(&Tick<'_>) -> bool,
) -> Result<End, DaemonError> {
    let run = Run::of(&parts, clock);
    Ok(attend(start(parts)?, &run, desk, stop, go_on))
}

/// What the supervisor knows of a run.
pub(super) struct Run {
    status: Arc<Status>,
    outputs: Outputs,
    stall_after: Duration,
    is_found_by_identity: bool,
    clock: Clock,
}

impl Run {
    pub fn of(parts: &Parts, clock: Clock) -> Self {
        Self {
            status: parts.status.clone(),
            outputs: parts.outputs.clone(),
            stall_after: Duration::from_millis(parts.config.daemon.stall_after_ms),
            is_found_by_identity: parts.config.calibration.is_found_by_identity(),
            clock,
        }
    }
}

/// Sees to these threads until they have ended.
pub(super) fn attend(
    threads: Threads,
    run: &Run,
    desk: Option<Desk>,
    stop: &AtomicBool,
    go_on: &mut dyn FnMut(&Tick<'_>) -> bool,
) -> End {
    let Run { status, outputs, stall_after, is_found_by_identity, clock } = run;
    let began = Instant::now();
    let mut watch = HealthWatch::new(status.clone(), *clock, *stall_after, monotonic_ns());
    let requests = threads.requests.clone();
    let maps = threads.maps.clone();
    let camera = CameraDesk::new(threads.camera.clone(), is_found_by_identity.then(|| requests.clone()));
    let mut bench = Bench { desk, saves: Vec::new(), requests, camera, maps, faults: RateLimiter::default() };
    let mut announcer = Announcer::default();
    let (mut stopped_at, mut ordered) = (None, false);
    loop {
        let health = bench.turn(&mut watch);
        let elapsed = began.elapsed();
        announcer.turn(&health, elapsed);
        report_suppressed(false);
        let wanted = !stop.load(Ordering::Relaxed) && go_on(&Tick { status, elapsed });
        // A stage that panics takes the others with it; without one of these they would go on for months.
        let lacks_hands = threads.lack_hands();
        let finished =
            threads.capture.is_finished() && threads.features.is_finished() && threads.reconstruction.is_finished();
        if (!wanted || (lacks_hands && !finished)) && stopped_at.is_none() {
            info!(after_ms = elapsed.as_millis() as u64, "stopping");
            tell_stopping();
            status.request_stop();
            (stopped_at, ordered) = (Some(Instant::now()), !wanted);
        }
        if finished || stopped_at.is_some_and(|at| at.elapsed() > GIVE_UP) {
            break;
        }
        // Short turns near the end, so that joining costs no whole turn.
        thread::sleep(if stopped_at.is_some() || threads.capture.is_finished() { TURN / 20 } else { TURN });
    }
    drop(bench);
    if stopped_at.is_none() {
        tell_stopping();
    }
    wind_up(threads, status, outputs, ordered, stopped_at.unwrap_or_else(Instant::now))
}

/// From now on the service manager's limit for a stop holds, and not its watchdog, which nobody feeds while files are written.
fn tell_stopping() {
    notify(&[NotifyState::Stopping, NotifyState::WatchdogUsec(u32::MAX)]);
}

impl Threads {
    /// Somebody has ended who works for the stages: when they do, or in a panic. (Whoever keeps the map file may end before, and it is told that
    /// nothing is written.)
    fn lack_hands(&self) -> bool {
        self.mapping.is_finished() || self.places.is_finished() || self.recorder.is_finished()
    }
}

/// Joins what ends, writes the files, and says how it went. `stopped`: by order, and the stages were told so `at`.
fn wind_up(threads: Threads, status: &Arc<Status>, outputs: &Outputs, stopped: bool, at: Instant) -> End {
    let Threads { capture, features, reconstruction, mapping, places, recorder, map_file, requests, camera, maps: _ } =
        threads;
    drop((requests, camera));
    let mut cause = if stopped { EndCause::Stopped } else { EndCause::SourceEnded };
    match join(capture, "capture", at + GIVE_UP) {
        Ok(true) if !stopped => cause = EndCause::SourceFailed,
        Ok(_) => {}
        Err(broken) => cause = broken,
    }
    if let Err(broken) = join(features, "features", at + GIVE_UP) {
        cause = broken;
    }
    let (mut map, mut outputs) = (FinalMap::default(), outputs.clone());
    let has_ended = wait(&reconstruction, at + LAST_WORD);
    match join(reconstruction, "reconstruction", at + LAST_WORD) {
        Ok(Ok(last)) => map = last,
        Ok(Err(reason)) => {
            status.set_calibration_refused(true);
            error!(reason, "calibration does not fit");
            (cause, outputs) = (EndCause::Calibration(reason), Outputs::default());
        }
        // Without its last word nothing true can be written of the map; older files stay as they are.
        Err(broken) => (cause, outputs) = (broken, outputs.without_map()),
    }
    let mut written = Written::default();
    // While it hangs it holds their queues open.
    if has_ended {
        for (hands, stage) in [(mapping, "mapping"), (places, "places")] {
            // One that is at a job still is left to it.
            if wait(&hands, Instant::now() + TURN)
                && let Err(broken) = join(hands, stage, at)
            {
                cause = broken;
            }
        }
        // What is in the queues may take a slow disk a while.
        match join(recorder, "recorder", at + WRITTEN) {
            Ok(mut recorder) => written = Recorder::write(&mut recorder, &outputs, &map),
            Err(broken) => cause = broken,
        }
        if let Some(keeper) = map_file {
            match join(keeper, "map file", at + WRITTEN) {
                Ok(outcome) => written.note_map(outcome),
                Err(broken) => cause = broken,
            }
        }
    }
    for failure in &written.failures {
        error!(reason = failure, "file not written");
    }
    info!(cause = ?cause, frames = status.captured.get(), tracked = status.tracked.get(), "ended");
    End { cause, map, written }
}

/// Waits for a thread that is about to end; whether it has.
fn wait<T>(handle: &JoinHandle<T>, deadline: Instant) -> bool {
    while !handle.is_finished() && Instant::now() < deadline {
        thread::sleep(Duration::from_millis(2));
    }
    handle.is_finished()
}

/// The same, and what it gives; one that does not end is left behind.
fn join<T>(handle: JoinHandle<T>, stage: &'static str, deadline: Instant) -> Result<T, EndCause> {
    if !wait(&handle, deadline) {
        error!(stage, "stage does not end, left behind");
        return Err(EndCause::Broken(format!("the {stage} stage hangs")));
    }
    handle.join().map_err(|_| {
        error!(stage, "stage panicked");
        EndCause::Broken(format!("the {stage} stage panicked"))
    })
}

/// A save (or another command that a stage carries out) under way: who waits for it.
struct Save {
    request: publish::Request,
    outcome: Receiver<Result<String, String>>,
    began: Instant,
    /// Its failure is a file that was not written.
    writes: bool,
}

/// What the supervisor does ten times a second.
struct Bench {
    desk: Option<Desk>,
    saves: Vec<Save>,
    requests: Sender<Request>,
    camera: CameraDesk,
    /// Where maps are kept by name; `None`: no commands on them.
    maps: Option<MapFolder>,
    faults: RateLimiter,
}

impl Bench {
    /// The health that was published.
    fn turn(&mut self, watch: &mut HealthWatch) -> Health {
        let now_ns = monotonic_ns();
        let health = watch.tick(now_ns);
        if watch.all_alive(now_ns) {
            notify(&[NotifyState::Watchdog]);
        }
        let Some(desk) = self.desk.as_mut() else { return health };
        if let Err(error) = desk.health.publish(&health)
            && let Some(messages) = self.faults.event(now_ns)
        {
            warn!(messages, %error, "health cannot be sent");
        }
        self.take_commands();
        self.answer_saves(watch);
        self.camera.answer();
        health
    }

    fn take_commands(&mut self) {
        // A few a turn, so that a flood of commands delays no health.
        for _ in 0..4 {
            let received = self.desk.as_mut().map_or(Ok(None), |desk| desk.commands.receive());
            match received {
                Ok(Some(request)) => self.carry_out(request),
                Ok(None) => return,
                Err(error) => {
                    if let Some(times) = self.faults.event(monotonic_ns()) {
                        warn!(times, %error, "command cannot be received");
                    }
                    return;
                }
            }
        }
    }

    fn carry_out(&mut self, request: publish::Request) {
        let command = *request.command();
        info!(kind = command.kind, path = command.path(), "command");
        let kind = match command.kind {
            command_kind::RESET => {
                let sent = self.requests.try_send(Request::Reset { why: "command" });
                reply(
                    request,
                    match sent {
                        Ok(()) => (reply_code::OK, "the map is dropped, a new one begins"),
                        Err(_) => (reply_code::BUSY, "the reconstruction stage does not take requests at the moment"),
                    },
                );
                return;
            }
            command_kind::SAVE_TRAJECTORY => SaveKind::Trajectory,
            command_kind::SAVE_MAP => SaveKind::Map,
            command_kind::SET_POSE => return self.set_pose(request),
            command_kind::LOAD_MAP
            | command_kind::MERGE_MAP
            | command_kind::STORE_MAP
            | command_kind::NEW_MAP
            | command_kind::LOCALISE
            | command_kind::LIST_MAPS
            | command_kind::COPY_MAP => return self.map_command(request),
            command_kind::CAMERA_CONTROLS
            | command_kind::SET_CAMERA
            | command_kind::CAMERA_IDENTITY
            | command_kind::KEEP_CALIBRATION => return self.camera.take(request),
            _ => {
                request.refuse();
                return;
            }
        };
        let path = match command.path().map(PathBuf::from) {
            Some(path) if path.is_absolute() => path,
            _ => return reply(request, (reply_code::INVALID, "the path must be absolute and UTF-8")),
        };
        let (sender, outcome) = bounded(1);
        match self.requests.try_send(Request::Save { kind, path, reply: sender }) {
            Ok(()) => self.saves.push(Save { request, outcome, began: Instant::now(), writes: true }),
            Err(_) => reply(request, (reply_code::BUSY, "other requests are under way")),
        }
    }

    fn map_command(&mut self, request: publish::Request) {
        let Some(folder) = &self.maps else {
            return reply(request, (reply_code::UNSUPPORTED, "this run keeps no maps"));
        };
        let asked = match map_request(request.command(), folder) {
            Ok(asked) => asked,
            Err(reason) => return reply(request, (reply_code::INVALID, &reason)),
        };
        let (sender, outcome) = bounded(1);
        match self.requests.try_send(Request::Map { request: asked, reply: sender }) {
            Ok(()) => self.saves.push(Save { request, outcome, began: Instant::now(), writes: false }),
            Err(_) => reply(request, (reply_code::BUSY, "other requests are under way")),
        }
    }

    fn set_pose(&mut self, request: publish::Request) {
        let command = request.command();
        let Some(map_from_body) = convert::from_wire(&command.position, &command.orientation) else {
            let why = "position must be finite, at most 1e6 map units, and orientation a unit quaternion (x, y, z, w)";
            return reply(request, (reply_code::INVALID, why));
        };
        let (sender, outcome) = bounded(1);
        match self.requests.try_send(Request::SetPose { map_from_body, reply: sender }) {
            Ok(()) => self.saves.push(Save { request, outcome, began: Instant::now(), writes: false }),
            Err(_) => reply(request, (reply_code::BUSY, "other requests are under way")),
        }
    }

    fn answer_saves(&mut self, watch: &mut HealthWatch) {
        for save in std::mem::take(&mut self.saves) {
            let outcome = match save.outcome.try_recv() {
                Ok(outcome) => outcome,
                Err(TryRecvError::Empty) if save.began.elapsed() < SAVE_TIMEOUT => {
                    self.saves.push(save);
                    continue;
                }
                Err(_) => Err("no answer from the stage that is asked".into()),
            };
            if save.writes {
                watch.save_failed = outcome.is_err();
            }
            match &outcome {
                Ok(text) => reply(save.request, (reply_code::OK, text)),
                Err(reason) => {
                    warn!(reason, "command not carried out");
                    reply(save.request, (reply_code::FAILED, reason));
                }
            }
        }
    }
}

/// What a command on maps asks for; the error says what is wrong with its name.
fn map_request(command: &Command, folder: &MapFolder) -> Result<MapRequest, String> {
    let text = command.path().ok_or("the name is not UTF-8")?;
    Ok(match command.kind {
        command_kind::LOAD_MAP => MapRequest::Load(folder.file(text)?),
        command_kind::MERGE_MAP => MapRequest::Merge(folder.file(text)?),
        command_kind::STORE_MAP if text.is_empty() => MapRequest::Store,
        command_kind::STORE_MAP => MapRequest::Copy(CopyTo::Named(folder.file(text)?, folder.clone())),
        command_kind::NEW_MAP => MapRequest::New(folder.file(text)?, folder.clone()),
        command_kind::COPY_MAP => MapRequest::Copy(CopyTo::Sender(folder.clone())),
        command_kind::LIST_MAPS => MapRequest::List(folder.clone(), text.into()),
        _ => match text {
            "on" => MapRequest::Localise(true),
            "off" => MapRequest::Localise(false),
            other => return Err(format!("{other:?}: on or off")),
        },
    })
}

/// Answers a command; a sender that has gone needs no answer.
fn reply(request: publish::Request, (code, message): (u32, &str)) {
    let _ = request.reply(CommandReply::new(code, message));
}
