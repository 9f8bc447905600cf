//! Messages as lines: JSON with the wire's own names, or text for a person.

use std::fmt::Write;

use serde::Serialize;

use crate::client::MapSnapshot;
use crate::messages::{
    Clock, Health, Intrinsics, MapHeader, NO_KEYFRAME, Pose, Scale, State, UNKNOWN_NS, error, map_mode, scale_source,
    stage,
};

/// A message that can be printed on one line.
pub trait Render {
    /// One JSON object: a key for every field of the message, in their order. Not-a-number, times and keyframes that are
    /// not known are null; states, scales, clocks and errors are words.
    fn json(&self) -> String;
    /// For a person.
    fn text(&self) -> String;
}

/// A JSON object that keeps the order of its keys.
pub(super) struct Object(String);

impl Object {
    pub(super) fn new() -> Self {
        Self("{".into())
    }

    pub(super) fn field(mut self, key: &str, value: impl Serialize) -> Self {
        if self.0.len() > 1 {
            self.0.push(',');
        }
        // serde_json writes numbers that are not finite as null. Keys are identifiers.
        let value = serde_json::to_string(&value).unwrap_or_else(|_| "null".into());
        let _ = write!(self.0, "\"{key}\":{value}");
        self
    }

    pub(super) fn end(mut self) -> String {
        self.0.push('}');
        self.0
    }
}

fn time(ns: i64) -> Option<i64> {
    (ns != UNKNOWN_NS).then_some(ns)
}

fn ms(ns: i64) -> String {
    time(ns).map_or("?".into(), |ns| format!("{:.1}", ns as f64 * 1e-6))
}

impl Render for Pose {
    fn json(&self) -> String {
        Object::new()
            .field("run_id", self.run_id)
            .field("sequence", self.sequence)
            .field("timestamp_ns", self.timestamp_ns)
            .field("arrival_ns", self.arrival_ns)
            .field("published_ns", self.published_ns)
            .field("latency_arrival_ns", time(self.latency_arrival_ns))
            .field("latency_capture_ns", time(self.latency_capture_ns))
            .field("frames_dropped", self.frames_dropped)
            .field("position", self.position)
            .field("orientation", self.orientation)
            .field("odom_position", self.odom_position)
            .field("odom_orientation", self.odom_orientation)
            .field("covariance", self.covariance)
            .field("linear_velocity", self.linear_velocity)
            .field("angular_velocity", self.angular_velocity)
            .field("quality", self.quality)
            .field("scale_sigma", self.scale_sigma)
            .field("landmarks", self.landmarks)
            .field("landmarks_sought", self.landmarks_sought)
            .field("reset_counter", self.reset_counter)
            .field("map_id", self.map_id)
            .field("map_revision", self.map_revision)
            .field("anchor_keyframe", (self.anchor_keyframe != NO_KEYFRAME).then_some(self.anchor_keyframe))
            .field("state", self.state().name())
            .field("scale", self.scale().name())
            .field("scale_source", scale_source::names(self.scale_source).collect::<Vec<_>>())
            .field("clock", self.clock().name())
            .field("keyframe", self.keyframe)
            .end()
    }

    fn text(&self) -> String {
        let [x, y, z] = self.position;
        let yaw = yaw_rad(&self.orientation).to_degrees();
        let unit = if self.scale() == Scale::Metric { "m" } else { "u" };
        let mut line = format!("{:>7} {:12}", self.sequence, self.state().name());
        match self.state() {
            State::Tracking | State::DeadReckoning => {
                let _ = write!(line, " x {x:8.3} y {y:8.3} z {z:8.3} {unit}  yaw {yaw:6.1} deg");
            }
            State::Orientation => {
                // Of a rotation about the body's own vertical: the last entry of the triangle.
                let sigma = self.covariance.last().map_or(f64::NAN, |variance| variance.sqrt().to_degrees());
                let _ = write!(line, " yaw {yaw:6.1} deg +- {sigma:.1}");
            }
            _ => {}
        }
        let _ = write!(
            line,
            "  landmarks {:3}/{:3}  quality {:.2}  latency {} ms  dropped {}{}",
            self.landmarks,
            self.landmarks_sought,
            self.quality,
            ms(self.latency_arrival_ns),
            self.frames_dropped,
            if self.keyframe != 0 { "  keyframe" } else { "" },
        );
        line
    }
}

/// Rotation about the vertical axis, counter-clockwise from above, of a quaternion (x, y, z, w).
pub(super) fn yaw_rad(&[x, y, z, w]: &[f64; 4]) -> f64 {
    (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z))
}

impl Render for Health {
    fn json(&self) -> String {
        #[derive(Serialize)]
        struct Stage {
            name: &'static str,
            steps: u64,
            heartbeat_age_ns: Option<i64>,
            p50_ms: f32,
            p95_ms: f32,
            p99_ms: f32,
            rate_hz: f32,
        }
        let stages = self.stages.iter().zip(stage::NAMES).map(|(s, name)| Stage {
            name,
            steps: s.steps,
            heartbeat_age_ns: time(s.heartbeat_age_ns),
            p50_ms: s.p50_ms,
            p95_ms: s.p95_ms,
            p99_ms: s.p99_ms,
            rate_hz: s.rate_hz,
        });
        Object::new()
            .field("run_id", self.run_id)
            .field("sequence", self.sequence)
            .field("published_ns", self.published_ns)
            .field("uptime_ns", self.uptime_ns)
            .field("realtime_minus_monotonic_ns", self.realtime_minus_monotonic_ns)
            .field("errors", error::names(self.errors).collect::<Vec<_>>())
            .field("frames_captured", self.frames_captured)
            .field("frames_dropped", self.frames_dropped)
            .field("frames_corrupt", self.frames_corrupt)
            .field("frames_tracked", self.frames_tracked)
            .field("keyframes_made", self.keyframes_made)
            .field("landmarks_made", self.landmarks_made)
            .field("adjustments", self.adjustments)
            .field("adjustments_late", self.adjustments_late)
            .field("resets", self.resets)
            .field("relocalisations", self.relocalisations)
            .field("maps_joined", self.maps_joined)
            .field("loops_closed", self.loops_closed)
            .field("frame_age_ns", time(self.frame_age_ns))
            .field("pose_age_ns", time(self.pose_age_ns))
            .field("stages", stages.collect::<Vec<_>>())
            .field("keyframes", self.keyframes)
            .field("landmarks", self.landmarks)
            .field("maps", self.maps)
            .field("reset_counter", self.reset_counter)
            .field("map_id", self.map_id)
            .field("map_revision", self.map_revision)
            .field("pid", self.pid)
            .field("state", self.state().name())
            .field("clock", self.clock().name())
            .field("intrinsics", self.intrinsics().name())
            .field("lens_model", self.lens_model().name())
            .field("version", self.version())
            .field("focal_px", self.focal_px)
            .field("centre_px", self.centre_px)
            .field("focal_sigma", self.focal_sigma)
            .field("centre_sigma_px", self.centre_sigma_px)
            .field("correction_distance", self.correction_distance)
            .field("correction_rad", self.correction_rad)
            .field("map_mode", map_mode::names(self.map_mode).collect::<Vec<_>>())
            .field("blind_ns", self.blind_ns)
            .field("blind_m", self.blind_m)
            .field("wheel_messages", self.wheel_messages)
            .field("wheel_refused", self.wheel_refused)
            .field("wheel_missing", self.wheel_missing)
            .field("wheel_late", self.wheel_late)
            .end()
    }

    fn text(&self) -> String {
        let errors: Vec<_> = error::names(self.errors).collect();
        let errors = if errors.is_empty() { "no errors".into() } else { errors.join(" ") };
        let lens = match self.intrinsics() {
            Intrinsics::Calibrated => String::new(),
            _ if !self.focal_px[0].is_finite() => String::new(), // before the first frame
            other => {
                let (name, sigma) = (other.name(), 100.0 * self.focal_sigma);
                format!("lens {name} f {:.0} px +- {sigma:.0} %  ", self.focal_px[0])
            }
        };
        let slow = self.stages.get(stage::END_TO_END).map_or(f32::NAN, |s| s.p95_ms);
        format!(
            "up {:.0} s  {:12}  frames {} (dropped {}, corrupt {}, tracked {})  keyframes {}  landmarks {}  \
             p95 {slow:.1} ms  resets {}  {lens}{errors}",
            self.uptime_ns as f64 * 1e-9,
            self.state().name(),
            self.frames_captured,
            self.frames_dropped,
            self.frames_corrupt,
            self.frames_tracked,
            self.keyframes,
            self.landmarks,
            self.resets,
        )
    }
}

impl Render for MapSnapshot {
    fn json(&self) -> String {
        self.header().json()
    }
    fn text(&self) -> String {
        self.header().text()
    }
}

impl Render for MapHeader {
    fn json(&self) -> String {
        Object::new()
            .field("run_id", self.run_id)
            .field("content_revision", self.content_revision)
            .field("timestamp_ns", self.timestamp_ns)
            .field("published_ns", self.published_ns)
            .field("count", self.count)
            .field("total", self.total)
            .field("map_id", self.map_id)
            .field("reset_counter", self.reset_counter)
            .field("map_revision", self.map_revision)
            .field("scale_sigma", self.scale_sigma)
            .field("scale", Scale::from_wire(self.scale).name())
            .field("scale_source", scale_source::names(self.scale_source).collect::<Vec<_>>())
            .field("clock", Clock::from_wire(self.clock).name())
            .field("map_mode", map_mode::names(self.map_mode).collect::<Vec<_>>())
            .end()
    }

    fn text(&self) -> String {
        let all = if self.total > self.count { format!(" of {}", self.total) } else { String::new() };
        format!(
            "map {} corrected {} content {}: {}{all} landmarks",
            self.map_id, self.map_revision, self.content_revision, self.count
        )
    }
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;
    use crate::messages::{Field, STATE_ORIENTATION, STATE_TRACKING};

    /// Keys in their order, with the values as JSON.
    fn keys(json: &str) -> Vec<String> {
        let value: Value = serde_json::from_str(json).expect("JSON");
        let mut keys: Vec<String> = value.as_object().expect("object").keys().cloned().collect();
        keys.sort_by_key(|key| json.find(&format!("\"{key}\":")));
        keys
    }

    fn fields(fields: &[Field]) -> Vec<&'static str> {
        fields.iter().map(|f| f.name).filter(|name| *name != "reserved").collect()
    }

    #[test]
    fn the_keys_are_the_fields_of_the_wire_in_their_order() {
        assert_eq!(keys(&Pose::default().json()), fields(Pose::FIELDS));
        assert_eq!(keys(&Health::default().json()), fields(Health::FIELDS));
        assert_eq!(keys(&MapHeader::default().json()), fields(MapHeader::FIELDS));
    }

    #[test]
    fn what_is_not_known_is_null() {
        let pose: Value = serde_json::from_str(&Pose::default().json()).expect("JSON");
        for key in ["latency_capture_ns", "anchor_keyframe", "scale_sigma"] {
            assert_eq!(pose[key], Value::Null, "{key}");
        }
        assert_eq!(pose["position"], serde_json::json!([null, null, null]));
        assert_eq!(pose["covariance"].as_array().map(Vec::len), Some(21));
        assert_eq!(pose["state"], "INITIALIZING");
        let health: Value = serde_json::from_str(&Health::default().json()).expect("JSON");
        assert_eq!(health["frame_age_ns"], Value::Null);
        assert_eq!(health["stages"][stage::TRACKING]["name"], "tracking");
        assert_eq!(health["stages"][stage::TRACKING]["p50_ms"], Value::Null);
    }

    #[test]
    fn numbers_come_back_as_they_were() {
        let pose = Pose {
            timestamp_ns: 1_305_031_102_175_304_123,
            position: [1.0 / 3.0, -1e-300, 0.0],
            quality: 0.1,
            state: STATE_TRACKING,
            ..Pose::default()
        };
        let value: Value = serde_json::from_str(&pose.json()).expect("JSON");
        assert_eq!(value["timestamp_ns"].as_i64(), Some(1_305_031_102_175_304_123));
        assert_eq!(value["position"][0].as_f64(), Some(1.0 / 3.0));
        assert_eq!(value["position"][1].as_f64(), Some(-1e-300));
        assert!(pose.json().contains("\"quality\":0.1,"));
        assert_eq!(value["state"], "TRACKING");
    }

    #[test]
    fn a_turn_to_the_left_is_a_positive_yaw() {
        let half = 0.5f64.sqrt();
        assert!((yaw_rad(&[0.0, 0.0, half, half]) - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
    }

    #[test]
    fn a_lost_pose_prints_no_position_and_an_orientation_only_its_heading() {
        assert!(!Pose::default().text().contains("NaN"));
        let half = 0.5f64.sqrt();
        let mut pose = Pose { state: STATE_ORIENTATION, orientation: [0.0, 0.0, half, half], ..Pose::default() };
        pose.covariance[20] = (2.0f64.to_radians()).powi(2);
        let text = pose.text();
        assert!(text.contains("ORIENTATION") && text.contains("yaw   90.0 deg +- 2.0"), "{text}");
        assert!(!text.contains(" x ") && !text.contains("NaN"), "{text}");
    }
}
