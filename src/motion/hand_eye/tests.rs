use nalgebra::Vector2;

use super::super::synthetic::{Drive, drive};
use super::*;
use crate::geometry::random::Random;
use crate::motion::planar::Planar;

/// Segments of a drive, weighed.
fn weighed(drive: &Drive) -> Vec<Segment> {
    let mut segments = drive.segments.clone();
    let robot = Robot::unknown();
    segments.iter_mut().for_each(|s| assert!(s.weigh(&drive.history, &robot)));
    segments
}

#[test]
fn jacobian_of_turn_and_step_agrees_with_numeric_differences() {
    let case = drive(3, |d| d.seconds = 12.0);
    let mut segments = weighed(&case);
    segments.iter_mut().take(4).for_each(|s| s.unit = Unit(7));
    let mut random = Random::new(8);
    let mut robot = case.truth;
    robot.base_from_camera = UnitQuaternion::from_scaled_axis(Vector3::new(0.1, -0.2, 0.3)) * robot.base_from_camera;
    (robot.lever_m, robot.yaw_factor, robot.time_offset_s) = (Vector2::new(0.2, -0.1), 1.03, 0.004);
    let state = State {
        log_scale: std::array::from_fn(|_| 0.5 * random.normal()),
        log_ratio: std::array::from_fn(|_| 0.5 * random.normal()),
        robot,
    };
    let prior = Robot::unknown();
    let problem = problem(&segments, &prior, &state, [1.0; 2], Loss::Squared, |_| true);
    for term in problem.terms.iter().step_by(3) {
        let jacobian = term.jacobian(&state);
        for column in 0..UNKNOWNS {
            let h = 1e-6;
            let at = |sign: f64| {
                let mut delta = SVector::<f64, UNKNOWNS>::zeros();
                delta[column] = sign * h;
                term.residual(&problem.step(&state, &delta))
            };
            let (after, before) = (at(1.0), at(-1.0));
            for ((after, before), jacobian) in after.iter().zip(&before).zip(&jacobian) {
                let numeric = (after - before) / (2.0 * h);
                let off = (numeric - jacobian.column(column)).norm();
                assert!(off < 1e-4 * (1.0 + numeric.norm()), "unknown {column}: {off} beside {numeric}");
            }
        }
    }
}

#[test]
fn everything_that_the_motion_tells_is_found() {
    // Without noise, every unknown to a thousandth.
    let case = drive(4, |d| (d.noise, d.seconds, d.drift) = (0.0, 40.0, 0.0));
    let mut segments = weighed(&case);
    let found = solve(&mut segments, &case.history, &Robot::unknown(), &Robot::unknown()).expect("a solution");
    assert!((found.log_scale - case.log_scale).abs() < 2e-3, "{found:?}");
    let off = found.robot.base_from_camera.angle_to(&case.truth.base_from_camera);
    assert!(off < 2e-3, "mount off by {off} rad");
    assert!((found.robot.lever_m - case.truth.lever_m).norm() < 2e-3, "{:?}", found.robot.lever_m);
    assert!((found.robot.yaw_factor - case.truth.yaw_factor).abs() < 2e-3, "{}", found.robot.yaw_factor);
    assert!((found.robot.time_offset_s - case.truth.time_offset_s).abs() < 2e-3, "{}", found.robot.time_offset_s);
}

#[test]
fn what_the_motion_does_not_tell_stays_unknown_and_says_so() {
    let case = drive(5, |d| d.turning = 0.0);
    let mut segments = weighed(&case);
    let found = solve(&mut segments, &case.history, &Robot::unknown(), &Robot::unknown()).expect("a solution");
    assert!((found.log_scale - case.log_scale).abs() < 0.02, "{found:?}");
    let sigma = found.robot.sigma;
    // Straight on: yaw and pitch are told, roll and the lever are not.
    assert!(sigma[1] < 0.02 && sigma[2] < 0.02, "{sigma:?}");
    assert!(sigma[0] > 0.05 && sigma[3] > 0.5 && sigma[4] > 0.5, "{sigma:?}");
}

#[test]
fn a_camera_that_looks_backwards_or_up_is_found() {
    for (seed, turn) in [Vector3::new(0.0, 0.0, 3.1), Vector3::new(0.0, -1.2, 0.0), Vector3::new(0.0, 0.1, -1.5)]
        .into_iter()
        .enumerate()
    {
        let case = drive(20 + seed as u64, |d| d.mount = turn);
        let mut segments = weighed(&case);
        let found = solve(&mut segments, &case.history, &Robot::unknown(), &Robot::unknown()).expect("a solution");
        let off = found.robot.base_from_camera.angle_to(&case.truth.base_from_camera).to_degrees();
        assert!(off < 1.0, "mount {turn:?} is off by {off} degrees");
        assert!((found.log_scale - case.log_scale).abs() < 0.03);
    }
}

#[test]
fn the_lever_moves_the_camera_of_a_base_that_turns_on_the_spot() {
    let robot = Robot { lever_m: Vector2::new(0.3, 0.0), ..Robot::unknown() };
    let on_the_spot = Planar { translation: Vector2::zeros(), yaw: std::f64::consts::FRAC_PI_2 };
    let step = robot.step_of(&on_the_spot);
    assert!((step - Vector3::new(-0.3, 0.3, 0.0)).norm() < 1e-12, "{step}");
}

#[test]
fn bursts_are_a_rival_as_far_as_they_tell_one_scale() {
    let case = drive(12, |d| (d.noise, d.seconds, d.drift) = (0.0, 20.0, 0.0));
    let believed = |shares: &[f64]| {
        let mut segments = case.segments.clone();
        for (i, s) in segments.iter_mut().enumerate() {
            assert!(s.weigh(&case.history, &case.truth));
            if (8..20).contains(&i) {
                s.slips = true;
                s.step *= shares[i % shares.len()];
            }
        }
        let length = |s: &Segment| (s.to_ns - s.from_ns) as f64 * 1e-9;
        let [slipped, all]: [f64; 2] = [&segments[8..20], &segments[..]].map(|s| s.iter().map(length).sum());
        let belief = Belief::of(&segments, Unit::default(), &case.truth).expect("motion");
        assert!((belief.seconds - (all - slipped)).abs() < 1e-9, "{belief:?}");
        assert!(Belief::of(&segments, Unit(9), &case.truth).is_none(), "nothing has moved there");
        belief.rival_s / slipped
    };
    assert!((believed(&[0.6]) - 1.0).abs() < 1e-9, "all alike");
    let of_four = believed(&[0.45, 0.55, 0.65, 0.75]);
    assert!((0.2..0.3).contains(&of_four), "each a quarter: {of_four}");
}
