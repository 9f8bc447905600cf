//! Where the simulated camera is, exactly, at any time: the ground truth.
//!
//! Input: a time. Output: `world_from_camera`, the pose of the camera's optical frame (right, down, forward) in the
//! simulator's world (REP-103 axes, z up, metres, origin on the floor in the middle of the room; not to be mixed up with
//! a map's own world). The pose of a frame is the pose at the frame's timestamp, which is the middle of the exposure of
//! the picture's middle row.
//!
//! Every movement is twice continuously differentiable and starts from rest: sums of sines, uniform cubic B-splines
//! (de Boor, "A Practical Guide to Splines", 1978) and legs whose speed rises and falls as `6x⁵ - 15x⁴ + 10x³`.
//! Cost: below 1 us a pose. Deliberately not here: dynamics, collisions (the paths keep clear of the furniture).

use std::f64::consts::{FRAC_PI_2, PI, TAU};
use std::sync::{Arc, OnceLock};

use nalgebra::{UnitQuaternion, Vector3};

use super::building;
use super::jerks::{Jerks, smooth};
use super::random::Random;
use super::room::CHESSBOARD_MIDDLE;
use crate::camera::simulator_config::{Scenario, SimulatorConfig};
use crate::frame::monotonic_ns;
use crate::geometry::frames::{Camera, World};
use crate::geometry::{Se3, ros_from_optical};

/// Time in which a movement starts from rest, s.
const START_S: f64 = 1.0;
/// Time of a sweep along the desk and back, s, and the way to either side of its middle, m.
const SWEEP_S: f64 = 14.0;
const SWEEP_M: f64 = 1.4;
/// Where a hand holds the camera, m; it looks along +x, at the desk.
const HAND: Vector3<f64> = Vector3::new(1.15, 0.0, 1.2);

/// Height of the camera on a driven base, m, and its pitch there (positive up), rad.
pub(super) const CAMERA_HEIGHT_M: f64 = 0.5;
pub(super) const CAMERA_PITCH_RAD: f64 = 0.04;

/// Position and attitude: yaw about z (0 = looking along +x, positive to the left), pitch (positive up), roll
/// (positive clockwise as the camera sees it), rad.
#[derive(Debug, Clone, Copy)]
struct Stance {
    position: Vector3<f64>,
    yaw: f64,
    pitch: f64,
    roll: f64,
}

impl Stance {
    fn pose(&self) -> Se3<World, Camera> {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.yaw)
            * UnitQuaternion::from_axis_angle(&Vector3::y_axis(), -self.pitch)
            * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), self.roll);
        Se3::new(turn * ros_from_optical(), self.position)
    }
}

/// The movement of one simulator. Clones share the clock.
#[derive(Debug, Clone)]
pub struct Trajectory {
    scenario: Scenario,
    speed: f64,
    /// Random phases, rad: no two seeds sway alike.
    phases: [f64; 24],
    tour: Option<Arc<Spline>>,
    legs: Option<Arc<Legs>>,
    jerks: Option<Jerks>,
    /// Place of the camera on a driven base, forward and to the left, m, and its yaw on it, rad.
    on_base: [f64; 3],
    /// Distance at which the chessboard fills about half of the picture, m, and the sheet's length, m.
    board: [f64; 2],
    /// How far past its middle the camera looks, sheets.
    board_aim: f64,
    /// Timestamp of frame 0, ns.
    start_ns: Arc<OnceLock<i64>>,
}

impl Trajectory {
    /// `start_ns`: timestamp of frame 0, set later for a source that runs in real time.
    pub(super) fn new(config: &SimulatorConfig, start_ns: Option<i64>) -> Self {
        let mut random = Random::new(config.seed, 0x7ac7);
        let phases = std::array::from_fn(|_| random.range(0.0, TAU));
        let sheet = f64::from((config.chessboard.columns + 3).max((config.chessboard.rows + 3) * 4 / 3));
        let sheet = sheet * config.chessboard.square_m;
        let start = OnceLock::new();
        if let Some(ns) = start_ns {
            let _ = start.set(ns);
        }
        Self {
            scenario: config.scenario,
            speed: config.speed,
            phases,
            tour: match config.scenario {
                Scenario::RoomTour => Some(Arc::new(room_tour(&mut random))),
                Scenario::ThreeRooms | Scenario::LookAlike => Some(Arc::new(along(&building::way()))),
                _ => None,
            },
            legs: match config.scenario {
                Scenario::Square => Some(Arc::new(square())),
                Scenario::Corridor => Some(Arc::new(corridor())),
                _ => None,
            },
            jerks: Jerks::new(&config.jerks, config.seed),
            on_base: match config.wheels.camera_m {
                [forward, left] => [forward, left, config.wheels.camera_yaw_deg.to_radians()],
            },
            board: [config.lens.active_focal_widths() * sheet / 0.55, sheet],
            // Wide pictures reach farther beyond the board.
            board_aim: if config.lens.wide_angle.enabled { 0.6 } else { 0.3 },
            start_ns: Arc::new(start),
        }
    }

    /// Timestamp of frame 0, ns. In real time the clock starts with the first frame that is grabbed, or with the first
    /// question for it.
    pub fn start_ns(&self) -> i64 {
        *self.start_ns.get_or_init(monotonic_ns)
    }

    /// Ground truth at a timestamp of the source, ns.
    pub fn pose_at(&self, timestamp_ns: i64) -> Se3<World, Camera> {
        self.pose_at_seconds((timestamp_ns - self.start_ns()) as f64 * 1e-9)
    }

    /// Ground truth at a time after frame 0, s. Before that the camera rests where it starts.
    pub fn pose_at_seconds(&self, seconds: f64) -> Se3<World, Camera> {
        let t = ramp(seconds) * self.speed;
        let mut stance = self.stance(t);
        if let Some(jerks) = &self.jerks {
            let shift = jerks.at(t);
            stance.position += shift.position;
            stance.yaw += shift.angles.x;
            stance.pitch += shift.angles.y;
            stance.roll += shift.angles.z;
        }
        stance.pose()
    }

    /// True place of the base that drives the camera, x and y of the middle between its wheels, m, and yaw, rad; `None` where none does.
    pub fn base_at_seconds(&self, seconds: f64) -> Option<[f64; 3]> {
        let held = self.jerks.is_some();
        self.base(ramp(seconds) * self.speed).filter(|_| !held).map(|(place, _)| place)
    }

    /// The same at a time of the movement, and the speed as a share of the usual.
    fn base(&self, t: f64) -> Option<([f64; 3], f64)> {
        let tour = || self.tour.as_ref().map(|spline| (spline.at(t), smooth(t / (self.speed * START_S))));
        self.legs.as_ref().map(|legs| legs.at(t)).or_else(tour)
    }

    /// Sine of period `period_s` at `t` with random phase `k`.
    fn sine(&self, t: f64, period_s: f64, k: usize) -> f64 {
        (TAU * t / period_s + self.phases[k % self.phases.len()]).sin()
    }

    /// A hand's sway about its place, m.
    fn sway(&self, t: f64) -> Vector3<f64> {
        Vector3::new(
            0.13 * self.sine(t, 4.1, 0) + 0.08 * self.sine(t, 6.7, 1),
            0.17 * self.sine(t, 3.7, 2) + 0.09 * self.sine(t, 5.9, 3),
            0.11 * self.sine(t, 4.7, 4) + 0.07 * self.sine(t, 7.3, 5),
        )
    }

    /// A hand's unrest: yaw, pitch, roll, rad.
    fn unrest(&self, t: f64) -> Vector3<f64> {
        Vector3::new(
            0.06 * self.sine(t, 5.3, 6) + 0.012 * self.sine(t, 0.9, 7),
            0.045 * self.sine(t, 4.3, 8) + 0.010 * self.sine(t, 0.7, 9),
            0.035 * self.sine(t, 6.1, 10) + 0.010 * self.sine(t, 1.1, 11),
        )
    }

    /// A wheeled robot's vibration: pitch and roll, rad; `drive` = speed as a share of the usual.
    fn vibration(&self, t: f64, drive: f64) -> [f64; 2] {
        [
            drive * (0.0025 * self.sine(t, 0.17, 12) + 0.004 * self.sine(t, 0.61, 13)),
            drive * (0.0020 * self.sine(t, 0.21, 14) + 0.004 * self.sine(t, 0.83, 15)),
        ]
    }

    fn held(&self, t: f64, still: f64) -> Stance {
        let (sway, unrest) = (self.sway(t) * still, self.unrest(t) * still);
        Stance { position: HAND + sway, yaw: unrest.x, pitch: -0.22 + unrest.y, roll: unrest.z }
    }

    fn robot(&self, t: f64, drive: f64, [x, y, yaw]: [f64; 3]) -> Stance {
        let [pitch, roll] = self.vibration(t, drive);
        let (mut position, [forward, left, turned]) = (Vector3::new(x, y, CAMERA_HEIGHT_M), self.on_base);
        if self.on_base != [0.0; 3] {
            let (sin, cos) = yaw.sin_cos();
            position += Vector3::new(forward * cos - left * sin, forward * sin + left * cos, 0.0);
        }
        Stance { position, yaw: yaw + turned, pitch: CAMERA_PITCH_RAD + pitch, roll }
    }

    /// `t`: time of the movement, s; runs slower than the clock at the start and `speed` times as fast later.
    fn stance(&self, t: f64) -> Stance {
        let phase = self.phases[20];
        match self.scenario {
            Scenario::RoomTour | Scenario::Square | Scenario::Corridor | Scenario::ThreeRooms | Scenario::LookAlike => {
                let (place, drive) = self.base(t).unwrap_or(([0.0; 3], 0.0));
                self.robot(t, drive, place)
            }
            Scenario::HandHeld => self.held(t, 1.0),
            Scenario::DeskOrbit => {
                let angle = phase + TAU * t / 24.0;
                let unrest = self.unrest(t);
                let radius = 1.5 + 0.05 * self.sine(t, 7.9, 16);
                let position =
                    Vector3::new(radius * angle.cos(), radius * angle.sin(), 1.25 + 0.1 * self.sine(t, 5.7, 17));
                Stance {
                    position,
                    yaw: angle + PI + 0.5 * unrest.x,
                    pitch: -((position.z - 0.78) / radius).atan() + 0.5 * unrest.y,
                    roll: 0.5 * unrest.z,
                }
            }
            Scenario::PureRotation => Stance {
                position: Vector3::new(0.9, -1.2, 1.0),
                yaw: phase + 1.1 * (TAU * t / 9.0).sin(),
                pitch: -0.05 + 0.15 * (TAU * t / 5.3).sin(),
                roll: 0.05 * (TAU * t / 7.1).sin(),
            },
            Scenario::MoveThenRotate => {
                let lap = t.rem_euclid(30.0);
                let still = 1.0 - smooth((lap - 10.0) / 1.5) + smooth((lap - 24.0) / 1.5);
                let turn = 1.0 - still;
                let mut s = self.held(t, still);
                s.yaw += turn * 0.6 * (TAU * (lap - 10.0) / 6.0).sin();
                s.pitch += turn * 0.12 * (TAU * (lap - 10.0) / 4.1).sin();
                s
            }
            Scenario::Standing => self.held(0.0, 1.0),
            Scenario::MoveThenStand => self.held(t.min(13.0), 1.0 - smooth((t - 10.0) / 2.0)),
            Scenario::Sideways => Stance {
                position: Vector3::new(
                    1.7 * (TAU * t / 24.0).sin(),
                    -1.25 + 0.05 * self.sine(t, 7.0, 17),
                    0.95 + 0.04 * self.sine(t, 5.0, 18),
                ),
                yaw: FRAC_PI_2 + 0.2 * self.unrest(t).x,
                pitch: -0.08 + 0.2 * self.unrest(t).y,
                roll: 0.2 * self.unrest(t).z,
            },
            Scenario::FastRotation => {
                // Bursts swell and fade every 5 s; between them there is time to map what has been seen.
                let burst = smooth((t - 4.0) / 1.0) * (0.55 - 0.45 * self.sine(t, 5.2, 19));
                let mut s = self.held(t, 1.0);
                s.yaw += burst * 0.50 * (TAU * (t - 4.0) / 0.83).sin();
                s.pitch += burst * 0.14 * (TAU * (t - 4.0) / 1.07).sin();
                s.roll += burst * 0.12 * (TAU * (t - 4.0) / 0.97).sin();
                s
            }
            Scenario::DeskSweep => {
                let angle = TAU * t / SWEEP_S;
                // 1 on the way there, -1 on the way back.
                let (along, way) = (-angle.cos(), angle.sin());
                let (sway, unrest) = (self.sway(t), self.unrest(t));
                let place = Vector3::new(1.83 + 0.10 * way, SWEEP_M * along, 1.13 - 0.10 * way);
                Stance {
                    position: place + 0.3 * sway,
                    yaw: 0.32 * way + 0.20 * self.sine(t, 2.9, 21) + unrest.x,
                    pitch: -0.56 - 0.05 * way + 0.12 * self.sine(t, 2.3, 22) + unrest.y,
                    roll: 0.12 * self.sine(t, 3.7, 23) + unrest.z,
                }
            }
            Scenario::CalibrationSweep => {
                let [middle, sheet] = self.board;
                let board = Vector3::from(CHESSBOARD_MIDDLE);
                let (azimuth, elevation) = (0.55 * self.sine(t, 7.3, 0), 0.08 + 0.38 * self.sine(t, 5.1, 1));
                let distance = middle * (1.0 + 0.33 * self.sine(t, 8.9, 2));
                let from_board =
                    Vector3::new(-azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin());
                let position = board + from_board * distance;
                // Looking past its middle brings it into the picture's corners.
                let aim = Vector3::new(0.0, self.sine(t, 6.1, 3), self.sine(t, 4.3, 4)) * (self.board_aim * sheet);
                let look = board + aim - position;
                Stance {
                    position,
                    yaw: look.y.atan2(look.x),
                    pitch: look.z.atan2(look.x.hypot(look.y)),
                    roll: 0.5 * self.sine(t, 9.7, 5),
                }
            }
        }
    }
}

/// Integral of [`smooth`]: grows from rest to slope 1; 0.5 at x = 1.
fn smooth_integral(x: f64) -> f64 {
    if x <= 0.0 {
        0.0
    } else if x < 1.0 {
        x.powi(4) * (2.5 + x * (x - 3.0))
    } else {
        x - 0.5
    }
}

/// Time of the movement for time on the clock, s.
fn ramp(seconds: f64) -> f64 {
    START_S * smooth_integral(seconds / START_S)
}

/// Closed uniform cubic B-spline of (x, y, yaw).
#[derive(Debug)]
struct Spline {
    points: Vec<[f64; 3]>,
    /// Time between knots, s.
    knot_s: f64,
    /// Yaw of one whole round, rad.
    round_yaw: f64,
}

impl Spline {
    fn at(&self, t: f64) -> [f64; 3] {
        let n = self.points.len() as i64;
        let s = t / self.knot_s;
        let (i, u) = (s.floor() as i64, s - s.floor());
        let weights = [
            (1.0 - u).powi(3) / 6.0,
            (3.0 * u.powi(3) - 6.0 * u.powi(2) + 4.0) / 6.0,
            (-3.0 * u.powi(3) + 3.0 * u.powi(2) + 3.0 * u + 1.0) / 6.0,
            u.powi(3) / 6.0,
        ];
        let mut sum = [0.0; 3];
        for (k, w) in weights.into_iter().enumerate() {
            let j = i - 1 + k as i64;
            let p = self.points[j.rem_euclid(n) as usize];
            sum[0] += w * p[0];
            sum[1] += w * p[1];
            sum[2] += w * (p[2] + self.round_yaw * j.div_euclid(n) as f64);
        }
        sum
    }
}

/// Three laps around the table, counter-clockwise, 0.42 m/s, no lap quite like the other.
fn room_tour(random: &mut Random) -> Spline {
    const LAPS: usize = 3;
    let (a, b, r) = (1.65, 1.2, 0.75);
    let (straight_x, straight_y, arc) = (2.0 * (a - r), 2.0 * (b - r), FRAC_PI_2 * r);
    let length = 2.0 * (straight_x + straight_y) + 4.0 * arc;
    let per_lap = (length / 0.35).round() as usize;
    let step = length / per_lap as f64;
    let wobble: [f64; 4] = std::array::from_fn(|_| random.range(0.0, TAU));
    // Starts where one of the long sides begins.
    let places: Vec<[f64; 2]> = (0..LAPS * per_lap)
        .map(|i| {
            let mut s = (i % per_lap) as f64 * step;
            let t = i as f64 / per_lap as f64;
            let out = 0.06 * (TAU * t / 3.0 + wobble[0]).sin() + 0.05 * (TAU * t * 4.0 / 3.0 + wobble[1]).sin();
            let mut corner = 0;
            // Side by side: x of the side's start, its direction, then the arc after it.
            let sides = [straight_x, straight_y, straight_x, straight_y];
            while corner < 3 && s >= sides[corner] + arc {
                s -= sides[corner] + arc;
                corner += 1;
            }
            let heading = corner as f64 * FRAC_PI_2;
            let (forward, left) = ([heading.cos(), heading.sin()], [-heading.sin(), heading.cos()]);
            // The middle of the arc that ends this side, relative to the room's middle.
            let hub = [(a - r) * (forward[0] - left[0]), (b - r) * (forward[1] - left[1])];
            let (along, across) = if s < sides[corner] {
                (s - sides[corner], -(r + out))
            } else {
                let angle = (s - sides[corner]) / r;
                ((r + out) * angle.sin(), -(r + out) * angle.cos())
            };
            [hub[0] + forward[0] * along + left[0] * across, hub[1] + forward[1] * along + left[1] * across]
        })
        .collect();
    heading(places, step)
}

/// A closed way along corners at 0.42 m/s, looking where it goes.
fn along(corners: &[[f64; 2]]) -> Spline {
    let ends = |i: usize| (corners[i], corners[(i + 1) % corners.len()]);
    let length = |i: usize| {
        let (a, b) = ends(i);
        (b[0] - a[0]).hypot(b[1] - a[1])
    };
    let whole: f64 = (0..corners.len()).map(length).sum();
    let knots = (whole / 0.35).round().max(4.0) as usize;
    let step = whole / knots as f64;
    let (mut corner, mut passed) = (0, 0.0);
    let places = (0..knots).map(|i| {
        let s = i as f64 * step;
        while corner + 1 < corners.len() && s > passed + length(corner) {
            passed += length(corner);
            corner += 1;
        }
        let ((a, b), share) = (ends(corner), (s - passed) / length(corner));
        [a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share]
    });
    heading(places.collect(), step)
}

/// A closed way over places that lie `step` m apart, at 0.42 m/s, looking where it goes.
fn heading(places: Vec<[f64; 2]>, step: f64) -> Spline {
    let n = places.len();
    let mut points: Vec<[f64; 3]> = Vec::with_capacity(n + 1);
    for i in 0..=n {
        let (p, q) = (places[(i + n - 1) % n], places[(i + 1) % n]);
        let heading = (q[1] - p[1]).atan2(q[0] - p[0]);
        let last = points.last().map_or(heading, |p| p[2]);
        let turned = (heading - last + PI).rem_euclid(TAU) - PI;
        points.push([places[i % n][0], places[i % n][1], last + turned]);
    }
    // Back at the first place it looks the same way again.
    let round_yaw = ((points[n][2] - points[0][2]) / TAU).round() * TAU;
    points.truncate(n);
    Spline { points, knot_s: step / 0.42, round_yaw }
}

/// Straight drives and turns on the spot, repeated for ever.
#[derive(Debug)]
struct Legs {
    legs: Vec<Leg>,
    total_s: f64,
}

#[derive(Debug)]
struct Leg {
    from: [f64; 3],
    /// Length of a drive, m, or angle of a turn, rad.
    amount: f64,
    turn: bool,
    /// Sideways swing of a drive, m, and the number of its periods.
    weave: [f64; 2],
    duration_s: f64,
    rise_s: f64,
}

impl Leg {
    /// `rate`: top speed, m/s or rad/s.
    fn new(from: [f64; 3], amount: f64, turn: bool, weave: [f64; 2], rate: f64) -> Self {
        let rise_s = (0.6 * amount.abs() / rate).min(0.9);
        Self { from, amount, turn, weave, duration_s: amount.abs() / rate + rise_s, rise_s }
    }

    /// (x, y, yaw) and the share of the top speed, `t` seconds after the leg's start.
    fn at(&self, t: f64) -> ([f64; 3], f64) {
        let (rise, whole) = (self.rise_s, self.duration_s);
        let way = |t: f64| rise * smooth_integral(t / rise);
        let share = (way(t) - way(t - (whole - rise))) / (whole - rise);
        let drive = smooth(t / rise) - smooth((t - (whole - rise)) / rise);
        let [x, y, yaw] = self.from;
        if self.turn {
            return ([x, y, yaw + self.amount * share], drive);
        }
        let along = self.amount * share;
        let [swing, periods] = self.weave;
        let across = swing * 0.5 * (1.0 - (TAU * periods * share).cos());
        let slope = swing * 0.5 * TAU * periods / self.amount * (TAU * periods * share).sin();
        let (sin, cos) = yaw.sin_cos();
        ([x + along * cos - across * sin, y + along * sin + across * cos, yaw + slope.atan()], drive)
    }
}

impl Legs {
    fn new(legs: Vec<Leg>) -> Self {
        let total_s = legs.iter().map(|l| l.duration_s).sum();
        Self { legs, total_s }
    }

    fn at(&self, t: f64) -> ([f64; 3], f64) {
        let mut t = t.rem_euclid(self.total_s);
        for leg in &self.legs {
            if t < leg.duration_s {
                return leg.at(t);
            }
            t -= leg.duration_s;
        }
        self.legs.last().map_or(([0.0; 3], 0.0), |l| l.at(l.duration_s))
    }
}

fn square() -> Legs {
    let (a, b) = (1.6, 1.2);
    let mut legs = Vec::new();
    for (i, (x, y)) in [(-a, -b), (a, -b), (a, b), (-a, b)].into_iter().enumerate() {
        let yaw = FRAC_PI_2 * i as f64;
        let length = if i % 2 == 0 { 2.0 * a } else { 2.0 * b };
        legs.push(Leg::new([x, y, yaw], length, false, [0.12, 1.0], 0.42));
        let end = [x + length * yaw.cos(), y + length * yaw.sin(), yaw];
        legs.push(Leg::new(end, FRAC_PI_2, true, [0.0; 2], 0.65));
    }
    Legs::new(legs)
}

fn corridor() -> Legs {
    let (low, high) = (-5.4, 5.2);
    let length = high - low;
    Legs::new(vec![
        Leg::new([low, -0.12, 0.0], length, false, [0.24, 3.0], 0.5),
        Leg::new([high, -0.12, 0.0], PI, true, [0.0; 2], 0.65),
        Leg::new([high, -0.12, PI], length, false, [-0.24, 3.0], 0.5),
        Leg::new([low, -0.12, PI], PI, true, [0.0; 2], 0.65),
    ])
}
