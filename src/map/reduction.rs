//! Which patches remain of an old keyframe's picture: of each landmark the views that differ, not every one that there was.

use nalgebra::Vector3;

use super::{KeyframeId, Landmark, LandmarkId, Map};

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
        for o in &keyframe.observations {
            if self.landmark(o.landmark).is_some_and(|l| !self.has_patch_alike(o.landmark, l, &centre)) {
                kept.push((o.landmark.0, o.pixel));
            }
        }
        if let Some(k) = self.keyframes.get_mut(id.0) {
            k.picture.reduce(kept.into_iter());
            if k.picture.whole().is_none() {
                k.corners = Vec::new();
            }
        }
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
