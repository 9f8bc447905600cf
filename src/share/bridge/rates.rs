//! How often a topic is sent at most.

use std::str::FromStr;

use super::BridgeError;
use super::topic::Topic;

/// `odom=10`; 0 Hz: not at all.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rate {
    topic: Topic,
    hz: f64,
}

/// No camera is faster, Hz.
const MOST_HZ: f64 = 1000.0;

impl FromStr for Rate {
    type Err = BridgeError;

    fn from_str(text: &str) -> Result<Self, BridgeError> {
        let parse = || {
            let (word, hz) = text.split_once('=')?;
            // Of the picture's topic the first word is enough.
            let named = |topic: &Topic| topic.word() == word || topic.word().split('/').next() == Some(word);
            let topic = Topic::ALL.into_iter().find(named)?;
            let hz: f64 = hz.parse().ok()?;
            (0.0..=MOST_HZ).contains(&hz).then_some(Self { topic, hz })
        };
        parse().ok_or_else(|| BridgeError::Rate {
            text: text.into(),
            topics: Topic::ALL.map(|topic| topic.word().split('/').next().unwrap_or_default()).join(", "),
        })
    }
}

#[derive(Debug, Clone, Copy, Default)]
enum Limit {
    #[default]
    None,
    Off,
    Every {
        period_ns: i64,
        /// When the next one is due.
        next_ns: Option<i64>,
    },
}

/// Of all topics.
#[derive(Debug, Clone, Default)]
pub struct Rates {
    limits: [Limit; Topic::ALL.len()],
}

impl Rates {
    /// The last of two for one topic holds.
    pub fn new(rates: &[Rate]) -> Self {
        let mut limits = [Limit::None; Topic::ALL.len()];
        for rate in rates {
            limits[rate.topic.index()] = if rate.hz > 0.0 {
                Limit::Every { period_ns: (1e9 / rate.hz) as i64, next_ns: None }
            } else {
                Limit::Off
            };
        }
        Self { limits }
    }

    /// A message of this time may be sent. Times are on a grid of periods, so that the mean rate is the one asked for, whatever the camera's is.
    pub fn allow(&mut self, topic: Topic, now_ns: i64) -> bool {
        match &mut self.limits[topic.index()] {
            Limit::None => true,
            Limit::Off => false,
            Limit::Every { period_ns, next_ns } => {
                let due_ns = next_ns.unwrap_or(now_ns);
                // A time far before is of another run.
                let is_due = now_ns >= due_ns || due_ns.saturating_sub(now_ns) > 2 * *period_ns;
                if is_due {
                    let on_grid_ns = due_ns.saturating_add(*period_ns);
                    let is_near = on_grid_ns > now_ns && on_grid_ns - now_ns <= *period_ns;
                    *next_ns = Some(if is_near { on_grid_ns } else { now_ns.saturating_add(*period_ns) });
                }
                is_due
            }
        }
    }

    /// The time from one message to the next that the rate asks for, s; zero: as they come.
    pub fn period_s(&self, topic: Topic) -> f64 {
        match self.limits[topic.index()] {
            Limit::None | Limit::Off => 0.0,
            Limit::Every { period_ns, .. } => period_ns as f64 / 1e9,
        }
    }

    /// Nothing of it is sent, ever.
    pub fn is_off(&self, topic: Topic) -> bool {
        matches!(self.limits[topic.index()], Limit::Off)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sent(rate: &str, period_ns: i64, frames: i64) -> usize {
        let mut rates = Rates::new(&[rate.parse().expect("rate")]);
        (0..frames).filter(|frame| rates.allow(Topic::Odometry, 1_000_000 + frame * period_ns)).count()
    }

    #[test]
    fn a_rate_is_kept_in_the_mean_whatever_the_cameras_is() {
        // 30 Hz for 10 s.
        for (rate, expected) in
            [("odom=10", 100), ("odom=7", 70), ("odom=30", 300), ("odom=90", 300), ("odom=0", 0), ("tf=1", 300)]
        {
            let sent = sent(rate, 33_333_333, 300);
            assert!(sent.abs_diff(expected) <= 1, "{rate}: {sent}");
        }
    }

    #[test]
    fn a_pause_is_not_caught_up_with_and_a_clock_that_begins_anew_does_not_silence_a_topic() {
        let mut rates = Rates::new(&["odom=1".parse().expect("rate")]);
        let mut allow = |ms: i64| rates.allow(Topic::Odometry, ms * 1_000_000);
        assert!(allow(0) && !allow(500) && allow(60_000) && !allow(60_500) && allow(61_000));
        assert!(allow(5) && !allow(6));
    }

    #[test]
    fn a_rate_names_a_topic_and_a_number() {
        assert_eq!("image=2.5".parse::<Rate>().expect("rate"), Rate { topic: Topic::Image, hz: 2.5 });
        assert_eq!("tf_static=1".parse::<Rate>().expect("rate").topic, Topic::TfStatic);
        let rates = Rates::new(&["odom=0.05".parse().expect("rate")]);
        assert_eq!([Topic::Odometry, Topic::Tf].map(|topic| rates.period_s(topic)), [20.0, 0.0]);
        for wrong in ["odom", "odom=", "odom=-1", "odom=nan", "odom=inf", "odometry=3", "=3"] {
            let error = wrong.parse::<Rate>().expect_err(wrong).to_string();
            assert!(error.contains("camera_info") && error.contains(wrong), "{error}");
        }
    }
}
