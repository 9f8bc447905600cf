//! One client for all feeds, made when the daemon's prefix can be looked at.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::client::{Client, ClientError};
use crate::messages::Endpoint;

/// Pause after an error that waiting may cure after all: the daemon is updated, or belongs to our user next time.
const PAUSE: Duration = Duration::from_secs(1);

/// How often a feed looks for something new. A person sees nothing of it, and the daemon need not wake the console for each message.
pub const LOOK: Duration = Duration::from_millis(10);

/// See module.
#[derive(Debug)]
pub struct Source {
    endpoint: Endpoint,
    client: Mutex<Option<Client>>,
}

impl Source {
    pub fn new(endpoint: Endpoint) -> Self {
        Self { endpoint, client: Mutex::new(None) }
    }

    pub fn prefix(&self) -> &str {
        self.endpoint.prefix()
    }

    /// The client; an error says why the daemon of this prefix cannot be read.
    pub fn client(&self) -> Result<Client, ClientError> {
        let mut shared = self.client.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(client) = &*shared {
            return Ok(client.clone());
        }
        let client = Client::with_endpoint(self.endpoint.clone())?;
        *shared = Some(client.clone());
        Ok(client)
    }
}

/// How soon a demand, its end, and a daemon that has gone are noticed.
pub const NAP: Duration = Duration::from_millis(100);

/// Until `stop`: `follow` while it is `wanted`, and again after a pause where that fails. Why, the feed of poses tells: it fails for the same reason.
pub fn while_wanted(stop: &AtomicBool, wanted: impl Fn() -> bool, mut follow: impl FnMut() -> Result<(), ClientError>) {
    while !stop.load(Ordering::Relaxed) {
        if !wanted() {
            wait(stop, NAP);
        } else if follow().is_err() {
            pause(stop);
        }
    }
}

/// Waits, unless it is time to end.
pub fn pause(stop: &AtomicBool) {
    wait(stop, PAUSE);
}

/// Sleeps in short naps.
pub fn wait(stop: &AtomicBool, time: Duration) {
    let start = Instant::now();
    while !stop.load(Ordering::Relaxed) && start.elapsed() < time {
        std::thread::sleep(Duration::from_millis(50));
    }
}
