//! How a map file gets its name, keeps it, and is locked: nothing that exists is ever replaced by a map, but an older format of the same one.

use std::fs::{File, TryLockError};
use std::io;
use std::os::unix::fs::{FileExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::error::{FORMAT, Fault};
use super::front::Front;
use crate::atomic_file::create_unique;

pub(super) fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

/// A file that is held is tried so often again, so long apart: whoever reads one is done in two seconds, but for that of a whole building.
const TRIES: u32 = 100;
const BETWEEN_TRIES: Duration = Duration::from_millis(20);

/// A file that is to have this name once it is whole: new, locked, and cleared away at a later start should this process be killed.
pub(super) fn nameless(path: &Path) -> Result<(File, PathBuf), Fault> {
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    create_unique(folder_of(path), &format!(".{name}"), false).map_err(Fault::Write)
}

/// It replaces nothing.
pub(super) fn give_name(temporary: &Path, path: &Path) -> Result<(), Fault> {
    use rustix::fs::{CWD, RenameFlags, renameat_with};
    let renamed = renameat_with(CWD, temporary, CWD, path, RenameFlags::NOREPLACE);
    linked_instead(renamed.map_err(Into::into), temporary, path)?;
    // Some file systems refuse to sync a folder; the file is whole and has its name.
    let _ = File::open(folder_of(path)).and_then(|f| f.sync_all());
    Ok(())
}

/// Where the file is of an older format: a copy of the present one that has taken its place.
pub(super) fn renewed(file: &File, path: &Path) -> Result<Option<File>, Fault> {
    let front = Front::read(file)?;
    if front.format == FORMAT {
        return Ok(None);
    }
    // A link to it stays one.
    let gone =
        |error: io::Error| if error.kind() == io::ErrorKind::NotFound { Fault::Replaced } else { Fault::Read(error) };
    let path = path.canonicalize().map_err(gone)?;
    let folder = path.parent().unwrap_or(Path::new("/"));
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let (copy, temporary) = create_unique(folder, &format!(".{name}"), false).map_err(Fault::Write)?;
    let filled = || {
        lock(copy.try_lock())?;
        let mut piece = vec![0; 1 << 20];
        let mut at = 0;
        loop {
            let read = file.read_at(&mut piece, at).map_err(Fault::Read)?;
            if read == 0 {
                break;
            }
            copy.write_all_at(&piece[..read], at).map_err(Fault::Write)?;
            at += read as u64;
        }
        copy.write_all_at(&front.page(), 0).and_then(|()| copy.sync_all()).map_err(Fault::Write)?;
        // Somebody may have moved another map there since it was opened.
        if !is_at(inode(file)?, &path)? {
            return Err(Fault::Replaced);
        }
        std::fs::rename(&temporary, &path).map_err(Fault::Write)?;
        let _ = File::open(folder).and_then(|f| f.sync_all());
        Ok(())
    };
    filled().inspect_err(|_: &Fault| {
        let _ = std::fs::remove_file(&temporary);
    })?;
    Ok(Some(copy))
}

pub(super) fn inode(file: &File) -> Result<(u64, u64), Fault> {
    file.metadata().map(|own| (own.dev(), own.ino())).map_err(Fault::Read)
}

/// Whether this is what the path holds, or leads to.
pub(super) fn is_at(inode: (u64, u64), path: &Path) -> Result<bool, Fault> {
    match std::fs::metadata(path) {
        Ok(there) => Ok((there.dev(), there.ino()) == inode),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(Fault::Read(error)),
    }
}

/// What came of renaming without replacing; network file systems that cannot do that can link a second name.
fn linked_instead(renamed: io::Result<()>, temporary: &Path, path: &Path) -> Result<(), Fault> {
    let named = match renamed {
        Err(e) if matches!(e.raw_os_error(), Some(libc::EINVAL | libc::ENOSYS)) => {
            std::fs::hard_link(temporary, path).inspect(|()| {
                // It has its own name; the other is cleared away at a later start.
                let _ = std::fs::remove_file(temporary);
            })
        }
        other => other,
    };
    named.map_err(|e| match e.kind() {
        io::ErrorKind::AlreadyExists => Fault::Exists,
        _ => Fault::Write(e),
    })
}

pub(super) fn lock(outcome: Result<(), TryLockError>) -> Result<(), Fault> {
    outcome.map_err(|e| match e {
        TryLockError::WouldBlock => Fault::Busy,
        TryLockError::Error(error) => Fault::Read(error),
    })
}

/// The same of a file that somebody may be reading at the moment, as `cairn map info` does: it is waited for a little.
pub(super) fn lock_soon(file: &File) -> Result<(), Fault> {
    for _ in 0..TRIES {
        match lock(file.try_lock()) {
            Err(Fault::Busy) => std::thread::sleep(BETWEEN_TRIES),
            outcome => return outcome,
        }
    }
    lock(file.try_lock())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_somebody_reads_is_waited_for_and_one_that_is_held_is_not_for_long() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.map");
        std::fs::write(&path, "a map").unwrap();
        let [reader, own, other] = [(); 3].map(|()| File::open(&path).unwrap());
        reader.try_lock_shared().unwrap();
        let reading = std::thread::spawn(move || {
            std::thread::sleep(Duration::from_millis(200));
            drop(reader);
        });
        lock_soon(&own).unwrap();
        reading.join().unwrap();
        assert!(matches!(lock_soon(&other), Err(Fault::Busy)));
    }

    #[test]
    fn where_a_file_cannot_be_renamed_without_replacing_it_is_linked() {
        let dir = tempfile::tempdir().unwrap();
        let [temporary, path] = ["t", "a.map"].map(|name| dir.path().join(name));
        for errno in [libc::EINVAL, libc::ENOSYS] {
            let refused = || Err(io::Error::from_raw_os_error(errno));
            std::fs::write(&temporary, "new").unwrap();
            linked_instead(refused(), &temporary, &path).unwrap();
            assert!(!temporary.exists() && std::fs::read(&path).unwrap() == b"new");
            std::fs::write(&temporary, "newer").unwrap();
            assert!(matches!(linked_instead(refused(), &temporary, &path), Err(Fault::Exists)));
            assert!(std::fs::read(&path).unwrap() == b"new");
            std::fs::remove_file(&path).unwrap();
        }
        let full = linked_instead(Err(io::Error::from_raw_os_error(libc::ENOSPC)), &temporary, &path);
        assert!(matches!(full, Err(Fault::Write(_))) && !path.exists());
    }
}
