//! Maps kept aside while another one grows, and how they lie to it.
//!
//! A keyframe of the present map that was recognised in another ([`Sighting`]) has a pose in both. The ratio of the maps' units is that of
//! depths: of corners that are landmarks of both, and of the other map's landmarks that two such keyframes have seen, triangulated from
//! where they are in the present one. Two keyframes that then tell the same similarity are believed (a wrong join costs a robot more than a
//! missed one):
//!
//! ```text
//! p_present = s p_other  in the camera's axes, so  x_present = s R x_other + t,  R = R_p' R_o,  t = R_p' (s t_o - t_p)
//! ```

use super::Relocaliser;
use super::asked::Asked;
use super::spread::shows_a_place;
use crate::geometry::frames::{Camera, World};
use crate::geometry::sim3::Sim3;
use crate::geometry::{SIGMA_OVER_MEDIAN, Se3, median};
use crate::map::graph::Tie;
use crate::map::observations::Observations;
use crate::map::{KeyframeId, LandmarkId, Map, MapId, vote};
use crate::reconstruction::active_map::ActiveMap;
use crate::reconstruction::keyframe::{SAME_CORNER_PX, triangulate};
use crate::reconstruction::track::frame::Frame;
use crate::reconstruction::track::search::Match;
use crate::reconstruction::track::{Tracked, Tracker};
use crate::reconstruction::types::TrajectoryEvent;

/// Maps that are kept at the most; the smallest goes first.
const MAX_KEPT: usize = 4;
/// A map with fewer keyframes is worth no waiting and no keeping.
pub const WORTH_KEEPING: usize = 4;
/// Frames between two attempts, at the least and at the most: twice as many after each that found nothing.
pub const ATTEMPT_GAP: u64 = 4;
pub const LONGEST_GAP: u64 = 32;
/// Depths that are known in both maps, at the least, and standard deviation of the logarithm of the units' ratio from them, at the most.
const MIN_COMMON: usize = 8;
pub const MAX_SCALE_SIGMA: f64 = 0.05;
/// Two keyframes agree on a similarity up to this rotation, rad, and this distance of the camera, in mean depths.
const AGREE_RAD: f64 = 0.05;
const AGREE_DEPTHS: f64 = 0.1;
/// And they are two witnesses: so far apart, in mean depths, or with fewer than half of what they see in common.
const APART_DEPTHS: f64 = 0.05;

/// Joins that are remembered, to be shown.
const MOST_JOINS: usize = 256;

/// Keyframes recognised in one map that are remembered.
pub const REMEMBERED: usize = 4;

/// A keyframe of the present map that was recognised in another.
pub struct Sighting {
    pub keyframe: KeyframeId,
    /// Its pose in the other map, and that one's landmarks that it sees.
    pub there: Se3<Camera, World>,
    pub found: Vec<Match>,
}

impl Sighting {
    /// How the other map lies to the present one by this keyframe alone, for a ratio of their units.
    pub fn similarity(&self, map: &Map, scale: f64) -> Option<Sim3<World, World>> {
        let here = map.keyframe(self.keyframe)?.camera_from_world;
        let turn = here.rotation.inverse();
        let shift = turn * (self.there.translation * scale - here.translation);
        Some(Sim3::new(scale, turn * self.there.rotation, shift))
    }

    /// Mean depth of what was found, in the other map's unit.
    fn mean_depth(&self) -> f64 {
        self.found.iter().map(|m| self.there.transform(&m.point).z).sum::<f64>() / self.found.len() as f64
    }

    /// Whether another keyframe tells the same as this one does (`own`).
    pub fn agrees(&self, own: &Sim3<World, World>, told: &Sim3<World, World>) -> bool {
        let centre = self.there.inverse().translation;
        let apart = (told.transform(&centre) - own.transform(&centre)).norm();
        let turned = told.rotation.angle_to(&own.rotation);
        turned < AGREE_RAD && apart < AGREE_DEPTHS * own.scale * self.mean_depth()
    }
}

/// How another map (or another part of the same) lies to the present one, as two sightings tell.
#[derive(Debug, Clone, Copy)]
pub struct Similarity {
    pub present_from_other: Sim3<World, World>,
    /// Standard deviation of the logarithm of its scale.
    pub log_scale_sigma: f64,
}

/// A map kept aside.
pub struct OtherMap {
    /// As it was when frames were placed in it last.
    pub own: ActiveMap,
    /// Keyframes of the present map that were recognised in it, the newest last.
    pub sightings: Vec<Sighting>,
    /// It came by a command ([`merging`](super::merging)).
    pub is_merged: bool,
}

impl OtherMap {
    pub fn new(own: ActiveMap) -> Self {
        Self { own, sightings: Vec::new(), is_merged: false }
    }
}

/// All maps kept aside, and what looks for them.
#[derive(Default)]
pub struct OtherMaps {
    /// In the order in which they came.
    pub kept: Vec<OtherMap>,
    pub relocaliser: Relocaliser,
    /// Frame before which nothing is asked again, and how many frames that was from the last time.
    pub next_attempt: u64,
    pub gap: u64,
    /// Which one is asked next.
    pub turn: usize,
    /// Attempts in a row that found something.
    pub warm: usize,
    /// Of maps that were joined to the present one, the newest last: the keyframe of theirs whose landmarks were
    /// recognised most, the present map's that showed them, and the number that the map had.
    pub joins: Vec<(KeyframeId, KeyframeId, Tie)>,
    pub asked: Asked,
}

impl OtherMaps {
    /// A map is a part of another one, by these keyframes.
    pub fn note_join(&mut self, map: MapId, from: KeyframeId, to: KeyframeId) {
        if self.joins.len() == MOST_JOINS {
            self.joins.remove(0);
        }
        self.joins.push((from, to, Tie::Join(map)));
    }

    pub fn maps(&self) -> impl Iterator<Item = &Map> {
        self.kept.iter().map(|other| &other.own.map)
    }

    /// Those that came by a command.
    pub fn merged(&self) -> impl Iterator<Item = &OtherMap> {
        self.kept.iter().filter(|other| other.is_merged)
    }

    /// Keeps a map; returns those that have to go for it. Those that came by a command neither go nor take the room of others.
    pub fn keep(&mut self, other: OtherMap, max_keyframes: usize) -> Vec<Map> {
        self.add(other);
        let mut gone = Vec::new();
        loop {
            let own: Vec<(usize, usize)> = self
                .kept
                .iter()
                .enumerate()
                .filter(|(_, other)| !other.is_merged)
                .map(|(i, other)| (other.own.map.keyframes.len(), i))
                .collect();
            let keyframes: usize = own.iter().map(|(keyframes, _)| keyframes).sum();
            let is_full = own.len() > MAX_KEPT || own.len() > 1 && keyframes > max_keyframes;
            let Some((_, smallest)) = own.into_iter().min().filter(|_| is_full) else { return gone };
            gone.push(self.kept.remove(smallest).own.map);
        }
    }

    /// Keeps a map beside all others, and asks again at once.
    pub fn add(&mut self, other: OtherMap) {
        self.kept.push(other);
        (self.next_attempt, self.gap, self.warm) = (0, ATTEMPT_GAP, 0);
    }
}

/// What was found of a keyframe that a tracker has placed elsewhere, but for assumed distances, which tell nothing; `None` if that is too little of its
/// picture to tell a place.
pub fn found_in(frame: &Frame<'_>, tracker: &Tracker, keyframe: KeyframeId, placed: &Tracked) -> Option<Sighting> {
    let is_measured = |m: &&Match| frame.map.landmark(m.landmark).is_some_and(|l| l.assumed.is_none());
    let found: Vec<Match> = tracker.inliers().filter(is_measured).copied().collect();
    shows_a_place(&found, frame.camera).then_some(Sighting { keyframe, there: placed.camera_from_world, found })
}

/// The keyframe, other than the one that was recognised, that sees most of what was found.
pub fn seen_most_by(map: &Map, sighting: &Sighting) -> Option<KeyframeId> {
    let mut votes: Vec<(KeyframeId, u32)> = Vec::new();
    for m in &sighting.found {
        let observers = map.landmark(m.landmark).into_iter().flat_map(|l| &l.observers);
        observers.for_each(|k| vote(&mut votes, *k));
    }
    Some(votes.iter().filter(|v| v.0 != sighting.keyframe).max_by_key(|&&(k, n)| (n, k))?.0)
}

/// The similarity, present from other, that two keyframes tell, if it is the same. `min_parallax`: of what they triangulate, rad.
pub fn similarity(
    map: &Map,
    other: &Map,
    [first, second]: [&Sighting; 2],
    readout_s: f64,
    min_parallax: f64,
) -> Option<Similarity> {
    let mut ratios = depth_ratios(map, first, other);
    ratios.extend(depth_ratios(map, second, other));
    ratios.extend(triangulated_ratios(map, [first, second], readout_s, min_parallax));
    let (scale, log_scale_sigma) = agreed_ratio(&mut ratios)?;
    let (a, b) = (first.similarity(map, scale)?, second.similarity(map, scale)?);
    let baseline = scale * (first.there.inverse().translation - second.there.inverse().translation).norm();
    let has = |m: &&Match| first.found.binary_search_by_key(&m.landmark, |m| m.landmark).is_ok();
    let common = second.found.iter().filter(has).count();
    if baseline < APART_DEPTHS * scale * second.mean_depth() && 2 * common > second.found.len() {
        return None;
    }
    (second.agrees(&b, &a) && b.is_valid()).then_some(Similarity { present_from_other: b, log_scale_sigma })
}

/// What was observed nearest to where a landmark of another map was found, if that is the same corner.
pub fn at_corner(seen: &Observations, m: &Match) -> Option<LandmarkId> {
    let apart = seen.pixels().map(|(landmark, pixel)| (landmark, (pixel - m.pixel).norm()));
    apart.filter(|o| o.1 < SAME_CORNER_PX).min_by(|a, b| a.1.total_cmp(&b.1)).map(|o| o.0)
}

/// Logarithms of the ratios of the depths, present to other, of the corners of a keyframe that are landmarks of both maps.
pub fn depth_ratios(map: &Map, sighting: &Sighting, other: &Map) -> Vec<f64> {
    let Some(keyframe) = map.keyframe(sighting.keyframe) else { return Vec::new() };
    let measured = |map: &Map, id: LandmarkId| Some(map.landmark(id).filter(|l| l.assumed.is_none())?.position);
    let ratio = |m: &Match| {
        let own = measured(map, at_corner(&keyframe.observations, m)?)?;
        let (here, there) = (keyframe.camera_from_world.transform(&own).z, measured(other, m.landmark)?);
        log_ratio(here, sighting.there.transform(&there).z)
    };
    sighting.found.iter().filter_map(ratio).collect()
}

/// The same of the other map's landmarks that both keyframes see, triangulated in the present one.
fn triangulated_ratios(map: &Map, [a, b]: [&Sighting; 2], readout_s: f64, min_parallax: f64) -> Vec<f64> {
    let (Some(first), Some(second)) = (map.keyframe(a.keyframe), map.keyframe(b.keyframe)) else { return Vec::new() };
    let (first, second) = (first.camera_from_world, second.camera_from_world);
    let ratio = |m: &Match| {
        let i = a.found.binary_search_by_key(&m.landmark, |m| m.landmark).ok()?;
        let (point, angle) =
            triangulate(&first, &a.found[i].at_middle_row(readout_s), &second, &m.at_middle_row(readout_s))?;
        let (here, there) = (second.transform(&point).z, b.there.transform(&m.point).z);
        log_ratio(here, there).filter(|_| angle >= min_parallax)
    };
    b.found.iter().filter_map(ratio).collect()
}

pub fn log_ratio(here: f64, there: f64) -> Option<f64> {
    (here > 0.0 && there > 0.0).then(|| (here / there).ln())
}

/// The median of such ratios and the standard deviation of its logarithm; `None` if too few tell it, or too differently.
pub fn agreed_ratio(logarithms: &mut [f64]) -> Option<(f64, f64)> {
    let n = logarithms.len();
    let middle = median(logarithms).filter(|_| n >= MIN_COMMON)?;
    let mut off: Vec<f64> = logarithms.iter().map(|r| (r - middle).abs()).collect();
    // Of a normal distribution: its standard deviation from the median deviation, and the median's from that.
    let sigma = SIGMA_OVER_MEDIAN * median(&mut off)? * (std::f64::consts::FRAC_PI_2 / n as f64).sqrt();
    (sigma <= MAX_SCALE_SIGMA).then(|| (middle.exp(), sigma))
}

/// A map has ended: the last poses of its keyframes.
pub fn retire(map: &Map, events: &mut Vec<TrajectoryEvent>) {
    events.extend(map.keyframes.iter().map(|(id, k)| TrajectoryEvent::KeyframeRetired {
        keyframe: KeyframeId(id),
        world_from_camera: k.camera_from_world.inverse(),
    }));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::random::Random;
    use crate::map::{Keyframe, Landmark, Observation, examples};
    use nalgebra::{Matrix2, Matrix3, UnitQuaternion, Vector2, Vector3};

    /// Two keyframes of the present map that see the same 40 points of another one, whose unit is a third of it.
    struct Scene {
        present: Map,
        other: Map,
        sightings: [Sighting; 2],
        present_from_other: Sim3<World, World>,
    }

    fn keyframe(camera_from_world: Se3<Camera, World>) -> Keyframe {
        examples::keyframe(Default::default(), camera_from_world)
    }

    fn landmark(position: Vector3<f64>) -> Landmark {
        Landmark::new(position, Matrix3::identity() * 1e-6, KeyframeId(0))
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
                    template: far[0],
                    point: there,
                    pixel,
                    normalised,
                    displacement: Vector2::zeros(),
                    inv_sigma_px: 1.0,
                    inlier: true,
                    is_alike: true,
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
        Some(similarity(&scene.present, &scene.other, scene.sightings.each_ref(), 0.0, 0.01)?.present_from_other)
    }

    fn is_right(scene: &Scene, told: &Sim3<World, World>) -> bool {
        let x = Vector3::new(0.3, -0.7, 2.0);
        (told.transform(&x) - scene.present_from_other.transform(&x)).norm() < 1e-9
    }

    #[test]
    fn two_keyframes_tell_the_similarity_by_common_corners_or_by_triangulation() {
        for (known, baseline) in [(40, 0.5), (0, 0.5), (4, 0.5)] {
            let scene = scene(known, baseline);
            let told = told(&scene).unwrap_or_else(|| panic!("{known} common corners, baseline {baseline}"));
            assert!(is_right(&scene, &told), "{told:?}");
        }
    }

    #[test]
    fn nothing_is_told_without_depths_or_where_they_or_the_poses_disagree() {
        assert!(told(&scene(3, 0.01)).is_none(), "no parallax, three common corners");
        assert!(told(&scene(40, 0.01)).is_none(), "one witness, heard twice");
        let mut apart = scene(40, 0.5);
        apart.sightings[0].there.translation.y += 0.5;
        assert!(told(&apart).is_none(), "another place");
        let mut turned = scene(40, 0.5);
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.0, 0.1, 0.0));
        turned.sightings[0].there.rotation = turn * turned.sightings[0].there.rotation;
        assert!(told(&turned).is_none(), "another direction");
        let mut random = Random::new(6);
        let mut torn = scene(40, 0.5);
        let places: Vec<_> = torn.present.landmarks.iter().map(|(id, l)| (LandmarkId(id), l.position)).collect();
        for (id, position) in places {
            torn.present.place_landmark(id, position * random.uniform(0.2, 3.0));
        }
        torn.sightings[0].found.truncate(20);
        torn.sightings[1].found.drain(..20);
        assert!(told(&torn).is_none(), "depths that have nothing in common");
    }

    fn map(id: u32, keyframes: usize) -> OtherMap {
        let mut map = Map::default();
        (0..keyframes).for_each(|_| {
            map.add_keyframe(keyframe(Se3::identity()));
        });
        OtherMap::new(ActiveMap::new(map, MapId(id)))
    }

    #[test]
    fn as_many_maps_are_kept_as_there_is_room_for_and_the_smallest_go() {
        let mut others = OtherMaps::default();
        for (id, keyframes) in [(0, 5), (1, 9), (2, 7), (3, 6)] {
            assert!(others.keep(map(id, keyframes), 40).is_empty());
        }
        let sizes = |gone: &[Map]| gone.iter().map(|m| m.keyframes.len()).collect::<Vec<_>>();
        assert_eq!(sizes(&others.keep(map(4, 8), 40)), [5], "a fifth");
        assert_eq!(sizes(&others.keep(map(5, 30), 40)), [6, 7, 8], "54, 47; 39 have room");
        let kept: Vec<u32> = others.kept.iter().map(|other| other.own.id.0).collect();
        assert_eq!(kept, [1, 5], "in the order in which they were lost");
        assert_eq!(sizes(&others.keep(map(6, 50), 40)), [9, 30], "the last one stays, however large");
    }

    #[test]
    fn a_map_that_came_by_a_command_stays_until_it_is_joined_and_takes_no_room() {
        let mut others = OtherMaps::default();
        (10..15).for_each(|id| others.add(OtherMap { is_merged: true, ..map(id, 4) }));
        for id in 0..4 {
            assert!(others.keep(map(id, 9), 40).is_empty());
        }
        let gone: Vec<usize> = others.keep(map(4, 20), 40).iter().map(|m| m.keyframes.len()).collect();
        assert_eq!((gone, others.merged().count()), (vec![9, 9], 5));
        assert!(others.keep(map(5, 80), 40).len() == 3 && others.kept.len() == 6);
    }
}
