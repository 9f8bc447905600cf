//! Camera pose from three points.
//!
//! Three points (any frame) and the rays that they are seen along (undistorted, normalised) -> up to four rigid motions
//! `camera_from_world` that are exact for the three. Persson & Nordberg, Lambda Twist: an accurate fast robust
//! perspective three point (P3P) solver, ECCV 2018: the distances along the rays fulfil two quadratic forms; a cubic
//! finds a singular form in their pencil, which splits into two planes; each gives two solutions of a quadratic, and
//! Gauss-Newton steps take away the rounding. (The split of the singular form is by its adjugate instead of its
//! eigenvectors.) Cost: about 0.5 us.
//!
//! Collinear points, equal rays and numbers that are not finite give none.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::polynomial::real_roots;

/// A camera's pose: `x_camera = rotation * x_world + translation`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    pub rotation: Matrix3<f64>,
    pub translation: Vector3<f64>,
}

/// `vᵀ M w` of a symmetric form.
#[inline]
fn form(m: &Matrix3<f64>, v: &Vector3<f64>, w: &Vector3<f64>) -> f64 {
    v.dot(&(m * w))
}

/// The two planes (through the origin) that a singular quadratic form is the product of; `None` when they are complex.
fn split(d: &Matrix3<f64>) -> Option<[Vector3<f64>; 2]> {
    // -adj(D) = q qᵀ with q along the planes' common line (Richter-Gebert, Perspectives on Projective Geometry, 11.1).
    let (r0, r1, r2) = (d.row(0).transpose(), d.row(1).transpose(), d.row(2).transpose());
    let adjugate = [r1.cross(&r2), r2.cross(&r0), r0.cross(&r1)];
    let i = (0..3).max_by(|&a, &b| adjugate[a][a].abs().total_cmp(&adjugate[b][b].abs()))?;
    let square = -adjugate[i][i];
    // Written so that NaN fails.
    if !(square > 0.0) {
        return None;
    }
    let q = -adjugate[i] / square.sqrt();
    // D + [q]x has rank one: the product of the planes' normals.
    let m = d + super::epipolar::skew(&q);
    let at = m.iter().enumerate().max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))?.0;
    let (row, column) = (at % 3, at / 3);
    Some([m.row(row).transpose(), m.column(column).into_owned()])
}

/// Poses of three points, pushed to `poses`. `rays` are normalised image points (x/z, y/z).
pub fn p3p(points: &[Vector3<f64>; 3], rays: &[Vector2<f64>; 3], poses: &mut Vec<Pose>) {
    let y = rays.map(|r| r.push(1.0).normalize());
    let [x1, x2, x3] = *points;
    let (a12, a13, a23) = ((x1 - x2).norm_squared(), (x1 - x3).norm_squared(), (x2 - x3).norm_squared());
    let (b12, b13, b23) = (y[0].dot(&y[1]), y[0].dot(&y[2]), y[1].dot(&y[2]));
    // Scene of unit size, so that thresholds mean the same everywhere.
    let total = a12 + a13 + a23;
    let edges = Matrix3::from_columns(&[x1 - x2, x2 - x3, (x1 - x2).cross(&(x2 - x3))]);
    // Twice the triangle's area squared: zero for collinear points. Written so that NaN fails.
    if !(edges.column(2).norm_squared() > 1e-16 * total * total && total.is_finite()) {
        return;
    }
    let (a12, a13, a23) = (a12 / total, a13 / total, a23 / total);
    // Distances l along the rays: lᵀ M12 l = a12 and so on.
    let m12 = Matrix3::new(1.0, -b12, 0.0, -b12, 1.0, 0.0, 0.0, 0.0, 0.0);
    let m13 = Matrix3::new(1.0, 0.0, -b13, 0.0, 0.0, 0.0, -b13, 0.0, 1.0);
    let m23 = Matrix3::new(0.0, 0.0, 0.0, 0.0, 1.0, -b23, 0.0, -b23, 1.0);
    let d1 = m12 * a23 - m23 * a12;
    let d2 = m13 * a23 - m23 * a13;
    // det(D1 + g D2) = 0
    let mixed = |m: &Matrix3<f64>, n: &Matrix3<f64>| {
        let (m0, m1, m2) = (m.column(0), m.column(1), m.column(2));
        m1.cross(&m2).dot(&n.column(0)) + m2.cross(&m0).dot(&n.column(1)) + m0.cross(&m1).dot(&n.column(2))
    };
    let cubic = [d1.determinant(), mixed(&d1, &d2), mixed(&d2, &d1), d2.determinant()];
    // Any singular form with real planes holds all solutions; take the one whose planes are split most clearly.
    let roots = real_roots(&cubic);
    let planes = roots
        .as_slice()
        .iter()
        .filter_map(|g| {
            // A large g is the same form divided by it.
            let d = if g.abs() > 1.0 { d1 / *g + d2 } else { d1 + d2 * *g };
            let planes = split(&d)?;
            let clear = planes[0].cross(&planes[1]).norm() / (planes[0].norm() * planes[1].norm());
            Some((planes, clear))
        })
        .max_by(|a, b| a.1.total_cmp(&b.1));
    let Some((planes, _)) = planes else { return };
    let sum = m12 + m13 + m23;
    for n in planes {
        // l in the plane n: eliminate the distance with the largest coefficient, l = u (p + t q).
        let k = n.iamax();
        let (i, j) = ((k + 1) % 3, (k + 2) % 3);
        let (mut p, mut q) = (Vector3::zeros(), Vector3::zeros());
        (p[i], p[k]) = (1.0, -n[i] / n[k]);
        (q[j], q[k]) = (1.0, -n[j] / n[k]);
        // The form that differs most from the singular one decides; both hold.
        let quadratic = |d: &Matrix3<f64>| [form(d, &p, &p), 2.0 * form(d, &p, &q), form(d, &q, &q)];
        let size = |c: &[f64; 3]| c.iter().map(|v| v.abs()).sum::<f64>();
        let (c1, c2) = (quadratic(&d1), quadratic(&d2));
        let c = if size(&c1) > size(&c2) { c1 } else { c2 };
        for t in quadratic_roots(&c).into_iter().flatten() {
            let direction = p + q * t;
            // sum of the three equations: u² lᵀ (M12 + M13 + M23) l = 1
            let square = form(&sum, &direction, &direction);
            if !(t > 0.0 && square > 0.0) {
                continue;
            }
            let mut l = direction / square.sqrt();
            if !(refine(&mut l, [b12, b13, b23], [a12, a13, a23]) && l.min() > 0.0) {
                continue;
            }
            let l = l * total.sqrt();
            let (z1, z2, z3) = (y[0] * l.x, y[1] * l.y, y[2] * l.z);
            let moved = Matrix3::from_columns(&[z1 - z2, z2 - z3, (z1 - z2).cross(&(z2 - z3))]);
            let Some(inverse) = edges.try_inverse() else { return };
            let rotation = moved * inverse;
            let pose = Pose { rotation, translation: z1 - rotation * x1 };
            if pose.rotation.iter().chain(pose.translation.iter()).all(|v| v.is_finite()) {
                poses.push(pose);
            }
        }
    }
}

/// Real roots of `c0 + c1 t + c2 t²` without cancellation; a slightly negative discriminant is a double root.
#[inline]
fn quadratic_roots(&[c0, c1, c2]: &[f64; 3]) -> [Option<f64>; 2] {
    let discriminant = c1 * c1 - 4.0 * c0 * c2;
    let scale = c1 * c1 + (4.0 * c0 * c2).abs();
    if discriminant < -1e-12 * scale {
        return [None; 2];
    }
    let s = -0.5 * (c1 + discriminant.max(0.0).sqrt().copysign(c1));
    [(s / c2).is_finite().then_some(s / c2), (c0 / s).is_finite().then_some(c0 / s)]
}

/// Gauss-Newton on the three distance equations; false when it does not reach them.
fn refine(l: &mut Vector3<f64>, [b12, b13, b23]: [f64; 3], [a12, a13, a23]: [f64; 3]) -> bool {
    let residual = |l: &Vector3<f64>| {
        Vector3::new(
            l.x * l.x + l.y * l.y - 2.0 * b12 * l.x * l.y - a12,
            l.x * l.x + l.z * l.z - 2.0 * b13 * l.x * l.z - a13,
            l.y * l.y + l.z * l.z - 2.0 * b23 * l.y * l.z - a23,
        )
    };
    let mut r = residual(l);
    for _ in 0..6 {
        if r.amax() < 1e-15 {
            break;
        }
        let j = 2.0
            * Matrix3::new(
                l.x - b12 * l.y,
                l.y - b12 * l.x,
                0.0,
                l.x - b13 * l.z,
                0.0,
                l.z - b13 * l.x,
                0.0,
                l.y - b23 * l.z,
                l.z - b23 * l.y,
            );
        let Some(inverse) = j.try_inverse() else { break };
        let next = *l - inverse * r;
        let next_r = residual(&next);
        if !(next_r.norm_squared() < r.norm_squared()) {
            break;
        }
        (*l, r) = (next, next_r);
    }
    r.amax() < 1e-10
}

#[cfg(test)]
mod tests {
    use super::super::random::Random;
    use super::super::synthetic::random_rotation;
    use super::*;

    fn case(random: &mut Random) -> ([Vector3<f64>; 3], [Vector2<f64>; 3], Pose) {
        let rotation = *random_rotation(random, 3.0).to_rotation_matrix().matrix();
        let translation = Vector3::new(random.normal(), random.normal(), random.normal());
        let rays: [Vector2<f64>; 3] =
            std::array::from_fn(|_| Vector2::new(random.uniform(-0.6, 0.6), random.uniform(-0.5, 0.5)));
        let points = rays.map(|r| rotation.tr_mul(&(r.push(1.0) * random.uniform(1.0, 10.0) - translation)));
        (points, rays, Pose { rotation, translation })
    }

    #[test]
    fn one_of_the_poses_is_the_true_one_and_all_are_exact() {
        let mut errors = vec![];
        for seed in 0..5000 {
            let mut random = Random::new(seed);
            let (points, rays, truth) = case(&mut random);
            let mut poses = vec![];
            p3p(&points, &rays, &mut poses);
            assert!(poses.len() <= 4, "seed {seed}");
            let mut best = f64::INFINITY;
            for pose in &poses {
                for (x, r) in points.iter().zip(&rays) {
                    let p = pose.rotation * x + pose.translation;
                    // The poses of nearly collinear triangles are worse conditioned.
                    assert!((p.xy() / p.z - r).norm() < 1e-5 && p.z > 0.0, "seed {seed}: {pose:?}");
                }
                let error = (pose.rotation - truth.rotation).norm() + (pose.translation - truth.translation).norm();
                best = best.min(error);
            }
            errors.push((best, seed));
        }
        errors.sort_by(|a, b| a.0.total_cmp(&b.0));
        assert!(errors[2500].0 < 1e-12, "median {:?}", errors[2500]);
        assert!(errors[4950].0 < 1e-8, "99 % {:?}", errors[4950]);
        assert!(errors[4995].0 < 1e-4, "99.9 % {:?}", errors[4995]);
    }

    #[test]
    fn degenerate_triangles_give_none() {
        let mut random = Random::new(2);
        let (points, rays, _) = case(&mut random);
        let run = |points: &[Vector3<f64>; 3], rays: &[Vector2<f64>; 3]| {
            let mut poses = vec![];
            p3p(points, rays, &mut poses);
            poses
        };
        assert!(!run(&points, &rays).is_empty());
        assert!(run(&[points[0], points[1], (points[0] + points[1]) * 0.5], &rays).is_empty());
        assert!(run(&[points[0]; 3], &rays).is_empty());
        let nan = Vector3::new(f64::NAN, 0.0, 0.0);
        assert!(run(&[points[0], points[1], nan], &rays).is_empty());
        assert!(run(&points, &[rays[0], rays[1], Vector2::new(0.0, f64::NAN)]).is_empty());
        assert!(run(&points, &[rays[0]; 3]).is_empty());
    }
}
