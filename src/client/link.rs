//! What the subscriptions of one [`super::Client`] share: the endpoint, and an iceoryx2 node while any of them is connected.

use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use iceoryx2::prelude::{Node, NodeBuilder, NodeName, SignalHandlingMode, ipc_threadsafe};

use super::ClientError;
use crate::messages::{Endpoint, Presence, effective_uid};

/// Ports of this flavour may move between threads; it meets every other flavour on the wire.
pub(super) type Ipc = ipc_threadsafe::Service;

/// Longest wait for a service that is half made: the next try comes soon, and reading must not block.
const CONNECTING: Duration = Duration::from_millis(50);

/// See module.
#[derive(Debug)]
pub(super) struct Link {
    endpoint: Endpoint,
    node: Mutex<Weak<Node<Ipc>>>,
    root: bool,
}

impl Link {
    pub fn new(endpoint: Endpoint) -> Self {
        Self { endpoint, node: Mutex::new(Weak::new()), root: effective_uid() == Some(0) }
    }

    pub fn endpoint(&self) -> &Endpoint {
        &self.endpoint
    }

    /// Whether the service exists; creates nothing.
    pub fn probe(&self, topic: &str) -> Result<bool, ClientError> {
        match self.endpoint.probe(&self.endpoint.service(topic)?) {
            Presence::Absent => Ok(false),
            Presence::Ours => Ok(true),
            Presence::OtherOwner { path, owner } => Err(ClientError::OtherOwner { path, owner }),
        }
    }

    /// Clears away what a process killed in the middle of making it left unfilled; the error names what is in the way for now, be it
    /// that it is just being made. To be called before anything is opened or cleared away: that could wait without end.
    pub fn clear_unfilled(&self) -> Result<(), String> {
        let in_the_way = self.endpoint.clear_unfilled();
        in_the_way.map_or(Ok(()), |path| Err(format!("{} is empty, as if its maker had been killed", path.display())))
    }

    /// Whether receiving, too, should come after [`Self::clear_unfilled`]: what iceoryx2 leaves unfilled holds root only, and looking costs
    /// more than receiving.
    pub fn receiving_may_hang(&self) -> bool {
        self.root
    }

    /// The node, made anew when nobody holds it. Call it only once a daemon's service was seen: a node creates folders.
    pub fn node(&self) -> Result<Arc<Node<Ipc>>, ClientError> {
        let mut shared = self.node.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(node) = shared.upgrade() {
            return Ok(node);
        }
        let fail = |reason: String| ClientError::Ipc {
            service: self.endpoint.root().display().to_string(),
            doing: "creating an iceoryx2 node",
            reason,
        };
        let mut config = self.endpoint.config().clone();
        config.global.creation_timeout = CONNECTING;
        let name = NodeName::new("cairn-client").map_err(|e| fail(e.to_string()))?;
        let node = NodeBuilder::new()
            .name(&name)
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Ipc>()
            .map_err(|e| fail(self.endpoint.squatter(true).map_or_else(|| e.to_string(), |s| s.to_string())))?;
        let node = Arc::new(node);
        *shared = Arc::downgrade(&node);
        Ok(node)
    }
}
