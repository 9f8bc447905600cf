//! Files that are either the old one or the whole new one, never half of one.
//!
//! Input: a path and a closure that writes. Output: the file at that path, complete, or an error that names the path and
//! leaves what was there before untouched. The content goes to a temporary file beside the target, is synced, and is
//! renamed over it. A path that is not a regular file (a pipe, `/dev/stdout`, `/dev/null`) is written directly: renaming
//! over a device would delete it. A symbolic link stays and its target is replaced.
//!
//! A process that is killed, or a power cut, leaves its temporary file: [`remove_stale`] clears them away at the next start. Whoever
//! writes one holds the kernel's lock on it (`flock`), which ends with the process however that ends; process numbers would not tell,
//! as they are given anew after a reboot.
//!
//! Deliberately not here: locks between two writers of one path (the later rename wins, whole).

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Why a file could not be written. Whatever was at the path before is still there.
#[derive(Debug, thiserror::Error)]
#[error("cannot write {path}: {source}")]
pub struct WriteError {
    pub path: String,
    pub source: io::Error,
}

/// Writes `path` as a whole or not at all; see the module's text.
pub fn write_atomically(
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>,
) -> Result<(), WriteError> {
    let named = |source| WriteError { path: path.display().to_string(), source };
    match fs::metadata(path) {
        Ok(meta) if meta.is_dir() => Err(named(io::Error::new(io::ErrorKind::IsADirectory, "it is a directory"))),
        Ok(meta) if !meta.is_file() => {
            let file = OpenOptions::new().write(true).open(path).map_err(named)?;
            let mut writer = BufWriter::new(file);
            fill(&mut writer).and_then(|()| writer.flush()).map_err(named)
        }
        Ok(_) => replace(&fs::canonicalize(path).map_err(named)?, fill).map_err(named),
        Err(e) if e.kind() == io::ErrorKind::NotFound => replace(path, fill).map_err(named),
        Err(e) => Err(named(e)),
    }
}

/// Removes the temporary file unless it was renamed away.
struct Temporary {
    path: PathBuf,
    renamed: bool,
}
impl Drop for Temporary {
    fn drop(&mut self) {
        if !self.renamed {
            // Nothing better can be done with a failure here; the error that brought us here is the one to report.
            let _ = fs::remove_file(&self.path);
        }
    }
}

fn replace(target: &Path, fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>) -> io::Result<()> {
    let name = target.file_name().ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "it names no file"))?;
    let directory = match target.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    let (file, path) = create_unique(directory, &format!(".{}", name.to_string_lossy()), false)?;
    let mut temporary = Temporary { path, renamed: false };
    let mut writer = BufWriter::with_capacity(1 << 16, file);
    fill(&mut writer)?;
    let file = writer.into_inner().map_err(io::IntoInnerError::into_error)?;
    file.sync_all()?;
    fs::rename(&temporary.path, target)?;
    temporary.renamed = true;
    // Locked until here, lest another process takes it for left over.
    drop(file);
    // The rename itself reaches the disk with the folder; some file systems refuse to sync one, which loses nothing now.
    if let Ok(folder) = File::open(directory) {
        let _ = folder.sync_all();
    }
    Ok(())
}

/// What tells our temporary files from anybody else's: `.NAME.cairn-PID-NUMBER.tmp`.
const MARK: &str = ".cairn-";
const ENDING: &str = ".tmp";
/// Entries of a folder that are looked at.
const MAX_ENTRIES: usize = 10_000;

/// Removes the temporary files in `directory` that a process before this one has left; their paths.
/// Only files of ours: by name, plain files (links are neither followed nor removed), of this user, and that nobody writes.
pub fn remove_stale(directory: &Path) -> Vec<PathBuf> {
    use std::os::unix::fs::MetadataExt;
    let Ok(us) = fs::metadata("/proc/self").map(|m| m.uid()) else { return Vec::new() };
    let Ok(entries) = fs::read_dir(directory) else { return Vec::new() };
    let mut removed = Vec::new();
    for entry in entries.flatten().take(MAX_ENTRIES).filter(|e| e.file_name().to_str().is_some_and(is_temporary)) {
        let path = entry.path();
        // Of the entry itself, not of what a link leads to.
        let ours = fs::symlink_metadata(&path).is_ok_and(|meta| meta.is_file() && meta.uid() == us);
        let lock = ours
            .then(|| OpenOptions::new().write(true).open(&path))
            .and_then(Result::ok)
            .filter(|file| file.try_lock().is_ok());
        if lock.is_some() && fs::remove_file(&path).is_ok() {
            removed.push(path);
        }
    }
    removed.sort();
    removed
}

/// Whether this is how we name temporary files.
fn is_temporary(name: &str) -> bool {
    let parts = || {
        let (stem, number) = name.strip_prefix('.')?.strip_suffix(ENDING)?.rsplit_once(MARK)?;
        let (pid, count) = number.split_once('-')?;
        Some((stem, pid.parse::<u32>().ok()?, count.parse::<u64>().ok()?))
    };
    parts().is_some_and(|(stem, ..)| !stem.is_empty())
}

/// A new file in `directory` that nobody else has, opened for reading and writing and locked; `private`: mode 0600.
pub(crate) fn create_unique(directory: &Path, stem: &str, private: bool) -> io::Result<(File, PathBuf)> {
    use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
    static COUNTER: AtomicU64 = AtomicU64::new(0);
    const ATTEMPTS: u32 = 100;
    for _ in 0..ATTEMPTS {
        let n = COUNTER.fetch_add(1, Ordering::Relaxed);
        let path = directory.join(format!("{stem}{MARK}{}-{n}{ENDING}", std::process::id()));
        let mode = if private { 0o600 } else { 0o666 };
        match OpenOptions::new().read(true).write(true).create_new(true).mode(mode).open(&path) {
            // A file system without locks leaves it to be cleared away by hand. One that was cleared away before the lock is no file any more.
            Ok(file) => match file.try_lock() {
                Err(TryLockError::WouldBlock) => continue,
                Ok(()) if file.metadata().is_ok_and(|meta| meta.nlink() == 0) => continue,
                _ => return Ok((file, path)),
            },
            // Left over by a killed process that had our number: try the next name.
            Err(e) if e.kind() == io::ErrorKind::AlreadyExists => continue,
            Err(e) => return Err(e),
        }
    }
    Err(io::Error::new(io::ErrorKind::AlreadyExists, format!("no free temporary name in {}", directory.display())))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(directory: &Path) -> Vec<String> {
        let mut all: Vec<_> =
            fs::read_dir(directory).unwrap().map(|e| e.unwrap().file_name().to_string_lossy().into_owned()).collect();
        all.sort();
        all
    }

    #[test]
    fn a_failed_write_leaves_the_old_file_and_no_litter() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("map.ply");
        fs::write(&path, "old").unwrap();
        let full = || io::Error::from_raw_os_error(libc::ENOSPC);
        let error = write_atomically(&path, |w| w.write_all(b"half").and(Err(full()))).unwrap_err();
        assert!(error.to_string().contains("map.ply") && error.to_string().contains("No space left"), "{error}");
        assert_eq!(fs::read_to_string(&path).unwrap(), "old");
        assert_eq!(names(dir.path()), ["map.ply"]);
    }

    #[test]
    fn a_device_is_written_and_not_replaced() {
        let error = write_atomically(Path::new("/dev/full"), |w| w.write_all(b"x")).unwrap_err();
        assert!(error.to_string().contains("/dev/full") && error.to_string().contains("No space left"), "{error}");
        write_atomically(Path::new("/dev/null"), |w| w.write_all(b"x")).unwrap();
        assert!(!fs::metadata("/dev/null").unwrap().is_file());
    }

    #[test]
    fn a_link_stays_a_link() {
        let dir = tempfile::tempdir().unwrap();
        let (real, link) = (dir.path().join("real"), dir.path().join("link"));
        fs::write(&real, "old").unwrap();
        std::os::unix::fs::symlink(&real, &link).unwrap();
        write_atomically(&link, |w| w.write_all(b"new")).unwrap();
        assert!(fs::symlink_metadata(&link).unwrap().is_symlink());
        assert_eq!(fs::read_to_string(&real).unwrap(), "new");
    }

    #[test]
    fn a_folder_and_a_missing_folder_are_clear_errors() {
        let dir = tempfile::tempdir().unwrap();
        assert!(write_atomically(dir.path(), |_| Ok(())).unwrap_err().to_string().contains("directory"));
        let missing = dir.path().join("no/such/folder.txt");
        assert!(write_atomically(&missing, |_| Ok(())).unwrap_err().to_string().contains("folder.txt"));
    }

    #[test]
    fn what_a_process_left_is_cleared_away_and_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        let put = |name: &str| fs::write(dir.path().join(name), "half a map").unwrap();
        // Of a number that lives, as after a reboot, and of one that nobody has.
        let own = format!(".map.ply.cairn-{}-3.tmp", std::process::id());
        for stale in [&own, ".map.ply.cairn-4194304-0.tmp", ".cairn-spool.cairn-4194304-17.tmp"] {
            put(stale);
        }
        let kept = [
            "map.ply",
            ".map.ply.4194304-0.tmp",
            ".cairn-4194304-0.tmp",
            ".map.ply.cairn-x-0.tmp",
            ".a.cairn-1-2.tmp.gz",
        ];
        for name in kept {
            put(name);
        }
        let link = ".map.ply.cairn-4194304-1.tmp";
        std::os::unix::fs::symlink(dir.path().join("map.ply"), dir.path().join(link)).unwrap();
        let folder = ".map.ply.cairn-4194304-2.tmp";
        fs::create_dir(dir.path().join(folder)).unwrap();
        assert_eq!(remove_stale(dir.path()).len(), 3);
        let mut left: Vec<String> = kept.iter().map(|n| n.to_string()).chain([link.into(), folder.into()]).collect();
        left.sort();
        assert_eq!(names(dir.path()), left);
        assert!(remove_stale(&dir.path().join("not there")).is_empty());
    }

    #[test]
    fn what_is_being_written_stays() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("map.ply");
        write_atomically(&path, |w| {
            assert!(remove_stale(dir.path()).is_empty());
            w.write_all(b"whole")
        })
        .unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "whole");
        let (file, left) = create_unique(dir.path(), ".spool", true).unwrap();
        assert!(remove_stale(dir.path()).is_empty());
        drop(file);
        assert_eq!(remove_stale(dir.path()), [left]);
    }
}
