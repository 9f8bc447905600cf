//! The robot's pose, one message a frame.

use iceoryx2::prelude::ZeroCopySend;

use super::{CLOCK_MONOTONIC, Clock, NO_KEYFRAME, SCALE_UNKNOWN, STATE_INITIALIZING, Scale, State, UNKNOWN_NS};

/// One frame's pose. Unless `state` is [`super::STATE_TRACKING`] or [`super::STATE_DEAD_RECKONING`], everything that belongs to the pose is NaN or zero; but with
/// [`super::STATE_ORIENTATION`] both orientations, the covariance of the rotation and the angular velocity are there.
///
/// # Covariance
/// `covariance` is the upper triangle, row by row, of the symmetric 6x6 matrix in the order x, y, z, rotation about x, y, z,
/// for a small error of the **body**, in the body's own axes (right tangent):
///
/// ```text
/// position_true = position + R · e[0..3]        R_true = R · exp(e[3..6])        covariance = E[e eᵀ]
/// ```
///
/// Positions in map units squared, angles in rad². It is relative to `anchor_keyframe`, scale removed: it says how well the
/// pose is known within the map around it. An absolute one of a monocular map would be an artefact of where its origin
/// lies. One part of it is not local: behind a turn on the spot that left everything behind whose distance was known, lengths are
/// those of an assumed distance, and what that may be wrong makes of the way since the turn is in it, along that way, until the robot
/// is located by what lies before the turn (health says `SCALE_ASSUMED` as long). NaN means unknown. The clients unpack it (`covariance_matrix`) and turn it into the axes that `nav_msgs/Odometry` and
/// MAVLink want (`covariance_in_map_axes`).
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("cairn.Pose.v2")]
pub struct Pose {
    /// Another value at every start of the daemon: ids, counters and frames of two runs are unrelated.
    pub run_id: u64,
    /// Counts every frame that the source saw, dropped ones too; 0 is the first.
    pub sequence: u64,
    /// Capture time in the source's clock (`clock`), ns.
    pub timestamp_ns: i64,
    /// CLOCK_MONOTONIC when the frame arrived in the daemon, ns.
    pub arrival_ns: i64,
    /// CLOCK_MONOTONIC when this message was sent, ns.
    pub published_ns: i64,
    /// From arrival to sending, ns.
    pub latency_arrival_ns: i64,
    /// From capture to sending, ns; [`UNKNOWN_NS`] unless `clock` is CLOCK_MONOTONIC. Some drivers stamp slightly in the
    /// future, so it can be negative.
    pub latency_capture_ns: i64,
    /// Frames of this run that were never looked at because a later one was there already.
    pub frames_dropped: u64,
    /// Map pose: the body's origin in the map, map units.
    pub position: [f64; 3],
    /// Map pose: `map_from_body`, quaternion (x, y, z, w). With [`super::STATE_ORIENTATION`], as there is no map, the same as `odom_orientation`.
    pub orientation: [f64; 4],
    /// Odom pose: the body's origin in odom, map units.
    pub odom_position: [f64; 3],
    /// Odom pose: `odom_from_body`, quaternion (x, y, z, w). With [`super::STATE_ORIENTATION`]: since the first frame; a map that then begins
    /// continues it.
    pub odom_orientation: [f64; 4],
    /// Upper triangle of the 6x6 covariance, see above.
    pub covariance: [f64; 21],
    /// Velocity of the body's origin in the body's axes, map units/s.
    pub linear_velocity: [f64; 3],
    /// Angular velocity in the body's axes, rad/s.
    pub angular_velocity: [f64; 3],
    /// 0 (none) to 1 (as good as it gets).
    pub quality: f32,
    /// Relative standard deviation of the scale (0.02: a length of 1 is known to 0.02); NaN unless it is estimated.
    pub scale_sigma: f32,
    /// Landmarks seen in this frame that the pose rests on.
    pub landmarks: u32,
    /// Landmarks that were looked for in this frame.
    pub landmarks_sought: u32,
    /// Grows with every reset and re-initialisation, and where an orientation without a map begins anew: poses across a change are unrelated.
    pub reset_counter: u32,
    /// The map that the pose is in.
    pub map_id: u32,
    /// Grows whenever coordinates of the map are corrected by more than ordinary adjustment; `odom` does not move then.
    pub map_revision: u32,
    /// Keyframe that the covariance is relative to; [`NO_KEYFRAME`] if there is none.
    pub anchor_keyframe: u32,
    /// [`super::STATE_INITIALIZING`], [`super::STATE_TRACKING`], [`super::STATE_LOST`], [`super::STATE_ORIENTATION`],
    /// [`super::STATE_DEAD_RECKONING`].
    pub state: u8,
    /// [`super::SCALE_UNKNOWN`], [`super::SCALE_ESTIMATED`], [`super::SCALE_METRIC`].
    pub scale: u8,
    /// Bits of [`super::scale_source`]: what the scale comes from; 0 = nothing.
    pub scale_source: u8,
    /// [`super::CLOCK_MONOTONIC`], [`super::CLOCK_RECORDING`].
    pub clock: u8,
    /// 1 if this frame becomes a keyframe, else 0.
    pub keyframe: u8,
    /// Zero.
    pub reserved: [u8; 19],
}

layout!(Pose, "cairn.Pose.v2", 448, {
    run_id @ 0, sequence @ 8, timestamp_ns @ 16, arrival_ns @ 24, published_ns @ 32, latency_arrival_ns @ 40,
    latency_capture_ns @ 48, frames_dropped @ 56, position @ 64, orientation @ 88, odom_position @ 120,
    odom_orientation @ 144, covariance @ 176, linear_velocity @ 344, angular_velocity @ 368, quality @ 392,
    scale_sigma @ 396, landmarks @ 400, landmarks_sought @ 404, reset_counter @ 408, map_id @ 412,
    map_revision @ 416, anchor_keyframe @ 420, state @ 424, scale @ 425, scale_source @ 426, clock @ 427, keyframe @ 428,
    reserved @ 429,
});

impl Default for Pose {
    /// No pose: initialising, everything unknown.
    fn default() -> Self {
        Self {
            run_id: 0,
            sequence: 0,
            timestamp_ns: 0,
            arrival_ns: 0,
            published_ns: 0,
            latency_arrival_ns: UNKNOWN_NS,
            latency_capture_ns: UNKNOWN_NS,
            frames_dropped: 0,
            position: [f64::NAN; 3],
            orientation: [f64::NAN; 4],
            odom_position: [f64::NAN; 3],
            odom_orientation: [f64::NAN; 4],
            covariance: [f64::NAN; 21],
            linear_velocity: [f64::NAN; 3],
            angular_velocity: [f64::NAN; 3],
            quality: 0.0,
            scale_sigma: f32::NAN,
            landmarks: 0,
            landmarks_sought: 0,
            reset_counter: 0,
            map_id: 0,
            map_revision: 0,
            anchor_keyframe: NO_KEYFRAME,
            state: STATE_INITIALIZING,
            scale: SCALE_UNKNOWN,
            scale_source: 0,
            clock: CLOCK_MONOTONIC,
            keyframe: 0,
            reserved: [0; 19],
        }
    }
}

impl Pose {
    /// `state` as a type.
    pub fn state(&self) -> State {
        State::from_wire(self.state)
    }

    /// There is a pose in this message that rests on what this frame shows.
    pub fn is_tracking(&self) -> bool {
        self.state() == State::Tracking
    }

    /// The picture is lost and the wheels alone carry the pose on: not usable to drive by as a tracked one is, see the covariance.
    pub fn is_dead_reckoned(&self) -> bool {
        self.state() == State::DeadReckoning
    }

    /// The orientations and their covariance are known: of a pose, or alone before there is a map.
    pub fn has_orientation(&self) -> bool {
        matches!(self.state(), State::Tracking | State::Orientation | State::DeadReckoning)
    }

    /// `scale` as a type.
    pub fn scale(&self) -> Scale {
        Scale::from_wire(self.scale)
    }

    /// Lengths are metres: their relative standard deviation (0.01: 1 %); `None` where they are of an arbitrary unit.
    pub fn metric(&self) -> Option<f32> {
        (self.scale() == Scale::Metric).then_some(self.scale_sigma)
    }

    /// `clock` as a type.
    pub fn clock(&self) -> Clock {
        Clock::from_wire(self.clock)
    }

    /// `anchor_keyframe`, if there is one.
    pub fn anchor(&self) -> Option<u32> {
        (self.anchor_keyframe != NO_KEYFRAME).then_some(self.anchor_keyframe)
    }

    /// The times are those of a camera on this machine and not of a recording: `timestamp_ns` can be compared with other
    /// sensors' CLOCK_MONOTONIC.
    pub fn is_live(&self) -> bool {
        self.clock() == Clock::Monotonic
    }

    /// How long ago the frame was taken, ns, or, of a recording, arrived in the daemon; `now_ns` is CLOCK_MONOTONIC (`client::monotonic_ns`).
    pub fn age_ns(&self, now_ns: i64) -> i64 {
        // A frame may have waited in its driver through a stall; a driver's clock may be some ms ahead.
        let since = if self.is_live() { self.timestamp_ns.min(self.arrival_ns) } else { self.arrival_ns };
        now_ns.saturating_sub(since)
    }

    /// The covariance as a full matrix, body axes, order x, y, z, rotation about x, y, z.
    pub fn covariance_matrix(&self) -> [[f64; 6]; 6] {
        let mut full = [[0.0; 6]; 6];
        let entries = (0..6).flat_map(|i| (i..6).map(move |j| (i, j)));
        for ((i, j), &value) in entries.zip(&self.covariance) {
            full[i][j] = value;
            full[j][i] = value;
        }
        full
    }

    /// The covariance in the axes of the map (`map_from_body` applied to both halves): position errors along the map's
    /// axes and rotations about them, as `nav_msgs/Odometry` and MAVLink's `ODOMETRY` define theirs.
    pub fn covariance_in_map_axes(&self) -> [[f64; 6]; 6] {
        let r = rotation_matrix(&self.orientation);
        let c = self.covariance_matrix();
        let mut half = [[0.0; 6]; 6]; // diag(R, R) · C
        let mut full = [[0.0; 6]; 6]; // ... · diag(R, R)ᵀ
        for (i, row) in half.iter_mut().enumerate() {
            for (j, out) in row.iter_mut().enumerate() {
                *out = (0..3).map(|k| r[i % 3][k] * c[i / 3 * 3 + k][j]).sum();
            }
        }
        for (i, row) in full.iter_mut().enumerate() {
            for (j, out) in row.iter_mut().enumerate() {
                *out = (0..3).map(|k| half[i][j / 3 * 3 + k] * r[j % 3][k]).sum();
            }
        }
        full
    }
}

/// Rotation matrix, row by row, of a unit quaternion (x, y, z, w).
pub(super) fn rotation_matrix(&[x, y, z, w]: &[f64; 4]) -> [[f64; 3]; 3] {
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_default_pose_looks_like_no_pose() {
        let pose = Pose::default();
        assert!(!pose.is_tracking());
        assert!(pose.position.iter().chain(&pose.orientation).chain(&pose.covariance).all(|v| v.is_nan()));
        assert_eq!((pose.anchor(), pose.metric()), (None, None));
        let metric = Pose { scale: crate::messages::SCALE_METRIC, scale_sigma: 0.012, ..pose };
        assert_eq!(metric.metric(), Some(0.012));
    }

    #[test]
    fn a_frame_that_waited_in_its_driver_is_as_old_as_it_is() {
        let pose = Pose { timestamp_ns: 1_000, arrival_ns: 5_000, ..Pose::default() };
        assert!(pose.is_live() && pose.age_ns(5_100) == 4_100);
        // A driver's clock that is ahead makes no frame of the future.
        assert_eq!(Pose { timestamp_ns: 5_200, ..pose }.age_ns(5_100), 100);
        assert_eq!(Pose { clock: crate::messages::CLOCK_RECORDING, ..pose }.age_ns(5_100), 100);
    }

    #[test]
    fn covariance_is_unpacked_row_by_row() {
        let pose = Pose { covariance: std::array::from_fn(|i| i as f64), ..Pose::default() };
        let full = pose.covariance_matrix();
        assert_eq!(full[0], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
        assert_eq!(full[1][1..], [6.0, 7.0, 8.0, 9.0, 10.0]);
        assert_eq!(full[5], [5.0, 10.0, 14.0, 17.0, 19.0, 20.0]);
    }

    #[test]
    fn a_quarter_turn_swaps_the_axes_of_the_covariance() {
        // Body turned left by 90 degrees: its x lies along the map's y.
        let half = 0.5f64.sqrt();
        let mut covariance = [0.0; 21];
        (covariance[0], covariance[6], covariance[11]) = (1.0, 4.0, 9.0); // x, y, z
        (covariance[15], covariance[18], covariance[20]) = (0.1, 0.2, 0.3); // rotations
        let pose = Pose { orientation: [0.0, 0.0, half, half], covariance, ..Pose::default() };
        let map = pose.covariance_in_map_axes();
        let diagonal: Vec<f64> = (0..6).map(|i| map[i][i]).collect();
        for (got, want) in diagonal.iter().zip([4.0, 1.0, 9.0, 0.2, 0.1, 0.3]) {
            assert!((got - want).abs() < 1e-12, "{diagonal:?}");
        }
    }
}
