use super::super::random::Random;
use super::super::synthetic::{FOCAL, Scene, Shape, projective_distance};
use super::*;

fn random_homography(random: &mut Random) -> Matrix3<f64> {
    let mut h = Matrix3::identity() + Matrix3::from_fn(|_, _| 0.2 * random.normal());
    h.m31 *= 0.3;
    h.m32 *= 0.3;
    h
}

fn planar(seed: u64, count: usize) -> (Random, Scene) {
    let mut random = Random::new(seed);
    let scene = Scene::new(&mut random, Shape::Plane, count, 1.0);
    (random, scene)
}

#[test]
fn four_exact_points_give_the_exact_homography() {
    for seed in 0..200 {
        let mut random = Random::new(seed);
        let h = random_homography(&mut random);
        let x1: [Vector2<f64>; 4] = std::array::from_fn(|_| Vector2::new(random.normal(), random.normal()));
        let depths: [f64; 4] = std::array::from_fn(|i| (h * x1[i].push(1.0)).z);
        // All on one side, as points that a camera sees are.
        if depths.iter().any(|d| *d < 0.2) {
            continue;
        }
        let x2 = x1.map(|x| apply(&h, &x));
        let Some(found) = four_point(&x1, &x2) else {
            // Nearly collinear.
            continue;
        };
        assert!(projective_distance(&found, &h) < 1e-7, "seed {seed}: {}", projective_distance(&found, &h));
    }
}

#[test]
fn collinear_or_overturned_samples_are_rejected() {
    let square = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(x, y)| Vector2::new(x, y));
    assert!(four_point(&square, &square).is_some());
    let mut line = square;
    line[2] = Vector2::new(2.0, 0.0);
    assert!(four_point(&line, &square).is_none() && four_point(&square, &line).is_none());
    let crossed = [square[0], square[2], square[1], square[3]];
    assert!(four_point(&square, &crossed).is_none());
    let mut nan = square;
    nan[3].x = f64::NAN;
    assert!(four_point(&nan, &square).is_none());
}

#[test]
fn dlt_of_exact_points_is_exact_in_pixels_too() {
    for seed in 0..20 {
        let (_, scene) = planar(seed, 30);
        let pixels = |x: &[Vector2<f64>]| -> Vec<Vector2<f64>> {
            x.iter().map(|p| p * FOCAL + Vector2::new(320.0, 240.0)).collect()
        };
        let (a, b) = (pixels(&scene.x1), pixels(&scene.x2));
        let h = dlt(&a, &b).expect("a plane");
        for (p, q) in a.iter().zip(&b) {
            assert!((apply(&h, p) - q).norm() < 1e-8, "seed {seed}");
        }
    }
    let line: Vec<Vector2<f64>> = (0..20).map(|i| Vector2::new(1.0, 2.0) * f64::from(i)).collect();
    assert!(dlt(&line, &line).is_none());
    assert!(dlt(&line[..3], &line[..3]).is_none());
}

#[test]
fn transfer_jacobian_equals_numeric_differences() {
    for seed in 0..20 {
        let mut random = Random::new(seed);
        let h = TwoWay::new(&random_homography(&mut random)).expect("regular");
        let x1 = Vector2::new(0.3 * random.normal(), 0.3 * random.normal());
        let x2 = apply(&h.forward, &x1) + Vector2::new(0.05 * random.normal(), 0.05 * random.normal());
        let problem = TransferProblem { matches: std::iter::once((x1, x2)), loss: Loss::Squared };
        let gradient = problem.linearise(&h).gradient;
        for k in 0..9 {
            let step = 1e-6;
            let moved = |s: f64| {
                let mut delta = SVector::<f64, 9>::zeros();
                delta[k] = s * step;
                problem.cost(&problem.step(&h, &delta))
            };
            // The cost's derivative is twice the gradient.
            let numeric = (moved(1.0) - moved(-1.0)) / (4.0 * step);
            assert!((numeric - gradient[k]).abs() < 1e-5 * (1.0 + gradient.norm()), "seed {seed}, entry {k}");
        }
    }
}

#[test]
fn half_outliers_and_half_a_pixel_leave_the_plane() {
    for seed in 0..30 {
        let (mut random, exact) = planar(seed, 200);
        let (clean1, clean2) = (exact.x1.clone(), exact.x2.clone());
        let share = 0.3 + 0.2 * (seed % 2) as f64;
        let scene = exact.noise(&mut random, 0.5).outliers(&mut random, share);
        let found = estimate_homography(&scene.x1, &scene.x2, &RansacOptions::new(2.0 / FOCAL)).expect("a plane");
        let (recall, precision) = scene.recall_precision(&found.inliers);
        assert!(recall > 0.9 && precision > 0.98, "seed {seed}: {recall} {precision}");
        for (a, b) in clean1.iter().zip(&clean2) {
            let error = (apply(&found.homography, a) - b).norm() * FOCAL;
            assert!(error < 1.0, "seed {seed}: {error} px");
        }
    }
}

#[test]
fn exact_matches_give_the_exact_homography() {
    for seed in 0..10 {
        let (_, scene) = planar(seed, 100);
        let found = estimate_homography(&scene.x1, &scene.x2, &RansacOptions::new(1e-3)).expect("a plane");
        for (a, b) in scene.x1.iter().zip(&scene.x2) {
            assert!((apply(&found.homography, a) - b).norm() < 1e-10, "seed {seed}");
        }
    }
}

#[test]
fn bad_input_gives_none() {
    let (mut random, scene) = planar(3, 100);
    let run = |a: &[Vector2<f64>], b: &[Vector2<f64>]| estimate_homography(a, b, &RansacOptions::new(0.003));
    assert!(run(&[], &[]).is_none());
    assert!(run(&scene.x1[..3], &scene.x2[..3]).is_none());
    assert!(run(&scene.x1[..4], &scene.x2[..4]).is_none(), "four matches fit anything");
    assert!(run(&[scene.x1[0]; 40], &[scene.x2[0]; 40]).is_none());
    let mut nan = scene.x2.clone();
    nan[50].x = f64::INFINITY;
    assert!(run(&scene.x1, &nan).is_none());
    let noise: Vec<Vector2<f64>> = (0..100).map(|_| Vector2::new(random.normal(), random.normal())).collect();
    assert!(run(&scene.x1, &noise).is_none(), "seed 3: random matches");
    let line: Vec<Vector2<f64>> = (0..50)
        .map(|i| Vector2::new(0.01, 0.02) * f64::from(i) + Vector2::new(random.normal(), random.normal()) * 1e-4)
        .collect();
    assert!(run(&line, &line).is_none(), "seed 3: a noisy line");
}
