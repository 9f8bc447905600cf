//! Trajectories of several maps of one run: the largest map's is the file that was asked for, each other one's stands beside it as
//! the same name with `.map<ID>` before the ending: `trajectory.map3.txt` for `trajectory.txt`, `trajectory.map3` for `trajectory`.
//!
//! Files that an earlier run has left under such names would be taken for this run's, so they are removed once this run's are
//! written: plain files whose name is exactly of that form. Nothing else in the folder is touched.

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};

use super::TrajectoryError;
use crate::atomic_file::WriteError;
use crate::map::MapId;

/// Entries of a folder that are looked at.
const MAX_ENTRIES: usize = 100_000;

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
        let name = entry.file_name();
        let is_plain = || entry.file_type().is_ok_and(|kind| kind.is_file());
        if is_beside(path, &name) && !own.contains(&name) && is_plain() {
            let stale = entry.path();
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
    fn only_what_has_exactly_that_name_is_removed() {
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
        for name in foreign.iter().chain(&["t.map0.txt", "t.map3.txt", "t.map12.txt"]) {
            std::fs::write(dir.path().join(name), name).unwrap();
        }
        std::fs::create_dir(dir.path().join("t.map5.txt")).unwrap();
        remove_others(&path, &[dir.path().join("t.map3.txt")]).unwrap();
        let mut left: Vec<String> =
            std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        left.sort();
        let mut expected: Vec<&str> = foreign.to_vec();
        expected.extend(["t.map3.txt", "t.map5.txt"]);
        expected.sort_unstable();
        assert_eq!(left, expected);
    }
}
