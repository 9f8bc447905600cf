//! What reconstruction tells the outside: poses, trajectory events, counters.

use nalgebra::{Matrix3, Matrix6, UnitQuaternion, Vector3};

use crate::geometry::Se3;
use crate::geometry::frames::{Camera, Keyframe, Odom, World};
use crate::map::scale::MapScale;
use crate::map::{KeyframeId, MapId};

/// State of tracking as published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum TrackingState {
    /// No map yet; no pose.
    #[default]
    Initializing,
    /// No map yet, but how the camera has turned since the first frame is known.
    Orientation,
    /// The pose rests on landmarks seen in this frame.
    Tracking,
    /// There was a map and this frame could not be placed in it; no pose.
    Lost,
    /// The picture does not place this frame; its pose is the last one carried on by the wheels.
    DeadReckoning,
}

/// How the camera has turned since the first frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrientationEstimate {
    /// Axes of the camera in those of the first frame's.
    pub first_from_camera: UnitQuaternion<f64>,
    /// Of its right tangent (rotations about the camera's axes now), rad².
    pub covariance: Matrix3<f64>,
    /// In the camera's axes, rad/s; NaN = unknown.
    pub angular_velocity: Vector3<f64>,
}

/// One frame's outcome.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseEstimate {
    pub sequence: u64,
    pub timestamp_ns: i64,
    pub arrival_ns: i64,
    pub state: TrackingState,
    /// Map pose; `None` unless tracking or dead reckoning.
    pub world_from_camera: Option<Se3<World, Camera>>,
    /// Smooth pose, continuous within one reset counter; `None` unless tracking or dead reckoning.
    pub odom_from_camera: Option<Se3<Odom, Camera>>,
    /// `Some` in the state of that name only.
    pub orientation: Option<OrientationEstimate>,
    /// Keyframe that the covariance is relative to.
    pub anchor: Option<KeyframeId>,
    /// Covariance of the left perturbation of `camera_from_world` (tangent `[rotation rad, translation map units]` in the
    /// camera's axes, [`Se3::perturb_left`]); NaN = unknown.
    pub covariance: Matrix6<f64>,
    /// Velocity of the camera in its own axes: angular (rad/s), linear (map units/s); NaN = unknown.
    pub angular_velocity: Vector3<f64>,
    pub linear_velocity: Vector3<f64>,
    /// Landmarks seen in this frame that the pose rests on.
    pub landmarks: u32,
    /// Landmarks that were looked for in this frame.
    pub landmarks_sought: u32,
    /// 0 (none) to 1 (as good as it gets).
    pub quality: f32,
    pub map: MapId,
    /// Counts corrections of published map coordinates beyond ordinary adjustment; the smooth pose does not move then.
    pub map_revision: u32,
    /// Counts re-initialisations and resets: poses across a change are unrelated.
    pub reset_counter: u32,
    /// This frame will become a keyframe.
    pub keyframe: bool,
    /// What lengths are.
    pub scale: MapScale,
}

/// No pose: what is not known is NaN or `None`.
impl Default for PoseEstimate {
    fn default() -> Self {
        Self {
            sequence: 0,
            timestamp_ns: 0,
            arrival_ns: 0,
            state: TrackingState::default(),
            world_from_camera: None,
            odom_from_camera: None,
            orientation: None,
            anchor: None,
            covariance: Matrix6::from_element(f64::NAN),
            angular_velocity: Vector3::from_element(f64::NAN),
            linear_velocity: Vector3::from_element(f64::NAN),
            landmarks: 0,
            landmarks_sought: 0,
            quality: 0.0,
            map: MapId(0),
            map_revision: 0,
            reset_counter: 0,
            keyframe: false,
            scale: MapScale::default(),
        }
    }
}

/// A frame's place in the map for the trajectory that is written at the end.
#[derive(Debug, Clone, PartialEq)]
pub enum TrajectoryEvent {
    /// A frame was tracked (or solved afterwards): its pose relative to a keyframe, which later adjustments move.
    Pose { timestamp_ns: i64, map: MapId, keyframe: KeyframeId, keyframe_from_camera: Se3<Keyframe, Camera> },
    /// The frame of this time has become `keyframe`: adjustments place it better than it was tracked, and with it the frames since the keyframe before.
    KeyframeMade { timestamp_ns: i64, keyframe: KeyframeId },
    /// `keyframe` was culled; poses that refer to it now hang on `parent`.
    KeyframeRemoved {
        map: MapId,
        keyframe: KeyframeId,
        parent: KeyframeId,
        parent_from_keyframe: Se3<Keyframe, Keyframe>,
    },
    /// Its map has ended; this is the keyframe's last pose.
    KeyframeRetired { keyframe: KeyframeId, world_from_camera: Se3<World, Camera> },
    /// `map` was recognised from `into`, or has become it by becoming metric, and is a part of it from here on; `scale`: its unit in the other's.
    MapJoined { map: MapId, into: MapId, scale: f64 },
    /// A closed loop, or what is known of metres, has changed the unit of lengths around `keyframe`: what was recorded relative to it before is to be multiplied by `scale`.
    KeyframeScaled { keyframe: KeyframeId, scale: f64 },
}

/// Counters since the start, for health and logs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counters {
    pub frames: u64,
    pub frames_tracked: u64,
    pub keyframes_made: u64,
    pub keyframes_culled: u64,
    pub landmarks_made: u64,
    pub landmarks_culled: u64,
    pub adjustments: u64,
    /// Adjustment results that came later than the configured number of frames (live only).
    pub adjustments_late: u64,
    pub resets: u64,
    pub relocalisations: u64,
    /// Maps that were recognised and joined to the present one.
    pub maps_joined: u64,
    /// Loops that were closed: places of the same map that were recognised after drift, and corrected.
    pub loops_closed: u64,
    /// Places of the same map that were recognised where it lay right already: tied to it, and nothing moved.
    pub loops_tied: u64,
    /// Times that the disk did not take pictures of far keyframes, which stay in memory, and that it did not give one back, which stays away; and
    /// pictures whose copies were spoiled.
    pub spool_faults: u64,
    pub pictures_unread: u64,
    pub pictures_lost: u64,
    /// Times that most of the picture contradicted the poses for a second: what the map had grown by since was dropped.
    pub contradictions: u64,
    /// Turns on the spot that left all behind whose distance was known: the scale of what follows is an assumption.
    pub blind_turns: u64,
    /// Time (ns) and way (mm) for which frames were placed by the wheels alone, and how often a map went on from there.
    pub blind_ns: u64,
    pub blind_mm: u64,
    pub blind_starts: u64,
}
