//! A thread that runs mapping jobs, so that no adjustment ever delays a pose.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::thread;

use crossbeam::channel::{Receiver, Sender, bounded};
use tracing::error;

use crate::reconstruction::{MappingJob, MappingResult, MappingWorker};

/// Reconstruction's end of the mapping thread. At most one job is under way, so both queues hold one.
pub struct ThreadWorker {
    jobs: Sender<MappingJob>,
    results: Receiver<MappingResult>,
    under_way: bool,
}

impl ThreadWorker {
    /// Starts the thread; it ends when this value is dropped.
    pub fn spawn() -> std::io::Result<(Self, thread::JoinHandle<()>)> {
        let (jobs, job_queue) = bounded::<MappingJob>(1);
        let (result_queue, results) = bounded(1);
        let handle = thread::Builder::new().name("cairn-mapping".into()).spawn(move || {
            for job in job_queue {
                // A job that panics must not leave reconstruction waiting: the queue is closed, and it goes on without.
                match catch_unwind(AssertUnwindSafe(|| job.run())) {
                    Ok(result) => drop(result_queue.send(result)),
                    Err(_) => {
                        error!("mapping job panicked, the map is not adjusted any more");
                        return;
                    }
                }
            }
        })?;
        Ok((Self { jobs, results, under_way: false }, handle))
    }
}

impl MappingWorker for ThreadWorker {
    fn post(&mut self, job: MappingJob) {
        // Never blocks: the queue is empty whenever a job may be posted. It fails only if the thread is gone.
        self.under_way = self.jobs.try_send(job).is_ok();
    }

    fn take(&mut self, wait: bool) -> Option<MappingResult> {
        if !self.under_way {
            return None;
        }
        let result = if wait { self.results.recv().ok() } else { self.results.try_recv().ok() };
        if result.is_some() || wait {
            self.under_way = false;
        }
        result
    }
}
