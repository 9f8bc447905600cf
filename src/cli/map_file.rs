//! The map file of a run: `--map-file FILE`, and what its faults mean to a script.

use std::path::Path;

use super::{CliError, exit_code, session};
use crate::daemon::MapPlan;
use crate::places::store::{Fault, MapFile, StoreError, read};

/// Opens or, where it is missing, plans the file. Nothing in it changes before the first frame.
pub fn plan(path: &Path, localise_only: bool) -> Result<MapPlan, CliError> {
    let exists =
        path.try_exists().map_err(|e| CliError::new(exit_code::NO_INPUT, format!("{}: {e}", path.display())))?;
    if localise_only {
        if !exists {
            let message = format!("{}: there is no such file, and `--localise` needs a map", path.display());
            return Err(CliError::new(exit_code::NO_INPUT, message));
        }
        let saved = read(path).map_err(|e| error(&e))?.saved;
        if saved.maps.is_empty() {
            let message = format!("{}: there is no map in it to be located in", path.display());
            return Err(CliError::new(exit_code::DATA, message));
        }
        return Ok(MapPlan { path: path.into(), file: None, saved: Some(saved), localise_only });
    }
    if !exists {
        session::check_outputs([&Some(path.to_path_buf())])?;
        return Ok(MapPlan { path: path.into(), file: None, saved: None, localise_only });
    }
    let (file, contents) = MapFile::open(path).map_err(|e| error(&e))?;
    Ok(MapPlan { path: path.into(), file: Some(file), saved: Some(contents.saved), localise_only })
}

/// A map file that cannot be used.
pub fn error(error: &StoreError) -> CliError {
    let code = match &error.fault {
        fault if fault.is_in_the_data() => exit_code::BROKEN_MAP,
        Fault::Busy => exit_code::UNAVAILABLE,
        Fault::Read(_) => exit_code::NO_INPUT,
        _ => exit_code::CANNOT_CREATE,
    };
    CliError::new(code, error.to_string())
}
