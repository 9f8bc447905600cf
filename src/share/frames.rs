//! What all ROS messages of ours share, of a recording or sent: names, stamps, and where things are.
//!
//! Times: a stamp is the capture time as Unix time by WIRE.md's rule, `timestamp_ns` plus the offset of both clocks, or `timestamp_ns` itself where the
//! source is a recording.
//!
//! Lengths of a map without a metric scale are no metres, so its frames have names of their own that no metric tree has: `map_unscaled`,
//! `odom_unscaled`, `base_link_unscaled`, `camera_unscaled`.

use super::conversion::is_finite;
use crate::messages::{CLOCK_MONOTONIC, EncodedHeader, Obstacles, Pose, State, Transform};
use crate::ros::standard::{self as ros, Header, Time};

/// Frames' names.
pub struct Frames {
    pub map: &'static str,
    pub odom: &'static str,
    pub body: &'static str,
    pub camera: &'static str,
}

pub const METRIC: Frames = Frames { map: "map", odom: "odom", body: "base_link", camera: "camera" };
const UNSCALED: Frames =
    Frames { map: "map_unscaled", odom: "odom_unscaled", body: "base_link_unscaled", camera: "camera_unscaled" };

/// The robot's foot point, level with the floor: a scan's, in the map.
pub const SCAN_FRAME: &str = "scan";

pub fn frames(is_metric: bool) -> &'static Frames {
    if is_metric { &METRIC } else { &UNSCALED }
}

/// A prefix as part of a topic's name: ROS 2 allows letters, digits and _ between slashes.
pub fn ros_name(prefix: &str) -> String {
    prefix.chars().map(|c| if c.is_ascii_alphanumeric() || c == '/' { c } else { '_' }).collect()
}

/// The wire's times as Unix time.
#[derive(Debug, Clone, Copy)]
pub struct UnixTime {
    pub realtime_minus_monotonic_ns: i64,
}

impl UnixTime {
    pub fn ns(self, monotonic_ns: i64) -> i64 {
        monotonic_ns.saturating_add(self.realtime_minus_monotonic_ns)
    }

    pub fn stamp(self, timestamp_ns: i64, clock: u8) -> Time {
        Time::from_ns(if clock == CLOCK_MONOTONIC { self.ns(timestamp_ns) } else { timestamp_ns })
    }
}

/// Where the body is.
pub struct Place {
    pub map_from_body: Transform,
    pub odom_from_body: Transform,
}

impl Place {
    /// `None` where a pose has no position.
    pub fn of(pose: &Pose) -> Option<Self> {
        let place = Self {
            map_from_body: Transform { position: pose.position, orientation: pose.orientation },
            odom_from_body: Transform { position: pose.odom_position, orientation: pose.odom_orientation },
        };
        let has_place = matches!(pose.state(), State::Tracking | State::DeadReckoning);
        (has_place && is_finite(&place.map_from_body) && is_finite(&place.odom_from_body)).then_some(place)
    }

    /// The tree above the body: `map` -> `odom` -> `base_link`.
    pub fn transforms(&self, stamp: &Time, frames: &Frames) -> Vec<ros::TransformStamped<'static>> {
        let map_from_odom = self.map_from_body * self.odom_from_body.inverse();
        vec![
            transform(stamp, frames.map, frames.odom, &map_from_odom),
            transform(stamp, frames.odom, frames.body, &self.odom_from_body),
        ]
    }
}

pub fn transform(
    stamp: &Time,
    parent: &'static str,
    child: &'static str,
    parent_from_child: &Transform,
) -> ros::TransformStamped<'static> {
    ros::TransformStamped {
        header: Header { stamp: stamp.clone(), frame_id: parent },
        child_frame_id: child,
        transform: ros::Transform {
            translation: parent_from_child.position.into(),
            rotation: parent_from_child.orientation.into(),
        },
    }
}

/// `body_from_camera`.
pub fn mount(header: &EncodedHeader) -> Option<Transform> {
    let mount = Transform { position: header.camera_position, orientation: header.camera_orientation };
    is_finite(&mount).then_some(mount)
}

/// `map_from_scan`, where anything is known.
pub fn scan_place(obstacles: &Obstacles) -> Option<Transform> {
    let place = Transform { position: obstacles.position, orientation: obstacles.orientation };
    (obstacles.is_told() && is_finite(&place)).then_some(place)
}
