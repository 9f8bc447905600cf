//! Corrections of the map's published coordinates that are more than ordinary adjustment.
//!
//! A join carries what was in another map's coordinates over into the present ones, or all into those of a larger one, and the first adjustment of both together then moves
//! poses and landmarks by more than the usual fraction of a pixel. A planner that keeps things in map coordinates must hear of both: each
//! raises the revision that pose and map messages carry, and so does a camera that is
//! placed anew once parallax tells where it went behind a turn on the spot. Ordinary adjustments are left uncounted, as they come several times a second.

use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};

/// How often, and how far the last time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Corrections {
    /// Of this run; never goes back.
    pub revision: u32,
    /// How far the newest camera was moved (map units) and turned (rad) by the last one; NaN before the first.
    pub distance: f64,
    pub angle_rad: f64,
    /// The next adjustment is the first of what was joined.
    awaited: bool,
}

impl Default for Corrections {
    fn default() -> Self {
        Self { revision: 0, distance: f64::NAN, angle_rad: f64::NAN, awaited: false }
    }
}

impl Corrections {
    /// Another map has become a part of this one; the camera stays where it is.
    pub(super) fn join(&mut self) {
        *self = Self { revision: self.revision.wrapping_add(1), distance: 0.0, angle_rad: 0.0, awaited: true };
    }

    /// Both are where the other one was, and so the camera went from there to here.
    pub(super) fn carried(&mut self, old: &Se3<Camera, World>, new: &Se3<Camera, World>) {
        (self.distance, self.angle_rad) = moved(old, new);
    }

    /// A loop was closed, which moved the newest camera so; the next adjustment is the first of both its ends together.
    pub(super) fn close_loop(&mut self, old: &Se3<Camera, World>, new: &Se3<Camera, World>) {
        self.moved(old, new);
        self.awaited = true;
    }

    /// An adjustment was merged that moved the newest camera so.
    pub(super) fn adjusted(&mut self, old: &Se3<Camera, World>, new: &Se3<Camera, World>) {
        if std::mem::take(&mut self.awaited) {
            self.moved(old, new);
        }
    }

    /// The newest camera was placed anew, and what was seen since a turn with it.
    pub(super) fn moved(&mut self, old: &Se3<Camera, World>, new: &Se3<Camera, World>) {
        let (distance, angle_rad) = moved(old, new);
        self.moved_by(distance, angle_rad);
    }

    /// The same by numbers.
    pub(super) fn moved_by(&mut self, distance: f64, angle_rad: f64) {
        self.revision = self.revision.wrapping_add(1);
        (self.distance, self.angle_rad) = (distance, angle_rad);
    }

    /// Another map begins: what is adjusted next is that one.
    pub(super) fn end_map(&mut self) {
        self.awaited = false;
    }
}

/// How far the newest camera was moved (map units) and turned (rad).
fn moved(old: &Se3<Camera, World>, new: &Se3<Camera, World>) -> (f64, f64) {
    let distance = (old.inverse().translation - new.inverse().translation).norm();
    (distance, old.rotation.angle_to(&new.rotation))
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;

    #[test]
    fn a_join_and_the_first_adjustment_after_it_are_counted_and_no_other() {
        let old = Se3::identity();
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.0, 0.1, 0.0));
        let new = Se3::new(turn, turn * Vector3::new(0.3, 0.0, -0.4));
        let mut corrections = Corrections::default();
        corrections.adjusted(&old, &new);
        assert!(corrections.revision == 0 && corrections.distance.is_nan());
        corrections.join();
        assert_eq!((corrections.revision, corrections.distance), (1, 0.0), "the camera stays in a join");
        corrections.adjusted(&old, &new);
        corrections.adjusted(&old, &new);
        assert_eq!(corrections.revision, 2);
        assert!((corrections.distance - 0.5).abs() < 1e-12 && (corrections.angle_rad - 0.1).abs() < 1e-12);
        corrections.close_loop(&old, &new);
        corrections.adjusted(&old, &old);
        corrections.adjusted(&old, &new);
        assert_eq!(
            (corrections.revision, corrections.distance),
            (4, 0.0),
            "the loop, and the adjustment of both its ends"
        );
        corrections.join();
        corrections.end_map();
        corrections.adjusted(&old, &new);
        assert_eq!(corrections.revision, 5);
    }
}
