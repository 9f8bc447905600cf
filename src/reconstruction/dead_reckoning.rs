//! The camera's motion by the wheels alone: where a frame must be, seen or not.
//!
//! Input: what the wheels say of the time since the frame that was tracked last ([`WheelScale::ahead`]), and how the camera sits on the base
//! ([`Robot`]). Output: the camera's motion since then in map units, with its covariance. With `B` the base's motion on its plane (start from end),
//! `X = (R, p)` base_from_camera and `m` map units a metre:
//!
//! ```text
//! now_from_last = X^-1 B^-1 X        (its translation times m; the lever's height cancels)
//! ```
//!
//! Covariance, by left perturbations `[w, v]` of `now_from_last`: that of the wheels' readings, which grows by time and way ([`Increment`]); what
//! is not known of rotation and lever of the mount, of the yaw rate factor and of `m`; a floor that is no plane. With `S` the camera's step, `d` an error of
//! the mount's rotation and `q` one of the lever, all in the base's axes at the end:
//!
//! ```text
//! base (w_b, v_b):  w = R' w_b               v = R' (w_b x p + v_b)
//! mount:            w = R' (B^-1 d - d)      v = R' B^-1 (d x S)
//! lever:            w = 0                    v = R' (B^-1 q - q)
//! ```
//!
//! A wheel that slips in the dark is in none of it: nothing sees it.
//!
//! Cost: 30 ns a reading since then. Not here: what becomes of a frame ([`blind`](super::blind)).

use nalgebra::{Matrix3, Matrix6, Matrix6x3, UnitQuaternion, Vector3, Vector6};

use crate::geometry::Se3;
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::frames::{Camera, Odom, World};
use crate::motion::hand_eye::{ROCKING_RAD, Robot, UPWARDS_SHARE};
use crate::motion::planar::Increment;
use crate::motion::wheel_scale::WheelScale;

/// Wheels are believed alone for so long and so far, s and m: what slips or is lifted meanwhile is not noticed.
pub const LONGEST_S: f64 = 15.0;
pub const LONGEST_M: f64 = 15.0;
/// And until the place is as uncertain as this, m (standard deviation of its worst direction) and rad.
const MOST_SIGMA_M: f64 = 0.3;
const MOST_SIGMA_RAD: f64 = 0.2;
/// A reading that is so late or lost is bridged by the one before, ns: a driver of 20 Hz and two lost messages.
const LATE_NS: i64 = 150_000_000;
/// How the base moves now is taken from so long before, ns.
const NOW_NS: i64 = 60_000_000;
/// Standard deviation of the mount's rotation, rad, above which nothing is predicted by wheels.
const MOUNT_RAD: f64 = 0.1;

/// How long a metre of the wheels is in the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Metre {
    /// Map units.
    pub units: f64,
    /// Its standard deviation as a share.
    pub sigma: f64,
}

/// The camera's motion since the frame that was tracked last, by the wheels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ahead {
    /// Map units.
    pub now_from_last: Se3<Camera, Camera>,
    /// Of its left perturbation (rotation, translation).
    pub covariance: Matrix6<f64>,
    /// How the camera moves now.
    pub motion: Option<CameraMotion>,
    /// Of the base, m, and the time, s.
    pub way_m: f64,
    pub span_s: f64,
    pub metre: Metre,
}

impl Ahead {
    /// The motion from one time to another (ns); `None` where the wheels say nothing of it, or the mount is not known.
    pub fn of(wheels: &WheelScale, (from_ns, to_ns): (i64, i64), metre: Metre) -> Option<Self> {
        let robot = wheels.robot();
        if to_ns <= from_ns || wheels.slipping || robot.sigma[..3].iter().any(|sigma| *sigma > MOUNT_RAD) {
            return None;
        }
        let increment = wheels.ahead(from_ns, to_ns, LATE_NS)?;
        let just_before = from_ns.max(to_ns - NOW_NS);
        let dt = (to_ns - just_before) as f64 * 1e-9;
        let motion = wheels.ahead(just_before, to_ns, LATE_NS).map(|now| {
            let step = camera_motion(&robot, &now).inverse().rescaled(metre.units);
            CameraMotion::over(&step, dt)
        });
        let now_from_last = camera_motion(&robot, &increment).inverse().rescaled(metre.units);
        let mut covariance = scaled_covariance(&camera_covariance(&robot, &increment), metre.units);
        let longer = now_from_last.translation * metre.sigma;
        let mut place = covariance.fixed_view_mut::<3, 3>(3, 3);
        place += longer * longer.transpose();
        let span_s = (to_ns - from_ns) as f64 * 1e-9;
        Some(Self { now_from_last, covariance, motion, way_m: increment.way_m, span_s, metre })
    }

    /// Standard deviations of place (its worst direction, m) and turn (rad).
    pub fn sigma(&self) -> (f64, f64) {
        let worst = |corner: usize| {
            let block: Matrix3<f64> = self.covariance.fixed_view::<3, 3>(corner, corner).into_owned();
            block.symmetric_eigenvalues().max().max(0.0).sqrt()
        };
        (worst(3) / self.metre.units, worst(0))
    }

    /// The wheels alone may tell the place so long after the last sight of it.
    pub fn is_believed(&self) -> bool {
        let (place, turn) = self.sigma();
        let near = self.span_s <= LONGEST_S && self.way_m <= LONGEST_M;
        near && place <= MOST_SIGMA_M && turn <= MOST_SIGMA_RAD && self.now_from_last.is_finite()
    }

    /// Covariance of the left perturbation of a pose that was known so before this motion.
    pub fn carry(&self, covariance: &Matrix6<f64>) -> Matrix6<f64> {
        let carried = self.now_from_last.adjoint();
        carried * covariance * carried.transpose() + self.covariance
    }

    /// Whether a pose is where this motion leads from the last one, within what it may be wrong by: `share` of the way is allowed beside three
    /// standard deviations.
    pub fn agrees(&self, last: &Se3<Camera, World>, pose: &Se3<Camera, World>) -> bool {
        const ROOM_RAD: f64 = 0.02;
        const ROOM_M: f64 = 0.03;
        const ROOM_SHARE: f64 = 0.05;
        let off = *pose * (self.now_from_last * *last).inverse();
        let (place, turn) = self.sigma();
        off.rotation.angle() <= ROOM_RAD + 3.0 * turn
            && off.translation.norm() <= self.metre.units * (ROOM_M + ROOM_SHARE * self.way_m + 3.0 * place)
    }
}

/// What is remembered from frame to frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DeadReckoning {
    /// Covariance of the pose that was tracked last, of its left perturbation.
    pub covariance: Matrix6<f64>,
    /// The newest frame, if it was placed by the wheels.
    pub reckoned: Option<Reckoned>,
    /// Up to the newest such frame, since the start: time, ns, and way, m.
    pub total_ns: u64,
    pub total_m: f64,
    /// Times that a map went on from a dead-reckoned pose.
    pub continued: u64,
    /// Since the frame that was tracked last, in the totals already: time, s, and way, m.
    counted: (f64, f64),
}

/// A frame that the wheels alone have placed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reckoned {
    pub odom_from_camera: Se3<Odom, Camera>,
    /// Since the last frame that was tracked: time, s, way, m, and how uncertain the place has become, m and rad.
    pub span_s: f64,
    pub way_m: f64,
    pub sigma_m: f64,
    pub sigma_rad: f64,
}

impl Default for DeadReckoning {
    fn default() -> Self {
        Self {
            covariance: Matrix6::from_element(f64::NAN),
            reckoned: None,
            total_ns: 0,
            total_m: 0.0,
            continued: 0,
            counted: (0.0, 0.0),
        }
    }
}

impl DeadReckoning {
    /// Another frame has been placed by the wheels.
    pub fn note(&mut self, ahead: &Ahead, odom_from_camera: Se3<Odom, Camera>) {
        // Not those of the frame before: the wheels may have been silent at that one.
        let (span_s, way_m) = self.counted;
        self.total_ns += ((ahead.span_s - span_s).max(0.0) * 1e9).round() as u64;
        self.total_m += (ahead.way_m - way_m).max(0.0);
        let (sigma_m, sigma_rad) = ahead.sigma();
        let Ahead { span_s, way_m, .. } = *ahead;
        self.counted = (span_s, way_m);
        self.reckoned = Some(Reckoned { odom_from_camera, span_s, way_m, sigma_m, sigma_rad });
    }

    /// A frame was tracked, or nothing is to go on from the one that was.
    pub fn see(&mut self) {
        (self.reckoned, self.counted) = (None, (0.0, 0.0));
    }

    /// The map's lengths are `factor` times as long from now on.
    pub fn rescale(&mut self, factor: f64) {
        self.covariance = scaled_covariance(&self.covariance, factor);
    }
}

/// Start from end, of the camera (m), by that of the base.
fn camera_motion(robot: &Robot, increment: &Increment) -> Se3<Camera, Camera> {
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), increment.motion.yaw);
    let camera_from_base = robot.base_from_camera.inverse();
    Se3::new(camera_from_base * turn * robot.base_from_camera, camera_from_base * robot.step_of(&increment.motion))
}

/// Of the left perturbation of the camera's motion, end from start, m.
fn camera_covariance(robot: &Robot, increment: &Increment) -> Matrix6<f64> {
    let yaw = increment.motion.yaw;
    let end_from_start = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), -yaw);
    let turned = end_from_start.to_rotation_matrix();
    // Errors of the base at the end, rotation and translation in its axes there.
    let mut by_wheels = Matrix6x3::zeros();
    by_wheels.fixed_view_mut::<3, 2>(3, 0).copy_from(&turned.matrix().fixed_view::<3, 2>(0, 0));
    by_wheels[(2, 2)] = 1.0;
    let mut base = by_wheels * increment.covariance * by_wheels.transpose();
    base[(0, 0)] += ROCKING_RAD * ROCKING_RAD;
    base[(1, 1)] += ROCKING_RAD * ROCKING_RAD;
    base[(5, 5)] += (UPWARDS_SHARE * increment.way_m).powi(2);
    let square = |rotation: Vector3<f64>, translation: Vector3<f64>| {
        let column = Vector6::new(rotation.x, rotation.y, rotation.z, translation.x, translation.y, translation.z);
        column * column.transpose()
    };
    // Half of what a turn is wrong by is a wrong direction of the way.
    let heading = Vector3::new(0.0, 0.0, robot.sigma[5] * yaw);
    base += square(heading, turned * (0.5 * heading).cross(&increment.motion.translation.push(0.0)));
    let lever = robot.lever_m.push(0.0);
    let mut from_base_to_lens = Matrix6::identity();
    from_base_to_lens.fixed_view_mut::<3, 3>(3, 0).copy_from(&-lever.cross_matrix());
    let mut camera = from_base_to_lens * base * from_base_to_lens.transpose();
    // The mount is wrong by the same at both ends.
    let step = robot.step_of(&increment.motion);
    for i in 0..3 {
        let axis = Vector3::ith(i, robot.sigma[i]);
        camera += square(turned * axis - axis, turned * axis.cross(&step));
    }
    for i in 0..2 {
        let lever = Vector3::ith(i, robot.sigma[3 + i]);
        camera += square(Vector3::zeros(), turned * lever - lever);
    }
    let axes = robot.base_from_camera.inverse().to_rotation_matrix().into_inner();
    let mut into_camera = Matrix6::zeros();
    into_camera.fixed_view_mut::<3, 3>(0, 0).copy_from(&axes);
    into_camera.fixed_view_mut::<3, 3>(3, 3).copy_from(&axes);
    into_camera * camera * into_camera.transpose()
}

fn scaled_covariance(covariance: &Matrix6<f64>, factor: f64) -> Matrix6<f64> {
    let units = Matrix6::from_diagonal(&Vector6::new(1.0, 1.0, 1.0, factor, factor, factor));
    units * covariance * units
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::random::Random;
    use crate::geometry::ros_from_optical;
    use crate::motion::wheel::WheelReading;
    use nalgebra::Vector2;

    const SIGMA: [f64; 3] = [0.05, 0.0, 0.06];

    /// All of it is known well.
    fn robot() -> Robot {
        let tilt = UnitQuaternion::from_euler_angles(0.03, -0.2, 0.3);
        let mounted = Robot::mounted(tilt * ros_from_optical(), Vector2::new(0.12, -0.05));
        Robot { sigma: [1e-4; 7], ..mounted }
    }

    /// Of a curve of two seconds at 0.5 m/s and 0.6 rad/s, noisy or not.
    fn readings(mut noise: impl FnMut() -> f64) -> Vec<WheelReading> {
        let reading = |i: i64| WheelReading {
            from_ns: i * 50_000_000,
            timestamp_ns: (i + 1) * 50_000_000,
            linear_x_mps: 0.5 + SIGMA[0] * noise(),
            linear_y_mps: 0.0,
            angular_z_radps: 0.6 + SIGMA[2] * noise(),
            variance: SIGMA.map(|s| s * s),
        };
        (0..40).map(reading).collect()
    }

    fn curve(noise: impl FnMut() -> f64) -> WheelScale {
        let mut wheels = WheelScale::new(robot(), 0.01);
        readings(noise).iter().for_each(|reading| assert!(wheels.add_reading(reading)));
        wheels
    }

    fn exact(units: f64) -> Metre {
        Metre { units, sigma: 0.0 }
    }

    fn ahead(wheels: &WheelScale) -> Ahead {
        Ahead::of(wheels, (0, 2_000_000_000), exact(2.0)).expect("told")
    }

    #[test]
    fn a_base_in_a_curve_carries_its_camera_along_an_arc() {
        let found = ahead(&curve(|| 0.0)).now_from_last.inverse();
        // The base's arc in its axes; the camera's place on it before and after.
        let (angle, robot) = (1.2_f64, robot());
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle);
        let arc = Vector3::new(angle.sin(), 1.0 - angle.cos(), 0.0) * (0.5 / 0.6);
        let lever = Vector3::new(0.12, -0.05, 0.7);
        let step = robot.base_from_camera.inverse() * (arc + turn * lever - lever);
        assert!((found.translation - 2.0 * step).norm() < 1e-9, "the lever's height has no part in it");
        let rotation = robot.base_from_camera.inverse() * turn * robot.base_from_camera;
        assert!(found.rotation.angle_to(&rotation) < 1e-9);
    }

    #[test]
    fn covariance_is_that_of_noisy_wheels() {
        let mut random = Random::new(9);
        let truth = ahead(&curve(|| 0.0));
        let (mut sum, n) = (Matrix6::zeros(), 1500);
        for _ in 0..n {
            let found = ahead(&curve(|| random.normal())).now_from_last;
            let turn = (found.rotation * truth.now_from_last.rotation.inverse()).scaled_axis();
            let shift = found.translation - UnitQuaternion::from_scaled_axis(turn) * truth.now_from_last.translation;
            let e = Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z);
            sum += e * e.transpose() / f64::from(n);
        }
        // What the floor and the mount add is no noise of wheels: along the base's up and plane alone both must agree.
        let axes = robot().base_from_camera.to_rotation_matrix().into_inner();
        let in_base = |m: &Matrix6<f64>, at: usize| axes * m.fixed_view::<3, 3>(at, at) * axes.transpose();
        let (sampled, told) = (in_base(&sum, 0), in_base(&truth.covariance, 0));
        let ratio = sampled[(2, 2)] / told[(2, 2)];
        assert!((0.85..1.15).contains(&ratio), "yaw: sampled over told {ratio}");
        let (sampled, told) = (in_base(&sum, 3), in_base(&truth.covariance, 3));
        for i in 0..2 {
            let ratio = sampled[(i, i)] / told[(i, i)];
            assert!((0.8..1.2).contains(&ratio), "axis {i}: sampled over told {ratio}");
        }
    }

    #[test]
    fn covariance_of_what_is_not_known_of_the_robot_is_that_of_the_motion_itself() {
        let (wheels, h) = (curve(|| 0.0), 1e-6);
        let known = Robot { sigma: [0.0; 7], ..robot() };
        for i in 0..6 {
            // In a longer arc what is wrong of the yaw rate shortens the chord, too, which is of the second order in the turn.
            let to_ns = if i < 5 { 2_000_000_000 } else { 500_000_000 };
            let increment = wheels.between(0, to_ns).expect("told");
            let (mut wrong, mut driven) = (known, increment);
            match i {
                0..3 => {
                    let turn = UnitQuaternion::from_scaled_axis(Vector3::ith(i, h));
                    wrong.base_from_camera = turn * wrong.base_from_camera;
                }
                3 | 4 => wrong.lever_m[i - 3] += h,
                _ => {
                    let mut by_factor = WheelScale::new(Robot { yaw_factor: 1.0 + h, ..robot() }, 0.01);
                    readings(|| 0.0).iter().for_each(|reading| assert!(by_factor.add_reading(reading)));
                    driven = by_factor.between(0, to_ns).expect("told");
                }
            }
            let off = camera_motion(&wrong, &driven).inverse() * camera_motion(&known, &increment);
            let (w, t) = (off.rotation.scaled_axis(), off.translation);
            let column = Vector6::new(w.x, w.y, w.z, t.x, t.y, t.z) / h;
            let expected = column * column.transpose();
            let mut doubted = known;
            doubted.sigma[i] = 1.0;
            let told = camera_covariance(&doubted, &increment) - camera_covariance(&known, &increment);
            let most = if i < 5 { 1e-4 } else { 0.1 };
            assert!((told - expected).norm() < most * expected.norm(), "{i}: {told} {expected}");
        }
    }

    #[test]
    fn a_metre_of_doubtful_length_makes_the_place_doubtful_along_the_way() {
        let wheels = curve(|| 0.0);
        let of = |sigma: f64| Ahead::of(&wheels, (0, 2_000_000_000), Metre { units: 2.0, sigma }).expect("told");
        let added = of(0.1).covariance - of(0.0).covariance;
        let way = of(0.0).now_from_last.translation * 0.1;
        assert!((added.fixed_view::<3, 3>(3, 3) - way * way.transpose()).norm() < 1e-12);
        assert!(added.fixed_view::<3, 6>(0, 0).norm() == 0.0);
        assert!(of(0.0).is_believed() && !of(0.5).is_believed(), "half of 0.9 m is not known");
    }

    #[test]
    fn wheels_are_believed_for_a_while_and_not_without_a_mount() {
        let wheels = curve(|| 0.0);
        assert!(ahead(&wheels).is_believed());
        let told = |from: i64, to: i64| Ahead::of(&wheels, (from, to), exact(1.0));
        assert!(told(0, 2_100_000_000).is_some() && told(0, 2_300_000_000).is_none(), "silent");
        let far = Ahead { way_m: LONGEST_M + 0.1, ..ahead(&wheels) };
        let long = Ahead { span_s: LONGEST_S + 0.1, ..ahead(&wheels) };
        let vague = Ahead { covariance: ahead(&wheels).covariance * 400.0, ..ahead(&wheels) };
        assert!(!far.is_believed() && !long.is_believed() && !vague.is_believed());
        let unknown = WheelScale::new(Robot::unknown(), 0.01);
        assert!(Ahead::of(&unknown, (0, 1), exact(1.0)).is_none());
    }

    #[test]
    fn time_and_way_are_counted_once_though_the_wheels_were_silent_in_between() {
        let after = |span_s: f64| Ahead { span_s, way_m: 0.5 * span_s, ..ahead(&curve(|| 0.0)) };
        let mut blind = DeadReckoning::default();
        blind.note(&after(1.0), Se3::identity());
        blind.reckoned = None;
        blind.note(&after(3.0), Se3::identity());
        assert_eq!((blind.total_ns, blind.total_m), (3_000_000_000, 1.5));
        blind.see();
        blind.note(&after(1.0), Se3::identity());
        assert_eq!((blind.total_ns, blind.total_m), (4_000_000_000, 2.0));
    }

    #[test]
    fn a_pose_known_before_is_less_so_after() {
        let ahead = ahead(&curve(|| 0.0));
        let before = Matrix6::from_diagonal(&Vector6::new(1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4));
        let after = ahead.carry(&before);
        assert!(after.determinant() > before.determinant());
        // Numerically: a small error before is where `carry` says after.
        let last: Se3<Camera, World> =
            Se3::new(UnitQuaternion::from_euler_angles(0.1, 0.2, 0.3), Vector3::new(1.0, 2.0, 3.0));
        let error = Vector6::new(1e-6, -2e-6, 3e-6, 2e-6, 1e-6, -1e-6);
        let moved = (ahead.now_from_last * last.perturb_left(&error)) * (ahead.now_from_last * last).inverse();
        let w = moved.rotation.scaled_axis();
        let e = Vector6::new(w.x, w.y, w.z, moved.translation.x, moved.translation.y, moved.translation.z);
        let told = Ahead { covariance: Matrix6::zeros(), ..ahead }.carry(&(error * error.transpose()));
        assert!((told - e * e.transpose()).norm() < 1e-5 * told.norm(), "{told} {e}");
    }
}
