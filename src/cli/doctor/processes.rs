//! Other processes by /proc: daemons, and who has a file open. Only what this user may read; root may read all.

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

/// Processes that are looked at, and open files of each.
const MAX_PROCESSES: usize = 32_768;
const MAX_FILES: usize = 4096;

/// A running process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Process {
    pub pid: u32,
    /// The user it runs as.
    pub uid: u32,
    /// The kernel's name of it, 15 characters at the most.
    pub name: String,
}

fn all(proc: &Path) -> impl Iterator<Item = Process> + use<> {
    let entries = fs::read_dir(proc).into_iter().flatten().flatten().take(MAX_PROCESSES);
    entries.filter_map(|entry| {
        let pid = entry.file_name().to_str()?.parse().ok()?;
        let uid = entry.metadata().ok()?.uid();
        let name = fs::read_to_string(entry.path().join("comm")).ok()?.trim().to_owned();
        Some(Process { pid, uid, name })
    })
}

/// Running daemons: `cairn run`, of either package.
pub fn daemons(proc: &Path) -> Vec<Process> {
    let runs = |process: &Process| {
        let line = fs::read(proc.join(process.pid.to_string()).join("cmdline")).unwrap_or_default();
        line.split(|byte| *byte == 0).skip(1).any(|word| word == b"run")
    };
    all(proc).filter(|process| matches!(process.name.as_str(), "cairn" | "cairn-tools") && runs(process)).collect()
}

/// Who has a file open, and whether some processes could not be looked into.
pub fn holders(proc: &Path, file: &Path) -> (Vec<Process>, bool) {
    let file = fs::canonicalize(file).unwrap_or_else(|_| file.into());
    let mut hidden = false;
    let holders = all(proc)
        .filter(|process| match fs::read_dir(proc.join(process.pid.to_string()).join("fd")) {
            Ok(open) => open.flatten().take(MAX_FILES).any(|fd| fs::read_link(fd.path()).is_ok_and(|to| to == file)),
            Err(error) => {
                hidden |= error.kind() == std::io::ErrorKind::PermissionDenied;
                false
            }
        })
        .collect();
    (holders, hidden)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_has_a_file_open_is_found_in_the_real_proc() {
        let file = tempfile::NamedTempFile::new().expect("file");
        let us = std::process::id();
        let (who, _) = holders(Path::new("/proc"), file.path());
        assert!(who.iter().any(|p| p.pid == us), "{who:?}");
        let (path, dir) = (file.path().to_path_buf(), tempfile::tempdir().expect("folder"));
        drop(file);
        assert!(holders(Path::new("/proc"), &path).0.is_empty(), "closed");
        assert_eq!(holders(dir.path(), &path), (Vec::new(), false), "no /proc at all");
    }

    #[test]
    fn a_daemon_is_told_from_other_commands_of_the_same_program() {
        let proc = tempfile::tempdir().expect("folder");
        for (pid, comm, line) in [
            ("10", "cairn", "/usr/bin/cairn\0run\0"),
            ("11", "cairn", "cairn\0watch\0--json\0"),
            ("12", "bash", "bash\0run\0"),
            ("13", "cairn-tools", "cairn-tools\0run\0"),
            ("self", "cairn", "cairn\0run\0"),
        ] {
            let folder = proc.path().join(pid);
            fs::create_dir(&folder).expect("folder");
            fs::write(folder.join("comm"), format!("{comm}\n")).expect("written");
            fs::write(folder.join("cmdline"), line).expect("written");
        }
        let mut found: Vec<u32> = daemons(proc.path()).iter().map(|p| p.pid).collect();
        found.sort_unstable();
        assert_eq!(found, [10, 13]);
    }
}
