//! From tracked frames to segments: the camera's motion of half a second and more, as the map has it now.
//!
//! Each end of a segment is a frame beside a keyframe, as in a trajectory, so that what an adjustment finds later of both keyframes is in the
//! segment the next time it is asked. Once a keyframe is gone, the segment keeps the motion that it had.

use crate::geometry::Se3;
use crate::geometry::frames::{Camera, Keyframe as KeyframeFrame, World};
use crate::map::scale::ScaleSource;
use crate::map::{KeyframeId, Map};
use crate::motion::hand_eye::{Robot, Segment};
use crate::motion::scale::ScaleFusion;
use crate::motion::wheel_scale::{LONGEST_SEGMENT_NS, SEGMENT_NS, WheelScale};

/// Standard deviation of a frame's place beside a keyframe, as a share of the mean depth: 0.8 px of a focal length of 500 px, 150 landmarks, and
/// what of their errors is common.
const PLACE_SHARE: f64 = 0.001;
/// A step below so many of its standard deviations waits to become longer.
const STEP_SIGMAS: f64 = 20.0;

/// Wheels that moved by fewer of their standard deviations tell no length.
const MOVED_SIGMAS: f64 = 5.0;

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
}

/// Wheels beside the present map.
#[derive(Debug)]
pub struct Wheels {
    pub scale: WheelScale,
    /// Ends of the segments that `scale` has, the oldest first, and of others that it had.
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
        let ends = self.ends.iter_mut().flat_map(|(a, b)| [a, b]).chain(&mut self.begin);
        for end in ends {
            end.keyframe_from_camera.translation *= factor;
            end.depth *= factor;
        }
        if let Some(last) = &mut self.last {
            last.translation *= factor;
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
        let taken = self.scale.push(segment);
        if taken {
            self.ends.push((begin, end));
            let kept = self.scale.segments().len();
            self.ends.drain(..self.ends.len().saturating_sub(kept));
        }
        taken
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

    /// The same in metres, an error common to both wheels taken out as far as other sources tell it: what a metric map is held to.
    pub fn held(&self, fusion: &ScaleFusion, from_ns: i64, to_ns: i64) -> Option<(f64, f64)> {
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
                (segment_before.turn, segment_before.step) = (now.turn, now.step);
            }
        });
    }
}

fn segment((begin, end): (&FrameEnd, &FrameEnd), map: &Map, at_depths: f64) -> Option<Segment> {
    let motion = begin.world_from_camera(map)?.inverse() * end.world_from_camera(map)?;
    let sigma = PLACE_SHARE * std::f64::consts::SQRT_2 * 0.5 * (begin.depth + end.depth);
    let times = (begin.timestamp_ns, end.timestamp_ns);
    let told = motion.is_finite() && sigma > 0.0 && sigma.is_finite();
    told.then(|| Segment::new(times, (motion.rotation.scaled_axis(), motion.translation), sigma, at_depths))
}
