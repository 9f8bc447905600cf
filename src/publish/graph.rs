//! `PREFIX/graph`: covisibility, closed loops and joins of the map, made only while somebody subscribes.

use crate::map::MapSnapshot;
use crate::map::graph::{EdgeView, MapGraph, Tie};
use crate::messages::{EDGE_COVISIBLE, EDGE_JOIN, EDGE_LOOP, GraphEdge, GraphHeader, NO_MAP};

use super::ports::Port;
use super::{Conversion, MapContext, PublishError, convert, count};
use crate::frame::monotonic_ns;

/// See module.
#[derive(Debug)]
pub struct GraphPublisher {
    pub(super) port: Port<[GraphEdge], GraphHeader>,
    pub(super) run_id: u64,
}

impl GraphPublisher {
    /// Somebody wants the graph.
    pub fn is_wanted(&self) -> bool {
        self.port.subscribers() > 0
    }

    /// Sends the graph of the map that `snapshot` is of, if somebody subscribes; tells whether it was sent. `graph` has at most
    /// [`MAX_EDGES`](crate::messages::services::MAX_EDGES) edges. To be called before that snapshot is sent: who wakes by the map finds its graph.
    pub fn publish(
        &mut self,
        graph: &MapGraph,
        snapshot: &MapSnapshot,
        conversion: &Conversion,
        context: &MapContext,
    ) -> Result<bool, PublishError> {
        if !self.is_wanted() {
            return Ok(false);
        }
        let edges = self.port.fill(&graph.edges, edge)?;
        let header = GraphHeader {
            run_id: self.run_id,
            content_revision: snapshot.revision,
            timestamp_ns: context.timestamp_ns,
            published_ns: monotonic_ns(),
            count: count(graph.edges.len()),
            total: count(graph.total),
            map_id: snapshot.map.0,
            reset_counter: context.reset_counter,
            map_revision: context.map_revision,
            clock: convert::clock(conversion.clock),
            map_mode: context.map_mode,
            reserved: [0; 10],
        };
        self.port.send_filled(edges, header)?;
        Ok(true)
    }
}

fn edge(edge: &EdgeView) -> GraphEdge {
    let (kind, joined_map) = match edge.tie {
        Tie::Covisible => (EDGE_COVISIBLE, NO_MAP),
        Tie::Loop => (EDGE_LOOP, NO_MAP),
        Tie::Join(map) => (EDGE_JOIN, map.0),
    };
    GraphEdge { from: edge.from.0, to: edge.to.0, shared: edge.shared, joined_map, kind, reserved: [0; 3] }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::{KeyframeId, MapId};

    #[test]
    fn every_tie_has_its_kind_and_a_join_the_number_of_its_map() {
        let view = |tie| EdgeView { from: KeyframeId(3), to: KeyframeId(9), shared: 5, tie };
        let sent = [Tie::Covisible, Tie::Loop, Tie::Join(MapId(2))].map(|tie| edge(&view(tie)));
        assert_eq!(sent.map(|e| e.kind), [EDGE_COVISIBLE, EDGE_LOOP, EDGE_JOIN]);
        assert_eq!(sent.map(|e| e.joined_map), [NO_MAP, NO_MAP, 2]);
        assert!(sent.iter().all(|e| (e.from, e.to, e.shared, e.reserved) == (3, 9, 5, [0; 3])));
    }
}
