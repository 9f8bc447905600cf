//! When the map is adjusted: which job the mapping worker gets, and when its result is taken over.
//!
//! One job is under way at a time, and what has come meanwhile is in the next one. Its result is merged after a pose was published; where frames
//! come slowly, before the next one is tracked. Lock-step waits for results at fixed frames, live operation never waits.

mod bundle;
pub mod intrinsics;
pub mod job;

use super::Reconstruction;
use crate::map::KeyframeId;
use job::{MappingJob, Merge};

/// Keyframes up to which the whole map is adjusted, and once when another was joined to it.
const WHOLE_LIMIT: usize = 120;
const JOINED_LIMIT: usize = 240;

/// Between frames this far apart, ns, an adjustment has long been done (three frames of a usual camera): it is merged before the next one is
/// tracked. A walk at 5 Hz sees a landmark in four or five frames; with a map adjusted three frames late it has lost most of them.
const AMPLE_NS: i64 = 110_000_000;

impl Reconstruction {
    /// Posts a job around the newest keyframe that no adjustment has seen, unless one is under way.
    pub(super) fn post_adjustment(&mut self) {
        if let Some(newest) = self.unadjusted
            && self.job_posted.is_none()
        {
            self.unadjusted = None;
            let keyframes = self.map.keyframes.len();
            let limit = if self.next_whole == 0 { JOINED_LIMIT } else { WHOLE_LIMIT };
            let job = if keyframes >= self.next_whole && keyframes <= limit {
                self.next_whole = self.intrinsics.next_whole(keyframes);
                self.intrinsics.whole_job(
                    &self.map,
                    &self.camera,
                    self.shutter.to_adjust(),
                    self.config.refine_intrinsics,
                )
            } else {
                MappingJob::local(&self.map, newest, &self.camera, self.shutter.to_adjust(), &self.config)
            };
            if let Some(job) = job {
                self.worker.post(job);
                self.job_posted = Some(self.frame);
            }
        }
    }

    /// Before a frame is tracked that comes `gap_ns` after the one before.
    pub(super) fn merge_after_gap(&mut self, gap_ns: i64) {
        if gap_ns >= AMPLE_NS {
            self.merge_adjustment(Merge::BeforeTracking);
        }
    }

    /// Merges a finished adjustment; lock-step, and the end, wait for one whose time has come.
    pub(super) fn merge_adjustment(&mut self, when: Merge) {
        let Some(posted) = self.job_posted else { return };
        let due = self.frame >= posted + self.config.merge_after_frames;
        if when == Merge::WhenDue && self.lockstep && !due {
            return;
        }
        let Some(result) = self.worker.take(self.lockstep || when == Merge::AtTheEnd) else { return };
        if !self.lockstep && self.frame > posted + self.config.merge_after_frames {
            self.counters.adjustments_late += 1;
        }
        self.job_posted = None;
        self.counters.adjustments += 1;
        let Some(lens) = self.intrinsics.judge(&result, &self.camera) else {
            // A lens that cannot be is not taken over, and its poses and points with it.
            if self.intrinsics.wants_another() {
                self.next_whole = 0;
                self.unadjusted = self.map.keyframes.iter().last().map(|(id, _)| KeyframeId(id));
            }
            return;
        };
        self.shutter.learn(result.readout());
        let old_from_new = result.merge(&mut self.map);
        self.intrinsics.merge(&result, lens, &mut self.map, &mut self.camera);
        if let Some(last) = &mut self.last {
            last.camera_from_world = last.camera_from_world * old_from_new;
        }
        if when != Merge::AtTheEnd && self.intrinsics.wants_restart(&self.camera) {
            self.reset();
        }
    }

    /// Waits for the job under way, if any, and merges it. Nothing is adjusted beyond it.
    pub fn finish(&mut self) {
        self.merge_adjustment(Merge::AtTheEnd);
    }
}
