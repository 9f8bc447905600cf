//! The reference that an estimate is held against.
//!
//! Input: a `groundtruth.txt` (TUM lines, world_from_camera, metres) or a folder that holds one. Output: the truth, and the
//! timestamps of the frames if there is an `rgb.txt` beside it (or one was named). Frames are coverage's denominator;
//! without them only a coverage of the ground-truth samples can be stated, and is called that.
//!
//! Deliberately not here: EuRoC's ground truth, which is the body's and not the camera's.

use std::path::{Path, PathBuf};

use super::EvaluationError;
use crate::trajectory::{TumPose, read_frame_times, read_tum};

/// Ground truth and what is known of the frames.
#[derive(Debug, Clone)]
pub struct Reference {
    pub ground_truth_path: PathBuf,
    /// Ascending time.
    pub ground_truth: Vec<TumPose>,
    /// The list that `frames` came from.
    pub frames_path: Option<PathBuf>,
    /// Timestamps of every frame, ascending.
    pub frames: Option<Vec<i64>>,
    /// What a reader of the result should know about the choice of files.
    pub notes: Vec<String>,
}

impl Reference {
    /// `path`: a ground-truth file, or a sequence's folder. `frames`: a list of frames to use instead of the `rgb.txt` beside it.
    pub fn open(path: &Path, frames: Option<&Path>) -> Result<Self, EvaluationError> {
        let ground_truth_path = match path.is_dir() {
            true => path.join("groundtruth.txt"),
            false => path.to_path_buf(),
        };
        let ground_truth = read_tum(&ground_truth_path)?;
        let beside = ground_truth_path.with_file_name("rgb.txt");
        let frames_path = match frames {
            Some(named) => Some(named.to_path_buf()),
            None => beside.is_file().then_some(beside),
        };
        let times = frames_path.as_deref().map(read_frame_times).transpose()?;
        let mut notes = Vec::new();
        match &frames_path {
            Some(found) if frames.is_none() && !path.is_dir() => {
                notes.push(format!(
                    "coverage is of the frames in {}, which lies beside the ground truth",
                    found.display()
                ));
            }
            Some(_) => {}
            None => notes.push(
                "no rgb.txt: coverage is of ground-truth samples; frames that have no pose cannot be counted".into(),
            ),
        }
        Ok(Self { ground_truth_path, ground_truth, frames_path, frames: times, notes })
    }
}
