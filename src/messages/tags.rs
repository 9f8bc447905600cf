//! Tags of a known size that the map's keyframes have seen, and where they are.

use iceoryx2::prelude::ZeroCopySend;

use super::UNKNOWN_NS;

/// Tags of a message at the most.
pub const MAX_TAGS: usize = 16;

/// `family` of a tag: AprilTag 36h11.
pub const TAG_36H11: u8 = 0;

/// A tag. Its axes are those of a robot that looks straight at it: x into the tag, y to the left, z up; its origin is the middle of its black square.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("cairn.Tag.v1")]
pub struct Tag {
    /// Its middle in the map, map units; NaN: seen, but from too few directions to be placed.
    pub position: [f64; 3],
    /// `map_from_tag`, quaternion (x, y, z, w); NaN as there.
    pub orientation: [f64; 4],
    /// Side of its black square as the configuration has it, m.
    pub size: f32,
    /// The same as the keyframes see it, map units: in a metric map another size than `size` is another tag, or a wrong `size`. NaN as above.
    pub edge: f32,
    /// Standard deviation of `position` in its worst direction, relative to the keyframes that saw it, map units; NaN as above.
    pub position_sigma: f32,
    /// Standard deviation of `orientation` about its worst axis, relative to the same, rad; NaN as above.
    pub orientation_sigma: f32,
    /// Its number in the family.
    pub id: u32,
    /// Keyframes of the map, as far as they are kept for it, that saw it.
    pub sightings: u32,
    /// [`super::TAG_36H11`].
    pub family: u8,
    /// 1: it is the dock of the configuration, whose place the map may be told in; else 0.
    pub is_dock: u8,
    /// Zero.
    pub reserved: [u8; 6],
}

layout!(Tag, "cairn.Tag.v1", 88, {
    position @ 0, orientation @ 24, size @ 56, edge @ 60, position_sigma @ 64, orientation_sigma @ 68, id @ 72,
    sightings @ 76, family @ 80, is_dock @ 81, reserved @ 82,
});

impl Default for Tag {
    /// Nothing is known.
    fn default() -> Self {
        Self {
            position: [f64::NAN; 3],
            orientation: [f64::NAN; 4],
            size: f32::NAN,
            edge: f32::NAN,
            position_sigma: f32::NAN,
            orientation_sigma: f32::NAN,
            id: 0,
            sightings: 0,
            family: TAG_36H11,
            is_dock: 0,
            reserved: [0; 6],
        }
    }
}

impl Tag {
    /// Its place in the map is known.
    pub fn is_placed(&self) -> bool {
        self.position.iter().chain(&self.orientation).all(|v| v.is_finite())
    }

    /// `36h11`, `UNKNOWN`.
    pub fn family_name(&self) -> &'static str {
        match self.family {
            TAG_36H11 => "36h11",
            _ => "UNKNOWN",
        }
    }
}

/// The tags of the map, at their places by the keyframes of now; the same `content_revision` as the map that was sent with it.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("cairn.Tags.v1")]
pub struct Tags {
    /// Another value at every start of the daemon.
    pub run_id: u64,
    /// Grows with every change of what the map holds: another picture of it.
    pub content_revision: u64,
    /// Capture time of the newest frame that the map knows of, in the source's clock (`clock`), ns.
    pub timestamp_ns: i64,
    /// CLOCK_MONOTONIC when this message was sent, ns.
    pub published_ns: i64,
    /// Tags in this message.
    pub count: u32,
    /// As in [`super::Pose::map_id`].
    pub map_id: u32,
    /// As in [`super::Pose::reset_counter`].
    pub reset_counter: u32,
    /// As in [`super::Pose::map_revision`]: what was kept of messages with another one is out of place.
    pub map_revision: u32,
    /// Relative standard deviation of the scale; NaN unless it is estimated.
    pub scale_sigma: f32,
    /// SCALE_UNKNOWN, SCALE_ESTIMATED, SCALE_METRIC.
    pub scale: u8,
    /// As in [`super::Pose::scale_source`].
    pub scale_source: u8,
    /// [`super::CLOCK_MONOTONIC`], [`super::CLOCK_RECORDING`].
    pub clock: u8,
    /// Bits of [`super::map_mode`].
    pub map_mode: u8,
    /// Zero.
    pub reserved: [u8; 8],
    /// By number, ascending; beyond `count` nothing.
    pub tags: [Tag; MAX_TAGS],
}

layout!(Tags, "cairn.Tags.v1", 1472, {
    run_id @ 0, content_revision @ 8, timestamp_ns @ 16, published_ns @ 24, count @ 32, map_id @ 36, reset_counter @ 40,
    map_revision @ 44, scale_sigma @ 48, scale @ 52, scale_source @ 53, clock @ 54, map_mode @ 55, reserved @ 56, tags @ 64,
});

impl Default for Tags {
    /// No tags.
    fn default() -> Self {
        Self {
            run_id: 0,
            content_revision: 0,
            timestamp_ns: UNKNOWN_NS,
            published_ns: UNKNOWN_NS,
            count: 0,
            map_id: 0,
            reset_counter: 0,
            map_revision: 0,
            scale_sigma: f32::NAN,
            scale: 0,
            scale_source: 0,
            clock: 0,
            map_mode: 0,
            reserved: [0; 8],
            tags: [Tag::default(); MAX_TAGS],
        }
    }
}

impl Tags {
    /// The tags that are there.
    pub fn seen(&self) -> &[Tag] {
        &self.tags[..(self.count as usize).min(MAX_TAGS)]
    }
}
