//! The last minutes, for pages that come late: samples of poses, and which of them mean the same map.

use std::collections::VecDeque;

use super::wire::Sample;
use crate::messages::{Pose, UNKNOWN_NS};

/// How far back.
const SPAN_S: f64 = 300.0;
/// Samples a second that are kept.
const RATE_HZ: f64 = 5.0;
/// What that makes, and some more.
const MOST: usize = (SPAN_S * RATE_HZ) as usize + 16;

/// What a position is in: another one of these means other coordinates.
type Coordinates = (u64, u32, u32, u32);

/// See module.
#[derive(Debug, Default)]
pub struct History {
    samples: VecDeque<Sample>,
    /// The newest coordinates; poses and maps come by different ways and may change theirs one after the other.
    epochs: VecDeque<(Coordinates, u32)>,
    epoch: u32,
}

/// Coordinates that are told apart.
const EPOCHS: usize = 16;

impl History {
    /// The epoch of these coordinates; a new one if they were not seen lately.
    pub fn epoch(&mut self, run_id: u64, map_id: u32, reset_counter: u32, map_revision: u32) -> u32 {
        let here = (run_id, map_id, reset_counter, map_revision);
        if let Some((_, epoch)) = self.epochs.iter().find(|(known, _)| *known == here) {
            return *epoch;
        }
        self.epoch = self.epoch.wrapping_add(1);
        if self.epochs.len() >= EPOCHS {
            self.epochs.pop_front();
        }
        self.epochs.push_back((here, self.epoch));
        self.epoch
    }

    /// The pose as a sample, which is kept if it is time.
    pub fn add(&mut self, pose: &Pose) -> Sample {
        let epoch = self.epoch(pose.run_id, pose.map_id, pose.reset_counter, pose.map_revision);
        let sample = Sample {
            time_s: pose.published_ns as f64 * 1e-9,
            position: pose.position.map(|v| v as f32),
            orientation: pose.orientation.map(|v| v as f32),
            latency_ms: if pose.latency_arrival_ns == UNKNOWN_NS {
                f32::NAN
            } else {
                pose.latency_arrival_ns as f32 * 1e-6
            },
            quality: pose.quality,
            landmarks: pose.landmarks,
            sought: pose.landmarks_sought,
            epoch,
            dropped: u32::try_from(pose.frames_dropped).unwrap_or(u32::MAX),
            state: pose.state,
            scale: pose.scale,
            keyframe: pose.keyframe != 0,
        };
        if self.samples.back().is_none_or(|last| !(sample.time_s - last.time_s < 1.0 / RATE_HZ)) {
            while self.samples.front().is_some_and(|s| self.samples.len() >= MOST || s.time_s < sample.time_s - SPAN_S)
            {
                self.samples.pop_front();
            }
            self.samples.push_back(sample);
        }
        sample
    }

    /// Oldest first.
    pub fn samples(&self) -> impl ExactSizeIterator<Item = &Sample> {
        self.samples.iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn five_minutes_are_kept_however_many_poses_come() {
        let mut history = History::default();
        for i in 0..40_000i64 {
            history.add(&Pose { published_ns: i * 33_000_000, ..Pose::default() });
        }
        let (first, last) = (history.samples[0].time_s, history.samples[history.samples.len() - 1].time_s);
        assert!(history.samples.len() <= MOST && (290.0..=301.0).contains(&(last - first)), "{first} {last}");
    }

    #[test]
    fn another_map_or_a_corrected_one_is_another_epoch() {
        let mut history = History::default();
        let epochs = [(1, 0, 0, 0), (1, 0, 0, 0), (1, 0, 0, 1), (1, 0, 0, 0), (1, 1, 1, 0), (2, 1, 1, 0)]
            .map(|(run, map, resets, revision)| history.epoch(run, map, resets, revision));
        assert_eq!(epochs, [1, 1, 2, 1, 3, 4]);
    }
}
