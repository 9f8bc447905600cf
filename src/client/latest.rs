//! One line for a program that only wants to know where the robot is: [`Pose::latest`], [`Health::latest`].

use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use super::{Client, ClientError, Healths, Poses, Subscription, Topic, monotonic_ns};
use crate::messages::{Health, Pose};

/// A new reader waits this long at most for the last message of a daemon that is there; it comes with the next one or with
/// the daemon's health, ten times a second.
const FIRST: Duration = Duration::from_millis(400);

static POSES: Mutex<Option<Poses>> = Mutex::new(None);
static HEALTH: Mutex<Option<Healths>> = Mutex::new(None);

impl Pose {
    /// The newest pose of the daemon that CAIRN_PREFIX names (`cairn` if it is not set); `None` while there has been none. The
    /// same one again while no newer has come, also when the daemon has died: ask [`Self::is_usable`].
    ///
    /// All callers in a process share one subscription, which is kept. The first call takes some ms, and up to 0.4 s if a
    /// daemon is there and silent; later ones under a microsecond. Never waits for a daemon.
    pub fn latest() -> Result<Option<Self>, ClientError> {
        latest(&POSES, Client::poses)
    }

    /// The robot may act on this pose: it was tracked, and its frame is no older than `max_age` ([`Self::age_ns`]).
    pub fn is_usable(&self, max_age: Duration) -> bool {
        self.is_tracking() && u128::try_from(self.age_ns(monotonic_ns())).is_ok_and(|age| age <= max_age.as_nanos())
    }
}

impl Health {
    /// The newest health of the daemon that CAIRN_PREFIX names; otherwise as [`Pose::latest`].
    pub fn latest() -> Result<Option<Self>, ClientError> {
        latest(&HEALTH, Client::health)
    }
}

fn latest<T: Topic<Item: Clone>>(
    shared: &Mutex<Option<Subscription<T>>>,
    subscribe: fn(&Client) -> Subscription<T>,
) -> Result<Option<T::Item>, ClientError> {
    let mut shared = shared.lock().unwrap_or_else(PoisonError::into_inner);
    let subscription = match &mut *shared {
        Some(subscription) => subscription,
        none => none.insert(subscribe(&Client::from_environment()?)),
    };
    subscription.latest_within(FIRST).map(|item| item.cloned())
}
