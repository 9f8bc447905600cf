//! Relocalisation by descriptors: which landmarks of a keyframe are which corners of this frame, and the pose from that.
//!
//! Input: the frame's pyramid, one keyframe after the other, the map. Output: a pose with its inliers, from P3P inside RANSAC
//! ([`pnp`](crate::geometry::pnp)), to be confirmed by the search by projection. Needs no guess of the pose: finds the view again
//! after fast turns, blur, missing frames and from beside where it was mapped, at any roll.
//!
//! Corners are taken and described on three levels of the pyramid, landmarks likewise in their keyframe's picture, and all are matched
//! with all: so a blurred picture still answers on the coarse levels, and a view from half or twice the distance on another one. By
//! histograms of gradients ([`gradients`](crate::features::gradients)): of some twenty views of a desk that came back after up to two seconds
//! had been cut out, binary descriptors knew 8 and these 20. Keyframes are described when they are first asked for and remembered, the least
//! recently used of [`REMEMBERED`] giving way: nothing is paid while tracking works. A condensed keyframe's are those that were kept with its
//! landmarks' views ([`View`](crate::map::view::View)), in it and in others.
//!
//! Cost: some seven milliseconds for the frame, and as much for each keyframe that is new; a few for each comparison, 0.2 to 1 ms for the
//! pose where enough corners match. Not here: an index over thousands of keyframes (loop closing's).

use nalgebra::Vector2;

use crate::features::Corner;
use crate::features::fast::FastDetector;
use crate::features::gradients::{GradientDescriptor, GradientMap};
use crate::features::matching::{Place, PlaceMatching, match_places};
use crate::features::spread::Spread;
use crate::geometry::CameraModel;
use crate::geometry::pnp::estimate_pose;
use crate::geometry::ransac::RansacOptions;
use crate::image::Pyramid;
use crate::image::pyramid::{base_from_level, level_from_base};
use crate::map::view::{
    CoarseDescriptor, DESCRIBED_LEVELS, Described as LandmarkDescriptors, Description, PLACE_DESCRIPTORS,
};
use crate::map::{Keyframe, KeyframeId, LandmarkId, Map};
use crate::places::describe::PlaceDescriber;
use crate::reconstruction::keyframe::corners::CELL_PX;
use crate::reconstruction::track::Guess;

/// Corners of a frame that are described, by level.
const CORNERS: [usize; DESCRIBED_LEVELS] = [500, 250, 100];
/// Brightness difference of a corner, grey levels: low, for blurred pictures; the strongest of each cell come first.
const THRESHOLD: u8 = 7;
/// Keyframes whose descriptors are remembered: some 0.1 MB each.
const REMEMBERED: usize = 48;
/// Landmarks matched at the least before a pose is tried, and in agreement with it.
const MIN_MATCHES: usize = 15;
const MIN_INLIERS: usize = 12;
/// Largest distance of an inlier from its projection, level-0 px.
const INLIER_PX: f64 = 5.0;
/// Samples drawn for a pose at the most.
const MAX_SAMPLES: usize = 200;

/// Descriptors, where they were taken, and what they belong to.
#[derive(Debug, Default)]
struct Described<T> {
    descriptors: Vec<GradientDescriptor>,
    places: Vec<Place>,
    of: Vec<T>,
}

impl<T: Copy> Described<T> {
    fn clear(&mut self) {
        self.descriptors.clear();
        self.places.clear();
        self.of.clear();
    }

    fn push(&mut self, gradients: &GradientMap, level: usize, pixel: Vector2<f32>, of: T) {
        let at = level_from_base(level, pixel);
        for d in gradients.describe(at.x, at.y).into_iter() {
            self.descriptors.push(d.descriptor);
            self.places.push(Place { at: [pixel.x, pixel.y], size_px: (1 << level) as f32 });
            self.of.push(of);
        }
    }
}

/// A keyframe's landmarks, described.
#[derive(Debug)]
struct Remembered {
    keyframe: KeyframeId,
    /// How many landmarks it had then: described anew when it has gained many.
    landmarks: usize,
    /// Something that it would have been described by was elsewhere: described anew the next time.
    is_partial: bool,
    described: Described<LandmarkId>,
    last_used: u64,
}

/// A landmark and where it was seen.
#[derive(Debug, Clone, Copy)]
struct Pair {
    landmark: LandmarkId,
    pixel: Vector2<f32>,
    distance: f32,
}

/// See the module.
#[derive(Debug, Default)]
pub struct DescriptorSearch {
    detector: FastDetector,
    corners: Vec<Corner>,
    spread: Spread,
    gradients: GradientMap,
    frame: Described<Vector2<f32>>,
    remembered: Vec<Remembered>,
    uses: u64,
    pairs: Vec<Pair>,
}

impl DescriptorSearch {
    /// Describes a frame; false when it shows too little (a covered lens).
    pub fn describe_frame(&mut self, pyramid: &Pyramid) -> bool {
        self.frame.clear();
        for level in 0..DESCRIBED_LEVELS {
            let Some(image) = pyramid.levels.get(level) else { break };
            self.detector.detect_all(image, THRESHOLD, &mut self.corners);
            self.gradients.fill(image);
            let spread = self.spread.over_cells((image.width, image.height), CELL_PX, &mut self.corners);
            for corner in spread.take(CORNERS[level]) {
                let pixel = base_from_level(level, Vector2::new(corner.x, corner.y));
                self.frame.push(&self.gradients, level, pixel, pixel);
            }
        }
        self.frame.of.len() >= MIN_MATCHES
    }

    /// Pose of the described frame from the landmarks of one keyframe, and how many agree.
    pub fn pose_from(
        &mut self,
        map: &Map,
        camera: &CameraModel,
        reference: KeyframeId,
        seed: u64,
    ) -> Option<(usize, Guess)> {
        let remembered = self.remember(map, reference)?;
        self.match_with(remembered);
        if self.pairs.len() < MIN_MATCHES {
            return None;
        }
        let (mut points, mut seen) = (Vec::with_capacity(self.pairs.len()), Vec::with_capacity(self.pairs.len()));
        for pair in &self.pairs {
            let Some(landmark) = map.landmark(pair.landmark) else { continue };
            // The distances to the projections are taken on the plane z = 1.
            let central = |n: &Vector2<f64>| camera.is_central(n);
            let Some(normalised) = camera.undistort(&pair.pixel.cast()).filter(central) else { continue };
            points.push(landmark.position);
            seen.push(normalised);
        }
        let options = RansacOptions {
            max_iterations: MAX_SAMPLES,
            confidence: 0.999,
            min_inliers: MIN_INLIERS,
            min_iterations: 30,
            // The search by projection refines anyway.
            local_iterations: 1,
            inner_samples: 0,
            seed,
            ..RansacOptions::new(INLIER_PX / camera.focal_px())
        };
        let found = estimate_pose(&points, &seen, &options)?;
        Some((found.inlier_count, Guess { camera_from_world: found.to_from_from, reference }))
    }

    /// Index of a keyframe among the remembered ones, described if it is new or has changed much.
    fn remember(&mut self, map: &Map, id: KeyframeId) -> Option<usize> {
        self.uses += 1;
        let keyframe = map.keyframe(id).filter(|k| !k.picture.is_away())?;
        let landmarks = keyframe.observations.len();
        let place = match self.remembered.iter().position(|r| r.keyframe == id) {
            Some(i)
                if landmarks <= self.remembered[i].landmarks + self.remembered[i].landmarks / 8
                    && !self.remembered[i].is_partial =>
            {
                self.remembered[i].last_used = self.uses;
                return Some(i);
            }
            Some(i) => i,
            None if self.remembered.len() < REMEMBERED => {
                let (described, is_partial) = (Described::default(), false);
                self.remembered.push(Remembered { keyframe: id, landmarks, is_partial, described, last_used: 0 });
                self.remembered.len() - 1
            }
            None => self.remembered.iter().enumerate().min_by_key(|(_, r)| r.last_used)?.0,
        };
        let entry = &mut self.remembered[place];
        (entry.keyframe, entry.landmarks, entry.last_used) = (id, landmarks, self.uses);
        entry.is_partial = describe_keyframe(map, keyframe, &mut self.gradients, &mut entry.described);
        Some(place)
    }

    /// The best match of each landmark, into `pairs`.
    fn match_with(&mut self, remembered: usize) {
        let rule = PlaceMatching::default();
        self.pairs.clear();
        let (theirs, ours) = (&self.remembered[remembered].described, &self.frame);
        let matches = match_places((&theirs.descriptors, &theirs.places), (&ours.descriptors, &ours.places), &rule);
        for m in &matches {
            let (landmark, pixel) = (theirs.of[m.first as usize], ours.of[m.second as usize]);
            self.pairs.push(Pair { landmark, pixel, distance: m.distance });
        }
        // One place a landmark: that of the smallest distance.
        self.pairs.sort_by(|a, b| a.landmark.cmp(&b.landmark).then(a.distance.total_cmp(&b.distance)));
        self.pairs.dedup_by_key(|p| p.landmark);
    }
}

/// Whether something that it would be described by is elsewhere.
fn describe_keyframe(
    map: &Map,
    keyframe: &Keyframe,
    gradients: &mut GradientMap,
    out: &mut Described<LandmarkId>,
) -> bool {
    out.clear();
    if keyframe.picture.is_condensed() {
        return describe_by_views(map, keyframe, out);
    }
    for level in 0..DESCRIBED_LEVELS {
        let Some(image) = keyframe.picture.level(level) else { break };
        gradients.fill(&image);
        for (landmark, pixel) in keyframe.observations.pixels() {
            out.push(gradients, level, pixel, landmark);
        }
    }
    false
}

/// A condensed keyframe has no picture to describe: its landmarks look as some keyframe that sees them keeps it, itself before others, and of these the
/// one that looks at them most alike.
fn describe_by_views(map: &Map, keyframe: &Keyframe, out: &mut Described<LandmarkId>) -> bool {
    let centre = keyframe.centre();
    let mut is_partial = false;
    for (id, pixel) in keyframe.observations.pixels() {
        let Some(landmark) = map.landmark(id) else { continue };
        let ray = landmark.position - centre;
        let view = |observer: &KeyframeId| {
            let other = map.keyframe(*observer)?;
            let view = other.picture.view(id.0)?;
            let there = landmark.position - other.centre();
            Some((ray.dot(&there) / (ray.norm() * there.norm()).max(1e-12), there.norm(), view))
        };
        let is_away = |k: &KeyframeId| map.keyframe(*k).is_some_and(|k| k.picture.is_away());
        is_partial |= landmark.observers.iter().any(is_away);
        let views = landmark.observers.iter().filter_map(view);
        let Some((_, distance, view)) = views.max_by(|a, b| a.0.total_cmp(&b.0)) else { continue };
        // A pixel of the view's level covers more of the scene from farther away.
        let size = (distance / ray.norm().max(1e-12)) as f32;
        for (level, descriptor) in view.described.iter().enumerate().filter_map(|(l, d)| Some((l, d.as_ref()?))) {
            out.descriptors.push(descriptor.restored());
            out.places.push(Place { at: [pixel.x, pixel.y], size_px: (1 << level) as f32 * size });
            out.of.push(id);
        }
    }
    is_partial
}

/// What a keyframe that is condensed keeps to be known by, and these landmarks of it.
pub fn describe_kept(keyframe: &Keyframe, landmarks: &[LandmarkId]) -> Description {
    let mut place = Vec::new();
    PlaceDescriber::default().describe_strongest(keyframe.picture.pyramid(), PLACE_DESCRIPTORS, &mut place);
    Description { landmarks: describe_landmarks(keyframe, landmarks), place }
}

/// The strongest direction on each level.
fn describe_landmarks(keyframe: &Keyframe, landmarks: &[LandmarkId]) -> Vec<LandmarkDescriptors> {
    let mut out = vec![[None; DESCRIBED_LEVELS]; landmarks.len()];
    for level in 0..DESCRIBED_LEVELS {
        let Some(image) = keyframe.picture.level(level) else { break };
        let gradients = GradientMap::new(&image);
        for (described, landmark) in out.iter_mut().zip(landmarks) {
            let Some(o) = keyframe.observation(*landmark) else { continue };
            let at = level_from_base(level, o.pixel);
            described[level] = gradients.describe(at.x, at.y).first().map(|d| CoarseDescriptor::of(&d.descriptor));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use crate::map::examples;
    use std::sync::Arc;

    use super::*;
    use crate::geometry::Se3;
    use crate::geometry::random::Random;
    use crate::image::GreyImage;
    use crate::map::Observation;
    use crate::reconstruction::track::template::observe;
    use nalgebra::{UnitQuaternion, Vector3};

    /// A wall of rectangles at distance 1, as the camera sees it from `x` px to the right of its middle.
    fn picture(x: usize) -> Pyramid {
        let mut random = Random::new(7);
        let mut wall = GreyImage::new(480, 240);
        for _ in 0..900 {
            let (left, top) = (random.below(470), random.below(232));
            let (width, height, grey) = (4 + random.below(16), 4 + random.below(16), random.below(256) as u8);
            for y in top..(top + height).min(240) {
                wall.data[y * 480..][left..(left + width).min(480)].fill(grey);
            }
        }
        let mut image = GreyImage::new(320, 240);
        for (y, row) in image.data.chunks_exact_mut(320).enumerate() {
            row.copy_from_slice(&wall.row(y)[x..x + 320]);
        }
        let mut noise = Random::new(x as u64);
        image.data.iter_mut().for_each(|v| *v = (f64::from(*v) + 2.0 * noise.normal()).clamp(0.0, 255.0) as u8);
        let mut pyramid = Pyramid::new(5);
        pyramid.build(&image);
        pyramid
    }

    #[test]
    fn a_frame_is_known_by_condensed_keyframes_as_by_whole_ones() {
        let camera = CameraModel::new(320, 240, 300.0, 300.0, 159.5, 119.5, [0.0; 5]).expect("a camera");
        let mut map = Map::default();
        let shifts = [0, 20, 40, 60];
        let ids = shifts.map(|x| {
            let moved = Se3::new(UnitQuaternion::identity(), Vector3::x() * -(x as f64 / 300.0));
            map.add_keyframe(examples::keyframe(Arc::new(picture(x)), moved))
        });
        let (mut detector, mut corners) = (FastDetector::default(), Vec::new());
        detector.detect_all(&picture(40).levels[0], 30, &mut corners);
        let mut spread = Spread::default();
        let spread: Vec<Corner> = spread.over_cells((320, 240), 24, &mut corners).take(90).copied().collect();
        for corner in spread {
            let seen: Vec<(KeyframeId, Observation)> = ids
                .iter()
                .zip(shifts)
                .filter_map(|(id, x)| {
                    let pixel = Vector2::new(corner.x + 40.0 - x as f32, corner.y);
                    let inside = (20.0..300.0).contains(&pixel.x);
                    inside.then(|| Some((*id, observe(&camera, LandmarkId(0), pixel, 1.0)?))).flatten()
                })
                .collect();
            let at = camera.undistort(&Vector2::new(f64::from(corner.x) + 40.0, f64::from(corner.y))).expect("a ray");
            let landmark = examples::landmark(at.push(1.0), ids[0]);
            map.add_landmark(landmark, &seen);
        }
        let known = |map: &Map| {
            ids.map(|id| {
                let mut search = DescriptorSearch::default();
                assert!(search.describe_frame(&picture(51)));
                let (inliers, guess) = search.pose_from(map, &camera, id, 1).expect("known");
                let off = (guess.camera_from_world.translation.x + 51.0 / 300.0).abs();
                assert!(off < 0.02, "{off}");
                inliers
            })
        };
        let by_whole = known(&map);
        let gone: usize = ids.iter().map(|id| map.condense_picture(*id, &camera, describe_kept)).sum();
        assert!(ids.iter().all(|id| map.keyframe(*id).is_some_and(|k| k.picture.is_condensed())));
        let (left, by_views) = (map.landmarks.len(), known(&map));
        println!("{left} landmarks left, {gone} gone; inliers {by_whole:?}, condensed {by_views:?}");
        // As many of those that are left; landmarks are fewer, each in fewer views.
        assert!(
            by_views.iter().zip(by_whole).all(|(views, whole)| 10 * views >= 7 * whole),
            "{by_whole:?} {by_views:?}"
        );
    }

    #[test]
    fn a_condensed_keyframe_keeps_the_strongest_half_of_what_the_index_is_told_of_either_level() {
        let described = |pyramid: &Pyramid| {
            let mut out = Vec::new();
            PlaceDescriber::default().describe(pyramid, &mut out);
            out
        };
        // Blocks of grey: many small ones, and few large ones, whose corners are on both levels.
        for (size, is_rich) in [(8, true), (120, false)] {
            let mut image = GreyImage::new(640, 480);
            for (i, v) in image.data.iter_mut().enumerate() {
                let (x, y) = (i % 640 / size, i / 640 / size);
                let mixed = (x as u32 + 77).wrapping_mul(0x9E37_79B9) ^ (y as u32 + 5).wrapping_mul(0x85EB_CA6B);
                *v = (mixed.wrapping_mul(0xC2B2_AE35) >> 24) as u8;
            }
            let mut pyramid = Pyramid::new(5);
            pyramid.build(&image);
            let all = described(&pyramid);
            let mut finer = pyramid.clone();
            finer.levels.truncate(2);
            let split = described(&finer).len();
            let kept = describe_kept(&examples::keyframe(Arc::new(pyramid), Se3::identity()), &[]);
            let [fine, coarse] = [(&all[..split], 48), (&all[split..], 16)].map(|(of, most)| &of[..of.len().min(most)]);
            assert!(kept.place == [fine, coarse].concat());
            assert_eq!((kept.place.len() == PLACE_DESCRIPTORS, fine.len() < 48), (is_rich, !is_rich), "{split}");
            assert!(!coarse.is_empty());
        }
    }
}
