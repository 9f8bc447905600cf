use super::super::random::Random;
use super::super::synthetic::{FOCAL, Scene, Shape};
use super::*;
use crate::geometry::Se3;
use crate::geometry::frames::{First, Second};
use nalgebra::UnitQuaternion;

const MIDDLE: Vector2<f64> = Vector2::new(319.5, 239.5);
const HALF: f64 = 320.0;

/// Pixels of a lens with some barrel distortion (of the usual polynomial kind, not that of the fit).
fn pixel(x: &Vector2<f64>) -> Vector2<f64> {
    let r2 = x.norm_squared();
    x * ((1.0 - 0.12 * r2 + 0.05 * r2 * r2) * FOCAL) + MIDDLE
}

/// A scene through that lens, each picture's rows taken one after the other while the camera turns on by `w` over its height.
fn seen(
    random: &mut Random,
    shape: Shape,
    motion: Se3<Second, First>,
    w: Vector3<f64>,
) -> Vec<(Vector2<f64>, Vector2<f64>)> {
    let scene = Scene::with_motion(random, shape, 300, motion);
    let late = |x: &Vector2<f64>, sign: f64| {
        let y = x.y * FOCAL / 480.0;
        let ray = Rotation3::new(w * (sign * y)) * x.push(1.0);
        ray.xy() / ray.z
    };
    let mut noisy = |x: Vector2<f64>| x + Vector2::new(random.normal(), random.normal()) * 0.2;
    scene.x1.iter().zip(&scene.x2).map(|(a, b)| (noisy(pixel(&late(a, -1.0))), noisy(pixel(&late(b, -1.0))))).collect()
}

fn median_off(turn: &UnknownTurn, matches: &[(Vector2<f64>, Vector2<f64>)]) -> f64 {
    let mut off: Vec<f64> = matches.iter().map(|(a, b)| turn.displacement(a, b)).collect();
    off.sort_by(f64::total_cmp);
    off[off.len() / 2]
}

#[test]
fn a_turn_through_a_bent_lens_and_a_rolling_shutter_is_explained_to_its_noise() {
    for seed in 0..10 {
        let mut random = Random::new(seed);
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.03, 0.2, 0.02));
        let motion = Se3::new(turn, Vector3::zeros());
        let w = Vector3::new(0.01, 0.03, -0.01);
        let matches = seen(&mut random, Shape::Volume, motion, w);
        let found = fit_unknown_turn(&matches, MIDDLE, HALF, 0.3).expect("a turn");
        // 0.2 px in both pictures: 1.18 sqrt(2) 0.2 in the median.
        let off = median_off(&found, &matches);
        assert!(off < 0.45, "seed {seed}: {off} px");
        // A homography alone leaves more.
        let h = found.homography();
        let mut alone: Vec<f64> =
            matches.iter().map(|(a, b)| (super::super::homography::apply(&h, a) - b).norm()).collect();
        alone.sort_by(f64::total_cmp);
        assert!(alone[150] > 2.0 * off, "seed {seed}: {} px", alone[150]);
    }
}

#[test]
fn depth_and_a_step_are_not_explained_by_lens_and_shutter() {
    for seed in 0..10 {
        let mut random = Random::new(seed);
        let scene = Scene::new(&mut random, Shape::Volume, 10, 0.3);
        let matches = seen(&mut random, Shape::Volume, scene.second_from_first, Vector3::new(0.0, 0.02, 0.0));
        let found = fit_unknown_turn(&matches, MIDDLE, HALF, 0.3).expect("a fit");
        let off = median_off(&found, &matches);
        assert!(off > 2.0, "seed {seed}: {off} px");
    }
}

#[test]
fn matches_placed_badly_are_no_parallax_and_displaced_along_their_lines_they_are() {
    let mut random = Random::new(3);
    let rows = Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);
    for seed in 0..20 {
        let place = Vector2::new(random.uniform(0.0, 640.0), random.uniform(0.0, 480.0));
        let places: Vec<Vector2<f64>> = (0..100)
            .map(|_| Vector2::new(random.uniform(0.0, 640.0), random.uniform(0.0, 480.0)))
            .chain([place])
            .collect();
        let lengths: Vec<f64> = places.iter().map(|_| random.uniform(4.0, 30.0)).collect();
        let moved = |along: bool, random: &mut Random| -> Vec<(Vector2<f64>, Vector2<f64>)> {
            let angle = |random: &mut Random| if along { 0.0 } else { random.uniform(0.0, std::f64::consts::TAU) };
            places
                .iter()
                .zip(&lengths)
                .map(|(p, d)| {
                    let (s, c) = angle(random).sin_cos();
                    (*p, p + Vector2::new(c, s) * *d + Vector2::new(0.0, 0.3 * random.normal()))
                })
                .collect()
        };
        let options = RansacOptions::new(1.0);
        let badly = moved(false, &mut random);
        assert!(!shows_parallax(&rows, &badly, &lengths, 3.9, &options), "seed 3, round {seed}");
        let along = moved(true, &mut random);
        assert!(shows_parallax(&rows, &along, &lengths, 3.9, &options), "seed 3, round {seed}");
        assert!(!shows_parallax(&rows, &along, &vec![1.0; lengths.len()], 3.9, &options));
    }
}

#[test]
fn the_slopes_point_where_the_cost_falls() {
    // The gradient of the whole cost against numeric differences of it.
    let mut random = Random::new(5);
    let motion = Se3::new(UnitQuaternion::from_scaled_axis(Vector3::new(0.03, 0.2, 0.02)), Vector3::zeros());
    let unit = |x: Vector2<f64>| (x - MIDDLE) / HALF;
    let all: Vec<_> = seen(&mut random, Shape::Volume, motion, Vector3::zeros())
        .into_iter()
        .map(|(a, b)| (unit(a), unit(b)))
        .collect();
    let problem = Problem { matches: &all, loss: Loss::Cauchy(0.01), variance: 1e-6 };
    let state = Camera {
        rotation: *Rotation3::new(Vector3::new(0.02, 0.19, 0.02)).matrix(),
        log_focal: 0.4,
        lambda: -0.05,
        shutter: [Vector3::new(0.01, -0.01, 0.02), Vector3::new(-0.02, 0.01, 0.01)],
    };
    let normal = problem.linearise(&state);
    for k in 0..UNKNOWNS {
        let at = |s: f64| problem.cost(&state.moved(&Unknowns::ith(k, s)));
        let numeric = (at(1e-5) - at(-1e-5)) / 2e-5;
        let analytic = 2.0 * normal.gradient[k];
        assert!(
            (numeric - analytic).abs() < 1e-3 * (1e-3 + analytic.abs()),
            "seed 5 unknown {k}: {numeric} {analytic}"
        );
    }
}

#[test]
fn nonsense_and_few_matches_give_none_or_something_finite() {
    let nan = vec![(Vector2::new(f64::NAN, 0.0), Vector2::new(1.0, 1.0)); 50];
    assert!(fit_unknown_turn(&nan, MIDDLE, HALF, 0.3).is_none());
    assert!(fit_unknown_turn(&nan[..0], MIDDLE, HALF, 0.3).is_none());
    let same = vec![(Vector2::new(9.0, 9.0), Vector2::new(8.0, 9.0)); 50];
    if let Some(turn) = fit_unknown_turn(&same, MIDDLE, HALF, 0.3) {
        assert!(turn.homography().iter().all(|v| v.is_finite()));
    }
    let mut random = Random::new(9);
    let mut place = || Vector2::new(random.uniform(0.0, 640.0), random.uniform(0.0, 480.0));
    let chaos: Vec<_> = (0..100).map(|_| (place(), place())).collect();
    let turn = fit_unknown_turn(&chaos, MIDDLE, HALF, 0.3);
    assert!(turn.is_none_or(|t| median_off(&t, &chaos) > 20.0), "seed 9");
}
