//! From tracks alone to a first map.
//!
//! Views are held while their tracks live, and the oldest of them is the reference. Once the flow that a rotation cannot explain is
//! large enough, two-view geometry is tried (essential matrix or homography, [`two_view`](crate::geometry::two_view)): from the
//! oldest view, which has the longest baseline, and from the oldest that shares half of today's tracks, which has more points.
//! Standing still and turning on the spot never pass: their rotation-compensated flow stays at the noise. What a rotation seen through
//! another lens than the supposed one explains is taken out as well, as far as the lens is uncertain (`turn`). All frames in between
//! are remembered by their tracks, so that their poses can be solved once there is a map. Where tracks are few, views that they do not join
//! are asked as well ([`untracked`](super::untracked)).

use std::collections::VecDeque;

use nalgebra::{Vector2, Vector3};

use super::turn::{Pair, unexplained_px};
use super::untracked::UntrackedViews;
use super::views::{MAX_BETWEEN, MIN_COMMON, Pairs, View, Views};
use crate::features::{FrameFeatures, Track};
use crate::geometry::frames::{First, Second};
use crate::geometry::two_view::{TwoViewOptions, reconstruct_two_views};
use crate::geometry::{CameraModel, Se3};
use crate::reconstruction::adjust::intrinsics::SupposedLens;
use crate::reconstruction::config::ReconstructionConfig;
use crate::reconstruction::consensus::{FrameTracks, MAX_DISAGREEMENTS};
use crate::reconstruction::keyframe::epipolar::FED;
use crate::reconstruction::measurement::TWO_VIEW_SIGMA_PX;

/// A first map: the motion between two frames, points, and views in between to hold them together.
#[derive(Debug)]
pub struct Start {
    pub views: Views,
    /// Some of its points are corners that no track follows, known again by what they look like.
    pub by_corners: bool,
    pub second_from_first: Se3<Second, First>,
    /// Track and place in the first camera's coordinates.
    pub points: Vec<(u64, Vector3<f64>)>,
}

/// Frames that are remembered for a pose afterwards; older ones are dropped.
const MAX_PENDING: usize = 900;
/// So long after the camera began to move, s, corners that look alike are asked as well as tracks: a turn on the spot before a lens that nobody has
/// calibrated begins a map by them else; and where frames are many tracks alone have given a start by then, a later one with more parallax.
const CORNERS_AFTER_S: f64 = 0.25;
/// Rotation-compensated flow since the reference at which the camera counts as moving, px.
const MOVING_FLOW_PX: f64 = 1.0;
/// A camera without such flow for so long since the reference stands, s.
const STANDING_S: f64 = 0.5;
/// One frame adds at most this much to the time spent trying, s.
const LONGEST_STEP_S: f64 = 0.5;

/// Waits for a start.
#[derive(Debug, Default)]
pub struct Initialiser {
    /// The reference, and views since then, every `stride`-th frame.
    views: Vec<View>,
    stride: u64,
    since_reference: u64,
    /// How often a start must still agree with the picture before one is believed.
    disagreements: u32,
    /// A start of this frame has been asked; another one shares its picture.
    voted: bool,
    /// How long the camera has moved without a start, s: standing still takes it back. It outlasts the reference.
    pub trying_s: f64,
    last_ns: Option<i64>,
    lengths: Vec<f64>,
    untracked: UntrackedViews,
    /// All frames since the last reset, or since the map before was lost, that may still get a pose, the reference among them.
    pub pending: VecDeque<FrameTracks>,
}

impl Initialiser {
    pub fn clear(&mut self) {
        self.begin_at(None);
        self.pending.clear();
        self.untracked.clear();
        self.trying_s = 0.0;
        self.last_ns = None;
        self.disagreements = 0;
    }

    /// After a map that has failed: these frames have no pose, and the next start must agree as often as may be asked.
    pub fn begin_again(&mut self, mut frames: Vec<FrameTracks>) {
        frames.drain(..frames.len().saturating_sub(MAX_PENDING));
        self.pending = frames.into();
        self.disagreements = MAX_DISAGREEMENTS;
    }

    fn begin_at(&mut self, reference: Option<View>) {
        self.views.clear();
        self.views.extend(reference);
        self.stride = 1;
        self.since_reference = 0;
    }

    /// A start disagreed with too much of the picture: something moves there. Of many tries one will seem to agree by chance, so the
    /// next ones must agree as often as they disagreed before one is believed.
    pub fn disagree(&mut self) {
        if !std::mem::replace(&mut self.voted, true) {
            self.disagreements = (self.disagreements + 1).min(MAX_DISAGREEMENTS);
        }
    }

    /// A start agrees; true if nothing speaks against it any more.
    pub fn agree(&mut self) -> bool {
        if std::mem::replace(&mut self.voted, true) {
            return false;
        }
        let settled = self.disagreements == 0;
        self.disagreements = self.disagreements.saturating_sub(1);
        settled
    }

    /// Keeps every `stride`-th view; the stride doubles as often as there is no more room.
    fn keep(&mut self, view: impl FnOnce() -> View) {
        self.since_reference += 1;
        if !self.since_reference.is_multiple_of(self.stride) {
            return;
        }
        if self.views.len() > MAX_BETWEEN {
            let mut n = 0;
            self.views.retain(|_| {
                n += 1;
                n % 2 == 1
            });
            self.stride *= 2;
            if !self.since_reference.is_multiple_of(self.stride) {
                return;
            }
        }
        self.views.push(view());
    }

    /// Takes a frame; what it could start together with a view before, best first. `lens`: what `camera` is believed to be.
    pub fn step(
        &mut self,
        features: &FrameFeatures,
        camera: &CameraModel,
        lens: SupposedLens,
        config: &ReconstructionConfig,
    ) -> Vec<Start> {
        let followed = self.follow(features, camera);
        let few = followed.as_ref().is_none_or(|pairs| pairs.tracks.len() < FED);
        let mut starts = match followed {
            Some(pairs) => self.starts_by_tracks(features, pairs, camera, lens, config),
            None => Vec::new(),
        };
        if few {
            starts.extend(self.starts_by_corners(features, camera, lens, config));
        }
        self.remember(features);
        starts
    }

    /// From the reference and, where tracks have come since, a later view.
    fn starts_by_tracks(
        &mut self,
        features: &FrameFeatures,
        pairs: Pairs,
        camera: &CameraModel,
        lens: SupposedLens,
        config: &ReconstructionConfig,
    ) -> Vec<Start> {
        let flow = unexplained_px(&pairs.places, lens, &mut self.lengths);
        self.spend_patience(features.timestamp_ns, flow);
        let richer = |pairs: &Pairs| 2 * pairs.tracks.len() >= features.tracks.len();
        let second = if richer(&pairs) {
            None
        } else {
            let pairs = |v: &View| pairs_with(v, features, camera).filter(richer);
            self.views.iter().enumerate().skip(1).find_map(|(i, v)| Some((i, pairs(v)?)))
        };
        let second = second.map(|(i, pairs)| (i, unexplained_px(&pairs.places, lens, &mut self.lengths), pairs));
        let starts = std::iter::once((0, flow, pairs)).chain(second).filter_map(|(i, flow, pairs)| {
            if flow < config.start_flow_px {
                return None;
            }
            let (first, between) = self.views.get(i..)?.split_first()?;
            let views = Views { first: first.clone(), between: between.to_vec(), newest: FrameTracks::of(features) };
            self.attempt(views, &pairs, camera, config)
        });
        starts.collect()
    }

    /// From views that tracks and corners join, the oldest first.
    fn starts_by_corners(
        &mut self,
        features: &FrameFeatures,
        camera: &CameraModel,
        lens: SupposedLens,
        config: &ReconstructionConfig,
    ) -> Vec<Start> {
        let mut starts = Vec::new();
        // Where no view's tracks are alive, corners tell whether the camera moves: then they are matched from the first frame on.
        let are_alive = self.last_ns == Some(features.timestamp_ns);
        if are_alive && self.trying_s < CORNERS_AFTER_S {
            return starts;
        }
        for (n, shared) in self.untracked.shared_with(features, camera).iter().enumerate() {
            let flow = unexplained_px(&shared.pairs.places, lens, &mut self.lengths);
            if n == 0 && !are_alive {
                self.spend_patience(features.timestamp_ns, flow);
            }
            if self.trying_s < CORNERS_AFTER_S {
                break;
            }
            if flow < config.start_flow_px {
                continue;
            }
            let Some(views) = self.untracked.views(shared, features) else { continue };
            let start = self.attempt(views, &shared.pairs, camera, config);
            starts.extend(start.map(|start| Start { by_corners: true, ..start }));
        }
        starts
    }

    /// Remembers a frame without asking for a start: while there is still hope for another map. The way that the camera goes meanwhile is
    /// time spent trying all the same.
    pub fn watch(&mut self, features: &FrameFeatures, camera: &CameraModel, lens: SupposedLens) {
        if let Some(pairs) = self.follow(features, camera) {
            let flow = unexplained_px(&pairs.places, lens, &mut self.lengths);
            self.spend_patience(features.timestamp_ns, flow);
        }
        self.remember(features);
    }

    fn remember(&mut self, features: &FrameFeatures) {
        self.untracked.hold(features);
        // A reference that this frame has become is there already.
        if self.views.last().is_some_and(|v| v.frame.sequence != features.sequence) {
            self.keep(|| View::of(features));
        }
    }

    /// Follows the tracks into a frame: those that the reference shares with it. `None` if no view does; then this frame becomes the
    /// reference.
    fn follow(&mut self, features: &FrameFeatures, camera: &CameraModel) -> Option<Pairs> {
        self.voted = false;
        self.pending.push_back(FrameTracks::of(features));
        if self.pending.len() > MAX_PENDING {
            self.pending.pop_front();
        }
        // Views that have lost their tracks make room for the next ones, which have some of the way behind them, too.
        let pairs = |v: &View| pairs_with(v, features, camera);
        let alive = self.views.iter().enumerate().find_map(|(i, v)| Some((i, pairs(v)?)));
        let Some((dead, pairs)) = alive else {
            self.begin_at((features.tracks.len() >= MIN_COMMON).then(|| View::of(features)));
            return None;
        };
        self.views.drain(..dead);
        if dead > 0 && self.views.len() <= MAX_BETWEEN / 2 {
            // There is room again, and a view that took over needs some in between soon.
            self.stride = 1;
            self.since_reference = 0;
        }
        Some(pairs)
    }

    /// Notes for how long the camera has moved, or stood: `flow_px` since the reference, compensated for rotation.
    fn spend_patience(&mut self, timestamp_ns: i64, flow_px: f64) {
        let since = |then: i64| (timestamp_ns - then) as f64 * 1e-9;
        let step_s = self.last_ns.map_or(0.0, since).clamp(0.0, LONGEST_STEP_S);
        self.last_ns = Some(timestamp_ns);
        if flow_px >= MOVING_FLOW_PX {
            self.trying_s += step_s;
        } else if self.views.first().is_some_and(|r| since(r.frame.timestamp_ns) > STANDING_S) {
            self.trying_s = (self.trying_s - step_s).max(0.0);
        }
    }

    /// Two-view geometry between the first and the newest of these views.
    fn attempt(
        &self,
        views: Views,
        pairs: &Pairs,
        camera: &CameraModel,
        config: &ReconstructionConfig,
    ) -> Option<Start> {
        let seen_first: Vec<Vector2<f64>> = pairs.places.iter().map(|p| p.first).collect();
        let seen_newest: Vec<Vector2<f64>> = pairs.places.iter().map(|p| p.second).collect();
        let options =
            TwoViewOptions { seed: views.newest.sequence, ..TwoViewOptions::new(TWO_VIEW_SIGMA_PX, camera.focal_px()) };
        let solution = reconstruct_two_views(&seen_first, &seen_newest, &options).ok()?;
        let places = pairs.tracks.iter().zip(&solution.points);
        let points: Vec<_> = places.filter_map(|(&track, point)| Some((track, (*point)?))).collect();
        (points.len() >= config.start_landmarks).then_some(Start {
            views,
            by_corners: false,
            second_from_first: solution.second_from_first,
            points,
        })
    }
}

/// Tracks that a view shares with a frame, if they are enough; of a wide-angle lens where the plane z = 1 is even, as two-view geometry
/// weighs all alike.
fn pairs_with(view: &View, features: &FrameFeatures, camera: &CameraModel) -> Option<Pairs> {
    let pair = |t: &Track| Some((t.id, Pair::between(&view.frame.track(t.id)?, &t.position, camera)?));
    let (tracks, places): (Vec<_>, Vec<_>) = features.tracks.iter().filter_map(pair).unzip();
    (tracks.len() >= MIN_COMMON.max(view.frame.tracks.len() / 4)).then_some(Pairs { tracks, places })
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENS: SupposedLens =
        SupposedLens { focal_px: 500.0, focal_sigma: 0.01, centre_sigma_px: 0.1, distortion_sigma: 0.02 };

    /// Where a camera that has moved so sees some eighty points.
    fn places(moved: Vector3<f64>) -> Vec<Vector2<f64>> {
        let mut places = Vec::new();
        for i in 0..10 {
            for j in 0..8 {
                let depth = 3.0 + ((i * 7 + j * 3) % 5) as f64 * 0.5;
                let n = Vector2::new((i as f64 - 4.5) * 0.1, (j as f64 - 3.5) * 0.1);
                let p = n.push(1.0) * depth + moved;
                places.push(p.xy() / p.z);
            }
        }
        places
    }

    #[test]
    fn patience_is_spent_by_moving_outlasts_the_reference_and_comes_back_while_standing() {
        let camera = CameraModel::new(640, 480, 500.0, 500.0, 320.0, 240.0, [0.0; 5]).unwrap();
        // No start is tried: only the time counts here.
        let config = ReconstructionConfig { start_flow_px: 100.0, ..ReconstructionConfig::default() };
        let mut initialiser = Initialiser::default();
        let mut frames = 0;
        let mut go_on = |seconds: f64, first_id: u64, step: f64| {
            for n in 0..(seconds * 30.0) as usize {
                let moved = Vector3::new(0.15 + step * n as f64, 0.0, 0.0);
                let tracks = places(moved).into_iter().enumerate().map(|(i, p)| Track {
                    id: first_id + i as u64,
                    position: (p * 500.0 + Vector2::new(320.0, 240.0)).cast(),
                    age: 1,
                });
                let features = FrameFeatures {
                    sequence: frames,
                    timestamp_ns: frames as i64 * 33_333_333,
                    tracks: tracks.collect(),
                    ..FrameFeatures::default()
                };
                assert!(initialiser.step(&features, &camera, LENS, &config).is_empty());
                frames += 1;
            }
            initialiser.trying_s
        };
        assert_eq!(go_on(3.0, 0, 0.0), 0.0, "standing");
        let moving = go_on(1.0, 0, 0.02);
        assert!((0.5..=1.0).contains(&moving), "{moving} s of trying after a second of motion");
        let again = go_on(1.0, 1000, 0.02);
        assert!(again > moving + 0.5, "{again} s after another with new tracks");
        assert_eq!(go_on(4.0, 2000, 0.0), 0.0, "after standing again");
    }

    #[test]
    fn a_view_that_has_lost_its_tracks_gives_way_to_the_next_one() {
        let camera = CameraModel::new(640, 480, 500.0, 500.0, 320.0, 240.0, [0.0; 5]).unwrap();
        let config = ReconstructionConfig { start_flow_px: 100.0, ..ReconstructionConfig::default() };
        let mut initialiser = Initialiser::default();
        // Five of eighty tracks are lost in every frame: after four of them sixty are left.
        for n in 0..6 {
            let tracks = places(Vector3::zeros()).into_iter().enumerate().map(|(i, p)| Track {
                id: 5 * n + i as u64,
                position: (p * 500.0 + Vector2::new(320.0, 240.0)).cast(),
                age: 1,
            });
            let features = FrameFeatures { sequence: n, tracks: tracks.collect(), ..FrameFeatures::default() };
            initialiser.step(&features, &camera, LENS, &config);
        }
        let held: Vec<u64> = initialiser.views.iter().map(|v| v.frame.sequence).collect();
        assert_eq!(held, [1, 2, 3, 4, 5]);
    }

    #[test]
    fn a_start_must_agree_as_often_as_it_disagreed_before() {
        let camera = CameraModel::new(640, 480, 500.0, 500.0, 320.0, 240.0, [0.0; 5]).unwrap();
        let config = ReconstructionConfig::default();
        let mut initialiser = Initialiser::default();
        let mut in_a_frame = |ask: fn(&mut Initialiser) -> bool| {
            initialiser.step(&FrameFeatures::default(), &camera, LENS, &config);
            [ask(&mut initialiser), ask(&mut initialiser)]
        };
        let disagree = |i: &mut Initialiser| {
            i.disagree();
            false
        };
        assert_eq!(in_a_frame(Initialiser::agree), [true, false], "one vote a frame");
        in_a_frame(disagree);
        in_a_frame(disagree);
        assert_eq!([0; 3].map(|_| in_a_frame(Initialiser::agree)[0]), [false, false, true]);
    }
}
