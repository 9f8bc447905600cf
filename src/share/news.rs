//! What need not be told twice.

use crate::messages::{GraphHeader, Health, KeyframesHeader, MapHeader, Tags};

/// Diagnostics that say the same are told once in so many s.
pub const DIAGNOSTICS_EVERY_S: f64 = 1.0;
const DIAGNOSTICS_EVERY_NS: i64 = (1e9 * DIAGNOSTICS_EVERY_S) as i64;

/// Health as diagnostics: told when something else is to be said, and once a second.
#[derive(Debug, Clone, Copy, Default)]
pub struct Diagnosed {
    /// Faults, state and time of the last.
    last: Option<(u64, u8, i64)>,
}

/// What health has to say.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum News {
    /// Another state or other faults than before: whoever holds messages back does not hold this one.
    Changed,
    /// The same again.
    Again,
}

impl Diagnosed {
    pub fn news(&mut self, health: &Health) -> Option<News> {
        let news = match self.last {
            Some((errors, state, at_ns)) if (errors, state) == (health.errors, health.state) => {
                (health.published_ns - at_ns >= DIAGNOSTICS_EVERY_NS).then_some(News::Again)
            }
            _ => Some(News::Changed),
        };
        if news.is_some() {
            self.last = Some((health.errors, health.state, health.published_ns));
        }
        news
    }
}

/// What a map, or what is told with it, holds.
pub type Content = (u64, u64, u32, u32);

pub fn content_of_map(header: &MapHeader) -> Content {
    (header.run_id, header.content_revision, header.map_revision, header.reset_counter)
}

pub fn content_of_keyframes(header: &KeyframesHeader) -> Content {
    (header.run_id, header.content_revision, header.map_revision, header.reset_counter)
}

pub fn content_of_graph(header: &GraphHeader) -> Content {
    (header.run_id, header.content_revision, header.map_revision, header.reset_counter)
}

pub fn content_of_tags(tags: &Tags) -> Content {
    (tags.run_id, tags.content_revision, tags.map_revision, tags.reset_counter)
}

/// The content that was told last.
#[derive(Debug, Clone, Copy, Default)]
pub struct Told(Option<Content>);

impl Told {
    pub fn is_news(&mut self, content: Content) -> bool {
        self.0.replace(content) != Some(content)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_state_or_fault_is_told_at_once_and_the_same_once_a_second() {
        let mut diagnosed = Diagnosed::default();
        let mut at = |ms: i64, state, errors| {
            diagnosed.news(&Health { published_ns: ms * 1_000_000, state, errors, ..Health::default() })
        };
        let told =
            [at(0, 1, 0), at(100, 1, 0), at(200, 1, 4), at(300, 2, 4), at(400, 2, 4), at(1300, 2, 4), at(1400, 2, 0)];
        let (changed, again) = (Some(News::Changed), Some(News::Again));
        assert_eq!(told, [changed, None, changed, changed, None, again, changed]);
    }
}
