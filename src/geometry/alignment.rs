//! Similarity or rigid alignment of point sets.
//!
//! Pairs of points (`from`, `to`) -> the `to_from_from` that makes `sum |to - (s R from + t)|²` smallest, with scale
//! (Sim3) or without (s = 1). Umeyama, Least-squares estimation of transformation parameters between two point
//! patterns, PAMI 1991, eq. 40-42. Closed form; about 1 us and 20 ns a pair.
//!
//! Used by the evaluation of trajectories and by loop closing; outliers are the caller's business (see
//! [`estimate_similarity`] for matched landmarks of two keyframes).

use nalgebra::{Matrix3, Vector2, Vector3};

use super::point_set::chance_near_point;
use super::ransac::{self, Estimator, RansacOptions, Workspace};
use super::rotation::quaternion;
use super::sim3::Sim3;

/// Second to first extent of a point set below which it counts as a line.
const COLLINEAR: f64 = 1e-6;

/// Why point sets cannot be aligned.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum AlignmentError {
    #[error("point sets of {from} and {to} points: every point needs a partner")]
    LengthMismatch { from: usize, to: usize },
    #[error("{count} pairs of points: an alignment needs 3")]
    TooFewPoints { count: usize },
    #[error("a coordinate is not a finite number")]
    NotFinite,
    #[error("the points lie on a line: the rotation about it is open")]
    Collinear,
}

/// The alignment and how well it holds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Alignment<To, From> {
    pub to_from_from: Sim3<To, From>,
    /// Root mean square distance after the alignment, in `To`'s unit.
    pub rmse: f64,
    /// Extent of the points across their main direction, as a share of the extent along it (the narrower of both sets).
    /// Small: the rotation about that direction rests on little.
    pub breadth: f64,
}

/// Least squares alignment; `with_scale: false` keeps the scale at one.
pub fn align<To, From>(
    from: &[Vector3<f64>],
    to: &[Vector3<f64>],
    with_scale: bool,
) -> Result<Alignment<To, From>, AlignmentError> {
    if from.len() != to.len() {
        return Err(AlignmentError::LengthMismatch { from: from.len(), to: to.len() });
    }
    if from.len() < 3 {
        return Err(AlignmentError::TooFewPoints { count: from.len() });
    }
    let pairs = || from.iter().copied().zip(to.iter().copied());
    let (to_from_from, breadth) = umeyama(pairs().map(|(a, b)| (a, b, 1.0)), with_scale)?;
    let sum: f64 = pairs().map(|(a, b)| (to_from_from.transform(&a) - b).norm_squared()).sum();
    Ok(Alignment { to_from_from, rmse: (sum / from.len() as f64).sqrt(), breadth })
}

/// Umeyama's solution of weighted pairs, and the breadth of the narrower set.
fn umeyama<To, From>(
    pairs: impl Iterator<Item = (Vector3<f64>, Vector3<f64>, f64)> + Clone,
    with_scale: bool,
) -> Result<(Sim3<To, From>, f64), AlignmentError> {
    let (mut weights, mut mean_from, mut mean_to) = (0.0, Vector3::zeros(), Vector3::zeros());
    for (a, b, w) in pairs.clone() {
        weights += w;
        mean_from += a * w;
        mean_to += b * w;
    }
    mean_from /= weights;
    mean_to /= weights;
    let mut cross = Matrix3::zeros();
    let (mut spread_from, mut spread_to) = (Matrix3::zeros(), Matrix3::zeros());
    for (a, b, w) in pairs {
        let (a, b) = (a - mean_from, b - mean_to);
        cross += b * a.transpose() * (w / weights);
        spread_from += a * a.transpose() * (w / weights);
        spread_to += b * b.transpose() * (w / weights);
    }
    if !cross.iter().chain(spread_from.iter()).chain(spread_to.iter()).all(|v| v.is_finite()) {
        return Err(AlignmentError::NotFinite);
    }
    let breadth = breadth(&spread_from).min(breadth(&spread_to));
    // Written so that NaN (no extent at all) fails.
    if !(breadth > COLLINEAR) {
        return Err(AlignmentError::Collinear);
    }
    let svd = cross.try_svd(true, true, f64::EPSILON, 200).ok_or(AlignmentError::NotFinite)?;
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else { return Err(AlignmentError::NotFinite) };
    // S of eq. 39: no reflections.
    let sign = Vector3::new(1.0, 1.0, (u * v_t).determinant().signum());
    let rotation = u * Matrix3::from_diagonal(&sign) * v_t;
    let scale = if with_scale { svd.singular_values.dot(&sign) / spread_from.trace() } else { 1.0 };
    if !(scale > 0.0 && scale.is_finite()) {
        return Err(AlignmentError::Collinear);
    }
    Ok((Sim3::new(scale, quaternion(&rotation), mean_to - rotation * mean_from * scale), breadth))
}

/// Square root of the ratio of the second to the first eigenvalue of a covariance.
fn breadth(covariance: &Matrix3<f64>) -> f64 {
    let mut e = covariance.symmetric_eigenvalues();
    e.as_mut_slice().sort_unstable_by(f64::total_cmp);
    (e[1].max(0.0) / e[2]).sqrt()
}

/// Landmarks that two keyframes both have, each in its own camera's coordinates, for the robust loop.
struct Problem<'a> {
    from: &'a [Vector3<f64>],
    to: &'a [Vector3<f64>],
    /// Where the points of `to` are seen.
    seen: Vec<Vector2<f64>>,
    with_scale: bool,
}

/// A similarity and its inverse: both are needed for every residual.
#[derive(Clone)]
struct TwoWay<To, From> {
    forward: Sim3<To, From>,
    backward: Sim3<From, To>,
}

#[inline]
fn reprojection_squared(point: &Vector3<f64>, seen: &Vector3<f64>) -> f64 {
    if point.z <= 0.0 {
        return f64::INFINITY;
    }
    (Vector2::new(point.x / point.z, point.y / point.z) - Vector2::new(seen.x / seen.z, seen.y / seen.z)).norm_squared()
}

/// Marker of the loop's own frames: their names are given back at the end.
#[derive(Clone)]
struct Here;

impl Estimator for Problem<'_> {
    type Model = TwoWay<Here, Here>;
    const SAMPLE_SIZE: usize = 3;

    fn data_count(&self) -> usize {
        self.from.len()
    }

    fn solve_minimal(&self, sample: &[usize], models: &mut Vec<Self::Model>) {
        let pairs = sample.iter().map(|&i| (self.from[i], self.to[i], 1.0));
        models.extend(umeyama(pairs, self.with_scale).ok().map(|(s, _)| TwoWay { forward: s, backward: s.inverse() }));
    }

    #[inline]
    fn residual_squared(&self, model: &Self::Model, i: usize) -> f64 {
        let there = reprojection_squared(&model.forward.transform(&self.from[i]), &self.to[i]);
        let back = reprojection_squared(&model.backward.transform(&self.to[i]), &self.from[i]);
        0.5 * (there + back)
    }

    fn refit(&self, _: &Self::Model, inliers: &[usize]) -> Option<Self::Model> {
        // A landmark's position errs in proportion to its depth.
        let pairs = inliers.iter().map(|&i| (self.from[i], self.to[i], self.to[i].z.powi(-2)));
        umeyama(pairs, self.with_scale).ok().map(|(s, _)| TwoWay { forward: s, backward: s.inverse() })
    }

    fn chance(&self, threshold: f64) -> f64 {
        chance_near_point(&self.seen, threshold)
    }
}

/// A similarity between two cameras and what it rests on.
#[derive(Debug, Clone, PartialEq)]
pub struct SimilarityEstimate<To, From> {
    pub to_from_from: Sim3<To, From>,
    /// One a pair.
    pub inliers: Vec<bool>,
    pub inlier_count: usize,
    pub iterations: usize,
    /// MSAC score, `sum min(r² / T², 1)`.
    pub score: f64,
    pub log10_false_alarms: f64,
}

/// The similarity between two keyframes' cameras that most of their common landmarks agree with. Points are in the
/// coordinates of their own camera (z forward); the residual is the reprojection error in both cameras, normalised units
/// (root of the mean square of the two). `None` for no model, points behind their camera or not finite.
pub fn estimate_similarity<To, From>(
    from: &[Vector3<f64>],
    to: &[Vector3<f64>],
    with_scale: bool,
    options: &RansacOptions,
) -> Option<SimilarityEstimate<To, From>> {
    let visible = |p: &Vector3<f64>| p.z > 0.0 && p.iter().all(|v| v.is_finite());
    if from.len() != to.len() || !from.iter().chain(to).all(visible) {
        return None;
    }
    let seen = to.iter().map(|p| Vector2::new(p.x / p.z, p.y / p.z)).collect();
    let problem = Problem { from, to, seen, with_scale };
    let mut workspace = Workspace::default();
    let found = ransac::estimate(&problem, options, &mut workspace)?;
    let s = found.model.forward;
    Some(SimilarityEstimate {
        to_from_from: Sim3::new(s.scale, s.rotation, s.translation),
        inliers: workspace.mask().to_vec(),
        inlier_count: found.inlier_count,
        iterations: found.iterations,
        score: found.score,
        log10_false_alarms: found.log10_false_alarms,
    })
}

#[cfg(test)]
mod tests {
    use super::super::random::Random;
    use super::super::synthetic::random_rotation;
    use super::*;

    #[derive(Debug, Clone, Copy, PartialEq)]
    struct A;
    #[derive(Debug, Clone, Copy, PartialEq)]
    struct B;

    fn cloud(random: &mut Random, count: usize) -> Vec<Vector3<f64>> {
        (0..count)
            .map(|_| Vector3::new(random.uniform(-2.0, 2.0), random.uniform(-1.5, 1.5), random.uniform(3.0, 8.0)))
            .collect()
    }

    fn truth(random: &mut Random, angle: f64) -> Sim3<A, B> {
        let t = Vector3::new(random.normal(), random.normal(), random.normal()) * 0.3;
        Sim3::new(random.uniform(0.5, 2.0), random_rotation(random, angle), t)
    }

    #[test]
    fn eq_40_to_42_give_the_exact_similarity_back() {
        for seed in 0..100 {
            let mut random = Random::new(seed);
            let s = truth(&mut random, 3.0);
            let count = 3 + random.below(40);
            let from = cloud(&mut random, count);
            let to: Vec<_> = from.iter().map(|p| s.transform(p)).collect();
            let found = align::<A, B>(&from, &to, true).expect("a similarity");
            let tolerance = 1e-9 / found.breadth;
            assert!((found.to_from_from.scale - s.scale).abs() < tolerance && found.rmse < tolerance, "seed {seed}");
            assert!(found.to_from_from.rotation.angle_to(&s.rotation) < tolerance.max(1e-7), "seed {seed}");
            let rigid: Vec<_> = from.iter().map(|p| s.rigid().transform(p)).collect();
            let found = align::<A, B>(&from, &rigid, false).expect("a motion");
            assert!(found.to_from_from.scale == 1.0 && found.rmse < tolerance, "seed {seed}: {found:?}");
        }
    }

    #[test]
    fn a_mirrored_set_gives_a_rotation_and_not_a_reflection() {
        let mut random = Random::new(3);
        let from = cloud(&mut random, 30);
        let mirrored: Vec<_> = from.iter().map(|p| Vector3::new(-p.x, p.y, p.z)).collect();
        let found = align::<A, B>(&from, &mirrored, true).expect("the nearest similarity");
        assert!(found.rmse > 0.1);
    }

    #[test]
    fn degenerate_sets_are_told() {
        let mut random = Random::new(1);
        let points = cloud(&mut random, 10);
        let run = |a: &[Vector3<f64>], b: &[Vector3<f64>]| align::<A, B>(a, b, true);
        assert_eq!(run(&points[..2], &points[..2]), Err(AlignmentError::TooFewPoints { count: 2 }));
        assert_eq!(run(&points, &points[..9]), Err(AlignmentError::LengthMismatch { from: 10, to: 9 }));
        let line: Vec<_> = (0..10).map(|i| Vector3::new(1.0, 2.0, 3.0) * f64::from(i)).collect();
        assert_eq!(run(&line, &points), Err(AlignmentError::Collinear));
        assert_eq!(run(&points, &line), Err(AlignmentError::Collinear));
        assert_eq!(run(&[points[0]; 5], &points[..5]), Err(AlignmentError::Collinear));
        let mut nan = points.clone();
        nan[4].y = f64::NAN;
        assert_eq!(run(&nan, &points), Err(AlignmentError::NotFinite));
        assert_eq!(run(&points, &nan), Err(AlignmentError::NotFinite));
    }

    #[test]
    fn half_wrong_landmarks_leave_the_similarity() {
        for seed in 0..20 {
            let mut random = Random::new(seed);
            let s = truth(&mut random, 0.1);
            let from = cloud(&mut random, 120);
            let to: Vec<_> = from
                .iter()
                .enumerate()
                .map(|(i, p)| {
                    let noise = 1.0 + 0.01 * random.normal();
                    let p = if i % 2 == 0 { *p } else { cloud(&mut random, 1)[0] };
                    s.transform(&(p * noise))
                })
                .collect();
            if to.iter().any(|p| p.z <= 0.0) {
                continue;
            }
            let options = RansacOptions::new(0.006);
            let found = estimate_similarity::<A, B>(&from, &to, true, &options).expect("a similarity");
            // 1 % depth noise over sqrt(60).
            assert!((found.to_from_from.scale / s.scale - 1.0).abs() < 0.01, "seed {seed}: {found:?}");
            assert!(found.to_from_from.rotation.angle_to(&s.rotation) < 0.01, "seed {seed}");
            let mut shuffled = to.clone();
            shuffled.rotate_left(7);
            assert!(estimate_similarity::<A, B>(&from, &shuffled, true, &options).is_none(), "seed {seed}: noise");
        }
    }
}
