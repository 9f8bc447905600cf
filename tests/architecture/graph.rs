//! Which file knows which, and circles among them.
//!
//! The rule: a file knows the file that *defines* an item that it names, by `use` or by a path in the code; re-exports are looked
//! through. A file that only hands items of its own children on (`pub use child::Item`) does not know them by that. No file may be
//! known by what it knows itself, however many files lie in between; a parent is a file like any other: it either uses its
//! children or is used by them. Methods are called by no path, so a call is no edge: several files may each hold an `impl` of one
//! type, as long as the file that defines the type names nothing of theirs.

use std::collections::{BTreeMap, BTreeSet};

use crate::sources::{Source, children, is_of_word};

/// Edges with the names that make them, by module path (`geometry::ransac`).
pub type Graph = BTreeMap<String, BTreeMap<String, BTreeSet<String>>>;

/// What a file says of names.
struct Module {
    children: BTreeSet<String>,
    /// Items that it defines.
    items: BTreeSet<String>,
    uses: Vec<Use>,
    /// Other paths of two or more names.
    paths: Vec<Vec<String>>,
}

struct Use {
    path: Vec<String>,
    /// What it is called here; `*` for all of them.
    name: String,
    is_public: bool,
}

type Modules = BTreeMap<Vec<String>, Module>;

/// Who knows whom among `sources`.
pub fn graph(sources: &[Source]) -> Graph {
    let modules: Modules = sources.iter().map(|s| (s.module.clone(), Module::of(&s.code))).collect();
    let mut graph = Graph::new();
    for (here, module) in &modules {
        let edges = graph.entry(here.join("::")).or_default();
        let handed_on =
            |u: &&Use| u.is_public && absolute(&modules, here, &u.path).is_some_and(|p| p.starts_with(here));
        let used = module.uses.iter().filter(|u| !handed_on(u)).map(|u| &u.path);
        for path in used.chain(&module.paths) {
            let there = absolute(&modules, here, path).and_then(|p| definer(&modules, &p, 0));
            if let Some(there) = there.filter(|there| there != here) {
                edges.entry(there.join("::")).or_default().insert(path.join("::"));
            }
        }
    }
    graph
}

/// The path from the crate's root of what `path` names in the module `here`; `None` for what is not of this crate.
fn absolute(modules: &Modules, here: &[String], path: &[String]) -> Option<Vec<String>> {
    let first = path.first()?;
    let supers = path.iter().take_while(|p| *p == "super").count();
    let (base, rest) = match first.as_str() {
        "crate" => (Vec::new(), &path[1..]),
        "self" => (here.to_vec(), &path[1..]),
        "super" => (here[..here.len().checked_sub(supers)?].to_vec(), &path[supers..]),
        _ if modules[here].children.contains(first) => (here.to_vec(), path),
        _ => {
            // A name that a `use` brought in, unless that is the very same one (an extern crate's).
            let brought = modules[here].uses.iter().find(|u| u.name == *first && u.path.first() != Some(first))?;
            (absolute(modules, here, &brought.path)?, &path[1..])
        }
    };
    Some(base.into_iter().chain(rest.iter().cloned()).collect())
}

/// The module that defines what an absolute path names; `None` if the path names a module itself. Items of macros are taken for the
/// module's in whose name they are asked for.
fn definer(modules: &Modules, path: &[String], depth: usize) -> Option<Vec<String>> {
    let known = (0..=path.len()).rev().find(|&n| modules.contains_key(&path[..n]))?;
    let (module, rest) = path.split_at(known);
    let (name, rest) = rest.split_first()?;
    let here = &modules[module];
    if depth < 8 && name != "*" && !here.items.contains(name) {
        let named = here.uses.iter().filter(|u| u.name == *name || u.name == "*");
        for u in named {
            let Some(mut target) = absolute(modules, module, &u.path) else { continue };
            if u.name == "*" {
                target.pop();
                target.push(name.clone());
                let defines = |m: &Vec<String>| modules[m].items.contains(name);
                if let Some(found) = definer(modules, &target, depth + 1).filter(defines) {
                    return Some(found);
                }
            } else if target != path {
                target.extend(rest.iter().cloned());
                return definer(modules, &target, depth + 1);
            }
        }
    }
    Some(module.to_vec())
}

impl Module {
    fn of(code: &str) -> Self {
        let words = words(code);
        let at = |i: usize| words.get(i).copied().unwrap_or_default();
        let mut module = Self {
            children: children(code).into_iter().collect(),
            items: BTreeSet::new(),
            uses: Vec::new(),
            paths: Vec::new(),
        };
        let (mut depth, mut i) = (0, 0);
        while i < words.len() {
            match at(i) {
                "{" => depth += 1,
                "}" => depth -= 1,
                "use" if at(i + 1) != "<" => {
                    let is_public = i > 0 && (at(i - 1) == "pub" || at(i - 1) == ")");
                    let mut found = Vec::new();
                    i = tree(&words, i + 1, &[], &mut found);
                    module.uses.extend(found.into_iter().map(|(path, name)| Use { path, name, is_public }));
                }
                "fn" | "struct" | "enum" | "trait" | "type" | "const" | "static" | "union" | "mod" if depth == 0 => {
                    module.items.insert(at(i + 1).to_owned());
                }
                "macro_rules" => {
                    module.items.insert(at(i + 2).to_owned());
                }
                word if word.starts_with(is_of_word) && at(i + 1) == "::" => {
                    let is_start = i == 0 || !matches!(at(i - 1), "::" | ".");
                    let mut path = vec![word.to_owned()];
                    while at(i + 1) == "::" && at(i + 2).starts_with(is_of_word) {
                        path.push(at(i + 2).to_owned());
                        i += 2;
                    }
                    if is_start && path.len() > 1 && word.starts_with(char::is_lowercase) {
                        module.paths.push(path);
                    }
                }
                _ => {}
            }
            i += 1;
        }
        module.items.retain(|item| !module.children.contains(item));
        module
    }
}

/// Names, `::`, and every other character by itself.
fn words(code: &str) -> Vec<&str> {
    let mut out = Vec::new();
    let mut rest = code.trim_start();
    while let Some(first) = rest.chars().next() {
        let length = if is_of_word(first) {
            rest.find(|c| !is_of_word(c)).unwrap_or(rest.len())
        } else if rest.starts_with("::") {
            2
        } else {
            first.len_utf8()
        };
        let (word, after) = rest.split_at(length);
        out.push(word);
        rest = after.trim_start();
    }
    out
}

/// Reads a tree of `use` from word `i` on: paths with the names that they get. Index of the word that ended it.
fn tree(words: &[&str], mut i: usize, prefix: &[String], out: &mut Vec<(Vec<String>, String)>) -> usize {
    let mut path = prefix.to_vec();
    let (mut name, mut is_itself) = (None, false);
    loop {
        match words.get(i).copied().unwrap_or(";") {
            "::" => {}
            "{" => {
                loop {
                    i = tree(words, i + 1, &path, out);
                    if words.get(i) != Some(&",") {
                        break;
                    }
                }
                // Behind the group's brace.
                return i + 1;
            }
            "as" => {
                i += 1;
                name = words.get(i).map(|w| (*w).to_owned());
            }
            "self" if !path.is_empty() => is_itself = true,
            word if word == "*" || word.starts_with(is_of_word) => path.push(word.to_owned()),
            _ => {
                if path.len() > prefix.len() || is_itself {
                    let name = name.or_else(|| path.last().cloned()).unwrap_or_default();
                    out.push((path, name));
                }
                return i;
            }
        }
        i += 1;
    }
}

/// A way from some file back to itself, with a name for each step; `None` where there is none.
pub fn circle(graph: &Graph) -> Option<Vec<String>> {
    let mut done = BTreeSet::new();
    graph.keys().find_map(|start| walk(graph, start, &mut Vec::new(), &mut done))
}

/// Depth first; what was left without a circle is not entered again.
fn walk<'a>(
    graph: &'a Graph,
    here: &'a str,
    way: &mut Vec<&'a str>,
    done: &mut BTreeSet<&'a str>,
) -> Option<Vec<String>> {
    if let Some(begin) = way.iter().position(|w| *w == here) {
        let round: Vec<&str> = way[begin..].iter().copied().chain([here]).collect();
        let step = |pair: &[&str]| {
            // A few names are enough to find the place.
            let names: Vec<&str> = graph[pair[0]][pair[1]].iter().map(String::as_str).take(3).collect();
            format!("{} knows {} by {}", pair[0], pair[1], names.join(", "))
        };
        return Some(round.windows(2).map(step).collect());
    }
    if done.contains(here) {
        return None;
    }
    way.push(here);
    let found = graph.get(here).into_iter().flatten().find_map(|(there, _)| walk(graph, there, way, done));
    way.pop();
    done.insert(here);
    found
}

fn made_up(files: &[(&str, &str)]) -> Graph {
    let source = |(module, code): &(&str, &str)| Source {
        module: module.split("::").filter(|p| !p.is_empty()).map(str::to_owned).collect(),
        path: module.into(),
        code: (*code).to_owned(),
        text: String::new(),
    };
    graph(&files.iter().map(source).collect::<Vec<_>>())
}

fn edges(graph: &Graph) -> Vec<String> {
    graph.iter().flat_map(|(a, to)| to.keys().map(move |b| format!("{a} -> {b}"))).collect()
}

#[test]
fn an_edge_leads_to_the_file_that_defines_the_item() {
    let graph = made_up(&[
        ("", "pub mod a; pub mod b;"),
        ("a", "mod x; mod y; pub use x::{self as old, Item, Other}; pub use y::*; struct Own; fn f() { y::g(); }"),
        ("a::x", "pub struct Item; pub enum Other { A } use std::fmt;"),
        ("a::y", "use super::{Item as Renamed, Own}; pub fn g() { fmt::write(); } pub const LIMIT: usize = 3;"),
        ("b", "use crate::a::{self, LIMIT}; fn h() { a::Item::new(); super::a::old::Other::A; Vec::new(); }"),
    ]);
    assert_eq!(edges(&graph), ["a -> a::y", "a::y -> a", "a::y -> a::x", "b -> a::x", "b -> a::y"]);
}

#[test]
fn a_circle_is_found_and_named_and_nothing_else_is_one() {
    let mut files = vec![
        ("", "mod a; mod b; mod c; mod d;"),
        ("a", "use crate::b::B; use crate::c::C; pub struct A;"),
        ("b", "pub struct B; fn f(_: crate::d::D) {}"),
        ("c", "use super::d::D; pub struct C;"),
        ("d", "pub struct D;"),
    ];
    assert_eq!(circle(&made_up(&files)), None);
    files[4].1 = "pub struct D; fn g() { crate::a::A; }";
    let found = circle(&made_up(&files)).expect("a knows b, b knows d, d knows a");
    assert_eq!(found, ["a knows b by crate::b::B", "b knows d by crate::d::D", "d knows a by crate::a::A"]);
}

#[test]
fn a_parent_that_hands_on_is_no_circle_and_one_that_uses_is() {
    let child = ("a::x", "use super::Own; pub struct Item(Own);");
    let handing_on = made_up(&[("a", "mod x; pub use x::Item; pub struct Own;"), child]);
    assert_eq!(circle(&handing_on), None);
    let using = made_up(&[("a", "mod x; pub use x::Item; use x::Item as I; pub struct Own;"), child]);
    assert!(circle(&using).is_some());
}
