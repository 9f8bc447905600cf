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
use crate::places::store::{Contents, Edition, Fault, MOST_IDS, MapFile, StoreError, read_to_locate};

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
    /// What the file had when it was read or written last; `None`: it is to be made.
    left: Option<Edition>,
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
    /// `file`: open for writing; `None`: to be opened with the first changes, which go into that edition of it and no other, or to be made.
    pub fn new(path: PathBuf, file: Option<MapFile>, left: Option<Edition>, word: Arc<KeeperWord>) -> Self {
        Self { path, file, left, failed: None, word }
    }

    /// Writes changes; everything, if the file is to be made or opened anew. Everything is written twice where a spool did not give a picture, or the
    /// file is not where it was: what was handed over last nothing repeats later.
    pub fn keep(&mut self, changes: &MapChanges) {
        self.keep_once(changes);
        if changes.is_everything && (self.lacks_pictures() || self.has_lost_file()) {
            self.keep_once(changes);
        }
    }

    fn keep_once(&mut self, changes: &MapChanges) {
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
                self.left = self.file.take().map(|file| file.edition()).or(self.left);
                self.failed = Some(reason);
                self.word.wants_everything.store(true, Ordering::Release);
            }
        }
        self.word.fails.store(self.failed.is_some(), Ordering::Release);
    }

    /// The last write failed for want of a picture.
    fn lacks_pictures(&self) -> bool {
        matches!(&self.failed, Some(StoreError { fault: Fault::Spool(_), .. }))
    }

    fn has_lost_file(&self) -> bool {
        matches!(&self.failed, Some(StoreError { fault: Fault::Replaced, .. }))
    }

    /// The file, to write the changes to; `None` if they are in it already, as it was made with them.
    fn ready(&mut self, changes: &MapChanges, without_unread: bool) -> Result<Option<&mut MapFile>, StoreError> {
        if self.file.is_none() {
            let make = |path: &Path| match without_unread {
                false => MapFile::create(path, changes),
                true => MapFile::create_without_unread(path, changes),
            };
            let there = match self.left.map(|left| MapFile::open_again(&self.path, &left)) {
                Some(Err(reason)) if !reason.fault.is_missing() => Err(reason),
                Some(Ok(file)) => Ok((file, false)),
                Some(Err(_)) | None => make(&self.path).map(|file| (file, true)),
            };
            let (file, is_made) = match there {
                Err(reason) if reason.fault.is_of_another_file() => {
                    // Neither map is lost.
                    let beside = beside(&self.path);
                    let file = make(&beside)?;
                    error!(%reason, kept_in = %beside.display(), "map file is another one now, the map is kept beside it");
                    self.path = beside;
                    (file, true)
                }
                there => there?,
            };
            self.file = Some(file);
            if is_made {
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
        self.close_as(MapFile::close)
    }

    fn close_as(self, close: fn(MapFile) -> Result<(), StoreError>) -> Result<Option<PathBuf>, String> {
        if let Some(failed) = self.failed {
            return Err(failed.to_string());
        }
        let Some(file) = self.file else { return Ok(None) };
        close(file).map_err(|e| e.to_string())?;
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

/// A name for a map whose own is taken: `kitchen-2.map` for `kitchen.map`. No longer than commands may name.
fn beside(path: &Path) -> PathBuf {
    let stem: String = path.file_stem().unwrap_or_default().to_string_lossy().chars().take(60).collect();
    let ending = path.extension().map(|e| format!(".{}", e.to_string_lossy())).unwrap_or_default();
    let mut names = (2_u64..).map(|n| path.with_file_name(format!("{stem}-{n}{ending}")));
    names.find(|name| name.symlink_metadata().is_err()).unwrap_or_else(|| path.into())
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
    // A service manager waits.
    keeper.map_or(Ok(None), |keeper| keeper.close_as(MapFile::close_now))
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
    let (file, contents) = match localise_only {
        true => (None, read_to_locate(&path).map_err(|e| e.to_string())?),
        false => {
            let (file, contents) = MapFile::open(&path).map_err(|e| e.to_string())?;
            (Some(file), contents)
        }
    };
    loaded(path, file, contents, given)
}

/// Only read: it stays as it is, and nobody's.
fn read_to_merge(path: PathBuf, given: Ids, keeper: Option<&Keeper>) -> Result<Loaded, String> {
    other_than_present(&path, keeper)?;
    let contents = read_to_locate(&path).map_err(|e| e.to_string())?;
    loaded(path, None, contents, given)
}

fn loaded(path: PathBuf, file: Option<MapFile>, contents: Contents, given: Ids) -> Result<Loaded, String> {
    let Contents { edition, saved, .. } = contents;
    let saved = of_this_run(saved, given).map_err(|reason| format!("{}: {reason}", path.display()))?;
    Ok(Loaded { path, file, edition, saved })
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
mod tests;
