//! Work on copies, and who runs it: what comes of it follows from its input alone, so it can run anywhere, also where it
//! delays no pose.
//!
//! There are two kinds: mapping ([`adjust::job`](super::adjust::job)), and looking for old places
//! ([`loops::recognition`](super::loops::recognition)).

/// One piece of work.
pub trait Work: Send {
    type Outcome: Send;

    /// Bounded, but not in time.
    fn run(self) -> Self::Outcome;
}

/// Who runs work of one kind: a thread of the daemon's, or the caller itself. At most one job is under way.
pub trait Worker<W: Work>: Send {
    /// Starts a job; never called while one is under way.
    fn post(&mut self, job: W);
    /// The result if there is one; with `wait`, blocks until it is there (`None` then only if no job is under way, the
    /// worker died, or it takes too long for a daemon that is to stop).
    fn take(&mut self, wait: bool) -> Option<W::Outcome>;
    /// Forgets the job under way: its result is never given. Another may be posted at once. Does not wait where it can
    /// be avoided.
    fn discard(&mut self);
}

/// Runs every job at once in the calling thread.
pub struct InlineWorker<W: Work> {
    result: Option<W::Outcome>,
}

impl<W: Work> Default for InlineWorker<W> {
    fn default() -> Self {
        Self { result: None }
    }
}

impl<W: Work> Worker<W> for InlineWorker<W> {
    fn post(&mut self, job: W) {
        self.result = Some(job.run());
    }

    fn take(&mut self, _wait: bool) -> Option<W::Outcome> {
        self.result.take()
    }

    fn discard(&mut self) {
        self.result = None;
    }
}
