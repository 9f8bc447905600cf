//! From counters, latencies and signs of life to a health message, and a record in the log: of every second at debug, at info when state or
//! faults have changed (once in ten seconds at the most; changes have records of their own) and once a minute.
//!
//! A fault that is an event (a dropped frame, a bad timestamp) stands for the second after the one it happened in; a
//! fault that is a condition (no camera, a stalled stage, tracking lost) stands as long as it lasts.

use std::sync::Arc;
use std::time::Duration;

use tracing::{debug, info, warn};

use super::advice::advice;
use super::status::{Status, state_name};
use crate::frame::Clock;
use crate::messages::{Health, STAGES, StageHealth, UNKNOWN_NS, error, stage};
use crate::publish::convert;
use crate::reconstruction::{LensKnowledge, TrackingState};
use crate::telemetry::{Counter, Heartbeat, Percentiles, Snapshot};

/// A source that is open and gives nothing for so long has a fault, ns.
const NO_FRAMES_NS: i64 = 2_000_000_000;
/// A driver of the base that was heard and is silent for so long has stopped, ns.
const WHEELS_SILENT_NS: i64 = 1_000_000_000;
/// Fewer points or landmarks than this may soon be too few.
const FEW: u32 = 40;
/// A camera that gives less than this part of its rate over a second has a fault.
const SLOW_SHARE: f64 = 0.75;
/// Length of the interval that rates and percentiles are of, ns.
const SECOND_NS: i64 = 1_000_000_000;
/// The health record at info: so long after the last one at the earliest, and, where nothing changes, at the latest, ns.
const NEWS_NS: i64 = 10 * SECOND_NS;
const REPEAT_NS: i64 = 60 * SECOND_NS;

/// Watches one run.
pub struct HealthWatch {
    status: Arc<Status>,
    clock: Clock,
    stall_after: Duration,
    started_ns: i64,
    second_began_ns: i64,
    before: Totals,
    stages: [StageHealth; STAGES],
    /// Faults that were events of the last second.
    events: u64,
    /// The second before, the camera was there and gave frames.
    flowed: bool,
    /// In this second the camera was away; and when it was so last.
    away: bool,
    away_ns: i64,
    /// Faults that the log knows of as standing, and when each was last seen, ns.
    logged: u64,
    last_seen_ns: [i64; 64],
    /// State and faults of the last health record at info, and when that was.
    told: Option<(TrackingState, u64, i64)>,
    /// A file could not be written; stands until one can.
    pub save_failed: bool,
}

/// Everything that grows, at one moment.
#[derive(Debug, Clone, Default)]
struct Totals {
    captured: u64,
    dropped: u64,
    missed: u64,
    corrupt: u64,
    bad_timestamps: u64,
    processed: u64,
    tracked: u64,
    poses_published: u64,
    publish_failures: u64,
    adjustments_late: u64,
    records_lost: u64,
    wheels: WheelTotals,
    decode: Snapshot,
    feature: Snapshot,
    queue: Snapshot,
    track: Snapshot,
    mapping: Snapshot,
    publish: Snapshot,
    capture_delay: Snapshot,
    latency: Snapshot,
}

impl Totals {
    fn of(s: &Status) -> Self {
        Self {
            captured: s.captured.get(),
            dropped: s.dropped.get(),
            missed: s.missed.get(),
            corrupt: [&s.corrupt, &s.unreadable, &s.wrong_size].map(Counter::get).iter().sum(),
            bad_timestamps: s.bad_timestamps.get(),
            processed: s.processed.get(),
            tracked: s.tracked.get(),
            poses_published: s.poses_published.get(),
            publish_failures: s.publish_failures.get(),
            adjustments_late: s.adjustments_late.get(),
            records_lost: s.records_lost.get(),
            wheels: WheelTotals::of(s),
            decode: s.decode.snapshot(),
            feature: s.feature.snapshot(),
            queue: s.queue.snapshot(),
            track: s.track.snapshot(),
            mapping: s.mapping.snapshot(),
            publish: s.publish.snapshot(),
            capture_delay: s.capture_delay.snapshot(),
            latency: s.latency.snapshot(),
        }
    }
}

/// What has become of the messages of the base's driver, at one moment.
#[derive(Debug, Clone, Copy, Default)]
struct WheelTotals {
    received: u64,
    refused: u64,
    missing: u64,
    late: u64,
}

impl WheelTotals {
    fn of(s: &Status) -> Self {
        let w = &s.wheels;
        let missing = w.missing.get().wrapping_add(w.dropped.get());
        Self { received: w.received.get(), refused: w.refused(), missing, late: w.late.get() }
    }

    /// Faults of the time since `before`, logged where messages were lost or late. (Those that were not believed have records of their own.)
    fn faults_since(&self, before: &Self) -> [(u64, u64); 2] {
        let [received, refused, missing, late] = [
            self.received.wrapping_sub(before.received),
            self.refused.wrapping_sub(before.refused),
            self.missing.wrapping_sub(before.missing),
            self.late.wrapping_sub(before.late),
        ];
        // One that comes late now and then is how a busy machine is.
        let faulty = missing > 0 || late > received / 2;
        if faulty {
            warn!(missing, late, received, "wheel readings lost or late");
        }
        [(refused, error::WHEELS_WRONG), (u64::from(faulty), error::WHEELS_LATE)]
    }
}

impl HealthWatch {
    pub fn new(status: Arc<Status>, clock: Clock, stall_after: Duration, now_ns: i64) -> Self {
        let before = Totals::of(&status);
        Self {
            status,
            clock,
            stall_after,
            started_ns: now_ns,
            second_began_ns: now_ns,
            before,
            stages: [StageHealth::default(); STAGES],
            events: 0,
            flowed: false,
            away: false,
            away_ns: now_ns,
            logged: 0,
            last_seen_ns: [0; 64],
            told: None,
            save_failed: false,
        }
    }

    /// The health at `now_ns` (CLOCK_MONOTONIC). Logs the record of every full second, and faults as they come and go.
    pub fn tick(&mut self, now_ns: i64) -> Health {
        if !self.status.source_present() {
            (self.away, self.away_ns) = (true, now_ns);
        }
        let interval_ns = now_ns - self.second_began_ns;
        if interval_ns >= SECOND_NS {
            self.end_second(interval_ns, now_ns);
            self.second_began_ns = now_ns;
        }
        let errors = self.errors(now_ns);
        self.log_faults(errors, now_ns);
        self.health(now_ns, errors)
    }

    /// No stage has been silent for longer than its limit.
    pub fn all_alive(&self, now_ns: i64) -> bool {
        self.hearts().iter().all(|h| h.stalled(now_ns, self.stall_after).is_none())
    }

    fn hearts(&self) -> [&Heartbeat; 3] {
        [&self.status.capture, &self.status.features, &self.status.reconstruction]
    }

    fn end_second(&mut self, interval_ns: i64, now_ns: i64) {
        let now = Totals::of(&self.status);
        let before = std::mem::replace(&mut self.before, now.clone());
        let since = |pick: fn(&Totals) -> &Snapshot| pick(&now).since(pick(&before)).percentiles();
        let decode = since(|t| &t.decode);
        let feature = since(|t| &t.feature);
        let queue = since(|t| &t.queue);
        let track = since(|t| &t.track);
        let mapping = since(|t| &t.mapping);
        let publish = since(|t| &t.publish);
        let latency = since(|t| &t.latency);
        let capture = since(|t| &t.capture_delay);

        let dropped = now.dropped - before.dropped;
        if dropped > 0 {
            warn!(dropped, dropped_total = now.dropped, "frames dropped, the pipeline could not keep up");
        }
        let missed = now.missed - before.missed;
        if missed > 0 {
            warn!(missed, missed_total = now.missed, "frames lost by the camera or its driver");
        }
        // A second in which the camera came or went tells nothing of its rate.
        let captured = now.captured - before.captured;
        let flows = !std::mem::take(&mut self.away) && captured > 0;
        let expected = self.status.nominal_rate_hz() * interval_ns as f64 * 1e-9;
        let slow = flows && self.flowed && (captured as f64) < SLOW_SHARE * expected;
        self.flowed = flows;
        let [wheels_wrong, wheels_late] = now.wheels.faults_since(&before.wheels);
        self.events = [
            wheels_wrong,
            wheels_late,
            (dropped + missed, error::DROPPED_FRAMES),
            (u64::from(slow), error::LOW_RATE),
            (now.corrupt - before.corrupt, error::CORRUPT_FRAMES),
            (now.bad_timestamps - before.bad_timestamps, error::BAD_TIMESTAMP),
            (now.publish_failures - before.publish_failures, error::PUBLISH_FAILED),
            (now.adjustments_late - before.adjustments_late, error::MAPPING_LATE),
            (now.records_lost - before.records_lost, error::SAVE_FAILED),
        ]
        .iter()
        .filter(|(count, _)| *count > 0)
        .fold(0, |bits, (_, bit)| bits | bit);

        let seconds = interval_ns as f64 * 1e-9;
        let stages = [
            (stage::CAPTURE, &self.status.captured, now.captured - before.captured, capture),
            (stage::FEATURES, &self.status.processed, now.processed - before.processed, feature),
            (stage::TRACKING, &self.status.processed, now.processed - before.processed, track),
            (stage::MAPPING, &self.status.processed, now.processed - before.processed, mapping),
            (stage::PUBLISHING, &self.status.poses_published, now.poses_published - before.poses_published, publish),
            (stage::END_TO_END, &self.status.poses_published, now.poses_published - before.poses_published, latency),
        ];
        for (index, total, steps, p) in stages {
            if let Some(stage) = self.stages.get_mut(index) {
                *stage = stage_health(total.get(), steps as f64 / seconds, &p);
            }
        }
        let (map_landmarks, map_keyframes) = self.status.map_size();
        // A record's level is part of its place in the code.
        macro_rules! record {
            ($level:ident) => {
                $level!(
                    state = state_name(self.status.state()),
                    frames = now.captured - before.captured,
                    tracked = now.tracked - before.tracked,
                    dropped,
                    missed,
                    corrupt = now.corrupt - before.corrupt,
                    map_landmarks,
                    map_keyframes,
                    landmarks = self.status.landmarks_tracked(),
                    decode_p50_ms = decode.p50_ms,
                    decode_p95_ms = decode.p95_ms,
                    decode_p99_ms = decode.p99_ms,
                    feature_p50_ms = feature.p50_ms,
                    feature_p95_ms = feature.p95_ms,
                    feature_p99_ms = feature.p99_ms,
                    queue_p50_ms = queue.p50_ms,
                    queue_p95_ms = queue.p95_ms,
                    queue_p99_ms = queue.p99_ms,
                    track_p50_ms = track.p50_ms,
                    track_p95_ms = track.p95_ms,
                    track_p99_ms = track.p99_ms,
                    mapping_p50_ms = mapping.p50_ms,
                    mapping_p95_ms = mapping.p95_ms,
                    mapping_p99_ms = mapping.p99_ms,
                    latency_p50_ms = latency.p50_ms,
                    latency_p95_ms = latency.p95_ms,
                    latency_p99_ms = latency.p99_ms,
                    "health"
                )
            };
        }
        if self.is_news(self.errors(now_ns), now_ns) {
            record!(info);
        } else {
            record!(debug);
        }
    }

    /// Whether this second's record is worth an info: nothing else on the daemon's way would fill a journal in a night.
    fn is_news(&mut self, faults: u64, now_ns: i64) -> bool {
        let state = self.status.state();
        let news = self.told.is_none_or(|(told_state, told_faults, at_ns)| {
            let changed = (told_state, told_faults) != (state, faults);
            now_ns - at_ns >= if changed { NEWS_NS } else { REPEAT_NS }
        });
        if news {
            self.told = Some((state, faults, now_ns));
        }
        news
    }

    /// All faults that stand.
    fn errors(&self, now_ns: i64) -> u64 {
        let s = &self.status;
        let state = s.state();
        // A camera that has just come had no time to send any.
        let last_frame_ns = s.last_arrival_ns().unwrap_or(self.started_ns).max(self.away_ns);
        let seen_any = s.processed.get() > 0;
        let conditions = [
            (!s.source_present(), error::NO_CAMERA),
            (s.source_present() && now_ns - last_frame_ns > NO_FRAMES_NS, error::NO_FRAMES),
            (seen_any && s.points_followed() == 0, error::NO_FEATURES),
            (state == TrackingState::Tracking && s.landmarks_tracked() < FEW, error::LOW_FEATURES),
            (seen_any && s.points_followed() < FEW, error::LOW_FEATURES),
            (s.calibration_refused(), error::BAD_CALIBRATION),
            (seen_any && s.lens().0 == LensKnowledge::Guessed, error::UNCALIBRATED),
            (s.scale_is_assumed(), error::SCALE_ASSUMED),
            (s.wheels_heard_ns().is_some_and(|at| now_ns - at > WHEELS_SILENT_NS), error::WHEELS_SILENT),
            (!self.all_alive(now_ns), error::STALLED_STAGE),
            (state == TrackingState::Lost, error::LOST),
            (self.save_failed || s.map_not_stored(), error::SAVE_FAILED),
        ];
        conditions.iter().filter(|(stands, _)| *stands).fold(self.events, |bits, (_, bit)| bits | bit)
    }

    /// A fault's beginning at once; its end when it has been away for a second, so that one that flickers is one record.
    fn log_faults(&mut self, errors: u64, now_ns: i64) {
        let mut recent = 0;
        for (bit, seen_ns) in self.last_seen_ns.iter_mut().enumerate() {
            if errors >> bit & 1 == 1 {
                *seen_ns = now_ns;
            }
            if self.logged >> bit & 1 == 1 && now_ns - *seen_ns < SECOND_NS {
                recent |= 1 << bit;
            }
        }
        let standing = errors | recent;
        let (began, ended) = (standing & !self.logged, self.logged & !standing);
        self.logged = standing;
        for fault in error::names(began) {
            warn!(fault, advice = advice(fault), "fault began");
        }
        for fault in error::names(ended) {
            info!(fault, "fault ended");
        }
        if began & error::STALLED_STAGE != 0 {
            for heart in self.hearts() {
                if let Some(silent) = heart.stalled(now_ns, self.stall_after) {
                    warn!(stage = heart.stage(), silent_ms = silent.as_millis() as u64, "stage has stalled");
                }
            }
        }
    }

    /// State of the last frame; but a robot whose pictures have stopped, or cannot be used any more, is no longer being tracked.
    fn state(&self, errors: u64, now_ns: i64) -> TrackingState {
        let blind = errors & (error::NO_CAMERA | error::NO_FRAMES | error::BAD_CALIBRATION) != 0;
        // Pictures that come and cannot be decoded are no frames either, nor are those that a stage hangs over.
        let blind = blind || self.status.last_processed_arrival_ns().is_some_and(|at| now_ns - at > NO_FRAMES_NS);
        match self.status.state() {
            TrackingState::Tracking if blind => TrackingState::Lost,
            TrackingState::DeadReckoning if blind => TrackingState::Lost,
            TrackingState::Orientation if blind => TrackingState::Initializing,
            state => state,
        }
    }

    fn health(&self, now_ns: i64, errors: u64) -> Health {
        let s = &self.status;
        let age = |at: Option<i64>| at.map_or(UNKNOWN_NS, |at| now_ns - at);
        let ((landmarks, keyframes), (map_id, reset_counter)) = (s.map_size(), s.map_and_resets());
        let mut stages = self.stages;
        let hearts = [
            (stage::CAPTURE, &s.capture),
            (stage::FEATURES, &s.features),
            (stage::TRACKING, &s.reconstruction),
            (stage::MAPPING, &s.reconstruction),
            (stage::PUBLISHING, &s.reconstruction),
        ];
        for (index, heart) in hearts {
            if let Some(stage) = stages.get_mut(index) {
                stage.heartbeat_age_ns = heart.age_ns(now_ns).unwrap_or(UNKNOWN_NS);
            }
        }
        let (map_revision, [correction_distance, correction_rad]) = s.corrections();
        let (knowledge, [fx, fy, cx, cy, focal_sigma, centre_sigma_px]) = s.lens();
        let wheels = WheelTotals::of(s);
        Health {
            errors,
            blind_ns: s.blind_ns.get(),
            blind_m: s.blind_mm.get() as f64 * 1e-3,
            wheel_messages: wheels.received,
            wheel_refused: wheels.refused,
            wheel_missing: wheels.missing,
            wheel_late: wheels.late,
            intrinsics: convert::intrinsics(knowledge),
            lens_model: convert::lens_model(s.lens_is_wide_angle()),
            focal_px: [fx, fy],
            centre_px: [cx, cy],
            focal_sigma,
            centre_sigma_px,
            frames_captured: s.captured.get(),
            frames_dropped: s.dropped.get() + s.missed.get(),
            frames_corrupt: s.corrupt.get() + s.unreadable.get(),
            frames_tracked: s.tracked.get(),
            keyframes_made: s.keyframes.get(),
            landmarks_made: s.landmarks_made.get(),
            adjustments: s.adjustments.get(),
            adjustments_late: s.adjustments_late.get(),
            resets: s.resets.get(),
            relocalisations: s.relocalisations.get(),
            maps_joined: s.maps_joined.get(),
            loops_closed: s.loops_closed.get(),
            maps: s.maps(),
            map_revision,
            map_mode: s.map_mode(),
            correction_distance,
            correction_rad,
            frame_age_ns: age(s.last_arrival_ns()),
            pose_age_ns: age(s.last_pose_arrival_ns()),
            stages,
            keyframes,
            landmarks,
            reset_counter,
            map_id,
            state: convert::state(self.state(errors, now_ns)),
            clock: convert::clock(self.clock),
            ..Health::default()
        }
    }
}

fn stage_health(steps: u64, rate_hz: f64, p: &Percentiles) -> StageHealth {
    StageHealth {
        steps,
        p50_ms: p.p50_ms as f32,
        p95_ms: p.p95_ms as f32,
        p99_ms: p.p99_ms as f32,
        rate_hz: rate_hz as f32,
        ..StageHealth::default()
    }
}

#[cfg(test)]
mod tests;
