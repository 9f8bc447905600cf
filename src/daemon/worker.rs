//! Threads that run mapping jobs and look for old places, so that neither an adjustment nor a loop ever delays a pose.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::thread;

use crossbeam::channel::{Receiver, Sender, bounded};
use tracing::error;

use crate::reconstruction::{Work, Worker};

/// Reconstruction's end of a thread that runs work of one kind. At most one job is under way that anybody waits for,
/// and beside it one that was given up while it ran; of a job that was given up before it ran nothing is left.
pub struct ThreadWorker<W: Work> {
    jobs: Sender<(u64, W)>,
    /// To take back what has not begun.
    waiting: Receiver<(u64, W)>,
    results: Receiver<(u64, W::Outcome)>,
    /// Number of the last job.
    number: u64,
    under_way: bool,
}

impl<W: Work + 'static> ThreadWorker<W> {
    /// Starts the thread; it ends when this value is dropped.
    pub fn spawn(name: &'static str) -> std::io::Result<(Self, thread::JoinHandle<()>)> {
        let (jobs, job_queue) = bounded::<(u64, W)>(1);
        let waiting = job_queue.clone();
        // Room for one that nobody wants any more, so that the thread never waits to get rid of it.
        let (result_queue, results) = bounded(2);
        let handle = thread::Builder::new().name(name.into()).spawn(move || {
            for (number, job) in job_queue {
                // A job that panics must not leave reconstruction waiting: the queue is closed, and it goes on without.
                match catch_unwind(AssertUnwindSafe(|| job.run())) {
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
}

impl<W: Work> Worker<W> for ThreadWorker<W> {
    fn post(&mut self, job: W) {
        self.number += 1;
        // Never blocks: the queue is empty whenever a job may be posted.
        self.under_way = self.jobs.try_send((self.number, job)).is_ok();
    }

    fn take(&mut self, wait: bool) -> Option<W::Outcome> {
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

    /// Waits at a gate before it ends.
    struct Gated {
        gate: Receiver<()>,
        number: u32,
    }

    impl Work for Gated {
        type Outcome = u32;

        fn run(self) -> u32 {
            let _ = self.gate.recv();
            10 * self.number
        }
    }

    #[test]
    fn a_job_that_is_given_up_while_it_runs_keeps_nobody_waiting_and_its_result_is_never_given() {
        let (go, gate) = bounded::<()>(8);
        let job = |number| Gated { gate: gate.clone(), number };
        let (mut worker, thread) = ThreadWorker::spawn("test").expect("thread");
        worker.post(job(1));
        while !worker.jobs.is_empty() {
            thread::yield_now();
        }
        // Neither of these waits: the gate is shut.
        worker.discard();
        worker.post(job(2));
        worker.discard();
        worker.post(job(3));
        assert_eq!(worker.take(false), None);
        for _ in 0..2 {
            go.send(()).expect("the thread lives");
        }
        assert_eq!(worker.take(true), Some(30), "the second was given up before it ran");
        assert_eq!(worker.take(true), None);
        drop(worker);
        thread.join().expect("ends");
    }
}
