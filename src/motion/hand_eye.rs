//! A camera and the wheels of its robot: what both saw of the same motions, brought together.
//!
//! Input: segments, each the camera's motion (map units) and the wheels' ([`WheelHistory::integrate`]) over the same time. Output, from one
//! nonlinear least squares problem over all of them: the length of a map unit in metres and how it drifted along the way, the camera's
//! place on the base (rotation, and its lever x and y), the factor on the wheels' yaw rate, the time offset; their covariance; and
//! which segments the wheels slipped in. With `A = (R_A, t_A)` the camera's motion, `(theta, d)` the base's, `(R, p)` `base_from_camera`:
//!
//! ```text
//! turn:  R log(R_A)    = [0, 0, theta(k, t)]
//! step:  e^l R t_A     = (Rz(phi) - I) p + d(k, t)      phi: the camera's turn about the base's up, which it knows better than the wheels
//! drift: l is linear between knots along the way; l_j+1 - l_j ~ N(0, q way_j)      q: a random walk, by the way in mean depths
//! units: in a part of the map that has another unit than the newest, r_u is added to l
//! ```
//!
//! Behind a turn on the spot whose next step had a length that was assumed, or told by wheels in a moment, a map goes on in another unit ([`Unit`]): no drift
//! makes such a jump. Each unit's ratio is an unknown of its own, and what is known of the robot is known in all of them.
//!
//! (Hand-eye calibration with planar motion: Guo, Mirzaei, Roumeliotis 2012 and Heng, Li, Pollefeys 2013 for the mount, Censi et al. 2013 for
//! factor and trust.) Straight driving tells yaw and pitch of the camera, turning tells roll and pitch, yaw rate factor and lever; what the motions
//! so far do not tell stays at its prior, and its sigma says so. The lever's height never shows. An error common to both wheels' radii is
//! the scale itself and cannot be seen here: [`super::wheel_scale`] adds its prior.
//!
//! Slip: residuals go through Cauchy's loss, at a noise level that is read off their median; segments that then contradict are left out of
//! a last pass and of the covariance. That holds as long as the wheels are right in most segments.
//!
//! Cost: 200 segments take about 2 ms. Not here: which motions make a segment, when a scale is believed.

mod robot;
mod segment;

use nalgebra::{Matrix3, SMatrix, SVector, UnitQuaternion, Vector3};

use self::robot::swing;
pub use self::robot::{ROBOT, Robot};
pub use self::segment::{Belief, Segment, Unit};
use self::segment::{SLIP_SHARE, TELLING, Wheels};
use super::planar::WheelHistory;
use crate::geometry::least_squares::{LeastSquares, LmOptions, Loss, NormalEquations, minimise};
use crate::geometry::median;

/// Places along the way at which the scale is an unknown of its own.
pub const KNOTS: usize = 6;
/// Units beside the newest one whose ratio to it is found; segments of older ones are left out.
const OTHERS: usize = 7;
const UNKNOWNS: usize = KNOTS + ROBOT + OTHERS;
const RATIO: usize = KNOTS + ROBOT;
const LEVER: usize = KNOTS + 3;
const FACTOR: usize = KNOTS + 5;
const OFFSET: usize = KNOTS + 6;

/// Standard deviation of the logarithm of a monocular map's scale from one place to another a mean depth further on.
pub const DRIFT_PER_ROOT_DEPTH: f64 = 0.006;
/// Standard deviation of the logarithm of two units' ratio: next to nothing is known of it.
const RATIO_SIGMA: f64 = 2.0;
/// Standard deviations beside those of the wheels and of the camera's step: floors are no planes and a base rocks on its wheels; rad, and as
/// shares of the way across it and upwards.
pub const ROCKING_RAD: f64 = 0.004;
const TURN_RAD: f64 = 0.0015;
const SIDEWAYS_SHARE: f64 = 0.005;
pub const UPWARDS_SHARE: f64 = 0.01;
/// Scale of Cauchy's loss, standard deviations of a residual of three numbers; and beyond which a segment contradicts.
const CAUCHY: f64 = 3.0;
const CONTRADICTS: f64 = 4.5;
/// Median of chi squared with three degrees of freedom.
const CHI2_3D_MEDIAN: f64 = 2.366;
/// The noise level is taken from the residuals within these bounds (variances, as a factor on what is expected).
const NOISE: (f64, f64) = (0.1, 16.0);
/// Passes with the loss, each at wheels and weights renewed.
const PASSES: usize = 3;
/// Below this a segment tells no direction, rad of turn.
const STRAIGHT_RAD: f64 = 0.08;

/// All unknowns.
#[derive(Debug, Clone, Copy)]
struct State {
    log_scale: [f64; KNOTS],
    /// ln(metres per unit there) - ln(metres per the newest unit).
    log_ratio: [f64; OTHERS],
    robot: Robot,
}

/// A unit before the newest.
#[derive(Debug, Clone, Copy)]
pub struct OtherUnit {
    pub unit: Unit,
    /// ln of how many of the newest unit it is long, and its standard deviation.
    pub log_ratio: f64,
    pub sigma: f64,
    pub belief: Belief,
}

/// What the segments tell.
#[derive(Debug, Clone, Copy)]
pub struct Solution {
    /// The newest unit, which the scale is of.
    pub unit: Unit,
    /// ln(metres per map unit), now.
    pub log_scale: f64,
    /// Its standard deviation, an error common to both wheels left out.
    pub sigma: f64,
    pub other_units: [Option<OtherUnit>; OTHERS],
    pub robot: Robot,
    /// Of the newest unit.
    pub belief: Belief,
    /// Variance of the steps' residuals, as a factor on what is expected of both.
    pub noise: f64,
}

/// A segment's part of the problem, weights fixed.
struct Term<'a> {
    segment: &'a Segment,
    wheels: Wheels,
    /// Knot before it and the share of the next.
    knot: (usize, f64),
    /// Of another unit than the newest.
    other: Option<usize>,
    /// One over the standard deviations: turn, step.
    weight: [Vector3<f64>; 2],
}

struct Problem<'a> {
    terms: Vec<Term<'a>>,
    prior: &'a Robot,
    /// One over the standard deviation of the scale's drift between two knots.
    stiffness: f64,
    loss: Loss,
}

/// Knot before a place on the way, and the share of the next; and the way between two knots.
fn knots(segments: &[Segment]) -> (impl Fn(f64) -> (usize, f64), f64) {
    let first = segments.first().map_or(0.0, |s| s.at_depths);
    let last = segments.last().map_or(0.0, |s| s.at_depths);
    let between = ((last - first) / (KNOTS - 1) as f64).max(1e-6);
    let place = move |at: f64| {
        let place = ((at - first) / between).clamp(0.0, (KNOTS - 1) as f64);
        let knot = (place.floor() as usize).min(KNOTS - 2);
        (knot, place - knot as f64)
    };
    (place, between)
}

/// ln(metres per unit) at a place of the way, in a unit.
fn log_scale(state: &State, (knot, share): (usize, f64), other: Option<usize>) -> f64 {
    let ratio = other.map_or(0.0, |other| state.log_ratio[other]);
    state.log_scale[knot] * (1.0 - share) + state.log_scale[knot + 1] * share + ratio
}

/// The newest unit, and those before it that the solution knows.
fn units(segments: &[Segment]) -> (Unit, [Option<Unit>; OTHERS]) {
    let (newest, mut others) = (segments.last().map_or_else(Unit::default, |s| s.unit), [None; OTHERS]);
    for unit in segments.iter().rev().map(|s| s.unit).filter(|unit| *unit != newest) {
        if others.contains(&Some(unit)) {
            continue;
        }
        let Some(free) = others.iter_mut().find(|other| other.is_none()) else { break };
        *free = Some(unit);
    }
    (newest, others)
}

impl Term<'_> {
    /// Whitened residuals of turn and step.
    fn residual(&self, state: &State) -> [Vector3<f64>; 2] {
        let robot = &state.robot;
        let base = self.wheels.at(robot.yaw_factor, robot.time_offset_s);
        let turned = robot.base_from_camera * self.segment.turn;
        let turn = turned - Vector3::new(0.0, 0.0, base.z);
        let step = self.step(state) - swing(turned.z, &robot.lever_m) - Vector3::new(base.x, base.y, 0.0);
        [turn.component_mul(&self.weight[0]), step.component_mul(&self.weight[1])]
    }

    fn log_scale(&self, state: &State) -> f64 {
        log_scale(state, self.knot, self.other)
    }

    /// `e^l R t_A`
    fn step(&self, state: &State) -> Vector3<f64> {
        state.robot.base_from_camera * self.segment.step * self.log_scale(state).exp()
    }

    /// Their derivatives by all unknowns.
    fn jacobian(&self, state: &State) -> [SMatrix<f64, 3, UNKNOWNS>; 2] {
        let robot = &state.robot;
        let (turned, step) = (robot.base_from_camera * self.segment.turn, self.step(state));
        let (s, c) = turned.z.sin_cos();
        let p = robot.lever_m;
        let by_yaw = Vector3::new(-s * p.x - c * p.y, c * p.x - s * p.y, 0.0);
        let [mut t, mut d] = [SMatrix::<f64, 3, UNKNOWNS>::zeros(), SMatrix::<f64, 3, UNKNOWNS>::zeros()];
        t.fixed_view_mut::<3, 3>(0, KNOTS).copy_from(&-turned.cross_matrix());
        d.fixed_view_mut::<3, 3>(0, KNOTS).copy_from(&(by_yaw * turned.cross_matrix().row(2) - step.cross_matrix()));
        let (knot, share) = self.knot;
        d.set_column(knot, &(step * (1.0 - share)));
        d.set_column(knot + 1, &(step * share));
        if let Some(other) = self.other {
            d.set_column(RATIO + other, &step);
        }
        d.set_column(LEVER, &-Vector3::new(c - 1.0, s, 0.0));
        d.set_column(LEVER + 1, &-Vector3::new(-s, c - 1.0, 0.0));
        for (column, by) in [(FACTOR, self.wheels.by_factor), (OFFSET, self.wheels.by_offset)] {
            t.set_column(column, &Vector3::new(0.0, 0.0, -by.z));
            d.set_column(column, &-Vector3::new(by.x, by.y, 0.0));
        }
        for i in 0..3 {
            t.row_mut(i).scale_mut(self.weight[0][i]);
            d.row_mut(i).scale_mut(self.weight[1][i]);
        }
        [t, d]
    }
}

impl Problem<'_> {
    /// Whitened residuals of the priors, and the columns and weights that they stand for.
    fn priors(&self, state: &State) -> [(f64, usize, f64); ROBOT + OTHERS] {
        let (prior, now) = (self.prior, &state.robot);
        let turn = (now.base_from_camera * prior.base_from_camera.inverse()).scaled_axis();
        let lever = now.lever_m - prior.lever_m;
        let factor = now.yaw_factor - prior.yaw_factor;
        let off = [turn.x, turn.y, turn.z, lever.x, lever.y, factor, now.time_offset_s - prior.time_offset_s];
        std::array::from_fn(|i| {
            let (off, sigma) = match i.checked_sub(ROBOT) {
                Some(other) => (state.log_ratio[other], RATIO_SIGMA),
                None => (off[i], prior.sigma[i]),
            };
            (off / sigma, KNOTS + i, 1.0 / sigma)
        })
    }
}

impl LeastSquares for Problem<'_> {
    type State = State;
    type Normal = NormalEquations<UNKNOWNS>;

    fn linearise(&self, state: &State) -> Self::Normal {
        let mut normal = NormalEquations::default();
        for term in &self.terms {
            for (residual, jacobian) in term.residual(state).iter().zip(term.jacobian(state)) {
                let (_, weight) = self.loss.evaluate(residual.norm_squared());
                for i in 0..3 {
                    normal.add(&jacobian.row(i).transpose(), residual[i], weight);
                }
            }
        }
        for (residual, column, weight) in self.priors(state) {
            let mut row = SVector::<f64, UNKNOWNS>::zeros();
            row[column] = weight;
            normal.add(&row, residual, 1.0);
        }
        for j in 1..KNOTS {
            let mut row = SVector::<f64, UNKNOWNS>::zeros();
            (row[j - 1], row[j]) = (-self.stiffness, self.stiffness);
            normal.add(&row, (state.log_scale[j] - state.log_scale[j - 1]) * self.stiffness, 1.0);
        }
        normal
    }

    fn cost(&self, state: &State) -> f64 {
        let of_term = |term: &Term<'_>| term.residual(state).map(|r| self.loss.evaluate(r.norm_squared()).0);
        let terms: f64 = self.terms.iter().map(|term| of_term(term).iter().sum::<f64>()).sum();
        let priors: f64 = self.priors(state).iter().map(|p| p.0 * p.0).sum();
        let drift = state.log_scale.windows(2).map(|l| ((l[1] - l[0]) * self.stiffness).powi(2));
        terms + priors + drift.sum::<f64>()
    }

    fn step(&self, state: &State, delta: &SVector<f64, UNKNOWNS>) -> State {
        let mut next = *state;
        next.log_scale.iter_mut().zip(delta.iter()).for_each(|(l, d)| *l += d);
        next.log_ratio.iter_mut().zip(delta.iter().skip(RATIO)).for_each(|(r, d)| *r += d);
        let robot = &mut next.robot;
        let turn = delta.fixed_rows::<3>(KNOTS).into_owned();
        robot.base_from_camera = UnitQuaternion::from_scaled_axis(turn) * robot.base_from_camera;
        robot.lever_m += delta.fixed_rows::<2>(LEVER);
        robot.yaw_factor += delta[FACTOR];
        robot.time_offset_s += delta[OFFSET];
        next
    }
}

/// Where the search may begin: the mount by the directions of straight driving and of the axes of turns, the scale by the quartiles of the ways'
/// ratios (a burst of slip at the beginning may well be half of all).
fn starts(segments: &[Segment], prior: &Robot) -> Option<[State; 3]> {
    let mut robot = *prior;
    if !prior.knows_rotation() {
        // Wahba's problem. A little of the prior says what no motion tells.
        let mut sum = 0.1 * prior.base_from_camera.to_rotation_matrix().into_inner();
        for (s, base) in segments.iter().filter_map(|s| Some((s, s.wheels.as_ref()?.increment.motion))) {
            if base.yaw.abs() < STRAIGHT_RAD && s.step.norm() > TELLING * s.sigma && base.translation.norm() > 1e-3 {
                sum += base.translation.push(0.0).normalize() * s.step.normalize().transpose();
            }
            if base.yaw.abs() > STRAIGHT_RAD && s.turn.norm() > 0.5 * STRAIGHT_RAD {
                sum += Vector3::new(0.0, 0.0, base.yaw.signum()) * s.turn.normalize().transpose();
            }
        }
        let svd = sum.svd(true, true);
        let (u, v) = (svd.u?, svd.v_t?);
        let proper = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v).determinant().signum()));
        let rotation = nalgebra::Rotation3::from_matrix_unchecked(u * proper * v);
        robot.base_from_camera = UnitQuaternion::from_rotation_matrix(&rotation);
    }
    let (newest, others) = units(segments);
    let quartile = |unit: Unit, quarter: usize| {
        let ratio = |s: &Segment| s.log_metres_per_unit(&robot).filter(|log| log.is_finite());
        let mut ratios: Vec<f64> = segments.iter().filter(|s| s.unit == unit).filter_map(ratio).collect();
        ratios.sort_unstable_by(f64::total_cmp);
        ratios.get(quarter * ratios.len() / 4).copied()
    };
    let state = |quarter: usize| {
        // A unit that has only begun tells nothing yet: it is taken for the one before.
        let known = std::iter::once(newest).chain(others.into_iter().flatten());
        let log_scale = known.into_iter().find_map(|unit| quartile(unit, quarter))?;
        let log_ratio = others.map(|other| quartile(other?, quarter)).map(|log| log.map_or(0.0, |log| log - log_scale));
        Some(State { log_scale: [log_scale; KNOTS], log_ratio, robot })
    };
    Some([state(2)?, state(1)?, state(3)?])
}

/// The problem at a state: residuals weighed by what is expected of them there, times the noise levels (variances) of turns and steps.
fn problem<'a>(
    segments: &'a [Segment],
    prior: &'a Robot,
    state: &State,
    noise: [f64; 2],
    loss: Loss,
    among: impl Fn(&Segment) -> bool,
) -> Problem<'a> {
    let (place, between) = knots(segments);
    let (newest, others) = units(segments);
    let term = |segment: &'a Segment| {
        let wheels = segment.wheels.filter(|_| among(segment))?;
        let knot = place(segment.at_depths);
        let other = match segment.unit == newest {
            true => None,
            false => Some(others.iter().position(|other| *other == Some(segment.unit))?),
        };
        let log_scale = log_scale(state, knot, other);
        let (p, way) = (wheels.increment.covariance, wheels.increment.way_m);
        let seen = (log_scale.exp() * segment.sigma).powi(2);
        let turn = Vector3::new(ROCKING_RAD.powi(2), ROCKING_RAD.powi(2), p[(2, 2)] + TURN_RAD.powi(2));
        let step = Vector3::new(
            p[(0, 0)] + seen,
            p[(1, 1)] + seen + (SIDEWAYS_SHARE * way).powi(2),
            seen + (UPWARDS_SHARE * way).powi(2) + 1e-6,
        );
        let weight = [turn * noise[0], step * noise[1]].map(|v| v.map(|v| 1.0 / v.sqrt()));
        Some(Term { segment, wheels, knot, other, weight })
    };
    let terms = segments.iter().filter_map(term).collect();
    Problem { terms, prior, stiffness: 1.0 / (DRIFT_PER_ROOT_DEPTH * between.sqrt()), loss }
}

/// Noise levels by the median of the residuals at a state.
fn noise(problem: &Problem<'_>, state: &State, before: [f64; 2]) -> [f64; 2] {
    std::array::from_fn(|i| {
        let mut chi2: Vec<f64> = problem.terms.iter().map(|t| t.residual(state)[i].norm_squared()).collect();
        let level = median(&mut chi2).unwrap_or(CHI2_3D_MEDIAN) / CHI2_3D_MEDIAN;
        (before[i] * level).clamp(NOISE.0, NOISE.1)
    })
}

/// What the segments tell; marks those in which the wheels slip. `None`: they do not tell enough.
pub fn solve(segments: &mut [Segment], history: &WheelHistory, prior: &Robot, known: &Robot) -> Option<Solution> {
    segments.iter_mut().for_each(|s| _ = s.weigh(history, known));
    let mut begin = *prior;
    if known.knows_rotation() {
        begin = Robot { sigma: [0.1; ROBOT], ..*known };
    }
    let options = LmOptions { max_iterations: 15, relative_cost: 1e-8, ..LmOptions::default() };
    let mut level = [1.0; 2];
    let tried = starts(segments, &begin)?.map(|start| {
        let now = problem(segments, prior, &start, level, Loss::Cauchy(CAUCHY), |_| true);
        let (state, summary) = minimise(&now, start, &options);
        (summary.final_cost, state)
    });
    let mut state = tried.into_iter().min_by(|a, b| a.0.total_cmp(&b.0))?.1;
    for _ in 0..PASSES {
        let now = problem(segments, prior, &state, level, Loss::Cauchy(CAUCHY), |_| true);
        state = minimise(&now, state, &options).0;
        level = noise(&now, &state, level);
        segments.iter_mut().for_each(|s| _ = s.weigh(history, &state.robot));
    }
    let now = problem(segments, prior, &state, level, Loss::Squared, |_| true);
    let slips: Vec<i64> = now.terms.iter().filter(|t| contradicts(t, &state)).map(|t| t.segment.from_ns).collect();
    segments.iter_mut().for_each(|s| s.slips = slips.binary_search(&s.from_ns).is_ok());
    let segments = &*segments;
    let now = problem(segments, prior, &state, level, Loss::Huber(CAUCHY), |s| !s.slips);
    state = minimise(&now, state, &options).0;
    finish(&now, &state, segments, level[1])
}

/// Whether a segment's residual is none that noise makes.
fn contradicts(term: &Term<'_>, state: &State) -> bool {
    let far = term.residual(state).iter().any(|r| r.norm() > CONTRADICTS);
    let base = term.wheels.at(state.robot.yaw_factor, state.robot.time_offset_s);
    let turned_z = (state.robot.base_from_camera * term.segment.turn).z;
    let wheels = swing(turned_z, &state.robot.lever_m) + Vector3::new(base.x, base.y, 0.0);
    let longer = wheels.norm().max(term.step(state).norm());
    let apart = (wheels - term.step(state)).norm() > SLIP_SHARE * longer;
    let turned = (base.z - turned_z).abs() > SLIP_SHARE * base.z.abs();
    far && (apart || turned)
}

/// Reads covariance and trust off the solution.
fn finish(problem: &Problem<'_>, state: &State, segments: &[Segment], noise: f64) -> Option<Solution> {
    let mut information = problem.linearise(state).hessian;
    information.fill_upper_triangle_with_lower_triangle();
    let covariance = information.cholesky()?.inverse();
    let mut robot = state.robot;
    robot.sigma = std::array::from_fn(|i| covariance[(KNOTS + i, KNOTS + i)].max(0.0).sqrt());
    let (newest, others) = units(segments);
    let belief = Belief::of(segments, newest, &state.robot)?;
    let (log_scale, sigma) = (state.log_scale[KNOTS - 1], covariance[(KNOTS - 1, KNOTS - 1)].sqrt());
    let finite = log_scale.is_finite() && sigma.is_finite() && robot.sigma.iter().all(|s| s.is_finite());
    finite.then_some(Solution {
        unit: newest,
        log_scale,
        sigma,
        other_units: std::array::from_fn(|i| {
            let sigma = covariance[(RATIO + i, RATIO + i)].sqrt();
            let unit = others[i]?;
            Some(OtherUnit {
                unit,
                log_ratio: state.log_ratio[i],
                sigma,
                belief: Belief::of(segments, unit, &state.robot)?,
            })
        }),
        robot,
        belief,
        noise,
    })
}

#[cfg(test)]
mod tests;
