//! The crate's sources as text, with comments, strings and tests blanked.

use std::fs;
use std::path::{Path, PathBuf};

/// One module's file; line numbers of `code` are those of the file.
pub struct Source {
    /// Path of the module below the crate: `geometry::ransac`.
    pub module: Vec<String>,
    /// Below `src`.
    pub path: PathBuf,
    /// Without comments, strings and tests.
    pub code: String,
    /// The file as it is.
    pub text: String,
}

impl Source {
    /// The room that the file is in; the crate's root is none.
    pub fn room(&self) -> &str {
        self.module.first().map_or("", String::as_str)
    }
}

/// Every file of the library that a `mod` leads to; test modules are no part of it.
pub fn sources() -> Vec<Source> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut found = Vec::new();
    let mut ahead = vec![Vec::new()];
    while let Some(module) = ahead.pop() {
        let path = file_of(&root, &module);
        let text = fs::read_to_string(root.join(&path)).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let code = without_tests(&blanked(&text));
        for child in children(&code) {
            ahead.push(module.iter().cloned().chain([child]).collect());
        }
        found.push(Source { module, path, code, text });
    }
    assert!(found.len() > 100, "only {} files found below {}", found.len(), root.display());
    found.sort_by(|a, b| a.path.cmp(&b.path));
    found
}

fn file_of(root: &Path, module: &[String]) -> PathBuf {
    if module.is_empty() {
        return "lib.rs".into();
    }
    let folder: PathBuf = module.iter().collect();
    let file = folder.with_extension("rs");
    if root.join(&file).exists() { file } else { folder.join("mod.rs") }
}

/// Names of `mod name;`.
pub fn children(code: &str) -> Vec<String> {
    let declared = code.match_indices("mod ").filter(|(at, _)| !code[..*at].ends_with(is_of_word));
    let names = declared.filter_map(|(at, word)| {
        let (name, _) = code[at + word.len()..].split_once(';')?;
        (!name.is_empty() && name.chars().all(is_of_word)).then(|| name.to_owned())
    });
    names.collect()
}

pub fn is_of_word(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

/// Comments, string and character literals replaced by blanks, lines kept.
pub fn blanked(text: &str) -> String {
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

/// What stands behind `#[cfg(test)]`, or `#[cfg(all(test, ...))]`, cut out: a module, an item, a declaration.
pub fn without_tests(code: &str) -> String {
    let mut out = String::new();
    let mut rest = code;
    let marks = ["#[cfg(test)]", "#[cfg(all(test,"];
    while let Some(at) = marks.iter().filter_map(|mark| rest.find(mark)).min() {
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
