//! What is said of obstacles and free floor.

use cairn::camera::simulator::Scenario;
use cairn::motion::obstacles::ObstaclesConfig;

use crate::drive::{Bearings, HEIGHT_M, judge, room, word};

fn share(part: usize, whole: usize) -> f64 {
    part as f64 / whole.max(1) as f64
}

#[test]
fn furniture_is_in_the_way_and_what_is_said_to_be_free_is() {
    let driven = judge(&room(Scenario::RoomTour, 303), 24.0, HEIGHT_M, Some(&ObstaclesConfig::default()));
    let b = driven.bearings;
    assert!(b.scans >= 5 && b.obstacles > 100 && b.free_reports > 50, "{b:?}: nothing was judged");
    assert!(share(b.reported, b.obstacles) > 0.5, "{b:?}");
    assert!(share(b.wrong, b.free_reports) <= 0.005, "{b:?}");
}

/// `SEEDS`, `SECONDS`, `SCENARIOS` and `SEEN_FLOOR` (1: what keyframes saw is told, too) choose; pictures of 640 x 480 at 20 Hz.
#[test]
#[ignore = "the long form, which prints its figures"]
fn table() {
    let seconds: f64 = word("SECONDS", "40").parse().unwrap();
    let seeds: Vec<u64> = word("SEEDS", "321,322,323").split(',').map(|s| s.parse().unwrap()).collect();
    let how = ObstaclesConfig { seen_floor: word("SEEN_FLOOR", "0") == "1", ..ObstaclesConfig::default() };
    let mut all = Bearings::default();
    for name in word("SCENARIOS", "room_tour").split(',') {
        let scenario = Scenario::ALL.into_iter().find(|s| s.name() == name).expect("a scenario");
        for seed in &seeds {
            let mut config = room(scenario, *seed);
            (config.width, config.height, config.rate_hz) = (640, 480, 20.0);
            let b = judge(&config, seconds, HEIGHT_M, Some(&how)).bearings;
            all.scans += b.scans;
            all.obstacles += b.obstacles;
            all.reported += b.reported;
            all.free += b.free;
            all.told_free += b.told_free;
            all.free_reports += b.free_reports;
            all.wrong += b.wrong;
            all.worst_m = all.worst_m.max(b.worst_m);
        }
    }
    println!("| bearings | of | share |\n|---|---:|---:|");
    println!(
        "| with an obstacle within 3 m, reported | {} | {:.1} % |",
        all.obstacles,
        100.0 * share(all.reported, all.obstacles)
    );
    println!("| truly free, reported | {} | {:.1} % |", all.free, 100.0 * share(all.told_free, all.free));
    let right = all.free_reports - all.wrong;
    println!("| free reports that are free | {} | {:.2} % |", all.free_reports, 100.0 * share(right, all.free_reports));
}
