//! A planner's side: typed subscriptions to a daemon, over iceoryx2 and nothing of ours but [`crate::messages`].
//!
//! The newest pose, in one line:
//!
//! ```no_run
//! # fn main() -> Result<(), cairn::client::ClientError> {
//! let pose = cairn::messages::Pose::latest()?.filter(|pose| pose.is_usable(std::time::Duration::from_millis(200)));
//! # Ok(())
//! # }
//! ```
//!
//! Every pose, asleep between two:
//!
//! ```no_run
//! # fn main() -> Result<(), cairn::client::ClientError> {
//! for pose in cairn::client::Client::connect("cairn")?.poses() {
//!     let pose = pose?;
//!     println!("{:?} {:?}", pose.state(), pose.position);
//! }
//! # Ok(())
//! # }
//! ```
//!
//! - The order of starting does not matter: a [`Subscription`] waits for the daemon, and finds it again when it was stopped,
//!   killed or replaced. [`crate::messages::Pose::run_id`] tells two runs apart.
//! - Waiting is by event: a sleeping planner costs nothing. While no daemon is there it looks 20 times a second.
//! - A daemon that has died leaves its last messages readable; their age tells ([`Subscription::latest`],
//!   [`crate::messages::Pose::age_ns`], [`monotonic_ns`]).
//! - Map, keyframes and frames are borrowed slices of shared memory, never copied. Two may be held at a time.
//! - What cannot work is an error that says why and what to do: another version, another user's files, too many readers.
//! - A client never creates anything before the daemon has: it could lock the daemon's user out.
//! - No signal handler is installed. No thread is started. All types are `Send`.

#[cfg(feature = "c")]
pub mod c;
mod camera;
mod commander;
mod error;
mod latest;
mod link;
mod search;
mod subscription;
mod topics;
mod wheel;

use std::sync::Arc;
use std::time::{Duration, Instant};

use iceoryx2_bb_posix::clock::{ClockType, Time};

pub use commander::{MapList, StoredMap};
pub use error::ClientError;
pub use subscription::{
    Encodeds, FeatureLists, Frames, Graphs, Healths, Keyframes, Map, ObstacleScans, Poses, Subscription, TagLists,
    WheelReports,
};
pub use topics::{Encoded, Features, Frame, Graph, KeyframesSnapshot, MapSnapshot, Slice, Topic};
pub use wheel::WheelPublisher;

use crate::messages::services::topic;
use crate::messages::{DEFAULT_PREFIX, Endpoint};
use link::Link;

/// How often a client looks for a daemon that is not there.
const LOOK_EVERY: Duration = Duration::from_millis(50);

/// CLOCK_MONOTONIC now, ns: what `published_ns` and `arrival_ns` are measured in.
pub fn monotonic_ns() -> i64 {
    // Fails only on systems without that clock, on which iceoryx2 does not run.
    Time::now_with_clock(ClockType::Monotonic)
        .map_or(0, |t| t.seconds() as i64 * 1_000_000_000 + i64::from(t.nanoseconds()))
}

/// The services of one daemon. Cheap; subscriptions made from it share one iceoryx2 node.
#[derive(Debug, Clone)]
pub struct Client {
    link: Arc<Link>,
}

impl Client {
    /// The daemon with this prefix (`cairn` unless it was told otherwise), which need not run yet. An error here is one that
    /// waiting would not cure. CAIRN_IPC_ROOT and CAIRN_IPC_PREFIX are looked at ([`Endpoint::with_environment`]).
    pub fn connect(prefix: &str) -> Result<Self, ClientError> {
        Self::with_endpoint(Endpoint::new(prefix)?.with_environment()?)
    }

    /// The daemon that CAIRN_PREFIX names, `cairn` if it is not set or empty; otherwise as [`Self::connect`].
    pub fn from_environment() -> Result<Self, ClientError> {
        let prefix = std::env::var("CAIRN_PREFIX").ok().filter(|prefix| !prefix.is_empty());
        Self::connect(prefix.as_deref().unwrap_or(DEFAULT_PREFIX))
    }

    /// As [`Self::connect`], regardless of the environment.
    pub fn with_endpoint(endpoint: Endpoint) -> Result<Self, ClientError> {
        let link = Link::new(endpoint);
        link.probe(topic::POSE)?;
        Ok(Self { link: Arc::new(link) })
    }

    /// Waits until a daemon is there; `false` after `timeout`.
    pub fn wait_for_daemon(&self, timeout: Duration) -> Result<bool, ClientError> {
        let start = Instant::now();
        loop {
            if self.link.probe(topic::POSE)? {
                return Ok(true);
            }
            match timeout.checked_sub(start.elapsed()) {
                Some(left) if !left.is_zero() => std::thread::sleep(left.min(LOOK_EVERY)),
                _ => return Ok(false),
            }
        }
    }

    /// Poses, one a frame.
    pub fn poses(&self) -> Poses {
        Subscription::new(self.link.clone())
    }

    /// The sparse map, at most twice a second.
    pub fn map(&self) -> Map {
        Subscription::new(self.link.clone())
    }

    /// Keyframes, with the map.
    pub fn keyframes(&self) -> Keyframes {
        Subscription::new(self.link.clone())
    }

    /// What holds the map together, before each map. The daemon makes it only while somebody holds such a subscription.
    pub fn graph(&self) -> Graphs {
        Subscription::new(self.link.clone())
    }

    /// The daemon's health, at a steady rate.
    pub fn health(&self) -> Healths {
        Subscription::new(self.link.clone())
    }

    /// Grey pictures as the daemon sees them. The daemon copies pictures only while somebody holds such a subscription.
    pub fn frames(&self) -> Frames {
        Subscription::new(self.link.clone())
    }

    /// Corners, tracks and matched landmarks of each picture. The daemon makes them only while somebody holds such a subscription.
    pub fn features(&self) -> FeatureLists {
        Subscription::new(self.link.clone())
    }

    /// What stands around the robot and where the floor is free, about six times a second. The daemon makes scans only while somebody holds such a
    /// subscription.
    pub fn obstacles(&self) -> ObstacleScans {
        Subscription::new(self.link.clone())
    }

    /// The tags that the map's keyframes have seen, before each map. The daemon tells them only while somebody holds such a subscription.
    pub fn tags(&self) -> TagLists {
        Subscription::new(self.link.clone())
    }

    /// What the base's driver tells the daemon, for recorders: it is looked for every `pause`, as its messages wake nobody. Connected is such a
    /// subscription while a driver is. Let go of it when the daemon has gone, or the driver takes this reader for one.
    pub fn wheel_reports(&self, pause: Duration) -> WheelReports {
        Subscription::new(self.link.clone()).polled(pause)
    }

    /// Every picture as it came from the camera (JPEG, rows of grey), with what is believed of its lens: for recorders. The queue holds a fifth of
    /// a second; the daemon copies these bytes only while somebody holds such a subscription, and two can.
    pub fn encoded(&self) -> Encodeds {
        Subscription::new(self.link.clone())
    }
}
