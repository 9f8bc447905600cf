//! The adjustment against known truth, and its Schur complement against the full system.

use nalgebra::{DMatrix, Matrix2, UnitQuaternion, Vector2, Vector6};

use super::*;
use crate::geometry::Se3;
use crate::geometry::random::Random;
use crate::reconstruction::measurement::rolling_shutter::Readout;

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
        p.cameras.push(BundleCamera { camera_from_world: Se3::new(rotation, -(rotation * centre)), fixed: i < 2 });
    }
    for _ in 0..points {
        let point = Vector3::new(
            2.0 * random.uniform(-1.0, 1.0),
            1.5 * random.uniform(-1.0, 1.0),
            5.0 + 2.0 * random.uniform(-1.0, 1.0),
        );
        for c in 0..cameras {
            let q = p.cameras[c].camera_from_world.transform(&point);
            let noise = Vector2::new(random.uniform(-1.0, 1.0), random.uniform(-1.0, 1.0)) * noise_px / 500.0;
            p.observations.push(BundleObservation {
                camera: c as u32,
                normalised: Vector2::new(q.x / q.z, q.y / q.z) + noise,
                displacement: Vector2::zeros(),
                pixel_scale: Matrix2::new(500.0, 0.0, 0.0, 510.0),
                inv_sigma_px: 1.0,
            });
        }
        p.points.push(point);
        p.first.push(p.observations.len() as u32);
    }
    p
}

fn disturb(p: &mut BundleProblem, seed: u64) {
    let mut random = Random::new(seed | 1);
    for camera in p.cameras.iter_mut().filter(|c| !c.fixed) {
        let (w, v) = (vector(&mut random) * 0.02, vector(&mut random) * 0.05);
        camera.camera_from_world = camera.camera_from_world.perturb_left(&Vector6::new(w.x, w.y, w.z, v.x, v.y, v.z));
    }
    for point in &mut p.points {
        *point += vector(&mut random) * 0.1;
    }
}

#[test]
fn noiseless_problem_comes_back_to_the_truth() {
    for seed in 1..6 {
        let truth = problem(seed, 5, 60, 0.0);
        let mut p = truth.clone();
        disturb(&mut p, seed + 100);
        let options = BundleOptions { steps: [30, 30], relative_gain: 0.0, ..BundleOptions::default() };
        let report = p.adjust(&options);
        assert!(report.final_cost < 1e-12, "seed {seed}: {report:?}");
        for (a, b) in p.points.iter().zip(&truth.points) {
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
        let options = BundleOptions { steps: [30, 30], ..BundleOptions::default() };
        let mut held = p.clone();
        held.adjust(&options);
        assert_eq!((held.readout.seconds, held.readout.found_information), (0.0, 0.0));
        p.readout.expected = Some((0.0, 1e4));
        p.adjust(&options);
        let sigma = p.readout.found_information.sqrt().recip();
        let off = p.readout.seconds - truth;
        assert!(sigma < 2e-3 && off.abs() < 4.0 * sigma, "seed {seed}: {off} s off, sigma {sigma} s");
    }
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
        let truth = p.points.clone();
        disturb(&mut p, seed + 7);
        let report = p.adjust(&BundleOptions { steps: [15, 10], ..BundleOptions::default() });
        assert!(wrong.iter().all(|&k| !p.inlier[k]), "seed {seed}");
        assert!(report.outliers < wrong.len() + 5, "seed {seed}: {report:?}");
        let mean = p.points.iter().zip(&truth).map(|(a, b)| (a - b).norm()).sum::<f64>() / truth.len() as f64;
        assert!(mean < 0.03, "seed {seed}: points {mean} off");
    }
}

/// Lets the log focal length and the principal point move; `expected` and how surely, in the observations' own sigmas.
fn few(first: [f64; 3]) -> SharedVector {
    let mut v = SharedVector::zeros();
    v.rows_mut(0, 3).copy_from_slice(&first);
    v
}

fn shared(p: &BundleProblem, expected: SharedVector, information: f64) -> Shared {
    let jacobian = |o: &BundleObservation| {
        let px = Vector2::new(1.0 / o.pixel_scale.m11, 1.0 / o.pixel_scale.m22);
        let mut j = SharedJacobian::zeros();
        j.set_column(0, &-o.normalised);
        j.set_column(1, &Vector2::new(-px.x, 0.0));
        j.set_column(2, &Vector2::new(0.0, -px.y));
        let n = &o.normalised;
        j.set_column(3, &(-n * n.norm_squared()));
        j
    };
    Shared {
        jacobians: p.observations.iter().map(jacobian).collect(),
        active: WITHOUT_DISTORTION,
        change: SharedVector::zeros(),
        expected,
        information: SharedVector::from_element(information),
        found_information: SharedMatrix::zeros(),
    }
}

#[test]
fn a_wrong_focal_length_is_found_with_the_rest_and_its_sigma_is_honest() {
    let mut off = Vec::new();
    for seed in 1..40 {
        // Uniform noise of +-0.1 px.
        let mut p = problem(seed, 6, 80, 0.1);
        for o in &mut p.observations {
            o.normalised *= 1.03;
            o.inv_sigma_px = 3f64.sqrt() / 0.1;
        }
        p.shared = Some(shared(&p, SharedVector::zeros(), 1e-6));
        disturb(&mut p, seed + 3);
        p.adjust(&BundleOptions { steps: [20, 20], relative_gain: 0.0, ..BundleOptions::default() });
        let found = p.shared.as_ref().unwrap();
        let information = found.found_information.fixed_view::<3, 3>(0, 0).into_owned();
        let covariance = information.try_inverse().unwrap();
        let error = found.change[0] - 1.03f64.ln();
        assert!(error.abs() < 2e-3, "seed {seed}: {error} off");
        off.push(error * error / covariance[(0, 0)]);
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
        p.shared = Some(shared(&p, SharedVector::zeros(), 1e-6));
        p.adjust(&BundleOptions { steps: [60, 60], relative_gain: 0.0, outlier_chi2: 1e6 });
        let found = p.shared.as_ref().map_or(0.0, |s| s.change[0].exp());
        assert!((found / factor - 1.0).abs() < 0.03, "seed {seed}: {found}, true {factor}");
    }
}

#[test]
fn a_sure_prior_holds_the_focal_length() {
    let mut p = problem(5, 6, 80, 0.5);
    let expected = few([0.02, 0.0, 0.0]);
    p.shared = Some(shared(&p, expected, 1e12));
    p.adjust(&BundleOptions { steps: [20, 20], relative_gain: 0.0, ..BundleOptions::default() });
    assert!((p.shared.unwrap().change - expected).norm() < 1e-4);
}

#[test]
fn schur_complement_gives_the_step_of_the_full_system() {
    // Intrinsics fixed, without and with distortion; the readout time held and found.
    for (unknowns, readout) in [(0, 0), (WITHOUT_DISTORTION, 0), (4, 0), (0, 1), (4, 1)] {
        let intrinsics = unknowns > 0;
        let mut p = problem(3, 4, 12, 1.0);
        for (i, o) in p.observations.iter_mut().enumerate() {
            o.displacement = Vector2::new(0.3 + 0.01 * i as f64, -0.2);
        }
        if readout > 0 {
            p.readout = Readout { seconds: 0.004, expected: Some((0.01, 5e3)), ..Readout::default() };
        }
        p.inlier = vec![true; p.observations.len()];
        if intrinsics {
            let mut shared = shared(&p, few([0.01, 2.0, -1.0]), 30.0);
            (shared.active, shared.change) = (unknowns, few([0.2, 1.0, 3.0]));
            p.shared = Some(shared);
        }
        disturb(&mut p, 9);
        let slot = [FIXED, FIXED, 0, 1];
        let mut system = System::default();
        p.linearise(&slot, 2, 1e9, &mut system);
        let lambda = 1e-3;
        let step = p.solve(&slot, 2, &system, lambda).unwrap();
        // The same step from the numeric Jacobian of all parameters at once: cameras, shared, points.
        let at = step.cameras.len();
        let n = at + 36;
        let residuals = |x: &DVector<f64>| {
            let mut q = p.clone();
            for (c, s) in [(2, 0), (3, 1)] {
                let d = x.fixed_rows::<6>(6 * s).into_owned();
                q.cameras[c].camera_from_world = q.cameras[c].camera_from_world.perturb_left(&d);
            }
            for i in 0..12 {
                q.points[i] += x.fixed_rows::<3>(at + 3 * i);
            }
            let mut r = Vec::new();
            if let Some((expected, information)) = q.readout.expected {
                q.readout.seconds += x[12];
                r.push((q.readout.seconds - expected) * f64::sqrt(information));
            }
            if let Some(shared) = &mut q.shared {
                for i in 0..unknowns {
                    shared.change[i] += x[12 + readout + i];
                }
                let prior = (shared.change - shared.expected).component_mul(&shared.information.map(f64::sqrt));
                r.extend(prior.iter().take(unknowns));
            }
            for i in 0..12 {
                for k in q.range(i) {
                    let (e, _) = q.residual(&q.points[i], k).unwrap();
                    r.extend([e.x, e.y]);
                }
            }
            DVector::from_vec(r)
        };
        let r0 = residuals(&DVector::zeros(n));
        let mut j = DMatrix::zeros(r0.len(), n);
        for c in 0..n {
            let mut d = DVector::zeros(n);
            d[c] = 1e-6;
            let column = (residuals(&d) - residuals(&-&d)) / 2e-6;
            j.set_column(c, &column);
        }
        let mut h = j.transpose() * &j;
        for i in (0..12).chain(at..n) {
            h[(i, i)] += lambda * h[(i, i)];
        }
        let full = h.cholesky().unwrap().solve(&-(j.transpose() * r0));
        assert!(
            (full.rows(0, at) - step.cameras).norm() < 1e-5 * full.norm(),
            "intrinsics {unknowns}, readout {readout}"
        );
        for i in 0..12 {
            assert!((full.fixed_rows::<3>(at + 3 * i) - step.points[i]).norm() < 1e-5 * full.norm());
        }
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
