//! Where the map's tags are: the daemon tells it while a page shows the map.

use std::sync::atomic::{AtomicBool, Ordering};

use super::source::{LOOK, NAP, Source, while_wanted};
use crate::client::ClientError;
use crate::console::hub::{Hub, demand, lock};
use crate::console::wire::{self, Kind};

/// Until `stop`.
pub fn run(hub: &Hub, source: &Source, stop: &AtomicBool) {
    while_wanted(stop, || hub.wants(demand::MAP), || follow(hub, source, stop));
}

/// While somebody looks.
fn follow(hub: &Hub, source: &Source, stop: &AtomicBool) -> Result<(), ClientError> {
    let client = source.client()?;
    let mut tags = client.tags().polled(LOOK);
    let mut told = None;
    while !stop.load(Ordering::Relaxed) && hub.wants(demand::MAP) {
        let Some(list) = tags.wait(NAP)? else { continue };
        let epoch = lock(&hub.history).epoch(list.run_id, list.map_id, list.reset_counter, list.map_revision);
        // The same content again, as while the robot stands, costs no page anything.
        let content = (list.run_id, list.content_revision, epoch);
        if told.replace(content) != Some(content) {
            hub.tell(Kind::Tags, demand::MAP, &wire::tags(&list, epoch));
        }
    }
    Ok(())
}
