//! From matched points of calibrated cameras to the relative pose and the points, step by step and both ways.
//!
//! Input: matches as undistorted normalised points, F of the same matches in undistorted pixels (if there is one), both
//! cameras. Output: [`PoseSteps`]: what each step of the method gave.
//! - Essential matrix from F and K with singular values forced to 1, 1, 0 (eq. 6), and from five points in the robust loop.
//! - The four motions of each (eq. 7-8), told apart by the one-point rules (Nistér, PAMI 2004) and by the votes of all.
//! - The judge: `geometry::two_view` says whether the matches fix a motion at all (turning on the spot, standing still, a
//!   plane seen with two motions). Of all motions found the one with most support is adjusted over all its points.
//! - Points by normalised linear triangulation (eq. 9-13), then by the adjustment.
//!
//! Cost: 5 to 300 ms by the share of outliers.

use nalgebra::{Matrix3, Matrix3x4, Vector2, Vector3};

use super::adjustment::{Adjusted, Observation, adjust};
use crate::geometry::Se3;
use crate::geometry::camera_model::CameraModel;
use crate::geometry::epipolar::sampson_squared;
use crate::geometry::essential::{
    EssentialOptions, cheirality_one_point, cheirality_votes, decompose, essential_from_fundamental, essential_of,
    estimate_essential,
};
use crate::geometry::frames::{First, Second};
use crate::geometry::ransac::RansacOptions;
use crate::geometry::triangulation::{euclidean, intersect, nearest_match, triangulate};
use crate::geometry::two_view::{TwoViewFailure, TwoViewOptions, TwoViewReconstruction, reconstruct_two_views};

/// 95 % point of chi-square with one degree of freedom, as a distance in sigma.
pub const LINE_SIGMAS: f64 = 1.96;
/// No match is placed better than this, pixels.
pub const MIN_NOISE_PX: f64 = 0.03;
/// Once the noise is known, an inlier lies within so many sigma of it.
pub const INLIER_SIGMAS: f64 = 3.5;
/// Names of the four motions, in the order of `geometry::essential::Decomposition`.
pub const CANDIDATES: [&str; 4] = ["P_A", "P_B", "P_C", "P_D"];

/// An essential matrix and its four motions.
#[derive(Debug, Clone, PartialEq)]
pub struct FourMotions {
    pub essential: Matrix3<f64>,
    /// Inliers of this matrix.
    pub inliers: usize,
    pub candidates: [Se3<Second, First>; 4],
    /// What the one-point rules say of the single best match, as an index.
    pub by_one_point: Option<usize>,
    /// How often they say each when asked for every inlier in turn.
    pub one_point_counts: [usize; 4],
    /// How many inliers each motion puts in front of both cameras.
    pub votes: [usize; 4],
}

impl FourMotions {
    /// The motion with most votes; the first of equals.
    pub fn winner(&self) -> usize {
        (0..4).max_by_key(|k| (self.votes[*k], 4 - k)).unwrap_or(0)
    }
}

/// What the steps gave.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseSteps {
    /// Singular values of `K2ᵀ F K1`, the largest scaled to 1; a true E has 1, 1, 0.
    pub singular_values: Option<[f64; 3]>,
    pub from_fundamental: Option<FourMotions>,
    pub five_point: Option<FourMotions>,
    /// Samples that the five-point loop drew.
    pub five_point_iterations: usize,
    pub judged: Result<TwoViewReconstruction, TwoViewFailure>,
    pub solution: Option<Solution>,
    /// The other motion when two explain the matches.
    pub other: Option<Se3<Second, First>>,
}

impl PoseSteps {
    /// Those of the E of F and K where there is one, otherwise of that of five points.
    pub fn four_motions(&self) -> Option<&FourMotions> {
        self.from_fundamental.as_ref().or(self.five_point.as_ref())
    }
}

/// The motion and its points.
#[derive(Debug, Clone, PartialEq)]
pub struct Solution {
    /// Which way it was found.
    pub origin: &'static str,
    /// Translation of unit length.
    pub second_from_first: Se3<Second, First>,
    pub essential: Matrix3<f64>,
    /// The same for undistorted pixels: `K2⁻ᵀ E K1⁻¹`, of unit norm.
    pub fundamental: Option<Matrix3<f64>>,
    /// One a match: agrees with the motion and is not behind a camera.
    pub inliers: Vec<bool>,
    /// One a match, adjusted, the first camera's axes, unit: the baseline; `None` for outliers and points too far.
    pub points: Vec<Option<Vector3<f64>>>,
    /// The same by linear triangulation before the adjustment: median relative difference.
    pub linear_difference: f64,
    /// Median angle between the rays of a point, radians.
    pub median_parallax_rad: f64,
    pub adjusted: Adjusted,
}

/// What the steps work on.
#[derive(Debug, Clone, Copy)]
pub struct PoseInput<'a> {
    pub cameras: [&'a CameraModel; 2],
    /// Undistorted normalised points of each match.
    pub x1: &'a [Vector2<f64>],
    pub x2: &'a [Vector2<f64>],
    /// The same as they were seen, with what they are uncertain by.
    pub seen: &'a [Observation],
    /// Of undistorted pixels.
    pub fundamental: Option<&'a Matrix3<f64>>,
    /// One sigma of a point, pixels.
    pub sigma_px: f64,
    pub seed: u64,
    /// Answer with the best motion found even where nothing makes it stand out from chance.
    pub always_answer: bool,
}

/// Runs every step.
pub fn pose_steps(input: &PoseInput) -> PoseSteps {
    let focal = 0.5 * (input.cameras[0].focal_px() + input.cameras[1].focal_px());
    let threshold = LINE_SIGMAS * input.sigma_px / focal;
    let matrices = input.cameras.map(intrinsics);
    let scaled = input.fundamental.map(|f| matrices[1].transpose() * f * matrices[0]);
    let from_fundamental = input
        .fundamental
        .and_then(|f| essential_from_fundamental(f, &matrices[0], &matrices[1]))
        .and_then(|e| four_motions(input, &e, threshold));
    let ransac = RansacOptions { seed: input.seed, max_iterations: 50_000, ..RansacOptions::thorough(threshold) };
    // Turning on the spot is the judge's to tell.
    let options = EssentialOptions { ransac, min_off_rotation: 0.0 };
    let estimate = estimate_essential(input.x1, input.x2, &options);
    let five_point = estimate.as_ref().and_then(|e| four_motions(input, &e.essential, threshold));

    let judge = TwoViewOptions { seed: input.seed, ..TwoViewOptions::single_pair(input.sigma_px, focal) };
    let judged = reconstruct_two_views(input.x1, input.x2, &judge);
    let (accepted, other) = match &judged {
        Ok(found) => (Some(found.second_from_first), None),
        Err(TwoViewFailure::Ambiguous { best, runner_up }) => {
            (Some(best.second_from_first), Some(runner_up.second_from_first))
        }
        Err(_) => (None, None),
    };
    let solution = match accepted {
        Some(motion) => {
            let mut motions = vec![("judge", motion)];
            for (name, four) in [("five points", &five_point), ("F and K", &from_fundamental)] {
                motions.extend(four.as_ref().map(|f| (name, f.candidates[f.winner()])));
            }
            solve(input, &motions, threshold)
        }
        None => input.always_answer.then(|| guess(input, &options, judge.max_rotation_rad)).flatten(),
    };
    PoseSteps {
        singular_values: scaled.and_then(|e| {
            let s = e.try_svd(false, false, f64::EPSILON, 200)?.singular_values;
            Some([1.0, s[1] / s[0], s[2] / s[0]])
        }),
        from_fundamental,
        five_point,
        five_point_iterations: estimate.map_or(0, |e| e.iterations),
        judged,
        solution,
        other,
    }
}

/// Draws of [`guess`] at each width of the threshold.
const GUESSES: u64 = 8;

/// The motion that fits best, however badly, of those that leave the pictures a common view (the judge's limit for a turn), or else
/// of all. No better than chance where the judge found nothing: only for comparisons with programs that always answer.
fn guess(input: &PoseInput, options: &EssentialOptions, max_rotation_rad: f64) -> Option<Solution> {
    // Every motion drawn at a width of the threshold that anything at all agrees with, the one with most support first.
    let drawn = |threshold: f64| {
        let mut motions: Vec<(f64, Se3<Second, First>)> = Vec::new();
        for draw in 0..GUESSES {
            let ransac = RansacOptions {
                max_log10_false_alarms: f64::INFINITY,
                max_iterations: options.ransac.max_iterations / GUESSES as usize,
                seed: input.seed.wrapping_add(draw),
                threshold,
                ..options.ransac
            };
            let found = estimate_essential(input.x1, input.x2, &EssentialOptions { ransac, ..*options });
            let Some(parts) = found.and_then(|e| decompose(&e.essential)) else { continue };
            let tallied = parts.candidates.into_iter().map(|m| (agreement(input, &m, threshold).1, m));
            motions.extend(tallied.filter(|(support, _)| *support > 0.0));
        }
        // Stable: of equals the first drawn.
        motions.sort_by(|a, b| b.0.total_cmp(&a.0));
        motions
    };
    let answer = |threshold: f64, motions: &[(f64, Se3<Second, First>)], limit: f64| {
        let best = motions.iter().find(|(_, m)| m.rotation.angle() <= limit)?.1;
        solve(input, &[("guess", best)], threshold)
    };
    let mut tried = Vec::new();
    for wider in [1.0, 2.0, 4.0, 8.0] {
        let threshold = wider * options.ransac.threshold;
        let motions = drawn(threshold);
        if let Some(solution) = answer(threshold, &motions, max_rotation_rad) {
            return Some(solution);
        }
        tried.push((threshold, motions));
    }
    tried.iter().find_map(|(threshold, motions)| answer(*threshold, motions, std::f64::consts::PI))
}

/// F of E, of unit norm.
fn fundamental_of(essential: &Matrix3<f64>, cameras: [&CameraModel; 2]) -> Option<Matrix3<f64>> {
    let [k1, k2] = cameras.map(|c| intrinsics(c).try_inverse());
    let f = k2?.transpose() * essential * k1?;
    let norm = f.norm();
    (norm > 0.0 && norm.is_finite()).then(|| f / norm)
}

/// K of a camera.
pub fn intrinsics(camera: &CameraModel) -> Matrix3<f64> {
    Matrix3::new(camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0)
}

/// Indices of the matches within `threshold` of E, nearest first.
fn near(input: &PoseInput, e: &Matrix3<f64>, threshold: f64) -> Vec<usize> {
    let mut near: Vec<(f64, usize)> = input
        .x1
        .iter()
        .zip(input.x2)
        .enumerate()
        .map(|(i, (a, b))| (sampson_squared(e, a, b), i))
        .filter(|(squared, _)| *squared <= threshold * threshold)
        .collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    near.into_iter().map(|(_, i)| i).collect()
}

fn four_motions(input: &PoseInput, e: &Matrix3<f64>, threshold: f64) -> Option<FourMotions> {
    let parts = decompose(e)?;
    let inliers = near(input, e, threshold);
    let mut one_point_counts = [0; 4];
    let rule = |i: &usize| cheirality_one_point(&parts, &input.x1[*i], &input.x2[*i]);
    for k in inliers.iter().filter_map(rule) {
        one_point_counts[k] += 1;
    }
    let votes = cheirality_votes(&parts, inliers.iter().map(|&i| (input.x1[i], input.x2[i])));
    Some(FourMotions {
        essential: *e,
        inliers: inliers.len(),
        by_one_point: inliers.first().and_then(rule),
        one_point_counts,
        votes,
        candidates: parts.candidates,
    })
}

/// What a motion makes of the matches: who agrees (near its epipolar line, and in front of both cameras or too far for
/// that to show), and how well altogether.
fn agreement(input: &PoseInput, motion: &Se3<Second, First>, threshold: f64) -> (Vec<bool>, f64) {
    let e = essential_of(motion);
    // Below three sigma of the angle the sign of a depth is noise.
    let far = 3.0 * std::f64::consts::SQRT_2 * threshold / LINE_SIGMAS;
    let mut support = 0.0;
    let inliers = input
        .x1
        .iter()
        .zip(input.x2)
        .map(|(x1, x2)| {
            let share = sampson_squared(&e, x1, x2) / (threshold * threshold);
            // Written so that NaN fails.
            if !(share <= 1.0) {
                return false;
            }
            let met = nearest_match(&e, x1, x2).and_then(|(y1, y2)| intersect(motion, &y1, &y2));
            if met.is_some_and(|m| m.parallax_rad > far && (m.depth1 <= 0.0 || m.depth2 <= 0.0)) {
                return false;
            }
            support += 1.0 - share;
            true
        })
        .collect();
    (inliers, support)
}

/// Adjusts the motion with most support, twice, because a better motion has other inliers.
fn solve(input: &PoseInput, motions: &[(&'static str, Se3<Second, First>)], threshold: f64) -> Option<Solution> {
    let tallies: Vec<(Vec<bool>, f64)> = motions.iter().map(|(_, m)| agreement(input, m, threshold)).collect();
    // The judge's motion comes first and stays unless another is clearly better.
    let mut best = 0;
    for k in 1..tallies.len() {
        if tallies[k].1 > 1.02 * tallies[best].1 {
            best = k;
        }
    }
    let (origin, start) = *motions.get(best)?;
    let mut inliers = tallies.into_iter().nth(best)?.0;
    let linear = triangulated(input, &start, &inliers);
    let mut motion = start;
    let mut adjusted = None;
    for _ in 0..3 {
        // With the noise that they show: what is a little off must not pull on what is exact.
        let sigma_px = noise_of(input, &motion, &inliers).clamp(MIN_NOISE_PX, input.sigma_px);
        let seen: Vec<Observation> = chosen(&inliers, input.seen)
            .map(|o| Observation { sigma_px: o.sigma_px.map(|s| s * sigma_px / input.sigma_px), ..*o })
            .collect();
        let found = adjust(input.cameras, &motion, &seen)?;
        motion = found.second_from_first;
        adjusted = Some((found, inliers.clone()));
        let limit = threshold * (INLIER_SIGMAS * sigma_px / (LINE_SIGMAS * input.sigma_px)).min(1.0);
        let next = agreement(input, &motion, limit).0;
        let count = |mask: &[bool]| mask.iter().filter(|i| **i).count();
        if 2 * count(&next) < count(&inliers) {
            break;
        }
        inliers = next;
    }
    let (adjusted, of) = adjusted?;
    let mut points = vec![None; of.len()];
    let mut inliers = of.clone();
    let mut angles = Vec::new();
    let far = 3.0 * std::f64::consts::SQRT_2 * input.sigma_px / input.cameras[0].focal_px();
    for (i, p) in (0..of.len()).filter(|i| of[*i]).zip(&adjusted.points) {
        let ray = p.xy().push(1.0);
        let moved = motion.rotation * ray + motion.translation * p.z;
        let angle = (motion.rotation * ray).angle(&moved);
        angles.push(angle);
        if angle > far {
            // Behind a camera after all.
            inliers[i] = p.z > 0.0 && moved.z > 0.0;
            points[i] = inliers[i].then(|| ray / p.z);
        }
    }
    let mut differences: Vec<f64> = points
        .iter()
        .zip(&linear)
        .filter_map(|(a, b)| Some((a.as_ref()? - b.as_ref()?).norm() / a.as_ref()?.norm()))
        .collect();
    let essential = essential_of(&motion);
    Some(Solution {
        origin,
        second_from_first: motion,
        essential,
        fundamental: fundamental_of(&essential, input.cameras),
        inliers,
        points,
        linear_difference: median(&mut differences),
        median_parallax_rad: median(&mut angles),
        adjusted,
    })
}

/// One sigma of a corner's place, pixels of its scale, that the inliers of a motion show.
fn noise_of(input: &PoseInput, motion: &Se3<Second, First>, inliers: &[bool]) -> f64 {
    let e = essential_of(motion);
    let focal = 0.5 * (input.cameras[0].focal_px() + input.cameras[1].focal_px());
    let scaled = |i: usize| {
        let [a, b] = input.seen[i].sigma_px.map(|s| s / input.sigma_px);
        sampson_squared(&e, &input.x1[i], &input.x2[i]).sqrt() * focal / (0.5 * (a * a + b * b)).sqrt()
    };
    noise((0..inliers.len()).filter(|i| inliers[*i]).map(scaled))
}

/// The items that a mask marks.
fn chosen<'a, T>(mask: &'a [bool], items: &'a [T]) -> impl Iterator<Item = &'a T> {
    mask.iter().zip(items).filter(|(m, _)| **m).map(|(_, item)| item)
}

/// The study's triangulation of the inliers.
fn triangulated(input: &PoseInput, motion: &Se3<Second, First>, inliers: &[bool]) -> Vec<Option<Vector3<f64>>> {
    let views = [Matrix3x4::identity(), motion.matrix()];
    let one = |i: usize| inliers[i].then(|| triangulate(&views, &[input.x1[i], input.x2[i]])).flatten();
    (0..inliers.len()).map(|i| one(i).and_then(|x| euclidean(&x))).collect()
}

/// One sigma of normal noise whose absolute values these are, by their median; NaN of nothing.
pub(super) fn noise(distances: impl Iterator<Item = f64>) -> f64 {
    let mut all: Vec<f64> = distances.collect();
    median(&mut all) / 0.6745
}

/// [`geometry::median`](crate::geometry::median()); NaN of nothing.
pub(super) fn median(values: &mut [f64]) -> f64 {
    crate::geometry::median(values).unwrap_or(f64::NAN)
}
