//! The daemon's side of the wire: internal types in, messages in shared memory out.
//!
//! [`Publisher::open`] makes every service and hands out one handle for each thread that needs one: poses, map and frames
//! for the threads that make them, health for the supervisor, commands for whoever carries them out. All are `Send`.
//!
//! - Nothing here waits for a reader: queues overflow, oldest first, and memory is of fixed size. Publishing a pose
//!   allocates nothing if [`PosePublisher::prepare`] was called before (a test counts).
//! - [`convert`] turns optical axes into REP-103 axes of the robot's body, covariance included.
//! - One daemon a prefix: a second one gets [`PublishError::AlreadyRunning`]. What a killed one left behind is cleared away.
//! - Shared memory, reserved though not touched before it is used, for 8 subscribers: poses 0.2 MB, health 0.03 MB, map
//!   12.5 MB (20,000 landmarks), keyframes 3.8 MB (2,000), graph 5.2 MB, frames 8 MB (640x480), features 3.6 MB, encoded pictures 6 MB (as frames), obstacles 0.3 MB, tags 0.05 MB. A full `/dev/shm` kills a process by
//!   SIGBUS, so [`Publisher::open`] refuses to start where there is no room.
//!
//! Does not: log, read configuration, spawn threads, convert pictures.

mod commands;
pub mod convert;
mod encoded;
mod error;
mod features;
mod graph;
mod obstacles;
mod opening;
mod ports;
mod tags;
mod wheels;

use std::sync::{Arc, Weak};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::{Node, NodeBuilder, NodeName, SignalHandlingMode};

pub use commands::{CommandServer, Request};
pub use convert::{Conversion, ScaleEstimate};
pub use encoded::{CameraView, EncodedPublisher};
pub use error::PublishError;
pub use features::FeaturesPublisher;
pub use graph::GraphPublisher;
pub use obstacles::{ObstaclesPublisher, ScanContext};
pub use tags::{TagsPublisher, map_from_tag};
pub use wheels::{WheelInbox, WheelNews};

use crate::frame::{Clock, monotonic_ns};
use crate::image::GreyImage;
use crate::map::MapSnapshot;
use crate::messages::services::{self, topic};
use crate::messages::{
    DAEMON_NODE, EncodedHeader, Endpoint, Feature, FeaturesHeader, FrameHeader, GraphEdge, GraphHeader, Health,
    Keyframe, KeyframesHeader, Landmark, MapHeader, Obstacles, Pose, Presence, Tags,
};
use crate::reconstruction::PoseEstimate;
use opening::Ipc;
use ports::{Loan, Port};

/// How often the remains of processes that were killed are looked for.
const CLEAN_UP_EVERY: Duration = Duration::from_secs(1);

/// How often what iceoryx2 cannot clear away itself is looked for.
const SWEEP_EVERY: Duration = Duration::from_secs(60);

/// Longest wait for what somebody is just making, or until what a killed process left of it is known as such; health is sent ten times a
/// second.
const HALF_MADE: Duration = Duration::from_millis(150);

/// Sizes that shared memory is reserved for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Landmarks in a map message; of a larger map the newest are sent.
    pub landmarks: usize,
    /// Keyframes in a keyframes message; of a larger map the newest are sent.
    pub keyframes: usize,
    /// Bytes of a picture, decoded or not; larger ones are not sent ([`PublishError::FrameTooLarge`]).
    pub frame_bytes: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            landmarks: services::DEFAULT_MAX_LANDMARKS,
            keyframes: services::DEFAULT_MAX_KEYFRAMES,
            frame_bytes: services::DEFAULT_MAX_FRAME_BYTES,
        }
    }
}

impl Limits {
    /// Bytes of message memory that these limits may come to use, all services together.
    pub fn shared_memory_bytes(&self) -> u64 {
        let parts = [
            (services::POSE, size_of::<Pose>()),
            (services::HEALTH, size_of::<Health>()),
            (services::MAP, self.landmarks * size_of::<Landmark>()),
            (services::KEYFRAMES, self.keyframes * size_of::<Keyframe>()),
            (services::GRAPH, services::MAX_EDGES * size_of::<GraphEdge>()),
            (services::FRAME, self.frame_bytes),
            (services::FEATURES, services::MAX_FEATURES * size_of::<Feature>()),
            (services::ENCODED, self.frame_bytes),
            (services::OBSTACLES, size_of::<Obstacles>()),
            (services::TAGS, size_of::<Tags>()),
        ];
        // 256: headers and rounding of a message.
        parts.iter().map(|(qos, bytes)| (qos.messages() * (bytes + 256)) as u64).sum()
    }
}

/// All services of a daemon; take it apart and give each thread its handle.
#[derive(Debug)]
pub struct Publisher {
    pub poses: PosePublisher,
    pub map: MapPublisher,
    pub graph: GraphPublisher,
    pub frames: FramePublisher,
    pub features: FeaturesPublisher,
    pub encoded: EncodedPublisher,
    pub obstacles: ObstaclesPublisher,
    pub tags: TagsPublisher,
    pub health: HealthPublisher,
    pub commands: CommandServer,
    /// What the base's driver tells.
    pub wheels: WheelInbox,
}

impl Publisher {
    /// Makes all services. Takes some 10 ms; up to 3 s while the remains of another daemon go away.
    pub fn open(endpoint: &Endpoint, limits: &Limits) -> Result<Self, PublishError> {
        if let Presence::OtherOwner { path, owner } = endpoint.probe(&endpoint.service(topic::POSE)?) {
            return Err(PublishError::OtherOwner { path, owner });
        }
        // What a daemon of ours was killed over is cleared away before it is taken for somebody else's.
        endpoint.clear_unfilled();
        if let Some(squatter) = endpoint.squatter(false) {
            return Err(PublishError::Squatted(squatter));
        }
        opening::check_room(limits.shared_memory_bytes())?;
        opening::clear_unfilled(endpoint, opening::PATIENCE)?;
        opening::sweep(endpoint);
        let node = Arc::new(node(endpoint)?);
        let run_id = run_id();
        // The pose first: it is what tells that another daemon has this prefix.
        let poses: Port<Pose, ()> = Port::open(&node, endpoint, topic::POSE, services::POSE)?;
        let map: Port<[Landmark], MapHeader> =
            Port::open_slices(&node, endpoint, topic::MAP, services::MAP, limits.landmarks)?;
        let keyframes: Port<[Keyframe], KeyframesHeader> =
            Port::open_slices(&node, endpoint, topic::KEYFRAMES, services::KEYFRAMES, limits.keyframes)?;
        let graph: Port<[GraphEdge], GraphHeader> =
            Port::open_slices(&node, endpoint, topic::GRAPH, services::GRAPH, services::MAX_EDGES)?;
        let frames: Port<[u8], FrameHeader> =
            Port::open_slices(&node, endpoint, topic::FRAME, services::FRAME, limits.frame_bytes)?;
        let features: Port<[Feature], FeaturesHeader> =
            Port::open_slices(&node, endpoint, topic::FEATURES, services::FEATURES, services::MAX_FEATURES)?;
        let encoded: Port<[u8], EncodedHeader> =
            Port::open_slices(&node, endpoint, topic::ENCODED, services::ENCODED, limits.frame_bytes)?;
        let obstacles: Port<Obstacles, ()> = Port::open(&node, endpoint, topic::OBSTACLES, services::OBSTACLES)?;
        let tags: Port<Tags, ()> = Port::open(&node, endpoint, topic::TAGS, services::TAGS)?;
        let commands = CommandServer::open(&node, endpoint)?;
        let wheels = WheelInbox::open(&node, endpoint)?;
        let health: Port<Health, ()> = Port::open(&node, endpoint, topic::HEALTH, services::HEALTH)?;
        let others = vec![
            updater(&poses.publisher),
            updater(&map.publisher),
            updater(&keyframes.publisher),
            updater(&graph.publisher),
            updater(&frames.publisher),
            updater(&features.publisher),
            updater(&encoded.publisher),
            updater(&obstacles.publisher),
            updater(&tags.publisher),
        ];
        Ok(Self {
            poses: PosePublisher { next: None, port: poses, run_id },
            map: MapPublisher { map, keyframes, limits: *limits, run_id, sent_ns: None },
            graph: GraphPublisher { port: graph, run_id },
            frames: FramePublisher { port: frames, limit: limits.frame_bytes, run_id },
            features: FeaturesPublisher::new(features, run_id),
            encoded: EncodedPublisher::new(encoded, limits.frame_bytes, run_id),
            obstacles: ObstaclesPublisher::new(obstacles, run_id),
            tags: TagsPublisher { port: tags, run_id },
            health: HealthPublisher {
                port: health,
                node,
                endpoint: endpoint.clone(),
                others,
                run_id,
                sequence: 0,
                started_ns: monotonic_ns(),
                cleaned: Instant::now(),
                swept: Instant::now(),
            },
            commands,
            wheels,
        })
    }
}

/// Longest wait for a subscriber that is just connecting (and may have died over it), in the middle of a pose's way.
const CONNECTING: Duration = Duration::from_millis(200);

fn node(endpoint: &Endpoint) -> Result<Node<Ipc>, PublishError> {
    let mut config = endpoint.config().clone();
    config.global.creation_timeout = CONNECTING;
    let create = || {
        let name = NodeName::new(DAEMON_NODE).map_err(|e| e.to_string())?;
        NodeBuilder::new()
            .name(&name)
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Ipc>()
            .map_err(|e| e.to_string())
    };
    create().map_err(|reason| match (opening::foreign_folder(endpoint), endpoint.squatter(true)) {
        (Some((path, owner)), _) => PublishError::OtherOwner { path, owner },
        (None, Some(squatter)) => PublishError::Squatted(squatter),
        (None, None) => {
            PublishError::Ipc { service: endpoint.root().display().to_string(), doing: "creating a node", reason }
        }
    })
}

/// Microseconds since 1970: another value at every start, and small enough for a JSON number.
fn run_id() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(1, |t| u64::try_from(t.as_micros()).unwrap_or(1))
}

type Updater = Box<dyn Fn() + Send>;

/// Lets a publisher meet subscribers that came since, and give them its history. The supervisor does that for every
/// publisher: one that has nothing to send would leave a late joiner without the last message.
fn updater<P>(publisher: &Arc<P>) -> Updater
where
    P: UpdateConnections + Send + Sync + 'static,
{
    let publisher: Weak<P> = Arc::downgrade(publisher);
    Box::new(move || {
        if let Some(publisher) = publisher.upgrade() {
            // A subscriber that cannot be reached has just died.
            let _ = publisher.update_connections();
        }
    })
}

/// `PREFIX/pose`.
pub struct PosePublisher {
    /// Memory taken in advance.
    next: Option<Loan<Pose>>,
    port: Port<Pose, ()>,
    run_id: u64,
}

impl std::fmt::Debug for PosePublisher {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("PosePublisher").field("run_id", &self.run_id).field("port", &self.port).finish_non_exhaustive()
    }
}

impl PosePublisher {
    /// Takes memory for the next pose. Call it when a frame's work is done: then [`Self::publish`] allocates nothing.
    /// (iceoryx2 0.10 makes one small heap allocation for every message.)
    pub fn prepare(&mut self) {
        if self.next.is_none() {
            // Without it `publish` tries again, and says why it fails.
            self.next = self.port.loan().ok();
        }
    }

    /// Sends the pose of one frame and returns it as sent. `frames_dropped`: of this run, so far. Waits for nobody;
    /// allocates nothing after [`Self::prepare`].
    pub fn publish(
        &mut self,
        estimate: &PoseEstimate,
        conversion: &Conversion,
        frames_dropped: u64,
    ) -> Result<Pose, PublishError> {
        let mut pose = convert::pose(estimate, conversion);
        pose.run_id = self.run_id;
        pose.frames_dropped = frames_dropped;
        pose.published_ns = monotonic_ns();
        pose.latency_arrival_ns = pose.published_ns.saturating_sub(pose.arrival_ns);
        if conversion.clock == Clock::Monotonic {
            pose.latency_capture_ns = pose.published_ns.saturating_sub(pose.timestamp_ns);
        }
        match self.next.take() {
            Some(memory) => self.port.send_in(memory, pose)?,
            None => self.port.send(pose)?,
        }
        Ok(pose)
    }

    /// Subscribers that poses go to.
    pub fn subscribers(&self) -> usize {
        self.port.subscribers()
    }
}

/// `PREFIX/map` and `PREFIX/keyframes`.
#[derive(Debug)]
pub struct MapPublisher {
    map: Port<[Landmark], MapHeader>,
    keyframes: Port<[Keyframe], KeyframesHeader>,
    limits: Limits,
    run_id: u64,
    sent_ns: Option<i64>,
}

/// What a map message says of itself besides the map.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct MapContext {
    /// Capture time of the newest frame that the map knows of.
    pub timestamp_ns: i64,
    /// As in the poses.
    pub reset_counter: u32,
    pub map_revision: u32,
    /// Bits of [`map_mode`](crate::messages::map_mode).
    pub map_mode: u8,
}

impl MapPublisher {
    /// The last map was sent long enough ago ([`services::MAP_RATE_HZ`]) that a snapshot is worth its time.
    pub fn is_due(&self, now_ns: i64) -> bool {
        let pause_ns = (1e9 / services::MAP_RATE_HZ) as i64;
        self.sent_ns.is_none_or(|sent| now_ns.saturating_sub(sent) >= pause_ns)
    }

    /// Landmarks and keyframes of a message, at the most.
    pub fn most(&self) -> [usize; 2] {
        [self.limits.landmarks, self.limits.keyframes]
    }

    /// Sends landmarks and keyframes, written straight into shared memory; of too many, the newest.
    ///
    /// Both are written before either is sent, and the map is the last: a reader that it wakes often gets this thread's core, and
    /// would wait there for whatever is left to do, so the way to the reader would grow with the map. Who wakes by the map also
    /// finds the keyframes of the same content.
    pub fn publish(
        &mut self,
        snapshot: &MapSnapshot,
        conversion: &Conversion,
        context: &MapContext,
    ) -> Result<(), PublishError> {
        self.sent_ns = Some(monotonic_ns());
        let (scale, scale_sigma, scale_source) = conversion.scale.to_wire();
        let landmarks = newest(&snapshot.landmarks, self.limits.landmarks);
        let keyframes = newest(&snapshot.keyframes, self.limits.keyframes);
        let map_from_optical = conversion.map_from_optical();
        let map = self.map.fill(landmarks, |l| convert::landmark(l, &map_from_optical))?;
        let path = self.keyframes.fill(keyframes, |k| convert::keyframe(k, conversion))?;
        let header = KeyframesHeader {
            run_id: self.run_id,
            content_revision: snapshot.revision,
            timestamp_ns: context.timestamp_ns,
            published_ns: monotonic_ns(),
            count: count(keyframes.len()),
            total: count(snapshot.totals()[1]),
            map_id: snapshot.map.0,
            reset_counter: context.reset_counter,
            map_revision: context.map_revision,
            scale_sigma,
            scale,
            scale_source,
            clock: convert::clock(conversion.clock),
            map_mode: context.map_mode,
            reserved: [0; 4],
        };
        self.keyframes.send_filled(path, header)?;
        let header = MapHeader {
            run_id: self.run_id,
            content_revision: snapshot.revision,
            timestamp_ns: context.timestamp_ns,
            published_ns: monotonic_ns(),
            count: count(landmarks.len()),
            total: count(snapshot.totals()[0]),
            map_id: snapshot.map.0,
            reset_counter: context.reset_counter,
            map_revision: context.map_revision,
            scale_sigma,
            scale,
            scale_source,
            clock: convert::clock(conversion.clock),
            map_mode: context.map_mode,
            reserved: [0; 4],
        };
        self.map.send_filled(map, header)
    }
}

fn newest<T>(all: &[T], limit: usize) -> &[T] {
    all.get(all.len().saturating_sub(limit)..).unwrap_or_default()
}

fn count(n: usize) -> u32 {
    u32::try_from(n).unwrap_or(u32::MAX)
}

/// `PREFIX/frame`.
#[derive(Debug)]
pub struct FramePublisher {
    port: Port<[u8], FrameHeader>,
    limit: usize,
    run_id: u64,
}

/// Which frame a picture is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct FrameStamp {
    pub sequence: u64,
    pub timestamp_ns: i64,
    pub arrival_ns: i64,
    pub clock: Clock,
}

impl FramePublisher {
    /// Somebody wants pictures.
    pub fn is_wanted(&self) -> bool {
        self.port.subscribers() > 0
    }

    /// Sends one picture (a single copy), if somebody subscribes; tells whether it was sent.
    pub fn publish(&mut self, image: &GreyImage, stamp: &FrameStamp) -> Result<bool, PublishError> {
        if !self.is_wanted() {
            return Ok(false);
        }
        if image.data.len() > self.limit {
            return Err(PublishError::FrameTooLarge { bytes: image.data.len(), limit: self.limit });
        }
        let header = FrameHeader {
            run_id: self.run_id,
            sequence: stamp.sequence,
            timestamp_ns: stamp.timestamp_ns,
            arrival_ns: stamp.arrival_ns,
            width: count(image.width),
            height: count(image.height),
            stride: count(image.width),
            clock: convert::clock(stamp.clock),
            reserved: [0; 3],
        };
        self.port.send_copy(header, &image.data)?;
        Ok(true)
    }
}

/// `PREFIX/health`, and the housekeeping that must go on whatever else has stalled.
pub struct HealthPublisher {
    port: Port<Health, ()>,
    node: Arc<Node<Ipc>>,
    endpoint: Endpoint,
    others: Vec<Updater>,
    run_id: u64,
    sequence: u64,
    started_ns: i64,
    cleaned: Instant,
    swept: Instant,
}

impl std::fmt::Debug for HealthPublisher {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("HealthPublisher").field("run_id", &self.run_id).field("sequence", &self.sequence).finish()
    }
}

impl HealthPublisher {
    /// Sends `health`, whose run, sequence, times, process and version are filled in here. Call it at a steady rate (5 to
    /// 10 Hz): it also lets late joiners of all services have their history, and clears away what killed processes left.
    pub fn publish(&mut self, health: &Health) -> Result<(), PublishError> {
        let mut health = *health;
        health.run_id = self.run_id;
        health.sequence = self.sequence;
        health.published_ns = monotonic_ns();
        health.uptime_ns = health.published_ns.saturating_sub(self.started_ns);
        health.realtime_minus_monotonic_ns = realtime_ns().saturating_sub(health.published_ns);
        health.pid = std::process::id();
        health.set_version(env!("CARGO_PKG_VERSION"));
        // First, as all that follows opens what subscribers made: one that was killed over it would hold us (root). This also frees another
        // port's thread that such a one holds already. What cannot be removed is not ours, and as a rule nothing that we open.
        let _ = opening::clear_unfilled(&self.endpoint, HALF_MADE);
        self.sequence += 1;
        let sent = self.port.send(health);
        for update in &self.others {
            update();
        }
        if self.cleaned.elapsed() >= CLEAN_UP_EVERY {
            self.node.try_cleanup_dead_nodes();
            self.cleaned = Instant::now();
        }
        if self.swept.elapsed() >= SWEEP_EVERY {
            opening::sweep(&self.endpoint);
            self.swept = Instant::now();
        }
        sent
    }

    /// Identifies this start of the daemon in all messages.
    pub fn run_id(&self) -> u64 {
        self.run_id
    }
}

fn realtime_ns() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |t| i64::try_from(t.as_nanos()).unwrap_or(0))
}

#[cfg(test)]
mod tests;
