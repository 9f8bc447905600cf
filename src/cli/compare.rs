//! `cairn compare`: detectors and matchers on pairs of pictures with known truth.
//!
//! The table of each way goes to stdout, progress to stderr; both tables, all figures as JSON and a chart into the folder.

use std::path::PathBuf;
use std::process::ExitCode;

use super::session::{self, ResultArgs, StatusLine, print};
use super::twoview::{picture_error, positive_px};
use super::{CliError, exit_code};
use crate::atomic_file::write_atomically;
use crate::plot::{Chart, write_chart};
use crate::workbench::compare::pairs::{PairsError, find};
use crate::workbench::compare::{Comparison, Plan, SequenceRule, compare, table};
use crate::workbench::{Detector, Matcher, Views, report};

/// Compare detectors and matchers on pairs of pictures: corners, repeatability, correct matches, inliers, pose errors, time
///
/// A PATH is a folder, or a list of pairs with cameras and poses. What is compared with what, and what is known of it, is told by
/// the files: homographies (img1, img2, H1to2p), a list of pairs (A B rotA rotB K_A K_B second_from_first), a sequence with ground truth
/// (rgb.txt, groundtruth.txt, camera.yaml), annotated points (nameA, nameB, name_pts.txt, name_vpts.mat), rectified pairs
/// (name_left, name_right, name_disp).
#[derive(Debug, Clone, clap::Args)]
pub struct CompareArgs {
    /// Folders of pairs or of a sequence, lists of pairs
    #[arg(required = true, value_name = "PATH")]
    pub paths: Vec<PathBuf>,
    /// Folder for compare.md, compare.json and compare.png; made if it is not there
    #[arg(long, value_name = "DIR")]
    pub output: PathBuf,
    /// Detectors, comma separated [default: all]
    #[arg(long, value_enum, value_delimiter = ',', value_name = "DETECTOR")]
    pub detectors: Vec<Detector>,
    /// Matchers, comma separated [default: all]
    #[arg(long, value_enum, value_delimiter = ',', value_name = "MATCHER")]
    pub matchers: Vec<Matcher>,
    /// Scales that are searched, 1 to 16 [default: by the matcher]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=16))]
    pub scales: Option<u8>,
    /// Most corners of a picture
    #[arg(long, value_name = "N", default_value_t = 2000, value_parser = clap::value_parser!(u32).range(8..=20_000))]
    pub corners: u32,
    /// One sigma of a corner's place, px
    #[arg(long, value_name = "PX", default_value_t = 1.0, value_parser = positive_px)]
    pub sigma: f64,
    /// Match again along the epipolar lines
    #[arg(long)]
    pub guided: bool,
    /// Simulate tilted views of both pictures, for surfaces that are seen at very different slants
    #[arg(long, value_enum, default_value = "auto")]
    pub views: Views,
    /// Frames between the pictures of a sequence's pairs
    #[arg(long, value_name = "FRAMES", default_value_t = 15, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub step: u32,
    /// Pairs of a sequence
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub pairs: u32,
    /// Seed of everything random
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Score the best motion found even where it is no better than chance, as programs that always answer do
    #[arg(long)]
    pub always_answer: bool,
    #[command(flatten)]
    pub result: ResultArgs,
}

/// Runs the command.
pub fn run(args: &CompareArgs) -> Result<ExitCode, CliError> {
    let rule = SequenceRule { step: args.step as usize, pairs: args.pairs as usize };
    let mut tasks = Vec::new();
    for path in &args.paths {
        tasks.extend(find(path, &rule).map_err(|e| {
            let code = match &e {
                PairsError::Malformed { .. } => exit_code::DATA,
                PairsError::Read { .. } | PairsError::None(_) => exit_code::NO_INPUT,
            };
            CliError::new(code, e.to_string())
        })?);
    }
    let cannot = |e: String| CliError::new(exit_code::CANNOT_CREATE, e);
    std::fs::create_dir_all(&args.output)
        .map_err(|e| cannot(format!("cannot make the folder {}: {e}", args.output.display())))?;
    let plan = Plan {
        detectors: if args.detectors.is_empty() { Detector::ALL.to_vec() } else { args.detectors.clone() },
        matchers: if args.matchers.is_empty() { Matcher::ALL.to_vec() } else { args.matchers.clone() },
        scales: args.scales.map(usize::from),
        max_corners: args.corners as usize,
        sigma_px: args.sigma,
        guided: args.guided,
        views: args.views,
        seed: args.seed,
        always_answer: args.always_answer,
    };
    let count = tasks.len();
    let mut line = StatusLine::new(args.result.quiet);
    let result = compare(&tasks, &plan, |index, task| line.show(&format!("{} of {count}: {}", index + 1, task.name)));
    line.clear();
    let result = result.map_err(|e| picture_error(&e))?;
    let summary = table::summary(&result);
    print(&if args.result.json { session::json(&result)? } else { summary.clone() })?;
    let markdown = format!("{summary}\n{}", table::details(&result));
    write_atomically(&args.output.join("compare.md"), |out| std::io::Write::write_all(out, markdown.as_bytes()))
        .map_err(|e| cannot(e.to_string()))?;
    let document = serde_json::to_value(&result)
        .map_err(|e| CliError::new(exit_code::FAILURE, format!("cannot print as JSON: {e}")))?;
    report::write_json(&args.output.join("compare.json"), &document).map_err(|e| cannot(e.to_string()))?;
    write_chart(&args.output.join("compare.png"), &chart(&result, count)).map_err(|e| cannot(e.to_string()))?;
    line.note(&format!("tables, figures and chart: {}", args.output.display()));
    Ok(ExitCode::SUCCESS)
}

/// The ways beside each other.
fn chart(result: &Comparison, pairs: usize) -> Chart {
    let mut columns: Vec<(String, bool)> = vec![("correct matches".into(), true), ("correct %".into(), true)];
    columns.push(("inliers after F %".into(), true));
    columns.push(("poses right".into(), true));
    columns.push(("rotation error °".into(), false));
    columns.push(("direction error °".into(), false));
    columns.push(("time ms".into(), false));
    let percent = |v: Option<f64>| v.map(|v| 100.0 * v);
    let group = |matcher: Matcher| Matcher::ALL.iter().position(|m| *m == matcher).unwrap_or(0);
    let mut rows: Vec<(String, usize, Vec<Option<f64>>)> = result
        .summaries
        .iter()
        .map(|s| {
            let values = vec![
                s.correct,
                percent(s.precision),
                percent(s.inlier_share),
                s.right.map(|(right, _)| right as f64),
                s.rotation_error_deg,
                s.direction_error_deg,
                Some(s.total_ms),
            ];
            (format!("{}, {}", s.matcher.name(), s.detector.name()), group(s.matcher), values)
        })
        .collect();
    // Stable: a matcher's rows beside each other, detectors in their order.
    rows.sort_by_key(|row| row.1);
    Chart {
        heading: "Detectors and matchers".into(),
        note: format!("medians over {pairs} pairs; a pair without a pose counts as 180 degrees"),
        columns,
        rows,
    }
}
