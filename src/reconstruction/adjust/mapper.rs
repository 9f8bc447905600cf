//! The one adjustment that is under way, and when its result is due.

use crate::reconstruction::keyframe::motion::Moved;
use crate::reconstruction::work::Worker;

use super::job::{MappingJob, MappingResult};

/// When an adjustment is merged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Merge {
    /// After a published pose: live as soon as it is done, in lock-step a fixed number of frames after it was posted.
    WhenDue,
    /// Before a frame that comes long after the last one.
    BeforeTracking,
    /// No frame will follow.
    AtTheEnd,
}

/// Who runs adjustments.
pub struct Mapper {
    worker: Box<dyn Worker<MappingJob>>,
    lockstep: bool,
    /// Frame at which the job under way was posted.
    posted: Option<u64>,
    /// It depends on nothing that changes.
    is_piece: bool,
    /// What a keyframe in it has moved by since.
    moved: Option<Moved>,
}

impl Mapper {
    pub fn new(worker: Box<dyn Worker<MappingJob>>, lockstep: bool) -> Self {
        Self { worker, lockstep, posted: None, is_piece: false, moved: None }
    }

    pub fn is_lockstep(&self) -> bool {
        self.lockstep
    }

    pub fn is_busy(&self) -> bool {
        self.posted.is_some()
    }

    pub fn post(&mut self, job: MappingJob, frame: u64) {
        self.is_piece = matches!(job, MappingJob::Piece(_));
        self.worker.post(job);
        (self.posted, self.moved) = (Some(frame), None);
    }

    /// Notes that the newest keyframe, made at that frame, has moved, if the job under way holds it where it was.
    pub fn note_moved(&mut self, moved: Moved, made_at: u64) {
        if self.posted.is_some_and(|posted| posted >= made_at) {
            self.moved = Some(moved);
        }
    }

    /// What a keyframe has moved by since the job whose result was just taken was posted.
    pub fn take_moved(&mut self) -> Option<Moved> {
        self.moved.take()
    }

    /// Forgets the job under way, but for a piece, which depends on nothing that has changed; true if there was one.
    pub fn discard(&mut self) -> bool {
        self.moved = None;
        let is_forgotten = !self.is_piece && self.posted.take().is_some();
        if is_forgotten {
            self.worker.discard();
        }
        is_forgotten
    }

    /// The result, once it is to be merged, and whether it comes later than `merge_after` frames after it was posted (live only).
    /// Lock-step, and the end, wait for it.
    pub fn take(&mut self, when: Merge, frame: u64, merge_after: u64) -> Option<(MappingResult, bool)> {
        let due = self.posted? + merge_after;
        if when == Merge::WhenDue && self.lockstep && frame < due {
            return None;
        }
        let result = self.worker.take(self.lockstep || when == Merge::AtTheEnd)?;
        self.posted = None;
        Some((result, !self.lockstep && frame > due))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reconstruction::adjust::job::Piece;
    use crate::reconstruction::work::InlineWorker;

    #[derive(Debug)]
    struct Nothing;

    impl Piece for Nothing {
        fn step(&mut self) {}

        fn is_done(&self) -> bool {
            true
        }
    }

    #[test]
    fn a_piece_outlives_what_adjustments_are_discarded_for() {
        let mut mapper = Mapper::new(Box::new(InlineWorker::default()), true);
        mapper.post(MappingJob::Piece(Box::new(Nothing)), 7);
        mapper.discard();
        assert!(mapper.is_busy());
        assert!(matches!(mapper.take(Merge::WhenDue, 10, 3), Some((MappingResult::Piece(_), false))));
        assert!(!mapper.is_busy());
    }
}
