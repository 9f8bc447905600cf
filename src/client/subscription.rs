//! One subscription: finds the daemon, reads, sleeps, and finds the next daemon.

use std::sync::Arc;
use std::time::{Duration, Instant};

use iceoryx2::port::ReceiveError;
use iceoryx2::port::listener::{Listener, ListenerCreateError, ListenerWaitError};
use iceoryx2::prelude::{Node, PortFactory as _, ServiceName};
use iceoryx2::service::builder::event::EventOpenError;

use super::link::{Ipc, Link};
use super::search::Search;
use super::topics::{
    EncodedTopic, FeaturesTopic, FrameTopic, GraphTopic, HealthTopic, KeyframesTopic, MapTopic, ObstaclesTopic,
    OpenFailure, PoseTopic, TagsTopic, Topic, WheelTopic,
};
use super::{ClientError, LOOK_EVERY};

/// Silence after which it is checked whether the daemon has died.
const SILENCE: Duration = Duration::from_secs(1);
/// A daemon that comes after this silence may be a new one. Poses and health come at shorter intervals.
const NEWCOMER: Duration = Duration::from_millis(120);
/// A daemon that is restarted within this time finds the services as they were.
const GRACE: Duration = Duration::from_millis(500);
/// Longest sleep while connected.
const NAP: Duration = Duration::from_millis(500);

/// Messages of one service in the order in which they were sent.
///
/// Read with [`Self::wait`] or as an iterator to get every message (the queue holds the newest ones if you are slow), with
/// [`Self::latest`] to get the state of the world now. An error stays one: waiting longer does not cure it.
#[derive(Debug)]
pub struct Subscription<T: Topic> {
    search: Search,
    open: Option<Open<T>>,
    latest: Option<T::Item>,
    /// A first message was waited for since it was opened.
    waited: bool,
    /// The iterator has given its error.
    ended: bool,
    /// Looks every so often instead of being woken.
    polls: Option<Duration>,
}

/// Subscription to poses; its items are copies (448 bytes).
pub type Poses = Subscription<PoseTopic>;
/// Subscription to health; its items are copies.
pub type Healths = Subscription<HealthTopic>;
/// Subscription to the map.
pub type Map = Subscription<MapTopic>;
/// Subscription to keyframes.
pub type Keyframes = Subscription<KeyframesTopic>;
/// Subscription to grey pictures.
pub type Frames = Subscription<FrameTopic>;
/// Subscription to what holds the map together.
pub type Graphs = Subscription<GraphTopic>;
/// Subscription to what is found in the pictures.
pub type FeatureLists = Subscription<FeaturesTopic>;
/// Subscription to what stands around the robot.
pub type ObstacleScans = Subscription<ObstaclesTopic>;
/// Subscription to the tags of the map; its items are copies.
pub type TagLists = Subscription<TagsTopic>;
/// Subscription to what the base's driver tells; its items are copies.
pub type WheelReports = Subscription<WheelTopic>;
/// Subscription to the camera's own bytes.
pub type Encodeds = Subscription<EncodedTopic>;

/// Ports of a connected subscription, dropped in this order.
struct Open<T: Topic> {
    port: T::Port,
    /// `None`: it polls.
    listener: Option<Listener<Ipc>>,
    node: Arc<Node<Ipc>>,
    /// Of the last message or sign that the daemon lives.
    heard: Instant,
    /// Since when there is no publisher.
    alone: Option<Instant>,
}

impl<T: Topic> std::fmt::Debug for Open<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Open").field("heard", &self.heard).field("alone", &self.alone).finish_non_exhaustive()
    }
}

impl<T: Topic> Subscription<T> {
    pub(super) fn new(link: Arc<Link>) -> Self {
        let search = Search::new(link, T::NAME);
        Self { search, open: None, latest: None, waited: false, ended: false, polls: None }
    }

    /// For a reader that need not have a message at once: no message wakes it, [`Self::wait`] looks every `pause` instead. That spares the
    /// daemon the waking, 30 us a message, more than a message costs it otherwise. Ask for it before anything is read.
    pub fn polled(mut self, pause: Duration) -> Self {
        self.polls = Some(pause);
        self
    }

    /// A daemon is there (it may still be silent: see the age of its messages).
    pub fn is_connected(&self) -> bool {
        self.open.as_ref().is_some_and(|open| T::publishers(&open.port) > 0)
    }

    /// The oldest message not read yet, without waiting. Also looks after the connection, so call this, [`Self::latest`]
    /// or [`Self::wait`] from time to time.
    pub fn try_next(&mut self) -> Result<Option<T::Item>, ClientError> {
        if self.open.is_none() {
            if !self.search.is_due() {
                return Ok(None);
            }
            self.connect()?;
        }
        let Some(open) = &mut self.open else { return Ok(None) };
        // Receiving also connects to a daemon that is new.
        if self.search.link.receiving_may_hang()
            && open.heard.elapsed() >= NEWCOMER
            && let Err(reason) = self.search.link.clear_unfilled()
        {
            self.search.troubled("receiving", reason)?;
            return Ok(None);
        }
        match T::receive(&open.port) {
            Ok(Some(item)) => {
                (open.heard, open.alone) = (Instant::now(), None);
                self.search.works();
                Ok(Some(item))
            }
            Ok(None) => {
                self.search.works();
                self.tend();
                Ok(None)
            }
            Err(ReceiveError::ExceedsMaxBorrows) => {
                let limit = T::max_held(&open.port);
                Err(ClientError::TooManyHeld { service: self.search.name()?.to_string(), limit })
            }
            Err(ReceiveError::ConnectionFailure(e)) => {
                // The publisher may have died while we connected. Start over, and give up only if that goes on.
                self.close();
                self.search.troubled("connecting to the publisher", e.to_string())?;
                Ok(None)
            }
        }
    }

    /// The newest message there is, without waiting; the same one again while no newer has come, also after the daemon has
    /// gone (look at its age). Of a slice, one of the messages that may be held is held here.
    pub fn latest(&mut self) -> Result<Option<&T::Item>, ClientError> {
        while let Some(item) = self.try_next()? {
            self.latest = Some(item);
        }
        Ok(self.latest.as_ref())
    }

    /// As [`Self::latest`], but if this subscription has had no message at all and a daemon is there, it waits up to `timeout`
    /// for the first, once: a late joiner's last pose, map or health comes within a tenth of a second, and a daemon without a camera says nothing
    /// for hours.
    pub fn latest_within(&mut self, timeout: Duration) -> Result<Option<&T::Item>, ClientError> {
        if self.latest()?.is_none() && self.is_connected() && !self.waited {
            let begin = Instant::now();
            self.latest = self.wait(timeout)?;
            // A signal ends it early.
            self.waited = begin.elapsed() >= timeout;
        }
        self.latest()
    }

    /// The oldest message not read yet, waiting for it if need be; `None` after `timeout`, or earlier when a signal
    /// arrives. Sleeps; a message wakes it.
    pub fn wait(&mut self, timeout: Duration) -> Result<Option<T::Item>, ClientError> {
        let start = Instant::now();
        loop {
            if let Some(item) = self.try_next()? {
                return Ok(Some(item));
            }
            let left = match timeout.checked_sub(start.elapsed()) {
                Some(left) if !left.is_zero() => left,
                _ => return Ok(None),
            };
            let Some(open) = &self.open else {
                std::thread::sleep(left.min(LOOK_EVERY));
                continue;
            };
            // Shorter naps without a publisher: its going is noticed after GRACE, its coming is an event.
            let nap = if open.alone.is_some() || self.search.is_troubled() { LOOK_EVERY } else { NAP };
            let Some(listener) = &open.listener else {
                std::thread::sleep(left.min(self.polls.unwrap_or(nap)));
                continue;
            };
            match listener.timed_wait(|_| (), left.min(nap)) {
                Ok(_) => {}
                Err(ListenerWaitError::InterruptSignal) => return Ok(None),
                Err(e) => {
                    self.close();
                    self.search.troubled("waiting", format!("{e:?}"))?;
                }
            }
        }
    }

    /// Nothing was there to read: is the daemon still alive?
    fn tend(&mut self) {
        let Some(open) = &mut self.open else { return };
        if T::publishers(&open.port) > 0 {
            open.alone = None;
            if open.heard.elapsed() < SILENCE {
                return;
            }
            // Silent: if it was killed, somebody has to clear its remains away, and that may be us.
            open.heard = Instant::now();
            if self.search.link.clear_unfilled().is_err() {
                return;
            }
            self.search.link.clear_after_daemon(&open.node);
            if T::publishers(&open.port) > 0 {
                return;
            }
        }
        // Nobody publishes. Let go of the services soon, so that a daemon of another version or user can make its own.
        let since = *open.alone.get_or_insert_with(Instant::now);
        if since.elapsed() >= GRACE {
            self.close();
        }
    }

    fn close(&mut self) {
        if T::BORROWS {
            self.latest = None;
        }
        self.open = None;
        self.search.rest();
    }

    /// Opens the service if it is there.
    fn connect(&mut self) -> Result<(), ClientError> {
        let Some((node, name)) = self.search.look()? else { return Ok(()) };
        let port = match T::open(&node, &name) {
            Ok(port) => port,
            Err(OpenFailure::Service(failure)) => return self.search.open_failed(failure, T::TYPE),
            Err(OpenFailure::Full { limit }) => {
                return Err(ClientError::TooManySubscribers { service: name.to_string(), limit });
            }
            Err(OpenFailure::Port(failure)) => return self.search.troubled("subscribing", failure.to_string()),
        };
        let listener = match self.polls {
            None => match self.listener(&node, &name)? {
                Some(listener) => Some(listener),
                None => return Ok(()),
            },
            Some(_) => None,
        };
        self.open = Some(Open { port, listener, node, heard: Instant::now(), alone: None });
        self.waited = false;
        Ok(())
    }

    /// What wakes this reader; `None`: it could not be made now, and is tried again.
    fn listener(&mut self, node: &Node<Ipc>, name: &ServiceName) -> Result<Option<Listener<Ipc>>, ClientError> {
        match node.service_builder(name).event().open() {
            Ok(service) => match service.listener_builder().create() {
                Ok(listener) => Ok(Some(listener)),
                Err(ListenerCreateError::ExceedsMaxSupportedListeners) => Err(ClientError::TooManySubscribers {
                    service: name.to_string(),
                    limit: service.static_config().max_listeners(),
                }),
                Err(e) => self.search.troubled("listening for its events", e.to_string()).map(|()| None),
            },
            Err(EventOpenError::VersionMismatch) => Err(ClientError::IpcVersionMismatch { service: name.to_string() }),
            Err(e) => self.search.troubled("opening its events", e.to_string()).map(|()| None),
        }
    }
}

/// Never ends by itself: sleeps until the next message. After an error it ends.
impl<T: Topic> Iterator for Subscription<T> {
    type Item = Result<T::Item, ClientError>;

    fn next(&mut self) -> Option<Self::Item> {
        while !self.ended {
            match self.wait(Duration::from_secs(60)) {
                Ok(Some(item)) => return Some(Ok(item)),
                Ok(None) => {}
                Err(e) => {
                    self.ended = true;
                    return Some(Err(e));
                }
            }
        }
        None
    }
}
