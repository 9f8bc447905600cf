//! Who writes maps to disk, and reads those that a command asks for: in the daemon a thread of its own, in lock-step called directly.
//!
//! A map that is left is written before: what comes with a load or a new map follows the last changes of the old one through the same
//! queue, and goes on only if these are on the disk. Reading a file, verifying it and giving its maps ids of this run happens here;
//! reconstruction gets maps that it only has to take.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use crossbeam::channel::{Receiver, Sender};
use tracing::{debug, error, info, warn};

use super::map_folder::MapFolder;
use super::request::{CopyTo, Loaded, Reply, Request};
use crate::map::saved::{Ids, MapChanges, SavedMaps};
use crate::messages::TEXT_LEN;
use crate::places::store::{Fault, MOST_IDS, MapFile, StoreError, read_to_locate};

/// Ids that a run may give while a file is read: half a minute of keyframes and landmarks at the utmost.
const MEANWHILE: Ids = Ids { maps: 16, keyframes: 1 << 10, landmarks: 1 << 17 };
/// A stage that does not take a request for so long hangs.
const PATIENCE: Duration = Duration::from_secs(5);

/// What whoever writes tells the desk.
#[derive(Debug, Default)]
pub struct KeeperWord {
    /// It has to hand over everything.
    pub wants_everything: AtomicBool,
    /// The newest changes are not in the file.
    pub fails: AtomicBool,
}

/// Who writes.
pub struct Keeper {
    path: PathBuf,
    file: Option<MapFile>,
    exists: bool,
    /// Why the newest changes are not in the file.
    failed: Option<StoreError>,
    word: Arc<KeeperWord>,
}

/// What is handed to whoever writes.
pub enum Order {
    /// Changes of the map; told whoever waits for them to be on the disk.
    Keep(Box<MapChanges>, Option<Reply>),
    /// Everything, into the map's own file if it has one, and into another, which is made.
    Copy {
        everything: Box<MapChanges>,
        to: CopyTo,
        reply: Reply,
    },
    /// Read a map for reconstruction, whose ids are these so far.
    Load {
        path: PathBuf,
        given: Ids,
        localise_only: bool,
        requests: Sender<Request>,
        reply: Reply,
    },
    /// Read maps that are to be merged with those of reconstruction, whose ids are these so far.
    Merge {
        path: PathBuf,
        given: Ids,
        requests: Sender<Request>,
        reply: Reply,
    },
    /// A new map is to begin in this file: back to reconstruction with it, if the old one is on the disk.
    Begin {
        path: PathBuf,
        folder: MapFolder,
        requests: Sender<Request>,
        reply: Reply,
    },
    List {
        folder: MapFolder,
        after: String,
        reply: Reply,
    },
    /// Changes go to this file from now on, or to none.
    Switch(Option<Box<Keeper>>),
}

impl Keeper {
    /// `file`: open for writing; `None`: to be opened, or made unless it `exists`, with the first changes.
    pub fn new(path: PathBuf, file: Option<MapFile>, exists: bool, word: Arc<KeeperWord>) -> Self {
        Self { path, file, exists, failed: None, word }
    }

    /// Writes changes; everything, if the file is to be made or opened anew. Everything is written twice where a spool did not give a picture: what was
    /// handed over last nothing repeats later.
    pub fn keep(&mut self, changes: &MapChanges) {
        self.keep_once(changes);
        if changes.is_everything && self.lacks_pictures() {
            self.keep_once(changes);
        }
    }

    fn keep_once(&mut self, changes: &MapChanges) {
        if matches!(&self.failed, Some(StoreError { fault: Fault::Replaced, .. })) {
            // It is somebody else's now, however whole; everything handed over again would not change that.
            self.word.wants_everything.store(false, Ordering::Release);
            return;
        }
        if self.failed.is_some() && !changes.is_everything {
            // They were on their way when the ones before were lost, and make no map without those.
            self.word.wants_everything.store(true, Ordering::Release);
            return;
        }
        // At the second attempt a picture that cannot be read holds up nothing else.
        let without_unread = self.lacks_pictures();
        let outcome = self.ready(changes, without_unread).and_then(|file| match file {
            Some(file) => file.write(changes),
            None => Ok(0),
        });
        match outcome {
            Ok(bytes) => {
                let left_out = self.file.as_ref().map_or(0, MapFile::left_out);
                tell_left_out(&self.path, left_out);
                let keyframes = changes.keyframes.len();
                debug!(path = %self.path.display(), keyframes, bytes, "map file written");
                self.failed = None;
            }
            Err(reason) => {
                if self.failed.is_none() {
                    error!(%reason, "map file not written, tried again later");
                }
                (self.file, self.failed) = (None, Some(reason));
                self.word.wants_everything.store(true, Ordering::Release);
            }
        }
        self.word.fails.store(self.failed.is_some(), Ordering::Release);
    }

    /// The last write failed for want of a picture.
    fn lacks_pictures(&self) -> bool {
        matches!(&self.failed, Some(StoreError { fault: Fault::Spool(_), .. }))
    }

    /// The file, to write the changes to; `None` if they are in it already, as it was made with them.
    fn ready(&mut self, changes: &MapChanges, without_unread: bool) -> Result<Option<&mut MapFile>, StoreError> {
        if self.file.is_none() {
            let file = match (self.exists, without_unread) {
                (true, _) => MapFile::open(&self.path)?.0,
                (false, false) => MapFile::create(&self.path, changes)?,
                (false, true) => MapFile::create_without_unread(&self.path, changes)?,
            };
            let made = !std::mem::replace(&mut self.exists, true);
            self.file = Some(file);
            if made {
                return Ok(None);
            }
        }
        if let Some(file) = self.file.as_mut().filter(|_| without_unread) {
            file.do_without_unread();
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

    /// Whether what was handed over last is on the disk.
    fn outcome(&self) -> Result<String, String> {
        match &self.failed {
            None => Ok(format!("the map is stored in {}", self.path.display())),
            Some(reason) => Err(reason.to_string()),
        }
    }
}

/// The keeper's thread: works off orders until the desk is gone.
pub fn serve(mut keeper: Option<Keeper>, orders: &Receiver<Order>) -> Result<Option<PathBuf>, String> {
    for order in orders {
        match order {
            Order::Keep(changes, reply) => {
                if let Some(keeper) = &mut keeper {
                    keeper.keep(&changes);
                }
                if let Some(reply) = reply {
                    answer(&reply, keeper.as_ref().map_or(Err("the map has no file".into()), Keeper::outcome));
                }
            }
            Order::Copy { everything, to, reply } => {
                if let Some(keeper) = &mut keeper {
                    keeper.keep(&everything);
                }
                answer(&reply, copy(&everything, to, keeper.as_ref()));
            }
            Order::Load { path, given, localise_only, requests, reply } => {
                let loaded = left(keeper.as_ref()).and_then(|()| load(path, given, localise_only, keeper.as_ref()));
                pass_on(
                    loaded.map(|loaded| Request::TakeMap { loaded: Box::new(loaded), reply: reply.clone() }),
                    &requests,
                    &reply,
                );
            }
            Order::Merge { path, given, requests, reply } => {
                let loaded = read_to_merge(path, given, keeper.as_ref());
                pass_on(
                    loaded.map(|loaded| Request::TakeMerged { loaded: Box::new(loaded), reply: reply.clone() }),
                    &requests,
                    &reply,
                );
            }
            Order::Begin { path, folder, requests, reply } => {
                let ready = left(keeper.as_ref()).and_then(|()| folder.new_file(&path));
                pass_on(ready.map(|()| Request::BeginMap { path, reply: reply.clone() }), &requests, &reply);
            }
            Order::List { folder, after, reply } => {
                let current = keeper.as_ref().map(|keeper| keeper.path.as_path());
                answer(&reply, Ok(folder.list(&after, current)));
            }
            Order::Switch(next) => {
                let old = std::mem::replace(&mut keeper, next.map(|next| *next));
                if let Some(old) = &old {
                    old.word.fails.store(false, Ordering::Release);
                }
                if let Some(Err(reason)) = old.map(Keeper::close) {
                    error!(reason, "map file not closed");
                }
            }
        }
    }
    keeper.map_or(Ok(None), Keeper::close)
}

/// Whoever asked may have gone.
fn answer(reply: &Reply, outcome: Result<String, String>) {
    let _ = reply.try_send(outcome);
}

fn pass_on(request: Result<Request, String>, requests: &Sender<Request>, reply: &Reply) {
    let sent = request.and_then(|request| {
        requests.send_timeout(request, PATIENCE).map_err(|_| "the reconstruction stage takes no requests".to_owned())
    });
    if let Err(reason) = sent {
        answer(reply, Err(reason));
    }
}

/// Whether the present map may be left: it is on the disk, if it has a file.
fn left(keeper: Option<&Keeper>) -> Result<(), String> {
    match keeper.and_then(|keeper| keeper.failed.as_ref()) {
        Some(reason) => Err(format!("the present map is not left, as it cannot be stored: {reason}")),
        None => Ok(()),
    }
}

fn load(path: PathBuf, given: Ids, localise_only: bool, keeper: Option<&Keeper>) -> Result<Loaded, String> {
    other_than_present(&path, keeper)?;
    let (file, saved) = match localise_only {
        true => (None, read_to_locate(&path).map_err(|e| e.to_string())?.saved),
        false => {
            let (file, contents) = MapFile::open(&path).map_err(|e| e.to_string())?;
            (Some(file), contents.saved)
        }
    };
    let saved = of_this_run(saved, given).map_err(|reason| format!("{}: {reason}", path.display()))?;
    Ok(Loaded { path, file, saved })
}

/// Only read: it stays as it is, and nobody's.
fn read_to_merge(path: PathBuf, given: Ids, keeper: Option<&Keeper>) -> Result<Loaded, String> {
    other_than_present(&path, keeper)?;
    let saved = read_to_locate(&path).map_err(|e| e.to_string())?.saved;
    let saved = of_this_run(saved, given).map_err(|reason| format!("{}: {reason}", path.display()))?;
    Ok(Loaded { path, file: None, saved })
}

fn other_than_present(path: &Path, keeper: Option<&Keeper>) -> Result<(), String> {
    match keeper.is_some_and(|keeper| keeper.path == path) {
        true => Err(format!("{}: it is the present map", path.display())),
        false => Ok(()),
    }
}

/// Maps with ids above those that the run has given, and gives while they are on their way.
fn of_this_run(saved: SavedMaps, given: Ids) -> Result<SavedMaps, String> {
    if saved.maps.is_empty() {
        return Err("there is no map in it yet".into());
    }
    let above = |given: u32, margin: u32| given.checked_add(margin);
    let from = || {
        Some(Ids {
            maps: above(given.maps, MEANWHILE.maps)?,
            keyframes: above(given.keyframes, MEANWHILE.keyframes)?,
            landmarks: above(given.landmarks, MEANWHILE.landmarks)?,
        })
    };
    let used_up = || "the ids of this run are used up; restart the daemon".to_owned();
    let saved = from().ok_or_else(used_up).and_then(|from| saved.renumbered(from))?;
    if saved.next_id() < MOST_IDS { Ok(saved) } else { Err(used_up()) }
}

fn tell_left_out(path: &Path, left_out: usize) {
    if left_out > 0 {
        warn!(path = %path.display(), left_out, "map file without pictures that the spool does not give");
    }
}

fn copy(everything: &MapChanges, to: CopyTo, keeper: Option<&Keeper>) -> Result<String, String> {
    let write = |path: &PathBuf| {
        let file = match MapFile::create(path, everything) {
            Err(StoreError { fault: Fault::Spool(_), .. }) => {
                let file = MapFile::create_without_unread(path, everything);
                file.inspect(|file| tell_left_out(path, file.left_out()))
            }
            other => other,
        };
        file.and_then(MapFile::close).map_err(|e| e.to_string())
    };
    match to {
        CopyTo::Named(path, folder) => {
            folder.new_file(&path)?;
            write(&path)?;
            info!(path = %path.display(), "map copied");
            Ok(format!("the map as it is now is stored in {}", path.display()))
        }
        CopyTo::Sender(folder) => {
            let path = folder.copy_file()?;
            let own = keeper.map(|keeper| keeper.path.display().to_string()).unwrap_or_default();
            let answer = format!("{}\n{own}", path.display());
            if answer.len() > TEXT_LEN {
                // Cut off, it would name another file, which the sender removes.
                let (is, most) = (answer.len(), TEXT_LEN);
                return Err(format!("the paths of the copy and of the map have {is} bytes, more than {most}"));
            }
            write(&path)?;
            Ok(answer)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::CameraModel;
    use crate::map::saved::{MapHead, SavedMap};
    use crate::map::scale::MapScale;
    use crate::map::{KeyframeId, Map, MapId};
    use crate::reconstruction::{InlineWorker, Reconstruction, ReconstructionConfig};

    fn begun() -> Reconstruction {
        let camera = CameraModel::new(320, 240, 300.0, 300.0, 159.5, 119.5, [0.0; 5]).expect("camera");
        Reconstruction::new(&ReconstructionConfig::default(), &camera, Box::new(InlineWorker::default()), true)
    }

    #[test]
    fn what_follows_a_write_that_failed_is_not_written_without_what_was_lost() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("missing/a.map");
        let word = Arc::<KeeperWord>::default();
        let mut keeper = Keeper::new(path.clone(), None, false, word.clone());
        let mut reconstruction = begun();
        keeper.keep(&reconstruction.take_changes(true));
        assert!(keeper.outcome().is_err() && word.wants_everything.swap(false, Ordering::AcqRel));
        std::fs::create_dir(dir.path().join("missing")).expect("made");
        let some = reconstruction.take_changes(false);
        assert!(!some.is_everything);
        keeper.keep(&some);
        assert!(keeper.outcome().is_err() && !path.exists(), "a part of a map");
        assert!(word.wants_everything.load(Ordering::Acquire) && word.fails.load(Ordering::Acquire));
        keeper.keep(&reconstruction.take_changes(true));
        assert!(keeper.outcome().is_ok() && path.exists() && !word.fails.load(Ordering::Acquire));
    }

    #[test]
    fn a_map_to_be_merged_is_nobody_elses_no_other_one_and_left_as_it_is() {
        let dir = tempfile::tempdir().expect("folder");
        let (path, empty) = (dir.path().join("a.map"), dir.path().join("b.map"));
        let given = Ids::default();
        let told =
            |path: &PathBuf, keeper: Option<&Keeper>| read_to_merge(path.clone(), given, keeper).expect_err("refused");
        assert!(told(&path, None).contains("cannot be read"));
        let changes = begun().take_changes(true);
        let held = MapFile::create(&path, &changes).expect("made");
        assert!(told(&path, None).contains("another process"));
        let keeper = Keeper::new(path.clone(), None, true, Arc::default());
        assert!(told(&path, Some(&keeper)).contains("the present map"));
        held.close().expect("closed");
        MapFile::create(&empty, &changes).and_then(MapFile::close).expect("made");
        let bytes = std::fs::read(&empty).expect("read");
        assert!(told(&empty, Some(&keeper)).contains("no map in it"));
        assert_eq!(std::fs::read(&empty).expect("read"), bytes);
        let full = Ids { maps: 0, keyframes: u32::MAX - 5, landmarks: 0 };
        let one = SavedMap { head: head(), map: Map::default() };
        let saved = || SavedMaps { frame_ns: 0, optics: changes.optics.clone(), maps: vec![one] };
        assert!(of_this_run(saved(), full).err().is_some_and(|told| told.contains("used up")));
    }

    fn head() -> MapHead {
        MapHead { id: MapId(0), reference: KeyframeId(0), frames: 0, scale: MapScale::Unknown, turns: vec![] }
    }

    #[test]
    fn a_copy_whose_path_fits_into_no_answer_is_not_made() {
        let dir = tempfile::tempdir().expect("folder");
        let deep = dir.path().join("d".repeat(200)).join("e".repeat(200)).join("f".repeat(100));
        let folder = MapFolder::new(deep.clone());
        let told = copy(&begun().take_changes(true), CopyTo::Sender(folder), None).expect_err("too long");
        assert!(told.contains("bytes"), "{told}");
        assert_eq!(std::fs::read_dir(deep.join("copies")).expect("made").count(), 0);
    }
}
