//! What `cairn evaluate` is asked.

use std::ffi::OsString;
use std::path::PathBuf;

use crate::cli::session::ResultArgs;

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
    /// The error of the estimate's own metres as well (SE(3) alignment, no scale taken from the truth), and the scale itself
    #[arg(long, conflicts_with_all = ["suite", "simulator"])]
    pub metric: bool,
    #[command(flatten)]
    pub result: ResultArgs,
    /// Replay these sequences' folders, one after the other, and tabulate them
    #[arg(long, value_name = "DIR", num_args = 1..)]
    pub suite: Vec<PathBuf>,
    /// Replay at the camera's pace instead of in lock-step: what is not ready in time is dropped
    #[arg(long, requires = "suite", conflicts_with = "simulator")]
    pub real_time: bool,
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
    /// The first of these rooms
    #[arg(long, value_name = "N", default_value_t = 3, conflicts_with = "suite", value_parser = clap::value_parser!(u64).range(..=1_000_000))]
    pub first_seed: u64,
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
