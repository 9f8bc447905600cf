//! What an adjustment of a metric map is told beside the pictures: lengths by the wheels, tags of known size, the floor under the robot.

use nalgebra::Vector3;

use super::{Adjustment, intrinsics_jacobian, seen_by};
use crate::geometry::CameraModel;
use crate::map::{KeyframeId, LandmarkId, Map, Observation};
use crate::motion::floor::DrivenFloor;
use crate::motion::floor::plane::{EVENNESS, KEEPS_HEIGHT, KEEPS_TILT_RAD, LEAST_LANDMARKS};
use crate::motion::tag::HeldTag;
use crate::reconstruction::adjust::bundle::{HeldFloor, KnownLength, TargetCorner};
use crate::reconstruction::keyframe::point::floor_point;
use crate::reconstruction::measurement::rolling_shutter::Shutter;

/// Keyframes further apart, ns, are held by no length: over a long way the distance of its ends is not what wheels know best.
const LONGEST_STEP_NS: i64 = 5_000_000_000;
/// A length is held no harder than this, m, and as a share of it: wheels that roll unevenly or are dented are no better, whatever their driver says.
const LEAST_HELD_M: f64 = 0.002;
const LEAST_HELD_SHARE: f64 = 0.01;

/// Standard deviation that a length of a metric map is held with, m.
fn held_sigma(length: f64, sigma: f64) -> f64 {
    sigma.max(LEAST_HELD_M).max(LEAST_HELD_SHARE * length)
}

impl Adjustment {
    /// Holds distances between keyframes that follow one another, at the places that `length` knows (times of both, ns): its length and standard
    /// deviation, m. Those of them that stay where they are, lie further apart than `LONGEST_STEP_NS` or have a unit that is in doubt are left alone.
    pub fn hold_lengths(&mut self, map: &Map, mut length: impl FnMut(i64, i64) -> Option<(f64, f64)>) {
        for i in 1..self.keyframes.len() {
            if self.problem.fixed[i - 1] && self.problem.fixed[i] {
                continue;
            }
            // Another run's times may be those of these wheels by chance. What lies behind a turn on the spot has a unit of its own until it is told how long
            // that is: held to metres, its newest keyframes would be bent away from the others. (Of 40 simulated corridors with slip
            // that bent five, by 12 to 30 cm: 0.039 -> 0.032 m in the geometric mean without; of 28 squares one, by 1.3 m: 0.028 -> 0.023.)
            let told = |i: usize| {
                let keyframe = map.keyframe(self.keyframes[i]).filter(|k| k.scale_from.is_none())?;
                map.numbers.is_new(self.keyframes[i]).then_some(keyframe.timestamp_ns)
            };
            let (Some(from_ns), Some(to_ns)) = (told(i - 1), told(i)) else { continue };
            if !(1..=LONGEST_STEP_NS).contains(&to_ns.saturating_sub(from_ns)) {
                continue;
            }
            if let Some((length, sigma)) = length(from_ns, to_ns) {
                let sigma = held_sigma(length, sigma);
                self.problem.lengths.push(KnownLength { cameras: [i as u32 - 1, i as u32], length, sigma });
            }
        }
    }

    /// Lets tags of known size take part where cameras that move see them: the place of each is one more unknown. To be said after
    /// [`refine_intrinsics`](Adjustment::refine_intrinsics).
    pub fn hold_tags(&mut self, map: &Map, camera: &CameraModel, shutter: &Shutter, tags: &[HeldTag]) {
        for tag in tags {
            let Some(from) = map.keyframe(tag.from.0) else { continue };
            let mut lies = tag.from.1;
            lies.translation *= tag.places[1].x - tag.places[0].x;
            let tag_from_world = lies * from.camera_from_world;
            let seen = tag.seen.iter().filter_map(|(id, corners)| {
                let index = self.keyframes.binary_search(id).ok()?;
                Some((index, map.keyframe(*id)?, corners))
            });
            let seen: Vec<_> = seen.collect();
            if seen.iter().all(|(index, ..)| self.problem.fixed[*index]) {
                continue;
            }
            let target = self.problem.state.poses.len() as u32;
            self.problem.state.poses.push(tag_from_world);
            self.problem.fixed.push(false);
            for (index, keyframe, corners) in seen {
                for (place, pixel) in tag.places.iter().zip(corners) {
                    let corner = TargetCorner { target, place: *place };
                    let point = keyframe.camera_from_world.transform(&corner.in_world(&tag_from_world));
                    let Some((normalised, normalised_from_pixel)) = camera.undistort_jacobian(pixel) else { continue };
                    let row = pixel.y as f32;
                    let o = Observation {
                        landmark: LandmarkId(u32::MAX),
                        pixel: pixel.cast(),
                        normalised,
                        displacement: shutter.displacement(keyframe.motion.as_ref(), &point, row),
                        inv_sigma_px: tag.sigma_px.recip(),
                        normalised_from_pixel,
                    };
                    if !self.problem.globals.jacobians.is_empty() {
                        self.problem.globals.jacobians.push(intrinsics_jacobian(&o, camera));
                    }
                    self.problem.observations.push(seen_by(index, &o, camera));
                    self.problem.corners.push(corner);
                }
            }
        }
    }

    /// Lets cameras keep height and tilt above the floor, and landmarks on it lie on one plane, in the part of the map that tells metres. Not where too few
    /// landmarks show the floor: cameras alone would keep a height above nothing by going a shorter way. Another run's cameras may have sat elsewhere on the robot.
    pub fn hold_floor(&mut self, map: &Map, camera: &CameraModel, shutter: &Shutter, floor: &DrivenFloor<'_>) {
        let (plane, height) = (&floor.plane, floor.height);
        let drives = |id: &KeyframeId| {
            let there = map.keyframe(*id).filter(|_| map.numbers.is_new(*id));
            there.is_some_and(|k| k.scale_from.is_none() && plane.carries(&k.centre()))
        };
        let drive = self.keyframes.iter().map(drives);
        let cameras: Vec<u32> = (0..).zip(drive).filter_map(|(i, drives)| drives.then_some(i)).collect();
        let place = |id: &LandmarkId| {
            floor_point(map, *id, camera, shutter).filter(|point| plane.bears(point)).map(|point| point.position)
        };
        let on_floor: Vec<bool> = self.landmarks.iter().map(|id| place(id).is_some()).collect();
        let others = floor.landmarks.iter().filter(|id| self.landmarks.binary_search(id).is_err());
        let around: Vec<Vector3<f64>> = others.filter_map(place).collect();
        let shown = on_floor.iter().filter(|on| **on).count() + around.len();
        let Some(newest) = map.keyframe(self.keyframes[self.newest]) else { return };
        if shown < LEAST_LANDMARKS || cameras.iter().all(|i| self.problem.fixed[*i as usize]) {
            return;
        }
        let poses = &mut self.problem.state.poses;
        self.problem.floor = Some(HeldFloor {
            pose: poses.len() as u32,
            height,
            height_sigma: KEEPS_HEIGHT * height,
            cameras,
            up_camera: plane.up_camera,
            tilt_sigma: KEEPS_TILT_RAD,
            evenness: EVENNESS * height,
            on_floor,
            around,
        });
        poses.push(plane.floor_from_world(&newest.centre()));
        self.problem.fixed.push(false);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use nalgebra::{Matrix3, UnitQuaternion};

    use super::*;
    use crate::geometry::Se3;
    use crate::geometry::frames::{Camera, World};
    use crate::map::{Landmark, examples};
    use crate::motion::floor::plane::{Plane, Scatter};
    use crate::reconstruction::track::template::observe;

    /// Looking along z, y down: four keyframes, one every 0.2 along x, a metre above a floor of which `on_floor` landmarks are seen, and 20 on a wall.
    fn driven(on_floor: usize, camera: &CameraModel) -> Map {
        let mut map = Map::default();
        let poses =
            [0.0, 0.2, 0.4, 0.6].map(|x| Se3::<Camera, World>::new(UnitQuaternion::identity(), -x * Vector3::x()));
        let keyframes = poses.map(|pose| map.add_keyframe(examples::keyframe(Arc::default(), pose)));
        let floor = (0..on_floor).map(|i| Vector3::new(0.1 * (i % 7) as f64, 1.0, 3.0 + 0.2 * (i / 7) as f64));
        let wall = (0..20).map(|i| Vector3::new(0.1 * (i % 5) as f64, 0.1 * (i / 5) as f64, 4.0));
        for point in floor.chain(wall) {
            let seen = std::array::from_fn::<_, 4, _>(|n| {
                let pixel = camera.project(&poses[n].transform(&point)).expect("in front");
                let seen = observe(camera, LandmarkId::default(), pixel.cast(), 1.0).expect("in the picture");
                (keyframes[n], seen)
            });
            let known = Matrix3::identity() * 1e-6;
            map.add_landmark(Landmark { covariance: known, ..examples::landmark(point, keyframes[0]) }, &seen);
        }
        map
    }

    /// What an adjustment of the whole map holds of a floor a metre below the first keyframe, and how many landmarks around it.
    fn held(map: &Map, camera: &CameraModel, offset: f64) -> Option<HeldFloor> {
        let plane = Plane {
            normal: -Vector3::y(),
            offset,
            height: 1.0,
            sigma: 0.01,
            up_camera: -Vector3::y_axis(),
            landmarks: LEAST_LANDMARKS,
            scatter: Scatter::default(),
        };
        let mut job = Adjustment::global(map, camera, &Shutter::new(0.0, 480, false), 1).expect("something to move");
        let poses = job.problem.state.poses.len();
        job.hold_floor(
            map,
            camera,
            &Shutter::new(0.0, 480, false),
            &DrivenFloor { plane, height: 1.0, landmarks: &[] },
        );
        let added = job.problem.state.poses.len() - poses;
        assert_eq!((added, job.problem.fixed.len() - poses), if job.problem.floor.is_some() { (1, 1) } else { (0, 0) });
        job.problem.floor.take()
    }

    #[test]
    fn a_floor_is_held_where_this_runs_cameras_drove_over_enough_of_it() {
        let camera = examples::lens();
        let map = driven(LEAST_LANDMARKS, &camera);
        let floor = held(&map, &camera, -1.0).expect("a floor");
        assert_eq!(floor.cameras, [0, 1, 2, 3]);
        assert_eq!(floor.on_floor.iter().filter(|on| **on).count(), LEAST_LANDMARKS, "the wall is no floor");
        assert!(floor.around.is_empty());

        assert!(held(&driven(LEAST_LANDMARKS - 1, &camera), &camera, -1.0).is_none(), "too little of it is seen");
        // The plane was found a fifth of the height lower: the camera is carried, or the map was corrected since.
        assert!(held(&map, &camera, -1.2).is_none(), "no camera is at its height");

        let mut yesterdays = driven(LEAST_LANDMARKS, &camera);
        yesterdays.numbers.load_below(3);
        assert_eq!(held(&yesterdays, &camera, -1.0).expect("a floor").cameras, [3], "of this run alone");
        yesterdays.numbers.load_below(4);
        assert!(held(&yesterdays, &camera, -1.0).is_none(), "nobody has driven here in this run");
    }

    #[test]
    fn no_length_is_held_as_if_it_were_exact() {
        let found = [held_sigma(0.05, 0.0), held_sigma(1.0, 1e-9), held_sigma(1.0, 0.03)];
        assert_eq!(found, [0.002, 0.01, 0.03]);
    }
}
