//! Which pose belongs to which frame and which ground truth.
//!
//! Input: sorted ground truth, sorted estimate, and the frames' timestamps where they are known. Output: pairs of poses and
//! the counts that coverage is made of. A frame counts when its nearest ground-truth sample is at most 20 ms away
//! (nothing is interpolated; the earlier of two equally near ones). An estimated pose belongs to the frame whose timestamp
//! it carries (1 ms is left for other programs' rounding), and each frame takes one pose at most, so that coverage never exceeds 100 %.
//! Cost: linear after sorting.

use nalgebra::Vector3;

use crate::geometry::Se3;
use crate::geometry::frames::{Camera, World};
use crate::trajectory::TumPose;

/// Ground truth further away in time than this does not count.
pub const MAX_TRUTH_DISTANCE_NS: i64 = 20_000_000;
/// An estimate's timestamp may differ from its frame's by this much.
pub const MAX_FRAME_DISTANCE_NS: i64 = 1_000_000;

/// The same instant in the truth and in the estimate, each in its own world.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pair {
    pub timestamp_ns: i64,
    pub truth: Se3<World, Camera>,
    pub estimate: Se3<World, Camera>,
}

/// What coverage is stated of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum CoverageBasis {
    /// Frames with ground truth within 20 ms.
    Frames,
    /// Ground-truth samples, for want of a list of frames; they may be denser than the frames or outlast them.
    GroundTruthSamples,
}

/// One thing that should have a pose: a frame (or a ground-truth sample), in ascending time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Expected {
    pub timestamp_ns: i64,
    /// Where the camera truly was, in the truth's world.
    pub truth_position: Vector3<f64>,
    pub covered: bool,
}

/// The outcome of [`associate`].
#[derive(Debug, Clone, PartialEq)]
pub struct Association {
    pub basis: CoverageBasis,
    /// Ascending time.
    pub pairs: Vec<Pair>,
    /// Coverage's denominator.
    pub expected: Vec<Expected>,
    /// Frames without ground truth within 20 ms: neither for nor against.
    pub frames_without_truth: u64,
    /// Estimated poses without ground truth within 20 ms.
    pub poses_without_truth: u64,
    /// Estimated poses that are no frame's, or a second one of the same frame.
    pub poses_without_frame: u64,
}

/// The sample nearest in time within 20 ms; `samples` ascending. The earlier of two equally near ones.
fn nearest(samples: &[TumPose], timestamp_ns: i64) -> Option<usize> {
    let after = samples.partition_point(|s| s.timestamp_ns <= timestamp_ns);
    let distance = |i: usize| samples.get(i).map(|s| (s.timestamp_ns.abs_diff(timestamp_ns), i));
    let before = after.checked_sub(1).and_then(distance);
    let (distance_ns, index) = [before, distance(after)].into_iter().flatten().min_by_key(|(d, _)| *d)?;
    (distance_ns <= MAX_TRUTH_DISTANCE_NS as u64).then_some(index)
}

/// Pairs up; all three ascending in time.
pub fn associate(truth: &[TumPose], estimate: &[TumPose], frames: Option<&[i64]>) -> Association {
    match frames {
        Some(frames) => by_frames(truth, estimate, frames),
        None => by_samples(truth, estimate),
    }
}

fn by_frames(truth: &[TumPose], estimate: &[TumPose], frames: &[i64]) -> Association {
    let mut out = Association {
        basis: CoverageBasis::Frames,
        pairs: Vec::new(),
        expected: Vec::new(),
        frames_without_truth: 0,
        poses_without_truth: 0,
        poses_without_frame: 0,
    };
    let mut poses = estimate.iter().peekable();
    for &timestamp_ns in frames {
        let mut pose = None;
        while let Some(next) =
            poses.peek().filter(|p| p.timestamp_ns <= timestamp_ns.saturating_add(MAX_FRAME_DISTANCE_NS))
        {
            let belongs = next.timestamp_ns.abs_diff(timestamp_ns) <= MAX_FRAME_DISTANCE_NS as u64;
            if belongs {
                pose = poses.next();
                break;
            }
            poses.next();
            out.poses_without_frame += 1;
        }
        match nearest(truth, timestamp_ns).and_then(|i| truth.get(i)) {
            Some(sample) => {
                let truth_position = sample.world_from_camera.translation;
                out.expected.push(Expected { timestamp_ns, truth_position, covered: pose.is_some() });
                out.pairs.extend(pose.map(|p| Pair {
                    timestamp_ns,
                    truth: sample.world_from_camera,
                    estimate: p.world_from_camera,
                }));
            }
            None => {
                out.frames_without_truth += 1;
                out.poses_without_truth += u64::from(pose.is_some());
            }
        }
    }
    out.poses_without_frame += poses.count() as u64;
    out
}

fn by_samples(truth: &[TumPose], estimate: &[TumPose]) -> Association {
    let expected = truth.iter().map(|s| Expected {
        timestamp_ns: s.timestamp_ns,
        truth_position: s.world_from_camera.translation,
        covered: nearest(estimate, s.timestamp_ns).is_some(),
    });
    let expected = expected.collect();
    let mut pairs = Vec::new();
    for pose in estimate {
        if let Some(sample) = nearest(truth, pose.timestamp_ns).and_then(|i| truth.get(i)) {
            pairs.push(Pair {
                timestamp_ns: pose.timestamp_ns,
                truth: sample.world_from_camera,
                estimate: pose.world_from_camera,
            });
        }
    }
    Association {
        basis: CoverageBasis::GroundTruthSamples,
        poses_without_truth: (estimate.len() - pairs.len()) as u64,
        pairs,
        expected,
        frames_without_truth: 0,
        poses_without_frame: 0,
    }
}
