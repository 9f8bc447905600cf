//! The dock: the tag by whose place the frame of the published map is.
//!
//! At keyframes and after corrections of a metric map: the dock's place by the keyframes of now -> the motion under which it is published where
//! `[tag.dock]` says ([`Outlet::put`]). Reconstruction's own coordinates stay as they are, and so do odom, odometry and files. The frame moves
//! when the dock is placed at first, when the map was corrected, when the dock's orientation is twice as sure as when it moved last, or where the dock has moved by
//! two sigmas; each is a correction of the map to whoever reads it, with another `map_revision`.

use tracing::{info, warn};

use super::outlet::Outlet;
use crate::geometry::Se3;
use crate::geometry::frames::{Body, World};
use crate::map::MapId;
use crate::motion::tag::TagConfig;
use crate::motion::tag::edge_length::PlacedTag;
use crate::publish::convert::Map;
use crate::reconstruction::{PoseEstimate, Reconstruction};

/// Nothing is said before the dock's orientation is known to this, rad (2 degrees): at 5 m from it 0.17 m.
const MOST_TURN_SIGMA: f64 = 0.035;
/// A place that has moved by more sigmas, and an orientation whose sigma is less than this share of what it was, moves the frame again.
const MOVED_SIGMAS: f64 = 2.0;
const SURER: f64 = 0.5;

/// See module.
#[derive(Debug)]
pub struct Dock {
    id: u16,
    map_from_dock: Se3<Map, Body>,
    put: Option<Put>,
    /// It was said that localisation only looks for none.
    told: bool,
}

/// When the frame was moved last.
#[derive(Debug, Clone, Copy)]
struct Put {
    map: MapId,
    revision: u32,
    turn_sigma: f64,
}

impl Dock {
    /// `None`: the configuration names none.
    pub fn new(config: &TagConfig) -> Option<Self> {
        let dock = &config.dock;
        dock.enabled.then(|| Self {
            id: dock.id,
            map_from_dock: dock.map_from_dock().relabel(),
            put: None,
            told: false,
        })
    }

    /// This map is published in the dock's frame.
    pub fn holds(&self, map: MapId) -> bool {
        self.put.is_some_and(|put| put.map == map)
    }

    /// After a frame was tracked and mapped: moves the published map, if that is due.
    pub fn follow(
        &mut self,
        reconstruction: &mut Reconstruction,
        localise_only: bool,
        outlet: &mut Outlet,
        e: &PoseEstimate,
    ) {
        // Tags are read in new keyframes, and there are none.
        if localise_only && !self.holds(reconstruction.map_id()) && !std::mem::replace(&mut self.told, true) {
            warn!(tag = self.id, "dock not looked for in localisation only");
        }
        let (map, revision) = (reconstruction.map_id(), reconstruction.corrections().revision);
        let is_corrected = self.put.is_some_and(|put| put.map != map || put.revision != revision);
        if !(e.keyframe || is_corrected) || !reconstruction.scale().is_metric() {
            return;
        }
        let Some(placed) = reconstruction.tag(self.id).filter(|placed| placed.turn_sigma <= MOST_TURN_SIGMA) else {
            return;
        };
        let was = outlet.map_from_tag(map, &placed);
        if !self.is_due(&placed, &was, map, revision) {
            return;
        }
        let (distance, angle_rad) = outlet.put(map, &was, &self.map_from_dock);
        reconstruction.note_moved_frame(distance, angle_rad);
        let revision = reconstruction.corrections().revision;
        self.put = Some(Put { map, revision, turn_sigma: placed.turn_sigma });
        let map_from_file = in_words(&outlet.map_from_optical(map));
        let (sequence, timestamp_ns, map, tag) = (e.sequence, e.timestamp_ns, map.0, self.id);
        let (sigma_m, sigma_rad) = (placed.place_sigma, placed.turn_sigma);
        info!(
            sequence,
            timestamp_ns, map, tag, distance, angle_rad, sigma_m, sigma_rad, map_from_file, "map put by the dock"
        );
    }

    fn is_due(&self, placed: &PlacedTag, was: &Se3<Map, Body>, map: MapId, revision: u32) -> bool {
        let Some(put) = self.put.filter(|put| put.map == map) else { return true };
        let off: Se3<Body, Body> = self.map_from_dock.inverse() * *was;
        put.revision != revision
            || placed.turn_sigma < SURER * put.turn_sigma
            || off.translation.norm() > MOVED_SIGMAS * placed.place_sigma
            || off.rotation.angle() > MOVED_SIGMAS * placed.turn_sigma
    }
}

/// `tx ty tz qx qy qz qw`, as in a trajectory.
fn in_words(map_from_file: &Se3<Map, World>) -> String {
    let (t, q) = (&map_from_file.translation, &map_from_file.rotation.coords);
    format!("{:.4} {:.4} {:.4} {:.5} {:.5} {:.5} {:.5}", t.x, t.y, t.z, q.x, q.y, q.z, q.w)
}
