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
use std::sync::atomic::Ordering;
use std::time::Duration;

use crossbeam::channel::Sender;
use tracing::{error, info, warn};

use super::map_keeper::{Keeper, KeeperWord, Order};
use super::request::Request;
use crate::geometry::CameraModel;
use crate::map::MapId;
use crate::map::saved::{Ids, SavedMaps, SavedOptics};
use crate::messages::map_mode;
use crate::places::store::{Edition, MOST_IDS, MapFile};
use crate::reconstruction::{LensPrior, Reconstruction, TrajectoryEvent};

/// Between two writes, ns of the frames' time: what a power cut loses at the most, with the time that a write takes.
const WRITE_EVERY_NS: i64 = 2_000_000_000;
/// The same at the most, live, where nothing of the map has changed.
const AT_LEAST_EVERY_NS: i64 = 60_000_000_000;
/// The same after a write that failed.
const RETRY_AFTER_NS: i64 = 30_000_000_000;
/// A slow disk is waited for so long at the end.
const LAST_WAIT: Duration = Duration::from_secs(2);

/// The map file of a run, as whoever starts it has found it.
pub struct MapPlan {
    pub path: PathBuf,
    /// Open for writing; `None`: it is still to be made, or only looked at.
    pub file: Option<MapFile>,
    /// What was in it, and which edition that is.
    pub saved: Option<SavedMaps>,
    pub edition: Option<Edition>,
    /// Nothing is written, and the maps stay as they are.
    pub localise_only: bool,
    /// Nobody has named it: where it turns out to be another camera's the run goes on without.
    pub may_fail: bool,
}

/// The way there.
pub enum KeeperLink {
    /// Called directly: lock-step.
    Inline(Box<Keeper>),
    Queue(Sender<Order>),
}

/// Reconstruction's end of it.
pub struct MapDesk {
    /// `None`: the map has no file.
    pub(super) path: Option<PathBuf>,
    saved: Option<SavedMaps>,
    /// Of the file that the maps were read from.
    pub(super) edition: Option<Edition>,
    /// Maps that came from the file, or have become a part of one.
    stored: BTreeSet<MapId>,
    /// Its maps outlive a reset: nothing is written to them that would have to be kept from the file.
    pub(super) localise_only: bool,
    /// Changes are handed over; not once the maps that the file is about were dropped.
    pub(super) keeps: bool,
    may_fail: bool,
    /// `None`: nobody is there who writes.
    pub(super) link: Option<KeeperLink>,
    /// For what comes back once a file was read; `None`: no commands.
    pub(super) requests: Option<Sender<Request>>,
    pub(super) word: Arc<KeeperWord>,
    /// Time of the frame after which it was written last.
    last_ns: Option<i64>,
    /// Time of the first frame at which what was handed over waited still, and whether it waits for so long that the disk hangs.
    busy_since_ns: Option<i64>,
    hangs: bool,
    /// Time of the frame after which changes were handed over last.
    last_write_ns: Option<i64>,
}

impl MapPlan {
    /// The keeper, and the desk without its link to it.
    pub fn split(self) -> (MapDesk, Option<Keeper>) {
        let Self { path, file, saved, edition, localise_only, may_fail } = self;
        let mut desk =
            MapDesk { path: Some(path.clone()), localise_only, keeps: !localise_only, ..MapDesk::without_file() };
        desk.note_stored(saved.as_ref());
        (desk.saved, desk.edition, desk.may_fail) = (saved, edition, may_fail);
        let keeper = (!localise_only).then(|| Keeper::new(path, file, edition, desk.word.clone()));
        (desk, keeper)
    }
}

impl MapDesk {
    /// For a run whose map has no file, until a command gives it one.
    pub fn without_file() -> Self {
        Self {
            path: None,
            saved: None,
            edition: None,
            stored: BTreeSet::new(),
            localise_only: false,
            keeps: false,
            may_fail: false,
            link: None,
            requests: None,
            word: Arc::default(),
            last_ns: None,
            busy_since_ns: None,
            hangs: false,
            last_write_ns: None,
        }
    }

    pub fn linked(self, link: Option<KeeperLink>) -> Self {
        Self { link, ..self }
    }

    /// With a way for what comes back from reading files.
    pub fn answered_by(self, requests: Sender<Request>) -> Self {
        Self { requests: Some(requests), ..self }
    }

    pub(super) fn note_stored(&mut self, saved: Option<&SavedMaps>) {
        self.stored = saved.iter().flat_map(|saved| saved.maps.iter().map(|m| m.head.id)).collect();
    }

    pub(super) fn forget_stored(&mut self) {
        self.stored.clear();
    }

    /// The next changes are everything, and due at once.
    pub(super) fn hand_over_everything(&mut self) {
        self.word.wants_everything.store(true, Ordering::Release);
        self.last_ns = None;
    }

    fn shown_path(&self) -> String {
        self.path.as_ref().map(|path| path.display().to_string()).unwrap_or_default()
    }

    /// A reconstruction has begun: it goes on in what the file has. The error: it is of another camera.
    pub fn begin(
        &mut self,
        reconstruction: &mut Reconstruction,
        camera: &CameraModel,
        prior: LensPrior,
    ) -> Result<(), String> {
        let Some(saved) = self.saved.take() else { return Ok(()) };
        let path = self.shown_path();
        if let Err(reason) = check_camera(&saved.optics, camera, prior) {
            if !self.may_fail {
                return Err(format!("{path}: {reason}"));
            }
            warn!(reason, "map file of another camera");
            self.let_go("it is of another camera or calibration");
            return Ok(());
        }
        let saved = if saved.next_id() > MOST_IDS / 2 {
            let saved = saved.renumbered(Ids::default()).map_err(|reason| format!("{path}: {reason}"))?;
            self.note_stored(Some(&saved));
            self.hand_over_everything();
            saved
        } else {
            saved
        };
        let maps = saved.maps.len();
        let keyframes = saved.maps.first().map_or(0, |m| m.map.keyframes.len());
        info!(path, maps, keyframes, localise_only = self.localise_only, "map loaded");
        reconstruction.resume(saved, self.localise_only);
        Ok(())
    }

    /// What was handed over last is not in the file.
    pub fn fails(&self) -> bool {
        self.keeps && (self.hangs || self.word.fails.load(Ordering::Acquire))
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
        if !self.keeps || self.localise_only {
            return;
        }
        let is_busy = matches!(&self.link, Some(KeeperLink::Queue(orders)) if !orders.is_empty());
        let since = self.busy_since_ns.filter(|since| *since <= timestamp_ns).unwrap_or(timestamp_ns);
        self.busy_since_ns = is_busy.then_some(since);
        self.hangs = is_busy && timestamp_ns.saturating_sub(since) >= RETRY_AFTER_NS;
        let every = if self.word.wants_everything.load(Ordering::Acquire) { RETRY_AFTER_NS } else { WRITE_EVERY_NS };
        let is_due = |last: i64| timestamp_ns < last || timestamp_ns.saturating_sub(last) >= every;
        if !self.last_ns.is_none_or(is_due) {
            return;
        }
        match &mut self.link {
            Some(KeeperLink::Inline(keeper)) => {
                let everything = self.word.wants_everything.swap(false, Ordering::AcqRel);
                keeper.keep(&reconstruction.take_changes(everything));
            }
            Some(KeeperLink::Queue(orders)) if orders.is_empty() => {
                let everything = self.word.wants_everything.swap(false, Ordering::AcqRel);
                // A robot that stands has nothing to tell but the time, which is worth no write every two seconds for months.
                if !everything
                    && self.last_write_ns.is_some_and(|last| timestamp_ns.saturating_sub(last) < AT_LEAST_EVERY_NS)
                    && !reconstruction.has_changes()
                {
                    self.last_ns = Some(timestamp_ns);
                    return;
                }
                self.last_write_ns = Some(timestamp_ns);
                // There is room: nobody else sends.
                let order = Order::Keep(Box::new(reconstruction.take_changes(everything)), None);
                if orders.try_send(order).is_err() {
                    // The thread has gone.
                    self.word.fails.store(true, Ordering::Release);
                }
            }
            _ => return,
        }
        self.last_ns = Some(timestamp_ns);
    }

    /// The last word: everything, with what is not worth a write by itself. `Inline`: the keeper, to be closed.
    pub fn finish(mut self, reconstruction: Option<&mut Reconstruction>) -> Option<Keeper> {
        let link = self.link.take()?;
        let is_kept = self.keeps && !self.localise_only;
        let changes = reconstruction.filter(|_| is_kept).map(|r| r.take_changes(true));
        match link {
            KeeperLink::Inline(mut keeper) => {
                if let Some(changes) = changes {
                    keeper.keep(&changes);
                }
                Some(*keeper)
            }
            KeeperLink::Queue(orders) => {
                if let Some(changes) = changes
                    && orders.send_timeout(Order::Keep(Box::new(changes), None), LAST_WAIT).is_err()
                {
                    error!(path = self.shown_path(), "map file: the disk is too slow, the last seconds are not in it");
                }
                None
            }
        }
    }

    /// The maps that the file is about are dropped: it keeps what it has.
    pub fn let_go(&mut self, why: &'static str) {
        self.saved = None;
        self.stored.clear();
        if !std::mem::take(&mut self.keeps) {
            return;
        }
        let path = self.shown_path();
        self.path = None;
        match &self.link {
            Some(KeeperLink::Queue(orders)) if orders.try_send(Order::Switch(None)).is_ok() => {}
            // Its thread ends with what it has.
            _ => self.link = None,
        }
        warn!(path, why, "map file keeps what it has, and nothing more is written to it");
    }
}

/// Whether a file's maps were made with this camera. Two that nobody calibrated are the same as far as can be said.
pub(super) fn check_camera(saved: &SavedOptics, camera: &CameraModel, prior: LensPrior) -> Result<(), String> {
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
        let plan = MapPlan {
            path: "a.map".into(),
            file: None,
            saved: None,
            edition: None,
            localise_only: true,
            may_fail: false,
        };
        let mut desk = plan.split().0;
        desk.keeps = true;
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
    fn a_map_that_was_only_located_in_grows_into_its_own_file_and_no_other() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("a.map");
        let mut r = begun(&camera(300.0), LensPrior::Calibrated);
        let make = |r: &mut Reconstruction| {
            MapFile::create(&path, &r.take_changes(true)).and_then(MapFile::close).expect("a map");
            std::fs::read(&path).expect("bytes")
        };
        make(&mut r);
        let edition = Some(crate::places::store::read(&path).expect("whole").edition);
        let plan =
            MapPlan { path: path.clone(), file: None, saved: None, edition, localise_only: true, may_fail: false };
        let (orders, queue) = crossbeam::channel::bounded(2);
        let mut desk = plan.split().0.linked(Some(KeeperLink::Queue(orders)));
        std::fs::remove_file(&path).expect("removed");
        let other = make(&mut begun(&camera(300.0), LensPrior::Calibrated));
        desk.localise(&mut r, false).expect("switched off");
        let Ok(Order::Switch(Some(mut keeper))) = queue.try_recv() else { panic!("nobody keeps the map") };
        keeper.keep(&r.take_changes(true));
        assert_eq!(keeper.close(), Ok(Some(dir.path().join("a-2.map"))));
        assert!(std::fs::read(&path).expect("bytes") == other, "somebody else's map");
    }

    #[test]
    fn a_disk_that_hangs_and_a_thread_that_has_gone_are_told() {
        let mut r = begun(&camera(300.0), LensPrior::Calibrated);
        let desk = |orders| {
            let plan = MapPlan {
                path: "a.map".into(),
                file: None,
                saved: None,
                edition: None,
                localise_only: false,
                may_fail: false,
            };
            plan.split().0.linked(Some(KeeperLink::Queue(orders)))
        };
        let (orders, queue) = crossbeam::channel::bounded(2);
        let mut hangs = desk(orders);
        hangs.turn(&mut r, 0);
        hangs.turn(&mut r, 1);
        hangs.turn(&mut r, RETRY_AFTER_NS);
        assert!(!hangs.fails(), "it is slow");
        hangs.turn(&mut r, RETRY_AFTER_NS + 1);
        assert!(hangs.fails() && queue.len() == 1);
        queue.recv().expect("what waited");
        hangs.turn(&mut r, RETRY_AFTER_NS + 2);
        assert!(!hangs.fails(), "it has gone on");
        let (orders, queue) = crossbeam::channel::bounded(2);
        drop(queue);
        let mut gone = desk(orders);
        gone.turn(&mut r, 0);
        assert!(gone.fails());
    }

    #[test]
    fn a_file_is_made_written_in_time_and_after_a_failure_anew() {
        let dir = tempfile::tempdir().expect("folder");
        let path = dir.path().join("missing").join("a.map");
        let plan = MapPlan {
            path: path.clone(),
            file: None,
            saved: None,
            edition: None,
            localise_only: false,
            may_fail: false,
        };
        let (desk, keeper) = plan.split();
        let mut desk = desk.linked(keeper.map(|keeper| KeeperLink::Inline(Box::new(keeper))));
        let mut r = begun(&camera(300.0), LensPrior::Calibrated);
        desk.turn(&mut r, 0);
        assert!(desk.word.wants_everything.load(Ordering::Acquire), "there is no folder");
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
