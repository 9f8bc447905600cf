//! The scale of the present map by wheel odometry: a bounded window of segments, and when they are believed.
//!
//! Input: readings as they come, and segments of the present map (the camera's motion over [`SEGMENT_NS`] or more, map units). Output: what
//! they tell of the scale ([`ScaleMeasurement`]) and of the robot ([`Robot`]), and whether the wheels slipped in the newest segment.
//!
//! A scale is told once it is known to `TOLD_SIGMA`: the solution's sigma beside the doubt whether the wheels slipped in all of the time in which the
//! camera and they agreed (`slip_sigma`). An error common to both wheels, which one camera and the wheels cannot see, is then in its sigma, too.
//! The window is the newest `SEGMENTS` segments (140 s of driving and more): older ones are forgotten, for the scale of
//! a monocular map drifts; within the window that drift is a part of the model ([`super::hand_eye`]). What is known of the robot outlasts a map.
//!
//! Cost: a solution every few segments, 2 ms. Not here: what the map does with it.

use super::hand_eye::{Belief, OtherUnit, ROBOT, Robot, Segment, Solution, Unit, solve};
use super::planar::{Increment, WheelHistory};
use super::scale::ScaleMeasurement;
use super::wheel::WheelReading;
use crate::map::scale::ScaleSource;

/// A segment takes so long at the least, ns: long enough for steps above a camera's noise, short enough to tell when a wheel slips.
pub const SEGMENT_NS: i64 = 600_000_000;
/// And at the most, where frames are missing or the robot hardly moves, ns.
pub const LONGEST_SEGMENT_NS: i64 = 3_000_000_000;
/// A segment waits so long for what the wheels say of it, ns.
const WAITS_NS: i64 = 2_000_000_000;
/// Segments that are kept.
const SEGMENTS: usize = 240;
/// So many times as long as they tell any other scale wheels and camera must agree.
const BELIEVED_TIMES: f64 = 1.5;
/// Standard deviation up to which it is told, and up to which parts of a map whose ratio is known so have one unit.
pub const TOLD_SIGMA: f64 = 0.03;
/// Where camera and wheels agree so much worse than they should (variances), it is no noise that they disagree by: half of what is young is slip, and the
/// solution lies between both. (Without this limit 11 of 24 simulated drives with a burst every 8.5 s were at times told a scale up to 30 % wrong;
/// with it none more than 4 %.)
const TOLD_NOISE: f64 = 4.0;
/// What is known of the robot is, for the next map, so many times as uncertain: it may have been lifted meanwhile.
const NEXT_MAP: f64 = 2.0;

/// Standard deviation of a length that wheels tell in a moment, which may be the one at which they slip, as a share.
pub const MOMENT_SIGMA: f64 = 0.2;
/// That doubt falls with the time for which they agree, as a normal distribution's density, s: a wheel that spins or skids does so for a second or four.
/// (3 % after 4.1 s, 1 % after 5.2, 0.4 % after 6.)
const SLIP_S: f64 = 3.0;

/// Standard deviation of a scale on which wheels and camera agree so long, for all that the wheels may have slipped, as a share.
fn slip_sigma(belief: &Belief) -> f64 {
    let rivals = belief.seconds < BELIEVED_TIMES * belief.rival_s;
    if rivals { MOMENT_SIGMA } else { MOMENT_SIGMA * (-(belief.seconds / SLIP_S).powi(2)).exp() }
}

/// `[wheel]`: what is known of the base's wheels.
#[derive(Debug, Clone, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct WheelConfig {
    /// Standard deviation of an error common to both wheels' radii, as a share of them, 0.0..=0.1: it is the map's scale itself, which camera and
    /// wheels cannot tell apart.
    pub scale_sigma: f64,
}

impl Default for WheelConfig {
    fn default() -> Self {
        // Tyres, wear and a tape measure.
        Self { scale_sigma: 0.01 }
    }
}

impl WheelConfig {
    /// First value out of its range: key, and what is allowed.
    pub fn validate(&self) -> Result<(), (&'static str, String)> {
        // NaN is not within.
        match (0.0..=0.1).contains(&self.scale_sigma) {
            true => Ok(()),
            false => Err(("scale_sigma", "must be 0 to 0.1, a share (0.01: 1 %)".into())),
        }
    }
}

/// Wheels beside a camera.
#[derive(Debug, Clone)]
pub struct WheelScale {
    history: WheelHistory,
    /// Of the configuration, or of maps before.
    prior: Robot,
    given: Robot,
    /// An error common to both wheels' radii, as a share.
    radius_sigma: f64,
    segments: Vec<Segment>,
    solution: Option<Solution>,
    /// Readings that made no sense, and segments in which the wheels slipped.
    pub refused: u64,
    pub slips: u64,
    /// In the newest segment they did.
    pub slipping: bool,
}

impl WheelScale {
    /// `given`: what is known of the robot; `radius_sigma`: standard deviation of an error common to both wheels' radii, as a share.
    pub fn new(given: Robot, radius_sigma: f64) -> Self {
        Self {
            history: WheelHistory::default(),
            prior: given,
            given,
            radius_sigma,
            segments: Vec::new(),
            solution: None,
            refused: 0,
            slips: 0,
            slipping: false,
        }
    }

    /// Standard deviation of an error common to both wheels' radii, as a share.
    pub fn radius_sigma(&self) -> f64 {
        self.radius_sigma
    }

    /// Standard deviation of what they have told of the map's scale, such an error left out.
    pub fn sigma(&self) -> f64 {
        self.solution.map_or(TOLD_SIGMA, |s| s.sigma.hypot(slip_sigma(&s.belief)).min(TOLD_SIGMA))
    }

    /// Takes a reading; `false` if it makes no sense.
    pub fn add_reading(&mut self, reading: &WheelReading) -> bool {
        let taken = self.history.add(reading);
        self.refused += u64::from(!taken);
        taken
    }

    /// No readings have come yet.
    pub fn is_silent(&self) -> bool {
        self.history.is_empty()
    }

    /// Another map begins. What is known of the robot stays.
    pub fn begin_map(&mut self) {
        if let Some(solution) = self.solution.take() {
            let wider = |i: usize| (NEXT_MAP * solution.robot.sigma[i]).min(self.given.sigma[i]);
            self.prior = Robot { sigma: std::array::from_fn::<f64, ROBOT, _>(wider), ..solution.robot };
        }
        self.segments.clear();
        self.slipping = false;
    }

    /// The map's lengths are `factor` times as long from now on.
    pub fn rescale(&mut self, factor: f64) {
        for segment in &mut self.segments {
            segment.step *= factor;
            segment.sigma *= factor;
        }
        if let Some(solution) = &mut self.solution {
            solution.log_scale -= factor.ln();
        }
    }

    /// How long a unit of the map is: ln of how many of another, and its standard deviation.
    pub fn ratio(&self, unit: Unit, of: Unit) -> Option<(f64, f64)> {
        if unit == of {
            return Some((0.0, 0.0));
        }
        let ((log, sigma), (other_log, other_sigma)) = self.of_the_newest(unit).zip(self.of_the_newest(of))?;
        Some((log - other_log, sigma.hypot(other_sigma)))
    }

    /// The same of the newest one, in which they may slip at the moment.
    fn of_the_newest(&self, unit: Unit) -> Option<(f64, f64)> {
        let solution = self.of_newest().filter(|s| s.noise <= TOLD_NOISE)?;
        if solution.unit == unit {
            return Some((0.0, slip_sigma(&solution.belief)));
        }
        let other = solution.other_units.iter().flatten().find(|other| other.unit == unit)?;
        Some((other.log_ratio, other.sigma.hypot(slip_sigma(&other.belief))))
    }

    /// Units beside the newest one whose ratio is known.
    pub fn others(&self) -> impl Iterator<Item = Unit> {
        let others = self.of_newest().into_iter().flat_map(|solution| solution.other_units.iter().flatten());
        others.map(|other| other.unit)
    }

    /// The solution, if it is of the newest unit. While the readings of that one's first segment are on their way, the solution before stands for what is
    /// known of the robot, and tells nothing of the unit.
    fn of_newest(&self) -> Option<&Solution> {
        self.solution.as_ref().filter(|s| self.segments.last().is_none_or(|newest| newest.unit == s.unit))
    }

    /// Units are renamed, and lengths in them multiplied: name and factor for each.
    pub fn follow_units(&mut self, becomes: impl Fn(Unit) -> (Unit, f64)) {
        for segment in &mut self.segments {
            let (unit, factor) = becomes(segment.unit);
            segment.step *= factor;
            segment.sigma *= factor;
            segment.unit = unit;
        }
        let Some(solution) = &mut self.solution else { return };
        let (newest, own) = becomes(solution.unit);
        (solution.unit, solution.log_scale) = (newest, solution.log_scale - own.ln());
        for other in &mut solution.other_units {
            *other = other.and_then(|other| {
                let (unit, factor) = becomes(other.unit);
                let log_ratio = other.log_ratio + own.ln() - factor.ln();
                (unit != newest).then_some(OtherUnit { unit, log_ratio, ..other })
            });
        }
    }

    /// Renews the segments' motions as the map has them now: `camera` gives turn and step (as in [`Segment`]) of the one that begins at a time.
    pub fn renew(&mut self, mut camera: impl FnMut(&mut Segment)) {
        self.segments.iter_mut().for_each(&mut camera);
    }

    /// Takes a segment of the present map and solves anew. The wheels may still have to tell of its end: messages are on their way, and their
    /// clock may lag. A segment of which they have told nothing in `WAITS_NS` is dropped.
    pub fn push(&mut self, segment: Segment) {
        let known = self.robot();
        if self.segments.len() == SEGMENTS {
            self.segments.remove(0);
        }
        let oldest_ns = segment.to_ns.saturating_sub(WAITS_NS);
        self.segments.push(segment);
        self.segments.retain_mut(|s| s.weigh(&self.history, &known) || s.to_ns > oldest_ns);
        self.solution = solve(&mut self.segments, &self.history, &self.prior, &known).or(self.solution);
        self.slipping = self.solution.is_some() && self.segments.last().is_some_and(|s| s.slips);
        self.slips += u64::from(self.slipping);
    }

    /// Oldest first.
    pub fn segments(&self) -> &[Segment] {
        &self.segments
    }

    /// What is known of the robot.
    pub fn robot(&self) -> Robot {
        self.solution.map_or(self.prior, |s| s.robot)
    }

    /// ln(metres per map unit) and its standard deviation, an error common to both wheels in it; `None` until they are believed.
    pub fn measurement(&self) -> Option<ScaleMeasurement> {
        let s = self.of_newest().filter(|s| s.noise <= TOLD_NOISE)?;
        let told = s.sigma.hypot(slip_sigma(&s.belief));
        let sigma = Some(told).filter(|told| *told <= TOLD_SIGMA)?.hypot(self.radius_sigma);
        Some(ScaleMeasurement { source: ScaleSource::Wheels, log_metres_per_unit: s.log_scale, sigma })
    }

    /// The base's motion between two times of pictures, ns, corrected by what is known of the wheels.
    pub fn between(&self, from_ns: i64, to_ns: i64) -> Option<Increment> {
        let robot = self.robot();
        let offset_ns = (robot.time_offset_s * 1e9).round() as i64;
        self.history.integrate(from_ns.saturating_add(offset_ns), to_ns.saturating_add(offset_ns), robot.yaw_factor)
    }

    /// The same up to a picture whose readings may still be on their way: the newest one holds for `longest_ns` at the most.
    pub fn ahead(&self, from_ns: i64, to_ns: i64, longest_ns: i64) -> Option<Increment> {
        let robot = self.robot();
        let offset_ns = (robot.time_offset_s * 1e9).round() as i64;
        let (from_ns, to_ns) = (from_ns.saturating_add(offset_ns), to_ns.saturating_add(offset_ns));
        self.history.integrate_until(from_ns, to_ns, robot.yaw_factor, longest_ns)
    }
}

#[cfg(test)]
mod tests;
