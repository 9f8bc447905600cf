//! No figure is typed twice: what README.md and docs quote of `tests/results` is what stands there.
//!
//! `tests/results/quoted.txt` says what is quoted, a line each: `PAGE: TEMPLATE`. Its places are filled from the generated files, and the page
//! must hold the outcome word for word (white space aside). A place is
//!
//! - `{kind | row | column}`: a cell of `tests/results/KIND.md`, of the first table that has such a row and column. A row is named by its first
//!   cell, or by its first cells with ", " between; of a cell "name: what it is" the name is enough;
//! - `{kind # heading | row | column}`: of the tables under that heading;
//! - `{... | @2}`: the cell's second number; `{... | .1}`: rounded to one decimal; both: `{... | @2 | .1}`;
//! - `{kind | row | column // kind | row | column | .1}`: the first cell divided by the second.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Versions and settings of README.md that are no results. Each must still stand there.
const ALLOWED: [&str; 1] = ["Rust 1.90"];
/// A number before one of these is a figure, as is every number with a decimal point.
const UNITS: [&str; 9] = ["%", "°", "µs", "ms", "MB", "mm", "cm", "m", "px"];
/// What stands at the head of every file.
const HEADER: [&str; 5] = ["date", "commit", "machine", "command", "took"];

struct Table {
    headings: Vec<String>,
    head: Vec<String>,
    rows: Vec<Vec<String>>,
}

/// Tables of each kind.
type Results = BTreeMap<String, Vec<Table>>;

fn cells(line: &str) -> Vec<String> {
    let line = line.trim().trim_start_matches('|').replace("\\|", "\u{1}");
    let line = line.strip_suffix('|').unwrap_or(&line);
    line.split('|').map(|c| c.replace('\u{1}', "|").trim().trim_matches(['*', '`']).to_string()).collect()
}

/// The tables of a Markdown text, each with the headings that it stands under.
fn tables(text: &str) -> Vec<Table> {
    let (mut found, mut headings, mut open, mut code) =
        (Vec::<Table>::new(), Vec::<(usize, String)>::new(), false, false);
    for line in text.lines() {
        code ^= line.starts_with("```");
        let table_line = !code && line.starts_with('|');
        if !code && line.starts_with('#') {
            let level = line.len() - line.trim_start_matches('#').len();
            headings.retain(|(other, _)| *other < level);
            headings.push((level, line.trim_start_matches('#').trim().to_string()));
        } else if table_line && !open {
            let headings = headings.iter().map(|(_, text)| text.clone()).collect();
            found.push(Table { headings, head: cells(line), rows: Vec::new() });
        } else if table_line && !line.trim_matches(['|', '-', ':', ' ']).is_empty() {
            found.last_mut().expect("an open table").rows.push(cells(line));
        }
        open = table_line;
    }
    found
}

impl Table {
    fn is_row(row: &[String], name: &str) -> bool {
        let short = |cell: &String| cell.split_once(": ").map_or(cell.clone(), |(name, _)| name.to_string());
        (1..=row.len())
            .any(|n| row[..n].join(", ") == name || row[..n].iter().map(short).collect::<Vec<_>>().join(", ") == name)
    }

    /// `None`: no such row or column; an error: more than one.
    fn cell(&self, row: &str, column: &str) -> Option<Result<&str, String>> {
        let at = self.head.iter().position(|h| h == column)?;
        let rows: Vec<_> = self.rows.iter().filter(|r| Self::is_row(r, row)).collect();
        match rows[..] {
            [] => None,
            [one] => one.get(at).map(|cell| Ok(cell.as_str())),
            _ => Some(Err(format!("{} rows are called {row:?}: name more of their cells", rows.len()))),
        }
    }
}

/// The numbers of a cell, as they stand there. A comma before three digits groups them; a minus between digits makes a range.
fn numbers(text: &str) -> Vec<&str> {
    let bytes = text.as_bytes();
    let digit = |i: usize| bytes.get(i).is_some_and(u8::is_ascii_digit);
    let (mut found, mut i) = (Vec::new(), 0);
    while i < bytes.len() {
        if !digit(i) {
            i += 1;
            continue;
        }
        let part_of_a_name = i > 0 && bytes[i - 1].is_ascii_alphabetic();
        let signed = i > 0 && matches!(bytes[i - 1], b'-' | b'+') && (i < 2 || !digit(i - 2));
        let begin = if signed { i - 1 } else { i };
        while digit(i) || bytes[i..].starts_with(b".") && digit(i + 1) || groups(&bytes[i..]) {
            i += 1;
        }
        if !part_of_a_name {
            found.push(&text[begin..i]);
        }
    }
    found
}

/// A comma and three digits.
fn groups(bytes: &[u8]) -> bool {
    bytes.len() > 3
        && bytes[0] == b','
        && bytes[1..4].iter().all(u8::is_ascii_digit)
        && !bytes.get(4).is_some_and(u8::is_ascii_digit)
}

fn number(text: &str) -> Result<f64, String> {
    text.replace(',', "").parse().map_err(|_| format!("{text:?} is no number"))
}

/// One place of a template, without its braces.
fn place(text: &str, results: &Results) -> Result<String, String> {
    let (mut which, mut decimals) = (None, None);
    let mut fields: Vec<&str> = text.split('|').map(str::trim).collect();
    while let Some(last) = fields.last().copied().filter(|_| fields.len() > 3) {
        if let Some(n) = last.strip_prefix('.').and_then(|n| n.parse::<usize>().ok()) {
            decimals = Some(n);
        } else if let Some(n) = last.strip_prefix('@').and_then(|n| n.parse::<usize>().ok()) {
            which = Some(n);
        } else {
            break;
        }
        fields.pop();
    }
    let cell = |fields: &[&str]| -> Result<String, String> {
        let &[kind, row, column] = fields else {
            return Err(format!("{{{text}}}: must be kind | row | column"));
        };
        let (kind, heading) = kind.split_once('#').map_or((kind, None), |(k, h)| (k.trim(), Some(h.trim())));
        let all = results.get(kind).ok_or_else(|| format!("{{{text}}}: there is no tests/results/{kind}.md"))?;
        let under = |t: &&Table| heading.is_none_or(|h| t.headings.iter().any(|own| own == h));
        let found = all.iter().filter(under).find_map(|t| t.cell(row, column));
        found
            .ok_or_else(|| format!("{{{text}}}: no table of {kind}.md has a row {row:?} and a column {column:?}"))?
            .map(str::to_string)
            .map_err(|e| format!("{{{text}}}: {e}"))
    };
    let one = |cell: &str| -> Result<String, String> {
        let found = numbers(cell);
        match (which, found.len()) {
            (Some(n), _) => found.get(n.wrapping_sub(1)).map(|s| s.to_string()),
            (None, 1) => Some(found[0].to_string()),
            _ => None,
        }
        .ok_or_else(|| format!("{{{text}}}: {cell:?} holds {} numbers: say which one with @1, @2 ...", found.len()))
    };
    let value = |text: &str| one(text).and_then(|n| number(&n));
    // A quotient's fields: three, the divisor's first one behind "//", two more.
    if let Some((column, kind)) = fields.get(2).and_then(|f| f.split_once("//")).filter(|_| fields.len() == 5) {
        let a = cell(&[fields[0], fields[1], column.trim()])?;
        let b = cell(&[kind.trim(), fields[3], fields[4]])?;
        let decimals = decimals.ok_or_else(|| format!("{{{text}}}: a quotient needs its decimals, as in | .1"))?;
        return Ok(format!("{:.decimals$}", value(&a)? / value(&b)?));
    }
    let cell = cell(&fields)?;
    match (decimals, which) {
        (Some(decimals), _) => Ok(format!("{:.decimals$}", value(&cell)?)),
        (None, Some(_)) => one(&cell),
        (None, None) => Ok(cell),
    }
}

/// A template with its places filled, and what of it was typed by hand.
fn render(template: &str, results: &Results) -> Result<(String, String), String> {
    let (mut filled, mut typed, mut rest) = (String::new(), String::new(), template);
    while let Some((before, after)) = rest.split_once('{') {
        let (inside, after) = after.split_once('}').ok_or_else(|| format!("{template}: {{ without }}"))?;
        filled += before;
        filled += &place(inside, results)?;
        typed += before;
        typed.push('\u{1}');
        rest = after;
    }
    Ok((filled + rest, typed + rest))
}

fn normalised(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// The text without code, comments and the targets of links.
fn prose(text: &str) -> String {
    let mut out = text.to_string();
    for (begin, end) in [("```", "```"), ("<!--", "-->"), ("`", "`"), ("](", ")")] {
        let mut kept = String::new();
        let mut rest = out.as_str();
        while let Some((before, after)) = rest.split_once(begin) {
            let Some((_, after)) = after.split_once(end) else { break };
            kept += before;
            kept += " \u{1} ";
            rest = after;
        }
        kept += rest;
        out = kept;
    }
    out
}

/// Figures that stand in the text: with a decimal point, or before a unit.
fn figures(text: &str) -> Vec<(usize, String)> {
    let (mut found, mut i) = (Vec::new(), 0);
    while let Some(begin) = text[i..].find(|c: char| c.is_ascii_digit()).map(|n| i + n) {
        let more = |c: char, next: Option<char>| {
            c.is_ascii_digit() || matches!(c, '.' | ',') && next.is_some_and(|n| n.is_ascii_digit())
        };
        let mut end = begin;
        while let Some(c) = text[end..].chars().next() {
            if !more(c, text[end + c.len_utf8()..].chars().next()) {
                break;
            }
            end += c.len_utf8();
        }
        i = end;
        if text[..begin].chars().next_back().is_some_and(|c| c.is_alphanumeric() || c == '_') {
            continue;
        }
        let after = text[end..].trim_start();
        let unit = UNITS.iter().find(|unit| {
            after.strip_prefix(**unit).is_some_and(|rest| {
                !unit.ends_with(char::is_alphanumeric) || !rest.starts_with(|c: char| c.is_alphanumeric() || c == '/')
            })
        });
        if text[begin..end].contains('.') || unit.is_some() {
            found.push((begin, format!("{}{}", &text[begin..end], unit.map_or(String::new(), |u| format!(" {u}")))));
        }
    }
    found
}

/// Figures of a page that lie in none of these texts, with what stands around them.
fn typed_by_hand(page: &str, quoted: &[String]) -> Vec<String> {
    let (page, mut covered) = (normalised(&prose(page)), Vec::new());
    for text in quoted {
        let text = normalised(&prose(text));
        covered.extend(page.match_indices(&text).map(|(at, found)| at..at + found.len()));
    }
    figures(&page)
        .into_iter()
        .filter(|(at, _)| !covered.iter().any(|range| range.contains(at)))
        .map(|(at, figure)| {
            let around: String = page[..at].chars().rev().take(30).collect::<Vec<_>>().into_iter().rev().collect();
            format!("{figure} in \"...{around}{}...\"", page[at..].chars().take(30).collect::<String>())
        })
        .collect()
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).to_path_buf()
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

fn generated() -> Vec<(String, String)> {
    let folder = fs::read_dir(root().join("tests/results")).expect("tests/results").flatten().map(|e| e.path());
    let mut files: Vec<_> = folder.filter(|p| p.extension().is_some_and(|e| e == "md")).collect();
    files.sort();
    files.iter().map(|p| (p.file_stem().expect("a name").to_string_lossy().into_owned(), read(p))).collect()
}

fn results() -> Results {
    generated().into_iter().map(|(kind, text)| (kind, tables(&text))).collect()
}

/// Page and template of every line of `quoted.txt`.
fn quoted() -> Vec<(String, String)> {
    let text = read(&root().join("tests/results/quoted.txt"));
    let lines = text.lines().filter(|l| !l.trim().is_empty() && !l.starts_with('#'));
    lines
        .map(|line| {
            let (page, template) = line.split_once(": ").unwrap_or_else(|| panic!("{line}: must be PAGE: TEMPLATE"));
            let docs = page.strip_prefix("docs/").is_some_and(|name| !name.contains('/') && name.ends_with(".md"));
            assert!(page == "README.md" || docs, "{page}: only README.md and docs/*.md quote results");
            (page.to_string(), template.to_string())
        })
        .collect()
}

/// What a page does not hold, and what its templates hold that no command wrote.
fn faults(quoted: &[(String, String)], results: &Results, page: impl Fn(&str) -> String) -> Vec<String> {
    let allowed = ALLOWED.map(String::from);
    let mut faults = Vec::new();
    for (name, template) in quoted {
        match render(template, results) {
            Err(e) => faults.push(e),
            Ok((text, typed)) => {
                if !normalised(&page(name)).contains(&normalised(&text)) {
                    faults.push(format!("{name} ought to hold:\n    {text}"));
                }
                let hand = typed_by_hand(&typed, &allowed);
                faults
                    .extend(hand.iter().map(|figure| format!("{name}: its template types a figure by hand: {figure}")));
            }
        }
    }
    faults
}

#[test]
fn pages_hold_what_the_results_say() {
    let faults = faults(&quoted(), &results(), |page| read(&root().join(page)));
    assert!(faults.is_empty(), "tests/results/quoted.txt:\n{}", faults.join("\n"));
}

#[test]

fn the_readme_has_no_figure_of_its_own() {
    let (results, readme) = (results(), read(&root().join("README.md")));
    let mut sources: Vec<String> = ALLOWED.map(String::from).to_vec();
    for text in &sources {
        assert!(readme.contains(text.as_str()), "ALLOWED: README.md no longer holds {text:?}");
    }
    for (_, template) in quoted().iter().filter(|(page, _)| page == "README.md") {
        sources.push(render(template, &results).expect("a template").0);
    }
    let hand = typed_by_hand(&readme, &sources);
    assert!(
        hand.is_empty(),
        "README.md: figures that are in no line of tests/results/quoted.txt:\n{}",
        hand.join("\n")
    );
}

#[test]
fn every_file_says_when_where_and_by_what_it_was_made() {
    let files = generated();
    assert!(!files.is_empty());
    for (kind, text) in files {
        let tables = tables(&text);
        let head = tables.first().unwrap_or_else(|| panic!("{kind}.md holds no table"));
        let names: Vec<_> = head.rows.iter().filter_map(|r| r.first()).map(String::as_str).collect();
        assert_eq!(names, HEADER, "{kind}.md: its first table");
        assert!(head.rows.iter().all(|r| r.get(1).is_some_and(|v| !v.is_empty())), "{kind}.md: an empty header");
        assert!(tables.len() > 1, "{kind}.md holds no result");
        for (table, row) in tables.iter().flat_map(|t| t.rows.iter().map(move |r| (t, r))) {
            assert_eq!(row.len(), table.head.len(), "{kind}.md: {row:?} below {:?}", table.head);
        }
    }
}

/// It never gets as far as building: `CARGO` is a program that fails.
#[test]
fn make_names_what_is_missing_and_leaves_the_old_files_alone() {
    let before = generated();
    let make = |words: &[&str]| {
        let script = root().join("tests/results/make");
        let output =
            Command::new("python3").arg(script).args(words).env("CARGO", "false").env("CAIRN_DATA", "/none").output();
        let output = output.ok()?;
        Some((output.status.success(), String::from_utf8_lossy(&output.stderr).into_owned()))
    };
    let Some((success, said)) = make(&["sequences", "calibration"]) else {
        println!("skipped: no python3");
        return;
    };
    assert!(!success && said.contains("sequences: not written: /none holds no folder with rgb.txt"), "{said}");
    assert!(said.contains("calibration: not written: /none/calib_opencv_left is not there"), "{said}");
    let (success, said) = make(&["sequence"]).expect("python3");
    assert!(!success && said.contains("there is no kind sequence; known: sequences, "), "{said}");
    assert!(make(&["--list"]).expect("python3").0);
    assert!(generated() == before, "a file was written");
}

#[cfg(test)]
mod engine {
    use super::*;

    const TEXT: &str = "# Kind\n\n| this run | |\n|---|---|\n| date | 2026-01-02 |\n\n## First\n\n```sh\n| no | table |\n```\n\n\
        | case | seed | ATE m | p50 / p95 ms |\n|---|---:|---:|---:|\n| far: a long way | 3 | 0.0447 | 2.53 / 13.52 |\n\
        | near: here | 3 | 1,234.5 | – |\n| near: here | 4 | -0.5 | 0.0090-0.0091 |\n\n\
        ## Second\n\n| case | ATE m | only here |\n|---|---|---|\n| far | **9** | `x` |\n";

    fn kinds() -> Results {
        BTreeMap::from([("kind".to_string(), tables(TEXT))])
    }

    fn filled(template: &str) -> Result<String, String> {
        render(template, &kinds()).map(|(text, _)| text)
    }

    #[test]
    fn places_are_filled() {
        for (template, text) in [
            ("| {kind | far | ATE m} |", "| 0.0447 |"),
            ("{kind|far: a long way|ATE m|.2} m", "0.04 m"),
            ("{kind # Second | far | ATE m}{kind | date |}", "92026-01-02"),
            ("{kind | far | only here}", "x"),
            ("{kind | near, 4 | ATE m}", "-0.5"),
            ("{kind | near: here, 3 | ATE m | .0}", "1234"),
            ("{kind | far | p50 / p95 ms | @2}", "13.52"),
            ("{kind | far | p50 / p95 ms | @2 | .1}", "13.5"),
            ("{kind | near, 4 | p50 / p95 ms | @2}", "0.0091"),
            ("{kind # Second | far | ATE m // kind | far | ATE m | .1} times", "201.3 times"),
            ("no place", "no place"),
        ] {
            assert_eq!(filled(template).as_deref(), Ok(text), "{template}");
        }
    }

    #[test]
    fn what_cannot_be_filled_says_why() {
        for (template, why) in [
            ("{kin | far | ATE m}", "no tests/results/kin.md"),
            ("{kind | fa | ATE m}", "no table of kind.md has a row \"fa\""),
            ("{kind | far | ATE}", "a column \"ATE\""),
            ("{kind # Third | far | ATE m}", "no table"),
            ("{kind | near | ATE m}", "2 rows are called"),
            ("{kind | far | p50 / p95 ms | .1}", "2 numbers"),
            ("{kind | far | p50 / p95 ms | @3}", "2 numbers"),
            ("{kind | near, 3 | p50 / p95 ms | .1}", "0 numbers"),
            ("{kind | far}", "kind | row | column"),
            ("{kind | far | ATE m // kind | near, 4 | ATE m}", "needs its decimals"),
            ("{kind | far | ATE m", "without }"),
        ] {
            let error = filled(template).expect_err(template);
            assert!(error.contains(why), "{template}: {error}");
        }
    }

    #[test]
    fn a_page_that_says_otherwise_is_found_with_what_it_ought_to_say() {
        let of = |template: &str, page: &str| {
            faults(&[("README.md".into(), template.into())], &kinds(), |_| page.to_string()).join("\n")
        };
        let template = "off by {kind | far | ATE m} m";
        assert_eq!(of(template, "It is off\n  by 0.0447 m."), "");
        assert!(of(template, "It is off by 0.0448 m.").ends_with("README.md ought to hold:\n    off by 0.0447 m"));
        assert!(of("off by 0.0447 m", "off by 0.0447 m").contains("types a figure by hand: 0.0447 m"));
        assert!(of("{kind | far | ATE m} m, 100 %", "0.0447 m, 100 %").contains("100 %"));
    }

    #[test]
    fn figures_are_numbers_with_a_decimal_point_or_a_unit() {
        for (text, expected) in [
            ("0.5 and 1,234.5", vec!["0.5", "1,234.5"]),
            ("100 %, 7%, 3 px, 12\u{a0}ms, 30° and 90 µs", vec!["100 %", "7 %", "3 px", "12 ms", "30 °", "90 µs"]),
            ("20 s, 3D, 8 readers, 2 maps, v1.0, k1, 640x480 px, 5. And 30 m/s, 1 MBit", vec![]),
            ("**66 MB**|4.8 ms", vec!["66 MB", "4.8 ms"]),
        ] {
            assert_eq!(figures(text).into_iter().map(|f| f.1).collect::<Vec<_>>(), expected, "{text}");
        }
    }

    #[test]
    fn a_figure_in_no_template_is_found_and_code_is_left_alone() {
        let page = "Off by `x` 0.04 m.\n```sh\nrun 0.5\n```\nSee [this](a/1.5.md), `0.2`. <!-- 0.3 --> Also 7 %.";
        let found = typed_by_hand(page, &["by `x` 0.04 m".into()]);
        assert!(matches!(&found[..], [one] if one.starts_with("7 %")), "{found:?}");
        assert_eq!(typed_by_hand(page, &["Off by `x` 0.04 m".into(), "Also 7 %".into()]), Vec::<String>::new());
        assert_eq!(typed_by_hand("0.04 m and 0.04", &["0.04 m".into()]).len(), 1);
    }
}
