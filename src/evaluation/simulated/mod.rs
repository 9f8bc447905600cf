//! The simulator suite: hard cases with exact truth, their figures in a table, and whether each keeps its promise.
//!
//! Input: a seed, the short or the long form. Output: a [`CaseResult`] a case, as a Markdown table and as JSON.
//! Errors are taken after one Sim(3) over the whole trajectory and stated as a share of the truth's path, which does not depend
//! on a room's size. Nothing is chosen among runs; a case whose figures miss its limits says which.
//!
//! Deliberately not here: CPU and memory of the product (its own process is measured by [`suite`](super::suite)).

pub mod cases;
pub mod consistency;
pub mod drive;

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::path::Path;

use super::{Outcome, Reference, evaluate};
use crate::features::FeaturesConfig;
use crate::map::MapId;
use crate::reconstruction::{ReconstructionConfig, TrackingState};
use crate::trajectory::TumPose;
use cases::{Case, Expectation};
use consistency::Consistency;
use drive::{Drive, DriveError, Record, Run, Sizes};

/// The figures of one case.
#[derive(Debug, Clone, serde::Serialize)]
pub struct CaseResult {
    pub name: &'static str,
    pub what: &'static str,
    pub seed: u64,
    pub seconds: f64,
    pub frames: usize,
    /// Of all frames, the share with a pose in the trajectory, and with one that was published at once, of the map with the most of these.
    pub coverage_percent: f64,
    pub live_percent: f64,
    /// Until the first published pose, s.
    pub first_pose_s: Option<f64>,
    /// RMSE after Sim(3), % of the truth's path: of the trajectory, and of the poses as published.
    pub ate_percent: Option<f64>,
    pub live_ate_percent: Option<f64>,
    pub rotation_deg: Option<f64>,
    pub path_m: f64,
    /// Frames in a row without a published pose, once there was one.
    pub longest_gap: usize,
    pub resets: u64,
    pub relocalisations: u64,
    pub keyframes: usize,
    pub landmarks: usize,
    /// While the camera stood: how far the mean of a second was from that of the first one at the most, and the spread of single
    /// poses, % of the scene's median depth; keyframes and landmarks that were added.
    pub standing: Option<Standing>,
    /// Normalised error squared of the whole pose, of its rotation and of its translation.
    pub consistency: [Option<Consistency>; 3],
    /// From corners to pose, ms: tracked frames p50 and p95, frames without a pose p95 and the longest.
    pub track_ms: [Option<f64>; 2],
    pub lost_ms: [Option<f64>; 2],
    pub sizes: Vec<Sizes>,
    /// Promises that were not kept; empty: all were.
    pub missed: Vec<String>,
    #[serde(skip)]
    pub outcome: Option<Outcome>,
}

/// See [`CaseResult::standing`].
#[derive(Debug, Clone, Copy, serde::Serialize)]
pub struct Standing {
    pub seconds: f64,
    pub drift_percent: f64,
    pub jitter_percent: f64,
    pub keyframes_added: i64,
    pub landmarks_added: i64,
}

/// Drift of a standing camera, % of the scene's depth.
const MAX_DRIFT_PERCENT: f64 = 0.1;
/// A map of a standing camera may still gain what its last movement showed.
const MAX_KEYFRAMES_ADDED: i64 = 2;

/// Runs one case. The trajectory goes to `folder/NAME.txt`.
pub fn run_case(
    case: &Case,
    long: bool,
    features: &FeaturesConfig,
    reconstruction: &ReconstructionConfig,
    folder: &Path,
) -> Result<(CaseResult, Run), DriveError> {
    let seconds = if long { case.long_s } else { case.short_s };
    let what = Drive { simulator: &case.config, steps: case.steps, seconds, features, reconstruction };
    let run = drive::drive(&what, &folder.join(format!("{}.txt", case.name)))?;
    Ok((figures(case, seconds, &run), run))
}

fn judged(run: &Run, estimate: &[TumPose]) -> Option<Outcome> {
    let truth = |r: &Record| TumPose { timestamp_ns: r.timestamp_ns, world_from_camera: r.truth };
    let reference = Reference {
        ground_truth_path: "simulator".into(),
        ground_truth: run.records.iter().map(truth).collect(),
        frames_path: None,
        frames: Some(run.records.iter().map(|r| r.timestamp_ns).collect()),
        notes: Vec::new(),
    };
    evaluate(estimate, &reference).ok()
}

/// Path of the truth over all frames, m.
fn path_m(run: &Run) -> f64 {
    run.records.windows(2).map(|w| (w[1].truth.translation - w[0].truth.translation).norm()).sum()
}

fn quantile(mut values: Vec<f64>, share: f64) -> Option<f64> {
    values.sort_unstable_by(f64::total_cmp);
    let last = values.len().checked_sub(1)?;
    values.get((share * last as f64).round() as usize).copied()
}

fn figures(case: &Case, seconds: f64, run: &Run) -> CaseResult {
    let records = &run.records;
    // As they were published, poses of different maps are unrelated: those of the map with the most.
    let mut poses_of_map = BTreeMap::<MapId, usize>::new();
    for r in records.iter().filter(|r| r.estimate.state == TrackingState::Tracking) {
        *poses_of_map.entry(r.estimate.map).or_default() += 1;
    }
    let largest = poses_of_map.iter().max_by_key(|(map, poses)| (**poses, Reverse(**map))).map(|(map, _)| *map);
    let live: Vec<TumPose> = records
        .iter()
        .filter(|r| Some(r.estimate.map) == largest && r.estimate.state == TrackingState::Tracking)
        .filter_map(|r| {
            Some(TumPose { timestamp_ns: r.timestamp_ns, world_from_camera: r.estimate.world_from_camera? })
        })
        .collect();
    let path = path_m(run);
    let ate = |o: &Option<Outcome>| Some(100.0 * o.as_ref()?.figures.ate_m?.rmse / path).filter(|v| v.is_finite());
    let outcome = judged(run, &run.trajectory);
    let live_outcome = judged(run, &live);
    let count = records.len().max(1) as f64;
    let first = records.iter().position(Record::is_tracking);
    let mut gap = 0;
    let mut longest_gap = 0;
    for r in records.iter().skip(first.unwrap_or(records.len())) {
        gap = if r.is_tracking() { 0 } else { gap + 1 };
        longest_gap = longest_gap.max(gap);
    }
    let nees = consistency::judge(records);
    let of = |f: fn(&consistency::Nees) -> f64, d| Consistency::of(&nees.iter().map(f).collect::<Vec<_>>(), d);
    let times = |tracked: bool| {
        let from = first.unwrap_or(records.len());
        records.iter().skip(from).filter(|r| r.is_tracking() == tracked).map(|r| r.track_ms).collect::<Vec<f64>>()
    };
    let mut result = CaseResult {
        name: case.name,
        what: case.what,
        seed: case.config.seed,
        seconds,
        frames: records.len(),
        coverage_percent: 100.0 * run.trajectory.len() as f64 / count,
        live_percent: 100.0 * live.len() as f64 / count,
        first_pose_s: first
            .and_then(|i| records.get(i))
            .zip(records.first())
            .map(|(r, start)| (r.timestamp_ns - start.timestamp_ns) as f64 * 1e-9),
        ate_percent: ate(&outcome),
        live_ate_percent: ate(&live_outcome),
        rotation_deg: outcome.as_ref().and_then(|o| Some(o.figures.rotation_deg?.rmse)),
        path_m: path,
        longest_gap,
        resets: run.counters.resets,
        relocalisations: run.counters.relocalisations,
        keyframes: run.sizes.last().map_or(0, |s| s.keyframes),
        landmarks: run.sizes.last().map_or(0, |s| s.landmarks),
        standing: case.stands_from_s.and_then(|from| standing(run, from, case.config.rate_hz)),
        consistency: [of(|n| n.pose, 6), of(|n| n.rotation, 3), of(|n| n.translation, 3)],
        track_ms: [quantile(times(true), 0.5), quantile(times(true), 0.95)],
        lost_ms: [quantile(times(false), 0.95), quantile(times(false), 1.0)],
        sizes: run.sizes.clone(),
        missed: Vec::new(),
        outcome,
    };
    result.missed = missed(case, &result, !live.is_empty());
    result
}

fn standing(run: &Run, from_s: f64, rate_hz: f64) -> Option<Standing> {
    let start_ns = run.records.first()?.timestamp_ns;
    let still: Vec<_> = run
        .records
        .iter()
        .filter(|r| (r.timestamp_ns - start_ns) as f64 * 1e-9 >= from_s)
        .filter_map(|r| Some(r.estimate.world_from_camera?.translation))
        .collect();
    let second = (rate_hz.round() as usize).max(1);
    let means: Vec<_> =
        still.chunks_exact(second).map(|c| (c.iter().sum::<nalgebra::Vector3<f64>>() / second as f64, c)).collect();
    let (first, depth) = (means.first()?.0, run.depth?);
    let percent = 100.0 / depth;
    let (mut drift, mut square, mut n) = (0.0f64, 0.0, 0.0);
    for (mean, chunk) in &means {
        drift = drift.max((mean - first).norm());
        square += chunk.iter().map(|p| (p - mean).norm_squared()).sum::<f64>();
        n += chunk.len() as f64;
    }
    let begin = run.sizes.iter().find(|s| s.seconds >= from_s);
    let (begin, end) = (begin.or(run.sizes.last())?, run.sizes.last()?);
    Some(Standing {
        seconds: means.len() as f64,
        drift_percent: drift * percent,
        jitter_percent: (square / n).sqrt() * percent,
        keyframes_added: end.keyframes as i64 - begin.keyframes as i64,
        landmarks_added: end.landmarks as i64 - begin.landmarks as i64,
    })
}

/// What a case promised and did not keep.
fn missed(case: &Case, r: &CaseResult, any_pose: bool) -> Vec<String> {
    let mut missed = Vec::new();
    let limits = match case.expectation {
        Expectation::NoPose => {
            if any_pose {
                missed.push(format!("a pose where none can be: {:.1} % of the frames", r.live_percent));
            }
            return missed;
        }
        Expectation::Poses(limits) => limits,
    };
    if r.coverage_percent < limits.coverage_percent {
        missed.push(format!("coverage {:.1} % < {} %", r.coverage_percent, limits.coverage_percent));
    }
    match r.ate_percent {
        Some(ate) if ate <= limits.ate_percent => {}
        Some(ate) => missed.push(format!("ATE {ate:.2} % > {} % of the path", limits.ate_percent)),
        None => missed.push("no ATE".into()),
    }
    if r.resets > limits.resets {
        missed.push(format!("{} resets > {}", r.resets, limits.resets));
    }
    if r.longest_gap as u64 > limits.gap_frames {
        missed.push(format!("{} frames in a row without a pose > {}", r.longest_gap, limits.gap_frames));
    }
    if let Some(s) = r.standing {
        if s.drift_percent > MAX_DRIFT_PERCENT {
            missed.push(format!("drift {:.3} % > {MAX_DRIFT_PERCENT} % of the depth while standing", s.drift_percent));
        }
        if s.keyframes_added > MAX_KEYFRAMES_ADDED {
            missed.push(format!("{} keyframes added while standing", s.keyframes_added));
        }
    } else if case.stands_from_s.is_some() {
        missed.push("no pose while standing".into());
    }
    missed
}

/// The table in Markdown.
pub fn table(results: &[CaseResult]) -> String {
    const HEADS: [&str; 15] = [
        "case",
        "seed",
        "seconds",
        "frames",
        "coverage %",
        "live %",
        "ATE % of path",
        "live ATE %",
        "rotation °",
        "longest gap",
        "resets",
        "relocalised",
        "keyframes",
        "lost ms p95 / max",
        "kept",
    ];
    let number = |v: Option<f64>, decimals: usize| v.map_or("–".into(), |v| format!("{v:.decimals$}"));
    let mut out = format!("| {} |\n|---|{}\n", HEADS.join(" | "), "---:|".repeat(HEADS.len() - 1));
    for r in results {
        let lost = r.lost_ms[0].map(|p95| format!("{p95:.1} / {}", number(r.lost_ms[1], 1)));
        let cells = [
            format!("{}: {}", r.name, r.what),
            r.seed.to_string(),
            format!("{:.0}", r.seconds),
            r.frames.to_string(),
            format!("{:.1}", r.coverage_percent),
            format!("{:.1}", r.live_percent),
            number(r.ate_percent, 2),
            number(r.live_ate_percent, 2),
            number(r.rotation_deg, 2),
            r.longest_gap.to_string(),
            r.resets.to_string(),
            r.relocalisations.to_string(),
            r.keyframes.to_string(),
            lost.unwrap_or("–".into()),
            if r.missed.is_empty() { "yes".into() } else { format!("no: {}", r.missed.join("; ")) },
        ];
        out += &format!("| {} |\n", cells.join(" | "));
    }
    for (i, (r, s)) in results.iter().filter_map(|r| Some((r, r.standing?))).enumerate() {
        if i == 0 {
            out += "\n| standing | seed | seconds | drift % of depth | jitter % | keyframes added | landmarks added |\n\
                    |---|---:|---:|---:|---:|---:|---:|\n";
        }
        out += &format!(
            "| {} | {} | {:.0} | {:.4} | {:.4} | {:+} | {:+} |\n",
            r.name, r.seed, s.seconds, s.drift_percent, s.jitter_percent, s.keyframes_added, s.landmarks_added
        );
    }
    out
}
