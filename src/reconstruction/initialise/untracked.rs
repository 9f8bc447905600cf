//! Starts between views that few tracks join, or none: corners that look alike in both.
//!
//! At a low rate, in blur or in noise tracks are cut before there is parallax, but most corners of the first picture are still in the
//! newest one. So a view is held every [`HELD_EVERY_S`], whether or not its tracks live. Once tracks are few the views' corners get binary
//! descriptors, the newest frame's are matched with those of the oldest views first (mutual and unambiguous matches), and what two views
//! share, tracks and corners, is tried as any start is. The views in between have the same corners by the same descriptors, so that chance, which
//! fits two views, must fit all of them.
//!
//! These are further starts beside those of the tracks alone, and touch nothing of theirs: look-alikes may not keep a reference alive whose
//! tracks are gone, nor raise the doubt in a start that the tracks give.
//!
//! Input: frames, as the initialiser gets them. Output: starts, best first. Cost: 0.7 ms a view described and about 1 ms a view compared,
//! only while there is no map and tracks are few; of many tracks a copy of the picture every [`HELD_EVERY_S`].

use std::collections::VecDeque;

use nalgebra::Vector2;

use super::turn::Pair;
use super::views::{MAX_BETWEEN, MIN_COMMON, Pairs, View, Views};
use crate::features::FrameFeatures;
use crate::features::descriptor::Descriptor;
use crate::features::matching::{DescriptorMatcher, DescriptorMatching};
use crate::geometry::CameraModel;
use crate::image::Pyramid;
use crate::reconstruction::consensus::FrameTracks;
use crate::reconstruction::keyframe::corners::{CornerFinder, SAME_CORNER_PX};

/// Views are held so far apart, s, or as far as frames come; as many as a start has in between: 1.6 s at 5 Hz and more, in which a hand has
/// turned most cameras to something else.
const HELD_EVERY_S: f64 = 0.2;
/// Ids of corners without a track begin here: no camera has shown so many tracks.
const FIRST_UNTRACKED: u64 = 1 << 63;

/// Whether what has this id is a corner that no track follows.
pub fn is_untracked(id: u64) -> bool {
    id >= FIRST_UNTRACKED
}

/// A frame's corners and what they look like.
#[derive(Debug, Clone, Default)]
struct Described {
    pixels: Vec<Vector2<f32>>,
    descriptors: Vec<Descriptor>,
}

impl Described {
    fn of(pyramid: &Pyramid, camera: &CameraModel, finder: &mut CornerFinder) -> Self {
        let found = finder.find(pyramid, camera, std::iter::empty());
        let (pixels, descriptors) = found.into_iter().map(|c| (c.pixel, c.descriptor)).unzip();
        Self { pixels, descriptors }
    }
}

/// A view and its corners, once they were asked for.
#[derive(Debug)]
struct Held {
    view: View,
    corners: Option<Described>,
}

/// What a held view shares with the newest frame.
pub struct Shared {
    /// Which of the views that are held.
    index: usize,
    pub pairs: Pairs,
    /// Corners without a track, by the index that the held view has of each, and where the newest frame sees them.
    corners: Vec<(usize, Vector2<f32>)>,
}

/// See the module.
#[derive(Debug, Default)]
pub struct UntrackedViews {
    finder: CornerFinder,
    matcher: DescriptorMatcher,
    /// Oldest first.
    held: VecDeque<Held>,
    /// Corners of the frame that was asked for last, by its number.
    newest: Option<(u64, Described)>,
}

impl UntrackedViews {
    pub fn clear(&mut self) {
        self.held.clear();
    }

    /// Holds this frame if the last one that is held is old enough.
    pub fn hold(&mut self, features: &FrameFeatures) {
        let age_s = |h: &Held| (features.timestamp_ns - h.view.frame.timestamp_ns) as f64 * 1e-9;
        if self.held.back().is_some_and(|last| (0.0..HELD_EVERY_S).contains(&age_s(last))) {
            return;
        }
        if self.held.len() >= MAX_BETWEEN {
            self.held.pop_front();
        }
        let corners = self.newest.take().filter(|(sequence, _)| *sequence == features.sequence).map(|newest| newest.1);
        self.held.push_back(Held { view: View::of(features), corners });
    }

    /// What the held views share with a frame, the oldest first, of those that share enough.
    pub fn shared_with(&mut self, features: &FrameFeatures, camera: &CameraModel) -> Vec<Shared> {
        let Self { finder, matcher, held, .. } = self;
        let corners = Described::of(&features.pyramid, camera, finder);
        let frame = FrameTracks::of(features);
        let mut all = Vec::new();
        for (index, Held { view, corners: own }) in held.iter_mut().enumerate() {
            let own = own.get_or_insert_with(|| Described::of(&view.pyramid, camera, finder));
            let known = known_again(matcher, (&view.frame, own), (&frame, &corners));
            let pairs = pairs_of((&view.frame, own), &frame, &known, camera);
            all.extend(pairs.map(|pairs| Shared { index, pairs, corners: known }));
        }
        self.newest = Some((features.sequence, corners));
        all
    }

    /// The views of a start between a held one and the newest frame.
    pub fn views(&mut self, shared: &Shared, newest: &FrameFeatures) -> Option<Views> {
        let mut held = self.held.iter().skip(shared.index).filter_map(|h| Some((&h.view, h.corners.as_ref()?)));
        let (view, own) = held.next()?;
        let places = shared.corners.iter().map(|&(i, _)| (i, own.pixels[i]));
        let first = View { frame: with_corners(&view.frame, places), pyramid: view.pyramid.clone() };
        let matcher = &mut self.matcher;
        let between = held.map(|(other, corners)| {
            let known = known_again(matcher, (&view.frame, own), (&other.frame, corners)).into_iter();
            let known = known.filter(|c| shared.corners.binary_search_by_key(&c.0, |s| s.0).is_ok());
            View { frame: with_corners(&other.frame, known), pyramid: other.pyramid.clone() }
        });
        let between = between.collect();
        Some(Views { first, between, newest: with_corners(&FrameTracks::of(newest), shared.corners.iter().copied()) })
    }
}

/// Corners of a held view that another frame shows too, ascending, and where; none that a track has in both.
fn known_again(
    matcher: &mut DescriptorMatcher,
    (first, own): (&FrameTracks, &Described),
    (frame, corners): (&FrameTracks, &Described),
) -> Vec<(usize, Vector2<f32>)> {
    let mut matches = Vec::new();
    let rule = DescriptorMatching::default();
    matcher.match_all(&own.descriptors, &corners.descriptors, &rule, &mut matches);
    let tracked: Vec<_> = frame.tracks.iter().filter_map(|&(id, now)| Some((first.track(id)?, now))).collect();
    let near = |a: Vector2<f32>, b: Vector2<f32>| (a - b).norm() < SAME_CORNER_PX;
    let places = matches.iter().map(|m| (m.first as usize, corners.pixels[m.second as usize]));
    places.filter(|&(i, now)| !tracked.iter().any(|t| near(t.0, own.pixels[i]) || near(t.1, now))).collect()
}

/// Tracks and corners that a held view shares with a frame, if they are enough.
fn pairs_of(
    (first, own): (&FrameTracks, &Described),
    frame: &FrameTracks,
    corners: &[(usize, Vector2<f32>)],
    camera: &CameraModel,
) -> Option<Pairs> {
    let tracked = frame.tracks.iter().filter_map(|&(id, now)| Some((id, first.track(id)?, now)));
    let untracked = corners.iter().map(|&(i, now)| (FIRST_UNTRACKED + i as u64, own.pixels[i], now));
    let pair = |(id, then, now): (u64, Vector2<f32>, Vector2<f32>)| Some((id, Pair::between(&then, &now, camera)?));
    let (tracks, places): (Vec<_>, Vec<_>) = tracked.chain(untracked).filter_map(pair).unzip();
    (tracks.len() >= MIN_COMMON).then_some(Pairs { tracks, places })
}

/// A frame with corners among its tracks that no track follows; they are ascending, and so are their ids behind those of tracks.
fn with_corners(frame: &FrameTracks, corners: impl Iterator<Item = (usize, Vector2<f32>)>) -> FrameTracks {
    let mut frame = frame.clone();
    frame.tracks.extend(corners.map(|(i, pixel)| (FIRST_UNTRACKED + i as u64, pixel)));
    frame
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::features::Track;

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
        let track =
            |i: u64| Track { id: 1000 * sequence + i, position: Vector2::new(20.0 + 3.0 * i as f32, 20.0), age: 1 };
        FrameFeatures {
            sequence,
            timestamp_ns: sequence as i64 * 200_000_000,
            pyramid: Arc::new(pyramid),
            tracks: (0..80).map(track).collect(),
            ..FrameFeatures::default()
        }
    }

    #[test]
    fn corners_that_no_track_joins_are_known_again_by_what_they_look_like() {
        let camera = CameraModel::new(320, 240, 400.0, 400.0, 159.5, 119.5, [0.0; 5]).unwrap();
        let mut views = UntrackedViews::default();
        for (n, shift) in [0, 7].into_iter().enumerate() {
            views.hold(&before_wall(n as u64, shift));
        }
        let newest = before_wall(2, 15);
        let shared = views.shared_with(&newest, &camera);
        assert_eq!(shared.iter().map(|s| s.index).collect::<Vec<_>>(), [0, 1]);
        let Views { first, between, newest } = views.views(&shared[0], &newest).expect("views of a start");
        let seen = |frame: &FrameTracks, id| frame.track(id).expect("a corner that this view has");
        let (mut wrong, mut held) = (0, 0);
        for &id in &shared[0].pairs.tracks {
            assert!(is_untracked(id));
            let then = seen(&first.frame, id);
            wrong += usize::from((then - seen(&newest, id) - Vector2::new(15.0, 0.0)).norm() > 1.5);
            held += usize::from(
                between[0].frame.track(id).is_some_and(|p| (then - p - Vector2::new(7.0, 0.0)).norm() < 1.5),
            );
        }
        let count = shared[0].pairs.tracks.len();
        assert!(
            count >= 100 && 20 * wrong <= count && 2 * held >= count,
            "{count} shared, {wrong} wrong, {held} held between"
        );
        assert!([&first.frame, &between[0].frame, &newest].iter().all(|f| f.tracks.is_sorted_by_key(|t| t.0)));
    }

    #[test]
    fn views_are_held_for_a_while_and_forgotten() {
        let mut views = UntrackedViews::default();
        for n in 0..12 {
            views.hold(&before_wall(n, 0));
            views.hold(&FrameFeatures { timestamp_ns: n as i64 * 200_000_000 + 1, ..before_wall(n, 0) });
        }
        let held: Vec<u64> = views.held.iter().map(|h| h.view.frame.sequence).collect();
        assert_eq!(held, (4..12).collect::<Vec<u64>>());
    }
}
