//! Commands to the daemon: sent, carried out between two frames, answered.

use std::time::{Duration, Instant};

use iceoryx2::prelude::PortFactory as _;
use iceoryx2::service::builder::request_response::RequestResponseOpenError;
use iceoryx2::service::port_factory::client::ClientCreateError;

use super::{Client, ClientError};
use crate::messages::services::{MAX_COMMANDERS, topic};
use crate::messages::{Command, CommandReply, TEXT_LEN, Transform, command_kind};

/// How often the answer is looked for: a command is rare, an event service of its own would cost more than it saves.
const LOOK_FOR_REPLY: Duration = Duration::from_millis(2);

impl Client {
    /// Drops the map and starts over.
    pub fn reset(&self, timeout: Duration) -> Result<CommandReply, ClientError> {
        self.command(Command::new(command_kind::RESET), timeout)
    }

    /// Writes the trajectory so far (TUM format). The daemon opens `path` as its own user: make it absolute.
    pub fn save_trajectory(&self, path: &str, timeout: Duration) -> Result<CommandReply, ClientError> {
        self.command(with_path(command_kind::SAVE_TRAJECTORY, path)?, timeout)
    }

    /// Writes the sparse map (PLY). The daemon opens `path` as its own user: make it absolute.
    pub fn save_map(&self, path: &str, timeout: Duration) -> Result<CommandReply, ClientError> {
        self.command(with_path(command_kind::SAVE_MAP, path)?, timeout)
    }

    /// Loads a map and has the robot find itself in it. Whether a daemon can is in its reply
    /// ([`crate::messages::reply_code::UNSUPPORTED`]).
    pub fn load_map(&self, path: &str, timeout: Duration) -> Result<CommandReply, ClientError> {
        self.command(with_path(command_kind::LOAD_MAP, path)?, timeout)
    }

    /// Says where the robot is now: from then on poses, map and keyframes are published in a map that is moved so that this
    /// holds, and the reset counter has grown by one. The place is lost with the map (a reset, a daemon's restart). Lengths
    /// are in map units; one camera's scale is not set by it.
    pub fn set_pose(&self, map_from_body: &Transform, timeout: Duration) -> Result<CommandReply, ClientError> {
        let Transform { position, orientation } = *map_from_body;
        self.command(Command { position, orientation, ..Command::new(command_kind::SET_POSE) }, timeout)
    }

    /// Sends any command and waits for its reply. The reply may be a refusal: look at its code.
    pub fn command(&self, command: Command, timeout: Duration) -> Result<CommandReply, ClientError> {
        let start = Instant::now();
        let endpoint = self.link.endpoint();
        let no_daemon = || ClientError::NoDaemon { prefix: endpoint.prefix().into() };
        // The pose service stands for the daemon: ownership is checked there.
        if !self.link.probe(topic::POSE)? {
            return Err(no_daemon());
        }
        let name = endpoint.service(topic::COMMAND)?;
        let fail = |doing, reason: String| ClientError::Ipc { service: name.to_string(), doing, reason };
        while let Err(reason) = self.link.clear_unfilled() {
            if start.elapsed() >= timeout {
                return Err(fail("opening it", reason));
            }
            std::thread::sleep(LOOK_FOR_REPLY);
        }
        let node = self.link.node()?;
        // After a kill the old daemon's remains would look like a daemon.
        node.try_cleanup_dead_nodes();
        let service = match node.service_builder(&name).request_response::<Command, CommandReply>().open() {
            Ok(service) => service,
            Err(RequestResponseOpenError::DoesNotExist | RequestResponseOpenError::IsMarkedForDestruction) => {
                return Err(no_daemon());
            }
            Err(RequestResponseOpenError::IncompatibleRequestOrResponseType) => {
                return Err(ClientError::VersionMismatch {
                    service: name.to_string(),
                    ours: format!("{} and {}", Command::TYPE_NAME, CommandReply::TYPE_NAME),
                    theirs: "other types".into(),
                });
            }
            Err(RequestResponseOpenError::VersionMismatch) => {
                return Err(ClientError::IpcVersionMismatch { service: name.to_string() });
            }
            Err(e) => return Err(fail("opening it", e.to_string())),
        };
        if service.dynamic_config().number_of_servers() == 0 {
            return Err(no_daemon());
        }
        let client = service.client_builder().create().map_err(|e| match e {
            ClientCreateError::ExceedsMaxSupportedClients => {
                ClientError::TooManySubscribers { service: name.to_string(), limit: MAX_COMMANDERS }
            }
            e => fail("connecting", e.to_string()),
        })?;
        let pending = client.send_copy(command).map_err(|e| fail("sending the command", e.to_string()))?;
        loop {
            if let Some(reply) = pending.receive().map_err(|e| fail("receiving the reply", e.to_string()))? {
                return Ok(*reply.payload());
            }
            if !pending.is_connected() || start.elapsed() >= timeout {
                // Once more: the reply may have come between the two looks.
                if let Ok(Some(reply)) = pending.receive() {
                    return Ok(*reply.payload());
                }
                return Err(ClientError::NoReply { prefix: endpoint.prefix().into(), waited: start.elapsed() });
            }
            std::thread::sleep(LOOK_FOR_REPLY);
        }
    }
}

fn with_path(kind: u32, path: &str) -> Result<Command, ClientError> {
    Command::with_path(kind, path).ok_or(ClientError::PathTooLong { bytes: path.len(), limit: TEXT_LEN })
}
