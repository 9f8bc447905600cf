//! What a distribution installs: that its parts name the same paths, users and folders, and how little the service may do.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::Command;

fn text(path: &str) -> String {
    fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// Values of a key of the daemon's unit.
fn unit(key: &str) -> Vec<String> {
    unit_of("cairn", key)
}

fn unit_of(name: &str, key: &str) -> Vec<String> {
    let text = text(&format!("systemd/{name}.service"));
    let lines = text.lines().filter_map(|line| line.strip_prefix(key)?.strip_prefix('='));
    lines.map(str::to_owned).collect()
}

fn metadata() -> toml::Table {
    let manifest: toml::Table = text("Cargo.toml").parse().expect("Cargo.toml");
    let deb = &manifest["package"]["metadata"]["deb"];
    deb.as_table().expect("metadata").clone()
}

/// Source and destination of what a package installs.
fn assets() -> Vec<(String, String)> {
    assets_of(&metadata())
}

fn assets_of(metadata: &toml::Table) -> Vec<(String, String)> {
    let assets = metadata["assets"].as_array().expect("assets").iter();
    let word = |asset: &toml::Value, key: &str| asset[key].as_str().expect("text").to_owned();
    assets.map(|asset| (word(asset, "source"), word(asset, "dest"))).collect()
}

#[test]
fn the_unit_starts_the_binary_that_the_package_installs() {
    let (_, folder) = assets().into_iter().find(|(source, _)| source == "target/release/cairn").expect("binary");
    assert_eq!(unit("ExecStart"), [format!("/{folder}cairn run")]);
    assert!(unit("ExecReload")[0].contains("-HUP"));
}

#[test]
fn every_file_of_the_package_exists_and_the_configuration_is_kept_on_upgrades() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    for (source, _) in assets().iter().filter(|(source, _)| !source.starts_with("target/")) {
        let path = root.join(source.trim_end_matches('*'));
        assert!(path.exists(), "{source}");
    }
    let metadata = metadata();
    let kept: Vec<_> =
        metadata["conf-files"].as_array().expect("conf-files").iter().filter_map(|f| f.as_str()).collect();
    assert_eq!(kept, ["/etc/cairn/cairn.toml"]);
    assert!(assets().contains(&("config/cairn.toml".into(), "etc/cairn/cairn.toml".into())));
    // What the package brings is where calibrations are looked for.
    let brought = assets().iter().any(|(_, to)| to == "usr/share/cairn/cameras/");
    assert!(brought && cairn::calibration::store::search_folders().contains(&"/usr/share/cairn/cameras".into()));
}

#[test]
fn the_tools_lie_beside_the_robots_package_and_share_no_file_with_it() {
    let metadata = metadata();
    assert_eq!(metadata["features"].as_array().expect("features")[0].as_str(), Some("robot"));
    assert_eq!(metadata["default-features"].as_bool(), Some(false));
    let tools = metadata["variants"]["tools"].as_table().expect("variant");
    assert_eq!((tools["name"].as_str(), metadata["name"].as_str()), (Some("cairn-tools"), Some("cairn")));
    // Conffiles, units and scripts are inherited unless they are named.
    assert_eq!(tools["conf-files"].to_string(), "[]");
    assert_eq!(tools["systemd-units"]["unit-name"].as_str(), Some("cairn-console"));
    let scripts = Path::new(env!("CARGO_MANIFEST_DIR")).join(tools["maintainer-scripts"].as_str().expect("scripts"));
    for name in ["preinst", "postinst", "prerm", "postrm", "config", "templates"] {
        assert!(!scripts.join(name).exists(), "{name} of the package cairn would be the tools', too");
    }
    let tools = assets_of(tools);
    assert!(tools.contains(&("target/release/cairn".into(), "usr/bin/cairn-tools".into())), "{tools:?}");
    for (source, to) in tools {
        assert!(!assets().iter().any(|(_, other)| *other == to), "{to} is in both packages");
        assert!(
            source.starts_with("target/") || Path::new(env!("CARGO_MANIFEST_DIR")).join(&source).exists(),
            "{source}"
        );
    }
}

/// Names of the crates that a build consists of.
fn crates(options: &[&str]) -> BTreeSet<String> {
    let output = Command::new(env!("CARGO"))
        .args(["tree", "--locked", "--offline", "--edges", "normal", "--prefix", "none", "--format", "{p}"])
        .args(options)
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .expect("cargo tree");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).expect("text");
    text.lines().filter_map(|line| line.split(' ').next()).map(str::to_owned).collect()
}

#[test]
fn the_robots_build_consists_of_what_a_robot_uses() {
    let robot = crates(&["--no-default-features", "--features", "robot"]);
    let tools = crates(&[]);
    let client = crates(&["--no-default-features", "--features", "client"]);
    let only_tools: Vec<&str> = tools.difference(&robot).map(String::as_str).collect();
    for name in ["tiny-skia", "tiny-skia-path", "ab_glyph", "ttf-parser", "dejavu", "tungstenite", "jpeg-encoder"] {
        assert!(only_tools.contains(&name), "{name} is not among what the tools alone bring: {only_tools:?}");
    }
    assert!(robot.is_superset(&client) && tools.is_superset(&robot), "a build lacks what a smaller one has");
    for name in ["v4l", "iceoryx2", "sd-notify", "roxmltree"] {
        assert!(robot.contains(name), "{name}");
    }
    // What doubles a build is in none that nobody asked for it.
    assert!(tools.iter().all(|name| !name.starts_with("zenoh") && name != "tokio"), "{tools:?}");
}

#[test]
fn user_folder_and_state_are_the_same_everywhere() {
    assert_eq!((unit("User"), unit("Group")), (vec!["cairn".into()], vec!["cairn".into()]));
    assert_eq!(unit("StateDirectory"), ["cairn"]);
    let users = text("systemd/cairn.sysusers");
    assert!(users.lines().any(|l| l.starts_with("u cairn ") && l.ends_with("/var/lib/cairn")), "{users}");
    assert!(users.lines().any(|l| l == "m cairn video"), "{users}");
    assert_eq!(unit("SupplementaryGroups"), ["video"]);
    // iceoryx2's folder: made for the user alone, bound into the unit, never aged.
    let root = cairn::messages::Endpoint::default().root();
    let root = root.to_str().expect("text").trim_end_matches('/').to_owned();
    assert_eq!(unit("BindPaths"), std::slice::from_ref(&root));
    let folders = text("systemd/cairn.tmpfiles");
    for line in [format!("d {root} 0750 cairn cairn -"), format!("x {root}"), format!("x {root}/*")] {
        assert!(folders.lines().any(|l| l == line), "{line} is not in {folders}");
    }
}

#[test]
fn the_console_runs_as_the_daemons_user_from_the_tools_and_serves_this_machine_only() {
    let metadata = metadata();
    let variant = metadata["variants"]["tools"].as_table().expect("variant");
    let tools = assets_of(variant);
    let unit = |key: &str| unit_of("cairn-console", key);
    let brought = |to: &str| tools.iter().any(|(_, there)| there == to);
    assert!(brought("usr/bin/cairn-tools"));
    // Installed as it is, off, and restarted by an upgrade where it runs.
    let units = &variant["systemd-units"];
    assert_eq!(units["unit-scripts"].as_str(), Some("systemd/"));
    let is = |key: &str| units[key].as_bool();
    assert_eq!((is("enable"), is("start"), is("restart-after-upgrade")), (Some(false), Some(false), Some(true)));
    assert_eq!(unit("ExecStart"), ["/usr/bin/cairn-tools console"]);
    for key in ["User", "Group", "BindPaths", "ReadWritePaths", "RemoveIPC"] {
        assert_eq!(unit(key), unit_of("cairn", key), "{key}");
    }
    assert_eq!((unit("IPAddressDeny"), unit("IPAddressAllow")), (vec!["any".into()], vec!["localhost".into()]));
    let documentation = unit("Documentation");
    assert!(brought(documentation[0].trim_start_matches("file:///")), "{documentation:?}");
}

#[test]
fn the_bridge_runs_as_the_daemons_user_from_a_package_of_its_own_and_is_off() {
    let metadata = metadata();
    let variant = metadata["variants"]["bridge"].as_table().expect("variant");
    assert_eq!((variant["name"].as_str(), variant["conf-files"].to_string().as_str()), (Some("cairn-bridge"), "[]"));
    assert_eq!(variant["features"].to_string(), r#"["bridge"]"#);
    let others = [assets(), assets_of(metadata["variants"]["tools"].as_table().expect("variant"))].concat();
    let bridge = assets_of(variant);
    for (source, to) in &bridge {
        assert!(!others.iter().any(|(_, other)| other == to), "{to} is in two packages");
        let is_there = Path::new(env!("CARGO_MANIFEST_DIR")).join(source).exists();
        assert!(source.starts_with("target/") || is_there, "{source}");
    }
    let unit = |key: &str| unit_of("cairn-bridge", key);
    let brought = |to: &str| bridge.iter().any(|(_, there)| there == to);
    assert!(brought("usr/bin/cairn-bridge"));
    assert_eq!(unit("ExecStart"), ["/usr/bin/cairn-bridge bridge"]);
    let units = &variant["systemd-units"];
    let is = |key: &str| units[key].as_bool();
    assert_eq!(
        (units["unit-name"].as_str(), is("enable"), is("start")),
        (Some("cairn-bridge"), Some(false), Some(false))
    );
    for key in ["User", "Group", "BindPaths", "RemoveIPC"] {
        assert_eq!(unit(key), unit_of("cairn", key), "{key}");
    }
    // Beside the daemon's shared memory it writes the copies alone that the daemon made for it, in a folder that systemd makes if need be;
    // and the folders above, which the daemon writes, too, are the package cairn's.
    assert_eq!(unit("ReadWritePaths"), unit_of("cairn", "ReadWritePaths"));
    assert_eq!(unit("StateDirectory"), ["cairn/maps/copies"]);
    assert_eq!(unit("StateDirectoryMode"), unit_of("cairn", "StateDirectoryMode"));
    assert_eq!(unit("Environment"), ["STATE_DIRECTORY=/var/lib/cairn"]);
    for above in ["/var/lib/cairn", "/var/lib/cairn/maps"] {
        let line = format!("d {above} {} cairn cairn -", unit_of("cairn", "StateDirectoryMode")[0]);
        assert!(text("systemd/cairn.tmpfiles").lines().any(|l| l == line), "{line}");
    }
    assert_eq!((unit("IPAddressDeny"), unit("IPAddressAllow")), (vec!["any".into()], vec!["localhost".into()]));
    let documentation = unit("Documentation");
    assert!(brought(documentation[0].trim_start_matches("file:///")), "{documentation:?}");
}

#[test]
fn the_services_expose_little_and_every_relaxation_is_explained() {
    // Of 10: the daemon has no network, the console and the bridge do.
    exposes_little("cairn", 2.0);
    exposes_little("cairn-console", 2.5);
    exposes_little("cairn-bridge", 2.5);
}

fn exposes_little(name: &str, limit: f64) {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("systemd/{name}.service"));
    let Ok(output) = Command::new("systemd-analyze").args(["security", "--offline=true"]).arg(&file).output() else {
        println!("skipped: no systemd-analyze here");
        return;
    };
    let report = String::from_utf8_lossy(&output.stdout);
    let Some(level) = report.lines().find_map(|l| l.split(&format!("exposure level for {name}.service: ")).nth(1))
    else {
        // Before systemd 250 there is no --offline.
        println!("skipped: systemd-analyze says nothing: {}", String::from_utf8_lossy(&output.stderr));
        return;
    };
    let level: f64 = level.split_whitespace().next().and_then(|n| n.parse().ok()).expect("a number");
    assert!(level < limit, "{name}: exposure {level}\n{report}");
    // What the report marks as open is written about in a comment of the unit, or set on purpose.
    let unit = text(&format!("systemd/{name}.service"));
    let comments: String = unit.lines().filter(|l| l.starts_with('#')).collect();
    for line in report.lines().filter(|l| l.starts_with('✗')) {
        let name = line.trim_start_matches('✗').trim().split(['=', '/', ' ']).next().unwrap_or("");
        let explained = comments.contains(name) || unit.lines().any(|l| l.starts_with(&format!("{name}=")));
        assert!(explained, "{name} is open and the unit does not say why: {line}");
    }
}
