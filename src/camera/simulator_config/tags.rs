//! `[simulator.tags]`: printed tags on the walls of the room.

use serde::{Deserialize, Serialize};

use super::{SimulatorConfigError, within};

config! {
    /// AprilTags 36h11 of exact size, numbers 1 to 4, one on each wall; number 1 hangs where the chessboard would and gives way to it. Only in the room.
    TagsConfig {
        enabled: bool = false,
        /// Side of their black squares, m, 0.05..=0.3.
        size_m: f64 = 0.16,
    }
}

impl TagsConfig {
    pub(super) fn validate(&self) -> Result<(), SimulatorConfigError> {
        within("tags.size_m", self.size_m, "m", 0.05, 0.3)
    }
}
