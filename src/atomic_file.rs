//! Files that are either the old one or the whole new one, never half of one.
//!
//! Input: a path and a closure that writes. Output: the file at that path, complete, or an error that names the path and
//! leaves what was there before untouched. The content goes to a temporary file beside the target, is synced, and is
//! renamed over it. A path that is not a regular file (a pipe, `/dev/stdout`, `/dev/null`) is written directly: renaming
//! over a device would delete it. A symbolic link stays and its target is replaced.
//!
//! Deliberately not here: locks between two writers of one path (the later rename wins, whole).

use std::fs::{self, File, OpenOptions};
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
    drop(file);
    fs::rename(&temporary.path, target)?;
    temporary.renamed = true;
    // The rename itself reaches the disk with the folder; some file systems refuse to sync one, which loses nothing now.
    if let Ok(folder) = File::open(directory) {
        let _ = folder.sync_all();
    }
    Ok(())
}

/// A new file in `directory` that nobody else has, opened for reading and writing; `private`: mode 0600.
pub(crate) fn create_unique(directory: &Path, stem: &str, private: bool) -> io::Result<(File, PathBuf)> {
    use std::os::unix::fs::OpenOptionsExt;
    static COUNTER: AtomicU64 = AtomicU64::new(0);
    const ATTEMPTS: u32 = 100;
    for _ in 0..ATTEMPTS {
        let n = COUNTER.fetch_add(1, Ordering::Relaxed);
        let path = directory.join(format!("{stem}.{}-{n}.tmp", std::process::id()));
        let mode = if private { 0o600 } else { 0o666 };
        match OpenOptions::new().read(true).write(true).create_new(true).mode(mode).open(&path) {
            Ok(file) => return Ok((file, path)),
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
}
