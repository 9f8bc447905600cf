//! What pages ask for that takes its time: commands to the daemon, the two-picture chain, and calibrations; one at a time of each.

use std::sync::Arc;
use std::time::Duration;

use crossbeam::channel::{Sender, TrySendError, bounded};
use serde_json::json;
use tracing::info;

use super::calibration::Desk;
use super::commands::Action;
use super::feed::Source;
use super::outbox::Outbox;
use super::pair::{Method, Pair, Which};
use super::session::{Job, Order};
use super::wire::{self, Kind};

/// Jobs of a kind that wait for the one before.
const WAITING: usize = 4;
/// Where more wait.
const BUSY: &str = "others are under way: try again";
/// A page takes the next picture of a chain within this, or is given up, so that it does not hold up others' chains.
const READ_WITHIN: Duration = Duration::from_secs(10);
const SLOW: &str = "this page did not take the pictures in time: run the chain again";

type Queue = Sender<(Arc<Outbox>, u32, Job)>;

/// Starts the two workers; jobs given to the result are theirs, or go to the `desk` of calibrations. They end when it is dropped and are not waited for: a daemon that hangs may hold a
/// command for half a minute.
pub fn start(source: &Arc<Source>, pair: &Arc<Pair>, desk: &Arc<Desk>) -> Order {
    let (commands, chains) = (worker(source, pair), worker(source, pair));
    let (prefix, desk) = (source.prefix().to_owned(), desk.clone());
    Box::new(move |page, id, job| {
        let job = match job {
            Job::Calibrate(action) => {
                if desk.orders.try_send((page.clone(), id, action)).is_err() {
                    answer(page, id, "", Err(BUSY.into()), false);
                }
                return;
            }
            job => job,
        };
        let queue: &Queue = if matches!(job, Job::Command(_)) { &commands } else { &chains };
        if let Err(TrySendError::Full((page, id, job)) | TrySendError::Disconnected((page, id, job))) =
            queue.try_send((page.clone(), id, job))
        {
            let terminal = if let Job::Command(action) = job { action.terminal(&prefix) } else { String::new() };
            answer(&page, id, &terminal, Err(BUSY.into()), false);
        }
    })
}

fn worker(source: &Arc<Source>, pair: &Arc<Pair>) -> Queue {
    let (queue, jobs) = bounded::<(Arc<Outbox>, u32, Job)>(WAITING);
    let (source, pair) = (source.clone(), pair.clone());
    std::thread::spawn(move || {
        for (page, id, job) in jobs {
            match job {
                Job::Command(action) => command(&source, &page, id, &action),
                Job::Take(which) => take(&source, &page, id, which, &pair),
                Job::Chain(method) => chain(&page, id, method, &pair),
                // Not given to these workers.
                Job::Calibrate(_) => {}
            }
        }
    });
    queue
}

fn command(source: &Source, page: &Outbox, id: u32, action: &Action) {
    let done = source.client().map_err(|e| e.to_string()).and_then(|client| action.carry_out(&client));
    let terminal = action.terminal(source.prefix());
    info!(terminal, ok = done.is_ok(), "console: command");
    answer(page, id, &terminal, done, false);
}

fn take(source: &Source, page: &Outbox, id: u32, which: Which, pair: &Pair) {
    let done = pair.take(which, source.prefix()).map(|png| {
        page.put(Kind::Picture, wire::picture(which.name(), &png));
        format!("picture {} is taken", which.name().to_uppercase())
    });
    answer(page, id, &which.terminal(source.prefix()), done, false);
}

fn chain(page: &Outbox, id: u32, method: Method, pair: &Pair) {
    match pair.reconstruct(method) {
        Ok(done) => {
            let mut pictures = done.pictures.iter();
            let is_read =
                pictures.all(|(name, png)| page.put_in_turn(Kind::Picture, wire::picture(name, png), READ_WITHIN));
            let outcome = if is_read { Ok(done.text) } else { Err(SLOW.into()) };
            answer(page, id, &done.terminal, outcome, true);
        }
        Err(reason) => answer(page, id, "", Err(reason), true),
    }
}

/// What became of an order of a calibration.
pub fn calibration(page: &Outbox, id: u32, terminal: &str, done: Result<String, String>) {
    answer(page, id, terminal, done, false);
}

/// What became of a job, to the page that asked for it.
fn answer(page: &Outbox, id: u32, terminal: &str, done: Result<String, String>, chain: bool) {
    let (ok, text) = match done {
        Ok(text) => (true, text),
        Err(text) => (false, text),
    };
    let said = json!({ "id": id, "ok": ok, "text": text, "terminal": terminal, "chain": chain });
    page.put(Kind::Reply, wire::json(Kind::Reply, &said));
}
