//! From tracked frames to segments: the camera's motion of half a second and more, as the map has it now.
//!
//! Each end of a segment is a frame beside a keyframe, as in a trajectory, so that what an adjustment finds later of both keyframes is in the
//! segment the next time it is asked. Once a keyframe is gone, the segment keeps the motion that it had.

use super::scale_uncertainty::Parts;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, Keyframe as KeyframeFrame, World};
use crate::map::scale::ScaleSource;
use crate::map::{Correction, KeyframeId, Map, TurnId};
use crate::motion::hand_eye::{Robot, Segment, Unit};
use crate::motion::scale::ScaleFusion;
use crate::motion::wheel_scale::{LONGEST_SEGMENT_NS, SEGMENT_NS, WheelScale};

/// Standard deviation of a frame's place beside a keyframe, as a share of the mean depth: 0.8 px of a focal length of 500 px, 150 landmarks, and
/// what of their errors is common.
const PLACE_SHARE: f64 = 0.001;
/// A step below so many of its standard deviations waits to become longer.
const STEP_SIGMAS: f64 = 20.0;

/// Wheels that moved by fewer of their standard deviations tell no length.
pub const MOVED_SIGMAS: f64 = 5.0;

/// A frame beside a keyframe.
#[derive(Debug, Clone, Copy)]
pub struct FrameEnd {
    pub timestamp_ns: i64,
    pub keyframe: KeyframeId,
    pub keyframe_from_camera: Se3<KeyframeFrame, Camera>,
    /// Median depth of the landmarks that it saw, map units.
    pub depth: f64,
}

impl FrameEnd {
    fn world_from_camera(&self, map: &Map) -> Option<Se3<World, Camera>> {
        let keyframe = map.keyframe(self.keyframe)?.camera_from_world.inverse();
        Some(keyframe.relabel::<World, KeyframeFrame>() * self.keyframe_from_camera)
    }

    /// Part of the map whose lengths have one unit.
    fn unit(&self, map: &Map) -> Option<Unit> {
        let turn = map.keyframe(self.keyframe)?.scale_from;
        Some(unit_behind(turn))
    }
}

fn unit_behind(turn: Option<TurnId>) -> Unit {
    Unit(turn.map_or(0, |turn| 1 + u32::from(turn.0)))
}

fn turn_before(unit: Unit) -> Option<TurnId> {
    Some(TurnId(u16::try_from(unit.0.checked_sub(1)?).ok()?))
}

/// Wheels beside the present map.
#[derive(Debug)]
pub struct Wheels {
    pub scale: WheelScale,
    /// Ends of the segments that `scale` has, in the same order.
    ends: Vec<(FrameEnd, FrameEnd)>,
    begin: Option<FrameEnd>,
    last: Option<Se3<World, Camera>>,
    /// Way of the camera in this map, in depths.
    depths: f64,
}

impl Wheels {
    pub fn new(given: Robot, radius_sigma: f64) -> Self {
        let scale = WheelScale::new(given, radius_sigma);
        Self { scale, ends: Vec::new(), begin: None, last: None, depths: 0.0 }
    }

    /// Another map begins.
    pub fn begin_map(&mut self) {
        self.scale.begin_map();
        self.ends.clear();
        (self.begin, self.last, self.depths) = (None, None, 0.0);
    }

    /// The next segment begins with the next frame.
    pub fn interrupt(&mut self) {
        (self.begin, self.last) = (None, None);
    }

    /// The map's lengths are `factor` times as long from now on.
    pub fn rescale(&mut self, factor: f64) {
        self.scale.rescale(factor);
        self.scale_ends(|_| factor);
        if let Some(last) = &mut self.last {
            last.translation *= factor;
        }
    }

    /// What the wheels say of the unit behind a turn: ln of how many of another part's it is long, and its standard deviation.
    pub fn ratio(&self, part: Option<TurnId>, of: Option<TurnId>) -> Option<(f64, f64)> {
        self.scale.ratio(unit_behind(part), unit_behind(of))
    }

    /// Parts with other units than the newest one's.
    pub fn others(&self) -> impl Iterator<Item = Option<TurnId>> {
        self.scale.others().map(turn_before)
    }

    /// The turn that the newest unit lies behind.
    pub fn newest_part(&self) -> Option<TurnId> {
        turn_before(self.scale.segments().last()?.unit)
    }

    /// Parts of the map have moved and been named anew.
    pub fn follow_parts(&mut self, parts: &Parts) {
        self.scale.follow_units(|unit| {
            let part = parts.of(turn_before(unit));
            (unit_behind(part.name), part.motion.scale)
        });
    }

    /// The surroundings of keyframes have moved so.
    pub fn follow_correction(&mut self, correction: &Correction) {
        self.scale_ends(|keyframe| correction.of(keyframe).scale);
        // The way from there to the next frame is none of the camera's.
        self.last = None;
    }

    fn scale_ends(&mut self, factor: impl Fn(KeyframeId) -> f64) {
        for end in self.ends.iter_mut().flat_map(|(a, b)| [a, b]).chain(&mut self.begin) {
            let factor = factor(end.keyframe);
            end.keyframe_from_camera.translation *= factor;
            end.depth *= factor;
        }
    }

    /// Takes a tracked frame. `true`: a segment has ended and the scale was asked anew.
    pub fn follow(&mut self, end: FrameEnd, map: &Map) -> bool {
        let Some(here) = end.world_from_camera(map) else {
            self.interrupt();
            return false;
        };
        if let Some(last) = self.last.replace(here) {
            self.depths += (here.translation - last.translation).norm() / end.depth;
        }
        let Some(begin) = self.begin else {
            self.begin = Some(end);
            return false;
        };
        let span_ns = end.timestamp_ns - begin.timestamp_ns;
        if span_ns < SEGMENT_NS {
            return false;
        }
        let Some(segment) = segment((&begin, &end), map, self.depths) else {
            self.begin = Some(end);
            return false;
        };
        let tells = segment.step.norm() > STEP_SIGMAS * segment.sigma || segment.turn.norm() > 0.1;
        if !tells && span_ns < LONGEST_SEGMENT_NS {
            return false;
        }
        self.begin = Some(end);
        self.renew(map);
        self.scale.push(segment);
        self.ends.push((begin, end));
        let kept = self.scale.segments();
        self.ends.retain(|(begin, _)| kept.binary_search_by_key(&begin.timestamp_ns, |s| s.from_ns).is_ok());
        true
    }

    /// How far the camera has gone from one time to another (ns), and its standard deviation, map units; `None` where the wheels have not told the
    /// map's scale, say nothing of that time, slipped in a part of it, or hardly moved.
    pub fn length(&self, fusion: &ScaleFusion, from_ns: i64, to_ns: i64) -> Option<(f64, f64)> {
        let metres_per_unit = fusion.word(ScaleSource::Wheels)?.exp();
        let slipped = |s: &Segment| s.slips && s.from_ns < to_ns && from_ns < s.to_ns;
        if self.scale.segments().iter().rev().take_while(|s| s.to_ns > from_ns).any(slipped) {
            return None;
        }
        let base = self.scale.between(from_ns, to_ns)?;
        let length = self.scale.robot().step_of(&base.motion).norm();
        let sigma = (base.covariance[(0, 0)] + base.covariance[(1, 1)]).max(0.0).sqrt();
        (length > MOVED_SIGMAS * sigma).then(|| (length / metres_per_unit, sigma / metres_per_unit))
    }

    /// The same in metres, an error common to both wheels taken out as far as other sources tell it: what a metric map is held to. Only of a
    /// time before the end of the newest segment, which have judged it but for frames that were not tracked and turns on the spot: held at once, the map bends
    /// to wheels that slip, and then they agree.
    pub fn held(&self, fusion: &ScaleFusion, from_ns: i64, to_ns: i64) -> Option<(f64, f64)> {
        let judged_ns = self.scale.segments().last()?.to_ns;
        if to_ns > judged_ns {
            return None;
        }
        let (log, ..) = fusion.fused()?;
        let (length, sigma) = self.length(fusion, from_ns, to_ns)?;
        Some((length * log.exp(), sigma * log.exp()))
    }

    /// Gives all segments the motions that the map has now.
    fn renew(&mut self, map: &Map) {
        let mut ends = self.ends.iter();
        self.scale.renew(|segment_before| {
            let Some((begin, end)) = ends.next() else { return };
            if let Some(now) = segment((begin, end), map, segment_before.at_depths) {
                let before = segment_before;
                (before.turn, before.step, before.sigma, before.unit) = (now.turn, now.step, now.sigma, now.unit);
            }
        });
    }
}

fn segment((begin, end): (&FrameEnd, &FrameEnd), map: &Map, at_depths: f64) -> Option<Segment> {
    let motion = begin.world_from_camera(map)?.inverse() * end.world_from_camera(map)?;
    let sigma = PLACE_SHARE * std::f64::consts::SQRT_2 * 0.5 * (begin.depth + end.depth);
    let times = (begin.timestamp_ns, end.timestamp_ns);
    let [unit, other] = [begin, end].map(|end| end.unit(map));
    let told = unit == other && motion.is_finite() && sigma > 0.0 && sigma.is_finite();
    if !told {
        return None;
    }
    Some(Segment::new(times, (motion.rotation.scaled_axis(), motion.translation), sigma, at_depths, unit?))
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;
    use crate::geometry::sim3::Sim3;
    use crate::map::examples;

    #[test]
    fn a_corrected_map_is_no_way_that_the_camera_went_and_lengths_take_its_unit() {
        let mut map = Map::default();
        let keyframe = map.add_keyframe(examples::keyframe(Default::default(), Se3::identity()));
        let step = Se3::new(UnitQuaternion::identity(), Vector3::x());
        let end = |timestamp_ns, depth| FrameEnd { timestamp_ns, keyframe, keyframe_from_camera: step, depth };
        let mut wheels = Wheels::new(Robot::unknown(), 0.01);
        wheels.follow(end(0, 2.0), &map);
        let moved = Sim3::new(3.0, UnitQuaternion::identity(), Vector3::y() * 10.0);
        let correction = Correction { keyframes: Vec::new(), younger: Some(moved) };
        map.correct(&correction);
        wheels.follow_correction(&correction);
        let begun = wheels.begin.expect("a segment has begun");
        assert_eq!((begun.depth, begun.keyframe_from_camera.translation.x), (6.0, 3.0));
        wheels.follow(end(33_000_000, 6.0), &map);
        assert_eq!(wheels.depths, 0.0);
    }
}
