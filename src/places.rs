//! Places: knowing one again after a long way, correcting the drift, and keeping maps on disk from one day to the next.

pub mod describe;
pub mod index;
pub mod loops;
pub mod spool;
pub mod store;
pub mod way;
