use std::f32::consts::PI;

use super::*;
use crate::features::attributes::Direction;
use proptest::prelude::*;

fn corner(grey: u8, salient_degree: f32, direction: Direction) -> Attributes {
    Attributes { grey, salient_degree, direction }
}

fn pairs(first: &[Attributes], second: &[Attributes], rule: &AttributeMatching) -> Vec<(u32, u32)> {
    let mut out = Vec::new();
    match_attributes(first, second, rule, &mut out);
    out.iter().map(|m| (m.first, m.second)).collect()
}

const RULE: AttributeMatching =
    AttributeMatching { max_grey: 10.0, max_salient_degree: 0.1, max_direction_rad: 0.3, max_ratio: 0.8 };

#[test]
fn each_attribute_has_a_threshold_of_its_own() {
    let a = corner(100, 0.3, Direction::Towards(0.0));
    let matches = |b| !pairs(&[a], &[b], &RULE).is_empty();
    assert!(matches(corner(110, 0.3, Direction::Towards(0.0))) && !matches(corner(111, 0.3, Direction::Towards(0.0))));
    assert!(matches(corner(90, 0.3, Direction::Towards(0.0))) && !matches(corner(89, 0.3, Direction::Towards(0.0))));
    assert!(
        matches(corner(100, 0.39, Direction::Towards(0.0))) && !matches(corner(100, 0.41, Direction::Towards(0.0)))
    );
    assert!(
        matches(corner(100, 0.3, Direction::Towards(-0.29))) && !matches(corner(100, 0.3, Direction::Towards(0.31)))
    );
}

#[test]
fn angles_go_round_the_circle_and_axes_round_half_of_it_and_kinds_never_mix() {
    let matches = |a, b| !pairs(&[corner(9, 0.2, a), corner(200, 0.2, a)], &[corner(9, 0.2, b)], &RULE).is_empty();
    assert!(matches(Direction::Towards(PI - 0.1), Direction::Towards(0.1 - PI)));
    assert!(!matches(Direction::Towards(0.1), Direction::Towards(0.1 - PI)));
    assert!(matches(Direction::Axis(0.1), Direction::Axis(PI - 0.1)));
    assert!(!matches(Direction::Axis(0.1), Direction::Axis(0.5 * PI)));
    assert!(matches(Direction::Undefined, Direction::Undefined));
    for (a, b) in [
        (Direction::Axis(0.5), Direction::Towards(0.5)),
        (Direction::Undefined, Direction::Towards(0.0)),
        (Direction::Undefined, Direction::Axis(0.0)),
    ] {
        assert!(!matches(a, b) && !matches(b, a));
    }
}

#[test]
fn what_is_not_mutual_or_not_clear_is_left_out() {
    let at = |grey| corner(grey, 0.3, Direction::Towards(1.0));
    // Two of the first want the same of the second: the nearer gets it, when that is clear.
    assert_eq!(pairs(&[at(105), at(101)], &[at(100)], &RULE), [(1, 0)]);
    assert_eq!(pairs(&[at(105), at(104)], &[at(100)], &RULE), []);
    assert_eq!(pairs(&[at(105), at(104)], &[at(100)], &AttributeMatching { max_ratio: 1.0, ..RULE }), [(1, 0)]);
    // Doubles in the second picture: none, though both are without any difference.
    assert_eq!(pairs(&[at(100)], &[at(100), at(100)], &RULE), []);
    assert_eq!(pairs(&[], &[at(1)], &RULE), []);
    assert_eq!(pairs(&[at(1)], &[], &RULE), []);
    // Thresholds of 0 leave only what is the same.
    let none = AttributeMatching { max_grey: 0.0, max_salient_degree: 0.0, max_direction_rad: 0.0, max_ratio: 1.0 };
    assert_eq!(pairs(&[at(100), at(90)], &[at(90), at(80)], &none), [(1, 0)]);
    let nan = corner(100, f32::NAN, Direction::Towards(f32::NAN));
    assert_eq!(pairs(&[nan], &[nan], &RULE), []);
}

fn any_corner() -> impl Strategy<Value = Attributes> {
    let direction = prop_oneof![
        (-PI..PI).prop_map(Direction::Towards),
        (0.0..PI).prop_map(Direction::Axis),
        Just(Direction::Undefined)
    ];
    (0u8..40, 0.0f32..0.3, direction).prop_map(|(grey, sd, direction)| corner(grey, sd, direction))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, ..ProptestConfig::default() })]

    #[test]
    fn pairs_are_the_definition_and_the_same_from_the_other_side(
        first in prop::collection::vec(any_corner(), 0..12), second in prop::collection::vec(any_corner(), 0..12),
        max_ratio in 0.2f32..1.0,
    ) {
        let rule = AttributeMatching { max_ratio, max_direction_rad: 1.0, ..RULE };
        let clear = |a: &Attributes, from: &[Attributes], i: usize| {
            let d = rule.distance(a, &from[i]);
            let mut others = from.iter().enumerate().filter(|(j, _)| *j != i).filter_map(|(_, b)| rule.distance(a, b));
            others.all(|other| d.is_some_and(|d| d < max_ratio * other))
        };
        let mut plain = Vec::new();
        for (i, a) in first.iter().enumerate() {
            for (j, b) in second.iter().enumerate() {
                if rule.distance(a, b).is_some() && clear(a, &second, j) && clear(b, &first, i) {
                    plain.push((i as u32, j as u32));
                }
            }
        }
        prop_assert_eq!(&pairs(&first, &second, &rule), &plain);
        let mut back: Vec<_> = pairs(&second, &first, &rule).iter().map(|&(j, i)| (i, j)).collect();
        back.sort_unstable();
        prop_assert_eq!(back, plain);
    }
}
