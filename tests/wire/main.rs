//! The wire end to end: publisher and client in one process, across processes, and through kills.
//!
//! Every test has an iceoryx2 root and prefix of its own, so that tests disturb neither each other nor a daemon on the same
//! machine, and so that their files can be counted. Other processes are this test binary again, told by the environment to
//! play a role ([`support::Role`]).

mod delivery;
mod killing;
mod latest;
mod other_user;
mod placement;
mod support;
mod watching;
mod wheels;
