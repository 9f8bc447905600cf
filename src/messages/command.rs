//! Commands to a running daemon and its replies.

use iceoryx2::prelude::ZeroCopySend;

/// Bytes of a path or message at most.
pub const TEXT_LEN: usize = 512;

/// Values of [`Command::kind`].
pub mod command_kind {
    /// Drop the map and start over.
    pub const RESET: u32 = 1;
    /// Write the trajectory so far to `path` (TUM format).
    pub const SAVE_TRAJECTORY: u32 = 2;
    /// Write the sparse map to `path` (PLY).
    pub const SAVE_MAP: u32 = 3;
    /// Go on in the stored map of this name (`path`), and find the robot in it. What was tracked in is in its file before.
    pub const LOAD_MAP: u32 = 4;
    /// The body is at `position`, `orientation` of the map now.
    pub const SET_POSE: u32 = 5;
    /// Store the map now: in its own file, or, with a name in `path`, a copy of it under that name.
    pub const STORE_MAP: u32 = 6;
    /// Begin a new map, to be kept under the name in `path`. What was tracked in is in its file before.
    pub const NEW_MAP: u32 = 7;
    /// Only be located in the map (`path` is `on`), or let it grow again (`off`).
    pub const LOCALISE: u32 = 8;
    /// Name the stored maps: a line each of the message, `NAME BYTES SECONDS` (since 1970, when it was written), ` current` behind the one
    /// in use. A last line `...`: there are more, behind the last name; ask again with that in `path`.
    pub const LIST_MAPS: u32 = 9;
    /// Write a copy of the map for the sender; the message is its path, then a line with that of the map's own file, if it has one. The
    /// sender removes the copy; the daemon does after some minutes.
    pub const COPY_MAP: u32 = 10;
    /// Name the camera's controls: a line each of the message, `NAME UNIT LOWEST HIGHEST STEP DEFAULT VALUE WHO`. Names: `exposure` (unit `ms`), `gain`
    /// and `focus` (unit `steps`, of the camera's own). WHO: `auto` (the camera decides), `manual`, `manual-only` (it has no automatic).
    pub const CAMERA_CONTROLS: u32 = 11;
    /// Set a control of the camera to a value in its unit, or have the camera decide: `path` is its name, a space, and a number or `auto`. It holds
    /// until the camera is opened anew.
    pub const SET_CAMERA: u32 = 12;
    /// Name the camera: the message is its identity, as calibrations are found by, a space, and its device file.
    pub const CAMERA_IDENTITY: u32 = 13;
    /// Keep the calibration in the file `path` for the camera, which has it from the next map on that a command begins. The message says where it
    /// lies.
    pub const KEEP_CALIBRATION: u32 = 14;
    /// Keep what is in the stored map of this name (`path`) beside the present one, and make it a part of that once a place of both is known. The
    /// present map's frame and number stay; the stored one stays as it is.
    pub const MERGE_MAP: u32 = 15;
}

/// Values of [`CommandReply::code`].
pub mod reply_code {
    /// Done.
    pub const OK: u32 = 0;
    /// The daemon does not know this kind of command (it is older), or cannot do it.
    pub const UNSUPPORTED: u32 = 1;
    /// The command makes no sense as it is: path missing or not UTF-8, pose not finite.
    pub const INVALID: u32 = 2;
    /// It was tried and failed; the message says why.
    pub const FAILED: u32 = 3;
    /// Not now: another one of its kind is under way.
    pub const BUSY: u32 = 4;
}

/// A request to the daemon.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("cairn.Command.v1")]
pub struct Command {
    /// Of [`command_kind`].
    pub kind: u32,
    /// Bytes of `path` that are used.
    pub path_len: u32,
    /// UTF-8; the daemon opens it as its own user, so it should be absolute. Of stored maps it is a name, never a path.
    pub path: [u8; TEXT_LEN],
    /// For [`command_kind::SET_POSE`]: the body in the map, map units.
    pub position: [f64; 3],
    /// For [`command_kind::SET_POSE`]: `map_from_body`, quaternion (x, y, z, w).
    pub orientation: [f64; 4],
}

layout!(Command, "cairn.Command.v1", 576, { kind @ 0, path_len @ 4, path @ 8, position @ 520, orientation @ 544 });

impl Default for Command {
    fn default() -> Self {
        Self { kind: 0, path_len: 0, path: [0; TEXT_LEN], position: [f64::NAN; 3], orientation: [f64::NAN; 4] }
    }
}

impl Command {
    /// A command without a path.
    pub fn new(kind: u32) -> Self {
        Self { kind, ..Self::default() }
    }

    /// A command with a path; `None` if that has more than [`TEXT_LEN`] bytes.
    pub fn with_path(kind: u32, path: &str) -> Option<Self> {
        let mut command = Self::new(kind);
        command.path.get_mut(..path.len())?.copy_from_slice(path.as_bytes());
        command.path_len = u32::try_from(path.len()).ok()?;
        Some(command)
    }

    /// The path; `None` if its length or its bytes are not valid (they come from another process).
    pub fn path(&self) -> Option<&str> {
        text(&self.path, self.path_len)
    }
}

/// What became of a [`Command`].
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("cairn.CommandReply.v1")]
pub struct CommandReply {
    /// Of [`reply_code`].
    pub code: u32,
    /// Bytes of `message` that are used.
    pub message_len: u32,
    /// For a person, UTF-8.
    pub message: [u8; TEXT_LEN],
}

layout!(CommandReply, "cairn.CommandReply.v1", 520, { code @ 0, message_len @ 4, message @ 8 });

impl Default for CommandReply {
    fn default() -> Self {
        Self { code: reply_code::OK, message_len: 0, message: [0; TEXT_LEN] }
    }
}

impl CommandReply {
    /// A reply; a message that is too long is cut off.
    pub fn new(code: u32, message: &str) -> Self {
        let cut = cut(message, TEXT_LEN);
        Self { code, message_len: cut.len() as u32, message: padded(cut) }
    }

    /// The message; empty if its length or its bytes are not valid.
    pub fn message(&self) -> &str {
        text(&self.message, self.message_len).unwrap_or_default()
    }

    /// The command was carried out.
    pub fn is_ok(&self) -> bool {
        self.code == reply_code::OK
    }
}

fn text(bytes: &[u8; TEXT_LEN], len: u32) -> Option<&str> {
    core::str::from_utf8(bytes.get(..usize::try_from(len).ok()?)?).ok()
}

/// As much of `text` as fits into `len` bytes, whole characters.
fn cut(text: &str, len: usize) -> &str {
    let end = (0..=len.min(text.len())).rev().find(|&i| text.is_char_boundary(i)).unwrap_or(0);
    text.get(..end).unwrap_or_default()
}

/// As much of `text` as fits, zero-padded.
pub(super) fn padded<const N: usize>(text: &str) -> [u8; N] {
    let mut bytes = [0; N];
    let cut = cut(text, N);
    for (to, from) in bytes.iter_mut().zip(cut.as_bytes()) {
        *to = *from;
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_survives_and_one_that_is_too_long_is_refused() {
        let path = "/var/lib/cairn/höhle.ply";
        assert_eq!(Command::with_path(command_kind::SAVE_MAP, path).unwrap().path(), Some(path));
        assert!(Command::with_path(command_kind::SAVE_MAP, &"x".repeat(TEXT_LEN)).is_some());
        assert!(Command::with_path(command_kind::SAVE_MAP, &"x".repeat(TEXT_LEN + 1)).is_none());
    }

    #[test]
    fn lengths_and_bytes_of_another_process_are_not_trusted() {
        let mut command = Command::with_path(command_kind::SAVE_MAP, "a").unwrap();
        command.path_len = u32::MAX;
        assert_eq!(command.path(), None);
        command.path_len = 1;
        command.path[0] = 0xff;
        assert_eq!(command.path(), None);
        let mut reply = CommandReply::new(reply_code::FAILED, "no space");
        assert_eq!(reply.message(), "no space");
        reply.message_len = 9999;
        assert_eq!(reply.message(), "");
    }

    #[test]
    fn a_message_that_is_too_long_is_cut_at_a_character() {
        let reply = CommandReply::new(reply_code::FAILED, &format!("x{}", "é".repeat(TEXT_LEN)));
        assert_eq!(reply.message().len(), TEXT_LEN - 1);
    }
}
