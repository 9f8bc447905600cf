//! The first motion after a turn on the spot.
//!
//! When most of what is in view lies at assumed distances, the frames that follow the turn move against a scene whose shape is not
//! known, as at the start of a map, and a pose optimised frame by frame runs into the nearest shape that is flat. So they are placed
//! as at the start: two-view geometry ([`two_view`](crate::geometry::two_view)) between a keyframe of the turn and the newest frame, as soon as that
//! finds enough parallax. The length of the step is what the landmarks of known distance make of it, if a few are left in view, else the
//! wheels' way where the map is metric by them, else what the assumed distances make of it; everything else is measured. Where two motions explain what is
//! seen, as a plane allows, the one is taken that leads where the wheels have gone; without these, and for as long as the way is straight, where the camera
//! went before the turn: a robot drives on as it drove.
//!
//! Input: the newest frame's matches. Output: its pose; the distances assumed are from then on those that the two views have told, and the keyframes in
//! between are solved anew. Cost: a few milliseconds, once after each turn (and at each attempt before).

use std::f64::consts::SQRT_2;

use nalgebra::{Unit, Vector2, Vector3};

use super::distance_prior::{is_blind, is_held};
use crate::features::FrameFeatures;
use crate::geometry::frames::{Camera, World};
use crate::geometry::two_view::{TwoViewFailure, TwoViewOptions, TwoViewReconstruction, reconstruct_two_views};
use crate::geometry::{CameraModel, Se3, median};
use crate::map::{AssumedDistance, Keyframe, KeyframeId, LandmarkId, Map, vote};
use crate::motion::scale::ScaleFusion;
use crate::reconstruction::Reconstruction;
use crate::reconstruction::dead_reckoning::{Ahead, Metre};
use crate::reconstruction::measurement::inverse_distance::{Ray, SIGMA_SHARE};
use crate::reconstruction::measurement::{Correspondence, TWO_VIEW_SIGMA_PX};
use crate::reconstruction::segments::Wheels;
use crate::reconstruction::track::pose::{PoseOptions, optimise_pose};
use crate::reconstruction::track::search::Match;

/// Matches with the keyframe of the turn, and points that both see under enough parallax, that two views need.
const MIN_MATCHES: usize = 40;
const MIN_POINTS: usize = 30;
const MIN_PARALLAX_DEG: f64 = 0.5;
/// Share of the most landmarks in common that the keyframe of the turn must have.
const NEARLY_ALL: f64 = 0.7;
/// Steps from keyframe to keyframe before the turn that tell where the camera went, at the least and at the most, none of which turns by more than this
/// (rad); and the share of them that must lead there in the camera's axes: a hand goes now here, now there.
const STEPS: std::ops::RangeInclusive<usize> = 4..=10;
const STRAIGHT_RAD: f64 = 0.05;
const ONE_WAY: f64 = 0.97;
/// A motion leads there that is no further off than this, rad; of two that explain the matches the other must be twice as far off at the least.
const THERE_RAD: f64 = 0.15;
/// So many landmarks whose distance is known say how long the step was; else the assumed distances do.
const MIN_MEASURED: usize = 10;

impl Reconstruction {
    /// Landmarks at assumed distances are looked for next where this frame makes them most likely.
    pub(in crate::reconstruction) fn follow_assumed(&mut self, pose: &Se3<Camera, World>) {
        let readout_s = self.optics.shutter.readout_s;
        for m in self.tracker.matches() {
            let Some(ray) = Ray::of(m.landmark, &self.active.map, readout_s) else { continue };
            if let Some(pair) = ray.eliminate(pose, &m.pair(&self.optics.camera, readout_s)) {
                self.active.map.place_landmark(m.landmark, pair.point);
            }
        }
    }

    /// The pose of a frame that comes out of a turn on the spot, from its parallax.
    pub(in crate::reconstruction) fn place_after_turn(
        &mut self,
        features: &FrameFeatures,
    ) -> Option<Se3<Camera, World>> {
        self.pending.turned.filter(|parallax_deg| *parallax_deg > self.config.min_parallax_deg)?;
        let way = Way { wheels: &self.wheels, fusion: &self.active.fusion, to_ns: features.timestamp_ns };
        let placed = place(
            &mut self.active.map,
            self.tracker.matches(),
            &self.optics.camera,
            self.optics.shutter.readout_s,
            (features.sequence, &way),
        )?;
        let pose = placed.camera_from_world;
        if let Some(before) = self.active.odometry.pose() {
            self.corrections.moved(&before, &pose);
        }
        self.active.odometry.replace(pose);
        self.tracker.look_up(&self.active.map, &pose);
        self.contradiction.look_anew();
        // One under way began from poses that are no more; the keyframe that this frame becomes posts another.
        self.discard_job();
        self.pending.turned = None;
        self.counters.blind_turns += u64::from(placed.step == Step::Assumed);
        if placed.step != Step::Measured {
            self.doubt_scale_behind(placed.from, placed.step == Step::Assumed);
        }
        Some(pose)
    }

    /// What has been seen since the turn at `from` began has the scale that was assumed or that wheels told in a moment, but for keyframes that saw
    /// enough of known distance.
    fn doubt_scale_behind(&mut self, from: KeyframeId, assumed: bool) {
        let before = self.active.map.keyframe(from).and_then(|k| k.scale_from);
        let Some(turn) = self.active.scale.add(&self.active.map, from, before, assumed) else { return };
        let map = &self.active.map;
        let mut behind: Vec<KeyframeId> = map.keyframes.iter().map(|(id, _)| KeyframeId(id)).collect();
        // What another run did not know has nothing to do with this turn.
        behind.retain(|id| map.numbers.is_new(*id));
        let blind = |id: &KeyframeId| is_blind(&self.active.map, *id);
        let before_turn = behind.iter().rposition(|id| *id < from && !blind(id));
        behind.drain(..before_turn.map_or(0, |last| last + 1));
        behind.retain(|id| *id == from || blind(id));
        for id in behind {
            self.active.map.set_scale_origin(id, Some(turn));
        }
        // The keyframe that this frame becomes has its scale from its reference.
        if self.active.map.keyframe(self.active.reference).is_none_or(|k| k.scale_from != Some(turn)) {
            self.active.reference = from;
        }
    }
}

/// The way that the wheels know.
struct Way<'a> {
    wheels: &'a Wheels,
    fusion: &'a ScaleFusion,
    /// Time of the newest frame, ns.
    to_ns: i64,
}

impl Way<'_> {
    /// From the frame of a time to the newest, map units.
    fn since(&self, from_ns: i64) -> Option<f64> {
        self.wheels.length(self.fusion, from_ns, self.to_ns).map(|(length, _)| length)
    }

    /// Where the camera has gone since the frame of a time, in its axes now; `None` where the wheels do not know it.
    fn heading_since(&self, from_ns: i64) -> Option<Unit<Vector3<f64>>> {
        let metre = Metre { units: 1.0, sigma: 0.0 };
        let driven = Ahead::of(&self.wheels.scale, (from_ns, self.to_ns), metre)?;
        let way = -driven.now_from_last.translation;
        Unit::try_new(way, driven.sigma().0 / THERE_RAD)
    }
}

/// Where two views have put a frame.
struct Placed {
    camera_from_world: Se3<Camera, World>,
    /// The first of the two views.
    from: KeyframeId,
    step: Step,
}

/// What makes the step behind a turn as long as it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    /// Landmarks of known distance.
    Measured,
    Wheels,
    /// Assumed distances.
    Assumed,
}

/// The newest frame's place from its `matches`; `None` if there is no such keyframe, or not enough parallax yet.
fn place(
    map: &mut Map,
    matches: &[Match],
    camera: &CameraModel,
    readout_s: f64,
    (seed, way): (u64, &Way<'_>),
) -> Option<Placed> {
    // The oldest keyframe that sees nearly as many of them as any: it was placed before the camera began to move.
    let mut votes: Vec<(KeyframeId, u32)> = Vec::new();
    for m in matches {
        let Some(landmark) = map.landmark(m.landmark).filter(|l| l.assumed.is_some()) else { continue };
        let own = landmark.observers.iter().filter(|k| map.numbers.is_new(**k));
        own.for_each(|k| vote(&mut votes, *k));
    }
    let most = votes.iter().map(|v| v.1).max()?;
    let enough = MIN_MATCHES.max((NEARLY_ALL * f64::from(most)) as usize);
    let from = votes.iter().filter(|v| v.1 as usize >= enough).map(|v| v.0).min()?;
    let keyframe = map.keyframe(from)?;
    // Landmark, its distance from the keyframe, and whether that is assumed.
    let mut seen: Vec<(LandmarkId, f64, bool)> = Vec::new();
    let (mut first, mut second): (Vec<Vector2<f64>>, Vec<Vector2<f64>>) = (Vec::new(), Vec::new());
    for m in matches {
        let (Some(landmark), Some(o)) = (map.landmark(m.landmark), keyframe.observation(m.landmark)) else { continue };
        let ray = Ray::of(m.landmark, map, readout_s);
        let place = ray.as_ref().map_or(landmark.position, Ray::point);
        seen.push((m.landmark, (place - keyframe.centre()).norm(), ray.is_some()));
        first.push(o.at_middle_row(readout_s));
        second.push(m.at_middle_row(readout_s));
    }
    let options = TwoViewOptions {
        seed,
        min_matches: MIN_MATCHES,
        min_points: MIN_POINTS,
        min_parallax_rad: MIN_PARALLAX_DEG.to_radians(),
        ..TwoViewOptions::new(TWO_VIEW_SIGMA_PX, camera.focal_px())
    };
    let solution = match reconstruct_two_views(&first, &second, &options) {
        Ok(solution) => solution,
        Err(TwoViewFailure::Ambiguous { best, runner_up }) => {
            let heading = way.heading_since(keyframe.timestamp_ns).or_else(|| heading_before(map, from))?;
            along(&heading, [*best, *runner_up])?
        }
        Err(_) => return None,
    };
    let lengths = |assumed: bool| -> Vec<f64> {
        let of_kind = seen.iter().zip(&solution.points).filter(|(s, _)| s.2 == assumed);
        of_kind.filter_map(|((_, distance, _), point)| Some(distance / (*point)?.norm())).collect()
    };
    let measured = lengths(false);
    let blind = measured.len() < MIN_MEASURED;
    let driven = if blind { way.since(keyframe.timestamp_ns) } else { None };
    let (told, length) = match driven {
        Some(driven) => (Step::Wheels, driven / solution.second_from_first.translation.norm()),
        None if blind => (Step::Assumed, median(&mut lengths(true)).unwrap_or(0.0)),
        None => (Step::Measured, median(&mut { measured }).unwrap_or(0.0)),
    };
    if !(length > 0.0 && length.is_finite()) {
        return None;
    }
    let mut step = solution.second_from_first.relabel::<Camera, Camera>();
    step.translation *= length;
    let from_world = keyframe.camera_from_world;
    let met = seen.iter().zip(&solution.points).filter_map(|(s, point)| Some((s.0, (*point)? * length)));
    assume_anew(map, (from, &step), &met.collect::<Vec<_>>(), camera, readout_s);
    resolve_between(map, from, camera, readout_s);
    Some(Placed { camera_from_world: step * from_world, from, step: told })
}

/// Where the camera went before the turn at `from`, in its own axes; `None` where that was nowhere in particular. In another run it may have sat elsewhere
/// on the robot.
fn heading_before(map: &Map, from: KeyframeId) -> Option<Unit<Vector3<f64>>> {
    let before = map.numbers.below(from.0).map(KeyframeId).take_while(|id| map.numbers.is_new(*id));
    let seeing = before.filter(|id| !is_blind(map, *id)).filter_map(|id| map.keyframe(id));
    let mut last: Option<&Keyframe> = None;
    let step = |earlier| {
        let later = last.replace(earlier)?;
        let rotation = later.camera_from_world.rotation;
        let is_straight = rotation.angle_to(&earlier.camera_from_world.rotation) <= STRAIGHT_RAD;
        (rotation * (later.centre() - earlier.centre())).try_normalize(1e-9).filter(|_| is_straight)
    };
    let steps: Vec<Vector3<f64>> = seeing.filter_map(step).take(*STEPS.end()).collect();
    let sum: Vector3<f64> = steps.iter().sum();
    let is_one_way = STEPS.contains(&steps.len()) && sum.norm() > ONE_WAY * steps.len() as f64;
    Unit::try_new(sum, 1e-9).filter(|_| is_one_way)
}

/// Of two motions that explain the matches the one that leads where the camera is heading, if the other does not.
fn along(heading: &Unit<Vector3<f64>>, motions: [TwoViewReconstruction; 2]) -> Option<TwoViewReconstruction> {
    // The first camera's centre lies behind the second one, which is on its way.
    let off = |motion: &TwoViewReconstruction| (-motion.second_from_first.translation).angle(heading);
    let [best, other] = motions;
    let (there, elsewhere) = if off(&best) <= off(&other) { (best, other) } else { (other, best) };
    let is_there = off(&there) <= THERE_RAD && off(&elsewhere) >= 2.0 * THERE_RAD;
    (is_there && there.wide_points >= MIN_POINTS).then_some(there)
}

/// Assumes of all that was seen since `from` and has no known distance what the `step` from there tells: of what two views have met (`met`, ascending, in
/// the first one's coordinates), its own distance, as surely as the step across its ray; of the rest, that of the scene, hardly. What was assumed in the
/// turn would pull the frames that follow to steps of another length. (With it a map that wheels had given the true step shrank to a quarter within 3 s.)
fn assume_anew(
    map: &mut Map,
    (from, step): (KeyframeId, &Se3<Camera, Camera>),
    met: &[(LandmarkId, Vector3<f64>)],
    camera: &CameraModel,
    readout_s: f64,
) {
    let mut distances: Vec<f64> = met.iter().map(|(_, point)| point.norm()).collect();
    let (Some(first), Some(scene)) = (map.keyframe(from), median(&mut distances)) else { return };
    let (world_from_first, moved) = (first.camera_from_world.inverse(), step.inverse().translation);
    let is_since = |id: KeyframeId| id >= from && map.numbers.is_new(id);
    let since = map.keyframes.iter().filter(|(id, _)| is_since(KeyframeId(*id)));
    let mut seen: Vec<LandmarkId> = since.flat_map(|(_, k)| k.observations.landmarks()).collect();
    seen.sort_unstable();
    seen.dedup();
    let sigma_rad = SQRT_2 * TWO_VIEW_SIGMA_PX / camera.focal_px();
    for id in seen {
        let Some(mut ray) = Ray::of(id, map, readout_s) else { continue };
        ray.assumed = AssumedDistance { inverse: 1.0 / scene, sigma: SIGMA_SHARE / scene };
        if let Ok(i) = met.binary_search_by_key(&id, |t| t.0) {
            let (point, hardly) = (met[i].1, ray.assumed.sigma);
            let across = moved.cross(&point.normalize()).norm();
            let distance = (world_from_first.transform(&point) - ray.centre).norm();
            ray.assumed = AssumedDistance { inverse: 1.0 / distance, sigma: (sigma_rad / across).min(hardly) };
        }
        map.assume_distance(id, ray.point(), ray.assumed);
    }
}

/// Keyframes after `from` were placed against distances that were wrong.
fn resolve_between(map: &mut Map, from: KeyframeId, camera: &CameraModel, readout_s: f64) {
    let is_later = |id: &KeyframeId| *id > from && map.numbers.is_new(*id) && is_held(map, *id);
    let later: Vec<KeyframeId> = map.keyframes.iter().map(|(id, _)| KeyframeId(id)).filter(is_later).collect();
    let mut inlier = Vec::new();
    for id in later {
        let Some(keyframe) = map.keyframe(id) else { continue };
        let pairs: Vec<Correspondence> = keyframe
            .observations
            .iter()
            .filter_map(|o| {
                let landmark = map.landmark(o.landmark)?;
                Some(Correspondence::observed(landmark.position, &o, camera, readout_s))
            })
            .collect();
        let options = PoseOptions { leverage: false, ..PoseOptions::from_poor_start() };
        let solved = optimise_pose(&keyframe.camera_from_world, &pairs, &options, &mut inlier);
        if let Some(solved) = solved.filter(|s| 2 * s.inliers > pairs.len()) {
            map.place_keyframe(id, solved.camera_from_world);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::LazyLock;

    use nalgebra::UnitQuaternion;

    use super::*;
    use crate::geometry::ros_from_optical;
    use crate::map::scale::ScaleSource;
    use crate::map::{Landmark, examples};
    use crate::motion::hand_eye::Robot;
    use crate::motion::scale::ScaleMeasurement;
    use crate::motion::wheel::WheelReading;
    use crate::reconstruction::keyframe::distance_prior::{ray_begins, rays_begin};
    use crate::reconstruction::track::template::observe;

    const TRUE_OVER_ASSUMED: f64 = 2.0;
    static NOTHING_SAID: LazyLock<ScaleFusion> = LazyLock::new(ScaleFusion::default);

    fn camera() -> CameraModel {
        CameraModel::new(640, 480, 520.0, 520.0, 320.0, 240.0, [0.0; 5]).expect("a camera")
    }

    /// A room 2 to 6 m away that two keyframes of a turn see, its landmarks half as far as they are; and the matches of a frame
    /// at `pose`.
    fn scene(pose: &Se3<Camera, World>) -> (Map, Vec<Match>) {
        seen(Map::default(), pose, |_, _, c| 2.0 + 4.0 * c / 12.0)
    }

    /// The same with each landmark at a depth, by its direction (x and y at depth 1) and a number from 0 to 12.
    fn seen(mut map: Map, pose: &Se3<Camera, World>, depth: impl Fn(f64, f64, f64) -> f64) -> (Map, Vec<Match>) {
        let camera = camera();
        let turned: Se3<Camera, World> =
            Se3::new(UnitQuaternion::from_scaled_axis(Vector3::new(0.0, 0.05, 0.0)), Vector3::zeros());
        let keyframes =
            [Se3::identity(), turned].map(|p| (map.add_keyframe(examples::keyframe(Default::default(), p)), p));
        let mut matches = Vec::new();
        for i in 0..120u32 {
            let (a, b, c) = (f64::from(i % 12), f64::from(i / 12), f64::from(i * 7 % 13));
            let (x, y) = ((a / 11.0 - 0.5) * 0.9, (b / 9.0 - 0.5) * 0.7);
            let point = Vector3::new(x, y, 1.0) * depth(x, y, c);
            let see = |p: &Se3<Camera, World>| camera.project(&p.transform(&point)).map(|px| px.cast::<f32>());
            let seen: Vec<_> = keyframes
                .iter()
                .filter_map(|(k, p)| Some((*k, observe(&camera, LandmarkId(0), see(p)?, 1.25)?)))
                .collect();
            let (Some(pixel), true) = (see(pose), seen.len() == 2) else { continue };
            let assumed = AssumedDistance { inverse: TRUE_OVER_ASSUMED / 4.0, sigma: 1.0 };
            let landmark = examples::landmark(point.normalize() / assumed.inverse, keyframes[1].0);
            let id = map.add_landmark(Landmark { assumed: Some(assumed), ..landmark }, &seen);
            matches.push(Match {
                landmark: id,
                template: seen[0].0,
                point: point.normalize() / assumed.inverse,
                pixel,
                normalised: camera.undistort(&pixel.cast()).expect("in the picture"),
                displacement: Vector2::zeros(),
                inv_sigma_px: 1.25,
                inlier: true,
                is_alike: true,
            });
        }
        (map, matches)
    }

    fn moved(by: Vector3<f64>) -> Se3<Camera, World> {
        Se3::new(UnitQuaternion::from_scaled_axis(Vector3::new(0.01, 0.06, -0.02)), -by)
    }

    fn silent(wheels: &Wheels) -> Way<'_> {
        Way { wheels, fusion: &NOTHING_SAID, to_ns: 0 }
    }

    #[test]
    fn wheels_tell_how_long_the_step_was() {
        let truth = moved(Vector3::new(0.0, 0.0, 0.3));
        let (mut map, matches) = scene(&truth);
        // Both keyframes are of time 0; the robot drives 0.3 m ahead in the second after it, in a map that is metric by its wheels.
        let mut robot = Robot::unknown();
        robot.sigma = [1e-3; 7];
        let mut wheels = Wheels::new(robot, 0.01);
        for i in 0..50 {
            let (from_ns, timestamp_ns) = (i * 20_000_000, (i + 1) * 20_000_000);
            let reading = WheelReading {
                from_ns,
                timestamp_ns,
                linear_x_mps: 0.3,
                linear_y_mps: 0.0,
                angular_z_radps: 0.0,
                variance: [f64::NAN; 3],
            };
            assert!(wheels.scale.add_reading(&reading));
        }
        let mut fusion = ScaleFusion::default();
        fusion.add(&ScaleMeasurement { source: ScaleSource::Wheels, log_metres_per_unit: 0.0, sigma: 0.01 });
        let way = Way { wheels: &wheels, fusion: &fusion, to_ns: 1_000_000_000 };
        let placed = place(&mut map, &matches, &camera(), 0.0, (1, &way)).expect("a place");
        let step = placed.camera_from_world.inverse().translation.norm();
        assert!(placed.step == Step::Wheels && (step - 0.3).abs() < 0.003, "the step is {step} long");
        // The distances assumed are the true ones now, which explain what is seen from there.
        let fit = matches.iter().filter(|m| {
            let (l, ray) = (map.landmark(m.landmark).expect("there"), Ray::of(m.landmark, &map, 0.0).expect("assumed"));
            let seen = camera().project(&truth.transform(&ray.point())).expect("in front");
            assert!((l.position - ray.point()).norm() < 1e-9, "{:?}", l.position);
            (seen - m.pixel.cast()).norm() < 1.5
        });
        let (fit, all) = (fit.count(), matches.len());
        assert!(10 * fit > 9 * all, "{fit} of {all} at the distance that the step tells");
        // Of a map whose scale the wheels have not told they tell no length.
        let placed = place(&mut map, &matches, &camera(), 0.0, (1, &silent(&wheels))).expect("a place");
        assert_eq!(placed.step, Step::Assumed);
    }

    #[test]
    fn two_views_find_the_motion_however_wrong_the_distances_are() {
        let wheels = Wheels::new(Robot::unknown(), 0.01);
        for by in [Vector3::new(0.0, 0.0, 0.3), Vector3::new(0.2, 0.0, 0.0), Vector3::new(0.1, -0.05, 0.2)] {
            let truth = moved(by);
            let (mut map, matches) = scene(&truth);
            assert!(matches.len() > 80, "{} matches: the scene is too poor", matches.len());
            let placed = place(&mut map, &matches, &camera(), 0.0, (1, &silent(&wheels))).expect("a place");
            assert_eq!(placed.step, Step::Assumed, "nothing here has a known distance");
            let found = placed.camera_from_world;
            let turn = (found.rotation * truth.rotation.inverse()).angle().to_degrees();
            assert!(turn < 0.05, "moved by {by:?}: rotation off by {turn} degrees");
            let heading = found.translation.angle(&truth.translation).to_degrees();
            assert!(heading < 1.0, "moved by {by:?}: direction off by {heading} degrees");
            // Its length is that of the assumption, half of the true one.
            let length = truth.translation.norm() / found.translation.norm();
            assert!((length / TRUE_OVER_ASSUMED - 1.0).abs() < 0.25, "moved by {by:?}: {length} times too short");
        }
    }

    #[test]
    fn before_a_wall_the_camera_goes_on_as_it_went_before_the_turn() {
        let wheels = Wheels::new(Robot::unknown(), 0.01);
        let truth = moved(Vector3::new(0.0, 0.0, 0.4));
        let (s, c) = 0.6_f64.sin_cos();
        let wall = |x: f64, _: f64, _: f64| 3.0 / (c + s * x);
        let (mut map, matches) = seen(Map::default(), &truth, wall);
        assert!(place(&mut map, &matches, &camera(), 0.0, (1, &silent(&wheels))).is_none(), "two motions explain it");
        // It has driven ahead to where it turned; then it has swayed.
        let went = |step: fn(f64) -> Vector3<f64>| {
            let mut map = Map::default();
            for i in 1..=6 {
                let before = Se3::new(UnitQuaternion::identity(), step(f64::from(7 - i)));
                map.add_keyframe(examples::keyframe(Default::default(), before));
            }
            map
        };
        let (mut map, matches) = seen(went(|back| Vector3::z() * (0.2 * back)), &truth, wall);
        let placed = place(&mut map, &matches, &camera(), 0.0, (1, &silent(&wheels))).expect("a place");
        let found = placed.camera_from_world;
        let (turn, off) =
            ((found.rotation * truth.rotation.inverse()).angle(), found.translation.angle(&truth.translation));
        assert!(turn.to_degrees() < 0.3 && off.to_degrees() < 3.0, "off by {turn} and {off} rad");
        let (mut map, matches) = seen(went(|back| Vector3::x() * (0.2 * (back % 2.0))), &truth, wall);
        assert!(place(&mut map, &matches, &camera(), 0.0, (1, &silent(&wheels))).is_none());
    }

    #[test]
    fn before_a_wall_the_wheels_tell_which_motion_it_was() {
        let truth = moved(Vector3::z() * 0.4);
        let (s, c) = 0.6_f64.sin_cos();
        let wall = |x: f64, _: f64, _: f64| 3.0 / (c + s * x);
        let by_wheels = |linear_x_mps: f64, linear_y_mps: f64| {
            let mounted = Robot::mounted(ros_from_optical(), Vector2::zeros());
            let mut wheels = Wheels::new(Robot { sigma: [1e-4; 7], ..mounted }, 0.01);
            for i in 0..40 {
                assert!(wheels.scale.add_reading(&WheelReading {
                    from_ns: i * 50_000_000,
                    timestamp_ns: (i + 1) * 50_000_000,
                    linear_x_mps,
                    linear_y_mps,
                    angular_z_radps: 0.0,
                    variance: [1e-6; 3],
                }));
            }
            let (mut map, matches) = seen(Map::default(), &truth, wall);
            let way = Way { to_ns: 2_000_000_000, ..silent(&wheels) };
            place(&mut map, &matches, &camera(), 0.0, (1, &way))
        };
        let found = by_wheels(0.2, 0.0).expect("a place").camera_from_world;
        assert!(found.translation.angle(&truth.translation).to_degrees() < 3.0);
        assert!(by_wheels(0.0, 0.2).is_none(), "neither motion leads there");
    }

    #[test]
    fn a_turn_alone_is_no_motion() {
        let wheels = Wheels::new(Robot::unknown(), 0.01);
        let (mut map, matches) = scene(&moved(Vector3::zeros()));
        let before: Vec<_> = map.landmarks.iter().map(|(_, l)| l.position).collect();
        assert!(place(&mut map, &matches, &camera(), 0.0, (1, &silent(&wheels))).is_none());
        assert!(map.landmarks.iter().map(|(_, l)| l.position).eq(before), "a landmark was moved");
    }

    #[test]
    fn a_way_rests_on_the_keyframe_that_its_distances_are_assumed_from() {
        let (map, matches) = scene(&moved(Vector3::zeros()));
        let [first, second] = [0, 1].map(KeyframeId);
        let mut begin: Vec<KeyframeId> = rays_begin(&map, second).collect();
        assert_eq!(begin.len(), matches.len());
        begin.dedup();
        assert_eq!(begin, [first]);
        let told = matches[0].landmark;
        let mut map = map;
        map.measure_landmark(told, Vector3::z(), nalgebra::Matrix3::identity());
        assert_eq!(ray_begins(&map, told), None);
        assert_eq!(rays_begin(&map, second).count(), matches.len() - 1);
    }

    #[test]
    fn without_its_distance_a_landmark_holds_the_turn_and_not_the_motion() {
        let truth = moved(Vector3::new(0.0, 0.0, 0.2));
        let (map, matches) = scene(&truth);
        let camera = camera();
        for m in &matches {
            let pair = m.pair(&camera, 0.0);
            let ray = Ray::of(m.landmark, &map, 0.0).expect("assumed");
            let free = ray.eliminate(&truth, &pair).expect("in front");
            // At the true pose it fits, at about the true distance, though the pair as it was is off by pixels.
            let p = truth.transform(&free.point);
            let e = free.sqrt_information * (p.xy() / p.z - free.normalised);
            assert!(e.norm() < 0.625, "off by {} standard deviations", e.norm());
            assert!(free.point.norm() > m.point.norm() / 1.05, "nearer than assumed");
            // On the spot nothing is eliminated: the pair counts in full.
            let still = moved(Vector3::zeros());
            let kept = ray.eliminate(&still, &pair).expect("in front");
            assert!((kept.sqrt_information - pair.sqrt_information).norm() < 1e-6 * pair.sqrt_information.norm());
        }
    }
}
