//! The side that wants a map.

use std::io;
use std::path::Path;
use std::str::FromStr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use xxhash_rust::xxh3::Xxh3;
use zenoh::qos::Priority;
use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

use super::offer::{LONGEST_OFFER, MAP, OFFSET, Offer, VERSION};
use crate::share::bridge::names::{maps_key, owner_of_maps};
use crate::share::bridge::{BridgeError, Robot, reason, session};

/// An offer needs two answers of the daemon where one holds the map, 30 s each, and the file is read once.
const OFFER_TIMEOUT: Duration = Duration::from_secs(120);
/// Of a piece: 256 KiB in it are 0.2 Mbit/s.
const PIECE_TIMEOUT: Duration = Duration::from_secs(10);
/// A network that was away for so long has not ended it; the giver waits as long.
const MOST_WAITED: Duration = Duration::from_secs(60);
/// Between two tries.
const PAUSE: Duration = Duration::from_millis(200);
/// A session that has just met the network hears of the robots one after another: sooner, one of two with one name would be taken for the only one.
const SETTLE: Duration = Duration::from_secs(2);
/// Answers of robots with one name that are looked at, and sentences of theirs that are shown: letters.
const MOST_ANSWERS: usize = 8;
const LONGEST_REASON: usize = 400;

/// `ROBOT:NAME`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Wanted {
    pub robot: Robot,
    pub map: String,
}

impl FromStr for Wanted {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (robot, map) = text.split_once(':').ok_or("it is ROBOT:NAME")?;
        let robot = Robot::new(robot).map_err(|e| e.to_string())?;
        // What a name may be the giver knows; these would be something else in a query.
        let is_name = !map.is_empty() && !map.contains([';', '=', '|', '#', '?']) && !map.contains(char::is_control);
        if is_name { Ok(Self { robot, map: map.into() }) } else { Err(format!("{map:?} is no name of a map")) }
    }
}

/// Why there is no map.
#[derive(Debug, thiserror::Error)]
pub enum PullError {
    #[error(transparent)]
    Network(#[from] BridgeError),
    #[error("no Zenoh router at {endpoints} within {waited_s} s")]
    Nobody { endpoints: String, waited_s: f64 },
    #[error("no bridge of {robot} that gives maps in domain {domain} within {waited_s} s")]
    NoRobot { robot: String, domain: u32, waited_s: f64 },
    #[error("{count} robots have the name {robot}; which one is meant is not known")]
    Twins { robot: String, count: usize },
    #[error("{robot} answered: {reason}")]
    Refused { robot: String, reason: String },
    #[error("{robot} answered with something that is none of a bridge's: {what}")]
    Senseless { robot: String, what: &'static str },
    #[error("{robot} gives no answer any more; {got} of {bytes} bytes have come")]
    Lost { robot: String, got: u64, bytes: u64 },
    #[error("what has come from {robot} is not what it has: the checksum differs, or the map has changed; try again")]
    Checksum { robot: String },
    #[error("interrupted")]
    Stopped,
    #[error("what has come cannot be written: {0}")]
    Write(io::Error),
}

/// Fetches a map, hands its bytes to `take` in their order and says how many there are. `file`: Zenoh's own configuration; `patience`: for network and robot.
pub fn pull(
    wanted: &Wanted,
    (domain, file): (u32, Option<&Path>),
    patience: Duration,
    stop: &AtomicBool,
    take: &mut dyn FnMut(&[u8]) -> io::Result<()>,
) -> Result<u64, PullError> {
    let (session, endpoints) = session::open(file)?;
    let fetching = Fetching { session: &session, wanted, domain, endpoints, stop };
    let outcome = fetching.find(patience).and_then(|(key, offer)| fetching.fetch(&key, &offer, take));
    // Whoever closes does not need to know that the network has gone before.
    let _ = session.close().wait();
    outcome
}

struct Fetching<'a> {
    session: &'a Session,
    wanted: &'a Wanted,
    domain: u32,
    endpoints: String,
    stop: &'a AtomicBool,
}

type Answer = Result<Sample, String>;

impl Fetching<'_> {
    fn robot(&self) -> String {
        let name = self.wanted.robot.name();
        if name.is_empty() { "/".into() } else { name.into() }
    }

    fn pause(&self) -> Result<(), PullError> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(PullError::Stopped);
        }
        std::thread::sleep(PAUSE);
        Ok(())
    }

    /// The key of the one robot of this name, and what it offers.
    fn find(&self, patience: Duration) -> Result<(String, Offer), PullError> {
        let (begin, waited_s) = (Instant::now(), patience.as_secs_f64());
        while session::link(self.session) == session::Link::Nobody && begin.elapsed() < patience {
            self.pause()?;
        }
        let met = Instant::now();
        while met.elapsed() < SETTLE {
            self.pause()?;
        }
        let everywhere = maps_key(self.domain, None, &self.wanted.robot);
        loop {
            let mut answers = self.ask(&format!("{everywhere}?{MAP}={}", self.wanted.map), OFFER_TIMEOUT)?;
            match answers.len() {
                0 => {}
                1 => return self.offer(answers.remove(0)),
                count => return Err(PullError::Twins { robot: self.robot(), count }),
            }
            if begin.elapsed() >= patience {
                let endpoints = self.endpoints.clone();
                return Err(match session::link(self.session) {
                    session::Link::Nobody => PullError::Nobody { endpoints, waited_s },
                    _ => PullError::NoRobot { robot: self.robot(), domain: self.domain, waited_s },
                });
            }
            self.pause()?;
        }
    }

    fn offer(&self, answer: Answer) -> Result<(String, Offer), PullError> {
        let senseless = |what| PullError::Senseless { robot: self.robot(), what };
        let sample = answer.map_err(|reason| PullError::Refused { robot: self.robot(), reason })?;
        let key = sample.key_expr().as_str();
        let session = owner_of_maps(key).ok_or_else(|| senseless("its key"))?;
        if sample.payload().len() > LONGEST_OFFER {
            return Err(senseless("its offer"));
        }
        let offer = sample.payload().try_to_string().ok().and_then(|text| Offer::of_text(&text));
        Ok((maps_key(self.domain, Some(session), &self.wanted.robot), offer.ok_or_else(|| senseless("its offer"))?))
    }

    fn fetch(&self, key: &str, offer: &Offer, take: &mut dyn FnMut(&[u8]) -> io::Result<()>) -> Result<u64, PullError> {
        let (mut got, mut sum, mut heard) = (0, Xxh3::new(), Instant::now());
        while got < offer.bytes {
            let piece = format!("{key}?{MAP}={};{VERSION}={};{OFFSET}={got}", self.wanted.map, offer.version);
            let Some(answer) = self.ask(&piece, PIECE_TIMEOUT)?.into_iter().next() else {
                if heard.elapsed() >= MOST_WAITED {
                    return Err(PullError::Lost { robot: self.robot(), got, bytes: offer.bytes });
                }
                self.pause()?;
                continue;
            };
            let sample = answer.map_err(|reason| PullError::Refused { robot: self.robot(), reason })?;
            if sample.payload().len() as u64 != offer.piece(got) {
                return Err(PullError::Senseless { robot: self.robot(), what: "a piece of another length" });
            }
            let bytes = sample.payload().to_bytes();
            sum.update(&bytes);
            take(&bytes).map_err(PullError::Write)?;
            got += bytes.len() as u64;
            heard = Instant::now();
        }
        if sum.digest128() != offer.checksum {
            return Err(PullError::Checksum { robot: self.robot() });
        }
        Ok(got)
    }

    /// What is answered; nothing where nobody is there or somebody is too slow.
    fn ask(&self, selector: &str, timeout: Duration) -> Result<Vec<Answer>, PullError> {
        let query = self.session.get(selector).target(QueryTarget::All).consolidation(ConsolidationMode::None);
        let replies = query.timeout(timeout).priority(Priority::Background).wait().map_err(|e| {
            let what = selector.to_owned();
            BridgeError::Declare { what, reason: reason(&e) }
        })?;
        let mut answers = Vec::new();
        while answers.len() < MOST_ANSWERS && !self.stop.load(Ordering::Relaxed) {
            match replies.recv_timeout(PAUSE) {
                Ok(Some(reply)) => answers.push(reply.into_result().map_err(|e| told(&e.payload().to_bytes()))),
                Ok(None) => {}
                // It has ended.
                Err(_) => break,
            }
        }
        // Zenoh itself tells so that a query has met nobody in time.
        answers.retain(|answer| answer.as_ref().err().is_none_or(|reason| reason != "Timeout"));
        if self.stop.load(Ordering::Relaxed) { Err(PullError::Stopped) } else { Ok(answers) }
    }
}

/// A stranger's sentence, which can do nothing to a terminal.
fn told(bytes: &[u8]) -> String {
    // A letter has four bytes at the most.
    let bytes = &bytes[..bytes.len().min(4 * LONGEST_REASON)];
    String::from_utf8_lossy(bytes).chars().take(LONGEST_REASON).flat_map(char::escape_debug).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_wanted_is_a_robot_and_a_name() {
        let wanted: Wanted = "fleet/robot7:ware-house.2".parse().expect("wanted");
        assert_eq!((wanted.robot.name(), wanted.map.as_str()), ("fleet/robot7", "ware-house.2"));
        assert_eq!("/:attic".parse::<Wanted>().expect("the root").robot.name(), "");
        for wrong in ["attic", ":attic", "r:", "r-1:a", "r:a;version=1", "r:a?b", "r:a#b", "r:a\n"] {
            assert!(wrong.parse::<Wanted>().is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn a_strangers_sentence_is_short_and_does_nothing() {
        assert_eq!(told(b"no such\x1b[2J map\n"), "no such\\u{1b}[2J map\\n");
        assert_eq!(told(&[b'x'; 1000]).len(), LONGEST_REASON);
    }
}
