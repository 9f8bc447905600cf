//! The desk's part of commands on maps: what is handed to whoever keeps the file, and what is done when that comes back.

use std::path::PathBuf;
use std::sync::atomic::Ordering;

use crossbeam::channel::Sender;
use tracing::info;

use super::map_file::{KeeperLink, MapDesk, check_camera};
use super::map_folder::MapFolder;
use super::map_keeper::{Keeper, Order};
use super::request::{CopyTo, Loaded, Reply, Request};
use crate::geometry::CameraModel;
use crate::map::saved::{MapChanges, SavedMaps};
use crate::reconstruction::{LensPrior, Reconstruction, Waiting};

const NOBODY_WRITES: &str = "this run keeps no maps";
const SLOW_DISK: &str = "the disk is too slow for what is asked of it; try again";

impl MapDesk {
    /// Room for what belongs together, which nobody else takes: only the desk sends.
    fn orders(&self, needed: usize) -> Result<&Sender<Order>, String> {
        match &self.link {
            Some(KeeperLink::Queue(orders)) => {
                let room = orders.capacity().unwrap_or(usize::MAX) - orders.len();
                if room < needed { Err(SLOW_DISK.into()) } else { Ok(orders) }
            }
            _ => Err(NOBODY_WRITES.into()),
        }
    }

    fn requests(&self) -> Result<Sender<Request>, String> {
        self.requests.clone().ok_or_else(|| NOBODY_WRITES.into())
    }

    /// What has come since the last write. Not all there is, which would hold the stage for some 50 us a keyframe.
    fn last_changes(&self, reconstruction: &mut Reconstruction) -> Box<MapChanges> {
        let everything = self.word.wants_everything.swap(false, Ordering::AcqRel);
        Box::new(reconstruction.take_changes(everything))
    }

    fn is_kept(&self) -> bool {
        self.keeps && !self.localise_only
    }

    pub(super) fn list(&self, folder: MapFolder, after: String, reply: Reply) -> Result<(), String> {
        send(self.orders(1)?, Order::List { folder, after, reply })
    }

    /// Everything to its own file.
    pub(super) fn store(&self, reconstruction: &mut Reconstruction, reply: Reply) -> Result<(), String> {
        if self.localise_only {
            return Err("the map is only located in, so there is nothing to store".into());
        }
        if !self.keeps {
            return Err("the map has no file: store it under a name".into());
        }
        send(self.orders(1)?, Order::Keep(self.last_changes(reconstruction), Some(reply)))
    }

    pub(super) fn copy(&self, reconstruction: &mut Reconstruction, to: CopyTo, reply: Reply) -> Result<(), String> {
        let orders = self.orders(1)?;
        if reconstruction.total_keyframes() == 0 {
            return Err("there is no map yet".into());
        }
        send(orders, Order::Copy { everything: Box::new(reconstruction.take_changes(true)), to, reply })
    }

    /// The last of the present map, then a file to be read.
    pub(super) fn load(&self, reconstruction: &mut Reconstruction, path: PathBuf, reply: Reply) -> Result<(), String> {
        let (orders, requests) = (self.orders(2)?, self.requests()?);
        if self.is_kept() {
            send(orders, Order::Keep(self.last_changes(reconstruction), None))?;
        }
        let (given, localise_only) = (reconstruction.given_ids(), self.localise_only);
        send(orders, Order::Load { path, given, localise_only, requests, reply })
    }

    /// A file to be read; what is in it becomes a part of the present map.
    pub(super) fn merge(&self, reconstruction: &Reconstruction, path: PathBuf, reply: Reply) -> Result<(), String> {
        let (orders, requests) = (self.orders(1)?, self.requests()?);
        reconstruction.can_merge()?;
        send(orders, Order::Merge { path, given: reconstruction.given_ids(), requests, reply })
    }

    /// The last of the present map, then a new one.
    pub(super) fn new_map(
        &self,
        reconstruction: &mut Reconstruction,
        path: PathBuf,
        folder: MapFolder,
        reply: Reply,
    ) -> Result<(), String> {
        let (orders, requests) = (self.orders(2)?, self.requests()?);
        if self.localise_only {
            return Err("frames are only located in the present map; switch that off before a new one begins".into());
        }
        if self.is_kept() {
            send(orders, Order::Keep(self.last_changes(reconstruction), None))?;
        }
        send(orders, Order::Begin { path, folder, requests, reply })
    }

    pub(super) fn localise(&mut self, reconstruction: &mut Reconstruction, on: bool) -> Result<(), String> {
        let orders = self.orders(1)?;
        if on && self.is_kept() {
            send(orders, Order::Keep(self.last_changes(reconstruction), None))?;
        }
        reconstruction.set_localise_only(on)?;
        if !on
            && !self.keeps
            && let Some(path) = self.path.clone()
        {
            // It was only read so far.
            let keeper = Keeper::new(path, None, self.edition, self.word.clone());
            send(orders, Order::Switch(Some(Box::new(keeper))))?;
            self.keeps = true;
        }
        self.localise_only = on;
        self.hand_over_everything();
        Ok(())
    }

    /// Leaves the present maps for those that were read. In the error's case everything is as it was.
    pub(super) fn exchange(
        &mut self,
        reconstruction: &mut Reconstruction,
        camera: &CameraModel,
        prior: LensPrior,
        loaded: Loaded,
    ) -> Result<String, String> {
        let Loaded { path, file, edition, saved } = loaded;
        let shown = path.display().to_string();
        check_camera(&saved.optics, camera, prior).map_err(|reason| format!("{shown}: {reason}"))?;
        check_ids(reconstruction, &saved).map_err(|reason| format!("{shown}: {reason}"))?;
        let orders = self.orders(2)?.clone();
        if self.is_kept() {
            // What has come while the file was read.
            send(&orders, Order::Keep(self.last_changes(reconstruction), None))?;
        }
        let keeper = (!self.localise_only).then(|| Keeper::new(path.clone(), file, Some(edition), self.word.clone()));
        self.keeps = keeper.is_some();
        send(&orders, Order::Switch(keeper.map(Box::new)))?;
        self.note_stored(Some(&saved));
        let (maps, keyframes) = (saved.maps.len(), saved.maps.first().map_or(0, |m| m.map.keyframes.len()));
        info!(path = shown, maps, keyframes, localise_only = self.localise_only, "map loaded");
        reconstruction.exchange(saved, self.localise_only);
        (self.path, self.edition) = (Some(path), Some(edition));
        self.hand_over_everything();
        Ok(format!("gone on in {shown}: {keyframes} keyframes; lost until a place of it is recognised"))
    }

    /// The new one's file is there; the present map may be dropped now.
    pub(super) fn begin_new(&mut self, reconstruction: &mut Reconstruction, path: PathBuf) -> Result<String, String> {
        let orders = self.orders(2)?;
        if self.localise_only {
            // Switched on since: the maps would stay, and be kept under the new name.
            return Err("frames are only located in the present map by now; no new one has begun".into());
        }
        if self.is_kept() {
            send(orders, Order::Keep(self.last_changes(reconstruction), None))?;
        }
        let keeper = Keeper::new(path.clone(), None, None, self.word.clone());
        send(orders, Order::Switch(Some(Box::new(keeper))))?;
        self.forget_stored();
        self.keeps = true;
        info!(path = %path.display(), "new map");
        let told = format!("a new map begins, kept in {}", path.display());
        self.path = Some(path);
        self.hand_over_everything();
        Ok(told)
    }
}

/// Keeps maps that were read beside the present one. In the error's case everything is as it was.
pub(super) fn keep_merged(
    reconstruction: &mut Reconstruction,
    camera: &CameraModel,
    prior: LensPrior,
    loaded: Loaded,
) -> Result<String, String> {
    let Loaded { path, saved, .. } = loaded;
    let path = path.display().to_string();
    let keep = || {
        check_camera(&saved.optics, camera, prior)?;
        check_ids(reconstruction, &saved)?;
        reconstruction.merge(saved)
    };
    let Waiting { maps, keyframes } = keep().map_err(|reason| format!("{path}: {reason}"))?;
    info!(path, maps, keyframes, "map waits to be joined");
    Ok(format!(
        "{keyframes} keyframes of {path} are kept beside the present map; they are a part of it, and stored with it, once a place of both is known"
    ))
}

/// Whether this run has given none of these ids meanwhile.
fn check_ids(reconstruction: &Reconstruction, saved: &SavedMaps) -> Result<(), String> {
    let Some(first) = saved.first_ids() else { return Ok(()) };
    let given = reconstruction.given_ids();
    if given.maps > first.maps || given.keyframes > first.keyframes || given.landmarks > first.landmarks {
        return Err("it took too long to read; try again".into());
    }
    Ok(())
}

fn send(orders: &Sender<Order>, order: Order) -> Result<(), String> {
    orders.try_send(order).map_err(|_| SLOW_DISK.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reconstruction::{InlineWorker, ReconstructionConfig};

    #[test]
    fn a_map_of_another_camera_is_not_merged() {
        let camera = |fx: f64| CameraModel::new(320, 240, fx, 300.0, 159.5, 119.5, [0.0; 5]).expect("camera");
        let config = ReconstructionConfig::default();
        let mut r = Reconstruction::new(&config, &camera(300.0), Box::new(InlineWorker::default()), true);
        let optics = r.take_changes(true).optics;
        let told = |r: &mut Reconstruction, own: &CameraModel| {
            let saved = SavedMaps { frame_ns: 0, optics: optics.clone(), maps: Vec::new() };
            let loaded = Loaded { path: "barn.map".into(), file: None, edition: Default::default(), saved };
            keep_merged(r, own, LensPrior::Calibrated, loaded).expect_err("refused")
        };
        let other = told(&mut r, &camera(310.0));
        assert!(other.starts_with("barn.map: the map is another camera's"), "{other}");
        let same = told(&mut r, &camera(300.0));
        assert!(same.contains("no map yet"), "{same}");
    }
}
