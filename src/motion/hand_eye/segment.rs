//! The same motion as the camera and the wheels saw it, and how long they agreed.

use nalgebra::Vector3;

use super::robot::Robot;
use crate::motion::planar::{Increment, Planar, WheelHistory};

/// A segment whose ways differ by less than this is no slip, whatever its residual.
pub(super) const SLIP_SHARE: f64 = 0.06;
/// A step below so many of its standard deviations tells nothing.
pub(super) const TELLING: f64 = 10.0;
/// Steps of the numeric derivatives by factor and offset.
const FACTOR_STEP: f64 = 1e-3;
const OFFSET_STEP_S: f64 = 2e-3;

/// What the wheels say of a segment, near some yaw rate factor and time offset.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wheels {
    near: (f64, f64),
    pub(super) increment: Increment,
    /// Derivatives of x, y, yaw.
    pub(super) by_factor: Vector3<f64>,
    pub(super) by_offset: Vector3<f64>,
}

impl Wheels {
    fn of(history: &WheelHistory, (from_ns, to_ns): (i64, i64), factor: f64, offset_s: f64) -> Option<Self> {
        let at = |factor: f64, offset_s: f64| {
            let offset_ns = (offset_s * 1e9).round() as i64;
            history.integrate(from_ns.saturating_add(offset_ns), to_ns.saturating_add(offset_ns), factor)
        };
        let numbers = |i: &Increment| i.motion.translation.push(i.motion.yaw);
        let increment = at(factor, offset_s)?;
        let here = numbers(&increment);
        let by_factor = (numbers(&at(factor + FACTOR_STEP, offset_s)?) - here) / FACTOR_STEP;
        // The newest readings may not reach further: the other side will do.
        let later = at(factor, offset_s + OFFSET_STEP_S).map(|i| (numbers(&i) - here) / OFFSET_STEP_S);
        let earlier = || at(factor, offset_s - OFFSET_STEP_S).map(|i| (here - numbers(&i)) / OFFSET_STEP_S);
        let by_offset = later.or_else(earlier)?;
        Some(Self { near: (factor, offset_s), increment, by_factor, by_offset })
    }

    pub(super) fn at(&self, factor: f64, offset_s: f64) -> Vector3<f64> {
        let Planar { translation, yaw } = self.increment.motion;
        translation.push(yaw) + self.by_factor * (factor - self.near.0) + self.by_offset * (offset_s - self.near.1)
    }
}

/// Names a part of a map that has one unit of length; its scale drifts, and no more.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Unit(pub u32);

/// The same motion, seen by the camera and by the wheels.
#[derive(Debug, Clone, Copy)]
pub struct Segment {
    /// Clock of the pictures.
    pub from_ns: i64,
    pub to_ns: i64,
    /// The camera's motion, start_from_end: axis times angle (rad), and translation (map units), in its axes at the start.
    pub turn: Vector3<f64>,
    pub step: Vector3<f64>,
    /// Standard deviation of each axis of `step`, map units.
    pub sigma: f64,
    /// The way of the camera up to here since its map began, in mean depths of the scene.
    pub at_depths: f64,
    /// Part of the map whose lengths have one unit: behind a turn on the spot whose next step had a length that was assumed, or told by
    /// wheels in a moment, begins another.
    pub unit: Unit,
    pub(super) wheels: Option<Wheels>,
    /// By the last solution: the wheels contradict.
    pub slips: bool,
}

impl Segment {
    pub fn new(
        (from_ns, to_ns): (i64, i64),
        (turn, step): (Vector3<f64>, Vector3<f64>),
        sigma: f64,
        at_depths: f64,
        unit: Unit,
    ) -> Self {
        Self { from_ns, to_ns, turn, step, sigma, at_depths, unit, wheels: None, slips: false }
    }

    /// What the wheels say, near what is known of the robot; stays as it was where the readings are gone. `false`: they say nothing.
    pub fn weigh(&mut self, history: &WheelHistory, robot: &Robot) -> bool {
        let renewed = Wheels::of(history, (self.from_ns, self.to_ns), robot.yaw_factor, robot.time_offset_s);
        self.wheels = renewed.or(self.wheels);
        self.wheels.is_some()
    }

    /// ln of the metres that the wheels make of a map unit here; `None` where they say nothing, or the camera's step tells nothing.
    pub(super) fn log_metres_per_unit(&self, robot: &Robot) -> Option<f64> {
        let wheels = self.wheels.filter(|_| self.step.norm() > TELLING * self.sigma)?;
        Some((robot.step_of(&wheels.increment.motion).norm() / self.step.norm()).ln())
    }

    /// By the wheels, m; 0 where they say nothing.
    pub fn way_m(&self) -> f64 {
        self.wheels.map_or(0.0, |w| w.increment.way_m)
    }
}

/// How long the wheels and the camera agreed in a unit, and how long at the most on another scale.
#[derive(Debug, Clone, Copy)]
pub struct Belief {
    /// Time in motion in which they agreed, s.
    pub seconds: f64,
    /// The most time in which the wheels slipped and told one scale all the same, s: a wheel spins for some seconds, and not always as much.
    pub rival_s: f64,
}

impl Belief {
    /// `None`: nothing has moved.
    pub(super) fn of(segments: &[Segment], unit: Unit, robot: &Robot) -> Option<Self> {
        let told = || {
            let of_unit = segments.iter().filter(|s| s.unit == unit);
            of_unit.filter_map(|s| Some((s.slips, s.log_metres_per_unit(robot)?, (s.to_ns - s.from_ns) as f64 * 1e-9)))
        };
        let slipped: Vec<(f64, f64)> = told().filter(|s| s.0).map(|(_, log, span)| (log, span)).collect();
        let alike = |from: &(f64, f64)| {
            slipped.iter().filter(|s| (0.0..=SLIP_SHARE).contains(&(s.0 - from.0))).map(|s| s.1).sum()
        };
        let rival_s = slipped.iter().map(alike).fold(0.0, f64::max);
        let seconds = told().filter(|s| !s.0).map(|s| s.2).sum();
        told().next().map(|_| Self { seconds, rival_s })
    }
}
