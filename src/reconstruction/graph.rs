//! What holds the present map together, for whoever shows it.

use super::Reconstruction;
use super::relocalise::other_maps::Join;
use crate::map::graph::{MapGraph, Tie};

impl Reconstruction {
    /// Fills `out` with what ties the current map: joins, closed loops, and the strongest of what is covisible, `limit` edges at the most.
    pub fn graph(&self, out: &mut MapGraph, limit: usize) {
        let joins = self.others.joins.iter().map(|&Join { map, from, to }| (from, to, Tie::Join(map)));
        let loops = self.closed_loops().map(|(old, recognised)| (old, recognised, Tie::Loop));
        out.fill(&self.active.map, joins.chain(loops), limit);
    }
}
