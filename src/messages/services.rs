//! Names and quality of service of everything on the wire, in one place.
//!
//! Everywhere but in `wheel`, which the daemon reads: one publisher, so that a second daemon with the same prefix is refused; safe overflow, so that a reader that
//! is slow or stuck loses its oldest messages and delays nobody; memory of fixed size, reserved at the start.

/// Last part of the services' names.
pub mod topic {
    pub const POSE: &str = "pose";
    pub const MAP: &str = "map";
    pub const KEYFRAMES: &str = "keyframes";
    pub const HEALTH: &str = "health";
    pub const GRAPH: &str = "graph";
    pub const FRAME: &str = "frame";
    pub const FEATURES: &str = "features";
    pub const ENCODED: &str = "encoded";
    pub const COMMAND: &str = "command";
    pub const WHEEL: &str = "wheel";
    pub const OBSTACLES: &str = "obstacles";
    pub const TAGS: &str = "tags";
}

/// Event: a publisher has come.
pub const EVENT_CREATED: usize = 1;
/// Event: the publisher has left.
pub const EVENT_DROPPED: usize = 2;
/// Event: the publisher died without leaving, and its remains were cleared away.
pub const EVENT_DEAD: usize = 3;
/// Event: there is a new message.
pub const EVENT_NEW: usize = 4;
/// Largest event id of a service, with room for later ones.
pub const EVENT_MAX: usize = 15;
/// Notifiers at most: the publisher's, and those that iceoryx2 makes for a moment to report a death.
pub const MAX_NOTIFIERS: usize = 4;

/// Subscribers of a service at most, but of `encoded`.
pub const MAX_SUBSCRIBERS: usize = 8;
/// Subscribers of `encoded` at most: each has a queue of whole pictures.
pub const MAX_ENCODED_SUBSCRIBERS: usize = 2;
/// Publishers of a service.
pub const MAX_PUBLISHERS: usize = 1;
/// Publishers of `wheel`: the base's driver, and a place for a second one, so that it is seen and named.
pub const MAX_WHEEL_PUBLISHERS: usize = 2;
/// Processes that can open a service.
pub const MAX_NODES: usize = 24;
/// Processes that can send commands at once.
pub const MAX_COMMANDERS: usize = 8;

/// Landmarks in a map message unless configured otherwise.
pub const DEFAULT_MAX_LANDMARKS: usize = 20_000;
/// Keyframes in a keyframes message unless configured otherwise.
pub const DEFAULT_MAX_KEYFRAMES: usize = 2_000;
/// Bytes of a frame message unless the daemon knows its source's picture size: 640x480.
pub const DEFAULT_MAX_FRAME_BYTES: usize = 640 * 480;
/// Features in a features message: a frame has a few hundred.
pub const MAX_FEATURES: usize = 3_000;
/// Edges in a graph message: five for each of 2,000 keyframes.
pub const MAX_EDGES: usize = 10_000;
/// Map messages a second at most.
pub const MAP_RATE_HZ: f64 = 2.0;

/// Queues of one publish/subscribe service.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Qos {
    /// Messages that a subscriber gets at once when it comes late.
    pub history: usize,
    /// Messages that wait for a subscriber; the oldest gives way.
    pub buffer: usize,
    /// Messages that a subscriber may hold at a time.
    pub borrowed: usize,
    /// Subscribers at a time.
    pub subscribers: usize,
}

impl Qos {
    /// Messages that the publisher keeps memory for: `subscribers * (buffer + borrowed) + history`, and two being written.
    pub const fn messages(&self) -> usize {
        self.subscribers * (self.buffer + self.borrowed) + self.history + PUBLISHER_LOANS
    }
}

/// Messages that a publisher may be writing at a time.
pub const PUBLISHER_LOANS: usize = 2;

/// A second of poses at 30 Hz for a reader that is busy. The history covers the time that a subscriber needs to connect.
pub const POSE: Qos = Qos { history: 4, buffer: 32, borrowed: 4, subscribers: MAX_SUBSCRIBERS };
/// Always the newest.
pub const MAP: Qos = Qos { history: 1, buffer: 1, borrowed: 2, subscribers: MAX_SUBSCRIBERS };
/// Always the newest.
pub const KEYFRAMES: Qos = Qos { history: 1, buffer: 1, borrowed: 2, subscribers: MAX_SUBSCRIBERS };
/// Always the newest. No history: it is made only while somebody subscribes, and comes with each map.
pub const GRAPH: Qos = Qos { history: 0, buffer: 1, borrowed: 2, subscribers: MAX_SUBSCRIBERS };
/// A few, so that no change of state is missed by a reader that is busy.
pub const HEALTH: Qos = Qos { history: 1, buffer: 4, borrowed: 2, subscribers: MAX_SUBSCRIBERS };
/// Always the newest. No history: pictures are sent only while somebody subscribes.
pub const FRAME: Qos = Qos { history: 0, buffer: 1, borrowed: 2, subscribers: MAX_SUBSCRIBERS };
/// A fifth of a second at 30 Hz, so that a recorder that is not run for a moment misses nothing; more would need memory that a small `/dev/shm` has
/// not. No history, as above.
pub const ENCODED: Qos = Qos { history: 0, buffer: 6, borrowed: 2, subscribers: MAX_ENCODED_SUBSCRIBERS };
/// As frames; a few more, so that who reads a picture finds its features.
pub const FEATURES: Qos = Qos { history: 0, buffer: 4, borrowed: 2, subscribers: MAX_SUBSCRIBERS };
/// Always the newest. No history, as frames: a scan of before is none of now.
pub const OBSTACLES: Qos = Qos { history: 0, buffer: 1, borrowed: 2, subscribers: MAX_SUBSCRIBERS };
/// Always the newest. No history, as the graph.
pub const TAGS: Qos = Qos { history: 0, buffer: 1, borrowed: 2, subscribers: MAX_SUBSCRIBERS };
/// What the base's driver sends and the daemon reads: half a second at 100 Hz, while the daemon is busy with a frame. No history: a twist of
/// before is none of now.
pub const WHEEL: Qos = Qos { history: 0, buffer: 64, borrowed: 2, subscribers: MAX_SUBSCRIBERS };
