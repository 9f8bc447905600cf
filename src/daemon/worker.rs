//! Threads that run mapping jobs and look for old places, so that neither an adjustment nor a loop ever delays a pose.

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, bounded};

use super::background::TURN;
use super::status::Status;
use crate::reconstruction::{Work, Worker};

/// Once the daemon is to stop a job is waited for so long: the map is whole without it, and must be on the disk in time.
const LAST_JOB: Duration = Duration::from_secs(1);

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
    status: Arc<Status>,
}

impl<W: Work + 'static> ThreadWorker<W> {
    /// Starts the thread; it ends when this value is dropped, or with a job that panics: nobody waits for that one, and the supervisor ends the run.
    pub fn spawn(name: &'static str, status: Arc<Status>) -> std::io::Result<(Self, thread::JoinHandle<()>)> {
        let (jobs, job_queue) = bounded::<(u64, W)>(1);
        let waiting = job_queue.clone();
        // Room for one that nobody wants any more, so that the thread never waits to get rid of it.
        let (result_queue, results) = bounded(2);
        let handle = thread::Builder::new().name(name.into()).spawn(move || {
            for (number, job) in job_queue {
                drop(result_queue.send((number, job.run())));
            }
        })?;
        Ok((Self { jobs, waiting, results, number: 0, under_way: false, status }, handle))
    }
}

impl<W: Work> ThreadWorker<W> {
    /// The next result; `None` if the thread has gone, or is not done in time once the daemon is to stop.
    fn next(&self) -> Option<(u64, W::Outcome)> {
        let mut left = LAST_JOB;
        loop {
            match self.results.recv_timeout(TURN) {
                Ok(result) => return Some(result),
                Err(RecvTimeoutError::Disconnected) => return None,
                Err(RecvTimeoutError::Timeout) if self.status.stopping() => left = left.checked_sub(TURN)?,
                Err(RecvTimeoutError::Timeout) => {}
            }
        }
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
            let next = if wait { self.next() } else { self.results.try_recv().ok() };
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
        let (mut worker, thread) = ThreadWorker::spawn("test", Arc::default()).expect("thread");
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

    #[test]
    fn a_job_that_outlasts_a_stop_is_not_waited_for() {
        let (go, gate) = bounded::<()>(1);
        let status = Arc::<Status>::default();
        let (mut worker, thread) = ThreadWorker::spawn("test", status.clone()).expect("thread");
        worker.post(Gated { gate, number: 1 });
        status.request_stop();
        assert_eq!(worker.take(true), None);
        drop((go, worker));
        thread.join().expect("ends");
    }

    #[test]
    fn a_job_that_panics_keeps_nobody_waiting_and_its_thread_tells() {
        struct Fault;
        impl Work for Fault {
            type Outcome = ();

            fn run(self) {
                panic!("on purpose");
            }
        }
        let (mut worker, thread) = ThreadWorker::spawn("test", Arc::default()).expect("thread");
        worker.post(Fault);
        assert_eq!(worker.take(true), None);
        worker.post(Fault);
        assert_eq!(worker.take(true), None);
        assert!(thread.join().is_err());
    }
}
