//! Where the frames between keyframes are, once the keyframes are somewhere else.

use crate::geometry::Se3;
use crate::geometry::frames::{Camera, Keyframe as KeyframeFrame, World};
use crate::map::{Keyframe, KeyframeId, Map, MapId};
use crate::reconstruction::relocalise::other_maps::OtherMap;

/// Logarithm of the ratio by which the unit of a map is believed to differ from the whole map's at some place: a factor of two.
const MOST_UNEVEN_LOG: f64 = std::f64::consts::LN_2;

/// Where the picture of a keyframe has a place in the new map: relative to a keyframe of that.
pub struct Placed {
    pub map: MapId,
    pub keyframe: KeyframeId,
    pub parent: KeyframeId,
    pub parent_from_keyframe: Se3<KeyframeFrame, KeyframeFrame>,
}

impl Placed {
    /// Its pose; `scale`: what the new map's unit is in that of `map`.
    pub fn world_from_camera(&self, map: &Map, scale: f64) -> Option<Se3<World, Camera>> {
        let world_from_parent =
            map.keyframe(self.parent)?.camera_from_world.inverse().relabel::<World, KeyframeFrame>();
        let mut step = self.parent_from_keyframe;
        step.translation *= scale;
        Some((world_from_parent * step).relabel())
    }
}

/// A keyframe of a map that was begun wrongly, as it was there, and where it is now.
struct Moved<'a> {
    parent: KeyframeId,
    before: &'a Keyframe,
    after: Se3<World, Camera>,
}

impl Moved<'_> {
    /// A pose beside it that goes with it; `unit`: what lengths have become.
    fn carry(&self, world_from_camera: &Se3<World, Camera>, unit: f64) -> Se3<World, Camera> {
        let mut step: Se3<Camera, Camera> = self.before.camera_from_world * *world_from_camera;
        step.translation *= unit;
        self.after * step
    }
}

/// What has become of the keyframes of a map that was begun wrongly.
pub struct Moves<'a> {
    /// In the order of time, two at the least.
    keyframes: Vec<Moved<'a>>,
    /// What a unit of length has become over all of them.
    unit: f64,
}

impl<'a> Moves<'a> {
    /// `scale`: the new map's unit in the `present` one's, which it is a part of by now. `None` if too few have a place to tell lengths.
    pub fn of(placed: &[Placed], old: &'a OtherMap, present: &Map, scale: f64) -> Option<Self> {
        let mut keyframes = Vec::new();
        for place in placed.iter().filter(|place| place.map == old.own.id) {
            let after = place.world_from_camera(present, scale);
            if let Some((before, after)) = old.own.map.keyframe(place.keyframe).zip(after) {
                keyframes.push(Moved { parent: place.parent, before, after });
            }
        }
        keyframes.sort_by_key(|m| m.before.timestamp_ns);
        Self::along(keyframes)
    }

    fn along(keyframes: Vec<Moved<'a>>) -> Option<Self> {
        let unit = unit(&keyframes);
        unit.is_finite().then_some(Self { keyframes, unit })
    }

    /// Where a frame is now, and the keyframe that the nearer one beside it hangs on: by the one before it and the one after it, each as far as it is near in
    /// time. What a wrong focal length makes of a turn, and of the unit of lengths, then holds between these two only.
    pub fn follow(&self, timestamp_ns: i64, before: &Se3<World, Camera>) -> Option<(Se3<World, Camera>, KeyframeId)> {
        let next = self.keyframes.partition_point(|m| m.before.timestamp_ns <= timestamp_ns);
        let last = self.keyframes.len().checked_sub(1)?;
        let pair = self.keyframes.get(next.clamp(1, last.max(1)) - 1..)?.get(..2)?;
        let (a, b) = (&pair[0], &pair[1]);
        // Where the camera hardly moved it is the noise of both.
        let own = Some(unit(pair)).filter(|own| (own / self.unit).ln().abs() < MOST_UNEVEN_LOG);
        let unit = own.unwrap_or(self.unit);
        let span_ns = (b.before.timestamp_ns - a.before.timestamp_ns).max(1) as f64;
        let share = ((timestamp_ns - a.before.timestamp_ns) as f64 / span_ns).clamp(0.0, 1.0);
        let (by_a, by_b) = (a.carry(before, unit), b.carry(before, unit));
        let between: Se3<Camera, Camera> = by_a.inverse() * by_b;
        Some((by_a * between.scaled(share), if share < 0.5 { a.parent } else { b.parent }))
    }
}

/// What a unit of length has become along keyframes, by the ways between them.
fn unit(keyframes: &[Moved<'_>]) -> f64 {
    let (before, after) = keyframes.windows(2).fold((0.0, 0.0), |(before, after), pair| {
        let step = pair[1].before.centre() - pair[0].before.centre();
        (before + step.norm(), after + (pair[1].after.translation - pair[0].after.translation).norm())
    });
    after / before
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;
    use crate::image::Pyramid;
    use crate::map::examples;

    /// Along x, turning about y.
    fn pose(way: f64, turn: f64) -> Se3<World, Camera> {
        Se3::new(UnitQuaternion::from_scaled_axis(Vector3::y() * turn), Vector3::x() * way)
    }

    #[test]
    fn a_frame_follows_the_keyframes_on_both_sides_of_it() {
        // A focal length that is far too short makes half as much again of a turn, and the map was half as large.
        let (was, is) = (|t: f64| pose(0.5 * t, 0.45 * t), |t: f64| pose(t, 0.3 * t));
        let ns = |t: f64| (t * 1e9) as i64;
        let keyframes: Vec<Keyframe> = [0.0, 1.0, 2.0]
            .map(|t| Keyframe {
                timestamp_ns: ns(t),
                ..examples::keyframe(Arc::new(Pyramid::new(1)), was(t).inverse())
            })
            .into();
        let first = |n: usize| {
            let known = keyframes[..n].iter().zip([(10, 0.0), (11, 1.0), (12, 2.0)]);
            let moved = known.map(|(before, (id, t))| Moved { parent: KeyframeId(id), before, after: is(t) });
            Moves::along(moved.collect())
        };
        assert!(first(0).is_none() && first(1).is_none(), "one tells no lengths");
        let moves = first(3).expect("lengths");
        let at = |t: f64| moves.follow(ns(t), &was(t)).expect("there are keyframes");
        for t in [0.0, 1.0, 2.0] {
            let off = is(t).inverse() * at(t).0;
            assert!(off.translation.norm() < 1e-9 && off.rotation.angle() < 1e-9, "{t}: it is one of them");
        }
        for t in [0.25, 0.5, 1.3, 1.9] {
            let off: Se3<Camera, Camera> = is(t).inverse() * at(t).0;
            assert!(off.rotation.angle() < 1e-6 && off.translation.norm() < 0.05, "{t}: {off:?}");
        }
        assert_eq!([0.2, 0.8, 1.2, 9.0].map(|t| at(t).1.0), [10, 11, 11, 12]);
        let off: Se3<Camera, Camera> = is(2.0).inverse() * moves.follow(ns(3.0), &was(2.0)).expect("there").0;
        assert!(off.translation.norm() < 1e-9, "after the last one it goes with that alone");
    }
}
