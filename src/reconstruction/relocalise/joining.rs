//! Maps that were lost: put aside when the next one begins, recognised from it, joined to it.
//!
//! A map in which frames cannot be placed any more is not given up when the next one begins. Keyframes of the present map are looked for
//! in those kept aside as a lost frame is ([`relocalise`](super::relocalise)): thumbnails, descriptors and P3P, then the search by
//! projection, which must speak for itself. Two keyframes that tell the same similarity ([`other_maps`](super::other_maps)) join the maps:
//! the other one is carried over into the present one, whose poses, unit and number stay as they are. A planner sees its map grow, and
//! nothing jumps. Landmarks of both that are one corner are fused, and the whole is adjusted soon, if it is not too large.
//!
//! Cost: nothing while no map is kept; else one attempt of relocalisation for every few keyframes, rarer while nothing is recognised, after
//! the pose was published. Not here: a kept map is not asked while the present one is lost.

use nalgebra::Vector3;

use super::other_maps::{
    ATTEMPT_GAP, LONGEST_GAP, OtherMap, OtherMaps, REMEMBERED, Sighting, at_corner, log_ratio, retire, similarity,
};
use crate::features::FrameFeatures;
use crate::geometry::Se3;
use crate::geometry::camera_motion::CameraMotion;
use crate::geometry::frames::{Camera, Odom, World};
use crate::geometry::sim3::Sim3;
use crate::map::{KeyframeId, LandmarkId, MapId, Observation};
use crate::reconstruction::adjust::job::WHOLE_FIRST;
use crate::reconstruction::keyframe::observe_match;
use crate::reconstruction::track::Tracker;
use crate::reconstruction::track::association::Bindings;
use crate::reconstruction::track::frame::Frame;
use crate::reconstruction::track::search::Match;
use crate::reconstruction::types::{PoseEstimate, TrajectoryEvent};
use crate::reconstruction::{LastFrame, Reconstruction};

/// Landmarks of both maps at one corner whose depths have a larger logarithm of their ratio are two points.
const SAME_POINT_LOG: f64 = 0.2;

/// A map that is put away while another one may begin, with what goes on where none does.
struct Aside {
    other: OtherMap,
    bindings: Bindings,
    last: Option<LastFrame>,
    odom_from_camera: Se3<Odom, Camera>,
    lost_frames: u64,
    next_whole: usize,
    unadjusted: Option<KeyframeId>,
}

impl Reconstruction {
    /// A frame that the map does not know, long after the last one that it did: perhaps the one that begins the next map.
    pub(in crate::reconstruction) fn begin_beside(&mut self, features: &FrameFeatures) -> PoseEstimate {
        let starts = self.initialiser.step(features, &self.camera, self.intrinsics.freedom().as_ref(), &self.config);
        if starts.is_empty() {
            return self.estimate_none(features);
        }
        let aside = self.set_aside();
        let Some(mut estimate) = self.start_from(&starts, features) else {
            self.take_back(aside);
            return self.estimate_none(features);
        };
        self.discard_job();
        self.intrinsics.end_map(&self.camera);
        self.reset_counter += 1;
        self.counters.resets += 1;
        estimate.reset_counter = self.reset_counter;
        // A map that was lost as soon as it had begun may have been none.
        let gone = match aside.other.map_frames >= self.config.lost_frames {
            true => self.others.keep(aside.other, self.config.max_keyframes),
            false => vec![aside.other.map],
        };
        gone.iter().for_each(|map| retire(map, &mut self.events));
        estimate
    }

    /// Puts the present map away, as if none had ever been. A job under way goes on.
    fn set_aside(&mut self) -> Aside {
        let next = self.map.successor();
        let id = self.map_id;
        self.map_id = MapId(id.0 + 1);
        self.tracker = Tracker::default();
        self.inliers.clear();
        self.pending = None;
        let other = OtherMap {
            map: std::mem::replace(&mut self.map, next),
            id,
            reference: self.reference,
            scale_doubt: std::mem::take(&mut self.scale_doubt),
            map_frames: std::mem::take(&mut self.map_frames),
            sightings: Vec::new(),
        };
        Aside {
            other,
            bindings: std::mem::take(&mut self.bindings),
            last: self.last.take(),
            odom_from_camera: std::mem::take(&mut self.odom_from_camera),
            lost_frames: std::mem::take(&mut self.lost_frames),
            next_whole: std::mem::replace(&mut self.next_whole, WHOLE_FIRST),
            unadjusted: self.unadjusted.take(),
        }
    }

    /// Undoes [`set_aside`](Self::set_aside).
    fn take_back(&mut self, aside: Aside) {
        let Aside { other, bindings, last, odom_from_camera, lost_frames, next_whole, unadjusted } = aside;
        // What was made of a revision meanwhile must not be taken for this map's.
        let revision = self.map.revision.max(other.map.revision) + 1;
        (self.map, self.map_id, self.reference) = (other.map, other.id, other.reference);
        self.map.revision = revision;
        (self.scale_doubt, self.map_frames) = (other.scale_doubt, other.map_frames);
        (self.bindings, self.last, self.odom_from_camera) = (bindings, last, odom_from_camera);
        (self.lost_frames, self.next_whole, self.unadjusted) = (lost_frames, next_whole, unadjusted);
    }

    /// Looks for the frame that has just become the keyframe `id` in the maps kept aside; joins the one that it is recognised in.
    pub(in crate::reconstruction) fn recognise(&mut self, features: &FrameFeatures, id: KeyframeId) {
        if self.others.kept.is_empty() || self.turned.is_some() {
            return;
        }
        // One that was recognised a moment ago is asked again at once.
        let others = &mut self.others;
        if others.warm == 0 {
            if self.frame < others.next_attempt {
                return;
            }
            others.turn += 1;
        }
        let index = others.turn % others.kept.len();
        let sighting = self.find_in(index, features, id);
        let others = &mut self.others;
        match sighting.is_some() && others.warm < REMEMBERED {
            true => (others.warm, others.gap) = (others.warm + 1, ATTEMPT_GAP),
            false => (others.warm, others.gap) = (0, (2 * others.gap).min(LONGEST_GAP)),
        }
        others.next_attempt = self.frame + others.gap;
        let Some(sighting) = sighting else { return };
        let other = &self.others.kept[index];
        let (readout_s, min_parallax) = (self.shutter.readout_s, self.config.min_parallax_deg.to_radians());
        let tell = |before| similarity(&self.map, &other.map, [before, &sighting], readout_s, min_parallax);
        let told = other.sightings.iter().rev().find_map(tell);
        match told {
            Some(present_from_other) => {
                let mut other = self.others.kept.remove(index);
                other.sightings.push(sighting);
                self.others.warm = 0;
                self.join(other, &present_from_other);
            }
            None => {
                let sightings = &mut self.others.kept[index].sightings;
                if sightings.len() == REMEMBERED {
                    sightings.remove(0);
                }
                sightings.push(sighting);
            }
        }
    }

    /// Where the keyframe `id` is in a map kept aside, if it is.
    fn find_in(&mut self, index: usize, features: &FrameFeatures, id: KeyframeId) -> Option<Sighting> {
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
        // An assumed distance tells nothing.
        let is_measured = |m: &&Match| other.map.landmark(m.landmark).is_some_and(|l| l.assumed.is_none());
        let found: Vec<Match> = tracker.inliers().filter(is_measured).copied().collect();
        (!found.is_empty()).then_some(Sighting { keyframe: id, there: placed.camera_from_world, found })
    }

    /// Makes the other map a part of this one.
    fn join(&mut self, mut other: OtherMap, present_from_other: &Sim3<World, World>) {
        self.discard_job();
        // The lens may be known better by now.
        other.map.undistort_anew(&self.camera);
        other.map.transform(present_from_other);
        let newest = other.sightings.last().map(|s| s.keyframe);
        let through = newest.and_then(|id| self.map.keyframe(id)?.scale_from);
        self.scale_doubt.absorb(&other.scale_doubt, &mut other.map, present_from_other, through);
        let own = |s: &Sighting| self.map.keyframe(s.keyframe).map(|k| k.observations.clone()).unwrap_or_default();
        let seen: Vec<Vec<Observation>> = other.sightings.iter().map(own).collect();
        self.map.absorb(other.map);
        for (sighting, seen) in other.sightings.iter().zip(&seen) {
            self.add_found(sighting, seen);
        }
        self.events.push(TrajectoryEvent::MapJoined {
            map: other.id,
            into: self.map_id,
            scale: present_from_other.scale,
        });
        self.counters.maps_joined += 1;
        self.map_frames += other.map_frames;
        self.next_whole = 0;
        self.unadjusted = newest;
    }

    /// Enters what a keyframe was found to see of another map, which is a part of this one by now; `seen`: what it saw before.
    fn add_found(&mut self, sighting: &Sighting, seen: &[Observation]) {
        for m in &sighting.found {
            let Some(own) = at_corner(seen, m) else {
                if let Some(o) = observe_match(&self.camera, m) {
                    self.map.add_observation(sighting.keyframe, o);
                }
                continue;
            };
            let depth = |id: LandmarkId| {
                let pose = self.map.keyframe(sighting.keyframe)?.camera_from_world;
                Some(pose.transform(&self.map.landmark(id)?.position).z)
            };
            let ratio = depth(own.landmark).zip(depth(m.landmark)).and_then(|(here, there)| log_ratio(here, there));
            if self.map.landmark(own.landmark).is_some_and(|l| l.assumed.is_some()) {
                self.map.fuse(m.landmark, own.landmark);
            } else if ratio.is_some_and(|r| r.abs() < SAME_POINT_LOG) {
                self.map.fuse(own.landmark, m.landmark);
            }
        }
    }
}
