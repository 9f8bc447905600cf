use super::super::random::Random;
use super::super::synthetic::{FOCAL, Scene, Shape, random_rotation};
use super::*;

fn options() -> TwoViewOptions {
    TwoViewOptions::new(0.6, FOCAL)
}

fn run(scene: &Scene) -> Result<TwoViewReconstruction, TwoViewFailure> {
    reconstruct_two_views(&scene.x1, &scene.x2, &options())
}

#[test]
fn exact_matches_of_a_volume_give_the_exact_map() {
    for seed in 0..20 {
        let mut random = Random::new(seed);
        let scene = Scene::new(&mut random, Shape::Volume, 150, 1.0);
        let found = run(&scene).expect("a map");
        let (r, t) = scene.motion_error(&found.second_from_first);
        assert!(r < 1e-7 && t < 1e-7 && found.inlier_count == 150, "seed {seed}: {r} {t}");
        for (point, truth) in found.points.iter().zip(&scene.points) {
            if let Some(point) = point {
                assert!((point - truth).norm() < 1e-7 * truth.norm_squared(), "seed {seed}: {point} {truth}");
            }
        }
        assert_eq!(found.model, TwoViewModel::Essential, "seed {seed}: ratio {}", found.homography_ratio);
    }
}

#[test]
fn noisy_volumes_with_outliers_give_a_map() {
    for seed in 0..30 {
        let mut random = Random::new(seed);
        let share = 0.3 + 0.2 * (seed % 2) as f64;
        let scene =
            Scene::new(&mut random, Shape::Volume, 300, 0.6).noise(&mut random, 0.5).outliers(&mut random, share);
        let found = run(&scene).unwrap_or_else(|e| panic!("seed {seed}: {e}"));
        let (r, t) = scene.motion_error(&found.second_from_first);
        assert!(r < 0.02 && t < 0.1, "seed {seed}: {r} {t}");
        let (recall, precision) = scene.recall_precision(&found.inliers);
        assert!(recall > 0.9 && precision > 0.9, "seed {seed}: {recall} {precision}");
        assert!(found.votes_runner_up * 4 < found.votes * 3, "seed {seed}: {} {}", found.votes, found.votes_runner_up);
    }
}

#[test]
fn a_plane_gives_the_map_or_both_motions() {
    let (mut maps, mut pairs) = (0, 0);
    for seed in 0..40 {
        let mut random = Random::new(seed);
        let scene = Scene::new(&mut random, Shape::Plane, 200, 0.8).noise(&mut random, 0.5).outliers(&mut random, 0.2);
        let near = |m: &TwoViewReconstruction| {
            let (r, t) = scene.motion_error(&m.second_from_first);
            r < 0.05 && t < 0.25
        };
        match run(&scene) {
            Ok(found) => {
                assert_eq!(found.model, TwoViewModel::Homography, "seed {seed}");
                assert!(near(&found), "seed {seed}: {:?}", scene.motion_error(&found.second_from_first));
                maps += 1;
            }
            Err(TwoViewFailure::Ambiguous { best, runner_up }) => {
                assert!(near(&best) || near(&runner_up), "seed {seed}: neither is true");
                pairs += 1;
            }
            Err(other) => panic!("seed {seed}: {other}"),
        }
    }
    assert!(maps >= 5 && pairs >= 5, "{maps} maps, {pairs} pairs");
}

#[test]
fn matches_beside_the_plane_decide_between_its_motions() {
    for seed in 0..20 {
        let mut random = Random::new(seed);
        let mut scene = Scene::new(&mut random, Shape::Plane, 150, 0.8);
        let beside = Scene::with_motion(&mut random, Shape::Volume, 75, scene.second_from_first);
        scene.x1.extend(&beside.x1);
        scene.x2.extend(&beside.x2);
        scene.truth.extend(&beside.truth);
        let scene = scene.noise(&mut random, 0.5);
        let found = run(&scene).unwrap_or_else(|e| panic!("seed {seed}: {e}"));
        let (r, t) = scene.motion_error(&found.second_from_first);
        assert!(r < 0.03 && t < 0.15, "seed {seed}: {r} {t}");
    }
}

/// The study's own case: 18 pairs of one object.
#[test]
fn eighteen_pairs_give_a_map() {
    for seed in 0..30 {
        let mut random = Random::new(seed);
        let scene = Scene::new(&mut random, Shape::Volume, 18, 1.5).noise(&mut random, 0.3).outliers(&mut random, 0.1);
        let options = TwoViewOptions::single_pair(0.5, FOCAL);
        let found = reconstruct_two_views(&scene.x1, &scene.x2, &options);
        let found = found.unwrap_or_else(|e| panic!("seed {seed}: {e}"));
        let (r, t) = scene.motion_error(&found.second_from_first);
        assert!(r < 0.03 && t < 0.1, "seed {seed}: {r} {t}");
    }
}

#[test]
fn turning_and_standing_still_are_told() {
    for seed in 0..20 {
        let mut random = Random::new(seed);
        for (angle, noise, outliers) in [(0.3, 0.0, 0.0), (0.3, 0.5, 0.3), (0.0, 0.0, 0.0), (0.0, 0.5, 0.3)] {
            let still = Se3::new(random_rotation(&mut random, angle), Vector3::zeros());
            let scene = Scene::with_motion(&mut random, Shape::Volume, 200, still)
                .noise(&mut random, noise)
                .outliers(&mut random, outliers);
            match run(&scene) {
                Err(TwoViewFailure::PureRotation { angle_rad }) if angle > 0.0 => {
                    assert!((angle_rad - still.rotation.angle()).abs() < 0.005, "seed {seed}: {angle_rad}");
                }
                Err(TwoViewFailure::LowParallax { .. }) if angle == 0.0 => {}
                other => panic!("seed {seed}, angle {angle}, noise {noise}: {other:?}"),
            }
        }
    }
}

#[test]
fn a_tiny_step_is_low_parallax_or_a_rotation() {
    for seed in 0..20 {
        let mut random = Random::new(seed);
        let scene = Scene::new(&mut random, Shape::Volume, 200, 0.01).noise(&mut random, 0.5);
        let found = run(&scene);
        let told = matches!(found, Err(TwoViewFailure::LowParallax { .. }) | Err(TwoViewFailure::PureRotation { .. }));
        assert!(told, "seed {seed}: {found:?}");
    }
}

#[test]
fn bad_input_is_named() {
    let mut random = Random::new(5);
    let scene = Scene::new(&mut random, Shape::Volume, 100, 0.8);
    let run = |a: &[Vector2<f64>], b: &[Vector2<f64>]| reconstruct_two_views(a, b, &options());
    assert!(matches!(run(&[], &[]), Err(TwoViewFailure::TooFewMatches { count: 0, .. })));
    assert!(matches!(run(&scene.x1, &scene.x2[..99]), Err(TwoViewFailure::LengthMismatch { .. })));
    let mut nan = scene.x1.clone();
    nan[3].x = f64::NAN;
    assert_eq!(run(&nan, &scene.x2), Err(TwoViewFailure::NotFinite));
    let same = vec![scene.x1[0]; 80];
    assert!(run(&same, &same).is_err());
    for seed in 0..5 {
        let mut random = Random::new(seed);
        let mut noise = || -> Vec<Vector2<f64>> {
            (0..200).map(|_| Vector2::new(random.uniform(-0.6, 0.6), random.uniform(-0.5, 0.5))).collect()
        };
        let (a, b) = (noise(), noise());
        assert_eq!(run(&a, &b), Err(TwoViewFailure::NoModel), "seed {seed}");
    }
}

#[test]
fn the_same_seed_gives_the_same_bits() {
    let mut random = Random::new(11);
    let scene = Scene::new(&mut random, Shape::Volume, 200, 0.8).noise(&mut random, 0.5).outliers(&mut random, 0.4);
    assert_eq!(run(&scene), run(&scene));
}
