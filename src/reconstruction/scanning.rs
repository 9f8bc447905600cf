//! What stands around the robot, for whoever asks: the floor that keyframes saw, kept while somebody does, and scans made from it and the map.
//!
//! Nothing here decides about a pose or the map. Cost while nobody asks: nothing.

use nalgebra::Vector3;

use super::Reconstruction;
use super::surroundings::NoScan;
use crate::geometry::Se3;
use crate::geometry::frames::{Body, Camera, World};
use crate::image::GreyImage;
use crate::map::{Keyframe, KeyframeId};
use crate::motion::floor::seen::{Footing, Picture, Seen, floor_seen};
use crate::motion::obstacles::{ObstaclesConfig, Point, Scan, Scanner};

/// Keyframes whose floor is kept: of a way of 10 m and more.
const KEPT: usize = 60;
/// Earlier pictures that a keyframe is compared with, and how far the camera has come since, in heights: nearer there is no parallax, farther it
/// looks different.
const COMPARED: usize = 6;
const LEAST_STEP: f64 = 0.35;
const MOST_STEP: f64 = 2.5;
/// The level of the pictures that is compared: the finest that is narrower than this, px.
const FINEST_PX: usize = 480;
/// Fewer keyframes have not seen enough of a landmark.
const LEAST_OBSERVERS: usize = 2;
/// Keyframes in a row farther apart than this, m, are no way that is known to be driven straight.
const MOST_DRIVEN_M: f64 = 1.0;

/// A level of a keyframe's picture, if there is all of it.
fn picture(keyframe: &Keyframe, level: usize) -> Option<&GreyImage> {
    keyframe.picture.pyramid().levels.get(level).filter(|image| !image.data.is_empty())
}

impl Reconstruction {
    /// Whether scans are asked for that tell seen floor as free: then keyframes note where they see it.
    pub fn want_seen_floor(&mut self, wanted: bool) {
        self.surroundings.wanted = wanted;
        if !wanted {
            self.surroundings.seen.clear();
        }
    }

    /// A new keyframe, once the floor was looked for.
    pub(super) fn note_floor(&mut self, id: KeyframeId) {
        if !self.surroundings.wanted {
            return;
        }
        let Some(floor) = self.floor.as_ref() else { return };
        let Some(plane) = floor.plane(self.active.id) else { return };
        let map = &self.active.map;
        let Some(keyframe) = map.keyframe(id) else { return };
        let Some(level) = keyframe.picture.pyramid().levels.iter().position(|l| l.width < FINEST_PX) else { return };
        let Some(image) = picture(keyframe, level) else { return };
        let size = |pixels: usize| u32::try_from(pixels).unwrap_or(0);
        let Ok(camera) = self.optics.camera.scaled(size(image.width), size(image.height)) else { return };
        let here = keyframe.centre();
        // Of the part of the map that has the same unit: poses of another are not where the floor's homography has them.
        let near = |other: &&Keyframe| {
            let step = (other.centre() - here).norm() / plane.height;
            other.scale_from == keyframe.scale_from && (LEAST_STEP..MOST_STEP).contains(&step)
        };
        let before = map.numbers.below(id.0).take(KEPT).filter_map(|id| map.keyframe(KeyframeId(id))).filter(near);
        let pictures: Vec<_> = before
            .filter_map(|k| Some(Picture { camera_from_world: &k.camera_from_world, image: picture(k, level)? }))
            .take(COMPARED)
            .collect();
        let seen = &mut self.surroundings.seen;
        let oldest = if seen.len() < KEPT { None } else { seen.pop_front() };
        let mut places = oldest.map(|(_, places)| places).unwrap_or_default();
        places.clear();
        let now = Picture { camera_from_world: &keyframe.camera_from_world, image };
        floor_seen(plane, floor.camera_height_m(), &camera, &now, &pictures, &mut places);
        seen.push_back((id, places));
    }

    /// The scan around the last frame's pose. `body_from_camera`: the mount, its translation in metres.
    pub fn obstacles(
        &mut self,
        config: &ObstaclesConfig,
        robot_height_m: f64,
        body_from_camera: &Se3<Body, Camera>,
    ) -> Result<&Scan, NoScan> {
        let last = self.active.odometry.last.filter(|_| self.active.odometry.lost_frames == 0);
        let Some(last) = last else { return Err(NoScan::NoPose) };
        // Behind a turn on the spot lengths may be those of an assumption, off by a factor.
        if !self.active.fusion.is_metric() || self.scale_is_assumed() {
            return Err(NoScan::NotMetric);
        }
        let Some(plane) = self.floor.as_ref().and_then(|floor| floor.plane(self.active.id)) else {
            return Err(NoScan::NoFloor);
        };
        // A map that was just corrected has its floor elsewhere, until the next keyframe.
        if !plane.carries(&last.camera_from_world.inverse().translation) {
            return Err(NoScan::NoFloor);
        }
        let (map, scanner) = (&self.active.map, &mut self.surroundings.scanner);
        let world_from_body: Se3<World, Body> = (*body_from_camera * last.camera_from_world).inverse();
        if !scanner.begin(plane, &world_from_body) {
            return Err(NoScan::NoFloor);
        }
        // Of the part of the map that has the present unit, and on this floor: one that was carried, or stood on something else, has not been on it.
        let part = map.keyframe(self.active.reference).and_then(|k| k.scale_from);
        let stood = |id: KeyframeId| map.keyframe(id).filter(|k| k.scale_from == part && plane.carries(&k.centre()));
        let add_seen = |scanner: &mut Scanner, (id, places): &(KeyframeId, Seen)| {
            if let Some(footing) = stood(*id).and_then(|k| Footing::of(plane, &k.camera_from_world)) {
                scanner.add_seen(&footing, plane.height, places, robot_height_m);
            }
        };
        let mut seen = self.surroundings.seen.iter().filter(|_| config.seen_floor).peekable();
        // What has taken a driven cell back must not be forgotten sooner than that it was driven.
        let full = config.seen_floor && self.surroundings.seen.len() >= KEPT;
        let oldest = self.surroundings.seen.front().filter(|_| full).map_or(0, |(id, _)| id.0);
        let body = |camera_from_world: &Se3<Camera, World>| -> Vector3<f64> {
            (*body_from_camera * *camera_from_world).inverse().translation
        };
        // Where keyframes in between are gone it may have driven around something, unless its footprints touch.
        let mut before: Option<(u32, Vector3<f64>)> = None;
        let end = map.keyframes.next_id();
        let lately = map.numbers.below(end).take(4 * KEPT).last().unwrap_or(end);
        for id in lately.max(self.surroundings.first).max(oldest)..end {
            // A merged map is another run's.
            if map.numbers.is_merged(KeyframeId(id)) {
                continue;
            }
            // In order of time: what was seen later than driven may take it back.
            while let Some(one) = seen.next_if(|(of, _)| of.0 <= id) {
                add_seen(scanner, one);
            }
            let Some(keyframe) = stood(KeyframeId(id)) else { continue };
            let here = body(&keyframe.camera_from_world);
            let from = before.replace((id, here)).filter(|(before, from)| {
                let is_next = map.numbers.since(KeyframeId(*before), KeyframeId(id)) == 1;
                let straight_m = if is_next { MOST_DRIVEN_M } else { 2.0 * config.robot_radius_m };
                (here - from).norm() <= straight_m
            });
            scanner.add_driven(&from.map_or(here, |(_, from)| from), &here, config.robot_radius_m);
        }
        seen.for_each(|one| add_seen(scanner, one));
        for (_, l) in map.landmarks.iter().filter(|(_, l)| l.assumed.is_none() && l.observers.len() >= LEAST_OBSERVERS)
        {
            scanner.add_landmark(plane, &Point { position: l.position, covariance: l.covariance }, robot_height_m);
        }
        Ok(scanner.finish(config.robot_radius_m))
    }
}
