//! `PREFIX/command`: the daemon's ear.

use std::fmt;

use iceoryx2::active_request::ActiveRequest;
use iceoryx2::port::server::Server;
use iceoryx2::prelude::{BackpressureStrategy, MessagingPattern, Node};
use iceoryx2::service::port_factory::server::ServerCreateError;

use super::PublishError;
use super::opening::Ipc;
use super::opening::open_patiently;
use crate::messages::services::{MAX_COMMANDERS, MAX_NODES, topic};
use crate::messages::{Command, CommandReply, Endpoint, reply_code};

/// Receives commands; may live in any thread.
#[derive(Debug)]
pub struct CommandServer {
    server: Server<Ipc, Command, (), CommandReply, ()>,
    name: String,
}

impl CommandServer {
    pub(super) fn open(node: &Node<Ipc>, endpoint: &Endpoint) -> Result<Self, PublishError> {
        let name = endpoint.service(topic::COMMAND)?;
        let failed = |doing, reason: String| PublishError::Ipc { service: name.to_string(), doing, reason };
        let service = open_patiently(endpoint, &name, MessagingPattern::RequestResponse, || {
            node.service_builder(&name)
                .request_response::<Command, CommandReply>()
                .max_servers(1)
                .max_clients(MAX_COMMANDERS)
                .max_nodes(MAX_NODES)
                .max_active_requests_per_client(1)
                .max_loaned_requests(1)
                .max_response_buffer_size(1)
                .max_borrowed_responses_per_pending_response(1)
                // A request whose sender cannot be answered is not carried out.
                .enable_fire_and_forget_requests(false)
                .open_or_create()
        })?;
        let server = service
            .server_builder()
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .max_loaned_responses_per_request(1)
            .create()
            .map_err(|e| match e {
                ServerCreateError::ExceedsMaxSupportedServers => {
                    PublishError::AlreadyRunning { prefix: endpoint.prefix().into(), pid: None }
                }
                e => failed("making its server", e.to_string()),
            })?;
        Ok(Self { server, name: name.to_string() })
    }

    /// The next command, without waiting. It may be answered later and from another thread; dropped, it is answered with
    /// nothing and its sender told that nothing will come.
    pub fn receive(&mut self) -> Result<Option<Request>, PublishError> {
        let request = self.server.receive().map_err(|e| PublishError::Ipc {
            service: self.name.clone(),
            doing: "receiving a command",
            reason: e.to_string(),
        })?;
        Ok(request.map(Request))
    }
}

/// A command that waits for its reply.
pub struct Request(ActiveRequest<Ipc, Command, (), CommandReply, ()>);

impl fmt::Debug for Request {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Request").field("kind", &self.command().kind).finish_non_exhaustive()
    }
}

impl Request {
    /// What is asked for; it comes from another process and may be nonsense.
    pub fn command(&self) -> &Command {
        self.0.payload()
    }

    /// Answers; `false` if the sender has gone.
    pub fn reply(self, reply: CommandReply) -> bool {
        self.0.loan_uninit().is_ok_and(|r| r.write_payload(reply).send().is_ok())
    }

    /// Answers that the daemon cannot do that.
    pub fn refuse(self) -> bool {
        let kind = self.command().kind;
        self.reply(CommandReply::new(reply_code::UNSUPPORTED, &format!("this daemon does not do command {kind}")))
    }
}
