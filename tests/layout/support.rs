//! The wire's types, and files that are made.

use std::path::PathBuf;

use cairn::messages::{self, Field};

pub fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// Every type of the wire: name in C, size, name on the wire, fields.
pub fn types() -> Vec<(&'static str, usize, &'static str, &'static [Field])> {
    macro_rules! types {
        ($($type:ident $name:literal),+) => {
            vec![$(($name, size_of::<messages::$type>(), messages::$type::TYPE_NAME, messages::$type::FIELDS)),+]
        };
    }
    types!(
        Pose "cairn_pose", Health "cairn_health", StageHealth "cairn_stage_health", Landmark "cairn_landmark",
        MapHeader "cairn_map_header", Keyframe "cairn_keyframe", KeyframesHeader "cairn_keyframes_header",
        GraphEdge "cairn_graph_edge", GraphHeader "cairn_graph_header",
        FrameHeader "cairn_frame_header", EncodedHeader "cairn_encoded_header", Feature "cairn_feature", FeaturesHeader "cairn_features_header",
        Command "cairn_command", CommandReply "cairn_command_reply", WheelOdometry "cairn_wheel_odometry", Obstacles "cairn_obstacles",
        Tag "cairn_tag", Tags "cairn_tags"
    )
}

/// Names in Rust and in C.
pub fn renames() -> Vec<(String, String)> {
    let config = cbindgen::Config::from_file(root().join("clients/c/cbindgen.toml")).expect("cbindgen.toml");
    config.export.rename.into_iter().collect()
}

/// Rust's documentation links as other readers know the things: `super::Pose::map_id` becomes `cairn_pose.map_id`.
pub fn plain(text: &str, names: &[(String, String)], constants: &str) -> String {
    let mut out = String::new();
    let mut rest = text;
    while let Some((before, from)) = rest.split_once("[`") {
        let Some((link, after)) = from.split_once("`]") else { break };
        let path = link.split("::").filter(|p| !["super", "crate", "messages", "error", "Self"].contains(p));
        let constant = |p: &str| p.chars().all(|c| c.is_ascii_uppercase() || c == '_');
        let part = |p: &str| match names.iter().find(|(from, _)| from == p) {
            Some((_, name)) => name.clone(),
            None if constant(p) => format!("{constants}{p}"),
            None => p.into(),
        };
        let parts: Vec<String> = path.map(part).collect();
        out += before;
        // What a module is called says enough.
        out += &if parts.is_empty() { link.rsplit("::").next().unwrap_or(link).to_owned() } else { parts.join(".") };
        rest = after;
    }
    out + rest
}

/// A file of the repository that is made; with CAIRN_WRITE it is written.
#[track_caller]
pub fn compare(file: &str, want: &str) {
    let path = root().join(file);
    if std::env::var_os("CAIRN_WRITE").is_some() {
        std::fs::write(&path, want).expect("written");
    }
    let have = std::fs::read_to_string(&path).unwrap_or_default();
    let line = have.lines().zip(want.lines()).position(|(a, b)| a != b).map(|line| line + 1);
    assert!(have == want, "{file} differs from the sources at line {line:?}: CAIRN_WRITE=1 cargo test --test layout");
}
