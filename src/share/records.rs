//! From messages of the wire to records of a recording: which topic, which time, which bytes.
//!
//! Input: a message of the wire. Output: [`Record`]s, complete ROS 2 messages in CDR. No clock is read and nothing is written here.
//!
//! Times: a header's stamp is the capture time as Unix time by WIRE.md's rule, `timestamp_ns` plus the offset of both clocks, or `timestamp_ns`
//! itself where the source is a recording. One offset holds for a whole recording, so that times of two messages differ in it by as much as they
//! did on the wire, whatever sets the time of day meanwhile. A record's time is the one at which its message was sent (a picture's: arrived).
//!
//! Lengths of a map without a metric scale are no metres, so its frames have names of their own that no metric tree has: `map_unscaled`,
//! `odom_unscaled`, `base_link_unscaled`, `camera_unscaled`. A message of ROS's own with a position is written only where there is one.

use super::wire::Keyframes;
use crate::messages::{
    self, CLOCK_MONOTONIC, EncodedHeader, Health, Keyframe, KeyframesHeader, Landmark, LensModel, MapHeader, Pose,
    Scale, State, Transform,
};
use crate::ros::standard::{self as ros, Header, Time};
use crate::ros::{Byte, Bytes, Message};

/// Topics of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Topic {
    Image,
    CameraInfo,
    EncodedHeader,
    Odometry,
    Tf,
    Pose,
    Points,
    MapHeader,
    Keyframes,
    Health,
    Diagnostics,
}

impl Topic {
    pub const ALL: [Self; 11] = [
        Self::Image,
        Self::CameraInfo,
        Self::EncodedHeader,
        Self::Odometry,
        Self::Tf,
        Self::Pose,
        Self::Points,
        Self::MapHeader,
        Self::Keyframes,
        Self::Health,
        Self::Diagnostics,
    ];

    /// Below the daemon's prefix; what belongs to a whole robot is at the root, as ROS 2 has it.
    pub fn name(self, prefix: &str) -> String {
        let own = |name: &str| {
            // ROS 2 allows letters, digits and _ between slashes.
            let allowed = |c: char| if c.is_ascii_alphanumeric() || c == '/' { c } else { '_' };
            format!("/{}/{name}", prefix.chars().map(allowed).collect::<String>())
        };
        match self {
            Self::Image => own("image/compressed"),
            Self::CameraInfo => own("camera_info"),
            Self::EncodedHeader => own("image/header"),
            Self::Odometry => own("odom"),
            Self::Tf => "/tf".into(),
            Self::Pose => own("pose"),
            Self::Points => own("points"),
            Self::MapHeader => own("map"),
            Self::Keyframes => own("keyframes"),
            Self::Health => own("health"),
            Self::Diagnostics => "/diagnostics".into(),
        }
    }

    /// Name and definition of its messages.
    pub fn schema(self) -> (&'static str, String) {
        fn of<M: Message>() -> (&'static str, String) {
            (M::NAME, M::schema())
        }
        match self {
            Self::Image => of::<ros::CompressedImage>(),
            Self::CameraInfo => of::<ros::CameraInfo>(),
            Self::EncodedHeader => of::<EncodedHeader>(),
            Self::Odometry => of::<ros::Odometry>(),
            Self::Tf => of::<ros::TfMessage>(),
            Self::Pose => of::<Pose>(),
            Self::Points => of::<ros::PointCloud2>(),
            Self::MapHeader => of::<MapHeader>(),
            Self::Keyframes => of::<Keyframes>(),
            Self::Health => of::<Health>(),
            Self::Diagnostics => of::<ros::DiagnosticArray>(),
        }
    }
}

/// One message of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Record {
    pub topic: Topic,
    /// Unix time, ns.
    pub time_ns: i64,
    /// CDR.
    pub data: Vec<u8>,
}

/// Frames' names.
struct Frames {
    map: &'static str,
    odom: &'static str,
    body: &'static str,
    camera: &'static str,
}

const METRIC: Frames = Frames { map: "map", odom: "odom", body: "base_link", camera: "camera" };
const UNSCALED: Frames =
    Frames { map: "map_unscaled", odom: "odom_unscaled", body: "base_link_unscaled", camera: "camera_unscaled" };

fn frames(is_metric: bool) -> &'static Frames {
    if is_metric { &METRIC } else { &UNSCALED }
}

/// Turns messages into records; remembers what one message must know of others.
#[derive(Debug)]
pub struct Converter {
    prefix: String,
    realtime_minus_monotonic_ns: i64,
    is_metric: bool,
    /// `body_from_camera`, of the last picture.
    mount: Option<Transform>,
    /// What the last diagnostics said, and when.
    diagnosed: Option<(u64, u8, i64)>,
    /// Of the last map and keyframes that were written.
    written: [Option<(u64, u64, u32, u32)>; 2],
}

/// Diagnostics that say the same are written once in so many ns.
const DIAGNOSTICS_EVERY_NS: i64 = 1_000_000_000;

impl Converter {
    pub fn new(prefix: &str, realtime_minus_monotonic_ns: i64) -> Self {
        Self {
            prefix: prefix.into(),
            realtime_minus_monotonic_ns,
            is_metric: false,
            mount: None,
            diagnosed: None,
            written: [None; 2],
        }
    }

    fn unix_ns(&self, monotonic_ns: i64) -> i64 {
        monotonic_ns.saturating_add(self.realtime_minus_monotonic_ns)
    }

    fn stamp(&self, timestamp_ns: i64, clock: u8) -> Time {
        Time::from_ns(if clock == CLOCK_MONOTONIC { self.unix_ns(timestamp_ns) } else { timestamp_ns })
    }

    /// A picture: `format` and `data` as in a CompressedImage.
    pub fn picture(&mut self, header: &EncodedHeader, format: &str, data: &[u8], out: &mut Vec<Record>) {
        let mount = Transform { position: header.camera_position, orientation: header.camera_orientation };
        self.mount = is_finite(&mount).then_some(mount);
        let time_ns = self.unix_ns(header.arrival_ns);
        let stamp = self.stamp(header.timestamp_ns, header.clock);
        let ros_header = || Header { stamp: stamp.clone(), frame_id: frames(self.is_metric).camera };
        let image = ros::CompressedImage { header: ros_header(), format, data: Bytes(data) };
        out.push(Record { topic: Topic::Image, time_ns, data: image.to_cdr() });
        if let Some(info) = camera_info(header, ros_header()) {
            out.push(Record { topic: Topic::CameraInfo, time_ns, data: info.to_cdr() });
        }
        out.push(Record { topic: Topic::EncodedHeader, time_ns, data: header.to_cdr() });
    }

    /// A pose; odometry and transforms only where it has a position.
    pub fn pose(&mut self, pose: &Pose, out: &mut Vec<Record>) {
        let time_ns = self.unix_ns(pose.published_ns);
        out.push(Record { topic: Topic::Pose, time_ns, data: pose.to_cdr() });
        self.is_metric = pose.scale() == Scale::Metric;
        let map_from_body = Transform { position: pose.position, orientation: pose.orientation };
        let odom_from_body = Transform { position: pose.odom_position, orientation: pose.odom_orientation };
        let has_place = matches!(pose.state(), State::Tracking | State::DeadReckoning);
        if !has_place || !is_finite(&map_from_body) || !is_finite(&odom_from_body) {
            return;
        }
        let frames = frames(self.is_metric);
        let header = |frame_id| Header { stamp: self.stamp(pose.timestamp_ns, pose.clock), frame_id };
        let odometry = odometry(pose, &odom_from_body, header(frames.odom), frames.body);
        out.push(Record { topic: Topic::Odometry, time_ns, data: odometry.to_cdr() });
        let map_from_odom = map_from_body * odom_from_body.inverse();
        let transform = |parent, child, t: &Transform| ros::TransformStamped {
            header: header(parent),
            child_frame_id: child,
            transform: ros::Transform { translation: t.position.into(), rotation: t.orientation.into() },
        };
        let mut transforms = vec![
            transform(frames.map, frames.odom, &map_from_odom),
            transform(frames.odom, frames.body, &odom_from_body),
        ];
        if let Some(mount) = self.mount {
            // In a map without metres the body's origin is the camera's centre.
            let position = if self.is_metric { mount.position } else { [0.0; 3] };
            transforms.push(transform(frames.body, frames.camera, &Transform { position, ..mount }));
        }
        out.push(Record { topic: Topic::Tf, time_ns, data: ros::TfMessage { transforms }.to_cdr() });
    }

    /// The map, unless it is the one that was written last.
    pub fn map(&mut self, header: &MapHeader, landmarks: &[Landmark], out: &mut Vec<Record>) {
        let content = (header.run_id, header.content_revision, header.map_revision, header.reset_counter);
        if self.written[0].replace(content) == Some(content) {
            return;
        }
        let time_ns = self.unix_ns(header.published_ns);
        out.push(Record { topic: Topic::MapHeader, time_ns, data: header.to_cdr() });
        let frame_id = frames(Scale::from_wire(header.scale) == Scale::Metric).map;
        let data = landmark_bytes(landmarks);
        let field = |name, offset, datatype| ros::PointField { name, offset, datatype, count: 1 };
        let width = u32::try_from(landmarks.len()).unwrap_or(u32::MAX);
        let cloud = ros::PointCloud2 {
            header: Header { stamp: self.stamp(header.timestamp_ns, header.clock), frame_id },
            height: 1,
            width,
            fields: vec![
                field("id", 0, ros::POINT_UINT32),
                field("observations", 4, ros::POINT_UINT32),
                field("x", 8, ros::POINT_FLOAT32),
                field("y", 12, ros::POINT_FLOAT32),
                field("z", 16, ros::POINT_FLOAT32),
                field("sigma", 20, ros::POINT_FLOAT32),
            ],
            is_bigendian: false,
            point_step: LANDMARK_BYTES,
            row_step: width.saturating_mul(LANDMARK_BYTES),
            data: Bytes(&data),
            is_dense: true,
        };
        out.push(Record { topic: Topic::Points, time_ns, data: cloud.to_cdr() });
    }

    /// Keyframes, unless they are those that were written last.
    pub fn keyframes(&mut self, header: &KeyframesHeader, keyframes: &[Keyframe], out: &mut Vec<Record>) {
        let content = (header.run_id, header.content_revision, header.map_revision, header.reset_counter);
        if self.written[1].replace(content) == Some(content) {
            return;
        }
        let time_ns = self.unix_ns(header.published_ns);
        let message = Keyframes { header: *header, keyframes };
        out.push(Record { topic: Topic::Keyframes, time_ns, data: message.to_cdr() });
    }

    /// Health; as diagnostics when something else is to be said, and once a second.
    pub fn health(&mut self, health: &Health, out: &mut Vec<Record>) {
        let time_ns = self.unix_ns(health.published_ns);
        out.push(Record { topic: Topic::Health, time_ns, data: health.to_cdr() });
        let said = self.diagnosed.is_some_and(|(errors, state, at_ns)| {
            (errors, state) == (health.errors, health.state) && health.published_ns - at_ns < DIAGNOSTICS_EVERY_NS
        });
        if said {
            return;
        }
        self.diagnosed = Some((health.errors, health.state, health.published_ns));
        let status = diagnostics(health, &self.prefix);
        let message = ros::DiagnosticArray {
            header: Header { stamp: Time::from_ns(time_ns), frame_id: "" },
            status: vec![status],
        };
        out.push(Record { topic: Topic::Diagnostics, time_ns, data: message.to_cdr() });
    }
}

fn is_finite(t: &Transform) -> bool {
    t.position.iter().chain(&t.orientation).all(|v| v.is_finite())
}

/// Bytes of a landmark, on the wire and in a cloud.
const LANDMARK_BYTES: u32 = size_of::<Landmark>() as u32;

fn landmark_bytes(landmarks: &[Landmark]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(size_of_val(landmarks));
    for l in landmarks {
        let [x, y, z] = l.position;
        bytes.extend_from_slice(&l.id.to_le_bytes());
        bytes.extend_from_slice(&l.observations.to_le_bytes());
        [x, y, z, l.sigma].iter().for_each(|v| bytes.extend_from_slice(&v.to_le_bytes()));
    }
    bytes
}

/// Not known, as nav_msgs says it.
const UNKNOWN: f64 = -1.0;

fn odometry<'a>(
    pose: &Pose,
    odom_from_body: &Transform,
    header: Header<'a>,
    child_frame_id: &'a str,
) -> ros::Odometry<'a> {
    // The method turns into the axes of whatever the orientation leads to.
    let turned = Pose { orientation: pose.odom_orientation, ..*pose }.covariance_in_map_axes();
    let mut covariance = [0.0; 36];
    covariance.iter_mut().zip(turned.iter().flatten()).for_each(|(to, from)| *to = *from);
    let mut unknown = [0.0; 36];
    unknown[0] = UNKNOWN;
    if covariance.iter().any(|v| !v.is_finite()) {
        covariance = unknown;
    }
    let known = |v: [f64; 3]| v.map(|v| if v.is_finite() { v } else { 0.0 });
    ros::Odometry {
        header,
        child_frame_id,
        pose: ros::PoseWithCovariance {
            pose: ros::Pose {
                position: odom_from_body.position.into(),
                orientation: odom_from_body.orientation.into(),
            },
            covariance,
        },
        twist: ros::TwistWithCovariance {
            twist: ros::Twist {
                linear: known(pose.linear_velocity).into(),
                angular: known(pose.angular_velocity).into(),
            },
            covariance: unknown,
        },
    }
}

/// `None` before anything is known of the lens. One that is only a guess is not told as a calibration: `k` is zero then, as ROS has it.
fn camera_info<'a>(header: &EncodedHeader, ros_header: Header<'a>) -> Option<ros::CameraInfo<'a>> {
    let ([fx, fy], [cx, cy]) = (header.focal_px, header.centre_px);
    if ![fx, fy, cx, cy].iter().chain(&header.distortion).all(|v| v.is_finite()) {
        return None;
    }
    let is_known = header.intrinsics != messages::INTRINSICS_GUESSED;
    let (distortion_model, d) = match LensModel::from_wire(header.lens_model) {
        LensModel::RadialTangential => ("plumb_bob", header.distortion.to_vec()),
        LensModel::KannalaBrandt => ("equidistant", header.distortion[..4].to_vec()),
        LensModel::Unknown(_) => return None,
    };
    let k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0];
    let p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0];
    Some(ros::CameraInfo {
        header: ros_header,
        height: header.height,
        width: header.width,
        distortion_model,
        d: if is_known { d } else { Vec::new() },
        k: if is_known { k } else { [0.0; 9] },
        r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: if is_known { p } else { [0.0; 12] },
        binning_x: 0,
        binning_y: 0,
        roi: ros::RegionOfInterest { x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false },
    })
}

/// `diagnostic_msgs/DiagnosticStatus`: levels.
const OK: u8 = 0;
const WARN: u8 = 1;
const ERROR: u8 = 2;

fn diagnostics<'a>(health: &Health, prefix: &'a str) -> ros::DiagnosticStatus<'a> {
    let state = State::from_wire(health.state);
    let faults: Vec<&str> = messages::error::names(health.errors).collect();
    use messages::error::{BAD_CALIBRATION, LOST, NO_CAMERA, NO_FRAMES, STALLED_STAGE};
    let level = match health.errors {
        0 => OK,
        e if e & (NO_CAMERA | NO_FRAMES | BAD_CALIBRATION | STALLED_STAGE | LOST) != 0 => ERROR,
        _ => WARN,
    };
    let message =
        if faults.is_empty() { state.name().into() } else { format!("{}: {}", state.name(), faults.join(" ")) };
    let end_to_end = &health.stages[messages::stage::END_TO_END];
    let value = |key, value: String| ros::KeyValue { key, value };
    ros::DiagnosticStatus {
        level: Byte(level),
        name: "cairn: pose and map",
        message,
        hardware_id: prefix,
        values: vec![
            value("state", state.name().into()),
            value("faults", faults.join(" ")),
            value("frames_captured", health.frames_captured.to_string()),
            value("frames_tracked", health.frames_tracked.to_string()),
            value("frames_dropped", health.frames_dropped.to_string()),
            value("landmarks", health.landmarks.to_string()),
            value("keyframes", health.keyframes.to_string()),
            value("resets", health.resets.to_string()),
            value("latency_p95_ms", format!("{:.1}", end_to_end.p95_ms)),
        ],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::{
        INTRINSICS_CALIBRATED, INTRINSICS_GUESSED, LENS_KANNALA_BRANDT, SCALE_METRIC, STATE_LOST, STATE_TRACKING,
    };
    use crate::ros::Reader;

    fn pose(scale: u8) -> Pose {
        Pose {
            state: STATE_TRACKING,
            scale,
            timestamp_ns: 5,
            published_ns: 7,
            position: [1.0, 2.0, 3.0],
            orientation: [0.0, 0.0, 0.0, 1.0],
            odom_position: [1.0, 2.0, 2.5],
            odom_orientation: [0.0, 0.0, 0.0, 1.0],
            ..Pose::default()
        }
    }

    fn topics(records: &[Record]) -> Vec<Topic> {
        records.iter().map(|record| record.topic).collect()
    }

    fn holds(record: &Record, text: &str) -> bool {
        record.data.windows(text.len() + 1).any(|w| w == format!("{text}\0").as_bytes())
    }

    #[test]
    fn a_pose_without_a_position_is_no_odometry() {
        let mut converter = Converter::new("robot", 0);
        let mut out = Vec::new();
        for wrong in [
            Pose { state: STATE_LOST, ..pose(0) },
            Pose { odom_position: [f64::NAN; 3], ..pose(0) },
            Pose { orientation: [f64::INFINITY; 4], ..pose(0) },
            Pose::default(),
        ] {
            out.clear();
            converter.pose(&wrong, &mut out);
            assert_eq!(topics(&out), [Topic::Pose], "{wrong:?}");
        }
    }

    #[test]
    fn lengths_that_are_no_metres_are_in_no_metric_frame_and_one_offset_makes_unix_time() {
        let mut converter = Converter::new("robot", 1_000_000_000_000);
        let (mut out, mut data) = (Vec::new(), EncodedHeader::default());
        data.camera_position = [0.25, 0.0, 0.5];
        converter.picture(&data, "png", &[1], &mut out);
        assert_eq!(topics(&out), [Topic::Image, Topic::EncodedHeader], "a lens of which nothing is known is not told");
        for (scale, end) in [(0, "_unscaled"), (SCALE_METRIC, "")] {
            out.clear();
            converter.pose(&pose(scale), &mut out);
            assert_eq!(topics(&out), [Topic::Pose, Topic::Odometry, Topic::Tf]);
            assert!(out.iter().all(|record| record.time_ns == 1_000_000_000_007));
            assert!(["odom", "base_link"].iter().all(|frame| holds(&out[1], &format!("{frame}{end}"))));
            assert!(["map", "odom", "base_link", "camera"].iter().all(|f| holds(&out[2], &format!("{f}{end}"))));
            let mount = out[2].data.windows(8).any(|w| w == 0.25_f64.to_le_bytes());
            assert_eq!(mount, scale == SCALE_METRIC, "the mount's translation is metres");
            let mut stamp = Reader::new(&out[1].data).expect("CDR");
            assert_eq!((stamp.i32(), stamp.u32()), (Ok(1000), Ok(5)));
        }
        let recorded = Pose { clock: crate::messages::CLOCK_RECORDING, ..pose(0) };
        out.clear();
        converter.pose(&recorded, &mut out);
        let mut stamp = Reader::new(&out[1].data).expect("CDR");
        assert_eq!((stamp.i32(), stamp.u32()), (Ok(0), Ok(5)), "a recording's own time");
    }

    #[test]
    fn a_guessed_lens_is_no_calibration() {
        let known = EncodedHeader {
            focal_px: [500.0; 2],
            centre_px: [320.0, 240.0],
            distortion: [0.1, 0.2, 0.3, 0.4, 0.0],
            intrinsics: INTRINSICS_CALIBRATED,
            lens_model: LENS_KANNALA_BRANDT,
            ..EncodedHeader::default()
        };
        let header = || Header { stamp: Time::from_ns(0), frame_id: "camera" };
        let info = camera_info(&known, header()).expect("a camera");
        assert_eq!((info.distortion_model, info.d.len(), info.k[0]), ("equidistant", 4, 500.0));
        let guess = camera_info(&EncodedHeader { intrinsics: INTRINSICS_GUESSED, ..known }, header()).expect("told");
        assert_eq!((guess.d.len(), guess.k), (0, [0.0; 9]));
    }

    #[test]
    fn the_same_map_is_written_once_and_faults_are_told_when_they_begin() {
        let mut converter = Converter::new("robot", 0);
        let mut out = Vec::new();
        let header = MapHeader { content_revision: 4, ..MapHeader::default() };
        converter.map(&header, &[Landmark::default()], &mut out);
        converter.map(&MapHeader { published_ns: 9, ..header }, &[Landmark::default()], &mut out);
        assert_eq!(topics(&out), [Topic::MapHeader, Topic::Points]);
        converter.map(&MapHeader { content_revision: 5, ..header }, &[], &mut out);
        assert_eq!(out.len(), 4);
        out.clear();
        let health = Health::default();
        converter.health(&health, &mut out);
        converter.health(&Health { published_ns: 1, ..health }, &mut out);
        converter.health(&Health { published_ns: 2, errors: messages::error::LOST, ..health }, &mut out);
        let told = topics(&out).iter().filter(|topic| **topic == Topic::Diagnostics).count();
        assert_eq!((out.len(), told), (5, 2));
        assert_eq!(Topic::Pose.name("front-left/cam.2"), "/front_left/cam_2/pose");
    }
}
