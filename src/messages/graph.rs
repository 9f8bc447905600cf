//! What holds the map together: which keyframes see the same, which loops were closed, which maps were joined.

use iceoryx2::prelude::ZeroCopySend;

/// `kind` of an edge: both keyframes see the same landmarks.
pub const EDGE_COVISIBLE: u8 = 0;
/// `kind` of an edge: a loop was closed, the newer keyframe showed the place of the older one again.
pub const EDGE_LOOP: u8 = 1;
/// `kind` of an edge: another map was joined to this one, by a keyframe that showed a place of it.
pub const EDGE_JOIN: u8 = 2;

/// Two keyframes that belong together; `PREFIX/graph` carries a slice of them: joins, then loops, oldest first each, then what is covisible, strongest
/// first.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[type_name("cairn.GraphEdge.v1")]
pub struct GraphEdge {
    /// As in [`super::Keyframe::id`]: the older one; of a join, the one of the map that was joined.
    pub from: u32,
    /// As in [`super::Keyframe::id`]: the newer one; of a join, the one that showed the other map's place.
    pub to: u32,
    /// Landmarks that both see now.
    pub shared: u32,
    /// Of a join: what [`super::Pose::map_id`] the other map had; else [`super::NO_MAP`].
    pub joined_map: u32,
    /// [`super::EDGE_COVISIBLE`], [`super::EDGE_LOOP`], [`super::EDGE_JOIN`].
    pub kind: u8,
    /// Zero.
    pub reserved: [u8; 3],
}

layout!(GraphEdge, "cairn.GraphEdge.v1", 20, {
    from @ 0, to @ 4, shared @ 8, joined_map @ 12, kind @ 16, reserved @ 17,
});

/// What a graph message is a picture of; the same `content_revision` as the keyframes message that was sent with it.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[type_name("cairn.GraphHeader.v1")]
pub struct GraphHeader {
    /// Another value at every start of the daemon.
    pub run_id: u64,
    /// Grows with every change of what the message holds: another picture of the map.
    pub content_revision: u64,
    /// Capture time of the newest frame that the map knows of, in the source's clock (`clock`), ns.
    pub timestamp_ns: i64,
    /// CLOCK_MONOTONIC when this message was sent, ns.
    pub published_ns: i64,
    /// Edges in this message.
    pub count: u32,
    /// Edges of the map; if larger than `count`, those of keyframes that were left out and the weakest covisible ones are not here.
    pub total: u32,
    /// As in [`super::Pose::map_id`].
    pub map_id: u32,
    /// As in [`super::Pose::reset_counter`].
    pub reset_counter: u32,
    /// As in [`super::Pose::map_revision`].
    pub map_revision: u32,
    /// [`super::CLOCK_MONOTONIC`], [`super::CLOCK_RECORDING`].
    pub clock: u8,
    /// Bits of [`super::map_mode`].
    pub map_mode: u8,
    /// Zero.
    pub reserved: [u8; 10],
}

layout!(GraphHeader, "cairn.GraphHeader.v1", 64, {
    run_id @ 0, content_revision @ 8, timestamp_ns @ 16, published_ns @ 24, count @ 32, total @ 36, map_id @ 40,
    reset_counter @ 44, map_revision @ 48, clock @ 52, map_mode @ 53, reserved @ 54,
});
