//! `systemctl reload cairn`: SIGHUP makes a running daemon read its configuration again.
//!
//! The log's level takes effect at once; for everything else the log says which keys have changed and need a restart. A file that
//! cannot be used changes nothing, and the reason is logged: the robot drives on with what it has.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use sd_notify::NotifyState;
use serde_json::Value;
use signal_hook::consts::SIGHUP;

use super::session::SessionArgs;
use super::{CliError, exit_code};
use crate::config::Config;
use crate::telemetry;

/// The key that takes effect at once.
const LIVE: &str = "log.level";
/// Keys that are named in one record at the most.
const MAX_NAMED: usize = 20;

/// Waits for SIGHUP, and knows what the daemon runs with.
#[derive(Debug)]
pub struct Reloader {
    hangup: Arc<AtomicBool>,
    args: SessionArgs,
    running: Config,
}

impl Reloader {
    /// From now on SIGHUP no longer ends the process.
    pub fn new(args: &SessionArgs, running: &Config) -> Result<Self, CliError> {
        let hangup = Arc::new(AtomicBool::new(false));
        signal_hook::flag::register(SIGHUP, hangup.clone())
            .map_err(|e| CliError::new(exit_code::FAILURE, format!("cannot handle signals: {e}")))?;
        Ok(Self { hangup, args: args.clone(), running: running.clone() })
    }

    /// Reloads if that was asked for; to be called now and then.
    pub fn turn(&mut self) {
        if !self.hangup.swap(false, Ordering::Relaxed) {
            return;
        }
        // The service manager waits for both; whether it listens is no concern of the reload's.
        let _ = NotifyState::monotonic_usec_now().map(|now| sd_notify::notify(&[NotifyState::Reloading, now]));
        match self.args.read().map_err(|e| e.message).and_then(|(config, _)| self.apply(config)) {
            Ok(later) => {
                tracing::info!(level = self.running.log.level, "configuration reloaded");
                if !later.is_empty() {
                    tracing::warn!(keys = list(&later), "changes need a restart of the daemon");
                }
            }
            Err(reason) => tracing::error!(reason, "configuration not reloaded, the old one stays"),
        }
        let _ = sd_notify::notify(&[NotifyState::Ready]);
    }

    /// Takes over what can be; the keys that cannot.
    fn apply(&mut self, new: Config) -> Result<Vec<String>, String> {
        let mut changed = differences(&self.running, &new)?;
        if changed.iter().any(|key| key == LIVE) {
            telemetry::set_level(&new.log)?;
            self.running.log.level = new.log.level;
            changed.retain(|key| key != LIVE);
        }
        Ok(changed)
    }
}

fn list(keys: &[String]) -> String {
    let more = keys.len().saturating_sub(MAX_NAMED);
    let named = keys.get(..MAX_NAMED.min(keys.len())).unwrap_or_default().join(", ");
    if more > 0 { format!("{named} and {more} more") } else { named }
}

/// Keys, dotted, whose values differ.
fn differences(old: &Config, new: &Config) -> Result<Vec<String>, String> {
    let flat = |config: &Config| {
        let mut keys = BTreeMap::new();
        let value = serde_json::to_value(config).map_err(|e| e.to_string())?;
        flatten("", value, &mut keys);
        Ok::<_, String>(keys)
    };
    let (old, new) = (flat(old)?, flat(new)?);
    let keys: std::collections::BTreeSet<&String> = old.keys().chain(new.keys()).collect();
    Ok(keys.into_iter().filter(|key| old.get(*key) != new.get(*key)).cloned().collect())
}

fn flatten(path: &str, value: Value, keys: &mut BTreeMap<String, Value>) {
    match value {
        // As deep as the configuration's own types.
        Value::Object(entries) => {
            for (key, value) in entries {
                let path = if path.is_empty() { key } else { format!("{path}.{key}") };
                flatten(&path, value, keys);
            }
        }
        value => drop(keys.insert(path.into(), value)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn reloader(file: &std::path::Path) -> Reloader {
        let args = SessionArgs { config: Some(file.into()), ..SessionArgs::default() };
        Reloader { hangup: Arc::default(), args, running: Config::default() }
    }

    #[test]
    fn keys_that_need_a_restart_are_named_and_the_running_values_stay() {
        let file = tempfile::NamedTempFile::new().expect("file");
        std::fs::write(file.path(), "[camera]\nwidth_px = 320\n[simulator.noise]\nread_sigma = 3.0\n")
            .expect("written");
        let mut reloader = reloader(file.path());
        let (config, _) = reloader.args.read().expect("valid");
        let later = reloader.apply(config).expect("applied");
        assert_eq!(later, ["camera.width_px", "simulator.noise.read_sigma"]);
        assert_eq!(reloader.running, Config::default());
        assert_eq!(list(&later), "camera.width_px, simulator.noise.read_sigma");
    }

    #[test]
    fn the_level_is_taken_over_at_once_and_a_broken_file_changes_nothing() {
        let file = tempfile::NamedTempFile::new().expect("file");
        let mut reloader = reloader(file.path());
        let _ = telemetry::init(&reloader.running.log);
        std::fs::write(file.path(), "[log]\nlevel = \"warn\"\n").expect("written");
        reloader.hangup.store(true, Ordering::Relaxed);
        reloader.turn();
        assert_eq!(reloader.running.log.level, "warn");
        std::fs::write(file.path(), "[log]\nlevel = \"loud\"\n").expect("written");
        reloader.hangup.store(true, Ordering::Relaxed);
        reloader.turn();
        assert_eq!(reloader.running.log.level, "warn");
        assert!(!reloader.hangup.load(Ordering::Relaxed));
    }

    #[test]
    fn a_long_list_of_keys_is_cut() {
        let keys: Vec<String> = (0..23).map(|i| format!("k{i}")).collect();
        assert!(list(&keys).ends_with("k19 and 3 more"), "{}", list(&keys));
    }
}
