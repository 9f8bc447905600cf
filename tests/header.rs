//! `clients/c/cairn.h` is what the sources say: made by cbindgen, compared, and its layout checked by a C and a C++ compiler.
//!
//! `CAIRN_WRITE=1 cargo test --test header` writes it anew.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

use cairn::messages::{self, Field};

const SOURCES: [&str; 7] = [
    "src/messages/mod.rs",
    "src/messages/pose.rs",
    "src/messages/map.rs",
    "src/messages/frame.rs",
    "src/messages/health.rs",
    "src/messages/command.rs",
    "src/client/c.rs",
];

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

/// Every type of the wire: name in C, size, name on the wire, fields.
fn types() -> Vec<(&'static str, usize, &'static str, &'static [Field])> {
    macro_rules! types {
        ($($type:ident $name:literal),+) => {
            vec![$(($name, size_of::<messages::$type>(), messages::$type::TYPE_NAME, messages::$type::FIELDS)),+]
        };
    }
    types!(
        Pose "cairn_pose", Health "cairn_health", StageHealth "cairn_stage_health", Landmark "cairn_landmark",
        MapHeader "cairn_map_header", Keyframe "cairn_keyframe", KeyframesHeader "cairn_keyframes_header",
        FrameHeader "cairn_frame_header", Command "cairn_command", CommandReply "cairn_command_reply"
    )
}

/// What cbindgen does not see: names on the wire, and the layout, which every compilation checks.
fn trailer() -> String {
    let mut text = String::from("/* Names that iceoryx2 compares when two processes meet. */\n");
    for (name, _, wire, _) in types() {
        writeln!(text, "#define {}_TYPE \"{wire}\"", name.to_uppercase()).expect("text");
    }
    text += "\n/* The layout, checked wherever this file is included. */\n";
    text += "#ifdef __cplusplus\n#define CAIRN_ASSERT(fact) static_assert(fact, #fact)\n#else\n";
    text += "#define CAIRN_ASSERT(fact) _Static_assert(fact, #fact)\n#endif\n";
    for (name, size, _, fields) in types() {
        writeln!(text, "CAIRN_ASSERT(sizeof({name}) == {size});").expect("text");
        for field in fields {
            let Field { name: member, offset, size } = field;
            writeln!(text, "CAIRN_ASSERT(offsetof({name}, {member}) == {offset} && sizeof((({name} *)0)->{member}) == {size});")
                .expect("text");
        }
    }
    text + "#undef CAIRN_ASSERT\n"
}

/// Rust's documentation links, as C's readers know the things.
fn plain(header: &str, names: &[(String, String)]) -> String {
    let mut out = String::new();
    for line in header.lines() {
        let comment = line.trim_start();
        if !comment.starts_with('*') && !comment.starts_with("/*") {
            out += line;
        } else {
            let mut rest = line;
            while let Some((before, from)) = rest.split_once("[`") {
                let Some((link, after)) = from.split_once("`]") else { break };
                // `super::Pose::map_id` is `cairn_pose.map_id`.
                let parts: Vec<&str> =
                    link.split("::").filter(|p| !["super", "crate", "messages", "error", "Self"].contains(p)).collect();
                let known = |part: &str| names.iter().find(|(from, _)| from == part).map(|(_, to)| to.clone());
                let constant = |p: &str| p.chars().all(|c| c.is_ascii_uppercase() || c == '_');
                let part = |p: &str| match known(p) {
                    Some(name) => name,
                    None if constant(p) => format!("CAIRN_{p}"),
                    None => p.into(),
                };
                let parts: Vec<String> = parts.into_iter().map(part).collect();
                out += before;
                out += &parts.join(".");
                rest = after;
            }
            out += rest;
        }
        out.push('\n');
    }
    out
}

fn generated() -> String {
    let mut config = cbindgen::Config::from_file(root().join("clients/c/cbindgen.toml")).expect("cbindgen.toml");
    config.trailer = Some(trailer());
    let mut names: Vec<_> = config.export.rename.iter().map(|(a, b)| (a.clone(), b.clone())).collect();
    names.sort();
    let mut builder = cbindgen::Builder::new().with_config(config);
    for source in SOURCES {
        builder = builder.with_src(root().join(source));
    }
    let mut bytes = Vec::new();
    builder.generate().expect("cbindgen").write(&mut bytes);
    plain(&String::from_utf8(bytes).expect("UTF-8"), &names)
}

#[test]
fn the_header_is_what_the_sources_say() {
    let path = root().join("clients/c/cairn.h");
    let want = generated();
    if std::env::var_os("CAIRN_WRITE").is_some() {
        std::fs::write(&path, &want).expect("cairn.h");
    }
    let have = std::fs::read_to_string(&path).unwrap_or_default();
    let different = have.lines().zip(want.lines()).position(|(a, b)| a != b);
    assert!(
        have == want,
        "{} differs from the sources at line {:?}: CAIRN_WRITE=1 cargo test --test header",
        path.display(),
        different.map(|line| line + 1)
    );
}

/// Compiles without linking; a missing compiler is told and forgiven.
fn compiles(compiler: &str, arguments: &[&str], source: &Path) {
    let output = Command::new(compiler)
        .args(["-Wall", "-Wextra", "-Wpedantic", "-Werror", "-fsyntax-only", "-I"])
        .arg(root().join("clients/c"))
        .args(arguments)
        .arg(source)
        .output();
    match output {
        Ok(output) => {
            let errors = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success(), "{compiler} {}: {errors}", source.display());
        }
        Err(e) => println!("skipped: {compiler} cannot be run: {e}"),
    }
}

#[test]
fn compilers_of_c_and_cpp_agree_with_the_layout() {
    let folder = root().join("clients/c");
    compiles("cc", &["-std=c11"], &folder.join("planner.c"));
    compiles("c++", &["-std=c++17"], &folder.join("planner.cpp"));
}
