//! Frames before the map, and what two of them share.

use std::sync::Arc;

use super::turn::Pair;
use crate::features::FrameFeatures;
use crate::image::Pyramid;
use crate::reconstruction::consensus::FrameTracks;

/// Views kept between the reference and the newest frame; when there would be more every other one is dropped.
pub const MAX_BETWEEN: usize = 8;
/// A view is given up below this many tracks in common with the newest frame, or a quarter of its own, and the next one takes over.
pub const MIN_COMMON: usize = 60;

/// A frame before the map that is kept with its picture.
#[derive(Debug, Clone)]
pub struct View {
    pub frame: FrameTracks,
    pub pyramid: Arc<Pyramid>,
}

impl View {
    /// The picture is a copy of its own: the frame's goes back to the pool.
    pub fn of(features: &FrameFeatures) -> Self {
        Self { frame: FrameTracks::of(features), pyramid: Arc::new(Pyramid::clone(&features.pyramid)) }
    }
}

/// The views of a start, the corners that no track follows among their tracks: first, in between, newest.
#[derive(Debug)]
pub struct Views {
    pub first: View,
    /// In order of time; neither the first nor the newest frame is among them.
    pub between: Vec<View>,
    pub newest: FrameTracks,
}

/// Tracks that two frames share, and where both see them.
pub struct Pairs {
    pub tracks: Vec<u64>,
    pub places: Vec<Pair>,
}
