//! Which capture times can be believed.
//!
//! A frame's time must ascend, or velocities and trajectories are nonsense. Cameras and recordings break that in four
//! ways: a time repeats, goes back, jumps ahead for one frame, or jumps for good (a suspend, a clock set, two recordings
//! in one). The gate drops what it cannot believe, and believes a jump when the next frames stand by it.

/// A step ahead by more than this needs a second frame to confirm it, ns.
const JUMP_NS: i64 = 2_000_000_000;
/// So many frames in a row behind the last believed time, ascending among themselves, are a new timeline.
const NEW_TIMELINE_FRAMES: u32 = 10;

/// What becomes of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    Accept,
    /// Time went back for good: everything that rests on earlier times must be forgotten.
    AcceptNewTimeline,
    Drop(Fault),
}

/// What is wrong with a time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fault {
    Repeats,
    GoesBack,
    /// Ahead by more than two seconds, and no second frame says so yet.
    Jumps,
}

impl Fault {
    /// As logged.
    pub fn name(self) -> &'static str {
        match self {
            Fault::Repeats => "repeats",
            Fault::GoesBack => "goes back",
            Fault::Jumps => "jumps ahead",
        }
    }
}

/// Remembers the last believed time, and the last one that was not.
#[derive(Debug, Clone, Default)]
pub struct TimestampGate {
    last_ns: Option<i64>,
    doubted_ns: Option<i64>,
    behind: u32,
    /// A pause is known of: the next time may be far ahead.
    pause: bool,
}

impl TimestampGate {
    /// The source was away: however far ahead the next frame is, that is no jump.
    pub fn expect_pause(&mut self) {
        self.pause = true;
    }

    /// Judges the next frame's time.
    pub fn judge(&mut self, ns: i64) -> Verdict {
        let Some(last) = self.last_ns else { return self.accept(ns, Verdict::Accept) };
        let doubted = self.doubted_ns.replace(ns);
        let follows_doubted = doubted.is_some_and(|d| ns > d && ns.saturating_sub(d) <= JUMP_NS);
        if ns == last {
            return Verdict::Drop(Fault::Repeats);
        }
        if ns < last {
            self.behind = if follows_doubted && self.behind > 0 { self.behind + 1 } else { 1 };
            if self.behind >= NEW_TIMELINE_FRAMES {
                return self.accept(ns, Verdict::AcceptNewTimeline);
            }
            return Verdict::Drop(Fault::GoesBack);
        }
        if ns.saturating_sub(last) > JUMP_NS && !follows_doubted && !self.pause {
            return Verdict::Drop(Fault::Jumps);
        }
        self.accept(ns, Verdict::Accept)
    }

    fn accept(&mut self, ns: i64, verdict: Verdict) -> Verdict {
        self.last_ns = Some(ns);
        self.doubted_ns = None;
        self.behind = 0;
        self.pause = false;
        verdict
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAME_NS: i64 = 33_333_333;

    /// Judges `times` (in frames) and returns the indices of those accepted.
    fn accepted(times: &[i64]) -> Vec<usize> {
        let mut gate = TimestampGate::default();
        let verdicts = times.iter().map(|t| gate.judge(t * FRAME_NS));
        verdicts.enumerate().filter(|(_, v)| !matches!(v, Verdict::Drop(_))).map(|(i, _)| i).collect()
    }

    #[test]
    fn ascending_times_pass() {
        assert_eq!(accepted(&[0, 1, 2, 3, 5, 30, 31]), [0, 1, 2, 3, 4, 5, 6]);
        assert_eq!(accepted(&[-3, -2, 0]), [0, 1, 2], "a clock may start anywhere");
    }

    #[test]
    fn repeats_and_steps_back_are_dropped_one_by_one() {
        assert_eq!(accepted(&[0, 1, 1, 2, 0, 3, 2, 4]), [0, 1, 3, 5, 7]);
    }

    #[test]
    fn one_frame_from_the_future_does_not_lock_out_the_present() {
        assert_eq!(accepted(&[0, 1, 100_000, 2, 3]), [0, 1, 3, 4]);
    }

    #[test]
    fn a_gap_is_believed_at_its_second_frame() {
        assert_eq!(accepted(&[0, 1, 3000, 3001, 3002]), [0, 1, 3, 4]);
    }

    #[test]
    fn a_new_timeline_is_believed_at_its_tenth_frame_and_said() {
        let mut gate = TimestampGate::default();
        for t in 1000..1010 {
            assert_eq!(gate.judge(t * FRAME_NS), Verdict::Accept);
        }
        for t in 0..9 {
            assert_eq!(gate.judge(t * FRAME_NS), Verdict::Drop(Fault::GoesBack), "frame {t}");
        }
        assert_eq!(gate.judge(9 * FRAME_NS), Verdict::AcceptNewTimeline);
        assert_eq!(gate.judge(10 * FRAME_NS), Verdict::Accept);
    }

    #[test]
    fn a_time_that_stands_still_never_becomes_a_timeline() {
        let mut gate = TimestampGate::default();
        gate.judge(1000);
        for _ in 0..100 {
            assert_eq!(gate.judge(1000), Verdict::Drop(Fault::Repeats));
            assert_eq!(gate.judge(0), Verdict::Drop(Fault::GoesBack));
        }
    }
}
