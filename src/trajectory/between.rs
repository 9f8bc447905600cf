//! Frames between two keyframes follow both.
//!
//! A frame is recorded relative to one keyframe, where it was tracked. What adjustments have made since of the keyframe that the way came to next says how
//! far the track was off by then, so its frames since the keyframe before were off by their share of the time:
//!
//! ```text
//! pose' = pose e(t)      e(t): from e(before) to e(after), by rotation and by translation      e(keyframe) = tracked^-1 adjusted
//! ```
//!
//! all relative to the keyframe that the frame was tracked by; that one itself is not off. Frames of which one end was tracked by another stay as they
//! are, but for a keyframe's own.

use nalgebra::UnitQuaternion;

use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::map::KeyframeId;

/// A frame as it was tracked, beside a keyframe as the map has that now.
#[derive(Debug, Clone, Copy)]
pub struct Tracked {
    pub timestamp_ns: i64,
    pub by: KeyframeId,
    pub world_from_camera: Se3<World, Camera>,
}

/// One that has become a keyframe.
#[derive(Debug, Clone, Copy)]
pub struct Made {
    tracked: Tracked,
    keyframe: KeyframeId,
    /// `tracked^-1 adjusted`
    off: Se3<Camera, Camera>,
}

impl Made {
    /// `adjusted`: where the map has the keyframe now.
    pub fn new(tracked: Tracked, keyframe: KeyframeId, adjusted: &Se3<World, Camera>) -> Self {
        Self { tracked, keyframe, off: tracked.world_from_camera.inverse() * *adjusted }
    }

    pub fn timestamp_ns(&self) -> i64 {
        self.tracked.timestamp_ns
    }

    /// What is off there of what was tracked by a keyframe.
    fn off(&self, by: KeyframeId) -> Option<Se3<Camera, Camera>> {
        if by == self.keyframe {
            return Some(Se3::identity());
        }
        (by == self.tracked.by).then_some(self.off)
    }
}

/// A frame's pose between the keyframes `before` and `after` it, or at the latter.
pub fn between(frame: &Tracked, before: Option<&Made>, after: Option<&Made>) -> Se3<World, Camera> {
    let end = |made: &Made| Some((made.timestamp_ns(), made.off(frame.by)?));
    let Some((to_ns, to)) = after.and_then(end) else { return frame.world_from_camera };
    let (from_ns, from) = match before.and_then(end) {
        Some(from) => from,
        None if to_ns == frame.timestamp_ns => (to_ns - 1, to),
        None => return frame.world_from_camera,
    };
    let share = (frame.timestamp_ns - from_ns) as f64 / (to_ns - from_ns).max(1) as f64;
    let axis = |off: &Se3<Camera, Camera>| off.rotation.scaled_axis();
    let off = Se3::new(
        UnitQuaternion::from_scaled_axis(axis(&from).lerp(&axis(&to), share)),
        from.translation.lerp(&to.translation, share),
    );
    frame.world_from_camera * off
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    fn pose(x: f64, yaw: f64) -> Se3<World, Camera> {
        Se3::new(UnitQuaternion::from_scaled_axis(Vector3::y() * yaw), Vector3::x() * x)
    }

    fn tracked(timestamp_ns: i64, by: u32, x: f64, yaw: f64) -> Tracked {
        Tracked { timestamp_ns, by: KeyframeId(by), world_from_camera: pose(x, yaw) }
    }

    #[test]
    fn frames_are_off_by_their_share_of_what_the_next_keyframe_was() {
        // Keyframe 1 at 0 s; tracked by it to 1 m, 0.2 rad at 4 s, where keyframe 2 lies at 1.2 m, 0.1 rad.
        let first = Made::new(tracked(0, 0, 0.1, 0.0), KeyframeId(1), &pose(0.0, 0.0));
        let next = Made::new(tracked(4, 1, 1.0, 0.2), KeyframeId(2), &pose(1.2, 0.1));
        let at = |t: i64, by, x, yaw| between(&tracked(t, by, x, yaw), Some(&first), Some(&next));
        let end = at(4, 1, 1.0, 0.2);
        assert!((end.translation - pose(1.2, 0.1).translation).norm() < 1e-12);
        assert!(end.rotation.angle_to(&pose(1.2, 0.1).rotation) < 1e-12, "the keyframe's own place");
        let way = at(1, 1, 0.25, 0.05);
        assert!((way.translation.x - 0.25 - 0.05).abs() < 0.003 && (way.rotation.scaled_axis().y - 0.025).abs() < 1e-9);
        // By the keyframe before the first: off there already.
        let (start, other) = (at(0, 0, 0.1, 0.0), at(1, 0, 0.3, 0.0));
        assert_eq!(start.translation.x, 0.1, "keyframe 2 was not tracked by that one");
        assert_eq!(other.translation.x, 0.3);
        let same = Made::new(tracked(4, 0, 1.0, 0.0), KeyframeId(2), &pose(1.1, 0.0));
        let half = between(&tracked(2, 0, 0.5, 0.0), Some(&first), Some(&same));
        assert!((half.translation.x - 0.5).abs() < 1e-12, "0.1 too far at the one, 0.1 too short at the other");
        let alone = between(&tracked(5, 2, 2.0, 0.0), Some(&next), None);
        assert_eq!(alone, pose(2.0, 0.0));
    }
}
