//! Sparse map and keyframes.

use iceoryx2::prelude::ZeroCopySend;

/// One point of the sparse map; `PREFIX/map` carries a slice of them, ascending `id`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[type_name("cairn.Landmark.v1")]
pub struct Landmark {
    /// Never reused within a run.
    pub id: u32,
    /// Keyframes that observe it.
    pub observations: u32,
    /// In the map (REP-103 axes), map units.
    pub position: [f32; 3],
    /// Standard deviation along the line of sight, map units; NaN = unknown.
    pub sigma: f32,
}

layout!(Landmark, "cairn.Landmark.v1", 24, { id @ 0, observations @ 4, position @ 8, sigma @ 20 });

/// What a map message is a picture of.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[type_name("cairn.MapHeader.v2")]
pub struct MapHeader {
    /// Another value at every start of the daemon.
    pub run_id: u64,
    /// Grows with every change of what the message holds: another picture of the map.
    pub content_revision: u64,
    /// Capture time of the newest frame that the map knows of, in the source's clock (`clock`), ns.
    pub timestamp_ns: i64,
    /// CLOCK_MONOTONIC when this message was sent, ns.
    pub published_ns: i64,
    /// Landmarks in this message.
    pub count: u32,
    /// Landmarks in the map; if larger than `count`, the oldest ones were left out.
    pub total: u32,
    /// As in [`super::Pose::map_id`].
    pub map_id: u32,
    /// As in [`super::Pose::reset_counter`].
    pub reset_counter: u32,
    /// As in [`super::Pose::map_revision`]: what was kept of messages with another one is out of place.
    pub map_revision: u32,
    /// Relative standard deviation of the scale; NaN unless it is estimated.
    pub scale_sigma: f32,
    /// [`super::SCALE_UNKNOWN`], [`super::SCALE_ESTIMATED`], [`super::SCALE_METRIC`].
    pub scale: u8,
    /// As in [`super::Pose::scale_source`].
    pub scale_source: u8,
    /// [`super::CLOCK_MONOTONIC`], [`super::CLOCK_RECORDING`].
    pub clock: u8,
    /// Bits of [`super::map_mode`].
    pub map_mode: u8,
    /// Zero.
    pub reserved: [u8; 4],
}

layout!(MapHeader, "cairn.MapHeader.v2", 64, {
    run_id @ 0, content_revision @ 8, timestamp_ns @ 16, published_ns @ 24, count @ 32, total @ 36, map_id @ 40,
    reset_counter @ 44, map_revision @ 48, scale_sigma @ 52, scale @ 56, scale_source @ 57, clock @ 58, map_mode @ 59,
    reserved @ 60,
});

/// One keyframe; `PREFIX/keyframes` carries a slice of them, ascending `id`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[type_name("cairn.Keyframe.v1")]
pub struct Keyframe {
    /// Capture time in the source's clock, ns.
    pub timestamp_ns: i64,
    /// The body's origin in the map, map units.
    pub position: [f64; 3],
    /// `map_from_body`, quaternion (x, y, z, w).
    pub orientation: [f64; 4],
    /// Never reused within a run.
    pub id: u32,
    /// Zero.
    pub reserved: u32,
}

layout!(Keyframe, "cairn.Keyframe.v1", 72, {
    timestamp_ns @ 0, position @ 8, orientation @ 32, id @ 64, reserved @ 68,
});

/// What a keyframes message is a picture of; the same `content_revision` as the map message that was sent with it.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[type_name("cairn.KeyframesHeader.v2")]
pub struct KeyframesHeader {
    /// Another value at every start of the daemon.
    pub run_id: u64,
    /// Grows with every change of what the message holds: another picture of the map.
    pub content_revision: u64,
    /// Capture time of the newest frame that the map knows of, in the source's clock (`clock`), ns.
    pub timestamp_ns: i64,
    /// CLOCK_MONOTONIC when this message was sent, ns.
    pub published_ns: i64,
    /// Keyframes in this message.
    pub count: u32,
    /// Keyframes in the map; if larger than `count`, the oldest ones were left out.
    pub total: u32,
    /// As in [`super::Pose::map_id`].
    pub map_id: u32,
    /// As in [`super::Pose::reset_counter`].
    pub reset_counter: u32,
    /// As in [`super::Pose::map_revision`]: what was kept of messages with another one is out of place.
    pub map_revision: u32,
    /// Relative standard deviation of the scale; NaN unless it is estimated.
    pub scale_sigma: f32,
    /// [`super::SCALE_UNKNOWN`], [`super::SCALE_ESTIMATED`], [`super::SCALE_METRIC`].
    pub scale: u8,
    /// As in [`super::Pose::scale_source`].
    pub scale_source: u8,
    /// [`super::CLOCK_MONOTONIC`], [`super::CLOCK_RECORDING`].
    pub clock: u8,
    /// Bits of [`super::map_mode`].
    pub map_mode: u8,
    /// Zero.
    pub reserved: [u8; 4],
}

layout!(KeyframesHeader, "cairn.KeyframesHeader.v2", 64, {
    run_id @ 0, content_revision @ 8, timestamp_ns @ 16, published_ns @ 24, count @ 32, total @ 36, map_id @ 40,
    reset_counter @ 44, map_revision @ 48, scale_sigma @ 52, scale @ 56, scale_source @ 57, clock @ 58, map_mode @ 59,
    reserved @ 60,
});
