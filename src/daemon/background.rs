//! Work that may hang, in a thread of its own: opening a camera, closing one.
//!
//! Input: orders, one at a time. Output: their outcome, asked for with a bounded wait. A driver may take many seconds to open a device that no
//! longer answers (uvcvideo waits 5 s for each request); whoever waits for it here stays alive meanwhile, and says so.
//!
//! A piece of work that never ends is left behind when this value is dropped: its thread ends with it, or with the process.

use std::thread;
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, bounded};

/// Longest wait of any stage: how late a stop is seen at the most.
pub const TURN: Duration = Duration::from_millis(100);

/// Something to be closed, and an attempt to open: more is never waiting.
const QUEUE: usize = 2;

/// See module.
pub struct Background<Order, Outcome> {
    orders: Sender<Order>,
    outcomes: Receiver<Outcome>,
    asked: Option<Instant>,
}

/// How far the work is.
pub enum Progress<Outcome> {
    Done(Outcome),
    /// Under way for so long.
    Pending(Duration),
    /// The work panicked.
    Dead,
}

impl<Order: Send + 'static, Outcome: Send + 'static> Background<Order, Outcome> {
    /// `work` answers what was asked, and gives `None` for what it was only told.
    pub fn spawn(name: &str, mut work: impl FnMut(Order) -> Option<Outcome> + Send + 'static) -> std::io::Result<Self> {
        let (orders, queue) = bounded(QUEUE);
        let (out, outcomes) = bounded(1);
        thread::Builder::new().name(name.into()).spawn(move || {
            for order in queue {
                if let Some(outcome) = work(order)
                    && out.send(outcome).is_err()
                {
                    return;
                }
            }
        })?;
        Ok(Self { orders, outcomes, asked: None })
    }

    /// Has something done that has no outcome. Never waits.
    pub fn tell(&self, order: Order) {
        // There is room, as only one question is ever open. It fails only if the thread has panicked, which the next answer tells.
        let _ = self.orders.try_send(order);
    }

    /// The outcome of `order`, which is begun unless a question is open already. Waits at most `patience`.
    pub fn ask(&mut self, order: impl FnOnce() -> Order, patience: Duration) -> Progress<Outcome> {
        if self.asked.is_none() {
            self.tell(order());
        }
        let asked = *self.asked.get_or_insert_with(Instant::now);
        match self.outcomes.recv_timeout(patience) {
            Ok(outcome) => {
                self.asked = None;
                Progress::Done(outcome)
            }
            Err(RecvTimeoutError::Timeout) => Progress::Pending(asked.elapsed()),
            Err(RecvTimeoutError::Disconnected) => Progress::Dead,
        }
    }
}

/// What `work` gives within `limit`; `None` if it is not done by then (it is left behind), or panics.
pub fn within<T: Send + 'static>(limit: Duration, work: impl FnOnce() -> T + Send + 'static) -> Option<T> {
    let mut work = Some(work);
    let mut thread = Background::spawn("cairn-attempt", move |()| work.take().map(|work| work())).ok()?;
    match thread.ask(|| (), limit) {
        Progress::Done(outcome) => Some(outcome),
        Progress::Pending(_) | Progress::Dead => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_that_hangs_is_not_waited_for_without_end() {
        let (hold, held) = bounded::<()>(1);
        assert_eq!(within(Duration::from_millis(50), move || held.recv().is_ok()), None);
        drop(hold);
        assert_eq!(within(Duration::from_secs(60), || 7), Some(7));
    }
}
