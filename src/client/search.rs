//! Looks for one service of a daemon that may not be there yet, or is just coming or going.

use std::sync::Arc;
use std::time::{Duration, Instant};

use iceoryx2::prelude::{MessagingPattern, Node, ServiceName};
use iceoryx2::service::Service as _;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError;

use super::link::{Ipc, Link};
use super::{ClientError, LOOK_EVERY};
use crate::messages::services::MAX_NODES;

/// Something half made or half removed that stays so for this long is an error.
const PATIENCE: Duration = Duration::from_secs(10);

/// A service that is there, and the node to open it with.
type Found = (Arc<Node<Ipc>>, ServiceName);

/// See module.
#[derive(Debug)]
pub(super) struct Search {
    pub link: Arc<Link>,
    topic: &'static str,
    /// When the service was looked for last, while it is not open.
    looked: Option<Instant>,
    /// Since when there are failures that should pass.
    trouble: Option<Instant>,
}

impl Search {
    pub fn new(link: Arc<Link>, topic: &'static str) -> Self {
        Self { link, topic, looked: None, trouble: None }
    }

    /// It is time to look, which the caller does now.
    pub fn is_due(&mut self) -> bool {
        let is_due = self.looked.is_none_or(|looked| looked.elapsed() >= LOOK_EVERY);
        if is_due {
            self.rest();
        }
        is_due
    }

    /// The next look is a pause from now.
    pub fn rest(&mut self) {
        self.looked = Some(Instant::now());
    }

    pub fn name(&self) -> Result<ServiceName, ClientError> {
        Ok(self.link.endpoint().service(self.topic)?)
    }

    /// What the service can be opened with, if it is there and nothing is in the way.
    pub fn look(&mut self) -> Result<Option<Found>, ClientError> {
        if !self.link.probe(self.topic)? {
            self.trouble = None;
            return Ok(None);
        }
        let name = self.name()?;
        if let Err(reason) = self.link.clear_unfilled() {
            return self.troubled("opening it", reason).map(|()| None);
        }
        Ok(Some((self.link.node()?, name)))
    }

    /// A service of `ours`, a versioned type, was not opened.
    pub fn open_failed(&mut self, failure: PublishSubscribeOpenError, ours: &str) -> Result<(), ClientError> {
        use PublishSubscribeOpenError as E;
        let name = self.name()?;
        let service = name.to_string();
        match failure {
            // It went away between looking and opening.
            E::DoesNotExist | E::IsMarkedForDestruction | E::Interrupt => Ok(()),
            E::VersionMismatch => Err(ClientError::IpcVersionMismatch { service }),
            E::IncompatibleTypes => {
                let theirs = self.type_on_the_wire(&name);
                Err(ClientError::VersionMismatch { service, ours: ours.into(), theirs })
            }
            E::ExceedsMaxNumberOfNodes => Err(ClientError::TooManySubscribers { service, limit: MAX_NODES }),
            e => self.troubled("opening it", e.to_string()),
        }
    }

    /// Type name of the service as it exists.
    fn type_on_the_wire(&self, name: &ServiceName) -> String {
        match Ipc::details(name, self.link.endpoint().config(), MessagingPattern::PublishSubscribe) {
            Ok(Some(details)) => {
                let types = details.static_details.publish_subscribe().message_type_details();
                format!("{} of {} bytes", types.payload.type_name(), types.payload.size())
            }
            _ => "another type".into(),
        }
    }

    /// A failure that should pass, because somebody is just making or clearing away things; an error when it does not.
    pub fn troubled(&mut self, doing: &'static str, reason: String) -> Result<(), ClientError> {
        if self.trouble.get_or_insert_with(Instant::now).elapsed() < PATIENCE {
            return Ok(());
        }
        self.trouble = None;
        Err(ClientError::Ipc { service: self.name()?.to_string(), doing, reason })
    }

    pub fn is_troubled(&self) -> bool {
        self.trouble.is_some()
    }

    /// It works: what failed before has passed.
    pub fn works(&mut self) {
        self.trouble = None;
    }
}
