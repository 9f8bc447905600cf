//! Search of the map's landmarks in a frame by projection.
//!
//! Input: local landmarks, a predicted pose, the frame's pyramid. Output: [`Match`]es, each a sub-pixel position found by
//! aligning a template that is cut from the keyframe whose view is closest and warped affinely into the frame (the same
//! landmark keeps the same templates, so its position does not drift with the frames; Forster et al. 2017, section V).
//! Cost: about 60 ns a landmark projected, 2 us a landmark aligned. Allocates nothing once warm.

use nalgebra::{Vector2, Vector3};

use super::template::{BLURRED_LEVELS, SearchOptions, affine_warp, align_template};
use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::image::Pyramid;
use crate::map::picture::Detail;
use crate::map::{Keyframe, KeyframeId, LandmarkId, Map, Observation};
use crate::reconstruction::measurement::{Correspondence, NEAREST};

/// A landmark found in the frame.
#[derive(Debug, Clone, Copy)]
pub struct Match {
    pub landmark: LandmarkId,
    /// Keyframe that its template was cut from.
    pub template: KeyframeId,
    /// World coordinates at the time of the search.
    pub point: Vector3<f64>,
    /// Level-0 pixel, distorted as in the picture.
    pub pixel: Vector2<f32>,
    /// Undistorted, z = 1, as seen.
    pub normalised: Vector2<f64>,
    /// How far a rolling shutter moved it, per second of readout time.
    pub displacement: Vector2<f64>,
    pub inv_sigma_px: f64,
    /// Agreed with the pose in the end.
    pub inlier: bool,
    /// A view from nearly the same direction shows it.
    pub is_alike: bool,
}

impl Match {
    /// Where the middle row's pose would have seen it, for a readout time in seconds.
    pub fn at_middle_row(&self, readout_s: f64) -> Vector2<f64> {
        self.normalised - self.displacement * readout_s
    }

    /// Its pair for the optimisation of the pose.
    pub fn pair(&self, camera: &CameraModel, readout_s: f64) -> Correspondence {
        let pixel_scale = camera.pixel_scale(&self.normalised);
        Correspondence::new(self.point, self.at_middle_row(readout_s), pixel_scale, self.inv_sigma_px)
    }
}

/// A landmark that should be in the picture.
#[derive(Debug, Clone, Copy)]
struct Candidate {
    landmark: LandmarkId,
    point: Vector3<f64>,
    pixel: Vector2<f64>,
    cell: u32,
}

/// Buffers of the search, kept between frames.
#[derive(Debug)]
pub struct Search {
    /// All that should be in the picture.
    candidates: Vec<Candidate>,
    /// Rank (the smallest is looked for first), landmark and index of the candidates that are looked for.
    chosen: Vec<(u32, LandmarkId, u32)>,
    per_cell: Vec<u32>,
    /// Found in the last call of [`align`](Self::align), ascending landmark id.
    pub matches: Vec<Match>,
    /// Looked for but not found in the last call, or should be in the picture and no view is near enough to look for it by.
    pub missed: Vec<LandmarkId>,
    /// How many of these should look as they did.
    pub missed_alike: usize,
}

/// Cell of the selection grid, px: keeps the landmarks spread over the picture.
const CELL_PX: usize = 32;
/// A landmark's place must lie this far inside the picture, px.
const BORDER_PX: f64 = 8.0;
/// Cosine of the largest angle between the view of a template and the present one.
const MIN_VIEW_COSINE: f64 = 0.5;
/// Cosine of the angle up to which a landmark should look as it did, 20 degrees: in places that were known nine of ten are found up to 10 degrees, four
/// of ten at 20, one of ten from 30 on.
const ALIKE_COSINE: f64 = 0.94;
/// Where less than this share of the landmarks is found, the others are looked for on coarser levels as well. Without it three of 35
/// sequences, of quick hands, lose a third of their frames.
const BLURRED_SHARE: f64 = 0.6;

impl Default for Search {
    fn default() -> Self {
        Self {
            candidates: Vec::with_capacity(4096),
            chosen: Vec::with_capacity(4096),
            per_cell: Vec::with_capacity(4096),
            matches: Vec::with_capacity(1024),
            missed: Vec::with_capacity(1024),
            missed_alike: 0,
        }
    }
}

impl Search {
    /// Projects `local` at `pose` and keeps up to `limit` visible ones, spread over the picture. Landmarks of which no
    /// picture in memory holds a patch are left out: they take no other's place, and are not missed.
    pub fn select(
        &mut self,
        map: &Map,
        local: &[LandmarkId],
        camera: &CameraModel,
        pose: &Se3<Camera, World>,
        limit: usize,
    ) {
        self.candidates.clear();
        self.chosen.clear();
        let columns = (camera.width as usize).div_ceil(CELL_PX);
        let rows = (camera.height as usize).div_ceil(CELL_PX);
        let some_are_away = map.away() > 0;
        for &id in local {
            let Some(landmark) = map.landmark(id) else { continue };
            let camera_point = pose.transform(&landmark.position);
            if camera_point.z < NEAREST {
                continue;
            }
            let Some(pixel) = camera.project(&camera_point) else { continue };
            if !camera.contains(&pixel, BORDER_PX) || (some_are_away && !is_shown_here(map, id, &landmark.observers)) {
                continue;
            }
            let cell = (pixel.y as usize / CELL_PX * columns + pixel.x as usize / CELL_PX) as u32;
            // Often found ones first.
            let rank = u32::MAX - (100 * (landmark.found + 2) / (landmark.sought + 2)).min(100);
            self.chosen.push((rank, id, self.candidates.len() as u32));
            self.candidates.push(Candidate { landmark: id, point: landmark.position, pixel, cell });
        }
        if self.candidates.len() <= limit {
            return;
        }
        self.chosen.sort_unstable();
        // Rounds over the grid: the n-th best of every cell before the (n+1)-th of any.
        self.per_cell.clear();
        self.per_cell.resize(columns * rows, 0);
        for (rank, _, i) in &mut self.chosen {
            let used = &mut self.per_cell[self.candidates[*i as usize].cell as usize];
            *rank = *used;
            *used += 1;
        }
        self.chosen.sort_unstable();
        self.chosen.truncate(limit);
    }

    /// Aligns the selected landmarks in `pyramid`, predictions taken at `pose`.
    pub fn align(
        &mut self,
        map: &Map,
        camera: &CameraModel,
        pose: &Se3<Camera, World>,
        pyramid: &Pyramid,
        options: &SearchOptions,
    ) {
        self.matches.clear();
        self.seek(map, camera, pose, pyramid, options);
        let sought = self.matches.len() + self.missed.len();
        if (self.matches.len() as f64) < BLURRED_SHARE * sought as f64 {
            // On coarser levels a streak of blur is short.
            let blurred = SearchOptions { blurred_levels: BLURRED_LEVELS, ..*options };
            self.seek(map, camera, pose, pyramid, &blurred);
        }
        self.matches.sort_unstable_by_key(|m| m.landmark);
    }

    /// Looks for the selected landmarks that were not found yet.
    fn seek(
        &mut self,
        map: &Map,
        camera: &CameraModel,
        pose: &Se3<Camera, World>,
        pyramid: &Pyramid,
        options: &SearchOptions,
    ) {
        self.missed.clear();
        self.missed_alike = 0;
        let centre = pose.inverse().translation;
        let found = self.matches.len();
        for n in 0..self.chosen.len() {
            let candidate = self.candidates[self.chosen[n].2 as usize];
            if self.matches[..found].iter().any(|m| m.landmark == candidate.landmark) {
                continue;
            }
            let view = closest_view(map, &centre, &candidate);
            match view.as_ref().and_then(|view| align_candidate(view, camera, pose, pyramid, &candidate, options)) {
                Some(found) => self.matches.push(found),
                None => {
                    self.missed.push(candidate.landmark);
                    self.missed_alike += usize::from(view.is_some_and(|view| view.is_alike));
                }
            }
        }
    }
}

/// Whether a picture that is in memory shows it.
fn is_shown_here(map: &Map, landmark: LandmarkId, observers: &[KeyframeId]) -> bool {
    let shows = |k: &Keyframe| !k.picture.is_away() && k.picture.detail(landmark.0) > Detail::None;
    // The newest are the likeliest to be here.
    observers.iter().rev().any(|k| map.keyframe(*k).is_some_and(shows))
}

/// Where a landmark is seen from, by a keyframe that shows it.
struct KnownView<'a> {
    template: KeyframeId,
    keyframe: &'a Keyframe,
    observation: Observation,
    /// It should look the same from here: the view is not from aside, and shows it.
    is_alike: bool,
}

fn align_candidate(
    view: &KnownView<'_>,
    camera: &CameraModel,
    pose: &Se3<Camera, World>,
    pyramid: &Pyramid,
    candidate: &Candidate,
    options: &SearchOptions,
) -> Option<Match> {
    let KnownView { template, keyframe, ref observation, is_alike } = *view;
    let affine = affine_warp(camera, keyframe, observation, pose, &candidate.point)?;
    let found = align_template(keyframe, observation, pyramid, &affine, candidate.pixel, options)?;
    let pixel = found.pixel;
    let normalised = camera.undistort(&pixel.cast::<f64>())?;
    Some(Match {
        landmark: candidate.landmark,
        template,
        point: candidate.point,
        pixel,
        normalised,
        displacement: Vector2::zeros(),
        inv_sigma_px: found.inv_sigma_px,
        inlier: true,
        is_alike,
    })
}

/// The observation whose direction of view is closest to the present one, of those that show it in full at the resolution that the present distance
/// asks for, if there are any.
fn closest_view<'a>(map: &'a Map, centre: &Vector3<f64>, candidate: &Candidate) -> Option<KnownView<'a>> {
    let landmark = map.landmark(candidate.landmark)?;
    let ray = candidate.point - centre;
    let depth = ray.norm();
    let mut best = None;
    let mut best_score = (Detail::None, f64::NEG_INFINITY);
    for &id in &landmark.observers {
        let keyframe = map.keyframe(id)?;
        if keyframe.picture.is_away() {
            continue;
        }
        let other = candidate.point - keyframe.centre();
        let other_depth = other.norm();
        let cosine = ray.dot(&other) / (depth * other_depth).max(1e-12);
        // Detail first, then the angle; a scale change of two costs as much as a turn by 25 degrees.
        let levels = (depth / other_depth.max(1e-12)).log2();
        let closeness = cosine - 0.1 * levels.abs();
        // What was seen from nearer is cut from a coarser level, which not every picture has.
        let level = levels.round().max(0.0) as usize;
        let score = (keyframe.picture.detail_at(level, candidate.landmark.0), closeness);
        if cosine >= MIN_VIEW_COSINE && score > best_score {
            best_score = score;
            best = Some((id, keyframe, cosine));
        }
    }
    let (template, keyframe, cosine) = best?;
    let is_alike = cosine >= ALIKE_COSINE && best_score.0 > Detail::None;
    Some(KnownView { template, keyframe, observation: keyframe.observation(candidate.landmark)?, is_alike })
}

#[cfg(test)]
mod tests {
    use crate::map::examples;
    use std::sync::Arc;

    use super::*;
    use crate::image::GreyImage;
    use crate::image::pyramid::level_from_base;
    use crate::reconstruction::track::template::{observe, picture};
    use nalgebra::Matrix2;

    fn camera() -> CameraModel {
        CameraModel::new(320, 240, 300.0, 300.0, 159.5, 119.5, [0.0; 5]).expect("a camera")
    }

    /// A keyframe at `centre` that sees the landmark in the middle of the discs, and the landmark's place before the first of them.
    fn seen_from(centre: Vector3<f64>, pixel: Vector2<f32>) -> (Keyframe, Observation) {
        let keyframe =
            examples::keyframe(Arc::new(picture(0)), Se3::new(nalgebra::UnitQuaternion::identity(), -centre));
        (keyframe, observe(&camera(), LandmarkId::default(), pixel, 1.0).expect("in the picture"))
    }

    #[test]
    fn a_condensed_view_from_too_near_gives_way_to_one_from_the_right_distance() {
        use crate::map::view::{DESCRIBED_LEVELS, Description};
        let pixel = Vector2::new(163.0, 117.0);
        let point = Vector3::new(0.0, 0.0, 4.0);
        let mut map = Map::default();
        // A quarter of the distance; the distance itself, from 20 degrees aside, twice.
        let aside = point - 4.0 * Vector3::new(0.342, 0.0, 0.94);
        let places = [Vector3::new(0.0, 0.0, 3.0), aside, aside];
        let seen = places.map(|place| {
            let (keyframe, observation) = seen_from(place, pixel);
            (map.add_keyframe(keyframe), observation)
        });
        let [near, beside, twin] = seen.map(|s| s.0);
        let landmark = map.add_landmark(examples::landmark(point, near), &seen);
        let candidate = Candidate { landmark, point, pixel: pixel.cast(), cell: 0 };
        let chosen = |map: &Map| closest_view(map, &Vector3::zeros(), &candidate).expect("a view").keyframe.centre();
        // The twin keeps the patch that the other then needs not.
        map.reduce_picture(twin);
        map.reduce_picture(beside);
        map.remove_observation(twin, landmark);
        let detail = |map: &Map, id, level| map.keyframe(id).expect("there").picture.detail_at(level, landmark.0);
        assert_eq!(detail(&map, beside, 0), Detail::Half);
        assert!((chosen(&map) - places[0]).norm() < 1e-9, "a picture with all levels is sampled on a coarser one");
        map.condense_picture(near, &camera(), |_, l| Description {
            landmarks: vec![[None; DESCRIBED_LEVELS]; l.len()],
            place: vec![],
        });
        assert_eq!(
            [0, 1, 2, 3].map(|level| detail(&map, near, level)),
            [Detail::Full, Detail::Full, Detail::Half, Detail::Full]
        );
        assert!((chosen(&map) - aside).norm() < 1e-9, "it has no level for this distance");

        // Where there is no other, the next coarser level finds it all the same.
        let mut far = Pyramid::new(4);
        let mut seen_small = GreyImage::new(320, 240);
        for (to, from) in seen_small.data.chunks_exact_mut(320).zip(picture(0).levels[2].data.chunks_exact(80)) {
            to[..80].copy_from_slice(from);
        }
        far.build(&seen_small);
        let keyframe = map.keyframe(near).expect("there");
        let there = level_from_base(2, pixel);
        let start = there.cast() + Vector2::new(0.6, -0.4);
        let options = SearchOptions::precise(0.8);
        let observation = keyframe.observation(landmark).expect("seen");
        let found = align_template(keyframe, &observation, &far, &(Matrix2::identity() * 0.25), start, &options)
            .expect("found");
        assert!((found.pixel - there).norm() < 0.3, "{} {there}", found.pixel);
    }

    #[test]
    fn what_was_only_seen_from_aside_is_no_landmark_that_should_look_as_it_did() {
        let (mut map, pixel) = (Map::default(), Vector2::new(159.5, 119.5));
        let (keyframe, observation) = seen_from(Vector3::zeros(), pixel);
        let id = map.add_keyframe(keyframe);
        let point = 4.0 * observation.normalised.push(1.0);
        let landmark = map.add_landmark(examples::landmark(point, id), &[(id, observation)]);
        let mut empty = Pyramid::new(4);
        empty.build(&GreyImage::new(320, 240));
        let mut search = Search::default();
        for (degrees, alike) in [(0.0_f64, 1), (10.0, 1), (30.0, 0), (50.0, 0), (80.0, 0)] {
            // About the landmark, which stays in the middle of the picture.
            let turn = nalgebra::UnitQuaternion::from_scaled_axis(degrees.to_radians() * Vector3::y());
            let pose = Se3::new(turn, point - turn * point);
            search.select(&map, &[landmark], &camera(), &pose, 9);
            search.align(&map, &camera(), &pose, &empty, &SearchOptions::precise(0.8));
            assert_eq!((search.missed.len(), search.missed_alike), (1, alike), "{degrees} degrees");
        }
    }

    #[test]
    fn nobody_looks_for_a_landmark_while_all_that_shows_it_is_elsewhere() {
        use crate::map::view::{DESCRIBED_LEVELS, Description};
        let (mut map, pixel) = (Map::default(), Vector2::new(163.0, 117.0));
        let seen = [(); 2].map(|()| {
            let (keyframe, observation) = seen_from(Vector3::zeros(), pixel);
            (map.add_keyframe(keyframe), observation)
        });
        let [showing, other] = seen.map(|s| s.0);
        let landmark = map.add_landmark(examples::landmark(4.0 * seen[0].1.normalised.push(1.0), showing), &seen);
        for id in [showing, other] {
            map.condense_picture(id, &camera(), |_, l| Description {
                landmarks: vec![[None; DESCRIBED_LEVELS]; l.len()],
                place: vec![],
            });
        }
        let detail = |map: &Map, id| map.keyframe(id).expect("there").picture.detail(landmark.0);
        assert_eq!([detail(&map, showing), detail(&map, other)], [Detail::Full, Detail::None]);
        let sought = |map: &Map| {
            let mut search = Search::default();
            let (pose, options) = (Se3::identity(), SearchOptions::precise(0.8));
            search.select(map, &[landmark], &camera(), &pose, 9);
            search.align(map, &camera(), &pose, &picture(0), &options);
            [search.matches.len(), search.missed.len()]
        };
        assert_eq!(sought(&map), [1, 0]);
        assert!(map.put_picture_away(showing, |picture| examples::copied(picture, 0)));
        assert_eq!(sought(&map), [0, 0], "the other is here, but shows nothing");
        assert_eq!(map.bring_picture_back(showing), Ok(true));
        assert_eq!(sought(&map), [1, 0]);
    }
}
