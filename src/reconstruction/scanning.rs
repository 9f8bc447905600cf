//! What stands around the robot, for whoever asks: the floor that keyframes saw, noted while somebody does, and scans made from it and the map.
//!
//! Nothing here decides about a pose or the map. Cost while nobody asks: what was noted until then is kept.

use nalgebra::Vector3;

use super::Reconstruction;
use super::recorded::Recorded;
use super::surroundings::{NoScan, SeenFrom};
use crate::geometry::Se3;
use crate::geometry::frames::{Body, Camera, World};
use crate::image::GreyImage;
use crate::map::{Keyframe, KeyframeId};
use crate::motion::floor::seen::{Footing, Picture, floor_seen};
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
        // Who asks again, as a planner that was restarted, must not be told that a way is free because what stood there was forgotten.
        self.surroundings.wanted = wanted;
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
        let mut places = oldest.map(|oldest| oldest.seen).unwrap_or_default();
        places.clear();
        let now = Picture { camera_from_world: &keyframe.camera_from_world, image };
        floor_seen(plane, floor.camera_height_m(), &camera, &now, &pictures, &mut places);
        let place = Recorded { map: self.active.id, keyframe: id, keyframe_from_camera: Se3::identity() };
        seen.push_back(SeenFrom { id, place, seen: places });
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
        let part = self.active.part();
        let has_unit = |id: KeyframeId| map.keyframe(id).is_some_and(|k| k.scale_from == part);
        let stood = |camera_from_world: &Se3<Camera, World>| plane.carries(&camera_from_world.inverse().translation);
        let add_seen = |scanner: &mut Scanner, SeenFrom { place, seen, .. }: &SeenFrom| {
            let from = place.camera_from_world(map).filter(|from| has_unit(place.keyframe) && stood(from));
            if let Some(footing) = from.and_then(|from| Footing::of(plane, &from)) {
                scanner.add_seen(&footing, plane.height, seen, robot_height_m);
            }
        };
        let mut seen = self.surroundings.seen.iter().filter(|_| config.seen_floor).peekable();
        // What has taken a driven cell back must not be forgotten sooner than that it was driven.
        let full = config.seen_floor && self.surroundings.seen.len() >= KEPT;
        let oldest = self.surroundings.seen.front().filter(|_| full).map_or(0, |one| one.id.0);
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
            while let Some(one) = seen.next_if(|one| one.id.0 <= id) {
                add_seen(scanner, one);
            }
            let keyframe = map.keyframe(KeyframeId(id)).filter(|_| has_unit(KeyframeId(id)));
            let Some(keyframe) = keyframe.filter(|k| stood(&k.camera_from_world)) else { continue };
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

#[cfg(test)]
mod tests {
    use nalgebra::Matrix3;

    use super::*;
    use crate::geometry::CameraModel;
    use crate::geometry::frames::Keyframe as KeyframeFrame;
    use crate::geometry::random::Random;
    use crate::geometry::ros_from_optical;
    use crate::map::scale::{MapScale, ScaleSource, ScaleSources};
    use crate::map::{LandmarkId, Observation, examples};
    use crate::motion::floor::seen::{Seen, Stretch};
    use crate::motion::floor::{FloorPoint, ScaleConfig};
    use crate::motion::hand_eye::Robot;
    use crate::motion::obstacles::BEARINGS;
    use crate::motion::scale::ScaleFusion;
    use crate::reconstruction::odometry::Odometry;
    use crate::reconstruction::{InlineWorker, ReconstructionConfig, TrackingState, TrajectoryEvent};

    const HEIGHT_M: f64 = 0.5;

    /// A level camera at a place on the way along x.
    fn camera_at(x: f64) -> Se3<Camera, World> {
        Se3::<World, Camera>::new(ros_from_optical(), Vector3::new(x, 0.0, HEIGHT_M)).inverse()
    }

    /// A metric map of a floor over which the robot has driven from x = 0 to 2.8 m; it stands at the beginning again, on keyframes 15 and 16, the first of which
    /// saw that the floor ends after 1 m.
    fn before_a_box() -> Reconstruction {
        let mut random = Random::new(5);
        let camera: CameraModel = examples::lens();
        let mut r =
            Reconstruction::new(&ReconstructionConfig::default(), &camera, Box::new(InlineWorker::default()), true);
        let map = &mut r.active.map;
        let way = (0..15).map(|i| 0.2 * f64::from(i)).chain([0.0, 0.0]);
        let ids: Vec<_> = way.map(|x| map.add_keyframe(examples::keyframe(Default::default(), camera_at(x)))).collect();
        let newest = ids[16];
        for _ in 0..150 {
            let position = Vector3::new(random.uniform(0.5, 5.0), random.uniform(-1.0, 1.0), 0.0);
            let seen = Observation {
                landmark: LandmarkId(0),
                pixel: Default::default(),
                normalised: Default::default(),
                displacement: Default::default(),
                inv_sigma_px: 1.0,
                normalised_from_pixel: nalgebra::Matrix2::identity(),
            };
            let seen: Vec<_> = ids.iter().map(|id| (*id, seen)).collect();
            map.add_landmark(examples::landmark(position, newest), &seen);
        }
        let config = ScaleConfig { camera_height_m: HEIGHT_M, ..ScaleConfig::default() };
        r.look_for_floor(&config, &Robot::unknown());
        let map = &r.active.map;
        let look = |id: LandmarkId| {
            let position = map.landmark(id)?.position;
            Some(FloorPoint { position, covariance: Matrix3::identity() * 1e-4 })
        };
        let floor = r.floor.as_mut().unwrap();
        (0..3).for_each(|_| _ = floor.see(map, r.active.id, newest, &look));
        assert!(floor.plane(r.active.id).is_some(), "{:?}", floor.refused());
        let sources = ScaleSources::default().with(ScaleSource::Height);
        r.active.fusion = ScaleFusion::of_stored(MapScale::Metric { sigma: 0.01, sources });
        r.active.odometry = Odometry::begin(0, camera_at(0.0));
        (r.active.reference, r.state) = (newest, TrackingState::Tracking);
        r.want_seen_floor(true);
        let in_heights = |from: f64, to: f64| {
            let [from, to] = [from, to].map(|m| (m / HEIGHT_M) as f32);
            Stretch { bearing: 0.0, from, to }
        };
        let ends = vec![in_heights(1.0, 1.2)];
        let place = Recorded { map: r.active.id, keyframe: ids[15], keyframe_from_camera: Se3::identity() };
        r.surroundings.seen.push_back(SeenFrom { id: ids[15], place, seen: Seen { ends, ..Seen::default() } });
        r
    }

    /// How far the floor ahead is told to be free, m.
    fn free_ahead(r: &mut Reconstruction) -> f32 {
        let how = ObstaclesConfig { seen_floor: true, ..ObstaclesConfig::default() };
        let body_from_camera = Se3::new(ros_from_optical(), Vector3::zeros());
        r.obstacles(&how, HEIGHT_M, &body_from_camera).expect("a scan").free_m[BEARINGS / 2]
    }

    #[test]
    fn what_a_culled_keyframe_saw_still_takes_back_that_the_robot_drove_there() {
        let mut r = before_a_box();
        let before = free_ahead(&mut r);
        assert!((0.8..1.05).contains(&before), "{before} m");
        // It leaves its poses to one that is somewhere else.
        let (gone, parent) = (KeyframeId(15), KeyframeId(3));
        let [from, to] = [gone, parent].map(|id| r.active.map.keyframe(id).unwrap().camera_from_world);
        let parent_from_keyframe: Se3<KeyframeFrame, KeyframeFrame> = (to * from.inverse()).relabel();
        let map = r.active.id;
        r.active.map.remove_keyframe(gone);
        r.events.push(TrajectoryEvent::KeyframeRemoved { map, keyframe: gone, parent, parent_from_keyframe });
        r.take_trajectory_events(&mut Vec::new());
        assert_eq!(free_ahead(&mut r), before);
    }

    #[test]
    fn who_asks_again_is_told_of_what_stood_there_before() {
        let mut r = before_a_box();
        let before = free_ahead(&mut r);
        r.want_seen_floor(false);
        r.want_seen_floor(true);
        assert_eq!(free_ahead(&mut r), before);
    }
}
