//! The listening half of a bridge: a subscriber like any other.
//!
//! Input: the daemon's services. Output: ROS 2 messages on the [`Node`]. Before lengths are metres odometry goes out in the frame `odom_unscaled`
//! and there are no transforms; what has no position is no odometry, no pose and no transform. A daemon that stops, dies or starts anew is waited for.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use tracing::{info, warn};

use super::anchors::Anchors;
use super::commands::Commands;
use super::error::BridgeError;
use super::inbox::Inbox;
use super::node::{Network, Node};
use super::on_demand::OnDemand;
use super::rates::Rates;
use super::scans::LastPoses;
use super::session::Link;
use super::topic::Topic;
use crate::client::{Client, Encodeds, Healths, Keyframes, Map, ObstacleScans, Poses, TagLists};
use crate::messages::{
    EncodedHeader, Endpoint, Health, Landmark, MapHeader, Obstacles, Pose, Scale, Tag, Transform, map_mode,
};
use crate::ros::standard::{self as ros, Header, Time};
use crate::ros::{Bytes, Message};
use crate::share::conversion::{
    camera_info, diagnostics, landmark_bytes, laser_scan, odometry, point_cloud, pose_with_covariance,
};
use crate::share::frames::{METRIC, Place, SCAN_FRAME, UnixTime, frames, mount, transform};
use crate::share::maps::Requests;
use crate::share::news::{DIAGNOSTICS_EVERY_S, Diagnosed, News, Told, content_of_map};
use crate::share::picture::compressed;

/// Longest sleep: how late a signal is noticed while nothing comes, and all but poses and pictures.
const TURN: Duration = Duration::from_millis(50);
/// How often it is looked after the network.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// How often the mount is asked for again while wheels are heard: where the configuration does not say it the robot's motion shows it, once in a map.
const MOUNT_EVERY: Duration = Duration::from_secs(10);
/// A step comes with every pose, so this keeps up with the camera. Where a picture takes longer to compress than the next to come, pictures are lost and
/// not odometry.
const PICTURES_A_STEP: usize = 2;
/// What repeats is said once in so long.
const SAY_EVERY: Duration = Duration::from_secs(10);

/// See module.
pub struct Bridge {
    out: Outputs,
    poses: Poses,
    map: Map,
    keyframes: OnDemand<Keyframes>,
    health: Healths,
    obstacles: OnDemand<ObstacleScans>,
    encoded: OnDemand<Encodeds>,
    tags: OnDemand<TagLists>,
    client: Client,
    prefix: String,
    name: String,
    time: UnixTime,
    is_metric: Arc<AtomicBool>,
    last_poses: LastPoses,
    run: Option<u64>,
    run_before: Option<u64>,
    /// Of the last pose.
    scale: Option<Scale>,
    /// `body_from_camera` of this run, and when it was told.
    mount: Option<(Transform, Instant)>,
    /// The map is told in the frame of the dock.
    is_docked: bool,
    /// The tag that is the dock of this run, as one word; other robots with the same one have the same frame.
    dock: Option<String>,
    /// Of the map that was published last.
    anchors: Option<Anchors>,
    /// The daemon believes what wheels tell.
    has_wheels: bool,
    /// What was sent of it.
    told_mount: Option<Transform>,
    diagnosed: Diagnosed,
    told_map: Told,
    /// It was said that there is no daemon.
    is_waiting: bool,
    link: Option<Link>,
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
    /// second half, if the network may ask for anything, is for a thread of its own. `maps`: where it asks for stored ones.
    pub fn open(
        endpoint: Endpoint,
        network: &Network,
        rates: Rates,
        realtime_minus_monotonic_ns: i64,
        maps: Option<Requests>,
    ) -> Result<(Self, Option<Commands>), BridgeError> {
        let prefix = endpoint.prefix().to_owned();
        let client = Client::with_endpoint(endpoint)?;
        let is_metric = Arc::new(AtomicBool::new(false));
        let inbox = Inbox::default();
        let node = Node::open(network, &inbox, maps)?;
        let commands = network.takes_commands.then(|| Commands::new(inbox, client.clone(), is_metric.clone()));
        let name = network.robot.name();
        let bridge = Self {
            out: Outputs { node, rates, said: None },
            poses: client.poses(),
            map: client.map().polled(TURN),
            keyframes: OnDemand::default(),
            health: client.health().polled(TURN),
            obstacles: OnDemand::default(),
            encoded: OnDemand::default(),
            tags: OnDemand::default(),
            client,
            name: if name.is_empty() { "cairn: pose and map".into() } else { format!("{name}: pose and map") },
            prefix,
            time: UnixTime { realtime_minus_monotonic_ns },
            is_metric,
            last_poses: LastPoses::default(),
            run: None,
            run_before: None,
            scale: None,
            mount: None,
            is_docked: false,
            dock: None,
            anchors: None,
            has_wheels: false,
            told_mount: None,
            diagnosed: Diagnosed::default(),
            told_map: Told::default(),
            is_waiting: false,
            link: None,
            looked: None,
            png: Vec::new(),
        };
        Ok((bridge, commands))
    }

    /// Waits for the next pose for 50 ms at most, and sends everything that has come.
    pub fn step(&mut self) -> Result<(), BridgeError> {
        let mut pose = self.poses.wait(TURN)?;
        // Before the poses: that of a scan's frame was sent before the scan.
        let scan = self.next_obstacles()?;
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
        let client = &self.client;
        if let Some(keyframes) = self.keyframes.try_next(|| client.keyframes().polled(TURN), Keyframes::try_next)? {
            self.anchors = Anchors::of(keyframes.header(), &keyframes);
        }
        if let Some(obstacles) = scan {
            self.take_obstacles(&obstacles);
        }
        self.take_pictures()?;
        self.look_for_dock()?;
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

    /// What comes is of this run: the next daemon may be there before the last one's services are gone.
    fn take_run(&mut self, run_id: u64) {
        let is_known = self.run == Some(run_id) && !self.is_waiting;
        // The last words of the one before are no other's.
        if is_known || self.run_before == Some(run_id) || !self.poses.is_connected() {
            return;
        }
        if self.run != Some(run_id) {
            self.run_before = self.run.replace(run_id);
            self.mount = None;
            self.dock = None;
            self.anchors = None;
        }
        self.is_waiting = false;
        info!(prefix = self.prefix, "bridging a daemon");
    }

    /// Says what goes and comes, once.
    fn look_around(&mut self) {
        if !self.poses.is_connected() && !std::mem::replace(&mut self.is_waiting, true) {
            info!(prefix = self.prefix, "waiting for a daemon");
        }
        if self.looked.is_some_and(|at| at.elapsed() < LOOK_EVERY) {
            return;
        }
        self.looked = Some(Instant::now());
        let link = self.out.node.link();
        if self.link.replace(link) != Some(link) {
            let endpoints = self.out.node.endpoints();
            match link {
                Link::Router => info!("connected to Zenoh"),
                Link::Peers => info!(endpoints, "other peers of Zenoh are there, and no router"),
                Link::Nobody => info!(endpoints, "waiting for a Zenoh router"),
            }
        }
    }

    fn take_pose(&mut self, pose: &Pose) {
        self.take_run(pose.run_id);
        self.scale = Some(pose.scale());
        let is_metric = pose.scale() == Scale::Metric;
        self.is_metric.store(is_metric, Ordering::Relaxed);
        let Some(place) = Place::of(pose) else { return };
        let frames = frames(is_metric);
        let stamp = self.time.stamp(pose.timestamp_ns, pose.clock);
        let header = |frame_id| Header { stamp: stamp.clone(), frame_id };
        let now_ns = pose.published_ns;
        if is_metric {
            self.last_poses.add(pose, &place, &stamp);
        }
        // First what others need to make use of the rest.
        if is_metric {
            if self.out.allow(Topic::Tf, now_ns) {
                let transforms = place.transforms(&stamp, frames);
                self.out.put(Topic::Tf, &ros::TfMessage { transforms });
            }
            if let Some((mount, _)) = self.mount
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
        self.take_run(health.run_id);
        self.time = UnixTime { realtime_minus_monotonic_ns: health.realtime_minus_monotonic_ns };
        self.has_wheels = health.wheel_messages > 0;
        self.is_docked = health.map_mode & map_mode::DOCK_FRAME != 0;
        let is_sent = match self.diagnosed.news(health) {
            Some(News::Changed) => !self.out.rates.is_off(Topic::Diagnostics),
            Some(News::Again) => self.out.allow(Topic::Diagnostics, health.published_ns),
            None => false,
        };
        if !is_sent {
            return;
        }
        let stamp = Time::from_ns(self.time.ns(health.published_ns));
        let mut status = ros::DiagnosticStatus { name: &self.name, ..diagnostics(health, &self.prefix) };
        // Health does not tell it, poses do; whoever looks after many robots hears diagnostics alone.
        if let Some(scale) = self.scale {
            status.values.push(ros::KeyValue { key: "scale", value: scale.name().into() });
        }
        let mut tell = |key, value| status.values.push(ros::KeyValue { key, value });
        if self.is_docked {
            self.dock.iter().for_each(|dock| tell("map_frame", dock.clone()));
        } else if let Some(anchors) = self.anchors.as_ref().filter(|anchors| anchors.map_id == health.map_id) {
            tell("map_anchors", anchors.text());
        }
        // Whoever waits for the next one knows how long.
        let period_s = self.out.rates.period_s(Topic::Diagnostics).max(DIAGNOSTICS_EVERY_S);
        status.values.push(ros::KeyValue { key: "period_s", value: period_s.to_string() });
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

    /// Which tag the dock is, asked once in a run.
    fn look_for_dock(&mut self) -> Result<(), BridgeError> {
        if !self.is_docked || self.dock.is_some() {
            self.tags.leave();
            return Ok(());
        }
        let client = &self.client;
        let next = self.tags.try_next(|| client.tags().polled(TURN), TagLists::try_next)?;
        let is_dock = |tag: &&Tag| tag.is_dock != 0;
        let word = |tag: &Tag| format!("dock_{}_{}", tag.family_name(), tag.id);
        self.dock = next.and_then(|tags| tags.seen().iter().find(is_dock).map(word));
        Ok(())
    }

    /// The daemon looks for obstacles only while it is asked for them. The newest scan.
    fn next_obstacles(&mut self) -> Result<Option<Obstacles>, BridgeError> {
        if !self.out.is_wanted(Topic::Scan) {
            self.obstacles.leave();
            return Ok(None);
        }
        let client = &self.client;
        Ok(self.obstacles.try_next(|| client.obstacles().polled(TURN), ObstacleScans::try_next)?)
    }

    fn take_obstacles(&mut self, obstacles: &Obstacles) {
        let Some((body_from_scan, stamp)) = self.last_poses.body_from_scan(obstacles) else { return };
        if !self.out.allow(Topic::Scan, obstacles.published_ns) {
            return;
        }
        // With its scan: the rate of the other transforms is none of its own.
        if !self.out.rates.is_off(Topic::Tf) {
            let transforms = vec![transform(&stamp, METRIC.body, SCAN_FRAME, &body_from_scan)];
            self.out.put(Topic::Tf, &ros::TfMessage { transforms });
        }
        self.out.put(Topic::Scan, &laser_scan(obstacles, Header { stamp, frame_id: SCAN_FRAME }));
    }

    /// Where the camera sits is to be told, and not known or not for long.
    fn needs_mount(&self) -> bool {
        let is_known = self.mount.is_some_and(|(_, at)| !self.has_wheels || at.elapsed() < MOUNT_EVERY);
        self.is_metric() && !is_known && self.out.is_wanted(Topic::TfStatic)
    }

    /// The daemon hands out pictures only while it is asked for them. Where the camera sits is told with them alone, so one is asked for now and then.
    fn take_pictures(&mut self) -> Result<(), BridgeError> {
        if !self.needs_mount() && !self.out.is_wanted(Topic::Image) && !self.out.is_wanted(Topic::CameraInfo) {
            self.encoded.leave();
            return Ok(());
        }
        let is_metric = self.is_metric.load(Ordering::Relaxed);
        let client = self.client.clone();
        for _ in 0..PICTURES_A_STEP {
            let next = self.encoded.try_next(|| client.encoded().polled(TURN), Encodeds::try_next)?;
            let Some(picture) = next else { break };
            let header: &EncodedHeader = picture.header();
            if self.run == Some(header.run_id) {
                self.mount = mount(header).map(|mount| (mount, Instant::now())).or(self.mount);
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
