//! How good is a trajectory? Error and coverage over all frames, in one place and counted in one way.
//!
//! Input: an estimate and a [`Reference`]. Output: [`Evaluation`] (figures) and its samples (for the plots).
//! - Coverage: of every frame of `rgb.txt` that has ground truth within 20 ms, the share with a pose ([`association`]).
//! - One Sim(3) over all matched poses of the file ([`alignment`]), then ATE, rotation error and relative error a metre
//!   ([`metrics`]). They agree with `evo_ape -as`, `evo_ape -as -r angle_deg` and `evo_rpe -as -d 1 -u m` (sources: each module).
//! - For an estimate that claims to be in metres the same errors after an SE(3) (`evo_ape -a`, `evo_rpe -a`), and the scale itself ([`MetricFigures`]).
//! - Units: the ground truth's, taken as metres; degrees.
//!
//! [`suite`] replays many sequences and tabulates them.
//!
//! Deliberately not here: choosing the best of several runs, cutting a file into pieces, leaving out frames.

use std::path::Path;

use crate::trajectory::{TrajectoryError, TumPose};

pub mod alignment;
pub mod association;
pub mod child;
mod ground_truth;
pub mod metrics;
pub mod simulated;
pub mod suite;

#[cfg(test)]
mod tests;

use association::{CoverageBasis, Expected, associate};
pub use ground_truth::Reference;
use metrics::{Sample, Statistics, absolute_errors, path_lengths, relative_errors, statistics};

/// Why nothing can be evaluated.
#[derive(Debug, thiserror::Error)]
pub enum EvaluationError {
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
    #[error("no frame of {frames} has ground truth within 20 ms in {ground_truth}: do they belong together?")]
    NoFrameWithTruth { frames: String, ground_truth: String },
}

/// The Sim(3) as numbers: `x_truth = scale * rotation * x_estimate + translation`.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct AlignmentFigures {
    /// Metres in a map unit.
    pub scale: f64,
    pub rotation_xyzw: [f64; 4],
    pub translation_m: [f64; 3],
}

/// Relative error over segments of 1 m (within 10 %) of the truth's path.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct RelativeFigures {
    pub segments: u64,
    /// Of a metre.
    pub translation_percent: Statistics,
    pub rotation_deg_per_m: Statistics,
}

/// How far off an estimate is that claims to be in metres: no scale is taken from the truth.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct MetricFigures {
    /// True metres in a metre of the estimate, that of the Sim(3) alignment; 1 is right.
    pub scale: f64,
    /// Distance of the positions after the SE(3) alignment, m.
    pub ate_m: Statistics,
    /// Relative error of the estimate's own lengths.
    pub relative: Option<RelativeFigures>,
}

/// The figures of one trajectory.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Evaluation {
    pub coverage_basis: CoverageBasis,
    /// Frames (or samples) that have ground truth: coverage's denominator.
    pub expected: u64,
    /// Those of them that have a pose.
    pub covered: u64,
    pub coverage_percent: f64,
    /// Frames without ground truth within 20 ms: not judged.
    pub frames_without_truth: u64,
    /// From the first expected frame to the first with a pose, s.
    pub first_pose_after_s: Option<f64>,
    /// Longest run of expected frames without a pose, once there was one.
    pub longest_gap: u64,
    pub estimate_poses: u64,
    /// Poses whose timestamp is no frame's, or a second one of a frame: not judged.
    pub poses_without_frame: u64,
    pub poses_without_truth: u64,
    /// Poses that the errors are taken over.
    pub matched_poses: u64,
    /// Path of the ground truth over the matched poses, m.
    pub path_m: f64,
    pub alignment: Option<AlignmentFigures>,
    /// Distance of the positions after alignment, m.
    pub ate_m: Option<Statistics>,
    /// Angle between the orientations after alignment.
    pub rotation_deg: Option<Statistics>,
    pub relative: Option<RelativeFigures>,
    /// What a reader of the figures must know.
    pub notes: Vec<String>,
}

/// Figures and what they were made of.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    pub figures: Evaluation,
    /// Matched and aligned, ascending time; empty where there is no alignment.
    pub samples: Vec<Sample>,
    /// Ascending time.
    pub expected: Vec<Expected>,
    /// The same errors without a scale; `None` where there is no alignment.
    pub metric: Option<MetricFigures>,
}

/// Judges `estimate` (ascending time, possibly empty) by `reference`.
pub fn evaluate(estimate: &[TumPose], reference: &Reference) -> Result<Outcome, EvaluationError> {
    let association = associate(&reference.ground_truth, estimate, reference.frames.as_deref());
    if association.expected.is_empty() {
        let name = |path: &Path| path.display().to_string();
        return Err(EvaluationError::NoFrameWithTruth {
            frames: reference.frames_path.as_deref().map(name).unwrap_or_default(),
            ground_truth: name(&reference.ground_truth_path),
        });
    }
    let mut notes = reference.notes.clone();
    if association.poses_without_frame > 0 {
        notes.push(format!("{} poses carry no frame's timestamp and are not judged", association.poses_without_frame));
    }
    let mut samples = Vec::new();
    let (mut alignment, mut metric) = (None, None);
    match alignment::align(&association.pairs) {
        Ok(aligned) => {
            notes.extend(aligned.notes);
            let found = aligned.truth_from_estimate;
            samples = absolute_errors(&association.pairs, &found);
            metric = metric_figures(&association.pairs, &found);
            let (q, t) = (found.rotation.coords, found.translation);
            alignment = Some(AlignmentFigures {
                scale: found.scale,
                rotation_xyzw: [q.x, q.y, q.z, q.w],
                translation_m: [t.x, t.y, t.z],
            });
        }
        Err(reason) => notes.push(format!("no errors: {reason}")),
    }
    let path_m = path_lengths(&samples).last().copied().unwrap_or(0.0);
    let relative = relative_figures(&samples);
    if relative.is_none() && alignment.is_some() {
        notes.push(format!("no relative error: no segment of 1 m in a path of {path_m:.2} m"));
    }

    let expected = &association.expected;
    let covered = expected.iter().filter(|e| e.covered).count() as u64;
    let start_ns = expected.first().map_or(0, |e| e.timestamp_ns);
    let first_pose = expected.iter().position(|e| e.covered);
    let after_first = first_pose.and_then(|i| expected.get(i..)).unwrap_or_default();
    let errors = |f: fn(&Sample) -> f64| statistics(&samples.iter().map(f).collect::<Vec<_>>());
    let figures = Evaluation {
        coverage_basis: association.basis,
        expected: expected.len() as u64,
        covered,
        coverage_percent: 100.0 * covered as f64 / expected.len() as f64,
        frames_without_truth: association.frames_without_truth,
        first_pose_after_s: after_first.first().map(|e| e.timestamp_ns.abs_diff(start_ns) as f64 * 1e-9),
        longest_gap: longest_gap(after_first),
        estimate_poses: estimate.len() as u64,
        poses_without_frame: association.poses_without_frame,
        poses_without_truth: association.poses_without_truth,
        matched_poses: association.pairs.len() as u64,
        path_m,
        alignment,
        ate_m: errors(|s| s.position_error_m),
        rotation_deg: errors(|s| s.rotation_error_deg),
        relative,
        notes,
    };
    Ok(Outcome { figures, samples, expected: association.expected, metric })
}

fn metric_figures(pairs: &[association::Pair], found: &alignment::TruthFromEstimate) -> Option<MetricFigures> {
    let samples = absolute_errors(pairs, &alignment::without_scale(found, pairs));
    let distances: Vec<f64> = samples.iter().map(|sample| sample.position_error_m).collect();
    let relative = relative_figures(&samples);
    Some(MetricFigures { scale: found.scale, ate_m: statistics(&distances)?, relative })
}

fn relative_figures(samples: &[Sample]) -> Option<RelativeFigures> {
    let segments = relative_errors(samples);
    let of = |f: fn(&metrics::Segment) -> f64| statistics(&segments.iter().map(f).collect::<Vec<_>>());
    Some(RelativeFigures {
        segments: segments.len() as u64,
        translation_percent: of(|s| 100.0 * s.translation_error_m / metrics::SEGMENT_M)?,
        rotation_deg_per_m: of(|s| s.rotation_error_deg / metrics::SEGMENT_M)?,
    })
}

fn longest_gap(expected: &[Expected]) -> u64 {
    let (mut longest, mut current) = (0, 0);
    for frame in expected {
        current = if frame.covered { 0 } else { current + 1 };
        longest = longest.max(current);
    }
    longest
}
