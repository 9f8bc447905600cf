use std::f32::consts::{FRAC_PI_2, FRAC_PI_4};

use super::super::susan::SusanResponse;
use super::*;

fn of(grey: impl Fn(i32, i32) -> u8) -> Attributes {
    let mut image = GreyImage::new(15, 15);
    for y in 0..15 {
        for x in 0..15 {
            image.data[y * 15 + x] = grey(x as i32 - 7, y as i32 - 7);
        }
    }
    let corner = Corner { x: 7.2, y: 6.8, response: 0.0 };
    attributes(&image, &corner, &Similarity::new(SusanResponse::Exponential, 25)).expect("inside")
}

fn assert_towards(direction: Direction, angle: f32) {
    let off = direction.difference_rad(&Direction::Towards(angle));
    assert!(off.is_some_and(|off| off < 0.02), "{direction:?} should be towards {angle}");
}

fn assert_axis(direction: Direction, angle: f32) {
    let off = direction.difference_rad(&Direction::Axis(angle));
    assert!(off.is_some_and(|off| off < 0.02), "{direction:?} should be along {angle}");
}

#[test]
fn an_asymmetric_usan_points_to_its_centre_of_gravity() {
    let corner = of(|x, y| if x >= 0 && y >= 0 { 180 } else { 60 });
    assert_eq!((corner.grey, corner.salient_degree), (180, 13.0 / 37.0));
    assert_towards(corner.direction, FRAC_PI_4);
    assert_towards(of(|x, y| if x <= 0 && y <= 0 { 180 } else { 60 }).direction, -3.0 * FRAC_PI_4);
    assert_towards(of(|x, y| if y <= -x.abs() { 180 } else { 60 }).direction, -FRAC_PI_2);
    assert_towards(of(|x, _| if x <= 0 { 30 } else { 90 }).direction, PI);
}

#[test]
fn a_symmetric_usan_has_an_axis_from_its_second_moments() {
    assert_axis(of(|_, y| if y == 0 { 180 } else { 60 }).direction, 0.0);
    assert_axis(of(|x, _| if x == 0 { 180 } else { 60 }).direction, FRAC_PI_2);
    assert_axis(of(|x, y| if x == y { 180 } else { 60 }).direction, FRAC_PI_4);
    assert_axis(of(|x, y| if x == -y { 180 } else { 60 }).direction, 3.0 * FRAC_PI_4);
}

#[test]
fn a_speck_and_an_even_picture_have_no_direction() {
    let speck = of(|x, y| if (x, y) == (0, 0) { 180 } else { 60 });
    assert_eq!((speck.salient_degree, speck.direction), (1.0 / 37.0, Direction::Undefined));
    assert_eq!(of(|_, _| 60).direction, Direction::Undefined);
}

#[test]
fn angles_wrap_at_a_turn_axes_at_half_a_turn_and_kinds_do_not_mix() {
    let close = |a: Option<f32>, b: f32| assert!(a.is_some_and(|a| (a - b).abs() < 1e-5), "{a:?} should be {b}");
    close(Direction::Towards(3.1).difference_rad(&Direction::Towards(-3.1)), TAU - 6.2);
    close(Direction::Towards(0.5).difference_rad(&Direction::Towards(0.5 - PI)), PI);
    close(Direction::Axis(0.05).difference_rad(&Direction::Axis(PI - 0.05)), 0.1);
    close(Direction::Axis(0.0).difference_rad(&Direction::Axis(FRAC_PI_2)), FRAC_PI_2);
    assert_eq!(Direction::Axis(1.0).difference_rad(&Direction::Towards(1.0)), None);
    assert_eq!(Direction::Undefined.difference_rad(&Direction::Axis(0.0)), None);
    assert_eq!(Direction::Undefined.difference_rad(&Direction::Undefined), Some(0.0));
}

#[test]
fn corners_outside_the_picture_have_no_attributes() {
    let image = GreyImage::new(15, 15);
    let similarity = Similarity::new(SusanResponse::Step, 20);
    for (x, y) in [(2.0, 7.0), (7.0, 12.0), (-4.0, 7.0), (f32::NAN, 7.0), (7.0, f32::INFINITY), (1e30, 1e30)] {
        assert_eq!(attributes(&image, &Corner { x, y, response: 0.0 }, &similarity), None, "{x} {y}");
    }
}
