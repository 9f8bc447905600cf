//! One frame against the map: predict, search by projection, optimise the pose.
//!
//! 1. *Prediction*: constant velocity, then corrected by the frame-to-frame tracks that are bound to landmarks (motion-only
//!    optimisation): it follows any acceleration that the flow could follow.
//! 2. *Search*: local landmarks are projected and aligned against keyframe templates ([`search`]).
//! 3. *Optimisation*: robust, motion-only, over everything found, each place whitened by what is known of its landmark. Where that
//!    is only a ray of most, as after a turn on the spot, it begins in several directions (`pose::minima`). In a quick turn tracks without depth hold the pose across their epipolar lines (`seed_rays`).
//!    Immature landmarks must then agree with the mature ones (`maturity`).
//! 4. If that fails or is not believed: again with a wide, coarse-to-fine search, from the prediction by flow and then from every guess.
//!
//! Everything reads the map and writes only its own buffers.

pub mod association;
pub mod frame;
mod information;
mod maturity;
pub mod pose;
pub mod search;
mod seed_rays;
pub mod template;

use nalgebra::Vector3;

use super::measurement::Correspondence;
use super::measurement::inverse_distance::mostly_assumed;
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::frames::{Camera, World};
use crate::geometry::sim3::Sim3;
use crate::geometry::{Se3, median};
use crate::map::{KeyframeId, LandmarkId, Map, vote};
use association::{TRACK_SIGMA_PX, Target};
use frame::{Frame, measurement_of, motion_since};
use information::PoseInformation;
use maturity::{MaturityGate, mature_after};
use pose::{PoseOptions, PoseSolution, lowest_minimum, optimise_pose};
use search::{Match, Search};
use seed_rays::SeedRays;
use template::SearchOptions;

/// A frame that was placed in the map.
#[derive(Debug, Clone, Copy)]
pub struct Tracked {
    pub camera_from_world: Se3<Camera, World>,
    pub information: PoseInformation,
    /// Landmarks that were found and agree.
    pub landmarks: usize,
    pub sought: usize,
    /// The same of those that should look as they did.
    pub alike: [usize; 2],
    /// Found by the narrow search around the prediction by flow.
    pub by_flow: bool,
}

impl Tracked {
    /// Of the landmarks looked for, the share that was found and agrees.
    pub fn share(&self) -> f64 {
        self.landmarks as f64 / self.sought.max(1) as f64
    }

    /// Enough where nothing else speaks for the pose: twice `min_landmarks`, a third of those looked for, and in a map that no frame of this run was tracked in
    /// 60 % of those that should look as they did.
    pub fn speaks_for_itself(&self, frame: &Frame<'_>) -> bool {
        let [found, sought] = self.alike;
        // Not of those alone that should look as they did: from a wrong place most are seen from aside.
        let min = frame.config.min_landmarks;
        let is_enough = self.landmarks >= 2 * min && self.share() >= SHARE_HERE;
        is_enough && (frame.was_here || found >= min && found as f64 >= SHARE_ANYWHERE * sought as f64)
    }
}

/// A pose to start a search from, and the keyframe whose surroundings are searched.
#[derive(Debug, Clone, Copy)]
pub struct Guess {
    pub camera_from_world: Se3<Camera, World>,
    pub reference: KeyframeId,
}

/// Buffers of tracking, kept between frames.
#[derive(Debug)]
pub struct Tracker {
    search: Search,
    pairs: Vec<Correspondence>,
    inlier: Vec<bool>,
    local: Vec<LandmarkId>,
    /// What `local` was made of.
    local_of: Option<(KeyframeId, u64)>,
    votes: Vec<(KeyframeId, u32)>,
    angles: Vec<f64>,
    maturity: MaturityGate,
    seeds: SeedRays,
    /// What the last frame that was accepted found of what it sought.
    share_before: f64,
}

/// Keyframes around the reference whose landmarks are looked for.
const LOCAL_KEYFRAMES: usize = 20;
/// Landmarks (counted once for each local keyframe) that there is room for at once.
const LOCAL_ROOM: usize = 16_384;
/// Of what should be in view, the share that must be found where nothing but that speaks for a pose: in the map that this run is in; and in any other,
/// of what should look as it did. The latter is also what a frame of a known place finds at the least when nothing is wrong with its prediction.
/// Places of one build share their edges: rooms of the same plan show up to 0.47 of each other, a corridor up to 0.43 of another stretch of it
/// (`tests/places`). A place itself shows 0.85 to 0.98 in the median, on another day too, but 0.35 to 0.5 where a hand has moved quickly on.
const SHARE_HERE: f64 = 1.0 / 3.0;
const SHARE_ANYWHERE: f64 = 0.6;
/// Bound tracks and seeds that a prediction by flow must rest on.
const MIN_FLOW: usize = 10;
/// A pose that so many landmarks or tracks agree with needs no competitors.
pub const PLENTY: usize = 30;
/// A search without a good prediction looks in this many times the usual radius.
const WIDE: f64 = 4.0;
/// A frame is taken to lie within so much of a turn beyond the expected one (rad), and within this share of the mean depth, of the
/// frame before: there no share of the landmarks looked for is asked.
const NEAR_RAD: f64 = 0.3;
const NEAR_DEPTHS: f64 = 0.3;

impl Default for Tracker {
    /// Room for what a large local map needs, so that a growing map does not allocate on the path of a pose.
    fn default() -> Self {
        Self {
            search: Search::default(),
            pairs: Vec::with_capacity(2048),
            inlier: Vec::with_capacity(2048),
            local: Vec::with_capacity(LOCAL_ROOM),
            local_of: None,
            votes: Vec::with_capacity(1024),
            angles: Vec::with_capacity(1024),
            maturity: MaturityGate::with_capacity(2048),
            seeds: SeedRays::with_capacity(2048),
            share_before: 0.0,
        }
    }
}

impl Tracker {
    /// Places a frame near a known pose. `guesses`: constant velocity, by the wheels, and the last pose at the end; what is not `believed` is as if it was not found.
    pub fn track(
        &mut self,
        frame: &Frame<'_>,
        reference: KeyframeId,
        guesses: &[Se3<Camera, World>],
        believed: impl Fn(&Self, &Tracked) -> bool,
    ) -> Option<Tracked> {
        self.refresh_local(frame.map, reference);
        let radius_px = frame.config.search_radius_px;
        self.seeds.collect(frame, guesses);
        let by_flow = guesses.iter().find_map(|guess| self.predict_by_flow(frame, guess));
        if let Some((pose, tracks)) = by_flow
            && let Some(tracked) = self.refine(frame, &pose, radius_px, 0)
        {
            let tracked = Tracked { by_flow: true, ..tracked };
            let is_doubtful =
                tracks < PLENTY && tracked.share() < SHARE_ANYWHERE && self.share_before >= SHARE_ANYWHERE;
            let tracked = match guesses.first().filter(|_| is_doubtful) {
                Some(guess) => self.refine_instead(frame, (&pose, tracked), guess, &believed),
                None => tracked,
            };
            if believed(self, &tracked) {
                return Some(tracked);
            }
        }
        by_flow.iter().map(|(pose, _)| pose).chain(guesses).find_map(|guess| {
            let tracked = self.refine(frame, guess, WIDE * radius_px, 3)?;
            believed(self, &tracked).then_some(tracked)
        })
    }

    /// What was found from a pose by flow, or from a guess if that finds more. Few tracks can agree on a wrong pose, from which a share of the landmarks is
    /// found all the same: where the map has long been known a frame has some ten tracks that are bound to landmarks. (In a mapped room ten of 18 agreed on
    /// a pose that was 6 degrees off: 81 of 220 landmarks from there, 211 from constant velocity.) It is doubted where the frame before found most of what
    /// it sought: in blur and quick turns constant velocity knows no better.
    fn refine_instead(
        &mut self,
        frame: &Frame<'_>,
        (pose, tracked): (&Se3<Camera, World>, Tracked),
        guess: &Se3<Camera, World>,
        believed: impl Fn(&Self, &Tracked) -> bool,
    ) -> Tracked {
        let radius_px = frame.config.search_radius_px;
        let other = self.refine(frame, guess, radius_px, 0);
        if let Some(other) = other.filter(|other| other.landmarks > tracked.landmarks && believed(self, other)) {
            return other;
        }
        // Callers read the matches of the last search: they must be those of the pose that is returned.
        let again = self.refine(frame, pose, radius_px, 0);
        again.map_or(tracked, |again| Tracked { by_flow: true, ..again })
    }

    /// Places a frame at a guess anywhere in the map; asks for more landmarks, as nothing else speaks for it but that it may lie near the
    /// frame before. `precise`: the
    /// guess is a pose solved from landmarks, not a neighbour's.
    pub fn relocalise(&mut self, frame: &Frame<'_>, guess: &Guess, precise: bool) -> Option<Tracked> {
        self.seeds.clear();
        self.refresh_local(frame.map, guess.reference);
        let (radius, coarse_levels) = if precise { (2.0, 1) } else { (WIDE, 3) };
        let placed =
            self.refine(frame, &guess.camera_from_world, radius * frame.config.search_radius_px, coarse_levels)?;
        (placed.speaks_for_itself(frame) || self.is_next(frame, &placed, frame.before)).then_some(placed)
    }

    /// Whether the frame that was just placed lies where the camera can have come to since one `before`, so many seconds ago, by twice the landmarks that a
    /// frame with a good prediction needs.
    pub fn is_next(&self, frame: &Frame<'_>, placed: &Tracked, before: Option<(Se3<Camera, World>, f64)>) -> bool {
        let pose = placed.camera_from_world;
        let expected = |dt: f64| frame.motion.map_or(0.0, |motion| motion.turn.norm() * dt);
        let is_near = |before: Se3<Camera, World>, dt| {
            is_near(&(pose * before.inverse()).relabel(), expected(dt), self.mean_depth(&pose))
        };
        placed.landmarks >= 2 * frame.config.min_landmarks && before.is_some_and(|(before, dt)| is_near(before, dt))
    }

    /// Mean depth of the landmarks found, map units.
    fn mean_depth(&self, pose: &Se3<Camera, World>) -> f64 {
        let (sum, n) = self.inliers().fold((0.0, 0.0), |(sum, n), m| (sum + pose.transform(&m.point).z, n + 1.0));
        sum / n
    }

    /// The keyframe that shares most landmarks with the frame just tracked (ties: the newer).
    pub fn best_reference(&mut self, map: &Map) -> Option<KeyframeId> {
        self.votes.clear();
        for m in self.search.matches.iter().filter(|m| m.inlier) {
            let Some(landmark) = map.landmark(m.landmark) else { continue };
            landmark.observers.iter().for_each(|k| vote(&mut self.votes, *k));
        }
        self.votes.iter().max_by_key(|&&(k, n)| (n, k)).map(|v| v.0)
    }

    /// What was found of the landmarks looked for; after [`keep_inliers`](Self::keep_inliers) all of it agrees with the pose.
    pub fn matches(&self) -> &[Match] {
        &self.search.matches
    }

    /// Landmarks that were looked for and not found.
    pub fn missed(&self) -> &[LandmarkId] {
        &self.search.missed
    }

    /// Forgets what does not agree with the pose.
    pub fn keep_inliers(&mut self) {
        self.search.matches.retain(|m| m.inlier);
    }

    /// Median angle between the rays to the frame's landmarks from here and from where each was seen before, degrees; of those of which `there` says that.
    pub fn median_parallax_deg(&mut self, here: &Vector3<f64>, there: impl Fn(&Match) -> Option<Vector3<f64>>) -> f64 {
        let parallax = |m: &Match| there(m).map(|there| (m.point - here).angle(&(m.point - there)));
        self.angles.clear();
        self.angles.extend(self.search.matches.iter().filter_map(parallax));
        median(&mut self.angles).unwrap_or(0.0).to_degrees()
    }

    /// Inlier matches of the last tracked frame.
    pub fn inliers(&self) -> impl Iterator<Item = &Match> + Clone {
        self.search.matches.iter().filter(|m| m.inlier)
    }

    fn refresh_local(&mut self, map: &Map, reference: KeyframeId) {
        if self.local_of == Some((reference, map.revision)) {
            return;
        }
        self.local_of = Some((reference, map.revision));
        self.local.clear();
        map.covisible(reference, 5, LOCAL_KEYFRAMES, &mut self.votes);
        self.votes.push((reference, 0));
        for &(id, _) in &self.votes {
            if let Some(k) = map.keyframe(id) {
                self.local.extend(k.observations.landmarks());
            }
        }
        self.local.sort_unstable();
        self.local.dedup();
    }

    /// Pose from the tracks that are bound to landmarks, and in a quick turn from seeds beside them, and how many of the tracks agree; `None` if too
    /// little does.
    fn predict_by_flow(
        &mut self,
        frame: &Frame<'_>,
        guess: &Se3<Camera, World>,
    ) -> Option<(Se3<Camera, World>, usize)> {
        let Frame { map, bindings, features, camera, .. } = *frame;
        self.pairs.clear();
        for track in &features.tracks {
            let Some(Target::Landmark(id)) = bindings.get(track.id) else { continue };
            let Some(landmark) = map.landmark(*id) else { continue };
            let Some(normalised) = camera.undistort(&track.position.cast()) else { continue };
            let pixel_scale = camera.pixel_scale(&normalised);
            self.pairs.push(Correspondence::new(landmark.position, normalised, pixel_scale, 1.0 / TRACK_SIGMA_PX));
        }
        let tracks = self.pairs.len();
        self.seeds.append_pairs(guess, frame.motion.as_ref(), frame.shutter, &mut self.pairs);
        // Seeds alone would rest on a distance that nobody knows.
        if tracks == 0 || self.pairs.len() < MIN_FLOW {
            return None;
        }
        let solution = optimise_pose(guess, &self.pairs, &PoseOptions::from_poor_start(), &mut self.inlier)?;
        let agree = self.inlier.iter().take(tracks).filter(|agrees| **agrees).count();
        let is_enough = solution.inliers >= MIN_FLOW && 2 * solution.inliers >= self.pairs.len();
        is_enough.then_some((solution.camera_from_world, agree))
    }

    /// What the last frame saw lies elsewhere in the map now, and so does the frame.
    pub(super) fn look_up(&mut self, map: &Map, pose: &Se3<Camera, World>) {
        for m in &mut self.search.matches {
            m.point = map.landmark(m.landmark).map_or(m.point, |landmark| landmark.position);
        }
        self.seeds.note_distance(&self.search.matches, &pose.inverse().translation);
    }

    /// The map's lengths are `factor` times as long from now on.
    pub(super) fn rescale(&mut self, factor: f64) {
        self.search.matches.iter_mut().for_each(|m| m.point *= factor);
        self.seeds.rescale(factor);
    }

    /// The map has moved so around the last frame.
    pub(super) fn carry(&mut self, motion: &Sim3<World, World>) {
        self.search.matches.iter_mut().for_each(|m| m.point = motion.transform(&m.point));
        self.seeds.rescale(motion.scale);
    }

    /// Notes of the frame that was accepted how far away is what it has seen, and how much it has found.
    pub(super) fn note_accepted(&mut self, tracked: &Tracked) {
        self.seeds.note_distance(&self.search.matches, &tracked.camera_from_world.inverse().translation);
        self.share_before = tracked.share();
    }

    /// Search at `guess` and optimise; a second search at the result when the first had to look widely.
    fn refine(
        &mut self,
        frame: &Frame<'_>,
        guess: &Se3<Camera, World>,
        radius_px: f64,
        coarse_levels: usize,
    ) -> Option<Tracked> {
        let Frame { map, features, camera, config, .. } = *frame;
        let mut options = SearchOptions { radius_px, coarse_levels, sigma_px: config.sigma_px, blurred_levels: 0 };
        self.search.select(map, &self.local, camera, guess, config.landmarks_per_frame);
        self.search.align(map, camera, guess, &features.pyramid, &options);
        let mut solution = self.solve(frame, guess, frame.motion.as_ref())?;
        if coarse_levels > 0 {
            options.coarse_levels = 0;
            options.radius_px = config.search_radius_px;
            self.search.select(map, &self.local, camera, &solution.camera_from_world, config.landmarks_per_frame);
            self.search.align(map, camera, &solution.camera_from_world, &features.pyramid, &options);
            solution = self.solve(frame, &solution.camera_from_world, frame.motion.as_ref())?;
        }
        let motion = motion_since(frame, &solution.camera_from_world);
        if motion.is_some() && !frame.shutter.is_off() {
            // The motion that the shutter saw is known only now. (Without: errors 17 % larger over 35 sequences.)
            solution = self.solve(frame, &solution.camera_from_world, motion.as_ref())?;
        }
        solution = self.include_immature(frame, solution);
        let landmarks = self.search.matches.iter().filter(|m| m.inlier).count();
        let sought = self.search.matches.len() + self.search.missed.len();
        let found_alike = self.inliers().filter(|m| m.is_alike).count();
        let sought_alike = self.search.matches.iter().filter(|m| m.is_alike).count() + self.search.missed_alike;
        if landmarks < config.min_landmarks {
            return None;
        }
        let pose = solution.camera_from_world;
        Some(Tracked {
            camera_from_world: pose,
            information: PoseInformation::of(frame, self.inliers(), &pose),
            landmarks,
            sought,
            alike: [found_alike, sought_alike],
            by_flow: false,
        })
    }

    /// Motion-only optimisation over the matches. They are
    /// corrected for a rolling shutter that moved as `motion` says.
    fn solve(
        &mut self,
        frame: &Frame<'_>,
        start: &Se3<Camera, World>,
        motion: Option<&CameraMotion>,
    ) -> Option<PoseSolution> {
        let Frame { camera, shutter, .. } = *frame;
        self.pairs.clear();
        for m in &mut self.search.matches {
            let p = start.transform(&m.point);
            m.displacement = shutter.displacement(motion, &p, m.pixel.y);
            let pair = m.pair(camera, shutter.readout_s);
            self.pairs.push(measurement_of(frame, m.landmark, start, pair));
        }
        let options = PoseOptions::judged_by(frame.outlier_chi2);
        let on_rays = self.pairs.iter().filter(|pair| pair.ray.is_some()).count();
        let start = if mostly_assumed(on_rays, self.search.matches.len()) {
            lowest_minimum(start, &self.pairs, &options, &mut self.inlier)
        } else {
            *start
        };
        self.seeds.append_pairs(&start, motion, shutter, &mut self.pairs);
        let solution = optimise_pose(&start, &self.pairs, &options, &mut self.inlier)?;
        // Seeds come after the matches.
        for (m, &ok) in self.search.matches.iter_mut().zip(&self.inlier) {
            m.inlier = ok;
        }
        Some(solution)
    }

    /// The last solution with those immature landmarks only that agree with the mature ones.
    fn include_immature(&mut self, frame: &Frame<'_>, solution: PoseSolution) -> PoseSolution {
        let matches = &self.search.matches;
        let enough = mature_after(frame.before.map(|(_, step_s)| step_s));
        // Nothing vouches for seeds, which come after the matches.
        let mature =
            |i: usize| matches.get(i).and_then(|m| frame.map.landmark(m.landmark)).is_some_and(|l| l.found >= enough);
        let options = PoseOptions::judged_by(frame.outlier_chi2);
        let judged = self.maturity.judge(&self.pairs, mature, &solution, &options, &mut self.inlier);
        for (m, &ok) in self.search.matches.iter_mut().zip(&self.inlier) {
            m.inlier = ok;
        }
        judged.unwrap_or(solution)
    }
}

/// Whether the camera can have made this step (it was expected to turn by `expected_rad`) among landmarks at this mean depth.
fn is_near(step: &Se3<Camera, Camera>, expected_rad: f64, depth: f64) -> bool {
    step.rotation.angle() < NEAR_RAD + expected_rad && step.translation.norm() < NEAR_DEPTHS * depth
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::*;

    #[test]
    fn a_step_is_near_by_what_was_expected_and_how_far_the_scene_is() {
        let step =
            |turn: f64, way: f64| Se3::new(UnitQuaternion::from_scaled_axis(Vector3::y() * turn), Vector3::x() * way);
        assert!(is_near(&step(0.2, 0.2), 0.0, 1.0));
        assert!(!is_near(&step(0.5, 0.2), 0.0, 1.0) && is_near(&step(0.5, 0.2), 0.3, 1.0), "a turn that was expected");
        assert!(!is_near(&step(0.2, 0.4), 0.0, 1.0) && is_near(&step(0.2, 0.4), 0.0, 2.0), "a far scene");
        assert!(!is_near(&step(0.2, 0.2), 0.0, f64::NAN), "nothing seen");
    }
}
