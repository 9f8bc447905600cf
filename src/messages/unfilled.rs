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

/// An object is filled within a millisecond or so. Whether the maker of one that takes longer still lives is looked up.
const MOMENT: Duration = Duration::from_millis(100);

const MAY_READ: u32 = 0o400;

impl Endpoint {
    /// Removes this user's unfilled objects whose makers are gone, and returns one with which opening anything now could wait without
    /// end: it is either just being made, or another user's.
    pub(crate) fn clear_unfilled(&self) -> Option<PathBuf> {
        self.clear_unfilled_in(Path::new("/dev/shm"), effective_uid()?)
    }

    fn clear_unfilled_in(&self, folder: &Path, us: u32) -> Option<PathBuf> {
        let prefix = self.config().global.prefix.to_string();
        let (mut orphans, mut others) = (Vec::new(), Vec::new());
        for entry in std::fs::read_dir(folder).ok()?.flatten() {
            let ours = entry.file_name().to_str().is_some_and(|name| name.starts_with(&prefix));
            // Of the entry itself: a link is not followed.
            let Some(meta) = ours.then(|| entry.metadata().ok()).flatten() else { continue };
            let (empty, readable) = (meta.len() == 0, meta.mode() & MAY_READ != 0);
            if !meta.is_file() || (!empty && readable) {
                continue;
            }
            let lingers = meta.modified().is_ok_and(|t| t.elapsed().is_ok_and(|age| age >= MOMENT));
            // What only its owner could open, and that not even for reading, is refused to us in bounded time.
            let holds_us = empty && (us == 0 || readable);
            (if lingers && meta.uid() == us { &mut orphans } else { &mut others }).push((entry.path(), holds_us));
        }
        let held = open_files(orphans.iter().map(|(path, _)| path), us);
        orphans.retain(|(path, _)| held.contains(path) || std::fs::remove_file(path).is_err());
        orphans.into_iter().chain(others).find(|(_, holds_us)| *holds_us).map(|(path, _)| path)
    }
}

/// Those of the files that a living process of `user` has open or mapped.
fn open_files<'a>(paths: impl Iterator<Item = &'a PathBuf>, user: u32) -> Vec<PathBuf> {
    let mut closed: Vec<&PathBuf> = paths.collect();
    let mut open = Vec::new();
    let processes = std::fs::read_dir("/proc").into_iter().flatten().flatten().map(|entry| entry.path());
    for process in processes.filter(|process| std::fs::metadata(process).is_ok_and(|meta| meta.uid() == user)) {
        if closed.is_empty() {
            break;
        }
        let descriptors = std::fs::read_dir(process.join("fd")).into_iter().flatten().flatten();
        let mut seen: Vec<PathBuf> = descriptors.filter_map(|fd| std::fs::read_link(fd.path()).ok()).collect();
        let maps = std::fs::read_to_string(process.join("maps")).unwrap_or_default();
        seen.extend(maps.lines().filter_map(|line| Some(PathBuf::from(&line[line.find('/')?..]))));
        let (held, rest) = closed.into_iter().partition(|path| seen.contains(path));
        closed = rest;
        open.extend(Vec::<&PathBuf>::into_iter(held).cloned());
    }
    open
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
        let old = MOMENT * 2;
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
        std::fs::set_permissions(&young, Permissions::from_mode(0o600)).unwrap();
        assert_eq!(endpoint.clear_unfilled_in(folder.path(), us), Some(young.clone()));
        make("cu_young", 0, 0o666, old);
        assert_eq!(endpoint.clear_unfilled_in(folder.path(), us + 1), Some(young), "another user's is left alone");
        assert!(there("cu_sized"));
    }
}
