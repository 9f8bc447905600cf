//! One way (a detector with a matcher) on one pair, held against what is known of the pair.
//!
//! Input: a [`Task`] and what the chain gave. Output: [`Score`]; what has no truth is `None`, never zero.
//! - Repeatability (Schmid, Mohr, Bauckhage, IJCV 2000): of the corners that both pictures can show, the share that has a corner
//!   of the other picture within 1.5 px of where the homography puts it, one to one; of the smaller number of both.
//! - A match is correct within 3 px of where the homography puts it, or (depth unknown) of its true epipolar line; points near
//!   a line by chance count, so this is an upper bound there.
//! - Errors of a pose: angle of the rotation that is left, angle between the translations; a pair without a pose has none.
//! - Annotated points: median Sampson distance from F.
//!
//! Cost: n m distances for the repeatability.

use nalgebra::{Matrix3, Vector2};
use serde::Serialize;

use super::pairs::Task;
use crate::geometry::epipolar::sampson_squared;
use crate::geometry::homography::{TwoWay, apply};
use crate::workbench::detect::{Corners, Detector};
use crate::workbench::pairing::Matcher;
use crate::workbench::pose::median;
use crate::workbench::two_view::{Outcome, TwoView};

/// A corner is repeated within this distance, pixels.
const REPEATED_PX: f64 = 1.5;
/// A match is correct within this distance, pixels.
const CORRECT_PX: f64 = 3.0;

/// How one way did on one pair.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Score {
    pub pair: String,
    pub group: String,
    /// `None`: the matches came with the pictures.
    pub detector: Option<Detector>,
    pub matcher: Option<Matcher>,
    pub corners: [usize; 2],
    pub repeatability: Option<f64>,
    pub matches: usize,
    pub correct: Option<usize>,
    pub inliers: usize,
    /// Inliers / matches; `None` without a model.
    pub inlier_share: Option<f64>,
    /// Correct ones among the inliers / inliers.
    pub inlier_precision: Option<f64>,
    /// Name of the outcome.
    pub outcome: String,
    /// Whether a pose was possible and asked for.
    pub wants_pose: bool,
    pub rotation_error_deg: Option<f64>,
    pub direction_error_deg: Option<f64>,
    /// Median Sampson distance of the annotated points from F, pixels.
    pub annotated_px: Option<f64>,
    /// Angle of the inliers' epipolar lines with the rows, degrees; rectified pairs only: tilt of the whole bundle (median of
    /// the signed angles), median and largest of each line's.
    pub row_tilt_deg: Option<f64>,
    pub row_angle_deg: Option<f64>,
    pub largest_row_angle_deg: Option<f64>,
    pub corners_ms: f64,
    pub matching_ms: f64,
    pub total_ms: f64,
}

/// Holds a result against the truth. `size_b`: of the second picture, pixels.
pub fn score(task: &Task, way: Option<(Detector, Matcher)>, result: &TwoView, sizes: [(usize, usize); 2]) -> Score {
    let truth = &task.truth;
    let correct: Option<Vec<bool>> = correct_matches(task, result);
    let model = result.epipolar.is_some();
    let inliers = result.inliers();
    let count = inliers.iter().filter(|i| **i).count();
    let solution = result.pose.as_ref().and_then(|p| p.solution.as_ref());
    let pose_errors = solution.zip(truth.second_from_first.as_ref()).map(|(s, t)| {
        let rotation = s.second_from_first.rotation.angle_to(&t.rotation).to_degrees();
        (rotation, s.second_from_first.translation.angle(&t.translation).to_degrees())
    });
    let fundamental = result.fundamental();
    let row_angles = fundamental.filter(|_| truth.rectified).map(|f| row_angles_deg(&f, result, &inliers));
    let time = |step: &str| result.times.iter().filter(|(name, _)| *name == step).map(|(_, ms)| ms).sum();
    Score {
        pair: task.name.clone(),
        group: task.group.clone(),
        detector: way.map(|w| w.0),
        matcher: way.map(|w| w.1),
        corners: [result.corners[0].plain_count(), result.corners[1].plain_count()],
        repeatability: way.and(truth.homography).and_then(|h| repeatability(&h, &result.corners, sizes)),
        matches: result.pairs.len(),
        correct: correct.as_ref().map(|c| c.iter().filter(|c| **c).count()),
        inliers: count,
        inlier_share: (model && !result.pairs.is_empty()).then(|| count as f64 / result.pairs.len() as f64),
        inlier_precision: correct
            .filter(|_| count > 0)
            .map(|c| c.iter().zip(&inliers).filter(|(c, i)| **c && **i).count() as f64 / count as f64),
        outcome: name_of(&result.outcome),
        wants_pose: task.cameras.is_some() && truth.second_from_first.is_some(),
        rotation_error_deg: pose_errors.map(|e| e.0),
        direction_error_deg: pose_errors.map(|e| e.1),
        annotated_px: fundamental.filter(|_| !truth.annotated.is_empty()).map(|f| {
            let mut distances: Vec<f64> =
                truth.annotated.iter().map(|[a, b]| sampson_squared(&f, a, b).sqrt()).collect();
            median(&mut distances)
        }),
        row_tilt_deg: row_angles.map(|a| a[0]),
        row_angle_deg: row_angles.map(|a| a[1]),
        largest_row_angle_deg: row_angles.map(|a| a[2]),
        corners_ms: time("corners") + time("tilted views"),
        matching_ms: time("matches"),
        total_ms: result.total_ms(),
    }
}

/// The outcome's name as in the JSON.
fn name_of(outcome: &Outcome) -> String {
    serde_json::to_value(outcome)
        .ok()
        .and_then(|v| v.get("name").and_then(|n| n.as_str().map(str::to_owned)))
        .unwrap_or_default()
}

/// One a match; `None` without truth.
fn correct_matches(task: &Task, result: &TwoView) -> Option<Vec<bool>> {
    let near = |distance: f64| distance <= CORRECT_PX;
    if let Some(h) = &task.truth.homography {
        return Some(result.pairs.iter().map(|p| near((apply(h, &p.a) - p.b).norm())).collect());
    }
    let f = task.truth.fundamental?;
    Some(result.ideal.iter().map(|[a, b]| near(sampson_squared(&f, a, b).sqrt())).collect())
}

/// Angles of the inliers' epipolar lines, in either picture, with the rows, degrees: tilt (not negative), median, largest.
fn row_angles_deg(f: &Matrix3<f64>, result: &TwoView, inliers: &[bool]) -> [f64; 3] {
    let mut signed = Vec::new();
    for ([a, b], _) in result.ideal.iter().zip(inliers).filter(|(_, i)| **i) {
        for line in [f * a.push(1.0), f.tr_mul(&b.push(1.0))] {
            // The line a x + b y + c = 0 runs along (b, -a); which of both ways does not matter.
            signed.push((-line.x * line.y.signum()).atan2(line.y.abs()).to_degrees());
        }
    }
    let mut angles: Vec<f64> = signed.iter().map(|a| a.abs()).collect();
    let largest = angles.iter().copied().fold(0.0, f64::max);
    [median(&mut signed).abs(), median(&mut angles), largest]
}

/// See the module. `None` when the homography has no inverse or the pictures share nothing.
fn repeatability(h: &Matrix3<f64>, corners: &[Corners; 2], sizes: [(usize, usize); 2]) -> Option<f64> {
    let both = TwoWay::new(h)?;
    let inside = |p: &Vector2<f64>, (w, h): (usize, usize)| {
        p.x >= 0.0 && p.y >= 0.0 && p.x <= w as f64 - 1.0 && p.y <= h as f64 - 1.0
    };
    // Those that the other picture can show, in the second picture's pixels.
    let [a, b] = [&corners[0], &corners[1]].map(|c| &c.keypoints[..c.plain_count()]);
    let first: Vec<Vector2<f64>> =
        a.iter().map(|k| apply(&both.forward, &k.position)).filter(|p| inside(p, sizes[1])).collect();
    let second: Vec<Vector2<f64>> =
        b.iter().map(|k| k.position).filter(|p| inside(&apply(&both.backward, p), sizes[0])).collect();
    let smaller = first.len().min(second.len());
    if smaller == 0 {
        return None;
    }
    let mut near: Vec<(f64, usize, usize)> = Vec::new();
    for (i, p) in first.iter().enumerate() {
        for (j, q) in second.iter().enumerate() {
            let squared = (p - q).norm_squared();
            if squared <= REPEATED_PX * REPEATED_PX {
                near.push((squared, i, j));
            }
        }
    }
    // The nearest first, each corner once.
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (mut used_a, mut used_b) = (vec![false; first.len()], vec![false; second.len()]);
    let mut repeated = 0;
    for (_, i, j) in near {
        if !used_a[i] && !used_b[j] {
            (used_a[i], used_b[j]) = (true, true);
            repeated += 1;
        }
    }
    Some(repeated as f64 / smaller as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::workbench::detect::Keypoint;

    fn corners(places: &[(f64, f64)]) -> Corners {
        let keypoint = |&(x, y): &(f64, f64)| Keypoint {
            position: Vector2::new(x, y),
            scale: 0,
            size_px: 1.0,
            response: 1.0,
            attributes: None,
            descriptor: None,
        };
        Corners { keypoints: places.iter().map(keypoint).collect(), found: places.len(), scales: vec![] }
    }

    #[test]
    fn repeatability_counts_each_corner_once_and_only_what_both_show() {
        let shift = Matrix3::new(1.0, 0.0, 50.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0);
        // Two near the same one, one that leaves the second picture, one unseen.
        let first = corners(&[(10.0, 10.0), (10.5, 10.0), (90.0, 10.0), (20.0, 70.0)]);
        let second = corners(&[(60.0, 10.2), (99.0, 99.0), (70.0, 72.0), (10.0, 10.0)]);
        // Shared: three of the first; three of the second (the last comes from outside); one is within 1.5 px.
        let share = repeatability(&shift, &[first, second], [(100, 100), (100, 100)]).expect("shared");
        assert!((share - 1.0 / 3.0).abs() < 1e-12, "{share}");
        assert!(repeatability(&Matrix3::zeros(), &[corners(&[]), corners(&[])], [(9, 9), (9, 9)]).is_none());
    }
}
