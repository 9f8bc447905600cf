//! Threads that run mapping jobs and look for old places, so that neither an adjustment nor a loop ever delays a pose.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::thread;

use crossbeam::channel::{Receiver, Sender, bounded};
use tracing::error;

use crate::reconstruction::{MappingJob, MappingResult, MappingWorker, PlaceWorker, Recognised, Recognition};

/// Reconstruction's end of the mapping thread.
pub struct ThreadWorker(Desk<MappingJob, MappingResult>);

impl ThreadWorker {
    /// Starts the thread; it ends when this value is dropped.
    pub fn spawn() -> std::io::Result<(Self, thread::JoinHandle<()>)> {
        let (desk, handle) = Desk::spawn("cairn-mapping", MappingJob::run)?;
        Ok((Self(desk), handle))
    }
}

impl MappingWorker for ThreadWorker {
    fn post(&mut self, job: MappingJob) {
        self.0.post(job);
    }

    fn take(&mut self, wait: bool) -> Option<MappingResult> {
        self.0.take(wait)
    }

    fn discard(&mut self) {
        self.0.discard();
    }
}

/// Reconstruction's end of the thread that knows places again.
pub struct PlaceThread(Desk<Recognition, Recognised>);

impl PlaceThread {
    /// Starts the thread; it ends when this value is dropped.
    pub fn spawn() -> std::io::Result<(Self, thread::JoinHandle<()>)> {
        let (desk, handle) = Desk::spawn("cairn-places", Recognition::run)?;
        Ok((Self(desk), handle))
    }
}

impl PlaceWorker for PlaceThread {
    fn post(&mut self, work: Recognition) {
        self.0.post(work);
    }

    fn take(&mut self, wait: bool) -> Option<Recognised> {
        self.0.take(wait)
    }

    fn discard(&mut self) {
        self.0.discard();
    }
}

/// At most one job is under way that anybody waits for, and beside it one that was given up while it ran; of a job that was given up
/// before it ran nothing is left.
struct Desk<Job, Outcome> {
    jobs: Sender<(u64, Job)>,
    /// To take back what has not begun.
    waiting: Receiver<(u64, Job)>,
    results: Receiver<(u64, Outcome)>,
    /// Number of the last job.
    number: u64,
    under_way: bool,
}

impl<Job: Send + 'static, Outcome: Send + 'static> Desk<Job, Outcome> {
    fn spawn(
        name: &'static str,
        mut run: impl FnMut(Job) -> Outcome + Send + 'static,
    ) -> std::io::Result<(Self, thread::JoinHandle<()>)> {
        let (jobs, job_queue) = bounded::<(u64, Job)>(1);
        let waiting = job_queue.clone();
        // Room for one that nobody wants any more, so that the thread never waits to get rid of it.
        let (result_queue, results) = bounded(2);
        let handle = thread::Builder::new().name(name.into()).spawn(move || {
            for (number, job) in job_queue {
                // A job that panics must not leave reconstruction waiting: the queue is closed, and it goes on without.
                match catch_unwind(AssertUnwindSafe(|| run(job))) {
                    Ok(result) => drop(result_queue.send((number, result))),
                    Err(_) => {
                        error!(thread = name, "mapping job panicked, its kind is not done any more");
                        return;
                    }
                }
            }
        })?;
        Ok((Self { jobs, waiting, results, number: 0, under_way: false }, handle))
    }

    fn post(&mut self, job: Job) {
        self.number += 1;
        // Never blocks: the queue is empty whenever a job may be posted.
        self.under_way = self.jobs.try_send((self.number, job)).is_ok();
    }

    fn take(&mut self, wait: bool) -> Option<Outcome> {
        while self.under_way {
            let next = if wait { self.results.recv().ok() } else { self.results.try_recv().ok() };
            match next {
                // Of a job that was given up while it ran.
                Some((number, _)) if number != self.number => {}
                Some((_, result)) => {
                    self.under_way = false;
                    return Some(result);
                }
                None => {
                    self.under_way = !wait;
                    return None;
                }
            }
        }
        None
    }

    fn discard(&mut self) {
        let _ = self.waiting.try_recv();
        self.under_way = false;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_job_that_is_given_up_while_it_runs_keeps_nobody_waiting_and_its_result_is_never_given() {
        let (go, gate) = bounded::<()>(8);
        let (mut desk, thread) = Desk::spawn("test", move |job: u32| {
            let _ = gate.recv();
            10 * job
        })
        .expect("thread");
        desk.post(1);
        while !desk.jobs.is_empty() {
            thread::yield_now();
        }
        // Neither of these waits: the gate is shut.
        desk.discard();
        desk.post(2);
        desk.discard();
        desk.post(3);
        assert_eq!(desk.take(false), None);
        for _ in 0..2 {
            go.send(()).expect("the thread lives");
        }
        assert_eq!(desk.take(true), Some(30), "the second was given up before it ran");
        assert_eq!(desk.take(true), None);
        drop(desk);
        thread.join().expect("ends");
    }
}
