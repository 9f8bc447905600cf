//! From tracks alone to a first map.
//!
//! Views are held while their tracks live, and the oldest of them is the reference. Once the flow that a rotation cannot explain is
//! large enough, two-view geometry is tried (essential matrix or homography, [`two_view`](crate::geometry::two_view)): from the
//! oldest view, which has the longest baseline, and from the oldest that shares half of today's tracks, which has more points.
//! Standing still and turning on the spot never pass: their rotation-compensated flow stays at the noise. What a rotation seen through
//! another lens than the supposed one explains is taken out as well, as far as the lens is uncertain (`turn`). All frames in between
//! are remembered by their tracks, so that their poses can be solved once there is a map. At a low rate, in blur or noise tracks are cut
//! before there is parallax: then corners that look alike in both views are asked as well ([`CornerFinder`]).

use std::collections::VecDeque;
use std::sync::Arc;

use nalgebra::{Vector2, Vector3};

use super::turn::{Pair, SupposedLens, unexplained_px};
use crate::features::descriptor::Descriptor;
use crate::features::matching::{DescriptorMatcher, DescriptorMatching};
use crate::features::{FrameFeatures, Track};
use crate::geometry::frames::{First, Second};
use crate::geometry::two_view::{TwoViewOptions, reconstruct_two_views};
use crate::geometry::{CameraModel, Se3};
use crate::image::Pyramid;
use crate::reconstruction::adjust::intrinsics::LensFreedom;
use crate::reconstruction::config::ReconstructionConfig;
use crate::reconstruction::keyframe::corners::{CornerFinder, SAME_CORNER_PX};
use crate::reconstruction::keyframe::epipolar::FED;

/// A frame before the map exists.
#[derive(Debug, Clone)]
pub struct PendingFrame {
    pub sequence: u64,
    pub timestamp_ns: i64,
    /// Track id and level-0 pixel, ascending id.
    pub tracks: Vec<(u64, Vector2<f32>)>,
}

impl PendingFrame {
    pub fn of(features: &FrameFeatures) -> Self {
        Self {
            sequence: features.sequence,
            timestamp_ns: features.timestamp_ns,
            tracks: features.tracks.iter().map(|t| (t.id, t.position)).collect(),
        }
    }

    /// The same with corners that no track joins.
    fn with(&self, corners: &[MatchedCorner], of: impl Fn(&MatchedCorner) -> Vector2<f32>) -> Self {
        let mut frame = self.clone();
        frame.tracks.extend(corners.iter().map(|c| (c.id, of(c))));
        frame
    }

    /// Pixel of a track.
    pub fn track(&self, id: u64) -> Option<Vector2<f32>> {
        let i = self.tracks.binary_search_by_key(&id, |t| t.0).ok()?;
        Some(self.tracks[i].1)
    }
}

/// One corner of a first map.
#[derive(Debug, Clone, Copy)]
pub struct StartPoint {
    pub track: u64,
    /// In the first camera's coordinates.
    pub point: Vector3<f64>,
}

/// A frame before the map that is kept with its picture.
#[derive(Debug, Clone)]
pub struct View {
    pub frame: PendingFrame,
    pub pyramid: Arc<Pyramid>,
    corners: Described,
}

impl View {
    /// The picture is a copy of its own: the frame's goes back to the pool.
    fn of(newest: &Newest<'_>) -> Self {
        Self {
            frame: newest.frame.clone(),
            pyramid: Arc::new(Pyramid::clone(&newest.features.pyramid)),
            corners: newest.corners.clone(),
        }
    }
}

/// Corners of a picture that may be known again without a track between.
#[derive(Debug, Clone, Default)]
struct Described {
    pixels: Vec<Vector2<f32>>,
    descriptors: Vec<Descriptor>,
}

/// The newest frame and its corners.
struct Newest<'a> {
    features: &'a FrameFeatures,
    frame: PendingFrame,
    corners: Described,
    /// Tracks alone have given no start for so long that corners are asked as well.
    ask_corners: bool,
}

impl<'a> Newest<'a> {
    fn of(features: &'a FrameFeatures, camera: &CameraModel, finder: &mut CornerFinder, ask_corners: bool) -> Self {
        let found = finder.find(&features.pyramid, camera, std::iter::empty());
        let (pixels, descriptors) = found.into_iter().map(|c| (c.pixel, c.descriptor)).unzip();
        Self { features, frame: PendingFrame::of(features), corners: Described { pixels, descriptors }, ask_corners }
    }
}

/// A first map: the motion between two frames, points, and views in between to hold them together.
#[derive(Debug)]
pub struct Start {
    pub first: View,
    /// How long the camera has moved without a start, s.
    pub trying_s: f64,
    /// In order of time; neither the first nor the newest frame is among them.
    pub between: Vec<View>,
    /// The newest frame. It and the first one have corners among their tracks that no track joins, under ids of no track.
    pub newest: PendingFrame,
    pub second_from_first: Se3<Second, First>,
    pub points: Vec<StartPoint>,
}

/// Frames that are remembered for a pose afterwards; older ones are dropped.
const MAX_PENDING: usize = 900;
/// Standard deviation of a track over the frames of a start, px.
const START_SIGMA_PX: f64 = 1.0;
/// Views kept between the reference and the newest frame; when there would be more every other one is dropped.
const MAX_BETWEEN: usize = 8;
/// A view is given up below this many tracks in common with the newest frame, or a quarter of its own, and the next one takes over.
const MIN_COMMON: usize = 60;
/// So long after the camera began to move, s, corners that look alike are asked as well as tracks: where frames are many tracks alone
/// have given a start by then, and a later one (with more parallax) is the better one; where they are few, or poor, tracks do not last.
/// Over 86 recordings (at several rates, with noise, gaps and changing light) the share of frames with a pose rises from 95.0 to 97.0 % by
/// this, the patience of `initialise` and `lost_s` together.
const CORNERS_AFTER_S: f64 = 0.25;
/// Ids of corners without a track begin here: no camera has shown so many tracks.
pub const FIRST_UNTRACKED: u64 = 1 << 63;
/// Further times that a start must agree with the picture, at the most.
const MAX_DOUBT: u32 = 5;
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
    doubt: u32,
    /// A start of this frame has been asked; another one shares its picture.
    voted: bool,
    /// How long the camera has moved without a start, s: standing still takes it back. It outlasts the reference.
    trying_s: f64,
    last_ns: Option<i64>,
    lengths: Vec<f64>,
    finder: CornerFinder,
    /// All frames since the last reset, or since the map before was lost, that may still get a pose, the reference among them.
    pub pending: VecDeque<PendingFrame>,
}

impl Initialiser {
    pub fn clear(&mut self) {
        self.begin_at(None);
        self.pending.clear();
        self.trying_s = 0.0;
        self.last_ns = None;
        self.doubt = 0;
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
            self.doubt = (self.doubt + 1).min(MAX_DOUBT);
        }
    }

    /// A start agrees; true if nothing speaks against it any more.
    pub fn agree(&mut self) -> bool {
        if std::mem::replace(&mut self.voted, true) {
            return false;
        }
        let settled = self.doubt == 0;
        self.doubt = self.doubt.saturating_sub(1);
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

    /// Takes a frame; what it could start together with a view before, best first. `freedom`: of the lens.
    pub fn step(
        &mut self,
        features: &FrameFeatures,
        camera: &CameraModel,
        freedom: &LensFreedom,
        config: &ReconstructionConfig,
    ) -> Vec<Start> {
        let newest = Newest::of(features, camera, &mut self.finder, self.trying_s >= CORNERS_AFTER_S);
        let Some(pairs) = self.follow(&newest, camera) else { return Vec::new() };
        let lens = SupposedLens { focal_px: camera.focal_px(), freedom: *freedom };
        let flow = unexplained_px(&pairs.places, lens, &mut self.lengths);
        self.spend_patience(features.timestamp_ns, flow);
        let richer = |pairs: &Pairs| 2 * pairs.tracks.len() >= features.tracks.len();
        let second = if richer(&pairs) {
            None
        } else {
            let pairs = |v: &View| pairs_with(v, &newest, camera).filter(richer);
            self.views.iter().enumerate().skip(1).find_map(|(i, v)| Some((i, pairs(v)?)))
        };
        let second = second.map(|(i, pairs)| (i, unexplained_px(&pairs.places, lens, &mut self.lengths), pairs));
        let starts = std::iter::once((0, flow, pairs)).chain(second).filter_map(|(i, flow, pairs)| {
            (flow >= config.start_flow_px).then(|| self.attempt(i, &pairs, &newest.frame, camera, config))?
        });
        let starts = starts.collect();
        self.keep(|| View::of(&newest));
        starts
    }

    /// Remembers a frame without asking for a start: while there is still hope for another map.
    pub fn watch(&mut self, features: &FrameFeatures, camera: &CameraModel) {
        let newest = Newest::of(features, camera, &mut self.finder, self.trying_s >= CORNERS_AFTER_S);
        if self.follow(&newest, camera).is_some() {
            self.keep(|| View::of(&newest));
        }
    }

    /// Follows the tracks into a frame: those that the reference shares with it. `None` if no view does; then this frame becomes the
    /// reference.
    fn follow(&mut self, newest: &Newest<'_>, camera: &CameraModel) -> Option<Pairs> {
        self.voted = false;
        self.pending.push_back(newest.frame.clone());
        if self.pending.len() > MAX_PENDING {
            self.pending.pop_front();
        }
        // Views that have lost their tracks make room for the next ones, which have some of the way behind them, too.
        let pairs = |v: &View| pairs_with(v, newest, camera);
        let alive = self.views.iter().enumerate().find_map(|(i, v)| Some((i, pairs(v)?)));
        let Some((dead, pairs)) = alive else {
            self.begin_at((newest.frame.tracks.len() >= MIN_COMMON).then(|| View::of(newest)));
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

    /// Two-view geometry between the view of this index and this frame.
    fn attempt(
        &self,
        index: usize,
        pairs: &Pairs,
        newest: &PendingFrame,
        camera: &CameraModel,
        config: &ReconstructionConfig,
    ) -> Option<Start> {
        let (reference, between) = self.views.get(index..)?.split_first()?;
        let first: Vec<Vector2<f64>> = pairs.places.iter().map(|p| p.first).collect();
        let second: Vec<Vector2<f64>> = pairs.places.iter().map(|p| p.second).collect();
        let options =
            TwoViewOptions { seed: newest.sequence, ..TwoViewOptions::new(START_SIGMA_PX, camera.focal_px()) };
        let solution = reconstruct_two_views(&first, &second, &options).ok()?;
        let points: Vec<StartPoint> = pairs
            .tracks
            .iter()
            .zip(&solution.points)
            .filter_map(|(&track, point)| Some(StartPoint { track, point: (*point)? }))
            .collect();
        if points.len() < config.start_landmarks {
            return None;
        }
        Some(Start {
            first: View { frame: reference.frame.with(&pairs.corners, |c| c.first), ..reference.clone() },
            newest: newest.with(&pairs.corners, |c| c.second),
            trying_s: self.trying_s,
            between: between.to_vec(),
            second_from_first: solution.second_from_first,
            points,
        })
    }
}

/// What two frames share, and where both see it.
struct Pairs {
    /// Tracks, then matched corners.
    tracks: Vec<u64>,
    places: Vec<Pair>,
    corners: Vec<MatchedCorner>,
}

/// A corner that two frames share without a track between.
#[derive(Debug, Clone, Copy)]
struct MatchedCorner {
    /// Beyond those of tracks, ascending.
    id: u64,
    first: Vector2<f32>,
    second: Vector2<f32>,
}

/// What a view shares with a frame, if it is enough: tracks, and where few lasted, corners that look alike. Of a wide-angle lens where
/// the plane z = 1 is even, as two-view geometry weighs all alike.
fn pairs_with(view: &View, newest: &Newest<'_>, camera: &CameraModel) -> Option<Pairs> {
    let pair = |first: Vector2<f32>, second: Vector2<f32>| {
        let first = camera.undistort(&first.cast()).filter(|n| camera.is_central(n))?;
        Pair::of(first, &second, camera)
    };
    let by_track = |t: &Track| Some((t.id, pair(view.frame.track(t.id)?, t.position)?));
    let (mut tracks, mut places): (Vec<_>, Vec<_>) = newest.features.tracks.iter().filter_map(by_track).unzip();
    let mut corners = Vec::new();
    if tracks.len() < FED && newest.ask_corners {
        let mut matches = Vec::new();
        let rule = DescriptorMatching::default();
        let (then, now) = (&view.corners, &newest.corners);
        DescriptorMatcher::default().match_all(&then.descriptors, &now.descriptors, &rule, &mut matches);
        let seen: Vec<_> =
            tracks.iter().filter_map(|&id| Some((view.frame.track(id)?, newest.frame.track(id)?))).collect();
        for m in &matches {
            let (first, second) = (then.pixels[m.first as usize], now.pixels[m.second as usize]);
            let near = |a: Vector2<f32>, b: Vector2<f32>| (a - b).norm() < SAME_CORNER_PX;
            if seen.iter().any(|s| near(s.0, first) || near(s.1, second)) {
                continue;
            }
            let Some(pair) = pair(first, second) else { continue };
            let id = FIRST_UNTRACKED + corners.len() as u64;
            corners.push(MatchedCorner { id, first, second });
            tracks.push(id);
            places.push(pair);
        }
    }
    (tracks.len() >= MIN_COMMON.max(view.frame.tracks.len() / 4)).then_some(Pairs { tracks, places, corners })
}

#[cfg(test)]
mod tests {
    use super::*;

    const LENS: LensFreedom = LensFreedom { focal: 0.01, centre_px: 0.1, distortion: 0.02 };

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
                assert!(initialiser.step(&features, &camera, &LENS, &config).is_empty());
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
            initialiser.step(&features, &camera, &LENS, &config);
        }
        let held: Vec<u64> = initialiser.views.iter().map(|v| v.frame.sequence).collect();
        assert_eq!(held, [1, 2, 3, 4, 5]);
    }

    /// A frame that looks at a wall of speckles `shift` px further to the right; none of its tracks is another frame's.
    fn before_wall(sequence: u64, shift: usize) -> FrameFeatures {
        let mut picture = crate::image::GreyImage::new(320, 240);
        for (i, pixel) in picture.data.iter_mut().enumerate() {
            let (x, y) = ((i % 320 + shift) as u32 / 5, (i / 320) as u32 / 5);
            let mixed = (x.wrapping_mul(0x9E37_79B9) ^ y.wrapping_mul(0x85EB_CA6B)).wrapping_mul(0xC2B2_AE35);
            *pixel = 40 + ((mixed >> 15).wrapping_mul(0x27D4_EB2F) >> 24) as u8 / 2;
        }
        let mut pyramid = Pyramid::new(4);
        pyramid.build(&picture);
        let tracks = (0..80).map(|i| Track {
            id: 1000 * sequence + i,
            position: Vector2::new(20.0 + 3.0 * i as f32, 20.0),
            age: 1,
        });
        FrameFeatures { sequence, pyramid: Arc::new(pyramid), tracks: tracks.collect(), ..FrameFeatures::default() }
    }

    #[test]
    fn corners_that_no_track_joins_are_known_again_by_what_they_look_like() {
        let camera = CameraModel::new(320, 240, 400.0, 400.0, 159.5, 119.5, [0.0; 5]).unwrap();
        let finder = &mut CornerFinder::default();
        let (then, now) = (before_wall(0, 0), before_wall(1, 15));
        let view = View::of(&Newest::of(&then, &camera, finder, false));
        assert!(pairs_with(&view, &Newest::of(&now, &camera, finder, false), &camera).is_none(), "no track in common");
        let newest = Newest::of(&now, &camera, finder, true);
        let pairs = pairs_with(&view, &newest, &camera).expect("corners in common");
        assert!(pairs.tracks.len() >= 100 && pairs.corners.len() == pairs.tracks.len(), "{}", pairs.tracks.len());
        let wrong = pairs.corners.iter().filter(|c| (c.first - c.second - Vector2::new(15.0, 0.0)).norm() > 1.5);
        assert!(20 * wrong.count() <= pairs.corners.len());
        // Both frames of a start have them, after their tracks.
        let first = view.frame.with(&pairs.corners, |c| c.first);
        let corner = &pairs.corners[0];
        assert_eq!(first.track(corner.id), Some(corner.first));
        assert!(first.tracks.is_sorted_by_key(|t| t.0));
    }

    #[test]
    fn a_start_must_agree_as_often_as_it_disagreed_before() {
        let camera = CameraModel::new(640, 480, 500.0, 500.0, 320.0, 240.0, [0.0; 5]).unwrap();
        let config = ReconstructionConfig::default();
        let mut initialiser = Initialiser::default();
        let mut in_a_frame = |ask: fn(&mut Initialiser) -> bool| {
            initialiser.step(&FrameFeatures::default(), &camera, &LENS, &config);
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
