//! What stands around the robot, and where the floor is seen free.

use iceoryx2::prelude::ZeroCopySend;

use super::UNKNOWN_NS;

/// Bearings of a scan: two degrees each, all round.
pub const OBSTACLE_BEARINGS: usize = 180;
/// Points of a scan at the most.
pub const OBSTACLE_POINTS: usize = 500;

/// `told`: the scan is what is known.
pub const OBSTACLES_TOLD: u8 = 0;
/// `told`: the robot has no pose, so nothing is known.
pub const OBSTACLES_NO_POSE: u8 = 1;
/// `told`: the map's lengths are no metres, so nothing is known.
pub const OBSTACLES_NOT_METRIC: u8 = 2;
/// `told`: the floor was not found, so nothing is known.
pub const OBSTACLES_NO_FLOOR: u8 = 3;

/// A planar scan by bearing, and the points that it is made from, in the robot's axes on the floor (forward, left, up, from the foot of its origin).
/// What is not known is never free and never far: NaN, and 0.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("cairn.Obstacles.v1")]
pub struct Obstacles {
    /// Another value at every start of the daemon.
    pub run_id: u64,
    /// As in [`super::Pose::sequence`] of the frame that the robot's place is of.
    pub sequence: u64,
    /// Capture time of that frame in the source's clock (`clock`), ns.
    pub timestamp_ns: i64,
    /// CLOCK_MONOTONIC when this message was sent, ns.
    pub published_ns: i64,
    /// The scan's origin in the map, m.
    pub position: [f64; 3],
    /// `map_from_scan`, quaternion (x, y, z, w): its z axis is the floor's normal.
    pub orientation: [f64; 4],
    /// Of the first bearing, from the robot's forward to the left, rad.
    pub angle_min: f32,
    /// From one bearing to the next, rad.
    pub angle_increment: f32,
    /// Nothing is told nearer, and nothing farther, m.
    pub range_min: f32,
    /// See `range_min`.
    pub range_max: f32,
    /// What is higher above the floor is not in the way, m.
    pub robot_height: f32,
    /// Relative standard deviation of the scale: of all lengths alike.
    pub scale_sigma: f32,
    /// As in [`super::Pose::map_id`].
    pub map_id: u32,
    /// As in [`super::Pose::reset_counter`].
    pub reset_counter: u32,
    /// As in [`super::Pose::map_revision`].
    pub map_revision: u32,
    /// Points in this message, nearest first.
    pub count: u32,
    /// Points in reach; if larger than `count`, the farthest were left out.
    pub total: u32,
    /// [`OBSTACLES_TOLD`], [`OBSTACLES_NO_POSE`], [`OBSTACLES_NOT_METRIC`], [`OBSTACLES_NO_FLOOR`].
    pub told: u8,
    /// [`super::CLOCK_MONOTONIC`], [`super::CLOCK_RECORDING`].
    pub clock: u8,
    /// Zero.
    pub reserved: [u8; 2],
    /// Distance of the nearest thing by bearing, m; NaN: none is known, which does not say that there is none. With `[obstacles] seen_floor` also of what keyframes saw stand, which is not in `points`.
    pub range: [f32; OBSTACLE_BEARINGS],
    /// Standard deviation of `range`, m; NaN as there.
    pub sigma: [f32; OBSTACLE_BEARINGS],
    /// The floor is free from here on, m: the longest stretch of those that begin near the robot; before it nothing is known, as a camera looks over the floor at the robot's feet; NaN where `free` is 0.
    pub free_from: [f32; OBSTACLE_BEARINGS],
    /// The floor is free up to here, m; 0: not known. Where the robot has been, or (`[obstacles] seen_floor`) keyframes saw nothing stand: not where what hangs above it has no landmark, and with unknown places filled up to a fifth of the distance.
    pub free: [f32; OBSTACLE_BEARINGS],
    /// Forward, left, up, and the standard deviation along the floor, m; NaN beyond `count`.
    pub points: [[f32; 4]; OBSTACLE_POINTS],
}

layout!(Obstacles, "cairn.Obstacles.v1", 11016, {
    run_id @ 0, sequence @ 8, timestamp_ns @ 16, published_ns @ 24, position @ 32, orientation @ 56, angle_min @ 88,
    angle_increment @ 92, range_min @ 96, range_max @ 100, robot_height @ 104, scale_sigma @ 108, map_id @ 112,
    reset_counter @ 116, map_revision @ 120, count @ 124, total @ 128, told @ 132, clock @ 133, reserved @ 134,
    range @ 136, sigma @ 856, free_from @ 1576, free @ 2296, points @ 3016,
});

impl Default for Obstacles {
    /// Nothing is known.
    fn default() -> Self {
        let step = core::f32::consts::TAU / OBSTACLE_BEARINGS as f32;
        Self {
            run_id: 0,
            sequence: 0,
            timestamp_ns: UNKNOWN_NS,
            published_ns: UNKNOWN_NS,
            position: [f64::NAN; 3],
            orientation: [f64::NAN; 4],
            angle_min: -core::f32::consts::PI,
            angle_increment: step,
            range_min: 0.0,
            range_max: 0.0,
            robot_height: f32::NAN,
            scale_sigma: f32::NAN,
            map_id: 0,
            reset_counter: 0,
            map_revision: 0,
            count: 0,
            total: 0,
            told: OBSTACLES_NO_POSE,
            clock: 0,
            reserved: [0; 2],
            range: [f32::NAN; OBSTACLE_BEARINGS],
            sigma: [f32::NAN; OBSTACLE_BEARINGS],
            free_from: [f32::NAN; OBSTACLE_BEARINGS],
            free: [0.0; OBSTACLE_BEARINGS],
            points: [[f32::NAN; 4]; OBSTACLE_POINTS],
        }
    }
}

impl Obstacles {
    /// The scan says something; else all of it is unknown.
    pub fn is_told(&self) -> bool {
        self.told == OBSTACLES_TOLD
    }

    /// `TOLD`, `NO_POSE`, `NOT_METRIC`, `NO_FLOOR`, `UNKNOWN`.
    pub fn told_name(&self) -> &'static str {
        match self.told {
            OBSTACLES_TOLD => "TOLD",
            OBSTACLES_NO_POSE => "NO_POSE",
            OBSTACLES_NOT_METRIC => "NOT_METRIC",
            OBSTACLES_NO_FLOOR => "NO_FLOOR",
            _ => "UNKNOWN",
        }
    }

    /// Of a bearing, from the robot's forward to the left, rad.
    pub fn angle(&self, bearing: usize) -> f32 {
        self.angle_min + self.angle_increment * bearing as f32
    }

    /// The points that are there.
    pub fn in_the_way(&self) -> &[[f32; 4]] {
        &self.points[..(self.count as usize).min(OBSTACLE_POINTS)]
    }
}
