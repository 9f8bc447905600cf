//! What a map is beyond this run: all that another one needs to go on in it, as plain values.
//!
//! In: [`MapChanges`], what reconstruction tells of its maps since it was asked last, made after a published pose. Out: [`SavedMaps`],
//! what a file gave back. Whoever keeps the file stands between the two; nothing here reads or writes one.
//!
//! What follows from the rest is not kept: who observes a landmark, covisibility, coarser levels of pictures, thumbnails.
//! [`Map::restored`] makes it anew, and refuses what does not fit together.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Vector3;

use super::scale::MapScale;
use super::store::PAGE;
use super::{Keyframe, KeyframeId, Landmark, LandmarkId, Map, MapId, TurnId, change_covisibility};
use crate::geometry::CameraModel;

/// A turn on the spot that the scale of what follows came through.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SavedTurn {
    /// Keyframe at its place, and where that was when it was last seen in the map.
    pub keyframe: KeyframeId,
    pub centre: Vector3<f64>,
    /// Of the scale behind it, as a share of it squared.
    pub variance: f64,
    /// The turn that the scale before it came through.
    pub before: Option<TurnId>,
}

/// What is known of the lens and the shutter.
#[derive(Debug, Clone, PartialEq)]
pub struct SavedOptics {
    /// As it was calibrated (or guessed): what reconstruction began with.
    pub calibration: CameraModel,
    /// Nobody has calibrated it.
    pub is_guessed: bool,
    /// As it is believed now: every observation of the maps is undistorted by it.
    pub camera: CameraModel,
    /// Around which, and how uncertainly (log focal length, principal point in px, distortion), before and with what the map says.
    pub expected: CameraModel,
    pub sigma: [f64; 7],
    pub refined_sigma: [f64; 7],
    pub begun_with_px: f64,
    pub restarts: u32,
    /// Log focal length and its variance, whenever that had shrunk.
    pub found_before: Vec<(f64, f64)>,
    pub unsettled: f64,
    /// Rolling shutter, s, and one over its variance, 1/s^2.
    pub readout_s: f64,
    pub readout_information: f64,
}

/// One map without its keyframes and landmarks.
#[derive(Debug, Clone, PartialEq)]
pub struct MapHead {
    pub id: MapId,
    /// Where it was tracked last.
    pub reference: KeyframeId,
    /// Frames tracked in it.
    pub frames: u64,
    pub scale: MapScale,
    pub turns: Vec<SavedTurn>,
}

/// One map as a file gave it back.
pub struct SavedMap {
    pub head: MapHead,
    pub map: Map,
}

/// All maps of a file; the largest first.
pub struct SavedMaps {
    /// Timestamp of the newest frame when they were written.
    pub frame_ns: i64,
    pub optics: SavedOptics,
    pub maps: Vec<SavedMap>,
}

/// Ids that a run has given so far: the next of each kind.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Ids {
    pub maps: u32,
    pub keyframes: u32,
    pub landmarks: u32,
}

/// What has changed since the last ones were taken.
pub struct MapChanges {
    /// Timestamp of the newest frame; `i64::MIN` before the first.
    pub frame_ns: i64,
    pub optics: SavedOptics,
    /// All maps there are, the one that is tracked in first, with all of their keyframes, ascending.
    pub maps: Vec<(MapHead, Vec<u32>)>,
    /// The next ids.
    pub next_keyframe: u32,
    pub next_landmark: u32,
    /// Keyframes that were added or changed.
    pub keyframes: Vec<(u32, Keyframe)>,
    /// Pages of landmarks ([`PAGE`] ids each, by number) of which some were added, changed or removed: all that
    /// is left of them.
    pub landmarks: BTreeMap<u32, Vec<(u32, Landmark)>>,
    /// This is all there is: what was written and is not in here is gone.
    pub is_everything: bool,
}

/// Maps and camera of the changes that were taken last.
#[derive(Debug, Clone, PartialEq)]
pub struct Taken {
    pub maps: Vec<MapId>,
    pub camera: CameraModel,
}

impl MapChanges {
    /// What has changed in maps, the one that is tracked in first, since this was called last; all there is with `is_everything`.
    pub fn take(optics: SavedOptics, frame_ns: i64, mut maps: Vec<(MapHead, &mut Map)>, is_everything: bool) -> Self {
        let (mut next_keyframe, mut next_landmark) = (0, 0);
        let (mut keyframes, mut pages) = (Vec::new(), BTreeSet::new());
        let page = |id: u32| id / PAGE as u32;
        for (_, map) in &mut maps {
            next_keyframe = next_keyframe.max(map.keyframes.next_id());
            next_landmark = next_landmark.max(map.landmarks.next_id());
            let (changed, moved) = map.take_changed();
            if is_everything {
                keyframes.extend(map.keyframes.iter().map(|(id, k)| (id, k.clone())));
                pages.extend(map.landmarks.iter().map(|(id, _)| page(id)));
            } else {
                keyframes.extend(changed.iter().filter_map(|id| Some((*id, map.keyframes.get(*id)?.clone()))));
                pages.extend(moved.into_iter().map(page));
            }
        }
        // A page may hold landmarks of several maps.
        let landmark = |id| Some((id, maps.iter().find_map(|(_, map)| map.landmarks.get(id))?.clone()));
        let ids = |page: u32| page * PAGE as u32..(page + 1) * PAGE as u32;
        let landmarks = pages.into_iter().map(|page| (page, ids(page).filter_map(landmark).collect())).collect();
        let heads = maps.into_iter().filter(|(_, map)| !map.keyframes.is_empty());
        let maps = heads.map(|(head, map)| (head, map.keyframes.ids().collect())).collect();
        Self { frame_ns, optics, maps, next_keyframe, next_landmark, keyframes, landmarks, is_everything }
    }
}

/// Ids of a kind, and what each is called anew.
struct Renumbered {
    /// Ascending.
    before: Vec<u32>,
    /// Stands for all that is gone; the first of those that are there follows.
    gone: u32,
}

impl Renumbered {
    /// `None`: so many ids do not follow.
    fn new(mut before: Vec<u32>, gone: u32) -> Option<Self> {
        before.sort_unstable();
        before.dedup();
        u32::try_from(before.len()).ok()?.checked_add(gone)?.checked_add(1)?;
        Some(Self { before, gone })
    }

    fn of(&self, id: u32) -> u32 {
        self.before.binary_search(&id).map_or(self.gone, |rank| self.gone + 1 + rank as u32)
    }

    fn next(&self) -> u32 {
        self.gone + 1 + self.before.len() as u32
    }
}

/// How all ids of maps change.
struct Renumbering {
    maps: Renumbered,
    keyframes: Renumbered,
    landmarks: Renumbered,
}

impl SavedMaps {
    /// The same maps with ids from these on, without holes, for a run that has given the smaller ones to maps of its own. (Without holes, as
    /// otherwise two maps that are gone on in by turns would have used up all ids before long: each time the one's would go on above the other's.)
    pub fn renumbered(self, from: Ids) -> Result<Self, String> {
        let maps = self.maps.iter().flat_map(|m| {
            // Keyframes of maps that were joined to others have their own map's number still.
            std::iter::once(m.head.id.0).chain(m.map.keyframes.iter().map(|(_, k)| k.map.0))
        });
        let keyframes = self.maps.iter().flat_map(|m| m.map.keyframes.iter()).map(|(id, _)| id);
        let landmarks = self.maps.iter().flat_map(|m| m.map.landmarks.iter()).map(|(id, _)| id);
        let all = (
            Renumbered::new(maps.collect(), from.maps),
            Renumbered::new(keyframes.collect(), from.keyframes),
            Renumbered::new(landmarks.collect(), from.landmarks),
        );
        let (Some(maps), Some(keyframes), Some(landmarks)) = all else { return Err("its ids are used up".into()) };
        let new = Renumbering { maps, keyframes, landmarks };
        let maps = self.maps.into_iter().map(|saved| saved.renumbered(&new)).collect::<Result<_, _>>()?;
        Ok(Self { maps, ..self })
    }

    /// The smallest ids there are; `None`: there is no map.
    pub fn first_ids(&self) -> Option<Ids> {
        let keyframes = self.maps.iter().filter_map(|m| m.map.keyframes.iter().next()).map(|(id, _)| id).min();
        let landmarks = self.maps.iter().filter_map(|m| m.map.landmarks.iter().next()).map(|(id, _)| id).min();
        let maps = self.maps.iter().map(|m| m.head.id.0).min()?;
        Some(Ids { maps, keyframes: keyframes.unwrap_or(u32::MAX), landmarks: landmarks.unwrap_or(u32::MAX) })
    }

    /// The next keyframe's and the next landmark's id, the larger of both.
    pub fn next_id(&self) -> u32 {
        let next = |m: &SavedMap| m.map.keyframes.next_id().max(m.map.landmarks.next_id());
        self.maps.iter().map(next).max().unwrap_or(0)
    }
}

impl SavedMap {
    fn renumbered(self, new: &Renumbering) -> Result<Self, String> {
        let Self { mut head, mut map } = self;
        let keyframe = |id: KeyframeId| KeyframeId(new.keyframes.of(id.0));
        head.id = MapId(new.maps.of(head.id.0));
        head.reference = keyframe(head.reference);
        for turn in &mut head.turns {
            turn.keyframe = keyframe(turn.keyframe);
        }
        let ids: Vec<u32> = map.keyframes.iter().map(|(id, _)| id).collect();
        let mut keyframes = Vec::with_capacity(ids.len());
        for id in ids {
            let Some(mut k) = map.keyframes.remove(id) else { continue };
            k.map = MapId(new.maps.of(k.map.0));
            k.observations.rename_all(|landmark| LandmarkId(new.landmarks.of(landmark.0)));
            k.picture.rename_all(|landmark| new.landmarks.of(landmark));
            keyframes.push((new.keyframes.of(id), k));
        }
        let ids: Vec<u32> = map.landmarks.iter().map(|(id, _)| id).collect();
        let mut landmarks = Vec::with_capacity(ids.len());
        for id in ids {
            let Some(mut l) = map.landmarks.remove(id) else { continue };
            l.created_by = keyframe(l.created_by);
            landmarks.push((new.landmarks.of(id), l));
        }
        let mut map = Map::restored(keyframes, landmarks)?;
        map.skip_ids_to(new.keyframes.next(), new.landmarks.next());
        Ok(Self { head, map })
    }
}

impl Map {
    /// A map from its keyframes and landmarks, whose links are made anew. The error says what does not fit together.
    pub fn restored(keyframes: Vec<(u32, Keyframe)>, landmarks: Vec<(u32, Landmark)>) -> Result<Self, String> {
        let mut map = Self::default();
        for (id, mut landmark) in landmarks {
            landmark.observers.clear();
            if map.landmark(LandmarkId(id)).is_some() {
                return Err(format!("landmark {id} is there twice"));
            }
            map.landmarks.restore(id, landmark);
        }
        for (id, mut keyframe) in keyframes {
            if map.keyframe(KeyframeId(id)).is_some() {
                return Err(format!("keyframe {id} is there twice"));
            }
            keyframe.covisible.clear();
            let observed: Vec<u32> = keyframe.observations.landmarks().map(|l| l.0).collect();
            if !observed.is_sorted_by(|a, b| a < b) {
                return Err(format!("keyframe {id}: its landmarks are in no order"));
            }
            keyframe.picture.keep_only(&observed);
            match keyframe.picture.is_condensed() {
                false => map.detailed.insert(KeyframeId(id)),
                true if keyframe.picture.is_away() => map.away.insert(KeyframeId(id)),
                true => keyframe.picture.can_be_away() && map.condensed_here.insert(KeyframeId(id)),
            };
            map.keyframes.restore(id, keyframe);
            for landmark in observed {
                let Some(entry) = map.landmarks.get_mut(landmark) else {
                    return Err(format!("keyframe {id} observes landmark {landmark}, which is not there"));
                };
                for &other in &entry.observers {
                    change_covisibility(&mut map.keyframes, KeyframeId(id), other, 1);
                }
                entry.observers.push(KeyframeId(id));
            }
        }
        let sorted = |(_, l): (u32, &Landmark)| l.observers.is_sorted();
        if !map.landmarks.iter().all(sorted) {
            return Err("keyframes are in no order".into());
        }
        map.take_changed();
        map.numbers.load_below(map.keyframes.next_id());
        Ok(map)
    }

    /// Ids go on from here at the least: others of the same run have those below.
    pub fn skip_ids_to(&mut self, next_keyframe: u32, next_landmark: u32) {
        self.keyframes.skip_to(next_keyframe);
        self.landmarks.skip_to(next_landmark);
    }

    /// Whether [`take_changed`](Self::take_changed) would tell of any.
    pub fn has_changed(&self) -> bool {
        self.keyframes.has_changed() || self.landmarks.has_changed()
    }

    /// Keyframes and landmarks that were added, changed or removed since the last call, ascending.
    pub fn take_changed(&mut self) -> (Vec<u32>, Vec<u32>) {
        (self.keyframes.take_changed(), self.landmarks.take_changed())
    }
}
