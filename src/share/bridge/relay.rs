//! The listening half of a bridge: a subscriber like any other.
//!
//! Input: the daemon's services. Output: ROS 2 messages on the [`Node`]. Before lengths are metres odometry goes out in the frame `odom_unscaled`
//! and there are no transforms; what has no position is no odometry, no pose and no transform. A daemon that stops, dies or starts anew is waited for.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use tracing::{info, warn};

use super::commands::Commands;
use super::error::BridgeError;
use super::node::{Network, Node};
use super::rates::Rates;
use super::topic::Topic;
use crate::client::{Client, Encodeds, Healths, Map, ObstacleScans, Poses};
use crate::messages::{EncodedHeader, Endpoint, Health, Landmark, MapHeader, Obstacles, Pose, Scale, Transform};
use crate::ros::standard::{self as ros, Header, Time};
use crate::ros::{Bytes, Message};
use crate::share::conversion::{
    camera_info, diagnostics, landmark_bytes, laser_scan, odometry, point_cloud, pose_with_covariance,
};
use crate::share::frames::{METRIC, Place, SCAN_FRAME, UnixTime, frames, mount, scan_place, transform};
use crate::share::news::{Diagnosed, Told, content_of_map};
use crate::share::picture::compressed;

/// Longest sleep: how late a signal is noticed while nothing comes, and all but poses and pictures.
const TURN: Duration = Duration::from_millis(50);
/// How often it is looked after the network.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// What repeats is said once in so long.
const SAY_EVERY: Duration = Duration::from_secs(10);

/// See module.
pub struct Bridge {
    out: Outputs,
    poses: Poses,
    map: Map,
    health: Healths,
    /// While somebody wants them.
    obstacles: Option<ObstacleScans>,
    encoded: Option<Encodeds>,
    client: Client,
    prefix: String,
    name: String,
    time: UnixTime,
    is_metric: Arc<AtomicBool>,
    run: Option<u64>,
    /// `body_from_camera` of this run.
    mount: Option<Transform>,
    /// What was sent of it.
    told_mount: Option<Transform>,
    diagnosed: Diagnosed,
    told_map: Told,
    has_daemon: Option<bool>,
    has_network: Option<bool>,
    looked: Option<Instant>,
    png: Vec<u8>,
}

/// The node, with what may be sent.
struct Outputs {
    node: Node,
    rates: Rates,
    said: Option<Instant>,
}

impl Outputs {
    fn is_wanted(&self, topic: Topic) -> bool {
        !self.rates.is_off(topic) && self.node.is_wanted(topic)
    }

    /// A message of this topic may be sent now.
    fn allow(&mut self, topic: Topic, now_ns: i64) -> bool {
        self.node.is_wanted(topic) && self.rates.allow(topic, now_ns)
    }

    fn put<M: Message>(&mut self, topic: Topic, message: &M) {
        debug_assert_eq!(M::NAME, topic.of().name);
        if let Err(error) = self.node.put(topic, message.to_cdr())
            && self.said.is_none_or(|at| at.elapsed() >= SAY_EVERY)
        {
            self.said = Some(Instant::now());
            warn!(topic = topic.word(), error, "message to ROS 2 not sent");
        }
    }
}

impl Bridge {
    /// Opens the Zenoh session and subscribes; neither router nor daemon need be there yet. `realtime_minus_monotonic_ns`: until health tells it. The
    /// second half is for a thread of its own.
    pub fn open(
        endpoint: Endpoint,
        network: &Network,
        rates: Rates,
        realtime_minus_monotonic_ns: i64,
    ) -> Result<(Self, Commands), BridgeError> {
        let prefix = endpoint.prefix().to_owned();
        let client = Client::with_endpoint(endpoint)?;
        let is_metric = Arc::new(AtomicBool::new(false));
        let (inbox, commands) = Commands::new(client.clone(), is_metric.clone());
        let node = Node::open(network, &inbox)?;
        let name = network.robot.name();
        let bridge = Self {
            out: Outputs { node, rates, said: None },
            poses: client.poses(),
            map: client.map().polled(TURN),
            health: client.health().polled(TURN),
            obstacles: None,
            encoded: None,
            client,
            name: if name.is_empty() { "cairn: pose and map".into() } else { format!("{name}: pose and map") },
            prefix,
            time: UnixTime { realtime_minus_monotonic_ns },
            is_metric,
            run: None,
            mount: None,
            told_mount: None,
            diagnosed: Diagnosed::default(),
            told_map: Told::default(),
            has_daemon: None,
            has_network: None,
            looked: None,
            png: Vec::new(),
        };
        Ok((bridge, commands))
    }

    /// Waits for the next pose for 50 ms at most, and sends everything that has come.
    pub fn step(&mut self) -> Result<(), BridgeError> {
        let mut pose = self.poses.wait(TURN)?;
        while let Some(health) = self.health.try_next()? {
            self.take_health(&health);
        }
        while let Some(next) = pose {
            self.take_pose(&next);
            pose = self.poses.try_next()?;
        }
        while let Some(map) = self.map.try_next()? {
            self.take_map(map.header(), &map);
        }
        self.take_obstacles()?;
        self.take_pictures()?;
        self.look_around();
        Ok(())
    }

    /// Takes leave of the network.
    pub fn close(self) {
        self.out.node.close();
    }

    fn is_metric(&self) -> bool {
        self.is_metric.load(Ordering::Relaxed)
    }

    /// Says what comes and goes, once.
    fn look_around(&mut self) {
        let has_daemon = self.poses.is_connected();
        if self.has_daemon.replace(has_daemon) != Some(has_daemon) {
            let prefix = &self.prefix;
            if has_daemon { info!(prefix, "bridging a daemon") } else { info!(prefix, "waiting for a daemon") }
        }
        if self.looked.is_some_and(|at| at.elapsed() < LOOK_EVERY) {
            return;
        }
        self.looked = Some(Instant::now());
        let has_network = self.out.node.is_connected();
        if self.has_network.replace(has_network) != Some(has_network) {
            let endpoints = self.out.node.endpoints();
            if has_network { info!("connected to Zenoh") } else { info!(endpoints, "waiting for a Zenoh router") }
        }
    }

    fn take_pose(&mut self, pose: &Pose) {
        if self.run.replace(pose.run_id) != Some(pose.run_id) {
            self.mount = None;
        }
        let is_metric = pose.scale() == Scale::Metric;
        self.is_metric.store(is_metric, Ordering::Relaxed);
        let Some(place) = Place::of(pose) else { return };
        let frames = frames(is_metric);
        let stamp = self.time.stamp(pose.timestamp_ns, pose.clock);
        let header = |frame_id| Header { stamp: stamp.clone(), frame_id };
        let now_ns = pose.published_ns;
        // First what others need to make use of the rest.
        if is_metric {
            if self.out.allow(Topic::Tf, now_ns) {
                let transforms = place.transforms(&stamp, frames);
                self.out.put(Topic::Tf, &ros::TfMessage { transforms });
            }
            if let Some(mount) = self.mount
                && self.told_mount != Some(mount)
                && self.out.allow(Topic::TfStatic, now_ns)
            {
                self.told_mount = Some(mount);
                let transforms = vec![transform(&stamp, frames.body, frames.camera, &mount)];
                self.out.put(Topic::TfStatic, &ros::TfMessage { transforms });
            }
        }
        if self.out.allow(Topic::Odometry, now_ns) {
            let odometry = odometry(pose, &place.odom_from_body, header(frames.odom), frames.body);
            self.out.put(Topic::Odometry, &odometry);
        }
        if self.out.allow(Topic::Pose, now_ns) {
            let pose = pose_with_covariance(pose, &place.map_from_body);
            self.out.put(Topic::Pose, &ros::PoseWithCovarianceStamped { header: header(frames.map), pose });
        }
    }

    fn take_health(&mut self, health: &Health) {
        self.time = UnixTime { realtime_minus_monotonic_ns: health.realtime_minus_monotonic_ns };
        if !self.diagnosed.is_news(health) || !self.out.allow(Topic::Diagnostics, health.published_ns) {
            return;
        }
        let stamp = Time::from_ns(self.time.ns(health.published_ns));
        let status = ros::DiagnosticStatus { name: &self.name, ..diagnostics(health, &self.prefix) };
        let message = ros::DiagnosticArray { header: Header { stamp, frame_id: "" }, status: vec![status] };
        self.out.put(Topic::Diagnostics, &message);
    }

    fn take_map(&mut self, header: &MapHeader, landmarks: &[Landmark]) {
        if !self.told_map.is_news(content_of_map(header)) {
            return;
        }
        if !self.out.allow(Topic::Points, header.published_ns) {
            // It is published again, and told once its rate has room.
            self.told_map = Told::default();
            return;
        }
        let frame_id = frames(Scale::from_wire(header.scale) == Scale::Metric).map;
        let stamp = self.time.stamp(header.timestamp_ns, header.clock);
        let data = landmark_bytes(landmarks);
        self.out.put(Topic::Points, &point_cloud(&data, landmarks.len(), Header { stamp, frame_id }));
    }

    /// The daemon looks for obstacles only while it is asked for them.
    fn take_obstacles(&mut self) -> Result<(), BridgeError> {
        if !self.out.is_wanted(Topic::Scan) {
            self.obstacles = None;
            return Ok(());
        }
        let subscription = self.obstacles.get_or_insert_with(|| self.client.obstacles().polled(TURN));
        while let Some(obstacles) = subscription.try_next()? {
            take_scan(&mut self.out, self.time, &obstacles);
        }
        Ok(())
    }

    /// The daemon hands out pictures only while it is asked for them. Where the camera sits is told with them alone, so the first one of a run is.
    fn take_pictures(&mut self) -> Result<(), BridgeError> {
        let needs_mount = self.is_metric() && self.mount.is_none() && self.out.is_wanted(Topic::TfStatic);
        if !needs_mount && !self.out.is_wanted(Topic::Image) && !self.out.is_wanted(Topic::CameraInfo) {
            self.encoded = None;
            return Ok(());
        }
        let subscription = self.encoded.get_or_insert_with(|| self.client.encoded().polled(TURN));
        let is_metric = self.is_metric.load(Ordering::Relaxed);
        while let Some(picture) = subscription.try_next()? {
            let header: &EncodedHeader = picture.header();
            if self.run == Some(header.run_id) {
                self.mount = mount(header).or(self.mount);
            }
            let stamp = self.time.stamp(header.timestamp_ns, header.clock);
            let ros_header = || Header { stamp: stamp.clone(), frame_id: frames(is_metric).camera };
            if self.out.allow(Topic::CameraInfo, header.arrival_ns)
                && let Some(info) = camera_info(header, ros_header())
            {
                self.out.put(Topic::CameraInfo, &info);
            }
            if self.out.allow(Topic::Image, header.arrival_ns)
                && let Some((format, data)) = compressed(header, &picture, &mut self.png)
            {
                let image = ros::CompressedImage { header: ros_header(), format, data: Bytes(data) };
                self.out.put(Topic::Image, &image);
            }
        }
        Ok(())
    }
}

fn take_scan(out: &mut Outputs, time: UnixTime, obstacles: &Obstacles) {
    let Some(map_from_scan) = scan_place(obstacles) else { return };
    if !out.allow(Topic::Scan, obstacles.published_ns) {
        return;
    }
    let stamp = time.stamp(obstacles.timestamp_ns, obstacles.clock);
    let transforms = vec![transform(&stamp, METRIC.map, SCAN_FRAME, &map_from_scan)];
    // With its scan: the rate of the other transforms is none of its own.
    if !out.rates.is_off(Topic::Tf) {
        out.put(Topic::Tf, &ros::TfMessage { transforms });
    }
    out.put(Topic::Scan, &laser_scan(obstacles, Header { stamp, frame_id: SCAN_FRAME }));
}
