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

/// Answers that a list of maps is made of at the most; a daemon keeps a hundred maps.
const MOST_LISTED: usize = 100;

/// A map that the daemon can load.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StoredMap {
    pub name: String,
    pub bytes: u64,
    /// When it was written, s since 1970.
    pub written_s: u64,
    /// The daemon goes on in it.
    pub is_current: bool,
}

/// Part of the stored maps.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MapList {
    pub maps: Vec<StoredMap>,
    pub has_more: bool,
}

impl MapList {
    /// An answer to [`command_kind::LIST_MAPS`]; lines that are none are left out.
    pub fn parse(message: &str) -> Self {
        let map = |line: &str| {
            let mut words = line.split(' ');
            let (name, bytes, written_s) =
                (words.next()?.to_owned(), words.next()?.parse().ok()?, words.next()?.parse().ok()?);
            Some(StoredMap { name, bytes, written_s, is_current: words.next() == Some("current") })
        };
        Self { maps: message.lines().filter_map(map).collect(), has_more: message.lines().last() == Some("...") }
    }
}

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

    /// Goes on in the stored map of this name, LOST until a place of it is recognised; the map before is stored first. Maps are named,
    /// never by path: the daemon keeps them in one folder, `NAME.map` each.
    pub fn load_map(&self, name: &str, timeout: Duration) -> Result<CommandReply, ClientError> {
        self.command(with_path(command_kind::LOAD_MAP, name)?, timeout)
    }

    /// Stores the map now: `None` in its own file, else a copy under a name that no map has yet. Answered once it is on the disk.
    pub fn store_map(&self, name: Option<&str>, timeout: Duration) -> Result<CommandReply, ClientError> {
        self.command(with_path(command_kind::STORE_MAP, name.unwrap_or_default())?, timeout)
    }

    /// Begins a new map, which is kept under this name; the map before is stored first.
    pub fn new_map(&self, name: &str, timeout: Duration) -> Result<CommandReply, ClientError> {
        self.command(with_path(command_kind::NEW_MAP, name)?, timeout)
    }

    /// Makes what is in the stored map of this name a part of the present one as soon as a place of both is known; the answer comes before that. The
    /// present map's frame and number stay.
    pub fn merge_map(&self, name: &str, timeout: Duration) -> Result<CommandReply, ClientError> {
        self.command(with_path(command_kind::MERGE_MAP, name)?, timeout)
    }

    /// Whether frames are only located in the map, which stays as it is.
    pub fn localise_only(&self, on: bool, timeout: Duration) -> Result<CommandReply, ClientError> {
        self.command(with_path(command_kind::LOCALISE, if on { "on" } else { "off" })?, timeout)
    }

    /// The stored maps behind the name `after` (empty: from the first on), by name, and whether there are more behind those. The error in the
    /// inner result is a refusal.
    pub fn list_maps(&self, after: &str, timeout: Duration) -> Result<Result<MapList, CommandReply>, ClientError> {
        let reply = self.command(with_path(command_kind::LIST_MAPS, after)?, timeout)?;
        Ok(if reply.is_ok() { Ok(MapList::parse(reply.message())) } else { Err(reply) })
    }

    /// All of them, at most `MOST_LISTED` answers.
    pub fn all_maps(&self, timeout: Duration) -> Result<Result<Vec<StoredMap>, CommandReply>, ClientError> {
        let mut maps: Vec<StoredMap> = Vec::new();
        for _ in 0..MOST_LISTED {
            let after = maps.last().map(|map| map.name.clone()).unwrap_or_default();
            match self.list_maps(&after, timeout)? {
                Ok(list) => {
                    maps.extend(list.maps);
                    if !list.has_more {
                        break;
                    }
                }
                Err(reply) => return Ok(Err(reply)),
            }
        }
        Ok(Ok(maps))
    }

    /// Has a copy of the map written for this process, which removes it when it has read it. The message of an answer that is OK is the
    /// copy's path, then, in a line of its own, that of the map's own file.
    pub fn copy_map(&self, timeout: Duration) -> Result<CommandReply, ClientError> {
        self.command(Command::new(command_kind::COPY_MAP), timeout)
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
        self.link.clear_after_daemon(&node);
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

pub(super) fn with_path(kind: u32, path: &str) -> Result<Command, ClientError> {
    Command::with_path(kind, path).ok_or(ClientError::PathTooLong { bytes: path.len(), limit: TEXT_LEN })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_of_maps_is_read_line_by_line() {
        let list = MapList::parse("attic 12 34\nkitchen 56 78 current\nsenseless\n...");
        let names: Vec<_> = list.maps.iter().map(|m| (m.name.as_str(), m.bytes, m.written_s, m.is_current)).collect();
        assert_eq!(names, [("attic", 12, 34, false), ("kitchen", 56, 78, true)]);
        assert!(list.has_more && !MapList::parse("attic 12 34\n").has_more);
        assert_eq!(MapList::parse(""), MapList::default());
    }
}
