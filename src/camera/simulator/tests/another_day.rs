//! The same place at another time: what has changed, and nothing else.

use super::super::scene::Scene;
use super::super::{place, room};
use super::*;

fn scene(config: &SimulatorConfig) -> Scene {
    let plan = room::Plan {
        seed: config.seed,
        texel_m: 0.02,
        rich: true,
        chessboard: &config.chessboard,
        tags: &config.tags,
        desk: &config.desk,
        another_day: &config.another_day,
    };
    place(config.scenario, &plan)
}

fn later(scenario: Scenario, moved_share: f64, other_light: bool) -> SimulatorConfig {
    let mut config = quick(SimulatorConfig { scenario, seed: 5, ..SimulatorConfig::default() });
    config.another_day.enabled = true;
    (config.another_day.moved_share, config.another_day.other_light) = (moved_share, other_light);
    config
}

/// Faces that stand elsewhere.
fn moved(config: &SimulatorConfig) -> (usize, usize) {
    let mut before = config.clone();
    before.another_day.enabled = false;
    let (before, after) = (scene(&before), scene(config));
    assert_eq!(before.quads.len(), after.quads.len());
    let pairs = before.quads.iter().zip(&after.quads);
    let moved = pairs.filter(|(a, b)| (a.origin - b.origin).norm() > 0.02 || a.right.dot(&b.right) < 0.999).count();
    (moved, after.quads.len())
}

#[test]
fn a_day_on_which_nothing_has_changed_gives_the_same_pictures() {
    let config = later(Scenario::RoomTour, 0.0, false);
    let before = SimulatorConfig { another_day: Default::default(), ..config.clone() };
    assert!(picture(&mut simulator(&config), 40) == picture(&mut simulator(&before), 40));
}

#[test]
fn a_third_of_the_furniture_stands_elsewhere_and_all_else_looks_as_it_did() {
    for scenario in [Scenario::RoomTour, Scenario::Corridor, Scenario::ThreeRooms] {
        let (mut elsewhere, mut faces) = (0, 0);
        for seed in 1..=12 {
            let mut config = later(scenario, 0.33, false);
            config.another_day.seed = seed;
            let found = moved(&config);
            (elsewhere, faces) = (elsewhere + found.0, faces + found.1);
        }
        let share = elsewhere as f64 / faces as f64;
        assert!((0.15..0.55).contains(&share), "{}: {share}", scenario.name());
        assert_eq!(moved(&later(scenario, 0.0, true)).0, 0);
    }
    // But for the floor's shadows.
    let config = later(Scenario::RoomTour, 0.33, false);
    let before = SimulatorConfig { another_day: Default::default(), ..config.clone() };
    let (before, after) = (scene(&before), scene(&config));
    let pairs = before.quads.iter().zip(&after.quads).filter(|(a, _)| a.away.z > -0.5 || a.origin.z > 0.0);
    let looks = |scene: &Scene, texture: usize| scene.textures[texture].clone();
    let (mut compared, mut others) = (0, 0);
    for (a, b) in pairs {
        let is_same = looks(&before, a.texture) == looks(&after, b.texture);
        if a.origin == b.origin && a.right == b.right {
            assert!(is_same, "a face at {:?}", a.origin);
            compared += 1;
        } else {
            others += usize::from(!is_same);
        }
    }
    assert!(compared > 100 && others > 20, "{compared} as they were, {others} others");
}

#[test]
fn another_light_changes_the_shading_and_not_only_the_brightness() {
    let mut differing = 0;
    for seed in 1..=6 {
        let mut config = later(Scenario::RoomTour, 0.0, true);
        config.another_day.seed = seed;
        let before = SimulatorConfig { another_day: Default::default(), ..config.clone() };
        let [a, b] = [&before, &config].map(|c| picture(&mut simulator(c), 40));
        // Shares of the picture's light in its four quarters.
        let quarters = |p: &GreyImage| {
            let mut sums = [0.0; 4];
            for (i, v) in p.data.iter().enumerate() {
                let (x, y) = (i % p.width, i / p.width);
                sums[2 * (2 * y / p.height) + 2 * x / p.width] += f64::from(*v);
            }
            let all: f64 = sums.iter().sum();
            sums.map(|s| s / all)
        };
        let change = quarters(&a).iter().zip(quarters(&b)).map(|(a, b)| (b / a - 1.0).abs()).fold(0.0, f64::max);
        differing += usize::from(change > 0.03);
    }
    assert!(differing >= 3, "{differing} of 6 lights are another one");
}
