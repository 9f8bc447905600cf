//! What is kept for scans of what stands around the robot ([`scanning`](super::scanning) makes them).

use std::collections::VecDeque;

use crate::map::KeyframeId;
use crate::motion::floor::seen::Seen;
use crate::motion::obstacles::Scanner;

/// See module.
#[derive(Debug, Default)]
pub(super) struct Surroundings {
    pub wanted: bool,
    /// Where keyframes saw the floor, in heights; newest last.
    pub seen: VecDeque<(KeyframeId, Seen)>,
    pub scanner: Scanner,
    /// Keyframes before this one are of another run: what was free then need not be now.
    pub first: u32,
}

/// Why there is no scan.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NoScan {
    NoPose,
    NotMetric,
    NoFloor,
}
