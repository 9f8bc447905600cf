//! From features to poses and a map. Knows no V4L2, ring or iceoryx2.

pub mod bundle;
pub mod pose_optimisation;

use nalgebra::{Matrix6, Vector3};

use crate::features::{Feedback, FrameFeatures};
use crate::geometry::frames::{Camera, Keyframe, Odom, World};
use crate::geometry::{CameraModel, Se3};
use crate::map::{KeyframeId, LandmarkId, MapId};

/// State of tracking as published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum TrackingState {
    /// No map yet; no pose.
    #[default]
    Initializing,
    /// The pose rests on landmarks seen in this frame.
    Tracking,
    /// There was a map and this frame could not be placed in it; no pose.
    Lost,
}

/// `[reconstruction]` of the configuration.
#[derive(Debug, Clone, PartialEq, Default, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReconstructionConfig {}

/// One frame's outcome.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseEstimate {
    pub sequence: u64,
    pub timestamp_ns: i64,
    pub arrival_ns: i64,
    pub state: TrackingState,
    /// Map pose; `None` unless tracking.
    pub world_from_camera: Option<Se3<World, Camera>>,
    /// Smooth pose, continuous within one reset counter; `None` unless tracking.
    pub odom_from_camera: Option<Se3<Odom, Camera>>,
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
    /// Counts re-initialisations and resets: poses across a change are unrelated.
    pub reset_counter: u32,
    /// This frame will become a keyframe.
    pub keyframe: bool,
}

/// A frame's place in the map for the trajectory that is written at the end.
#[derive(Debug, Clone, PartialEq)]
pub enum TrajectoryEvent {
    /// A frame was tracked (or solved afterwards): its pose relative to a keyframe, which later adjustments move.
    Pose { timestamp_ns: i64, map: MapId, keyframe: KeyframeId, keyframe_from_camera: Se3<Keyframe, Camera> },
    /// `keyframe` was culled; poses that refer to it now hang on `parent`.
    KeyframeRemoved { keyframe: KeyframeId, parent: KeyframeId, parent_from_keyframe: Se3<Keyframe, Keyframe> },
}

/// A landmark as the outside sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LandmarkView {
    pub id: LandmarkId,
    pub position_world: Vector3<f64>,
    /// One sigma along the line of sight, map units; NaN = unknown.
    pub sigma: f32,
    /// Keyframes that observe it.
    pub observations: u32,
}

/// A keyframe as the outside sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyframeView {
    pub id: KeyframeId,
    pub timestamp_ns: i64,
    pub world_from_camera: Se3<World, Camera>,
}

/// The current map; buffers are reused by [`Reconstruction::snapshot`].
#[derive(Debug, Clone, Default)]
pub struct MapSnapshot {
    pub map: MapId,
    /// Grows with every change of the map.
    pub revision: u64,
    /// Ascending id.
    pub landmarks: Vec<LandmarkView>,
    /// Ascending id.
    pub keyframes: Vec<KeyframeView>,
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
}

/// A piece of mapping work on a snapshot: a pure function of its input, so that it can run anywhere.
#[derive(Debug)]
pub struct MappingJob {}
/// What a [`MappingJob`] gives back, merged by reconstruction.
#[derive(Debug)]
pub struct MappingResult {}
impl MappingJob {
    /// Bounded in iterations, not in time.
    pub fn run(self) -> MappingResult {
        MappingResult {}
    }
}

/// Who runs mapping jobs: a thread of the daemon's, or the caller itself. At most one job is under way.
pub trait MappingWorker: Send {
    /// Starts a job; never called while one is under way.
    fn post(&mut self, job: MappingJob);
    /// The result if there is one; with `wait`, blocks until it is there (`None` then only if no job is under way or the worker died).
    fn take(&mut self, wait: bool) -> Option<MappingResult>;
}

/// Runs every job at once in the calling thread.
#[derive(Debug, Default)]
pub struct InlineWorker {
    result: Option<MappingResult>,
}
impl MappingWorker for InlineWorker {
    fn post(&mut self, job: MappingJob) {
        self.result = Some(job.run());
    }
    fn take(&mut self, _wait: bool) -> Option<MappingResult> {
        self.result.take()
    }
}

/// Tracking and mapping. One frame is [`track`](Self::track) (publish its result at once), then [`map`](Self::map).
pub struct Reconstruction {}

impl Reconstruction {
    /// `lockstep`: mapping results are merged a fixed number of frames after they were posted, by waiting.
    pub fn new(
        _config: &ReconstructionConfig,
        _camera: &CameraModel,
        _worker: Box<dyn MappingWorker>,
        _lockstep: bool,
    ) -> Self {
        Self {}
    }

    /// The pose of a frame. Allocates nothing once warm.
    pub fn track(&mut self, _features: &FrameFeatures) -> PoseEstimate {
        unreachable!("replaced by the reconstruction room")
    }

    /// Keyframe work for the frame just tracked, after its pose was published.
    pub fn map(&mut self, _feedback: &mut Feedback) {}

    /// Drops the map and starts over at the next frame.
    pub fn reset(&mut self) {}

    /// Waits for the job under way, if any, and merges it. Nothing is adjusted beyond it.
    pub fn finish(&mut self) {}

    /// Fills `out` with the current map.
    pub fn snapshot(&self, _out: &mut MapSnapshot) {}

    /// Events since the last call, in order; to be drained after every frame.
    pub fn take_trajectory_events(&mut self, _out: &mut Vec<TrajectoryEvent>) {}

    /// Poses of every keyframe of every map of this run that still exists, for the trajectory written at the end.
    pub fn keyframe_poses(&self) -> Vec<(KeyframeId, Se3<World, Camera>)> {
        Vec::new()
    }

    pub fn counters(&self) -> Counters {
        Counters::default()
    }
}
