//! Does the picture contradict the map for so long that the poses of late must be wrong?
//!
//! Where little is found, in the dark or in blur, a few landmarks that fit a pose are followed off the others, the next ones are placed by wrong poses, and
//! from there on the map explains itself: it never says that it is lost. The tracks know no map. So every tracked frame, ten times a second at the
//! most, is asked what a start is asked ([`PosedViews::agreement`]) beside those of the last 0.7 s. Where most of the picture contradicts ten times more
//! than it agrees, the keyframes since it began to are no good, and the camera is lost.
//!
//! Input: each frame that was tracked, and the number of the keyframe that comes next. Output: the first keyframe that is not to be believed. Cost: 0.8
//! million instructions a frame that is asked, a hundredth of the frames' all in all. Not here: what fills most of the picture and
//! moves for less than a second.
//!
//! Kept by ablation: of 174 recordings (`tests/results/derived.py`) three are told to be lost, once each. One is `tum_fr1_desk.dark`, whose unit had shrunk to a
//! twentieth by then: 78 % of it are 0.010 m off, where all of it was 0.755 m off. In the other two somebody walks past, the map was right, and a frame or two
//! are lost until it is known again. (At half as many contradictions half B loses 0.6 points of its coverage, where somebody walks past.)

use super::PosedViews;
use crate::features::FrameFeatures;
use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};
use crate::map::KeyframeId;
use crate::reconstruction::measurement::rolling_shutter::Shutter;

/// How long ago the views were that a frame is asked beside: parallax takes time, and one bad view must not speak ten times.
const WINDOW_NS: i64 = 700_000_000;
/// Time from one frame that is asked to the next, at the least: three frames of a camera of 30 Hz.
const STEP_NS: i64 = 90_000_000;
/// Share of the picture that must agree: most of it.
const CONTRADICTING_SHARE: f64 = 0.5;
/// How often more it must contradict than agree.
const MAX_CONTRADICTIONS: u32 = 10;
/// What has not come to that within this time says nothing: keyframes of so long ago are not dropped.
const SUSPICION_NS: i64 = 3_000_000_000;

/// Of the frames placed in the present map.
#[derive(Debug, Default)]
pub struct Contradiction {
    views: PosedViews,
    /// Frames that contradicted, less those that agreed since.
    contradictions: u32,
    /// When they began to, and the first keyframe since.
    since_ns: i64,
    first_doubtful: KeyframeId,
}

impl Contradiction {
    /// Whether keyframes may be wrong that have been made of late.
    pub fn is_suspected(&self) -> bool {
        self.contradictions > 0
    }

    /// An adjustment has moved the camera's surroundings.
    pub fn correct(&mut self, old_from_new: &Se3<World, World>) {
        self.views.correct(old_from_new);
    }

    /// The frames to come are placed on their own, as after a loss: those before may be wrong where they are right.
    pub fn look_anew(&mut self) {
        self.views.forget_before(i64::MAX, i64::MAX);
    }

    /// The map was moved, or is another one.
    pub fn end(&mut self) {
        self.look_anew();
        self.contradictions = 0;
    }

    /// Takes a frame that was tracked. Keyframes from the one returned on are made of poses that are wrong, if any is.
    pub fn doubtful_since(
        &mut self,
        features: &FrameFeatures,
        pose: &Se3<Camera, World>,
        (camera, shutter): (&CameraModel, &Shutter),
        next: KeyframeId,
    ) -> Option<KeyframeId> {
        let now = features.timestamp_ns;
        if self.views.newest_ns().is_some_and(|last| (0..STEP_NS).contains(&(now - last))) {
            return None;
        }
        self.views.forget_before(now - WINDOW_NS, now);
        self.views.push_features(features, pose);
        if !(0..SUSPICION_NS).contains(&(now - self.since_ns)) {
            self.contradictions = 0;
        }
        let share = self.views.verdict(camera, shutter)?;
        if share >= CONTRADICTING_SHARE {
            self.contradictions = self.contradictions.saturating_sub(1);
            return None;
        }
        if self.contradictions == 0 {
            (self.since_ns, self.first_doubtful) = (now, next);
        }
        self.contradictions += 1;
        (self.contradictions >= MAX_CONTRADICTIONS).then_some(self.first_doubtful)
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{Scene, camera, features, global_shutter, views};
    use super::*;

    /// The frame that tells, and the first keyframe not to be believed; each frame is the last before a keyframe of its number. `share` of the wall moves
    /// in the pictures `falls`.
    fn told(share: f64, falls: std::ops::Range<f64>) -> Option<(u64, KeyframeId)> {
        let scene = Scene { step: 0.008, share, falls, ..Scene::default() };
        let mut contradiction = Contradiction::default();
        scene.views(90).iter().find_map(|(frame, pose)| {
            let next = KeyframeId(frame.sequence as u32);
            let optics = (&camera(), &global_shutter());
            Some((frame.sequence, contradiction.doubtful_since(&features(frame), pose, optics, next)?))
        })
    }

    #[test]
    fn poses_that_most_of_the_picture_contradicts_for_a_second_are_told_from_where_it_began_to() {
        let (at, since) = told(0.7, 30.0..90.0).expect("most of it");
        assert!((55..75).contains(&at), "frame {at}");
        assert!((30..40).contains(&since.0), "keyframe {}", since.0);
    }

    #[test]
    fn something_smaller_or_shorter_says_nothing() {
        assert_eq!(told(0.0, 0.0..90.0), None);
        assert_eq!(told(0.4, 0.0..90.0), None, "less than half of the picture");
        assert_eq!(told(0.7, 30.0..33.0), None, "a tenth of a second");
    }

    #[test]
    fn what_was_suspected_long_ago_counts_no_more() {
        let scene = Scene { step: 0.008, share: 0.7, ..Scene::default() };
        let mut contradiction = Contradiction::default();
        // Thrice two thirds of a second, half an hour apart.
        for n in 0..3 {
            for (mut frame, pose) in scene.views(20) {
                frame.timestamp_ns += n * 1_800_000_000_000;
                let optics = (&camera(), &global_shutter());
                let told = contradiction.doubtful_since(&features(&frame), &pose, optics, KeyframeId(0));
                assert_eq!(told, None, "time {n}, frame {}", frame.sequence);
            }
            assert!(contradiction.is_suspected(), "time {n}");
        }
    }

    #[test]
    fn what_was_told_before_the_end_counts_no_more() {
        let all = views(60, 0.02, 0.7);
        let mut contradiction = Contradiction::default();
        for (frame, pose) in all {
            let optics = (&camera(), &global_shutter());
            let told = contradiction.doubtful_since(&features(&frame), &pose, optics, KeyframeId(0));
            assert_eq!(told, None, "frame {}", frame.sequence);
            if frame.sequence % 20 == 0 {
                contradiction.end();
            }
        }
    }
}
