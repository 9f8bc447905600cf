//! Trajectories of several maps of one run: the largest map's is the file that was asked for, each other one's stands beside it as
//! the same name with `.map<ID>` before the ending: `trajectory.map3.txt` for `trajectory.txt`, `trajectory.map3` for `trajectory`.
//!
//! Nobody has named these files, so somebody else's may lie there. Each of ours begins with a comment that says what it is ([`MARK`]); a file
//! without it is neither replaced nor removed. Those that an earlier run has left would be taken for this run's, so they are removed once this
//! run's are written: plain files whose name is exactly of that form and that begin so. Nothing else in the folder is touched.

use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use super::TrajectoryError;
use crate::atomic_file::WriteError;
use crate::map::MapId;

/// First line of such a file; readers of TUM files skip it.
pub const MARK: &str = "# poses of another map of the same run, whose file cairn has put here by itself\n";
/// Entries of a folder that are looked at.
const MAX_ENTRIES: usize = 100_000;

/// What became of the files beside the one that was asked for.
#[derive(Debug, Default)]
pub struct Beside {
    pub files: Vec<PathBuf>,
    /// One a file that could not be written or removed.
    pub failures: Vec<TrajectoryError>,
}

/// Where the trajectory of another map goes.
pub fn path_of(path: &Path, map: MapId) -> PathBuf {
    let mut name = path.file_stem().unwrap_or_default().to_os_string();
    name.push(format!(".map{}", map.0));
    if let Some(ending) = path.extension() {
        name.push(".");
        name.push(ending);
    }
    path.with_file_name(name)
}

/// Whether a file of this name is another map's beside `path`.
fn is_beside(path: &Path, name: &OsStr) -> bool {
    let number = || {
        let stem = path.file_stem()?.to_str()?;
        let ending = path.extension().map_or(Some(String::new()), |ending| Some(format!(".{}", ending.to_str()?)))?;
        name.to_str()?.strip_prefix(stem)?.strip_prefix(".map")?.strip_suffix(ending.as_str())?.parse::<u32>().ok()
    };
    // As it would be written: no sign, no leading zeros.
    number().is_some_and(|number| path_of(path, MapId(number)).file_name() == Some(name))
}

/// Whether a plain file (no link to one) begins with the mark.
fn is_ours(path: &Path) -> bool {
    let mut begin = [0; MARK.len()];
    let is_plain = path.symlink_metadata().is_ok_and(|about| about.is_file());
    is_plain && File::open(path).and_then(|mut file| file.read_exact(&mut begin)).is_ok() && begin == *MARK.as_bytes()
}

/// Whether nothing is lost when another map's trajectory is written there.
pub fn check_free(path: &Path) -> Result<(), TrajectoryError> {
    match path.symlink_metadata().is_err() || is_ours(path) {
        true => Ok(()),
        false => Err(TrajectoryError::NotOurs { path: path.display().to_string() }),
    }
}

/// Removes other maps' trajectories beside `path` that are not among `ours`.
pub fn remove_others(path: &Path, ours: &[PathBuf]) -> Result<(), TrajectoryError> {
    if !path.is_file() {
        return Ok(());
    }
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let failed = |path: &Path, source| WriteError { path: path.display().to_string(), source };
    let own: Vec<OsString> = ours.iter().filter_map(|path| path.file_name().map(OsStr::to_os_string)).collect();
    let entries = std::fs::read_dir(folder).map_err(|e| failed(folder, e))?;
    for entry in entries.flatten().take(MAX_ENTRIES) {
        let (name, stale) = (entry.file_name(), entry.path());
        if is_beside(path, &name) && !own.contains(&name) && is_ours(&stale) {
            std::fs::remove_file(&stale).map_err(|e| failed(&stale, e))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_number_stands_before_the_ending() {
        for (path, expected) in [
            ("a/trajectory.txt", "a/trajectory.map3.txt"),
            ("trajectory", "trajectory.map3"),
            ("run.2.tum", "run.2.map3.tum"),
            (".hidden", ".hidden.map3"),
        ] {
            assert_eq!(path_of(Path::new(path), MapId(3)), Path::new(expected));
        }
    }

    #[test]
    fn only_what_has_exactly_that_name_and_the_mark_is_removed() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.txt");
        let foreign = [
            "t.txt",
            "t.map.txt",
            "t.map03.txt",
            "t.map+3.txt",
            "t.mapx.txt",
            "t.map3.csv",
            "u.map3.txt",
            "t.map3",
            "xt.map3.txt",
        ];
        let marked = format!("{MARK}1 0 0 0 0 0 0 1\n");
        for name in foreign.iter().chain(&["t.map0.txt", "t.map3.txt", "t.map12.txt"]) {
            std::fs::write(dir.path().join(name), &marked).unwrap();
        }
        // By name they could be ours.
        let somebodys = ["t.map7.txt", "t.map8.txt", "t.map9.txt"];
        for (name, text) in somebodys.iter().zip(["1 0 0 0 0 0 0 1\n", "", &marked[1..]]) {
            std::fs::write(dir.path().join(name), text).unwrap();
        }
        std::fs::create_dir(dir.path().join("t.map5.txt")).unwrap();
        std::os::unix::fs::symlink("t.map3.csv", dir.path().join("t.map6.txt")).unwrap();
        remove_others(&path, &[dir.path().join("t.map3.txt")]).unwrap();
        let mut left: Vec<String> =
            std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        left.sort();
        let mut expected: Vec<&str> = foreign.iter().chain(&somebodys).copied().collect();
        expected.extend(["t.map3.txt", "t.map5.txt", "t.map6.txt"]);
        expected.sort_unstable();
        assert_eq!(left, expected);
        for (name, free) in [("t.map3.txt", true), ("t.map99.txt", true), ("t.map5.txt", false), ("t.map6.txt", false)]
        {
            assert_eq!(check_free(&dir.path().join(name)).is_ok(), free, "{name}");
        }
        let told = check_free(&dir.path().join("t.map7.txt")).expect_err("somebody's").to_string();
        assert!(told.contains("t.map7.txt"), "{told}");
    }
}
