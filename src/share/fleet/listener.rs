//! The Zenoh session of a [`Table`]: what its callbacks hear is told to the table at once, under a lock, so nothing waits anywhere.

use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use zenoh::pubsub::Subscriber;
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Session, Wait};

use super::listing::Listing;
use super::report::MOST_BYTES;
use super::table::Table;
use crate::share::bridge::attachment::{Attachment, BYTES};
use crate::share::bridge::names::{bridges, key};
use crate::share::bridge::session;
use crate::share::bridge::topic::Topic;
use crate::share::bridge::{BridgeError, reason};

/// Where bridges tell it, whatever the robot.
const TOPIC: &str = "/diagnostics";

/// See module. What is held only to be there is behind `_`.
pub struct Listener {
    table: Arc<Mutex<Table>>,
    endpoints: String,
    _heard: [Subscriber<()>; 2],
    session: Session,
}

impl Listener {
    /// Opens the session, which need not find anybody yet. `file`: Zenoh's own configuration.
    pub fn open(domain: u32, file: Option<&Path>) -> Result<Self, BridgeError> {
        let (session, endpoints) = session::open(file)?;
        let table = Arc::new(Mutex::new(Table::new(domain)));
        let failed = |what: &str| {
            let what = what.to_owned();
            move |e: zenoh::Error| BridgeError::Declare { what, reason: reason(&e) }
        };
        let (pattern, seen) = (bridges(domain, TOPIC), table.clone());
        let tokens = session.liveliness().declare_subscriber(pattern.clone()).history(true);
        let tokens = tokens.callback(move |sample| {
            let (token, now) = (sample.key_expr().as_str(), Instant::now());
            match sample.kind() {
                SampleKind::Put => lock(&seen).token_up(token, now),
                SampleKind::Delete => lock(&seen).token_down(token, now),
            }
        });
        let tokens = tokens.wait().map_err(failed(&pattern))?;
        let (key, told) = (key(domain, TOPIC, Topic::Diagnostics.of()), table.clone());
        let diagnostics = session.declare_subscriber(key.clone()).callback(move |sample| take(&told, &sample));
        let diagnostics = diagnostics.wait().map_err(failed(&key))?;
        Ok(Self { table, endpoints, _heard: [tokens, diagnostics], session })
    }

    /// As it is now.
    pub fn listing(&self) -> Listing {
        // Asked before the lock: Zenoh's threads may hold what it asks for while they wait for the table.
        let link = session::link(&self.session);
        let mut table = lock(&self.table);
        table.network(link);
        table.listing(Instant::now())
    }

    /// Where it connects to, as configured.
    pub fn endpoints(&self) -> &str {
        &self.endpoints
    }

    pub fn close(self) {
        // Whoever closes does not need to know that the network has gone before.
        let _ = self.session.close().wait();
    }
}

/// Whoever sends something else, or more than a bridge does, is not listened to, and nothing of it is copied.
fn take(table: &Mutex<Table>, sample: &Sample) {
    let attachment = sample.attachment().filter(|attachment| attachment.len() == BYTES);
    let attachment = attachment.and_then(|attachment| Attachment::from_bytes(&attachment.to_bytes()));
    let is_fit = sample.kind() == SampleKind::Put && sample.payload().len() <= MOST_BYTES;
    if let Some(attachment) = attachment.filter(|_| is_fit) {
        lock(table).diagnostics(&attachment.gid, &sample.payload().to_bytes(), Instant::now());
    }
}

fn lock(table: &Mutex<Table>) -> MutexGuard<'_, Table> {
    // A row is whole at any time.
    table.lock().unwrap_or_else(PoisonError::into_inner)
}
