use super::*;
use crate::geometry::random::Random;

const FOCAL_PX: f64 = 500.0;
/// A calibrated lens.
const KNOWN: f64 = 0.01;

/// Points in front of a camera of 65 degrees: at distances of 2 to 6, or all on a wall four units away.
fn seen(random: &mut Random, wall: bool) -> Vector3<f64> {
    let z = if wall { 4.0 } else { random.uniform(2.0, 6.0) };
    Vector3::new(random.uniform(-0.64, 0.64) * z, random.uniform(-0.48, 0.48) * z, z)
}

/// Tracks of a motion, with a pixel's half as noise; `stretch`: the true focal length over the supposed one.
fn pairs(random: &mut Random, n: usize, wall: bool, motion: &Se3<Second, First>, stretch: f64) -> Vec<Pair> {
    let noise = |random: &mut Random| Vector2::new(random.normal(), random.normal()) * 0.5 / FOCAL_PX;
    let mut found = Vec::new();
    while found.len() < n {
        let x = seen(random, wall);
        let p = motion.transform(&x);
        let (first, second) = (x.xy() / x.z, p.xy() / p.z);
        if p.z > 0.1 && second.x.abs() < 0.64 && second.y.abs() < 0.48 {
            let (first, second) = (first * stretch + noise(random), second * stretch + noise(random));
            found.push(Pair { first, second, scale: Matrix2::identity() * FOCAL_PX });
        }
    }
    found
}

fn turned(x: f64, y: f64, z: f64, shift: Vector3<f64>) -> Se3<Second, First> {
    Se3::new(UnitQuaternion::from_scaled_axis(Vector3::new(x, y, z)), shift)
}

fn lens(focal_sigma: f64) -> SupposedLens {
    let (centre_sigma_px, distortion_sigma) = if focal_sigma > KNOWN { (16.0, 0.1) } else { (0.1, 0.02) };
    SupposedLens { focal_px: FOCAL_PX, focal_sigma, centre_sigma_px, distortion_sigma }
}

fn found(pairs: &[Pair], focal_sigma: f64) -> Option<ViewTurn> {
    view_turn(pairs, &TurnState::none(), lens(focal_sigma), &mut Vec::new())
}

/// Error of a rotation (rad) and its squared length in standard deviations (three degrees of freedom).
fn error(turn: &ViewTurn, truth: &UnitQuaternion<f64>) -> (f64, f64) {
    let e = (truth * turn.second_from_first.inverse()).scaled_axis();
    let covariance = turn.covariance + turn.by_lens * turn.by_lens.transpose();
    let inverse = covariance.try_inverse().expect("a covariance");
    (e.norm(), e.dot(&(inverse * e)))
}

/// Largest error (rad), and mean of the squared errors in standard deviations, over some seeds.
fn errors(motion: &Se3<Second, First>, wall: bool, stretch: f64, focal_sigma: f64) -> (f64, f64) {
    const SEEDS: u64 = 20;
    let (mut largest, mut sum, mut told) = (0f64, 0.0, 0);
    for seed in 0..SEEDS {
        let mut random = Random::new(seed);
        let turn = found(&pairs(&mut random, 120, wall, motion, stretch), focal_sigma);
        // Straight on into depth, and by much, begun from no turn at all: rather nothing than something wrong.
        assert!(turn.is_some() || !wall && motion.translation.z > 0.5, "seed {seed}, {motion:?}, wall {wall}");
        let Some(turn) = turn else { continue };
        let (off, squared) = error(&turn, &motion.rotation);
        largest = largest.max(off);
        sum += squared;
        told += 1;
    }
    (largest, sum / f64::from(told.max(1)))
}

#[test]
fn the_jacobian_of_a_turn_equals_numeric_differences() {
    let state = TurnState {
        rotation: UnitQuaternion::from_scaled_axis(Vector3::new(0.1, -0.2, 0.3)),
        shift: Vector3::new(0.02, -0.03, 0.05),
        focal: 0.1,
        distortion: -0.15,
        centre: Vector2::new(0.03, -0.02),
    };
    let pair = Pair {
        first: Vector2::new(0.3, -0.2),
        second: Vector2::new(0.25, 0.1),
        scale: Matrix2::new(500.0, 3.0, -2.0, 480.0),
    };
    let problem = TurnProblem { pairs: &[pair], lens: lens(KNOWN), hidden_px: 1.0, loss: Loss::Squared };
    let (_, jacobian) = problem.residual_jacobian(&state, &pair).expect("in front");
    for i in 0..UNKNOWNS {
        let there = |h: f64| {
            let mut delta = SVector::<f64, UNKNOWNS>::zeros();
            delta[i] = h;
            problem.residual(&problem.step(&state, &delta), &pair).expect("in front")
        };
        let numeric = (there(1e-6) - there(-1e-6)) / 2e-6;
        assert!((numeric - jacobian.column(i)).norm() < 1e-5 * numeric.norm().max(1.0), "{i}: {numeric}");
    }
}

#[test]
fn a_turn_is_found_as_exactly_as_is_said() {
    for (x, y, z) in [(0.0, 0.0, 0.0), (0.02, 0.3, -0.05), (-0.2, 0.05, 0.5)] {
        let (largest, squared) = errors(&turned(x, y, z, Vector3::zeros()), false, 1.0, KNOWN);
        assert!(largest < 6e-3, "{largest} rad");
        assert!(squared < 4.0, "{squared}: three degrees of freedom");
    }
}

#[test]
fn a_motion_beside_the_turn_does_not_bend_it_by_more_than_is_said() {
    let shifts = [
        Vector3::new(0.01, 0.0, 0.0),
        Vector3::new(0.05, 0.01, 0.0),
        Vector3::new(0.3, 0.0, 0.05),
        Vector3::new(0.0, 0.0, 0.6),
    ];
    for shift in shifts {
        for wall in [false, true] {
            let (largest, squared) = errors(&turned(0.02, 0.15, 0.0, shift), wall, 1.0, KNOWN);
            assert!(largest < 0.03 && squared < 5.0, "{shift:?}, wall {wall}: {largest} rad, {squared}");
        }
    }
}

#[test]
fn a_lens_that_is_a_guess_makes_large_turns_doubtful_and_not_wrong() {
    for stretch in [0.8, 1.0, 1.25] {
        let motion = turned(0.0, 0.35, 0.0, Vector3::zeros());
        let (largest, squared) = errors(&motion, false, stretch, 0.25);
        assert!(largest < 0.1, "{stretch}: {largest} rad of 0.35");
        assert!(squared < 5.0, "{stretch}: {squared}");
        let guessed = found(&pairs(&mut Random::new(1), 120, false, &motion, stretch), 0.25).expect("a turn");
        let known = found(&pairs(&mut Random::new(1), 120, false, &motion, 1.0), KNOWN).expect("a turn");
        assert!(guessed.by_lens.norm() > known.by_lens.norm(), "{:?}", guessed.by_lens);
    }
}

#[test]
fn a_third_of_wrong_tracks_is_put_up_with_and_most_of_them_are_not() {
    let motion = turned(0.02, 0.2, 0.0, Vector3::zeros());
    for (wrong, expected) in [(36, true), (80, false)] {
        let mut random = Random::new(9);
        let mut pairs = pairs(&mut random, 120, false, &motion, 1.0);
        for pair in &mut pairs[..wrong] {
            pair.second += Vector2::new(random.uniform(-0.3, 0.3), random.uniform(-0.3, 0.3));
        }
        let turn = found(&pairs, KNOWN);
        assert_eq!(turn.is_some(), expected, "{wrong} of 120");
        if let Some(turn) = turn {
            assert!(error(&turn, &motion.rotation).0 < 5e-3, "{:?}", error(&turn, &motion.rotation));
        }
    }
}

#[test]
fn a_dozen_tracks_tell_nothing() {
    let motion = turned(0.0, 0.1, 0.0, Vector3::zeros());
    assert_eq!(found(&pairs(&mut Random::new(1), 12, false, &motion, 1.0), KNOWN), None);
}

/// Points of a room seen before and after a motion through `real`, undistorted with `supposed`.
fn seen_through(real: &CameraModel, supposed: &CameraModel, motion: &Se3<Second, First>) -> Vec<Pair> {
    let mut pairs = Vec::new();
    for i in 0..16 {
        for j in 0..12 {
            let pixel = Vector2::new(20.0 + 40.0 * f64::from(i), 20.0 + 40.0 * f64::from(j));
            let depth = 2.0 + f64::from((i * 7 + j * 5) % 11) * 0.3;
            let there = real.undistort(&pixel).and_then(|n| real.project(&motion.transform(&(n.push(1.0) * depth))));
            let Some(seen) = there.filter(|seen| real.contains(seen, 0.0)) else { continue };
            pairs.extend(supposed.undistort(&pixel).and_then(|first| Pair::of(first, &seen.cast(), supposed)));
        }
    }
    pairs
}

fn camera(focal: f64, k1: f64, centre: [f64; 2]) -> CameraModel {
    CameraModel::new(640, 480, focal, focal, centre[0], centre[1], [k1, 0.0, 0.0, 0.0, 0.0]).expect("a camera")
}

#[test]
fn a_turn_seen_through_a_wrong_lens_is_explained_and_a_translation_is_not() {
    let supposed = camera(554.0, 0.0, [319.5, 239.5]);
    let lens = SupposedLens { focal_px: 554.0, focal_sigma: 0.25, centre_sigma_px: 16.0, distortion_sigma: 0.1 };
    for view in [37f64, 60.0, 75.0, 90.0] {
        let real = camera(320.0 / (0.5 * view).to_radians().tan(), -0.12, [325.0, 236.0]);
        let left = |shift| {
            let pairs = seen_through(&real, &supposed, &turned(0.05, 0.22, 0.03, shift));
            assert!(pairs.len() > 60, "{view} degrees: {} points", pairs.len());
            unexplained_px(&pairs, lens, &mut Vec::new())
        };
        let (turned, moved) = (left(Vector3::zeros()), left(Vector3::new(0.25, 0.05, 0.1)));
        // A start is tried from 5 px on.
        assert!(turned < 2.0 && moved > 5.0, "{view} degrees: turned {turned}, moved {moved}");
    }
}

#[test]
fn a_lens_that_is_known_is_held() {
    let (real, supposed) = (camera(330.0, 0.0, [319.5, 239.5]), camera(554.0, 0.0, [319.5, 239.5]));
    let pairs = seen_through(&real, &supposed, &turned(0.05, 0.22, 0.03, Vector3::zeros()));
    let lens = SupposedLens { focal_px: 554.0, focal_sigma: 0.002, centre_sigma_px: 0.1, distortion_sigma: 0.001 };
    let left = unexplained_px(&pairs, lens, &mut Vec::new());
    assert!(left > 4.0, "{left}");
}

#[test]
fn a_known_lens_leaves_nothing_of_a_turn() {
    let lens = camera(500.0, 0.0, [320.0, 240.0]);
    let left = |shift| {
        let pairs = seen_through(&lens, &lens, &turned(0.1, -0.3, 0.2, shift));
        unexplained_px(&pairs, self::lens(KNOWN), &mut Vec::new())
    };
    assert!(left(Vector3::zeros()) < 1e-3);
    assert!(left(Vector3::new(0.3, 0.0, 0.0)) > 3.0);
}
