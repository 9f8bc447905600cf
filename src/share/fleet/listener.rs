//! The Zenoh session of a [`Table`]: what its callbacks hear is told to the table at once, under a lock, so nothing waits anywhere.

use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use zenoh::pubsub::Subscriber;
use zenoh::sample::{Sample, SampleKind};
use zenoh::{Session, Wait};

use super::listing::Listing;
use super::table::Table;
use super::{path, report};
use crate::share::bridge::attachment::{Attachment, BYTES, GID_BYTES};
use crate::share::bridge::names::{bridges, bridges_own, key, key_of_all};
use crate::share::bridge::session;
use crate::share::bridge::topic::Topic;
use crate::share::bridge::{BridgeError, reason};

/// Where bridges tell it, whatever the robot.
const TOPIC: &str = "/diagnostics";

/// See module. What is held only to be there is behind `_`.
pub struct Listener {
    table: Arc<Mutex<Table>>,
    endpoints: String,
    _heard: Vec<Subscriber<()>>,
    session: Session,
}

impl Listener {
    /// Opens the session, which need not find anybody yet. `file`: Zenoh's own configuration. `poses`: listen to them, too; they come with every picture.
    pub fn open(domain: u32, file: Option<&Path>, poses: bool) -> Result<Self, BridgeError> {
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
        let diagnostics = session.declare_subscriber(key.clone()).callback(move |sample| {
            take(&sample, report::MOST_BYTES, |id, message| lock(&told).diagnostics(id, message, Instant::now()));
        });
        let mut heard = vec![tokens, diagnostics.wait().map_err(failed(&key))?];
        if poses {
            let (pattern, seen) = (bridges_own(domain, Topic::Pose.word()), table.clone());
            let tokens = session.liveliness().declare_subscriber(pattern.clone()).history(true);
            let tokens = tokens.callback(move |sample| {
                let token = sample.key_expr().as_str();
                match sample.kind() {
                    SampleKind::Put => lock(&seen).pose_token_up(token),
                    SampleKind::Delete => lock(&seen).pose_token_down(token),
                }
            });
            heard.push(tokens.wait().map_err(failed(&pattern))?);
            let (key, told) = (key_of_all(domain, Topic::Pose.word(), Topic::Pose.of()), table.clone());
            let subscriber = session.declare_subscriber(key.clone()).callback(move |sample| {
                take(&sample, path::MOST_BYTES, |id, message| lock(&told).pose(id, message, Instant::now()));
            });
            heard.push(subscriber.wait().map_err(failed(&key))?);
        }
        Ok(Self { table, endpoints, _heard: heard, session })
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
fn take(sample: &Sample, most_bytes: usize, told: impl FnOnce(&[u8; GID_BYTES], &[u8])) {
    let attachment = sample.attachment().filter(|attachment| attachment.len() == BYTES);
    let attachment = attachment.and_then(|attachment| Attachment::from_bytes(&attachment.to_bytes()));
    let is_fit = sample.kind() == SampleKind::Put && sample.payload().len() <= most_bytes;
    if let Some(attachment) = attachment.filter(|_| is_fit) {
        told(&attachment.gid, &sample.payload().to_bytes());
    }
}

fn lock(table: &Mutex<Table>) -> MutexGuard<'_, Table> {
    // A row is whole at any time.
    table.lock().unwrap_or_else(PoisonError::into_inner)
}
