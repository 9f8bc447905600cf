//! Whether what a map says twice agrees.

use super::{KeyframeId, LandmarkId, Map};

impl Map {
    /// Every link is mutual and counted right (tests call it after random edits).
    pub fn check_consistency(&self) -> Result<(), String> {
        for (id, landmark) in self.landmarks.iter() {
            for &k in &landmark.observers {
                if self.keyframe(k).is_none_or(|k| !k.observations.contains(LandmarkId(id))) {
                    return Err(format!("landmark {id} names keyframe {} which does not observe it", k.0));
                }
            }
        }
        for (id, keyframe) in self.keyframes.iter() {
            let mut counts = std::collections::BTreeMap::new();
            for seen in keyframe.observations.landmarks() {
                let landmark = self.landmark(seen).ok_or(format!("keyframe {id}: no landmark {}", seen.0))?;
                for &k in landmark.observers.iter().filter(|k| k.0 != id) {
                    *counts.entry(k).or_insert(0u32) += 1;
                }
                if landmark.observers.binary_search(&KeyframeId(id)).is_err() {
                    return Err(format!("keyframe {id} observes landmark {} which does not know", seen.0));
                }
            }
            let counted: Vec<_> = counts.into_iter().collect();
            if counted != keyframe.covisible {
                return Err(format!("keyframe {id}: covisibility {:?}, counted {counted:?}", keyframe.covisible));
            }
        }
        Ok(())
    }
}
