//! What is wrong in a configuration file, and where: from toml's spans to file, line, key, value, unit and reason.

use std::ops::Range;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// A value that a room cannot use; [`parse`](super::parse) adds where it stands.
#[derive(Debug, Clone, PartialEq)]
pub struct Invalid {
    /// Dotted path from the top of the file.
    pub key: String,
    /// Lower case, with what would be right: `must be 1 or 2`.
    pub reason: String,
}

impl Invalid {
    pub fn new(key: impl Into<String>, reason: impl Into<String>) -> Self {
        Self { key: key.into(), reason: reason.into() }
    }
}

/// Why there is no usable configuration.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{file}: {reason}")]
    Read { file: String, reason: String },
    /// The text is no TOML.
    #[error("{file}:{line}: {reason}")]
    Syntax { file: String, line: usize, reason: String },
    /// A key nobody knows, or a value that cannot be used.
    #[error("{file}:{line}: {key} = {value}{}: {reason}", unit.map(|u| format!(" {u}")).unwrap_or_default())]
    Key { file: String, line: usize, key: String, value: String, unit: Option<&'static str>, reason: String },
    /// A default or a value given by other ways than the file is wrong.
    #[error("{file}: {key}: {reason}")]
    Absent { file: String, key: String, reason: String },
}

/// One `key = value` of the file.
struct Entry {
    path: String,
    key: Range<usize>,
    value: Range<usize>,
}

/// Every entry and every table of the file in the order of the text's structure; nothing when the text is no TOML.
fn entries(text: &str) -> Vec<Entry> {
    fn walk(table: &DeTable<'_>, prefix: &str, out: &mut Vec<Entry>) {
        for (key, value) in table {
            let path =
                if prefix.is_empty() { key.get_ref().to_string() } else { format!("{prefix}.{}", key.get_ref()) };
            out.push(Entry { path: path.clone(), key: key.span(), value: value.span() });
            match value.get_ref() {
                DeValue::Table(inner) => walk(inner, &path, out),
                DeValue::Array(items) => items.iter().for_each(|item: &Spanned<DeValue<'_>>| {
                    if let DeValue::Table(inner) = item.get_ref() {
                        walk(inner, &path, out);
                    }
                }),
                _ => {}
            }
        }
    }
    let mut out = Vec::new();
    if let Ok(table) = DeTable::parse(text) {
        walk(table.get_ref(), "", &mut out);
    }
    out
}

/// Line of a byte of the text, from 1.
fn line_of(text: &str, at: usize) -> usize {
    text.as_bytes().iter().take(at).filter(|b| **b == b'\n').count() + 1
}

/// The value as written, on one line and not endless.
fn excerpt(text: &str, span: &Range<usize>) -> String {
    let raw = text.get(span.clone()).unwrap_or("").split_whitespace().collect::<Vec<_>>().join(" ");
    if raw.chars().count() <= 60 { raw } else { raw.chars().take(57).chain("...".chars()).collect() }
}

/// The unit that a key's name ends in, spelled out.
pub(super) fn unit(key: &str) -> Option<&'static str> {
    const UNITS: [(&str, &str); 17] = [
        ("_px", "px"),
        ("_ns", "ns"),
        ("_us", "us"),
        ("_ms", "ms"),
        ("_s", "s"),
        ("_hz", "Hz"),
        ("_m", "m"),
        ("_mm", "mm"),
        ("_deg", "degrees"),
        ("_rad", "rad"),
        ("_frames", "frames"),
        ("_levels", "grey levels"),
        ("_bytes", "bytes"),
        ("_mb", "MB"),
        ("_percent", "%"),
        ("_m_s", "m/s"),
        ("_deg_s", "degrees/s"),
    ];
    // The longest suffix wins: `_m_s` is not `_s`.
    UNITS
        .iter()
        .filter(|(suffix, _)| key.ends_with(suffix))
        .max_by_key(|(suffix, _)| suffix.len())
        .map(|(_, unit)| *unit)
}

/// Names in backticks after "expected" in serde's message.
fn expected_names(message: &str) -> Vec<&str> {
    let Some((_, list)) = message.split_once("expected") else { return Vec::new() };
    list.split('`').skip(1).step_by(2).collect()
}

/// Edit distance (Levenshtein), for hints only.
fn distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, ca) in a.chars().enumerate() {
        let mut diagonal = i;
        let mut left = i + 1;
        for (j, cb) in b.iter().enumerate() {
            let above = row.get(j + 1).copied().unwrap_or(usize::MAX);
            let cell = (above + 1).min(left + 1).min(diagonal + usize::from(ca != *cb));
            diagonal = above;
            if let Some(slot) = row.get_mut(j) {
                *slot = left;
            }
            left = cell;
        }
        if let Some(last) = row.last_mut() {
            *last = left;
        }
    }
    row.last().copied().unwrap_or(0)
}

/// A key without its unit.
fn stem(key: &str) -> &str {
    key.rsplit_once('_').map_or(key, |(stem, _)| stem)
}

/// The key that was probably meant.
fn hint<'a>(unknown: &str, known: &[&'a str]) -> Option<&'a str> {
    let same_quantity = known.iter().find(|k| stem(k) == stem(unknown) || stem(k) == unknown || **k == stem(unknown));
    same_quantity
        .or_else(|| known.iter().filter(|k| distance(unknown, k) <= 2).min_by_key(|k| distance(unknown, k)))
        .copied()
}

/// A key or a value that serde refused, or a fault of syntax.
pub(super) fn from_toml(error: &toml::de::Error, text: &str, file: &str) -> ConfigError {
    let span = error.span().unwrap_or(0..0);
    let message = error.message().trim().replace('\n', ", ");
    let entries = entries(text);
    // The innermost entry whose key or value holds the place of the error.
    let holds = |range: &Range<usize>| range.start <= span.start && span.end <= range.end;
    let found = entries.iter().filter(|e| holds(&e.key) || holds(&e.value)).min_by_key(|e| e.value.len());
    let Some(entry) = found else {
        return ConfigError::Syntax { file: file.into(), line: line_of(text, span.start), reason: message };
    };
    let reason = if message.starts_with("unknown field") {
        let name = entry.path.rsplit('.').next().unwrap_or(&entry.path);
        let known = expected_names(&message);
        match hint(name, &known) {
            Some(meant) => format!("there is no such key; `{meant}` is meant, perhaps"),
            None => format!("there is no such key; known here: {}", known.join(", ")),
        }
    } else {
        message
    };
    ConfigError::Key {
        file: file.into(),
        line: line_of(text, span.start),
        unit: unit(&entry.path),
        key: entry.path.clone(),
        value: excerpt(text, &entry.value),
        reason,
    }
}

/// A value that a room refused.
pub(super) fn from_invalid(invalid: Invalid, text: &str, file: &str) -> ConfigError {
    match entries(text).into_iter().find(|e| e.path == invalid.key) {
        Some(entry) => ConfigError::Key {
            file: file.into(),
            line: line_of(text, entry.key.start),
            unit: unit(&invalid.key),
            value: excerpt(text, &entry.value),
            key: invalid.key,
            reason: invalid.reason,
        },
        None => ConfigError::Absent { file: file.into(), key: invalid.key, reason: invalid.reason },
    }
}
