//! A recording's wheel odometry: `odometry.txt` beside `rgb.txt`.
//!
//! A line: `timestamp linear_x_mps linear_y_mps angular_z_radps`, seconds in the clock of `rgb.txt`, m/s, m/s, rad/s: the mean twist of the base over
//! the interval that ends at the stamp (and starts at the line before; a gap of over 0.5 s is missing data and not standing), in the base frame
//! at the interval's start (REP-103: x forward, y left, yaw positive to the left). Blank lines and those that begin with `#` are comments.
//!
//! A line that is not of the form is an error with file and line, as in `rgb.txt`. Values that cannot be (NaN, an absurd speed, a time that goes
//! back, or jumps ahead of lines that follow, a clock of its own) are a driver's failing: the line is named in the log, counted, and not believed. What
//! ends long before the first picture concerns nobody.

use std::path::Path;

use tracing::warn;

use super::super::SourceError;
use super::list::{contents, shortened};
use crate::motion::wheel::{GAP_NS, WheelFault, WheelMessage};
use crate::trajectory::{format_timestamp, parse_timestamp};

/// One believable or unbelievable line; `fault`: known without the lines before it.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Line {
    message: WheelMessage,
    fault: Option<WheelFault>,
}

/// The lines of one file, handed out once, in the file's order.
#[derive(Debug, Default)]
pub struct Odometry {
    lines: Vec<Line>,
    next: usize,
}

impl Odometry {
    /// Reads the whole file. `pictures_ns`: first and last timestamp of the recording's pictures.
    pub fn read(path: &Path, pictures_ns: (i64, i64)) -> Result<Self, SourceError> {
        let name = path.display().to_string();
        let failed = |place: &str, reason: String| SourceError::Open { path: place.into(), reason };
        let text = contents(path)?;
        let mut lines = Vec::new();
        for (number, line) in (1..).zip(text.lines()) {
            let line = line.trim();
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let message = parse_line(number, line).map_err(|reason| failed(&format!("{name}:{number}"), reason))?;
            lines.push(Line { message, fault: None });
        }
        doubt_jumps(&mut lines, pictures_ns.1);
        let stamps = || lines.iter().filter(|line| line.fault.is_none()).map(|line| line.message.timestamp_ns);
        let Some((first, last)) = stamps().min().zip(stamps().max()) else {
            warn!(file = name, lines = 0, "no wheel reading lies between the pictures");
            return Ok(Self::default());
        };
        if last < pictures_ns.0 || first > pictures_ns.1 {
            let [from, to, pictures_from, pictures_to] =
                [first, last, pictures_ns.0, pictures_ns.1].map(format_timestamp);
            let (count, file) = (lines.len(), name.as_str());
            warn!(
                file,
                lines = count,
                from,
                to,
                pictures_from,
                pictures_to,
                "no wheel reading lies between the pictures"
            );
            for line in &mut lines {
                let ahead_ns = line.message.timestamp_ns.saturating_sub(pictures_ns.0);
                line.fault = Some(WheelFault::WrongClock { ahead_ns });
            }
        }
        // From before the camera ran: with the first picture they would come all at once, and leave no room for those that matter.
        let begin_ns = pictures_ns.0.saturating_sub(GAP_NS);
        let is_early = |line: &Line| line.fault.is_none() && line.message.timestamp_ns < begin_ns;
        let early = lines.iter().position(|line| line.fault.is_none() && !is_early(line)).unwrap_or(0);
        let mut number = 0;
        lines.retain(|line| {
            number += 1;
            number > early || line.fault.is_some()
        });
        Ok(Self { lines, next: 0 })
    }

    /// Gives what the file has up to `until_ns`, and what is wrong with it, each line once.
    pub fn give(&mut self, until_ns: i64, to: &mut dyn FnMut(&WheelMessage, Option<WheelFault>)) {
        while let Some(line) = self.lines.get(self.next)
            && (line.fault.is_some() || line.message.timestamp_ns <= until_ns)
        {
            to(&line.message, line.fault);
            self.next += 1;
        }
    }
}

/// Faults lines that jump ahead: believed, each would shut out all that follow. Which of two lines is wrong, one ahead or one behind, the most say: as
/// many lines are kept as can be in ascending time. Those after the last picture are none of them where a line follows that is not.
fn doubt_jumps(lines: &mut [Line], last_picture_ns: i64) {
    let stamp = |i: usize| lines[i].message.timestamp_ns;
    let inside = (0..lines.len()).rev().find(|i| stamp(*i) <= last_picture_ns).unwrap_or(0);
    // Longest ascending subsequence: ends[n] is the line of least stamp that n + 1 ascending lines end with.
    let (mut ends, mut before) = (Vec::<usize>::new(), vec![None; lines.len()]);
    for i in (0..lines.len()).filter(|i| *i >= inside || stamp(*i) <= last_picture_ns) {
        let n = ends.partition_point(|end| stamp(*end) < stamp(i));
        before[i] = n.checked_sub(1).map(|n| ends[n]);
        match ends.get_mut(n) {
            Some(end) => *end = i,
            None => ends.push(i),
        }
    }
    let mut kept = ends.last().copied();
    // Backwards: `next` is the kept line that follows.
    let (mut next, mut jumps) = (None, Vec::new());
    for i in (0..lines.len()).rev() {
        if kept == Some(i) {
            (kept, next) = (before[i], Some(i));
        } else if let Some(by_ns) = next.map(|next| stamp(i).saturating_sub(stamp(next))).filter(|by_ns| *by_ns > 0) {
            jumps.push((i, by_ns));
        }
    }
    for (i, by_ns) in jumps {
        lines[i].fault = Some(WheelFault::JumpsAhead { by_ns });
    }
}

fn parse_line(number: u64, line: &str) -> Result<WheelMessage, String> {
    const NAMES: [&str; 3] = ["linear_x_mps", "linear_y_mps", "angular_z_radps"];
    let fields: Vec<&str> = line.split_whitespace().collect();
    let [time, ref values @ ..] = fields[..] else { return Err("is empty".into()) };
    if values.len() != NAMES.len() {
        let form = "'timestamp linear_x_mps linear_y_mps angular_z_radps'";
        return Err(format!("has {} values, must be {form}, not {}", fields.len(), shortened(line)));
    }
    let timestamp_ns = parse_timestamp(time).map_err(|e| format!("timestamp {} {e}", shortened(time)))?;
    let mut twist = [0.0; 3];
    for ((value, name), field) in twist.iter_mut().zip(NAMES).zip(values) {
        *value = field.parse().map_err(|_| format!("{name} {} is not a number", shortened(field)))?;
    }
    Ok(WheelMessage::new(number, timestamp_ns, twist))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Odometry, String> {
        read_with(text, (0, 100_000_000_000))
    }

    fn read_with(text: &str, pictures_ns: (i64, i64)) -> Result<Odometry, String> {
        let dir = tempfile::tempdir().expect("temporary folder");
        let path = dir.path().join("odometry.txt");
        std::fs::write(&path, text).expect("written");
        Odometry::read(&path, pictures_ns).map_err(|e| e.to_string())
    }

    /// Line numbers and faults of what comes up to a time, s.
    fn given(odometry: &mut Odometry, until_s: f64) -> Vec<(u64, Option<&'static str>)> {
        let mut all = Vec::new();
        odometry.give((until_s * 1e9) as i64, &mut |m, fault| all.push((m.number, fault.map(|f| f.name()))));
        all
    }

    #[test]
    fn lines_come_once_and_not_before_their_time() {
        let mut odometry = read("# base\n0.02 0.5 0 0.1\n\n0.04 0.5 0 -1e-1\n0.06 nan 0 0\n").expect("read");
        assert_eq!(given(&mut odometry, 0.01), []);
        assert_eq!(given(&mut odometry, 0.04), [(2, None), (4, None)]);
        assert_eq!(given(&mut odometry, 1.0), [(5, None)], "the queue judges values");
        assert_eq!(given(&mut odometry, 1.0), []);
    }

    #[test]
    fn a_malformed_line_is_an_error_with_file_line_and_value() {
        for (text, parts) in [
            ("0.02 0.5 0\n", ["odometry.txt:1", "has 3 values"]),
            ("#\n0.02 0.5 0 0 0\n", ["odometry.txt:2", "has 5 values"]),
            ("0.02 0.5 zero 0\n", ["odometry.txt:1", "linear_y_mps \"zero\" is not a number"]),
            ("0.0x 0.5 0 0\n", ["odometry.txt:1", "timestamp \"0.0x\""]),
        ] {
            let error = read(text).expect_err(text);
            assert!(parts.iter().all(|part| error.contains(part)), "{error}");
        }
    }

    #[test]
    fn one_line_far_ahead_does_not_shut_out_those_that_follow() {
        let text = "0.02 0 0 0\n9.04 0 0 0\n0.06 0 0 0\n0.08 0 0 0\n0.05 0 0 0\n0.10 0 0 0\n";
        let mut odometry = read(text).expect("read");
        assert_eq!(
            given(&mut odometry, 1.0),
            [(1, None), (2, Some("jumps_ahead")), (3, None), (4, None), (5, None), (6, None)],
            "line 5 goes back, which the queue sees"
        );
    }

    #[test]
    fn any_number_of_lines_an_hour_ahead_are_counted_and_shut_out_nothing() {
        for bad in [2, 50] {
            // Among the first, after the last picture; and in the middle, before it.
            for (begin, ahead) in [(0, 3600.0), (100, 3600.0), (100, 60.0)] {
                let stamp =
                    |k: usize| 0.02 * (k + 1) as f64 + if (begin..begin + bad).contains(&k) { ahead } else { 0.0 };
                let text: String = (0..300).map(|k| format!("{:.2} 1 0 0\n", stamp(k))).collect();
                let all = given(&mut read(&text).expect("read"), 100.0);
                assert_eq!(all.len(), 300, "{bad} from {begin}");
                let is_right = |(number, fault): &(u64, Option<&str>)| {
                    let is_bad = (begin..begin + bad).contains(&(*number as usize - 1));
                    *fault == is_bad.then_some("jumps_ahead")
                };
                assert!(all.iter().all(is_right), "{bad} from {begin}, {ahead} s ahead: {all:?}");
            }
        }
    }

    #[test]
    fn a_long_hole_is_no_jump_and_what_ends_before_the_camera_ran_is_left_out() {
        let text = "0.02 1 0 0\n0.04 1 0 0\n9.00 1 0 0\n9.02 1 0 0\n";
        assert_eq!(given(&mut read(text).expect("read"), 10.0).iter().filter(|line| line.1.is_some()).count(), 0);
        let early: String = (0..1000).map(|k| format!("{:.2} 1 0 0\n", 0.02 * f64::from(k))).collect();
        let mut odometry = read_with(&early, (10_000_000_000, 90_000_000_000)).expect("read");
        assert_eq!(given(&mut odometry, 100.0).first(), Some(&(476, None)), "9.50 s");
    }

    #[test]
    fn each_line_of_another_clock_is_counted_and_one_of_comments_has_none() {
        let mut odometry = read("1305031102.1 1 0 0\n1305031102.2 1 0 0\n").expect("read");
        assert_eq!(given(&mut odometry, 0.0), [(1, Some("wrong_clock")), (2, Some("wrong_clock"))]);
        assert_eq!(given(&mut read("# nothing yet\n").expect("read"), 1e9), []);
    }
}
