//! `[simulator.another_day]`: the same place at another time, for what has to know it again.

use serde::{Deserialize, Serialize};

use super::{SimulatorConfigError, within};

config! {
    /// Room, corridor and rooms in a row as `simulator.seed` has them, but for what has changed since: some furniture stands elsewhere, and
    /// the light is another. The camera's way is the same.
    AnotherDayConfig {
        enabled: bool = false,
        /// Seed of what has changed, 0..=2^63-1.
        seed: u64 = 1,
        /// Share of the furniture, of what lies on it and of the pictures on the walls that has been moved (each by chance), 0..=1. Things and
        /// pictures that were moved are others, too.
        moved_share: f64 = 0.33,
        /// Other lamps are on, and more or less light comes from where the window is.
        other_light: bool = true,
    }
}

impl AnotherDayConfig {
    pub(super) fn validate(&self) -> Result<(), SimulatorConfigError> {
        within("another_day.seed", self.seed as f64, "", 0.0, i64::MAX as f64)?;
        within("another_day.moved_share", self.moved_share, "", 0.0, 1.0)
    }
}
