//! Essential matrix: relative pose of two calibrated views.
//!
//! Matched points, undistorted and normalised (`x = (X/Z, Y/Z)`), -> E with `x2ᵀ E x1 = 0`, `E = [t]x R`,
//! `[R | t] = second_from_first`, |t| = 1; inliers, votes. `None` when there is none: too few, repeated, collinear or
//! random matches, numbers that are not finite, or a rotation alone explains the matches.
//! - E from F (eq. 6), with singular values forced to 1, 1, 0.
//! - Decomposition (eq. 7-8): E = U S Vᵀ with det U = det V = +1; R = U W Vᵀ or U Wᵀ Vᵀ, t = ± u3.
//! - Cheirality by one point (Nistér, PAMI 2004, section 5.2) as the study has it, and by the votes of all.
//! - Robust: five-point samples ([`super::five_point`]) in the common loop with Sampson residuals; local optimisation
//!   and the final refinement by Levenberg-Marquardt over the five degrees of freedom.
//!
//!   Both motions of a homography through the inliers are tried too: the search alone ends in the wrong one of them now
//!   and then.
//!
//! Thresholds are in normalised units: pixels divided by the focal length. Cost: about 2 ms for 300 matches with 30 %
//! outliers.

use nalgebra::{Matrix3, Matrix3x4, SMatrix, SVector, UnitQuaternion, Vector2, Vector3, Vector4};

use super::Se3;
use super::epipolar::{sampson_cost, sampson_normal_equations, sampson_squared, skew};
use super::five_point::five_point;
use super::frames::{First, Second};
use super::homography::estimate_homography;
use super::homography_decomposition::{PlaneMotions, decompose_homography};
use super::least_squares::{LeastSquares, LmOptions, Loss, NormalEquations, minimise};
use super::point_set::{all_finite, chance_near_line, spread};
use super::ransac::{self, Estimator, RansacOptions, Workspace};
use super::rotation::{estimate_rotation, quaternion};
use super::triangulation::{intersect, triangulate};

/// The study's W (eq. 7).
pub const W: Matrix3<f64> = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);

/// `E = [t]x R` of a motion.
pub fn essential_of<A, B>(second_from_first: &Se3<A, B>) -> Matrix3<f64> {
    skew(&second_from_first.translation) * second_from_first.rotation.to_rotation_matrix().matrix()
}

/// E from F (eq. 6, two cameras): `K2ᵀ F K1`, singular values forced to 1, 1, 0. `None` when F has no rank two.
pub fn essential_from_fundamental(f: &Matrix3<f64>, k1: &Matrix3<f64>, k2: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let (u, s, v) = proper_svd(&(k2.transpose() * f * k1))?;
    // Written so that NaN fails.
    if !(s[1] > 1e-9 * s[0]) {
        return None;
    }
    Some(u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, 0.0)) * v.transpose())
}

/// Singular value decomposition with det U = det V = +1 (the sign of the third column is free because s3 is, or will
/// be, zero).
fn proper_svd(m: &Matrix3<f64>) -> Option<(Matrix3<f64>, Vector3<f64>, Matrix3<f64>)> {
    if !m.iter().all(|v| v.is_finite()) {
        return None;
    }
    let svd = m.try_svd(true, true, f64::EPSILON, 200)?;
    let (mut u, mut v) = (svd.u?, svd.v_t?.transpose());
    for q in [&mut u, &mut v] {
        if q.determinant() < 0.0 {
            q.neg_mut();
        }
    }
    Some((u, svd.singular_values, v))
}

/// The parts of E that its four motions are made of (eq. 7-8).
#[derive(Debug, Clone, PartialEq)]
pub struct Decomposition {
    /// P_A = [U W Vᵀ | u3], P_B = [U W Vᵀ | -u3], P_C = [U Wᵀ Vᵀ | u3], P_D = [U Wᵀ Vᵀ | -u3].
    pub candidates: [Se3<Second, First>; 4],
    /// Third column of V: the first camera's epipole.
    pub v3: Vector3<f64>,
}

/// The four motions of an essential matrix; `None` when it has no rank two.
pub fn decompose(e: &Matrix3<f64>) -> Option<Decomposition> {
    let (u, s, v) = proper_svd(e)?;
    if !(s[1] > 1e-9 * s[0]) {
        return None;
    }
    let a = quaternion(&(u * W * v.transpose()));
    let b = quaternion(&(u * W.transpose() * v.transpose()));
    let t = u.column(2).into_owned();
    let candidates = [Se3::new(a, t), Se3::new(a, -t), Se3::new(b, t), Se3::new(b, -t)];
    Some(Decomposition { candidates, v3: v.column(2).into_owned() })
}

/// Which of the four motions puts one match in front of both cameras (Nistér's one-point rules): the index into
/// [`Decomposition::candidates`]. One triangulation with P_A decides, by the reflection H_r = diag(1, 1, 1, -1) and the
/// twist H_t = [I 0; -2 v13, -2 v23, -2 v33, -1]. In theory one exact match is enough; noisy ones should vote
/// ([`cheirality_votes`]). `None` for a match at infinity.
pub fn cheirality_one_point(parts: &Decomposition, x1: &Vector2<f64>, x2: &Vector2<f64>) -> Option<usize> {
    let p_a = parts.candidates[0].matrix();
    let x = triangulate(&[Matrix3x4::identity(), p_a], &[*x1, *x2])?;
    let c1 = x.z * x.w;
    let c2 = (p_a * x).z * x.w;
    if c1 == 0.0 || c2 == 0.0 {
        return None;
    }
    if c1 > 0.0 && c2 > 0.0 {
        return Some(0);
    }
    if c1 < 0.0 && c2 < 0.0 {
        return Some(1);
    }
    // (H_t X)4
    let last_row = Vector4::new(-2.0 * parts.v3.x, -2.0 * parts.v3.y, -2.0 * parts.v3.z, -1.0);
    Some(if x.z * last_row.dot(&x) > 0.0 { 2 } else { 3 })
}

/// For each of the four motions, how many matches it puts in front of both cameras. Rays without parallax do not vote.
pub fn cheirality_votes(
    parts: &Decomposition,
    matches: impl Iterator<Item = (Vector2<f64>, Vector2<f64>)>,
) -> [usize; 4] {
    let mut votes = [0; 4];
    for (x1, x2) in matches {
        for k in [0, 2] {
            if let Some(p) = intersect(&parts.candidates[k], &x1, &x2) {
                votes[k] += usize::from(p.depth1 > 0.0 && p.depth2 > 0.0);
                // -t turns the sign of both depths.
                votes[k + 1] += usize::from(p.depth1 < 0.0 && p.depth2 < 0.0);
            }
        }
    }
    votes
}

/// A motion with a unit translation as the refinement moves it: left rotation, then the translation on its sphere.
#[derive(Debug, Clone, Copy)]
pub(super) struct Motion {
    rotation: UnitQuaternion<f64>,
    translation: Vector3<f64>,
}

impl Motion {
    /// `None` without a translation.
    pub(super) fn new(motion: &Se3<Second, First>) -> Option<Self> {
        Some(Self { rotation: motion.rotation, translation: motion.translation.try_normalize(0.0)? })
    }

    pub(super) fn essential(&self) -> Matrix3<f64> {
        skew(&self.translation) * self.rotation.to_rotation_matrix().matrix()
    }

    /// Two directions across the translation.
    fn tangent(&self) -> [Vector3<f64>; 2] {
        let t = &self.translation;
        // Across the axis that t is farthest from.
        let axis = Vector3::ith(t.iamin(), 1.0);
        let a = t.cross(&axis).normalize();
        [a, t.cross(&a)]
    }

    /// Moved by the five parameters.
    pub(super) fn moved(&self, delta: &SVector<f64, 5>) -> Self {
        let turn = UnitQuaternion::from_scaled_axis(delta.fixed_rows::<3>(0).into_owned());
        let mut rotation = turn * self.rotation;
        rotation.renormalize_fast();
        let [a, b] = self.tangent();
        Self { rotation, translation: (self.translation + a * delta[3] + b * delta[4]).normalize() }
    }

    /// dE by the five parameters, column by column of E.
    pub(super) fn directions(&self) -> SMatrix<f64, 9, 5> {
        let r = *self.rotation.to_rotation_matrix().matrix();
        let t = skew(&self.translation);
        let mut d = SMatrix::<f64, 9, 5>::zeros();
        for k in 0..3 {
            d.column_mut(k).copy_from_slice((t * skew(&Vector3::ith(k, 1.0)) * r).as_slice());
        }
        for (k, b) in self.tangent().iter().enumerate() {
            d.column_mut(3 + k).copy_from_slice((skew(b) * r).as_slice());
        }
        d
    }
}

/// Sampson distances of a set of matches as a least squares problem in a motion.
struct MotionProblem<I> {
    matches: I,
    loss: Loss,
}

impl<I: Iterator<Item = (Vector2<f64>, Vector2<f64>)> + Clone> LeastSquares for MotionProblem<I> {
    type State = Motion;
    type Normal = NormalEquations<5>;

    fn linearise(&self, motion: &Motion) -> NormalEquations<5> {
        sampson_normal_equations(&motion.essential(), &motion.directions(), self.matches.clone(), &self.loss)
    }

    fn cost(&self, motion: &Motion) -> f64 {
        sampson_cost(&motion.essential(), self.matches.clone(), &self.loss)
    }

    fn step(&self, motion: &Motion, delta: &SVector<f64, 5>) -> Motion {
        motion.moved(delta)
    }
}

/// The motion of least Sampson distance near `start`; its translation comes back with unit length.
pub fn refine_motion(
    start: &Se3<Second, First>,
    matches: impl Iterator<Item = (Vector2<f64>, Vector2<f64>)> + Clone,
    loss: Loss,
    options: &LmOptions,
) -> Option<Se3<Second, First>> {
    let (motion, _) = minimise(&MotionProblem { matches, loss }, Motion::new(start)?, options);
    let refined = Se3::new(motion.rotation, motion.translation);
    refined.is_finite().then_some(refined)
}

/// Information of a motion's five parameters (left rotation, rad, then the translation's direction on its sphere, rad) from Sampson
/// distances, in the unit of the matches; `None` without a translation.
pub fn motion_information(
    motion: &Se3<Second, First>,
    matches: impl Iterator<Item = (Vector2<f64>, Vector2<f64>)> + Clone,
    loss: Loss,
) -> Option<SMatrix<f64, 5, 5>> {
    let mut information = MotionProblem { matches, loss }.linearise(&Motion::new(motion)?).hessian;
    information.fill_upper_triangle_with_lower_triangle();
    Some(information)
}

/// Essential matrices for the robust loop.
struct Problem<'a> {
    x1: &'a [Vector2<f64>],
    x2: &'a [Vector2<f64>],
}

impl Problem<'_> {
    fn at(&self, i: usize) -> (Vector2<f64>, Vector2<f64>) {
        (self.x1[i], self.x2[i])
    }
}

impl Estimator for Problem<'_> {
    type Model = Matrix3<f64>;
    const SAMPLE_SIZE: usize = 5;

    fn data_count(&self) -> usize {
        self.x1.len()
    }

    fn solve_minimal(&self, sample: &[usize], models: &mut Vec<Self::Model>) {
        five_point(&std::array::from_fn(|i| self.x1[sample[i]]), &std::array::from_fn(|i| self.x2[sample[i]]), models);
    }

    #[inline]
    fn residual_squared(&self, e: &Self::Model, i: usize) -> f64 {
        sampson_squared(e, &self.x1[i], &self.x2[i])
    }

    fn refit(&self, e: &Self::Model, inliers: &[usize]) -> Option<Self::Model> {
        // E is ± [t]x R for each of its four motions, so any of them will do.
        let start = decompose(e)?.candidates[0];
        let options = LmOptions { max_iterations: 6, relative_cost: 1e-4, ..LmOptions::default() };
        refine_motion(&start, inliers.iter().map(|&i| self.at(i)), Loss::Squared, &options).map(|m| essential_of(&m))
    }

    fn chance(&self, threshold: f64) -> f64 {
        chance_near_line(self.x1, threshold).max(chance_near_line(self.x2, threshold))
    }
}

/// How [`estimate_essential`] works.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EssentialOptions {
    /// The loop's; its threshold is a Sampson distance in normalised units (pixels / focal length).
    pub ransac: RansacOptions,
    /// Share of the inliers (and at least eight) that must be farther than twice the threshold from where the best
    /// rotation alone puts them: less than that, and the translation rests on noise.
    pub min_off_rotation: f64,
}

impl EssentialOptions {
    /// The usual settings at a threshold in normalised units.
    pub fn new(threshold: f64) -> Self {
        Self { ransac: RansacOptions::new(threshold), min_off_rotation: 0.1 }
    }
}

/// A relative pose and what it rests on.
#[derive(Debug, Clone, PartialEq)]
pub struct EssentialEstimate {
    /// `[t]x R` of the motion: Frobenius norm sqrt(2).
    pub essential: Matrix3<f64>,
    /// The motion with most votes; its translation has unit length.
    pub second_from_first: Se3<Second, First>,
    /// Votes of that motion and of the runner-up among the other three.
    pub votes: usize,
    pub votes_runner_up: usize,
    /// One a match.
    pub inliers: Vec<bool>,
    pub inlier_count: usize,
    /// Samples drawn.
    pub iterations: usize,
    /// MSAC score, `sum min(r² / T², 1)`.
    pub score: f64,
    pub log10_false_alarms: f64,
}

/// The relative pose that most matches agree with, or `None`.
pub fn estimate_essential(
    x1: &[Vector2<f64>],
    x2: &[Vector2<f64>],
    options: &EssentialOptions,
) -> Option<EssentialEstimate> {
    if x1.len() != x2.len() || !all_finite(x1) || !all_finite(x2) {
        return None;
    }
    let problem = Problem { x1, x2 };
    let mut workspace = Workspace::default();
    let found = ransac::estimate(&problem, &options.ransac, &mut workspace)?;
    let threshold = options.ransac.threshold;
    let model = plane_twins(&problem, &options.ransac, &workspace, (found.model, found.score));
    // Refine twice, because a better motion has other inliers; what is left of the outliers fades.
    let mut motion = decompose(&model)?.candidates[0];
    let mut near = Vec::new();
    for _ in 0..2 {
        ransac::collect_inliers(&problem, &essential_of(&motion), ransac::REFIT_WIDTH * threshold, &mut near);
        let matches = near.iter().map(|&i| problem.at(i));
        motion = refine_motion(&motion, matches, Loss::Cauchy(2.0 * threshold), &LmOptions::default())?;
    }
    let log10_false_alarms = ransac::judge(&problem, &essential_of(&motion), &options.ransac, &mut workspace)?;
    let essential = essential_of(&motion);
    if degenerate(&problem, options, &workspace) {
        return None;
    }
    let (parts, votes) = vote(&problem, &essential, &workspace)?;
    let winner = (0..4).max_by_key(|&k| (votes[k], 4 - k))?;
    let runner_up = (0..4).filter(|&k| k != winner).map(|k| votes[k]).max()?;
    let second_from_first = parts.candidates[winner];
    Some(EssentialEstimate {
        essential: essential_of(&second_from_first),
        second_from_first,
        votes: votes[winner],
        votes_runner_up: runner_up,
        inlier_count: workspace.inliers().len(),
        inliers: workspace.mask().to_vec(),
        iterations: found.iterations,
        score: ransac::score(&problem, &essential, &ransac::Cost::msac(threshold), f64::INFINITY)?,
        log10_false_alarms,
    })
}

/// The better one of the model and of the motions of a homography through its inliers. Matches near a plane, or seen
/// under a narrow angle, are nearly as well explained by a second motion, and the search may have ended in that.
fn plane_twins(
    problem: &Problem,
    options: &RansacOptions,
    workspace: &Workspace<Matrix3<f64>>,
    mut best: (Matrix3<f64>, f64),
) -> Matrix3<f64> {
    let inliers = workspace.inliers();
    let pick = |x: &[Vector2<f64>]| inliers.iter().map(|&i| x[i]).collect::<Vec<_>>();
    let transfer = RansacOptions {
        threshold: 2.0 * options.threshold,
        max_iterations: 100,
        min_inliers: inliers.len() / 4,
        ..*options
    };
    let plane = estimate_homography(&pick(problem.x1), &pick(problem.x2), &transfer);
    let motions = plane.and_then(|p| decompose_homography(&p.homography, 1e-6));
    // The other two are these with n and t turned about: the same E.
    let Some(PlaneMotions::Four([a, b, ..])) = motions else { return best.0 };
    let mut near = Vec::new();
    for twin in [a, b] {
        let mut e = essential_of(&Se3::<Second, First>::new(twin.rotation, twin.translation.normalize()));
        for _ in 0..3 {
            ransac::collect_inliers(problem, &e, ransac::REFIT_WIDTH * options.threshold, &mut near);
            let Some(better) = problem.refit(&e, &near) else { break };
            e = better;
        }
        if let Some(score) = ransac::score(problem, &e, &options.cost(), best.1) {
            best = (e, score);
        }
    }
    best.0
}

fn vote(
    problem: &Problem,
    e: &Matrix3<f64>,
    workspace: &Workspace<Matrix3<f64>>,
) -> Option<(Decomposition, [usize; 4])> {
    let parts = decompose(e)?;
    let votes = cheirality_votes(&parts, workspace.inliers().iter().map(|&i| problem.at(i)));
    Some((parts, votes))
}

/// Do the inliers lie on a line, or does a rotation alone explain them?
fn degenerate(problem: &Problem, options: &EssentialOptions, workspace: &Workspace<Matrix3<f64>>) -> bool {
    let inliers = workspace.inliers();
    let threshold = options.ransac.threshold;
    let y1: Vec<Vector2<f64>> = inliers.iter().map(|&i| problem.x1[i]).collect();
    let y2: Vec<Vector2<f64>> = inliers.iter().map(|&i| problem.x2[i]).collect();
    if spread(y1.iter().copied()).1 < threshold || spread(y2.iter().copied()).1 < threshold {
        return true;
    }
    let ransac = RansacOptions {
        threshold: 2.0 * threshold,
        local_iterations: 10,
        max_iterations: 200,
        max_log10_false_alarms: f64::INFINITY,
        ..options.ransac
    };
    let explained = estimate_rotation(&y1, &y2, &ransac, &mut Workspace::default()).map_or(0, |r| r.inlier_count);
    let off = inliers.len() - explained;
    off < 8 || (off as f64) < options.min_off_rotation * inliers.len() as f64
}

#[cfg(test)]
mod tests;
