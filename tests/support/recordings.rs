//! Recordings that are not in the source tree: `CAIRN_DATA` names their folder.

use std::path::{Path, PathBuf};

/// A recording's folder; where it is not there the caller skips its test, and this says so.
pub fn recording(name: &str) -> Option<PathBuf> {
    let data = std::env::var_os("CAIRN_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"), PathBuf::from);
    let folder = data.join(name);
    if folder.is_dir() {
        return Some(folder);
    }
    println!("skipped: {} is not there; CAIRN_DATA names the folder of recordings", folder.display());
    None
}
