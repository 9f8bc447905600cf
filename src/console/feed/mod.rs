//! The daemon's services, each subscribed once for all pages.

pub mod graph;
pub mod obstacles;
pub mod pictures;
pub mod robot;
mod source;
pub mod tags;

pub use source::{Source, wait};
