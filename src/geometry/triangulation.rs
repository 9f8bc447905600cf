//! Points from two or more views.
//!
//! - [`triangulate`]: the study's linear method, eq. 9-13: every view gives the rows `P3 x - P1` and `P3 y - P2`
//!   (eq. 9-12), each divided by its norm (eq. 13); the point X (homogeneous, unit norm) is the last column of V of the
//!   stacked matrix. Any number of views; 1 us for two.
//! - [`intersect`]: two rays in closed form, for the frame path: point, both depths and the parallax angle, 30 ns.
//!   The midpoint of the shortest segment between the rays: exact for exact matches, biased at small parallax.
//! - [`nearest_match`]: moves a noisy match onto its epipolar geometry first, which makes `intersect` the maximum
//!   likelihood point (Lindstrom, Triangulation made easy, CVPR 2010, two iterations: equal to the optimum of Hartley &
//!   Sturm to far below the noise).
//!
//! A view is a 3x4 matrix P = [R | t] (or K [R | t]: then x is in pixels). Points at infinity have X4 = 0. Not here:
//! refinement over many views, which is bundle adjustment's.

use nalgebra::{Matrix3, Matrix3x4, Vector2, Vector3, Vector4};

use super::Se3;
use super::null_space::RowTriangle;

/// Two smallest singular values closer than this ratio: the rays are the same line and the point could be anywhere.
const AMBIGUOUS: f64 = 0.99;
/// Squared sine of the angle between rays that count as parallel.
const PARALLEL: f64 = 1e-16;

/// Homogeneous point (unit norm) seen at `x[i]` by view `views[i]`. `None` for fewer than two views, numbers that are
/// not finite or a point that the views do not fix (the same view twice).
pub fn triangulate(views: &[Matrix3x4<f64>], x: &[Vector2<f64>]) -> Option<Vector4<f64>> {
    if views.len() < 2 || views.len() != x.len() {
        return None;
    }
    let mut rows = RowTriangle::<4>::default();
    for (p, x) in views.iter().zip(x) {
        for (coordinate, k) in [(x.x, 0), (x.y, 1)] {
            let row = p.row(2) * coordinate - p.row(k);
            let norm = row.norm();
            if !(norm > 0.0 && norm.is_finite()) {
                return None;
            }
            rows.push(std::array::from_fn(|c| row[c] / norm));
        }
    }
    let solution = rows.solve()?;
    // Exact data have a smallest singular value of zero; then the next one decides.
    let fixed = solution.next > 1e-12 * solution.largest && solution.smallest < AMBIGUOUS * solution.next;
    fixed.then(|| Vector4::from(solution.vector))
}

/// Euclidean point of a homogeneous one; `None` at infinity.
pub fn euclidean(x: &Vector4<f64>) -> Option<Vector3<f64>> {
    let point = x.xyz() / x.w;
    (x.w != 0.0 && point.iter().all(|v| v.is_finite())).then_some(point)
}

/// Where two rays meet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intersection {
    /// In the first camera's coordinates, in units of the baseline's.
    pub point: Vector3<f64>,
    /// Depth (z) in the first and in the second camera; negative behind it.
    pub depth1: f64,
    pub depth2: f64,
    /// Angle between the rays, radians, 0 to pi.
    pub parallax_rad: f64,
}

/// Midpoint of the rays through `x1` and `x2` (undistorted, normalised). `None` when they are parallel (no parallax)
/// or not finite. Depths may be negative: the caller decides about cheirality.
#[inline]
pub fn intersect<Second, First>(
    second_from_first: &Se3<Second, First>,
    x1: &Vector2<f64>,
    x2: &Vector2<f64>,
) -> Option<Intersection> {
    let (f1, f2) = (x1.push(1.0), x2.push(1.0));
    // d1 a + t = d2 b in the second camera; the depths are the factors because the rays have z = 1.
    let a = second_from_first.rotation * f1;
    let t = &second_from_first.translation;
    let (aa, bb, ab) = (a.norm_squared(), f2.norm_squared(), a.dot(&f2));
    let (at, bt) = (a.dot(t), f2.dot(t));
    // |a x b|² by the cross product: aa bb - ab² would cancel.
    let cross = a.cross(&f2).norm_squared();
    if !(cross > PARALLEL * aa * bb) {
        return None;
    }
    let depth1 = (ab * bt - bb * at) / cross;
    let depth2 = (aa * bt - ab * at) / cross;
    // Midpoint of the two nearest points, in the first camera.
    let other = second_from_first.rotation.inverse_transform_vector(&(f2 * depth2 - t));
    let point = (f1 * depth1 + other) * 0.5;
    let found = Intersection { point, depth1, depth2, parallax_rad: cross.sqrt().atan2(ab) };
    point.iter().all(|v| v.is_finite()).then_some(found)
}

/// The match nearest to `(x1, x2)` that fulfils `x2ᵀ E x1 = 0` (Lindstrom's niter2).
#[inline]
pub fn nearest_match(e: &Matrix3<f64>, x1: &Vector2<f64>, x2: &Vector2<f64>) -> Option<(Vector2<f64>, Vector2<f64>)> {
    let upper = e.fixed_view::<2, 2>(0, 0);
    // Gradients of the constraint by the two points.
    let mut n1 = (e.tr_mul(&x2.push(1.0))).xy();
    let mut n2 = (e * x1.push(1.0)).xy();
    let a = n2.dot(&(upper * n1));
    let b = 0.5 * (n1.norm_squared() + n2.norm_squared());
    let c = x2.push(1.0).dot(&(e * x1.push(1.0)));
    let d = (b * b - a * c).max(0.0).sqrt();
    let lambda = c / (b + d);
    let (d1, d2) = (n1 * lambda, n2 * lambda);
    n1 -= upper.tr_mul(&d2);
    n2 -= upper * d1;
    let denominator = n1.norm_squared() + n2.norm_squared();
    let lambda = lambda * 2.0 * d / denominator;
    let (y1, y2) = (x1 - n1 * lambda, x2 - n2 * lambda);
    (y1.x + y1.y + y2.x + y2.y).is_finite().then_some((y1, y2))
}

#[cfg(test)]
mod tests {
    use super::super::epipolar::skew;
    use super::super::random::Random;
    use super::super::synthetic::{FOCAL, Scene, Shape};
    use super::*;

    /// Sign of a homogeneous point's depth in a view whose left 3x3 part has a positive determinant (Hartley & Zisserman,
    /// eq. 6.15): is it in front?
    fn is_in_front(view: &Matrix3x4<f64>, x: &Vector4<f64>) -> bool {
        (view * x).z * x.w > 0.0
    }

    /// Squared distance of the projected point from where it was seen, in the unit of `seen`. `None` for a point in the
    /// camera's focal plane; the side is not checked.
    fn reprojection_squared(view: &Matrix3x4<f64>, x: &Vector4<f64>, seen: &Vector2<f64>) -> Option<f64> {
        let p = view * x;
        let error = Vector2::new(p.x / p.z, p.y / p.z) - seen;
        let squared = error.norm_squared();
        squared.is_finite().then_some(squared)
    }

    /// Angle between the rays of a match after the rotation is taken out, radians.
    fn parallax<Second, First>(second_from_first: &Se3<Second, First>, x1: &Vector2<f64>, x2: &Vector2<f64>) -> f64 {
        let a = second_from_first.rotation * x1.push(1.0);
        let b = x2.push(1.0);
        a.cross(&b).norm().atan2(a.dot(&b))
    }

    fn scene(seed: u64) -> (Random, Scene) {
        let mut random = Random::new(seed);
        let scene = Scene::new(&mut random, Shape::Volume, 40, 0.6);
        (random, scene)
    }

    #[test]
    fn eq_9_to_13_give_exact_points_from_exact_matches() {
        let (_, scene) = scene(1);
        let views = [Matrix3x4::identity(), scene.second_from_first.matrix()];
        for ((x1, x2), point) in scene.x1.iter().zip(&scene.x2).zip(&scene.points) {
            let x = triangulate(&views, &[*x1, *x2]).expect("a point");
            assert!((euclidean(&x).expect("finite") - point).norm() < 1e-10);
            assert!(views.iter().all(|p| is_in_front(p, &x)));
            assert!(reprojection_squared(&views[1], &x, x2).expect("in view") < 1e-24);
        }
    }

    /// eq. 13: dividing each row by its norm makes the answer independent of how P is scaled, K included.
    #[test]
    fn eq_13_makes_the_rows_independent_of_the_scale_of_p() {
        let (mut random, scene) = scene(2);
        let scene = scene.noise(&mut random, 1.0);
        let k = Matrix3::new(FOCAL, 0.0, 320.0, 0.0, FOCAL, 240.0, 0.0, 0.0, 1.0);
        let pixel = |x: &Vector2<f64>| (k * x.push(1.0)).xy();
        let views = [Matrix3x4::identity(), scene.second_from_first.matrix()];
        let scaled = [views[0] * 1000.0, views[1] * -0.01];
        let pixels = [k * views[0], k * views[1]];
        for (x1, x2) in scene.x1.iter().zip(&scene.x2) {
            let plain = euclidean(&triangulate(&views, &[*x1, *x2]).expect("a point")).expect("finite");
            let other = euclidean(&triangulate(&scaled, &[*x1, *x2]).expect("a point")).expect("finite");
            assert!((plain - other).norm() < 1e-9 * plain.norm());
            let in_pixels = triangulate(&pixels, &[pixel(x1), pixel(x2)]).expect("a point");
            // Another weighting of the same noise, so near but not equal.
            assert!((plain - euclidean(&in_pixels).expect("finite")).norm() < 0.2 * plain.norm());
        }
    }

    #[test]
    fn many_views_average_the_noise() {
        let (mut random, scene) = scene(3);
        let motions: Vec<Matrix3x4<f64>> = (0..20)
            .map(|i| {
                let angle = f64::from(i) * 0.3;
                let mut m = Matrix3x4::identity();
                m.set_column(3, &Vector3::new(angle.cos(), angle.sin(), 0.1 * angle));
                m
            })
            .collect();
        let (mut two, mut all) = (0.0, 0.0);
        for point in &scene.points {
            let seen: Vec<Vector2<f64>> = motions
                .iter()
                .map(|m| {
                    let p = m * point.push(1.0);
                    Vector2::new(p.x / p.z + random.normal() / FOCAL, p.y / p.z + random.normal() / FOCAL)
                })
                .collect();
            let error = |n: usize| {
                let x = triangulate(&motions[..n], &seen[..n]).expect("a point");
                (euclidean(&x).expect("finite") - point).norm()
            };
            two += error(2);
            all += error(20);
        }
        assert!(all < 0.3 * two, "seed 3: {all} and {two}");
    }

    #[test]
    fn rays_meet_in_the_point_with_its_depths_and_parallax() {
        let (_, scene) = scene(4);
        let pose = &scene.second_from_first;
        for ((x1, x2), point) in scene.x1.iter().zip(&scene.x2).zip(&scene.points) {
            let found = intersect(pose, x1, x2).expect("a point");
            assert!((found.point - point).norm() < 1e-11 * point.norm_squared());
            assert!((found.depth1 - point.z).abs() < 1e-11 * point.z * point.z);
            assert!((found.depth2 - pose.transform(point).z).abs() < 1e-11 * point.z * point.z);
            let centre = pose.inverse().translation;
            let angle = point.angle(&(point - centre));
            assert!((found.parallax_rad - angle).abs() < 1e-9 && (parallax(pose, x1, x2) - angle).abs() < 1e-9);
        }
    }

    #[test]
    fn the_nearest_match_is_the_optimum_and_its_rays_meet() {
        let (mut random, scene) = scene(5);
        let scene = scene.noise(&mut random, 1.5);
        let pose = &scene.second_from_first;
        let e = skew(&pose.translation) * pose.rotation.to_rotation_matrix().matrix();
        let view = pose.matrix();
        for (x1, x2) in scene.x1.iter().zip(&scene.x2) {
            let (y1, y2) = nearest_match(&e, x1, x2).expect("finite");
            assert!(y2.push(1.0).dot(&(e * y1.push(1.0))).abs() < 1e-9);
            let best = intersect(pose, &y1, &y2).expect("a point").point;
            let cost = |p: &Vector3<f64>| {
                let (a, b) = (p.xy() / p.z, view * p.push(1.0));
                (a - x1).norm_squared() + (Vector2::new(b.x / b.z, b.y / b.z) - x2).norm_squared()
            };
            // No point near it reprojects better.
            for k in 0..3 {
                for h in [-1e-4, 1e-4] {
                    let mut other = best;
                    other[k] += h;
                    assert!(cost(&other) >= cost(&best) * (1.0 - 1e-6), "seed 5: {best}");
                }
            }
            let middle = intersect(pose, x1, x2).expect("a point").point;
            assert!(cost(&best) <= cost(&middle) * (1.0 + 1e-9), "seed 5");
        }
    }

    #[test]
    fn points_behind_and_parallel_or_bad_rays_are_told() {
        let (_, scene) = scene(6);
        let pose = scene.second_from_first;
        let turned = Se3::<(), ()>::new(pose.rotation, -pose.translation);
        let found = intersect(&turned, &scene.x1[0], &scene.x2[0]).expect("lines meet behind both cameras");
        assert!(found.depth1 < 0.0 && found.depth2 < 0.0);
        let still = Se3::<(), ()>::identity();
        assert!(intersect(&still, &scene.x1[0], &scene.x1[0]).is_none());
        assert!(intersect(&turned, &Vector2::new(f64::NAN, 0.0), &scene.x2[0]).is_none());
        let same = [Matrix3x4::identity(), Matrix3x4::identity()];
        assert!(triangulate(&same, &[scene.x1[0], scene.x1[0]]).is_none());
        assert!(triangulate(&same[..1], &scene.x1[..1]).is_none());
        assert!(triangulate(&[same[0], turned.matrix()], &[Vector2::new(f64::NAN, 0.0), scene.x1[0]]).is_none());
        assert!(euclidean(&Vector4::new(1.0, 0.0, 0.0, 0.0)).is_none());
    }
}
