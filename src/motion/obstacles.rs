//! What stands around the robot and where the floor is free, by bearing: from a metric map and the floor under it.
//!
//! Floor, landmarks, where keyframes saw the floor ([`seen`](super::floor::seen)), the way that was driven -> [`Scan`]: for each of
//! [`BEARINGS`] directions the nearest thing, its standard deviation, and how far the floor is seen free; and the points above the floor and below the
//! robot's height. All in the robot's own axes on the floor: forward, left, up from the foot of its origin.
//!
//! - A landmark between [`LEAST_HEIGHT_M`] and the robot's height is in the way. Bearings between two such points less than `LINK_M` apart
//!   have what lies on the line between them: things are more than their corners.
//! - So is what keyframes saw stand upright (with `seen_floor`), where two agree.
//! - **Unknown is never free**, but for what `seen` says may hide. A cell of the floor is free where the robot itself has been, and (with `seen_floor`)
//!   where two keyframes proved that nothing stands; a bearing is free along a row of such cells with none missing in between, less `MARGIN_M`: of those that
//!   begin near the robot the longest (a camera that looks ahead may have looked over what is before). All end before anything in the way, and where keyframes
//!   saw the floor end. What a keyframe proves has gaps of its own: places in which it knows nothing, up to a fifth of the distance, see `seen`.
//! - **The newest word counts.** A keyframe that sees the floor end, or something stand, takes back what older ones saw there and that the robot drove
//!   there; two newer keyframes give it again, once they are more than those that saw it end. A driven cell that no keyframe looked at since stays free.
//!
//! Cost: 1 to 2 ms with 60 keyframes and 5,000 landmarks; only while somebody asks. Bounded by its constants.
//!
//! Deliberately not here: a map of occupancy that outlives the map (this is made anew from the map as it is), things that move, what hangs above the
//! floor without a landmark on it (a table's top), and steps down: there the floor is not seen, and unknown is what is said.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::floor::seen::{Footing, Seen, Stretch};
use super::floor::{Plane, ScaleConfig};
use crate::geometry::Se3;
use crate::geometry::frames::{Body, World};
use crate::map::Around;

/// Directions of a scan: two degrees each, all round. The first looks backwards, the middle one forward.
pub const BEARINGS: usize = 180;
/// Points of a scan at the most: the nearest.
pub const MOST_POINTS: usize = 500;
/// Nearest thing that is told, m: what is nearer to the robot's origin than a cell has no bearing. A thing may well be within the robot's radius.
pub const RANGE_MIN_M: f64 = CELL_M;
/// Farthest thing and free floor that are told, m.
pub const RANGE_MAX_M: f64 = 5.0;
/// What is lower than this is driven over, and is what a sill, a carpet or an error of the floor's is, m.
pub const LEAST_HEIGHT_M: f64 = 0.06;
/// Where a stretch of free floor begins at the farthest, m: a camera that looks ahead does not see the floor at the robot's feet; and the shortest
/// of whose cells is told, m.
const FIRST_M: f64 = 1.6;
const LEAST_STRETCH_M: f64 = 0.15;
/// Points nearer to each other than this are one thing, m.
const LINK_M: f64 = 0.4;
/// Bearings that a link bridges at the most: 30 degrees.
const LINK_BEARINGS: usize = 15;
/// A landmark less sure than this along the floor, m, tells no distance.
const MOST_SIGMA_M: f64 = 0.3;
/// A thing is at least so large around its landmark, m.
const HALF_SIZE_M: f64 = 0.03;
/// What stands free is told up to so much before what is in the way, m, and so many of its sigmas; and so much before the last cell that was seen free.
const MARGIN_M: f64 = 0.05;
const MARGIN_SIGMAS: f64 = 2.0;
/// Side of a cell of the floor, m, and cells a side.
const CELL_M: f64 = 0.05;
const CELLS: usize = (2.0 * RANGE_MAX_M / CELL_M) as usize;
/// Keyframes that must have seen a cell free, and more than saw the floor end there.
const FREE_FOR: u8 = 2;
/// A robot higher than the camera by more than this share does not pass where the camera's rays do.
const MOST_ABOVE: f64 = 0.05;
/// Keyframes that must have seen a thing stand, no farther from each other than this, m, and no fewer than saw the floor free there since.
const STANDS_FOR: u8 = 2;
const SAME_THING_M: f64 = 0.15;
/// Half the angle between two bearings of what a keyframe saw, rad.
const HALF_BEARING: f64 = 0.0175;

/// `[obstacles]`: what of the map is in the robot's way.
#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct ObstaclesConfig {
    /// Things between the floor and this height are in the way, m. 0 (as high as the camera) or 0.07..=3.0.
    pub robot_height_m: f64,
    /// Of the robot's footprint around its origin, m: where it has been the floor was free. 0.05..=1.0.
    pub robot_radius_m: f64,
    /// Tell what keyframes saw, too: free floor (of a robot no higher than the camera), and what stands on it.
    pub seen_floor: bool,
}

impl Default for ObstaclesConfig {
    fn default() -> Self {
        Self { robot_height_m: 0.0, robot_radius_m: 0.12, seen_floor: false }
    }
}

impl ObstaclesConfig {
    /// Up to which height things are in the way, m: as configured, else the camera's.
    pub fn height_m(&self, scale: &ScaleConfig) -> f64 {
        if self.robot_height_m > 0.0 { self.robot_height_m } else { scale.camera_height_m }
    }

    /// First value out of its range: key, and what is allowed.
    pub fn validate(&self) -> Result<(), (&'static str, String)> {
        // Written so that NaN fails.
        if !(self.robot_height_m == 0.0 || (0.07..=3.0).contains(&self.robot_height_m)) {
            return Err(("robot_height_m", "must be 0 (the camera's height) or 0.07 to 3 m".into()));
        }
        if !(0.05..=1.0).contains(&self.robot_radius_m) {
            return Err(("robot_radius_m", "must be 0.05 to 1 m".into()));
        }
        Ok(())
    }
}

/// A landmark of a metric map.
#[derive(Debug, Clone, Copy)]
pub struct Point {
    pub position: Vector3<f64>,
    pub covariance: Matrix3<f64>,
}

/// In the way: forward, left, up, m, and the standard deviation along the floor, m.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InTheWay {
    pub position: [f32; 3],
    pub sigma: f32,
}

/// See module. Bearing `i` looks along `-π + i 2π / BEARINGS`, positive to the left.
#[derive(Debug, Clone, PartialEq)]
pub struct Scan {
    /// The foot of the robot's origin, its axes level with the floor.
    pub world_from_scan: Se3<World, Body>,
    /// Distance of the nearest thing, m, and its standard deviation; NaN: nothing is known to be there.
    pub range_m: [f32; BEARINGS],
    pub sigma_m: [f32; BEARINGS],
    /// The floor is seen free from here (NaN: nowhere) to there, m; 0: not known.
    pub free_from_m: [f32; BEARINGS],
    pub free_m: [f32; BEARINGS],
    /// Nearest first.
    pub points: Vec<InTheWay>,
    /// Before the farthest were left out.
    pub total: usize,
}

impl Default for Scan {
    fn default() -> Self {
        Self {
            world_from_scan: Se3::identity(),
            range_m: [f32::NAN; BEARINGS],
            sigma_m: [f32::NAN; BEARINGS],
            free_from_m: [f32::NAN; BEARINGS],
            free_m: [0.0; BEARINGS],
            points: Vec::with_capacity(MOST_POINTS),
            total: 0,
        }
    }
}

impl Scan {
    /// For a picture of the map.
    pub fn around(&self) -> Around {
        let world = |x: f64, y: f64, z: f64| self.world_from_scan.transform(&Vector3::new(x, y, z));
        let at = |bearing: usize, distance: f32| {
            let (sin, cos) = bearing_rad(bearing).sin_cos();
            world(f64::from(distance) * cos, f64::from(distance) * sin, 0.0)
        };
        let told = (0..BEARINGS).filter(|i| self.free_m[*i] > 0.0);
        Around {
            free: told.map(|i| [self.free_from_m[i], self.free_m[i]].map(|v| at(i, v))).collect(),
            in_the_way: self
                .points
                .iter()
                .map(|p| world(p.position[0].into(), p.position[1].into(), p.position[2].into()))
                .collect(),
        }
    }
}

/// Angle of a bearing, rad.
pub fn bearing_rad(bearing: usize) -> f64 {
    std::f64::consts::TAU * bearing as f64 / BEARINGS as f64 - std::f64::consts::PI
}

/// What is said of a cell.
#[derive(Clone, Copy, PartialEq)]
enum Of {
    Free,
    /// Something else than free floor.
    Against,
    /// Something stands near there.
    Standing,
    Driven,
}

/// Half the width of what a keyframe saw at this distance, m: at the least the cell that it lies in, half a diagonal.
fn spread(at: f64) -> f64 {
    (HALF_BEARING * at).max(0.71 * CELL_M)
}

/// World, from a bearing and a distance.
fn along(footing: &Footing, bearing: f32, at: f64) -> Vector3<f64> {
    let (sin, cos) = f64::from(bearing).sin_cos();
    footing.place([at * cos, at * sin])
}

/// Makes scans; its memory is reused.
#[derive(Debug)]
pub struct Scanner {
    /// Keyframes that saw a cell free since one saw that it is not.
    seen: Vec<u8>,
    /// Keyframes that saw the floor end, or something stand, there.
    against: Vec<u8>,
    /// Keyframes that saw something stand near there.
    standing: Vec<u8>,
    /// The last round that was counted in a cell: a round is what one keyframe saw of one sort.
    last: Vec<u16>,
    rounds: u16,
    /// Places of things that keyframes saw stand, and standard deviations, m.
    things: Vec<(Vector2<f64>, f64)>,
    axes: Footing,
    /// The nearest thing by bearing.
    nearest: [Option<(Vector2<f64>, f64)>; BEARINGS],
    scan: Scan,
}

impl Default for Scanner {
    fn default() -> Self {
        let axes = Footing { foot: Vector3::zeros(), forward: Vector3::x(), left: Vector3::y() };
        Self {
            seen: vec![0; CELLS * CELLS],
            against: vec![0; CELLS * CELLS],
            standing: vec![0; CELLS * CELLS],
            things: Vec::new(),
            last: vec![0; CELLS * CELLS],
            rounds: 0,
            axes,
            nearest: [None; BEARINGS],
            scan: Scan::default(),
        }
    }
}

impl Scanner {
    /// Begins a scan around the robot; `false`: it does not stand on its wheels.
    pub fn begin(&mut self, plane: &Plane, world_from_body: &Se3<World, Body>) -> bool {
        let forward = world_from_body.rotation * Vector3::x();
        let Some(forward) = (forward - plane.normal * plane.normal.dot(&forward)).try_normalize(0.5) else {
            return false;
        };
        let left = plane.normal.cross(&forward);
        let foot = world_from_body.translation - plane.normal * plane.height_of(&world_from_body.translation);
        self.axes = Footing { foot, forward, left };
        let axes = Matrix3::from_columns(&[forward, left, plane.normal]);
        self.scan.world_from_scan = Se3::from_matrix(&axes, foot);
        self.seen.fill(0);
        self.against.fill(0);
        self.standing.fill(0);
        self.things.clear();
        self.last.fill(0);
        self.rounds = 0;
        self.nearest = [None; BEARINGS];
        self.scan.points.clear();
        self.scan.total = 0;
        true
    }

    /// Forward and left of a place.
    fn local(&self, world: &Vector3<f64>) -> Vector2<f64> {
        let relative = world - self.axes.foot;
        Vector2::new(self.axes.forward.dot(&relative), self.axes.left.dot(&relative))
    }

    /// What a keyframe saw, in heights of its camera. Oldest first, in turn with [`Self::add_driven`].
    pub fn add_seen(&mut self, footing: &Footing, height_m: f64, seen: &Seen, robot_height_m: f64) {
        self.rounds = self.rounds.saturating_add(1);
        // The rays that saw the floor passed no higher than the camera.
        let floor: &[Stretch] = if robot_height_m > height_m * (1.0 + MOST_ABOVE) { &[] } else { &seen.floor };
        for stretch in floor {
            let [from, to] = [stretch.from, stretch.to].map(|v| f64::from(v) * height_m);
            let mut at = from + spread(from);
            while at + spread(at) <= to.min(2.0 * RANGE_MAX_M) {
                let middle = self.local(&along(footing, stretch.bearing, at));
                self.cover(&middle, spread(at), Of::Free);
                at += 0.5 * CELL_M;
            }
        }
        // After what the same keyframe saw free: where it contradicts itself nothing is free.
        self.rounds = self.rounds.saturating_add(1);
        for stretch in &seen.ends {
            let [from, to] = [stretch.from, stretch.to].map(|v| f64::from(v) * height_m);
            // The cell in which the floor was last seen is not where it ends.
            let mut at = (from + 0.5 * CELL_M).min(to);
            while at <= to.min(2.0 * RANGE_MAX_M) {
                let middle = self.local(&along(footing, stretch.bearing, at));
                self.cover(&middle, spread(at), Of::Against);
                at += 0.5 * CELL_M;
            }
        }
        let is_in_the_way = |[lowest, highest]: [f32; 2]| {
            f64::from(lowest) * height_m < robot_height_m && f64::from(highest) * height_m > LEAST_HEIGHT_M
        };
        let things = || seen.things.iter().filter(|(_, heights)| is_in_the_way(*heights)).map(|(thing, _)| thing);
        let half = |thing: &Stretch| (0.5 * f64::from(thing.to - thing.from) * height_m).max(HALF_SIZE_M);
        let middle = |thing: &Stretch| 0.5 * f64::from(thing.from + thing.to) * height_m;
        for thing in things() {
            let at = self.local(&along(footing, thing.bearing, middle(thing)));
            self.cover(&at, half(thing) + spread(middle(thing)), Of::Against);
        }
        self.rounds = self.rounds.saturating_add(1);
        for thing in things() {
            let at = self.local(&along(footing, thing.bearing, middle(thing)));
            self.things.push((at, half(thing)));
            self.cover(&at, SAME_THING_M, Of::Standing);
        }
    }

    /// The robot has driven from here to there.
    pub fn add_driven(&mut self, from: &Vector3<f64>, to: &Vector3<f64>, radius_m: f64) {
        self.rounds = self.rounds.saturating_add(1);
        let (from, to) = (self.local(from), self.local(to));
        let steps = ((to - from).norm() / CELL_M).ceil().clamp(1.0, 100.0) as usize;
        for i in 0..=steps {
            self.cover(&from.lerp(&to, i as f64 / steps as f64), radius_m, Of::Driven);
        }
    }

    fn cover(&mut self, middle: &Vector2<f64>, radius: f64, of: Of) {
        let cell = |v: f64| ((v + RANGE_MAX_M) / CELL_M).floor();
        let [x0, x1, y0, y1] = [middle.x - radius, middle.x + radius, middle.y - radius, middle.y + radius].map(cell);
        let inside = |v: f64| v.clamp(0.0, CELLS as f64 - 1.0) as usize;
        if !(x1 >= 0.0 && y1 >= 0.0 && x0 < CELLS as f64 && y0 < CELLS as f64) {
            return;
        }
        for y in inside(y0)..=inside(y1) {
            for x in inside(x0)..=inside(x1) {
                let centre = Vector2::new(x as f64 + 0.5, y as f64 + 0.5) * CELL_M - Vector2::repeat(RANGE_MAX_M);
                let i = y * CELLS + x;
                if (centre - middle).norm() <= radius && self.last[i] != self.rounds {
                    self.last[i] = self.rounds;
                    match of {
                        Of::Free => self.seen[i] = self.seen[i].saturating_add(1),
                        Of::Against => {
                            self.seen[i] = 0;
                            self.against[i] = self.against[i].saturating_add(1);
                        }
                        Of::Standing => self.standing[i] = self.standing[i].saturating_add(1),
                        // What stood there before does not any more.
                        Of::Driven => (self.seen[i], self.against[i], self.standing[i]) = (u8::MAX, 0, 0),
                    }
                }
            }
        }
    }

    /// A landmark, which may be in the way of a robot of this height.
    pub fn add_landmark(&mut self, plane: &Plane, point: &Point, robot_height_m: f64) {
        let up = plane.height_of(&point.position);
        if !(up > LEAST_HEIGHT_M && up < robot_height_m) {
            return;
        }
        let at = self.local(&point.position);
        let distance = at.norm();
        if !(distance > RANGE_MIN_M && distance < RANGE_MAX_M) {
            return;
        }
        let variance = |axis: &Vector3<f64>| axis.dot(&(point.covariance * axis)).max(0.0);
        let away = (self.axes.forward * at.x + self.axes.left * at.y) / distance;
        let sigma = variance(&away).sqrt();
        // As high as a sill within what is known of it: not in the way for sure.
        let unsure = up < LEAST_HEIGHT_M + 2.0 * variance(&plane.normal).sqrt();
        if !(sigma <= MOST_SIGMA_M) || unsure {
            return;
        }
        self.scan.total += 1;
        let position = [at.x as f32, at.y as f32, up as f32];
        let new = InTheWay { position, sigma: sigma as f32 };
        let far = |p: &InTheWay| p.position[0].hypot(p.position[1]);
        let place = self.scan.points.partition_point(|p| far(p) <= far(&new));
        if place < MOST_POINTS {
            self.scan.points.truncate(MOST_POINTS - 1);
            self.scan.points.insert(place, new);
        }
        self.in_the_way(&at, sigma);
    }

    /// The nearest by bearing.
    fn in_the_way(&mut self, at: &Vector2<f64>, sigma: f64) {
        let distance = at.norm();
        let spread = (HALF_SIZE_M / distance).min(0.5);
        let angle = at.y.atan2(at.x);
        let index =
            |angle: f64| ((angle + std::f64::consts::PI) / std::f64::consts::TAU * BEARINGS as f64).round() as i64;
        for i in index(angle - spread)..=index(angle + spread) {
            let bearing = i.rem_euclid(BEARINGS as i64) as usize;
            let nearest = &mut self.nearest[bearing];
            if nearest.is_none_or(|(nearest, _)| distance < nearest.norm()) {
                *nearest = Some((*at, sigma));
            }
        }
    }

    /// Things that keyframes saw stand are in the way where several agree, and no fewer than saw the floor free there since.
    fn stand(&mut self) {
        for i in 0..self.things.len() {
            let (at, sigma) = self.things[i];
            let distance = at.norm();
            if !(distance > RANGE_MIN_M && distance < RANGE_MAX_M) {
                continue;
            }
            let [x, y] = [at.x, at.y].map(|v| ((v + RANGE_MAX_M) / CELL_M) as usize);
            let Some(cell) = (x < CELLS && y < CELLS).then_some(y * CELLS + x) else { continue };
            let standing = self.standing[cell];
            if standing >= STANDS_FOR && standing >= self.seen[cell] {
                self.in_the_way(&at, sigma);
            }
        }
    }

    /// The scan of all that was added; its memory is used again by the next one. `radius_m`: the robot's.
    pub fn finish(&mut self, radius_m: f64) -> &Scan {
        self.stand();
        self.link();
        for bearing in 0..BEARINGS {
            // A line between two things may pass nearer than either.
            let nearest = self.nearest[bearing].map(|(at, sigma)| (at.norm().max(RANGE_MIN_M), sigma));
            let (range, sigma) = nearest.unwrap_or((f64::NAN, f64::NAN));
            (self.scan.range_m[bearing], self.scan.sigma_m[bearing]) = (range as f32, sigma as f32);
            let limit = nearest.map_or(RANGE_MAX_M, |(range, sigma)| range - MARGIN_M - MARGIN_SIGMAS * sigma);
            let free = self.free(bearing_rad(bearing), radius_m, limit);
            let (from, to) = free.unwrap_or((f64::NAN, 0.0));
            (self.scan.free_from_m[bearing], self.scan.free_m[bearing]) = (from as f32, to as f32);
        }
        &self.scan
    }

    /// What lies between the points of one thing.
    fn link(&mut self) {
        let found = self.nearest;
        for first in 0..BEARINGS {
            let Some((from, from_sigma)) = found[first] else { continue };
            for step in 2..=LINK_BEARINGS {
                let second = (first + step) % BEARINGS;
                let Some((to, to_sigma)) = found[second] else { continue };
                if (to - from).norm() > LINK_M {
                    continue;
                }
                for between in 1..step {
                    let bearing = (first + between) % BEARINGS;
                    let (sin, cos) = bearing_rad(bearing).sin_cos();
                    // Where the bearing's ray crosses the line from one to the other.
                    let along = to - from;
                    let cross = cos * along.y - sin * along.x;
                    if cross.abs() < 1e-9 {
                        continue;
                    }
                    let share = ((sin * from.x - cos * from.y) / cross).clamp(0.0, 1.0);
                    let (at, sigma) = (from + along * share, from_sigma.max(to_sigma));
                    let nearest = &mut self.nearest[bearing];
                    if nearest.is_none_or(|(nearest, _)| at.norm() < nearest.norm()) {
                        *nearest = Some((at, sigma));
                    }
                }
                break;
            }
        }
    }

    /// From where to where the floor is seen free, at most to `limit`, m: of the stretches that begin near the robot the longest.
    fn free(&self, angle: f64, radius_m: f64, limit: f64) -> Option<(f64, f64)> {
        let (sin, cos) = angle.sin_cos();
        let (mut longest, mut stretch, mut at) = (None::<(f64, f64)>, None::<(f64, f64)>, radius_m);
        while at < limit && (stretch.is_some() || at < FIRST_M) {
            let [x, y] = [at * cos, at * sin].map(|v| ((v + RANGE_MAX_M) / CELL_M) as usize);
            let cell = (x < CELLS && y < CELLS).then(|| y * CELLS + x);
            let (seen, against) = cell.map_or((0, 0), |i| (self.seen[i], self.against[i]));
            if against > 0 && against >= seen {
                break;
            }
            if seen >= FREE_FOR {
                let from = stretch.map_or(at, |(from, _)| from);
                stretch = Some((from, at));
                // Of two alike the nearer.
                if longest.is_none_or(|(start, end)| start == from || at - from > end - start + CELL_M) {
                    longest = stretch;
                }
            }
            at += 0.5 * CELL_M;
            stretch = stretch.filter(|(_, last)| at - last <= CELL_M);
        }
        let told = longest.filter(|(from, last)| last - from >= LEAST_STRETCH_M);
        told.map(|(from, last)| (from, last - MARGIN_M))
    }
}

#[cfg(test)]
mod tests;
