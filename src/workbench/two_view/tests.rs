use super::*;
use crate::geometry::Se3;
use crate::geometry::frames::{First, Second};
use crate::geometry::random::Random;
use crate::geometry::synthetic::{FOCAL, Scene, Shape};
use crate::workbench::detect::Detection;
use crate::workbench::detect::{Detector, Keypoint};
use crate::workbench::guided::correlate_along_lines;
use crate::workbench::pairing::{Matcher, Matching};
use crate::workbench::report;
use nalgebra::{UnitQuaternion, Vector3};

fn options() -> Options {
    Options {
        detection: Detection { detector: Detector::Fast, scales: 1, max_corners: 500 },
        matching: Matching::new(Matcher::Descriptors),
        views: Views::Auto,
        sigma_px: 1.0,
        guided: false,
        seed: 1,
        always_answer: false,
    }
}

fn cameras() -> Cameras {
    let camera = CameraModel::new(640, 480, FOCAL, FOCAL, 320.0, 240.0, [0.0; 5]).expect("a camera");
    Cameras { a: camera.clone(), b: camera }
}

/// The matches of a scene, in pixels.
fn pairs(scene: &Scene) -> Vec<Pair> {
    let pixel = |x: &Vector2<f64>| x * FOCAL + Vector2::new(320.0, 240.0);
    scene.x1.iter().zip(&scene.x2).enumerate().map(|(i, (a, b))| Pair::given(i, pixel(a), pixel(b))).collect()
}

fn no_nan(result: &TwoView) {
    let document = report::document(result, ["a", "b"], [(640, 480); 2], &options());
    let text = serde_json::to_string(&document).expect("JSON");
    assert!(!text.contains("NaN") && document["outcome"]["name"].is_string(), "{text}");
}

#[test]
fn noise_and_outliers_leave_the_motion_and_both_rules_of_cheirality_agree() {
    for seed in 0..10 {
        let mut random = Random::new(seed);
        let scene = Scene::new(&mut random, Shape::Volume, 300, 1.0).noise(&mut random, 0.3).outliers(&mut random, 0.3);
        let result = reconstruct_from_pairs(pairs(&scene), Some(&cameras()), &options());
        assert_eq!(result.outcome, Outcome::Reconstructed, "seed {seed}");
        let steps = result.pose.as_ref().expect("a pose");
        let solution = steps.solution.as_ref().expect("a solution");
        let (rotation, direction) = scene.motion_error(&solution.second_from_first);
        assert!(rotation < 0.004 && direction < 0.03, "seed {seed}: {rotation} {direction}");
        let four = steps.five_point.as_ref().expect("five points");
        assert_eq!(four.by_one_point, Some(four.winner()), "seed {seed}: {four:?}");
        // 0.3 px in each of four coordinates: Sampson's distance has the same sigma.
        let noise = result.epipolar.as_ref().expect("F").noise_px;
        assert!((0.2..0.4).contains(&noise), "seed {seed}: {noise} px");
        assert!(solution.linear_difference < 0.05, "seed {seed}: {}", solution.linear_difference);
        no_nan(&result);
    }
}

#[test]
fn a_plane_without_a_camera_and_a_turn_with_one_are_told() {
    for seed in 0..5 {
        let mut random = Random::new(seed);
        let plane = Scene::new(&mut random, Shape::Plane, 200, 0.8).noise(&mut random, 0.3);
        let result = reconstruct_from_pairs(pairs(&plane), None, &options());
        assert!(!result.outcome.is_success(), "seed {seed}: {:?}", result.outcome);
        no_nan(&result);
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.05, 0.15, 0.02));
        let motion = Se3::<Second, First>::new(turn, Vector3::zeros());
        let turned = Scene::with_motion(&mut random, Shape::Volume, 200, motion).noise(&mut random, 0.3);
        let result = reconstruct_from_pairs(pairs(&turned), Some(&cameras()), &options());
        let Outcome::PureRotation { angle_deg: Some(angle) } = result.outcome else {
            panic!("seed {seed}: {:?}", result.outcome)
        };
        assert!((angle - turn.angle().to_degrees()).abs() < 0.2, "seed {seed}: {angle}");
        no_nan(&result);
    }
}

#[test]
fn random_few_repeated_and_wild_matches_end_in_outcomes_with_names() {
    let mut random = Random::new(11);
    let place = |random: &mut Random| Vector2::new(random.uniform(0.0, 640.0), random.uniform(0.0, 480.0));
    let chaos: Vec<Pair> = (0..200).map(|i| Pair::given(i, place(&mut random), place(&mut random))).collect();
    let same: Vec<Pair> = (0..50).map(|i| Pair::given(i, Vector2::new(9.0, 9.0), Vector2::new(8.0, 9.0))).collect();
    let mut wild = chaos.clone();
    wild[3].a.x = 1e300;
    wild[4].b.y = f64::NAN;
    let cameras = cameras();
    for camera in [None, Some(&cameras)] {
        for (name, pairs) in [("chaos", &chaos), ("few", &chaos[..5].to_vec()), ("same", &same), ("wild", &wild)] {
            let result = reconstruct_from_pairs(pairs.clone(), camera, &options());
            assert!(!result.outcome.is_success(), "{name}: {:?}", result.outcome);
            assert!(!result.outcome.sentence().is_empty());
            no_nan(&result);
        }
    }
    // Programs that always answer: a motion that is a motion, and the outcome says what it is worth.
    let answered = reconstruct_from_pairs(chaos, Some(&cameras), &Options { always_answer: true, ..options() });
    assert!(!answered.outcome.is_success());
    let solution = answered.pose.as_ref().and_then(|p| p.solution.as_ref());
    assert!(solution.expect("an answer").second_from_first.is_finite());
}

#[test]
fn guided_matches_lie_where_the_scene_puts_them() {
    // A picture of noise, and the same moved 12 px to the left: epipolar lines are rows.
    let mut random = Random::new(5);
    let (width, height, shift) = (200usize, 120usize, 12usize);
    let mut first = GreyImage::new(width, height);
    first.data.iter_mut().for_each(|p| *p = random.below(256) as u8);
    let mut second = GreyImage::new(width, height);
    for y in 0..height {
        for x in 0..width - shift {
            second.data[y * width + x] = first.at(x + shift, y);
        }
    }
    let corners = |image: &GreyImage, dx: f64| Corners {
        keypoints: (0..20)
            .map(|i| Keypoint {
                position: Vector2::new(60.0 + 4.0 * f64::from(i) - dx, 25.0 + 3.0 * f64::from(i)),
                scale: 0,
                size_px: 1.0,
                response: 1.0,
                attributes: None,
                descriptor: None,
            })
            .collect(),
        found: 20,
        scales: crate::workbench::scales::scales(image, 1),
    };
    let (a, b) = (corners(&first, 0.0), corners(&second, 12.0));
    let rows = Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);
    let found = correlate_along_lines([&a, &b], &rows, &Matching::new(Matcher::Correlation).correlation);
    assert!(found.len() >= 18, "seed 5: {} of 20", found.len());
    for pair in &found {
        assert!((pair.b - pair.a + Vector2::new(12.0, 0.0)).norm() < 0.1, "seed 5: {pair:?}");
    }
}

/// Rectangles of every size and grey, and the same seen at a slant: squeezed by `tilt` across and turned, smoothed as a lens does.
fn slanted(seed: u64, tilt: f64) -> ([GreyImage; 2], Matrix3<f64>) {
    let mut random = Random::new(seed);
    let (width, height) = (640usize, 480usize);
    let mut first = GreyImage::new(width, height);
    first.data.fill(120);
    for _ in 0..700 {
        let (w, h) = (6 + random.below(40), 6 + random.below(40));
        let (x, y, grey) = (random.below(width), random.below(height), random.below(256) as u8);
        for row in first.data.chunks_exact_mut(width).skip(y).take(h) {
            row[x..(x + w).min(width)].fill(grey);
        }
    }
    let middle = Vector2::new(319.5, 239.5);
    let turn = |degrees: f64| *nalgebra::Rotation2::new(degrees.to_radians()).matrix();
    let map = turn(15.0) * nalgebra::Matrix2::new(1.0 / tilt, 0.0, 0.0, 1.0) * turn(-35.0);
    let back = map.try_inverse().expect("invertible");
    let mut second = GreyImage::new(width, height);
    for (i, pixel) in second.data.iter_mut().enumerate() {
        let (mut sum, mut count) = (0.0, 0.0);
        for k in 0..36 {
            let off = Vector2::new(f64::from(k % 6) - 2.5, f64::from(k / 6) - 2.5) / 6.0;
            let at = middle + back * (Vector2::new((i % width) as f64, (i / width) as f64) + off - middle);
            let at = at.map(f64::round);
            if at.x >= 0.0 && at.y >= 0.0 && at.x < width as f64 && at.y < height as f64 {
                sum += f64::from(first.at(at.x as usize, at.y as usize));
                count += 1.0;
            }
        }
        *pixel = if count > 0.0 { (sum / count) as u8 } else { 120 };
    }
    let shift = middle - map * middle;
    let homography = Matrix3::new(map.m11, map.m12, shift.x, map.m21, map.m22, shift.y, 0.0, 0.0, 1.0);
    ([first, second], homography)
}

#[test]
fn a_slanted_plane_is_matched_in_tilted_views_and_each_corner_once() {
    for matcher in [Matcher::Gradients, Matcher::Descriptors] {
        let ([first, second], homography) = slanted(3, 3.2);
        let detection = Detection { detector: Detector::Fast, scales: 8, max_corners: 1000 };
        let run = |views: Views| {
            let options = Options { detection, matching: Matching::new(matcher), views, ..options() };
            reconstruct(&first, &second, None, &options)
        };
        let correct = |result: &TwoView| {
            let near = |p: &&Pair| (crate::geometry::homography::apply(&homography, &p.a) - p.b).norm() < 3.0;
            result.pairs.iter().filter(near).count()
        };
        let (plain, views, auto) = (run(Views::None), run(Views::Affine), run(Views::Auto));
        let counts = [&plain, &views, &auto].map(correct);
        assert!(counts[0] < 5 && counts[1] >= 15 && counts[2] == counts[1], "seed 3: {matcher:?} {counts:?}");
        let first_try = auto.first_try.as_ref().expect("a first try");
        assert!(!first_try.kept && first_try.matches == plain.pairs.len() && plain.first_try.is_none());
        for (i, p) in views.pairs.iter().enumerate() {
            assert!(views.pairs[..i].iter().all(|q| (p.a - q.a).norm() > 0.5), "seed 3: {p:?} twice");
        }
        no_nan(&auto);
    }
}

#[test]
fn views_of_strangers_the_same_and_black_pictures_end_in_outcomes() {
    let ([first, _], _) = slanted(4, 2.0);
    let ([other, _], _) = slanted(5, 2.0);
    let black = GreyImage::new(640, 480);
    let detection = Detection { detector: Detector::Fast, scales: 8, max_corners: 600 };
    for views in [Views::Auto, Views::Affine] {
        let options = Options { detection, views, ..options() };
        assert_eq!(reconstruct(&first, &first, None, &options).outcome, Outcome::IdenticalPictures);
        assert!(matches!(reconstruct(&first, &black, None, &options).outcome, Outcome::TooFewCorners { .. }));
        let strangers = reconstruct(&first, &other, None, &options);
        let nothing = matches!(strangers.outcome, Outcome::NoModel { .. } | Outcome::TooFewMatches { .. });
        assert!(nothing, "seeds 4 and 5: {:?}", strangers.outcome);
    }
}
