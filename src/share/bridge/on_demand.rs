//! A subscription of the daemon's that can be done without, held only while somebody wants it: where all its places are taken it is tried again.

use std::time::{Duration, Instant};

use tracing::warn;

use crate::client::ClientError;

/// How long it is left alone when all its places are taken: a recording ends some time.
const AGAIN_AFTER: Duration = Duration::from_secs(5);

/// `S`: the subscription.
pub struct OnDemand<S> {
    open: Option<S>,
    places: Places,
}

impl<S> Default for OnDemand<S> {
    fn default() -> Self {
        Self { open: None, places: Places::default() }
    }
}

impl<S> OnDemand<S> {
    /// Nobody wants it any more.
    pub fn leave(&mut self) {
        self.open = None;
    }

    /// The next message, without waiting: `next` of what `subscribe` opens.
    pub fn try_next<M>(
        &mut self,
        subscribe: impl FnOnce() -> S,
        next: impl FnOnce(&mut S) -> Result<Option<M>, ClientError>,
    ) -> Result<Option<M>, ClientError> {
        let now = Instant::now();
        if !self.places.may_try(now) {
            return Ok(None);
        }
        let next = next(self.open.get_or_insert_with(subscribe));
        let next = self.places.judge(next, now);
        if !self.places.may_try(now) {
            self.open = None;
        }
        next
    }
}

/// What is known of the places at a service. Without a clock.
#[derive(Debug, Default)]
struct Places {
    /// They were all taken: not before this time again.
    again: Option<Instant>,
    has_said: bool,
}

impl Places {
    fn may_try(&self, now: Instant) -> bool {
        self.again.is_none_or(|again| now >= again)
    }

    /// Without a place there is no message now. Said once, until there was one.
    fn judge<M>(&mut self, next: Result<Option<M>, ClientError>, now: Instant) -> Result<Option<M>, ClientError> {
        match next {
            Err(ClientError::TooManySubscribers { service, limit }) => {
                self.again = Some(now + AGAIN_AFTER);
                if !std::mem::replace(&mut self.has_said, true) {
                    warn!(service, limit, "all places at a service are taken, tried again");
                }
                Ok(None)
            }
            Ok(Some(message)) => {
                *self = Self::default();
                Ok(Some(message))
            }
            other => other,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_service_without_a_place_is_none_for_now_and_no_end() {
        let (mut places, now) = (Places::default(), Instant::now());
        let full = || Err::<Option<u8>, _>(ClientError::TooManySubscribers { service: "encoded".into(), limit: 2 });
        assert!(places.may_try(now));
        assert_eq!(places.judge(full(), now), Ok(None));
        assert!(!places.may_try(now) && !places.may_try(now + AGAIN_AFTER / 2) && places.may_try(now + AGAIN_AFTER));
        assert!(places.has_said);
        assert_eq!(places.judge(Ok(Some(7)), now + AGAIN_AFTER), Ok(Some(7)));
        assert!(places.may_try(now) && !places.has_said);
        let other = || Err::<Option<u8>, _>(ClientError::IpcVersionMismatch { service: "encoded".into() });
        assert!(places.judge(other(), now).is_err());
    }
}
