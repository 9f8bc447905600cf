//! The wire's own messages as ROS 2 messages: every field as it is on the wire (`cairn_msgs/msg/...`), NaN and all; what is reserved is left out.

use crate::messages::{
    EncodedHeader, GraphEdge, GraphHeader, Health, Keyframe, KeyframesHeader, MAX_TAGS, MapHeader, OBSTACLE_BEARINGS,
    OBSTACLE_POINTS, Obstacles, Pose, STAGES, StageHealth, Tag, Tags, WheelOdometry,
};
use crate::ros_fields;

macro_rules! mirror {
    ($type:ty, $name:literal, { $($field:ident: $kind:ty),+ $(,)? }) => {
        ros_fields!([] $type, $name, { $($field: $kind),+ });
        #[cfg(test)]
        impl tests::Mirrored for $type {
            const MIRRORED: &'static [&'static str] = &[$(stringify!($field)),+];
        }
    };
}

mirror!(Pose, "cairn_msgs/msg/Pose", {
    run_id: u64, sequence: u64, timestamp_ns: i64, arrival_ns: i64, published_ns: i64, latency_arrival_ns: i64,
    latency_capture_ns: i64, frames_dropped: u64, position: [f64; 3], orientation: [f64; 4], odom_position: [f64; 3],
    odom_orientation: [f64; 4], covariance: [f64; 21], linear_velocity: [f64; 3], angular_velocity: [f64; 3],
    quality: f32, scale_sigma: f32, landmarks: u32, landmarks_sought: u32, reset_counter: u32, map_id: u32,
    map_revision: u32, anchor_keyframe: u32, state: u8, scale: u8, scale_source: u8, clock: u8, keyframe: u8,
});

mirror!(StageHealth, "cairn_msgs/msg/StageHealth", {
    steps: u64, heartbeat_age_ns: i64, p50_ms: f32, p95_ms: f32, p99_ms: f32, rate_hz: f32,
});

mirror!(Health, "cairn_msgs/msg/Health", {
    run_id: u64, sequence: u64, published_ns: i64, uptime_ns: i64, realtime_minus_monotonic_ns: i64, errors: u64,
    frames_captured: u64, frames_dropped: u64, frames_corrupt: u64, frames_tracked: u64, keyframes_made: u64,
    landmarks_made: u64, adjustments: u64, adjustments_late: u64, resets: u64, relocalisations: u64, maps_joined: u64,
    loops_closed: u64, frame_age_ns: i64, pose_age_ns: i64, stages: [StageHealth; STAGES], keyframes: u32,
    landmarks: u32, maps: u32, reset_counter: u32, map_id: u32, map_revision: u32, pid: u32, state: u8, clock: u8,
    intrinsics: u8, lens_model: u8, version: [u8; 32], focal_px: [f32; 2], centre_px: [f32; 2], focal_sigma: f32,
    centre_sigma_px: f32, correction_distance: f32, correction_rad: f32, map_mode: u8,
    blind_ns: u64, blind_m: f64,
    wheel_messages: u64, wheel_refused: u64, wheel_missing: u64, wheel_late: u64,
});

mirror!(MapHeader, "cairn_msgs/msg/MapHeader", {
    run_id: u64, content_revision: u64, timestamp_ns: i64, published_ns: i64, count: u32, total: u32, map_id: u32,
    reset_counter: u32, map_revision: u32, scale_sigma: f32, scale: u8, scale_source: u8, clock: u8, map_mode: u8,
});

mirror!(KeyframesHeader, "cairn_msgs/msg/KeyframesHeader", {
    run_id: u64, content_revision: u64, timestamp_ns: i64, published_ns: i64, count: u32, total: u32, map_id: u32,
    reset_counter: u32, map_revision: u32, scale_sigma: f32, scale: u8, scale_source: u8, clock: u8, map_mode: u8,
});

mirror!(Keyframe, "cairn_msgs/msg/Keyframe", {
    timestamp_ns: i64, position: [f64; 3], orientation: [f64; 4], id: u32,
});

/// A keyframes message whole.
pub struct Keyframes<'a> {
    pub header: KeyframesHeader,
    pub keyframes: &'a [Keyframe],
}

ros_fields!(['a] Keyframes<'a>, "cairn_msgs/msg/Keyframes", { header: KeyframesHeader, keyframes: &'a [Keyframe] });

mirror!(GraphHeader, "cairn_msgs/msg/GraphHeader", {
    run_id: u64, content_revision: u64, timestamp_ns: i64, published_ns: i64, count: u32, total: u32, map_id: u32,
    reset_counter: u32, map_revision: u32, clock: u8, map_mode: u8,
});

mirror!(GraphEdge, "cairn_msgs/msg/GraphEdge", { from: u32, to: u32, shared: u32, joined_map: u32, kind: u8 });

/// A graph message whole.
pub struct Graph<'a> {
    pub header: GraphHeader,
    pub edges: &'a [GraphEdge],
}

ros_fields!(['a] Graph<'a>, "cairn_msgs/msg/Graph", { header: GraphHeader, edges: &'a [GraphEdge] });

mirror!(Tag, "cairn_msgs/msg/Tag", {
    position: [f64; 3], orientation: [f64; 4], size: f32, edge: f32, position_sigma: f32, orientation_sigma: f32,
    id: u32, sightings: u32, family: u8, is_dock: u8,
});

mirror!(Tags, "cairn_msgs/msg/Tags", {
    run_id: u64, content_revision: u64, timestamp_ns: i64, published_ns: i64, count: u32, map_id: u32,
    reset_counter: u32, map_revision: u32, scale_sigma: f32, scale: u8, scale_source: u8, clock: u8, map_mode: u8,
    tags: [Tag; MAX_TAGS],
});

mirror!(EncodedHeader, "cairn_msgs/msg/EncodedHeader", {
    run_id: u64, sequence: u64, timestamp_ns: i64, arrival_ns: i64, focal_px: [f64; 2], centre_px: [f64; 2],
    distortion: [f64; 5], camera_position: [f64; 3], camera_orientation: [f64; 4], width: u32, height: u32, stride: u32,
    format: u8, clock: u8, intrinsics: u8, lens_model: u8,
});

mirror!(Obstacles, "cairn_msgs/msg/Obstacles", {
    run_id: u64, sequence: u64, timestamp_ns: i64, published_ns: i64, position: [f64; 3], orientation: [f64; 4],
    angle_min: f32, angle_increment: f32, range_min: f32, range_max: f32, robot_height: f32, scale_sigma: f32,
    map_id: u32, reset_counter: u32, map_revision: u32, count: u32, total: u32, told: u8, clock: u8,
    range: [f32; OBSTACLE_BEARINGS], sigma: [f32; OBSTACLE_BEARINGS], free_from: [f32; OBSTACLE_BEARINGS],
    free: [f32; OBSTACLE_BEARINGS], points: [[f32; 4]; OBSTACLE_POINTS],
});

mirror!(WheelOdometry, "cairn_msgs/msg/WheelOdometry", {
    sequence: u64, timestamp_ns: i64, interval_start_ns: i64, linear_x_mps: f64, linear_y_mps: f64, angular_z_radps: f64,
    variance: [f64; 3],
});

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::Field;

    pub trait Mirrored {
        const MIRRORED: &'static [&'static str];
    }

    #[test]
    fn every_field_of_the_wire_is_there_in_its_order() {
        fn check<T: Mirrored>(fields: &[Field], wire: &str) {
            let all: Vec<&str> = fields.iter().map(|field| field.name).filter(|name| *name != "reserved").collect();
            assert_eq!(T::MIRRORED, all, "{wire}");
        }
        macro_rules! all {
            ($($type:ty),+) => { $(check::<$type>(<$type>::FIELDS, <$type>::TYPE_NAME);)+ };
        }
        all!(Pose, StageHealth, Health, MapHeader, KeyframesHeader, Keyframe, EncodedHeader, Obstacles, WheelOdometry);
        all!(GraphHeader, GraphEdge, Tag, Tags);
    }
}
