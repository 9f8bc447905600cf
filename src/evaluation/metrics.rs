//! Errors of an aligned trajectory, and their statistics.
//!
//! Input: pairs of poses in ascending time and the Sim(3) between them. Output, in the truth's unit (metres):
//! - absolute: per pair, distance of the positions and angle between the orientations (Sturm et al., IROS 2012, ATE);
//! - relative: per segment of 1 m of the truth's path, `E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j)` with the estimate scaled (ibid., RPE).
//!   From every pair i, j is the later pair whose path length from i is nearest to 1 m, and counts when it is within 10 %:
//!   the definition of `evo_rpe -d 1 -u m --all_pairs --pairs_from_reference`.
//!
//! Cost: linear. Deliberately not here: interpolation over gaps; a gap's path is the straight line across it.

use nalgebra::UnitQuaternion;

use super::alignment::TruthFromEstimate;
use super::association::Pair;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};

/// Length of the segments of the relative error, metres.
pub const SEGMENT_M: f64 = 1.0;
/// How far a segment may be from that length, metres.
const SEGMENT_TOLERANCE_M: f64 = 0.1;

/// Of a set of non-negative errors.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Statistics {
    pub rmse: f64,
    pub mean: f64,
    pub median: f64,
    pub max: f64,
}

/// `None` of nothing.
pub fn statistics(errors: &[f64]) -> Option<Statistics> {
    if errors.is_empty() {
        return None;
    }
    let n = errors.len() as f64;
    let mut sorted = errors.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    let middle = (sorted.get((sorted.len() - 1) / 2)? + sorted.get(sorted.len() / 2)?) / 2.0;
    Some(Statistics {
        rmse: (errors.iter().map(|e| e * e).sum::<f64>() / n).sqrt(),
        mean: errors.iter().sum::<f64>() / n,
        median: middle,
        max: *sorted.last()?,
    })
}

/// Angle of a rotation, degrees; accurate for small ones, where `acos` is not.
pub fn angle_deg(rotation: &UnitQuaternion<f64>) -> f64 {
    (2.0 * rotation.imag().norm().atan2(rotation.w.abs())).to_degrees()
}

/// One aligned pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    pub timestamp_ns: i64,
    pub truth: Se3<World, Camera>,
    /// The estimate in the truth's world and unit.
    pub estimate: Se3<World, Camera>,
    pub position_error_m: f64,
    pub rotation_error_deg: f64,
}

/// Applies the alignment and measures each pair.
pub fn absolute_errors(pairs: &[Pair], alignment: &TruthFromEstimate) -> Vec<Sample> {
    let measure = |pair: &Pair| {
        let position = alignment.transform(&pair.estimate.translation);
        let rotation = alignment.rotation * pair.estimate.rotation;
        Sample {
            timestamp_ns: pair.timestamp_ns,
            truth: pair.truth,
            estimate: Se3::new(rotation, position),
            position_error_m: (position - pair.truth.translation).norm(),
            rotation_error_deg: angle_deg(&(rotation.inverse() * pair.truth.rotation)),
        }
    };
    pairs.iter().map(measure).collect()
}

/// Errors of one segment of about 1 m.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Segment {
    /// Length of the truth's path, metres.
    pub length_m: f64,
    pub translation_error_m: f64,
    pub rotation_error_deg: f64,
}

/// Path of the truth up to each sample, metres.
pub fn path_lengths(samples: &[Sample]) -> Vec<f64> {
    let mut total = 0.0;
    let mut lengths = Vec::with_capacity(samples.len());
    let mut previous: Option<&Sample> = None;
    for sample in samples {
        total += previous.map_or(0.0, |p| (sample.truth.translation - p.truth.translation).norm());
        lengths.push(total);
        previous = Some(sample);
    }
    lengths
}

/// The error of every segment that begins at a sample and has about [`SEGMENT_M`].
pub fn relative_errors(samples: &[Sample]) -> Vec<Segment> {
    let lengths = path_lengths(samples);
    let mut segments = Vec::new();
    for (i, (start, start_length)) in samples.iter().zip(&lengths).enumerate() {
        // Lengths ascend: the nearest is the last below or the first at and above; of equal ones, the first.
        let above = lengths.partition_point(|l| l - start_length < SEGMENT_M);
        let below = above.checked_sub(1).and_then(|j| lengths.get(j)).map(|last| lengths.partition_point(|l| l < last));
        let nearest = [below.map(|j| j.max(i + 1)), Some(above)]
            .into_iter()
            .flatten()
            .filter_map(|j| Some((j, lengths.get(j)? - start_length)))
            .min_by(|a, b| (a.1 - SEGMENT_M).abs().total_cmp(&(b.1 - SEGMENT_M).abs()));
        let Some((j, length_m)) = nearest.filter(|(_, l)| (l - SEGMENT_M).abs() <= SEGMENT_TOLERANCE_M) else {
            continue;
        };
        let Some(end) = samples.get(j) else { continue };
        let truth = start.truth.inverse() * end.truth;
        let estimate = start.estimate.inverse() * end.estimate;
        let error = truth.inverse() * estimate;
        segments.push(Segment {
            length_m,
            translation_error_m: error.translation.norm(),
            rotation_error_deg: angle_deg(&error.rotation),
        });
    }
    segments
}
