//! How far older keyframes of the present map have been looked for in maps that wait to be joined, and when the next one is
//! ([`merging`](super::merging)).

use crate::map::KeyframeId;

/// Frames between two attempts: in the first rounds, and once nothing comes of them.
pub const ASK_GAP: u64 = 8;
const LONGEST_ASK_GAP: u64 = 256;

/// Which older keyframes were looked for.
#[derive(Debug)]
pub struct Asked {
    /// The round goes on before this one; `None`: it begins.
    pub before: Option<KeyframeId>,
    /// Rounds that are over.
    pub rounds: usize,
    /// Frame before which nothing is asked.
    pub next_attempt: u64,
    pub gap: u64,
}

impl Default for Asked {
    fn default() -> Self {
        Self { before: None, rounds: 0, next_attempt: 0, gap: ASK_GAP }
    }
}

impl Asked {
    /// Each of `of_maps` has been asked by a round.
    pub fn end_round(&mut self, of_maps: usize) {
        self.before = None;
        self.rounds += 1;
        // Each map is asked by the index first and then by all.
        if self.rounds >= 2 * of_maps && self.rounds.is_multiple_of(of_maps) {
            self.gap = (2 * self.gap).min(LONGEST_ASK_GAP);
        }
    }
}
