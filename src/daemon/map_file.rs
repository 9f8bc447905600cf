//! The map on disk while the daemon runs: loaded before the first frame, written every few seconds, whole at the end.
//!
//! The reconstruction stage hands over what has changed ([`MapDesk`]) after a pose was published and never waits for a disk: in the daemon the
//! changes go to a thread of their own, and while that is at work none are taken, so the next ones hold all that came meanwhile. In lock-step the
//! same keeper is called directly, at the same frames of a recording every time.
//!
//! A write that fails loses nothing that is in the file: it is opened anew after a while, verified, and given all there is.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use crossbeam::channel::{Receiver, Sender};
use tracing::{debug, error, info, warn};

use crate::geometry::CameraModel;
use crate::map::MapId;
use crate::map::saved::{MapChanges, SavedMaps, SavedOptics};
use crate::messages::map_mode;
use crate::places::store::{MapFile, StoreError};
use crate::reconstruction::{LensPrior, Reconstruction, TrajectoryEvent};

/// Between two writes, ns of the frames' time: what a power cut loses at the most, with the time that a write takes.
const WRITE_EVERY_NS: i64 = 2_000_000_000;
/// The same after a write that failed.
const RETRY_AFTER_NS: i64 = 30_000_000_000;
/// A slow disk is waited for so long at the end.
const LAST_WAIT: Duration = Duration::from_secs(2);

/// The map file of a run, as whoever starts it has found it.
pub struct MapPlan {
    pub path: PathBuf,
    /// Open for writing; `None`: it is still to be made, or only looked at.
    pub file: Option<MapFile>,
    /// What was in it.
    pub saved: Option<SavedMaps>,
    /// Nothing is written, and the maps stay as they are.
    pub localise_only: bool,
}

/// Who writes.
pub struct Keeper {
    path: PathBuf,
    file: Option<MapFile>,
    exists: bool,
    /// Why the newest changes are not in the file.
    failed: Option<StoreError>,
    /// Told to the desk: it has to hand over everything.
    wants_everything: Arc<AtomicBool>,
}

/// The way there.
pub enum KeeperLink {
    /// Called directly: lock-step.
    Inline(Box<Keeper>),
    Queue(Sender<Box<MapChanges>>),
}

/// Reconstruction's end of it.
pub struct MapDesk {
    path: PathBuf,
    saved: Option<SavedMaps>,
    /// Maps that came from the file, or have become a part of one.
    stored: BTreeSet<MapId>,
    localise_only: bool,
    /// `None`: nothing is written (any more).
    link: Option<KeeperLink>,
    wants_everything: Arc<AtomicBool>,
    /// Time of the frame after which it was written last.
    last_ns: Option<i64>,
}

impl MapPlan {
    /// The keeper, and the desk without its link to it.
    pub fn split(self) -> (MapDesk, Option<Keeper>) {
        let wants_everything = Arc::new(AtomicBool::new(false));
        let keeper = (!self.localise_only).then(|| Keeper {
            path: self.path.clone(),
            exists: self.file.is_some(),
            file: self.file,
            failed: None,
            wants_everything: wants_everything.clone(),
        });
        let (path, saved, localise_only) = (self.path, self.saved, self.localise_only);
        let stored = saved.iter().flat_map(|saved| saved.maps.iter().map(|m| m.head.id)).collect();
        (MapDesk { path, saved, stored, localise_only, link: None, wants_everything, last_ns: None }, keeper)
    }
}

impl Keeper {
    /// Writes changes; everything, if the file is to be made or opened anew.
    pub fn keep(&mut self, changes: &MapChanges) {
        let outcome = self.ready(changes).and_then(|file| match file {
            Some(file) => file.write(changes),
            None => Ok(0),
        });
        match outcome {
            Ok(bytes) => {
                let keyframes = changes.keyframes.len();
                debug!(path = %self.path.display(), keyframes, bytes, "map file written");
                self.failed = None;
            }
            Err(reason) => {
                if self.failed.is_none() {
                    error!(%reason, "map file not written, tried again later");
                }
                (self.file, self.failed) = (None, Some(reason));
                self.wants_everything.store(true, Ordering::Release);
            }
        }
    }

    /// The file, to write the changes to; `None` if they are in it already, as it was made with them.
    fn ready(&mut self, changes: &MapChanges) -> Result<Option<&mut MapFile>, StoreError> {
        if self.file.is_none() {
            let file = match self.exists {
                true => MapFile::open(&self.path)?.0,
                false => MapFile::create(&self.path, changes)?,
            };
            let made = !std::mem::replace(&mut self.exists, true);
            self.file = Some(file);
            if made {
                return Ok(None);
            }
        }
        Ok(self.file.as_mut())
    }

    /// Closes the file: where it lies, or why what came last is not in it.
    pub fn close(self) -> Result<Option<PathBuf>, String> {
        if let Some(failed) = self.failed {
            return Err(failed.to_string());
        }
        let Some(file) = self.file else { return Ok(None) };
        file.close().map_err(|e| e.to_string())?;
        info!(path = %self.path.display(), "map file closed");
        Ok(Some(self.path))
    }
}

/// The keeper's thread: works off changes until the desk is gone.
pub fn serve(mut keeper: Keeper, changes: &Receiver<Box<MapChanges>>) -> Result<Option<PathBuf>, String> {
    for changes in changes {
        keeper.keep(&changes);
    }
    keeper.close()
}

impl MapDesk {
    pub fn linked(self, link: Option<KeeperLink>) -> Self {
        Self { link, ..self }
    }

    /// A reconstruction has begun: it goes on in what the file has. The error: it is of another camera.
    pub fn begin(
        &mut self,
        reconstruction: &mut Reconstruction,
        camera: &CameraModel,
        prior: LensPrior,
    ) -> Result<(), String> {
        let Some(saved) = self.saved.take() else { return Ok(()) };
        let path = self.path.display();
        check_camera(&saved.optics, camera, prior).map_err(|reason| format!("{path}: {reason}"))?;
        let maps = saved.maps.len();
        let keyframes = saved.maps.first().map_or(0, |m| m.map.keyframes.len());
        info!(path = %path, maps, keyframes, localise_only = self.localise_only, "map loaded");
        reconstruction.resume(saved, self.localise_only);
        Ok(())
    }

    /// What happened to maps.
    pub fn note(&mut self, event: &TrajectoryEvent) {
        if let TrajectoryEvent::MapJoined { map, into, .. } = event
            && self.stored.contains(map)
        {
            self.stored.insert(*into);
        }
    }

    /// Bits of the wire's `map_mode` while frames are placed in this map.
    pub fn mode(&self, map: MapId) -> u8 {
        let bit = |is_set: bool, bit: u8| if is_set { bit } else { 0 };
        bit(self.localise_only, map_mode::LOCALISATION_ONLY) | bit(self.stored.contains(&map), map_mode::STORED)
    }

    /// After a frame: hands over what has changed, if it is time and the keeper has nothing to do.
    pub fn turn(&mut self, reconstruction: &mut Reconstruction, timestamp_ns: i64) {
        let every = if self.wants_everything.load(Ordering::Acquire) { RETRY_AFTER_NS } else { WRITE_EVERY_NS };
        let is_due = |last: i64| timestamp_ns < last || timestamp_ns.saturating_sub(last) >= every;
        if !self.last_ns.is_none_or(is_due) {
            return;
        }
        match &mut self.link {
            Some(KeeperLink::Inline(keeper)) => {
                let everything = self.wants_everything.swap(false, Ordering::AcqRel);
                keeper.keep(&reconstruction.take_changes(everything));
            }
            Some(KeeperLink::Queue(orders)) if orders.is_empty() => {
                let everything = self.wants_everything.swap(false, Ordering::AcqRel);
                // There is room: nobody else sends. If the thread has gone, the end tells.
                let _ = orders.try_send(Box::new(reconstruction.take_changes(everything)));
            }
            _ => return,
        }
        self.last_ns = Some(timestamp_ns);
    }

    /// The last word: everything, with what is not worth a write by itself. `Inline`: the keeper, to be closed.
    pub fn finish(mut self, reconstruction: Option<&mut Reconstruction>) -> Option<Keeper> {
        let link = self.link.take()?;
        let changes = reconstruction.map(|r| r.take_changes(true));
        match link {
            KeeperLink::Inline(mut keeper) => {
                if let Some(changes) = changes {
                    keeper.keep(&changes);
                }
                Some(*keeper)
            }
            KeeperLink::Queue(orders) => {
                if let Some(changes) = changes
                    && orders.send_timeout(Box::new(changes), LAST_WAIT).is_err()
                {
                    error!(path = %self.path.display(), "map file: the disk is too slow, the last seconds are not in it");
                }
                None
            }
        }
    }

    /// The maps that the file is about are dropped: it keeps what it has.
    pub fn let_go(&mut self, why: &'static str) {
        self.saved = None;
        self.stored.clear();
        if self.link.take().is_some() {
            warn!(path = %self.path.display(), why, "map file keeps what it has, and nothing more is written to it");
        }
    }
}

/// Whether a file's maps were made with this camera. Two that nobody calibrated are the same as far as can be said.
fn check_camera(saved: &SavedOptics, camera: &CameraModel, prior: LensPrior) -> Result<(), String> {
    let is_guessed = prior != LensPrior::Calibrated;
    let own = &saved.calibration;
    let same = match is_guessed {
        true => (own.width, own.height) == (camera.width, camera.height),
        false => own == camera,
    };
    if same && is_guessed == saved.is_guessed {
        return Ok(());
    }
    let describe = |camera: &CameraModel, is_guessed: bool| {
        if is_guessed {
            return format!("{} x {} px, not calibrated", camera.width, camera.height);
        }
        let lens = camera.lens.names().iter().zip(camera.lens.coefficients());
        let lens: Vec<String> = lens.map(|(name, value)| format!("{name} {value}")).collect();
        let CameraModel { width, height, fx, fy, cx, cy, .. } = camera;
        format!("{width} x {height} px, fx {fx} fy {fy} cx {cx} cy {cy} px, {} {}", camera.lens.name(), lens.join(" "))
    };
    Err(format!(
        "the map is another camera's or calibration's: it was made with {}; this is {}",
        describe(own, saved.is_guessed),
        describe(camera, is_guessed)
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reconstruction::{InlineWorker, ReconstructionConfig};

    fn camera(fx: f64) -> CameraModel {
        CameraModel::new(320, 240, fx, 300.0, 159.5, 119.5, [0.1, 0.0, 0.0, 0.0, 0.0]).expect("camera")
    }

    fn begun(camera: &CameraModel, prior: LensPrior) -> Reconstruction {
        let config = ReconstructionConfig::default();
        Reconstruction::with_lens(&config, camera, prior, Box::new(InlineWorker::default()), true)
    }

    #[test]
    fn a_map_of_another_camera_or_calibration_is_refused_with_both_values() {
        let saved = begun(&camera(301.5), LensPrior::Calibrated).take_changes(true).optics;
        assert_eq!(check_camera(&saved, &camera(301.5), LensPrior::Calibrated), Ok(()));
        let told = check_camera(&saved, &camera(302.25), LensPrior::Calibrated).expect_err("another focal length");
        assert!(told.contains("301.5") && told.contains("302.25") && told.contains("px"), "{told}");
        let told = check_camera(&saved, &camera(301.5), LensPrior::UNKNOWN).expect_err("nobody calibrated this one");
        assert!(told.contains("not calibrated"), "{told}");
        let guessed = begun(&camera(280.0), LensPrior::UNKNOWN).take_changes(true).optics;
        assert_eq!(check_camera(&guessed, &camera(290.0), LensPrior::UNKNOWN), Ok(()), "both are guesses");
    }

    #[test]
    fn a_map_that_a_stored_one_was_joined_to_counts_as_stored() {
        let plan = MapPlan { path: "a.map".into(), file: None, saved: None, localise_only: true };
        let mut desk = plan.split().0;
        desk.stored.insert(MapId(3));
        let joined = |map, into| TrajectoryEvent::MapJoined { map: MapId(map), into: MapId(into), scale: 1.0 };
        assert_eq!(desk.mode(MapId(4)), map_mode::LOCALISATION_ONLY);
        desk.note(&joined(2, 5));
        desk.note(&joined(3, 4));
        assert_eq!(
            [5, 4, 3].map(|id| desk.mode(MapId(id)) & map_mode::STORED),
            [0, map_mode::STORED, map_mode::STORED]
        );
        desk.let_go("reset");
        assert_eq!(desk.mode(MapId(3)) & map_mode::STORED, 0);
    }

    #[test]
    fn a_file_is_made_written_in_time_and_after_a_failure_anew() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("missing").join("a.map");
        let plan = MapPlan { path: path.clone(), file: None, saved: None, localise_only: false };
        let (desk, keeper) = plan.split();
        let mut desk = desk.linked(keeper.map(|keeper| KeeperLink::Inline(Box::new(keeper))));
        let mut r = begun(&camera(300.0), LensPrior::Calibrated);
        desk.turn(&mut r, 0);
        assert!(desk.wants_everything.load(Ordering::Acquire), "there is no folder");
        std::fs::create_dir(dir.path().join("missing")).expect("folder");
        desk.turn(&mut r, RETRY_AFTER_NS - 1);
        assert!(!path.exists(), "not so soon");
        desk.turn(&mut r, RETRY_AFTER_NS);
        assert!(path.exists());
        let keeper = desk.finish(Some(&mut r)).expect("called directly");
        assert_eq!(keeper.close(), Ok(Some(path.clone())));
        let contents = crate::places::store::read(&path).expect("whole");
        assert!(contents.saved.maps.is_empty() && contents.saved.optics.calibration == camera(300.0));
    }
}
