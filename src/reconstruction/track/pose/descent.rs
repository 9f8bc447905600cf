//! The pose that a set of pairs wants.

use nalgebra::Vector6;

use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::geometry::least_squares::{LeastSquares, LmOptions, Loss, NormalEquations, minimise};
use crate::reconstruction::measurement::{BEHIND_CAMERA, CHI2_2D_95, Correspondence, residual};

/// Options of [`optimise_pose`](super::optimise_pose).
#[derive(Debug, Clone, Copy)]
pub struct PoseOptions {
    /// Steps a round at the most.
    pub steps: usize,
    /// Limit of the squared, sigma-scaled residual above which a pair is an outlier.
    pub outlier_chi2: f64,
    /// The first round uses this many times the limit and a Cauchy weight: a poor start must not throw good pairs out.
    pub first_round_relaxation: f64,
    /// Pairs with leverage are judged by what the others make of them (`leverage`).
    pub leverage: bool,
}

impl Default for PoseOptions {
    fn default() -> Self {
        Self { steps: 6, outlier_chi2: CHI2_2D_95, first_round_relaxation: 4.0, leverage: true }
    }
}

impl PoseOptions {
    /// With this limit.
    pub fn judged_by(outlier_chi2: f64) -> Self {
        Self { outlier_chi2, ..Self::default() }
    }

    /// From a start that may be far off.
    pub fn from_poor_start() -> Self {
        Self { first_round_relaxation: 25.0, ..Self::default() }
    }
}

/// What the pairs that are inliers cost a pose.
struct PoseProblem<'a> {
    pairs: &'a [Correspondence],
    inlier: &'a [bool],
    loss: Loss,
    /// The price of a pair behind the camera.
    behind: f64,
}

impl PoseProblem<'_> {
    fn pairs(&self) -> impl Iterator<Item = &Correspondence> {
        self.pairs.iter().zip(self.inlier).filter(|(_, ok)| **ok).map(|(pair, _)| pair)
    }
}

impl LeastSquares for PoseProblem<'_> {
    type State = Se3<Camera, World>;
    type Normal = NormalEquations<6>;

    fn linearise(&self, pose: &Se3<Camera, World>) -> NormalEquations<6> {
        let mut normal = NormalEquations::default();
        for pair in self.pairs() {
            let Some(seen) = residual(pose, pair) else { continue };
            let (e, (jx, jy)) = (seen.e, seen.rows());
            let (_, weight) = self.loss.evaluate(e.norm_squared());
            normal.add(&Vector6::from(jx), e.x, weight);
            normal.add(&Vector6::from(jy), e.y, weight);
        }
        normal
    }

    fn cost(&self, pose: &Se3<Camera, World>) -> f64 {
        let cost = |pair| residual(pose, pair).map_or(self.behind, |seen| self.loss.evaluate(seen.e.norm_squared()).0);
        self.pairs().map(cost).sum()
    }

    fn step(&self, pose: &Se3<Camera, World>, delta: &Vector6<f64>) -> Se3<Camera, World> {
        pose.perturb_left(delta)
    }
}

/// The pose that the current inliers want, and what they cost there; Cauchy's loss when `relaxed`, Huber's else.
pub(super) fn descend(
    start: &Se3<Camera, World>,
    pairs: &[Correspondence],
    inlier: &[bool],
    options: &PoseOptions,
    relaxed: bool,
) -> (Se3<Camera, World>, f64) {
    let limit = options.outlier_chi2.sqrt();
    let loss = if relaxed { Loss::Cauchy(limit) } else { Loss::Huber(limit) };
    let problem = PoseProblem { pairs, inlier, loss, behind: BEHIND_CAMERA * options.outlier_chi2 };
    let lm = LmOptions { max_iterations: options.steps, relative_cost: 1e-6, step_norm: 1e-8, initial_damping: 1e-6 };
    let (pose, summary) = minimise(&problem, *start, &lm);
    (pose, summary.final_cost)
}

/// Says of every pair whether it lies within `limit`; how many do.
pub(super) fn judge(pose: &Se3<Camera, World>, pairs: &[Correspondence], limit: f64, inlier: &mut [bool]) -> usize {
    let mut count = 0;
    for (pair, flag) in pairs.iter().zip(inlier) {
        *flag = residual(pose, pair).is_some_and(|seen| seen.e.norm_squared() <= limit);
        count += usize::from(*flag);
    }
    count
}
