//! Where the camera was last, how it moved, and the smooth pose that follows from it.

use nalgebra::{UnitQuaternion, Vector3};

use crate::geometry::Se3;
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::frames::{Camera, Odom, World};
use crate::geometry::sim3::Sim3;
use crate::map::Correction;

/// Frames farther apart than this tell too little of the motion within one of them to tell a velocity, or to correct a rolling shutter by it, s. (At
/// 5 Hz it still pays: hand-held and walking, errors without the correction are larger than with it.)
pub const LONGEST_STEP_S: f64 = 0.3;

/// A motion, `this camera from the previous one`, and how long it took, s.
pub type Step = (Se3<Camera, Camera>, f64);

/// The frame that was tracked last.
#[derive(Debug, Clone, Copy)]
pub struct LastFrame {
    pub timestamp_ns: i64,
    pub camera_from_world: Se3<Camera, World>,
    /// The motion that led here.
    pub step: Option<Step>,
    /// How the camera moved at the frame before, by the steps to both sides of it, and when that was, ns.
    pub motion_before: Option<(i64, CameraMotion)>,
}

/// The frames that were tracked in one map.
#[derive(Debug, Clone, Copy, Default)]
pub struct Odometry {
    pub last: Option<LastFrame>,
    /// Smooth pose: no correction of the map moves it.
    pub odom_from_camera: Se3<Odom, Camera>,
    /// Frames in a row, up to the newest, that could not be tracked.
    pub lost_frames: u64,
    /// The first of them since the map was there.
    pub lost_since_ns: Option<i64>,
}

impl Odometry {
    /// Begins with the frame that a map was begun with.
    pub fn begin(timestamp_ns: i64, camera_from_world: Se3<Camera, World>) -> Self {
        Self {
            last: Some(LastFrame { timestamp_ns, camera_from_world, step: None, motion_before: None }),
            odom_from_camera: camera_from_world.inverse().relabel(),
            lost_frames: 0,
            lost_since_ns: None,
        }
    }

    /// Turns the smooth frame about its origin such that the camera has this orientation in it.
    pub fn turn_to(&mut self, odom_from_camera: UnitQuaternion<f64>) {
        let turn = odom_from_camera * self.odom_from_camera.rotation.inverse();
        self.odom_from_camera = Se3::new(odom_from_camera, turn * self.odom_from_camera.translation);
    }

    /// Takes over a frame that was tracked; the motion that led to it, if the one before was not lost.
    pub fn accept(&mut self, timestamp_ns: i64, camera_from_world: Se3<Camera, World>) -> Option<Step> {
        let mut step = None;
        if let Some(last) = &self.last {
            let dt = (timestamp_ns - last.timestamp_ns) as f64 * 1e-9;
            let motion = (camera_from_world * last.camera_from_world.inverse()).relabel::<Camera, Camera>();
            self.odom_from_camera = self.odom_from_camera * motion.inverse();
            step = (dt > 0.0 && self.lost_frames == 0).then_some((motion, dt));
        }
        let motion_before = self
            .followed()
            .zip(step.as_ref())
            .and_then(|(last, after)| Some((last.timestamp_ns, motion_between(last.step.as_ref()?, after)?)));
        self.last = Some(LastFrame { timestamp_ns, camera_from_world, step, motion_before });
        (self.lost_frames, self.lost_since_ns) = (0, None);
        step
    }

    /// The last frame is there instead; how it came there is not known.
    pub fn replace(&mut self, camera_from_world: Se3<Camera, World>) {
        if let Some(last) = &mut self.last {
            (last.camera_from_world, last.step, last.motion_before) = (camera_from_world, None, None);
        }
    }

    /// An adjustment has moved the last frame's surroundings.
    pub fn correct(&mut self, old_from_new: &Se3<World, World>) {
        if let Some(last) = &mut self.last {
            last.camera_from_world = last.camera_from_world * *old_from_new;
        }
    }

    /// A closed loop has moved the last frame's surroundings, and changed the unit of lengths there; the smooth pose goes on from
    /// where it is, in that unit.
    pub fn correct_scaled(&mut self, new_from_old: &Sim3<World, World>) {
        if let Some(last) = &mut self.last {
            last.camera_from_world = Correction::placed(&last.camera_from_world, new_from_old);
            last.motion_before = None;
            if let Some((motion, _)) = &mut last.step {
                motion.translation *= new_from_old.scale;
            }
        }
    }

    /// Notes a frame that could not be tracked.
    pub fn lose(&mut self, timestamp_ns: i64) {
        self.lost_frames += 1;
        self.lost_since_ns.get_or_insert(timestamp_ns);
    }

    /// For how long frames could not be tracked, s.
    pub fn lost_for_s(&self, timestamp_ns: i64) -> f64 {
        self.lost_since_ns.map_or(0.0, |since_ns| timestamp_ns.saturating_sub(since_ns) as f64 * 1e-9)
    }

    /// Where the camera was last, in the map as it is now.
    pub fn pose(&self) -> Option<Se3<Camera, World>> {
        self.last.map(|last| last.camera_from_world)
    }

    /// The last frame, if it is the one just before.
    pub fn followed(&self) -> Option<&LastFrame> {
        self.last.as_ref().filter(|_| self.lost_frames == 0)
    }

    /// Pose of the frame before and the time since, if that was tracked and not long ago.
    pub fn before(&self, timestamp_ns: i64) -> Option<(Se3<Camera, World>, f64)> {
        let last = self.followed()?;
        let dt = (timestamp_ns - last.timestamp_ns) as f64 * 1e-9;
        (dt > 0.0 && dt < LONGEST_STEP_S).then_some((last.camera_from_world, dt))
    }

    /// How the camera moved at the last frame; nothing is known of that after frames that were lost.
    pub fn motion(&self) -> Option<CameraMotion> {
        let (motion, dt) = self.followed()?.step?;
        Some(CameraMotion::over(&motion, dt))
    }

    /// Where the next frame is likely to be: by constant velocity, by the wheels (`now_from_last`) if they tell, then where the last
    /// one was. (The wheels first: errors of 16 drives at 5 Hz are the same in the geometric mean, one is a third, another almost four times as large.)
    pub fn guesses(
        &self,
        timestamp_ns: i64,
        now_from_last: Option<&Se3<Camera, Camera>>,
    ) -> ([Se3<Camera, World>; 3], usize) {
        let Some(last) = &self.last else { return ([Se3::identity(); 3], 0) };
        let dt = (timestamp_ns - last.timestamp_ns) as f64 * 1e-9;
        let by_wheels = now_from_last.map(|motion| *motion * last.camera_from_world);
        let by_velocity = last.step.filter(|(_, over)| self.lost_frames == 0 && dt < 5.0 * over);
        let by_velocity = by_velocity.map(|(motion, over)| motion.scaled(dt / over) * last.camera_from_world);
        let (mut guesses, mut n) = ([last.camera_from_world; 3], 0);
        for guess in [by_velocity, by_wheels, Some(last.camera_from_world)].into_iter().flatten() {
            guesses[n] = guess;
            n += 1;
        }
        (guesses, n)
    }
}

/// How the camera moves between two steps that follow each other: that of the parabola through three poses.
fn motion_between((before, before_s): &Step, (after, after_s): &Step) -> Option<CameraMotion> {
    let (a, b) = (CameraMotion::over(before, *before_s), CameraMotion::over(after, *after_s));
    let share = before_s / (before_s + after_s);
    let between = |a: Vector3<f64>, b: Vector3<f64>| a + (b - a) * share;
    (before_s.max(*after_s) < LONGEST_STEP_S)
        .then(|| CameraMotion { turn: between(a.turn, b.turn), shift: between(a.shift, b.shift) })
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;

    use super::*;

    fn at(x: f64, turn: f64) -> Se3<Camera, World> {
        Se3::new(UnitQuaternion::from_scaled_axis(Vector3::new(0.0, turn, 0.0)), Vector3::new(-x, 0.0, 0.0))
    }

    #[test]
    fn the_next_frame_is_expected_where_the_motion_goes_on_and_after_lost_ones_where_the_last_was() {
        let mut odometry = Odometry::begin(0, at(0.0, 0.0));
        assert_eq!(odometry.guesses(100_000_000, None).1, 1, "one frame tells no motion");
        odometry.accept(100_000_000, at(0.1, 0.0)).expect("a step");
        let (guesses, n) = odometry.guesses(300_000_000, None);
        assert!(n == 2 && (guesses[0].translation.x + 0.3).abs() < 1e-12, "twice the step in twice the time");
        assert!(odometry.before(300_000_000).is_some() && odometry.before(450_000_000).is_none());
        let wheels = at(0.2, 0.1);
        let (guesses, n) = odometry.guesses(300_000_000, Some(&wheels.relabel()));
        assert!(n == 3 && (guesses[0].translation.x + 0.3).abs() < 1e-12 && guesses[1] != guesses[2]);
        odometry.lose(200_000_000);
        odometry.lose(300_000_000);
        assert!((odometry.lost_for_s(300_000_000) - 0.1).abs() < 1e-9);
        let (guesses, n) = odometry.guesses(300_000_000, Some(&wheels.relabel()));
        assert!(n == 2 && (guesses[0].translation.x + 0.3).abs() < 2e-3, "after lost frames the wheels' word first");
        assert!(odometry.guesses(300_000_000, None).1 == 1 && odometry.motion().is_none());
        assert!(odometry.accept(300_000_000, at(0.5, 0.0)).is_none(), "what led here after lost frames is not known");
        assert_eq!((odometry.lost_frames, odometry.lost_for_s(400_000_000)), (0, 0.0));
    }

    #[test]
    fn a_smooth_frame_that_is_turned_keeps_all_motions() {
        let mut odometry = Odometry::begin(0, at(2.0, 0.4));
        let before = odometry.odom_from_camera;
        let turned = UnitQuaternion::from_scaled_axis(Vector3::new(0.1, 1.5, -0.2));
        odometry.turn_to(turned);
        assert!(odometry.odom_from_camera.rotation.angle_to(&turned) < 1e-12);
        let shift = odometry.odom_from_camera.translation.norm() - before.translation.norm();
        assert!(shift.abs() < 1e-12, "about the origin");
        let camera_shift = |odom: &Se3<Odom, Camera>| odom.rotation.inverse() * odom.translation;
        assert!((camera_shift(&odometry.odom_from_camera) - camera_shift(&before)).norm() < 1e-12);
    }

    #[test]
    fn a_closed_loop_does_not_move_the_smooth_pose_and_motions_go_on_in_the_new_unit() {
        let mut odometry = Odometry::begin(0, at(0.0, 0.3));
        odometry.accept(100, at(1.0, 0.3));
        let before = odometry.odom_from_camera;
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.0, 0.2, 0.0));
        let moved: Sim3<World, World> = Sim3::new(2.0, turn, Vector3::new(0.0, 0.5, 0.0));
        odometry.correct_scaled(&moved);
        assert_eq!(odometry.odom_from_camera, before);
        let ([expected, ..], _) = odometry.guesses(200, None);
        assert!(
            (Correction::placed(&at(2.0, 0.3), &moved).inverse().translation - expected.inverse().translation).norm()
                < 1e-9
        );
        odometry.accept(200, expected);
        let way = (before.inverse() * odometry.odom_from_camera).translation;
        assert!((way.norm() - 2.0).abs() < 1e-9, "{way}");
    }

    #[test]
    fn corrections_of_the_map_do_not_move_the_smooth_pose() {
        let mut odometry = Odometry::begin(0, at(0.0, 0.3));
        odometry.accept(1, at(1.0, 0.3));
        let before = odometry.odom_from_camera;
        let old_from_new: Se3<World, World> = Se3::new(UnitQuaternion::identity(), Vector3::new(0.0, 0.5, 0.0));
        odometry.correct(&old_from_new);
        assert_eq!(odometry.odom_from_camera, before);
        // The next frame, tracked in the corrected map, goes on from there.
        odometry.accept(2, at(2.0, 0.3) * old_from_new);
        let moved = (before.inverse() * odometry.odom_from_camera).translation;
        assert!((moved.norm() - 1.0).abs() < 1e-12, "{moved}");
    }

    /// Where a camera is after `t` seconds that speeds up or turns more and more.
    fn after(t: f64, twist: [f64; 6], change: [f64; 6]) -> Se3<Camera, Camera> {
        let (twist, change) = (Vector6::from(twist), Vector6::from(change));
        let steps = 1000;
        let dt = t / f64::from(steps);
        (0..steps).fold(Se3::identity(), |pose, i| {
            let now = twist + change * ((f64::from(i) + 0.5) * dt);
            Se3::exp(&(now * dt)) * pose
        })
    }

    #[test]
    fn the_motion_between_two_steps_is_that_at_the_frame_between_them() {
        let twist = [0.1, 1.0, -0.2, 0.05, -0.1, 0.5];
        for change in [[0.0; 6], [0.5, -1.0, 0.3, 0.2, 0.1, -0.5]] {
            for [before_s, after_s] in [[0.1, 0.1], [0.2, 0.1], [0.03, 0.07]] {
                let (a, b) = (after(before_s, twist, change), after(before_s + after_s, twist, change));
                let found = motion_between(&(a, before_s), &(b * a.inverse(), after_s)).expect("short steps");
                let truth = Vector6::from(twist) + Vector6::from(change) * before_s;
                let off = |v: Vector3<f64>, first| (v - truth.fixed_rows::<3>(first)).norm();
                let off = off(found.turn, 0).max(off(found.shift, 3));
                let of_before = CameraMotion::over(&a, before_s);
                let off_before = (of_before.shift - truth.fixed_rows::<3>(3)).norm();
                assert!(off < 2e-3 && (off_before > 5.0 * off || change == [0.0; 6]), "{off}, {off_before} before");
            }
        }
    }
}
