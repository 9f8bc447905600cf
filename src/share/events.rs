//! What a ring is kept for, by the poses of a daemon and by its silence.
//!
//! - `LOST`: tracking is lost. Another `reset_counter` with the first pose that is not tracked says that somebody asked for it (a reset, another map),
//!   but of a map with fewer than four keyframes, which the daemon drops when it is lost: its end looks the same, and counts as a loss.
//! - `GONE`: a daemon that was heard is no longer there, or another run of it is, however it ended.

use std::time::{Duration, Instant};

use crate::messages::{KeyframesHeader, Pose, State};

/// A map with so many keyframes is not dropped when it is lost: `LOST` is told of it first.
const KEPT_KEYFRAMES: u32 = 4;
/// A subscription that only connects anew has the daemon back sooner.
const GONE_AFTER: Duration = Duration::from_millis(500);

/// Something that a ring is kept for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    Lost,
    Gone,
}

impl Event {
    /// As it stands in the name of the file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Lost => "LOST",
            Self::Gone => "GONE",
        }
    }
}

/// Of the last pose.
#[derive(Debug, Clone, Copy)]
struct Last {
    run_id: u64,
    reset_counter: u32,
    state: State,
}

/// See module.
#[derive(Debug, Default)]
pub struct Events {
    last: Option<Last>,
    /// Run and reset counter of the map that is known to have had [`KEPT_KEYFRAMES`] last.
    grown: Option<(u64, u32)>,
    away_since: Option<Instant>,
    /// The daemon's end was told.
    is_told: bool,
}

impl Events {
    /// With each pose.
    pub fn pose(&mut self, pose: &Pose) -> Option<Event> {
        let now = Last { run_id: pose.run_id, reset_counter: pose.reset_counter, state: pose.state() };
        let before = self.last.replace(now);
        let is_told = std::mem::take(&mut self.is_told);
        self.away_since = None;
        let same_run = before.filter(|before| before.run_id == now.run_id);
        let same_map = same_run.is_some_and(|before| before.reset_counter == now.reset_counter);
        let Some(before) = same_run else {
            return (before.is_some() && !is_told).then_some(Event::Gone);
        };
        if before.state != State::Tracking || now.state == State::Tracking {
            return None;
        }
        let was_grown = self.grown == Some((before.run_id, before.reset_counter));
        let may_be_young = matches!(now.state, State::Initializing | State::Orientation) && !was_grown;
        (same_map || may_be_young).then_some(Event::Lost)
    }

    /// With each message of keyframes.
    pub fn keyframes(&mut self, header: &KeyframesHeader) {
        if header.total >= KEPT_KEYFRAMES {
            self.grown = Some((header.run_id, header.reset_counter));
        }
    }

    /// Several times a second: whether a daemon is there.
    pub fn look(&mut self, is_connected: bool, now: Instant) -> Option<Event> {
        if is_connected || self.last.is_none() {
            self.away_since = None;
            return None;
        }
        let since = *self.away_since.get_or_insert(now);
        if self.is_told || now.saturating_duration_since(since) < GONE_AFTER {
            return None;
        }
        self.is_told = true;
        Some(Event::Gone)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::{STATE_DEAD_RECKONING, STATE_INITIALIZING, STATE_LOST, STATE_ORIENTATION, STATE_TRACKING};

    fn pose(run_id: u64, reset_counter: u32, state: u8) -> Pose {
        Pose { run_id, reset_counter, state, ..Pose::default() }
    }

    /// After a pose that is tracked in a map of so many keyframes.
    fn tracked(keyframes: u32) -> Events {
        let mut events = Events::default();
        assert_eq!(events.pose(&pose(1, 3, STATE_INITIALIZING)), None);
        assert_eq!(events.pose(&pose(1, 3, STATE_TRACKING)), None);
        events.keyframes(&KeyframesHeader { run_id: 1, reset_counter: 3, total: keyframes, ..Default::default() });
        events
    }

    #[test]
    fn a_loss_is_told_once_and_a_reset_is_none() {
        for (state, resets, keyframes, told) in [
            (STATE_LOST, 3, 9, Some(Event::Lost)),
            (STATE_LOST, 3, 2, Some(Event::Lost)),
            (STATE_DEAD_RECKONING, 3, 9, Some(Event::Lost)),
            // A reset, or the end of a map that is young.
            (STATE_INITIALIZING, 4, 9, None),
            (STATE_ORIENTATION, 4, 9, None),
            (STATE_INITIALIZING, 4, 3, Some(Event::Lost)),
            (STATE_ORIENTATION, 5, 3, Some(Event::Lost)),
            // Another map was loaded, or its first metre was told.
            (STATE_LOST, 4, 9, None),
            (STATE_LOST, 4, 2, None),
            (STATE_TRACKING, 4, 9, None),
        ] {
            let mut events = tracked(keyframes);
            assert_eq!(
                events.pose(&pose(1, resets, state)),
                told,
                "state {state}, {resets} resets, {keyframes} keyframes"
            );
            if state != STATE_TRACKING {
                assert_eq!(events.pose(&pose(1, resets, STATE_LOST)), None, "it is told once");
            }
        }
    }

    #[test]
    fn a_map_that_follows_one_that_had_grown_is_young_again() {
        let mut events = tracked(9);
        events.pose(&pose(1, 4, STATE_INITIALIZING));
        // Of the map before, and late.
        events.keyframes(&KeyframesHeader { run_id: 1, reset_counter: 3, total: 9, ..Default::default() });
        events.pose(&pose(1, 4, STATE_TRACKING));
        assert_eq!(events.pose(&pose(1, 5, STATE_INITIALIZING)), Some(Event::Lost));
    }

    #[test]
    fn the_end_of_a_daemon_is_told_once_by_its_absence_or_by_the_next_run() {
        let begin = Instant::now();
        let at = |ms| begin + Duration::from_millis(ms);
        let mut events = Events::default();
        assert_eq!((events.look(false, at(0)), events.look(false, at(5000))), (None, None), "none was heard");
        // Another run at once.
        let mut events = tracked(9);
        assert_eq!(events.look(true, at(0)), None);
        assert_eq!(events.pose(&pose(2, 0, STATE_INITIALIZING)), Some(Event::Gone));
        assert_eq!(events.pose(&pose(2, 0, STATE_INITIALIZING)), None);
        // Away for a moment, and then for good; the next run is no further event.
        assert_eq!((events.look(false, at(100)), events.look(true, at(300))), (None, None));
        let looks = [400, 800, 1000, 9000].map(|ms| events.look(false, at(ms)));
        assert_eq!(looks, [None, None, Some(Event::Gone), None]);
        assert_eq!(events.pose(&pose(3, 0, STATE_TRACKING)), None);
        // That one's end is.
        let looks = [9100, 9700].map(|ms| events.look(false, at(ms)));
        assert_eq!(looks, [None, Some(Event::Gone)], "{events:?}");
    }
}
