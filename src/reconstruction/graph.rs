//! What holds the present map together and which tags hang in it, for whoever shows it.

use super::Reconstruction;
use crate::map::KeyframeId;
use crate::map::graph::{MapGraph, Tie};
use crate::motion::tag::edge_length::PlacedTag;
use crate::motion::tag::{Optics, TagView};

impl Reconstruction {
    /// Fills `out` with what ties the current map's keyframes from `oldest` on: joins, closed loops, and the strongest of what is covisible, `limit` edges
    /// at the most.
    pub fn graph(&self, out: &mut MapGraph, oldest: KeyframeId, limit: usize) {
        let joins = self.others.joins.iter().copied();
        let loops = self.closed_loops().map(|(old, recognised)| (old, recognised, Tie::Loop));
        out.fill(&self.active.map, joins.chain(loops), oldest, limit);
    }

    /// Fills `out` with the tags that keyframes of the current map have seen, where they are by the keyframes of now.
    ///
    /// Cost: 0.2 to 0.3 ms a tag.
    pub fn tags(&self, out: &mut Vec<TagView>) {
        out.clear();
        if let Some(tags) = &self.tags {
            tags.tell(&self.active.map, &self.tag_optics(), out);
        }
    }

    /// The same of one tag; `None` where it was not seen, or from too few directions.
    pub fn tag(&self, id: u16) -> Option<PlacedTag> {
        self.tags.as_ref()?.placed_now(id, &self.active.map, &self.tag_optics())
    }

    fn tag_optics(&self) -> Optics<'_> {
        Optics { camera: &self.optics.camera, readout_s: self.optics.shutter.readout_s }
    }

    /// Whoever publishes the map does so in another frame from now on, which moves the newest pose so: a correction of the map to who reads it.
    pub fn note_moved_frame(&mut self, distance: f64, angle_rad: f64) {
        self.corrections.moved_by(distance, angle_rad);
    }
}
