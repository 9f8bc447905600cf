//! Maps from one robot to another over Zenoh: files, as they are stored.
//!
//! ```text
//! shelf (`cli`) ──► Giver (a thread of the bridge's) ──► Zenoh, piece by piece ──► pull ──► a file, verified by `cli` before it has its name
//! ```
//!
//! A bridge answers queries of the key `@cairn/DOMAIN/SESSION/%ROBOT/maps`, which no pattern with `**` meets, as `@cairn` is a verbatim chunk of Zenoh's.
//! `?map=NAME` is answered with an [`Offer`]; with `version` and `offset` beside it the answer is the piece there. Whoever fetches has one query
//! under way at a time, at Zenoh's lowest priority, so poses go first. Everything that comes is a stranger's: sizes are bounded, the whole has a checksum
//! (against loss and change, not against malice), and the file is verified like any other.
//!
//! Does not: know what a map is, choose folders, ask who somebody is. Users' page: `docs/fleet.md`.

mod giver;
mod offer;
mod pull;

pub use giver::{Giver, Requests, Shelf};
pub use pull::{PullError, Wanted, pull};
