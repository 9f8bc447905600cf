//! What a robot tells of itself: the DiagnosticArray of its bridge. Pure; believes nothing.

use std::time::Duration;

use serde::Serialize;

use crate::messages::Transform;
use crate::ros::{CdrError, Reader};
use crate::share::bridge::MOST_ANCHORS;

/// A bridge's diagnostics have some 1000 bytes at the most; what is longer than this is not copied.
pub const MOST_BYTES: usize = 16 * 1024;
/// Of the values of a status, of which a bridge tells fourteen.
const MOST_VALUES: u32 = 64;
/// The health has bits for as many.
const MOST_FAULTS: usize = 64;
/// Between two diagnostics: a day. Who names more is as good as silent.
const LONGEST_PERIOD: Duration = Duration::from_secs(86_400);
/// Letters of a word; the longest of ours has 17.
const LONGEST_WORD: usize = 32;
/// A message that says it is farther away than this, in m, is none of a robot's on a floor; a plot would show nothing else.
pub const FARTHEST_M: f64 = 100_000.0;

/// Why a message is none of a bridge's.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ReportError {
    #[error("{bytes} bytes, {MOST_BYTES} at most")]
    Long { bytes: usize },
    #[error(transparent)]
    Cdr(#[from] CdrError),
    #[error("no status")]
    Empty,
    #[error("{count} values, {MOST_VALUES} at most")]
    Many { count: u32 },
    #[error("the value of `{key}` is no word, or too many")]
    Word { key: &'static str },
    #[error("`period_s` is no time, or longer than a day")]
    Period,
    #[error("`map_anchors` are no places: a name, x and y, m, and yaw, rad, of {MOST_ANCHORS} at most")]
    Anchors,
    #[error("no `state`")]
    NoState,
}

/// How it is, in all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Level {
    Ok,
    Warning,
    Error,
    Unknown,
}

/// See module.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    pub level: Level,
    /// `TRACKING`, ...
    pub state: String,
    /// `UNKNOWN`, `ESTIMATED`, `METRIC`; `None` before the first pose.
    pub scale: Option<String>,
    /// `NO_CAMERA`, ...
    pub faults: Vec<String>,
    /// The map's frame, where others may have it: that of a dock.
    pub map_frame: Option<String>,
    /// Keyframes of the map that others may have, too, by their names, and where they are in it, on level ground.
    pub anchors: Vec<(u64, Transform)>,
    /// From one to the next while nothing changes; zero: not said.
    pub period: Duration,
}

fn anchors(text: &str) -> Result<Vec<(u64, Transform)>, ReportError> {
    let anchor = |text: &str| {
        let (name, place) = text.split_once(' ')?;
        let numbers: Vec<f64> = place.split(' ').map(|number| number.parse().ok()).collect::<Option<_>>()?;
        match numbers[..] {
            [x, y, yaw] if numbers.iter().all(|v| v.abs() <= FARTHEST_M) => {
                Some((u64::from_str_radix(name, 16).ok()?, Transform::level(x, y, yaw)))
            }
            _ => None,
        }
    };
    let told: Option<Vec<_>> = text.split(',').take(MOST_ANCHORS + 1).map(anchor).collect();
    told.filter(|told| told.len() <= MOST_ANCHORS).ok_or(ReportError::Anchors)
}

fn period(text: &str) -> Result<Duration, ReportError> {
    let period = text.parse().ok().and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    period.filter(|period| *period <= LONGEST_PERIOD).ok_or(ReportError::Period)
}

/// Text that can do nothing to a terminal.
fn word(text: &str, key: &'static str) -> Result<String, ReportError> {
    let is_word = (1..=LONGEST_WORD).contains(&text.len())
        && text.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_');
    if is_word { Ok(text.to_owned()) } else { Err(ReportError::Word { key }) }
}

impl Report {
    /// Of the first status; a bridge sends one.
    pub fn of(message: &[u8]) -> Result<Self, ReportError> {
        if message.len() > MOST_BYTES {
            return Err(ReportError::Long { bytes: message.len() });
        }
        let mut reader = Reader::new(message)?;
        let _stamp = (reader.i32()?, reader.u32()?);
        let _frame = reader.text()?;
        if reader.u32()? == 0 {
            return Err(ReportError::Empty);
        }
        let level = match reader.u8()? {
            0 => Level::Ok,
            1 => Level::Warning,
            2 => Level::Error,
            _ => Level::Unknown,
        };
        let _name_message_hardware = (reader.text()?, reader.text()?, reader.text()?);
        let count = reader.u32()?;
        if count > MOST_VALUES {
            return Err(ReportError::Many { count });
        }
        let (mut state, mut scale, mut map_frame, mut faults, mut every) =
            (None, None, None, Vec::new(), Duration::ZERO);
        let mut told = Vec::new();
        for _ in 0..count {
            match (reader.text()?, reader.text()?) {
                ("state", text) => state = Some(word(text, "state")?),
                ("scale", text) => scale = Some(word(text, "scale")?),
                ("map_frame", text) => map_frame = Some(word(text, "map_frame")?),
                ("map_anchors", text) => told = anchors(text)?,
                ("period_s", text) => every = period(text)?,
                ("faults", text) => {
                    let words = text.split_ascii_whitespace().take(MOST_FAULTS + 1);
                    faults = words.map(|text| word(text, "faults")).collect::<Result<_, _>>()?;
                    if faults.len() > MOST_FAULTS {
                        return Err(ReportError::Word { key: "faults" });
                    }
                }
                _ => {}
            }
        }
        Ok(Self {
            level,
            state: state.ok_or(ReportError::NoState)?,
            scale,
            faults,
            map_frame,
            anchors: told,
            period: every,
        })
    }
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use crate::messages::{Health, error};
    use crate::ros::Message;
    use crate::ros::standard::{DiagnosticArray, DiagnosticStatus, Header, KeyValue, Time};
    use crate::share::conversion::diagnostics;

    /// As a bridge sends it, with these values beside its own.
    pub fn message(health: &Health, more: &[(&'static str, &str)]) -> Vec<u8> {
        let mut status = diagnostics(health, "front");
        status.values.extend(more.iter().map(|&(key, value)| KeyValue { key, value: value.into() }));
        array(vec![status])
    }

    fn array(status: Vec<DiagnosticStatus<'_>>) -> Vec<u8> {
        DiagnosticArray { header: Header { stamp: Time::from_ns(1), frame_id: "" }, status }.to_cdr()
    }

    #[test]
    fn what_a_bridge_sends_is_read_back() {
        let health = Health { state: 1, errors: error::LOST | error::LOW_RATE, ..Health::default() };
        let report = Report::of(&message(&health, &[("scale", "METRIC")])).expect("a report");
        assert_eq!((report.level, report.state.as_str()), (Level::Error, health.state().name()));
        assert_eq!((report.scale.as_deref(), report.faults), (Some("METRIC"), vec!["LOST".into(), "LOW_RATE".into()]));
        let plain = Report::of(&message(&Health::default(), &[])).expect("a report");
        assert_eq!((plain.level, plain.scale, plain.faults.len()), (Level::Ok, None, 0));
        let slow = Report::of(&message(&Health::default(), &[("period_s", "20"), ("map_frame", "dock_36h11_5")]))
            .expect("a report");
        assert_eq!((slow.map_frame.as_deref(), plain.map_frame), (Some("dock_36h11_5"), None));
        assert_eq!((slow.period, plain.period), (Duration::from_secs(20), Duration::ZERO));
    }

    #[test]
    fn what_is_cut_off_lies_or_is_no_word_is_refused() {
        let whole = message(&Health::default(), &[("scale", "METRIC")]);
        for end in 0..whole.len() {
            assert!(Report::of(&whole[..end]).is_err(), "{end}");
        }
        let refused = |more: &[(&'static str, &str)]| Report::of(&message(&Health::default(), more)).expect_err("none");
        let long = "A".repeat(LONGEST_WORD + 1);
        for text in ["", "two words", "\u{1b}[2J", "ÄH", long.as_str()] {
            assert_eq!(refused(&[("state", text)]), ReportError::Word { key: "state" }, "{text:?}");
        }
        for text in ["", "-1", "NaN", "inf", "86401", "1e30"] {
            assert_eq!(refused(&[("period_s", text)]), ReportError::Period, "{text}");
        }
        let many = ["1 2 3 4"; MOST_ANCHORS + 1].join(",");
        for text in
            ["", "a", "a 1 2", "a 1 2 3 4", "a 1 2 NaN", "a 1e9 0 0", "a 1  2 3", "x 1 2 3", "a 1 2 3,", many.as_str()]
        {
            assert_eq!(refused(&[("map_anchors", text)]), ReportError::Anchors, "{text}");
        }
        let told = Report::of(&message(&Health::default(), &[("map_anchors", "1f 1 2 0.5,20 -1 0 0")]));
        let told = told.expect("a report").anchors;
        assert_eq!((told.len(), told[0], told[1].0), (2, (0x1f, Transform::level(1.0, 2.0, 0.5)), 0x20));
        assert_eq!(refused(&[("faults", "F ".repeat(MOST_FAULTS + 1).as_str())]), ReportError::Word { key: "faults" });
        assert_eq!(refused(&[("x", ""); 100]), ReportError::Many { count: 110 });
        assert_eq!(Report::of(&array(Vec::new())), Err(ReportError::Empty));
        let status = DiagnosticStatus { values: Vec::new(), ..diagnostics(&Health::default(), "front") };
        assert_eq!(Report::of(&array(vec![status])), Err(ReportError::NoState));
        assert_eq!(Report::of(&vec![0; MOST_BYTES + 1]), Err(ReportError::Long { bytes: MOST_BYTES + 1 }));
        // "x" of a value becomes a byte that is in no text.
        let mut wrong = message(&Health::default(), &[("x", "y")]);
        let at = wrong.iter().rposition(|byte| *byte == b'y').expect("y");
        wrong[at] = 0xff;
        assert_eq!(Report::of(&wrong), Err(ReportError::Cdr(CdrError::Text)));
    }
}
