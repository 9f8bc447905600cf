//! Normal equations of some parameters that all share and of many small blocks that know nothing of each other: an arrow-shaped matrix.
//!
//! A camera and the poses of a board, a motion and the points of two views. The blocks are eliminated (Schur complement; Triggs et
//! al., Bundle adjustment, 2000, section 6), which leaves a system of the shared parameters' size. Cost: proportional to the blocks.

use nalgebra::{SMatrix, SVector};

use super::{Damped, damped};

/// Added to every pivot, so that what nothing depends on stays where it is.
const LEAST_PIVOT: f64 = 1e-12;

/// `S` shared parameters and blocks of `B`: both triangles of `JᵀWJ`, and `JᵀWr`.
#[derive(Debug, Clone, PartialEq)]
pub struct ArrowEquations<const S: usize, const B: usize> {
    pub shared: SMatrix<f64, S, S>,
    pub gradient: SVector<f64, S>,
    pub blocks: Vec<Block<S, B>>,
}

/// What one block adds.
#[derive(Debug, Clone, PartialEq)]
pub struct Block<const S: usize, const B: usize> {
    /// Shared parameters by the block's own.
    pub cross: SMatrix<f64, S, B>,
    pub own: SMatrix<f64, B, B>,
    pub gradient: SVector<f64, B>,
}

impl<const S: usize, const B: usize> Default for ArrowEquations<S, B> {
    fn default() -> Self {
        Self { shared: SMatrix::zeros(), gradient: SVector::zeros(), blocks: Vec::new() }
    }
}

impl<const S: usize, const B: usize> Default for Block<S, B> {
    fn default() -> Self {
        Self { cross: SMatrix::zeros(), own: SMatrix::zeros(), gradient: SVector::zeros() }
    }
}

/// The shared parameters' system once the blocks are eliminated.
pub struct Reduced<const S: usize, const B: usize> {
    pub information: SMatrix<f64, S, S>,
    pub gradient: SVector<f64, S>,
    /// Of each block: its inverse times its cross terms and times its gradient.
    eliminated: Vec<(SMatrix<f64, B, S>, SVector<f64, B>)>,
}

impl<const S: usize, const B: usize> ArrowEquations<S, B> {
    /// Without the blocks, at a damping; `None` if one of them is not positive definite.
    pub fn reduce(&self, damping: f64) -> Option<Reduced<S, B>> {
        let mut information = damped(&self.shared, damping, LEAST_PIVOT);
        let mut gradient = self.gradient;
        let mut eliminated = Vec::with_capacity(self.blocks.len());
        for block in &self.blocks {
            let factor = nalgebra::Cholesky::new(damped(&block.own, damping, LEAST_PIVOT))?;
            let by_shared = factor.solve(&block.cross.transpose());
            let by_gradient = factor.solve(&block.gradient);
            information -= block.cross * by_shared;
            gradient -= block.cross * by_gradient;
            eliminated.push((by_shared, by_gradient));
        }
        Some(Reduced { information, gradient, eliminated })
    }
}

impl<const S: usize, const B: usize> Damped for ArrowEquations<S, B> {
    /// Of the shared parameters and of each block.
    type Step = (SVector<f64, S>, Vec<SVector<f64, B>>);

    fn solve(&self, damping: f64) -> Option<(Self::Step, f64)> {
        let Reduced { information, gradient, eliminated } = self.reduce(damping)?;
        let shared = -nalgebra::Cholesky::new(information)?.solve(&gradient);
        let own: Vec<_> = eliminated.iter().map(|(by_shared, by_gradient)| -by_gradient - by_shared * shared).collect();
        // -δᵀg + δᵀDδ, D what the damping added.
        let added = |step: f64, pivot: f64| step * step * (damping * pivot + LEAST_PIVOT);
        let mut predicted = -shared.dot(&self.gradient);
        predicted += (0..S).map(|i| added(shared[i], self.shared[(i, i)])).sum::<f64>();
        for (block, step) in self.blocks.iter().zip(&own) {
            predicted -= step.dot(&block.gradient);
            predicted += (0..B).map(|i| added(step[i], block.own[(i, i)])).sum::<f64>();
        }
        Some(((shared, own), predicted))
    }

    fn length((shared, own): &Self::Step) -> f64 {
        (shared.norm_squared() + own.iter().map(SVector::norm_squared).sum::<f64>()).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;
    use crate::geometry::random::Random;

    #[test]
    fn elimination_gives_the_step_of_the_full_system() {
        const BLOCKS: usize = 4;
        let n = 3 + 2 * BLOCKS;
        for seed in 1..10 {
            let mut random = Random::new(seed);
            // Five residuals a block.
            let mut j = DMatrix::<f64>::zeros(5 * BLOCKS, n);
            let r = DVector::from_fn(5 * BLOCKS, |_, _| random.normal());
            for row in 0..5 * BLOCKS {
                for c in [0, 1, 2, 3 + 2 * (row / 5), 4 + 2 * (row / 5)] {
                    j[(row, c)] = random.normal();
                }
            }
            let (h, g) = (j.transpose() * &j, j.transpose() * &r);
            let block = |k: usize| Block {
                cross: h.fixed_view::<3, 2>(0, 3 + 2 * k).into_owned(),
                own: h.fixed_view::<2, 2>(3 + 2 * k, 3 + 2 * k).into_owned(),
                gradient: g.fixed_rows::<2>(3 + 2 * k).into_owned(),
            };
            let arrow = ArrowEquations {
                shared: h.fixed_view::<3, 3>(0, 0).into_owned(),
                gradient: g.fixed_rows::<3>(0).into_owned(),
                blocks: (0..BLOCKS).map(block).collect(),
            };
            let damping = 0.1;
            let mut full = h.clone();
            for i in 0..n {
                full[(i, i)] *= 1.0 + damping;
            }
            let expected = -full.cholesky().expect("positive definite").solve(&g);
            let (step, predicted) = arrow.solve(damping).expect("positive definite");
            assert!((step.0 - expected.fixed_rows::<3>(0)).norm() < 1e-9, "seed {seed}");
            for (k, own) in step.1.iter().enumerate() {
                assert!((own - expected.fixed_rows::<2>(3 + 2 * k)).norm() < 1e-9, "seed {seed}");
            }
            let gain = r.norm_squared() - (&r + &j * &expected).norm_squared();
            assert!((predicted - gain).abs() < 1e-9 * gain, "seed {seed}: {predicted} for {gain}");
            assert!((ArrowEquations::<3, 2>::length(&step) - expected.norm()).abs() < 1e-9);
            // Undamped: what is left is the inverse of the full inverse's corner.
            let corner = h.try_inverse().expect("regular").fixed_view::<3, 3>(0, 0).into_owned();
            let information = arrow.reduce(0.0).expect("positive definite").information;
            assert!((information * corner - SMatrix::<f64, 3, 3>::identity()).norm() < 1e-6, "seed {seed}");
        }
    }
}
