//! Places that are known again, without threads and in lock-step: after a covered lens, on another day, in rooms that look alike, and
//! recordings in their own maps; and hours in one building. Short forms are tests but for the hours; the ignored ones print the tables of
//! `tests/results/make places` and `hours`.
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

/// A number of the environment.
fn number(name: &str, default: usize) -> usize {
    std::env::var(name).map_or(default, |text| text.parse().unwrap_or_else(|_| panic!("{name}={text} is no number")))
}

fn seeds(count: usize) -> Range<u64> {
    let first = number("FIRST_SEED", 501) as u64;
    first..first + count as u64
}
