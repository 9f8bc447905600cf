//! Keyframes, landmarks and their covisibility. Knows no threads.

/// A keyframe of a map; never reused within a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct KeyframeId(pub u32);

/// A landmark of a map; never reused within a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct LandmarkId(pub u32);

/// A connected map; a new one begins after every re-initialisation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct MapId(pub u32);
