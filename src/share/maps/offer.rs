//! What both sides of a fetched map agree on. Pure.

use zenoh::query::Parameters;

/// Bytes of a piece: a fifth of a second of a radio link with 10 Mbit/s, so that what is more urgent waits no longer behind one.
pub const PIECE: u64 = 256 * 1024;
/// Bytes of a map that is given or taken: some 11,000 keyframes of 640 x 480 pictures.
pub const MOST_BYTES: u64 = 1 << 30;
/// Bytes of an offer's text, which has 80.
pub const LONGEST_OFFER: usize = 256;

/// Of a query: the map's name, and of a piece the version and where it begins.
pub const MAP: &str = "map";
pub const VERSION: &str = "version";
pub const OFFSET: &str = "offset";
const BYTES: &str = "bytes";
const CHECKSUM: &str = "xxh3";

/// A map that is held to be fetched.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Offer {
    pub bytes: u64,
    /// XXH3, 128 bits, of all of them.
    pub checksum: u128,
    /// Says the giver which state of the file is meant; letters and digits.
    pub version: String,
}

impl Offer {
    pub fn to_text(&self) -> String {
        let Self { bytes, checksum, version } = self;
        format!("{BYTES}={bytes};{CHECKSUM}={checksum:032x};{VERSION}={version}")
    }

    /// `None`: it is none, or of a size that nobody may offer.
    pub fn of_text(text: &str) -> Option<Self> {
        let values = Parameters::from(text);
        let bytes = values.get(BYTES)?.parse().ok().filter(|bytes| (1..=MOST_BYTES).contains(bytes))?;
        let checksum = u128::from_str_radix(values.get(CHECKSUM)?, 16).ok()?;
        let version = values.get(VERSION).filter(|version| is_version(version))?;
        (text.len() <= LONGEST_OFFER).then(|| Self { bytes, checksum, version: version.to_owned() })
    }

    /// Bytes of the piece that begins there.
    pub fn piece(&self, offset: u64) -> u64 {
        self.bytes.saturating_sub(offset).min(PIECE)
    }
}

fn is_version(text: &str) -> bool {
    (1..=32).contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_alphanumeric())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_offer_is_read_back_and_what_lies_is_none() {
        let offer = Offer { bytes: 300_000, checksum: 0xab, version: "7".into() };
        assert_eq!(Offer::of_text(&offer.to_text()), Some(offer.clone()));
        assert_eq!([0, PIECE, 300_000, u64::MAX].map(|at| offer.piece(at)), [PIECE, 37_856, 0, 0]);
        let text = offer.to_text();
        for (from, to) in [
            ("bytes=300000", "bytes=0".to_owned()),
            ("bytes=300000", format!("bytes={}", MOST_BYTES + 1)),
            ("bytes=300000", "bytes=-1".into()),
            ("bytes=", "size=".into()),
            ("xxh3=", "xxh3=g".into()),
            ("version=7", "version=".into()),
            ("version=7", "version=\u{1b}[2J".into()),
            ("version=7", format!("version=7;x={}", "x".repeat(LONGEST_OFFER))),
        ] {
            assert_eq!(Offer::of_text(&text.replace(from, &to)), None, "{to}");
        }
        assert_eq!(Offer::of_text(""), None);
    }
}
