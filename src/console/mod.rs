//! The console: a web page that shows what the robot sees. A process of its own, a subscriber like any planner; the daemon knows nothing of it.
//!
//! ```text
//! daemon ──► shared memory ──► feeds (one subscription each) ──► hub ──► a page's outbox (newest wins) ──► its WebSocket
//!                                                                  ▲                                              │
//!                         commands, two-picture chain, calibration, journal (one at a time each) ◄── orders ◄─────┘
//! ```
//!
//! - [`guard`] decides who may speak: names of this host, the page's own origin, and a token unless only this machine can connect.
//! - `http` answers with what is embedded ([`assets`]); all that the robot tells goes through the WebSocket (`session`).
//! - `feed` subscribes once however many pages there are: to poses and health always, to pictures, features and map only while a page
//!   that is looked at shows them, so that without one the daemon copies no picture. A picture is encoded once for all.
//! - A page that is slow gets fewer pictures: an `outbox` keeps the newest message of a kind, and at most `outbox::IN_FLIGHT` pictures are under
//!   way to a page that has not said that it has drawn them.
//! - Who has not said who he is waits at a `door`, whose limits keep nobody else out.
//! - Everything is bounded: connections, pages, sizes and times of requests, messages of a page a second, and what waits for it.
//!
//! Threads, because 32 pages are few: one a connection and one more a page. The bytes of the WebSocket are described in `docs/console.md`.
//! Does not: know the daemon's rooms or configuration, or keep anything on disk but the two pictures of `pair`, until it ends.

pub mod assets;
pub mod calibration;
mod commands;
mod door;
mod error;
mod feed;
pub mod guard;
mod history;
mod http;
mod hub;
mod jobs;
mod journal;
mod outbox;
mod pair;
mod picture;
mod server;
mod session;
mod wire;

pub use error::ConsoleError;
pub use guard::{Access, Token};
pub use server::{Console, LogChoice, Options};
