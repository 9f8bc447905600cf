//! The house's invariants as a test: which room may know which, that none is known by what it knows, and what no room may do.
//!
//! The sources are read as text (`sources`), and the names in them make edges between files (`graph`, with the rule).
//! A new edge is not wrong because it is new; it is added here, with a look at the invariants in `src/lib.rs`.

mod graph;
mod sources;

use std::collections::{BTreeMap, BTreeSet};

use graph::{Graph, circle, graph};
use sources::{blanked, sources, without_tests};

/// What each room may know, and does. A room that is missing here fails the test.
const MAY_KNOW: &[(&str, &[&str])] = &[
    // Pure: nothing of ours at all.
    ("frame", &[]),
    ("geometry", &[]),
    ("ring", &[]),
    ("ros", &[]),
    ("telemetry", &[]),
    ("atomic_file", &[]),
    // The wire: builds alone, for planners.
    ("messages", &[]),
    ("client", &["messages"]),
    // Pictures and where they come from.
    ("image", &["frame"]),
    ("calibration", &["atomic_file", "geometry", "image"]),
    ("camera", &["calibration", "frame", "geometry", "image", "motion", "ros", "trajectory"]),
    // From pictures to a map. Features know no map, the map knows no reconstruction, and none of them knows a camera, the
    // ring or the wire.
    ("features", &["frame", "geometry", "image"]),
    ("map", &["atomic_file", "features", "geometry", "image"]),
    // What the robot knows besides the picture says how long a map unit is.
    ("motion", &["calibration", "features", "geometry", "image", "map", "telemetry"]),
    // Places and maps on disk, whose library's panics are kept from the log.
    ("places", &["atomic_file", "features", "geometry", "image", "map", "telemetry"]),
    ("reconstruction", &["features", "geometry", "image", "map", "motion", "places"]),
    // What comes out.
    ("trajectory", &["atomic_file", "geometry", "map", "reconstruction"]),
    (
        "evaluation",
        &["atomic_file", "camera", "features", "frame", "geometry", "image", "map", "reconstruction", "trajectory"],
    ),
    ("plot", &["atomic_file", "image", "map", "trajectory"]),
    ("publish", &["frame", "geometry", "image", "map", "messages", "motion", "reconstruction"]),
    // The web console: a process of its own, a subscriber like any planner. What it says of faults it is given.
    ("console", &["client", "messages", "telemetry"]),
    // Recorder and bridge are processes of their own, and subscribers like any other.
    ("share", &["client", "messages", "ros"]),
    // The method on two pictures: what `features` and `geometry` can do, on files, outside the daemon. Nobody but `cli` knows it.
    ("workbench", &["atomic_file", "calibration", "camera", "features", "frame", "geometry", "image", "trajectory"]),
    // What holds it together.
    ("config", &["camera", "features", "geometry", "motion", "publish", "reconstruction", "telemetry"]),
    (
        "daemon",
        &[
            // A calibration that is handed in is kept where the camera's is looked for.
            "calibration",
            "camera",
            "config",
            "features",
            "frame",
            "geometry",
            "image",
            "map",
            "messages",
            "motion",
            "places",
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
            "console",
            "daemon",
            "evaluation",
            "features",
            "frame",
            "geometry",
            "image",
            "map",
            "messages",
            "motion",
            "places",
            "plot",
            "publish",
            "reconstruction",
            "share",
            "telemetry",
            "trajectory",
            "workbench",
        ],
    ),
];

/// Edges between rooms only.
fn between_rooms(graph: &Graph) -> Graph {
    let room = |module: &str| module.split("::").next().unwrap_or_default().to_owned();
    let mut rooms = Graph::new();
    for (here, edges) in graph.iter().filter(|(here, _)| !here.is_empty()) {
        let known = rooms.entry(room(here)).or_default();
        for (there, names) in edges.iter().filter(|(there, _)| !there.is_empty() && room(there) != room(here)) {
            known.entry(room(there)).or_default().extend(names.iter().map(|name| format!("{name} ({here})")));
        }
    }
    rooms
}

/// All places in the code of `rooms` (of every room, if empty) where one of `words` stands.
fn places(rooms: &[&str], words: &[&str]) -> Vec<String> {
    let mut found = Vec::new();
    for source in sources().iter().filter(|s| rooms.is_empty() || rooms.contains(&s.room())) {
        for (number, line) in source.code.lines().enumerate() {
            if let Some(word) = words.iter().find(|word| line.contains(**word)) {
                found.push(format!("{}:{}: {word}", source.path.display(), number + 1));
            }
        }
    }
    found
}

#[test]
fn rooms_know_what_they_may_and_nothing_is_allowed_without_need() {
    let rooms = between_rooms(&graph(&sources()));
    let allowed: BTreeMap<&str, BTreeSet<&str>> =
        MAY_KNOW.iter().map(|(room, may)| (*room, may.iter().copied().collect())).collect();
    let mut wrong = Vec::new();
    for (room, known) in &rooms {
        let Some(may) = allowed.get(room.as_str()) else {
            wrong.push(format!("room `{room}` is not in this test's list"));
            continue;
        };
        let forbidden = known.iter().filter(|(other, _)| !may.contains(other.as_str()));
        wrong.extend(forbidden.map(|(other, names)| format!("`{room}` may not know `{other}`: {names:?}")));
        let needless = may.iter().filter(|other| !known.contains_key(**other));
        wrong.extend(needless.map(|other| format!("`{room}` has no need to know `{other}`: take it off the list")));
    }
    wrong.extend(allowed.keys().filter(|r| !rooms.contains_key(**r)).map(|r| format!("there is no room `{r}`")));
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn no_room_is_known_by_what_it_knows() {
    assert_eq!(circle(&between_rooms(&graph(&sources()))), None);
}

/// Edges between the rooms of a room; what stands in its own file, which knows them all, is none of them.
fn within(graph: &Graph, house: &str) -> Graph {
    let inner = |module: &str| module.strip_prefix(house)?.strip_prefix("::")?.split("::").next().map(str::to_owned);
    let mut rooms = Graph::new();
    for (here, edges) in graph {
        let Some(room) = inner(here) else { continue };
        let known = rooms.entry(room.clone()).or_default();
        for (there, names) in edges {
            if let Some(other) = inner(there).filter(|other| *other != room) {
                known.entry(other).or_default().extend(names.iter().map(|name| format!("{name} ({here})")));
            }
        }
    }
    rooms
}

#[test]
fn no_room_of_the_reconstruction_is_known_by_what_it_knows() {
    let rooms = within(&graph(&sources()), "reconstruction");
    assert!(rooms.len() >= 10, "{:?}: the test looks for the wrong thing", rooms.keys());
    assert_eq!(circle(&rooms), None);
}

#[test]
fn no_file_is_known_by_what_it_knows() {
    let graph = graph(&sources());
    let edges: usize = graph.values().map(BTreeMap::len).sum();
    assert!(edges > 500, "only {edges} edges: the test looks for the wrong thing");
    assert_eq!(circle(&graph), None);
}

#[test]
fn only_the_daemon_and_processes_beside_it_start_threads() {
    let found = places(&[], &["thread::spawn", "thread::Builder", "thread::scope", "rayon::"]);
    let wrong: Vec<_> =
        found.iter().filter(|place| !["daemon", "console"].iter().any(|room| place.starts_with(room))).collect();
    assert!(wrong.is_empty(), "{wrong:#?}");
    assert!(!found.is_empty(), "the daemon's own threads were not found: the test looks for the wrong thing");
}

#[test]
fn no_room_of_the_daemon_opens_a_network_socket() {
    let words =
        ["std::net", "TcpListener", "TcpStream", "UdpSocket", "AF_INET", "libc::socket", "tokio", "hyper", "zenoh::"];
    let found = places(&[], &words);
    // `cli` passes on where the console listens. Bridge, fleet and who fetches maps are other processes, too.
    let may = ["console/", "cli/console.rs", "share/bridge/", "share/fleet/", "share/maps/"];
    let wrong: Vec<_> = found.iter().filter(|place| !may.iter().any(|room| place.starts_with(room))).collect();
    assert!(wrong.is_empty(), "{wrong:#?}");
    assert!(!found.is_empty(), "the console's own socket was not found: the test looks for the wrong thing");
}

#[test]
fn geometry_is_pure() {
    let words = ["std::fs", "std::io", "std::thread", "std::time", "std::env", "tracing", "monotonic_ns", "println!"];
    assert_eq!(places(&["geometry"], &words), Vec::<String>::new());
}

#[test]
fn nothing_on_the_path_depends_on_a_clock_or_on_hash_order() {
    let rooms = ["geometry", "features", "map", "places", "reconstruction"];
    let words = ["HashMap", "HashSet", "Instant::now", "SystemTime", "thread_rng", "from_entropy", "rand::random"];
    // A map file says when it was written; nothing is decided by that.
    let found: Vec<_> = places(&rooms, &words).into_iter().filter(|p| !p.starts_with("places/store/file.rs")).collect();
    assert_eq!(found, Vec::<String>::new());
}

#[test]
fn unsafe_code_stands_where_it_may_and_argues_its_case() {
    // Ring, the camera's driver, SIMD kernels, what iceoryx2's derives need, the pointers of C callers; and two system calls that the standard library
    // has no name for: reading CLOCK_MONOTONIC, and what the kernel counted for a child.
    let may = [
        "ring/",
        "camera/v4l2",
        "image/",
        "features/",
        "messages/",
        "frame.rs",
        "evaluation/child.rs",
        "client/c.rs",
        "client/c/",
    ];
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
                #[cfg(test)]\nmod tests { use crate::test_only; fn x() { if true {} } }\ncrate::g;\n\
                #[cfg(all(test, feature = \"h\"))]\nmod more_tests;\ncrate::i;\n";
    let code = without_tests(&blanked(text));
    for (word, is_code) in [
        ("a", true),
        ("e", true),
        ("g", true),
        ("comment", false),
        ("string", false),
        ("test_only", false),
        ("more_tests", false),
        ("i", true),
    ] {
        assert_eq!(code.split(|c: char| !sources::is_of_word(c)).any(|w| w == word), is_code, "{word}");
    }
    assert_eq!(code.lines().count(), text.lines().count());
}
