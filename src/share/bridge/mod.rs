//! To ROS 2 without ROS: a process of its own, which subscribes to the daemon like a planner and speaks rmw_zenoh's format over Zenoh.
//!
//! ```text
//! services ──► Bridge (messages into ROS 2's, as recordings have them) ──► Node (Zenoh session) ──► rmw_zenoh's nodes
//! command  ◄── Commands (a thread of `cli`'s making) ◄── bounded queue ◄── Node (services, initial pose)
//! ```
//!
//! What costs the daemon or this process something (pictures, scans) is asked for only while a subscriber of ROS 2's stands in the graph. Names, tokens
//! and attachments are those of rmw_zenoh's design (`names`, `attachment`); Zenoh, its threads and its sockets are of the crate `zenoh`.
//!
//! Does not: follow pixels, know the daemon, invent a position. Users' page: `docs/ros2.md`.

mod anchors;
pub(super) mod attachment;
mod commands;
mod error;
mod inbox;
pub(super) mod names;
mod node;
mod on_demand;
mod rates;
mod relay;
mod scans;
pub(super) mod session;
pub(super) mod topic;

pub(super) use anchors::MOST_ANCHORS;
pub use commands::Commands;
pub use error::BridgeError;
pub(super) use error::reason;
pub use names::Robot;
pub use node::{Network, Node};
pub use rates::{Rate, Rates};
pub use relay::Bridge;
