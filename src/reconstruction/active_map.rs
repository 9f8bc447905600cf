//! The map that frames are placed in, with everything that belongs to it alone: what begins anew when the map does.

use super::adjust::job::GLOBAL_FIRST;
use super::consensus::probation::Probation;
use super::odometry::Odometry;
use super::scale_uncertainty::ScaleUncertainty;
use super::track::association::Bindings;
use crate::map::saved::{MapHead, SavedMap};
use crate::map::{KeyframeId, Map, MapId, TurnId};
use crate::motion::scale::ScaleFusion;

pub struct ActiveMap {
    pub map: Map,
    pub id: MapId,
    /// What the tracks of the newest frame stand for.
    pub bindings: Bindings,
    pub odometry: Odometry,
    pub scale: ScaleUncertainty,
    /// What is said of the length of its unit in metres.
    pub fusion: ScaleFusion,
    /// For its first second.
    pub probation: Probation,
    /// The map that was lost when this one began.
    pub beside: Option<MapId>,
    /// Keyframe that shares most with the last frame.
    pub reference: KeyframeId,
    /// Frames tracked in it.
    pub frames: u64,
    pub last_keyframe_frame: u64,
    /// Newest keyframe that no adjustment has seen yet.
    pub unadjusted: Option<KeyframeId>,
    /// Keyframes at which the map is adjusted globally next.
    pub next_global: usize,
    /// How often it was thinned out, as it is too large.
    pub thinned: u32,
    /// Somebody has said where the robot is in it: its frame stays, whatever is joined to it.
    pub is_placed: bool,
    /// Id of the map that begins next.
    pub next_id: MapId,
}

impl Default for ActiveMap {
    fn default() -> Self {
        Self::new(Map::default(), MapId(0))
    }
}

impl ActiveMap {
    pub fn new(map: Map, id: MapId) -> Self {
        Self {
            map,
            id,
            bindings: Bindings::default(),
            odometry: Odometry::default(),
            scale: ScaleUncertainty::default(),
            fusion: ScaleFusion::default(),
            probation: Probation::default(),
            beside: None,
            reference: KeyframeId(0),
            frames: 0,
            last_keyframe_frame: 0,
            unadjusted: None,
            next_global: GLOBAL_FIRST,
            thinned: 0,
            is_placed: false,
            next_id: MapId(id.0 + 1),
        }
    }

    /// One that another run has left.
    pub fn of_another_run(saved: SavedMap) -> Self {
        let SavedMap { head: MapHead { id, reference, frames, scale, turns }, map } = saved;
        let (scale, fusion) = (ScaleUncertainty::restored(&turns, &map), ScaleFusion::of_stored(scale));
        Self { reference, frames, scale, fusion, ..Self::new(map, id) }
    }

    /// What another run has to know of it.
    pub fn head(&self) -> MapHead {
        let Self { id, reference, frames, scale, fusion, .. } = self;
        MapHead { id: *id, reference: *reference, frames: *frames, scale: fusion.scale(), turns: scale.saved() }
    }

    /// The last turn that the scale of the frame tracked last came through.
    pub fn part(&self) -> Option<TurnId> {
        self.map.keyframe(self.reference)?.scale_from
    }

    /// An empty one whose ids go on after this one's.
    pub fn successor(&self) -> Self {
        // A map that has become metric has taken the number after its own.
        Self::new(self.map.successor(), MapId(self.next_id.0.max(self.id.0 + 1)))
    }

    /// Empty again, as before a start that did not hold.
    pub fn clear(&mut self) {
        self.map.clear();
        self.bindings.clear();
        self.odometry = Odometry::default();
        self.probation.end();
    }
}
