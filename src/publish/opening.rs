//! Opening or creating services where others have been before: daemons of another version, of another user, and such as
//! were killed in the middle of it.

use std::fmt::Display;
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use iceoryx2::node::NodeView;
use iceoryx2::prelude::{MessagingPattern, NodeState, ServiceName, ipc_threadsafe};
use iceoryx2::service::Service as _;
use iceoryx2::service::builder::event::{EventCreateError, EventOpenError, EventOpenOrCreateError};
use iceoryx2::service::builder::publish_subscribe::{
    PublishSubscribeCreateError, PublishSubscribeOpenError, PublishSubscribeOpenOrCreateError,
};
use iceoryx2::service::builder::request_response::{
    RequestResponseCreateError, RequestResponseOpenError, RequestResponseOpenOrCreateError,
};

use super::PublishError;
use crate::messages::{Endpoint, effective_uid};

/// Ports of this flavour may move between threads; it meets every other flavour on the wire.
pub(super) type Ipc = ipc_threadsafe::Service;

/// How long a service of another shape, or one that is just being made or cleared away, is waited for. Clients let go of
/// theirs half a second after its daemon has gone.
pub(super) const PATIENCE: Duration = Duration::from_secs(3);
/// Pause between two tries.
const PAUSE: Duration = Duration::from_millis(50);
/// A service is made within milliseconds. One that is still half made after this time has lost its maker.
const WRECK_AGE: Duration = Duration::from_secs(1);

/// A node is made and cleared away within milliseconds.
const SWEEP_AGE: Duration = Duration::from_secs(60);

/// What to think of a failure to open or create a service.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verdict {
    /// Somebody is just making it or clearing it away.
    Passing,
    /// It is half made or half removed.
    Broken,
    /// It has another type or other queues.
    OtherShape,
    /// This user may not.
    Forbidden,
}

/// Errors of iceoryx2's builders.
pub(super) trait Judged: Display {
    fn verdict(&self) -> Verdict;
}

/// Of a builder's error: `broken`, what a half made service is called when it is created.
macro_rules! judged {
    ($error:ident, $open:ident, $create:ident, broken: $($broken:ident)|+) => {
        impl Judged for $error {
            fn verdict(&self) -> Verdict {
                match self {
                    Self::$open(e) => match e {
                        $open::HangsInCreation | $open::ServiceInCorruptedState => Verdict::Broken,
                        $open::InsufficientPermissions => Verdict::Forbidden,
                        $open::DoesNotExist
                        | $open::Interrupt
                        | $open::InternalFailure
                        | $open::IsMarkedForDestruction
                        | $open::ExceedsMaxNumberOfNodes
                        | $open::UnableToCreateServiceTag => Verdict::Passing,
                        _ => Verdict::OtherShape,
                    },
                    Self::$create(e) => match e {
                        $($create::$broken)|+ => Verdict::Broken,
                        $create::InsufficientPermissions => Verdict::Forbidden,
                        _ => Verdict::Passing,
                    },
                    Self::SystemInFlux => Verdict::Passing,
                }
            }
        }
    };
}

judged!(
    PublishSubscribeOpenOrCreateError, PublishSubscribeOpenError, PublishSubscribeCreateError,
    broken: HangsInCreation | ServiceInCorruptedState
);
judged!(EventOpenOrCreateError, EventOpenError, EventCreateError, broken: ServiceInCorruptedState);
judged!(
    RequestResponseOpenOrCreateError, RequestResponseOpenError, RequestResponseCreateError,
    broken: HangsInCreation | ServiceInCorruptedState
);

/// Waits until nothing half made in shared memory would hold who opens or clears away something: as a rule not at all, else a moment, or
/// until what a killed process left is old enough to be removed.
pub(super) fn clear_unfilled(endpoint: &Endpoint, patience: Duration) -> Result<(), PublishError> {
    let start = Instant::now();
    while let Some(path) = endpoint.clear_unfilled() {
        if start.elapsed() >= patience {
            let reason = format!("{} is empty, as if its maker had been killed", path.display());
            return Err(PublishError::Ipc {
                service: endpoint.prefix().into(),
                doing: "opening shared memory",
                reason,
            });
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    Ok(())
}

/// Opens or creates a service, again and again for a bounded time while that may help.
///
/// A daemon that was killed while it made a service leaves a description that is never finished, and iceoryx2 0.10 then
/// refuses that name to everybody for ever. Such a wreck is removed here.
pub(super) fn open_patiently<S, E: Judged>(
    endpoint: &Endpoint,
    name: &ServiceName,
    pattern: MessagingPattern,
    open_or_create: impl Fn() -> Result<S, E>,
) -> Result<S, PublishError> {
    let start = Instant::now();
    loop {
        clear_unfilled(endpoint, PATIENCE)?;
        let error = match open_or_create() {
            Ok(service) => return Ok(service),
            Err(e) => e,
        };
        if error.verdict() == Verdict::Broken {
            remove_wreck(endpoint, name, pattern);
        }
        if start.elapsed() < PATIENCE && error.verdict() != Verdict::Forbidden {
            std::thread::sleep(PAUSE);
            continue;
        }
        let (service, reason) = (name.to_string(), error.to_string());
        return Err(match (error.verdict(), foreign_folder(endpoint)) {
            (Verdict::Forbidden, Some((path, owner))) => PublishError::OtherOwner { path, owner },
            (Verdict::OtherShape, _) => {
                PublishError::Incompatible { reason, pids: holders(endpoint, name, pattern), service }
            }
            _ => PublishError::Ipc { service, doing: "making it", reason },
        });
    }
}

/// Removes the description of a service that nobody alive holds and that is too old to be in the making. What cannot be
/// removed stays the error that it was.
fn remove_wreck(endpoint: &Endpoint, name: &ServiceName, pattern: MessagingPattern) {
    let path = endpoint.description_path(name, pattern);
    let modified = std::fs::metadata(&path).and_then(|m| m.modified());
    let old = modified.is_ok_and(|t| t.elapsed().is_ok_and(|age| age >= WRECK_AGE));
    if old && holders(endpoint, name, pattern).is_empty() {
        let _ = std::fs::remove_file(path);
    }
}

/// Living processes that hold a service open.
fn holders(endpoint: &Endpoint, name: &ServiceName, pattern: MessagingPattern) -> Vec<u32> {
    let details = Ipc::details(name, endpoint.config(), pattern);
    let nodes = details.ok().flatten().and_then(|d| d.dynamic_details).map(|d| d.nodes).unwrap_or_default();
    nodes
        .iter()
        .filter_map(|node| match node {
            NodeState::Alive(node) => node.details().as_ref().and_then(|d| u32::try_from(d.process_id().value()).ok()),
            _ => None,
        })
        .collect()
}

/// One of iceoryx2's folders that belongs to another user.
pub(super) fn foreign_folder(endpoint: &Endpoint) -> Option<(PathBuf, u32)> {
    let us = effective_uid()?;
    let (root, global) = (endpoint.root(), &endpoint.config().global);
    let folders = [root.join(global.node.directory.to_string()), root.join(global.service.directory.to_string()), root];
    folders.into_iter().find_map(|folder| {
        let owner = std::fs::metadata(&folder).ok()?.uid();
        (owner != us).then_some((folder, owner))
    })
}

/// Removes nodes that iceoryx2 has cleared away by half: a process that is killed while it writes one of its tag files
/// leaves a file that iceoryx2 0.10 does not see and a folder that it therefore cannot remove, and every later clearing away
/// stumbles over it again. Such a folder lacks the node's details, which are the first to come and the last but one to go.
pub(super) fn sweep(endpoint: &Endpoint) {
    let global = &endpoint.config().global;
    let nodes = endpoint.root().join(global.node.directory.to_string());
    for entry in std::fs::read_dir(&nodes).into_iter().flatten().flatten() {
        let Some(id) = entry.file_name().to_str().map(String::from) else { continue };
        let old = |m: std::fs::Metadata| {
            m.is_dir() && m.modified().is_ok_and(|t| t.elapsed().is_ok_and(|age| age >= SWEEP_AGE))
        };
        if !id.bytes().all(|b| b.is_ascii_digit()) || !entry.metadata().is_ok_and(old) {
            continue;
        }
        let details = global.node.static_config_suffix.to_string();
        let mut files = std::fs::read_dir(entry.path()).into_iter().flatten().flatten();
        if files.any(|file| file.file_name().to_string_lossy().ends_with(&details)) {
            continue;
        }
        // What cannot be removed is tried again.
        let _ = std::fs::remove_dir_all(entry.path());
        let monitor = format!("{}{id}{}", global.prefix, global.node.monitor_suffix);
        for suffix in ["", "_context", "_owner_lock"] {
            let _ = std::fs::remove_file(nodes.join(format!("{monitor}{suffix}")));
        }
    }
}

/// Free bytes of /dev/shm must exceed what may be written there.
pub(super) fn check_room(needed: u64) -> Result<(), PublishError> {
    let Some(free) = free_shared_memory() else { return Ok(()) };
    if free >= needed {
        return Ok(());
    }
    Err(PublishError::NoRoom { free_mb: free >> 20, needed_mb: (needed >> 20) + 1 })
}

/// Free bytes of /dev/shm; `None` where there is none.
fn free_shared_memory() -> Option<u64> {
    let stat = rustix::fs::statvfs("/dev/shm").ok()?;
    Some(stat.f_bavail.saturating_mul(stat.f_frsize))
}

#[cfg(test)]
mod tests {
    use std::fs::{File, Permissions};
    use std::os::unix::fs::PermissionsExt;
    use std::path::Path;
    use std::time::SystemTime;

    use super::*;
    use crate::messages::services::topic;
    use crate::publish::{Limits, Publisher};

    /// Removes what iceoryx2 keeps in /dev/shm for good.
    struct Place(#[expect(dead_code, reason = "removes its folder when dropped")] tempfile::TempDir, String);

    impl Drop for Place {
        fn drop(&mut self) {
            for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
                if entry.file_name().to_string_lossy().starts_with(&self.1) {
                    let _ = std::fs::remove_file(entry.path());
                }
            }
        }
    }

    /// An endpoint of its own, and the place that goes with it.
    fn endpoint() -> (Place, Endpoint) {
        let folder = tempfile::Builder::new().prefix("co").tempdir_in("/tmp").expect("folder");
        let name = folder.path().file_name().expect("name").to_string_lossy().replace('.', "");
        let endpoint = Endpoint::new("robot").and_then(|e| e.with_root(folder.path()));
        let endpoint = endpoint.and_then(|e| e.with_ipc_prefix(&format!("{name}_"))).expect("endpoint");
        (Place(folder, name), endpoint)
    }

    fn write(path: &Path, age: Duration) -> File {
        std::fs::create_dir_all(path.parent().expect("folder")).expect("folder");
        let file = File::create(path).expect("file");
        file.set_modified(SystemTime::now() - age).expect("age");
        file
    }

    #[test]
    fn services_whose_maker_was_killed_are_made_anew() {
        let (_place, endpoint) = endpoint();
        let wrecks = [
            (topic::POSE, MessagingPattern::Event),
            (topic::POSE, MessagingPattern::PublishSubscribe),
            (topic::COMMAND, MessagingPattern::RequestResponse),
        ];
        for (topic, pattern) in wrecks {
            let path = endpoint.description_path(&endpoint.service(topic).expect("name"), pattern);
            let file = write(&path, WRECK_AGE * 2);
            // As iceoryx2 creates it, before it is complete.
            file.set_permissions(Permissions::from_mode(0o600)).expect("mode");
        }
        let limits = Limits { landmarks: 1, keyframes: 1, frame_bytes: 1 };
        Publisher::open(&endpoint, &limits).expect("healed");
    }

    #[test]
    fn nodes_cleared_away_by_half_are_swept_and_no_others() {
        let (_place, endpoint) = endpoint();
        let nodes = endpoint.root().join("nodes");
        let prefix = &endpoint.config().global.prefix;
        let node = |id: &str, details: bool, age: Duration| {
            let folder = nodes.join(id);
            write(&folder.join(format!("{prefix}5.port_tag")), age);
            if details {
                write(&folder.join(format!("{prefix}node.details")), age);
            }
            for suffix in ["", "_context", "_owner_lock"] {
                write(&nodes.join(format!("{prefix}{id}.node_monitor{suffix}")), age);
            }
            File::open(&folder).and_then(|f| f.set_modified(SystemTime::now() - age)).expect("age");
        };
        node("11", false, SWEEP_AGE * 2);
        node("22", true, SWEEP_AGE * 2);
        node("33", false, Duration::ZERO);
        sweep(&endpoint);
        let mut left: Vec<_> = std::fs::read_dir(&nodes)
            .expect("nodes")
            .flatten()
            .map(|e| e.file_name().to_string_lossy().replace(&prefix.to_string(), ""))
            .collect();
        left.sort();
        let monitor = |id: &str| ["", "_context", "_owner_lock"].map(|s| format!("{id}.node_monitor{s}"));
        let mut want: Vec<String> =
            ["22".into(), "33".into()].into_iter().chain(monitor("22")).chain(monitor("33")).collect();
        want.sort();
        assert_eq!(left, want);
    }

    #[test]
    fn too_little_shared_memory_is_refused_before_it_kills() {
        let error = check_room(u64::MAX).expect_err("nobody has that much").to_string();
        assert!(error.contains("/dev/shm") && error.contains("MB"), "{error}");
        assert!(check_room(1).is_ok());
    }
}
