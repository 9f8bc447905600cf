//! Essential matrices from five matches of calibrated cameras.
//!
//! Five undistorted normalised matches -> up to ten E with `x2ᵀ E x1 = 0`, `det E = 0` and
//! `2 E Eᵀ E - tr(E Eᵀ) E = 0`, each of Frobenius norm sqrt(2) (singular values 1, 1, 0).
//! Nistér, An efficient solution to the five-point relative pose problem, PAMI 2004: the four-dimensional null space of
//! the epipolar constraints, `E = x X + y Y + z Z + W`, makes the ten cubic constraints a 10 x 20 system; its
//! elimination leaves a 3 x 3 matrix of polynomials in z whose determinant, of degree ten, has the solutions. Every
//! solution is then polished by Gauss-Newton steps on the ten cubics, which takes away what the determinant lost.
//! Cost: about 10 us, no allocation.
//!
//! Samples without an answer give none: repeated points, points on a line, no translation.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::null_space::null_space;
use super::polynomial::real_roots;

/// Polynomial of degree 1 in x, y, z: coefficients of [x, y, z, 1].
type Linear = [f64; 4];
/// Degree 2: [x², y², z², xy, xz, yz, x, y, z, 1].
type Quadratic = [f64; 10];
/// Degree 3, in Nistér's order:
/// [x³, y³, x²y, xy², x²z, x², y²z, y², xyz, xy, xz², xz, x, yz², yz, y, z³, z², z, 1].
type Cubic = [f64; 20];

/// Index of the monomial that a quadratic's monomial (row) times x, y, z, 1 (column) gives.
const CUBIC_INDEX: [[usize; 4]; 10] = [
    [0, 2, 4, 5],
    [3, 1, 6, 7],
    [10, 13, 16, 17],
    [2, 3, 8, 9],
    [4, 8, 10, 11],
    [8, 6, 13, 14],
    [5, 9, 11, 12],
    [9, 7, 14, 15],
    [11, 14, 17, 18],
    [12, 15, 18, 19],
];

/// A pivot below this share of the largest coefficient: the sample has no isolated solutions.
const SINGULAR: f64 = 1e-13;
/// A polished solution violates the ten cubics by no more than this (E of norm one).
const MAX_RESIDUAL: f64 = 1e-9;

#[inline(always)]
fn add_product(out: &mut Quadratic, a: &Linear, b: &Linear) {
    out[0] += a[0] * b[0];
    out[1] += a[1] * b[1];
    out[2] += a[2] * b[2];
    out[3] += a[0] * b[1] + a[1] * b[0];
    out[4] += a[0] * b[2] + a[2] * b[0];
    out[5] += a[1] * b[2] + a[2] * b[1];
    out[6] += a[0] * b[3] + a[3] * b[0];
    out[7] += a[1] * b[3] + a[3] * b[1];
    out[8] += a[2] * b[3] + a[3] * b[2];
    out[9] += a[3] * b[3];
}

#[inline(always)]
fn add_cubic(out: &mut Cubic, a: &Quadratic, b: &Linear) {
    for i in 0..10 {
        for j in 0..4 {
            out[CUBIC_INDEX[i][j]] += a[i] * b[j];
        }
    }
}

/// The ten cubic constraints on `E = x X + y Y + z Z + W`; `e[i][j]` is entry (i, j) as a polynomial.
fn constraints(e: &[[Linear; 3]; 3]) -> [Cubic; 10] {
    let mut rows = [[0.0; 20]; 10];
    // det E, along the first row.
    let minor = |a: &Linear, d: &Linear, b: &Linear, c: &Linear| {
        let mut q = [0.0; 10];
        add_product(&mut q, a, d);
        let negative: Linear = std::array::from_fn(|i| -b[i]);
        add_product(&mut q, &negative, c);
        q
    };
    add_cubic(&mut rows[0], &minor(&e[1][1], &e[2][2], &e[1][2], &e[2][1]), &e[0][0]);
    add_cubic(&mut rows[0], &minor(&e[1][2], &e[2][0], &e[1][0], &e[2][2]), &e[0][1]);
    add_cubic(&mut rows[0], &minor(&e[1][0], &e[2][1], &e[1][1], &e[2][0]), &e[0][2]);
    // L = E Eᵀ - 1/2 tr(E Eᵀ) I, then L E = 0.
    let mut l = [[[0.0; 10]; 3]; 3];
    for i in 0..3 {
        for j in i..3 {
            let mut q = [0.0; 10];
            for k in 0..3 {
                add_product(&mut q, &e[i][k], &e[j][k]);
            }
            l[i][j] = q;
            l[j][i] = q;
        }
    }
    let half_trace: Quadratic = std::array::from_fn(|i| 0.5 * (l[0][0][i] + l[1][1][i] + l[2][2][i]));
    for (i, row) in l.iter_mut().enumerate() {
        row[i].iter_mut().zip(&half_trace).for_each(|(a, b)| *a -= b);
    }
    for i in 0..3 {
        for j in 0..3 {
            for k in 0..3 {
                add_cubic(&mut rows[1 + 3 * i + j], &l[i][k], &e[k][j]);
            }
        }
    }
    rows
}

/// Gauss-Jordan on the first ten columns; only rows 4 to 9 are reduced upwards, the others are not needed.
fn eliminate(rows: &mut [Cubic; 10]) -> bool {
    for column in 0..10 {
        let mut pivot_row = column;
        for r in column + 1..10 {
            if rows[r][column].abs() > rows[pivot_row][column].abs() {
                pivot_row = r;
            }
        }
        rows.swap(column, pivot_row);
        let pivot = rows[column][column];
        // Written so that NaN fails. The null vectors are of unit length, so coefficients are about 1.
        if !(pivot.abs() > SINGULAR) {
            return false;
        }
        let inverse = 1.0 / pivot;
        for c in column..20 {
            rows[column][c] *= inverse;
        }
        let (head, tail) = rows.split_at_mut(column + 1);
        let source = &head[column];
        for row in tail {
            let factor = row[column];
            for c in column..20 {
                row[c] -= factor * source[c];
            }
        }
    }
    for column in (5..10).rev() {
        let (head, tail) = rows.split_at_mut(column);
        let source = &tail[0];
        for row in &mut head[4..] {
            let factor = row[column];
            for c in column..20 {
                row[c] -= factor * source[c];
            }
        }
    }
    true
}

/// Rows k, l, m of Nistér's B(z): `upper - z lower`; ascending coefficients of x, y (degree 3) and 1 (degree 4).
fn row_of_b(upper: &Cubic, lower: &Cubic) -> ([f64; 4], [f64; 4], [f64; 5]) {
    let (e, f) = (&upper[10..], &lower[10..]);
    (
        [e[2], e[1] - f[2], e[0] - f[1], -f[0]],
        [e[5], e[4] - f[5], e[3] - f[4], -f[3]],
        [e[9], e[8] - f[9], e[7] - f[8], e[6] - f[7], -f[6]],
    )
}

fn multiply<const A: usize, const B: usize, const C: usize>(a: &[f64; A], b: &[f64; B]) -> [f64; C] {
    let mut out = [0.0; C];
    for i in 0..A {
        for j in 0..B {
            out[i + j] += a[i] * b[j];
        }
    }
    out
}

fn subtract<const N: usize>(a: [f64; N], b: [f64; N]) -> [f64; N] {
    std::array::from_fn(|i| a[i] - b[i])
}

fn evaluate<const N: usize>(p: &[f64; N], z: f64) -> f64 {
    p.iter().rev().fold(0.0, |v, c| v * z + c)
}

/// Monomials of a cubic at (x, y, z), and their derivatives by x, y and z.
#[rustfmt::skip]
fn monomials(x: f64, y: f64, z: f64) -> [[f64; 20]; 4] {
    let (xx, yy, zz, xy, xz, yz) = (x * x, y * y, z * z, x * y, x * z, y * z);
    [
        [xx * x, yy * y, xx * y, xy * y, xx * z, xx, yy * z, yy, xy * z, xy,
         xz * z, xz, x, yz * z, yz, y, zz * z, zz, z, 1.0],
        [3.0 * xx, 0.0, 2.0 * xy, yy, 2.0 * xz, 2.0 * x, 0.0, 0.0, yz, y,
         zz, z, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 3.0 * yy, xx, 2.0 * xy, 0.0, 0.0, 2.0 * yz, 2.0 * y, xz, x,
         0.0, 0.0, 0.0, zz, z, 1.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.0, 0.0, xx, 0.0, yy, 0.0, xy, 0.0,
         2.0 * xz, x, 0.0, 2.0 * yz, y, 0.0, 3.0 * zz, 2.0 * z, 1.0, 0.0],
    ]
}

/// Gauss-Newton on the ten cubics; the residual that is left, for an E of unit norm.
fn polish(cubics: &[Cubic; 10], solution: &mut Vector3<f64>) -> f64 {
    let mut best = f64::INFINITY;
    for _ in 0..5 {
        let m = monomials(solution.x, solution.y, solution.z);
        // The cubics grow with the third power of E's norm.
        let scale = (solution.norm_squared() + 1.0).powf(-1.5);
        let mut jtj = Matrix3::zeros();
        let mut jtr = Vector3::zeros();
        let mut sum = 0.0;
        for row in cubics {
            let mut v = [0.0; 4];
            for c in 0..20 {
                for k in 0..4 {
                    v[k] += row[c] * m[k][c];
                }
            }
            let j = Vector3::new(v[1], v[2], v[3]);
            jtj += j * j.transpose();
            jtr += j * v[0];
            sum += v[0] * v[0];
        }
        let residual = sum.sqrt() * scale;
        let Some(step) = jtj.cholesky().map(|c| c.solve(&jtr)) else { return best.min(residual) };
        // Rounding, or no longer converging.
        if residual < 1e-16 || residual > 0.5 * best {
            return best.min(residual);
        }
        best = residual;
        *solution -= step;
    }
    best
}

/// Essential matrices of five matches, pushed to `solutions`. Points are undistorted and normalised.
pub fn five_point(x1: &[Vector2<f64>; 5], x2: &[Vector2<f64>; 5], solutions: &mut Vec<Matrix3<f64>>) {
    let rows: [[f64; 9]; 5] = std::array::from_fn(|i| {
        let (a, b) = (x1[i], x2[i]);
        [b.x * a.x, b.x * a.y, b.x, b.y * a.x, b.y * a.y, b.y, a.x, a.y, 1.0]
    });
    let Some(basis) = null_space::<5, 4>(&rows) else { return };
    let e: [[Linear; 3]; 3] =
        std::array::from_fn(|i| std::array::from_fn(|j| std::array::from_fn(|k| basis[k][3 * i + j])));
    let cubics = constraints(&e);
    let mut reduced = cubics;
    if !eliminate(&mut reduced) {
        return;
    }
    let (kx, ky, k1) = row_of_b(&reduced[4], &reduced[5]);
    let (lx, ly, l1) = row_of_b(&reduced[6], &reduced[7]);
    let (mx, my, m1) = row_of_b(&reduced[8], &reduced[9]);
    // det B(z), along the column of ones.
    let p1: [f64; 7] = subtract(multiply(&lx, &my), multiply(&ly, &mx));
    let p2: [f64; 7] = subtract(multiply(&ky, &mx), multiply(&kx, &my));
    let p3: [f64; 7] = subtract(multiply(&kx, &ly), multiply(&ky, &lx));
    let (d1, d2, d3): ([f64; 11], [f64; 11], [f64; 11]) = (multiply(&p1, &k1), multiply(&p2, &l1), multiply(&p3, &m1));
    let determinant: [f64; 11] = std::array::from_fn(|i| d1[i] + d2[i] + d3[i]);
    for &z in real_roots(&determinant).as_slice() {
        // (x, y, 1) is the null vector of B(z): the cross product of the two rows that differ most.
        let k = Vector3::new(evaluate(&kx, z), evaluate(&ky, z), evaluate(&k1, z));
        let l = Vector3::new(evaluate(&lx, z), evaluate(&ly, z), evaluate(&l1, z));
        let m = Vector3::new(evaluate(&mx, z), evaluate(&my, z), evaluate(&m1, z));
        let mut null = k.cross(&l);
        for other in [k.cross(&m), l.cross(&m)] {
            if other.z.abs() > null.z.abs() {
                null = other;
            }
        }
        let mut solution = Vector3::new(null.x / null.z, null.y / null.z, z);
        // Written so that NaN fails.
        if !(polish(&cubics, &mut solution) < MAX_RESIDUAL) {
            continue;
        }
        let c = [solution.x, solution.y, solution.z, 1.0];
        let entry = |i: usize| c[0] * basis[0][i] + c[1] * basis[1][i] + c[2] * basis[2][i] + c[3] * basis[3][i];
        let found = Matrix3::from_fn(|i, j| entry(3 * i + j));
        solutions.push(found * (std::f64::consts::SQRT_2 / found.norm()));
    }
}

#[cfg(test)]
mod tests {
    use super::super::epipolar::skew;
    use super::super::random::Random;
    use super::super::synthetic::{Scene, Shape, projective_distance};
    use super::super::{Se3, frames};
    use super::*;

    fn solve(scene: &Scene) -> Vec<Matrix3<f64>> {
        let mut solutions = vec![];
        let x1: [Vector2<f64>; 5] = std::array::from_fn(|i| scene.x1[i]);
        let x2: [Vector2<f64>; 5] = std::array::from_fn(|i| scene.x2[i]);
        five_point(&x1, &x2, &mut solutions);
        solutions
    }

    fn truth(scene: &Scene) -> Matrix3<f64> {
        let pose = &scene.second_from_first;
        skew(&pose.translation) * pose.rotation.to_rotation_matrix().matrix()
    }

    #[test]
    fn one_of_the_solutions_is_the_true_motion() {
        let mut errors = vec![];
        for seed in 0..1000 {
            let mut random = Random::new(seed);
            let scene = Scene::new(&mut random, Shape::Volume, 5, 0.5);
            let solutions = solve(&scene);
            // One a real root of the determinant.
            assert!(solutions.len() <= 10);
            let e = truth(&scene);
            let error = solutions.iter().map(|s| projective_distance(s, &e)).fold(f64::INFINITY, f64::min);
            errors.push((error, seed));
        }
        errors.sort_by(|a, b| a.0.total_cmp(&b.0));
        // Rounding times the condition of a random minimal sample, whose tail is heavy.
        assert!(errors[500].0 < 1e-12, "median {:?}", errors[500]);
        assert!(errors[989].0 < 1e-8, "99 %: {:?}", errors[989]);
        assert!(errors[994].0 < 1e-6, "99.5 %: {:?}", errors[994]);
    }

    #[test]
    fn every_solution_is_an_essential_matrix_of_the_sample() {
        for seed in 0..200 {
            let mut random = Random::new(seed);
            let scene = Scene::new(&mut random, Shape::Volume, 5, 0.5).noise(&mut random, 2.0);
            for e in solve(&scene) {
                for (x1, x2) in scene.x1.iter().zip(&scene.x2) {
                    assert!(x2.push(1.0).dot(&(e * x1.push(1.0))).abs() < 1e-12, "seed {seed}");
                }
                let s = e.singular_values();
                // Singular values come from the cubics, which are accurate to 1e-9.
                assert!((s[0] - 1.0).abs() < 1e-7 && (s[1] - 1.0).abs() < 1e-7 && s[2] < 1e-7, "seed {seed}: {s}");
            }
        }
    }

    #[test]
    fn a_planar_scene_has_the_true_motion_among_its_solutions() {
        for seed in 0..100 {
            let mut random = Random::new(seed);
            let scene = Scene::new(&mut random, Shape::Plane, 5, 0.8);
            let e = truth(&scene);
            let error = solve(&scene).iter().map(|s| projective_distance(s, &e)).fold(f64::INFINITY, f64::min);
            assert!(error < 1e-5, "seed {seed}: {error}");
        }
    }

    #[test]
    fn samples_without_an_answer_give_none() {
        let mut random = Random::new(9);
        let mut scene = Scene::new(&mut random, Shape::Volume, 5, 0.5);
        let good = (scene.x1.clone(), scene.x2.clone());
        // The same point twice.
        (scene.x1[4], scene.x2[4]) = (scene.x1[0], scene.x2[0]);
        assert!(solve(&scene).is_empty());
        (scene.x1, scene.x2) = good.clone();
        scene.x1[2].x = f64::NAN;
        assert!(solve(&scene).is_empty());
        // On a line in both pictures.
        for i in 0..5 {
            let s = f64::from(i as u8);
            scene.x1[i] = Vector2::new(0.1, 0.2) + Vector2::new(0.05, 0.02) * s;
            scene.x2[i] = Vector2::new(-0.1, 0.1) + Vector2::new(0.04, -0.03) * (s + 0.1 * s * s);
        }
        assert!(solve(&scene).is_empty());
        // No translation: every direction would do.
        let still = Se3::<frames::Second, frames::First>::new(
            nalgebra::UnitQuaternion::from_euler_angles(0.1, -0.05, 0.02),
            Vector3::zeros(),
        );
        for seed in 0..20 {
            let scene = Scene::with_motion(&mut Random::new(seed), Shape::Volume, 5, still);
            assert!(solve(&scene).is_empty(), "seed {seed}: {:?}", solve(&scene));
        }
    }
}
