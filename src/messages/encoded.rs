//! The camera's own bytes, for recorders.

use iceoryx2::prelude::ZeroCopySend;

/// Describes the bytes of a `PREFIX/encoded` message: the picture as it came from the camera, before it is decoded or looked at, with what is
/// believed of its lens and mount at that moment.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("cairn.EncodedHeader.v1")]
pub struct EncodedHeader {
    /// Another value at every start of the daemon.
    pub run_id: u64,
    /// As in [`super::Pose::sequence`] of the same frame, whether it becomes a pose or not.
    pub sequence: u64,
    /// Capture time in the source's clock (`clock`), ns.
    pub timestamp_ns: i64,
    /// CLOCK_MONOTONIC when the frame arrived in the daemon, ns.
    pub arrival_ns: i64,
    /// Focal lengths fx and fy in use, px; NaN before the first frame was looked at.
    pub focal_px: [f64; 2],
    /// Principal point in use, px; NaN as `focal_px`.
    pub centre_px: [f64; 2],
    /// Distortion in use: k1 k2 p1 p2 k3, or k1 k2 k3 k4 and zero of a wide-angle lens; NaN as `focal_px`.
    pub distortion: [f64; 5],
    /// The mount: the camera's optical centre in the body, m. Part of a pose only where `scale` is [`super::SCALE_METRIC`].
    pub camera_position: [f64; 3],
    /// The mount: `body_from_camera` of the optical axes (right, down, forward), quaternion (x, y, z, w).
    pub camera_orientation: [f64; 4],
    /// Pixels; 0 where the picture's own header cannot be read.
    pub width: u32,
    /// Pixels; 0 where the picture's own header cannot be read.
    pub height: u32,
    /// Bytes from one row to the next of [`super::ENCODED_GREY`] and [`super::ENCODED_YUYV`]; else 0.
    pub stride: u32,
    /// [`super::ENCODED_GREY`], [`super::ENCODED_YUYV`], [`super::ENCODED_JPEG`], [`super::ENCODED_PNG`].
    pub format: u8,
    /// [`super::CLOCK_MONOTONIC`], [`super::CLOCK_RECORDING`].
    pub clock: u8,
    /// As in [`super::Health::intrinsics`].
    pub intrinsics: u8,
    /// As in [`super::Health::lens_model`].
    pub lens_model: u8,
    /// Zero.
    pub reserved: [u8; 16],
}

layout!(EncodedHeader, "cairn.EncodedHeader.v1", 192, {
    run_id @ 0, sequence @ 8, timestamp_ns @ 16, arrival_ns @ 24, focal_px @ 32, centre_px @ 48, distortion @ 64,
    camera_position @ 104, camera_orientation @ 128, width @ 160, height @ 164, stride @ 168, format @ 172, clock @ 173,
    intrinsics @ 174, lens_model @ 175, reserved @ 176,
});

impl Default for EncodedHeader {
    /// A picture of no size through an unknown lens.
    fn default() -> Self {
        Self {
            run_id: 0,
            sequence: 0,
            timestamp_ns: 0,
            arrival_ns: 0,
            focal_px: [f64::NAN; 2],
            centre_px: [f64::NAN; 2],
            distortion: [f64::NAN; 5],
            camera_position: [0.0; 3],
            camera_orientation: [0.0, 0.0, 0.0, 1.0],
            width: 0,
            height: 0,
            stride: 0,
            format: super::ENCODED_GREY,
            clock: super::CLOCK_MONOTONIC,
            intrinsics: super::INTRINSICS_GUESSED,
            lens_model: super::LENS_RADIAL_TANGENTIAL,
            reserved: [0; 16],
        }
    }
}
