//! Timestamps as text: decimal seconds, exactly, to and from whole nanoseconds.
//!
//! A `f64` of today's Unix time has a resolution of 0.24 us: not enough to give a frame its own timestamp back. So text
//! is read digit by digit into nanoseconds and written from them. Cost: some 50 ns each, no allocation when displayed.

use std::fmt;

const NANOSECONDS_PER_SECOND: u64 = 1_000_000_000;

/// Why a text is no timestamp.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum TimestampError {
    #[error("is not a decimal number of seconds")]
    Malformed,
    #[error("is out of range for seconds (are these nanoseconds?)")]
    OutOfRange,
}

/// Decimal seconds (`1305031102.175304`, `.5`, `1.305e9`, negative ones too) to nanoseconds. Digits beyond the ninth are
/// rounded half away from zero.
pub fn parse_timestamp(text: &str) -> Result<i64, TimestampError> {
    use TimestampError::{Malformed, OutOfRange};
    let (negative, rest) = match text.as_bytes().first() {
        Some(b'-') => (true, &text[1..]),
        Some(b'+') => (false, &text[1..]),
        _ => (false, text),
    };
    let (mantissa, exponent) = match rest.find(['e', 'E']) {
        Some(at) => (&rest[..at], rest[at + 1..].parse::<i32>().map_err(|_| Malformed)?),
        None => (rest, 0),
    };
    // value = digits * 10^power seconds; 30 digits fit in i128 with room for the shift to nanoseconds.
    const MAX_DIGITS: u32 = 30;
    let (mut digits, mut count, mut power) = (0_i128, 0_u32, exponent);
    let (mut seen_digit, mut seen_point) = (false, false);
    for byte in mantissa.bytes() {
        match byte {
            b'0'..=b'9' => {
                seen_digit = true;
                if count < MAX_DIGITS {
                    digits = digits * 10 + i128::from(byte - b'0');
                    count += u32::from(digits != 0);
                    power = power.checked_sub(i32::from(seen_point)).ok_or(OutOfRange)?;
                } else if !seen_point {
                    power = power.checked_add(1).ok_or(OutOfRange)?;
                }
            }
            b'.' if !seen_point => seen_point = true,
            _ => return Err(Malformed),
        }
    }
    if !seen_digit {
        return Err(Malformed);
    }
    if digits == 0 {
        return Ok(0);
    }
    let shift = power.checked_add(9).ok_or(OutOfRange)?;
    let magnitude = match u32::try_from(shift) {
        Ok(up) => 10_i128.checked_pow(up).and_then(|factor| digits.checked_mul(factor)).ok_or(OutOfRange)?,
        // More digits than nanoseconds: a divisor that does not fit means that nothing is left.
        Err(_) => match 10_i128.checked_pow(shift.unsigned_abs()) {
            Some(divisor) => (digits + divisor / 2) / divisor,
            None => 0,
        },
    };
    i64::try_from(if negative { -magnitude } else { magnitude }).map_err(|_| OutOfRange)
}

/// Seconds with six decimals, or nine if six would lose something: `rgb.txt`'s way of writing them.
pub fn format_timestamp(timestamp_ns: i64) -> String {
    TimestampText(timestamp_ns).to_string()
}

/// [`format_timestamp`] without an allocation.
#[derive(Debug, Clone, Copy)]
pub struct TimestampText(pub i64);

impl fmt::Display for TimestampText {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let sign = if self.0 < 0 { "-" } else { "" };
        let magnitude = self.0.unsigned_abs();
        let (seconds, ns) = (magnitude / NANOSECONDS_PER_SECOND, magnitude % NANOSECONDS_PER_SECOND);
        if ns % 1000 == 0 {
            write!(f, "{sign}{seconds}.{:06}", ns / 1000)
        } else {
            write!(f, "{sign}{seconds}.{ns:09}")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use proptest::test_runner::RngSeed;

    #[test]
    fn the_digits_of_real_files_come_back() {
        for text in ["1305031102.175304", "0.000000", "0.033333", "9.966667", "-1.500000", "1403636579.763555584"] {
            assert_eq!(format_timestamp(parse_timestamp(text).unwrap()), text);
        }
    }

    #[test]
    fn other_ways_to_write_a_number_are_read_exactly() {
        for (text, ns) in [
            ("1305031101.1759", 1_305_031_101_175_900_000),
            ("1.305031102175304000e+09", 1_305_031_102_175_304_000),
            (".5", 500_000_000),
            ("5.", 5_000_000_000),
            ("+2", 2_000_000_000),
            ("1E-9", 1),
            ("0.00000000049", 0),
            ("0.0000000005", 1),
            ("-0.0000000005", -1),
            ("0e999999999", 0),
            ("1e-999999999", 0),
            ("0.1234567894999999999999999999999999999999999999", 123_456_789),
        ] {
            assert_eq!(parse_timestamp(text), Ok(ns), "{text}");
        }
    }

    #[test]
    fn what_is_no_timestamp_is_refused() {
        for text in ["", "-", ".", "nan", "inf", "1.2.3", "1,5", "0x10", "1e", "1e1.5", "--1", "1 2", "१"] {
            assert_eq!(parse_timestamp(text), Err(TimestampError::Malformed), "{text:?}");
        }
        for text in ["1403636579763555584", "1e10", "1e999999999", "99999999999999999999999999999999999999999"] {
            assert_eq!(parse_timestamp(text), Err(TimestampError::OutOfRange), "{text:?}");
        }
    }

    fn seeded(cases: u32) -> ProptestConfig {
        ProptestConfig { cases, rng_seed: RngSeed::Fixed(11), failure_persistence: None, ..Default::default() }
    }

    #[test]
    fn every_nanosecond_round_trips() {
        proptest!(seeded(2000), |(ns in any::<i64>())| {
            prop_assert_eq!(parse_timestamp(&format_timestamp(ns)), Ok(ns));
        });
    }

    #[test]
    fn no_text_panics() {
        proptest!(seeded(2000), |(bytes in proptest::collection::vec(proptest::sample::select(b"-+0123456789.eE".to_vec()), 0..60))| {
            let _ = parse_timestamp(std::str::from_utf8(&bytes).unwrap());
        });
    }
}
