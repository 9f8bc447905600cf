//! What stands around the robot, and where the floor is free: the daemon makes it while a page asks for it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::source::{LOOK, NAP, Source, while_wanted};
use crate::client::ClientError;
use crate::console::hub::{Hub, demand, lock};
use crate::console::wire::{self, Kind};

/// How often it is said why there is nothing: a page takes what it was told longer ago for old.
const AGAIN: Duration = Duration::from_secs(1);

/// Until `stop`.
pub fn run(hub: &Hub, source: &Source, stop: &AtomicBool) {
    while_wanted(stop, || hub.wants(demand::OBSTACLES), || follow(hub, source, stop));
}

/// While somebody looks.
fn follow(hub: &Hub, source: &Source, stop: &AtomicBool) -> Result<(), ClientError> {
    let client = source.client()?;
    let mut scans = client.obstacles().polled(LOOK);
    let mut silent = None;
    while !stop.load(Ordering::Relaxed) && hub.wants(demand::OBSTACLES) {
        let Some(scan) = scans.wait(NAP)? else { continue };
        let epoch = lock(&hub.history).epoch(scan.run_id, scan.map_id, scan.reset_counter, scan.map_revision);
        // Why there is nothing is said once a second, not seven times.
        let why = (!scan.is_told()).then_some((scan.told, epoch));
        if why.is_some() && silent.is_some_and(|(said, at): (_, Instant)| why == Some(said) && at.elapsed() < AGAIN) {
            continue;
        }
        silent = why.map(|why| (why, Instant::now()));
        hub.tell(Kind::Obstacles, demand::OBSTACLES, &wire::obstacles(&scan, epoch));
    }
    Ok(())
}
