use super::super::Se3;
use super::super::essential::essential_of;
use super::super::frames::{First, Second};
use super::super::random::Random;
use super::super::synthetic::{FOCAL, Scene, Shape, projective_distance, random_rotation};
use super::*;

/// Pixels of a 640 x 480 picture.
fn pixels(x: &[Vector2<f64>]) -> Vec<Vector2<f64>> {
    x.iter().map(|p| p * FOCAL + Vector2::new(320.0, 240.0)).collect()
}

fn true_fundamental(scene: &Scene) -> Matrix3<f64> {
    let k = Matrix3::new(FOCAL, 0.0, 320.0, 0.0, FOCAL, 240.0, 0.0, 0.0, 1.0);
    let inverse = k.try_inverse().expect("regular");
    inverse.transpose() * essential_of(&scene.second_from_first) * inverse
}

fn sampson(f: &Matrix3<f64>, scene: &Scene) -> Vec<f64> {
    let (a, b) = (pixels(&scene.x1), pixels(&scene.x2));
    a.iter().zip(&b).map(|(x1, x2)| sampson_squared(f, x1, x2).sqrt()).collect()
}

fn run(scene: &Scene) -> Option<FundamentalEstimate> {
    estimate_fundamental(&pixels(&scene.x1), &pixels(&scene.x2), &RansacOptions::new(1.2))
}

#[test]
fn eq_4_seven_points_give_one_to_three_and_one_is_true() {
    let mut errors = vec![];
    for seed in 0..500 {
        let mut random = Random::new(seed);
        let scene = Scene::new(&mut random, Shape::Volume, 7, 0.8);
        let mut found = vec![];
        let take = |x: &[Vector2<f64>]| std::array::from_fn(|i| x[i]);
        seven_point(&take(&scene.x1), &take(&scene.x2), &mut found);
        assert!((1..=3).contains(&found.len()), "seed {seed}: {}", found.len());
        for f in &found {
            assert!(f.determinant().abs() < 1e-12, "seed {seed}");
            for (x1, x2) in scene.x1.iter().zip(&scene.x2) {
                assert!(x2.push(1.0).dot(&(f * x1.push(1.0))).abs() < 1e-12, "seed {seed}");
            }
        }
        let e = essential_of(&scene.second_from_first);
        errors.push((found.iter().map(|f| projective_distance(f, &e)).fold(f64::INFINITY, f64::min), seed));
    }
    errors.sort_by(|a, b| a.0.total_cmp(&b.0));
    assert!(errors[250].0 < 1e-11 && errors[490].0 < 1e-7, "{:?} {:?}", errors[250], errors[490]);
}

#[test]
fn refinement_directions_equal_numeric_differences() {
    for seed in 0..30 {
        let mut random = Random::new(seed);
        let f = RankTwo::nearest(&Matrix3::from_fn(|_, _| random.normal())).expect("rank two");
        let problem = SampsonProblem { matches: std::iter::empty(), loss: Loss::Squared };
        let directions = f.directions();
        for k in 0..7 {
            let h = 1e-6;
            let moved = |s: f64| {
                let mut delta = SVector::<f64, 7>::zeros();
                delta[k] = s * h;
                problem.step(&f, &delta).matrix()
            };
            let numeric = (moved(1.0) - moved(-1.0)) / (2.0 * h);
            for i in 0..9 {
                assert!((numeric[i] - directions[(i, k)]).abs() < 1e-9, "seed {seed}, parameter {k}, entry {i}");
            }
        }
    }
}

#[test]
fn exact_matches_give_the_exact_matrix() {
    for seed in 0..20 {
        let mut random = Random::new(seed);
        let scene = Scene::new(&mut random, Shape::Volume, 100, 0.8);
        let found = run(&scene).expect("a matrix");
        let worst = sampson(&found.fundamental, &scene).into_iter().fold(0.0, f64::max);
        assert!(worst < 1e-7 && found.inlier_count == 100, "seed {seed}: {worst} px");
        assert_eq!(found.degeneracy, Degeneracy::None, "seed {seed}");
        assert!(projective_distance(&found.fundamental, &true_fundamental(&scene)) < 1e-6, "seed {seed}");
    }
}

#[test]
fn half_outliers_and_half_a_pixel_leave_the_geometry() {
    for seed in 0..20 {
        let mut random = Random::new(seed);
        let exact = Scene::new(&mut random, Shape::Volume, 200, 0.8);
        let clean = Scene { points: vec![], x1: exact.x1.clone(), x2: exact.x2.clone(), truth: vec![], ..exact };
        let share = 0.3 + 0.2 * (seed % 2) as f64;
        let scene = exact.noise(&mut random, 0.5).outliers(&mut random, share);
        let found = run(&scene).expect("a matrix");
        let (recall, precision) = scene.recall_precision(&found.inliers);
        assert!(recall > 0.9 && precision > 0.9, "seed {seed}: {recall} {precision}");
        let mut errors = sampson(&found.fundamental, &clean);
        errors.sort_by(f64::total_cmp);
        assert!(errors[100] < 0.25, "seed {seed}: median {} px of the exact matches", errors[100]);
        assert!(found.fundamental.determinant().abs() < 1e-15, "seed {seed}: rank two");
    }
}

#[test]
fn a_plane_is_told_and_matches_beside_it_choose_the_epipole() {
    for seed in 0..10 {
        let mut random = Random::new(seed);
        let plane = Scene::new(&mut random, Shape::Plane, 160, 0.8);
        let mut mixed = Scene::with_motion(&mut random, Shape::Volume, 40, plane.second_from_first);
        let beside = Scene { x1: mixed.x1.clone(), x2: mixed.x2.clone(), points: vec![], truth: vec![], ..plane };
        mixed.x1.extend(&plane.x1);
        mixed.x2.extend(&plane.x2);
        mixed.truth = vec![true; 200];
        let found = run(&mixed.noise(&mut random, 0.5).outliers(&mut random, 0.2)).expect("a matrix");
        assert!(matches!(found.degeneracy, Degeneracy::DominantPlane { .. }), "seed {seed}: {:?}", found.degeneracy);
        let mut errors = sampson(&found.fundamental, &beside);
        errors.sort_by(f64::total_cmp);
        assert!(errors[20] < 0.5, "seed {seed}: {} px beside the plane", errors[20]);

        let flat = Scene { points: vec![], truth: vec![true; 160], ..plane }.noise(&mut random, 0.5);
        let found = run(&flat).expect("a matrix");
        assert!(matches!(found.degeneracy, Degeneracy::Plane { .. }), "seed {seed}: {:?}", found.degeneracy);
    }
}

#[test]
fn a_rotation_and_standing_still_are_told() {
    for seed in 0..10 {
        let mut random = Random::new(seed);
        let angle = if seed % 2 == 0 { 0.0 } else { 0.3 };
        let still = Se3::<Second, First>::new(random_rotation(&mut random, angle), Vector3::zeros());
        let scene = Scene::with_motion(&mut random, Shape::Volume, 150, still).noise(&mut random, 0.4);
        if let Some(found) = run(&scene) {
            let told = matches!(found.degeneracy, Degeneracy::PureRotation { .. });
            assert!(told, "seed {seed}: {:?}", found.degeneracy);
        }
    }
}

#[test]
fn bad_input_gives_none() {
    let mut random = Random::new(5);
    let scene = Scene::new(&mut random, Shape::Volume, 100, 0.8);
    let (a, b) = (pixels(&scene.x1), pixels(&scene.x2));
    let run = |x1: &[Vector2<f64>], x2: &[Vector2<f64>]| estimate_fundamental(x1, x2, &RansacOptions::new(1.2));
    assert!(run(&[], &[]).is_none());
    assert!(run(&a[..6], &b[..6]).is_none());
    assert!(run(&a[..7], &b[..7]).is_none(), "seven matches fit anything");
    assert!(run(&a, &b[..99]).is_none());
    assert!(run(&[a[0]; 50], &[b[0]; 50]).is_none());
    let mut nan = a.clone();
    nan[0].x = f64::NAN;
    assert!(run(&nan, &b).is_none());
    for seed in 0..5 {
        let mut random = Random::new(seed);
        let mut points = || -> Vec<Vector2<f64>> {
            (0..200).map(|_| Vector2::new(random.uniform(0.0, 640.0), random.uniform(0.0, 480.0))).collect()
        };
        let (a, b) = (points(), points());
        assert!(run(&a, &b).is_none(), "seed {seed}: no model in random matches");
    }
    let mut line = |slope: f64| -> Vec<Vector2<f64>> {
        let point = |i| Vector2::new(3.0, slope) * f64::from(i);
        (0..60).map(|i| point(i) + Vector2::new(random.normal(), random.normal()) * 0.2).collect()
    };
    let (a, b) = (line(1.0), line(2.0));
    assert!(run(&a, &b).is_none(), "seed 5: a noisy line");
}

#[test]
fn a_few_exact_matches_among_rough_ones_and_strangers_hold_the_geometry() {
    // Of 60 matches 15 are right to a tenth of a pixel, 15 to a whole one, 30 are wrong; errors at 200 exact points, pixels.
    let errors = |options: RansacOptions| -> Vec<f64> {
        let error = |seed: u64| {
            let mut random = Random::new(seed);
            let mut scene = Scene::new(&mut random, Shape::Volume, 60, 0.8).outliers(&mut random, 0.5);
            for i in 0..60 {
                let sigma_px = if i % 4 < 2 { 0.1 } else { 1.0 };
                for x in [&mut scene.x1[i], &mut scene.x2[i]] {
                    *x += Vector2::new(random.normal(), random.normal()) * (sigma_px / FOCAL);
                }
            }
            let exact = Scene::with_motion(&mut random, Shape::Volume, 200, scene.second_from_first);
            let found =
                estimate_fundamental(&pixels(&scene.x1), &pixels(&scene.x2), &RansacOptions { seed, ..options });
            let mut left = found.map_or(vec![f64::INFINITY], |f| sampson(&f.fundamental, &exact));
            left.sort_by(f64::total_cmp);
            left[left.len() / 2]
        };
        let mut all: Vec<f64> = (0..40).map(error).collect();
        all.sort_by(f64::total_cmp);
        all
    };
    let plain = RansacOptions::thorough(1.96);
    let (of_one_noise, of_any) =
        (errors(plain), errors(RansacOptions { least_share: 0.3, search_iterations: 100, ..plain }));
    assert!(of_any[20] < 0.2 && of_any[38] < 0.5, "seeds 0 to 39: {of_any:?}");
    assert!(of_any[20] < 0.75 * of_one_noise[20] && of_any[38] < of_one_noise[38], "{of_one_noise:?} {of_any:?}");
}
