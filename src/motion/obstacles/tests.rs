use nalgebra::Unit;

use super::*;
use crate::motion::floor::plane::Scatter;
use crate::motion::floor::seen::Stretch;

/// A floor at z = 0, metres; the robot at the origin looks along x.
fn floor() -> Plane {
    Plane {
        normal: Vector3::z(),
        offset: 0.0,
        height: 0.5,
        sigma: 0.01,
        up_camera: Unit::new_normalize(-Vector3::y()),
        landmarks: 100,
        scatter: Scatter::default(),
    }
}

fn begun() -> Scanner {
    let mut scanner = Scanner::default();
    assert!(scanner.begin(&floor(), &Se3::new(nalgebra::UnitQuaternion::identity(), Vector3::new(0.0, 0.0, 0.2))));
    scanner
}

fn point(x: f64, y: f64, z: f64) -> Point {
    Point { position: Vector3::new(x, y, z), covariance: Matrix3::identity() * 1e-4 }
}

/// Forward.
const AHEAD: usize = BEARINGS / 2;

fn axes() -> Footing {
    Footing { foot: Vector3::zeros(), forward: Vector3::x(), left: Vector3::y() }
}

/// Straight ahead, in heights of 0.5 m.
fn stretch(from_m: f64, to_m: f64) -> Stretch {
    Stretch { bearing: 0.0, from: (2.0 * from_m) as f32, to: (2.0 * to_m) as f32 }
}

fn line(from_m: f64, to_m: f64) -> Seen {
    Seen { floor: vec![stretch(from_m, to_m)], ..Seen::default() }
}

#[test]
fn unknown_is_never_free_and_never_far() {
    let mut scanner = begun();
    let scan = scanner.finish(0.12);
    assert!(scan.range_m.iter().chain(&scan.sigma_m).all(|v| v.is_nan()));
    assert!(scan.free_m.iter().all(|v| *v == 0.0));
}

#[test]
fn free_is_where_a_keyframe_saw_the_floor_without_a_gap() {
    let seen = |pieces: &[[f64; 2]]| {
        let mut scanner = begun();
        for [from, to] in pieces {
            (0..2).for_each(|_| scanner.add_seen(&axes(), 0.5, &line(*from, *to), 0.5));
        }
        let scan = scanner.finish(0.12);
        assert!(scan.free_m.iter().zip(&scan.free_from_m).all(|(to, from)| (*to == 0.0) == from.is_nan()));
        (scan.free_m[AHEAD], scan.free_m[AHEAD + 20])
    };
    let (ahead, aside) = seen(&[[0.2, 2.0]]);
    assert!((1.85..=2.0).contains(&ahead) && aside == 0.0, "{ahead} {aside}");
    assert_eq!(seen(&[[1.8, 3.0]]).0, 0.0, "too far from the robot");
    let gap = seen(&[[0.2, 1.0], [1.2, 1.9]]).0;
    assert!((0.85..=1.0).contains(&gap), "{gap}: not beyond a gap");
    let longer = seen(&[[0.2, 0.8], [1.2, 2.0]]);
    assert!((1.85..=2.0).contains(&longer.0), "{longer:?}: the longest");
    let overlap = seen(&[[0.2, 1.0], [0.9, 2.0]]).0;
    assert!(overlap > 1.8, "{overlap}");
}

#[test]
fn what_stands_in_between_ends_what_is_free() {
    let mut scanner = begun();
    (0..3).for_each(|_| scanner.add_seen(&axes(), 0.5, &line(0.2, 3.0), 0.5));
    scanner.add_landmark(&floor(), &point(1.5, 0.0, 0.3), 0.5);
    let scan = scanner.finish(0.12);
    assert!((scan.range_m[AHEAD] - 1.5).abs() < 1e-6 && (scan.sigma_m[AHEAD] - 0.01).abs() < 1e-6);
    assert!((1.2..1.45).contains(&scan.free_m[AHEAD]), "{}", scan.free_m[AHEAD]);
    assert_eq!((scan.total, scan.points.len()), (1, 1));
    let [x, y, z] = scan.points[0].position;
    assert!((x - 1.5).abs() < 1e-6 && y.abs() < 1e-6 && (z - 0.3).abs() < 1e-6);
}

#[test]
fn where_keyframes_saw_the_floor_end_nothing_is_free() {
    let mut scanner = begun();
    for _ in 0..3 {
        scanner.add_seen(&axes(), 0.5, &Seen { ends: vec![stretch(1.3, 1.5)], ..line(0.2, 1.3) }, 0.5);
    }
    // One that looked past it from elsewhere, later.
    scanner.add_seen(&axes(), 0.5, &line(0.2, 3.0), 0.5);
    let free = scanner.finish(0.12).free_m[AHEAD];
    assert!((1.15..=1.32).contains(&free), "{free}");
}

#[test]
fn what_two_keyframes_saw_stand_is_in_the_way_of_a_robot_that_is_as_high() {
    // Heights of 0.5 m.
    let range = |times: usize, lowest: f32, free: usize| {
        let mut scanner = begun();
        for i in 0..times {
            let thing = stretch(1.5 + 0.02 * i as f64, 1.54 + 0.02 * i as f64);
            scanner.add_seen(
                &axes(),
                0.5,
                &Seen { things: vec![(thing, [lowest, lowest + 0.1])], ..Seen::default() },
                0.3,
            );
        }
        (0..free).for_each(|_| scanner.add_seen(&axes(), 0.5, &line(0.2, 3.0), 0.3));
        scanner.finish(0.12).range_m[AHEAD]
    };
    let found = range(2, 0.2, 0);
    assert!((1.5..1.56).contains(&found), "{found}");
    assert!(range(1, 0.2, 0).is_nan(), "one keyframe is not enough");
    assert!(range(2, 0.7, 0).is_nan(), "it begins above the robot");
    assert!(range(2, 0.0, 0).is_nan(), "it is driven over");
    assert!(!range(2, 0.2, 2).is_nan(), "as many saw the floor there since");
    assert!(range(2, 0.2, 3).is_nan(), "more saw the floor there since");
}

/// Ahead, of a robot of this height.
fn free_ahead(robot_height_m: f64, told: &[&Seen]) -> f32 {
    let mut scanner = begun();
    told.iter().for_each(|seen| scanner.add_seen(&axes(), 0.5, seen, robot_height_m));
    scanner.finish(0.12).free_m[AHEAD]
}

fn ended(at_m: f64) -> Seen {
    Seen { ends: vec![stretch(at_m, at_m + 0.1)], ..Seen::default() }
}

fn standing(at_m: f64) -> Seen {
    Seen { things: vec![(stretch(at_m, at_m + 0.04), [0.2, 0.5])], ..Seen::default() }
}

#[test]
fn one_keyframe_proves_nothing_and_a_tie_is_not_free() {
    let (free, end) = (line(0.2, 2.0), ended(1.0));
    assert_eq!(free_ahead(0.5, &[&free]), 0.0);
    assert!(free_ahead(0.5, &[&free, &free]) > 1.8);
    let tie = free_ahead(0.5, &[&end, &end, &free, &free]);
    assert!(tie < 1.05, "{tie}: as many saw it end");
    assert!(free_ahead(0.5, &[&end, &end, &free, &free, &free]) > 1.8, "more saw it free since");
    assert!(free_ahead(0.5, &[&end, &free]) < 1.05);
}

#[test]
fn what_is_put_down_later_is_not_free_however_often_the_floor_was_seen_there() {
    let free = line(0.2, 2.0);
    for bag in [ended(1.0), standing(1.0)] {
        let mut told = vec![&free; 20];
        told.push(&bag);
        let before = free_ahead(0.5, &told);
        assert!((0.8..1.05).contains(&before), "{before}");
        // One that saw the floor there since may be wrong.
        told.push(&free);
        let one = free_ahead(0.5, &told);
        assert!((0.8..1.05).contains(&one), "{one}");
        told.push(&free);
        assert!(free_ahead(0.5, &told) > 1.8, "it was taken away");
    }
}

#[test]
fn what_was_driven_long_ago_is_taken_back_too() {
    let drive = |scanner: &mut Scanner| scanner.add_driven(&Vector3::zeros(), &Vector3::new(2.0, 0.0, 0.0), 0.12);
    for bag in [ended(1.0), standing(1.0)] {
        let free = |before: usize, after: usize| {
            let mut scanner = begun();
            (0..before).for_each(|_| drive(&mut scanner));
            scanner.add_seen(&axes(), 0.5, &bag, 0.5);
            (0..after).for_each(|_| drive(&mut scanner));
            scanner.finish(0.12).free_m[AHEAD]
        };
        let before = free(3, 0);
        assert!((0.8..1.05).contains(&before), "{before}");
        assert!(free(0, 1) > 1.8, "the robot has been there since");
    }
}

#[test]
fn a_robot_higher_than_the_camera_has_no_free_floor_by_what_was_seen() {
    let free = line(0.2, 2.0);
    assert!(free_ahead(0.5, &[&free; 3]) > 1.8);
    assert_eq!(free_ahead(0.6, &[&free; 3]), 0.0);
}

#[test]
fn the_floor_a_lamp_and_what_is_not_known_are_not_in_the_way() {
    let mut scanner = begun();
    for z in [0.0, 0.03, 0.6, 2.0] {
        scanner.add_landmark(&floor(), &point(1.5, 0.0, z), 0.5);
    }
    let unsure = Point { covariance: Matrix3::identity(), ..point(1.5, 0.0, 0.3) };
    scanner.add_landmark(&floor(), &unsure, 0.5);
    scanner.add_landmark(&floor(), &point(f64::NAN, 0.0, 0.3), 0.5);
    let scan = scanner.finish(0.12);
    assert!(scan.range_m.iter().all(|v| v.is_nan()) && scan.total == 0);
}

#[test]
fn things_are_more_than_their_corners() {
    let mut scanner = begun();
    // Two corners of a box, 30 cm apart; and another box far to the left.
    for y in [-0.15, 0.15, 2.0] {
        scanner.add_landmark(&floor(), &point(2.0, y, 0.3), 0.5);
    }
    let scan = scanner.finish(0.12);
    assert!((scan.range_m[AHEAD] - 2.0).abs() < 0.02, "{}", scan.range_m[AHEAD]);
    assert!(scan.range_m[AHEAD + 10].is_nan(), "nothing joins two things");
}

#[test]
fn where_the_robot_was_the_floor_was_free() {
    let mut scanner = begun();
    scanner.add_driven(&Vector3::new(-2.0, 0.0, 0.2), &Vector3::new(0.0, 0.0, 0.2), 0.12);
    let scan = scanner.finish(0.12);
    assert!((1.9..2.1).contains(&scan.free_m[0]) && scan.free_m[AHEAD] == 0.0, "{} behind", scan.free_m[0]);
}

#[test]
fn between_two_tracks_of_the_robot_nothing_is_known() {
    let mut scanner = begun();
    // Two ways across, with 15 cm between them (0.62 to 0.77 m): room for a pole that the robot drove around.
    for x in [0.5, 0.89] {
        scanner.add_driven(&Vector3::new(x, -1.0, 0.2), &Vector3::new(x, 1.0, 0.2), 0.12);
    }
    let scan = scanner.finish(0.12);
    let (from, to) = (scan.free_from_m[AHEAD], scan.free_m[AHEAD]);
    assert!(to > from && (to < 0.65 || from > 0.74), "{from} to {to}: one of both");
}

#[test]
fn what_touches_the_robot_is_told_within_the_range_of_the_message() {
    let mut scanner = begun();
    scanner.add_landmark(&floor(), &point(0.09, 0.0, 0.3), 0.5);
    let range = f64::from(scanner.finish(0.12).range_m[AHEAD]);
    assert!((range - 0.09).abs() < 1e-6 && range > RANGE_MIN_M, "{range}");
}

#[test]
fn of_many_points_the_nearest_are_told() {
    let mut scanner = begun();
    for i in (0..2 * MOST_POINTS).rev() {
        scanner.add_landmark(&floor(), &point(0.5 + 0.002 * i as f64, 0.0, 0.3), 0.5);
    }
    let scan = scanner.finish(0.12);
    assert_eq!((scan.points.len(), scan.total), (MOST_POINTS, 2 * MOST_POINTS));
    assert!((scan.points[0].position[0] - 0.5).abs() < 1e-6);
    assert!(scan.points.windows(2).all(|w| w[0].position[0] <= w[1].position[0]));
}

#[test]
fn impossible_robots_are_refused() {
    assert!(ObstaclesConfig::default().validate().is_ok());
    for (robot_height_m, robot_radius_m) in [(0.01, 0.1), (f64::NAN, 0.1), (0.3, 0.0), (0.3, f64::NAN), (9.0, 0.1)] {
        assert!(ObstaclesConfig { robot_height_m, robot_radius_m, ..ObstaclesConfig::default() }.validate().is_err());
    }
}
