//! Which daemon is meant: the prefix of its services, and where iceoryx2 keeps its files.

use std::fmt;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use iceoryx2::prelude::{Config, FileName, MessagingPattern, SemanticString, ServiceName, ipc_threadsafe};
use iceoryx2::service::Service;
use iceoryx2::service::service_hash::ServiceHash;

/// Prefix of the services unless chosen otherwise (`--prefix`, `CAIRN_PREFIX`, configuration).
pub const DEFAULT_PREFIX: &str = "cairn";
/// Characters of a prefix at most.
pub const MAX_PREFIX_LEN: usize = 64;
/// Bytes of iceoryx2's root folder at most: event sockets live there, and the path of a Unix socket has 107 bytes.
const MAX_ROOT_LEN: usize = 48;
/// End of the name of iceoryx2's common counter in /dev/shm; before it are the prefix, a digest and the version.
const COUNTER_SUFFIX: &str = ".global_mgmt";
/// A counter that is still empty after this time will not be filled.
const COUNTER_AGE: std::time::Duration = std::time::Duration::from_secs(1);

/// Name of a service: `service_name("cairn", "pose")` is `cairn/pose`.
pub fn service_name(prefix: &str, topic: &str) -> Result<String, EndpointError> {
    check_prefix(prefix)?;
    Ok(format!("{prefix}/{topic}"))
}

fn check_prefix(prefix: &str) -> Result<(), EndpointError> {
    let bad = |reason| Err(EndpointError::Prefix { prefix: prefix.into(), reason });
    if prefix.is_empty() {
        return bad("it is empty");
    }
    if prefix.chars().count() > MAX_PREFIX_LEN {
        return bad("it has more than 64 characters");
    }
    if !prefix.chars().all(|c| c.is_ascii_alphanumeric() || "_-./".contains(c)) {
        return bad("only ASCII letters, digits and _ - . / may be in it");
    }
    if prefix.split('/').any(str::is_empty) {
        return bad("there must be something on both sides of every /");
    }
    Ok(())
}

/// The services of one daemon.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Endpoint {
    prefix: String,
    root: Option<PathBuf>,
    ipc_prefix: Option<String>,
    config: Config,
}

impl Default for Endpoint {
    fn default() -> Self {
        Self { prefix: DEFAULT_PREFIX.into(), root: None, ipc_prefix: None, config: Config::default() }
    }
}

impl Endpoint {
    /// Services `prefix/...`, iceoryx2's files where they are by default (`/tmp/iceoryx2` and `/dev/shm/iox2_*`).
    ///
    /// iceoryx2's own configuration files are not read: `./config/iceoryx2.toml` would depend on where a process was
    /// started, and all participants must agree.
    pub fn new(prefix: &str) -> Result<Self, EndpointError> {
        check_prefix(prefix)?;
        Ok(Self { prefix: prefix.into(), ..Self::default() })
    }

    /// Another folder for iceoryx2's service, node and socket files. Every participant must use the same.
    pub fn with_root(mut self, root: &Path) -> Result<Self, EndpointError> {
        let bad = |reason: &str| EndpointError::Root { root: root.into(), reason: reason.into() };
        let text = root.to_str().ok_or_else(|| bad("it is not UTF-8"))?;
        if !root.is_absolute() {
            return Err(bad("it is not absolute"));
        }
        if text.len() > MAX_ROOT_LEN {
            return Err(bad("it has more than 48 bytes, and Unix sockets are made in it"));
        }
        let path = iceoryx2::prelude::Path::new(text.as_bytes()).map_err(|e| bad(&format!("{e:?}")))?;
        self.config.global.set_root_path(&path);
        self.root = Some(root.into());
        Ok(self)
    }

    /// Another prefix for iceoryx2's files and shared-memory objects (default `iox2_`). Every participant must use the
    /// same.
    pub fn with_ipc_prefix(mut self, prefix: &str) -> Result<Self, EndpointError> {
        let bad = |reason: &str| EndpointError::IpcPrefix { prefix: prefix.into(), reason: reason.into() };
        if prefix.is_empty() || prefix.len() > 32 {
            return Err(bad("it must have 1 to 32 characters"));
        }
        if !prefix.chars().all(|c| c.is_ascii_alphanumeric() || "_-".contains(c)) {
            return Err(bad("only ASCII letters, digits and _ - may be in it"));
        }
        self.config.global.prefix = FileName::new(prefix.as_bytes()).map_err(|e| bad(&format!("{e:?}")))?;
        self.ipc_prefix = Some(prefix.into());
        Ok(self)
    }

    /// As [`Self::with_root`] and [`Self::with_ipc_prefix`] with CAIRN_IPC_ROOT and CAIRN_IPC_PREFIX of the environment,
    /// where they are set and not empty.
    pub fn with_environment(self) -> Result<Self, EndpointError> {
        let set = |name| std::env::var_os(name).filter(|value| !value.is_empty());
        let endpoint = match set("CAIRN_IPC_ROOT") {
            Some(root) => self.with_root(Path::new(&root))?,
            None => self,
        };
        match set("CAIRN_IPC_PREFIX") {
            Some(prefix) => endpoint.with_ipc_prefix(&prefix.to_string_lossy()),
            None => Ok(endpoint),
        }
    }

    /// First part of every service's name.
    pub fn prefix(&self) -> &str {
        &self.prefix
    }

    /// Folder of iceoryx2's service, node and socket files.
    pub fn root(&self) -> PathBuf {
        PathBuf::from(self.config.global.root_path().to_string())
    }

    /// What iceoryx2 is to be configured with.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Name of the service `topic` as iceoryx2 wants it.
    pub fn service(&self, topic: &str) -> Result<ServiceName, EndpointError> {
        let name = service_name(&self.prefix, topic)?;
        ServiceName::new(&name)
            .map_err(|_| EndpointError::Prefix { prefix: self.prefix.clone(), reason: "iceoryx2 refuses it" })
    }

    /// Where the description of a service lies, if it exists.
    pub(crate) fn description_path(&self, service: &ServiceName, pattern: MessagingPattern) -> PathBuf {
        let hash = ServiceHash::new::<<ipc_threadsafe::Service as Service>::ServiceNameHasher>(service, pattern);
        let global = &self.config.global;
        let file = format!("{}{hash}{}", global.prefix, global.service.static_config_storage_suffix);
        self.root().join(global.service.directory.to_string()).join(file)
    }

    /// Looks whether a publish/subscribe service exists and whose it is, without leaving anything behind: a process of
    /// another user that created so much as a folder would lock the rightful one out.
    pub fn probe(&self, service: &ServiceName) -> Presence {
        let path = self.description_path(service, MessagingPattern::PublishSubscribe);
        let us = effective_uid();
        match std::fs::metadata(&path) {
            Ok(meta) if us.is_some_and(|us| us != meta.uid()) => Presence::OtherOwner { path, owner: meta.uid() },
            Ok(_) => Presence::Ours,
            Err(e) if e.kind() == std::io::ErrorKind::PermissionDenied => {
                // The folder is closed to us; the nearest parent that can be looked at says whose it is.
                let parents = path.ancestors().skip(1).filter_map(|p| Some((p, std::fs::metadata(p).ok()?.uid())));
                match parents.into_iter().next() {
                    Some((p, owner)) => Presence::OtherOwner { path: p.into(), owner },
                    None => Presence::Absent,
                }
            }
            Err(_) => Presence::Absent,
        }
    }
}

/// Something in the place of iceoryx2's common counter with which no node can be made, and so no daemon and no planner be started.
///
/// The counter is the one file in shared memory whose name can be known beforehand: every process of this iceoryx2 version uses it,
/// whoever made it first owns it, all may write it, and it is never removed. All other names have a random part.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Squatter {
    pub path: PathBuf,
    pub owner: u32,
    /// What is wrong with it.
    pub fault: &'static str,
}

impl fmt::Display for Squatter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (path, owner) = (self.path.display(), user_name(self.owner));
        write!(
            f,
            "{path} belongs to user {owner} and {}, so nothing can use iceoryx2: end what uses iceoryx2, `sudo rm -r {path}`, start again \
             (or give daemon and planners another CAIRN_IPC_PREFIX)",
            self.fault
        )
    }
}

impl Endpoint {
    /// What lies in the place of iceoryx2's common counter and cannot work. `failed`: a node could not be made, so that whatever lies
    /// there is to blame even if it looks right.
    pub fn squatter(&self, failed: bool) -> Option<Squatter> {
        self.squatter_in(Path::new("/dev/shm"), failed, effective_uid()?)
    }

    fn squatter_in(&self, folder: &Path, failed: bool, us: u32) -> Option<Squatter> {
        let prefix = self.config.global.prefix.to_string();
        for entry in std::fs::read_dir(folder).ok()?.flatten() {
            let name = entry.file_name();
            let counter = name.to_str().is_some_and(|n| n.starts_with(&prefix) && n.ends_with(COUNTER_SUFFIX));
            // Of the entry itself: a link is not followed.
            let Some(meta) = counter.then(|| entry.metadata().ok()).flatten() else { continue };
            let open_to_us = us == 0 || meta.uid() == us || meta.mode() & 0o006 == 0o006;
            // It is filled within a moment of being made.
            let old = meta.modified().is_ok_and(|t| t.elapsed().is_ok_and(|age| age >= COUNTER_AGE));
            let fault = match () {
                () if !meta.is_file() => "is no file",
                () if !open_to_us => "may not be written by others",
                () if meta.len() == 0 && old => "is empty",
                () if failed => "does not hold what it should",
                () => continue,
            };
            return Some(Squatter { path: entry.path(), owner: meta.uid(), fault });
        }
        None
    }
}

/// Outcome of [`Endpoint::probe`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Presence {
    /// No such service.
    Absent,
    /// The service exists and belongs to this process's user.
    Ours,
    /// The service, or the folder that it would be in, belongs to another user.
    OtherOwner { path: PathBuf, owner: u32 },
}

/// User id that this process acts as; `None` where /proc is not mounted.
pub fn effective_uid() -> Option<u32> {
    // The kernel gives /proc/self the effective user of the process.
    std::fs::metadata("/proc/self").ok().map(|m| m.uid())
}

/// `name (id)` of a user, or the id alone.
pub(crate) fn user_name(uid: u32) -> String {
    let passwd = std::fs::read_to_string("/etc/passwd").unwrap_or_default();
    let name = passwd.lines().find_map(|line| {
        let mut fields = line.split(':');
        let name = fields.next()?;
        (fields.nth(1)?.parse() == Ok(uid)).then_some(name)
    });
    match name {
        Some(name) => format!("{name} ({uid})"),
        None => uid.to_string(),
    }
}

/// A name that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum EndpointError {
    Prefix { prefix: String, reason: &'static str },
    Root { root: PathBuf, reason: String },
    IpcPrefix { prefix: String, reason: String },
}

impl fmt::Display for EndpointError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Prefix { prefix, reason } => write!(f, "prefix {prefix:?} cannot be used: {reason}"),
            Self::Root { root, reason } => write!(f, "iceoryx2 root {root:?} cannot be used: {reason}"),
            Self::IpcPrefix { prefix, reason } => write!(f, "iceoryx2 prefix {prefix:?} cannot be used: {reason}"),
        }
    }
}
impl std::error::Error for EndpointError {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn services_are_named_after_the_prefix() {
        assert_eq!(service_name("cairn", "pose").unwrap(), "cairn/pose");
        assert_eq!(
            Endpoint::new("robot-1/front_camera").unwrap().service("map").unwrap().as_str(),
            "robot-1/front_camera/map"
        );
    }

    #[test]
    fn prefixes_that_would_end_in_trouble_are_refused_with_the_reason() {
        for (prefix, reason) in [
            ("", "empty"),
            ("a b", "ASCII"),
            ("höhle", "ASCII"),
            ("/a", "both sides"),
            ("a//b", "both sides"),
            ("a/", "both sides"),
        ] {
            let message = Endpoint::new(prefix).expect_err(prefix).to_string();
            assert!(message.contains(reason), "{message}");
        }
        assert!(Endpoint::new(&"x".repeat(MAX_PREFIX_LEN)).is_ok());
        assert!(Endpoint::new(&"x".repeat(MAX_PREFIX_LEN + 1)).is_err());
    }

    #[test]
    fn roots_that_sockets_do_not_fit_into_are_refused() {
        let endpoint = Endpoint::new("cairn").unwrap();
        assert!(endpoint.clone().with_root(Path::new("relative")).is_err());
        assert!(endpoint.clone().with_root(Path::new(&format!("/{}", "x".repeat(60)))).is_err());
        let there = endpoint.with_root(Path::new("/run/cairn")).unwrap();
        assert_eq!(there.root(), Path::new("/run/cairn"));
    }

    #[test]
    fn what_squats_in_the_counters_place_is_told_from_a_counter_that_another_user_made() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let endpoint = Endpoint::new("cairn").unwrap();
        let path = folder.path().join("iox2_0123_node.0_10_0.global_mgmt");
        let owner = std::fs::metadata(folder.path()).unwrap().uid();
        let other = owner + 1;
        let fault = |failed, us| endpoint.squatter_in(folder.path(), failed, us).map(|s| s.fault);
        let mode = |mode| std::fs::set_permissions(&path, PermissionsExt::from_mode(mode)).unwrap();
        assert_eq!(fault(true, other), None, "nothing there");
        std::fs::write(folder.path().join("elsewhere.global_mgmt"), "").unwrap();
        std::fs::write(&path, [0; 16]).unwrap();
        mode(0o666);
        assert_eq!(fault(false, other), None, "made by another user as iceoryx2 makes it");
        assert_eq!(fault(true, other), Some("does not hold what it should"));
        mode(0o644);
        assert_eq!(fault(false, owner), None);
        assert_eq!(fault(false, other), Some("may not be written by others"));
        assert_eq!(fault(false, 0), None, "root may write everything");
        mode(0o666);
        let file = std::fs::File::create(&path).unwrap();
        assert_eq!(fault(false, other), None, "just being made");
        file.set_modified(std::time::SystemTime::now() - COUNTER_AGE * 2).unwrap();
        assert_eq!(fault(false, other), Some("is empty"));
        std::fs::remove_file(&path).unwrap();
        std::os::unix::fs::symlink("/etc/passwd", &path).unwrap();
        let squatter = endpoint.squatter_in(folder.path(), false, owner).expect("a link");
        let text = squatter.to_string();
        for part in [path.to_str().unwrap(), "is no file", "belongs to user", "sudo rm"] {
            assert!(text.contains(part), "{part}: {text}");
        }
    }

    #[test]
    fn looking_for_a_service_creates_nothing() {
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        let root = folder.path().join("r");
        let endpoint = Endpoint::new("cairn").unwrap().with_root(&root).unwrap();
        assert_eq!(endpoint.probe(&endpoint.service("pose").unwrap()), Presence::Absent);
        assert!(!root.exists());
    }
}
