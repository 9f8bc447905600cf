//! The epipolar geometry of a pair's matches: one F, with the noise that its inliers show.
//!
//! Input: the matches as undistorted pixels, or as the pictures' own where no camera is known. Output: [`Epipolar`], F with `x_Bᵀ F x_A = 0`
//! in those pixels. Without cameras, F is that of one camera (eq. 6's assumption) with its centre in the middle wherever the matches do
//! not speak against it.
//! Matches are placed to between a tenth of a pixel and several, by the scale they were found at and whether they could be polished: the search
//! takes no noise for known ([`crate::geometry::ransac::Cost`]).
//!
//! Cost: that of the robust loop (`geometry::fundamental`), 10 to 300 ms by the share of outliers.

use nalgebra::{Matrix3, Vector2};

use super::result::{Epipolar, MIN_MATCHES, Options, TwoView};
use super::turn::turn_of_unknown_camera;
use crate::geometry::epipolar::{sampson_cost, sampson_squared};
use crate::geometry::fundamental::{Degeneracy, estimate_fundamental, refine_fundamental};
use crate::geometry::least_squares::{LmOptions, Loss};
use crate::geometry::one_camera::one_camera_fundamental;
use crate::geometry::point_set::Conditioning;
use crate::geometry::ransac::RansacOptions;
use crate::workbench::detect::Corners;
use crate::workbench::pose::{INLIER_SIGMAS, LINE_SIGMAS, MIN_NOISE_PX, median, noise};

/// 95 % point of chi-square with two degrees of freedom.
const CHI2_TWO: f64 = 5.99;

/// Least threshold of an inlier, as a share of the largest: matches of fine scales that were laid onto each other are several times as exact as
/// those of coarse scales that were not, and a few exact ones say more of F than many that are near many F.
const LEAST_SHARE: f64 = 0.3;
/// Samples of one search: several F are about as good at first, and it is the refined ones that must be compared.
const SEARCH_ITERATIONS: usize = 100;

/// Share of the free F's inliers that the F of one camera must have.
const KEPT_INLIERS: f64 = 0.95;

/// F of the matches in `ideal` pixels. The search runs with the noise that was asked for; the last refinement with the noise
/// that the inliers show, so that what is a little off does not pull on what is exact.
pub(super) fn epipolar(out: &TwoView, options: &Options) -> Option<Epipolar> {
    let (u1, u2): (Vec<_>, Vec<_>) = out.ideal.iter().map(|[a, b]| (*a, *b)).unzip();
    let threshold = LINE_SIGMAS * options.sigma_px;
    let ransac = RansacOptions {
        seed: options.seed,
        least_share: LEAST_SHARE,
        search_iterations: SEARCH_ITERATIONS,
        ..RansacOptions::thorough(threshold)
    };
    let mut estimate = estimate_fundamental(&u1, &u2, &ransac)?;
    let distances =
        |f: &Matrix3<f64>| -> Vec<f64> { u1.iter().zip(&u2).map(|(a, b)| sampson_squared(f, a, b).sqrt()).collect() };
    let mut residuals_px = distances(&estimate.fundamental);
    let mut noise_px = noise(residuals_px.iter().zip(&estimate.inliers).filter(|(_, i)| **i).map(|(r, _)| *r));
    // Where not all places are exact, those that are still count most, as they did in the search.
    let loss_px = |sigma_px: f64| (2.0 * sigma_px).min(LEAST_SHARE * threshold);
    for _ in 0..2 {
        let sigma = noise_px.clamp(MIN_NOISE_PX, options.sigma_px);
        let Some(better) = refined(&estimate.fundamental, &u1, &u2, &residuals_px, sigma, loss_px(sigma)) else {
            break;
        };
        let limit = threshold.min(INLIER_SIGMAS * sigma);
        let moved = distances(&better);
        let inliers: Vec<bool> = moved.iter().map(|r| *r <= limit).collect();
        let count = inliers.iter().filter(|i| **i).count();
        // A refinement that loses what the search had found went astray.
        if 2 * count < estimate.inlier_count {
            break;
        }
        noise_px = noise(moved.iter().zip(&inliers).filter(|(_, i)| **i).map(|(r, _)| *r));
        (estimate.fundamental, estimate.inliers, estimate.inlier_count) = (better, inliers, count);
        residuals_px = moved;
    }
    let middle = one_cameras_middle(out);
    if let (Some(middle), false) = (middle, matches!(estimate.degeneracy, Degeneracy::PureRotation { .. })) {
        let limit_px = threshold.min(INLIER_SIGMAS * noise_px.clamp(MIN_NOISE_PX, options.sigma_px));
        if let Some((homography, on_plane)) =
            turn_of_unknown_camera(out, &estimate, middle, (noise_px, limit_px), options)
        {
            estimate.degeneracy = Degeneracy::PureRotation { homography, on_plane };
        }
    }
    let one_camera = match (middle, estimate.degeneracy) {
        (Some(_), Degeneracy::Plane { .. } | Degeneracy::PureRotation { .. }) | (None, _) => None,
        (Some(middle), _) => {
            one_camera(&estimate.fundamental, middle, &u1, &u2, noise_px.clamp(MIN_NOISE_PX, options.sigma_px))
        }
    };
    let mut is_one_camera = false;
    if let Some(f) = one_camera {
        let moved = distances(&f);
        let limit = threshold.min(INLIER_SIGMAS * noise_px.clamp(MIN_NOISE_PX, options.sigma_px));
        let inliers: Vec<bool> = moved.iter().map(|r| *r <= limit).collect();
        let count = inliers.iter().filter(|i| **i).count();
        // The same matches must stand for it: the costs that were compared are a sum, which a few matches hide in. Within the same limit:
        // that of `estimate` may be an earlier, wider one.
        let of_free = residuals_px.iter().filter(|r| **r <= limit).count();
        is_one_camera = count as f64 >= KEPT_INLIERS * of_free as f64;
        if is_one_camera {
            noise_px = noise(moved.iter().zip(&inliers).filter(|(_, i)| **i).map(|(r, _)| *r));
            (estimate.fundamental, estimate.inliers, estimate.inlier_count) = (f, inliers, count);
            residuals_px = moved;
        }
    }
    let mut of_inliers: Vec<f64> =
        residuals_px.iter().zip(&estimate.inliers).filter(|(_, i)| **i).map(|(r, _)| *r).collect();
    let median_px = median(&mut of_inliers);
    Some(Epipolar { median_px, noise_px, estimate, residuals_px, one_camera: is_one_camera })
}

/// The middle of two pictures that one camera may have taken: of the same size, and without cameras that say otherwise.
fn one_cameras_middle(out: &TwoView) -> Option<Vector2<f64>> {
    let size = |c: &Corners| c.scales.first().map(|s| (s.image.width, s.image.height));
    let (first, second) = (size(&out.corners[0])?, size(&out.corners[1])?);
    let middle = |n: usize| 0.5 * (n as f64 - 1.0);
    (!out.undistorted && first == second).then(|| Vector2::new(middle(first.0), middle(first.1)))
}

/// The F of one camera ([`one_camera_fundamental`]), where it explains the matches no worse than `free` does: by a difference of chi-square
/// that the two numbers it is held by (the seventh of F, and a focal length as cameras have) often make of noise alone, and by what no lens
/// and no matching is better than.
fn one_camera(
    free: &Matrix3<f64>,
    middle: Vector2<f64>,
    u1: &[Vector2<f64>],
    u2: &[Vector2<f64>],
    sigma_px: f64,
) -> Option<Matrix3<f64>> {
    let scale = 1.0 / middle.amax();
    // Pixels less the middle, over half the longer side.
    let to_unit = Matrix3::new(scale, 0.0, -scale * middle.x, 0.0, scale, -scale * middle.y, 0.0, 0.0, 1.0);
    let from_unit = to_unit.try_inverse()?;
    let near: Vec<(Vector2<f64>, Vector2<f64>)> = u1
        .iter()
        .zip(u2)
        .filter(|(a, b)| sampson_squared(free, a, b).sqrt() <= INLIER_SIGMAS * sigma_px)
        .map(|(a, b)| ((a - middle) * scale, (b - middle) * scale))
        .collect();
    if near.len() < MIN_MATCHES {
        return None;
    }
    let loss = Loss::Cauchy(2.0 * sigma_px * scale);
    let start = from_unit.transpose() * free * from_unit;
    let (with_belief, found) =
        one_camera_fundamental(&start, near.iter().copied(), loss, sigma_px * scale, &LmOptions::default())?;
    let cost = |f: &Matrix3<f64>| sampson_cost(f, near.iter().copied(), &loss);
    // In squared pixels: what noise makes of it, and what all matches of a part of the picture may be wrong by together.
    let lost = (with_belief - cost(&start)) / (scale * scale);
    let allowed = CHI2_TWO * sigma_px * sigma_px + near.len() as f64 * MIN_NOISE_PX * MIN_NOISE_PX;
    let f = to_unit.transpose() * found * to_unit;
    let norm = f.norm();
    (lost <= allowed && norm > 0.0 && norm.is_finite()).then(|| f / norm)
}

/// F of least distance over what is within three sigma of `start`.
fn refined(
    start: &Matrix3<f64>,
    u1: &[Vector2<f64>],
    u2: &[Vector2<f64>],
    residuals_px: &[f64],
    sigma_px: f64,
    loss_px: f64,
) -> Option<Matrix3<f64>> {
    let conditioning = Conditioning::of(u1, u2)?;
    let (to_first, to_second) = (conditioning.matrix1(), conditioning.matrix2());
    let conditioned = to_second.try_inverse()?.transpose() * start * to_first.try_inverse()?;
    let near: Vec<(Vector2<f64>, Vector2<f64>)> = (0..u1.len())
        .filter(|i| residuals_px[*i] <= INLIER_SIGMAS * sigma_px)
        .map(|i| (conditioning.first(&u1[i]), conditioning.second(&u2[i])))
        .collect();
    if near.len() < MIN_MATCHES {
        return None;
    }
    let loss = Loss::Cauchy(loss_px * conditioning.scale);
    let better = refine_fundamental(&conditioned, near.iter().copied(), loss, &LmOptions::default())?;
    let f = to_second.transpose() * better * to_first;
    let norm = f.norm();
    (norm > 0.0 && norm.is_finite()).then(|| f / norm)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::random::Random;
    use crate::geometry::synthetic::{FOCAL, Scene, Shape};

    const MIDDLE: Vector2<f64> = Vector2::new(319.5, 239.5);
    const SIGMA_PX: f64 = 0.2;

    /// What [`one_camera`] makes of a scene whose second camera has `focal` and its principal point `off` the middle: the median Sampson
    /// distance that is left, pixels, or nothing where it was refused.
    fn judged(seed: u64, focal: f64, off: Vector2<f64>) -> Option<f64> {
        let mut random = Random::new(seed);
        let scene = Scene::new(&mut random, Shape::Volume, 200, 0.8);
        let mut noisy = |x: Vector2<f64>| x + Vector2::new(random.normal(), random.normal()) * SIGMA_PX;
        let u1: Vec<_> = scene.x1.iter().map(|x| noisy(x * FOCAL + MIDDLE)).collect();
        let u2: Vec<_> = scene.x2.iter().map(|x| noisy(x * focal + MIDDLE + off)).collect();
        let options = RansacOptions { seed, ..RansacOptions::new(INLIER_SIGMAS * SIGMA_PX) };
        let start = estimate_fundamental(&u1, &u2, &options).expect("F").fundamental;
        let far = vec![0.0; u1.len()];
        let free = refined(&start, &u1, &u2, &far, SIGMA_PX, 2.0 * SIGMA_PX).expect("F of least distance");
        let f = one_camera(&free, MIDDLE, &u1, &u2, SIGMA_PX)?;
        let mut distances: Vec<f64> = u1.iter().zip(&u2).map(|(a, b)| sampson_squared(&f, a, b).sqrt()).collect();
        Some(median(&mut distances))
    }

    #[test]
    fn the_f_of_one_camera_is_taken_where_one_camera_saw_both() {
        for seed in 0..10 {
            // A true F leaves 0.6745 sigma in the median.
            let left = judged(seed, FOCAL, Vector2::zeros());
            assert!(left.is_some_and(|px| px < 0.85 * SIGMA_PX), "seed {seed}: {left:?}");
        }
    }

    #[test]
    fn the_f_of_one_camera_is_refused_where_another_camera_saw_the_second_picture() {
        // Seven numbers of one F and six of the other: now and then the one that is too many fits by chance, and then nothing is lost.
        let left: Vec<Option<f64>> = (0..10).map(|seed| judged(seed, 1.4 * FOCAL, Vector2::new(90.0, -60.0))).collect();
        assert!(left.iter().filter(|l| l.is_none()).count() >= 8, "seeds 0 to 9: {left:?}");
        assert!(left.iter().flatten().all(|px| *px < 0.85 * SIGMA_PX), "seeds 0 to 9: {left:?}");
    }
}
