//! What is kept for scans of what stands around the robot ([`scanning`](super::scanning) makes them).

use std::collections::VecDeque;

use super::recorded::Recorded;
use super::types::TrajectoryEvent;
use crate::map::KeyframeId;
use crate::motion::floor::seen::Seen;
use crate::motion::obstacles::Scanner;

/// See module.
#[derive(Debug, Default)]
pub(super) struct Surroundings {
    pub wanted: bool,
    /// Where keyframes saw the floor; newest last.
    pub seen: VecDeque<SeenFrom>,
    pub scanner: Scanner,
    /// Keyframes before this one are of another run: what was free then need not be now.
    pub first: u32,
}

/// What a keyframe saw of the floor, in heights. It outlives the keyframe, which is culled once others show its landmarks: that an obstacle
/// stood there they need not have seen.
#[derive(Debug)]
pub(super) struct SeenFrom {
    pub id: KeyframeId,
    pub place: Recorded,
    pub seen: Seen,
}

impl Surroundings {
    /// Follows what becomes of the keyframes.
    pub fn hear(&mut self, events: &[TrajectoryEvent]) {
        self.seen.iter_mut().for_each(|one| events.iter().for_each(|event| one.place.hear(event)));
    }
}

/// Why there is no scan.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NoScan {
    NoPose,
    NotMetric,
    NoFloor,
}
