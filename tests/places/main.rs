//! Places that are known again, without threads and in lock-step: after a covered lens, on another day, in rooms that look alike, and
//! recordings in their own maps; and hours in one building. Short forms are tests but for the hours; the ignored ones print the tables of
//! `tests/results/make places`, `long_drives` and `hours`.
//!
//! `TRIALS`: how many there are in a table; `FIRST_SEED`: of the rooms, 1 to 20 are for development; `DETAILED`: keyframes of the recordings that are not
//! condensed.

mod hours;
mod merging;
mod recordings;
mod robot;
mod rooms;
#[path = "../support/recordings.rs"]
mod support;

use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

/// A number of the environment.
fn number(name: &str, default: usize) -> usize {
    std::env::var(name).map_or(default, |text| text.parse().unwrap_or_else(|_| panic!("{name}={text} is no number")))
}

fn seeds(count: usize) -> Range<u64> {
    let first = number("FIRST_SEED", 501) as u64;
    first..first + count as u64
}

/// What becomes of each of these rooms, in their order; as many at once as there are cores.
fn each<T: Send>(rooms: Range<u64>, of: impl Fn(u64) -> T + Sync) -> Vec<T> {
    let next = AtomicU64::new(rooms.start);
    let work = || {
        let mut own = Vec::new();
        loop {
            let seed = next.fetch_add(1, Ordering::Relaxed);
            if !rooms.contains(&seed) {
                return own;
            }
            own.push((seed, of(seed)));
        }
    };
    let mut all: Vec<(u64, T)> = std::thread::scope(|scope| {
        let cores = std::thread::available_parallelism().map_or(1, |n| n.get());
        let workers: Vec<_> = (0..cores).map(|_| scope.spawn(work)).collect();
        workers.into_iter().flat_map(|worker| worker.join().expect("no trial panics")).collect()
    });
    all.sort_by_key(|(seed, _)| *seed);
    all.into_iter().map(|(_, outcome)| outcome).collect()
}
