//! `cairn evaluate`: one trajectory against its ground truth, or a suite of sequences.
//!
//! Figures go to stdout (text, `--json`, or the suite's Markdown table), notes and progress to stderr.

mod simulated;

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use super::session::{config_error, print};
use super::{CliError, exit_code};
use crate::config::{self, Config};
use crate::evaluation::association::CoverageBasis;
use crate::evaluation::suite::{self, SuiteError, SuiteOptions};
use crate::evaluation::{Evaluation, EvaluationError, Reference, evaluate};
use crate::plot::write_comparison;
use crate::trajectory::{TrajectoryError, read_tum};

/// How far off is a trajectory, and how much of it is there?
///
/// Coverage is of every frame of rgb.txt that has ground truth within 20 ms. Errors are taken after one Sim(3) alignment of
/// the whole file.
#[derive(Debug, Clone, clap::Args)]
pub struct EvaluateArgs {
    /// Estimated trajectory: TUM lines, "timestamp tx ty tz qx qy qz qw"
    #[arg(required_unless_present_any = ["suite", "simulator"], conflicts_with_all = ["suite", "simulator"])]
    pub estimate: Option<PathBuf>,
    /// Ground truth: a TUM file, or a sequence's folder with groundtruth.txt and rgb.txt
    #[arg(required_unless_present_any = ["suite", "simulator"], conflicts_with_all = ["suite", "simulator"])]
    pub ground_truth: Option<PathBuf>,
    /// List of frames ("timestamp filename" a line) instead of the rgb.txt beside the ground truth
    #[arg(long, value_name = "FILE", conflicts_with = "suite")]
    pub frames: Option<PathBuf>,
    /// Picture to write [default: beside the estimate, ending in .png]
    #[arg(long, value_name = "OUT.png", conflicts_with = "suite")]
    pub plot: Option<PathBuf>,
    /// Print one JSON object instead of text or a table
    #[arg(long)]
    pub json: bool,
    /// Replay these sequences' folders in lock-step, one after the other, and tabulate them
    #[arg(long, value_name = "DIR", num_args = 1..)]
    pub suite: Vec<PathBuf>,
    /// Run the simulator's hard cases and tabulate them; fails when one misses its limits
    #[arg(long, conflicts_with = "suite")]
    pub simulator: bool,
    /// The hard cases' long form: up to ten minutes each
    #[arg(long, requires = "simulator")]
    pub long: bool,
    /// Only these of the hard cases
    #[arg(long, value_name = "NAME", num_args = 1.., requires = "simulator")]
    pub case: Vec<String>,
    /// Run each hard case in so many rooms
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=100))]
    pub seeds: u64,
    /// Folder for the suite's table, trajectories, logs and pictures
    #[arg(long, value_name = "DIR", default_value = "cairn-suite")]
    pub output: PathBuf,
    /// Longest time that one sequence of the suite may take, in seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 1800, value_parser = clap::value_parser!(u64).range(1..=86_400))]
    pub timeout: u64,
    /// What to call this machine in the suite's table [default: its processor]
    #[arg(long, value_name = "NAME")]
    pub machine: Option<String>,
    /// Configuration file of the suite's replays and of the hard cases (its sections features and reconstruction) [default: for the hard cases none]
    #[arg(long, value_name = "FILE", conflicts_with = "estimate")]
    pub config: Option<PathBuf>,
    /// Prefix of the services that the suite's replays use
    #[arg(long, env = "CAIRN_PREFIX", value_name = "PREFIX")]
    pub prefix: Option<String>,
    /// Handed to every replay of the suite, after "--"
    #[arg(last = true, value_name = "REPLAY_OPTIONS")]
    pub replay_options: Vec<OsString>,
}

/// Runs the command.
pub fn run(args: &EvaluateArgs) -> Result<ExitCode, CliError> {
    match (&args.estimate, &args.ground_truth) {
        _ if args.simulator => simulated::run(args, &configured(args)?),
        (Some(estimate), Some(ground_truth)) if args.suite.is_empty() => judge_one(args, estimate, ground_truth),
        _ => run_suite(args),
    }
}

/// The configuration that was named, else the defaults: a table must not depend on what is installed.
fn configured(args: &EvaluateArgs) -> Result<Config, CliError> {
    let Some(path) = &args.config else { return Ok(Config::default()) };
    config::load(path).map_err(|e| config_error(&e))
}

fn trajectory_error(error: TrajectoryError) -> CliError {
    let code = match &error {
        TrajectoryError::Read { .. } => exit_code::NO_INPUT,
        TrajectoryError::Malformed { .. } | TrajectoryError::Empty { .. } => exit_code::DATA,
        TrajectoryError::Write(_) | TrajectoryError::Spool { .. } => exit_code::CANNOT_CREATE,
    };
    CliError::new(code, error.to_string())
}

fn evaluation_error(error: EvaluationError) -> CliError {
    match error {
        EvaluationError::Trajectory(e) => trajectory_error(e),
        EvaluationError::NoFrameWithTruth { .. } => CliError::new(exit_code::DATA, error.to_string()),
    }
}

#[derive(serde::Serialize)]
struct JsonReport<'a> {
    estimate: String,
    ground_truth: String,
    frames: Option<String>,
    plot: Option<String>,
    #[serde(flatten)]
    figures: &'a Evaluation,
}

fn judge_one(args: &EvaluateArgs, estimate_path: &Path, ground_truth: &Path) -> Result<ExitCode, CliError> {
    let estimate = read_tum(estimate_path).map_err(trajectory_error)?;
    let reference = Reference::open(ground_truth, args.frames.as_deref()).map_err(evaluation_error)?;
    let outcome = evaluate(&estimate, &reference).map_err(evaluation_error)?;
    let figures = &outcome.figures;

    let plot_path = args.plot.clone().unwrap_or_else(|| estimate_path.with_extension("png"));
    let title = estimate_path.file_name().map_or("trajectory".into(), |n| n.to_string_lossy());
    let written = write_comparison(&plot_path, &outcome, &title);
    let plot = written.is_ok().then(|| plot_path.display().to_string());
    let text = if args.json {
        let report = JsonReport {
            estimate: estimate_path.display().to_string(),
            ground_truth: reference.ground_truth_path.display().to_string(),
            frames: reference.frames_path.as_ref().map(|p| p.display().to_string()),
            plot,
            figures,
        };
        let json = serde_json::to_string(&report)
            .map_err(|e| CliError::new(exit_code::FAILURE, format!("cannot print as JSON: {e}")))?;
        json + "\n"
    } else {
        report(figures, plot.as_deref())
    };
    print(&text)?;
    for note in &figures.notes {
        eprintln!("note: {note}");
    }
    if let Err(error) = written {
        // The figures are out; a picture that nobody asked for by name is not worth a failure.
        if args.plot.is_some() {
            return Err(CliError::new(exit_code::CANNOT_CREATE, error.to_string()));
        }
        eprintln!("note: no picture: {error}");
    }
    if figures.matched_poses == 0 {
        return Err(CliError::new(
            exit_code::FAILURE,
            format!("no pose of {} belongs to a frame with ground truth", estimate_path.display()),
        ));
    }
    Ok(ExitCode::SUCCESS)
}

/// The figures for a person.
fn report(figures: &Evaluation, plot: Option<&str>) -> String {
    let mut lines = Vec::new();
    let mut line = |name: &str, value: String| lines.push(format!("{name:<15}{value}\n"));
    let of = match figures.coverage_basis {
        CoverageBasis::Frames => "frames with ground truth",
        CoverageBasis::GroundTruthSamples => "ground-truth samples",
    };
    line("coverage", format!("{:.2} %  ({} of {} {of})", figures.coverage_percent, figures.covered, figures.expected));
    if let Some(seconds) = figures.first_pose_after_s {
        line("first pose", format!("after {seconds:.2} s; longest gap from then on: {} frames", figures.longest_gap));
    }
    if let Some(ate) = &figures.ate_m {
        let (mean, median, max) = (ate.mean, ate.median, ate.max);
        line("ATE RMSE", format!("{:.4} m  (mean {mean:.4}, median {median:.4}, max {max:.4})", ate.rmse));
    }
    if let Some(rotation) = &figures.rotation_deg {
        let (mean, median, max) = (rotation.mean, rotation.median, rotation.max);
        line("rotation RMSE", format!("{:.3} deg  (mean {mean:.3}, median {median:.3}, max {max:.3})", rotation.rmse));
    }
    if let Some(relative) = &figures.relative {
        let (t, r) = (relative.translation_percent.rmse, relative.rotation_deg_per_m.rmse);
        line("relative RMSE", format!("{t:.3} % and {r:.3} deg a metre  ({} segments of 1 m)", relative.segments));
    }
    if let Some(alignment) = &figures.alignment {
        line("scale", format!("{:.6} m a unit of the estimate", alignment.scale));
        line("path", format!("{:.3} m over {} poses", figures.path_m, figures.matched_poses));
    }
    if let Some(plot) = plot {
        line("picture", plot.to_string());
    }
    lines.concat()
}

fn run_suite(args: &EvaluateArgs) -> Result<ExitCode, CliError> {
    let program = std::env::current_exe()
        .map_err(|e| CliError::new(exit_code::FAILURE, format!("cannot find this executable to replay with: {e}")))?;
    let mut more_arguments = Vec::new();
    if let Some(config) = &args.config {
        more_arguments.extend([OsString::from("--config"), config.into()]);
    }
    if let Some(prefix) = &args.prefix {
        more_arguments.extend([OsString::from("--prefix"), prefix.into()]);
    }
    more_arguments.extend(args.replay_options.iter().cloned());
    let options = SuiteOptions {
        program,
        leading_arguments: vec!["replay".into()],
        more_arguments,
        output: args.output.clone(),
        limit: Duration::from_secs(args.timeout),
        machine: args.machine.clone().unwrap_or_else(suite::machine_name),
    };
    let result = suite::run_suite(&args.suite, &options, |line| eprintln!("{line}")).map_err(|error| match error {
        SuiteError::Evaluation(e) => evaluation_error(e),
        SuiteError::NoFolder(_) => CliError::new(exit_code::NO_INPUT, error.to_string()),
        _ => CliError::new(exit_code::CANNOT_CREATE, error.to_string()),
    })?;
    for row in &result.sequences {
        if let Some(outcome) = &row.outcome {
            let path = args.output.join(format!("{}.png", row.name));
            write_comparison(&path, outcome, &row.name)
                .map_err(|e| CliError::new(exit_code::CANNOT_CREATE, e.to_string()))?;
        }
    }
    if args.json {
        let json = serde_json::to_string(&result)
            .map_err(|e| CliError::new(exit_code::FAILURE, format!("cannot print as JSON: {e}")))?;
        print(&(json + "\n"))?;
    } else {
        print(&suite::table(&result))?;
    }
    eprintln!("table, figures, trajectories, logs and pictures: {}", args.output.display());
    if result.is_complete() {
        Ok(ExitCode::SUCCESS)
    } else {
        Err(CliError::new(exit_code::FAILURE, "at least one sequence failed, see the table"))
    }
}

#[cfg(test)]
mod tests;
