//! A new map is on probation: does it still explain most of the picture, now that the camera has moved on?
//!
//! A start is made of a moment. Somebody who walks past while the camera hardly moves brings most of the parallax there is, and two views of a body are
//! as good a start as two views of a room; a moment later the room's tracks say that the camera went elsewhere. So every frame of the first second is
//! asked what the start was asked ([`consensus`](super::consensus)), and a map that the picture contradicts in five frames more than it agrees in is given
//! up. (Below five pictures a second that cannot be.)
//!
//! Input: the views of the start with their poses, then each frame that was tracked. Output: whether the map has failed. Cost: 0.8 million instructions
//! a frame for a second, a fiftieth of the frame's. Not here: what comes before the camera later, where the gate for immature landmarks judges.
//!
//! Kept by ablation: of eight recordings with somebody who walks past from the first picture on (`passing33` of `tests/results/derived.py`) four are
//! given up and begin later. Two of these bent without it, to 5.6 and to 1.35 times the error. The other 166 recordings are the same with it.
//! What it costs: it knows nothing of the rolling shutter, which bends tracks by more than the limit in quick turns, so that sound maps are given up in two
//! of five rooms of the simulator's `desk_sweep`. With the readout left free, track by track or as one unknown, these are kept, but so is a wrong start
//! that it gives up now (`tum_fr1_desk.dark`).

use super::consensus::{AGREEING_SHARE, MAX_DISAGREEMENTS, PosedView, agreement};
use super::views::PendingFrame;
use crate::features::FrameFeatures;
use crate::geometry::frames::{Camera, World};
use crate::geometry::{CameraModel, Se3};

/// How long, s. Later something large may come between the camera and what it has mapped.
const PROBATION_S: f64 = 1.0;
/// Of the picture's cells with tracks, so many must tell for a frame to count: where the camera comes back to where it began, only what moves does.
const MIN_TELLING: f64 = 0.5;

/// Of the present map.
#[derive(Debug, Default)]
pub struct Probation {
    /// The start's, and all frames since, in order of time; none once it is over.
    views: Vec<PosedView>,
    began_ns: i64,
    /// Frames that disagreed, less those that agreed since.
    disagreements: u32,
    /// All frames up to the start.
    before: Vec<PendingFrame>,
}

impl Probation {
    /// Begins with the views of a start, in order of time.
    pub fn begin(&mut self, views: Vec<PosedView>) {
        let began_ns = views.last().map_or(0, |(frame, _)| frame.timestamp_ns);
        *self = Self { views, began_ns, ..Self::default() };
    }

    /// Keeps the frames that led to the start; a map that fails gives them back.
    pub fn keep(&mut self, before: Vec<PendingFrame>) {
        if !self.views.is_empty() {
            self.before = before;
        }
    }

    /// It is over: the map has proved itself, was moved, or is another one.
    pub fn end(&mut self) {
        *self = Self::default();
    }

    /// Takes a frame that was tracked; true if the map has failed.
    pub fn fails(&mut self, features: &FrameFeatures, pose: &Se3<Camera, World>, camera: &CameraModel) -> bool {
        if self.views.is_empty() {
            return false;
        }
        let since_s = (features.timestamp_ns - self.began_ns) as f64 * 1e-9;
        if !(0.0..=PROBATION_S).contains(&since_s) {
            self.end();
            return false;
        }
        self.views.push((PendingFrame::of(features), *pose));
        let told = agreement(&self.views, camera).filter(|told| told.telling >= MIN_TELLING);
        let Some(told) = told else { return false };
        let agrees = told.share >= AGREEING_SHARE;
        self.disagreements = if agrees { self.disagreements.saturating_sub(1) } else { self.disagreements + 1 };
        self.disagreements >= MAX_DISAGREEMENTS
    }

    /// Ends it; all frames but the last one taken, for a pose in the next map.
    pub fn take_frames(&mut self) -> Vec<PendingFrame> {
        let Self { mut before, mut views, began_ns, .. } = std::mem::take(self);
        views.pop();
        before.extend(views.into_iter().map(|(frame, _)| frame).filter(|frame| frame.timestamp_ns > began_ns));
        before
    }
}

#[cfg(test)]
mod tests {
    use super::super::consensus::tests::{camera, views};
    use super::*;
    use crate::features::Track;

    fn features(frame: &PendingFrame) -> FrameFeatures {
        let tracks = frame.tracks.iter().map(|&(id, position)| Track { id, position, age: 1 }).collect();
        FrameFeatures { sequence: frame.sequence, timestamp_ns: frame.timestamp_ns, tracks, ..FrameFeatures::default() }
    }

    /// After how many of the frames that follow a start a map fails, and the frames that it gives back.
    fn failed(start: &[PosedView], after: &[PosedView]) -> Option<(usize, Vec<u64>)> {
        let mut probation = Probation::default();
        probation.begin(start.to_vec());
        probation.keep(start.iter().map(|view| view.0.clone()).collect());
        let count = after.iter().position(|(frame, pose)| probation.fails(&features(frame), pose, &camera()))?;
        Some((count, probation.take_frames().iter().map(|f| f.sequence).collect()))
    }

    #[test]
    fn a_map_that_the_picture_contradicts_fails_and_gives_its_frames_back() {
        let failed = |share| {
            let all = views(22, 0.02, share);
            failed(&all[..2], &all[2..])
        };
        let (count, frames) = failed(0.6).expect("a failure");
        assert!((4..10).contains(&count), "{count}");
        assert_eq!(frames, (0..2 + count as u64).collect::<Vec<_>>(), "all but the one that told");
        assert_eq!(failed(0.0), None);
        assert_eq!(failed(0.15), None, "something small moves");
    }

    #[test]
    fn what_moves_alone_says_nothing_where_the_camera_has_come_back() {
        let mut all = views(22, 0.02, 0.15);
        for (frame, pose) in all.iter_mut().skip(2) {
            // The room is where it was, and the camera.
            let before = views(1, 0.02, 0.15).remove(0);
            let moving = std::mem::take(&mut frame.tracks).into_iter().filter(|(id, _)| id / 24 < 4);
            let standing = before.0.tracks.into_iter().filter(|(id, _)| id / 24 >= 4);
            frame.tracks = moving.chain(standing).collect();
            *pose = before.1;
        }
        assert_eq!(failed(&all[..1], &all[2..]), None);
    }

    #[test]
    fn probation_is_over_after_a_second_or_when_it_is_ended() {
        let all = views(60, 0.004, 0.6);
        let over = |probation: &mut Probation, n: usize| {
            probation.fails(&features(&all[n].0), &all[n].1, &camera());
            probation.take_frames().is_empty()
        };
        let mut probation = Probation::default();
        assert!(over(&mut probation, 3), "none has begun");
        probation.begin(all[..2].to_vec());
        probation.fails(&features(&all[3].0), &all[3].1, &camera());
        assert!(!over(&mut probation, 4), "it goes on");
        probation.begin(all[..2].to_vec());
        assert!(over(&mut probation, 40), "after more than a second");
        probation.begin(all[20..22].to_vec());
        assert!(over(&mut probation, 3), "the clock went back");
        probation.begin(all[..2].to_vec());
        probation.end();
        assert!(over(&mut probation, 3));
    }
}
