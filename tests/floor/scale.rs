//! Metres by the camera's height.

use cairn::camera::simulator::Scenario;

use crate::drive::{Driven, HEIGHT_M, PITCH_DEG, judge, room, word};

/// All places in the map, which a corridor is not held to: what lies behind its turns lies where an assumption puts it (docs/floor.md).
#[test]
fn a_room_is_metric_by_the_height_of_the_camera_within_two_percent() {
    let driven = judge(&room(Scenario::RoomTour, 303), 24.0, HEIGHT_M, None);
    assert!(driven.until_metric_m.is_some_and(|way_m| way_m < 8.0), "metric after {:?} m", driven.until_metric_m);
    assert!(driven.scale_error.abs() < 0.02, "scale {} off", driven.scale_error);
    assert!(driven.scale_error.abs() < 3.0 * driven.sigma, "{} against sigma {}", driven.scale_error, driven.sigma);
    let (roll, pitch) = driven.roll_pitch_deg.expect("the floor");
    assert!(roll.abs() < 1.5 && (pitch - PITCH_DEG).abs() < 1.5, "roll {roll} pitch {pitch}");
}

/// Turns on the spot leave everything mapped behind: until the floor was driven over anew the scale's standard deviation says so, then lengths are
/// metres again. (Without asking anew they are 51 % off here where nothing is said to be assumed.)
#[test]
fn behind_a_turn_on_the_spot_the_height_tells_lengths_anew() {
    let driven = judge(&room(Scenario::Square, 312), 25.0, HEIGHT_M, None);
    assert!(driven.until_metric_m.is_some() && driven.assumed.0 > 0, "metric, then a turn: {:?}", driven.assumed);
    assert!(driven.scale_error.abs() < 0.05, "scale {} off", driven.scale_error);
    assert!(driven.scale_error_sure.abs() < 0.02, "{} off where it is said to be sure", driven.scale_error_sure);
    assert!(driven.assumed.0 < driven.assumed.1 * 3 / 4, "known again: assumed in {:?}", driven.assumed);
    // Turns within. (113 of 196 while frames that came out of a turn, not placed yet, were said to be sure.)
    let (inside, lengths) = driven.inside;
    assert!(lengths > 100 && 10 * inside >= 9 * lengths, "published within 1.96 sigma in {inside} of {lengths} frames");
    // It ends behind another turn, and says so.
    assert!(driven.sigma > 0.3, "sigma {}", driven.sigma);
}

/// What is driven straight behind a turn is straight and level, though next to no distance is known there (two motions fit for some frames), and
/// where lengths are said to be known again they are.
#[test]
fn behind_turns_on_the_spot_the_way_is_level_and_lengths_are_as_sure_as_they_are_said_to_be() {
    let drives: Vec<_> = [359, 360, 361].map(|seed| judge(&room(Scenario::Square, seed), 45.0, HEIGHT_M, None)).into();
    let sum = |of: &dyn Fn(&Driven) -> usize| drives.iter().map(of).sum::<usize>();
    let (steep, ways) = (sum(&|d| d.steep.0), sum(&|d| d.steep.1));
    // 2 to 5 of 100 where a frame's pose is looked for from the last one alone.
    assert!(ways > 1000 && 100 * steep < 2 * ways, "{steep} of {ways} ways lead up or down");
    let (inside, sure) = (sum(&|d| d.sure_anew.0), sum(&|d| d.sure_anew.1));
    assert!(sure > 60 && 10 * inside >= 9 * sure, "published within 1.96 sigma in {inside} of {sure} frames");
    for driven in &drives {
        let off = driven.anew_rms;
        assert!(driven.sure_anew.1 == 0 || off < 0.05, "{off} off behind turns where it is said to be sure");
    }
}

#[test]
fn where_no_floor_is_driven_over_nothing_is_told() {
    // A desk before a hand that sways.
    let driven = judge(&room(Scenario::HandHeld, 302), 12.0, 1.2, None);
    assert!(driven.until_metric_m.is_none(), "metric by a desk");
    assert!(!driven.refused.is_empty(), "the floor was not looked for");
}

/// `SCENARIOS`, `SEEDS`, `SECONDS` choose.
#[test]
#[ignore = "the long form, which prints its figures"]
fn table() {
    let seconds: f64 = word("SECONDS", "25").parse().unwrap();
    let seeds: Vec<u64> = word("SEEDS", "311,312,313").split(',').map(|s| s.parse().unwrap()).collect();
    for name in word("SCENARIOS", "room_tour,square,corridor,three_rooms").split(',') {
        let scenario = Scenario::ALL.into_iter().find(|s| s.name() == name).expect("a scenario");
        for seed in &seeds {
            judge(&room(scenario, *seed), seconds, HEIGHT_M, None);
        }
    }
}
