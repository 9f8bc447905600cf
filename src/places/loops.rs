//! Closing a loop: what a keyframe that saw an old place again means for all that lie between.
//!
//! Input: a copy of the keyframes' poses, which of them share landmarks, and where a recognised keyframe lies to an old one. Output: how the
//! surroundings of each keyframe move ([`Correction`]). The nodes of the graph are the keyframes, its edges the essential ones (Mur-Artal et al. 2015,
//! section VII): the way, the strongest links of each keyframe to older ones, all links that are strong anyway, and loops that were closed before. A link
//! says that the two lie as they do now and have one scale, as surely as the landmarks that they share tell it: where the camera passed a bare wall or
//! saw far things only, there most of the drift came in, and there it is taken out. A turn that told no scale is the utmost of that.
//! The way ends where a map of another number begins: keyframes are numbered on, but nobody knows how the camera moved there. (A map that was
//! loaded keeps its number, so runs that went on in it are one way.) Only where nothing else holds
//! two parts of the graph together do they stay as they lie there. The oldest keyframe of the map that the newest one was made in stays where it is,
//! unless most others would have to move for it: after months it may hang on the rest by a few landmarks, and places that a planner has stored lie
//! where most keyframes do.
//!
//! It is a piece of work on a copy, so that it can run anywhere and be merged later; cost as [`pose_graph`](crate::geometry::pose_graph).
//! Not here: who recognises, and what is fused afterwards (`reconstruction`).

use nalgebra::Vector3;

use crate::geometry::frames::{Camera, World};
use crate::geometry::least_squares::LmOptions;
use crate::geometry::pose_graph::{Edge, EdgeSigma, solve};
use crate::geometry::sim3::Sim3;
use crate::geometry::{Se3, median};
use crate::map::{Correction, Keyframe, KeyframeId, Map};

/// Links to older keyframes that every keyframe has, if it shares anything with so many.
const LINKS: usize = 3;
/// Shared landmarks that make a link of any two keyframes, and such links of one keyframe at the most.
const STRONG: u32 = 60;
const MOST_LINKS: usize = 10;
/// How surely one landmark that both see says how they lie to each other: rotation, rad, and way, as a share of the scene's depth. Only the ratios of
/// these and of the landmarks' own deviations count.
const SIGMA_RAD: f64 = 0.04;
const SIGMA_DEPTHS: f64 = 0.08;
/// Where nothing told the scale, as a turn on the spot does not, its logarithm is as unsure as this.
const SIGMA_UNTOLD_SCALE: f64 = 0.5;
/// Where the map's lengths are known from elsewhere no loop changes them.
const SIGMA_HELD_SCALE: f64 = 1e-4;
/// Levenberg-Marquardt steps at the most.
const STEPS: usize = 30;
/// The oldest keyframe does not stay where the others would then move so many times as far in all as with another one held; so many are tried,
/// evenly spread.
/// (Drift that grows with the way moves twice as much about its beginning as about its middle.)
const MOVES_MORE: f64 = 3.0;
const HELD_TRIED: usize = 64;

/// A keyframe that was recognised: where it lies to an old one. Later corrections of the map move both, so of loops that were closed the pair is kept.
#[derive(Debug, Clone, Copy)]
pub struct LoopEdge {
    pub old: KeyframeId,
    pub recognised: KeyframeId,
    /// The scale is the old surroundings' unit in the recognised keyframe's.
    pub recognised_from_old: Sim3<Camera, Camera>,
    /// Standard deviation of the logarithm of that scale.
    pub log_scale_sigma: f64,
    /// Landmarks that say so.
    pub landmarks: usize,
}

/// Work to be done. See the module.
#[derive(Debug)]
pub struct LoopClosure {
    /// Ascending id; the nodes.
    keyframes: Vec<KeyframeId>,
    poses: Vec<Se3<Camera, World>>,
    /// Median depths of what they see, map units.
    depths: Vec<f64>,
    oldest: usize,
    /// Of this run; of a map that was merged numbers may be greater.
    youngest: usize,
    edges: Vec<Edge>,
}

impl LoopClosure {
    /// `closed`: earlier loops, which hold as the map is now. `is_metric`: the map's lengths are known from elsewhere, so that a loop corrects
    /// six degrees of freedom. `None` where an end of the loop is not in the map.
    pub fn new(
        map: &Map,
        newest: KeyframeId,
        told: &[LoopEdge],
        closed: &[(KeyframeId, KeyframeId)],
        is_metric: bool,
    ) -> Option<Self> {
        let keyframes: Vec<KeyframeId> = map.keyframes.iter().map(|(id, _)| KeyframeId(id)).collect();
        let place = |id: KeyframeId| keyframes.binary_search(&id).ok();
        let own = map.keyframe(newest)?.map;
        let oldest = map.keyframes.iter().position(|(_, k)| k.map == own)?;
        let youngest = place(map.newest()?)?;
        let mut edges = Vec::new();
        let depths: Vec<f64> = map.keyframes.iter().map(|(_, k)| depth(k, map)).collect();
        let mut link = |a: KeyframeId, b: KeyframeId| {
            let ends = place(a).zip(place(b));
            edges.extend(ends.and_then(|(from, to)| held(map, (a, from), (b, to), &depths)));
        };
        let mut around = Vec::new();
        for &id in &keyframes {
            older_links(map, id, &mut around);
            around.iter().for_each(|&other| link(other, id));
            // The way, wherever nothing is shared.
            if let Some(before) = followed(map, id).filter(|k| !around.contains(k)) {
                link(before, id);
            }
        }
        for &(old, recognised) in closed {
            link(old, recognised);
        }
        let mut parts = Parts::new(keyframes.len(), &edges);
        for (i, ids) in keyframes.windows(2).enumerate() {
            if parts.unite(i, i + 1) {
                edges.extend(held(map, (ids[0], i), (ids[1], i + 1), &depths));
            }
        }
        let first = edges.len();
        for told in told {
            let (from, to) = (place(told.old)?, place(told.recognised)?);
            let sigma = sigma(told.landmarks, depths[to], told.log_scale_sigma);
            edges.push(Edge { from, to, to_from_from: told.recognised_from_old, sigma });
        }
        (edges.len() > first).then_some(())?;
        if is_metric {
            edges.iter_mut().for_each(hold_scale);
        }
        let poses = map.keyframes.iter().map(|(_, k)| k.camera_from_world).collect();
        Some(Self { keyframes, poses, depths, oldest, youngest, edges })
    }

    /// Bounded in iterations, not in time. `None` if nothing better was found, or nothing that can be.
    pub fn run(&self) -> Option<Correction> {
        let options = LmOptions { max_iterations: STEPS, relative_cost: 1e-6, ..LmOptions::default() };
        let start = self.poses.iter().map(Sim3::from_se3).collect();
        let fixed: Vec<bool> = (0..self.poses.len()).map(|i| i == self.oldest).collect();
        let (solved, summary) = solve(start, &fixed, &self.edges, &options).ok()?;
        if !(summary.final_cost < summary.initial_cost) || !solved.iter().all(Sim3::is_valid) {
            return None;
        }
        let moved = |(pose, new): (&Se3<Camera, World>, &Sim3<Camera, World>)| new.inverse() * Sim3::from_se3(pose);
        let mut moved: Vec<_> = self.poses.iter().zip(&solved).map(moved).collect();
        if let Some(held) = self.held_instead(&moved) {
            let back = moved[held].inverse();
            moved.iter_mut().for_each(|moved| *moved = back * *moved);
        }
        let younger = moved.get(self.youngest).copied();
        let keyframes = self.keyframes.iter().copied().zip(moved).collect();
        Some(Correction { keyframes, younger })
    }

    /// The keyframe that is to stay where it is instead of the oldest, if most of the map stays with it.
    fn held_instead(&self, moved: &[Sim3<World, World>]) -> Option<usize> {
        // Where each camera is, and what lies before it.
        let shown = |(pose, depth): (&Se3<Camera, World>, &f64)| {
            let centre = pose.inverse().translation;
            [centre, pose.inverse().transform(&(Vector3::z() * *depth))]
        };
        let before: Vec<[Vector3<f64>; 2]> = self.poses.iter().zip(&self.depths).map(shown).collect();
        let in_all = |held: usize| -> f64 {
            let back = moved[held].inverse();
            let way = |(points, moved): (&[Vector3<f64>; 2], &Sim3<World, World>)| -> f64 {
                points.iter().map(|x| (back.transform(&moved.transform(x)) - x).norm()).sum()
            };
            before.iter().zip(moved).map(way).sum()
        };
        let tried = (0..moved.len()).step_by(moved.len().div_ceil(HELD_TRIED));
        let best = tried.map(|i| (i, in_all(i))).min_by(|a, b| a.1.total_cmp(&b.1))?;
        (in_all(self.oldest) > MOVES_MORE * best.1).then_some(best.0)
    }
}

/// The keyframe from which the camera was followed to this one: the one before it in the same map. Where that began it was lost, or another run's.
pub(super) fn followed(map: &Map, id: KeyframeId) -> Option<KeyframeId> {
    let own = map.keyframe(id)?.map;
    let mut before = id.0;
    loop {
        before = map.keyframes.last_before(before)?;
        if map.keyframe(KeyframeId(before))?.map == own {
            return Some(KeyframeId(before));
        }
    }
}

/// The reverse.
pub(super) fn following(map: &Map, id: KeyframeId) -> Option<KeyframeId> {
    let own = map.keyframe(id)?.map;
    let mut after = map.keyframes.ids_from(id.0 + 1).map(KeyframeId);
    after.find(|id| map.keyframe(*id).is_some_and(|k| k.map == own))
}

/// Nodes that edges hold together.
struct Parts {
    /// Another node of the same part, or the node itself.
    of: Vec<usize>,
}

impl Parts {
    fn new(nodes: usize, edges: &[Edge]) -> Self {
        let mut parts = Self { of: (0..nodes).collect() };
        for edge in edges {
            parts.unite(edge.from, edge.to);
        }
        parts
    }

    fn find(&mut self, mut node: usize) -> usize {
        while self.of[node] != node {
            self.of[node] = self.of[self.of[node]];
            node = self.of[node];
        }
        node
    }

    /// Whether they were two.
    fn unite(&mut self, a: usize, b: usize) -> bool {
        let (a, b) = (self.find(a), self.find(b));
        self.of[a.max(b)] = a.min(b);
        a != b
    }
}

/// Older keyframes that a keyframe is linked with, strongest first.
fn older_links(map: &Map, id: KeyframeId, out: &mut Vec<KeyframeId>) {
    out.clear();
    let Some(keyframe) = map.keyframe(id) else { return };
    let mut older: Vec<_> = keyframe.covisible.iter().filter(|c| c.0 < id).copied().collect();
    older.sort_unstable_by(|a, b| b.1.cmp(&a.1).then(b.0.cmp(&a.0)));
    let strong = older.iter().take_while(|c| c.1 >= STRONG).count();
    out.extend(older.iter().take(strong.clamp(LINKS, MOST_LINKS)).map(|c| c.0));
}

/// Two keyframes (the numbers of their nodes with them) lie as they do now.
fn held(map: &Map, from: (KeyframeId, usize), to: (KeyframeId, usize), depths: &[f64]) -> Option<Edge> {
    let ((a, from), (b, to)) = (from, to);
    let (a, b) = (map.keyframe(a)?, map.keyframe(b)?);
    let to_from_from = Sim3::from_se3(&(b.camera_from_world * a.camera_from_world.inverse()).relabel());
    let (shared, mut log_scale) = shared(map, a, b);
    if a.scale_from != b.scale_from {
        log_scale = SIGMA_UNTOLD_SCALE;
    }
    Some(Edge { from, to, to_from_from, sigma: sigma(shared, depths[to], log_scale) })
}

/// Landmarks that both see, and the standard deviation of the logarithm of the scale that `b` has from `a` by them: each tells it as surely as its
/// distance is known.
fn shared(map: &Map, a: &Keyframe, b: &Keyframe) -> (usize, f64) {
    let centre = b.centre();
    let (mut count, mut information) = (0, 0.0);
    let mut own = b.observations.landmarks().peekable();
    for seen in a.observations.landmarks() {
        while own.next_if(|o| *o < seen).is_some() {}
        let Some(id) = own.next_if(|o| *o == seen) else { continue };
        let Some(landmark) = map.landmark(id).filter(|l| l.assumed.is_none()) else { continue };
        let ray = landmark.position - centre;
        // Of the distance d along the ray: (sigma / d)² = rᵀ P r / d⁴.
        let told = ray.norm_squared().powi(2) / ray.dot(&(landmark.covariance * ray));
        count += 1;
        information += if told.is_finite() { told.max(0.0) } else { 0.0 };
    }
    (count, 1.0 / information.sqrt())
}

/// Median depth of what a keyframe sees, map units.
fn depth(keyframe: &Keyframe, map: &Map) -> f64 {
    let depth = |id| Some(keyframe.camera_from_world.transform(&map.landmark(id)?.position).z);
    let mut depths: Vec<f64> = keyframe.observations.landmarks().filter_map(depth).filter(|z| *z > 0.0).collect();
    median(&mut depths).unwrap_or(1.0)
}

/// Of what `landmarks` tell; `log_scale`: standard deviation of that.
fn sigma(landmarks: usize, depth: f64, log_scale: f64) -> EdgeSigma {
    let share = 1.0 / (landmarks.max(1) as f64).sqrt();
    EdgeSigma {
        rotation_rad: SIGMA_RAD * share,
        translation: SIGMA_DEPTHS * depth * share,
        log_scale: log_scale.clamp(SIGMA_HELD_SCALE, SIGMA_UNTOLD_SCALE),
    }
}

/// Both ends have the unit that they have.
fn hold_scale(edge: &mut Edge) {
    let Sim3 { scale, rotation, translation, .. } = edge.to_from_from;
    edge.to_from_from = Sim3::new(1.0, rotation, translation / scale);
    edge.sigma.log_scale = SIGMA_HELD_SCALE;
}

#[cfg(test)]
mod tests;
