//! The tables of `src/messages/WIRE.md`: services and fields.

use std::collections::BTreeMap;

use cairn::messages::services::{self, Qos};

use crate::support::{compare, plain, root, types};

const PAGE: &str = "src/messages/WIRE.md";

/// Type and documentation of every field, by struct and field, out of the sources.
fn documented() -> BTreeMap<(String, String), (String, String)> {
    let mut found = BTreeMap::new();
    for file in
        ["pose", "map", "graph", "frame", "encoded", "features", "health", "command", "wheel", "obstacles", "tags"]
    {
        let text = std::fs::read_to_string(root().join(format!("src/messages/{file}.rs"))).expect("source");
        let (mut inside, mut words) = (None::<String>, Vec::new());
        for line in text.lines() {
            let trimmed = line.trim();
            if let Some(rest) = line.strip_prefix("pub struct ") {
                (inside, words) = (rest.split_whitespace().next().map(String::from), Vec::new());
            } else if line == "}" {
                inside = None;
            } else if let Some(doc) = trimmed.strip_prefix("/// ") {
                words.push(doc.to_owned());
            } else if let (Some(name), Some(field)) = (&inside, trimmed.strip_prefix("pub "))
                && let Some((field, kind)) = field.trim_end_matches(',').split_once(": ")
            {
                let key = (name.clone(), field.to_owned());
                found.insert(key, (kind.to_owned(), std::mem::take(&mut words).join(" ")));
            }
        }
    }
    found
}

/// The table of one type.
fn fields(wire: &str) -> String {
    let documented = documented();
    let (_, size, _, fields) = types().into_iter().find(|t| t.2 == wire).unwrap_or_else(|| panic!("no type {wire}"));
    let rust = wire.split('.').nth(1).expect("cairn.Name.vN");
    let mut table = format!("{size} bytes.\n\n| offset | bytes | field | type | meaning |\n|---:|---:|---|---|---|\n");
    for field in fields {
        let key = (rust.to_owned(), field.name.to_owned());
        let (kind, meaning) = documented.get(&key).unwrap_or_else(|| panic!("{wire}.{} is not documented", field.name));
        assert!(!meaning.is_empty(), "{wire}.{} is not documented", field.name);
        let meaning = plain(meaning, &[], "").replace('|', "/");
        let (offset, bytes, name) = (field.offset, field.size, field.name);
        table += &format!("| {offset} | {bytes} | `{name}` | `{kind}` | {meaning} |\n");
    }
    table
}

/// The table of queues.
fn queues() -> String {
    let mut table = String::from(
        "| service | history for late joiners | queue of a reader | held by a reader | readers |\n|---|---:|---:|---:|---:|\n",
    );
    let rows: [(&str, Qos); 11] = [
        (services::topic::POSE, services::POSE),
        (services::topic::MAP, services::MAP),
        (services::topic::KEYFRAMES, services::KEYFRAMES),
        (services::topic::GRAPH, services::GRAPH),
        (services::topic::HEALTH, services::HEALTH),
        (services::topic::FRAME, services::FRAME),
        (services::topic::FEATURES, services::FEATURES),
        (services::topic::ENCODED, services::ENCODED),
        (services::topic::OBSTACLES, services::OBSTACLES),
        (services::topic::TAGS, services::TAGS),
        (services::topic::WHEEL, services::WHEEL),
    ];
    for (name, qos) in rows {
        let Qos { history, buffer, borrowed, subscribers } = qos;
        table += &format!("| `PREFIX/{name}` | {history} | {buffer} | {borrowed} | {subscribers} |\n");
    }
    table
        + &format!(
            "\nOf each service: {} publisher (of `wheel`, which the daemon reads, one is believed and a second one seen), {} processes; {} \
             processes may send commands at once.\n",
            services::MAX_PUBLISHERS,
            services::MAX_NODES,
            services::MAX_COMMANDERS
        )
}

#[test]
fn the_page_lists_every_type_and_queue_as_they_are() {
    let page = std::fs::read_to_string(root().join(PAGE)).expect(PAGE);
    let mut want = String::new();
    let mut rest = page.as_str();
    let mut listed = Vec::new();
    // What stands between `<!-- made: X -->` and `<!-- end -->` is made.
    while let Some((before, from)) = rest.split_once("<!-- made: ") {
        let (what, from) = from.split_once(" -->\n").expect("a mark");
        let (_, after) = from.split_once("<!-- end -->").expect("an end");
        let table = if what == "queues" { queues() } else { fields(what) };
        want += &format!("{before}<!-- made: {what} -->\n\n{table}\n<!-- end -->");
        listed.push(what.to_owned());
        rest = after;
    }
    want += rest;
    for (_, _, wire, _) in types() {
        assert!(listed.iter().any(|l| l == wire), "{PAGE} does not list {wire}");
    }
    assert!(listed.iter().any(|l| l == "queues"), "{PAGE} does not list the queues");
    compare(PAGE, &want);
}

#[test]
fn the_page_names_every_fault_state_command_and_reply() {
    let page = std::fs::read_to_string(root().join(PAGE)).expect(PAGE);
    for file in ["mod", "health", "command"] {
        let text = std::fs::read_to_string(root().join(format!("src/messages/{file}.rs"))).expect("source");
        for line in text.lines().filter_map(|line| line.trim_start().strip_prefix("pub const ")) {
            let (name, rest) = line.split_once(": ").expect("a constant");
            if !rest.starts_with(['&', '[']) {
                assert!(page.contains(&format!("`{name}`")), "{PAGE} does not name {name}");
            }
        }
    }
}
