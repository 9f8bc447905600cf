//! A point of the scene, and how often it was seen.

use nalgebra::{Matrix3, Vector3};

use super::KeyframeId;

/// A point of the scene.
#[derive(Debug, Clone)]
pub struct Landmark {
    pub position: Vector3<f64>,
    /// Covariance of `position` with the keyframes held fixed, map units squared.
    pub covariance: Matrix3<f64>,
    /// Keyframes that observe it, ascending id.
    pub observers: Vec<KeyframeId>,
    /// Keyframe at whose time it was made.
    pub created_by: KeyframeId,
    /// `None`: its place rests on what was seen alone.
    pub assumed: Option<AssumedDistance>,
    /// Frames in which it was looked for, and in how many it was found and agreed with the pose.
    pub sought: u32,
    pub found: u32,
}

impl Landmark {
    /// Frames that are counted, some days of them: beyond it is the share found that counts.
    pub const MOST_SOUGHT: u32 = 1 << 24;

    /// Counts that it was looked for in a frame.
    pub fn count(&mut self, found: bool) {
        self.bound_counts();
        self.sought += 1;
        self.found += u32::from(found);
    }

    /// Counts fewer frames, the same share of them found, where there are more than that.
    pub fn bound_counts(&mut self) {
        while self.sought.max(self.found) >= Self::MOST_SOUGHT {
            (self.sought, self.found) = (self.sought / 2, self.found / 2);
        }
    }

    /// Found the one time that it was sought, in the frame that made it.
    pub fn new(position: Vector3<f64>, covariance: Matrix3<f64>, created_by: KeyframeId) -> Self {
        Self { position, covariance, observers: Vec::new(), created_by, assumed: None, sought: 1, found: 1 }
    }
}

/// What a landmark's distance from its first observer is taken to be as long as no parallax tells it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AssumedDistance {
    /// 1 / map units.
    pub inverse: f64,
    /// Its standard deviation, 1 / map units.
    pub sigma: f64,
}
