//! Corners of two keyframes matched along epipolar lines, where tracks did not live long enough to make landmarks.
//!
//! In a blurred, fast or slow sequence the frame-to-frame tracks are cut long before a degree of parallax has passed, and what has no
//! depth yet goes with them. The corners themselves are still in the pictures. Those of the covisible keyframes that are no landmark yet
//! are looked for among the newest keyframe's, near the line on which any distance from [`NEAREST_SHARE`] of the scene's
//! median one to infinity puts them, by binary descriptors that must be unambiguous along it. What is found is aligned against the older
//! keyframe's patch, triangulated, and looked for in the keyframes around as well. (Mur-Artal, Montiel, Tardós, "ORB-SLAM", T-RO 2015, section
//! VI.C, has such a search; the alignment is ours.)
//!
//! Only a keyframe that sees fewer than [`FED`] landmarks is completed so: where tracks live, landmarks made from them are the more
//! exact ones (from many views, and never a mistaken corner).
//!
//! Input: the newest keyframe and the map around it. Output: landmarks in the map; corners that stay free in the keyframe. Cost: 0.7 ms
//! a keyframe for its corners, 0.5 ms a neighbour where it is completed, after its pose was published. Not here: corners with tracks,
//! which triangulate by themselves (`keyframe`).

use nalgebra::{Vector2, Vector3};

use super::corners::CornerFinder;
use super::{Lens, displaced, made_of, triangulate};
use crate::geometry::frames::Camera;
use crate::geometry::{CameraModel, Se3};
use crate::map::{FreeCorner, Keyframe, KeyframeId, Landmark, LandmarkId, Map, Observation};
use crate::reconstruction::measurement::{NEAREST, middle_distance};
use crate::reconstruction::track::template::{observe, refine_in};

/// A frame with so many landmarks in view is safe from running out of them before new ones are made.
pub const FED: usize = 120;

/// Keyframes whose corners are looked for in the newest one, and landmarks that they must share with it.
pub(super) const NEIGHBOURS: usize = 5;
pub(super) const MIN_SHARED: u32 = 15;
/// Nearest distance looked at, as a share of the median one.
const NEAREST_SHARE: f64 = 0.25;
/// Distance of a corner from the epipolar line, px.
const BESIDE_LINE_PX: f64 = 3.0;
/// Bits in which descriptors of one corner may differ, and the share of the next best one's along the line.
const MAX_BITS: u32 = 60;
const MAX_RATIO: f64 = 0.8;

/// Buffers, kept between keyframes.
#[derive(Debug, Default)]
pub struct EpipolarMatcher {
    finder: CornerFinder,
    around: Vec<(KeyframeId, u32)>,
}

impl EpipolarMatcher {
    /// Finds the free corners of keyframe `newest`; where it sees few landmarks, makes some of those that its neighbours have too.
    pub fn complete(&mut self, map: &mut Map, newest: KeyframeId, lens: &Lens<'_>) {
        let Some(keyframe) = map.keyframe(newest) else { return };
        let (seen, median) = (keyframe.observations.len(), median_distance(map, keyframe));
        self.note_corners(map, newest, lens.camera);
        let Some(median) = median.filter(|_| seen < FED) else { return };
        map.covisible(newest, MIN_SHARED, NEIGHBOURS, &mut self.around);
        for i in 0..self.around.len() {
            self.complete_from(map, newest, self.around[i].0, median, lens);
        }
    }

    /// Finds the corners of a keyframe that are no landmark's place.
    fn note_corners(&mut self, map: &mut Map, id: KeyframeId, camera: &CameraModel) {
        let Some(keyframe) = map.keyframe(id) else { return };
        let Some(pyramid) = keyframe.picture.whole() else { return map.set_corners(id, Vec::new()) };
        let taken = keyframe.observations.pixels().map(|o| o.1);
        let corners = self.finder.find(pyramid, camera, taken);
        map.set_corners(id, corners);
    }

    /// Makes landmarks of the free corners that keyframe `older` shares with the newest one, `median` map units away or so.
    fn complete_from(&self, map: &mut Map, newest: KeyframeId, older: KeyframeId, median: f64, lens: &Lens<'_>) {
        let (Some(new), Some(old)) = (map.keyframe(newest), map.keyframe(older)) else { return };
        let new_from_old = new.camera_from_world * old.camera_from_world.inverse();
        if new_from_old.translation.norm() < median * lens.config.min_parallax_deg.to_radians() {
            return;
        }
        let beside = BESIDE_LINE_PX / lens.camera.focal_px();
        let (mut old_used, mut new_used, mut made) = (Vec::new(), Vec::new(), Vec::new());
        for (i, corner) in old.corners.iter().enumerate() {
            let Some(line) = Segment::of(&corner.normalised, &new_from_old.relabel(), NEAREST_SHARE * median) else {
                continue;
            };
            let Some(j) = best_along(&line, corner, &new.corners, beside) else { continue };
            if new_used.contains(&j) {
                continue;
            }
            let confirmed = self.confirm(map, (older, corner.pixel), (newest, new.corners[j].pixel), lens);
            if let Some(landmark) = confirmed {
                made.push(landmark);
                old_used.push(i);
                new_used.push(j);
            }
        }
        for (landmark, seen) in made {
            map.add_landmark(landmark, &seen);
        }
        map.drop_corners(older, &mut old_used);
        map.drop_corners(newest, &mut new_used);
    }

    /// The landmark that the older and the newest keyframe see at these pixels; `None` where alignment or triangulation fails.
    fn confirm(
        &self,
        map: &Map,
        (old_id, old_pixel): (KeyframeId, Vector2<f32>),
        (new_id, new_pixel): (KeyframeId, Vector2<f32>),
        lens: &Lens<'_>,
    ) -> Option<(Landmark, Vec<(KeyframeId, Observation)>)> {
        let Lens { camera, config, shutter, .. } = *lens;
        let (old, new) = (map.keyframe(old_id)?, map.keyframe(new_id)?);
        let see = |pixel| observe(camera, LandmarkId::default(), pixel, 1.0 / config.sigma_px);
        let (a, b) = (see(old_pixel)?, see(new_pixel)?);
        let meet = |b: &Observation| {
            let (old, new) = (&old.camera_from_world, &new.camera_from_world);
            let (point, angle) = triangulate(old, &a.normalised, new, &b.normalised)?;
            (angle >= config.min_parallax_deg.to_radians()).then_some(point)
        };
        let b = refine_in(old, &a, new, &meet(&b)?, b.pixel, camera, config.sigma_px)?;
        let point = meet(&b)?;
        let mut seen = vec![(old_id, displaced(old, a, &point, shutter))];
        for &(id, _) in self.around.iter().filter(|k| k.0 != old_id) {
            let Some(other) = map.keyframe(id).filter(|k| k.picture.whole().is_some()) else { continue };
            let p = other.camera_from_world.transform(&point);
            let visible = |pixel: &Vector2<f64>| p.z > NEAREST && camera.contains(pixel, 10.0);
            let Some(pixel) = camera.project(&p).filter(visible) else { continue };
            if let Some(o) = refine_in(old, &a, other, &point, pixel.cast(), camera, config.sigma_px) {
                seen.push((id, displaced(other, o, &point, shutter)));
            }
        }
        seen.push((new_id, displaced(new, b, &point, shutter)));
        made_of(map, &seen, lens)
    }
}

/// Where the points of a ray are seen by another camera, on its plane z = 1.
#[derive(Debug, Clone, Copy)]
struct Segment {
    /// Of the point at infinity.
    far: Vector2<f64>,
    /// Unit vector towards nearer points.
    along: Vector2<f64>,
    length: f64,
}

impl Segment {
    /// From `nearest` (map units) to infinity; `None` where that is behind the camera or one point.
    fn of(normalised: &Vector2<f64>, other_from_this: &Se3<Camera, Camera>, nearest: f64) -> Option<Self> {
        let ray = normalised.push(1.0).normalize();
        let far = other_from_this.rotation * ray;
        let near: Vector3<f64> = far * nearest + other_from_this.translation;
        if far.z < 0.1 || near.z < 0.1 * nearest {
            return None;
        }
        let far = far.xy() / far.z;
        let way = near.xy() / near.z - far;
        let length = way.norm();
        (length > 1e-9).then(|| Self { far, along: way / length, length })
    }

    /// Whether a place lies within `beside` of it.
    fn passes(&self, place: &Vector2<f64>, beside: f64) -> bool {
        let d = place - self.far;
        let t = d.dot(&self.along);
        (d.x * self.along.y - d.y * self.along.x).abs() <= beside && t >= -beside && t <= self.length + beside
    }
}

/// Which of `others` along the line looks like `corner`, if that is clear.
fn best_along(line: &Segment, corner: &FreeCorner, others: &[FreeCorner], beside: f64) -> Option<usize> {
    let (mut best, mut bits, mut next) = (None, u32::MAX, u32::MAX);
    for (j, other) in others.iter().enumerate().filter(|(_, other)| line.passes(&other.normalised, beside)) {
        let distance = corner.descriptor.distance(&other.descriptor);
        if distance < bits {
            (best, next, bits) = (Some(j), bits, distance);
        } else {
            next = next.min(distance);
        }
    }
    let clear = bits <= MAX_BITS && (next == u32::MAX || f64::from(bits) < MAX_RATIO * f64::from(next));
    best.filter(|_| clear)
}

/// Median distance of a keyframe's landmarks, map units.
pub(super) fn median_distance(map: &Map, keyframe: &Keyframe) -> Option<f64> {
    let centre = keyframe.centre();
    let measured = |id| map.landmark(id).filter(|l| l.assumed.is_none());
    let distances = keyframe.observations.landmarks().filter_map(|id| Some((measured(id)?.position - centre).norm()));
    middle_distance(&mut distances.collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use nalgebra::{Matrix3, UnitQuaternion};

    use super::*;
    use crate::features::descriptor::Descriptor;
    use crate::image::{GreyImage, Pyramid};
    use crate::map::examples;
    use crate::reconstruction::config::ReconstructionConfig;
    use crate::reconstruction::measurement::CHI2_2D_95;
    use crate::reconstruction::measurement::rolling_shutter::Shutter;

    const FOCAL_PX: f64 = 400.0;

    fn camera() -> CameraModel {
        CameraModel::new(320, 240, FOCAL_PX, FOCAL_PX, 159.5, 119.5, [0.0; 5]).unwrap()
    }

    /// A wall of speckles, seen by a camera that has moved to the right by `shift` px at its distance.
    fn picture(shift: usize, seed: u32) -> GreyImage {
        let mut picture = GreyImage::new(320, 240);
        for (i, pixel) in picture.data.iter_mut().enumerate() {
            let (x, y) = ((i % 320 + shift) as u32 / 5, (i / 320) as u32 / 5);
            let mixed = (x.wrapping_mul(0x9E37_79B9) ^ y.wrapping_mul(0x85EB_CA6B) ^ seed.wrapping_mul(0x2545_F491))
                .wrapping_mul(0xC2B2_AE35);
            *pixel = 40 + ((mixed >> 15).wrapping_mul(0x27D4_EB2F) >> 24) as u8 / 2;
        }
        picture
    }

    fn observation(camera: &CameraModel, pixel: Vector2<f32>) -> Observation {
        observe(camera, LandmarkId::default(), pixel, 1.0).unwrap()
    }

    /// Three keyframes beside each other before the wall at distance 1, with 20 landmarks that all of them see.
    fn map_before_wall(camera: &CameraModel, seeds: [u32; 3]) -> (Map, KeyframeId) {
        let mut map = Map::default();
        let shifts = [0usize, 15, 30];
        let ids = [0, 1, 2].map(|k| {
            let mut pyramid = Pyramid::new(4);
            pyramid.build(&picture(shifts[k], seeds[k]));
            let moved = Vector3::new(-(shifts[k] as f64) / FOCAL_PX, 0.0, 0.0);
            let pose = Se3::new(UnitQuaternion::identity(), moved);
            map.add_keyframe(examples::keyframe(Arc::new(pyramid), pose))
        });
        for n in 0..20 {
            let pixel = Vector2::new(60.0 + 12.0 * n as f32, 20.0);
            let seen = [0, 1, 2].map(|k| (ids[k], observation(camera, pixel - Vector2::new(shifts[k] as f32, 0.0))));
            let landmark = Landmark::new(seen[0].1.normalised.push(1.0), Matrix3::identity() * 1e-6, ids[0]);
            map.add_landmark(landmark, &seen);
        }
        (map, ids[2])
    }

    fn completed(seeds: [u32; 3]) -> Map {
        let (camera, config) = (camera(), ReconstructionConfig::default());
        let shutter = Shutter::new(0.0, camera.height, false);
        let (mut map, newest) = map_before_wall(&camera, seeds);
        let lens = Lens { camera: &camera, config: &config, shutter: &shutter, outlier_chi2: CHI2_2D_95 };
        let mut matcher = EpipolarMatcher::default();
        // The older ones have their corners since they were the newest.
        for id in [KeyframeId(0), KeyframeId(1)] {
            matcher.note_corners(&mut map, id, &camera);
        }
        matcher.complete(&mut map, newest, &lens);
        map.check_consistency().unwrap();
        map
    }

    #[test]
    fn corners_without_a_track_become_landmarks_where_they_are() {
        let map = completed([7; 3]);
        let made: Vec<_> = map.landmarks.iter().skip(20).map(|(_, l)| l.position).collect();
        assert!(made.len() >= 60, "{} made", made.len());
        let off = made.iter().filter(|p| (p.z - 1.0).abs() > 0.03).count();
        assert!(50 * off <= made.len(), "{off} of {} off the wall", made.len());
        for (_, keyframe) in map.keyframes.iter() {
            for corner in &keyframe.corners {
                let taken = keyframe.observations.pixels().any(|o| o.1 == corner.pixel);
                assert!(!taken, "a corner that is a landmark is still free");
            }
        }
    }

    #[test]
    fn pictures_of_different_walls_make_none() {
        let map = completed([7, 8, 9]);
        assert!(map.landmarks.iter().count() <= 22, "{} by chance", map.landmarks.iter().count() - 20);
    }

    #[test]
    fn the_line_holds_every_distance_from_the_nearest_to_infinity() {
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.02, -0.1, 0.05));
        let motion: Se3<Camera, Camera> = Se3::new(turn, Vector3::new(-0.3, 0.1, 0.05));
        let normalised = Vector2::new(0.1, -0.2);
        let line = Segment::of(&normalised, &motion, 0.5).unwrap();
        for distance in [0.5, 0.8, 2.0, 10.0, 1e6] {
            let p = motion.transform(&(normalised.push(1.0).normalize() * distance));
            let place = p.xy() / p.z;
            assert!(line.passes(&place, 1e-9), "at {distance}");
            let beside = Vector2::new(-line.along.y, line.along.x) * 0.01;
            assert!(!line.passes(&(place + beside), 0.005) && line.passes(&(place + beside), 0.02));
        }
        let nearer = motion.transform(&(normalised.push(1.0).normalize() * 0.4));
        assert!(!line.passes(&(nearer.xy() / nearer.z), 1e-3));
        let back: Se3<Camera, Camera> =
            Se3::new(UnitQuaternion::from_scaled_axis(Vector3::new(0.0, 3.0, 0.0)), Vector3::zeros());
        assert!(Segment::of(&normalised, &back, 0.5).is_none(), "behind");
        assert!(Segment::of(&normalised, &Se3::identity(), 0.5).is_none(), "no way, no line");
    }

    #[test]
    fn two_corners_that_look_alike_along_the_line_are_none() {
        let corner = |x: f64, bits: u64| FreeCorner {
            pixel: Vector2::zeros(),
            normalised: Vector2::new(x, 0.0),
            descriptor: Descriptor([bits, 0, 0, 0]),
        };
        let line = Segment { far: Vector2::zeros(), along: Vector2::x(), length: 0.5 };
        let alike = [corner(0.1, 0b11), corner(0.2, 0b101)];
        assert_eq!(best_along(&line, &corner(0.0, 0), &alike, 0.01), None);
        assert_eq!(best_along(&line, &corner(0.0, 0), &[corner(0.1, 0b11), corner(0.7, 0b101)], 0.01), Some(0));
        assert_eq!(best_along(&line, &corner(0.0, 0), &[corner(0.1, u64::MAX)], 0.01), None, "too unlike");
        assert_eq!(best_along(&line, &corner(0.0, 0), &[corner(0.1, 0b1), corner(0.2, 0xFF)], 0.01), Some(0));
    }
}
