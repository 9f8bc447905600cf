//! Null spaces of the small homogeneous systems of two-view geometry, without heap allocation.
//!
//! - [`null_space`]: M < 9 equations in nine unknowns -> orthonormal basis of the 9 - M dimensional null space, by
//!   Householder reflections on the transposed system. Backward stable; about 0.3 us.
//! - [`RowTriangle`]: any number of equations in N unknowns -> the unit vector with the smallest residual. The rows are
//!   reduced to a triangle by Householder reflections a block at a time, the triangle by one-sided Jacobi rotations
//!   (Demmel & Veselic 1992), which keep small singular values and their vectors accurate where a bidiagonal QR
//!   iteration or `AᵀA` loses them: the null spaces of F, H and poor triangulations are nearly degenerate.
//!   About 160 flops a row and 10 us for the triangle (N = 9).

/// One equation counts as a combination of the ones before it when less than this share of it is independent.
const DEPENDENT: f64 = 1e-11;
/// Jacobi sweeps; 6 to 8 are usual.
const MAX_SWEEPS: usize = 40;
/// Rows that [`RowTriangle`] collects before it reduces them.
const BLOCK: usize = 16;

/// Orthonormal basis of the null space of `rows`; `M + K` must be 9. `None` when the rows are linearly dependent (the
/// null space is larger) or not finite.
#[inline]
pub fn null_space<const M: usize, const K: usize>(rows: &[[f64; 9]; M]) -> Option<[[f64; 9]; K]> {
    const { assert!(M + K == 9, "as many unknowns as equations and null vectors") };
    let mut a = *rows;
    let mut beta = [0.0; M];
    for k in 0..M {
        let total: f64 = rows[k].iter().map(|v| v * v).sum();
        let tail: f64 = a[k][k..].iter().map(|v| v * v).sum();
        // Written so that NaN fails.
        if !(tail > DEPENDENT * DEPENDENT * total && total.is_finite()) {
            return None;
        }
        let norm = tail.sqrt();
        let pivot = a[k][k];
        a[k][k] = pivot + norm.copysign(pivot);
        beta[k] = 1.0 / (norm * (norm + pivot.abs()));
        let (reflector, rest) = a.split_at_mut(k + 1);
        for row in rest {
            reflect(&reflector[k], beta[k], k, row);
        }
    }
    let mut basis = [[0.0; 9]; K];
    for (i, vector) in basis.iter_mut().enumerate() {
        vector[M + i] = 1.0;
        for k in (0..M).rev() {
            reflect(&a[k], beta[k], k, vector);
        }
    }
    Some(basis)
}

/// `vector -= beta (v · vector) v`, the first `from` numbers of `v` being zero.
#[inline(always)]
fn reflect(v: &[f64; 9], beta: f64, from: usize, vector: &mut [f64; 9]) {
    let mut dot = 0.0;
    for i in from..9 {
        dot += v[i] * vector[i];
    }
    dot *= beta;
    for i in from..9 {
        vector[i] -= dot * v[i];
    }
}

/// The least squares solution of a homogeneous system.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Smallest<const N: usize> {
    /// Unit right singular vector of the smallest singular value.
    pub vector: [f64; N],
    /// Smallest singular value: the residual's norm.
    pub smallest: f64,
    /// The next one: as small as the smallest means that the vector is arbitrary.
    pub next: f64,
    /// Largest singular value: the scale of the two others.
    pub largest: f64,
}

/// Homogeneous equations in `N` unknowns, reduced as they come.
#[derive(Debug, Clone)]
pub struct RowTriangle<const N: usize> {
    triangle: [[f64; N]; N],
    block: [[f64; N]; BLOCK],
    used: usize,
}

impl<const N: usize> Default for RowTriangle<N> {
    fn default() -> Self {
        Self { triangle: [[0.0; N]; N], block: [[0.0; N]; BLOCK], used: 0 }
    }
}

impl<const N: usize> RowTriangle<N> {
    /// Adds one equation, `row · unknowns = 0`.
    pub fn push(&mut self, row: [f64; N]) {
        self.block[self.used] = row;
        self.used += 1;
        if self.used == BLOCK {
            self.reduce();
        }
    }

    /// Reflects the collected rows into the triangle.
    fn reduce(&mut self) {
        let block = &mut self.block[..self.used];
        for k in 0..N {
            // Column k of [triangle row k; block]: the rows of the triangle below k are zero there.
            let tail: f64 = block.iter().map(|row| row[k] * row[k]).sum();
            if tail == 0.0 {
                continue;
            }
            let pivot = self.triangle[k][k];
            let norm = (pivot * pivot + tail).sqrt();
            let head = pivot + norm.copysign(pivot);
            let beta = 1.0 / (norm * (norm + pivot.abs()));
            let mut dots = [0.0; N];
            for j in k..N {
                dots[j] = head * self.triangle[k][j];
            }
            for row in block.iter() {
                let v = row[k];
                for j in k..N {
                    dots[j] += v * row[j];
                }
            }
            for j in k..N {
                dots[j] *= beta;
                self.triangle[k][j] -= dots[j] * head;
            }
            for row in block.iter_mut() {
                let v = row[k];
                for j in k + 1..N {
                    row[j] -= dots[j] * v;
                }
                row[k] = 0.0;
            }
        }
        self.used = 0;
    }

    /// The unit vector that solves the equations best; `None` when they are not finite or all zero.
    pub fn solve(mut self) -> Option<Smallest<N>> {
        self.reduce();
        // columns[j] is column j of the triangle, v[j] column j of V.
        let mut columns = [[0.0; N]; N];
        let mut v = [[0.0; N]; N];
        for j in 0..N {
            for i in 0..N {
                if !self.triangle[i][j].is_finite() {
                    return None;
                }
                columns[j][i] = self.triangle[i][j];
            }
            v[j][j] = 1.0;
        }
        for _ in 0..MAX_SWEEPS {
            let mut rotated = false;
            for p in 0..N {
                for q in p + 1..N {
                    let (mut pp, mut qq, mut pq) = (0.0, 0.0, 0.0);
                    for i in 0..N {
                        pp += columns[p][i] * columns[p][i];
                        qq += columns[q][i] * columns[q][i];
                        pq += columns[p][i] * columns[q][i];
                    }
                    if pq == 0.0 || pq.abs() <= 2.0 * f64::EPSILON * (pp * qq).sqrt() {
                        continue;
                    }
                    rotated = true;
                    let zeta = (qq - pp) / (2.0 * pq);
                    let t = zeta.signum() / (zeta.abs() + (1.0 + zeta * zeta).sqrt());
                    let c = 1.0 / (1.0 + t * t).sqrt();
                    let s = c * t;
                    rotate(&mut columns, p, q, c, s);
                    rotate(&mut v, p, q, c, s);
                }
            }
            if !rotated {
                break;
            }
        }
        let mut order: [(f64, usize); N] = std::array::from_fn(|j| (columns[j].iter().map(|x| x * x).sum::<f64>(), j));
        order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let largest = order[N - 1].0.sqrt();
        let smallest =
            Smallest { vector: v[order[0].1], smallest: order[0].0.sqrt(), next: order[1].0.sqrt(), largest };
        (largest > 0.0).then_some(smallest)
    }
}

/// Rotates columns p and q.
#[inline(always)]
fn rotate<const N: usize>(m: &mut [[f64; N]; N], p: usize, q: usize, c: f64, s: f64) {
    for i in 0..N {
        let (a, b) = (m[p][i], m[q][i]);
        m[p][i] = c * a - s * b;
        m[q][i] = s * a + c * b;
    }
}

#[cfg(test)]
mod tests {
    use super::super::random::Random;
    use super::*;

    fn dot(a: &[f64; 9], b: &[f64; 9]) -> f64 {
        a.iter().zip(b).map(|(x, y)| x * y).sum()
    }

    #[test]
    fn null_vectors_are_orthonormal_and_solve_the_rows() {
        for seed in 0..50 {
            let mut random = Random::new(seed);
            let rows: [[f64; 9]; 5] = std::array::from_fn(|_| std::array::from_fn(|_| random.normal()));
            let basis = null_space::<5, 4>(&rows).expect("independent rows");
            for (i, a) in basis.iter().enumerate() {
                for row in &rows {
                    assert!(dot(a, row).abs() < 1e-13, "seed {seed}: {}", dot(a, row));
                }
                for (j, b) in basis.iter().enumerate() {
                    let expected = if i == j { 1.0 } else { 0.0 };
                    assert!((dot(a, b) - expected).abs() < 1e-13, "seed {seed}");
                }
            }
        }
    }

    #[test]
    fn dependent_or_nan_rows_have_no_basis() {
        let mut random = Random::new(3);
        let mut rows: [[f64; 9]; 7] = std::array::from_fn(|_| std::array::from_fn(|_| random.normal()));
        let good = rows;
        assert!(null_space::<7, 2>(&rows).is_some());
        rows[6] = std::array::from_fn(|i| 2.0 * rows[1][i] - 0.3 * rows[4][i]);
        assert!(null_space::<7, 2>(&rows).is_none());
        rows = good;
        rows[2][2] = f64::NAN;
        assert!(null_space::<7, 2>(&rows).is_none());
        assert!(null_space::<7, 2>(&[[0.0; 9]; 7]).is_none());
    }

    /// Two smallest singular values 1e-6 and 1e-5 below a largest of 1: where nalgebra's SVD errs by 2.5e-2.
    #[test]
    fn close_small_singular_values_keep_their_vectors() {
        for seed in 0..20 {
            let mut random = Random::new(seed);
            let sigma = [1.0, 0.8, 0.5, 0.3, 0.1, 0.05, 0.01, 1e-5, 1e-6];
            let u = random_orthonormal::<24>(&mut random);
            let v = random_orthonormal::<9>(&mut random);
            let mut triangle = RowTriangle::<9>::default();
            for r in 0..24 {
                let row = std::array::from_fn(|c| (0..9).map(|k| u[k][r] * sigma[k] * v[k][c]).sum());
                triangle.push(row);
            }
            let s = triangle.solve().expect("finite");
            assert!((dot(&s.vector, &v[8]).abs() - 1.0).abs() < 1e-12, "seed {seed}: {}", dot(&s.vector, &v[8]));
            let error: f64 = s.vector.iter().zip(v[8]).map(|(a, b)| (a.abs() - b.abs()).abs()).fold(0.0, f64::max);
            // Rounding of the rows, 1e-16, over the gap of 9e-6.
            assert!(error < 1e-9, "seed {seed}: {error}");
            assert!((s.smallest / 1e-6 - 1.0).abs() < 1e-8 && (s.next / 1e-5 - 1.0).abs() < 1e-8, "seed {seed}: {s:?}");
        }
    }

    #[test]
    fn row_triangle_agrees_with_faer() {
        let mut random = Random::new(11);
        let rows: Vec<[f64; 9]> = (0..40).map(|_| std::array::from_fn(|_| random.normal())).collect();
        let mut triangle = RowTriangle::<9>::default();
        rows.iter().for_each(|row| triangle.push(*row));
        let ours = triangle.solve().expect("finite");
        let a = faer::Mat::from_fn(40, 9, |i, j| rows[i][j]);
        let svd = a.thin_svd().expect("converges");
        let sigma: Vec<f64> = svd.S().column_vector().iter().copied().collect();
        assert!((ours.smallest - sigma[8]).abs() < 1e-12 && (ours.next - sigma[7]).abs() < 1e-12);
        let overlap: f64 = (0..9).map(|i| ours.vector[i] * svd.V()[(i, 8)]).sum();
        assert!((overlap.abs() - 1.0).abs() < 1e-13, "{overlap}");
    }

    #[test]
    fn zero_and_nan_equations_have_no_solution() {
        let mut triangle = RowTriangle::<4>::default();
        assert!(triangle.clone().solve().is_none());
        triangle.push([f64::NAN, 0.0, 0.0, 1.0]);
        assert!(triangle.solve().is_none());
    }

    /// Nine orthonormal vectors of R^N (Gram and Schmidt, twice).
    fn random_orthonormal<const N: usize>(random: &mut Random) -> [[f64; N]; 9] {
        let mut q: [[f64; N]; 9] = std::array::from_fn(|_| std::array::from_fn(|_| random.normal()));
        for _ in 0..2 {
            for i in 0..9 {
                for j in 0..i {
                    let d: f64 = q[i].iter().zip(q[j]).map(|(a, b)| a * b).sum();
                    let other = q[j];
                    q[i].iter_mut().zip(other).for_each(|(a, b)| *a -= d * b);
                }
                let n = q[i].iter().map(|a| a * a).sum::<f64>().sqrt();
                q[i].iter_mut().for_each(|a| *a /= n);
            }
        }
        q
    }
}
