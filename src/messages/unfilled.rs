//! Shared memory that was made and never filled.
//!
//! iceoryx2 0.10 makes an object in /dev/shm empty and unreadable, gives it its size, fills it, and last lets others read it. A process that is
//! killed in between leaves it so for good. Who opens it later fails after a time-out; who may read every file (root) and finds it still
//! empty waits without end, because that one state has no time-out (iceoryx2-cal 0.10, `dynamic_storage/posix_shared_memory.rs`,
//! `MappingSizeIsZero`). So such objects are looked for before anything is opened, here on both sides of the wire.

use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::Endpoint;
use super::endpoint::effective_uid;

/// An object is filled within a millisecond or so. One that is not after this time has lost its maker, unless that is seen to live.
const LINGERS: Duration = Duration::from_secs(1);
/// For root, whom it would hold all that time.
const LINGERS_FOR_ROOT: Duration = Duration::from_millis(100);

const OWNER_READS: u32 = 0o400;
const OTHERS_READ_AND_WRITE: u32 = 0o006;

impl Endpoint {
    /// Removes unfilled objects whose makers are gone (this user's; root: everybody's), and returns one with which opening anything now
    /// could wait without end: as a rule one that is just being made.
    pub(crate) fn clear_unfilled(&self) -> Option<PathBuf> {
        self.clear_unfilled_in(Path::new("/dev/shm"), effective_uid()?)
    }

    fn clear_unfilled_in(&self, folder: &Path, us: u32) -> Option<PathBuf> {
        let prefix = self.config().global.prefix.to_string();
        let age = if us == 0 { LINGERS_FOR_ROOT } else { LINGERS };
        let (mut orphans, mut others) = (Vec::new(), Vec::new());
        for entry in std::fs::read_dir(folder).ok()?.flatten() {
            let ours = entry.file_name().to_str().is_some_and(|name| name.starts_with(&prefix));
            // Of the entry itself: a link is not followed.
            let Some(meta) = ours.then(|| entry.metadata().ok()).flatten() else { continue };
            if !meta.is_file() || (meta.len() > 0 && meta.mode() & OWNER_READS != 0) {
                continue;
            }
            let lingers = meta.modified().is_ok_and(|t| t.elapsed().is_ok_and(|lasted| lasted >= age));
            let mine = us == 0 || meta.uid() == us;
            // What may not be read is refused in bounded time.
            let readable = us == 0
                || if mine {
                    meta.mode() & OWNER_READS != 0
                } else {
                    meta.mode() & OTHERS_READ_AND_WRITE == OTHERS_READ_AND_WRITE
                };
            let found = Unfilled { path: entry.path(), inode: meta.ino(), holds_us: meta.len() == 0 && readable };
            (if lingers && mine { &mut orphans } else { &mut others }).push(found);
        }
        if !orphans.is_empty() {
            let open = open_inodes(us);
            orphans
                .retain(|o| open.contains(&o.inode) || !o.is_still_there() || std::fs::remove_file(&o.path).is_err());
        }
        orphans.into_iter().chain(others).find(|unfilled| unfilled.holds_us).map(|unfilled| unfilled.path)
    }
}

struct Unfilled {
    path: PathBuf,
    inode: u64,
    /// Opening it could wait without end.
    holds_us: bool,
}

impl Unfilled {
    /// The name may have been taken anew meanwhile.
    fn is_still_there(&self) -> bool {
        std::fs::symlink_metadata(&self.path).is_ok_and(|meta| meta.ino() == self.inode)
    }
}

/// Inodes of the files that living processes have open (root: all processes, else `user`'s). Not all of them let themselves be looked into: a
/// service has a user namespace of its own. So this saves what is seen, and time tells of the rest.
fn open_inodes(user: u32) -> Vec<u64> {
    let processes = std::fs::read_dir("/proc").into_iter().flatten().flatten().map(|entry| entry.path());
    let ours = processes.filter(|process| user == 0 || std::fs::metadata(process).is_ok_and(|meta| meta.uid() == user));
    let descriptors = ours.flat_map(|process| std::fs::read_dir(process.join("fd")).into_iter().flatten().flatten());
    descriptors.filter_map(|fd| std::fs::metadata(fd.path()).ok().map(|meta| meta.ino())).collect()
}

#[cfg(test)]
mod tests {
    use std::fs::{File, Permissions};
    use std::os::unix::fs::PermissionsExt;
    use std::time::SystemTime;

    use super::*;

    #[test]
    fn what_lost_its_maker_is_removed_and_what_is_being_made_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let endpoint = Endpoint::new("cairn").unwrap().with_ipc_prefix("cu_").unwrap();
        let us = std::fs::metadata(folder.path()).unwrap().uid();
        let make = |name: &str, bytes: u64, mode: u32, age: Duration| {
            let file = File::create(folder.path().join(name)).unwrap();
            file.set_len(bytes).unwrap();
            file.set_permissions(Permissions::from_mode(mode)).unwrap();
            file.set_modified(SystemTime::now() - age).unwrap();
        };
        let there = |name: &str| folder.path().join(name).exists();
        let old = LINGERS * 2;
        make("cu_filled", 8, 0o600, old);
        make("elsewhere_empty", 0, 0o200, old);
        make("cu_empty", 0, 0o200, old);
        make("cu_unreadable", 8, 0o200, old);
        assert_eq!(endpoint.clear_unfilled_in(folder.path(), us), None);
        assert!(there("cu_filled") && there("elsewhere_empty"), "not ours to judge");
        assert!(!there("cu_empty") && !there("cu_unreadable"));

        make("cu_slow", 8, 0o200, old);
        let maker = File::options().write(true).open(folder.path().join("cu_slow")).unwrap();
        assert_eq!(endpoint.clear_unfilled_in(folder.path(), us), None);
        assert!(there("cu_slow"), "its maker lives");
        drop(maker);
        assert_eq!(endpoint.clear_unfilled_in(folder.path(), us), None);
        assert!(!there("cu_slow"));

        make("cu_sized", 8, 0o200, Duration::ZERO);
        assert_eq!(endpoint.clear_unfilled_in(folder.path(), us), None, "opening it has a time-out");
        make("cu_young", 0, 0o200, Duration::ZERO);
        let young = folder.path().join("cu_young");
        let named = endpoint.clear_unfilled_in(folder.path(), us);
        assert_eq!(named, (us == 0).then(|| young.clone()), "who may not read it is refused in time");
        let mode = |mode| std::fs::set_permissions(&young, Permissions::from_mode(mode)).unwrap();
        mode(0o600);
        assert_eq!(endpoint.clear_unfilled_in(folder.path(), us), Some(young.clone()));
        File::options().write(true).open(&young).unwrap().set_modified(SystemTime::now() - old).unwrap();
        assert_eq!(endpoint.clear_unfilled_in(folder.path(), us + 1), None, "another user's that we may not open");
        mode(0o666);
        assert_eq!(
            endpoint.clear_unfilled_in(folder.path(), us + 1),
            Some(young.clone()),
            "another user's is left alone"
        );
        assert!(there("cu_young"));
        assert!(there("cu_sized"));
    }
}
