//! Maps that were lost: kept while the next one grows, recognised from it, joined to it.
//!
//! A map in which frames cannot be placed any more is not given up when the next one begins. Keyframes of the present map are looked for
//! in those kept aside as a lost frame is ([`relocalise`](super::relocalise)): descriptors, P3P, then the search by projection, which must
//! speak for itself. What was found has a pose in both maps. The ratio of the maps' units is that of depths: of corners that are landmarks
//! of both, and of the other map's landmarks that two such keyframes have seen, triangulated from where they are in the present one. Two
//! keyframes that then tell the same similarity (a wrong join costs a robot more than a missed one) join the maps:
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
use super::keyframes::{SAME_CORNER_PX, triangulate};
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
use crate::map::{Keyframe, KeyframeId, LandmarkId, Map, MapId, Observation};

/// Maps that are kept at the most; the smallest goes first.
const MAX_KEPT: usize = 4;
/// A map with fewer keyframes is worth no waiting and no keeping.
pub(super) const WORTH_KEEPING: usize = 4;
/// Frames between two attempts while nothing was recognised.
const ATTEMPT_GAP: u64 = 4;
/// Depths that are known in both maps, at the least, and standard deviation of the logarithm of the units' ratio from them, at the most.
const MIN_COMMON: usize = 8;
const MAX_SCALE_SIGMA: f64 = 0.05;
/// Two keyframes agree on a similarity up to this rotation, rad, and this distance of the camera, in mean depths.
const AGREE_RAD: f64 = 0.05;
const AGREE_DEPTHS: f64 = 0.1;

/// Keyframes recognised in one map that are remembered.
const REMEMBERED: usize = 4;

/// A keyframe of the present map that was recognised in another.
struct Sighting {
    keyframe: KeyframeId,
    /// Its pose in the other map, and that one's landmarks that it sees.
    there: Se3<Camera, World>,
    found: Vec<Match>,
}

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
    /// Keyframes of the present map that were recognised in it, the newest last.
    sightings: Vec<Sighting>,
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
    /// The last attempt found something.
    warm: bool,
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
            odom_from_camera: std::mem::take(&mut self.odom_from_camera),
            lost_frames: std::mem::take(&mut self.lost_frames),
            map_frames: std::mem::take(&mut self.map_frames),
            next_whole: std::mem::replace(&mut self.next_whole, WHOLE_FIRST),
            unadjusted: self.unadjusted.take(),
            sightings: Vec::new(),
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
        if !self.others.warm {
            if self.frame < self.others.last_attempt + ATTEMPT_GAP {
                return;
            }
            self.others.turn = (self.others.turn + 1) % self.others.kept.len();
        }
        let index = self.others.turn.min(self.others.kept.len() - 1);
        self.others.last_attempt = self.frame;
        let sighting = self.find_in(index, features, id);
        self.others.warm = sighting.is_some();
        let Some(sighting) = sighting else { return };
        let other = &self.others.kept[index];
        let (readout_s, min_parallax) = (self.shutter.readout_s, self.config.min_parallax_deg.to_radians());
        let tell = |before| similarity(&self.map, &other.map, [before, &sighting], readout_s, min_parallax);
        let told = other.sightings.iter().rev().find_map(tell);
        match told {
            Some(present_from_other) => {
                let mut other = self.others.kept.remove(index);
                other.sightings.push(sighting);
                self.join(other, &present_from_other);
                self.others.warm = false;
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
        placed.speaks_for_itself(self.config.min_landmarks).then(|| Sighting {
            keyframe: id,
            there: placed.camera_from_world,
            found: tracker.inliers().copied().collect(),
        })
    }

    /// Makes the other map a part of this one.
    fn join(&mut self, mut other: OtherMap, present_from_other: &Sim3<World, World>) {
        self.discard_job();
        // The lens may be known better by now.
        other.map.undistort_anew(&self.camera);
        other.map.transform(present_from_other);
        self.scale_doubt.absorb(&other.scale_doubt, &mut other.map);
        self.map.absorb(other.map);
        let newest = other.sightings.last().map(|s| s.keyframe);
        for Sighting { keyframe, found, .. } in &other.sightings {
            for m in found {
                let Some(k) = self.map.keyframe(*keyframe) else { break };
                match at_corner(k, m).map(|o| o.landmark) {
                    Some(own) => self.map.fuse(own, m.landmark),
                    None => {
                        if let Some(o) = observe(&self.camera, m.landmark, m.pixel, m.inv_sigma_px) {
                            self.map.add_observation(*keyframe, Observation { displacement: m.displacement, ..o });
                        }
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
        self.unadjusted = newest;
    }
}

/// The similarity, present from other, that two keyframes tell, if it is the same. `min_parallax`: of what they triangulate, rad.
fn similarity(
    map: &Map,
    other: &Map,
    [first, second]: [&Sighting; 2],
    readout_s: f64,
    min_parallax: f64,
) -> Option<Sim3<World, World>> {
    let mut ratios = depth_ratios(map, first, other);
    ratios.extend(depth_ratios(map, second, other));
    ratios.extend(triangulated_ratios(map, [first, second], readout_s, min_parallax));
    let scale = agreed_ratio(&mut ratios)?;
    let told_by = |s: &Sighting| {
        let here = map.keyframe(s.keyframe)?.camera_from_world;
        let turn = here.rotation.inverse();
        let shift = turn * (s.there.translation * scale - here.translation);
        Some(Sim3::<World, World>::new(scale, turn * s.there.rotation, shift))
    };
    let (a, b) = (told_by(first)?, told_by(second)?);
    let centre = second.there.inverse().translation;
    let apart = (a.transform(&centre) - b.transform(&centre)).norm();
    let depths: f64 = second.found.iter().map(|m| second.there.transform(&m.point).z).sum();
    let depth = scale * depths / second.found.len() as f64;
    let agrees = a.rotation.angle_to(&b.rotation) < AGREE_RAD && apart < AGREE_DEPTHS * depth;
    (agrees && b.is_valid()).then_some(b)
}

/// What a keyframe observes where a landmark of another map was found in it.
fn at_corner<'a>(keyframe: &'a Keyframe, m: &Match) -> Option<&'a Observation> {
    keyframe.observations.iter().find(|o| (o.pixel - m.pixel).norm() < SAME_CORNER_PX)
}

/// Logarithms of the ratios of the depths, present to other, of the corners of a keyframe that are landmarks of both maps.
fn depth_ratios(map: &Map, sighting: &Sighting, other: &Map) -> Vec<f64> {
    let Some(keyframe) = map.keyframe(sighting.keyframe) else { return Vec::new() };
    let measured = |map: &Map, id: LandmarkId| Some(map.landmark(id).filter(|l| l.assumed.is_none())?.position);
    let ratio = |m: &Match| {
        let own = measured(map, at_corner(keyframe, m)?.landmark)?;
        let (here, there) = (keyframe.camera_from_world.transform(&own).z, measured(other, m.landmark)?);
        log_ratio(here, sighting.there.transform(&there).z)
    };
    sighting.found.iter().filter_map(ratio).collect()
}

/// The same of the other map's landmarks that both keyframes see, triangulated in the present one.
fn triangulated_ratios(map: &Map, [a, b]: [&Sighting; 2], readout_s: f64, min_parallax: f64) -> Vec<f64> {
    let (Some(first), Some(second)) = (map.keyframe(a.keyframe), map.keyframe(b.keyframe)) else { return Vec::new() };
    let (first, second) = (first.camera_from_world, second.camera_from_world);
    let seen = |m: &Match| m.normalised - m.displacement * readout_s;
    let ratio = |m: &Match| {
        let i = a.found.binary_search_by_key(&m.landmark, |m| m.landmark).ok()?;
        let (point, angle) = triangulate(&first, &seen(&a.found[i]), &second, &seen(m))?;
        let (here, there) = (second.transform(&point).z, b.there.transform(&m.point).z);
        log_ratio(here, there).filter(|_| angle >= min_parallax)
    };
    b.found.iter().filter_map(ratio).collect()
}

fn log_ratio(here: f64, there: f64) -> Option<f64> {
    (here > 0.0 && there > 0.0).then(|| (here / there).ln())
}

/// The median of such ratios; `None` if too few tell it, or too differently.
fn agreed_ratio(logarithms: &mut [f64]) -> Option<f64> {
    let n = logarithms.len();
    let middle = median(logarithms).filter(|_| n >= MIN_COMMON)?;
    let mut off: Vec<f64> = logarithms.iter().map(|r| (r - middle).abs()).collect();
    // Of a normal distribution: its standard deviation from the median deviation, and the median's from that.
    let sigma = 1.4826 * median(&mut off)? * (std::f64::consts::FRAC_PI_2 / n as f64).sqrt();
    (sigma <= MAX_SCALE_SIGMA).then(|| middle.exp())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::random::Random;
    use crate::image::Pyramid;
    use crate::map::Landmark;
    use nalgebra::{Matrix2, Matrix3, UnitQuaternion, Vector2};

    /// Two keyframes of the present map that see the same 40 points of another one, whose unit is a third of it.
    struct Scene {
        present: Map,
        other: Map,
        sightings: [Sighting; 2],
        present_from_other: Sim3<World, World>,
    }

    fn keyframe(camera_from_world: Se3<Camera, World>) -> Keyframe {
        Keyframe {
            sequence: 0,
            timestamp_ns: 0,
            map: MapId(0),
            camera_from_world,
            motion: None,
            pyramid: std::sync::Arc::new(Pyramid::default()),
            thumbnail: Default::default(),
            scale_from: None,
            observations: Vec::new(),
            covisible: Vec::new(),
            corners: Vec::new(),
        }
    }

    fn landmark(position: Vector3<f64>) -> Landmark {
        Landmark {
            position,
            covariance: Matrix3::identity() * 1e-6,
            observers: Vec::new(),
            created_by: KeyframeId(0),
            assumed: None,
            sought: 0,
            found: 0,
            disagreed: 0,
        }
    }

    /// `known`: how many of the points are landmarks of the present map, too; `baseline` of its keyframes.
    fn scene(known: usize, baseline: f64) -> Scene {
        let mut random = Random::new(5);
        let present_from_other = Sim3::new(
            3.0,
            UnitQuaternion::from_scaled_axis(Vector3::new(0.4, -1.1, 0.3)),
            Vector3::new(1.0, -2.0, 0.5),
        );
        let poses = [0.0, baseline].map(|x| {
            Se3::new(UnitQuaternion::from_scaled_axis(Vector3::new(0.0, 0.02 * x, 0.0)), Vector3::new(-x, 0.0, 0.0))
        });
        let (mut present, mut other) = (Map::default(), Map::default());
        let ids = poses.map(|pose| present.add_keyframe(keyframe(pose)));
        // The other map's own two keyframes, wherever they are.
        let far = [0, 1].map(|_| other.add_keyframe(keyframe(Se3::identity())));
        let mut found = [Vec::new(), Vec::new()];
        for n in 0..40 {
            let x = Vector3::new(random.uniform(-2.0, 2.0), random.uniform(-1.5, 1.5), random.uniform(4.0, 8.0));
            let seen = poses.map(|pose| {
                let p = pose.transform(&x);
                let normalised = p.xy() / p.z;
                (normalised, (normalised * 500.0 + Vector2::new(320.0, 240.0)).cast::<f32>())
            });
            let observation = |(normalised, pixel)| Observation {
                landmark: LandmarkId(0),
                pixel,
                normalised,
                displacement: Vector2::zeros(),
                inv_sigma_px: 1.0,
                normalised_from_pixel: Matrix2::identity() / 500.0,
            };
            if n < known {
                present.add_landmark(landmark(x), &[(ids[0], observation(seen[0])), (ids[1], observation(seen[1]))]);
            }
            let there = present_from_other.inverse().transform(&x);
            let id = other.add_landmark(landmark(there), &far.map(|k| (k, observation(seen[0]))));
            for (found, (normalised, pixel)) in found.iter_mut().zip(seen) {
                found.push(Match {
                    landmark: id,
                    point: there,
                    pixel,
                    normalised,
                    displacement: Vector2::zeros(),
                    inv_sigma_px: 1.0,
                    blurred: false,
                    inlier: true,
                    template: far[0],
                });
            }
        }
        let there = poses.map(|pose| {
            let here = Sim3::<Camera, World>::from_se3(&pose) * present_from_other;
            Se3::new(here.rotation, here.translation / here.scale)
        });
        let [a, b] = found;
        let sightings = [
            Sighting { keyframe: ids[0], there: there[0], found: a },
            Sighting { keyframe: ids[1], there: there[1], found: b },
        ];
        Scene { present, other, sightings, present_from_other }
    }

    fn told(scene: &Scene) -> Option<Sim3<World, World>> {
        similarity(&scene.present, &scene.other, scene.sightings.each_ref(), 0.0, 0.01)
    }

    fn is_right(scene: &Scene, told: &Sim3<World, World>) -> bool {
        let x = Vector3::new(0.3, -0.7, 2.0);
        (told.transform(&x) - scene.present_from_other.transform(&x)).norm() < 1e-9
    }

    #[test]
    fn two_keyframes_tell_the_similarity_by_common_corners_or_by_triangulation() {
        for (known, baseline) in [(40, 0.01), (0, 0.5), (4, 0.5)] {
            let scene = scene(known, baseline);
            let told = told(&scene).unwrap_or_else(|| panic!("{known} common corners, baseline {baseline}"));
            assert!(is_right(&scene, &told), "{told:?}");
        }
    }

    #[test]
    fn nothing_is_told_without_depths_or_where_they_or_the_poses_disagree() {
        assert!(told(&scene(3, 0.01)).is_none(), "no parallax, three common corners");
        let mut apart = scene(40, 0.5);
        apart.sightings[0].there.translation.y += 0.5;
        assert!(told(&apart).is_none(), "another place");
        let mut turned = scene(40, 0.5);
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.0, 0.1, 0.0));
        turned.sightings[0].there.rotation = turn * turned.sightings[0].there.rotation;
        assert!(told(&turned).is_none(), "another direction");
        let mut random = Random::new(6);
        let mut torn = scene(12, 0.01);
        for (_, l) in torn.present.landmarks.iter_mut() {
            l.position *= random.uniform(0.2, 3.0);
        }
        assert!(told(&torn).is_none(), "depths that have nothing in common");
    }
}
