//! A made drive for tests: a robot with wheels and a camera whose motions are known exactly, and what both say of them.

use nalgebra::{UnitQuaternion, Vector2, Vector3};

use super::hand_eye::{Robot, Segment, Unit};
use super::planar::WheelHistory;
use super::wheel::WheelReading;
use crate::geometry::frames::{Body, Camera, World};
use crate::geometry::random::Random;
use crate::geometry::{Se3, ros_from_optical};

/// What a drive is like.
pub struct Course {
    pub seconds: f64,
    /// 1: usual noise of both; 0: none.
    pub noise: f64,
    /// Yaw rates up to about this, rad/s.
    pub turning: f64,
    /// Bursts of slip: how many.
    pub bursts: usize,
    /// Error of both wheels' radii, share.
    pub radius: f64,
    /// Standard deviation of the map's scale from one place to the next a mean depth on.
    pub drift: f64,
    /// Rotation of the mount beyond looking forward.
    pub mount: Vector3<f64>,
}

/// A drive.
pub struct Drive {
    pub truth: Robot,
    pub history: WheelHistory,
    pub segments: Vec<Segment>,
    /// ln(metres per map unit) at its end.
    pub log_scale: f64,
    /// Bursts of slip, s.
    pub slips: Vec<(f64, f64)>,
}

const SPEED_MPS: f64 = 0.5;
const DEPTH_M: f64 = 2.5;
/// Of the path, ms.
const STEP_MS: usize = 5;

/// Pose of the base, its forward speed (m/s) and yaw rate (rad/s).
type Moment = (Se3<World, Body>, f64, f64);

/// One every so often.
fn path(course: &Course, random: &mut Random) -> Vec<Moment> {
    let phases: [f64; 4] = std::array::from_fn(|_| random.uniform(0.0, std::f64::consts::TAU));
    let (mut yaw, mut at, mut out) = (0.0_f64, Vector3::zeros(), Vec::new());
    let dt = STEP_MS as f64 * 1e-3;
    for i in 0..(course.seconds / dt) as usize {
        let t = i as f64 * dt;
        let v = SPEED_MPS * (1.0 + 0.3 * (0.7 * t + phases[0]).sin());
        let w = course.turning * ((0.5 * t + phases[1]).sin() + 0.6 * (0.23 * t + phases[2]).sin());
        out.push((Se3::new(UnitQuaternion::from_scaled_axis(Vector3::z() * yaw), at), v, w));
        at += Vector3::new((yaw + 0.5 * w * dt).cos(), (yaw + 0.5 * w * dt).sin(), 0.0) * v * dt;
        yaw += w * dt;
    }
    out
}

pub fn drive(seed: u64, change: impl Fn(&mut Course)) -> Drive {
    let mut random = Random::new(seed);
    let mut course = Course {
        seconds: 30.0,
        noise: 1.0,
        turning: 0.5,
        bursts: 0,
        radius: 0.0,
        drift: 0.003,
        mount: Vector3::new(0.03, 0.2, -0.1),
    };
    change(&mut course);
    let truth = Robot {
        base_from_camera: UnitQuaternion::from_scaled_axis(course.mount) * ros_from_optical(),
        lever_m: Vector2::new(0.12, -0.05),
        yaw_factor: 1.02,
        time_offset_s: 0.03,
        ..Robot::unknown()
    };
    let path = path(&course, &mut random);
    let slips: Vec<(f64, f64)> = (0..course.bursts)
        .map(|_| {
            let begin = random.uniform(0.0, course.seconds - 4.0);
            (begin, begin + random.uniform(1.0, 4.0))
        })
        .collect();
    let history = readings(&course, &path, &slips, &truth, &mut random);
    let (segments, log_scale) = segments(&course, &path, &truth, &mut random);
    Drive { truth, history, segments, log_scale, slips }
}

/// At 50 Hz; what the wheels say at `t + offset` is what the base did at `t`.
fn readings(
    course: &Course,
    path: &[Moment],
    slips: &[(f64, f64)],
    truth: &Robot,
    random: &mut Random,
) -> WheelHistory {
    let mut history = WheelHistory::default();
    let factors: Vec<f64> = slips.iter().map(|_| 1.0 / (1.0 - random.uniform(0.3, 0.5))).collect();
    let offset_ns = (truth.time_offset_s * 1e9) as i64;
    for (i, block) in path.chunks_exact(20 / STEP_MS).enumerate() {
        let t = i as f64 * 0.02;
        let slip: f64 = slips.iter().zip(&factors).filter(|((a, b), _)| (*a..*b).contains(&t)).map(|s| s.1).product();
        let mean = |f: fn(&Moment) -> f64| block.iter().map(f).sum::<f64>() / block.len() as f64;
        let (v, w) = (mean(|p| p.1), mean(|p| p.2));
        let noise = |random: &mut Random| course.noise * random.normal();
        let x = v * slip * (1.0 + course.radius) * (1.0 + 0.04 * noise(random)) + 0.01 * noise(random);
        let z = w / truth.yaw_factor * (1.0 + 0.04 * noise(random)) + 0.02 * noise(random);
        history.add(&WheelReading {
            from_ns: i as i64 * 20_000_000 + offset_ns,
            timestamp_ns: (i as i64 + 1) * 20_000_000 + offset_ns,
            linear_x_mps: x,
            linear_y_mps: 0.0,
            angular_z_radps: z,
            variance: [f64::NAN; 3],
        });
    }
    history
}

/// Of 0.7 s each, in a map whose scale drifts.
fn segments(course: &Course, path: &[Moment], truth: &Robot, random: &mut Random) -> (Vec<Segment>, f64) {
    let camera: Se3<Body, Camera> = Se3::new(truth.base_from_camera, truth.lever_m.push(0.3));
    let mut log_scale = random.uniform(-1.0, 1.5);
    let (mut out, mut depths, mut noise_before) = (Vec::new(), 0.0, Vector3::zeros());
    for k in 0.. {
        let (from, to) = (100 + 700 * k, 100 + 700 * (k + 1));
        let Some((end, ..)) = path.get(to / STEP_MS) else { break };
        let motion = (path[from / STEP_MS].0 * camera).inverse() * (*end * camera);
        let step_depths = motion.translation.norm() / DEPTH_M;
        log_scale += course.drift * step_depths.sqrt() * random.normal();
        depths += step_depths;
        let noise = Vector3::from_fn(|_, _| 0.001 * DEPTH_M * course.noise * random.normal());
        let turn = motion.rotation.scaled_axis() + Vector3::from_fn(|_, _| 5e-4 * course.noise * random.normal());
        // Both of a frame's neighbours share its error.
        let step = (motion.translation + noise - noise_before) / log_scale.exp();
        noise_before = noise;
        let times = (from as i64 * 1_000_000, to as i64 * 1_000_000);
        out.push(Segment::new(times, (turn, step), 0.0015 * DEPTH_M / log_scale.exp(), depths, Unit::default()));
    }
    (out, log_scale)
}
