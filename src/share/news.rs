//! What need not be told twice.

use crate::messages::{Health, KeyframesHeader, MapHeader};

/// Diagnostics that say the same are told once in so many ns.
const DIAGNOSTICS_EVERY_NS: i64 = 1_000_000_000;

/// Health as diagnostics: told when something else is to be said, and once a second.
#[derive(Debug, Clone, Copy, Default)]
pub struct Diagnosed {
    /// Faults, state and time of the last.
    last: Option<(u64, u8, i64)>,
}

impl Diagnosed {
    pub fn is_news(&mut self, health: &Health) -> bool {
        let said = self.last.is_some_and(|(errors, state, at_ns)| {
            (errors, state) == (health.errors, health.state) && health.published_ns - at_ns < DIAGNOSTICS_EVERY_NS
        });
        if !said {
            self.last = Some((health.errors, health.state, health.published_ns));
        }
        !said
    }
}

/// What a map, or keyframes, hold.
pub type Content = (u64, u64, u32, u32);

pub fn content_of_map(header: &MapHeader) -> Content {
    (header.run_id, header.content_revision, header.map_revision, header.reset_counter)
}

pub fn content_of_keyframes(header: &KeyframesHeader) -> Content {
    (header.run_id, header.content_revision, header.map_revision, header.reset_counter)
}

/// The content that was told last.
#[derive(Debug, Clone, Copy, Default)]
pub struct Told(Option<Content>);

impl Told {
    pub fn is_news(&mut self, content: Content) -> bool {
        self.0.replace(content) != Some(content)
    }
}
