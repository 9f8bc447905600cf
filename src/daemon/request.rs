//! What may be asked of the reconstruction stage between two frames: by the supervisor, and by whoever reads map files for it.

use std::path::PathBuf;

use crossbeam::channel::Sender;

use super::calibration::Calibration;
use super::map_folder::MapFolder;
use super::recorder::SaveKind;
use crate::geometry::Se3;
use crate::geometry::frames::Body;
use crate::map::saved::SavedMaps;
use crate::places::store::{Edition, MapFile};
use crate::publish::convert::Map;

/// What became of a command: a sentence either way.
pub type Reply = Sender<Result<String, String>>;

/// What may be asked of the stage between two frames.
#[derive(Debug)]
pub enum Request {
    /// Drop the map and start over.
    Reset { why: &'static str },
    /// A calibration of the camera was kept: the next map has it.
    Calibrated(Box<Calibration>),
    /// Have a file written.
    Save { kind: SaveKind, path: PathBuf, reply: Reply },
    /// Publish such that the robot is here now.
    SetPose { map_from_body: Se3<Map, Body>, reply: Reply },
    /// Something about maps and their files.
    Map { request: MapRequest, reply: Reply },
    /// A map that was asked for has been read.
    TakeMap { loaded: Box<Loaded>, reply: Reply },
    /// Maps that are to be merged with the present one have been read.
    TakeMerged { loaded: Box<Loaded>, reply: Reply },
    /// The old map is stored: a new one may begin, kept in this file.
    BeginMap { path: PathBuf, reply: Reply },
}

/// A command on maps. Names are checked already.
#[derive(Debug)]
pub enum MapRequest {
    /// To its own file, now.
    Store,
    Copy(CopyTo),
    Load(PathBuf),
    Merge(PathBuf),
    New(PathBuf, MapFolder),
    Localise(bool),
    List(MapFolder, String),
}

/// Where a copy goes.
#[derive(Debug)]
pub enum CopyTo {
    /// A map of the folder.
    Named(PathBuf, MapFolder),
    /// A file for the sender of the command alone.
    Sender(MapFolder),
}

/// A map that is to be gone on in, or merged, with ids of this run.
pub struct Loaded {
    pub path: PathBuf,
    /// Open for writing; `None`: it is only to be located in, or its maps are to be parts of another one.
    pub file: Option<MapFile>,
    pub edition: Edition,
    pub saved: SavedMaps,
}

impl std::fmt::Debug for Loaded {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Loaded").field("path", &self.path).finish_non_exhaustive()
    }
}
