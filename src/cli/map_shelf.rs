//! Stored maps, for whoever fetches them over the network: the files of the folder, and a copy of the one that the daemon goes on in.

use std::fs::File;
use std::path::Path;
use std::time::Duration;

use super::CliError;
use crate::client::{Client, ClientError};
use crate::daemon::MapFolder;
use crate::messages::Endpoint;
use crate::share::maps::Shelf;

/// A large map on a slow disk.
const PATIENCE: Duration = Duration::from_secs(30);
/// Bytes of a sentence that names the maps there are.
const MOST_NAMED: usize = 300;

/// See module.
pub struct MapShelf {
    folder: MapFolder,
    client: Client,
}

impl MapShelf {
    pub fn open(folder: MapFolder, endpoint: Endpoint) -> Result<Self, CliError> {
        Ok(Self { folder, client: Client::with_endpoint(endpoint)? })
    }

    /// The daemon writes to it at this time.
    fn is_held(&self, path: &Path) -> Result<bool, String> {
        let maps = match self.client.all_maps(PATIENCE) {
            // Without a daemon nobody writes; what another program does is seen by the file's time.
            Err(ClientError::NoDaemon { .. }) => return Ok(false),
            Err(error) => return Err(error.to_string()),
            // It keeps no maps.
            Ok(Err(_)) => return Ok(false),
            Ok(Ok(maps)) => maps,
        };
        let is_it = |name: &str| self.folder.file(name).is_ok_and(|file| file == path);
        Ok(maps.iter().any(|map| map.is_current && is_it(&map.name)))
    }

    fn copy(&self) -> Result<File, String> {
        let reply = self.client.copy_map(PATIENCE).map_err(|e| e.to_string())?;
        if !reply.is_ok() {
            return Err(reply.message().into());
        }
        let copy = Path::new(reply.message().lines().next().unwrap_or_default());
        let file = File::open(copy).map_err(|e| format!("the daemon's copy of the map cannot be read: {e}"))?;
        // It was made for us alone. Where we may not remove it the daemon does, when it makes another one minutes later.
        let _ = std::fs::remove_file(copy);
        Ok(file)
    }
}

impl Shelf for MapShelf {
    fn open(&mut self, name: &str) -> Result<File, String> {
        // Whoever asks need not know where they are kept.
        let path = self.folder.file(name).map_err(|_| format!("{name:?} is no name of a map"))?;
        if !path.is_file() {
            let listed = self.folder.list("", None);
            let mut names: String =
                listed.lines().filter_map(|line| line.split(' ').next()).collect::<Vec<_>>().join(", ");
            if names.len() > MOST_NAMED {
                names.truncate(MOST_NAMED);
                names += " ...";
            }
            return Err(match names.as_str() {
                "" => "there are no stored maps".into(),
                names => format!("there is no map {name}; there are {names}"),
            });
        }
        if self.is_held(&path)? {
            return self.copy();
        }
        File::open(&path).map_err(|e| format!("the map {name} cannot be read: {e}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stored_map_is_given_and_nothing_else_of_the_disk() {
        let dir = tempfile::tempdir().expect("folder");
        let folder = MapFolder::new(dir.path().join("maps"));
        let endpoint = Endpoint::new(&format!("shelf-{}", std::process::id())).expect("endpoint");
        let mut shelf = MapShelf::open(folder.clone(), endpoint).expect("shelf");
        let mut refused = |name: &str| shelf.open(name).expect_err("refused");
        assert_eq!(refused("attic"), "there are no stored maps");
        std::fs::create_dir(folder.path()).expect("folder");
        std::fs::write(dir.path().join("secret.map"), "s").expect("written");
        for name in ["a", "b"] {
            std::fs::write(folder.file(name).expect("name"), name).expect("written");
        }
        assert_eq!(refused("attic"), "there is no map attic; there are a, b");
        for name in ["../secret", "..", "", ".hidden", "/etc/passwd", "\u{1b}[2J"] {
            let told = refused(name);
            assert!(told.ends_with("is no name of a map") && !told.contains(char::is_control), "{told}");
        }
        // There is no daemon: the file itself.
        let given = std::io::read_to_string(shelf.open("b").expect("given")).expect("read");
        assert_eq!(given, "b");
    }
}
