//! Poses, health and map: where the robot is, how it is, and what it knows.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use serde::Serialize;

use super::source::{LOOK, NAP, Source, pause, while_wanted};
use crate::client::{ClientError, monotonic_ns};
use crate::console::hub::{Hub, demand, lock};
use crate::console::wire::{self, Kind, MapHead};
use crate::messages::{Health, Pose, Scale, State, UNKNOWN_NS, error, scale_source, stage};

/// Messages of state a second at most.
const STATE_EVERY: Duration = Duration::from_millis(200);
/// Health comes ten times a second; a daemon that is silent for so long hangs or was stopped.
const SILENT_NS: i64 = 1_500_000_000;

/// What is known of the daemon.
#[derive(Debug, Serialize)]
struct Report<'a> {
    /// `connected`, `waiting` (there is no daemon), `silent` (there is one that says nothing), `error`.
    link: &'static str,
    /// A sentence for a person.
    sentence: String,
    prefix: &'a str,
    console_version: &'static str,
    /// What the daemon said last.
    daemon: Option<Daemon>,
}

#[derive(Debug, Serialize)]
struct Fault {
    name: &'static str,
    advice: &'static str,
}

#[derive(Debug, Serialize)]
struct Daemon {
    version: String,
    pid: u32,
    /// As text: it does not fit a number of JavaScript's.
    run_id: String,
    uptime_s: f64,
    realtime_minus_monotonic_s: f64,
    state: &'static str,
    faults: Vec<Fault>,
    frames_captured: u64,
    frames_dropped: u64,
    frames_corrupt: u64,
    frames_tracked: u64,
    keyframes: u32,
    landmarks: u32,
    maps: u32,
    resets: u64,
    relocalisations: u64,
    maps_joined: u64,
    loops_closed: u64,
    frame_age_s: Option<f64>,
    pose_age_s: Option<f64>,
    rate_hz: f32,
    latency_p50_ms: f32,
    latency_p95_ms: f32,
    latency_p99_ms: f32,
    intrinsics: &'static str,
    lens_model: &'static str,
    focal_px: [f32; 2],
    focal_sigma: f32,
    scale: &'static str,
    scale_sigma: f32,
    scale_source: Vec<&'static str>,
}

/// What a state means for whoever stands beside the robot.
fn sentence(state: State) -> &'static str {
    match state {
        State::Tracking => "Tracking: the pose rests on landmarks seen in this frame.",
        State::Initializing => "No map yet: move the camera sideways.",
        State::Orientation => "No map yet, but a heading: move the camera sideways.",
        State::Lost => "Lost: go back to where the camera has been, or move on and a new map begins.",
        State::DeadReckoning => "The picture is lost; the wheels alone carry the pose on.",
        State::Unknown(_) => "A state of a newer daemon: install the same version of both.",
    }
}

fn seconds(ns: i64) -> Option<f64> {
    (ns != UNKNOWN_NS).then_some(ns as f64 * 1e-9)
}

/// What is known of the length of a map unit.
#[derive(Debug, Clone, Copy)]
struct ScaleKnown {
    scale: Scale,
    sigma: f32,
    /// Bits of [`scale_source`].
    source: u8,
}

impl ScaleKnown {
    const NOTHING: Self = Self { scale: Scale::Arbitrary, sigma: f32::NAN, source: 0 };

    fn of(pose: &Pose) -> Self {
        Self { scale: pose.scale(), sigma: pose.scale_sigma, source: pose.scale_source }
    }
}

fn daemon(h: &Health, advice: fn(&str) -> &'static str, scale: ScaleKnown) -> Daemon {
    let end_to_end = h.stages.get(stage::END_TO_END).copied().unwrap_or_default();
    Daemon {
        version: h.version().into(),
        pid: h.pid,
        run_id: h.run_id.to_string(),
        uptime_s: h.uptime_ns as f64 * 1e-9,
        realtime_minus_monotonic_s: h.realtime_minus_monotonic_ns as f64 * 1e-9,
        state: h.state().name(),
        faults: error::names(h.errors).map(|name| Fault { name, advice: advice(name) }).collect(),
        frames_captured: h.frames_captured,
        frames_dropped: h.frames_dropped,
        frames_corrupt: h.frames_corrupt,
        frames_tracked: h.frames_tracked,
        keyframes: h.keyframes,
        landmarks: h.landmarks,
        maps: h.maps,
        resets: h.resets,
        relocalisations: h.relocalisations,
        maps_joined: h.maps_joined,
        loops_closed: h.loops_closed,
        frame_age_s: seconds(h.frame_age_ns),
        pose_age_s: seconds(h.pose_age_ns),
        rate_hz: h.stages.get(stage::CAPTURE).map_or(f32::NAN, |s| s.rate_hz),
        latency_p50_ms: end_to_end.p50_ms,
        latency_p95_ms: end_to_end.p95_ms,
        latency_p99_ms: end_to_end.p99_ms,
        intrinsics: h.intrinsics().name(),
        lens_model: h.lens_model().name(),
        focal_px: h.focal_px,
        focal_sigma: h.focal_sigma,
        scale: scale.scale.name(),
        scale_sigma: scale.sigma,
        scale_source: scale_source::names(scale.source).collect(),
    }
}

fn tell(hub: &Hub, report: &Report<'_>) {
    hub.tell(Kind::State, 0, &wire::json(Kind::State, report));
}

fn report<'a>(source: &'a Source, link: &'static str, sentence: String, daemon: Option<Daemon>) -> Report<'a> {
    Report { link, sentence, prefix: source.prefix(), console_version: env!("CARGO_PKG_VERSION"), daemon }
}

/// Poses and health until `stop`.
pub fn run(hub: &Hub, source: &Source, advice: fn(&str) -> &'static str, stop: &AtomicBool) {
    while !stop.load(Ordering::Relaxed) {
        if let Err(error) = follow(hub, source, advice, stop) {
            tell(hub, &report(source, "error", error.to_string(), None));
            pause(stop);
        }
    }
}

fn follow(hub: &Hub, source: &Source, advice: fn(&str) -> &'static str, stop: &AtomicBool) -> Result<(), ClientError> {
    let client = source.client()?;
    let (mut poses, mut healths) = (client.poses().polled(LOOK), client.health().polled(LOOK));
    let mut told: Option<(Instant, &str)> = None;
    let mut scale = ScaleKnown::NOTHING;
    let mut connected_ns = None;
    while !stop.load(Ordering::Relaxed) {
        if let Some(pose) = poses.wait(NAP)? {
            scale = ScaleKnown::of(&pose);
            let sample = lock(&hub.history).add(&pose);
            hub.tell(Kind::Poses, 0, &wire::samples(Kind::Poses, [sample].iter()));
        }
        let is_connected = poses.is_connected();
        let health = healths.latest()?;
        connected_ns = is_connected.then(|| connected_ns.unwrap_or_else(monotonic_ns));
        let since_ns = connected_ns.map_or(0, |at| monotonic_ns() - at);
        let silent = health.map_or(since_ns, |h| h.age_ns(monotonic_ns())) > SILENT_NS;
        let link = match (is_connected, silent) {
            (false, _) => "waiting",
            // It has just begun.
            (true, false) if health.is_none() => "waiting",
            (true, true) => "silent",
            (true, false) => "connected",
        };
        if told.is_some_and(|(when, said)| said == link && when.elapsed() < STATE_EVERY) {
            continue;
        }
        told = Some((Instant::now(), link));
        let text = match (link, health) {
            ("waiting", _) => {
                format!("No daemon with the prefix \"{}\" runs. It will be found when it starts.", source.prefix())
            }
            ("silent", _) => {
                "A daemon is there and says nothing: it hangs, was stopped, or has just been killed.".into()
            }
            (_, Some(health)) => sentence(health.state()).into(),
            _ => String::new(),
        };
        tell(hub, &report(source, link, text, health.map(|h| daemon(h, advice, scale))));
    }
    Ok(())
}

/// The map while a page shows it, until `stop`.
pub fn run_map(hub: &Hub, source: &Source, stop: &AtomicBool) {
    while_wanted(stop, || hub.wants(demand::MAP), || follow_map(hub, source, stop));
}

fn follow_map(hub: &Hub, source: &Source, stop: &AtomicBool) -> Result<(), ClientError> {
    let client = source.client()?;
    let (mut maps, mut keyframes) = (client.map().polled(LOOK), client.keyframes().polled(LOOK));
    let mut told = None;
    while !stop.load(Ordering::Relaxed) && hub.wants(demand::MAP) {
        let Some(map) = maps.wait(NAP)? else { continue };
        let h = map.header();
        // The same content again, as while the robot stands, costs no page anything.
        let content = (h.run_id, h.content_revision, h.map_revision, h.reset_counter);
        if told.replace(content) == Some(content) {
            continue;
        }
        let epoch = lock(&hub.history).epoch(h.run_id, h.map_id, h.reset_counter, h.map_revision);
        let head = MapHead { epoch, total: h.total, scale: h.scale, revision: h.content_revision };
        if let Some(keyframes) = keyframes.latest()? {
            let k = keyframes.header();
            let epoch = lock(&hub.history).epoch(k.run_id, k.map_id, k.reset_counter, k.map_revision);
            let head = MapHead { epoch, total: k.total, scale: k.scale, revision: k.content_revision };
            hub.tell(Kind::Keyframes, demand::MAP, &wire::keyframes(keyframes, &head));
        }
        hub.tell(Kind::Map, demand::MAP, &wire::map(&map, &head));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faults_come_with_what_to_do() {
        let health = Health { errors: error::LOST | error::NO_CAMERA, ..Health::default() };
        let pose = Pose { scale: 2, scale_sigma: 0.02, scale_source: scale_source::TAG, ..Pose::default() };
        let said = daemon(&health, |name| if name == "LOST" { "go back" } else { "plug it in" }, ScaleKnown::of(&pose));
        assert_eq!((said.scale, said.scale_sigma, said.scale_source.as_slice()), ("METRIC", 0.02, &["TAG"][..]));
        let faults: Vec<_> = said.faults.iter().map(|f| (f.name, f.advice)).collect();
        assert_eq!(faults, [("NO_CAMERA", "plug it in"), ("LOST", "go back")]);
        assert_eq!(said.frame_age_s, None);
    }
}
