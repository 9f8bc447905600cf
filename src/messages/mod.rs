#![doc = include_str!("WIRE.md")]
//!
//! # In Rust
//! Layout is asserted at compile time and readable as `FIELDS` ([`Pose::FIELDS`]); names and queues are in [`services`]; [`Endpoint`] says
//! which daemon is meant. This module needs iceoryx2 and nothing of ours.

/// Checks a wire struct at compile time and lists its fields: offsets as written, no padding, nothing left out.
macro_rules! layout {
    ($type:ident, $name:literal, $size:literal, { $($field:ident @ $offset:literal),+ $(,)? }) => {
        impl $type {
            /// Name that iceoryx2 compares when two processes meet.
            pub const TYPE_NAME: &'static str = $name;
            /// All fields in order.
            pub const FIELDS: &'static [$crate::messages::Field] = &[$($crate::messages::Field {
                name: stringify!($field),
                offset: core::mem::offset_of!($type, $field),
                size: $crate::messages::size_of_field::<$type, _>(|s| &s.$field),
            }),+];
        }
        const _: () = {
            assert!(core::mem::size_of::<$type>() == $size);
            $(assert!(core::mem::offset_of!($type, $field) == $offset);)+
            let (mut i, mut end) = (0, 0);
            while i < $type::FIELDS.len() {
                assert!($type::FIELDS[i].offset == end, "padding, or a field is not listed");
                end += $type::FIELDS[i].size;
                i += 1;
            }
            assert!(end == $size, "padding at the end, or a field is not listed");
        };
    };
}

mod camera;
mod command;
mod encoded;
mod endpoint;
mod features;
mod frame;
mod graph;
mod health;
mod map;
mod obstacles;
mod pose;
pub mod services;
mod tags;
mod transform;
mod unfilled;
mod wheel;

pub use camera::{Automatic, CameraControl, NoControl};
pub use command::{Command, CommandReply, TEXT_LEN, command_kind, reply_code};
pub use encoded::EncodedHeader;
pub(crate) use endpoint::user_name;
pub use endpoint::{DEFAULT_PREFIX, Endpoint, EndpointError, Presence, Squatter, effective_uid, service_name};
pub use features::{Feature, FeaturesHeader};
pub use frame::FrameHeader;
pub use graph::{EDGE_COVISIBLE, EDGE_JOIN, EDGE_LOOP, GraphEdge, GraphHeader};
pub use health::{Health, STAGES, StageHealth, error, map_mode, stage};
pub use map::{Keyframe, KeyframesHeader, Landmark, MapHeader};
pub use obstacles::{
    OBSTACLE_BEARINGS, OBSTACLE_POINTS, OBSTACLES_NO_FLOOR, OBSTACLES_NO_POSE, OBSTACLES_NOT_METRIC, OBSTACLES_TOLD,
    Obstacles,
};
pub use pose::Pose;
pub use tags::{MAX_TAGS, TAG_36H11, Tag, Tags};
pub use transform::Transform;
pub use wheel::WheelOdometry;

/// A field of a wire struct, for documentation, bindings to other languages and tests.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Field {
    pub name: &'static str,
    /// Bytes from the start of the struct.
    pub offset: usize,
    /// Bytes.
    pub size: usize,
}

const fn size_of_field<T, F>(_field: fn(&T) -> &F) -> usize {
    core::mem::size_of::<F>()
}

/// Names of the bits that are set, in the order given; all others together are `UNKNOWN`.
fn bit_names<B: BitFlags>(names: &'static [(B, &'static str)], set: B) -> impl Iterator<Item = &'static str> {
    let none = B::default();
    let unknown = names.iter().fold(set, |rest, (bit, _)| rest & !*bit) != none;
    let known = names.iter().filter(move |(bit, _)| set & *bit != none).map(|(_, name)| *name);
    known.chain(unknown.then_some("UNKNOWN"))
}

/// An integer whose bits mean something each.
trait BitFlags: Copy + Default + PartialEq + core::ops::BitAnd<Output = Self> + core::ops::Not<Output = Self> {}
impl BitFlags for u8 {}
impl BitFlags for u64 {}

/// Name of a daemon's iceoryx2 node.
pub(crate) const DAEMON_NODE: &str = "cairn";

/// Stands where a time or duration in ns is not known.
pub const UNKNOWN_NS: i64 = i64::MIN;
/// Stands where there is no keyframe.
pub const NO_KEYFRAME: u32 = u32::MAX;
/// Stands where there is no landmark.
pub const NO_LANDMARK: u32 = u32::MAX;
/// Stands where there is no map.
pub const NO_MAP: u32 = u32::MAX;
/// Stands where there is no track.
pub const NO_TRACK: u64 = u64::MAX;

/// `state`: no map yet, no pose.
pub const STATE_INITIALIZING: u8 = 0;
/// `state`: the pose rests on landmarks that were seen in this frame.
pub const STATE_TRACKING: u8 = 1;
/// `state`: there was a map and this frame could not be placed in it; no pose.
pub const STATE_LOST: u8 = 2;
/// `state`: no map yet, but how the body has turned since the first frame is known: orientation and its covariance without a position. Not
/// tracking, and nothing to drive by; enough for a heading while a robot turns on the spot.
pub const STATE_ORIENTATION: u8 = 3;
/// `state`: reserved, not sent yet: `odom` goes on by other means than the picture, with growing covariance. Not tracking.
pub const STATE_DEAD_RECKONING: u8 = 4;

/// `scale`: lengths are arbitrary (one camera alone); only ratios mean something.
pub const SCALE_UNKNOWN: u8 = 0;
/// `scale`: lengths are meant to be metres, with the relative uncertainty `scale_sigma`.
pub const SCALE_ESTIMATED: u8 = 1;
/// `scale`: lengths are metres, the mount's translation is applied, `scale_sigma` says how well.
pub const SCALE_METRIC: u8 = 2;

/// Bits of `scale_source`: what a scale comes from; 0 while `scale` is [`SCALE_UNKNOWN`].
pub mod scale_source {
    /// Wheel odometry.
    pub const WHEELS: u8 = 1 << 0;
    /// The camera's known height above the floor.
    pub const HEIGHT: u8 = 1 << 1;
    /// A tag or board of known size.
    pub const TAG: u8 = 1 << 2;
    /// The map was metric when it was loaded.
    pub const STORED_MAP: u8 = 1 << 3;

    const NAMES: [(u8, &str); 4] = [(WHEELS, "WHEELS"), (HEIGHT, "HEIGHT"), (TAG, "TAG"), (STORED_MAP, "STORED_MAP")];

    /// Names of the bits that are set; bits of a newer daemon together are `UNKNOWN`.
    pub fn names(source: u8) -> impl Iterator<Item = &'static str> {
        super::bit_names(&NAMES, source)
    }
}

/// `clock`: `timestamp_ns` is CLOCK_MONOTONIC of this machine.
pub const CLOCK_MONOTONIC: u8 = 0;
/// `clock`: `timestamp_ns` is a recording's own time.
pub const CLOCK_RECORDING: u8 = 1;

/// `intrinsics`: of a calibration, refined around it.
pub const INTRINSICS_CALIBRATED: u8 = 0;
/// `intrinsics`: the camera is not calibrated; found from its motion, as surely as `focal_sigma` says.
pub const INTRINSICS_ESTIMATED: u8 = 1;
/// `intrinsics`: the camera is not calibrated, and its motion has not shown the focal length so far: angles, depths and the shape of
/// the map may be off by `focal_sigma`.
pub const INTRINSICS_GUESSED: u8 = 2;

/// `lens_model`: pinhole with radial and tangential distortion.
pub const LENS_RADIAL_TANGENTIAL: u8 = 0;
/// `lens_model`: wide angle (Kannala-Brandt; `equidistant` of ROS, OpenCV's `fisheye`): `focal_px` is pixels per radian off the axis.
pub const LENS_KANNALA_BRANDT: u8 = 1;

/// `format` of an encoded picture: rows of `stride` bytes, one byte a pixel, top left first.
pub const ENCODED_GREY: u8 = 0;
/// `format` of an encoded picture: rows of `stride` bytes, packed 4:2:2 as Y0 U Y1 V.
pub const ENCODED_YUYV: u8 = 1;
/// `format` of an encoded picture: a JPEG, or a webcam's motion JPEG, which may lack its Huffman tables.
pub const ENCODED_JPEG: u8 = 2;
/// `format` of an encoded picture: a PNG.
pub const ENCODED_PNG: u8 = 3;

/// `state` as a type; a value from a newer daemon is kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum State {
    Initializing,
    Tracking,
    Lost,
    /// Orientation without a position.
    Orientation,
    /// Reserved: not sent yet.
    DeadReckoning,
    Unknown(u8),
}

impl State {
    /// From the wire.
    pub fn from_wire(value: u8) -> Self {
        match value {
            STATE_INITIALIZING => Self::Initializing,
            STATE_TRACKING => Self::Tracking,
            STATE_LOST => Self::Lost,
            STATE_ORIENTATION => Self::Orientation,
            STATE_DEAD_RECKONING => Self::DeadReckoning,
            other => Self::Unknown(other),
        }
    }

    /// `INITIALIZING`, `TRACKING`, `LOST`, `ORIENTATION`, `DEAD_RECKONING`, `UNKNOWN`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Initializing => "INITIALIZING",
            Self::Tracking => "TRACKING",
            Self::Lost => "LOST",
            Self::Orientation => "ORIENTATION",
            Self::DeadReckoning => "DEAD_RECKONING",
            Self::Unknown(_) => "UNKNOWN",
        }
    }
}

/// `scale` as a type; a value from a newer daemon is kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Scale {
    /// Arbitrary units.
    Arbitrary,
    /// Metres as estimated.
    Estimated,
    /// Metres.
    Metric,
    Unknown(u8),
}

impl Scale {
    /// From the wire.
    pub fn from_wire(value: u8) -> Self {
        match value {
            SCALE_UNKNOWN => Self::Arbitrary,
            SCALE_ESTIMATED => Self::Estimated,
            SCALE_METRIC => Self::Metric,
            other => Self::Unknown(other),
        }
    }

    /// `UNKNOWN` (arbitrary units, or a value of a newer daemon), `ESTIMATED`, `METRIC`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Arbitrary | Self::Unknown(_) => "UNKNOWN",
            Self::Estimated => "ESTIMATED",
            Self::Metric => "METRIC",
        }
    }
}

/// `clock` as a type; a value from a newer daemon is kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Clock {
    Monotonic,
    Recording,
    Unknown(u8),
}

impl Clock {
    /// From the wire.
    pub fn from_wire(value: u8) -> Self {
        match value {
            CLOCK_MONOTONIC => Self::Monotonic,
            CLOCK_RECORDING => Self::Recording,
            other => Self::Unknown(other),
        }
    }

    /// `MONOTONIC`, `RECORDING`, `UNKNOWN`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Monotonic => "MONOTONIC",
            Self::Recording => "RECORDING",
            Self::Unknown(_) => "UNKNOWN",
        }
    }
}

/// `intrinsics` as a type; a value from a newer daemon is kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Intrinsics {
    /// Of a calibration.
    Calibrated,
    /// Found from the motion.
    Estimated,
    /// A guess.
    Guessed,
    Unknown(u8),
}

impl Intrinsics {
    /// From the wire.
    pub fn from_wire(value: u8) -> Self {
        match value {
            INTRINSICS_CALIBRATED => Self::Calibrated,
            INTRINSICS_ESTIMATED => Self::Estimated,
            INTRINSICS_GUESSED => Self::Guessed,
            other => Self::Unknown(other),
        }
    }

    /// `CALIBRATED`, `ESTIMATED`, `GUESSED`, `UNKNOWN`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Calibrated => "CALIBRATED",
            Self::Estimated => "ESTIMATED",
            Self::Guessed => "GUESSED",
            Self::Unknown(_) => "UNKNOWN",
        }
    }
}

/// `lens_model` as a type; a value from a newer daemon is kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum LensModel {
    /// Pinhole with radial and tangential distortion.
    RadialTangential,
    /// Wide angle.
    KannalaBrandt,
    Unknown(u8),
}

impl LensModel {
    /// From the wire.
    pub fn from_wire(value: u8) -> Self {
        match value {
            LENS_RADIAL_TANGENTIAL => Self::RadialTangential,
            LENS_KANNALA_BRANDT => Self::KannalaBrandt,
            other => Self::Unknown(other),
        }
    }

    /// `RADIAL_TANGENTIAL`, `KANNALA_BRANDT`, `UNKNOWN`.
    pub fn name(self) -> &'static str {
        match self {
            Self::RadialTangential => "RADIAL_TANGENTIAL",
            Self::KannalaBrandt => "KANNALA_BRANDT",
            Self::Unknown(_) => "UNKNOWN",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use iceoryx2::service::static_config::message_type_details::{TypeDetail, TypeVariant};

    #[test]
    fn iceoryx2_sees_the_versioned_name_and_the_asserted_size_of_every_type() {
        macro_rules! check {
            ($($type:ty),+) => {$(
                let seen = TypeDetail::new::<$type>(TypeVariant::FixedSize);
                assert_eq!(seen.type_name().to_string(), <$type>::TYPE_NAME);
                assert_eq!(seen.size(), core::mem::size_of::<$type>());
                assert!(<$type>::TYPE_NAME.starts_with("cairn."));
                let version = <$type>::TYPE_NAME.rsplit_once(".v").map(|(_, v)| v.parse::<u32>());
                assert!(matches!(version, Some(Ok(1..))), "{}", <$type>::TYPE_NAME);
            )+};
        }
        check!(
            Pose,
            Health,
            Landmark,
            MapHeader,
            Keyframe,
            KeyframesHeader,
            FrameHeader,
            EncodedHeader,
            Feature,
            FeaturesHeader,
            Command,
            CommandReply,
            WheelOdometry,
            Obstacles,
            Tag,
            Tags
        );
    }

    #[test]
    fn values_of_a_newer_daemon_are_kept_and_not_taken_for_good_ones() {
        assert_eq!(State::from_wire(77), State::Unknown(77));
        assert_eq!(Scale::from_wire(9), Scale::Unknown(9));
        assert_eq!(Clock::from_wire(9), Clock::Unknown(9));
        assert_eq!(Intrinsics::from_wire(9), Intrinsics::Unknown(9));
        assert_eq!(LensModel::from_wire(9), LensModel::Unknown(9));
        assert_eq!(LensModel::from_wire(1).name(), "KANNALA_BRANDT");
        for state in [STATE_ORIENTATION, STATE_DEAD_RECKONING, 77] {
            let pose = Pose { state, ..Pose::default() };
            assert!(!pose.is_tracking(), "{}", pose.state().name());
            assert_eq!(pose.has_orientation(), state != 77);
            assert_eq!(pose.odom_from_body().is_some(), state == STATE_DEAD_RECKONING);
        }
        assert_eq!(scale_source::names(0b1000_0101).collect::<Vec<_>>(), ["WHEELS", "TAG", "UNKNOWN"]);
        assert_eq!(map_mode::names(map_mode::STORED).collect::<Vec<_>>(), ["STORED"]);
    }
}
