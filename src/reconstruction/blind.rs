//! Frames that the picture cannot place: odometry goes on by the wheels, and vision takes up again where it is.
//!
//! Once the map is metric and the camera's place on the base is known, the wheels say where each frame is expected
//! ([`dead_reckoning`](super::dead_reckoning)): tracking searches there what it does not find where the last motion leads, and a frame that it cannot
//! place all the same (dark, covered, blurred) is published as `DeadReckoning`, up to a limit of time, way and doubt; beyond it, and without wheels, it is lost as ever.
//!
//! Vision takes up again by the same search at the expected place, among the landmarks of the keyframe nearest to it. A pose that agrees
//! with the wheels need not speak for itself as one after a loss must. The smooth pose goes on without a jump: what the wheels were off by moves the map
//! pose alone.
//!
//! Where nothing of the map is in view when the picture comes back, the same map goes on from the dead-reckoned pose: a start as that of a map,
//! brought into the present one by the newest camera's dead-reckoned place and by the way that the wheels drove between its first and
//! last view. It must agree with the wheels' motion over its views. Landmarks on both sides of the gap hang together by the wheels alone: the doubt is
//! told ([`Reckoned`]), and a loop that is closed later takes it out.
//!
//! Not here: what is seen of an old part of the map while a new one is in view (`loops` finds it).

use nalgebra::{Matrix6, Vector3};

use super::Reconstruction;
use super::active_map::ActiveMap;
use super::dead_reckoning::{Ahead, Metre, Reckoned};
use super::odometry::{LastFrame, Odometry};
use super::optics::Optics;
use super::relocalise::other_maps::WORTH_KEEPING;
use super::segments::MOVED_SIGMAS;
use super::track::Tracker;
use super::types::{PoseEstimate, TrackingState, TrajectoryEvent};
use crate::features::FrameFeatures;
use crate::geometry::Se3;
use crate::geometry::frames::{Camera, Odom, World};
use crate::geometry::sim3::Sim3;
use crate::map::scale::ScaleSource;
use crate::map::{KeyframeId, Map};
use crate::motion::scale::METRIC_SIGMA;

/// A keyframe that looks elsewhere than the expected pose by more than this sees nothing of the same, rad; and how far away counts as much as a
/// radian, m.
const SAME_VIEW_RAD: f64 = 1.0;
const RADIAN_M: f64 = 4.0;
/// The views of a start and the wheels over the same time agree up to this turn (rad) and direction (rad).
const START_TURN_RAD: f64 = 0.06;
const START_DIRECTION_RAD: f64 = 0.3;

impl Reconstruction {
    /// The wheels alone place the newest frame: for how long and how surely; `None` otherwise.
    pub fn reckoned(&self) -> Option<Reckoned> {
        self.blind.reckoned.filter(|_| self.state == TrackingState::DeadReckoning)
    }

    /// Where the camera is expected at a time, ns, by the wheels; `None` where they do not tell.
    pub(super) fn look_ahead(&self, timestamp_ns: i64) -> Option<Ahead> {
        if self.wheels.scale.is_silent() || !self.active.fusion.is_metric() {
            return None;
        }
        let last = self.active.odometry.last?;
        Ahead::of(&self.wheels.scale, (last.timestamp_ns, timestamp_ns), self.metre()).filter(Ahead::is_believed)
    }

    /// A metre of the wheels in the map: near one unit, as that is metric. Behind a turn the map's scale may be in doubt; how far the wheels went is not.
    fn metre(&self) -> Metre {
        let fusion = &self.active.fusion;
        match fusion.word(ScaleSource::Wheels) {
            // An error that all wheels share is in both.
            Some(log) => Metre { units: (-log).exp(), sigma: self.wheels.scale.sigma() },
            None => {
                let of_map = fusion.fused().map_or(METRIC_SIGMA, |(_, sigma, _)| sigma);
                Metre { units: 1.0, sigma: of_map.hypot(self.wheels.scale.radius_sigma()) }
            }
        }
    }

    /// The keyframe to search around: after frames that were not tracked, the one with the view nearest to the expected one.
    pub(super) fn expected_reference(&self, ahead: Option<&Ahead>) -> KeyframeId {
        let ActiveMap { map, odometry, reference, .. } = &self.active;
        let expected = ahead.zip(odometry.last).filter(|_| odometry.lost_frames > 0);
        let nearest =
            expected.and_then(|(ahead, last)| nearest_view(map, &(ahead.now_from_last * last.camera_from_world)));
        nearest.unwrap_or(*reference)
    }

    /// The smooth pose of a frame of this time, if the one before was placed by the wheels.
    pub(super) fn odom_after_reckoning(&self, ahead: Option<&Ahead>) -> Option<Se3<Odom, Camera>> {
        let reckoned = self.reckoned()?;
        // Where the wheels have just fallen silent the last word holds.
        Some(ahead.map_or(reckoned.odom_from_camera, |ahead| self.odom_ahead(ahead)))
    }

    fn odom_ahead(&self, ahead: &Ahead) -> Se3<Odom, Camera> {
        self.active.odometry.odom_from_camera * ahead.now_from_last.inverse()
    }

    /// A frame that the picture does not place, and the wheels do.
    pub(super) fn reckon(&mut self, features: &FrameFeatures, ahead: &Ahead) -> PoseEstimate {
        let Some(last) = self.active.odometry.last else { return self.estimate_none(features) };
        let camera_from_world = ahead.now_from_last * last.camera_from_world;
        let odom_from_camera = self.odom_ahead(ahead);
        self.state = TrackingState::DeadReckoning;
        self.blind.note(ahead, odom_from_camera);
        if !self.localise_only
            && self.active.map.keyframes.len() >= WORTH_KEEPING
            && let Some(estimate) = self.go_on_from(features, (camera_from_world, odom_from_camera), ahead.metre)
        {
            return estimate;
        }
        // `motion` takes camera coordinates at one time to later ones; the camera itself moves the other way.
        let unknown = Vector3::from_element(f64::NAN);
        let (angular, linear) = ahead.motion.map_or((unknown, unknown), |m| (-m.turn, -m.shift));
        PoseEstimate {
            state: TrackingState::DeadReckoning,
            world_from_camera: Some(camera_from_world.inverse()),
            odom_from_camera: Some(odom_from_camera),
            anchor: Some(self.active.reference),
            covariance: ahead.carry(&self.blind.covariance),
            angular_velocity: angular,
            linear_velocity: linear,
            ..self.estimate_none(features)
        }
    }

    /// The picture is back, and nothing of the map is in it: perhaps this frame makes a start, which the map then goes on with.
    fn go_on_from(
        &mut self,
        features: &FrameFeatures,
        (here, odom_from_camera): (Se3<Camera, World>, Se3<Odom, Camera>),
        metre: Metre,
    ) -> Option<PoseEstimate> {
        let Optics { camera, intrinsics, .. } = &self.optics;
        let starts = self.initialiser.step(features, camera, intrinsics.supposed(camera), &self.config);
        if starts.is_empty() {
            return None;
        }
        // As where a map begins beside this one, but all of it is undone if it is not to be believed.
        let (counters, events) = (self.counters, self.events.len());
        let next = self.active.successor();
        let old = std::mem::replace(&mut self.active, next);
        let tracker = std::mem::take(&mut self.tracker);
        let begun = self.start_from(&starts, features).and_then(|_| self.placed_by_wheels(&here, metre));
        let Some(present_from_start) = begun else {
            let revision = self.active.map.revision;
            (self.active, self.tracker) = (old, tracker);
            // What was made of a revision meanwhile must not be taken for this map's.
            self.active.map.revision = self.active.map.revision.max(revision) + 1;
            self.counters = counters;
            self.events.truncate(events);
            self.state = TrackingState::DeadReckoning;
            return None;
        };
        self.carry_on(old, &present_from_start, features.timestamp_ns, (here, odom_from_camera));
        let Some(tracked) = self.track_at(features, here) else {
            self.state = TrackingState::Lost;
            return Some(self.estimate_none(features));
        };
        self.active.odometry.replace(tracked.camera_from_world);
        self.blind.see();
        let estimate = self.estimate_tracked(features, &tracked, None, true);
        self.blind.covariance = estimate.covariance;
        Some(estimate)
    }

    /// How the map that has just begun lies to the one before, given where its newest camera is there, and how long a metre of the wheels is in that one;
    /// `None` if its motion and the wheels' disagree.
    fn placed_by_wheels(&self, here: &Se3<Camera, World>, metre: Metre) -> Option<Sim3<World, World>> {
        let newest = self.active.odometry.last?;
        let first = self.active.map.keyframes.iter().next()?.1;
        let seen = (newest.camera_from_world * first.camera_from_world.inverse()).relabel::<Camera, Camera>();
        let driven = Ahead::of(&self.wheels.scale, (first.timestamp_ns, newest.timestamp_ns), metre)?;
        let way = driven.now_from_last.translation.norm();
        let turn = seen.rotation.angle_to(&driven.now_from_last.rotation);
        let direction = seen.translation.angle(&driven.now_from_last.translation);
        let (sigma_m, sigma_rad) = driven.sigma();
        let agrees = turn <= START_TURN_RAD + 3.0 * sigma_rad && direction <= START_DIRECTION_RAD;
        if !agrees || way <= MOVED_SIGMAS * sigma_m * metre.units {
            return None;
        }
        let scale = way / seen.translation.norm();
        let own = newest.camera_from_world;
        let turn = here.rotation.inverse();
        let present_from_start =
            Sim3::new(scale, turn * own.rotation, turn * (own.translation * scale - here.translation));
        present_from_start.is_valid().then_some(present_from_start)
    }

    /// The map before goes on, with what has just begun as a part of it.
    fn carry_on(
        &mut self,
        mut old: ActiveMap,
        present_from_start: &Sim3<World, World>,
        timestamp_ns: i64,
        (here, odom_from_camera): (Se3<Camera, World>, Se3<Odom, Camera>),
    ) {
        self.discard_job();
        self.wheels.interrupt();
        self.contradiction.end();
        self.tracker = Tracker::default();
        let scale = present_from_start.scale;
        let mut begun = std::mem::take(&mut self.active);
        begun.map.transform(present_from_start);
        begun.map.renumber(begun.id, old.id);
        self.events.push(TrajectoryEvent::MapJoined { map: begun.id, into: old.id, scale });
        old.unadjusted = begun.map.newest();
        old.map.absorb(begun.map);
        old.bindings = begun.bindings;
        old.reference = begun.reference;
        old.next_id = begun.next_id;
        old.frames += begun.frames;
        old.last_keyframe_frame = self.counters.frames;
        let last = LastFrame { timestamp_ns, camera_from_world: here, step: None, motion_before: None };
        old.odometry = Odometry { last: Some(last), odom_from_camera, ..Odometry::default() };
        self.active = old;
        self.state = TrackingState::Tracking;
        self.blind.continued += 1;
    }

    /// A frame was tracked, whose pose is known so.
    pub(super) fn note_seen(&mut self, covariance: &Matrix6<f64>) {
        self.blind.covariance = *covariance;
        self.blind.see();
    }
}

/// The keyframe whose view is nearest to that of a pose; `None` if all look elsewhere. (Lengths are metres.)
fn nearest_view(map: &Map, camera_from_world: &Se3<Camera, World>) -> Option<KeyframeId> {
    let centre = camera_from_world.inverse().translation;
    let apart = |(id, k): (u32, &crate::map::Keyframe)| {
        let angle = k.camera_from_world.rotation.angle_to(&camera_from_world.rotation);
        (angle < SAME_VIEW_RAD).then(|| (angle + (k.centre() - centre).norm() / RADIAN_M, KeyframeId(id)))
    };
    map.keyframes.iter().filter_map(apart).min_by(|a, b| a.0.total_cmp(&b.0)).map(|nearest| nearest.1)
}
