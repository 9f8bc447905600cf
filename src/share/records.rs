//! From messages of the wire to records of a recording: which topic, which time, which bytes.
//!
//! Input: a message of the wire. Output: [`Record`]s, complete ROS 2 messages in CDR. No clock is read and nothing is written here.
//!
//! Times and frames are as [`super::frames`] has them. One offset of both clocks holds for a whole recording, so that times of two messages differ in
//! it by as much as they did on the wire, whatever sets the time of day meanwhile. A record's time is the one at which its message was sent (a
//! picture's: arrived). A message of ROS's own with a position is written only where there is one.

use super::conversion::{camera_info, diagnostics, landmark_bytes, laser_scan, odometry, point_cloud, wheel_twist};
use super::frames::{METRIC, Place, SCAN_FRAME, UnixTime, frames, mount, ros_name, scan_place, transform};
use super::news::{Diagnosed, Told, content_of_graph, content_of_keyframes, content_of_map, content_of_tags};
use super::wire::{Graph, Keyframes};
use crate::messages::{
    CLOCK_MONOTONIC, EncodedHeader, GraphEdge, GraphHeader, Health, Keyframe, KeyframesHeader, Landmark, MapHeader,
    Obstacles, Pose, Scale, Tags, Transform, WheelOdometry,
};
use crate::ros::standard::{self as ros, Header, Time};
use crate::ros::{Bytes, Message};

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
    Path,
    Graph,
    Tags,
    Health,
    Diagnostics,
    Scan,
    Obstacles,
    WheelTwist,
    Wheel,
}

impl Topic {
    pub const ALL: [Self; 18] = [
        Self::Image,
        Self::CameraInfo,
        Self::EncodedHeader,
        Self::Odometry,
        Self::Tf,
        Self::Pose,
        Self::Points,
        Self::MapHeader,
        Self::Keyframes,
        Self::Path,
        Self::Graph,
        Self::Tags,
        Self::Health,
        Self::Diagnostics,
        Self::Scan,
        Self::Obstacles,
        Self::WheelTwist,
        Self::Wheel,
    ];

    /// Below the daemon's prefix; what belongs to a whole robot is at the root, as ROS 2 has it.
    pub fn name(self, prefix: &str) -> String {
        let own = |name: &str| format!("/{}/{name}", ros_name(prefix));
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
            Self::Path => own("path"),
            Self::Graph => own("graph"),
            Self::Tags => own("tags"),
            Self::Health => own("health"),
            Self::Diagnostics => "/diagnostics".into(),
            Self::Scan => own("scan"),
            Self::Obstacles => own("obstacles"),
            Self::WheelTwist => own("wheel/twist"),
            Self::Wheel => own("wheel"),
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
            Self::Path => of::<ros::Path>(),
            Self::Graph => of::<Graph>(),
            Self::Tags => of::<Tags>(),
            Self::Health => of::<Health>(),
            Self::Diagnostics => of::<ros::DiagnosticArray>(),
            Self::Scan => of::<ros::LaserScan>(),
            Self::Obstacles => of::<Obstacles>(),
            Self::WheelTwist => of::<ros::TwistWithCovarianceStamped>(),
            Self::Wheel => of::<WheelOdometry>(),
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

/// Turns messages into records; remembers what one message must know of others.
#[derive(Debug)]
pub struct Converter {
    prefix: String,
    time: UnixTime,
    is_metric: bool,
    /// Of the last pose: [`CLOCK_MONOTONIC`], or a recording's.
    clock: u8,
    /// `body_from_camera`, of the last picture.
    mount: Option<Transform>,
    diagnosed: Diagnosed,
    /// Of the last map that was written.
    map: Told,
    /// Of the last keyframes that were written.
    keyframes: Told,
    /// Of the last graph that was written.
    graph: Told,
    /// Of the last tags that were written.
    tags: Told,
}

impl Converter {
    pub fn new(prefix: &str, realtime_minus_monotonic_ns: i64) -> Self {
        Self {
            prefix: prefix.into(),
            time: UnixTime { realtime_minus_monotonic_ns },
            is_metric: false,
            clock: CLOCK_MONOTONIC,
            mount: None,
            diagnosed: Diagnosed::default(),
            map: Told::default(),
            keyframes: Told::default(),
            graph: Told::default(),
            tags: Told::default(),
        }
    }

    /// The daemon has a camera, by its last pose, and does not replay a recording.
    pub fn is_live(&self) -> bool {
        self.clock == CLOCK_MONOTONIC
    }

    /// A picture: `format` and `data` as in a CompressedImage.
    pub fn picture(&mut self, header: &EncodedHeader, format: &str, data: &[u8], out: &mut Vec<Record>) {
        self.mount = mount(header);
        let time_ns = self.time.ns(header.arrival_ns);
        let stamp = self.time.stamp(header.timestamp_ns, header.clock);
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
        let time_ns = self.time.ns(pose.published_ns);
        out.push(Record { topic: Topic::Pose, time_ns, data: pose.to_cdr() });
        (self.is_metric, self.clock) = (pose.scale() == Scale::Metric, pose.clock);
        let Some(place) = Place::of(pose) else { return };
        let frames = frames(self.is_metric);
        let stamp = self.time.stamp(pose.timestamp_ns, pose.clock);
        let header = Header { stamp: stamp.clone(), frame_id: frames.odom };
        let odometry = odometry(pose, &place.odom_from_body, header, frames.body);
        out.push(Record { topic: Topic::Odometry, time_ns, data: odometry.to_cdr() });
        let mut transforms = place.transforms(&stamp, frames);
        if let Some(mount) = self.mount {
            // In a map without metres the body's origin is the camera's centre.
            let position = if self.is_metric { mount.position } else { [0.0; 3] };
            transforms.push(transform(&stamp, frames.body, frames.camera, &Transform { position, ..mount }));
        }
        out.push(Record { topic: Topic::Tf, time_ns, data: ros::TfMessage { transforms }.to_cdr() });
    }

    /// What stands around the robot; as a scan, with the transform to its frame, where anything is known.
    pub fn obstacles(&self, obstacles: &Obstacles, out: &mut Vec<Record>) {
        let time_ns = self.time.ns(obstacles.published_ns);
        out.push(Record { topic: Topic::Obstacles, time_ns, data: obstacles.to_cdr() });
        let Some(map_from_scan) = scan_place(obstacles) else { return };
        let stamp = self.time.stamp(obstacles.timestamp_ns, obstacles.clock);
        let transforms = vec![transform(&stamp, METRIC.map, SCAN_FRAME, &map_from_scan)];
        out.push(Record { topic: Topic::Tf, time_ns, data: ros::TfMessage { transforms }.to_cdr() });
        let scan = laser_scan(obstacles, Header { stamp, frame_id: SCAN_FRAME });
        out.push(Record { topic: Topic::Scan, time_ns, data: scan.to_cdr() });
    }

    /// What the base's driver tells beside a camera ([`is_live`](Self::is_live)); as a twist only what is finite.
    /// Its log time is when it was heard (`heard_ns`, monotonic), by which a replay knows stamps of another clock.
    pub fn wheel(&self, wheel: &WheelOdometry, heard_ns: i64, out: &mut Vec<Record>) {
        let time_ns = self.time.ns(heard_ns);
        out.push(Record { topic: Topic::Wheel, time_ns, data: wheel.to_cdr() });
        let Some(twist) = wheel_twist(wheel) else { return };
        let header = Header { stamp: Time::from_ns(self.time.ns(wheel.timestamp_ns)), frame_id: METRIC.body };
        let message = ros::TwistWithCovarianceStamped { header, twist };
        out.push(Record { topic: Topic::WheelTwist, time_ns, data: message.to_cdr() });
    }

    /// The map, unless it is the one that was written last.
    pub fn map(&mut self, header: &MapHeader, landmarks: &[Landmark], out: &mut Vec<Record>) {
        if !self.map.is_news(content_of_map(header)) {
            return;
        }
        let time_ns = self.time.ns(header.published_ns);
        out.push(Record { topic: Topic::MapHeader, time_ns, data: header.to_cdr() });
        let frame_id = frames(Scale::from_wire(header.scale) == Scale::Metric).map;
        let data = landmark_bytes(landmarks);
        let header = Header { stamp: self.time.stamp(header.timestamp_ns, header.clock), frame_id };
        let cloud = point_cloud(&data, landmarks.len(), header);
        out.push(Record { topic: Topic::Points, time_ns, data: cloud.to_cdr() });
    }

    /// Keyframes, and the way that they tell, unless they are those that were written last.
    pub fn keyframes(&mut self, header: &KeyframesHeader, keyframes: &[Keyframe], out: &mut Vec<Record>) {
        if !self.keyframes.is_news(content_of_keyframes(header)) {
            return;
        }
        let time_ns = self.time.ns(header.published_ns);
        let message = Keyframes { header: *header, keyframes };
        out.push(Record { topic: Topic::Keyframes, time_ns, data: message.to_cdr() });
        let frame_id = frames(Scale::from_wire(header.scale) == Scale::Metric).map;
        let at = |timestamp_ns| Header { stamp: self.time.stamp(timestamp_ns, header.clock), frame_id };
        let place = |k: &Keyframe| ros::PoseStamped {
            header: at(k.timestamp_ns),
            pose: ros::Pose { position: k.position.into(), orientation: k.orientation.into() },
        };
        let path = ros::Path { header: at(header.timestamp_ns), poses: keyframes.iter().map(place).collect() };
        out.push(Record { topic: Topic::Path, time_ns, data: path.to_cdr() });
    }

    /// What holds the map together, unless it is what was written last.
    pub fn graph(&mut self, header: &GraphHeader, edges: &[GraphEdge], out: &mut Vec<Record>) {
        if self.graph.is_news(content_of_graph(header)) {
            let time_ns = self.time.ns(header.published_ns);
            out.push(Record { topic: Topic::Graph, time_ns, data: Graph { header: *header, edges }.to_cdr() });
        }
    }

    /// The tags of the map, unless they are those that were written last.
    pub fn tags(&mut self, tags: &Tags, out: &mut Vec<Record>) {
        if self.tags.is_news(content_of_tags(tags)) {
            let time_ns = self.time.ns(tags.published_ns);
            out.push(Record { topic: Topic::Tags, time_ns, data: tags.to_cdr() });
        }
    }

    /// Health; as diagnostics when something else is to be said, and once a second.
    pub fn health(&mut self, health: &Health, out: &mut Vec<Record>) {
        let time_ns = self.time.ns(health.published_ns);
        out.push(Record { topic: Topic::Health, time_ns, data: health.to_cdr() });
        if self.diagnosed.news(health).is_none() {
            return;
        }
        let status = diagnostics(health, &self.prefix);
        let message = ros::DiagnosticArray {
            header: Header { stamp: Time::from_ns(time_ns), frame_id: "" },
            status: vec![status],
        };
        out.push(Record { topic: Topic::Diagnostics, time_ns, data: message.to_cdr() });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::{self, OBSTACLE_BEARINGS, SCALE_METRIC, STATE_LOST, STATE_TRACKING};
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
    fn a_scan_is_told_where_it_is_known_and_its_unknown_is_never_far() {
        let converter = Converter::new("robot", 1_000_000_000_000);
        let mut out = Vec::new();
        let mut obstacles = Obstacles {
            timestamp_ns: 5,
            published_ns: 7,
            position: [1.0, 2.0, 0.0],
            orientation: [0.0, 0.0, 0.0, 1.0],
            told: messages::OBSTACLES_TOLD,
            range_max: 4.0,
            ..Obstacles::default()
        };
        obstacles.range[3] = 1.5;
        for unknown in [
            Obstacles { told: messages::OBSTACLES_NOT_METRIC, ..obstacles },
            Obstacles { position: [f64::NAN; 3], ..obstacles },
        ] {
            out.clear();
            converter.obstacles(&unknown, &mut out);
            assert_eq!(topics(&out), [Topic::Obstacles]);
        }
        out.clear();
        converter.obstacles(&obstacles, &mut out);
        assert_eq!(topics(&out), [Topic::Obstacles, Topic::Tf, Topic::Scan]);
        assert!(holds(&out[1], "map") && holds(&out[1], "scan") && holds(&out[2], "scan"));
        let mut scan = Reader::new(&out[2].data).expect("CDR");
        assert_eq!((scan.i32(), scan.u32(), scan.text()), (Ok(1000), Ok(5), Ok("scan")));
        let floats: Vec<f32> =
            out[2].data[4 + 20..].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().expect("4"))).collect();
        assert_eq!(floats[0], obstacles.angle_min);
        assert_eq!((floats[1], floats[6]), (obstacles.angle(OBSTACLE_BEARINGS - 1), 4.0));
        let ranges = &floats[8..8 + OBSTACLE_BEARINGS];
        assert!(ranges.iter().enumerate().all(|(i, r)| if i == 3 { *r == 1.5 } else { r.is_nan() }), "{ranges:?}");
    }

    #[test]
    fn wheels_are_a_twist_unless_they_are_nonsense() {
        let mut converter = Converter::new("robot", 1_000_000_000_000);
        let mut out = Vec::new();
        let known = WheelOdometry {
            timestamp_ns: 5,
            linear_x_mps: 0.4,
            linear_y_mps: 0.0,
            angular_z_radps: 0.1,
            variance: [0.01, f64::NAN, 0.04],
            ..WheelOdometry::default()
        };
        converter.wheel(&known, 9, &mut out);
        assert_eq!(topics(&out), [Topic::Wheel, Topic::WheelTwist]);
        assert!(out.iter().all(|record| record.time_ns == 1_000_000_000_009) && holds(&out[1], "base_link"));
        let mut twist = Reader::new(&out[1].data).expect("CDR");
        assert_eq!((twist.i32(), twist.u32()), (Ok(1000), Ok(5)), "its stamp is the driver's");
        assert!(!out[1].data.chunks(4).any(|w| w == f32::NAN.to_le_bytes()));
        out.clear();
        converter.wheel(&WheelOdometry { linear_x_mps: f64::NAN, ..known }, 9, &mut out);
        assert_eq!(topics(&out), [Topic::Wheel]);
        assert!(converter.is_live());
        converter.pose(&Pose { clock: messages::CLOCK_RECORDING, ..Pose::default() }, &mut out);
        assert!(!converter.is_live(), "pictures of a recording are of another time than the wheels");
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
        for published_ns in [1, 2] {
            converter.graph(&GraphHeader { published_ns, ..Default::default() }, &[GraphEdge::default()], &mut out);
            converter.tags(&Tags { published_ns, ..Tags::default() }, &mut out);
        }
        assert_eq!(topics(&out), [Topic::Graph, Topic::Tags]);
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
