//! What the mapping worker does: bundle adjustments, now and then a pose graph ([`LoopClosure`]), and longer work by others in
//! pieces ([`Piece`]).
//!
//! Local bundle adjustment as a job: built from a part of the map, run anywhere, merged later.
//!
//! The newest keyframe and its strongest covisible ones move, other observers of their landmarks hold them in place
//! (Mur-Artal et al. 2015, section VI-D). What the map gained while the job ran is carried along by the motion of the
//! newest adjusted keyframe.

mod held;

use std::any::Any;
use std::collections::BTreeMap;

use nalgebra::{SVector, Vector2, Vector3};

use super::bundle::{
    BundleObservation, BundleOptions, BundleProblem, Globals, INTRINSICS, IntrinsicsJacobian, IntrinsicsVector, READOUT,
};
use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::map::{Correction, KeyframeId, LandmarkId, Map, MapId, Observation, vote};
use crate::places::loops::LoopClosure;
use crate::reconstruction::config::ReconstructionConfig;
use crate::reconstruction::keyframe::distance_prior;
use crate::reconstruction::measurement::rolling_shutter::Shutter;
use crate::reconstruction::work::Work;

/// Mapping work on a copy of a part of the map.
#[derive(Debug)]
pub enum MappingJob {
    Adjust(Box<Adjustment>),
    CloseLoop(Box<LoopClosure>),
    Piece(Box<dyn Piece>),
}

impl Work for MappingJob {
    type Outcome = MappingResult;

    fn run(self) -> MappingResult {
        match self {
            Self::Adjust(job) => MappingResult::Adjusted(Box::new(job.run())),
            Self::CloseLoop(job) => MappingResult::ClosedLoop(job.run()),
            Self::Piece(mut piece) => {
                piece.step();
                MappingResult::Piece(piece)
            }
        }
    }
}

/// Work that takes longer than an adjustment may wait: it goes to the worker and back with each step, and who has
/// posted it knows what it is.
pub trait Piece: Any + std::fmt::Debug + Send {
    /// Bounded.
    fn step(&mut self);
    /// No step is left.
    fn is_done(&self) -> bool;
}

/// What a [`MappingJob`] gives back.
#[derive(Debug)]
pub enum MappingResult {
    Adjusted(Box<AdjustmentResult>),
    /// `None`: it could not be closed.
    ClosedLoop(Option<Correction>),
    /// One step further.
    Piece(Box<dyn Piece>),
}

/// A bundle adjustment of a part of the map.
#[derive(Debug)]
pub struct Adjustment {
    problem: BundleProblem,
    options: BundleOptions,
    keyframes: Vec<KeyframeId>,
    landmarks: Vec<LandmarkId>,
    /// Its motion carries along what was added after the job was built.
    newest: usize,
    before: Se3<Camera, World>,
    next_keyframe: u32,
    next_landmark: u32,
}

/// What an [`Adjustment`] gives back.
#[derive(Debug)]
pub struct AdjustmentResult {
    job: Adjustment,
    /// Robust standard deviation of what it leaves of places in the pictures, in supposed ones; `None` where it has too few to tell.
    pub noise: Option<f64>,
}

/// What an adjustment found of the intrinsics.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundIntrinsics {
    /// Against those that the observations were made with.
    pub change: IntrinsicsVector,
    /// Which were held.
    pub held: SVector<bool, INTRINSICS>,
    /// Variances of the others, everything else free, the priors in them; `None` where they cannot be told.
    pub variance: Option<IntrinsicsVector>,
}

/// Share of the cost by which a step has to lower it of a global adjustment: errors that span the map hardly show in one residual.
const GLOBAL_GAIN: f64 = 1e-5;
/// Keyframes at which a map is first adjusted globally; then whenever it has grown by a third, up to the limit.
pub const GLOBAL_FIRST: usize = 5;

impl Adjustment {
    /// The local problem around `newest`; `None` if it has nothing to move.
    pub fn local(
        map: &Map,
        newest: KeyframeId,
        camera: &CameraModel,
        shutter: &Shutter,
        config: &ReconstructionConfig,
    ) -> Option<Self> {
        let mut around = Vec::new();
        map.covisible(newest, 10, config.adjusted_keyframes.saturating_sub(1), &mut around);
        let mut free: Vec<KeyframeId> = around.iter().map(|c| c.0).chain([newest]).collect();
        free.sort_unstable();
        let mut landmarks: Vec<LandmarkId> = Vec::new();
        for &id in &free {
            landmarks.extend(map.keyframe(id)?.observations.landmarks());
        }
        landmarks.sort_unstable();
        landmarks.dedup();
        let mut votes: Vec<(KeyframeId, u32)> = Vec::new();
        for &id in &landmarks {
            let outside = map.landmark(id)?.observers.iter().filter(|k| free.binary_search(k).is_err());
            outside.for_each(|k| vote(&mut votes, *k));
        }
        votes.sort_by(|a, b| b.1.cmp(&a.1).then(b.0.cmp(&a.0)));
        votes.truncate(config.fixed_keyframes);
        let mut keyframes: Vec<(KeyframeId, bool)> =
            free.iter().map(|&k| (k, false)).chain(votes.iter().map(|v| (v.0, true))).collect();
        keyframes.sort_unstable();
        if votes.is_empty() {
            // Nobody outside holds the problem.
            hold_oldest(map, &mut keyframes)?;
        }
        let options = BundleOptions { steps: config.adjustment_steps, ..BundleOptions::default() };
        Self::build(map, &keyframes, landmarks, newest, camera, shutter, options)
    }

    /// Global bundle adjustment: the whole map, its first keyframe held (of maps that became one: the first of that which has most).
    pub fn global(map: &Map, camera: &CameraModel, shutter: &Shutter, steps: usize) -> Option<Self> {
        let mut keyframes: Vec<(KeyframeId, bool)> =
            map.keyframes.iter().map(|(id, _)| (KeyframeId(id), false)).collect();
        let newest = map.newest()?;
        hold_oldest(map, &mut keyframes)?;
        let landmarks = map.landmarks.iter().map(|(id, _)| LandmarkId(id)).collect();
        let options = BundleOptions { steps, relative_gain: GLOBAL_GAIN, ..BundleOptions::default() };
        Self::build(map, &keyframes, landmarks, newest, camera, shutter, options)
    }

    fn build(
        map: &Map,
        keyframes: &[(KeyframeId, bool)],
        mut landmarks: Vec<LandmarkId>,
        newest: KeyframeId,
        camera: &CameraModel,
        shutter: &Shutter,
        options: BundleOptions,
    ) -> Option<Self> {
        let mut globals = Globals::default();
        (globals.expected[READOUT], globals.information[READOUT]) = shutter.prior();
        let mut problem = BundleProblem { first: vec![0], ..BundleProblem::default() };
        problem.state.globals = globals.expected;
        problem.globals = globals;
        for &(id, fixed) in keyframes {
            problem.fixed.push(fixed || distance_prior::is_held(map, id));
            problem.state.poses.push(map.keyframe(id)?.camera_from_world);
        }
        // Room for all at once: of a whole map this is most of what an adjustment takes.
        let observers = |id: &LandmarkId| map.landmark(*id).map_or(0, |l| l.observers.len());
        problem.observations.reserve_exact(landmarks.iter().map(observers).sum());
        landmarks.retain(|&id| {
            let Some(landmark) = map.landmark(id).filter(|l| l.assumed.is_none()) else { return false };
            let begin = problem.observations.len();
            for &k in &landmark.observers {
                let Ok(index) = keyframes.binary_search_by_key(&k, |k| k.0) else { continue };
                let Some(o) = map.keyframe(k).and_then(|k| k.observation(id)) else { continue };
                problem.observations.push(seen_by(index, &o, camera));
            }
            if problem.observations.len() < begin + 2 {
                problem.observations.truncate(begin);
                return false;
            }
            problem.state.points.push(landmark.position);
            problem.first.push(problem.observations.len() as u32);
            true
        });
        let index = keyframes.binary_search_by_key(&newest, |k| k.0).ok()?;
        Some(Self {
            before: problem.state.poses[index],
            problem,
            options,
            keyframes: keyframes.iter().map(|k| k.0).collect(),
            landmarks,
            newest: index,
            next_keyframe: map.keyframes.next_id(),
            next_landmark: map.landmarks.next_id(),
        })
    }

    /// Lets the adjustment refine the intrinsics as well: by how much they are expected to change, and one over the variance of that
    /// (infinite: held).
    pub fn refine_intrinsics(
        &mut self,
        map: &Map,
        camera: &CameraModel,
        expected: &IntrinsicsVector,
        information: &IntrinsicsVector,
    ) {
        let mut jacobians = Vec::with_capacity(self.problem.observations.len());
        for (i, &id) in self.landmarks.iter().enumerate() {
            for k in self.problem.range(i) {
                let keyframe = self.keyframes[self.problem.observations[k].camera as usize];
                let o = map.keyframe(keyframe).and_then(|k| k.observation(id));
                jacobians.push(o.map_or_else(IntrinsicsJacobian::zeros, |o| intrinsics_jacobian(&o, camera)));
            }
        }
        let globals = &mut self.problem.globals;
        globals.expected.fixed_rows_mut::<INTRINSICS>(1).copy_from(expected);
        globals.information.fixed_rows_mut::<INTRINSICS>(1).copy_from(information);
        globals.jacobians = jacobians;
    }

    /// With this limit of squared residuals, in supposed standard deviations; `is_lens_known`: no guess.
    pub fn judged_by(mut self, outlier_chi2: f64, is_lens_known: bool) -> Self {
        (self.options.outlier_chi2, self.options.is_lens_known) = (outlier_chi2, is_lens_known);
        self
    }

    /// Bounded in iterations, not in time.
    pub fn run(mut self) -> AdjustmentResult {
        self.problem.adjust(&self.options);
        AdjustmentResult { noise: self.problem.noise(), job: self }
    }
}

/// Holds the oldest keyframe of the map that most of them were made in, and that no command has brought: what was joined to it follows.
fn hold_oldest(map: &Map, keyframes: &mut [(KeyframeId, bool)]) -> Option<()> {
    let made_in = |id: KeyframeId| map.keyframe(id).filter(|_| !map.numbers.is_merged(id)).map(|k| k.map);
    let mut counts: BTreeMap<MapId, usize> = BTreeMap::new();
    for made_in in keyframes.iter().filter_map(|(id, _)| made_in(*id)) {
        *counts.entry(made_in).or_default() += 1;
    }
    let (most, _) = counts.into_iter().max_by_key(|(map, count)| (*count, std::cmp::Reverse(*map)))?;
    keyframes.iter_mut().find(|(id, _)| made_in(*id) == Some(most))?.1 = true;
    Some(())
}

/// What the camera of this index saw, for an adjustment.
fn seen_by(index: usize, o: &Observation, camera: &CameraModel) -> BundleObservation {
    BundleObservation {
        camera: index as u32,
        normalised: o.normalised,
        displacement: o.displacement,
        sqrt_information: camera.pixel_scale(&o.normalised) * o.inv_sigma_px,
    }
}

/// How an observation's undistorted place answers to log focal length, principal point (px) (of any lens) and k1 k2 p1 p2: by
/// Brown's model the distorted place moves by `n |n|²`, `n |n|⁴`, and the tangential terms.
fn intrinsics_jacobian(o: &Observation, camera: &CameraModel) -> IntrinsicsJacobian {
    let j = &o.normalised_from_pixel;
    let from_centre = Vector2::new(f64::from(o.pixel.x) - camera.cx, f64::from(o.pixel.y) - camera.cy);
    let n = &o.normalised;
    let px = |x: f64, y: f64| Vector2::new(camera.fx * x, camera.fy * y);
    let (s, xy) = (n.norm_squared(), n.x * n.y);
    IntrinsicsJacobian::from_columns(&[
        -(j * from_centre),
        -j.column(0).into_owned(),
        -j.column(1).into_owned(),
        -(j * px(n.x * s, n.y * s)),
        -(j * px(n.x * s * s, n.y * s * s)),
        -(j * px(2.0 * xy, s + 2.0 * n.y * n.y)),
        -(j * px(s + 2.0 * n.x * n.x, 2.0 * xy)),
    ])
}

impl AdjustmentResult {
    /// The readout time that the adjustment ended with (s), and its variance (s^2; NaN where it is not told), the prior in it.
    pub fn readout(&self) -> (f64, f64) {
        let problem = &self.job.problem;
        (problem.state.globals[READOUT], problem.global_covariance.map_or(f64::NAN, |c| c[(READOUT, READOUT)]))
    }

    /// What it found of the intrinsics; `None` if they were none of its unknowns.
    pub fn intrinsics(&self) -> Option<FoundIntrinsics> {
        let problem = &self.job.problem;
        let Globals { information, jacobians, .. } = &problem.globals;
        (!jacobians.is_empty()).then(|| FoundIntrinsics {
            change: problem.state.globals.fixed_rows::<INTRINSICS>(1).into_owned(),
            held: information.fixed_rows::<INTRINSICS>(1).map(f64::is_infinite),
            variance: problem.global_covariance.map(|c| c.diagonal().fixed_rows::<INTRINSICS>(1).into_owned()),
        })
    }

    /// Writes the result into the map. Returns `old_from_new`: how the newest adjusted keyframe's surroundings moved, to be
    /// multiplied to the right of a `camera_from_world` that was estimated meanwhile.
    pub fn merge(&self, map: &mut Map) -> Se3<World, World> {
        let job = &self.job;
        let BundleProblem { state, fixed, .. } = &job.problem;
        let after = state.poses[job.newest];
        let old_from_new: Se3<World, World> = job.before.inverse() * after;
        for (&id, (pose, fixed)) in job.keyframes.iter().zip(state.poses.iter().zip(fixed)) {
            if !fixed && pose.is_finite() {
                map.place_keyframe(id, *pose);
            }
        }
        let mut outliers = Vec::new();
        for (i, &id) in job.landmarks.iter().enumerate() {
            let point: Vector3<f64> = state.points[i];
            if !point.iter().all(|v| v.is_finite()) {
                continue;
            }
            map.measure_landmark(id, point, job.problem.point_covariances[i]);
            for k in job.problem.range(i) {
                if !job.problem.inlier[k] {
                    outliers.push((job.keyframes[job.problem.observations[k].camera as usize], id));
                }
            }
        }
        map.carry_newer(job.next_keyframe, job.next_landmark, &old_from_new);
        for (keyframe, landmark) in outliers {
            map.remove_observation(keyframe, landmark);
        }
        map.revision += 1;
        old_from_new
    }

    /// How surely the newest camera is placed against the oldest one: standard deviation of the direction of its translation
    /// (rad), once the length of that translation is taken as the unit; infinite where it cannot be told.
    pub fn direction_sigma(&self) -> f64 {
        self.job.problem.direction_sigma(self.job.newest).unwrap_or(f64::INFINITY)
    }

    /// Landmarks of the job with at least two inlier observations.
    pub fn supported_landmarks(&self) -> usize {
        let problem = &self.job.problem;
        (0..problem.state.points.len()).filter(|i| problem.inliers(*i).count() >= 2).count()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intrinsics_jacobian_agrees_with_numeric_differences() {
        let lens = [0.1, -0.2, 0.001, -0.002, 0.05];
        let own = [540.0, 530.0, 322.0, 238.0];
        // Log focal length, principal point, k1 k2 p1 p2.
        let camera = |change: &IntrinsicsVector| {
            let mut lens = lens;
            lens.iter_mut().zip(change.iter().skip(3)).for_each(|(l, c)| *l += c);
            let (s, [fx, fy, cx, cy]) = (change[0].exp(), own);
            CameraModel::new(640, 480, fx * s, fy * s, cx + change[1], cy + change[2], lens).expect("a camera")
        };
        let present = camera(&IntrinsicsVector::zeros());
        for (x, y) in [(40.0, 60.0), (600.0, 100.0), (330.0, 240.0), (200.0, 430.0)] {
            let pixel = Vector2::new(x, y);
            let (normalised, normalised_from_pixel) = present.undistort_jacobian(&pixel).expect("in the picture");
            let seen = Observation {
                landmark: LandmarkId(0),
                pixel: pixel.cast(),
                normalised,
                displacement: Vector2::zeros(),
                inv_sigma_px: 1.0,
                normalised_from_pixel,
            };
            let jacobian = intrinsics_jacobian(&seen, &present);
            for i in 0..INTRINSICS {
                let h = if i == 1 || i == 2 { 0.1 } else { 1e-3 };
                let at = |sign: f64| {
                    let mut change = IntrinsicsVector::zeros();
                    change[i] = sign * h;
                    camera(&change).undistort(&pixel).expect("in the picture")
                };
                let numeric = (at(1.0) - at(-1.0)) / (2.0 * h);
                let off = (numeric - jacobian.column(i)).norm();
                assert!(off < 1e-5 * (1.0 + numeric.norm()), "({x}, {y}), parameter {i}: {off} beside {numeric}");
            }
        }
    }
}
