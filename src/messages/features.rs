//! What was found in a picture, for whoever shows or judges it.

use iceoryx2::prelude::ZeroCopySend;

/// A place in a picture that was found; `PREFIX/features` carries a slice of them: first the landmarks of the map that the pose rests on, then
/// the tracks, ascending `track`. A track may lie where a landmark was found.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[type_name("cairn.Feature.v1")]
pub struct Feature {
    /// Of a track: unique within a run; [`super::NO_TRACK`] for a landmark.
    pub track: u64,
    /// In the picture as the camera gave it, (0, 0) in the middle of its first pixel, px.
    pub position: [f32; 2],
    /// Of a track: frames since the corner was detected, 0 in this one; 0 for a landmark.
    pub age: u32,
    /// As in [`super::Landmark::id`]; [`super::NO_LANDMARK`] for a track.
    pub landmark: u32,
}

layout!(Feature, "cairn.Feature.v1", 24, { track @ 0, position @ 8, age @ 16, landmark @ 20 });

/// Which picture the features are of.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[type_name("cairn.FeaturesHeader.v1")]
pub struct FeaturesHeader {
    /// Another value at every start of the daemon.
    pub run_id: u64,
    /// As in [`super::Pose::sequence`] of the same frame.
    pub sequence: u64,
    /// Capture time in the source's clock (`clock`), ns.
    pub timestamp_ns: i64,
    /// CLOCK_MONOTONIC when the frame arrived in the daemon, ns.
    pub arrival_ns: i64,
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Features in this message.
    pub count: u32,
    /// Features of the frame; if larger than `count`, the newest tracks were left out.
    pub total: u32,
    /// [`super::CLOCK_MONOTONIC`], [`super::CLOCK_RECORDING`].
    pub clock: u8,
    /// Zero.
    pub reserved: [u8; 7],
}

layout!(FeaturesHeader, "cairn.FeaturesHeader.v1", 56, {
    run_id @ 0, sequence @ 8, timestamp_ns @ 16, arrival_ns @ 24, width @ 32, height @ 36, count @ 40, total @ 44,
    clock @ 48, reserved @ 49,
});
