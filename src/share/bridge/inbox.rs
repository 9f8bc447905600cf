//! What ROS 2 asks, until it is carried out: a bounded queue between Zenoh's threads and [`super::Commands`].
//!
//! Full, it takes no more and says so. Of initial poses only the newest waits. Each has the monotonic time of its arrival: what has waited longer than
//! [`OLDEST`] is no longer what anybody wants. A sender's own time is not looked at, as clocks of two machines may differ.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tracing::warn;
use zenoh::query::Query;

use super::attachment::Attachment;

/// Requests that wait.
const QUEUE: usize = 8;
/// A robot at 0.5 m/s is a metre on by then, and whoever asked has seen nothing happen.
pub const OLDEST: Duration = Duration::from_secs(2);
/// What repeats is said once in so long.
const SAY_EVERY: Duration = Duration::from_secs(10);

/// Services, each a `std_srvs/srv/Trigger`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Service {
    /// Drops the map and starts over.
    Reset,
    /// Stores the map in its file.
    Save,
}

impl Service {
    pub const ALL: [Self; 2] = [Self::Reset, Self::Save];

    /// Below the robot's namespace.
    pub fn word(self) -> &'static str {
        match self {
            Self::Reset => "reset",
            Self::Save => "save",
        }
    }
}

/// `Q`: what is answered.
pub enum Request<Q = Query> {
    Service {
        service: Service,
        asked: Attachment,
        query: Q,
    },
    /// A PoseWithCovarianceStamped's bytes.
    InitialPose(Vec<u8>),
}

/// A request, and whether it has waited too long.
pub struct Taken<Q = Query> {
    pub request: Request<Q>,
    pub age: Duration,
}

impl<Q> Taken<Q> {
    /// It is too late for it.
    pub fn is_stale(&self) -> bool {
        self.age > OLDEST
    }
}

/// Without a clock.
struct Queue<Q> {
    waiting: VecDeque<(Request<Q>, Instant)>,
    /// Requests that found it full.
    dropped: u64,
}

impl<Q> Default for Queue<Q> {
    fn default() -> Self {
        Self { waiting: VecDeque::with_capacity(QUEUE), dropped: 0 }
    }
}

impl<Q> Queue<Q> {
    /// If it is not taken, how many were not so far.
    fn push(&mut self, request: Request<Q>, now: Instant) -> Option<u64> {
        if matches!(request, Request::InitialPose(_)) {
            self.waiting.retain(|(request, _)| !matches!(request, Request::InitialPose(_)));
        }
        if self.waiting.len() < QUEUE {
            self.waiting.push_back((request, now));
            return None;
        }
        self.dropped += 1;
        Some(self.dropped)
    }

    fn pop(&mut self, now: Instant) -> Option<Taken<Q>> {
        let (request, came) = self.waiting.pop_front()?;
        Some(Taken { request, age: now.saturating_duration_since(came) })
    }
}

struct Shared {
    queue: Mutex<Queue<Query>>,
    come: Condvar,
    said: Mutex<Option<Instant>>,
}

/// Both ends of the queue.
#[derive(Clone)]
pub struct Inbox {
    shared: Arc<Shared>,
}

impl Default for Inbox {
    fn default() -> Self {
        let queue = Mutex::new(Queue::default());
        Self { shared: Arc::new(Shared { queue, come: Condvar::new(), said: Mutex::new(None) }) }
    }
}

impl Inbox {
    /// Waits for nothing but another push.
    pub fn push(&self, request: Request) {
        let refused = lock(&self.shared.queue).push(request, Instant::now());
        match refused {
            None => self.shared.come.notify_one(),
            Some(dropped) => warn!(dropped, "too many requests from ROS 2 at once, one is not answered"),
        }
    }

    /// Says that something came that is no request of rmw_zenoh's.
    pub fn refuse(&self, key: &str, reason: &str) {
        let mut said = lock(&self.shared.said);
        if said.is_none_or(|at| at.elapsed() >= SAY_EVERY) {
            *said = Some(Instant::now());
            warn!(key, reason, "request over Zenoh refused");
        }
    }

    /// The oldest one, waiting for it up to `patience`.
    pub fn pop(&self, patience: Duration) -> Option<Taken> {
        let queue = lock(&self.shared.queue);
        let waited = self.shared.come.wait_timeout_while(queue, patience, |queue| queue.waiting.is_empty());
        let (mut queue, _) = waited.unwrap_or_else(PoisonError::into_inner);
        queue.pop(Instant::now())
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // What it holds is whole at any time.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::share::bridge::attachment::GID_BYTES;

    fn service(query: u32) -> Request<u32> {
        let asked = Attachment { sequence: 1, time_ns: 0, gid: [0; GID_BYTES] };
        Request::Service { service: Service::Reset, asked, query }
    }

    fn told(taken: &Taken<u32>) -> u32 {
        match &taken.request {
            Request::Service { query, .. } => *query,
            Request::InitialPose(bytes) => 100 + u32::from(bytes[0]),
        }
    }

    #[test]
    fn of_initial_poses_the_newest_waits_and_the_rest_in_their_order() {
        let (mut queue, now) = (Queue::default(), Instant::now());
        let place = |number: u8| Request::InitialPose(vec![number]);
        for request in [place(1), service(2), place(3), service(4), place(5)] {
            assert_eq!(queue.push(request, now), None);
        }
        let order: Vec<u32> = std::iter::from_fn(|| queue.pop(now)).map(|taken| told(&taken)).collect();
        assert_eq!(order, [2, 4, 105]);
    }

    #[test]
    fn a_full_queue_takes_nothing_but_a_newer_pose_for_an_older_one() {
        let (mut queue, now) = (Queue::default(), Instant::now());
        assert_eq!(queue.push(Request::InitialPose(vec![1]), now), None);
        assert!((1..QUEUE as u32).all(|number| queue.push(service(number), now).is_none()));
        assert_eq!(
            [99, 100].map(|number| queue.push(service(number), now)),
            [Some(1), Some(2)],
            "dropped, and counted"
        );
        assert_eq!((queue.push(Request::InitialPose(vec![2]), now), queue.waiting.len()), (None, QUEUE));
    }

    #[test]
    fn what_has_waited_too_long_is_stale() {
        let (mut queue, now) = (Queue::default(), Instant::now());
        queue.push(service(1), now);
        queue.push(service(2), now);
        let ages = [OLDEST, OLDEST + Duration::from_millis(1)];
        let stale = ages.map(|age| queue.pop(now + age).expect("a request").is_stale());
        assert_eq!(stale, [false, true]);
    }
}
