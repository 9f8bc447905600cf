//! The part of the client for C that shows what holds the map together.

use std::time::Duration;

use super::{Handle, failed, hand_over, newest};
use crate::client::Graph;
use crate::messages::{GraphEdge, GraphHeader};

/// What holds the map together, in shared memory; never changes. Two may be held at a time.
#[repr(C)]
pub struct GraphView {
    /// What the edges are a picture of.
    pub header: *const GraphHeader,
    /// `count` edges.
    pub edges: *const GraphEdge,
    pub count: usize,
    /// For `cairn_graph_release`.
    pub held: *mut GraphHold,
}

/// Keeps a graph in shared memory.
pub struct GraphHold(#[expect(dead_code, reason = "held until it is dropped")] Graph);

/// The next graph that has not been read, waiting for it if need be. From the first call until `cairn_close` or `cairn_graph_stop` the daemon
/// makes one with every map. Release it with `cairn_graph_release`.
///
/// # Safety
/// `client` comes from `cairn_connect`; `graph` may be written.
#[unsafe(no_mangle)] // SAFETY: every name begins with `cairn_` and is defined once, here.
pub unsafe extern "C" fn cairn_graph_wait(client: *mut Handle, timeout_ns: u64, graph: *mut GraphView) -> i32 {
    let handle = handle!(client);
    let graphs = handle.graphs.get_or_insert_with(|| handle.client.graph());
    let item = newest(graphs, Duration::from_nanos(timeout_ns));
    let view = |graph: Graph| GraphView {
        header: graph.header(),
        edges: graph.as_ptr(),
        count: graph.len(),
        held: Box::into_raw(Box::new(GraphHold(graph))),
    };
    // SAFETY: the caller's promise.
    unsafe { hand_over(item, graph, view) }
}

/// Gives a graph back; the view is empty then. Null and empty views are left alone.
///
/// # Safety
/// `graph` is null or was filled by `cairn_graph_wait`, and is zeroed or unchanged since.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_graph_release(graph: *mut GraphView) {
    // SAFETY: the caller's promise; what is held came out of `Box::into_raw` and is taken once.
    if let Some(graph) = unsafe { graph.as_mut() }
        && !graph.held.is_null()
    {
        // SAFETY: as above.
        drop(unsafe { Box::from_raw(graph.held) });
        *graph =
            GraphView { header: core::ptr::null(), edges: core::ptr::null(), count: 0, held: core::ptr::null_mut() };
    }
}

/// No more graphs are wanted.
///
/// # Safety
/// `client` is null or comes from `cairn_connect`.
#[unsafe(no_mangle)] // SAFETY: as above
pub unsafe extern "C" fn cairn_graph_stop(client: *mut Handle) {
    // SAFETY: the caller's promise; null is looked at.
    if let Some(handle) = unsafe { client.as_mut() } {
        handle.graphs = None;
    }
}
