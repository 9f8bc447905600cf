//! Which pairs of pictures a path stands for, and what is known of each.
//!
//! Input: a folder or a list. Output: [`Task`]s: two picture files, cameras where they are known, and [`Truth`]. The kind is told
//! by the files:
//!
//! | files | pairs | truth |
//! |---|---|---|
//! | a text file with lines `A B rotA rotB K_A(9) K_B(9) second_from_first(16)`, or a folder with one | each line's | relative pose |
//! | `img1.*`, `img2.*`, `H1to2p` ... | the first picture with each other one | homography |
//! | `rgb.txt`, `groundtruth.txt`, a calibration (TUM RGB-D layout) | frames a few apart | relative pose |
//! | `nameA.*`, `nameB.*` with `name_pts.txt` or `name_vpts.mat` | each name's | annotated points; listed matches |
//! | `name_left.*`, `name_right.*` with `name_disp.*` | each name's | rectified: epipolar lines are rows |
//!
//! A folder may hold several kinds, and folders with these. What fits none of it is passed over; a path that gives no pair is
//! an error.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Vector2, Vector3};

use super::mat5;
use crate::calibration;
use crate::camera::recording::list;
use crate::geometry::Se3;
use crate::geometry::camera_model::CameraModel;
use crate::geometry::epipolar::skew;
use crate::geometry::frames::{First, Second};
use crate::geometry::rotation::rotation_nearest;
use crate::trajectory::read_tum;
use crate::workbench::picture::Picture;
use crate::workbench::pose::intrinsics;
use crate::workbench::two_view::Cameras;

/// Ground truth further away in time does not count, ns.
const MAX_TRUTH_DISTANCE_NS: i64 = 20_000_000;
/// Folders within folders.
const MAX_DEPTH: usize = 2;
/// Text files longer than this are no lists, bytes.
const MAX_LIST_BYTES: u64 = 4 << 20;

/// What is known of a pair.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Truth {
    /// `x_b ~ H x_a`, pixels.
    pub homography: Option<Matrix3<f64>>,
    /// Translation in the truth's own unit.
    pub second_from_first: Option<Se3<Second, First>>,
    /// `x_bᵀ F x_a = 0`, undistorted pixels where there are cameras.
    pub fundamental: Option<Matrix3<f64>>,
    /// Points that a person marked in both pictures, pixels.
    pub annotated: Vec<[Vector2<f64>; 2]>,
    /// The rows of both pictures correspond.
    pub rectified: bool,
}

/// A pair to work on.
#[derive(Debug, Clone, PartialEq)]
pub struct Task {
    /// For tables.
    pub name: String,
    /// Which path it came from, and of which kind it is.
    pub group: String,
    pub first: PathBuf,
    pub second: PathBuf,
    pub cameras: Option<Cameras>,
    pub truth: Truth,
    /// Matches that came with the pictures, wrong ones among them, pixels.
    pub listed: Vec<[Vector2<f64>; 2]>,
}

/// How pairs are taken from sequences.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SequenceRule {
    /// Frames from the first picture of a pair to the second.
    pub step: usize,
    /// Pairs of a sequence, spread over it.
    pub pairs: usize,
}

/// Why a path gives no pairs.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PairsError {
    #[error("{path}: {reason}")]
    Read { path: String, reason: String },
    #[error("{path}: {reason}")]
    Malformed { path: String, reason: String },
    #[error(
        "{0}: no pair of pictures with a list, homographies, ground truth, annotated points or a disparity beside it"
    )]
    None(String),
}

/// Every pair that a path stands for, in the order of names.
pub fn find(path: &Path, rule: &SequenceRule) -> Result<Vec<Task>, PairsError> {
    let metadata = std::fs::metadata(path)
        .map_err(|e| PairsError::Read { path: path.display().to_string(), reason: e.to_string() })?;
    let mut tasks = Vec::new();
    if metadata.is_dir() {
        search(path, rule, 0, &mut tasks)?;
    } else {
        tasks = from_list(path)?.unwrap_or_default();
    }
    if tasks.is_empty() {
        return Err(PairsError::None(path.display().to_string()));
    }
    Ok(tasks)
}

fn malformed(path: &Path, reason: impl Into<String>) -> PairsError {
    PairsError::Malformed { path: path.display().to_string(), reason: reason.into() }
}

fn folder_name(folder: &Path) -> String {
    folder.file_name().map_or_else(|| folder.display().to_string(), |n| n.to_string_lossy().into_owned())
}

fn search(folder: &Path, rule: &SequenceRule, depth: usize, tasks: &mut Vec<Task>) -> Result<(), PairsError> {
    let entries = std::fs::read_dir(folder)
        .map_err(|e| PairsError::Read { path: folder.display().to_string(), reason: e.to_string() })?;
    // By name; other names than text are nobody's here.
    let files: BTreeMap<String, PathBuf> =
        entries.flatten().filter_map(|e| Some((e.file_name().into_string().ok()?, e.path()))).collect();
    if files.contains_key("rgb.txt") && files.contains_key("groundtruth.txt") {
        tasks.extend(from_sequence(folder, rule)?);
        return Ok(());
    }
    for (name, path) in &files {
        if name.ends_with(".txt") && path.is_file() {
            tasks.extend(from_list(path)?.unwrap_or_default());
        }
    }
    tasks.extend(with_homographies(folder, &files)?);
    tasks.extend(annotated(folder, &files)?);
    tasks.extend(rectified(folder, &files));
    if depth < MAX_DEPTH {
        for path in files.values().filter(|p| p.is_dir()) {
            search(path, rule, depth + 1, tasks)?;
        }
    }
    Ok(())
}

fn read_text(path: &Path) -> Result<String, PairsError> {
    let read = |reason: String| PairsError::Read { path: path.display().to_string(), reason };
    let length = std::fs::metadata(path).map_err(|e| read(e.to_string()))?.len();
    if length > MAX_LIST_BYTES {
        return Ok(String::new());
    }
    let bytes = std::fs::read(path).map_err(|e| read(e.to_string()))?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

fn numbers(fields: &[&str]) -> Option<Vec<f64>> {
    fields.iter().map(|f| f.parse::<f64>().ok().filter(|v| v.is_finite())).collect()
}

/// A list's pairs; `None` when the text is no such list.
fn from_list(path: &Path) -> Result<Option<Vec<Task>>, PairsError> {
    let folder = path.parent().unwrap_or(Path::new("."));
    let text = read_text(path)?;
    let mut tasks = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let fields: Vec<&str> = line.split_whitespace().collect();
        if fields.is_empty() || line.starts_with('#') {
            continue;
        }
        if fields.len() != 38 {
            return Ok(None);
        }
        let Some(n) = numbers(&fields[2..]) else { return Ok(None) };
        let place = |what: &str| malformed(path, format!("line {}: {what}", index + 1));
        let (first, second) = (folder.join(fields[0]), folder.join(fields[1]));
        let rotation = rotation_nearest(&Matrix3::new(n[20], n[21], n[22], n[24], n[25], n[26], n[28], n[29], n[30]))
            .ok_or_else(|| place("the pose holds no rotation"))?;
        let motion = Se3::from_matrix(&rotation, Vector3::new(n[23], n[27], n[31]));
        let camera = |k: &[f64], picture: &Path| {
            let size = picture_size(picture)?;
            CameraModel::new(size.0, size.1, k[0], k[4], k[2], k[5], [0.0; 5]).map_err(|e| place(&e.to_string()))
        };
        let cameras = Cameras { a: camera(&n[2..11], &first)?, b: camera(&n[11..20], &second)? };
        tasks.push(Task {
            name: format!("{} {}", stem(fields[0]), stem(fields[1])),
            group: folder_name(folder),
            truth: of_motion(&cameras, motion),
            first,
            second,
            cameras: Some(cameras),
            listed: Vec::new(),
        });
    }
    Ok((!tasks.is_empty()).then_some(tasks))
}

/// Truth of a known motion.
fn of_motion(cameras: &Cameras, motion: Se3<Second, First>) -> Truth {
    let inverse = |c: &CameraModel| intrinsics(c).try_inverse().unwrap_or_else(Matrix3::identity);
    let essential = skew(&motion.translation) * motion.rotation.to_rotation_matrix().matrix();
    let fundamental = inverse(&cameras.b).transpose() * essential * inverse(&cameras.a);
    Truth { second_from_first: Some(motion), fundamental: Some(fundamental), ..Truth::default() }
}

/// Size of a picture, pixels: it has to be decoded for some formats, which is cheap beside what follows.
fn picture_size(path: &Path) -> Result<(u32, u32), PairsError> {
    let picture = Picture::load(path)
        .map_err(|e| PairsError::Read { path: path.display().to_string(), reason: e.to_string() })?;
    Ok((picture.grey.width as u32, picture.grey.height as u32))
}

fn stem(name: &str) -> &str {
    name.rsplit_once('.').map_or(name, |(stem, _)| stem)
}

/// The file of a folder whose name without extension is `stem` and that is a picture by its extension.
fn picture<'a>(files: &'a BTreeMap<String, PathBuf>, wanted: &str) -> Option<&'a PathBuf> {
    ["png", "jpg", "jpeg", "ppm", "pgm", "PNG", "JPG"].iter().find_map(|e| files.get(&format!("{wanted}.{e}")))
}

/// `img1`, `imgN` and `H1toNp`.
fn with_homographies(folder: &Path, files: &BTreeMap<String, PathBuf>) -> Result<Vec<Task>, PairsError> {
    let mut tasks = Vec::new();
    for (name, path) in files {
        let Some(number) = name.strip_prefix("H1to").and_then(|r| r.strip_suffix('p')) else { continue };
        let (Some(first), Some(second)) = (picture(files, "img1"), picture(files, &format!("img{number}"))) else {
            continue;
        };
        let text = read_text(path)?;
        let fields: Vec<&str> = text.split_whitespace().collect();
        let n = numbers(&fields).filter(|n| n.len() == 9).ok_or_else(|| malformed(path, "must hold nine numbers"))?;
        tasks.push(Task {
            name: format!("{} 1 {number}", folder_name(folder)),
            group: folder_name(folder),
            first: first.clone(),
            second: second.clone(),
            cameras: None,
            truth: Truth { homography: Some(Matrix3::from_row_slice(&n)), ..Truth::default() },
            listed: Vec::new(),
        });
    }
    Ok(tasks)
}

/// `nameA`, `nameB` with annotated points or listed matches.
fn annotated(folder: &Path, files: &BTreeMap<String, PathBuf>) -> Result<Vec<Task>, PairsError> {
    let names: std::collections::BTreeSet<&str> =
        files.keys().filter_map(|f| f.strip_suffix("_pts.txt").or_else(|| f.strip_suffix("_vpts.mat"))).collect();
    let mut tasks = Vec::new();
    for name in names {
        let (Some(first), Some(second)) = (picture(files, &format!("{name}A")), picture(files, &format!("{name}B")))
        else {
            continue;
        };
        let mut truth = Truth::default();
        if let Some(path) = files.get(&format!("{name}_vpts.mat")) {
            let data = std::fs::read(path)
                .map_err(|e| PairsError::Read { path: path.display().to_string(), reason: e.to_string() })?;
            truth.annotated = mat5::read_pairs(&data).map_err(|reason| malformed(path, reason))?;
        }
        let listed = match files.get(&format!("{name}_pts.txt")) {
            Some(path) => listed(path)?,
            None => Vec::new(),
        };
        tasks.push(Task {
            name: name.to_owned(),
            group: folder_name(folder),
            first: first.clone(),
            second: second.clone(),
            cameras: None,
            truth,
            listed,
        });
    }
    Ok(tasks)
}

/// Matches from a text: `xa ya xb yb`, or `xa ya 1 xb yb 1` and anything; one a line.
pub fn listed(path: &Path) -> Result<Vec<[Vector2<f64>; 2]>, PairsError> {
    let text = read_text(path)?;
    let mut pairs = Vec::new();
    for (index, line) in text.lines().enumerate() {
        let fields: Vec<&str> = line.split_whitespace().collect();
        if fields.is_empty() {
            continue;
        }
        let n = numbers(&fields)
            .filter(|n| n.len() == 4 || n.len() >= 6)
            .ok_or_else(|| malformed(path, format!("line {}: must be xa ya xb yb or xa ya 1 xb yb 1", index + 1)))?;
        pairs.push(match n[..] {
            [xa, ya, xb, yb] => [Vector2::new(xa, ya), Vector2::new(xb, yb)],
            _ => [Vector2::new(n[0] / n[2], n[1] / n[2]), Vector2::new(n[3] / n[5], n[4] / n[5])],
        });
    }
    if pairs.iter().flatten().any(|p| !p.iter().all(|v| v.is_finite())) {
        return Err(malformed(path, "holds a point that is not finite"));
    }
    Ok(pairs)
}

/// `name_left`, `name_right` with a disparity: rows correspond.
fn rectified(folder: &Path, files: &BTreeMap<String, PathBuf>) -> Vec<Task> {
    let mut tasks = Vec::new();
    for file in files.keys() {
        let Some(name) = stem(file).strip_suffix("_disp") else { continue };
        let (Some(first), Some(second)) =
            (picture(files, &format!("{name}_left")), picture(files, &format!("{name}_right")))
        else {
            continue;
        };
        // y_b = y_a
        let rows = Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);
        tasks.push(Task {
            name: name.to_owned(),
            group: folder_name(folder),
            first: first.clone(),
            second: second.clone(),
            cameras: None,
            truth: Truth { fundamental: Some(rows), rectified: true, ..Truth::default() },
            listed: Vec::new(),
        });
    }
    tasks
}

/// Frames of a sequence with ground truth, `step` apart.
fn from_sequence(folder: &Path, rule: &SequenceRule) -> Result<Vec<Task>, PairsError> {
    let read = |reason: String| PairsError::Read { path: folder.display().to_string(), reason };
    let sequence = list::read(folder).map_err(|e| read(e.to_string()))?;
    let file = sequence.calibration.ok_or_else(|| read("has no calibration".into()))?;
    let camera = calibration::load_camera(&file).map_err(|e| read(e.to_string()))?;
    let poses = read_tum(&folder.join("groundtruth.txt")).map_err(|e| read(e.to_string()))?;
    let pose_at = |time: i64| {
        let after = poses.partition_point(|p| p.timestamp_ns < time);
        [after.checked_sub(1), Some(after)]
            .into_iter()
            .flatten()
            .filter_map(|i| poses.get(i))
            .min_by_key(|p| p.timestamp_ns.abs_diff(time))
            .filter(|p| p.timestamp_ns.abs_diff(time) <= MAX_TRUTH_DISTANCE_NS.unsigned_abs())
            .map(|p| p.world_from_camera)
    };
    let last = sequence.frames.len().saturating_sub(rule.step.max(1) + 1);
    let count = rule.pairs.min(last + 1).max(1);
    let mut tasks = Vec::new();
    for k in 0..count {
        let i = if count > 1 { k * last / (count - 1) } else { 0 };
        let (Some(a), Some(b)) = (sequence.frames.get(i), sequence.frames.get(i + rule.step.max(1))) else { continue };
        let (Some(pose_a), Some(pose_b)) = (pose_at(a.timestamp_ns), pose_at(b.timestamp_ns)) else { continue };
        // The camera at two times is the pair's first and second camera.
        let motion: Se3<Second, First> = (pose_b.inverse() * pose_a).relabel();
        let cameras = Cameras { a: camera.clone(), b: camera.clone() };
        tasks.push(Task {
            name: format!("{} {i} {}", folder_name(folder), i + rule.step.max(1)),
            group: folder_name(folder),
            first: sequence.folder.join(&*a.file),
            second: sequence.folder.join(&*b.file),
            truth: of_motion(&cameras, motion),
            cameras: Some(cameras),
            listed: Vec::new(),
        });
    }
    Ok(tasks)
}
