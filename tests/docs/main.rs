//! The pages for users: links lead somewhere, command lines are taken, keys exist, code is that of the examples, and the front page
//! stays short. Every checker is tried on wrong input beside it.

mod commands;
mod keys;
mod markdown;

use std::collections::BTreeSet;
use std::fs;
use std::path::{Component, Path, PathBuf};

use markdown::Page;

/// Bytes of the front page and of another, and characters of a line.
const FRONT_BYTES: usize = 9000;
const PAGE_BYTES: usize = 10_000;
const LINE: usize = 120;

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn text(path: &str) -> String {
    fs::read_to_string(root().join(path)).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// `README.md` and `docs/*.md`: what is written for users.
fn users_pages() -> Vec<String> {
    let mut found = vec!["README.md".to_owned()];
    for entry in fs::read_dir(root().join("docs")).expect("docs") {
        let name = entry.expect("entry").file_name().into_string().expect("UTF-8");
        assert!(name.ends_with(".md"), "docs/{name} is no page");
        found.push(format!("docs/{name}"));
    }
    found.sort();
    assert!(found.len() >= 9, "{found:?}");
    found
}

/// All pages that are held to the program.
fn pages() -> Vec<(String, Page)> {
    let linked =
        ["src/messages/WIRE.md", "src/telemetry/EVENTS.md", "clients/python/README.md", "config/cameras/README.md"];
    let names = users_pages().into_iter().chain(linked.map(String::from));
    names.map(|name| (name.clone(), markdown::read(&text(&name)).unwrap_or_else(|e| panic!("{name}: {e}")))).collect()
}

fn none(faults: &[String]) {
    assert!(faults.is_empty(), "\n{}", faults.join("\n"));
}

/// `folder/../b` as `b`, without looking at the disk.
fn plain(path: &Path) -> PathBuf {
    let mut plain = PathBuf::new();
    for part in path.components() {
        match part {
            Component::ParentDir => _ = plain.pop(),
            Component::CurDir => {}
            other => plain.push(other),
        }
    }
    plain
}

/// What is wrong with a link of a page, below a folder.
fn fault_of_link(root: &Path, page: &str, target: &str) -> Option<String> {
    if target.starts_with("https://") || target.starts_with("http://") {
        return None;
    }
    let (file, anchor) = target.split_once('#').map_or((target, None), |(file, anchor)| (file, Some(anchor)));
    let path = if file.is_empty() {
        PathBuf::from(page)
    } else {
        plain(&Path::new(page).parent().unwrap_or(Path::new("")).join(file))
    };
    if !root.join(&path).exists() {
        return Some(format!("{} is not there", path.display()));
    }
    let anchor = anchor?;
    let read = fs::read_to_string(root.join(&path)).map_err(|e| e.to_string()).and_then(|text| markdown::read(&text));
    match read {
        Ok(page) if page.anchors.iter().any(|known| known == anchor) => None,
        Ok(page) => Some(format!("{} has no #{anchor}, but {:?}", path.display(), page.anchors)),
        Err(reason) => Some(format!("{}: {reason}", path.display())),
    }
}

#[test]
fn every_link_leads_somewhere() {
    let mut faults = Vec::new();
    let mut count = 0;
    for (name, page) in pages() {
        for (line, target) in &page.links {
            count += 1;
            faults
                .extend(fault_of_link(&root(), &name, target).map(|fault| format!("{name}:{line}: {target}: {fault}")));
        }
    }
    none(&faults);
    assert!(count > 50, "only {count} links found");
}

#[test]
fn a_link_that_leads_nowhere_is_found() {
    let folder = tempfile::tempdir().expect("folder");
    fs::create_dir(folder.path().join("docs")).expect("folder");
    fs::write(folder.path().join("docs/a.md"), "# A title\n").expect("file");
    fs::write(folder.path().join("b.md"), "# B\n").expect("file");
    let fault = |page, target| fault_of_link(folder.path(), page, target);
    for right in ["../b.md", "#a-title", "a.md#a-title", "../docs/a.md", "../b.md#b", "https://nowhere.invalid/"] {
        assert_eq!(fault("docs/a.md", right), None, "{right}");
    }
    for wrong in ["b.md", "../b.md#a-title", "#b", "docs/a.md", "../c.md"] {
        assert!(fault("docs/a.md", wrong).is_some(), "{wrong}");
    }
}

#[test]
fn every_page_is_linked_from_the_front_page() {
    let front = markdown::read(&text("README.md")).expect("README.md");
    let linked: BTreeSet<_> = front.links.iter().map(|(_, target)| target.split('#').next().unwrap_or("")).collect();
    for page in users_pages().iter().filter(|page| *page != "README.md") {
        assert!(linked.contains(page.as_str()), "README.md does not link {page}");
    }
}

#[test]
fn every_command_line_is_one_that_the_program_takes() {
    let mut faults = Vec::new();
    let mut seen = BTreeSet::new();
    for (name, page) in pages() {
        for block in page.blocks.iter().filter(|block| block.language == "sh") {
            for words in commands::shell(&block.text) {
                let Some(arguments) = commands::arguments(&words) else { continue };
                seen.extend(arguments.first().cloned());
                let fault = commands::fault(arguments);
                faults.extend(fault.map(|fault| format!("{name}:{}: {}: {fault}", block.line, words.join(" "))));
            }
        }
        for (line, span) in &page.spans {
            for words in commands::shell(span) {
                let Some(arguments) = commands::arguments(&words).filter(|arguments| !arguments.is_empty()) else {
                    continue;
                };
                let fault = commands::fault_of_form(arguments);
                faults.extend(fault.map(|fault| format!("{name}:{line}: `{span}`: {fault}")));
            }
        }
    }
    none(&faults);
    // Each subcommand is shown in a block somewhere, as it is typed.
    let all: BTreeSet<_> = <cairn::cli::Arguments as clap::CommandFactory>::command()
        .get_subcommands()
        .map(|command| command.get_name().to_owned())
        .collect();
    let missing: Vec<_> = all.difference(&seen).collect();
    assert!(missing.is_empty(), "no block shows {missing:?}");
}

#[test]
fn every_key_of_the_configuration_exists() {
    let mut faults = Vec::new();
    let mut count = 0;
    for (name, page) in pages() {
        for (line, span) in &page.spans {
            let Some(key) = keys::named(span) else { continue };
            count += 1;
            if !keys::exists(&key) {
                faults.push(format!("{name}:{line}: `{span}`: there is no key {key}"));
            }
        }
        // A camera's file is no configuration.
        let blocks = page.blocks.iter().filter(|b| b.language == "toml" && name != "config/cameras/README.md");
        faults.extend(blocks.filter_map(|block| {
            let fault = cairn::config::parse(&block.text, "block").err()?;
            Some(format!("{name}:{}: {fault}", block.line))
        }));
    }
    none(&faults);
    assert!(count > 20, "only {count} keys found");
}

#[test]
fn the_page_of_the_configuration_lists_every_key_with_its_default_and_unit() {
    // The simulator's keys have a page of their own.
    none(&keys::faults_of_list(&(text("docs/configuration.md") + &text("docs/simulator.md"))));
}

/// What is wrong with the comment above a block of shell, which `try-commands` goes by.
fn fault_of_marker(marker: Option<&str>) -> Option<String> {
    let Some(marker) = marker else { return Some("says neither `try` nor `not tried: why`".into()) };
    let known = matches!(marker, "try" | "try, beside a demo")
        || marker.strip_prefix("not tried: ").is_some_and(|why| why.len() > 3)
        || marker.strip_prefix("try, may end with ").is_some_and(|code| code.parse::<u8>().is_ok());
    (!known).then(|| format!("`{marker}` is none of the ways to try a block"))
}

#[test]
fn every_block_of_shell_says_whether_it_is_tried() {
    let mut faults = Vec::new();
    for name in users_pages() {
        for block in markdown::read(&text(&name)).expect("page").blocks.iter().filter(|block| block.language == "sh") {
            let fault = fault_of_marker(block.marker.as_deref());
            faults.extend(fault.map(|fault| format!("{name}:{}: {fault}", block.line)));
        }
    }
    none(&faults);
    for right in ["try", "try, beside a demo", "try, may end with 69", "not tried: needs a camera"] {
        assert_eq!(fault_of_marker(Some(right)), None);
    }
    for wrong in [None, Some("tried"), Some("not tried: "), Some("try, may end with 300"), Some("")] {
        assert!(fault_of_marker(wrong).is_some(), "{wrong:?}");
    }
}

/// Lines of a block that its example does not have.
fn foreign_lines<'a>(block: &'a str, example: &str) -> Vec<&'a str> {
    let own: BTreeSet<_> = example.lines().map(str::trim).collect();
    block.lines().map(str::trim).filter(|line| !line.is_empty() && !own.contains(line)).collect()
}

#[test]
fn code_on_the_pages_is_that_of_the_examples() {
    let examples = [
        ("rust", &["examples/planner.rs", "examples/wheels.rs"][..]),
        ("c", &["clients/c/planner.c", "clients/c/wheels.c"]),
        ("cpp", &["clients/c/planner.cpp"]),
        ("python", &["clients/python/examples/planner.py", "clients/python/examples/wheels.py"]),
    ];
    let mut shown = BTreeSet::new();
    for name in users_pages() {
        for block in &markdown::read(&text(&name)).expect("page").blocks {
            let known = ["sh", "toml", "text"].contains(&block.language.as_str());
            let example = examples.iter().find(|(language, _)| *language == block.language);
            assert!(known || example.is_some(), "{name}:{}: a block of `{}`", block.line, block.language);
            let Some((language, examples)) = example else { continue };
            shown.insert(language);
            // All of a block is of one example.
            let foreign = examples.iter().map(|example| foreign_lines(&block.text, &text(example)).len()).min();
            assert_eq!(foreign, Some(0), "{name}:{}: not in one of {examples:?}", block.line);
        }
    }
    assert_eq!(shown.len(), examples.len(), "{shown:?}");
    assert_eq!(foreign_lines("a\n\n  b\nc", "  a\nb"), ["c"]);
}

/// What is too long on a page: bytes of all of it, characters of its lines, tables and blocks only where `everywhere`.
fn too_long(text: &str, bytes: usize, everywhere: bool) -> Vec<String> {
    let mut faults = Vec::new();
    if text.len() > bytes {
        faults.push(format!("{} bytes, more than {bytes}", text.len()));
    }
    let mut block = false;
    for (i, line) in text.lines().enumerate() {
        block ^= line.trim().starts_with("```");
        let counts = everywhere || !(block || line.starts_with('|'));
        if counts && line.chars().count() > LINE {
            faults.push(format!("line {}: {} characters, more than {LINE}", i + 1, line.chars().count()));
        }
    }
    faults
}

#[test]
fn pages_stay_short() {
    let mut faults = Vec::new();
    for name in users_pages() {
        let front = name == "README.md";
        let limit = if front { FRONT_BYTES } else { PAGE_BYTES };
        faults.extend(too_long(&text(&name), limit, front).into_iter().map(|fault| format!("{name}: {fault}")));
    }
    none(&faults);
    let long = "x".repeat(LINE + 1);
    assert_eq!(too_long(&long, PAGE_BYTES, false).len(), 1);
    assert_eq!(too_long(&format!("| {long}\n```\n{long}\n```\n"), PAGE_BYTES, false).len(), 0);
    assert_eq!(too_long(&format!("| {long}\n```\n{long}\n```\n"), PAGE_BYTES, true).len(), 2);
    assert_eq!(too_long(&"x\n".repeat(PAGE_BYTES), PAGE_BYTES, true).len(), 1);
}
