//! What the subscriptions of one [`super::Client`] share: the endpoint, and an iceoryx2 node while any of them is connected.

use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use iceoryx2::node::{NodeState, NodeView};
use iceoryx2::prelude::{CallbackProgression, Node, NodeBuilder, NodeName, SignalHandlingMode, ipc_threadsafe};

use super::ClientError;
use crate::messages::{DAEMON_NODE, Endpoint, Presence, effective_uid};

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

    /// Clears away after a daemon that was killed. While it lives it clears away after others itself, and two at it lose places: see
    /// [`Self::node`].
    pub fn clear_after_daemon(&self, node: &Node<Ipc>) {
        let mut died = false;
        let listed = Node::<Ipc>::list(self.endpoint.config(), |state| {
            let dead = matches!(&state, NodeState::<Ipc>::Dead(view) if view.details().as_ref().is_some_and(|d| d.name().as_str() == DAEMON_NODE));
            died |= dead;
            if dead { CallbackProgression::Stop } else { CallbackProgression::Continue }
        });
        if listed.is_err() || died {
            node.try_cleanup_dead_nodes();
        }
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
        // A living daemon clears away after killed planners. iceoryx2 gives a dead port up for good when its removal fails once, as it does
        // when a second process is at it or was killed over it: planners that clear away whenever they come or go would lose places.
        config.global.node.cleanup_dead_nodes_on_creation = false;
        config.global.node.cleanup_dead_nodes_on_destruction = false;
        config.global.service.cleanup_dead_nodes_on_open = false;
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
