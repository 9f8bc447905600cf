//! Cholesky factor of a dense symmetric matrix whose size is known at run time only: the cameras of an adjustment.
//!
//! Input: the lower triangle. Output: the factor, and solutions by it. Cost: n³/3 multiplications, blocked and vectorised (`faer`, one thread).
//! Matrices of a fixed size stay with nalgebra, on the stack.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::{factor, solve};
use faer::{MatMut, MatRef, Par};
use nalgebra::{DMatrix, DVector, SMatrix};

/// `A = L Lᵀ`
#[derive(Debug)]
pub struct DenseCholesky {
    /// Lower triangle; above it is what was there.
    factor: DMatrix<f64>,
}

impl DenseCholesky {
    /// Of the matrix with this lower triangle, in its place; `None` where it is not positive definite.
    pub fn of(mut matrix: DMatrix<f64>) -> Option<Self> {
        let (rows, columns) = matrix.shape();
        let mut scratch = MemBuffer::new(factor::cholesky_in_place_scratch::<f64>(rows, Par::Seq, Default::default()));
        let whole = MatMut::from_column_major_slice_mut(matrix.as_mut_slice(), rows, columns);
        let (stack, none) = (MemStack::new(&mut scratch), Default::default());
        factor::cholesky_in_place(whole, none, Par::Seq, stack, Default::default()).ok()?;
        // What is not a number fails no comparison.
        matrix.diagonal().iter().all(|pivot| pivot.is_finite()).then_some(Self { factor: matrix })
    }

    /// `A⁻¹ right`
    pub fn solve(&self, mut right: DVector<f64>) -> DVector<f64> {
        let rows = self.factor.nrows();
        let mut scratch = MemBuffer::new(solve::solve_in_place_scratch::<f64>(rows, 1, Par::Seq));
        let factor = MatRef::from_column_major_slice(self.factor.as_slice(), rows, rows);
        let column = MatMut::from_column_major_slice_mut(right.as_mut_slice(), rows, 1);
        solve::solve_in_place(factor, column, Par::Seq, MemStack::new(&mut scratch));
        right
    }

    /// The last `W` rows and columns of `A⁻¹`: the covariance of the last unknowns, the others free. `None` if it is not finite.
    pub fn last_block_of_inverse<const W: usize>(&self) -> Option<SMatrix<f64, W, W>> {
        let at = self.factor.nrows().checked_sub(W)?;
        // The last block of the factor is the factor of what is left once the others are eliminated.
        let factor = SMatrix::<f64, W, W>::from_fn(|r, c| if r < c { 0.0 } else { self.factor[(at + r, at + c)] });
        let inverse = factor.try_inverse()?;
        let block = inverse.tr_mul(&inverse);
        block.iter().all(|v| v.is_finite()).then_some(block)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A well-conditioned matrix with no structure.
    fn matrix(n: usize) -> DMatrix<f64> {
        let root = DMatrix::from_fn(n, n, |r, c| ((r * 31 + c * 17) % 23) as f64 / 23.0 - 0.5);
        &root * root.transpose() + DMatrix::identity(n, n) * 0.5
    }

    #[test]
    fn solves_as_nalgebra_does_and_reads_the_lower_triangle_only() {
        for n in [1, 6, 7, 31, 61, 150] {
            let full = matrix(n);
            let right = DVector::from_fn(n, |i, _| (i as f64 * 0.7).sin());
            let expected = full.clone().cholesky().expect("positive definite").solve(&right);
            let mut lower = full;
            lower.fill_upper_triangle(f64::NAN, 1);
            let found = DenseCholesky::of(lower).expect("positive definite").solve(right);
            assert!(
                (&found - &expected).norm() <= 1e-10 * expected.norm(),
                "{n}: off by {}",
                (found - expected).norm()
            );
        }
    }

    #[test]
    fn the_last_block_is_that_of_the_inverse() {
        let full = matrix(40);
        let inverse = full.clone().try_inverse().expect("regular");
        let block = DenseCholesky::of(full).and_then(|f| f.last_block_of_inverse::<5>()).expect("positive definite");
        assert!((block - inverse.fixed_view::<5, 5>(35, 35)).norm() < 1e-10);
    }

    #[test]
    fn what_is_not_positive_definite_has_none() {
        let mut full = matrix(20);
        full[(12, 12)] = -1.0;
        assert!(DenseCholesky::of(full.clone()).is_none());
        full[(12, 12)] = f64::NAN;
        assert!(DenseCholesky::of(full.clone()).is_none());
        assert!(DenseCholesky::of(DMatrix::zeros(3, 3)).is_none());
    }
}
