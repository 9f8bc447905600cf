//! What each frame-to-frame track of the feature stage stands for: a landmark, or a seed that waits for parallax.

use nalgebra::Vector2;

use crate::features::Track;
use crate::map::{KeyframeId, LandmarkId};

/// A seed's observations in keyframes; more than this many are not kept (the first is the anchor).
pub const SEED_OBSERVATIONS: usize = 6;
/// Standard deviation of a frame-to-frame track's position, px (drifts; templates do not).
pub const TRACK_SIGMA_PX: f64 = 2.0;

/// A corner that is followed but whose depth is not known yet.
#[derive(Debug, Clone, Copy)]
pub struct Seed {
    /// Keyframes in which the track was seen since it became a seed, and its pixel there; the first is the anchor.
    pub seen: [(KeyframeId, Vector2<f32>); SEED_OBSERVATIONS],
    pub count: usize,
}

impl Seed {
    pub fn new(keyframe: KeyframeId, pixel: Vector2<f32>) -> Self {
        Self { seen: [(keyframe, pixel); SEED_OBSERVATIONS], count: 1 }
    }

    pub fn add(&mut self, keyframe: KeyframeId, pixel: Vector2<f32>) {
        if self.count < SEED_OBSERVATIONS {
            self.seen[self.count] = (keyframe, pixel);
            self.count += 1;
        } else {
            // The anchor and the newest say most.
            self.seen[SEED_OBSERVATIONS - 1] = (keyframe, pixel);
        }
    }

    pub fn observations(&self) -> &[(KeyframeId, Vector2<f32>)] {
        &self.seen[..self.count]
    }
}

/// What a track stands for.
#[derive(Debug, Clone, Copy)]
pub enum Target {
    Landmark(LandmarkId),
    Seed(Seed),
}

/// Targets of the living tracks.
#[derive(Debug, Default)]
pub struct Bindings {
    /// Ascending track id.
    list: Vec<(u64, Target)>,
}

impl Bindings {
    pub fn get(&self, track: u64) -> Option<&Target> {
        let i = self.list.binary_search_by_key(&track, |b| b.0).ok()?;
        Some(&self.list[i].1)
    }

    pub fn set(&mut self, track: u64, target: Target) {
        match self.list.binary_search_by_key(&track, |b| b.0) {
            Ok(i) => self.list[i].1 = target,
            Err(i) => self.list.insert(i, (track, target)),
        }
    }

    pub fn remove(&mut self, track: u64) {
        if let Ok(i) = self.list.binary_search_by_key(&track, |b| b.0) {
            self.list.remove(i);
        }
    }

    /// Drops the targets of tracks that are not among `tracks` (ascending id).
    pub fn retain_living(&mut self, tracks: &[Track]) {
        let mut i = 0;
        self.list.retain(|&(id, _)| {
            while i < tracks.len() && tracks[i].id < id {
                i += 1;
            }
            i < tracks.len() && tracks[i].id == id
        });
    }

    pub fn clear(&mut self) {
        self.list.clear();
    }

    /// Ascending track id.
    pub fn iter(&self) -> impl Iterator<Item = &(u64, Target)> {
        self.list.iter()
    }
}
