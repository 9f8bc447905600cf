//! One Sim(3) that lays an estimate over the ground truth.
//!
//! Input: pairs of camera poses, estimate and truth, of the same instants. Output: scale, rotation and translation that
//! minimise the squared distances of the positions (Umeyama, "Least-squares estimation of transformation parameters between two
//! point patterns", PAMI 1991, eq. 40-42), and what is weak about them in words; and the SE(3) that does so where the estimate claims to be in metres.
//!
//! On a straight line the positions say nothing about the roll around it: every roll has the same position error. There
//! it is the orientations that choose it, so that a rotation error can be stated at all; position errors are not touched.
//! Cost: linear, 0.1 us a pair.
//!
//! Deliberately not here: robust weights, time offsets. Every pose counts.

use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use super::association::Pair;

/// `x_truth = scale * rotation * x_estimate + translation`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TruthFromEstimate {
    pub scale: f64,
    pub rotation: UnitQuaternion<f64>,
    pub translation: Vector3<f64>,
}

impl TruthFromEstimate {
    /// A position of the estimate in the truth's frame and unit.
    pub fn transform(&self, position: &Vector3<f64>) -> Vector3<f64> {
        self.scale * (self.rotation * position) + self.translation
    }
}

/// The same rotation with the estimate's own lengths, `scale = 1`: of all SE(3) the best one, since Umeyama's rotation does not depend on the scale
/// and the translation takes one mean to the other.
pub fn without_scale(found: &TruthFromEstimate, pairs: &[Pair]) -> TruthFromEstimate {
    let n = pairs.len().max(1) as f64;
    let left = |p: &Pair| p.truth.translation - found.rotation * p.estimate.translation;
    let translation = pairs.iter().map(left).sum::<Vector3<f64>>() / n;
    TruthFromEstimate { scale: 1.0, rotation: found.rotation, translation }
}

/// An alignment and its caveats.
#[derive(Debug, Clone, PartialEq)]
pub struct Aligned {
    pub truth_from_estimate: TruthFromEstimate,
    pub notes: Vec<String>,
}

/// Fewest pairs that are aligned: two points fit any two points.
pub const MIN_PAIRS: usize = 3;
/// Below this ratio of the second to the first singular value of the positions' cross-covariance, one of the two
/// trajectories is a straight line as far as numbers go.
const COLLINEAR_RATIO: f64 = 1e-9;
/// Below this ratio (sideways spread under 1 % of the length) the roll is decided by noise.
const NEARLY_COLLINEAR_RATIO: f64 = 1e-4;

/// The alignment, or why there is none.
pub fn align(pairs: &[Pair]) -> Result<Aligned, String> {
    if pairs.len() < MIN_PAIRS {
        return Err(format!("{} poses have ground truth, at least {MIN_PAIRS} are needed to align", pairs.len()));
    }
    let n = pairs.len() as f64;
    let mean = |f: fn(&Pair) -> Vector3<f64>| pairs.iter().map(f).sum::<Vector3<f64>>() / n;
    let (estimate, truth) = (|p: &Pair| p.estimate.translation, |p: &Pair| p.truth.translation);
    let (mean_estimate, mean_truth) = (mean(estimate), mean(truth));
    let (mut covariance, mut variance_estimate, mut variance_truth) = (Matrix3::zeros(), 0.0, 0.0);
    for pair in pairs {
        let (x, y) = (estimate(pair) - mean_estimate, truth(pair) - mean_truth);
        covariance += y * x.transpose() / n;
        variance_estimate += x.norm_squared() / n;
        variance_truth += y.norm_squared() / n;
    }
    let stands = |variance: f64, mean: &Vector3<f64>| variance.sqrt() <= 1e-9 * (1.0 + mean.norm());
    if stands(variance_truth, &mean_truth) {
        return Err("the ground truth stands still: no scale and no alignment exist".into());
    }
    if stands(variance_estimate, &mean_estimate) {
        return Err("the estimate stands still: no scale and no alignment exist".into());
    }

    const MAX_ITERATIONS: usize = 1000;
    let svd = covariance.try_svd(true, true, f64::EPSILON, MAX_ITERATIONS);
    let (u, d, v_t) = match svd.map(|s| (s.u, s.singular_values, s.v_t)) {
        Some((Some(u), d, Some(v_t))) if d.iter().all(|v| v.is_finite()) => (u, d, v_t),
        _ => return Err("the positions' cross-covariance has no singular value decomposition".into()),
    };
    if d[0] <= f64::EPSILON * (variance_estimate * variance_truth).sqrt() {
        return Err("the estimate's motion has nothing in common with the ground truth's".into());
    }
    let mut notes = Vec::new();
    let (rotation, trace) = if d[1] < COLLINEAR_RATIO * d[0] {
        notes.push("the positions lie on a straight line: the roll about it comes from the orientations".into());
        (about_a_line(pairs, &u.column(0).into_owned(), &v_t.row(0).transpose()), d[0])
    } else {
        if d[1] < NEARLY_COLLINEAR_RATIO * d[0] {
            notes.push("the positions lie nearly on a straight line: rotation errors are poorly determined".into());
        }
        // Eq. 43: a reflection is no rotation.
        let sign = if u.determinant() * v_t.determinant() < 0.0 { -1.0 } else { 1.0 };
        let rotation = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, sign)) * v_t;
        let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
        (rotation, d[0] + d[1] + sign * d[2])
    };
    let scale = trace / variance_estimate;
    let translation = mean_truth - scale * (rotation * mean_estimate);
    Ok(Aligned { truth_from_estimate: TruthFromEstimate { scale, rotation, translation }, notes })
}

/// The rotation that takes the unit vector `line_estimate` to `line_truth` and, of all those, minimises the squared chordal
/// distances of the orientations: with `N = sum R_truth (R_0 R_estimate)^T`, maximise `trace(N^T Rot(line_truth, roll))`.
fn about_a_line(pairs: &[Pair], line_truth: &Vector3<f64>, line_estimate: &Vector3<f64>) -> UnitQuaternion<f64> {
    let start = UnitQuaternion::rotation_between(line_estimate, line_truth).unwrap_or_else(|| {
        // Opposite directions: half a turn about any axis across.
        let across = if line_truth.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() };
        let axis = nalgebra::Unit::new_normalize(line_truth.cross(&across));
        UnitQuaternion::from_axis_angle(&axis, std::f64::consts::PI)
    });
    let mut n = Matrix3::zeros();
    for pair in pairs {
        let estimate = (start * pair.estimate.rotation).to_rotation_matrix();
        n += pair.truth.rotation.to_rotation_matrix().matrix() * estimate.matrix().transpose();
    }
    let along_cosine = n.trace() - line_truth.dot(&(n * line_truth));
    let along_sine = (n.transpose() * line_truth.cross_matrix()).trace();
    let roll = along_sine.atan2(along_cosine);
    UnitQuaternion::from_axis_angle(&nalgebra::Unit::new_normalize(*line_truth), roll) * start
}
