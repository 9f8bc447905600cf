//! Maps by name: the one folder in which commands may load and store, and what a name may be.
//!
//! A client says names and never paths. `kitchen` is the file `kitchen.map` of the folder; a name has 1 to 64 letters, digits, `-`, `_` and `.`,
//! and begins with a letter or digit, so none leads out of the folder or is hidden in it.

use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use crate::messages::TEXT_LEN;

const ENDING: &str = ".map";
const LONGEST_NAME: usize = 64;
/// Maps in the folder at the most: whoever presses a button all night does not fill the disk with new ones.
const MOST_MAPS: usize = 100;
/// Entries of the folder that are looked at.
const MOST_ENTRIES: usize = 10_000;
/// The folder below for copies that are made for a client: whoever removes his own need not be able to write where the maps are.
const COPIES: &str = "copies";
/// How long a client has to fetch its own.
const COPY_LIVES: Duration = Duration::from_secs(300);
/// Copies at a time: whoever fetches none does not fill the disk.
const MOST_COPIES: usize = 8;

/// Where maps are kept by name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MapFolder {
    path: PathBuf,
}

impl MapFolder {
    pub fn new(path: PathBuf) -> Self {
        Self { path }
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The file of a name, with or without its ending. The error says what a name may be.
    pub fn file(&self, name: &str) -> Result<PathBuf, String> {
        let name = name.strip_suffix(ENDING).unwrap_or(name);
        let may = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
        let is_name = name.starts_with(|c: char| c.is_ascii_alphanumeric())
            && name.len() <= LONGEST_NAME
            && name.chars().all(may);
        if !is_name {
            return Err(format!(
                "{name:?} is no name of a map: 1 to {LONGEST_NAME} letters, digits, '-', '_' and '.', a letter or digit first; maps are kept in {}",
                self.path.display()
            ));
        }
        Ok(self.path.join(format!("{name}{ENDING}")))
    }

    /// The same for a map that is to be made; the folder is made if it is missing.
    pub fn new_file(&self, path: &Path) -> Result<(), String> {
        make(&self.path)?;
        if path.symlink_metadata().is_ok() {
            return Err(format!("{}: there is such a map already", path.display()));
        }
        let there = self.maps().len();
        if there >= MOST_MAPS {
            return Err(format!("{}: there are {there} maps; remove some", self.path.display()));
        }
        Ok(())
    }

    /// Where a copy for a client goes. Copies that nobody has fetched are removed, and nothing else that is in their folder.
    pub fn copy_file(&self) -> Result<PathBuf, String> {
        let folder = self.path.join(COPIES);
        make(&folder)?;
        let now = SystemTime::now();
        let mut there = 0;
        for entry in std::fs::read_dir(&folder).into_iter().flatten().flatten().take(MOST_ENTRIES) {
            let is_copy = entry.file_name().to_str().is_some_and(is_copy);
            let Some(about) = entry.metadata().ok().filter(|about| is_copy && about.is_file()) else { continue };
            let age = about.modified().ok().and_then(|made| now.duration_since(made).ok());
            // What cannot be removed is looked at with the next copy again.
            let removed = age.is_some_and(|age| age > COPY_LIVES) && std::fs::remove_file(entry.path()).is_ok();
            there += usize::from(!removed);
        }
        if there >= MOST_COPIES {
            let (folder, minutes) = (folder.display(), COPY_LIVES.as_secs() / 60);
            return Err(format!(
                "{folder}: {there} copies wait for whoever asked for them; they go after {minutes} minutes"
            ));
        }
        let stamp = now.duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos();
        Ok(folder.join(format!("{}-{stamp}{ENDING}", std::process::id())))
    }

    /// Maps by name, ascending, with their bytes and when they were written, s since 1970.
    fn maps(&self) -> Vec<(String, u64, u64)> {
        let entries = std::fs::read_dir(&self.path).into_iter().flatten().flatten().take(MOST_ENTRIES);
        let of = |entry: std::fs::DirEntry| {
            let name = entry.file_name().into_string().ok()?.strip_suffix(ENDING)?.to_owned();
            self.file(&name).ok()?;
            let about = std::fs::metadata(entry.path()).ok().filter(std::fs::Metadata::is_file)?;
            let written = about.modified().ok()?.duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
            Some((name, about.len(), written))
        };
        let mut maps: Vec<_> = entries.filter_map(of).collect();
        maps.sort();
        maps
    }

    /// As many lines on the maps behind the name `after` as fit into an answer; see the command's text.
    pub fn list(&self, after: &str, current: Option<&Path>) -> String {
        const MORE: &str = "...";
        let mut text = String::new();
        for (name, bytes, written) in self.maps().into_iter().filter(|(name, ..)| name.as_str() > after) {
            let is_current = current == Some(&*self.path.join(format!("{name}{ENDING}")));
            let line = format!("{name} {bytes} {written}{}\n", if is_current { " current" } else { "" });
            if text.len() + line.len() + MORE.len() > TEXT_LEN {
                return text + MORE;
            }
            text += &line;
        }
        text
    }
}

fn make(folder: &Path) -> Result<(), String> {
    std::fs::create_dir_all(folder).map_err(|e| format!("{}: {e}", folder.display()))
}

/// Whether this is how copies for clients are named.
fn is_copy(name: &str) -> bool {
    let numbers = || name.strip_suffix(ENDING)?.split_once('-');
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    numbers().is_some_and(|(process, stamp)| is_number(process) && is_number(stamp))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_that_nobody_fetches_are_few_and_go_and_nothing_else_does() {
        let dir = tempfile::tempdir().unwrap();
        let folder = MapFolder::new(dir.path().join("maps"));
        let foreign = ["copies/notes", "copies/1-2", "copies/1-x.map", "copies/-1.map", "kitchen.map", "1-2.map"];
        std::fs::create_dir_all(folder.path().join(COPIES)).unwrap();
        let long_ago = SystemTime::now() - 2 * COPY_LIVES;
        let old = |path: &Path| {
            std::fs::write(path, "x").unwrap();
            std::fs::File::options().write(true).open(path).unwrap().set_modified(long_ago).unwrap();
        };
        foreign.iter().for_each(|name| old(&folder.path().join(name)));
        let copies: Vec<PathBuf> = (0..MOST_COPIES)
            .map(|_| {
                let copy = folder.copy_file().unwrap();
                std::fs::write(&copy, "x").unwrap();
                copy
            })
            .collect();
        assert!(folder.copy_file().expect_err("enough").contains("copies"));
        old(&copies[3]);
        folder.copy_file().unwrap();
        assert!(!copies[3].exists() && copies[4].exists());
        assert!(foreign.iter().all(|name| folder.path().join(name).exists()));
    }

    #[test]
    fn no_name_leads_out_of_the_folder() {
        let folder = MapFolder::new("/var/lib/cairn/maps".into());
        for (name, file) in [("kitchen", "kitchen.map"), ("kitchen.map", "kitchen.map"), ("1_a-b.c", "1_a-b.c.map")] {
            assert_eq!(folder.file(name), Ok(folder.path().join(file)));
        }
        let long = "x".repeat(65);
        for name in
            ["", ".map", "..", "../a", "a/b", "/etc/passwd", ".hidden", "-x", "a b", "a\0b", "ä", "a\n", long.as_str()]
        {
            let told = folder.file(name).expect_err(name);
            assert!(told.contains("/var/lib/cairn/maps"), "{told}");
        }
    }

    #[test]
    fn maps_are_listed_in_answers_that_hold_some_each() {
        let dir = tempfile::tempdir().unwrap();
        let folder = MapFolder::new(dir.path().join("maps"));
        assert_eq!(folder.list("", None), "", "there is no folder yet");
        assert_eq!(folder.new_file(&folder.file("a").unwrap()), Ok(()));
        for n in 0..30 {
            std::fs::write(folder.path().join(format!("a-long-name-of-a-map-{n:02}.map")), "x").unwrap();
        }
        std::fs::create_dir(folder.path().join(COPIES)).unwrap();
        for foreign in ["copies/1-1.map", "notes.txt", ".a.map.12"] {
            std::fs::write(folder.path().join(foreign), "x").unwrap();
        }
        let current = folder.file("a-long-name-of-a-map-07").unwrap();
        let (mut names, mut after) = (Vec::new(), String::new());
        for _ in 0..30 {
            let text = folder.list(&after, Some(&current));
            assert!(text.len() <= TEXT_LEN);
            let lines: Vec<&str> = text.lines().filter(|line| *line != "...").collect();
            names.extend(lines.iter().map(|line| line.split(' ').next().unwrap().to_owned()));
            assert!(lines.iter().all(|line| line.ends_with(" current") == line.contains("-07 ")), "{text}");
            let Some(last) = names.last().filter(|_| text.ends_with("...")) else { break };
            after.clone_from(last);
        }
        assert_eq!(names.len(), 30, "{names:?}");
        assert!(names.is_sorted());
        let told = folder.new_file(&current).expect_err("it is there");
        assert!(told.contains("already"), "{told}");
        for n in 0..MOST_MAPS {
            std::fs::write(folder.path().join(format!("b{n}.map")), "x").unwrap();
        }
        assert!(folder.new_file(&folder.file("new").unwrap()).expect_err("full").contains("remove some"));
    }
}
