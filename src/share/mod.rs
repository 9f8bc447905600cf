//! Recordings that every tool opens: a process of its own, which subscribes to the daemon like a planner and writes MCAP. Beside it, another one: the
//! same messages of ROS 2 over Zenoh, and others, which list the robots there and fetch their maps (`bridge`, `fleet`, `maps`; one feature).
//!
//! ```text
//! services ──► Recorder (messages into ROS 2's) ──► bounded queue ──► Sink (file or ring)
//! ```
//!
//! Each half is a plain step or loop; `cli` puts the second into a thread of the daemon's making. Does not: open sockets, follow pixels, know the daemon.
//! Users' page: `docs/recordings.md`.

#[cfg(feature = "bridge")]
pub mod bridge;
mod conversion;
mod copy;
mod error;
mod events;
mod file;
#[cfg(feature = "bridge")]
pub mod fleet;
mod frames;
#[cfg(feature = "bridge")]
pub mod maps;
mod news;
mod picture;
mod recorder;
mod records;
mod ring;
mod room;
mod sink;
mod wire;

pub use error::ShareError;
pub use file::Origin;
pub use picture::compressed;
pub use recorder::{Heard, Recorder};
pub use records::{Converter, Record, Topic};
pub use ring::MAX_KEPT;
pub use sink::{Plan, Queue, Sink, Written, open};
