//! One calibration from start to end, as steps: orders of pages, pictures, and time that passes. No thread and no clock of its own.

use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use tracing::error;

use super::guided::{Board, Calibrator, Camera, Glance, Guidance, Guided, Outcome, Picture};
use crate::telemetry::contained;

/// It ends by itself after this time with what there is, as `cairn calibrate` does.
pub const LIMIT: Duration = Duration::from_secs(300);
/// Without a picture for so long it is given up, as `cairn calibrate` does.
pub const SILENCE: Duration = Duration::from_secs(10);
/// Largest picture, px: what `[camera] width_px` and `height_px` allow.
pub const MAX_PIXELS: usize = 1920 * 1200;

/// What a page may ask for.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub enum Action {
    Start {
        board: Board,
    },
    /// Takes what there is.
    Finish {},
    /// Has the daemon keep the outcome for its camera.
    Save {},
    /// Gives it up, or puts its outcome away.
    Cancel {},
}

/// Has the daemon keep a calibration, the text of its file, for its camera; the sentence says where.
pub type Keep<'a> = dyn Fn(&str) -> Result<String, String> + 'a;

#[derive(Debug)]
enum State {
    Idle,
    Running(Running),
    Done(Done),
    Failed { board: Board, why: String },
}

#[derive(Debug)]
struct Running {
    board: Board,
    guided: Box<dyn Guided>,
    guidance: Guidance,
    glance: Option<Glance>,
    begun: Instant,
    last_picture: Instant,
    /// The daemon that the pictures are from.
    run_id: Option<u64>,
    /// `None`: nobody has looked yet.
    camera: Option<Option<Camera>>,
}

#[derive(Debug)]
struct Done {
    board: Board,
    guidance: Guidance,
    outcome: Outcome,
    why: &'static str,
    camera: Option<Camera>,
    saved: Option<String>,
}

/// What pages are told.
#[derive(Debug, Default, Serialize)]
pub struct Told<'a> {
    /// `idle`, `running`, `done`, `failed`.
    pub phase: &'static str,
    /// Number of the calibration, from 1, and the `id` of the order that began it: a page knows its own.
    pub run: u32,
    pub by: u32,
    pub sentence: &'a str,
    pub board: Option<&'a Board>,
    pub seconds: u64,
    pub limit_s: u64,
    pub glance: Option<&'a Glance>,
    pub guidance: Option<&'a Guidance>,
    pub outcome: Option<&'a Outcome>,
    pub camera: Option<&'a Camera>,
    pub saved: Option<&'a str>,
    pub terminal: String,
}

/// See module.
#[derive(Debug)]
pub struct Session {
    calibrator: Arc<dyn Calibrator>,
    run: u32,
    by: u32,
    state: State,
}

impl Session {
    pub fn new(calibrator: Arc<dyn Calibrator>) -> Self {
        Self { calibrator, run: 0, by: 0, state: State::Idle }
    }

    pub fn is_running(&self) -> bool {
        matches!(self.state, State::Running(_))
    }

    /// A step of it. One that panics, a defect of whoever calibrates, ends this calibration and not those that come after it; the error says so.
    pub fn guarded<T>(&mut self, step: impl FnOnce(&mut Self) -> T) -> Result<T, String> {
        contained(|| step(self)).map_err(|panic| {
            let reason = format!("a defect of the program, please report it: {panic}");
            error!(reason, "console: a calibration broke");
            self.fail(reason.clone());
            reason
        })
    }

    /// An order of a page; the sentence says what became of it. `id`: the order's; `keep` has the daemon keep the text of a calibration.
    pub fn obey(&mut self, action: Action, id: u32, now: Instant, keep: &Keep<'_>) -> Result<String, String> {
        match action {
            Action::Start { board } => self.start(board, id, now),
            Action::Finish {} => match &self.state {
                State::Running(running) if running.guidance.solved => {
                    self.end("stopped");
                    Ok("calibrated with the views that there are".into())
                }
                State::Running(running) => {
                    Err(format!("{} views are too few to calibrate from", running.guidance.views))
                }
                _ => Err("no calibration is under way".into()),
            },
            Action::Save {} => self.save(keep),
            Action::Cancel {} => match std::mem::replace(&mut self.state, State::Idle) {
                State::Idle => Err("no calibration is under way".into()),
                State::Running(_) => Ok("the calibration is cancelled, and nothing is kept of it".into()),
                State::Done(_) | State::Failed { .. } => Ok("put away".into()),
            },
        }
    }

    fn start(&mut self, board: Board, id: u32, now: Instant) -> Result<String, String> {
        if let State::Running(running) = &self.state {
            return Err(format!(
                "a calibration is under way ({} views of a board of {}x{}): only one at a time; it can be cancelled here",
                running.guidance.views, running.board.columns, running.board.rows
            ));
        }
        let guided = self.calibrator.begin(&board)?;
        let guidance = guided.guidance();
        let said = format!("show a board of {}x{} inner corners", board.columns, board.rows);
        (self.run, self.by) = (self.run.wrapping_add(1), id);
        self.state = State::Running(Running {
            board,
            guided,
            guidance,
            glance: None,
            begun: now,
            last_picture: now,
            run_id: None,
            camera: None,
        });
        Ok(said)
    }

    fn save(&mut self, keep: &Keep<'_>) -> Result<String, String> {
        let State::Done(done) = &mut self.state else { return Err("no calibration is finished".into()) };
        if done.camera.is_none() {
            return Err("the daemon has no camera that it could be kept for: download the file instead".into());
        }
        let said = keep(&done.outcome.file)?;
        done.saved = Some(said.clone());
        Ok(said)
    }

    /// A picture of the camera.
    pub fn look(&mut self, picture: Picture) {
        let State::Running(running) = &mut self.state else { return };
        if picture.width * picture.height > MAX_PIXELS || picture.pixels.len() != picture.width * picture.height {
            let (width, height) = (picture.width, picture.height);
            return self.fail(format!("pictures of {width}x{height} px are larger than a calibration takes"));
        }
        if *running.run_id.get_or_insert(picture.run_id) != picture.run_id {
            // It may have another camera, and views of two cameras are those of none.
            return self.fail("the daemon was started anew: begin again".into());
        }
        let glance = running.guided.look(picture);
        // Views change it, and the picture after one.
        running.guidance = running.guided.guidance();
        running.glance = Some(glance);
        if running.guided.is_done() {
            self.end("done");
        }
    }

    /// The picture is dealt with, however long that took: from now on the next one is waited for.
    pub fn wait(&mut self, now: Instant) {
        if let State::Running(running) = &mut self.state {
            running.last_picture = now;
        }
    }

    /// Time passes; whether something came of it.
    pub fn turn(&mut self, now: Instant) -> bool {
        let State::Running(running) = &self.state else { return false };
        if now.duration_since(running.last_picture) > SILENCE {
            let silence = SILENCE.as_secs();
            self.fail(format!("no picture for {silence} s: is the daemon running, and the camera there?"));
        } else if now.duration_since(running.begun) > LIMIT {
            self.end("the time is over");
        }
        !self.is_running()
    }

    /// The daemon whose camera is not known so far.
    pub fn nameless(&self) -> Option<u64> {
        match &self.state {
            State::Running(Running { camera: None, run_id, .. }) => *run_id,
            _ => None,
        }
    }

    pub fn name(&mut self, camera: Option<Camera>) {
        if let State::Running(running) = &mut self.state {
            running.camera = Some(camera);
        }
    }

    fn fail(&mut self, why: String) {
        if let State::Running(Running { board, .. }) = std::mem::replace(&mut self.state, State::Idle) {
            self.state = State::Failed { board, why };
        }
    }

    /// With what there is.
    fn end(&mut self, why: &'static str) {
        let State::Running(running) = &self.state else { return };
        // While it is running still: what panics here is that calibration's end.
        let outcome = running.guided.outcome();
        let State::Running(running) = std::mem::replace(&mut self.state, State::Idle) else { return };
        let Running { board, guidance, camera, .. } = running;
        self.state = match outcome {
            Some(outcome) => State::Done(Done { board, guidance, outcome, why, camera: camera.flatten(), saved: None }),
            None => {
                State::Failed { board, why: format!("{why}: {} views are too few to calibrate from", guidance.views) }
            }
        };
    }

    /// For pages.
    pub fn told(&self, now: Instant) -> Told<'_> {
        let told = Told { run: self.run, by: self.by, limit_s: LIMIT.as_secs(), ..Told::default() };
        match &self.state {
            State::Idle => Told { phase: "idle", ..told },
            State::Failed { board, why } => {
                Told { phase: "failed", sentence: why, board: Some(board), terminal: board.terminal(None), ..told }
            }
            State::Running(r) => {
                let camera = r.camera.as_ref().and_then(Option::as_ref);
                Told {
                    phase: "running",
                    sentence: r.glance.as_ref().map_or("waiting for a picture", |g| &g.advice),
                    board: Some(&r.board),
                    seconds: now.duration_since(r.begun).as_secs(),
                    glance: r.glance.as_ref(),
                    guidance: Some(&r.guidance),
                    camera,
                    terminal: r.board.terminal(camera.map(|c| c.device.as_str())),
                    ..told
                }
            }
            State::Done(d) => Told {
                phase: "done",
                sentence: d.why,
                board: Some(&d.board),
                guidance: Some(&d.guidance),
                outcome: Some(&d.outcome),
                camera: d.camera.as_ref(),
                saved: d.saved.as_deref(),
                terminal: d.board.terminal(d.camera.as_ref().map(|c| c.device.as_str())),
                ..told
            },
        }
    }
}

#[cfg(test)]
mod tests;
