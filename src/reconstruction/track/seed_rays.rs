//! What tracks without depth tell of a frame's pose.
//!
//! In a quick turn the landmarks leave the picture on one side, and what comes in on the other has no depth yet. A pose that rests
//! on the last landmarks alone, all at one edge, takes a turn for a sidestep, by a degree a frame; then the rays of what has come into view
//! do not meet, nothing becomes a landmark, and the next frame rests on still less. Yet each of these tracks was seen in a keyframe, and
//! across its epipolar line it counts as much as a landmark does: its distance is eliminated
//! (`measurement::inverse_distance`), with the median distance of the landmarks seen last as the assumption.
//!
//! Input: the frame's tracks that are seeds. Output: pairs for the optimisation of its pose. They are no landmarks: a pose that is
//! published rests on enough of these. Cost: some 0.5 us a seed and solution, only in a quick turn. Allocates
//! nothing once warm. Not here: distances; two keyframes triangulate.
//!
//! Their distances are eliminated once a solution, where it starts. (Anew at each pose compared, as those of landmarks are, errors over 21 recordings of one
//! flight are 16 % larger: with little else the weights follow the pose astray.)
//!
//! Kept by ablation (as `maturity`): without it errors are 11 % larger in the geometric mean, that of one walk at 5 Hz fifteen times;
//! beside few landmarks only (below 60 matches) 13 % larger, two of 17 walks lost.

use nalgebra::{Vector2, Vector3};

use super::association::{Seed, TRACK_SIGMA_PX, Target};
use super::frame::{Frame, QUICK_TURN_RAD};
use super::search::Match;
use super::template::observe;
use crate::geometry::Se3;
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::frames::{Camera, World};
use crate::map::{LandmarkId, Observation};
use crate::reconstruction::measurement::inverse_distance::Ray;
use crate::reconstruction::measurement::rolling_shutter::Shutter;
use crate::reconstruction::measurement::{Correspondence, middle_distance};

/// A seed that the frame sees.
#[derive(Debug, Clone, Copy)]
struct SeedRay {
    ray: Ray,
    row_px: f32,
    /// Not corrected for a rolling shutter; its point is where the ray's assumed distance puts it.
    pair: Correspondence,
}

/// The seeds that a frame sees, and the distance to assume for them.
#[derive(Debug)]
pub struct SeedRays {
    list: Vec<SeedRay>,
    distances: Vec<f64>,
    /// Median distance of the landmarks that the last tracked frame saw, map units.
    distance: Option<f64>,
}

impl SeedRays {
    /// Room for `n` of them.
    pub fn with_capacity(n: usize) -> Self {
        Self { list: Vec::with_capacity(n), distances: Vec::with_capacity(n), distance: None }
    }

    /// The map's lengths are `factor` times as long from now on.
    pub fn rescale(&mut self, factor: f64) {
        self.distance = self.distance.map(|distance| distance * factor);
    }

    /// None for this frame.
    pub fn clear(&mut self) {
        self.list.clear();
    }

    /// Takes the seeds among the frame's tracks, if the way from the pose before it (the last guess) to the one expected for it is a quick turn.
    pub fn collect(&mut self, frame: &Frame<'_>, expected: &[Se3<Camera, World>]) {
        self.list.clear();
        let quick = matches!(expected, [next, .., last] if next.rotation.angle_to(&last.rotation) > QUICK_TURN_RAD);
        let Some(distance) = self.distance.filter(|_| quick) else { return };
        for track in &frame.features.tracks {
            if let Some(Target::Seed(seed)) = frame.bindings.get(track.id) {
                self.list.extend(seed_ray(frame, seed, track.position, distance));
            }
        }
    }

    /// Their pairs near `pose`, for a camera that moves as `motion` says.
    pub fn append_pairs(
        &self,
        pose: &Se3<Camera, World>,
        motion: Option<&CameraMotion>,
        shutter: &Shutter,
        pairs: &mut Vec<Correspondence>,
    ) {
        pairs.extend(self.list.iter().filter_map(|seed| {
            let p = pose.transform(&seed.pair.point);
            let displacement = shutter.displacement(motion, &p, seed.row_px);
            let normalised = seed.pair.normalised - displacement * shutter.readout_s;
            seed.ray.eliminate(pose, &Correspondence { normalised, ..seed.pair })
        }));
    }

    /// Notes how far away is what a frame at `centre` has seen.
    pub fn note_distance(&mut self, matches: &[Match], centre: &Vector3<f64>) {
        self.distances.clear();
        self.distances.extend(matches.iter().filter(|m| m.inlier).map(|m| (m.point - centre).norm()));
        if !self.distances.is_empty() {
            self.distance = middle_distance(&mut self.distances);
        }
    }
}

fn seed_ray(frame: &Frame<'_>, seed: &Seed, position: Vector2<f32>, distance: f64) -> Option<SeedRay> {
    let Frame { map, camera, shutter, .. } = *frame;
    let (anchor, pixel) = seed.observations().iter().find_map(|(k, pixel)| Some((map.keyframe(*k)?, *pixel)))?;
    let seen = observe(camera, LandmarkId::default(), pixel, 1.0)?;
    let displacement = shutter.displacement(anchor.motion.as_ref(), &(seen.normalised.push(1.0) * distance), pixel.y);
    let seen = Observation { displacement, ..seen };
    let ray = Ray::at_distance(&anchor.camera_from_world, &seen, shutter.readout_s, distance);
    let normalised = camera.undistort(&position.cast())?;
    let pixel_scale = camera.pixel_scale(&normalised);
    let pair = Correspondence::new(ray.point(), normalised, pixel_scale, 1.0 / TRACK_SIGMA_PX);
    Some(SeedRay { ray, row_px: position.y, pair })
}
