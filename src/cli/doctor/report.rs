//! What `cairn doctor` has found, line by line.

use std::fmt::Write as _;

/// The report as it grows.
#[derive(Default)]
pub struct Report {
    pub text: String,
    /// What keeps `cairn run` from working.
    pub problems: usize,
    pub next: Vec<String>,
}

impl Report {
    pub fn title(&mut self, title: &str) {
        let _ = writeln!(self.text, "{title}");
    }
    pub fn good(&mut self, line: &str) {
        let _ = writeln!(self.text, "  ok    {line}");
    }
    pub fn note(&mut self, line: &str) {
        let _ = writeln!(self.text, "  note  {line}");
    }
    /// Nothing that keeps `cairn run` from working, but somebody should do something about it.
    pub fn warn(&mut self, line: &str, next: &str) {
        let _ = writeln!(self.text, "  warn  {line}");
        self.next.push(next.into());
    }
    pub fn bad(&mut self, line: &str, next: &str) {
        let _ = writeln!(self.text, "  FAIL  {line}");
        self.problems += 1;
        self.next.push(next.into());
    }
}
