//! What holds the map together: loops and joins while a page shows the map, covisibility while one asks for it, too.

use std::sync::atomic::{AtomicBool, Ordering};

use super::source::{LOOK, NAP, Source, while_wanted};
use crate::client::ClientError;
use crate::console::hub::{Hub, demand, lock};
use crate::console::wire::{self, Kind, MapHead};
use crate::messages::{EDGE_COVISIBLE, SCALE_UNKNOWN};

/// Until `stop`.
pub fn run(hub: &Hub, source: &Source, stop: &AtomicBool) {
    while_wanted(stop, || hub.wants(demand::MAP), || follow(hub, source, stop));
}

/// While somebody looks.
fn follow(hub: &Hub, source: &Source, stop: &AtomicBool) -> Result<(), ClientError> {
    let client = source.client()?;
    let mut graphs = client.graph().polled(LOOK);
    let (mut told, mut told_covisible) = (None, None);
    while !stop.load(Ordering::Relaxed) && hub.wants(demand::MAP) {
        let Some(graph) = graphs.wait(NAP)? else { continue };
        let h = graph.header();
        let epoch = lock(&hub.history).epoch(h.run_id, h.map_id, h.reset_counter, h.map_revision);
        // Lines have no length of their own: the scale is the keyframes'.
        let head = MapHead { epoch, total: h.total, scale: SCALE_UNKNOWN, revision: h.content_revision };
        let ties = graph.iter().take_while(|e| e.kind != EDGE_COVISIBLE).count();
        let (ties, covisible) = graph.split_at(ties);
        // The same content again, as while the robot stands, costs no page anything.
        let content = (h.run_id, h.content_revision, epoch);
        if told.replace(content) != Some(content) {
            hub.tell(Kind::Ties, demand::MAP, &wire::edges(Kind::Ties, ties, &head));
        }
        if hub.wants(demand::COVISIBLE) && told_covisible.replace(content) != Some(content) {
            hub.tell(Kind::Covisible, demand::COVISIBLE, &wire::edges(Kind::Covisible, covisible, &head));
        }
    }
    Ok(())
}
