//! A Zenoh session as rmw_zenoh opens it, and whom it reaches.

use std::path::Path;

use zenoh::{Config, Session, Wait};

use super::error::{BridgeError, reason};

/// rmw_zenoh's session where no file says otherwise: Zenoh's defaults, and these.
const DEFAULT: &str = r#"{
    mode: "peer",
    connect: { endpoints: ["tcp/localhost:7447"], timeout_ms: -1, exit_on_failure: false,
               retry: { period_init_ms: 1000, period_max_ms: 1000, period_increase_factor: 1 } },
    listen: { endpoints: ["tcp/localhost:0"] },
    scouting: { multicast: { enabled: false }, gossip: { enabled: true } },
    timestamping: { enabled: { router: true, peer: true, client: true } },
}"#;

fn configuration(file: Option<&Path>) -> Result<Config, BridgeError> {
    let Some(file) = file else {
        return Config::from_json5(DEFAULT).map_err(|e| BridgeError::Open { reason: reason(&e) });
    };
    let path = file.display().to_string();
    Config::from_file(file).map_err(|e| BridgeError::Configuration { path, reason: reason(&e) })
}

/// Endpoints as a sentence has them; lists for each mode stay as the file has them.
fn listed(endpoints: &str) -> String {
    serde_json::from_str::<Vec<String>>(endpoints).map_or_else(|_| endpoints.into(), |all| all.join(", "))
}

/// Opens a session by Zenoh's own configuration file, or rmw_zenoh's; it need not find anybody yet. With it, where it connects to.
pub fn open(file: Option<&Path>) -> Result<(Session, String), BridgeError> {
    let configuration = configuration(file)?;
    let endpoints = listed(&configuration.get_json("connect/endpoints").unwrap_or_default());
    let session = zenoh::open(configuration).wait().map_err(|e| BridgeError::Open { reason: reason(&e) })?;
    Ok((session, endpoints))
}

/// Whom a session reaches.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Link {
    Nobody,
    /// Other peers, directly, and no router.
    Peers,
    Router,
}

pub fn link(session: &Session) -> Link {
    let info = session.info();
    if info.routers_zid().wait().next().is_some() {
        Link::Router
    } else if info.peers_zid().wait().next().is_some() {
        Link::Peers
    } else {
        Link::Nobody
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_is_a_configuration_and_a_file_that_is_none_is_named() {
        let config = configuration(None).expect("configuration");
        assert_eq!(listed(&config.get_json("connect/endpoints").expect("endpoints")), "tcp/localhost:7447");
        assert_eq!(listed(r#"["tcp/a:1","tcp/b:2"]"#), "tcp/a:1, tcp/b:2");
        assert_eq!(listed(r#"{"peer":[]}"#), r#"{"peer":[]}"#);
        assert_eq!(config.get_json("mode").expect("mode"), r#""peer""#);
        let folder = tempfile::tempdir().expect("folder");
        let file = folder.path().join("zenoh.json5");
        std::fs::write(&file, "{ mode: \"boss\" }").expect("file");
        for file in [file, folder.path().join("none.json5")] {
            let text = configuration(Some(&file)).expect_err("none").to_string();
            assert!(text.starts_with(&file.display().to_string()) && !text.contains(".rs:"), "{text}");
        }
    }
}
