//! The one adjustment that is under way, and when its result is due.

use super::job::{MappingJob, MappingResult, MappingWorker};

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
    worker: Box<dyn MappingWorker>,
    lockstep: bool,
    /// Frame at which the job under way was posted.
    posted: Option<u64>,
}

impl Mapper {
    pub fn new(worker: Box<dyn MappingWorker>, lockstep: bool) -> Self {
        Self { worker, lockstep, posted: None }
    }

    pub fn is_lockstep(&self) -> bool {
        self.lockstep
    }

    pub fn is_busy(&self) -> bool {
        self.posted.is_some()
    }

    pub fn post(&mut self, job: MappingJob, frame: u64) {
        self.worker.post(job);
        self.posted = Some(frame);
    }

    /// Forgets the job under way.
    pub fn discard(&mut self) {
        if self.posted.take().is_some() {
            self.worker.discard();
        }
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
