use super::super::random::Random;
use super::super::synthetic::{FOCAL, Scene, Shape, projective_distance, random_rotation};
use super::*;

fn options() -> EssentialOptions {
    EssentialOptions::new(1.2 / FOCAL)
}

#[test]
fn eq_6_e_from_f_is_the_essential_matrix() {
    let mut random = Random::new(1);
    let scene = Scene::new(&mut random, Shape::Volume, 8, 0.5);
    let e = essential_of(&scene.second_from_first);
    let k1 = Matrix3::new(500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0);
    let k2 = Matrix3::new(700.0, 0.0, 310.0, 0.0, 690.0, 250.0, 0.0, 0.0, 1.0);
    let f = k2.try_inverse().expect("regular").transpose() * e * k1.try_inverse().expect("regular");
    let found = essential_from_fundamental(&(f * -3.0), &k1, &k2).expect("rank two");
    assert!(projective_distance(&found, &e) < 1e-12);
    let s = found.singular_values();
    assert!((s - Vector3::new(1.0, 1.0, 0.0)).norm() < 1e-14, "{s}");
    // Singular values are forced, whatever F brings.
    let noisy = f + Matrix3::from_fn(|_, _| 1e-8 * random.normal());
    let s = essential_from_fundamental(&noisy, &k1, &k2).expect("rank two").singular_values();
    assert!((s - Vector3::new(1.0, 1.0, 0.0)).norm() < 1e-14, "{s}");
    assert!(essential_from_fundamental(&Matrix3::zeros(), &k1, &k2).is_none());
    assert!(essential_from_fundamental(&(f * f64::NAN), &k1, &k2).is_none());
}

#[test]
fn eq_7_8_decomposition_gives_four_rotations_with_one_true_motion() {
    for seed in 0..50 {
        let mut random = Random::new(seed);
        let scene = Scene::new(&mut random, Shape::Volume, 1, 1.0);
        let e = essential_of(&scene.second_from_first);
        let parts = decompose(&e).expect("rank two");
        let mut right = 0;
        for candidate in &parts.candidates {
            let det = candidate.rotation.to_rotation_matrix().matrix().determinant();
            assert!((det - 1.0).abs() < 1e-12, "seed {seed}");
            assert!(projective_distance(&essential_of(candidate), &e) < 1e-12, "seed {seed}");
            let (r, t) = scene.motion_error(candidate);
            right += usize::from(r < 1e-7 && t < 1e-7);
        }
        assert_eq!(right, 1, "seed {seed}");
    }
}

#[test]
fn one_point_rules_and_votes_choose_the_true_motion() {
    for seed in 0..50 {
        let mut random = Random::new(seed);
        let scene = Scene::new(&mut random, Shape::Volume, 30, 1.0);
        // Every sign and order of U and V that an SVD may return ends in another of the four cases.
        let sign = if seed % 2 == 0 { 1.0 } else { -1.0 };
        let parts = decompose(&(essential_of(&scene.second_from_first) * sign)).expect("rank two");
        let votes = cheirality_votes(&parts, scene.x1.iter().copied().zip(scene.x2.iter().copied()));
        let winner = (0..4).find(|&k| votes[k] == 30).expect("all points agree");
        assert_eq!(votes.iter().sum::<usize>(), 30, "seed {seed}: {votes:?}");
        let (r, t) = scene.motion_error(&parts.candidates[winner]);
        assert!(r < 1e-7 && t < 1e-7, "seed {seed}");
        for (x1, x2) in scene.x1.iter().zip(&scene.x2) {
            assert_eq!(cheirality_one_point(&parts, x1, x2), Some(winner), "seed {seed}");
        }
        // Each of the four takes its turn as P_A.
        for first in 0..4 {
            let turned = decompose(&essential_of(&parts.candidates[first])).expect("rank two");
            let k = cheirality_one_point(&turned, &scene.x1[0], &scene.x2[0]).expect("a point");
            let (r, t) = scene.motion_error(&turned.candidates[k]);
            assert!(r < 1e-7 && t < 1e-7, "seed {seed}");
        }
    }
}

#[test]
fn refinement_directions_equal_numeric_differences() {
    for seed in 0..30 {
        let mut random = Random::new(seed);
        let scene = Scene::new(&mut random, Shape::Volume, 1, 1.0);
        let pose = scene.second_from_first;
        let motion = Motion { rotation: pose.rotation, translation: pose.translation };
        let directions = motion.directions();
        let problem = MotionProblem { matches: std::iter::empty(), loss: Loss::Squared };
        for k in 0..5 {
            let h = 1e-6;
            let moved = |s: f64| {
                let mut delta = SVector::<f64, 5>::zeros();
                delta[k] = s * h;
                problem.step(&motion, &delta).essential()
            };
            let numeric = (moved(1.0) - moved(-1.0)) / (2.0 * h);
            for i in 0..9 {
                assert!((numeric[i] - directions[(i, k)]).abs() < 1e-9, "seed {seed}, parameter {k}, entry {i}");
            }
        }
    }
}

#[test]
fn refinement_reaches_the_exact_motion() {
    for seed in 0..20 {
        let mut random = Random::new(seed);
        let scene = Scene::new(&mut random, Shape::Volume, 40, 1.0);
        let off = Se3::new(
            random_rotation(&mut random, 0.02) * scene.second_from_first.rotation,
            scene.second_from_first.translation + Vector3::new(0.05, -0.03, 0.04),
        );
        let matches = scene.x1.iter().copied().zip(scene.x2.iter().copied());
        let refined = refine_motion(&off, matches, Loss::Squared, &LmOptions::default()).expect("finite");
        let (r, t) = scene.motion_error(&refined);
        assert!(r < 1e-9 && t < 1e-7, "seed {seed}: {r} {t}");
    }
}

#[test]
fn exact_matches_give_the_exact_motion() {
    for seed in 0..20 {
        let mut random = Random::new(seed);
        let scene = Scene::new(&mut random, Shape::Volume, 100, 1.0);
        let found = estimate_essential(&scene.x1, &scene.x2, &options()).expect("a motion");
        let (r, t) = scene.motion_error(&found.second_from_first);
        assert!(r < 1e-9 && t < 1e-7 && found.inlier_count == 100, "seed {seed}: {r} {t} {found:?}");
        assert!(found.votes == 100 && found.votes_runner_up < 20, "seed {seed}: {found:?}");
    }
}

#[test]
fn half_outliers_and_half_a_pixel_leave_the_motion() {
    for shape in [Shape::Volume, Shape::Plane] {
        for seed in 0..30 {
            let mut random = Random::new(seed);
            let share = 0.3 + 0.2 * (seed % 2) as f64;
            let scene = Scene::new(&mut random, shape, 200, 0.8).noise(&mut random, 0.5).outliers(&mut random, share);
            let found = estimate_essential(&scene.x1, &scene.x2, &options()).expect("a motion");
            let (recall, precision) = scene.recall_precision(&found.inliers);
            assert!(recall > 0.9 && precision > 0.9, "seed {seed}: {recall} {precision}");
            let (r, t) = scene.motion_error(&found.second_from_first);
            // A plane has a second motion that fits as well: see `homography` and `two_view`, which tell.
            if matches!(shape, Shape::Volume) {
                assert!(r < 0.02 && t < 0.1, "seed {seed}: {r} {t}");
            }
        }
    }
}

#[test]
fn pure_rotation_and_standing_still_give_none() {
    for seed in 0..20 {
        let mut random = Random::new(seed);
        let angle = if seed % 3 == 0 { 0.0 } else { 0.2 };
        let still = Se3::new(random_rotation(&mut random, angle), Vector3::zeros());
        let scene = Scene::with_motion(&mut random, Shape::Volume, 200, still);
        assert!(estimate_essential(&scene.x1, &scene.x2, &options()).is_none(), "seed {seed}, exact");
        let scene = scene.noise(&mut random, 0.5);
        assert!(estimate_essential(&scene.x1, &scene.x2, &options()).is_none(), "seed {seed}, noisy");
        let scene = scene.outliers(&mut random, 0.3);
        assert!(estimate_essential(&scene.x1, &scene.x2, &options()).is_none(), "seed {seed}, outliers");
    }
}

#[test]
fn bad_input_gives_none() {
    let mut random = Random::new(5);
    let scene = Scene::new(&mut random, Shape::Volume, 100, 0.8);
    let run = |x1: &[Vector2<f64>], x2: &[Vector2<f64>]| estimate_essential(x1, x2, &options());
    assert!(run(&[], &[]).is_none());
    assert!(run(&scene.x1[..4], &scene.x2[..4]).is_none());
    assert!(run(&scene.x1[..5], &scene.x2[..5]).is_none(), "five matches fit anything");
    assert!(run(&scene.x1, &scene.x2[..99]).is_none());
    assert!(run(&[scene.x1[0]; 50], &[scene.x2[0]; 50]).is_none(), "one point fifty times");
    let mut nan = scene.x1.clone();
    nan[7].y = f64::NAN;
    assert!(run(&nan, &scene.x2).is_none());
    let random_points = |random: &mut Random| -> Vec<Vector2<f64>> {
        (0..200).map(|_| Vector2::new(random.uniform(-0.6, 0.6), random.uniform(-0.5, 0.5))).collect()
    };
    for seed in 0..5 {
        let mut random = Random::new(seed);
        let (a, b) = (random_points(&mut random), random_points(&mut random));
        assert!(run(&a, &b).is_none(), "seed {seed}: no model in random matches");
    }
    // Points of one line in space.
    let pose = scene.second_from_first;
    let line: Vec<Vector3<f64>> =
        (0..60).map(|i| Vector3::new(-0.5, 0.2, 3.0) + Vector3::new(0.02, 0.01, 0.02) * f64::from(i)).collect();
    let project = |p: &Vector3<f64>| Vector2::new(p.x / p.z, p.y / p.z);
    let a: Vec<Vector2<f64>> = line.iter().map(project).collect();
    let b: Vec<Vector2<f64>> = line.iter().map(|p| project(&pose.transform(p))).collect();
    assert!(run(&a, &b).is_none(), "collinear");
}

#[test]
fn the_same_seed_gives_the_same_bits() {
    let mut random = Random::new(8);
    let scene = Scene::new(&mut random, Shape::Volume, 150, 0.8).noise(&mut random, 0.5).outliers(&mut random, 0.4);
    let run = || estimate_essential(&scene.x1, &scene.x2, &options());
    assert_eq!(run(), run());
}
