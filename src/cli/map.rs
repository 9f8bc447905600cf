//! `cairn map`: what is in a map file, and the same for other programs; the maps of a running daemon (`map_daemon`) and of other robots (`map_pull`).
//!
//! A file is read, verified in full and left as it is. One that a daemon holds changes all the time, so that daemon is asked for a copy.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use serde::Serialize;

use super::endpoint_args::EndpointArgs;
use super::map_daemon::{self, DaemonAction};
use super::utc::date;
use super::{CliError, exit_code, map_file, session};
use crate::geometry::CameraModel;
use crate::map::MapSnapshot;
use crate::map::colmap::write_colmap;
use crate::map::export::write_ply;
use crate::map::saved::SavedMap;
use crate::map::scale::MapScale;
use crate::places::store::{Contents, Fault, read};
use crate::trajectory::{TumPose, format_timestamp, write_tum};

/// Show a map file or write its map for other programs; have a running daemon store, load, list and begin maps; fetch another robot's
#[derive(Debug, clap::Args)]
pub struct MapArgs {
    #[command(flatten)]
    endpoint: EndpointArgs,
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    Info(InfoArgs),
    Export(ExportArgs),
    #[cfg(feature = "bridge")]
    Pull(super::map_pull::PullArgs),
    #[command(flatten)]
    OfDaemon(DaemonAction),
}

/// Verify a map file and print what is in it
#[derive(Debug, clap::Args)]
struct InfoArgs {
    /// Map file; of one that a running daemon writes to, that one is asked [default: the running daemon's map]
    file: Option<PathBuf>,
    /// Print the result as one JSON object
    #[arg(long)]
    json: bool,
    /// Draw the largest map from above (PNG)
    #[arg(long, visible_alias = "picture", value_name = "OUT.png")]
    overview: Option<PathBuf>,
}

/// Write the largest map of a file for other programs
#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("format").required(true).multiple(true).args(["ply", "tum", "colmap"])))]
struct ExportArgs {
    /// Map file; of one that a running daemon writes to, that one is asked [default: the running daemon's map]
    file: Option<PathBuf>,
    /// Landmarks and keyframes (PLY)
    #[arg(long, value_name = "OUT.ply")]
    ply: Option<PathBuf>,
    /// Poses of the keyframes (TUM format)
    #[arg(long, value_name = "OUT")]
    tum: Option<PathBuf>,
    /// Folder for COLMAP's text model
    #[arg(long, value_name = "DIR")]
    colmap: Option<PathBuf>,
}

pub fn run(args: &MapArgs) -> Result<ExitCode, CliError> {
    match &args.action {
        Action::Info(info_args) => info(info_args, &args.endpoint),
        Action::Export(export_args) => export(export_args, &args.endpoint),
        #[cfg(feature = "bridge")]
        Action::Pull(pull_args) => super::map_pull::run(pull_args),
        Action::OfDaemon(action) => map_daemon::run(action, &args.endpoint),
    }
}

/// What `info` says of a file.
#[derive(Debug, Serialize)]
struct Info {
    file: String,
    format: u32,
    id: String,
    cairn: String,
    /// Seconds since 1970 (UTC).
    created_s: i64,
    written_s: i64,
    /// Timestamp of the newest frame that it knows of, s; null: it has seen none.
    newest_frame_s: Option<String>,
    size_bytes: u64,
    bytes_per_keyframe: u64,
    /// Of these: keyframes, their pictures, landmarks.
    record_bytes: [u64; 3],
    camera: CameraInfo,
    readout_ms: f64,
    maps: Vec<MapInfo>,
}

#[derive(Debug, Serialize)]
struct CameraInfo {
    width: u32,
    height: u32,
    /// `calibrated` or `estimated`.
    knowledge: &'static str,
    lens_model: &'static str,
    /// As it was refined from the motion: fx fy cx cy, px.
    intrinsics_px: [f64; 4],
    distortion: Vec<f64>,
    /// As it was given.
    given_px: [f64; 4],
    given_distortion: Vec<f64>,
}

#[derive(Debug, Serialize)]
struct MapInfo {
    id: u32,
    keyframes: usize,
    landmarks: usize,
    observations: usize,
    /// Frames that were tracked in it.
    frames: u64,
    /// Maps that have become a part of it, and how many keyframes of each are left.
    joined: Vec<JoinedInfo>,
    /// Standard deviation of the scale, as a share, where lengths are metres; null: they are map units.
    scale_sigma: Option<f64>,
    /// Who told it; empty: nobody.
    scale_source: String,
    /// Timestamps of the oldest and the newest keyframe, s.
    from_s: Option<String>,
    to_s: Option<String>,
    /// Corners of the box around all landmarks of known distance and keyframes, map units or metres, world axes (right, down, forward of the first
    /// keyframe); null: there are none.
    low: Option<[f64; 3]>,
    high: Option<[f64; 3]>,
}

#[derive(Debug, Serialize)]
struct JoinedInfo {
    id: u32,
    keyframes: usize,
}

impl JoinedInfo {
    fn of(saved: &SavedMap) -> Vec<Self> {
        let mut counts = BTreeMap::<u32, usize>::new();
        for (_, k) in saved.map.keyframes.iter().filter(|(_, k)| k.map != saved.head.id) {
            *counts.entry(k.map.0).or_default() += 1;
        }
        counts.into_iter().map(|(id, keyframes)| Self { id, keyframes }).collect()
    }
}

fn info(args: &InfoArgs, endpoint: &EndpointArgs) -> Result<ExitCode, CliError> {
    if args.overview.is_some() {
        super::builds::needs_tools("`--overview`")?;
    }
    session::check_outputs([&args.overview])?;
    let (file, contents) = contents(args.file.as_deref(), endpoint)?;
    let info = Info::of(&file, &contents);
    if let Some(path) = &args.overview {
        draw(path, largest(&file, &contents)?)?;
    }
    session::print(&if args.json { session::json(&info)? } else { info.text() })?;
    Ok(ExitCode::SUCCESS)
}

fn export(args: &ExportArgs, endpoint: &EndpointArgs) -> Result<ExitCode, CliError> {
    session::check_outputs([&args.ply, &args.tum])?;
    let (file, contents) = contents(args.file.as_deref(), endpoint)?;
    let saved = largest(&file, &contents)?;
    let failed = |error: &dyn std::fmt::Display| CliError::new(exit_code::CANNOT_CREATE, error.to_string());
    if let Some(path) = &args.ply {
        write_ply(path, &snapshot(saved)).map_err(|e| failed(&e))?;
    }
    if let Some(path) = &args.tum {
        write_tum(path, &poses(saved)).map_err(|e| failed(&e))?;
    }
    if let Some(folder) = &args.colmap {
        write_colmap(folder, &saved.map, &contents.saved.optics.camera).map_err(|e| failed(&e))?;
    }
    let (keyframes, landmarks) = (saved.map.keyframes.len(), saved.map.landmarks.len());
    let mut text = format!("map {}: {keyframes} keyframes, {landmarks} landmarks\n", saved.head.id.0);
    let others = contents.saved.maps.len() - 1;
    if others > 0 {
        text += &format!("{others} smaller maps of the file are not in it: they are not joined to this one\n");
    }
    for path in [&args.ply, &args.tum, &args.colmap].into_iter().flatten() {
        text += &format!("wrote {}\n", path.display());
    }
    session::print(&text)?;
    Ok(ExitCode::SUCCESS)
}

/// What is in a file, from the daemon where that one writes to it, or where no file is named.
fn contents(file: Option<&Path>, endpoint: &EndpointArgs) -> Result<(PathBuf, Contents), CliError> {
    let Some(file) = file else { return map_daemon::present(endpoint, None) };
    match read(file) {
        Ok(contents) => Ok((file.into(), contents)),
        Err(error) if matches!(error.fault, Fault::Busy) => {
            let held = |e: CliError| CliError::new(exit_code::UNAVAILABLE, format!("{error}; {}", e.message));
            map_daemon::present(endpoint, Some(file)).map_err(held)
        }
        Err(error) => Err(map_file::error(&error)),
    }
}

fn largest<'a>(file: &Path, contents: &'a Contents) -> Result<&'a SavedMap, CliError> {
    let none = || CliError::new(exit_code::DATA, format!("{}: there is no map in it yet", file.display()));
    contents.saved.maps.first().ok_or_else(none)
}

fn snapshot(saved: &SavedMap) -> MapSnapshot {
    let mut snapshot = MapSnapshot::default();
    snapshot.fill(saved.head.id, &saved.map);
    snapshot
}

/// Of the keyframes, by time.
fn poses(saved: &SavedMap) -> Vec<TumPose> {
    let keyframes = saved.map.keyframes.iter().map(|(_, k)| k);
    let pose = |k: &crate::map::Keyframe| TumPose {
        timestamp_ns: k.timestamp_ns,
        world_from_camera: k.camera_from_world.inverse(),
    };
    let mut poses: Vec<TumPose> = keyframes.map(pose).collect();
    poses.sort_by_key(|p| p.timestamp_ns);
    poses
}

#[cfg(feature = "tools")]
fn draw(path: &Path, saved: &SavedMap) -> Result<(), CliError> {
    use crate::plot::{LengthUnit, write_overview};
    let snapshot = snapshot(saved);
    let title = format!("map {} with {} landmarks", snapshot.map.0, snapshot.landmarks.len());
    write_overview(path, &snapshot, &[], LengthUnit::MapUnits, &title)
        .map_err(|e| CliError::new(exit_code::CANNOT_CREATE, e.to_string()))
}

/// Refused before the work.
#[cfg(not(feature = "tools"))]
fn draw(_: &Path, _: &SavedMap) -> Result<(), CliError> {
    super::builds::needs_tools("`--overview`")
}

impl Info {
    fn of(file: &Path, contents: &Contents) -> Self {
        let optics = &contents.saved.optics;
        let keyframes: usize = contents.saved.maps.iter().map(|m| m.map.keyframes.len()).sum();
        let intrinsics = |c: &CameraModel| [c.fx, c.fy, c.cx, c.cy];
        Self {
            file: file.display().to_string(),
            format: contents.format,
            id: contents.id.iter().map(|byte| format!("{byte:02x}")).collect(),
            cairn: contents.cairn.clone(),
            created_s: contents.created_ns.div_euclid(1_000_000_000),
            written_s: contents.written_ns.div_euclid(1_000_000_000),
            newest_frame_s: Some(contents.saved.frame_ns).filter(|ns| *ns != i64::MIN).map(format_timestamp),
            size_bytes: contents.bytes,
            bytes_per_keyframe: contents.bytes / keyframes.max(1) as u64,
            record_bytes: contents.record_bytes,
            camera: CameraInfo {
                width: optics.camera.width,
                height: optics.camera.height,
                knowledge: if optics.is_guessed { "estimated" } else { "calibrated" },
                lens_model: optics.camera.lens.name(),
                intrinsics_px: intrinsics(&optics.camera),
                distortion: optics.camera.lens.coefficients().to_vec(),
                given_px: intrinsics(&optics.calibration),
                given_distortion: optics.calibration.lens.coefficients().to_vec(),
            },
            readout_ms: 1e3 * optics.readout_s,
            maps: contents.saved.maps.iter().map(MapInfo::of).collect(),
        }
    }

    fn text(&self) -> String {
        let Self { file, format, id, cairn, .. } = self;
        let mb = self.size_bytes as f64 / 1e6;
        let mut text = format!("{file}: map {id}, format {format}, written by cairn {cairn}\n");
        text += &format!("  made {}, written {} (UTC)\n", date(self.created_s), date(self.written_s));
        let [keyframes, pictures, landmarks] = self.record_bytes.map(|bytes| bytes as f64 / 1e6);
        text += &format!("  {mb:.1} MB, {:.1} kB a keyframe", self.bytes_per_keyframe as f64 / 1e3);
        text += &format!(" (pictures {pictures:.1} MB, keyframes {keyframes:.1}, landmarks {landmarks:.1})\n");
        let CameraInfo { width, height, knowledge, lens_model, intrinsics_px: [fx, fy, cx, cy], .. } = &self.camera;
        text += &format!(
            "  camera {width} x {height} px, {knowledge}, {lens_model}: fx {fx:.2} fy {fy:.2} cx {cx:.2} cy {cy:.2} px\n"
        );
        let [fx, fy, cx, cy] = self.camera.given_px;
        text += &format!(
            "  as it was given: fx {fx:.2} fy {fy:.2} cx {cx:.2} cy {cy:.2} px; readout {:.1} ms\n",
            self.readout_ms
        );
        if self.maps.is_empty() {
            text += "  no map yet\n";
        }
        for map in &self.maps {
            text += &map.text();
        }
        text
    }
}

impl MapInfo {
    fn of(saved: &SavedMap) -> Self {
        let map = &saved.map;
        let landmarks = map.landmarks.iter().filter(|(_, l)| l.assumed.is_none()).map(|(_, l)| l.position);
        let points: Vec<_> = landmarks.chain(map.keyframes.iter().map(|(_, k)| k.centre())).collect();
        let corner =
            |pick: fn(f64, f64) -> f64| points.iter().copied().reduce(|a, b| a.zip_map(&b, pick)).map(<[f64; 3]>::from);
        let (scale_sigma, scale_source) = match saved.head.scale {
            MapScale::Unknown => (None, String::new()),
            MapScale::Metric { sigma, sources } => (Some(sigma), sources.to_string()),
        };
        let times = || map.keyframes.iter().map(|(_, k)| k.timestamp_ns);
        Self {
            id: saved.head.id.0,
            keyframes: map.keyframes.len(),
            landmarks: map.landmarks.len(),
            observations: map.keyframes.iter().map(|(_, k)| k.observations.len()).sum(),
            frames: saved.head.frames,
            joined: JoinedInfo::of(saved),
            scale_sigma,
            scale_source,
            from_s: times().min().map(format_timestamp),
            to_s: times().max().map(format_timestamp),
            low: corner(f64::min),
            high: corner(f64::max),
        }
    }

    fn text(&self) -> String {
        let Self { id, keyframes, landmarks, observations, frames, .. } = self;
        let mut text = format!(
            "  map {id}: {keyframes} keyframes, {landmarks} landmarks, {observations} observations; {frames} frames tracked in it\n"
        );
        if let (Some(from), Some(to)) = (&self.from_s, &self.to_s) {
            text += &format!("    keyframes from {from} to {to} s\n");
        }
        for JoinedInfo { id, keyframes } in &self.joined {
            text += &format!("    {keyframes} of these keyframes were made in map {id}, which was joined to it\n");
        }
        match self.scale_sigma {
            Some(sigma) => {
                text += &format!("    lengths are metres, to {:.2} % by {}\n", 1e2 * sigma, self.scale_source)
            }
            None => text += "    lengths are map units, no metres\n",
        }
        if let (Some(low), Some(high)) = (self.low, self.high) {
            let point = |p: [f64; 3]| format!("({:.2} {:.2} {:.2})", p[0], p[1], p[2]);
            let unit = if self.scale_sigma.is_some() { "m" } else { "map units" };
            text += &format!("    from {} to {} {unit} (right, down, forward)\n", point(low), point(high));
        }
        text
    }
}
