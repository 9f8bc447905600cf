//! The rotation between two views that did not move apart.
//!
//! Matched undistorted normalised points -> `second_from_first` rotation, robustly. When a rotation alone explains the
//! matches, neither a translation nor a point can be had from them: the essential matrix is then arbitrary although it
//! fits every match. Minimal sample: two matches; refit: Kabsch's orthogonal fit of the rays (Acta Cryst. 1976).
//! Residual: distance in the second picture, normalised coordinates.

use nalgebra::{Matrix3, UnitQuaternion, Vector2, Vector3};

use super::point_set::{all_finite, chance_near_point};
use super::ransac::{self, Consensus, Estimator, RansacOptions, Workspace};

/// Rotation R that brings `R from[i]` nearest to `to[i]` (all unit vectors). `None` when fewer than two directions
/// differ or a number is not finite.
pub fn fit_rotation(pairs: impl Iterator<Item = (Vector3<f64>, Vector3<f64>)>) -> Option<Matrix3<f64>> {
    let mut sum = Matrix3::zeros();
    for (from, to) in pairs {
        sum += to * from.transpose();
    }
    rotation_nearest(&sum)
}

/// The rotation R that maximises `tr(Rᵀ M)`; `None` when M leaves it open (rank below two).
pub fn rotation_nearest(m: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    if !m.iter().all(|v| v.is_finite()) {
        return None;
    }
    let svd = m.try_svd(true, true, f64::EPSILON, 200)?;
    let (u, v_t) = (svd.u?, svd.v_t?);
    let s = svd.singular_values;
    if !(s[1] > 1e-12 * s[0]) {
        return None;
    }
    let sign = (u * v_t).determinant().signum();
    Some(u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t)
}

struct Problem<'a> {
    x1: &'a [Vector2<f64>],
    x2: &'a [Vector2<f64>],
}

impl Estimator for Problem<'_> {
    type Model = Matrix3<f64>;
    const SAMPLE_SIZE: usize = 2;

    fn data_count(&self) -> usize {
        self.x1.len()
    }

    fn solve_minimal(&self, sample: &[usize], models: &mut Vec<Self::Model>) {
        models.extend(self.refit(&Matrix3::identity(), sample));
    }

    #[inline]
    fn residual_squared(&self, r: &Self::Model, i: usize) -> f64 {
        let p = r * self.x1[i].push(1.0);
        if p.z <= 0.0 {
            return f64::INFINITY;
        }
        (Vector2::new(p.x / p.z, p.y / p.z) - self.x2[i]).norm_squared()
    }

    fn refit(&self, _: &Self::Model, inliers: &[usize]) -> Option<Self::Model> {
        fit_rotation(inliers.iter().map(|&i| (self.x1[i].push(1.0).normalize(), self.x2[i].push(1.0).normalize())))
    }

    fn chance(&self, threshold: f64) -> f64 {
        chance_near_point(self.x2, threshold)
    }
}

/// The rotation that most matches agree with. `workspace` holds the inliers afterwards.
pub fn estimate_rotation(
    x1: &[Vector2<f64>],
    x2: &[Vector2<f64>],
    options: &RansacOptions,
    workspace: &mut Workspace<Matrix3<f64>>,
) -> Option<Consensus<Matrix3<f64>>> {
    if x1.len() != x2.len() || !all_finite(x1) || !all_finite(x2) {
        return None;
    }
    ransac::estimate(&Problem { x1, x2 }, options, workspace)
}

/// Unit quaternion of a rotation matrix.
pub fn quaternion(r: &Matrix3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::from_rotation_matrix(&nalgebra::Rotation3::from_matrix_unchecked(*r))
}

#[cfg(test)]
mod tests {
    use super::super::random::Random;
    use super::super::synthetic::{FOCAL, Scene, Shape, random_rotation};
    use super::super::{Se3, frames};
    use super::*;

    fn turned(random: &mut Random) -> Scene {
        let rotation = random_rotation(random, 0.3);
        let motion = Se3::<frames::Second, frames::First>::new(rotation, Vector3::zeros());
        Scene::with_motion(random, Shape::Volume, 100, motion)
    }

    #[test]
    fn exact_rays_give_the_exact_rotation() {
        let mut random = Random::new(1);
        let scene = turned(&mut random);
        let found = estimate_rotation(&scene.x1, &scene.x2, &RansacOptions::new(1e-6), &mut Workspace::default())
            .expect("a rotation");
        let error = (quaternion(&found.model).inverse() * scene.second_from_first.rotation).angle();
        assert!(error < 1e-12 && found.inlier_count == 100, "{error}");
    }

    #[test]
    fn half_outliers_and_noise_leave_the_rotation() {
        for seed in 0..20 {
            let mut random = Random::new(seed);
            let scene = turned(&mut random).noise(&mut random, 0.5).outliers(&mut random, 0.5);
            let options = RansacOptions::new(2.0 / FOCAL);
            let found =
                estimate_rotation(&scene.x1, &scene.x2, &options, &mut Workspace::default()).expect("a rotation");
            let error = (quaternion(&found.model).inverse() * scene.second_from_first.rotation).angle();
            // 0.7 px / 500 / sqrt(50), and up to three times that about the optical axis.
            assert!(error < 1.5e-3, "seed {seed}: {error}");
        }
    }

    #[test]
    fn a_moving_camera_has_no_common_rotation() {
        let mut random = Random::new(4);
        let scene = Scene::new(&mut random, Shape::Volume, 100, 1.0);
        let options = RansacOptions { min_inliers: 50, ..RansacOptions::new(2.0 / FOCAL) };
        assert!(estimate_rotation(&scene.x1, &scene.x2, &options, &mut Workspace::default()).is_none());
    }

    #[test]
    fn one_direction_or_nan_gives_none() {
        let x = vec![Vector2::new(0.1, 0.2); 20];
        assert!(estimate_rotation(&x, &x, &RansacOptions::new(0.01), &mut Workspace::default()).is_none());
        let mut y = x.clone();
        y[3].x = f64::NAN;
        assert!(estimate_rotation(&x, &y, &RansacOptions::new(0.01), &mut Workspace::default()).is_none());
        assert!(rotation_nearest(&Matrix3::from_element(f64::NAN)).is_none());
    }
}
