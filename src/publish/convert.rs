//! From optical axes (right, down, forward) to the wire's REP-103 axes (forward, left, up) of the robot's body.
//!
//! With `M` the rotation of `body_from_camera`, `b` its translation (the camera in the body; zero unless the scale is
//! metric), and `R`, `t` of `world_from_camera`:
//!
//! ```text
//! map_from_body:  R_b = M R Mᵀ          p_b = M t − R_b b
//! landmark:       p   = M x
//! velocity:       w_b = M w             v_b = M v − w_b × b
//! covariance:     e_b = J e_c           J = | M  [b]x M |     e = [position, rotation], right tangent
//!                                           | 0     M   |
//! ```
//!
//! The map's axes are the body's at the map's first keyframe, where `R = I`; its origin is the camera's centre there; unless a
//! planner has said where the robot is ([`Conversion::map_from_world`], [`place`]): then poses, landmarks and keyframes go
//! through one more rigid motion. Odometry, velocity and covariance (body axes) are the same in either.
//!
//! Covariance comes in as that of the left perturbation of `camera_from_world`, `R' = exp(w) R_cw`, `t' = exp(w) t_cw + v`.
//! Then `R_wc' = R_wc exp(-w)` and the centre moves by `-R_wc v` to first order: the right tangent of `world_from_camera` is
//! `e_c = -[v, w]`, so its covariance is the same one with its halves swapped.

use nalgebra::{Matrix3, Matrix6, UnitQuaternion, Vector3};

use crate::frame;
use crate::geometry::frames::{Body, Camera, World};
use crate::geometry::{Se3, ros_from_optical};
use crate::map::scale::{MapScale, ScaleSource};
use crate::map::{KeyframeView, LandmarkView};
use crate::messages::{self, Keyframe, Landmark, NO_KEYFRAME, Pose};
use crate::reconstruction::{LensKnowledge, OrientationEstimate, PoseEstimate, TrackingState};

/// What is known of the length of a map unit.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum ScaleEstimate {
    /// Arbitrary.
    #[default]
    Unknown,
    /// Metres, with this relative standard deviation, as estimated; not relied upon.
    Estimated { sigma: f32 },
    /// Metres, with this relative standard deviation, and what tells it (bits of [`messages::scale_source`]).
    Metric { sigma: f32, source: u8 },
}

impl ScaleEstimate {
    /// `scale`, `scale_sigma` and `scale_source` of the messages.
    pub fn to_wire(self) -> (u8, f32, u8) {
        match self {
            Self::Unknown => (messages::SCALE_UNKNOWN, f32::NAN, 0),
            Self::Estimated { sigma } => (messages::SCALE_ESTIMATED, sigma, 0),
            Self::Metric { sigma, source } => (messages::SCALE_METRIC, sigma, source),
        }
    }
}

impl From<MapScale> for ScaleEstimate {
    fn from(scale: MapScale) -> Self {
        let MapScale::Metric { sigma, sources } = scale else { return Self::Unknown };
        let bits = [
            (ScaleSource::Wheels, messages::scale_source::WHEELS),
            (ScaleSource::Height, messages::scale_source::HEIGHT),
            (ScaleSource::Tag, messages::scale_source::TAG),
            (ScaleSource::StoredMap, messages::scale_source::STORED_MAP),
        ];
        let source =
            bits.into_iter().filter(|(source, _)| sources.contains(*source)).fold(0, |all, (_, bit)| all | bit);
        Self::Metric { sigma: sigma as f32, source }
    }
}

/// Frame of the map as published: the world's, in REP-103 axes, moved to where a planner has put it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Map;

/// What the messages need to know beyond the estimate itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Conversion {
    /// The mount, of the configuration; its translation in metres.
    pub body_from_camera: Se3<Body, Camera>,
    pub scale: ScaleEstimate,
    /// What the source's timestamps count from.
    pub clock: frame::Clock,
    /// Where a planner has put the map; `None`: where it began. Both sides in REP-103 axes.
    pub map_from_world: Option<Se3<Map, World>>,
}

impl Default for Conversion {
    /// A camera that looks forward, upright, at the body's origin; unknown scale.
    fn default() -> Self {
        Self {
            body_from_camera: Se3::new(ros_from_optical(), Vector3::zeros()),
            scale: ScaleEstimate::Unknown,
            clock: frame::Clock::Monotonic,
            map_from_world: None,
        }
    }
}

impl Conversion {
    /// `M`: camera axes to body axes, and the world's optical axes to the map's.
    pub fn rotation(&self) -> UnitQuaternion<f64> {
        self.body_from_camera.rotation
    }

    /// `b`: the camera's centre in the body, zero unless lengths are metres.
    fn lever(&self) -> Vector3<f64> {
        match self.scale {
            ScaleEstimate::Metric { .. } => self.body_from_camera.translation,
            ScaleEstimate::Unknown | ScaleEstimate::Estimated { .. } => Vector3::zeros(),
        }
    }

    /// The body in REP-103 axes, from `world_from_camera` (or `odom_from_camera`).
    fn body<W>(&self, world_from_camera: &Se3<W, Camera>) -> Se3<W, Body> {
        let m = self.rotation();
        let rotation = m * world_from_camera.rotation * m.inverse();
        Se3::new(rotation, m * world_from_camera.translation - rotation * self.lever())
    }

    /// The body in the map as published.
    fn body_in_map(&self, world_from_camera: &Se3<World, Camera>) -> Se3<Map, Body> {
        let world_from_body = self.body(world_from_camera);
        self.map_from_world.map_or(world_from_body.relabel(), |map_from_world| map_from_world * world_from_body)
    }

    /// From the world's optical axes to the map as published.
    pub fn map_from_optical(&self) -> Se3<Map, World> {
        let turned: Se3<World, World> = Se3::new(self.rotation(), Vector3::zeros());
        self.map_from_world.map_or(turned.relabel(), |map_from_world| map_from_world * turned)
    }
}

/// Position and quaternion as on the wire.
pub(super) fn to_wire<W>(pose: &Se3<W, Body>) -> ([f64; 3], [f64; 4]) {
    // One of the two quaternions of a rotation, always the same.
    let q = if pose.rotation.w < 0.0 { -pose.rotation.coords } else { pose.rotation.coords };
    (pose.translation.into(), [q.x, q.y, q.z, q.w])
}

/// Farther away from the map's origin, map units, single precision tells less than a tenth of a unit, and landmarks have no more.
pub const FARTHEST: f64 = 1e6;

/// The other way: `None` unless every number is finite, the place within [`FARTHEST`], and the quaternion of unit length within a thousandth.
pub fn from_wire(position: &[f64; 3], [x, y, z, w]: &[f64; 4]) -> Option<Se3<Map, Body>> {
    let q = nalgebra::Quaternion::new(*w, *x, *y, *z);
    let unit = (q.norm() - 1.0).abs() < 1e-3;
    let pose = Se3::new(UnitQuaternion::new_normalize(q), Vector3::from(*position));
    (unit && pose.is_finite() && position.iter().all(|v| v.abs() <= FARTHEST)).then_some(pose)
}

/// The [`Conversion::map_from_world`] under which the body that is published at `was` would be published at `now`.
pub fn place(now: &Se3<Map, Body>, was: &Se3<Map, Body>, map_from_world: Option<Se3<Map, World>>) -> Se3<Map, World> {
    let new_from_old: Se3<Map, Map> = *now * was.inverse();
    new_from_old * map_from_world.unwrap_or_default()
}

/// `clock` of the messages.
pub fn clock(clock: frame::Clock) -> u8 {
    match clock {
        frame::Clock::Monotonic => messages::CLOCK_MONOTONIC,
        frame::Clock::Recording => messages::CLOCK_RECORDING,
    }
}

/// `intrinsics` of the messages.
pub fn intrinsics(knowledge: LensKnowledge) -> u8 {
    match knowledge {
        LensKnowledge::Calibrated => messages::INTRINSICS_CALIBRATED,
        LensKnowledge::Estimated => messages::INTRINSICS_ESTIMATED,
        LensKnowledge::Guessed => messages::INTRINSICS_GUESSED,
    }
}

/// `lens_model` of the messages.
pub fn lens_model(is_wide_angle: bool) -> u8 {
    if is_wide_angle { messages::LENS_KANNALA_BRANDT } else { messages::LENS_RADIAL_TANGENTIAL }
}

/// `state` of the messages.
pub fn state(state: TrackingState) -> u8 {
    match state {
        TrackingState::Initializing => messages::STATE_INITIALIZING,
        TrackingState::Tracking => messages::STATE_TRACKING,
        TrackingState::Lost => messages::STATE_LOST,
        TrackingState::Orientation => messages::STATE_ORIENTATION,
        TrackingState::DeadReckoning => messages::STATE_DEAD_RECKONING,
    }
}

/// The message of one frame, without what only the sender knows (run, drops, times of sending).
///
/// An estimate that claims to track, or to reckon, and has no finite pose is sent as lost: nothing invented may look good.
pub fn pose(estimate: &PoseEstimate, conversion: &Conversion) -> Pose {
    let (scale, scale_sigma, scale_source) = conversion.scale.to_wire();
    let mut pose = Pose {
        sequence: estimate.sequence,
        timestamp_ns: estimate.timestamp_ns,
        arrival_ns: estimate.arrival_ns,
        scale_sigma,
        landmarks_sought: estimate.landmarks_sought,
        reset_counter: estimate.reset_counter,
        map_id: estimate.map.0,
        map_revision: estimate.map_revision,
        state: state(estimate.state),
        scale,
        scale_source,
        clock: clock(conversion.clock),
        ..Pose::default()
    };
    match (estimate.state, &estimate.orientation) {
        (TrackingState::Tracking | TrackingState::DeadReckoning, _) => {}
        (TrackingState::Orientation, Some(orientation)) => {
            turned(&mut pose, orientation, conversion);
            return pose;
        }
        (TrackingState::Orientation, None) => {
            pose.state = messages::STATE_INITIALIZING;
            return pose;
        }
        _ => return pose,
    }
    let finite = |p: &Se3<_, Camera>| p.is_finite();
    let Some(world_from_camera) = estimate.world_from_camera.filter(finite) else {
        pose.state = messages::STATE_LOST;
        return pose;
    };
    (pose.position, pose.orientation) = to_wire(&conversion.body_in_map(&world_from_camera));
    if let Some(odom_from_camera) = estimate.odom_from_camera.filter(|p| p.is_finite()) {
        (pose.odom_position, pose.odom_orientation) = to_wire(&conversion.body(&odom_from_camera));
    }
    pose.covariance = upper_triangle(&body_covariance(&estimate.covariance, conversion));
    let (m, lever) = (conversion.rotation(), conversion.lever());
    let (angular, mut linear) = (m * estimate.angular_velocity, m * estimate.linear_velocity);
    if lever != Vector3::zeros() {
        // Not without a lever: an unknown rate would make the known velocity unknown.
        linear -= angular.cross(&lever);
    }
    pose.angular_velocity = angular.into();
    pose.linear_velocity = linear.into();
    pose.quality = estimate.quality;
    pose.landmarks = estimate.landmarks;
    pose.anchor_keyframe = estimate.anchor.map_or(NO_KEYFRAME, |k| k.0);
    pose.keyframe = u8::from(estimate.keyframe);
    pose
}

/// Fills in what is known of a body without a place: how it has turned since the first frame. Its covariance is that of the camera with
/// the mount's axes; all of it that a position has part in is NaN.
fn turned(pose: &mut Pose, orientation: &OrientationEstimate, conversion: &Conversion) {
    let m = conversion.rotation();
    let first_from_camera: Se3<Map, Camera> = Se3::new(orientation.first_from_camera, Vector3::zeros());
    let (_, quaternion) = to_wire(&conversion.body(&first_from_camera));
    let axes = m.to_rotation_matrix();
    let mut covariance = Matrix6::from_element(f64::NAN);
    covariance.fixed_view_mut::<3, 3>(3, 3).copy_from(&(axes * orientation.covariance * axes.transpose()));
    if !quaternion.iter().chain(covariance.fixed_view::<3, 3>(3, 3).iter()).all(|v| v.is_finite()) {
        pose.state = messages::STATE_INITIALIZING;
        return;
    }
    (pose.orientation, pose.odom_orientation) = (quaternion, quaternion);
    pose.covariance = upper_triangle(&covariance);
    pose.angular_velocity = (m * orientation.angular_velocity).into();
}

/// Covariance of the body's pose, order position, rotation, right tangent; from that of the left perturbation of
/// `camera_from_world`, order rotation, translation.
pub fn body_covariance(camera: &Matrix6<f64>, conversion: &Conversion) -> Matrix6<f64> {
    let m: Matrix3<f64> = conversion.rotation().to_rotation_matrix().into_inner();
    // From [w, v] to [position, rotation] of the body; the common sign cancels.
    let mut j = Matrix6::zeros();
    j.fixed_view_mut::<3, 3>(0, 3).copy_from(&m);
    j.fixed_view_mut::<3, 3>(0, 0).copy_from(&(conversion.lever().cross_matrix() * m));
    j.fixed_view_mut::<3, 3>(3, 0).copy_from(&m);
    j * camera * j.transpose()
}

fn upper_triangle(m: &Matrix6<f64>) -> [f64; 21] {
    let mut packed = [f64::NAN; 21];
    let entries = (0..6).flat_map(|i| (i..6).map(move |j| (i, j)));
    for (slot, (i, j)) in packed.iter_mut().zip(entries) {
        // The mean of both halves, so that rounding leaves no trace of which one was taken.
        *slot = 0.5 * (m[(i, j)] + m[(j, i)]);
    }
    packed
}

/// A landmark in the map as published; `map_from_optical` is [`Conversion::map_from_optical`].
pub fn landmark(landmark: &LandmarkView, map_from_optical: &Se3<Map, World>) -> Landmark {
    let p = map_from_optical.transform(&landmark.position_world);
    Landmark {
        id: landmark.id.0,
        observations: landmark.observations,
        position: [p.x as f32, p.y as f32, p.z as f32],
        sigma: landmark.sigma,
    }
}

/// A keyframe as the pose of the body.
pub fn keyframe(keyframe: &KeyframeView, conversion: &Conversion) -> Keyframe {
    let (position, orientation) = to_wire(&conversion.body_in_map(&keyframe.world_from_camera));
    Keyframe { timestamp_ns: keyframe.timestamp_ns, position, orientation, id: keyframe.id.0, reserved: 0 }
}
