//! The grey picture, for other processes that want to share the camera.

use iceoryx2::prelude::ZeroCopySend;

/// Describes the bytes of a `PREFIX/frame` message: rows of `stride` bytes, top left first, one byte a pixel. The picture
/// is as the camera gave it, lens distortion included.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[type_name("cairn.FrameHeader.v1")]
pub struct FrameHeader {
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
    /// Bytes from one row to the next, at least `width`.
    pub stride: u32,
    /// [`super::CLOCK_MONOTONIC`], [`super::CLOCK_RECORDING`].
    pub clock: u8,
    /// Zero.
    pub reserved: [u8; 3],
}

layout!(FrameHeader, "cairn.FrameHeader.v1", 48, {
    run_id @ 0, sequence @ 8, timestamp_ns @ 16, arrival_ns @ 24, width @ 32, height @ 36, stride @ 40, clock @ 44,
    reserved @ 45,
});
