//! The plane that a driven camera moves parallel to, at one height: found among landmarks, or refused with the reason.
//!
//! Landmarks (position, covariance) and cameras (poses in order of time) in the map's unit, and where "up" is in the camera as far as the mount
//! tells -> unit normal n, height H of the cameras above the plane with its standard deviation, tilt of the mount, and how far the camera was driven over it
//! ([`Found`]); or [`NoFloor`].
//!
//! 1. Candidates: planes through three landmarks that lie below the camera (RANSAC, Fischler and Bolles 1981, seeded), with a normal that the mount
//!    allows. The score counts landmarks on the plane, less those beneath it: below a floor there is nothing, below a table top there is.
//! 2. Fit of n (2), a and H over `(n·pᵢ - a + H) / sᵢ` for landmarks, `(n·cₖ - a) / s_c` for camera centres, and the tilt of n from the mount's up
//!    over its sigma. What stands on a floor would lift the plane, as nothing lies beneath it to lower it again. So a landmark down there is on the floor,
//!    or of a thing on it, or a mistake beneath it, at any distance up to `REACH`; it weighs by its probability to be on the floor, and the shares
//!    of the three are found with the plane (expectation and maximisation: Dempster, Laird, Rubin 1977), one Gauss-Newton step to each maximisation.
//! 3. Asked: whether the cameras keep one height above it, nothing lies beneath it, and **the camera was driven over it**: landmarks of the plane on the
//!    strip below the way that was driven, at several stations along it. Nobody drives over a table top, a sofa or a shelf; a wall's normal is not up.
//!
//! Lengths in the tests are shares of H, so they mean the same in any unit. Cost: a few ms for 400 landmarks, 40 cameras (200 candidates).
//! Deliberately not here: ramps and thresholds in the house (the cameras would not keep one height), floors that are no planes.

use std::f64::consts::{FRAC_PI_4, PI};

use nalgebra::{Matrix3, Matrix4, Unit, UnitQuaternion, Vector3, Vector4};

use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::geometry::random::Random;
use crate::geometry::sim3::Sim3;

/// A landmark, in the map's unit.
#[derive(Debug, Clone, Copy)]
pub struct FloorPoint {
    pub position: Vector3<f64>,
    pub covariance: Matrix3<f64>,
}

/// Where the mount has "up" in the camera's optical axes.
#[derive(Debug, Clone, Copy)]
pub struct UpPrior {
    pub up_camera: Unit<Vector3<f64>>,
    /// Standard deviation of roll and pitch, rad.
    pub sigma_rad: f64,
}

/// The floor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    /// Unit, up, world.
    pub normal: Vector3<f64>,
    /// `normal · x` of the floor's points, map units.
    pub offset: f64,
    /// Of the cameras above it, map units, and the standard deviation of its logarithm.
    pub height: f64,
    pub sigma: f64,
    /// The floor's normal in the camera's axes, as all cameras have it.
    pub up_camera: Unit<Vector3<f64>>,
    /// Landmarks that it rests on.
    pub landmarks: usize,
    pub scatter: Scatter,
}

/// How landmarks near a floor lie about it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scatter {
    /// Shares of them that are of things on it, and mistakes beneath it.
    pub things: f64,
    pub mistakes: f64,
    /// How far from it the others lie, RMS, in their own standard deviations: 1 at the most.
    pub spread: f64,
}

impl Default for Scatter {
    fn default() -> Self {
        Self { things: 0.25, mistakes: 0.25, spread: 1.0 }
    }
}

impl Plane {
    /// Of a point above the floor, map units.
    pub fn height_of(&self, point: &Vector3<f64>) -> f64 {
        self.normal.dot(point) - self.offset
    }

    /// The robot stands on this floor: the camera is as high above it as it was found to be. Not one that is carried, has driven up a step, or
    /// whose map was corrected since.
    pub fn carries(&self, camera: &Vector3<f64>) -> bool {
        // Written so that NaN fails.
        (self.height_of(camera) / self.height - 1.0).abs() <= MOST_OFF
    }

    /// A landmark lies on it, as far as both are known.
    pub fn bears(&self, point: &FloorPoint) -> bool {
        let Self { normal, offset: floor, scatter, .. } = *self;
        let plane = Candidate { normal, floor, cameras: floor + self.height, scatter };
        plane.side(point) == 1 && plane.beside(point).iter().sum::<f64>() < 0.5
    }

    /// The part of the map that it lies in was moved by this.
    pub fn follow(&mut self, motion: &Sim3<World, World>) {
        let on_it = motion.transform(&(self.normal * self.offset));
        self.normal = motion.rotation * self.normal;
        self.offset = self.normal.dot(&on_it);
        self.height *= motion.scale;
    }

    /// Axes on it below `point`: z is the height above it.
    pub fn floor_from_world(&self, point: &Vector3<f64>) -> Se3<Camera, World> {
        let rotation = UnitQuaternion::rotation_between(&self.normal, &Vector3::z())
            .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI));
        let foot = point - self.normal * self.height_of(point);
        Se3::new(rotation, -(rotation * foot))
    }

    /// Lengths are `factor` times as long from now on.
    pub fn rescale(&mut self, factor: f64) {
        self.offset *= factor;
        self.height *= factor;
    }
}

/// How much driving over it makes a plane the floor.
#[derive(Debug, Clone, Copy)]
pub struct Driven {
    /// The way that must be driven, in heights.
    way: f64,
    /// Stations of it that must have a landmark of the plane on the strip.
    stations: usize,
}

impl Driven {
    /// The first time in a map, with nothing but a mount that tells which way is up.
    pub const FIRST: Self = Self { way: 4.0, stations: 4 };
    /// Where the floor was found before: the robot still stands on it, and its camera is tilted as it was.
    pub const AGAIN: Self = Self { way: 1.5, stations: 2 };
}

/// Why no floor is told.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum NoFloor {
    /// Too few landmarks below the camera.
    FewLandmarks,
    /// No plane that the mount allows.
    NoPlane,
    /// The camera has not moved far enough.
    FewMetres,
    /// The camera does not keep one height above it; how far it strays, a share of the height.
    NotParallel(f64),
    /// Landmarks beneath it.
    SomethingBeneath(usize),
    /// Stations of the way with landmarks of the plane on the driven strip.
    NotDrivenOver(usize),
    /// The height is less sure than is of use.
    Unsure(f64),
}

/// Candidates that are drawn. With a third of the landmarks below the camera on the floor, one in 27 is good.
const CANDIDATES: usize = 200;
/// Landmarks on the plane at the least.
pub const LEAST_LANDMARKS: usize = 15;
/// How even a floor is, one sigma, as a share of the camera's height: carpets' edges, sills, and what poses share of their error.
pub const EVENNESS: f64 = 0.015;
/// A landmark is on the plane within so many of its sigmas.
const ON_SIGMAS: f64 = 3.0;
/// A landmark whose place across the plane is less sure than this share of the height says nothing.
const MOST_LANDMARK_SIGMA: f64 = 0.05;
/// A camera on wheels keeps its height to this share (one sigma), and a plane above which it strays by more than the second is no floor.
pub const KEEPS_HEIGHT: f64 = 0.02;
const MOST_STRAY: f64 = 0.05;
/// And its tilt, one sigma, rad: it nods as it starts and stops.
pub const KEEPS_TILT_RAD: f64 = 0.01;
/// A camera whose height differs from the floor's by more than this share of it is above another one, or carried: twice what may stray.
const MOST_OFF: f64 = 0.1;
/// Landmarks within this share of the height are on the plane, of things on it (skirting boards, feet of furniture, the lower end of walls), or mistakes
/// a little beneath it. What lies farther down is beneath it; such a share of those on the plane is let pass, of either: mistaken matches.
const REACH: f64 = 0.15;
const MOST_BENEATH: f64 = 0.15;
/// Half width of the driven strip and length of a station, in heights: a robot is about as wide as its camera is high.
const STRIP: f64 = 0.5;
const STATION: f64 = 0.5;
/// A step between keyframes longer than this, in heights, is no way that is known to be driven straight.
const LONGEST_STEP: f64 = 2.0;
/// Standard deviation of the height beyond which nothing is told.
const MOST_SIGMA: f64 = 0.05;
/// What landmarks share of their keyframes' errors does not shrink with their number: as measured in the simulator's rooms.
const COMMON_SIGMA: f64 = 0.004;
const ITERATIONS: usize = 15;

/// One hypothesis: n, n·x of the floor, n·x of the cameras.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    normal: Vector3<f64>,
    floor: f64,
    cameras: f64,
    scatter: Scatter,
}

impl Candidate {
    fn height(&self) -> f64 {
        self.cameras - self.floor
    }

    /// Standard deviation of a landmark's place across the plane.
    fn sigma(&self, point: &FloorPoint) -> f64 {
        let own = self.normal.dot(&(point.covariance * self.normal)).max(0.0);
        (own + (EVENNESS * self.height()).powi(2)).sqrt()
    }

    fn above(&self, point: &FloorPoint) -> f64 {
        self.normal.dot(&point.position) - self.floor
    }

    /// +1: on the plane; -1: beneath it; 0: neither, or not sure enough.
    fn side(&self, point: &FloorPoint) -> i32 {
        let (above, sigma) = (self.above(point), self.sigma(point));
        if sigma > MOST_LANDMARK_SIGMA * self.height() {
            return 0;
        }
        if above.abs() <= ON_SIGMAS * sigma {
            return 1;
        }
        -i32::from(above < -REACH * self.height())
    }

    /// Probabilities that a landmark at most `REACH` away is of a thing on the floor, and a mistake beneath it; else it is on the floor.
    fn beside(&self, point: &FloorPoint) -> [f64; 2] {
        let Scatter { things, mistakes, spread } = self.scatter;
        let (above, sigma, reach) = (self.above(point), self.sigma(point) * spread, REACH * self.height());
        let [beneath, at, over] = [above + reach, above, above - reach].map(|a| cumulative(a / sigma));
        let on = (-0.5 * (above / sigma).powi(2)).exp() / ((2.0 * PI).sqrt() * sigma);
        let [thing, mistake] = [things * (at - over) / reach, mistakes * (beneath - at) / reach];
        let all = (1.0 - things - mistakes) * on + thing + mistake;
        [thing / all, mistake / all]
    }
}

/// Of the standard normal distribution, within 0.01 (a logistic curve).
fn cumulative(x: f64) -> f64 {
    1.0 / (1.0 + (-1.702 * x).exp())
}

/// A plane that may be the floor, and how far the camera was driven over it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Found {
    pub plane: Plane,
    /// The way, in heights, and stations of it with a landmark of the plane on the strip.
    way: f64,
    stations: usize,
}

impl Found {
    /// Whether it was driven over as far as is asked.
    pub fn driven_over(&self, least: &Driven) -> Result<(), NoFloor> {
        if self.way < least.way {
            return Err(NoFloor::FewMetres);
        }
        if self.stations < least.stations { Err(NoFloor::NotDrivenOver(self.stations)) } else { Ok(()) }
    }
}

/// See module. `seed`: of the draw; the same question has the same answer.
pub fn find_floor(
    points: &[FloorPoint],
    cameras: &[Se3<Camera, World>],
    prior: &UpPrior,
    seed: u64,
) -> Result<Found, NoFloor> {
    let centres: Vec<Vector3<f64>> = cameras.iter().map(|c| c.inverse().translation).collect();
    let ups = cameras.iter().map(|c| c.rotation.inverse() * prior.up_camera.into_inner());
    let (Some(last), Some(up)) = (centres.last(), Unit::try_new(ups.sum::<Vector3<f64>>(), 1e-9)) else {
        return Err(NoFloor::FewMetres);
    };
    let below: Vec<usize> = (0..points.len()).filter(|i| (points[*i].position - last).dot(&up) < 0.0).collect();
    if below.len() < LEAST_LANDMARKS {
        return Err(NoFloor::FewLandmarks);
    }
    let best = best_candidate(points, &below, &centres, &up, prior.sigma_rad, seed).ok_or(NoFloor::NoPlane)?;
    let (fitted, mut sigma, on) = fit(best, points, &centres, &up, prior.sigma_rad).ok_or(NoFloor::NoPlane)?;
    if on.len() < LEAST_LANDMARKS {
        return Err(NoFloor::FewLandmarks);
    }
    is_level(&fitted, points, &on, &centres)?;
    sigma = sigma.hypot(COMMON_SIGMA);
    if sigma > MOST_SIGMA {
        return Err(NoFloor::Unsure(sigma));
    }
    let ups: Vector3<f64> = cameras.iter().map(|c| c.rotation * fitted.normal).sum();
    let height = fitted.height();
    let plane = Plane {
        normal: fitted.normal,
        offset: fitted.floor,
        height,
        sigma,
        up_camera: Unit::try_new(ups, 1e-9).unwrap_or(prior.up_camera),
        landmarks: on.len(),
        scatter: fitted.scatter,
    };
    let way = steps(&centres, height).map(|(a, b)| (b - a).norm()).sum::<f64>() / height;
    Ok(Found { plane, way, stations: driven_stations(&fitted, points, &on, &centres) })
}

fn best_candidate(
    points: &[FloorPoint],
    below: &[usize],
    centres: &[Vector3<f64>],
    up: &Unit<Vector3<f64>>,
    up_sigma: f64,
    seed: u64,
) -> Option<Candidate> {
    let mut random = Random::new(seed);
    let middle = centres.iter().sum::<Vector3<f64>>() / centres.len() as f64;
    let least_cos = (ON_SIGMAS * up_sigma).min(FRAC_PI_4).cos();
    let mut best: Option<(i64, Candidate)> = None;
    for _ in 0..CANDIDATES {
        let mut sample = [0; 3];
        if !random.sample_distinct(below.len(), &mut sample) {
            return None;
        }
        let [a, b, c] = sample.map(|i| points[below[i]].position);
        let Some(normal) = Unit::try_new((b - a).cross(&(c - a)), 1e-12) else { continue };
        let normal = if normal.dot(up) < 0.0 { -normal.into_inner() } else { normal.into_inner() };
        let candidate =
            Candidate { normal, floor: normal.dot(&a), cameras: normal.dot(&middle), scatter: Scatter::default() };
        if normal.dot(up) < least_cos || candidate.height() <= 0.0 {
            continue;
        }
        // One beneath weighs as two on it.
        let sides = points.iter().map(|point| candidate.side(point));
        let score = sides.map(|side| i64::from(if side < 0 { -2 } else { side })).sum::<i64>();
        if best.as_ref().is_none_or(|(most, _)| score > *most) {
            best = Some((score, candidate));
        }
    }
    best.filter(|(score, _)| *score > 0).map(|(_, candidate)| candidate)
}

/// The plane, the standard deviation of ln H, and the landmarks that are on it.
fn fit(
    start: Candidate,
    points: &[FloorPoint],
    centres: &[Vector3<f64>],
    up: &Unit<Vector3<f64>>,
    up_sigma: f64,
) -> Option<(Candidate, f64, Vec<usize>)> {
    let (across, along) = basis(up);
    let origin = *centres.last()?;
    let mut now = start;
    let (mut sigma, mut on) = (f64::INFINITY, Vec::new());
    for _ in 0..ITERATIONS {
        let (e1, e2) = basis(&Unit::new_unchecked(now.normal));
        let height = now.height();
        let (mut normal_matrix, mut gradient) = (Matrix4::zeros(), Vector4::zeros());
        let mut add = |row: Vector4<f64>, residual: f64, weight: f64| {
            normal_matrix += row * row.transpose() * weight;
            gradient += row * (residual * weight);
        };
        on.clear();
        let (mut chi2, mut weights, mut beside) = (0.0, 0.0, [0.0; 2]);
        for (i, point) in points.iter().enumerate() {
            let (above, sigma, relative) = (now.above(point), now.sigma(point), point.position - origin);
            if sigma > MOST_LANDMARK_SIGMA * height || above.abs() > REACH * height {
                continue;
            }
            let [thing, mistake] = now.beside(point);
            let weight = 1.0 - thing - mistake;
            let row = Vector4::new(e1.dot(&relative), e2.dot(&relative), -1.0, 1.0) / sigma;
            add(row, above / sigma, weight);
            (chi2, weights) = (chi2 + weight * (above / sigma).powi(2), weights + weight);
            beside = [beside[0] + thing, beside[1] + mistake];
            if now.side(point) == 1 {
                on.push(i);
            }
        }
        for centre in centres {
            let relative = centre - origin;
            let stray = (now.normal.dot(centre) - now.cameras) / (KEEPS_HEIGHT * height);
            add(Vector4::new(e1.dot(&relative), e2.dot(&relative), -1.0, 0.0) / (KEEPS_HEIGHT * height), stray, 1.0);
        }
        for axis in [across, along] {
            let tilt = axis.dot(&now.normal) / up_sigma;
            add(Vector4::new(axis.dot(&e1), axis.dot(&e2), 0.0, 0.0) / up_sigma, tilt, 1.0);
        }
        let cholesky = normal_matrix.cholesky()?;
        let step = -cholesky.solve(&gradient);
        let normal = (now.normal + e1 * step.x + e2 * step.y).normalize();
        // `a` is taken about the newest camera, where a turn of n does not move it.
        let cameras = normal.dot(&origin) + (now.cameras - now.normal.dot(&origin)) + step.z;
        // As if one more were seen of each kind, and ten more that lie as far off as they should. Landmarks that lie farther off than they should make no
        // plane the wider: it would swallow what stands on it.
        let [things, mistakes] = beside.map(|n| (n + 1.0) / (weights + beside[0] + beside[1] + 3.0));
        let spread = ((chi2 + 10.0) / ((weights - 4.0).max(0.0) + 10.0)).sqrt().min(1.0);
        let scatter = Scatter { things, mistakes, spread };
        let next = Candidate { normal, floor: cameras - (height + step.w), cameras, scatter };
        if !(next.height() > 0.0 && normal.iter().all(|v| v.is_finite())) {
            return None;
        }
        sigma = cholesky.inverse()[(3, 3)].sqrt() / next.height();
        now = next;
    }
    (sigma.is_finite()).then_some((now, sigma, on))
}

/// Two unit vectors across a third.
pub fn basis(normal: &Unit<Vector3<f64>>) -> (Vector3<f64>, Vector3<f64>) {
    let axis = if normal.x.abs() < 0.6 { Vector3::x() } else { Vector3::y() };
    let e1 = (axis - normal.into_inner() * normal.dot(&axis)).normalize();
    (e1, normal.cross(&e1))
}

/// The camera keeps one height above it, and nothing lies beneath it.
fn is_level(plane: &Candidate, points: &[FloorPoint], on: &[usize], centres: &[Vector3<f64>]) -> Result<(), NoFloor> {
    let stray = centres.iter().map(|c| (plane.normal.dot(c) - plane.cameras).powi(2)).sum::<f64>();
    let stray = (stray / centres.len() as f64).sqrt() / plane.height();
    if stray > MOST_STRAY {
        return Err(NoFloor::NotParallel(stray));
    }
    let beneath = points.iter().filter(|point| plane.side(point) < 0).count();
    let something = beneath as f64 > MOST_BENEATH * on.len() as f64 || plane.scatter.mistakes > MOST_BENEATH;
    if something { Err(NoFloor::SomethingBeneath(beneath)) } else { Ok(()) }
}

fn steps(centres: &[Vector3<f64>], height: f64) -> impl Iterator<Item = (Vector3<f64>, Vector3<f64>)> {
    let known = move |(a, b): &(Vector3<f64>, Vector3<f64>)| (b - a).norm() <= LONGEST_STEP * height;
    centres.windows(2).map(|pair| (pair[0], pair[1])).filter(known)
}

/// Stations of the way that have landmarks of the plane below it.
fn driven_stations(plane: &Candidate, points: &[FloorPoint], on: &[usize], centres: &[Vector3<f64>]) -> usize {
    let height = plane.height();
    let foot = |x: &Vector3<f64>| x - plane.normal * (plane.normal.dot(x) - plane.floor);
    let (mut driven, mut stations) = (0.0, std::collections::BTreeSet::new());
    for (from, to) in steps(centres, height) {
        let (from, to) = (foot(&from), foot(&to));
        let step = to - from;
        let length = step.norm();
        for point in on.iter().map(|i| points[*i].position) {
            let share =
                if length > 0.0 { (step.dot(&(point - from)) / (length * length)).clamp(0.0, 1.0) } else { 0.0 };
            if (foot(&point) - from - step * share).norm() <= STRIP * height {
                stations.insert(((driven + share * length) / (STATION * height)) as u64);
            }
        }
        driven += length;
    }
    stations.len()
}
