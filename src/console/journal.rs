//! The daemon's log: the journal's tail, or a file's of JSON lines, read only while a page shows it.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use serde_json::{Map, Value, json};

use super::hub::{Hub, demand};

/// Longest record, bytes; a longer one is left out.
const MAX_LINE: usize = 8 * 1024;
/// Records of before that are read.
const BEFORE: &str = "200";
/// Bytes of a file of before that are read.
const BEFORE_BYTES: u64 = 128 * 1024;
/// Records of one message.
const BATCH: usize = 100;
const NAP: Duration = Duration::from_millis(200);
/// Pause before the journal is asked again.
const PAUSE: Duration = Duration::from_secs(3);
/// Fields of the journal that are its own and tell nothing of the robot.
const NOISE: [&str; 7] = ["SYSLOG_", "CODE_", "TARGET", "TID", "INVOCATION_ID", "JOB_", "UNIT"];

/// Where records come from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LogSource {
    /// A program that prints a JSON object a line, and goes on; in words, what its records are of.
    Program {
        words: Vec<String>,
        of: String,
    },
    File(PathBuf),
}

impl LogSource {
    /// The journal of a unit.
    pub fn journal(unit: &str) -> Self {
        let words = ["journalctl", "--quiet", "--follow", "--output=json", "--lines", BEFORE, "--unit", unit];
        let of = format!(
            "The journal of the unit {unit}, as far as this user may read it. A daemon that runs in a terminal is not in it: write its log to a \
             file (cairn demo --log info 2>FILE) and start the console with --log-file FILE to see it here."
        );
        Self::Program { words: words.map(String::from).to_vec(), of }
    }

    /// Where records come from, before any does: whoever sees none is to know where to look.
    fn origin(&self) -> Value {
        match self {
            Self::Program { of, .. } => note(of),
            Self::File(path) => note(&format!("The file {}.", path.display())),
        }
    }
}

/// What the console itself says of the log.
fn note(text: &str) -> Value {
    json!({ "level": "NOTE", "message": text })
}

/// Until `stop`.
pub fn run(hub: &Hub, source: &LogSource, stop: &AtomicBool) {
    while !stop.load(Ordering::Relaxed) {
        if !hub.wants(demand::LOG) {
            std::thread::sleep(NAP);
            continue;
        }
        hub.begin_log(vec![source.origin()]);
        let wanted = || hub.wants(demand::LOG) && !stop.load(Ordering::Relaxed);
        let end = match source {
            LogSource::Program { words, .. } => follow_program(words, &wanted, &mut |records| hub.tell_log(records)),
            LogSource::File(path) => follow_file(path, &wanted, &mut |records| hub.tell_log(records)),
        };
        if let Err(reason) = end {
            hub.tell_log(vec![note(&reason)]);
            super::feed::wait(stop, PAUSE);
        }
    }
}

type Sink<'a> = &'a mut dyn FnMut(Vec<Value>);

/// Ends the program with whoever reads it.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn follow_program(words: &[String], wanted: &dyn Fn() -> bool, sink: Sink<'_>) -> Result<(), String> {
    let Some((program, arguments)) = words.split_first() else { return Ok(()) };
    let hint = "start the console with --log-file FILE to read a daemon's log from a file";
    let mut command = Command::new(program);
    command.args(arguments).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut child = Running(command.spawn().map_err(|e| format!("{program} cannot be run ({e}): {hint}"))?);
    let Some(mut out) = child.0.stdout.take() else { return Ok(()) };
    let mut lines = Lines::default();
    while wanted() {
        if !readable(&out) {
            continue;
        }
        match lines.read(&mut out) {
            Ok(0) => {
                return Err(format!(
                    "{program} has ended: there is no journal here, or this user may not read it; {hint}"
                ));
            }
            Ok(_) => lines.drain(sink),
            Err(e) => return Err(format!("{program}: {e}")),
        }
    }
    Ok(())
}

fn readable(out: &ChildStdout) -> bool {
    let nap = Timespec { tv_sec: 0, tv_nsec: NAP.as_nanos() as i64 };
    matches!(poll(&mut [PollFd::new(out, PollFlags::IN)], Some(&nap)), Ok(1..))
}

fn follow_file(path: &Path, wanted: &dyn Fn() -> bool, sink: Sink<'_>) -> Result<(), String> {
    let fault = |e: io::Error| format!("{}: {e}", path.display());
    let mut file = File::open(path).map_err(fault)?;
    let mut length = file.metadata().map_err(fault)?.len();
    let mut lines = Lines::default();
    if length > BEFORE_BYTES {
        file.seek(SeekFrom::Start(length - BEFORE_BYTES)).map_err(fault)?;
        lines.skipping = true;
    }
    while wanted() {
        if lines.read(&mut file).map_err(fault)? > 0 {
            lines.drain(sink);
            continue;
        }
        std::thread::sleep(NAP);
        // Another file of that name, or one that was emptied, is read from its beginning.
        let there = std::fs::metadata(path).map_err(fault)?;
        let ours = file.metadata().map_err(fault)?;
        if there.ino() != ours.ino() || there.len() < length {
            (file, lines) = (File::open(path).map_err(fault)?, Lines::default());
        }
        length = there.len();
    }
    Ok(())
}

/// Cuts bytes into records.
#[derive(Debug, Default)]
struct Lines {
    bytes: Vec<u8>,
    /// The rest of a line that is not wanted.
    skipping: bool,
}

impl Lines {
    fn read(&mut self, from: &mut impl Read) -> io::Result<usize> {
        let mut chunk = [0; 16 * 1024];
        let n = from.read(&mut chunk)?;
        self.bytes.extend_from_slice(&chunk[..n]);
        Ok(n)
    }

    fn drain(&mut self, sink: Sink<'_>) {
        let mut records = Vec::new();
        while let Some(end) = self.bytes.iter().position(|b| *b == b'\n') {
            let line: Vec<u8> = self.bytes.drain(..=end).collect();
            if !std::mem::take(&mut self.skipping) {
                records.extend(record(&line));
            }
            if records.len() >= BATCH {
                sink(std::mem::take(&mut records));
            }
        }
        if self.bytes.len() > MAX_LINE {
            (self.bytes, self.skipping) = (Vec::new(), true);
        }
        if !records.is_empty() {
            sink(records);
        }
    }
}

/// A record as the page shows it: time, level, message and the record's own fields, in small letters; `None` for what is no record.
fn record(line: &[u8]) -> Option<Value> {
    let Ok(Value::Object(object)) = serde_json::from_slice(line) else {
        return human(String::from_utf8_lossy(line).trim());
    };
    let is_journal = object.contains_key("__REALTIME_TIMESTAMP");
    let (mut out, mut fields) = (Map::new(), Map::new());
    for (key, value) in object {
        match key.as_str() {
            "MESSAGE" | "message" => drop(out.insert("message".into(), value)),
            "PRIORITY" if is_journal => drop(out.insert("level".into(), level(value.as_str()).into())),
            "level" => drop(out.insert("level".into(), value)),
            "timestamp" => drop(out.insert("time".into(), value)),
            "__REALTIME_TIMESTAMP" => {
                let us = value.as_str().and_then(|us| us.parse::<f64>().ok());
                out.insert("time".into(), us.map_or(Value::Null, |us| (us / 1000.0).into()));
            }
            "target" => {}
            key if is_journal && (key.starts_with('_') || NOISE.iter().any(|noise| key.starts_with(noise))) => {}
            key => drop(fields.insert(key.to_lowercase(), value)),
        }
    }
    out.insert("fields".into(), Value::Object(fields));
    Some(Value::Object(out))
}

/// A line for a person: as on a terminal, time and level first, or any other.
fn human(line: &str) -> Option<Value> {
    let mut words = line.split_whitespace();
    if let (Some(time), Some(level @ ("ERROR" | "WARN" | "INFO" | "DEBUG" | "TRACE"))) = (words.next(), words.next())
        && let Some((_, message)) = line.split_once(level)
    {
        let (message, fields) = parts(message.trim());
        return Some(json!({ "time": time, "level": level, "message": message, "fields": fields }));
    }
    (!line.is_empty()).then(|| json!({ "level": "INFO", "message": line, "fields": {} }))
}

/// Message and fields of `words name=value name="words"`: a field reaches up to the next one's name outside of quotes.
fn parts(line: &str) -> (&str, Map<String, Value>) {
    let is_name = |name: &str| {
        let mut characters = name.chars();
        characters.next().is_some_and(|c| c.is_ascii_lowercase())
            && characters.all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || matches!(c, '_' | '.'))
    };
    // Where each field begins, and its name.
    let (mut starts, mut at, mut quoted) = (Vec::new(), 0, false);
    for word in line.split_inclusive(' ') {
        if !quoted && let Some((name, _)) = word.split_once('=').filter(|(name, _)| is_name(name)) {
            starts.push((at, name));
        }
        let quotes = word.matches('"').count() - word.matches("\\\"").count();
        quoted ^= quotes % 2 == 1;
        at += word.len();
    }
    let ends = starts.iter().skip(1).map(|(start, _)| *start).chain([line.len()]);
    let field = |((start, name), end): (&(usize, &str), usize)| {
        let value = line[start + name.len() + 1..end].trim();
        let bare = value.strip_prefix('"').and_then(|v| v.strip_suffix('"')).unwrap_or(value);
        ((*name).to_owned(), bare.into())
    };
    let message = starts.first().map_or(line, |(start, _)| line[..*start].trim());
    (message, starts.iter().zip(ends).map(field).collect())
}

/// Of syslog's numbers.
fn level(priority: Option<&str>) -> &'static str {
    match priority.and_then(|p| p.parse::<u8>().ok()) {
        Some(0..=3) => "ERROR",
        Some(4) => "WARN",
        Some(7) => "DEBUG",
        _ => "INFO",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::console::outbox::Next;

    #[test]
    fn records_of_journal_and_file_look_alike() {
        let journal = br#"{"__REALTIME_TIMESTAMP":"1700000000000000","PRIORITY":"4","MESSAGE":"fault began","FAULT":"LOST","_PID":"7","CODE_FILE":"x","TARGET":"t"}"#;
        let made = record(journal).expect("record");
        assert_eq!(
            made,
            json!({ "time": 1.7e12, "level": "WARN", "message": "fault began", "fields": { "fault": "LOST" } })
        );
        let file = br#"{"timestamp":"2026-01-01T00:00:00Z","level":"WARN","message":"fault began","target":"t","fault":"LOST"}"#;
        let made = record(file).expect("record");
        assert_eq!(made["fields"], json!({ "fault": "LOST" }));
        assert_eq!(record(b"plain words\n"), Some(json!({ "level": "INFO", "message": "plain words", "fields": {} })));
        let terminal = record(b"2026-11-23T15:01:24Z  WARN fault began fault=\"LOST\"\n").expect("record");
        assert_eq!((&terminal["level"], &terminal["message"]), (&json!("WARN"), &json!("fault began")));
        assert_eq!(terminal["fields"], json!({ "fault": "LOST" }));
        for (line, message, fields) in [
            ("no field", "no field", json!({})),
            ("a=1 alone", "", json!({ "a": "1 alone" })),
            (
                r#"kept, 2 = 2 path="/a b=c \" d=e" n=1.5 reason=no such file x.y=-1"#,
                "kept, 2 = 2",
                json!({ "path": r#"/a b=c \" d=e"#, "n": "1.5", "reason": "no such file", "x.y": "-1" }),
            ),
        ] {
            let made = record(format!("2026-11-23T15:01:24Z  INFO {line}\n").as_bytes()).expect("record");
            assert_eq!((&made["message"], &made["fields"]), (&json!(message), &fields), "{line}");
        }
        assert_eq!(record(b"\n"), None);
    }

    #[test]
    fn a_line_without_an_end_is_left_out() {
        let mut lines = Lines::default();
        let mut got = Vec::new();
        let text = [vec![b'x'; 3 * MAX_LINE], b"\n{\"message\":\"good\"}\n".to_vec()].concat();
        let mut from = text.as_slice();
        while lines.read(&mut from).expect("memory") > 0 {
            lines.drain(&mut |records| got.extend(records));
            assert!(lines.bytes.len() <= MAX_LINE + 16 * 1024);
        }
        assert_eq!(got.len(), 1);
        assert_eq!(got[0]["message"], "good");
    }

    #[test]
    fn a_file_is_followed_when_it_grows_and_when_it_is_replaced() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("log");
        std::fs::write(&path, "{\"message\":\"1\"}\n").expect("file");
        let (mut got, step) = (Vec::new(), std::cell::Cell::new(0));
        let wanted = || {
            step.set(step.get() + 1);
            let more = "{\"message\":\"2\"}\n{\"message\":\"1\"}\n";
            match step.get() {
                3 => std::fs::write(folder.path().join("new"), "{\"message\":\"3\"}\n").expect("file"),
                4 => std::fs::rename(folder.path().join("new"), &path).expect("renamed"),
                2 => std::fs::write(&path, more).expect("file"),
                _ => {}
            }
            step.get() < 10
        };
        follow_file(&path, &wanted, &mut |records| got.extend(records.iter().map(|r| r["message"].clone())))
            .expect("file");
        assert_eq!(got.first(), Some(&json!("1")));
        assert_eq!(got.last(), Some(&json!("3")));
    }

    /// What a page is told of the log once it shows it, until this many records have come.
    fn shown(source: &LogSource, count: usize) -> Vec<Value> {
        let (hub, stop) = (Hub::default(), AtomicBool::new(false));
        let page = hub.join().expect("a page");
        page.open();
        page.set_demand(demand::LOG);
        let mut got = Vec::new();
        std::thread::scope(|scope| {
            scope.spawn(|| run(&hub, source, &stop));
            while got.len() < count
                && let Next::Send(message) = page.next(Duration::from_secs(20))
            {
                let told: Value = serde_json::from_slice(&message[8..]).expect("JSON");
                got.extend(told["records"].as_array().expect("records").iter().cloned());
            }
            stop.store(true, Ordering::Relaxed);
        });
        got
    }

    #[test]
    fn a_journal_without_records_says_whose_it_is_and_where_others_are() {
        let LogSource::Program { of, .. } = LogSource::journal("cairn") else { panic!("a program") };
        let told = shown(&LogSource::Program { words: vec!["sleep".into(), "60".into()], of }, 1);
        assert_eq!(told[0]["level"], "NOTE");
        let words = told[0]["message"].as_str().expect("text");
        assert!(words.contains("the unit cairn,") && words.contains("--log-file FILE"), "{words}");
    }

    #[test]
    fn a_file_says_which_it_is_before_its_records() {
        let file = tempfile::NamedTempFile::new().expect("file");
        std::fs::write(file.path(), "{\"message\":\"1\"}\n").expect("written");
        let told = shown(&LogSource::File(file.path().into()), 2);
        assert_eq!(told[0], note(&format!("The file {}.", file.path().display())));
        assert_eq!(told[1]["message"], "1");
    }

    #[test]
    fn a_program_that_is_not_there_is_told() {
        let words = vec!["/nowhere/journalctl".to_owned()];
        let reason = follow_program(&words, &|| true, &mut |_| {}).expect_err("not there");
        assert!(reason.contains("--log-file"), "{reason}");
    }
}
