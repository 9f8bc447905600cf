//! Distances of matched points from epipolar geometry, shared by the essential and the fundamental matrix.
//!
//! Convention: `x2ᵀ M x1 = 0`; `M x1` is the epipolar line in the second picture, `Mᵀ x2` the one in the first. Points
//! are inhomogeneous; the unit of a distance is theirs (pixels for F, focal lengths for E).
//! Sampson's distance is the first-order distance of a match from the nearest exact one (Hartley & Zisserman,
//! eq. 11.9).

use nalgebra::{Matrix3, SMatrix, SVector, Vector2, Vector3};

use super::least_squares::{Loss, NormalEquations};

/// Gradient with respect to the nine entries of M, column by column as nalgebra stores them.
pub type Gradient9 = SVector<f64, 9>;

/// `[v]x`: `skew(v) * w = v x w`.
#[inline]
pub fn skew(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

/// `x2ᵀ M x1` and the squared length of its gradient with respect to the four coordinates.
#[inline]
fn parts(m: &Matrix3<f64>, x1: &Vector2<f64>, x2: &Vector2<f64>) -> (f64, f64) {
    let l2x = m.m11 * x1.x + m.m12 * x1.y + m.m13;
    let l2y = m.m21 * x1.x + m.m22 * x1.y + m.m23;
    let l2z = m.m31 * x1.x + m.m32 * x1.y + m.m33;
    let l1x = m.m11 * x2.x + m.m21 * x2.y + m.m31;
    let l1y = m.m12 * x2.x + m.m22 * x2.y + m.m32;
    (x2.x * l2x + x2.y * l2y + l2z, l2x * l2x + l2y * l2y + l1x * l1x + l1y * l1y)
}

/// Squared Sampson distance. NaN when both points are epipoles.
#[inline]
pub fn sampson_squared(m: &Matrix3<f64>, x1: &Vector2<f64>, x2: &Vector2<f64>) -> f64 {
    let (c, d) = parts(m, x1, x2);
    c * c / d
}

/// Squared distances of each point from its epipolar line: (in the first picture, in the second).
#[inline]
pub fn line_distances_squared(m: &Matrix3<f64>, x1: &Vector2<f64>, x2: &Vector2<f64>) -> (f64, f64) {
    let l2 = m * x1.push(1.0);
    let l1 = m.tr_mul(&x2.push(1.0));
    let c = x2.x * l2.x + x2.y * l2.y + l2.z;
    (c * c / (l1.x * l1.x + l1.y * l1.y), c * c / (l2.x * l2.x + l2.y * l2.y))
}

/// Signed Sampson distance and its derivative with respect to the entries of M.
#[inline]
pub fn sampson_gradient(m: &Matrix3<f64>, x1: &Vector2<f64>, x2: &Vector2<f64>) -> (f64, Gradient9) {
    let (p1, p2) = (x1.push(1.0), x2.push(1.0));
    let l2 = m * p1;
    let l1 = m.tr_mul(&p2);
    let c = p2.dot(&l2);
    let d = l2.x * l2.x + l2.y * l2.y + l1.x * l1.x + l1.y * l1.y;
    let inverse = 1.0 / d.sqrt();
    let r = c * inverse;
    // r = c d^(-1/2): dr = inverse dc - r / (2 d) dd, dc/dM = x2 x1ᵀ, dd/dM_ij = 2 (l2_i x1_j [i<2] + l1_j x2_i [j<2])
    let k = r * inverse * inverse;
    let mut gradient = Gradient9::zeros();
    for j in 0..3 {
        for i in 0..3 {
            let mut dd = 0.0;
            if i < 2 {
                dd += l2[i] * p1[j];
            }
            if j < 2 {
                dd += l1[j] * p2[i];
            }
            gradient[3 * j + i] = inverse * p2[i] * p1[j] - k * dd;
        }
    }
    (r, gradient)
}

/// Normal equations of robust Sampson distances with respect to the entries of M, projected onto the `N` directions in
/// which M may move (columns of `directions`: dM by parameter, column by column).
pub fn sampson_normal_equations<const N: usize>(
    m: &Matrix3<f64>,
    directions: &SMatrix<f64, 9, N>,
    matches: impl Iterator<Item = (Vector2<f64>, Vector2<f64>)>,
    loss: &Loss,
) -> NormalEquations<N> {
    let mut full = NormalEquations::<9>::default();
    for (x1, x2) in matches {
        let (r, gradient) = sampson_gradient(m, &x1, &x2);
        let (_, weight) = loss.evaluate(r * r);
        if weight > 0.0 {
            full.add(&gradient, r, weight);
        }
    }
    for c in 0..9 {
        for r in 0..c {
            full.hessian[(r, c)] = full.hessian[(c, r)];
        }
    }
    NormalEquations {
        hessian: directions.tr_mul(&(full.hessian * directions)),
        gradient: directions.tr_mul(&full.gradient),
    }
}

/// Robust cost of Sampson distances; infinite when a distance is not a number.
pub fn sampson_cost(m: &Matrix3<f64>, matches: impl Iterator<Item = (Vector2<f64>, Vector2<f64>)>, loss: &Loss) -> f64 {
    let sum: f64 = matches.map(|(x1, x2)| loss.evaluate(sampson_squared(m, &x1, &x2)).0).sum();
    if sum.is_nan() { f64::INFINITY } else { sum }
}

#[cfg(test)]
mod tests {
    use super::super::random::Random;
    use super::*;

    fn random_case(random: &mut Random) -> (Matrix3<f64>, Vector2<f64>, Vector2<f64>) {
        let m = Matrix3::from_fn(|_, _| random.normal());
        let x1 = Vector2::new(random.normal(), random.normal());
        (m, x1, Vector2::new(random.normal(), random.normal()))
    }

    #[test]
    fn sampson_gradient_equals_numeric_differences() {
        for seed in 0..50 {
            let (m, x1, x2) = random_case(&mut Random::new(seed));
            let (r, gradient) = sampson_gradient(&m, &x1, &x2);
            assert!((r * r - sampson_squared(&m, &x1, &x2)).abs() < 1e-12 * (1.0 + r * r), "seed {seed}");
            for k in 0..9 {
                let h = 1e-6;
                let (mut plus, mut minus) = (m, m);
                plus[k] += h;
                minus[k] -= h;
                let numeric = (sampson_gradient(&plus, &x1, &x2).0 - sampson_gradient(&minus, &x1, &x2).0) / (2.0 * h);
                assert!(
                    (numeric - gradient[k]).abs() < 1e-6 * (1.0 + gradient.norm().powi(3)),
                    "seed {seed} entry {k}"
                );
            }
        }
    }

    /// The nearest exact match, found by following the gradient, is as far away as Sampson's distance says.
    #[test]
    fn sampson_distance_is_the_first_order_distance_to_an_exact_match() {
        for seed in 0..50 {
            let (m, x1, x2) = random_case(&mut Random::new(seed));
            // Walk onto the surface x2ᵀ M x1 = 0 from a point close to it.
            let (mut a, mut b) = (x1, x2);
            for _ in 0..100 {
                let l2 = m * a.push(1.0);
                let l1 = m.tr_mul(&b.push(1.0));
                let c = b.push(1.0).dot(&l2);
                let d = l2.xy().norm_squared() + l1.xy().norm_squared();
                a -= l1.xy() * (c / d);
                b -= l2.xy() * (c / d);
            }
            // Off the surface again by a small known distance along its normal.
            let l2 = (m * a.push(1.0)).xy();
            let l1 = m.tr_mul(&b.push(1.0)).xy();
            let norm = (l1.norm_squared() + l2.norm_squared()).sqrt();
            let h = 1e-6;
            let distance = sampson_squared(&m, &(a + l1 * (h / norm)), &(b + l2 * (h / norm))).sqrt();
            assert!((distance / h - 1.0).abs() < 1e-3, "seed {seed}: {distance}");
        }
    }

    #[test]
    fn skew_is_the_cross_product() {
        let (v, w) = (Vector3::new(0.3, -1.2, 0.7), Vector3::new(1.1, 0.4, -0.9));
        assert!((skew(&v) * w - v.cross(&w)).norm() < 1e-16);
    }
}
