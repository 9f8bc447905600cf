//! Cairn: one webcam in, the robot's pose and a sparse map out, in shared memory.
//!
//! # Data flow, one direction
//!
//! ```text
//! camera ──► capture thread ──► frame ring ──► feature thread ──► bounded channel ──► reconstruction thread ──► publish
//! (v4l2 | recording | simulator) (newest wins)  (decode, pyramid,                     (pose now, then keyframe,  (iceoryx2)
//!                                                corners, tracks)                      map, adjustment)
//! ```
//!
//! # Features
//! `client` (wire types and subscriptions, iceoryx2 only) and `daemon` (default: everything).

#[cfg(feature = "client")]
pub mod client;
#[cfg(feature = "client")]
pub mod messages;

#[cfg(feature = "daemon")]
pub mod atomic_file;
#[cfg(feature = "daemon")]
pub mod calibration;
#[cfg(feature = "daemon")]
pub mod camera;
#[cfg(feature = "daemon")]
pub mod cli;
#[cfg(feature = "daemon")]
pub mod config;
#[cfg(feature = "daemon")]
pub mod daemon;
#[cfg(feature = "daemon")]
pub mod evaluation;
#[cfg(feature = "daemon")]
pub mod features;
#[cfg(feature = "daemon")]
pub mod frame;
#[cfg(feature = "daemon")]
pub mod geometry;
#[cfg(feature = "daemon")]
pub mod image;
#[cfg(feature = "daemon")]
pub mod map;
#[cfg(feature = "daemon")]
pub mod plot;
#[cfg(feature = "daemon")]
pub mod publish;
#[cfg(feature = "daemon")]
pub mod reconstruction;
#[cfg(feature = "daemon")]
pub mod ring;
#[cfg(feature = "daemon")]
pub mod telemetry;
#[cfg(feature = "daemon")]
pub mod trajectory;
