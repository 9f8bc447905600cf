//! `cairn evaluate`: one trajectory against its ground truth, or a suite of sequences.
//!
//! Figures go to stdout (text, `--json`, or the suite's Markdown table), notes and progress to stderr.

mod args;
mod drawing;
mod simulated;

use std::ffi::OsString;
use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

pub use args::EvaluateArgs;
use drawing::write_comparison;

use super::session::{StatusLine, config_error, json, print};
use super::{CliError, exit_code};
use crate::config::{self, Config};
use crate::evaluation::association::CoverageBasis;
use crate::evaluation::suite::{self, SuiteError, SuiteOptions};
use crate::evaluation::{Evaluation, EvaluationError, MetricFigures, Reference, evaluate};
use crate::trajectory::{TrajectoryError, read_tum};

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
        TrajectoryError::Write(_) | TrajectoryError::NotOurs { .. } | TrajectoryError::Spool { .. } => {
            exit_code::CANNOT_CREATE
        }
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
    /// With `--metric`; null where nothing can be aligned.
    #[serde(skip_serializing_if = "Option::is_none")]
    metric: Option<Option<MetricFigures>>,
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
    let text = if args.result.json {
        let report = JsonReport {
            estimate: estimate_path.display().to_string(),
            ground_truth: reference.ground_truth_path.display().to_string(),
            frames: reference.frames_path.as_ref().map(|p| p.display().to_string()),
            plot,
            figures,
            metric: args.metric.then_some(outcome.metric),
        };
        json(&report)?
    } else {
        report(figures, outcome.metric.as_ref().filter(|_| args.metric), plot.as_deref())
    };
    print(&text)?;
    let mut line = StatusLine::new(args.result.quiet);
    for note in &figures.notes {
        line.note(&format!("note: {note}"));
    }
    if let Err(error) = written {
        // The figures are out; a picture that nobody asked for by name is not worth a failure.
        if args.plot.is_some() {
            return Err(CliError::new(exit_code::CANNOT_CREATE, error.to_string()));
        }
        line.note(&format!("note: no picture: {error}"));
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
fn report(figures: &Evaluation, metric: Option<&MetricFigures>, plot: Option<&str>) -> String {
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
    if let Some(MetricFigures { scale, ate_m: ate, relative }) = metric {
        let (mean, median, max) = (ate.mean, ate.median, ate.max);
        line("metric ATE", format!("{:.4} m  (mean {mean:.4}, median {median:.4}, max {max:.4})", ate.rmse));
        if let Some(relative) = relative {
            let percent = relative.translation_percent.rmse;
            line("metric RPE", format!("{percent:.3} % a metre  ({} segments of 1 m)", relative.segments));
        }
        let off = 100.0 * (scale - 1.0);
        line("metric scale", format!("a metre of the estimate is {scale:.6} m ({off:+.3} %)"));
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
        lockstep: !args.real_time,
        output: args.output.clone(),
        limit: Duration::from_secs(args.timeout),
        machine: args.machine.clone().unwrap_or_else(suite::machine_name),
    };
    let mut line = StatusLine::new(args.result.quiet);
    let result = suite::run_suite(&args.suite, &options, |text| line.show(text));
    line.clear();
    let result = result.map_err(|error| match error {
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
    print(&if args.result.json { json(&result)? } else { suite::table(&result) })?;
    line.note(&format!("table, figures, trajectories, logs and pictures: {}", args.output.display()));
    if result.is_complete() {
        Ok(ExitCode::SUCCESS)
    } else {
        Err(CliError::new(exit_code::FAILURE, "at least one sequence failed, see the table"))
    }
}

#[cfg(test)]
mod tests;
