//! Maps that were lost: kept while the next one grows, recognised from it, joined to it.
//!
//! A map in which frames cannot be placed any more is not given up when the next one begins. Keyframes of the present map are looked for
//! in those kept aside as a lost frame is ([`relocalise`](super::relocalise)): descriptors, P3P, then the search by projection, which must
//! speak for itself. What was found has a pose in both maps, and corners that are landmarks of both tell the ratio of their units by
//! their depths. Two keyframes that tell the same similarity (a wrong join costs a robot more than a missed one) join the maps:
//!
//! ```text
//! p_present = s p_other  in the camera's axes, so  x_present = s R x_other + t,  R = R_p' R_o,  t = R_p' (s t_o - t_p)
//! ```
//!
//! The other map is carried over into the present one, whose poses, unit and number stay as they are: a planner sees its map grow, and
//! nothing jumps. Landmarks of both that are one corner are fused, and the whole is adjusted soon.
//!
//! Cost: nothing while no map is kept; else one attempt of relocalisation for every few keyframes, after the pose was published.

use nalgebra::Vector3;

use super::Reconstruction;
use super::bindings::Bindings;
use super::frame::Frame;
use super::keyframes::SAME_CORNER_PX;
use super::relocalise::Relocaliser;
use super::scale_doubt::ScaleDoubt;
use super::search::{Match, observe};
use super::tracking::Tracker;
use super::types::{PoseEstimate, TrajectoryEvent};
use super::{LastFrame, WHOLE_FIRST, retire};
use crate::features::FrameFeatures;
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::frames::{Camera, Odom, World};
use crate::geometry::sim3::Sim3;
use crate::geometry::{Se3, median};
use crate::map::{KeyframeId, LandmarkId, Map, MapId, Observation};

/// Maps that are kept at the most; the smallest goes first.
const MAX_KEPT: usize = 4;
/// A map with fewer keyframes is worth no waiting and no keeping.
pub(super) const WORTH_KEEPING: usize = 4;
/// Frames between two attempts while nothing was recognised.
const ATTEMPT_GAP: u64 = 4;
/// Corners that are landmarks of both maps, at the least, and standard deviation of the logarithm of the units' ratio from them, at the most.
const MIN_COMMON: usize = 8;
const MAX_SCALE_SIGMA: f64 = 0.05;
/// Two keyframes agree on a similarity up to this rotation, rad, this logarithm of the scale, and this distance of the camera, in mean depths.
const AGREE_RAD: f64 = 0.05;
const AGREE_LOG_SCALE: f64 = 0.15;
const AGREE_DEPTHS: f64 = 0.1;

/// A map kept aside, with what tracking goes on from.
pub(super) struct OtherMap {
    map: Map,
    id: MapId,
    /// Where it was tracked last.
    reference: KeyframeId,
    scale_doubt: ScaleDoubt,
    bindings: Bindings,
    last: Option<LastFrame>,
    odom_from_camera: Se3<Odom, Camera>,
    lost_frames: u64,
    map_frames: u64,
    next_whole: usize,
    unadjusted: Option<KeyframeId>,
    /// Where a keyframe of the present map was recognised in it: the similarity that this tells.
    sighting: Option<Sim3<World, World>>,
}

/// All maps kept aside, and what looks for them.
#[derive(Default)]
pub(super) struct OtherMaps {
    /// Ascending id.
    kept: Vec<OtherMap>,
    tracker: Tracker,
    relocaliser: Relocaliser,
    last_attempt: u64,
    /// Which one is asked next.
    turn: usize,
}

impl OtherMaps {
    pub(super) fn maps(&self) -> impl Iterator<Item = &Map> {
        self.kept.iter().map(|other| &other.map)
    }

    /// Keeps a map; returns one that has to go for it.
    fn keep(&mut self, other: OtherMap, max_keyframes: usize) -> Option<Map> {
        self.kept.push(other);
        let keyframes: usize = self.maps().map(|map| map.keyframes.len()).sum();
        if self.kept.len() <= MAX_KEPT && keyframes <= max_keyframes {
            return None;
        }
        let smallest = (0..self.kept.len()).min_by_key(|&i| self.kept[i].map.keyframes.len())?;
        Some(self.kept.remove(smallest).map)
    }

}

impl Reconstruction {
    /// A frame that the map does not know, long after the last one that it did: perhaps the one that begins the next map.
    pub(super) fn begin_beside(&mut self, features: &FrameFeatures) -> PoseEstimate {
        let starts = self.initialiser.step(features, &self.camera, self.intrinsics.freedom().as_ref(), &self.config);
        if starts.is_empty() {
            return self.estimate_none(features);
        }
        let aside = self.set_aside();
        let Some(mut estimate) = self.start_from(&starts, features) else {
            self.take_back(aside);
            return self.estimate_none(features);
        };
        self.intrinsics.end_map(&self.camera);
        self.reset_counter += 1;
        self.counters.resets += 1;
        estimate.reset_counter = self.reset_counter;
        if let Some(gone) = self.others.keep(aside, self.config.max_keyframes) {
            retire(&gone, &mut self.events);
        }
        estimate
    }

    /// Puts the present map away, as if none had ever been.
    fn set_aside(&mut self) -> OtherMap {
        self.discard_job();
        let next = self.map.successor();
        self.map_id.0 += 1;
        self.tracker = Tracker::default();
        self.inliers.clear();
        self.pending = None;
        OtherMap {
            map: std::mem::replace(&mut self.map, next),
            id: MapId(self.map_id.0 - 1),
            reference: self.reference,
            scale_doubt: std::mem::take(&mut self.scale_doubt),
            bindings: std::mem::take(&mut self.bindings),
            last: self.last.take(),
            odom_from_camera: std::mem::replace(&mut self.odom_from_camera, Se3::identity()),
            lost_frames: std::mem::take(&mut self.lost_frames),
            map_frames: std::mem::take(&mut self.map_frames),
            next_whole: std::mem::replace(&mut self.next_whole, WHOLE_FIRST),
            unadjusted: self.unadjusted.take(),
            sighting: None,
        }
    }

    /// Undoes [`set_aside`](Self::set_aside).
    fn take_back(&mut self, aside: OtherMap) {
        let revision = self.map.revision;
        self.map = aside.map;
        // What was made of a revision meanwhile must not be taken for this map's.
        self.map.revision = self.map.revision.max(revision) + 1;
        self.tracker = Tracker::default();
        self.map_id = aside.id;
        self.reference = aside.reference;
        self.scale_doubt = aside.scale_doubt;
        self.bindings = aside.bindings;
        self.last = aside.last;
        self.odom_from_camera = aside.odom_from_camera;
        self.lost_frames = aside.lost_frames;
        self.map_frames = aside.map_frames;
        self.next_whole = aside.next_whole;
        self.unadjusted = aside.unadjusted;
    }

    /// Looks for the frame that has just become the keyframe `id` in the maps kept aside; joins the one that it is recognised in.
    pub(super) fn recognise(&mut self, features: &FrameFeatures, id: KeyframeId) {
        if self.others.kept.is_empty() || self.turned.is_some() {
            return;
        }
        // One that was recognised a moment ago is asked again at once.
        let seen = self.others.kept.iter().position(|other| other.sighting.is_some());
        if seen.is_none() && self.frame < self.others.last_attempt + ATTEMPT_GAP {
            return;
        }
        self.others.last_attempt = self.frame;
        self.others.turn += 1;
        let index = seen.unwrap_or(self.others.turn % self.others.kept.len());
        let sighting = self.find_in(index, features, id);
        let Some((present_from_other, found)) = sighting else {
            self.others.kept[index].sighting = None;
            return;
        };
        let before = self.others.kept[index].sighting.replace(present_from_other);
        let centre = self.map.keyframe(id).map_or_else(Vector3::zeros, |k| k.centre());
        let depth = self.mean_depth_seen(id);
        if before.is_some_and(|before| agree(&before, &present_from_other, &centre, depth)) {
            let other = self.others.kept.remove(index);
            self.join(other, &present_from_other, id, &found);
        }
    }

    /// Where the keyframe `id` is in a map kept aside: the similarity between the maps, and the landmarks found there.
    fn find_in(
        &mut self,
        index: usize,
        features: &FrameFeatures,
        id: KeyframeId,
    ) -> Option<(Sim3<World, World>, Vec<Match>)> {
        let OtherMaps { kept, tracker, relocaliser, .. } = &mut self.others;
        let other = kept.get(index)?;
        let bindings = Bindings::default();
        // Of its motion only the turn is known in the other map's unit.
        let turn = |motion: CameraMotion| CameraMotion { shift: Vector3::zeros(), ..motion };
        let frame = Frame {
            features,
            map: &other.map,
            bindings: &bindings,
            camera: &self.camera,
            config: &self.config,
            before: None,
            motion: self.map.keyframe(id)?.motion.map(turn),
            shutter: &self.shutter,
            is_calibrated: self.intrinsics.is_calibrated(),
        };
        let placed = relocaliser.place(tracker, &frame, other.reference)?;
        if !placed.speaks_for_itself(self.config.min_landmarks) {
            return None;
        }
        let found: Vec<Match> = tracker.inliers().copied().collect();
        let there = placed.camera_from_world;
        let scale = scale_between(&self.map, id, &other.map, &there, &found)?;
        let here = self.map.keyframe(id)?.camera_from_world;
        let turn = here.rotation.inverse();
        let shift = turn * (there.translation * scale - here.translation);
        let similarity = Sim3::new(scale, turn * there.rotation, shift);
        similarity.is_valid().then_some((similarity, found))
    }

    /// Makes the other map a part of this one. `found`: its landmarks that keyframe `id` has seen.
    fn join(&mut self, mut other: OtherMap, present_from_other: &Sim3<World, World>, id: KeyframeId, found: &[Match]) {
        self.discard_job();
        // The lens may be known better by now.
        other.map.undistort_anew(&self.camera);
        other.map.transform(present_from_other);
        self.scale_doubt.absorb(&other.scale_doubt, &mut other.map);
        let here = self.map.keyframe(id).map(|k| k.observations.clone()).unwrap_or_default();
        self.map.absorb(other.map);
        for m in found {
            let twin = here.iter().find(|o| (o.pixel - m.pixel).norm() < SAME_CORNER_PX);
            match twin {
                Some(own) => self.map.fuse(own.landmark, m.landmark),
                None => {
                    if let Some(o) = observe(&self.camera, m.landmark, m.pixel, m.inv_sigma_px) {
                        self.map.add_observation(id, Observation { displacement: m.displacement, ..o });
                    }
                }
            }
        }
        self.events.push(TrajectoryEvent::MapJoined {
            map: other.id,
            into: self.map_id,
            scale: present_from_other.scale,
        });
        self.counters.maps_joined += 1;
        self.map_frames += other.map_frames;
        self.next_whole = 0;
        self.unadjusted = Some(id);
    }

    /// Mean depth of what a keyframe sees, map units.
    fn mean_depth_seen(&self, id: KeyframeId) -> f64 {
        let Some(k) = self.map.keyframe(id) else { return 0.0 };
        let depths = k.observations.iter().filter_map(|o| {
            self.map.landmark(o.landmark).map(|l| k.camera_from_world.transform(&l.position).z)
        });
        let (sum, n) = depths.fold((0.0, 0.0), |(sum, n), z| (sum + z, n + 1.0));
        if n > 0.0 { sum / n } else { 0.0 }
    }
}

/// The same up to what two keyframes may tell differently; `centre`: of the camera, at `depth` from what it sees.
fn agree(a: &Sim3<World, World>, b: &Sim3<World, World>, centre: &Vector3<f64>, depth: f64) -> bool {
    let there = b.inverse().transform(centre);
    a.rotation.angle_to(&b.rotation) < AGREE_RAD
        && (a.scale / b.scale).ln().abs() < AGREE_LOG_SCALE
        && (a.transform(&there) - centre).norm() < AGREE_DEPTHS * depth
}

/// The unit of the other map in that of the present one, from corners of keyframe `id` that are landmarks of both: the median ratio of
/// their depths; `None` if too few tell it, or too differently.
fn scale_between(
    map: &Map,
    id: KeyframeId,
    other: &Map,
    camera_from_other: &Se3<Camera, World>,
    found: &[Match],
) -> Option<f64> {
    let keyframe = map.keyframe(id)?;
    let measured = |map: &Map, id: LandmarkId| Some(map.landmark(id).filter(|l| l.assumed.is_none())?.position);
    let mut ratios: Vec<f64> = found
        .iter()
        .filter_map(|m| {
            let own = keyframe.observations.iter().find(|o| (o.pixel - m.pixel).norm() < SAME_CORNER_PX)?;
            let here = keyframe.camera_from_world.transform(&measured(map, own.landmark)?).z;
            let there = camera_from_other.transform(&measured(other, m.landmark)?).z;
            (here > 0.0 && there > 0.0).then(|| (here / there).ln())
        })
        .collect();
    if ratios.len() < MIN_COMMON {
        return None;
    }
    let middle = median(&mut ratios)?;
    let mut off: Vec<f64> = ratios.iter().map(|r| (r - middle).abs()).collect();
    // Of a normal distribution: the standard deviation from the median deviation, and the median's from that of one.
    let sigma = 1.4826 * median(&mut off)? * (std::f64::consts::FRAC_PI_2 / ratios.len() as f64).sqrt();
    (sigma <= MAX_SCALE_SIGMA).then(|| middle.exp())
}
