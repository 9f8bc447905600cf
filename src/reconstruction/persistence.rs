//! Maps beyond this run: what has changed in them, and going on in what another run left.
//!
//! A map of another run is what a lost map is: frames are looked for in it as they are after a loss ([`relocalise`](super::relocalise)),
//! but more of it must be found until one is located, the state is LOST until one is located, and unless the map is to stay as it is a second one begins beside it after as many
//! frames as always, to be joined to it once it is recognised. Of several maps the first is looked in at once, the others once that has been in vain for so long
//! ([`taking_up`](super::relocalise::taking_up)).
//!
//! The index over places is made anew with the frames that follow, some keyframes at each.
//!
//! Cost: [`take_changes`](Reconstruction::take_changes) copies what has changed, 20 kB a keyframe (pictures are shared), so after an
//! adjustment of a whole map of 240 keyframes 5 MB. It is called after a published pose.

use super::Reconstruction;
use super::active_map::ActiveMap;
use super::keyframe::SAME_CORNER_PX;
use super::relocalise::other_maps::OtherMap;
use super::track::association::Target;
use super::types::TrackingState;
use crate::features::FrameFeatures;
use crate::map::MapId;
use crate::map::saved::{Ids, MapChanges, SavedMap, SavedMaps, Taken};

impl Reconstruction {
    /// What has changed in all maps since the last call; `everything`, and the first time, all there is.
    pub fn take_changes(&mut self, everything: bool) -> MapChanges {
        let optics = self.optics.saved();
        let taken = Taken { maps: self.own_maps(), camera: optics.camera.clone() };
        // Of a map that has gone the changes are not known, and with another camera what follows from it is another.
        let is_known =
            |before: &Taken| before.camera == taken.camera && before.maps.iter().all(|id| taken.maps.contains(id));
        let is_everything = everything || !self.taken.as_ref().is_some_and(is_known);
        self.taken = Some(taken);
        let others = self.others.kept.iter_mut().filter(|other| !other.is_merged).map(|other| &mut other.own);
        let maps = std::iter::once(&mut self.active).chain(others).map(|own| (own.head(), &mut own.map)).collect();
        MapChanges::take(optics, self.frame_ns, maps, is_everything)
    }

    /// Those that a file of this run is about: what is to be merged becomes a part of one when it is joined.
    fn own_maps(&self) -> Vec<MapId> {
        let others = self.others.kept.iter().filter(|other| !other.is_merged).map(|other| other.own.id);
        std::iter::once(self.active.id).chain(others).collect()
    }

    /// Whether keyframes or landmarks have been added, changed or removed since changes were taken last.
    pub fn has_changes(&self) -> bool {
        let others = self.others.kept.iter().filter(|other| !other.is_merged).map(|other| &other.own.map);
        self.taken.is_none() || std::iter::once(&self.active.map).chain(others).any(crate::map::Map::has_changed)
    }

    /// Goes on in the maps of another run; to be called before the first frame. Of several maps the first is the one that frames are looked for in
    /// first. `localise_only`: the maps stay as they are.
    pub fn resume(&mut self, saved: SavedMaps, localise_only: bool) {
        self.optics.resume(&saved.optics);
        // Keyframes of maps that were joined to others have their own map's number still.
        let made_in = |m: &SavedMap| m.map.keyframes.iter().map(|(_, k)| k.map.0).max();
        let newest_id = saved.maps.iter().flat_map(|m| std::iter::once(m.head.id.0).chain(made_in(m))).max();
        // A file with the very last number is refused when it is read.
        let next_id = newest_id.and_then(|id| id.checked_add(1)).unwrap_or_default();
        let mut maps = saved.maps.into_iter();
        let Some(first) = maps.next() else { return };
        self.localise_only = localise_only;
        let next_global = self.optics.intrinsics.next_global(first.map.keyframes.len());
        self.active = ActiveMap { next_global, next_id: MapId(next_id), ..ActiveMap::of_another_run(first) };
        self.surroundings.first = self.active.map.keyframes.next_id();
        // It speaks for nothing that a frame is near: landmarks must.
        self.active.odometry.lost_frames = 1;
        self.state = TrackingState::Lost;
        for saved in maps {
            // All of them were kept before.
            self.others.keep(OtherMap::new(ActiveMap::of_another_run(saved)), usize::MAX);
        }
        self.loops.expect(&self.active.map, &self.others);
        self.taken = Some(Taken { maps: self.own_maps(), camera: self.optics.camera.clone() });
    }

    /// Leaves all maps of this run, as a reset does, and goes on in those of another one. None of their ids may be one that this run
    /// has given ([`given_ids`](Self::given_ids)).
    pub fn exchange(&mut self, saved: SavedMaps, localise_only: bool) {
        // All of them, also those that were only located in.
        self.localise_only = false;
        self.reset();
        self.resume(saved, localise_only);
        // Whoever keeps them knows them by other ids.
        self.taken = None;
    }

    /// The next ids.
    pub fn given_ids(&self) -> Ids {
        let maps = std::iter::once(&self.active.map).chain(self.others.maps());
        let next = maps.map(|map| (map.keyframes.next_id(), map.landmarks.next_id()));
        let (keyframes, landmarks) = next.fold((0, 0), |a, b| (a.0.max(b.0), a.1.max(b.1)));
        Ids { maps: self.active.next_id.0.max(self.active.id.0.saturating_add(1)), keyframes, landmarks }
    }

    /// From now on the map stays as it is, or grows again. The error: there is none to be located in.
    pub fn set_localise_only(&mut self, on: bool) -> Result<(), &'static str> {
        if on && (self.state == TrackingState::Initializing || self.active.map.keyframes.is_empty()) {
            return Err("there is no map yet to be located in");
        }
        if on != self.localise_only {
            self.discard_job();
            self.pending = Default::default();
            self.initialiser.clear();
            self.end_checks();
            self.localise_only = on;
        }
        Ok(())
    }

    /// Keyframes in all maps.
    pub fn total_keyframes(&self) -> usize {
        let maps = std::iter::once(&self.active.map).chain(self.others.maps());
        maps.map(|map| map.keyframes.len()).sum()
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
