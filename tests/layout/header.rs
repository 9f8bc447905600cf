//! `clients/c/cairn.h` is what the sources say: made by cbindgen, compared, and its layout checked by a C and a C++ compiler.
//!

use std::fmt::Write;
use std::path::Path;
use std::process::Command;

use cairn::messages::Field;

use crate::support::{compare, plain, renames, root, types};

const SOURCES: [&str; 16] = [
    "src/messages/mod.rs",
    "src/messages/pose.rs",
    "src/messages/map.rs",
    "src/messages/graph.rs",
    "src/messages/frame.rs",
    "src/messages/encoded.rs",
    "src/messages/health.rs",
    "src/messages/command.rs",
    "src/messages/wheel.rs",
    "src/messages/obstacles.rs",
    "src/messages/tags.rs",
    "src/client/c.rs",
    "src/client/c/graph.rs",
    "src/client/c/wheels.rs",
    "src/client/c/obstacles.rs",
    "src/client/c/tags.rs",
];

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
            writeln!(
                text,
                "CAIRN_ASSERT(offsetof({name}, {member}) == {offset} && sizeof((({name} *)0)->{member}) == {size});"
            )
            .expect("text");
        }
    }
    text + "#undef CAIRN_ASSERT\n"
}

fn generated() -> String {
    let mut config = cbindgen::Config::from_file(root().join("clients/c/cbindgen.toml")).expect("cbindgen.toml");
    config.trailer = Some(trailer());
    let mut builder = cbindgen::Builder::new().with_config(config);
    for source in SOURCES {
        builder = builder.with_src(root().join(source));
    }
    let mut bytes = Vec::new();
    builder.generate().expect("cbindgen").write(&mut bytes);
    plain(&String::from_utf8(bytes).expect("UTF-8"), &renames(), "CAIRN_")
}

#[test]
fn the_header_is_what_the_sources_say() {
    compare("clients/c/cairn.h", &generated());
}

#[test]
fn no_two_constants_share_a_name_because_cbindgen_would_drop_one() {
    let mut names = Vec::new();
    for source in SOURCES.iter().chain(&["src/messages/services.rs"]) {
        let text = std::fs::read_to_string(root().join(source)).expect("source");
        let constants = text.lines().filter_map(|line| line.trim_start().strip_prefix("pub const "));
        // Strings and lists have no macro.
        let plain = constants.filter_map(|c| c.split_once(": ")).filter(|(_, rest)| !rest.starts_with(['&', '[', 'Q']));
        names.extend(plain.map(|(name, _)| name.to_owned()));
    }
    let all = names.len();
    names.sort();
    names.dedup();
    assert!(all > 40 && names.len() == all, "{all} constants, {} names", names.len());
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
    compiles("cc", &["-std=c11"], &folder.join("wheels.c"));
    compiles("c++", &["-std=c++17"], &folder.join("planner.cpp"));
}
