//! The house's invariants as a test: which room may know which, and what no room may do.
//!
//! The sources are read as text: comments, strings and test modules are blanked, then every `crate::room` is an edge.
//! A new edge is not wrong because it is new; it is added here, with a look at the invariants in `src/lib.rs`.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

/// What each room may know. A room that is missing here fails the test.
const MAY_KNOW: &[(&str, &[&str])] = &[
    // Pure: nothing of ours at all.
    ("frame", &[]),
    ("geometry", &[]),
    ("ring", &[]),
    ("telemetry", &[]),
    ("atomic_file", &[]),
    // The wire: builds alone, for planners.
    ("messages", &[]),
    ("client", &["messages"]),
    // Pictures and where they come from.
    ("image", &["frame"]),
    ("calibration", &["atomic_file", "features", "geometry", "image"]),
    ("camera", &["atomic_file", "calibration", "frame", "geometry", "image", "trajectory"]),
    // From pictures to a map. Features know no map, the map knows no reconstruction but for what it shows, and none of
    // them knows a camera, the ring or the wire.
    ("features", &["frame", "geometry", "image"]),
    ("map", &["atomic_file", "features", "geometry", "image", "reconstruction"]),
    ("reconstruction", &["features", "geometry", "image", "map"]),
    // What comes out.
    ("trajectory", &["atomic_file", "geometry", "map", "reconstruction"]),
    ("evaluation", &["atomic_file", "geometry", "plot", "trajectory"]),
    ("plot", &["atomic_file", "evaluation", "geometry", "image", "map", "reconstruction", "trajectory"]),
    ("publish", &["frame", "geometry", "image", "map", "messages", "reconstruction"]),
    // What holds it together.
    ("config", &["camera", "features", "geometry", "publish", "reconstruction", "telemetry"]),
    (
        "daemon",
        &[
            "camera",
            "config",
            "features",
            "frame",
            "geometry",
            "image",
            "map",
            "messages",
            "plot",
            "publish",
            "reconstruction",
            "ring",
            "telemetry",
            "trajectory",
        ],
    ),
    (
        "cli",
        &[
            "atomic_file",
            "calibration",
            "camera",
            "client",
            "config",
            "daemon",
            "evaluation",
            "features",
            "frame",
            "geometry",
            "image",
            "map",
            "messages",
            "plot",
            "publish",
            "reconstruction",
            "telemetry",
            "trajectory",
        ],
    ),
];

/// One source file, with comments, strings and tests blanked; line numbers are those of the file.
struct Source {
    room: String,
    path: PathBuf,
    code: String,
    /// The file as it is.
    text: String,
}

fn sources() -> Vec<Source> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    collect(&root, &mut files);
    files.sort();
    assert!(files.len() > 30, "only {} files found below {}", files.len(), root.display());
    files
        .into_iter()
        .filter_map(|path| {
            let inside = path.strip_prefix(&root).expect("below src").to_path_buf();
            let name = inside.file_name()?.to_str()?.to_owned();
            let is_test =
                name == "tests.rs" || name.ends_with("_tests.rs") || inside.iter().any(|part| part == "tests");
            let room = inside.iter().next()?.to_str()?.trim_end_matches(".rs").to_owned();
            if is_test || room == "lib" || room == "main" {
                return None;
            }
            let text = fs::read_to_string(&path).expect("source");
            Some(Source { room, path: inside, code: without_tests(&blanked(&text)), text })
        })
        .collect()
}

fn collect(folder: &Path, out: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).expect("folder") {
        let path = entry.expect("entry").path();
        if path.is_dir() {
            collect(&path, out);
        } else if path.extension().is_some_and(|e| e == "rs") {
            out.push(path);
        }
    }
}

/// Comments, string and character literals replaced by blanks, lines kept.
fn blanked(text: &str) -> String {
    let bytes = text.as_bytes();
    let mut out = Vec::with_capacity(bytes.len());
    let mut i = 0;
    let starts = |i: usize, what: &str| bytes[i..].starts_with(what.as_bytes());
    // Copies a stretch as blanks.
    let blank = |out: &mut Vec<u8>, from: usize, to: usize| {
        out.extend(bytes[from..to.min(bytes.len())].iter().map(|b| if *b == b'\n' { b'\n' } else { b' ' }));
    };
    while i < bytes.len() {
        let end = if starts(i, "//") {
            i + bytes[i..].iter().position(|b| *b == b'\n').unwrap_or(bytes.len() - i)
        } else if starts(i, "/*") {
            text[i..].find("*/").map_or(bytes.len(), |n| i + n + 2)
        } else if starts(i, "r#\"") {
            text[i..].find("\"#").map_or(bytes.len(), |n| i + n + 2)
        } else if bytes[i] == b'"' {
            let mut j = i + 1;
            while j < bytes.len() && bytes[j] != b'"' {
                j += if bytes[j] == b'\\' { 2 } else { 1 };
            }
            j + 1
        } else if starts(i, "'\"'") || starts(i, "'{'") || starts(i, "'}'") {
            i + 3
        } else {
            out.push(bytes[i]);
            i += 1;
            continue;
        };
        blank(&mut out, i, end);
        i = end;
    }
    String::from_utf8_lossy(&out).into_owned()
}

/// `#[cfg(test)] mod name { ... }` cut out.
fn without_tests(code: &str) -> String {
    let mut out = String::new();
    let mut rest = code;
    while let Some(at) = rest.find("#[cfg(test)]") {
        let (before, from) = rest.split_at(at);
        out += before;
        let brace = from.find('{');
        let semicolon = from.find(';');
        let end = match (brace, semicolon) {
            (Some(brace), semicolon) if semicolon.is_none_or(|s| brace < s) => closing(from, brace),
            (_, Some(semicolon)) => semicolon + 1,
            _ => from.len(),
        };
        out.extend(from[..end].chars().filter(|c| *c == '\n'));
        rest = &from[end..];
    }
    out + rest
}

/// Index after the brace that closes the one at `open`.
fn closing(code: &str, open: usize) -> usize {
    let mut depth = 0;
    for (i, c) in code[open..].char_indices() {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            _ => {}
        }
        if depth == 0 {
            return open + i + 1;
        }
    }
    code.len()
}

/// Rooms named after `crate::`, those of a group `crate::{a, b::c}` included.
fn rooms_named(code: &str) -> BTreeSet<String> {
    let mut rooms = BTreeSet::new();
    let word = |text: &str| text.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect::<String>();
    for (at, found) in code.match_indices("crate::") {
        let after = &code[at + found.len()..];
        if after.starts_with('{') {
            let group = &after[1..closing(after, 0).max(2) - 1];
            let mut depth = 0;
            let mut begin = true;
            for (i, c) in group.char_indices() {
                match c {
                    '{' => depth += 1,
                    '}' => depth -= 1,
                    ',' if depth == 0 => begin = true,
                    c if begin && !c.is_whitespace() => {
                        rooms.insert(word(&group[i..]));
                        begin = false;
                    }
                    _ => {}
                }
            }
        } else {
            rooms.insert(word(after));
        }
    }
    rooms
}

/// All places in the code of `rooms` (of every room, if empty) where one of `words` stands.
fn places(rooms: &[&str], words: &[&str]) -> Vec<String> {
    let mut found = Vec::new();
    for source in sources().iter().filter(|s| rooms.is_empty() || rooms.contains(&s.room.as_str())) {
        for (number, line) in source.code.lines().enumerate() {
            if let Some(word) = words.iter().find(|word| line.contains(**word)) {
                found.push(format!("{}:{}: {word}", source.path.display(), number + 1));
            }
        }
    }
    found
}

#[test]
fn rooms_know_only_what_they_may() {
    let allowed: BTreeMap<&str, &[&str]> = MAY_KNOW.iter().copied().collect();
    let mut wrong = Vec::new();
    for source in sources() {
        let Some(may) = allowed.get(source.room.as_str()) else {
            wrong.push(format!("{}: room `{}` is not in this test's list", source.path.display(), source.room));
            continue;
        };
        for room in rooms_named(&source.code) {
            // A name that is no room is an item of the crate's root, such as a macro.
            let is_room = allowed.contains_key(room.as_str());
            if is_room && room != source.room && !may.contains(&room.as_str()) {
                wrong.push(format!("{}: `{}` may not know `{room}`", source.path.display(), source.room));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn only_the_daemon_starts_threads() {
    let found = places(&[], &["thread::spawn", "thread::Builder", "thread::scope", "rayon::"]);
    let wrong: Vec<_> = found.iter().filter(|place| !place.starts_with("daemon")).collect();
    assert!(wrong.is_empty(), "{wrong:#?}");
    assert!(!found.is_empty(), "the daemon's own threads were not found: the test looks for the wrong thing");
}

#[test]
fn nothing_opens_a_network_socket() {
    let words = ["std::net", "TcpListener", "TcpStream", "UdpSocket", "AF_INET", "libc::socket", "tokio", "hyper"];
    assert_eq!(places(&[], &words), Vec::<String>::new());
}

#[test]
fn geometry_is_pure() {
    let words = ["std::fs", "std::io", "std::thread", "std::time", "std::env", "tracing", "monotonic_ns", "println!"];
    assert_eq!(places(&["geometry"], &words), Vec::<String>::new());
}

#[test]
fn nothing_on_the_path_depends_on_a_clock_or_on_hash_order() {
    let rooms = ["geometry", "features", "map", "reconstruction"];
    let words = ["HashMap", "HashSet", "Instant::now", "SystemTime", "thread_rng", "from_entropy", "rand::random"];
    assert_eq!(places(&rooms, &words), Vec::<String>::new());
}

#[test]
fn unsafe_code_stands_where_it_may_and_argues_its_case() {
    // Ring, the camera's driver, SIMD kernels, what iceoryx2's derives need; and two system calls that the standard library
    // has no name for: reading CLOCK_MONOTONIC, and what the kernel counted for a child.
    let may = ["ring/", "camera/v4l2", "image/", "features/", "messages/", "frame.rs", "evaluation/child.rs"];
    let mut wrong = Vec::new();
    for source in sources() {
        let path = source.path.display().to_string();
        let lines: Vec<&str> = source.text.lines().collect();
        for (number, line) in source.code.lines().enumerate() {
            let is_unsafe = line.split(|c: char| !c.is_alphanumeric() && c != '_').any(|word| word == "unsafe");
            if !is_unsafe || line.contains("UnsafeCell") || line.contains("unsafe_code") {
                continue;
            }
            let argued =
                lines[number.saturating_sub(6)..=number].iter().any(|l| l.contains("SAFETY") || l.contains("# Safety"));
            if !may.iter().any(|room| path.starts_with(room)) {
                wrong.push(format!("{path}:{}: unsafe code here", number + 1));
            } else if !argued {
                wrong.push(format!("{path}:{}: no SAFETY sentence", number + 1));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn the_blanking_sees_code_and_nothing_else() {
    let text = "use crate::{a, b::{c, d}};\n// crate::comment\nlet s = \"crate::string \\\" \";\ncrate::e::f();\n\
                #[cfg(test)]\nmod tests { use crate::test_only; fn x() { if true {} } }\ncrate::g;\n";
    let code = without_tests(&blanked(text));
    assert_eq!(rooms_named(&code).into_iter().collect::<Vec<_>>(), ["a", "b", "e", "g"]);
    assert_eq!(code.lines().count(), text.lines().count());
}
