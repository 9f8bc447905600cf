//! What commands ask of maps, between two frames.
//!
//! Nothing here waits: what needs a disk is handed to whoever keeps the map file ([`map_keeper`](super::map_keeper)), which answers the command, or
//! comes back with a request of its own once a file was read or the old map is stored.

use std::path::PathBuf;
use std::time::Instant;

use tracing::info;

use super::map_commands::keep_merged;
use super::reconstruct::ReconstructStep;
use super::request::{Loaded, MapRequest, Reply};
use crate::geometry::Se3;
use crate::geometry::frames::Body;
use crate::publish::convert::Map;

const NO_PICTURE: &str = "no picture has come yet, so it is not known what camera this is";
const NO_MAPS: &str = "this run keeps no maps";

impl ReconstructStep {
    /// Carries out a command on maps, or hands it on; it is answered in time.
    pub(super) fn map_request(&mut self, request: MapRequest, reply: Reply) {
        let outcome = match request {
            MapRequest::Localise(on) => self.localise(on).map(Some),
            other => self.ask_keeper(other, &reply).map(|()| None),
        };
        // Whoever asked may have gone.
        match outcome {
            Ok(Some(done)) => drop(reply.try_send(Ok(done))),
            Ok(None) => {}
            Err(reason) => drop(reply.try_send(Err(reason))),
        }
    }

    fn ask_keeper(&mut self, request: MapRequest, reply: &Reply) -> Result<(), String> {
        let desk = self.map_file.as_mut().ok_or(NO_MAPS)?;
        if let MapRequest::List(folder, after) = request {
            return desk.list(folder, after, reply.clone());
        }
        let reconstruction = self.reconstruction.as_mut().ok_or(NO_PICTURE)?;
        let begin = Instant::now();
        let asked = match request {
            MapRequest::Store => desk.store(reconstruction, reply.clone()),
            MapRequest::Copy(to) => desk.copy(reconstruction, to, reply.clone()),
            MapRequest::Load(path) => desk.load(reconstruction, path, reply.clone()),
            MapRequest::Merge(path) => desk.merge(reconstruction, path, reply.clone()),
            MapRequest::New(path, folder) => desk.new_map(reconstruction, path, folder, reply.clone()),
            MapRequest::Localise(_) | MapRequest::List(..) => Ok(()),
        };
        tracing::debug!(took_us = begin.elapsed().as_micros() as u64, "map handed over");
        asked
    }

    fn localise(&mut self, on: bool) -> Result<String, String> {
        let reconstruction = self.reconstruction.as_mut().ok_or(NO_PICTURE)?;
        let desk = self.map_file.as_mut().ok_or(NO_MAPS)?;
        desk.localise(reconstruction, on)?;
        info!(on, "localisation only");
        Ok(match on {
            true => "frames are only located in the map, which stays as it is",
            false => "the map grows again",
        }
        .into())
    }

    /// A map that was read is there: gone on in, if it is of this camera.
    pub(super) fn take_map(&mut self, loaded: Loaded, reply: &Reply) {
        let begin = Instant::now();
        let outcome = self.exchange(loaded);
        tracing::debug!(took_us = begin.elapsed().as_micros() as u64, "map exchanged");
        // Whoever asked may have gone.
        drop(reply.try_send(outcome));
    }

    /// Maps that were read are kept beside the present one, if they are of this camera.
    pub(super) fn take_merged(&mut self, loaded: Loaded, reply: &Reply) {
        let begin = Instant::now();
        let outcome = self.keep_merged(loaded);
        tracing::debug!(took_us = begin.elapsed().as_micros() as u64, "map kept to be merged");
        // Whoever asked may have gone.
        drop(reply.try_send(outcome));
    }

    fn keep_merged(&mut self, loaded: Loaded) -> Result<String, String> {
        let (width, height) = self.size;
        let reconstruction = self.reconstruction.as_mut().ok_or(NO_PICTURE)?;
        let camera = self.calibration.fit(width, height)?;
        keep_merged(reconstruction, &camera, self.calibration.prior, loaded)
    }

    fn exchange(&mut self, loaded: Loaded) -> Result<String, String> {
        let (width, height) = self.size;
        let reconstruction = self.reconstruction.as_mut().ok_or(NO_PICTURE)?;
        let desk = self.map_file.as_mut().ok_or(NO_MAPS)?;
        let camera = self.calibration.fit(width, height)?;
        let done = desk.exchange(reconstruction, &camera, self.calibration.prior, loaded)?;
        self.drain_events();
        Ok(done)
    }

    /// The old map is on the disk: a new one begins, kept in this file.
    pub(super) fn begin_map(&mut self, path: PathBuf, reply: &Reply) {
        let begun = match (self.reconstruction.as_mut(), self.map_file.as_mut()) {
            (Some(reconstruction), Some(desk)) => desk.begin_new(reconstruction, path),
            _ => Err(NO_PICTURE.into()),
        };
        if begun.is_ok() {
            self.drop_map();
        }
        drop(reply.try_send(begun));
    }

    /// The present map ends. A map rests on the lens that it began with, so a calibration that was kept meanwhile comes into use with the next one.
    pub(super) fn drop_map(&mut self) {
        // Maps that are only located in stay, and with them their camera model.
        let stays = self.map_file.as_ref().is_some_and(|desk| desk.localise_only);
        let next = if stays || self.reconstruction.is_none() { None } else { self.next_calibration.take() };
        let camera = next.and_then(|next| {
            // A camera that sends another size since keeps what it has.
            let camera = next.fit(self.size.0, self.size.1).ok()?;
            self.calibration = next;
            Some(camera)
        });
        if let Some(camera) = &camera {
            self.tell_camera(camera);
        }
        let prior = self.calibration.prior;
        if let Some(reconstruction) = self.reconstruction.as_mut() {
            match &camera {
                Some(camera) => reconstruction.change_camera(camera, prior),
                None => reconstruction.reset(),
            }
        }
        self.drain_events();
    }

    /// The map is published such that the robot is where a planner says.
    pub(super) fn set_pose(&mut self, map_from_body: &Se3<Map, Body>, reply: &Reply) {
        let docked = self.is_docked();
        let moved = match self.outlet.as_mut() {
            Some(_) if docked => Err("the map is in the frame of the dock".into()),
            Some(outlet) => outlet.set_pose(map_from_body).map_err(String::from),
            None => Err("nothing is published".into()),
        };
        if moved.is_ok() {
            if let Some(reconstruction) = self.reconstruction.as_mut() {
                reconstruction.hold_frame();
            }
            self.placements = self.placements.wrapping_add(1);
            info!("map put where a planner wants it");
        }
        let done = "poses, map and keyframes are published there from now on; files keep the map's own origin";
        drop(reply.try_send(moved.map(|()| done.into())));
    }
}
