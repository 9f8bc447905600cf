//! The adjustment against known truth, and its Schur complement against the full system.

use nalgebra::{DMatrix, DVector, Matrix2, UnitQuaternion, Vector2, Vector3, Vector6};

use super::normal_equations::Step;
use super::options::LEAST_PIVOT;
use super::problem::BundleState;
use super::*;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::geometry::least_squares::{Damped, LeastSquares, Loss};
use crate::geometry::random::Random;

fn vector(random: &mut Random) -> Vector3<f64> {
    Vector3::from_fn(|_, _| random.uniform(-1.0, 1.0))
}

/// A problem at its true solution.
fn problem(seed: u64, cameras: usize, points: usize, noise_px: f64) -> BundleProblem {
    let mut random = Random::new(seed);
    let mut p = BundleProblem { first: vec![0], ..BundleProblem::default() };
    for i in 0..cameras {
        let rotation = UnitQuaternion::from_scaled_axis(vector(&mut random) * 0.1);
        let centre = Vector3::new(i as f64 * 0.3, 0.0, 0.0) + vector(&mut random) * 0.1;
        p.state.poses.push(Se3::new(rotation, -(rotation * centre)));
        p.fixed.push(i < 2);
    }
    for _ in 0..points {
        let point = Vector3::new(
            2.0 * random.uniform(-1.0, 1.0),
            1.5 * random.uniform(-1.0, 1.0),
            5.0 + 2.0 * random.uniform(-1.0, 1.0),
        );
        for c in 0..cameras {
            let q = p.state.poses[c].transform(&point);
            let noise = Vector2::new(random.uniform(-1.0, 1.0), random.uniform(-1.0, 1.0)) * noise_px / 500.0;
            p.observations.push(BundleObservation {
                camera: c as u32,
                normalised: Vector2::new(q.x / q.z, q.y / q.z) + noise,
                displacement: Vector2::zeros(),
                sqrt_information: Matrix2::new(500.0, 0.0, 0.0, 510.0),
            });
        }
        p.state.points.push(point);
        p.first.push(p.observations.len() as u32);
    }
    p
}

fn disturb(p: &mut BundleProblem, seed: u64) {
    let mut random = Random::new(seed | 1);
    for pose in p.state.poses.iter_mut().zip(&p.fixed).filter(|(_, fixed)| !**fixed).map(|(pose, _)| pose) {
        let (w, v) = (vector(&mut random) * 0.02, vector(&mut random) * 0.05);
        *pose = pose.perturb_left(&Vector6::new(w.x, w.y, w.z, v.x, v.y, v.z));
    }
    for point in &mut p.state.points {
        *point += vector(&mut random) * 0.1;
    }
}

#[test]
fn noiseless_problem_comes_back_to_the_truth() {
    for seed in 1..6 {
        let truth = problem(seed, 5, 60, 0.0);
        let mut p = truth.clone();
        disturb(&mut p, seed + 100);
        let options = BundleOptions { steps: 30, relative_gain: 0.0, ..BundleOptions::default() };
        p.adjust(&options);
        let cost = Adjustment::<1>::new(&p, Loss::Squared).cost(&p.state);
        assert!(cost < 1e-12, "seed {seed}: {cost}");
        for (a, b) in p.state.points.iter().zip(&truth.state.points) {
            assert!((a - b).norm() < 1e-6, "seed {seed}");
        }
    }
}

#[test]
fn readout_time_is_found_with_poses_and_points_and_a_held_one_stays() {
    for (seed, truth) in [(1, 0.0), (2, 0.02), (3, -0.015), (4, 0.03)] {
        let mut p = problem(seed, 6, 120, 0.5);
        let mut random = Random::new(seed + 7);
        let flows: Vec<_> =
            (0..6).map(|_| Vector2::new(random.uniform(-1.0, 1.0), random.uniform(-1.0, 1.0))).collect();
        for o in &mut p.observations {
            o.displacement = flows[o.camera as usize] * o.normalised.y;
            o.normalised += o.displacement * truth;
        }
        disturb(&mut p, seed + 100);
        let options = BundleOptions { steps: 30, ..BundleOptions::default() };
        let mut held = p.clone();
        held.adjust(&options);
        assert_eq!((held.state.globals[READOUT], held.global_covariance), (0.0, None));
        p.globals.information[READOUT] = 1e4;
        p.adjust(&options);
        let sigma = p.global_covariance.unwrap()[(READOUT, READOUT)].sqrt();
        let off = p.state.globals[READOUT] - truth;
        assert!(sigma < 2e-3 && off.abs() < 4.0 * sigma, "seed {seed}: {off} s off, sigma {sigma} s");
    }
}

#[test]
fn the_noise_of_places_is_told_whatever_was_supposed_and_beside_outliers() {
    for (seed, cameras, noise_px, supposed_px) in [(1, 3, 0.15, 0.8), (2, 3, 0.5, 0.8), (3, 6, 0.5, 0.8)] {
        let mut p = problem(seed, cameras, 400, 0.0);
        let mut random = Random::new(seed + 7);
        for (k, o) in p.observations.iter_mut().enumerate() {
            let off = Vector2::new(random.normal() / 500.0, random.normal() / 510.0) * noise_px;
            o.normalised += if k % 61 == 0 { Vector2::new(0.05, 0.02) } else { off };
            o.sqrt_information *= 1.0 / supposed_px;
        }
        p.adjust(&BundleOptions { steps: 30, ..BundleOptions::default() });
        let told = p.noise().expect("enough") * supposed_px;
        // With three cameras half of the residuals are fitted away: without that it would be 0.7 of the truth.
        assert!((told / noise_px - 1.0).abs() < 0.12, "seed {seed}: {told} px for {noise_px} px");
    }
    let mut two_views = problem(4, 2, 120, 0.5);
    two_views.adjust(&BundleOptions::default());
    assert_eq!(two_views.noise(), None, "two cameras agree about anything along their epipolar lines");
}

/// Where an edge crosses another one behind it nothing is seen that stays: its place slides, by less than any limit tells.
#[test]
fn corners_that_are_none_bend_a_map_little() {
    let (mut by_cauchy, mut by_huber) = (0.0, 0.0);
    for seed in 1..6 {
        let mut truth = problem(seed, 6, 160, 0.0);
        let mut random = Random::new(seed + 7);
        for (k, o) in truth.observations.iter_mut().enumerate() {
            let slides = if k / 6 % 8 == 0 { 0.5 * (f64::from(o.camera) - 2.5) } else { 0.0 };
            o.normalised += (Vector2::new(random.normal(), random.normal()) * 0.03 + Vector2::y() * slides) / 500.0;
            o.sqrt_information *= 1.0 / 0.8;
        }
        let off = |state: &BundleState| {
            let poses = state.poses.iter().zip(&truth.state.poses);
            poses.map(|(a, b)| (a.inverse().translation - b.inverse().translation).norm()).sum::<f64>()
        };
        let mut p = truth.clone();
        p.adjust(&BundleOptions { steps: 30, ..BundleOptions::default() });
        by_cauchy += off(&p.state);
        p = BundleProblem { inlier: vec![true; truth.observations.len()], ..truth.clone() };
        let huber = Adjustment::<1>::new(&p, Loss::Huber(CHI2_2D_95.sqrt()));
        let lm = LmOptions { max_iterations: 60, ..LmOptions::default() };
        by_huber += off(&minimise(&huber, truth.state.clone(), &lm).0);
    }
    assert!(by_cauchy < 0.75 * by_huber, "off by {by_cauchy}, by Huber's loss {by_huber}");
}

#[test]
fn outliers_are_named_and_the_rest_still_fits() {
    for seed in 1..6 {
        let mut p = problem(seed, 6, 80, 0.5);
        let mut random = Random::new(seed);
        let wrong: Vec<usize> = (0..p.observations.len()).step_by(17).collect();
        for &k in &wrong {
            p.observations[k].normalised += Vector2::new(0.1 + 0.05 * random.uniform(-1.0, 1.0), 0.1);
        }
        let truth = p.state.points.clone();
        disturb(&mut p, seed + 7);
        p.adjust(&BundleOptions { steps: 15, ..BundleOptions::default() });
        assert!(wrong.iter().all(|&k| !p.inlier[k]), "seed {seed}");
        let outliers = p.inlier.iter().filter(|ok| !**ok).count();
        assert!(outliers < wrong.len() + 5, "seed {seed}: {outliers}");
        let mean = p.state.points.iter().zip(&truth).map(|(a, b)| (a - b).norm()).sum::<f64>() / truth.len() as f64;
        assert!(mean < 0.03, "seed {seed}: points {mean} off");
    }
}

/// Lets the first `active` of the intrinsics move (log focal length, principal point, k1, ...); the information on each is in the
/// observations' own sigmas.
fn free_intrinsics(p: &mut BundleProblem, active: usize, information: f64) {
    let jacobian = |o: &BundleObservation| {
        // By the focal lengths of `problem`.
        let px = Vector2::new(1.0 / 500.0, 1.0 / 510.0);
        let mut j = IntrinsicsJacobian::zeros();
        j.set_column(0, &-o.normalised);
        j.set_column(1, &Vector2::new(-px.x, 0.0));
        j.set_column(2, &Vector2::new(0.0, -px.y));
        let n = &o.normalised;
        j.set_column(3, &(-n * n.norm_squared()));
        j
    };
    p.globals.jacobians = p.observations.iter().map(jacobian).collect();
    p.globals.information.rows_mut(1, active).fill(information);
}

#[test]
fn a_wrong_focal_length_is_found_with_the_rest_and_its_sigma_is_honest() {
    let mut off = Vec::new();
    for seed in 1..40 {
        // Uniform noise of +-0.1 px.
        let mut p = problem(seed, 6, 80, 0.1);
        for o in &mut p.observations {
            o.normalised *= 1.03;
            o.sqrt_information *= 3f64.sqrt() / 0.1;
        }
        free_intrinsics(&mut p, WITHOUT_DISTORTION, 1e-6);
        disturb(&mut p, seed + 3);
        p.adjust(&BundleOptions { steps: 20, relative_gain: 0.0, ..BundleOptions::default() });
        let error = p.state.globals[1] - 1.03f64.ln();
        assert!(error.abs() < 2e-3, "seed {seed}: {error} off");
        off.push(error * error / p.global_covariance.unwrap()[(1, 1)]);
    }
    let mean = off.iter().sum::<f64>() / off.len() as f64;
    assert!((0.6..1.6).contains(&mean), "normalised squared error {mean}, expected 1");
}

#[test]
fn a_focal_length_that_is_far_off_is_found_without_a_pull_towards_long_ones() {
    for (seed, factor) in (1..8).flat_map(|seed| [(seed, 0.6), (seed, 1.6)]) {
        let mut p = problem(seed, 6, 80, 0.3);
        for o in &mut p.observations {
            o.normalised *= factor;
        }
        free_intrinsics(&mut p, WITHOUT_DISTORTION, 1e-6);
        p.adjust(&BundleOptions { steps: 60, relative_gain: 0.0, outlier_chi2: 1e6, ..BundleOptions::default() });
        let found = p.state.globals[1].exp();
        assert!((found / factor - 1.0).abs() < 0.03, "seed {seed}: {found}, true {factor}");
    }
}

#[test]
fn a_sure_prior_holds_the_focal_length() {
    let mut p = problem(5, 6, 80, 0.5);
    free_intrinsics(&mut p, WITHOUT_DISTORTION, 1e12);
    p.globals.expected[1] = 0.02;
    p.adjust(&BundleOptions { steps: 20, relative_gain: 0.0, ..BundleOptions::default() });
    assert!((p.state.globals - p.globals.expected).norm() < 1e-4);
}

/// Four cameras of which two move, twelve points, so many targets, a floor if asked for, and of the global parameters the readout time and the first `active` intrinsics.
fn small(readout: bool, active: usize, targets: usize, floor: bool) -> BundleProblem {
    let mut p = problem(3, 4, 12, 1.0);
    add_targets(&mut p, targets, 1.0);
    if floor {
        add_floor(&mut p);
    }
    for (i, o) in p.observations.iter_mut().enumerate() {
        o.displacement = Vector2::new(0.3 + 0.01 * i as f64, -0.2);
    }
    p.state.globals[READOUT] = 0.004;
    if readout {
        (p.globals.expected[READOUT], p.globals.information[READOUT]) = (0.01, 5e3);
    }
    if active > 0 {
        free_intrinsics(&mut p, active, 30.0);
        p.globals.expected.rows_mut(1, active).fill(0.01);
        p.state.globals.fixed_rows_mut::<4>(1).copy_from_slice(&[0.2, 1.0, 3.0, 0.0]);
    }
    disturb(&mut p, 9);
    p.inliers_all()
}

/// Adds squares of the side 0.6 before the cameras, seen by all of them.
fn add_targets(p: &mut BundleProblem, targets: usize, noise_px: f64) {
    let mut random = Random::new(77);
    let cameras = p.state.poses.len();
    for target in cameras..cameras + targets {
        let turn = UnitQuaternion::from_scaled_axis(vector(&mut random) * 0.4);
        let centre = vector(&mut random) + Vector3::new(0.0, 0.0, 4.0);
        p.state.poses.push(Se3::new(turn, -(turn * centre)));
        p.fixed.push(false);
        for camera in 0..cameras {
            for (x, y) in [(-0.3, -0.3), (0.3, -0.3), (0.3, 0.3), (-0.3, 0.3)] {
                let corner = TargetCorner { target: target as u32, place: Vector3::new(x, y, 0.0) };
                let q = p.state.poses[camera].transform(&p.corner(&p.state, &corner));
                let noise = vector(&mut random).xy() * noise_px / 500.0;
                p.observations.push(BundleObservation {
                    camera: camera as u32,
                    normalised: q.xy() / q.z + noise,
                    displacement: Vector2::new(0.1, x),
                    sqrt_information: Matrix2::new(500.0, 0.0, 0.0, 510.0) * 4.0,
                });
                p.corners.push(corner);
            }
        }
    }
}

/// All of it shrinks towards its first camera.
fn shrink(p: &mut BundleProblem, factor: f64) {
    let held = p.state.poses[0].inverse().translation;
    p.state.points.iter_mut().for_each(|point| *point = held + (*point - held) * factor);
    for pose in &mut p.state.poses {
        let centre = held + (pose.inverse().translation - held) * factor;
        pose.translation = -(pose.rotation * centre);
    }
}

/// How far a point is from its truth at the most.
fn farthest(p: &BundleProblem, truth: &BundleProblem) -> f64 {
    p.state.points.iter().zip(&truth.state.points).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max)
}

#[test]
fn a_target_of_known_size_brings_a_map_of_another_scale_back_to_the_truth() {
    for seed in 1..6 {
        let mut truth = problem(seed, 5, 60, 0.0);
        add_targets(&mut truth, 1, 0.0);
        let mut p = truth.clone();
        (p.fixed[1], truth.fixed[1]) = (false, false);
        shrink(&mut p, 0.8);
        let mut without = p.clone();
        without.observations.truncate(without.observations.len() - without.corners.len());
        without.corners.clear();
        let options = BundleOptions { steps: 40, relative_gain: 0.0, ..BundleOptions::default() };
        p.adjust(&options);
        without.adjust(&options);
        let off = |p: &BundleProblem| farthest(p, &truth);
        assert!(off(&p) < 1e-5 && off(&without) > 0.5, "seed {seed}: {} off, {} without", off(&p), off(&without));
        assert!(p.inlier.iter().all(|ok| *ok), "seed {seed}");
    }
}

#[test]
fn a_corner_that_is_seen_wrong_is_named() {
    let mut p = problem(3, 5, 60, 0.3);
    add_targets(&mut p, 2, 0.1);
    let wrong = p.observations.len() - 7;
    p.observations[wrong].normalised += Vector2::new(0.02, -0.01);
    p.adjust(&BundleOptions { steps: 15, ..BundleOptions::default() });
    let seen: Vec<usize> = p.seen_corners().map(|(k, _)| k).collect();
    assert!(!p.inlier[wrong] && seen.iter().filter(|k| !p.inlier[**k]).count() < 4, "{:?}", p.inlier);
}

/// Adds a plane below the cameras, y down, on which every third point lies; the four cameras are not all at the same height above it.
fn add_floor(p: &mut BundleProblem) {
    let on_floor: Vec<bool> = (0..p.state.points.len()).map(|i| i % 3 == 0).collect();
    let around = (0..8).map(|i| Vector3::new(f64::from(i % 3) - 1.0, 2.0, 2.0 + f64::from(i)));
    let up = UnitQuaternion::rotation_between(&-Vector3::y(), &Vector3::z()).unwrap();
    p.floor = Some(HeldFloor {
        pose: p.state.poses.len() as u32,
        height: 2.0,
        height_sigma: 0.1,
        cameras: (0..4).collect(),
        up_camera: -Vector3::y_axis(),
        tilt_sigma: 0.1,
        evenness: 0.5,
        on_floor,
        around: around.collect(),
    });
    p.state.poses.push(Se3::new(up, Vector3::new(0.0, 0.0, 2.0)));
    p.fixed.push(false);
}

#[test]
fn a_camera_of_known_height_brings_a_map_of_another_scale_back_to_the_truth() {
    for seed in 1..6 {
        let mut random = Random::new(seed);
        let mut truth = problem(seed, 5, 60, 0.0);
        // Cameras at one height, upright, and half of the points on the floor.
        for pose in &mut truth.state.poses {
            let centre = Vector3::new(pose.inverse().translation.x, 0.0, random.uniform(-0.2, 0.2));
            let turn = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), random.uniform(-0.1, 0.1));
            *pose = Se3::new(turn, -(turn * centre));
        }
        truth.state.points.iter_mut().step_by(2).for_each(|point| point.y = 1.5);
        for i in 0..truth.state.points.len() {
            for k in truth.range(i) {
                let q = truth.state.poses[truth.observations[k].camera as usize].transform(&truth.state.points[i]);
                truth.observations[k].normalised = q.xy() / q.z;
            }
        }
        (truth.fixed[1], truth.fixed[0]) = (false, true);
        let up = UnitQuaternion::rotation_between(&-Vector3::y(), &Vector3::z()).unwrap();
        let mut p = truth.clone();
        shrink(&mut p, 0.9);
        let mut without = p.clone();
        p.floor = Some(HeldFloor {
            pose: 5,
            height: 1.5,
            height_sigma: 0.03,
            cameras: (0..5).collect(),
            up_camera: -Vector3::y_axis(),
            tilt_sigma: 0.01,
            evenness: 0.02,
            on_floor: (0..60).map(|i| i % 2 == 0).collect(),
            around: Vec::new(),
        });
        p.state.poses.push(Se3::new(up, Vector3::new(0.0, 0.0, 1.35)));
        p.fixed.push(false);
        let options = BundleOptions { steps: 60, relative_gain: 0.0, ..BundleOptions::default() };
        p.adjust(&options);
        without.adjust(&options);
        let off = |p: &BundleProblem| farthest(p, &truth);
        assert!(off(&p) < 1e-4 && off(&without) > 0.3, "seed {seed}: {} off, {} without", off(&p), off(&without));
    }
}

/// What the floor adds, each times the root of its weight at the problem's own state.
fn floor_residuals(p: &BundleProblem, state: &BundleState) -> Vec<f64> {
    let Some(held) = &p.floor else { return Vec::new() };
    let rotation = |pose: &Se3<Camera, World>| *pose.rotation.to_rotation_matrix().matrix();
    let at = |state: &BundleState| {
        let floor = &state.poses[held.pose as usize];
        let turn = rotation(floor);
        let on = state.points.iter().zip(&held.on_floor).filter(|(_, on)| **on).map(|(point, _)| point);
        let of_points = on.chain(&held.around).map(|point| held.point_term(floor, &turn, point));
        let mut all: Vec<([f64; 2], f64)> = of_points.map(|term| (term.residual.map(|r| r.x), term.weight)).collect();
        for camera in held.cameras.iter().map(|camera| &state.poses[*camera as usize]) {
            let pair = ((floor, &turn), (camera, &rotation(camera)));
            let terms = [held.camera_term(pair.0, pair.1), held.tilt_term(pair.0, pair.1)];
            all.extend(terms.map(|term| (term.residual.map(|r| r.x), term.weight)));
        }
        all
    };
    let weighted =
        |((residual, _), (_, weight)): (([f64; 2], f64), ([f64; 2], f64))| residual.map(|r| r * weight.sqrt());
    at(state).into_iter().zip(at(&p.state)).flat_map(weighted).collect()
}

/// All unknowns as one vector: those of the free poses, the global parameters, 36 of the points. Residuals, those of the priors last, and
/// their numeric Jacobian.
fn dense<const W: usize>(p: &BundleProblem) -> (DVector<f64>, DMatrix<f64>) {
    let poses = 6 * p.fixed.iter().filter(|fixed| !**fixed).count();
    let n = poses + W + 36;
    let adjustment = Adjustment::<W>::new(p, Loss::Squared);
    let residuals = |x: &DVector<f64>| {
        let points = (0..12).map(|i| x.fixed_rows::<3>(poses + W + 3 * i).into_owned()).collect();
        let state = adjustment.step(&p.state, &Step { reduced: x.rows(0, poses + W).into_owned(), points });
        let points = &state.points;
        let observed = (0..12).flat_map(|i| p.range(i).map(move |k| (k, points[i])));
        let corners = p.seen_corners().map(|(k, corner)| (k, p.corner(&state, corner)));
        let mut r: Vec<f64> = Vec::new();
        for (k, point) in observed.chain(corners) {
            r.extend(p.residual(&state, &point, k).unwrap().0.iter());
        }
        r.extend(floor_residuals(p, &state));
        for i in (0..W).filter(|&i| !p.globals.is_held(i)) {
            r.push((state.globals[i] - p.globals.expected[i]) * p.globals.information[i].sqrt());
        }
        DVector::from_vec(r)
    };
    let r0 = residuals(&DVector::zeros(n));
    let mut j = DMatrix::zeros(r0.len(), n);
    for c in (0..n).filter(|c| !(poses..poses + W).contains(c) || !p.globals.is_held(c - poses)) {
        let mut d = DVector::zeros(n);
        d[c] = 1e-6;
        let column: DVector<f64> = (residuals(&d) - residuals(&-&d)) / 2e-6;
        // What moves nothing but rounding moves nothing.
        if column.norm() > 1e-6 {
            j.set_column(c, &column);
        }
    }
    (r0, j)
}

/// The problem by elimination against the full system from a numeric Jacobian of all unknowns at once.
fn compare_with_the_full_system<const W: usize>(p: &BundleProblem) {
    let adjustment = Adjustment::<W>::new(p, Loss::Squared);
    let system = adjustment.linearise(&p.state);
    let lambda = 1e-3;
    let (step, predicted) = system.solve(lambda).unwrap();
    let (r0, j) = dense::<W>(p);
    let (poses, at) = (j.ncols() - W - 36, j.ncols() - 36);
    let mut h = j.transpose() * &j;
    for i in (poses..at).filter(|i| p.globals.is_held(i - poses)) {
        h[(i, i)] = 1.0;
    }
    // Nothing tells where on the floor its own axes are, nor how they are turned about its normal.
    h += DMatrix::identity(h.nrows(), h.ncols()) * LEAST_PIVOT;
    let undamped = h.clone();
    for i in (0..poses).chain(at..h.nrows()) {
        h[(i, i)] *= 1.0 + lambda;
    }
    let full = h.cholesky().unwrap().solve(&-(j.transpose() * &r0));
    let gain = r0.norm_squared() - (&r0 + &j * &full).norm_squared();
    assert!((predicted / gain - 1.0).abs() < 1e-4, "{predicted} for {gain}");
    let close = 1e-5 * full.norm();
    assert!((full.rows(0, at) - &step.reduced).norm() < close, "{:?}", p.globals.information);
    for i in 0..12 {
        assert!((full.fixed_rows::<3>(at + 3 * i) - step.points[i]).norm() < close);
    }
    // The last columns' covariance, all others free; what is held is not told.
    let (all, found) = (undamped.try_inverse().unwrap(), system.global_covariance().unwrap());
    for i in (0..W).filter(|&i| !p.globals.is_held(i)) {
        let expected = all[(poses + i, poses + i)];
        assert!((found[(i, i)] / expected - 1.0).abs() < 1e-4, "parameter {i}: {} for {expected}", found[(i, i)]);
    }
}

#[test]
fn elimination_gives_step_and_covariance_of_the_full_system_from_numeric_jacobians() {
    for (readout, targets, floor) in
        [(false, 0, false), (true, 0, false), (false, 1, false), (true, 2, false), (false, 0, true), (true, 1, true)]
    {
        compare_with_the_full_system::<1>(&small(readout, 0, targets, floor));
        // Without and with distortion.
        compare_with_the_full_system::<GLOBALS>(&small(readout, WITHOUT_DISTORTION, targets, floor));
        compare_with_the_full_system::<GLOBALS>(&small(readout, 4, targets, floor));
    }
}

#[test]
fn direction_of_a_motion_is_the_surer_the_more_points_there_are() {
    let sigma = |points| problem(4, 3, points, 0.0).inliers_all().direction_sigma(2).unwrap();
    let (few, many) = (sigma(20), sigma(80));
    assert!(many < 0.7 * few && few < 0.1, "{few} with 20 points, {many} with 80");
    // A camera that is held has no uncertainty to tell.
    assert!(problem(4, 3, 20, 0.0).inliers_all().direction_sigma(0).is_none());
}

impl BundleProblem {
    fn inliers_all(mut self) -> Self {
        self.inlier = vec![true; self.observations.len()];
        self
    }
}
