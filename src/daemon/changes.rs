//! What is logged of a frame: what is different since the one before, and at `debug` the frame itself.

use tracing::{debug, error, info, warn};

use super::blind::BlindLog;
use super::floor::FloorLog;
use super::status::state_name;
use crate::map::scale::MapScale;
use crate::motion::floor::ScaleConfig;
use crate::motion::scale::ScaleMeasurement;
use crate::reconstruction::{PoseEstimate, Reconstruction, TrackingState};

/// What was told last.
#[derive(Debug, Default)]
pub struct ChangeLog {
    state: Option<TrackingState>,
    resets: u32,
    maps_joined: u64,
    loops_closed: u64,
    loops_tied: u64,
    spool_faults: u64,
    pictures_unread: u64,
    pictures_lost: u64,
    blind_turns: u64,
    contradictions: u64,
    scale: MapScale,
    slipping: bool,
    tag_scale: Option<ScaleMeasurement>,
    blind: BlindLog,
    floor: FloorLog,
}

impl ChangeLog {
    /// After each frame; whether the map has become metric with it.
    pub fn follow(&mut self, reconstruction: &Reconstruction, scale: &ScaleConfig, e: &PoseEstimate) -> bool {
        let (sequence, timestamp_ns, map) = (e.sequence, e.timestamp_ns, e.map.0);
        let counters = reconstruction.counters();
        self.tag_scale(reconstruction, e);
        if e.reset_counter != self.resets {
            info!(sequence, timestamp_ns, map, reset_counter = e.reset_counter, "reset");
            self.resets = e.reset_counter;
        }
        if counters.maps_joined != self.maps_joined {
            info!(sequence, timestamp_ns, map, maps_joined = counters.maps_joined, "map joined");
            self.maps_joined = counters.maps_joined;
        }
        let became_metric = self.map_scale(reconstruction, e);
        if counters.loops_closed != self.loops_closed {
            let (distance, angle_rad) = (reconstruction.corrections().distance, reconstruction.corrections().angle_rad);
            let loops_closed = counters.loops_closed;
            info!(sequence, timestamp_ns, map, loops_closed, distance, angle_rad, "loop closed");
            self.loops_closed = loops_closed;
        }
        if counters.loops_tied != self.loops_tied {
            info!(sequence, timestamp_ns, map, loops_tied = counters.loops_tied, "loop tied");
            self.loops_tied = counters.loops_tied;
        }
        if counters.spool_faults != self.spool_faults {
            let reason = reconstruction.picture_fault();
            warn!(sequence, reason, "pictures of far keyframes stay in memory");
            self.spool_faults = counters.spool_faults;
        }
        if counters.pictures_unread != self.pictures_unread {
            let reason = reconstruction.picture_fault();
            warn!(sequence, reason, "picture of a far keyframe not read, tried again later");
            self.pictures_unread = counters.pictures_unread;
        }
        if counters.pictures_lost != self.pictures_lost {
            let (reason, pictures_lost) = (reconstruction.picture_fault(), counters.pictures_lost);
            error!(sequence, reason, pictures_lost, "pictures of far keyframes lost");
            self.pictures_lost = pictures_lost;
        }
        self.blind.follow(reconstruction, e, state_name(e.state));
        if scale.is_on() {
            self.floor.follow(scale, reconstruction, e);
        }
        if counters.contradictions != self.contradictions {
            let contradictions = counters.contradictions;
            warn!(sequence, timestamp_ns, map, contradictions, "most of the picture contradicts the poses");
            self.contradictions = counters.contradictions;
        }
        if counters.blind_turns != self.blind_turns {
            let blind_turns = counters.blind_turns;
            warn!(sequence, timestamp_ns, map, blind_turns, "scale assumed after a turn on the spot");
            self.blind_turns = blind_turns;
        }
        self.state(e);
        if e.keyframe {
            let (keyframes, landmarks_made) = (counters.keyframes_made, counters.landmarks_made);
            // Where much is new there is one a second, which would fill a journal in a night.
            debug!(sequence, timestamp_ns, map, keyframes, landmarks_made, landmarks = e.landmarks, "keyframe");
        } else {
            debug!(sequence, landmarks = e.landmarks, sought = e.landmarks_sought, quality = e.quality, "frame");
        }
        became_metric
    }

    fn state(&mut self, e: &PoseEstimate) {
        if self.state == Some(e.state) {
            return;
        }
        let (sequence, timestamp_ns, map) = (e.sequence, e.timestamp_ns, e.map.0);
        let from = self.state.map_or("none", state_name);
        let (state, landmarks) = (state_name(e.state), e.landmarks);
        // In dim light an orientation may come and go with each frame, which would fill a journal.
        let before_a_map = |s: TrackingState| matches!(s, TrackingState::Initializing | TrackingState::Orientation);
        if before_a_map(e.state) && self.state.is_some_and(before_a_map) {
            debug!(sequence, timestamp_ns, map, from, state, landmarks, "state");
        } else {
            info!(sequence, timestamp_ns, map, from, state, landmarks, "state");
        }
        self.state = Some(e.state);
    }

    /// The scale that tags tell, when it is told first, has become surer by a fifth or has moved by two sigmas.
    fn tag_scale(&mut self, reconstruction: &Reconstruction, e: &PoseEstimate) {
        let told = reconstruction.scale_by_tags();
        let news = match (told, self.tag_scale) {
            (Some(now), Some(last)) => {
                let moved = (now.log_metres_per_unit - last.log_metres_per_unit).abs();
                now.sigma < 0.8 * last.sigma || moved > 2.0 * last.sigma
            }
            (now, _) => now.is_some(),
        };
        if let Some(now) = told.filter(|_| news) {
            let (sequence, timestamp_ns, map) = (e.sequence, e.timestamp_ns, e.map.0);
            let metres_per_unit = now.log_metres_per_unit.exp();
            info!(sequence, timestamp_ns, map, metres_per_unit, sigma = now.sigma, "scale by tags");
        }
        if news || told.is_none() {
            self.tag_scale = told;
        }
    }

    /// The map has become metric, or another one has begun that is not; the wheels slip.
    fn map_scale(&mut self, reconstruction: &Reconstruction, e: &PoseEstimate) -> bool {
        let (sequence, timestamp_ns, scale) = (e.sequence, e.timestamp_ns, reconstruction.scale());
        let was_metric = self.scale.is_metric();
        if let (MapScale::Metric { sigma, sources }, false) = (scale, was_metric) {
            let sources = format!("{sources}");
            info!(sequence, timestamp_ns, sigma, sources, "map is metric");
        }
        let slipping = reconstruction.wheels_slip();
        if slipping && !self.slipping {
            let slips = reconstruction.base().map(|(_, slips)| slips);
            warn!(sequence, timestamp_ns, slips, "wheels slip");
        }
        (self.scale, self.slipping) = (scale, slipping);
        scale.is_metric() && !was_metric
    }
}
