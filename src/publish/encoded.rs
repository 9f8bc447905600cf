//! `PREFIX/encoded`: the camera's own bytes, for recorders.

use super::ports::Port;
use super::{PublishError, convert};
use crate::frame::{Clock, PixelFormat, RawFrame};
use crate::geometry::Se3;
use crate::geometry::frames::{Body, Camera};
use crate::image::decode::picture_size;
use crate::messages::{self, EncodedHeader};

/// What is believed of the camera that took a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraView {
    /// fx fy cx cy, px; NaN before the first frame was looked at.
    pub pinhole_px: [f64; 4],
    /// k1 k2 p1 p2 k3, or k1 k2 k3 k4 and zero of a wide-angle lens.
    pub distortion: [f64; 5],
    /// As on the wire.
    pub intrinsics: u8,
    /// As on the wire.
    pub lens_model: u8,
}

/// `PREFIX/encoded`.
#[derive(Debug)]
pub struct EncodedPublisher {
    port: Port<[u8], EncodedHeader>,
    limit: usize,
    /// What every message has in common.
    common: EncodedHeader,
}

impl EncodedPublisher {
    pub(super) fn new(port: Port<[u8], EncodedHeader>, limit: usize, run_id: u64) -> Self {
        Self { port, limit, common: EncodedHeader { run_id, ..EncodedHeader::default() } }
    }

    /// Where the camera sits and what its times count from: part of every message from now on.
    pub fn describe(&mut self, body_from_camera: &Se3<Body, Camera>, clock: Clock) {
        self.describe_mount(body_from_camera);
        self.common.clock = convert::clock(clock);
    }

    /// Where the camera sits, once more is known of it.
    pub fn describe_mount(&mut self, body_from_camera: &Se3<Body, Camera>) {
        let q = &body_from_camera.rotation;
        self.common.camera_position = body_from_camera.translation.into();
        self.common.camera_orientation = [q.i, q.j, q.k, q.w];
    }

    /// Somebody records.
    pub fn is_wanted(&self) -> bool {
        self.port.subscribers() > 0
    }

    /// Sends one picture as it came (a single copy), if somebody subscribes; tells whether it was sent. Waits for nobody; allocates nothing
    /// of its own (iceoryx2 0.10 makes one small heap allocation for every message).
    pub fn publish(&mut self, frame: &RawFrame, camera: &CameraView) -> Result<bool, PublishError> {
        if !self.is_wanted() {
            return Ok(false);
        }
        if frame.data.len() > self.limit {
            return Err(PublishError::FrameTooLarge { bytes: frame.data.len(), limit: self.limit });
        }
        let [fx, fy, cx, cy] = camera.pinhole_px;
        let (format, (width, height)) = match frame.format {
            PixelFormat::Grey => (messages::ENCODED_GREY, (frame.width, frame.height)),
            PixelFormat::Yuyv => (messages::ENCODED_YUYV, (frame.width, frame.height)),
            PixelFormat::Jpeg => (messages::ENCODED_JPEG, picture_size(&frame.data).unwrap_or_default()),
            PixelFormat::Png => (messages::ENCODED_PNG, picture_size(&frame.data).unwrap_or_default()),
        };
        let has_rows = matches!(frame.format, PixelFormat::Grey | PixelFormat::Yuyv);
        let header = EncodedHeader {
            sequence: frame.sequence,
            timestamp_ns: frame.timestamp_ns,
            arrival_ns: frame.arrival_ns,
            focal_px: [fx, fy],
            centre_px: [cx, cy],
            distortion: camera.distortion,
            width,
            height,
            stride: if has_rows { frame.stride } else { 0 },
            format,
            intrinsics: camera.intrinsics,
            lens_model: camera.lens_model,
            ..self.common
        };
        self.port.send_copy(header, &frame.data)?;
        Ok(true)
    }
}
