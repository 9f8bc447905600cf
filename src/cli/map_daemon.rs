//! The maps of a running daemon, on the command line.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use super::endpoint_args::EndpointArgs;
use super::utc::date;
use super::{CliError, command, exit_code, map_file, session};
use crate::client::{Client, StoredMap};
use crate::places::store::{Contents, read};

/// A large map on a slow disk.
const PATIENCE: Duration = Duration::from_secs(30);

/// What a running daemon may be asked to do with its maps.
#[derive(Debug, Clone, clap::Subcommand)]
pub enum DaemonAction {
    /// List the maps that the running daemon can load
    List {
        /// Print the result as one JSON array
        #[arg(long)]
        json: bool,
    },
    /// Have the running daemon store its map now, and wait until it is on the disk
    Save {
        /// A copy under this name, which no map has yet [default: in the map's own file]
        name: Option<String>,
    },
    /// Have the running daemon go on in a stored map; the one before is stored first
    Load {
        /// Name of the map, as `cairn map list` shows it
        name: String,
    },
    /// Have the running daemon begin a new map; the one before is stored first
    New {
        /// The new map's name
        name: String,
    },
    /// Have the running daemon make a stored map a part of its own, as soon as a place of both is known; the stored one stays as it is
    Merge {
        /// Name of the map, as `cairn map list` shows it
        name: String,
    },
    /// Have the running daemon only locate frames in its map, which stays as it is, or let it grow again
    Localise {
        /// on or off
        switch: Switch,
    },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Switch {
    On,
    Off,
}

pub fn run(action: &DaemonAction, endpoint: &EndpointArgs) -> Result<ExitCode, CliError> {
    let client = Client::with_endpoint(endpoint.endpoint()?)?;
    let reply = match action {
        DaemonAction::List { json } => return list(&client, *json),
        DaemonAction::Save { name } => client.store_map(name.as_deref(), PATIENCE)?,
        DaemonAction::Load { name } => client.load_map(name, PATIENCE)?,
        DaemonAction::New { name } => client.new_map(name, PATIENCE)?,
        DaemonAction::Merge { name } => client.merge_map(name, PATIENCE)?,
        DaemonAction::Localise { switch } => client.localise_only(*switch == Switch::On, PATIENCE)?,
    };
    command::outcome(&reply)
}

fn list(client: &Client, as_json: bool) -> Result<ExitCode, CliError> {
    let maps = match client.all_maps(PATIENCE)? {
        Ok(maps) => maps,
        Err(refused) => return command::outcome(&refused),
    };
    let text = if as_json {
        let object = |m: &StoredMap| serde_json::json!({ "name": m.name, "bytes": m.bytes, "written_s": m.written_s, "current": m.is_current });
        session::json(&maps.iter().map(object).collect::<Vec<_>>())?
    } else if maps.is_empty() {
        "no maps yet\n".into()
    } else {
        let line = |m: &StoredMap| {
            let written = date(i64::try_from(m.written_s).unwrap_or(i64::MAX));
            let current = if m.is_current { ", the current one" } else { "" };
            format!("{}  {:.1} MB, written {written} (UTC){current}\n", m.name, m.bytes as f64 / 1e6)
        };
        maps.iter().map(line).collect()
    };
    session::print(&text)?;
    Ok(ExitCode::SUCCESS)
}

/// The map of a running daemon as it is now, and its file (or that of the copy, where it has none). `held`: only if that is its file.
pub fn present(endpoint: &EndpointArgs, held: Option<&Path>) -> Result<(PathBuf, Contents), CliError> {
    let reply = Client::with_endpoint(endpoint.endpoint()?)?.copy_map(PATIENCE)?;
    if !reply.is_ok() {
        return Err(CliError::new(exit_code::UNAVAILABLE, format!("the daemon answered: {}", reply.message())));
    }
    let (copy, own) = reply.message().split_once('\n').unwrap_or((reply.message(), ""));
    let (copy, own) = (PathBuf::from(copy), PathBuf::from(own));
    let contents = read(&copy);
    // It was made for us alone; the daemon removes what is left in some minutes.
    let _ = std::fs::remove_file(&copy);
    if let Some(held) = held
        && !is_same(held, &own)
    {
        let message = format!("daemon {} has another map, {}", endpoint.prefix, own.display());
        return Err(CliError::new(exit_code::UNAVAILABLE, message));
    }
    let contents = contents.map_err(|e| map_file::error(&e))?;
    Ok((if own.as_os_str().is_empty() { copy } else { own }, contents))
}

fn is_same(a: &Path, b: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let id = |path: &Path| std::fs::metadata(path).ok().map(|about| (about.dev(), about.ino()));
    id(a).is_some() && id(a) == id(b)
}
