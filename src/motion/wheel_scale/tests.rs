use super::super::synthetic::{Drive, drive};
use super::*;
use crate::geometry::random::Random;

const RADIUS_SIGMA: f64 = 0.01;

/// Everything at once: what the window holds at the end of a drive.
fn after(drive: &Drive, given: Robot) -> WheelScale {
    let mut scale = WheelScale::new(given, RADIUS_SIGMA);
    scale.history = drive.history.clone();
    let (last, before) = drive.segments.split_last().expect("segments");
    for segment in before {
        let mut segment = *segment;
        assert!(segment.weigh(&scale.history, &given));
        scale.segments.push(segment);
    }
    scale.push(*last);
    scale
}

#[test]
fn truth_lies_in_the_published_interval_as_often_as_it_says() {
    // Bursts of slip, wheels of a common error, a scale that drifts, an unknown mount: 100 seeds.
    let (mut inside, mut worst, mut squares, mut told) = (0, 0.0_f64, 0.0, 0);
    for seed in 0..100 {
        let radius = RADIUS_SIGMA * Random::new(900 + seed).normal();
        let drive = drive(seed, |d| (d.bursts, d.radius) = (1 + seed as usize % 2, radius));
        let scale = after(&drive, Robot::unknown());
        let Some(word) = scale.measurement() else { continue };
        told += 1;
        let off = (word.log_metres_per_unit - drive.log_scale) / word.sigma;
        inside += usize::from(off.abs() <= 1.96);
        worst = worst.max(off.abs());
        squares += off * off;
    }
    println!("told {told}, inside {inside}, rms {:.2}, worst {worst:.2} sigma", (squares / f64::from(told)).sqrt());
    assert!(told >= 97, "{told} of 100 drives told a scale");
    assert!((90 * told as usize..=98 * told as usize).contains(&(100 * inside)), "{inside} of {told}");
    assert!(worst < 5.0, "worst {worst} sigma");
}

#[test]
fn ten_seconds_at_half_a_metre_a_second_tell_the_scale_of_true_wheels_within_a_percent() {
    let mut off: Vec<f64> = Vec::new();
    for seed in 200..220 {
        let drive = drive(seed, |d| (d.seconds, d.bursts) = (11.0, usize::from(seed % 2 == 0)));
        let scale = after(&drive, Robot::unknown());
        if let Some(word) = scale.measurement() {
            off.push((word.log_metres_per_unit - drive.log_scale).abs());
            if off[off.len() - 1] > 0.012 {
                println!("seed {seed}: {word:?} {:?} {:?}", scale.solution, drive.slips);
                println!("{:?}", scale.segments.iter().map(|s| u8::from(s.slips)).collect::<Vec<_>>());
            }
        }
    }
    off.sort_unstable_by(f64::total_cmp);
    println!("{} told, {off:.4?}", off.len());
    assert!(off.len() >= 12, "{} of 20 told a scale after 5 m", off.len());
    assert!(off[off.len() / 2] < 0.01 && off[off.len() - 1] < 0.03, "{off:?}");
}

#[test]
fn slip_is_seen_where_it_is_and_nowhere_else() {
    let (mut seen, mut slipped, mut wrong, mut all) = (0, 0, 0, 0);
    for seed in 300..310 {
        let drive = drive(seed, |d| d.bursts = 2);
        let scale = after(&drive, Robot::unknown());
        for s in &scale.segments {
            let (a, b) = (s.from_ns as f64 * 1e-9, s.to_ns as f64 * 1e-9);
            let within = |(from, to): &(f64, f64)| *from <= a + 0.1 && b <= *to + 0.1;
            let beside = |(from, to): &(f64, f64)| b + 0.1 < *from || *to < a - 0.1;
            let (inside, outside) = (drive.slips.iter().any(within), drive.slips.iter().all(beside));
            slipped += usize::from(inside);
            seen += usize::from(inside && s.slips);
            wrong += usize::from(outside && s.slips);
            all += usize::from(outside);
        }
    }
    println!("{seen} of {slipped} slips seen, {wrong} of {all} others called slips");
    assert!(slipped > 30 && 20 * seen >= 19 * slipped, "{seen} of {slipped}");
    assert!(100 * wrong <= 3 * all, "{wrong} of {all}");
}

#[test]
fn wheels_that_slip_most_of_the_time_tell_nothing_and_a_short_drive_neither() {
    let short = drive(7, |d| d.seconds = 4.0);
    assert!(after(&short, Robot::unknown()).measurement().is_none());
    let mut skid = drive(8, |d| d.seconds = 20.0);
    // A camera that stands still half of the time while the wheels turn at random speeds.
    let mut random = Random::new(3);
    for segment in &mut skid.segments {
        segment.step *= random.uniform(0.2, 1.8);
    }
    let word = after(&skid, Robot::unknown()).measurement();
    assert!(word.is_none_or(|w| (w.log_metres_per_unit - skid.log_scale).abs() < 3.0 * w.sigma), "{word:?}");
}

#[test]
fn wheels_are_believed_by_how_long_they_agree_beside_any_other_scale() {
    let sigma = |seconds, rival_s| slip_sigma(&Belief { seconds, rival_s });
    assert!(sigma(6.7, 3.3) < 0.002 && sigma(6.7, 0.0) < 0.002, "more than a burst, and half as long again as another");
    assert!(
        sigma(2.0, 0.0) > 0.1 && sigma(4.0, 0.0) > TOLD_SIGMA && sigma(4.2, 0.0) < TOLD_SIGMA,
        "a wheel may spin as long"
    );
    assert_eq!(sigma(8.0, 6.0), MOMENT_SIGMA, "two scales nearly as long as each other");
}

#[test]
fn what_is_known_of_the_robot_outlasts_a_map_and_a_rescaled_map_tells_one() {
    let drive = drive(11, |_| {});
    let mut scale = after(&drive, Robot::unknown());
    let word = scale.measurement().expect("told");
    let factor = word.log_metres_per_unit.exp();
    scale.rescale(factor);
    assert!(scale.measurement().expect("told").log_metres_per_unit.abs() < 1e-9);
    let robot = scale.robot();
    scale.begin_map();
    assert!(scale.measurement().is_none());
    let kept = scale.robot();
    assert!(kept.lever_m == robot.lever_m && kept.sigma[3] > robot.sigma[3] && kept.sigma[3] < 0.2);
    assert!(scale.between(1_000_000_000, 2_000_000_000).is_some(), "the readings stay");
}

#[test]
fn a_unit_that_has_only_begun_is_not_told_by_what_was_told_of_the_one_before() {
    let drive = drive(11, |_| {});
    let mut scale = after(&drive, Robot::unknown());
    assert!(scale.measurement().is_some());
    // Behind a turn the map goes on three times as large. What the wheels say of its first segment is still on its way.
    let last = drive.segments[drive.segments.len() - 1];
    let times = (last.to_ns + 5_000_000_000, last.to_ns + 5_600_000_000);
    let robot = scale.robot();
    scale.push(Segment::new(times, (last.turn, 3.0 * last.step), last.sigma, last.at_depths, Unit(1)));
    assert!(scale.measurement().is_none(), "{:?}", scale.measurement());
    assert!(scale.ratio(Unit::default(), Unit(1)).is_none() && scale.others().next().is_none());
    assert_eq!(scale.robot(), robot, "the robot is the one that it was");
}
