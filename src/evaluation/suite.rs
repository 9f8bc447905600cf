//! Many sequences, one table: each is replayed by a process of its own and judged over all its frames.
//!
//! Input: sequence folders (`rgb.txt`, `groundtruth.txt`, pictures, calibration). Output: a [`SuiteResult`], and in the output
//! folder per sequence the trajectory, the live one, the log and replay's summary, and of all of them `table.md` and
//! `results.json`.
//! Accuracy and cost in one row come from the same run. CPU time and peak memory are the whole process's, decoding included.
//! A replay that fails or hangs is a row that says so, and the suite goes on.
//!
//! Deliberately not here: choosing the best of several runs; running two at once (they would disturb each other's times).

use std::ffi::OsString;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use super::child::{Usage, run_bounded};
use super::{Evaluation, EvaluationError, Outcome, Reference, evaluate};
use crate::atomic_file::{WriteError, write_atomically};
use crate::trajectory::{TrajectoryError, TumPose, read_tum};

/// What is read of `replay --json`'s summary. A key that is missing is not known; others are passed over.
#[derive(Debug, Clone, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default)]
pub struct ReplaySummary {
    /// Frames of the recording.
    pub frames: Option<u64>,
    pub tracked: Option<u64>,
    pub unreadable: Option<u64>,
    pub dropped: Option<u64>,
    pub keyframes: Option<u64>,
    pub landmarks: Option<u64>,
    pub resets: Option<u64>,
    pub relocalisations: Option<u64>,
    /// Turns on the spot behind which the scale is an assumption.
    pub blind_turns: Option<u64>,
    /// Places seen again after a long way: the map was corrected, or lay right already.
    pub loops: Option<u64>,
    pub loops_tied: Option<u64>,
    pub stages: Stages,
}

/// Latencies of replay's stages, ms a frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default)]
pub struct Stages {
    pub decode: Option<Quantiles>,
    /// From the decoded grey picture to its corners and tracks.
    pub feature: Option<Quantiles>,
    /// From there to the pose.
    pub track: Option<Quantiles>,
    pub mapping: Option<Quantiles>,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default)]
pub struct Quantiles {
    /// `None` (JSON's null) where nothing was counted.
    pub p50_ms: Option<f64>,
    pub p95_ms: Option<f64>,
    pub p99_ms: Option<f64>,
}

impl Stages {
    /// From the decoded grey picture to the pose, p50 and p95: sums of the stages', so the latter is an upper bound.
    fn picture_to_pose_ms(&self) -> Option<(f64, f64)> {
        let (feature, track) = self.feature.zip(self.track)?;
        Some((feature.p50_ms? + track.p50_ms?, feature.p95_ms? + track.p95_ms?))
    }
}

/// How to run a suite.
#[derive(Debug, Clone)]
pub struct SuiteOptions {
    /// Our own executable, and what comes before the folder (`replay`).
    pub program: PathBuf,
    pub leading_arguments: Vec<OsString>,
    /// Passed on to every replay, after everything else.
    pub more_arguments: Vec<OsString>,
    /// Every frame, with the same result every time; otherwise at the camera's pace.
    pub lockstep: bool,
    pub output: PathBuf,
    /// Longest time for one sequence.
    pub limit: Duration,
    /// What the machine is called in the table.
    pub machine: String,
}

/// Why there is no table. What concerns one sequence only is in its row.
#[derive(Debug, thiserror::Error)]
pub enum SuiteError {
    #[error(transparent)]
    Evaluation(#[from] EvaluationError),
    #[error("{0}: no such folder")]
    NoFolder(String),
    #[error("cannot make {path}: {source}")]
    Output { path: String, source: io::Error },
    #[error(transparent)]
    Write(#[from] WriteError),
}

/// How a sequence went.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
#[serde(rename_all = "snake_case", tag = "status", content = "reason")]
pub enum RunStatus {
    Tracked,
    /// Replay worked and no frame got a pose: right for a camera that stands still, a failure otherwise.
    NoPose,
    Failed(String),
}

/// One row.
#[derive(Debug, Clone, serde::Serialize)]
pub struct SequenceResult {
    pub name: String,
    pub folder: String,
    #[serde(flatten)]
    pub status: RunStatus,
    /// Frames in `rgb.txt`, with or without ground truth.
    pub frames: Option<u64>,
    /// The trajectory as the map knows it at the end.
    pub evaluation: Option<Evaluation>,
    /// The poses as they were published.
    pub live: Option<Evaluation>,
    pub replay: ReplaySummary,
    pub wall_s: Option<f64>,
    pub cpu_ms_per_frame: Option<f64>,
    pub peak_rss_mb: Option<f64>,
    /// What `evaluation` was made of, for a picture. Draw after the whole suite: a caller that has grown large shows in the
    /// memory figures of the children that it starts ([`super::child`]).
    #[serde(skip)]
    pub outcome: Option<Outcome>,
}

/// All rows and where they were measured.
#[derive(Debug, Clone, serde::Serialize)]
pub struct SuiteResult {
    pub machine: String,
    pub version: String,
    pub lockstep: bool,
    pub sequences: Vec<SequenceResult>,
}

impl SuiteResult {
    /// No sequence failed.
    pub fn is_complete(&self) -> bool {
        self.sequences.iter().all(|s| !matches!(s.status, RunStatus::Failed(_)))
    }
}

struct Job {
    name: String,
    folder: PathBuf,
    reference: Reference,
}

/// Replays and judges every folder; `progress` gets a line when a sequence begins and one when it ends.
pub fn run_suite(
    folders: &[PathBuf],
    options: &SuiteOptions,
    mut progress: impl FnMut(&str),
) -> Result<SuiteResult, SuiteError> {
    // Everything that can be known to be wrong is said before the first replay, not after an hour.
    let jobs = jobs(folders)?;
    fs::create_dir_all(&options.output)
        .map_err(|source| SuiteError::Output { path: options.output.display().to_string(), source })?;
    let mut result = SuiteResult {
        machine: options.machine.clone(),
        version: env!("CARGO_PKG_VERSION").to_string(),
        lockstep: options.lockstep,
        sequences: Vec::with_capacity(jobs.len()),
    };
    for (i, job) in jobs.iter().enumerate() {
        progress(&format!("[{}/{}] {}: replaying", i + 1, jobs.len(), job.name));
        let row = run_sequence(job, options);
        progress(&format!("[{}/{}] {}", i + 1, jobs.len(), in_short(&row)));
        result.sequences.push(row);
    }
    write_atomically(&options.output.join("table.md"), |out| io::Write::write_all(out, table(&result).as_bytes()))?;
    write_atomically(&options.output.join("results.json"), |out| {
        serde_json::to_writer_pretty(&mut *out, &result)?;
        io::Write::write_all(out, b"\n")
    })?;
    Ok(result)
}

fn jobs(folders: &[PathBuf]) -> Result<Vec<Job>, SuiteError> {
    let mut jobs: Vec<Job> = Vec::with_capacity(folders.len());
    for folder in folders {
        if !folder.is_dir() {
            return Err(SuiteError::NoFolder(folder.display().to_string()));
        }
        // `.` and `..` have a name only once they are resolved.
        let resolved = fs::canonicalize(folder).unwrap_or_else(|_| folder.clone());
        let base = resolved.file_name().map_or("sequence".into(), |n| n.to_string_lossy().into_owned());
        let same = jobs.iter().filter(|j| j.name == base || j.name.starts_with(&format!("{base}-"))).count();
        let name = if same == 0 { base } else { format!("{base}-{}", same + 1) };
        jobs.push(Job { name, folder: folder.clone(), reference: Reference::open(folder, None)? });
    }
    Ok(jobs)
}

fn run_sequence(job: &Job, options: &SuiteOptions) -> SequenceResult {
    let mut row = SequenceResult {
        name: job.name.clone(),
        folder: job.folder.display().to_string(),
        status: RunStatus::Tracked,
        frames: job.reference.frames.as_ref().map(|f| f.len() as u64),
        evaluation: None,
        live: None,
        replay: ReplaySummary::default(),
        wall_s: None,
        cpu_ms_per_frame: None,
        peak_rss_mb: None,
        outcome: None,
    };
    match replay_and_judge(job, options, &mut row) {
        Ok(outcome) => row.outcome = Some(outcome),
        Err(reason) => row.status = RunStatus::Failed(reason),
    }
    row
}

fn replay_and_judge(job: &Job, options: &SuiteOptions, row: &mut SequenceResult) -> Result<Outcome, String> {
    let file = |ending: &str| options.output.join(format!("{}{ending}", job.name));
    let (trajectory, live, summary, log) = (file(".txt"), file("-live.txt"), file("-summary.json"), file(".log"));
    // What an earlier suite left must not be taken for this one's.
    for old in [&trajectory, &live, &summary, &file(".png")] {
        if let Err(e) = fs::remove_file(old)
            && e.kind() != io::ErrorKind::NotFound
        {
            return Err(format!("cannot remove {}: {e}", old.display()));
        }
    }
    let create = |path: &Path| File::create(path).map_err(|e| format!("cannot write {}: {e}", path.display()));
    let mut command = Command::new(&options.program);
    command.args(&options.leading_arguments).arg(&job.folder).args(options.lockstep.then_some("--lockstep"));
    command.arg("--trajectory").arg(&trajectory).arg("--live-trajectory").arg(&live).arg("--json");
    command.args(&options.more_arguments).stdin(Stdio::null()).stdout(create(&summary)?).stderr(create(&log)?);

    let usage: Usage = run_bounded(&mut command, options.limit).map_err(|e| e.to_string())?;
    row.wall_s = Some(usage.wall_s);
    row.peak_rss_mb = Some(usage.peak_rss_mb);
    // A replay that failed early printed none, and its exit code says more than that.
    let text = fs::read_to_string(&summary).map_err(|e| format!("cannot read {}: {e}", summary.display()))?;
    match serde_json::from_str(&text) {
        Ok(printed) => row.replay = printed,
        Err(e) if usage.status.success() => return Err(format!("{}: {e}", summary.display())),
        Err(_) => {}
    }
    row.frames = row.replay.frames.or(row.frames);
    row.cpu_ms_per_frame = row.frames.filter(|n| *n > 0).map(|n| 1e3 * usage.cpu_s / n as f64);
    let nothing_tracked = row.replay.tracked == Some(0);
    if !usage.status.success() && !nothing_tracked {
        return Err(format!("{}: {}", usage.status, last_line(&log)));
    }
    let estimate = read_estimate(&trajectory, nothing_tracked)?;
    let live_estimate = read_estimate(&live, true)?;
    let judge = |poses: &[TumPose]| evaluate(poses, &job.reference).map_err(|e| e.to_string());
    let outcome = judge(&estimate)?;
    row.live = Some(judge(&live_estimate)?.figures);
    row.evaluation = Some(outcome.figures.clone());
    if estimate.is_empty() {
        row.status = RunStatus::NoPose;
    }
    Ok(outcome)
}

/// A file without poses is an answer; a missing one only when nothing was tracked (or nothing live was asked of replay).
fn read_estimate(path: &Path, may_be_missing: bool) -> Result<Vec<TumPose>, String> {
    match read_tum(path) {
        Ok(poses) => Ok(poses),
        Err(TrajectoryError::Empty { .. }) => Ok(Vec::new()),
        Err(TrajectoryError::Read { source, .. }) if may_be_missing && source.kind() == io::ErrorKind::NotFound => {
            Ok(Vec::new())
        }
        Err(e) => Err(e.to_string()),
    }
}

/// The end of a log, for the reason of a failure.
fn last_line(log: &Path) -> String {
    const MOST: usize = 300;
    let bytes = fs::read(log).unwrap_or_default();
    let text = String::from_utf8_lossy(bytes.get(bytes.len().saturating_sub(4096)..).unwrap_or_default());
    let line = text.lines().rev().find(|l| !l.trim().is_empty()).unwrap_or("it logged nothing");
    line.trim().chars().take(MOST).collect()
}

fn in_short(row: &SequenceResult) -> String {
    match (&row.status, &row.evaluation) {
        (RunStatus::Failed(reason), _) => format!("{}: failed: {reason}", row.name),
        (_, Some(e)) => {
            let ate = e.ate_m.map_or("no ATE".to_string(), |a| format!("ATE {:.4} m", a.rmse));
            format!("{}: coverage {:.1} %, {ate}", row.name, e.coverage_percent)
        }
        _ => row.name.clone(),
    }
}

/// The table in Markdown, with the machine under it.
pub fn table(result: &SuiteResult) -> String {
    const HEADS: [&str; 15] = [
        "sequence",
        "frames",
        "coverage %",
        "ATE m",
        "live cov. %",
        "live ATE m",
        "rotation °",
        "per metre %, °",
        "resets",
        "first pose s",
        "relocalised",
        "loops closed, tied",
        "picture to pose ms p50 / p95",
        "CPU ms a frame",
        "peak RSS MB",
    ];
    let mut out = format!("| {} |\n|---|{}\n", HEADS.join(" | "), "---:|".repeat(HEADS.len() - 1));
    for row in &result.sequences {
        out += &table_row(row);
    }
    out += &format!(
        "\nCairn {}, {}. {}, one run, every frame of `rgb.txt` that has ground truth within 20 ms; one Sim(3) a file; \
         RMSE. Picture to pose: features and tracking, without decoding. CPU and memory: the whole process, decoding included.\n",
        result.version,
        result.machine,
        if result.lockstep { "Lock-step" } else { "At the camera's pace" }
    );
    for row in &result.sequences {
        let failed = match &row.status {
            RunStatus::Failed(reason) => Some(format!("failed: {reason}")),
            _ => None,
        };
        let blind = row.replay.blind_turns.filter(|turns| *turns > 0);
        let blind = blind.map(|turns| format!("{turns} turns on the spot behind which the scale is an assumption"));
        let notes = row.evaluation.iter().flat_map(|e| &e.notes).cloned();
        for note in failed.into_iter().chain(blind).chain(notes) {
            out += &format!("\n- {}: {note}\n", row.name);
        }
    }
    out
}

fn table_row(row: &SequenceResult) -> String {
    let or_dash = |text: Option<String>| text.unwrap_or_else(|| "–".to_string());
    let number = |value: Option<f64>, decimals: usize| or_dash(value.map(|v| format!("{v:.decimals$}")));
    let count = |value: Option<u64>| or_dash(value.map(|v| v.to_string()));
    let (end, live) = (row.evaluation.as_ref(), row.live.as_ref());
    let relative = end.and_then(|e| e.relative);
    let first_pose = live.and_then(|l| l.first_pose_after_s);
    let picture_to_pose = row.replay.stages.picture_to_pose_ms();
    let name = match row.status {
        RunStatus::Failed(_) => format!("{} (failed)", row.name),
        RunStatus::NoPose => format!("{} (no pose)", row.name),
        RunStatus::Tracked => row.name.clone(),
    };
    let cells = [
        name.replace('|', "\\|"),
        count(row.frames),
        number(end.map(|e| e.coverage_percent), 1),
        number(end.and_then(|e| e.ate_m).map(|a| a.rmse), 4),
        number(live.map(|e| e.coverage_percent), 1),
        number(live.and_then(|e| e.ate_m).map(|a| a.rmse), 4),
        number(end.and_then(|e| e.rotation_deg).map(|a| a.rmse), 2),
        or_dash(relative.map(|r| format!("{:.2}, {:.2}", r.translation_percent.rmse, r.rotation_deg_per_m.rmse))),
        count(row.replay.resets),
        number(first_pose, 2),
        count(row.replay.relocalisations),
        or_dash(row.replay.loops.zip(row.replay.loops_tied).map(|(closed, tied)| format!("{closed}, {tied}"))),
        or_dash(picture_to_pose.map(|(p50, p95)| format!("{p50:.2} / {p95:.2}"))),
        number(row.cpu_ms_per_frame, 2),
        number(row.peak_rss_mb, 0),
    ];
    format!("| {} |\n", cells.join(" | "))
}

/// The processor's (or board's) name and the number of cores in use, as far as the system tells.
pub fn machine_name() -> String {
    let board =
        fs::read_to_string("/proc/device-tree/model").ok().map(|t| t.trim_matches(['\0', '\n', ' ']).to_string());
    let processor = || {
        let text = fs::read_to_string("/proc/cpuinfo").ok()?;
        let line = text.lines().find(|l| l.starts_with("model name"))?;
        Some(line.split_once(':')?.1.trim().to_string())
    };
    let name = board.filter(|b| !b.is_empty()).or_else(processor).unwrap_or_else(|| std::env::consts::ARCH.to_string());
    let cores = std::thread::available_parallelism().map_or(1, |n| n.get());
    format!("{name}, {cores} core{}", if cores == 1 { "" } else { "s" })
}
