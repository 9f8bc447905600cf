use std::f64::consts::FRAC_PI_2;

use nalgebra::{Matrix3, Matrix6, UnitQuaternion, Vector3, Vector6};

use super::convert::{self, Conversion, ScaleEstimate};
use super::*;
use crate::geometry::frames::{Body, Camera, Odom, World};
use crate::geometry::random::Random;
use crate::geometry::{Se3, ros_from_optical};
use crate::map::{KeyframeId, KeyframeView, LandmarkId, LandmarkView, MapId};
use crate::messages::State;
use crate::reconstruction::{OrientationEstimate, TrackingState};

fn estimate(world_from_camera: Se3<World, Camera>) -> PoseEstimate {
    PoseEstimate {
        sequence: 7,
        timestamp_ns: 1_000,
        arrival_ns: 2_000,
        state: TrackingState::Tracking,
        world_from_camera: Some(world_from_camera),
        odom_from_camera: Some(world_from_camera.relabel::<Odom, Camera>()),
        anchor: Some(KeyframeId(3)),
        covariance: Matrix6::identity(),
        angular_velocity: Vector3::zeros(),
        linear_velocity: Vector3::zeros(),
        landmarks: 120,
        landmarks_sought: 150,
        quality: 0.8,
        map: MapId(1),
        reset_counter: 2,
        keyframe: true,
        ..PoseEstimate::default()
    }
}

fn rotation(axis: Vector3<f64>, angle_rad: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_scaled_axis(axis * angle_rad)
}

#[track_caller]
fn close<const N: usize>(got: [f64; N], want: [f64; N]) {
    for (g, w) in got.iter().zip(&want) {
        assert!((g - w).abs() < 1e-12, "{got:?} is not {want:?}");
    }
}

#[test]
fn right_down_forward_becomes_forward_left_up() {
    let moved = Se3::new(UnitQuaternion::identity(), Vector3::new(1.0, 2.0, 3.0));
    let pose = convert::pose(&estimate(moved), &Conversion::default());
    close(pose.position, [3.0, -1.0, -2.0]);
    close(pose.orientation, [0.0, 0.0, 0.0, 1.0]);
    close(pose.odom_position, [3.0, -1.0, -2.0]);
    assert_eq!(pose.state(), State::Tracking);
    assert_eq!((pose.sequence, pose.anchor(), pose.landmarks, pose.keyframe), (7, Some(3), 120, 1));
}

#[test]
fn a_turn_to_the_left_is_a_positive_yaw() {
    // About the camera's y axis, which points down, a left turn is negative.
    let turned = Se3::new(rotation(Vector3::y(), -FRAC_PI_2), Vector3::zeros());
    let pose = convert::pose(&estimate(turned), &Conversion::default());
    let half = 0.5f64.sqrt();
    close(pose.orientation, [0.0, 0.0, half, half]);
    // Nose up: about the camera's x axis (right) positive, about the body's y axis (left) negative.
    let raised = Se3::new(rotation(Vector3::x(), FRAC_PI_2), Vector3::zeros());
    close(convert::pose(&estimate(raised), &Conversion::default()).orientation, [0.0, -half, 0.0, half]);
}

#[test]
fn a_robot_that_drives_level_stays_level_though_its_camera_looks_down() {
    let pitch = 0.5;
    // In REP-103 axes a positive turn about y (left) lowers the nose.
    let tilted = rotation(Vector3::y(), pitch) * ros_from_optical();
    let conversion = Conversion { body_from_camera: Se3::new(tilted, Vector3::zeros()), ..Conversion::default() };
    // Level and forward, seen from a camera that looks down: forward and up, and up is -y.
    let forward = Vector3::new(0.0, -pitch.sin(), pitch.cos());
    let pose = convert::pose(&estimate(Se3::new(UnitQuaternion::identity(), 2.0 * forward)), &conversion);
    close(pose.position, [2.0, 0.0, 0.0]);
    close(pose.orientation, [0.0, 0.0, 0.0, 1.0]);
    let view = LandmarkView { id: LandmarkId(9), position_world: 4.0 * forward, sigma: 0.1, observations: 5 };
    let landmark = convert::landmark(&view, &conversion.map_from_optical());
    assert_eq!((landmark.id, landmark.observations), (9, 5));
    close(landmark.position.map(|v| (f64::from(v) * 1e6).round() / 1e6), [4.0, 0.0, 0.0]);
}

#[test]
fn a_robot_that_turns_on_the_spot_stays_there_once_the_scale_is_metric() {
    // Camera 0.2 m ahead of the body's centre; the robot turns left by 90 degrees.
    let mount: Se3<Body, Camera> = Se3::new(ros_from_optical(), Vector3::new(0.2, 0.0, 0.0));
    let metric = Conversion {
        body_from_camera: mount,
        scale: ScaleEstimate::Metric { sigma: 0.01, source: 1 },
        ..Conversion::default()
    };
    let start = convert::pose(&estimate(Se3::identity()), &metric);
    close(start.position, [-0.2, 0.0, 0.0]);
    // The camera went on a quarter circle: 0.2 m back and 0.2 m to the left.
    let turned = Se3::new(rotation(Vector3::y(), -FRAC_PI_2), Vector3::new(-0.2, 0.0, -0.2));
    let mut turning = estimate(turned);
    // At 1 rad/s to the left the camera moves with 0.2 m/s to the left, the body not at all.
    turning.angular_velocity = Vector3::new(0.0, -1.0, 0.0);
    turning.linear_velocity = Vector3::new(-0.2, 0.0, 0.0);
    let end = convert::pose(&turning, &metric);
    close(end.position, [-0.2, 0.0, 0.0]);
    close(end.angular_velocity, [0.0, 0.0, 1.0]);
    close(end.linear_velocity, [0.0, 0.0, 0.0]);
    assert_eq!((end.scale, end.scale_sigma, end.scale_source), (crate::messages::SCALE_METRIC, 0.01, 1));
    // While lengths are arbitrary the same mount moves nothing: 0.2 of what?
    let arbitrary = Conversion { scale: ScaleEstimate::Estimated { sigma: 0.1 }, ..metric };
    close(convert::pose(&estimate(turned), &arbitrary).position, [-0.2, 0.2, 0.0]);
}

#[test]
fn covariance_equals_the_numeric_jacobian_of_the_body_pose() {
    let seed = 20_240_611u64;
    let mut generator = Random::new(seed);
    let mut random = || generator.uniform(-1.0, 1.0);
    for case in 0..20 {
        let mut vector = || Vector3::new(random(), random(), random());
        let camera_from_world: Se3<Camera, World> = Se3::new(rotation(vector(), 3.0), 5.0 * vector());
        let mount: Se3<Body, Camera> = Se3::new(rotation(vector(), 3.0), vector());
        let conversion = Conversion {
            body_from_camera: mount,
            scale: ScaleEstimate::Metric { sigma: 0.0, source: 1 },
            ..Conversion::default()
        };
        let root = Matrix6::from_fn(|_, _| random());
        let covariance = root * root.transpose();

        // The body's pose as published, as a function of the internal perturbation.
        let body = |delta: &Vector6<f64>| {
            let pose = convert::pose(&estimate(camera_from_world.perturb_left(delta).inverse()), &conversion);
            let [x, y, z, w] = pose.orientation;
            let q = UnitQuaternion::new_unchecked(nalgebra::Quaternion::new(w, x, y, z));
            (Vector3::from(pose.position), q)
        };
        let (p, q) = body(&Vector6::zeros());
        let tangent = |delta: &Vector6<f64>| {
            let (p2, q2) = body(delta);
            let (dp, dr) = (q.inverse() * (p2 - p), (q.inverse() * q2).scaled_axis());
            Vector6::new(dp.x, dp.y, dp.z, dr.x, dr.y, dr.z)
        };
        let h = 1e-6;
        let mut j = Matrix6::zeros();
        for i in 0..6 {
            let step = Vector6::ith(i, h);
            j.set_column(i, &((tangent(&step) - tangent(&-step)) / (2.0 * h)));
        }
        let want = j * covariance * j.transpose();
        let got = convert::body_covariance(&covariance, &conversion);
        assert!((got - want).norm() < 1e-6 * want.norm(), "seed {seed}, case {case}: {got} is not {want}");

        let mut sent = estimate(camera_from_world.inverse());
        sent.covariance = covariance;
        let unpacked = convert::pose(&sent, &conversion).covariance_matrix();
        let unpacked = Matrix6::from_fn(|i, k| unpacked[i][k]);
        assert!((unpacked - got).norm() < 1e-12 * got.norm(), "seed {seed}, case {case}");
    }
}

#[test]
fn what_is_not_tracked_has_no_pose_on_the_wire() {
    let mut lost = estimate(Se3::identity());
    lost.state = TrackingState::Lost;
    let pose = convert::pose(&lost, &Conversion::default());
    assert_eq!(pose.state(), State::Lost);
    assert!(pose.position.iter().chain(&pose.odom_orientation).chain(&pose.covariance).all(|v| v.is_nan()));
    assert_eq!((pose.quality, pose.landmarks, pose.anchor(), pose.keyframe), (0.0, 0, None, 0));
}

fn turned(first_from_camera: UnitQuaternion<f64>, covariance: Matrix3<f64>) -> PoseEstimate {
    let orientation = OrientationEstimate {
        first_from_camera,
        covariance,
        angular_velocity: Vector3::new(0.0, -0.5, 0.0), // about "down", to the left
    };
    PoseEstimate {
        state: TrackingState::Orientation,
        world_from_camera: None,
        odom_from_camera: None,
        orientation: Some(orientation),
        ..estimate(Se3::identity())
    }
}

#[test]
fn an_orientation_alone_is_sent_with_its_covariance_and_without_a_position() {
    let covariance = Matrix3::from_diagonal(&Vector3::new(1.0, 4.0, 9.0)); // about right, down, forward
    // A turn to the left is one about "down", backwards.
    let sent = turned(rotation(Vector3::y(), -0.5), covariance);
    let placed =
        Conversion { map_from_world: Some(Se3::new(rotation(Vector3::z(), 1.0), Vector3::x())), ..Default::default() };
    for conversion in [Conversion::default(), placed] {
        let pose = convert::pose(&sent, &conversion);
        assert_eq!(pose.state(), State::Orientation);
        assert!(!pose.is_tracking() && pose.has_orientation() && pose.map_from_body().is_none());
        assert!(pose.position.iter().chain(&pose.odom_position).chain(&pose.linear_velocity).all(|v| v.is_nan()));
        assert!((pose.heading_rad().expect("heading") - 0.5).abs() < 1e-12);
        assert_eq!(pose.orientation, pose.odom_orientation);
        close(pose.angular_velocity, [0.0, 0.0, 0.5]);
        let full = pose.covariance_matrix();
        for (i, row) in full.iter().enumerate() {
            for (j, entry) in row.iter().enumerate() {
                assert_eq!(entry.is_finite(), i >= 3 && j >= 3, "{i}, {j}");
            }
        }
        close([full[3][3], full[4][4], full[5][5]], [9.0, 1.0, 4.0]);
        assert_eq!((pose.quality, pose.landmarks, pose.anchor(), pose.keyframe), (0.0, 0, None, 0));
    }
    // Seen from the side: the camera looks to the body's left, so its "forward" is the body's y.
    let left = Se3::new(rotation(Vector3::z(), FRAC_PI_2) * ros_from_optical(), Vector3::zeros());
    let pose = convert::pose(&sent, &Conversion { body_from_camera: left, ..Default::default() });
    assert!((pose.heading_rad().expect("heading") - 0.5).abs() < 1e-12, "the same turn of the body");
    let full = pose.covariance_matrix();
    close([full[3][3], full[4][4], full[5][5]], [1.0, 9.0, 4.0]);
}

#[test]
fn an_orientation_that_is_not_finite_is_not_sent() {
    for broken in [
        turned(UnitQuaternion::identity(), Matrix3::repeat(f64::NAN)),
        PoseEstimate { orientation: None, ..turned(UnitQuaternion::identity(), Matrix3::zeros()) },
    ] {
        let pose = convert::pose(&broken, &Conversion::default());
        assert_eq!((pose.state(), pose.heading_rad()), (State::Initializing, None));
        assert!(pose.orientation.iter().chain(&pose.covariance).all(|v| v.is_nan()));
    }
}

#[test]
fn a_claim_to_track_without_a_finite_pose_is_sent_as_lost() {
    let nowhere = Se3::new(UnitQuaternion::identity(), Vector3::new(f64::NAN, 0.0, 0.0));
    for broken in [None, Some(nowhere)] {
        let mut claim = estimate(Se3::identity());
        claim.world_from_camera = broken;
        let pose = convert::pose(&claim, &Conversion::default());
        assert_eq!((pose.state(), pose.quality), (State::Lost, 0.0));
        assert!(pose.position.iter().all(|v| v.is_nan()));
    }
}

#[test]
fn an_unknown_turn_rate_leaves_the_velocity_known() {
    let mut moving = estimate(Se3::identity());
    moving.angular_velocity = Vector3::repeat(f64::NAN);
    moving.linear_velocity = Vector3::new(0.0, 0.0, 1.5);
    let pose = convert::pose(&moving, &Conversion::default());
    close(pose.linear_velocity, [1.5, 0.0, 0.0]);
    assert!(pose.angular_velocity.iter().all(|v| v.is_nan()));
}

#[test]
fn a_keyframe_is_the_pose_of_the_body() {
    let at = Se3::new(rotation(Vector3::y(), -FRAC_PI_2), Vector3::new(1.0, 2.0, 3.0));
    let view = KeyframeView { id: KeyframeId(4), timestamp_ns: 5, world_from_camera: at };
    let keyframe = convert::keyframe(&view, &Conversion::default());
    let pose = convert::pose(&estimate(at), &Conversion::default());
    assert_eq!((keyframe.id, keyframe.timestamp_ns), (4, 5));
    assert_eq!((keyframe.position, keyframe.orientation), (pose.position, pose.orientation));
}

/// A quaternion (x, y, z, w) and its negative are the same rotation.
fn near(got: [f64; 4], want: [f64; 4]) -> bool {
    let dot: f64 = got.iter().zip(&want).map(|(a, b)| a * b).sum();
    (dot.abs() - 1.0).abs() < 1e-12
}

#[test]
fn a_planner_that_says_where_the_robot_is_moves_pose_landmarks_and_keyframes_alike() {
    let at = Se3::new(rotation(Vector3::y(), -0.4), Vector3::new(1.0, 2.0, 3.0));
    let mut conversion = Conversion::default();
    let was = convert::pose(&estimate(at), &conversion);
    let (position, orientation) = ([10.0, 20.0, 0.5], [0.0, 0.0, 0.6, 0.8]);
    for _ in 0..2 {
        // The second time from where the first one has put it.
        let published = convert::pose(&estimate(at), &conversion);
        let from = convert::from_wire(&published.position, &published.orientation).expect("tracked");
        let to = convert::from_wire(&position, &orientation).expect("a pose");
        conversion.map_from_world = Some(convert::place(&to, &from, conversion.map_from_world));
        let pose = convert::pose(&estimate(at), &conversion);
        close(pose.position.map(|v| (v * 1e9).round() * 1e-9), position);
        assert!(near(pose.orientation, orientation), "{:?}", pose.orientation);
        assert_eq!((pose.odom_position, pose.odom_orientation), (was.odom_position, was.odom_orientation));
        assert_eq!(pose.covariance, was.covariance, "in the body's axes");
        let keyframe = KeyframeView { id: KeyframeId(4), timestamp_ns: 5, world_from_camera: at };
        assert_eq!(convert::keyframe(&keyframe, &conversion).position, pose.position);
        // A landmark one unit ahead of the camera is one unit ahead of the body.
        let view = LandmarkView {
            id: LandmarkId(9),
            position_world: at.transform(&Vector3::new(0.0, 0.0, 1.0)),
            sigma: 0.1,
            observations: 5,
        };
        let landmark = convert::landmark(&view, &conversion.map_from_optical());
        let ahead = [10.0 + 0.28, 20.0 + 0.96, 0.5]; // cos and sin of twice atan2(0.6, 0.8)
        for (got, want) in landmark.position.iter().zip(ahead) {
            assert!((f64::from(*got) - want).abs() < 1e-5, "{landmark:?}");
        }
    }
}

#[test]
fn a_place_that_is_none_is_refused() {
    assert!(convert::from_wire(&[0.0; 3], &[0.0, 0.0, 0.0, 1.0]).is_some());
    for bad in [[0.0; 4], [0.0, 0.0, 0.0, 2.0], [f64::NAN, 0.0, 0.0, 1.0], [f64::INFINITY, 0.0, 0.0, 0.0]] {
        assert!(convert::from_wire(&[0.0; 3], &bad).is_none(), "{bad:?}");
    }
    assert!(convert::from_wire(&[0.0, f64::NAN, 0.0], &[0.0, 0.0, 0.0, 1.0]).is_none());
}

#[test]
fn of_too_many_the_newest_are_sent() {
    assert_eq!(newest(&[1, 2, 3, 4], 3), [2, 3, 4]);
    assert_eq!(newest(&[1, 2], 3), [1, 2]);
    assert_eq!(newest::<u8>(&[], 3), [0u8; 0]);
}
