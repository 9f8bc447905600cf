//! What holds the map together, as plain values: which keyframes see the same landmarks, and what else ties them.

use std::cmp::Reverse;

use super::{KeyframeId, Map, MapId};

/// Why two keyframes belong together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tie {
    /// They see the same landmarks.
    Covisible,
    /// A loop was closed between them.
    Loop,
    /// The other map, of this number, was joined to the present one by them.
    Join(MapId),
}

/// Two keyframes that belong together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EdgeView {
    /// The older one; of a join, the one of the other map.
    pub from: KeyframeId,
    pub to: KeyframeId,
    /// Landmarks that both see now.
    pub shared: u32,
    pub tie: Tie,
}

/// The graph of the current map; whoever fills it reuses the buffer.
#[derive(Debug, Clone, Default)]
pub struct MapGraph {
    /// What ties the map in the order given, then what is covisible, strongest first (ties: newer first).
    pub edges: Vec<EdgeView>,
    /// Edges that there are, those that were left out among them.
    pub total: usize,
}

impl MapGraph {
    /// Becomes what this map shows of the keyframes from `oldest` on, at most `limit` edges: first `ties` whose keyframes are both among them, then the
    /// strongest covisible ones.
    ///
    /// Cost: 1.5 ms for 2,000 keyframes with 100 neighbours each, of which 10,000 edges are kept.
    pub fn fill(
        &mut self,
        map: &Map,
        ties: impl Iterator<Item = (KeyframeId, KeyframeId, Tie)>,
        oldest: KeyframeId,
        limit: usize,
    ) {
        let edges = &mut self.edges;
        edges.clear();
        let mut left_out = 0;
        for (from, to, tie) in ties {
            let Some(keyframe) = map.keyframe(from).filter(|_| map.keyframe(to).is_some()) else { continue };
            if from.min(to) < oldest {
                left_out += 1;
                continue;
            }
            let shared = keyframe.covisible.binary_search_by_key(&to, |c| c.0).map_or(0, |i| keyframe.covisible[i].1);
            edges.push(EdgeView { from, to, shared, tie });
        }
        let ties = edges.len();
        for (id, keyframe) in map.keyframes.iter() {
            let from = KeyframeId(id);
            // Each is known to both ends; ascending, so the newer ones are the last.
            let newer = keyframe.covisible.iter().rev().take_while(|c| c.0 > from);
            if from < oldest {
                left_out += newer.count();
                continue;
            }
            edges.extend(newer.map(|&(to, shared)| EdgeView { from, to, shared, tie: Tie::Covisible }));
        }
        self.total = edges.len() + left_out;
        let strongest = |e: &EdgeView| (Reverse(e.shared), Reverse(e.to), Reverse(e.from));
        let (_, covisible) = edges.split_at_mut(ties);
        let room = limit.saturating_sub(ties);
        if (1..covisible.len()).contains(&room) {
            covisible.select_nth_unstable_by_key(room - 1, strongest);
        }
        edges.truncate(limit);
        if let Some(covisible) = edges.get_mut(ties..) {
            covisible.sort_unstable_by_key(strongest);
        }
    }
}
