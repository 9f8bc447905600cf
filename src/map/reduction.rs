//! Which patches remain of an old keyframe's picture: of each landmark the views that differ, not every one that there was.
//!
//! And which views remain of it when it is condensed: those of the landmarks that most keyframes see. A landmark that no keyframe shows any more,
//! as all that see it are condensed and had better ones to keep, could never be found again and goes.

use std::sync::Arc;

use nalgebra::Vector3;

use super::away::{CopyFault, PictureCopy};
use super::picture::{Detail, KeyframePicture};
use super::view::{Description, View};
use super::{Keyframe, KeyframeId, Landmark, LandmarkId, Map};
use crate::features::thumbnail::Thumbnail;
use crate::geometry::CameraModel;

/// Views that a condensed keyframe keeps, at the most. A new keyframe has some 37 landmarks that are new (of 200): a quarter of these, which few
/// others see, are not kept for ever.
pub const MOST_VIEWS: usize = 28;

/// Views of a landmark within this cosine (10 degrees) and this share of each other's distance show it alike.
const ALIKE_COSINE: f64 = 0.985;
const ALIKE_DISTANCE: f64 = 0.8;

impl Map {
    /// Reduces a keyframe's picture to the views of its landmarks that no reduced keyframe has alike, and forgets its free corners, which
    /// nothing could be aligned with any more.
    pub fn reduce_picture(&mut self, id: KeyframeId) {
        let Some(keyframe) = self.keyframe(id).filter(|k| k.picture.whole().is_some()) else { return };
        let centre = keyframe.centre();
        let mut kept = Vec::with_capacity(keyframe.observations.len());
        for (id, pixel) in keyframe.observations.pixels() {
            if self.landmark(id).is_some_and(|l| !self.has_patch_alike(id, l, &centre)) {
                kept.push((id.0, pixel));
            }
        }
        if let Some(k) = self.keyframes.get_mut(id.0) {
            k.picture.reduce(kept.into_iter());
            if k.picture.whole().is_none() {
                k.corners = Vec::new();
            }
        }
    }

    /// Keyframes whose pictures are not condensed, ascending.
    pub fn detailed(&self) -> impl ExactSizeIterator<Item = KeyframeId> {
        self.detailed.iter().copied()
    }

    /// The last of these that was made before a keyframe; `None`: before the next one.
    pub fn detailed_before(&self, id: Option<KeyframeId>) -> Option<KeyframeId> {
        match id {
            Some(id) => self.detailed.range(..id).next_back().copied(),
            None => self.detailed.last().copied(),
        }
    }

    /// Condenses a keyframe's picture to the views of at most [`MOST_VIEWS`] landmarks, those of the most keyframes first; `describe` gives
    /// the descriptors of the picture, and of what it is told of the keyframe's landmarks, in the same order. Its observations, undistorted by
    /// `camera`, are packed. Landmarks that nothing shows any
    /// more are taken out of the map; how many. Of a picture that is too small nothing is given up.
    pub fn condense_picture(
        &mut self,
        id: KeyframeId,
        camera: &CameraModel,
        describe: impl FnOnce(&Keyframe, &[LandmarkId]) -> Description,
    ) -> usize {
        self.reduce_picture(id);
        self.detailed.remove(&id);
        let Some(keyframe) = self.keyframe(id).filter(|k| k.picture.can_be_condensed()) else { return 0 };
        // Where a patch of level 0 is there it is the only one of this view; without one another keyframe has it, or level 1 must do.
        let mut ranked = Vec::with_capacity(keyframe.observations.len());
        for seen in keyframe.observations.landmarks() {
            let Some(landmark) = self.landmark(seen) else { continue };
            let shown = |other: &KeyframeId| *other != id && self.detail(*other, seen) > Detail::None;
            if keyframe.picture.shows(seen.0) || !landmark.observers.iter().any(shown) {
                ranked.push((std::cmp::Reverse(landmark.observers.len()), seen));
            }
        }
        ranked.sort_unstable();
        ranked.truncate(MOST_VIEWS);
        let mut kept: Vec<LandmarkId> = ranked.into_iter().map(|(_, landmark)| landmark).collect();
        kept.sort_unstable();
        let Description { landmarks: described, place } = describe(keyframe, &kept);
        let mut views = Vec::with_capacity(kept.len());
        for (&landmark, described) in kept.iter().zip(described) {
            let Some(o) = keyframe.observation(landmark) else { continue };
            let patches = keyframe.picture.small_patches(landmark.0, o.pixel);
            if patches.iter().any(Option::is_some) {
                views.push(View { landmark: landmark.0, patches, described });
            }
        }
        let seen: Vec<LandmarkId> = keyframe.observations.landmarks().collect();
        let lens = self.lens.take().filter(|lens| **lens == *camera).unwrap_or_else(|| Arc::new(camera.clone()));
        if let Some(k) = self.keyframes.get_mut(id.0) {
            k.picture.condense(views, place);
            // It follows from the picture.
            k.thumbnail = Thumbnail::default();
            k.observations.pack(&lens);
            k.covisible.shrink_to_fit();
        }
        self.lens = Some(lens);
        self.condensed_here.insert(id);
        self.remove_hidden(&seen)
    }

    /// Keyframes whose pictures are condensed and here, ascending.
    pub fn condensed_here(&self) -> impl ExactSizeIterator<Item = KeyframeId> {
        self.condensed_here.iter().copied()
    }

    /// Keyframes whose pictures are elsewhere.
    pub fn away(&self) -> usize {
        self.away.len()
    }

    /// Gives up a keyframe's condensed picture here, as there is a copy elsewhere; `copied` makes one where the last one is none any more. Whether
    /// it is away now.
    pub fn put_picture_away(
        &mut self,
        id: KeyframeId,
        copied: impl FnOnce(&KeyframePicture) -> Option<Arc<dyn PictureCopy>>,
    ) -> bool {
        // A map that is only located in changes by this as well: no file needs to be told.
        let is_away = self.keyframes.get_mut_unnoticed(id.0).is_some_and(|k| k.picture.put_away(copied));
        if is_away {
            self.condensed_here.remove(&id);
            self.away.insert(id);
        }
        is_away
    }

    /// Whether a keyframe's picture was elsewhere and is here again. One that cannot be read now stays away, and all is as it was. One whose copy makes
    /// no sense is lost, and so are the landmarks that nothing else shows.
    pub fn bring_picture_back(&mut self, id: KeyframeId) -> Result<bool, CopyFault> {
        let Some(k) = self.keyframes.get_mut_unnoticed(id.0).filter(|k| k.picture.is_away()) else { return Ok(false) };
        let brought = k.picture.bring_back();
        if brought.is_ok() {
            self.condensed_here.insert(id);
            self.away.remove(&id);
        } else if k.picture.is_lost() {
            self.away.remove(&id);
            let seen: Vec<LandmarkId> = k.observations.landmarks().collect();
            self.remove_hidden(&seen);
        }
        brought.map(|()| true)
    }

    /// Brings back all pictures that are elsewhere, for a copy of a part of the map; what cannot be read stays away.
    pub fn bring_pictures_back(&mut self) {
        for (_, k) in self.keyframes.iter_mut() {
            // Who keeps the map itself says why.
            let _ = k.picture.bring_back();
        }
    }

    fn remove_hidden(&mut self, landmarks: &[LandmarkId]) -> usize {
        let is_hidden = |id: &&LandmarkId| self.landmark(**id).is_some_and(|l| self.is_hidden(**id, l));
        let hidden: Vec<LandmarkId> = landmarks.iter().filter(is_hidden).copied().collect();
        hidden.iter().for_each(|landmark| self.remove_landmark(*landmark));
        hidden.len()
    }

    /// Nothing shows it any more, so no frame could find it again.
    pub(super) fn is_hidden(&self, id: LandmarkId, landmark: &Landmark) -> bool {
        landmark.observers.iter().all(|k| self.detail(*k, id) == Detail::None)
    }

    fn detail(&self, keyframe: KeyframeId, landmark: LandmarkId) -> Detail {
        self.keyframe(keyframe).map_or(Detail::None, |k| k.picture.detail(landmark.0))
    }

    /// Whether a patch shows the landmark as it is seen from `centre`.
    fn has_patch_alike(&self, id: LandmarkId, landmark: &Landmark, centre: &Vector3<f64>) -> bool {
        let ray = landmark.position - centre;
        landmark.observers.iter().filter_map(|k| self.keyframe(*k)).any(|k| {
            let other = landmark.position - k.centre();
            let (here, there) = (ray.norm(), other.norm());
            k.picture.whole().is_none()
                && k.picture.shows(id.0)
                && ray.dot(&other) > ALIKE_COSINE * here * there
                && here.min(there) > ALIKE_DISTANCE * here.max(there)
        })
    }
}
