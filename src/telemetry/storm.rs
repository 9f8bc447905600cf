//! Keeps a storm of warnings out of the log, whatever its source: of one kind (one place in the code) [`BURST`] warnings and
//! errors in [`WINDOW`] are written, the rest is counted, and [`report_suppressed`] says how many there were.
//!
//! A [`RateLimiter`](super::RateLimiter) at the place itself makes one record of many equal events, with their sum; this
//! layer is for all the places that have none, in libraries too. In the journal, where a service logs for months, information has its
//! limit as well ([`BURST_OF_INFORMATION`]: keyframes come several a second); elsewhere it passes, because a replay at thirty times
//! real time makes keyframes that somebody may want to read. Debug and below pass: somebody asked for them.
//!
//! Cost: one lock and one look into a small table for a record that is limited, nothing for anything else.

use std::collections::HashMap;
use std::fmt::{Debug, Write as _};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use tracing::callsite::Identifier;
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::layer::{Context, Layer};

/// Records of one kind that are written in one window.
const BURST: u32 = 20;
/// The same of information.
const BURST_OF_INFORMATION: u32 = 100;
/// Length of a window.
const WINDOW: Duration = Duration::from_secs(10);
/// Characters of a suppressed record's message that are repeated in the report.
const MAX_MESSAGE: usize = 120;

/// One kind of record in its present window.
#[derive(Debug)]
struct Bucket {
    began: Instant,
    written: u32,
    held: u64,
    message: String,
    information: bool,
}

/// All kinds that were ever limited: as many as there are places in the code at the most.
#[derive(Debug, Default)]
struct Buckets(HashMap<Identifier, Bucket>);

impl Buckets {
    /// Whether a record of this kind, of which `burst` may be written in a window, is written at `now`; `message` is asked for only where
    /// one is held back.
    fn allow(&mut self, kind: Identifier, burst: u32, now: Instant, message: impl FnOnce() -> String) -> bool {
        let information = burst == BURST_OF_INFORMATION;
        let fresh = || Bucket { began: now, written: 0, held: 0, message: String::new(), information };
        let bucket = self.0.entry(kind).or_insert_with(fresh);
        // With held records the window stays until they are reported.
        if bucket.held == 0 && now.saturating_duration_since(bucket.began) >= WINDOW {
            (bucket.began, bucket.written) = (now, 0);
        }
        if bucket.written < burst && bucket.held == 0 {
            bucket.written += 1;
            return true;
        }
        if bucket.held == 0 {
            bucket.message = message();
        }
        bucket.held += 1;
        false
    }

    /// What was held back in windows that are over at `now` (`all`: in all of them): how many, of which message, and whether it was
    /// information only.
    fn take(&mut self, now: Instant, all: bool) -> Vec<(u64, String, bool)> {
        let mut taken = Vec::new();
        for bucket in self.0.values_mut() {
            if bucket.held > 0 && (all || now.saturating_duration_since(bucket.began) >= WINDOW) {
                let message = std::mem::take(&mut bucket.message);
                taken.push((std::mem::take(&mut bucket.held), message, bucket.information));
                (bucket.began, bucket.written) = (now, 0);
            }
        }
        taken
    }
}

fn buckets() -> &'static Mutex<Buckets> {
    static BUCKETS: OnceLock<Mutex<Buckets>> = OnceLock::new();
    BUCKETS.get_or_init(Mutex::default)
}

/// The layer.
pub(super) struct StormGuard {
    /// Information is limited, too.
    pub information: bool,
}

impl<S: Subscriber> Layer<S> for StormGuard {
    fn event_enabled(&self, event: &Event<'_>, _: Context<'_, S>) -> bool {
        let burst = match *event.metadata().level() {
            Level::ERROR | Level::WARN => BURST,
            Level::INFO if self.information => BURST_OF_INFORMATION,
            _ => return true,
        };
        let mut buckets = buckets().lock().unwrap_or_else(PoisonError::into_inner);
        buckets.allow(event.metadata().callsite(), burst, Instant::now(), || {
            let mut message = Message(String::new());
            event.record(&mut message);
            message.0
        })
    }
}

/// Takes the message out of an event's fields.
struct Message(String);

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        if field.name() == "message" {
            let _ = write!(self.0, "{value:?}");
            self.0 = self.0.chars().take(MAX_MESSAGE).collect();
        }
    }
}

/// Logs what was held back in windows that are over; to be called now and then, and at the end with `all`.
pub fn report_suppressed(all: bool) {
    let taken = buckets().lock().unwrap_or_else(PoisonError::into_inner).take(Instant::now(), all);
    for (suppressed, event, information) in taken {
        if information {
            tracing::info!(suppressed, event, "records suppressed");
        } else {
            tracing::warn!(suppressed, event, "records suppressed");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_storm_is_written_in_part_and_every_record_of_it_is_counted() {
        let kind = |n: usize| {
            // Two kinds: any two places in the code.
            let a = tracing::callsite!(name: "a", kind: tracing::metadata::Kind::EVENT, fields: message);
            let b = tracing::callsite!(name: "b", kind: tracing::metadata::Kind::EVENT, fields: message);
            let all: [&dyn tracing::Callsite; 2] = [a, b];
            all[n].metadata().callsite()
        };
        let (start, ms) = (Instant::now(), Duration::from_millis);
        let mut buckets = Buckets::default();
        let (mut written, mut reported) = (0, 0);
        // 100 a second for 30 seconds, looked at ten times a second.
        for i in 0..3000 {
            let now = start + ms(10) * i;
            written += u64::from(buckets.allow(kind(0), BURST, now, || "frame cannot be read".into()));
            assert!(i % 1000 != 0 || buckets.allow(kind(1), BURST, now, String::new), "another kind is another matter");
            if i % 10 == 0 {
                for (held, message, _) in buckets.take(now, false) {
                    assert_eq!(message, "frame cannot be read");
                    reported += held;
                }
            }
        }
        assert_eq!(written, 3 * u64::from(BURST), "one burst a window");
        reported += buckets.take(start + ms(30_000), true).iter().map(|(held, ..)| held).sum::<u64>();
        assert_eq!(written + reported, 3000);
        assert!(buckets.take(start + ms(90_000), true).is_empty(), "reported once");
        assert!(buckets.allow(kind(0), BURST, start + ms(90_000), String::new), "the storm is over");
    }

    /// Counts records by message, and sums their `suppressed`.
    #[derive(Clone, Default)]
    struct Seen(std::sync::Arc<Mutex<(u64, u64)>>);

    struct Fields {
        ours: bool,
        suppressed: Option<u64>,
    }

    impl Visit for Fields {
        fn record_debug(&mut self, _: &Field, value: &dyn Debug) {
            self.ours |= format!("{value:?}").contains("the storm of this test");
        }
        fn record_u64(&mut self, field: &Field, value: u64) {
            self.suppressed = self.suppressed.or((field.name() == "suppressed").then_some(value));
        }
    }

    impl<S: Subscriber> Layer<S> for Seen {
        fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
            let mut fields = Fields { ours: false, suppressed: None };
            event.record(&mut fields);
            let mut seen = self.0.lock().expect("whole");
            match fields.suppressed {
                Some(n) if fields.ours => seen.1 += n,
                None if fields.ours => seen.0 += 1,
                _ => {}
            }
        }
    }

    #[test]
    fn the_layer_holds_warnings_back_and_information_in_the_journal_alone() {
        use tracing_subscriber::layer::SubscriberExt;
        let seen = Seen::default();
        let subscriber = tracing_subscriber::registry().with(StormGuard { information: true }).with(seen.clone());
        tracing::subscriber::with_default(subscriber, || {
            for _ in 0..150 {
                tracing::info!("the storm of this test, in the journal");
            }
            report_suppressed(true);
        });
        assert_eq!(*seen.0.lock().expect("whole"), (u64::from(BURST_OF_INFORMATION), 50));
        let seen = Seen::default();
        let guard = StormGuard { information: false };
        let subscriber = tracing_subscriber::registry().with(guard).with(seen.clone());
        tracing::subscriber::with_default(subscriber, || {
            for _ in 0..50 {
                tracing::info!("the storm of this test, as information");
            }
            assert_eq!(*seen.0.lock().expect("whole"), (50, 0));
            for _ in 0..50 {
                tracing::error!("the storm of this test");
            }
            assert_eq!(*seen.0.lock().expect("whole"), (50 + u64::from(BURST), 0));
            report_suppressed(true);
        });
        assert_eq!(*seen.0.lock().expect("whole"), (50 + u64::from(BURST), 50 - u64::from(BURST)));
    }
}
