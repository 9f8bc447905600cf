//! Maps beyond this run: what has changed in them, and going on in what another run left.
//!
//! A map of another run is what a lost map is: frames are looked for in it as they are after a loss ([`relocalise`](super::relocalise)),
//! the state is LOST until one is located, and unless the map is to stay as it is a second one begins beside it after as many
//! frames as always, to be joined to it once it is recognised.
//!
//! Cost: [`take_changes`](Reconstruction::take_changes) copies what has changed, 20 kB a keyframe (pictures are shared), so after an
//! adjustment of a whole map of 240 keyframes 5 MB. It is called after a published pose.

use super::Reconstruction;
use super::active_map::ActiveMap;
use super::keyframe::SAME_CORNER_PX;
use super::relocalise::other_maps::OtherMap;
use super::scale_uncertainty::ScaleUncertainty;
use super::track::association::Target;
use super::types::TrackingState;
use crate::features::FrameFeatures;
use crate::map::MapId;
use crate::map::saved::{MapChanges, MapHead, SavedMap, SavedMaps, Taken};
use crate::map::scale::MapScale;
use crate::motion::scale::ScaleFusion;

impl Reconstruction {
    /// What has changed in all maps since the last call; `everything`, and the first time, all there is.
    pub fn take_changes(&mut self, everything: bool) -> MapChanges {
        let optics = self.optics.saved();
        let ids = std::iter::once(self.active.id).chain(self.others.kept.iter().map(|other| other.id)).collect();
        let taken = Taken { maps: ids, camera: optics.camera.clone() };
        // Of a map that has gone the changes are not known, and with another camera what follows from it is another.
        let is_known =
            |before: &Taken| before.camera == taken.camera && before.maps.iter().all(|id| taken.maps.contains(id));
        let is_everything = everything || !self.taken.as_ref().is_some_and(is_known);
        self.taken = Some(taken);
        let ActiveMap { map, id, reference, frames, scale, fusion, .. } = &mut self.active;
        let (told, turns) = (fusion.scale(), scale.saved());
        let head = MapHead { id: *id, reference: *reference, frames: *frames, scale: told, turns };
        let others = self.others.kept.iter_mut().map(|other| {
            let OtherMap { map, id, reference, scale, fusion, frames, .. } = other;
            let (told, turns) = (fusion.scale(), scale.saved());
            (MapHead { id: *id, reference: *reference, frames: *frames, scale: told, turns }, map)
        });
        let maps = std::iter::once((head, map)).chain(others).collect();
        MapChanges::take(optics, self.frame_ns, maps, is_everything)
    }

    /// Goes on in the maps of another run; to be called before the first frame. Of several maps the first is the one that frames are looked for in
    /// first. `localise_only`: the maps stay as they are.
    pub fn resume(&mut self, saved: SavedMaps, localise_only: bool) {
        self.optics.resume(&saved.optics);
        let next_id = saved.maps.iter().map(|m| m.head.id.0 + 1).max().unwrap_or_default();
        let mut maps = saved.maps.into_iter();
        let Some(SavedMap { head, map }) = maps.next() else { return };
        self.localise_only = localise_only;
        let next_whole = self.optics.intrinsics.next_whole(map.keyframes.len());
        self.active = ActiveMap {
            reference: head.reference,
            frames: head.frames,
            scale: ScaleUncertainty::restored(&head.turns),
            fusion: restored(head.scale),
            next_whole,
            next_id: MapId(next_id),
            ..ActiveMap::new(map, head.id)
        };
        // It speaks for nothing that a frame is near: landmarks must.
        self.active.odometry.lost_frames = 1;
        self.state = TrackingState::Lost;
        for SavedMap { head, map } in maps {
            let MapHead { id, reference, frames, scale: told, turns } = head;
            let (scale, fusion) = (ScaleUncertainty::restored(&turns), restored(told));
            let other = OtherMap { map, id, reference, scale, fusion, frames, sightings: Vec::new() };
            // All of them were kept before.
            self.others.keep(other, usize::MAX);
        }
        let ids = std::iter::once(self.active.id).chain(self.others.kept.iter().map(|other| other.id)).collect();
        self.taken = Some(Taken { maps: ids, camera: self.optics.camera.clone() });
    }

    /// Without keyframes nothing else says what new tracks stand for: what they were found at.
    pub(super) fn bind_found(&mut self, features: &FrameFeatures) {
        if self.state != TrackingState::Tracking {
            return;
        }
        let bindings = &mut self.active.bindings;
        for track in features.tracks.iter().filter(|t| bindings.get(t.id).is_none()).collect::<Vec<_>>() {
            let near = self.tracker.matches().iter().find(|m| (m.pixel - track.position).norm() < SAME_CORNER_PX);
            if let Some(m) = near {
                bindings.set(track.id, Target::Landmark(m.landmark));
            }
        }
    }
}

/// What is known of the scale of a map that was stored with this.
fn restored(scale: MapScale) -> ScaleFusion {
    match scale {
        MapScale::Unknown => ScaleFusion::default(),
        MapScale::Metric { sigma, sources } => ScaleFusion::restored(sigma, sources),
    }
}
