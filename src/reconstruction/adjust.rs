//! When the map is adjusted: which job the mapping worker gets, and when its result is taken over.
//!
//! One job is under way at a time, and what has come meanwhile is in the next one. Its result is merged after a pose was published; where frames
//! come slowly, before the next one is tracked. Lock-step waits for results at fixed frames, live operation never waits.

mod bundle;
pub mod intrinsics;
pub mod job;
pub mod mapper;

use super::Reconstruction;
use crate::map::Keyframe;
use job::{Adjustment, AdjustmentResult, MappingJob, MappingResult};
use mapper::Merge;

/// Keyframes up to which a map is adjusted globally.
const GLOBAL_LIMIT: usize = 240;

/// Between frames this far apart, ns, an adjustment has long been done (three frames of a usual camera): it is merged before the next one is
/// tracked. A walk at 5 Hz sees a landmark in four or five frames; with a map adjusted three frames late it has lost most of them.
const AMPLE_NS: i64 = 110_000_000;

impl Reconstruction {
    /// Posts a job unless one is under way: a loop that waits to be closed, a piece of a second look, else around the newest keyframe that no adjustment has seen.
    pub(super) fn post_adjustment(&mut self) {
        if self.mapper.is_busy() {
            return;
        }
        if let Some(job) = self.loop_closure() {
            self.mapper.post(MappingJob::CloseLoop(Box::new(job)), self.counters.frames);
            return;
        }
        if let Some(piece) = self.second_look.next_piece(self.active.unadjusted.is_none()) {
            self.mapper.post(piece, self.counters.frames);
            return;
        }
        let (optics, active) = (&self.optics, &mut self.active);
        let Some(newest) = active.unadjusted.take() else { return };
        let keyframes = active.map.keyframes.len();
        let job = if keyframes >= active.next_global && keyframes <= GLOBAL_LIMIT {
            active.next_global = optics.intrinsics.next_global(keyframes);
            optics.intrinsics.global_job(&active.map, &optics.camera, &optics.shutter, self.config.refine_intrinsics)
        } else {
            Adjustment::local(&active.map, newest, &optics.camera, &optics.shutter, &self.config)
        };
        let is_lens_known = optics.intrinsics.is_calibrated();
        if let Some(mut job) = job.map(|job| job.judged_by(optics.noise.outlier_chi2(), is_lens_known)) {
            if active.fusion.is_metric() {
                job.hold_lengths(&active.map, |from_ns, to_ns| self.wheels.held(&active.fusion, from_ns, to_ns));
                let tags = self.tags.as_ref().map_or_else(Vec::new, |tags| tags.held(&active.map, &active.fusion));
                job.hold_tags(&active.map, &optics.camera, &optics.shutter, &tags);
                let centre = active.map.keyframe(newest).map(Keyframe::centre);
                let floor = self.floor.as_ref().zip(centre);
                if let Some(floor) = floor.and_then(|(floor, at)| floor.driven(active.id, &active.fusion, &at)) {
                    job.hold_floor(&active.map, &optics.camera, &optics.shutter, &floor);
                }
            }
            self.mapper.post(MappingJob::Adjust(Box::new(job)), self.counters.frames);
        }
    }

    /// Forgets the job under way, as what it began from is no more; with it what was found of loops, which would wait for it for ever.
    pub(super) fn discard_job(&mut self) {
        self.mapper.discard();
        self.loops.forget_found();
    }

    /// Before a frame is tracked that comes `gap_ns` after the one before.
    pub(super) fn merge_after_gap(&mut self, gap_ns: i64) {
        if gap_ns >= AMPLE_NS {
            self.merge_adjustment(Merge::BeforeTracking);
            self.hear_recognition(Merge::BeforeTracking);
        }
    }

    /// Merges a finished adjustment; lock-step, and the end, wait for one whose time has come.
    pub(super) fn merge_adjustment(&mut self, when: Merge) {
        let taken = self.mapper.take(when, self.counters.frames, self.config.merge_after_frames);
        let Some((result, late)) = taken else { return };
        self.counters.adjustments_late += u64::from(late);
        match result {
            MappingResult::Adjusted(result) => self.take_over(&result, when),
            MappingResult::ClosedLoop(closed) => self.take_over_loop(closed),
            MappingResult::Piece(look) => self.take_over_second_look(look),
        }
    }

    fn take_over(&mut self, result: &AdjustmentResult, when: Merge) {
        self.counters.adjustments += 1;
        let (optics, active) = (&mut self.optics, &mut self.active);
        let found = result.intrinsics();
        let Some(lens) = optics.intrinsics.judge(found.as_ref(), &optics.camera) else {
            // A lens that cannot be is not taken over, and its poses and points with it.
            if optics.intrinsics.wants_another() {
                active.next_global = 0;
                active.unadjusted = active.map.newest();
            }
            return;
        };
        let (readout_s, variance) = result.readout();
        optics.shutter.learn(readout_s, variance);
        optics.noise.learn(result.noise);
        let old_from_new = result.merge(&mut active.map);
        if let Some(moved) = self.mapper.take_moved() {
            moved.apply(&mut active.map, optics.shutter.readout_s);
        }
        if let (Some(found), Some(lens)) = (found, lens) {
            optics.intrinsics.merge(&found, lens, &mut active.map, &mut optics.camera);
        }
        let before = active.odometry.pose();
        active.odometry.correct(&old_from_new);
        active.probation.correct(&old_from_new);
        self.contradiction.correct(&old_from_new);
        if let Some((old, new)) = before.zip(active.odometry.pose()) {
            self.corrections.adjusted(&old, &new);
        }
        if when != Merge::AtTheEnd && optics.intrinsics.wants_restart(&optics.camera) {
            self.note_begun_wrongly();
            self.put_aside();
        }
    }

    /// Waits for the job under way, if any, and merges it. Nothing is adjusted beyond it.
    pub fn finish(&mut self) {
        self.hear_recognition(Merge::AtTheEnd);
        self.merge_adjustment(Merge::AtTheEnd);
    }
}
