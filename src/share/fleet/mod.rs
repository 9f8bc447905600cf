//! Several robots on one Zenoh network: who is there, and how they are. A process of its own, which hears what bridges send and sends nothing.
//!
//! ```text
//! Zenoh (tokens of bridges, /diagnostics; poses, if asked for) ──► Table (no clock, no Zenoh) ──► Listing
//! ```
//!
//! A robot is the liveliness token of its bridge's publisher of `/diagnostics`. Each message there has its publisher's id, which is made of that token, so
//! two robots with one name are told apart, and nobody else's diagnostics are taken for a robot's. Everything comes from strangers: lengths, numbers and
//! texts are bounded, and nothing is shown that is not a word.
//!
//! Does not: command robots, know the daemon. Users' page: `docs/fleet.md`.

mod anchors;
mod listener;
mod listing;
mod path;
mod report;
mod table;

pub use listener::Listener;
pub use listing::{Listing, Place, Presence, Row};
pub use report::Level;
