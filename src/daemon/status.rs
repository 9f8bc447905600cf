//! What the stages say of themselves while they run: counters, latencies, signs of life. Written by the stages, read by
//! the supervisor and by whoever prints a summary. Fixed size, no locks.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU8, AtomicU32, AtomicU64, Ordering};

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use crate::geometry::Se3;
use crate::geometry::frames::{Body, Camera};
use crate::map::MapSnapshot;
use crate::motion::wheel::WheelCounts;
use crate::reconstruction::{Corrections, Counters, LensEstimate, LensKnowledge, PoseEstimate, TrackingState};
use crate::telemetry::{Counter, Heartbeat, Histogram};

/// State and statistics of one run.
#[derive(Debug)]
pub struct Status {
    pub capture: Heartbeat,
    pub features: Heartbeat,
    pub reconstruction: Heartbeat,

    /// Frames that a source delivered.
    pub captured: Counter,
    /// Frames overwritten in the ring because the feature thread had no room for them.
    pub dropped: Counter,
    /// Frames that a camera's driver lost, by its numbers.
    pub missed: Counter,
    /// Frames that the source itself could not read.
    pub unreadable: Counter,
    /// Frames whose timestamp repeated, went back, or jumped without a second frame to confirm it.
    pub bad_timestamps: Counter,
    /// Frames that could not be decoded.
    pub corrupt: Counter,
    /// Frames of another size than those before.
    pub wrong_size: Counter,
    /// Frames handed to reconstruction.
    pub processed: Counter,
    /// Frames with a pose.
    pub tracked: Counter,
    pub poses_published: Counter,
    pub maps_published: Counter,
    /// Messages that could not be published.
    pub publish_failures: Counter,
    /// Trajectory records that the recorder had no room or no disk for.
    pub records_lost: Counter,
    pub keyframes: Counter,
    pub landmarks_made: Counter,
    pub resets: Counter,
    pub relocalisations: Counter,
    pub maps_joined: Counter,
    pub loops_closed: Counter,
    pub loops_tied: Counter,
    /// Turns on the spot behind which the scale is an assumption.
    pub blind_turns: Counter,
    /// Time (ns) and way (mm) for which the wheels alone told the pose.
    pub blind_ns: Counter,
    pub blind_mm: Counter,
    pub adjustments: Counter,
    pub adjustments_late: Counter,
    /// What has become of the messages of the base's driver.
    pub wheels: Arc<WheelCounts>,

    /// Grey picture from the bytes of a frame.
    pub decode: Histogram,
    /// Pyramid, corners and tracks of a decoded picture.
    pub feature: Histogram,
    /// Between the end of the feature step and the beginning of tracking.
    pub queue: Histogram,
    /// A frame's pose from its features.
    pub track: Histogram,
    /// Keyframe work after the pose, in the reconstruction thread.
    pub mapping: Histogram,
    /// Sending of one message.
    pub publish: Histogram,
    /// From a frame's capture to its arrival in the process, where the source's clock tells.
    pub capture_delay: Histogram,
    /// From a frame's arrival in the process to its published pose.
    pub latency: Histogram,

    source_present: AtomicBool,
    /// What the camera granted, mHz; 0: not known.
    nominal_rate_mhz: AtomicU32,
    calibration_refused: AtomicBool,
    map_not_stored: AtomicBool,
    scale_is_assumed: AtomicBool,
    state: AtomicU8,
    /// Of the current map, as of its last snapshot.
    map_landmarks: AtomicU32,
    map_keyframes: AtomicU32,
    map_id: AtomicU32,
    map_revision: AtomicU32,
    map_mode: AtomicU8,
    /// Kept, the current one among them.
    maps: AtomicU32,
    /// Bits of: how far the last correction moved (map units) and turned (rad) the pose.
    correction: [AtomicU32; 2],
    reset_counter: AtomicU32,
    /// That the last frame's pose rests on.
    landmarks_tracked: AtomicU32,
    /// Points followed in the last frame.
    points_followed: AtomicU32,
    /// CLOCK_MONOTONIC of the arrival of the last frame, of the last that was looked at, and of the last with a pose, ns; 0 before the first.
    last_arrival_ns: AtomicI64,
    last_processed_arrival_ns: AtomicI64,
    last_pose_arrival_ns: AtomicI64,
    /// CLOCK_MONOTONIC when the base's driver was heard last on the wire, ns; 0 before.
    wheels_heard_ns: AtomicI64,
    /// 0 calibrated, 1 estimated, 2 guessed. Nothing is known of a lens before there is one: then it is no better than a guess.
    lens_knowledge: AtomicU8,
    lens_is_wide_angle: AtomicBool,
    /// Bits of: fx fy cx cy, standard deviations of the focal length (share) and the principal point (px).
    lens: [AtomicU32; 6],
    /// The same lens with all digits, for recorders: fx fy cx cy (px), and its coefficients.
    exact_lens: [AtomicU64; 9],
    /// Where the camera sits, if the robot's motion has shown it, for recorders: position (m) and quaternion of `body_from_camera`; NaN before.
    found_mount: [AtomicU64; 7],
    stop: AtomicBool,
}

impl Default for Status {
    fn default() -> Self {
        Self {
            capture: Heartbeat::new("capture"),
            features: Heartbeat::new("features"),
            reconstruction: Heartbeat::new("reconstruction"),
            captured: Counter::default(),
            dropped: Counter::default(),
            missed: Counter::default(),
            unreadable: Counter::default(),
            bad_timestamps: Counter::default(),
            corrupt: Counter::default(),
            wrong_size: Counter::default(),
            processed: Counter::default(),
            tracked: Counter::default(),
            poses_published: Counter::default(),
            maps_published: Counter::default(),
            publish_failures: Counter::default(),
            records_lost: Counter::default(),
            keyframes: Counter::default(),
            landmarks_made: Counter::default(),
            resets: Counter::default(),
            relocalisations: Counter::default(),
            maps_joined: Counter::default(),
            loops_closed: Counter::default(),
            loops_tied: Counter::default(),
            blind_turns: Counter::default(),
            blind_ns: Counter::default(),
            blind_mm: Counter::default(),
            adjustments: Counter::default(),
            adjustments_late: Counter::default(),
            wheels: Arc::default(),
            decode: Histogram::default(),
            feature: Histogram::default(),
            queue: Histogram::default(),
            track: Histogram::default(),
            mapping: Histogram::default(),
            publish: Histogram::default(),
            capture_delay: Histogram::default(),
            latency: Histogram::default(),
            source_present: AtomicBool::new(false),
            nominal_rate_mhz: AtomicU32::new(0),
            calibration_refused: AtomicBool::new(false),
            map_not_stored: AtomicBool::new(false),
            scale_is_assumed: AtomicBool::new(false),
            state: AtomicU8::new(0),
            map_landmarks: AtomicU32::new(0),
            map_keyframes: AtomicU32::new(0),
            map_id: AtomicU32::new(0),
            map_revision: AtomicU32::new(0),
            map_mode: AtomicU8::new(0),
            maps: AtomicU32::new(0),
            correction: [const { AtomicU32::new(f32::NAN.to_bits()) }; 2],
            reset_counter: AtomicU32::new(0),
            landmarks_tracked: AtomicU32::new(0),
            points_followed: AtomicU32::new(0),
            last_arrival_ns: AtomicI64::new(0),
            last_processed_arrival_ns: AtomicI64::new(0),
            last_pose_arrival_ns: AtomicI64::new(0),
            wheels_heard_ns: AtomicI64::new(0),
            lens_knowledge: AtomicU8::new(2),
            lens_is_wide_angle: AtomicBool::new(false),
            lens: [const { AtomicU32::new(f32::NAN.to_bits()) }; 6],
            exact_lens: [const { AtomicU64::new(f64::NAN.to_bits()) }; 9],
            found_mount: [const { AtomicU64::new(f64::NAN.to_bits()) }; 7],
            stop: AtomicBool::new(false),
        }
    }
}

impl Status {
    /// Asks every stage to end.
    pub fn request_stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    /// The stages are to end. A flag that is polled: nothing else is ordered by it.
    pub fn stopping(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Whether there is a source that delivers or may deliver.
    pub fn source_present(&self) -> bool {
        self.source_present.load(Ordering::Relaxed)
    }

    pub fn set_source_present(&self, present: bool) {
        self.source_present.store(present, Ordering::Relaxed);
    }

    /// Frames a second that the source said it would give; 0: not known.
    pub fn nominal_rate_hz(&self) -> f64 {
        f64::from(self.nominal_rate_mhz.load(Ordering::Relaxed)) * 1e-3
    }

    pub fn set_nominal_rate_hz(&self, rate_hz: f64) {
        // A cast of what is no number or negative gives 0.
        self.nominal_rate_mhz.store((rate_hz * 1e3) as u32, Ordering::Relaxed);
    }

    /// The calibration does not belong to the source's pictures.
    pub fn calibration_refused(&self) -> bool {
        self.calibration_refused.load(Ordering::Relaxed)
    }

    pub fn set_calibration_refused(&self, refused: bool) {
        self.calibration_refused.store(refused, Ordering::Relaxed);
    }

    /// The map's newest changes cannot be written to its file.
    pub fn map_not_stored(&self) -> bool {
        self.map_not_stored.load(Ordering::Relaxed)
    }

    pub fn set_map_not_stored(&self, is_not: bool) {
        self.map_not_stored.store(is_not, Ordering::Relaxed);
    }

    /// The last pose lies behind a turn on the spot, at a scale that is assumed.
    pub fn scale_is_assumed(&self) -> bool {
        self.scale_is_assumed.load(Ordering::Relaxed)
    }

    pub fn set_scale_is_assumed(&self, assumed: bool) {
        self.scale_is_assumed.store(assumed, Ordering::Relaxed);
    }

    /// State of tracking after the last frame.
    pub fn state(&self) -> TrackingState {
        match self.state.load(Ordering::Relaxed) {
            1 => TrackingState::Tracking,
            2 => TrackingState::Lost,
            3 => TrackingState::Orientation,
            4 => TrackingState::DeadReckoning,
            _ => TrackingState::Initializing,
        }
    }

    /// Landmarks that the last frame's pose rests on.
    pub fn landmarks_tracked(&self) -> u32 {
        self.landmarks_tracked.load(Ordering::Relaxed)
    }

    /// Points followed in the last frame.
    pub fn points_followed(&self) -> u32 {
        self.points_followed.load(Ordering::Relaxed)
    }

    /// Takes over one frame's outcome.
    pub fn set_frame(&self, estimate: &PoseEstimate, points_followed: usize) {
        let state = match estimate.state {
            TrackingState::Initializing => 0,
            TrackingState::Tracking => 1,
            TrackingState::Lost => 2,
            TrackingState::Orientation => 3,
            TrackingState::DeadReckoning => 4,
        };
        self.state.store(state, Ordering::Relaxed);
        self.last_processed_arrival_ns.store(estimate.arrival_ns, Ordering::Relaxed);
        self.map_id.store(estimate.map.0, Ordering::Relaxed);
        self.reset_counter.store(estimate.reset_counter, Ordering::Relaxed);
        self.landmarks_tracked.store(estimate.landmarks, Ordering::Relaxed);
        self.points_followed.store(u32::try_from(points_followed).unwrap_or(u32::MAX), Ordering::Relaxed);
        if estimate.state == TrackingState::Tracking {
            // What the wheels alone tell is no pose that the picture has confirmed.
            self.last_pose_arrival_ns.store(estimate.arrival_ns, Ordering::Relaxed);
        }
    }

    /// Takes over how the lens is believed to be. Readers may see half of a change; the next health message has all of it.
    pub fn set_lens(&self, lens: &LensEstimate) {
        let (c, [sx, sy]) = (&lens.camera, lens.centre_sigma_px);
        let numbers = [c.fx, c.fy, c.cx, c.cy, lens.focal_sigma, sx.max(sy)];
        for (slot, number) in self.lens.iter().zip(numbers) {
            slot.store((number as f32).to_bits(), Ordering::Relaxed);
        }
        let coefficients = c.lens.coefficients().iter().copied().chain([0.0]);
        for (slot, number) in self.exact_lens.iter().zip([c.fx, c.fy, c.cx, c.cy].into_iter().chain(coefficients)) {
            slot.store(number.to_bits(), Ordering::Relaxed);
        }
        self.set_lens_knowledge(lens.knowledge);
        self.lens_is_wide_angle.store(c.lens.is_wide_angle(), Ordering::Relaxed);
    }

    /// Where the lens comes from, before the first frame tells its numbers.
    pub fn set_lens_knowledge(&self, knowledge: LensKnowledge) {
        let knowledge = match knowledge {
            LensKnowledge::Calibrated => 0,
            LensKnowledge::Estimated => 1,
            LensKnowledge::Guessed => 2,
        };
        self.lens_knowledge.store(knowledge, Ordering::Relaxed);
    }

    /// Whether it is a wide-angle (Kannala-Brandt) lens.
    pub fn lens_is_wide_angle(&self) -> bool {
        self.lens_is_wide_angle.load(Ordering::Relaxed)
    }

    /// Where the lens comes from, and fx fy cx cy (px), standard deviations of focal length (share) and principal point (px); NaN
    /// before the first frame.
    pub fn lens(&self) -> (LensKnowledge, [f32; 6]) {
        let knowledge = match self.lens_knowledge.load(Ordering::Relaxed) {
            0 => LensKnowledge::Calibrated,
            1 => LensKnowledge::Estimated,
            _ => LensKnowledge::Guessed,
        };
        (knowledge, std::array::from_fn(|i| f32::from_bits(self.lens[i].load(Ordering::Relaxed))))
    }

    /// fx fy cx cy (px), and k1 k2 p1 p2 k3 or the four coefficients of a wide-angle lens and zero; NaN before the first frame.
    pub fn exact_lens(&self) -> ([f64; 4], [f64; 5]) {
        let number = |i: usize| f64::from_bits(self.exact_lens[i].load(Ordering::Relaxed));
        (std::array::from_fn(number), std::array::from_fn(|i| number(4 + i)))
    }

    /// Where the camera sits as poses are published, once the robot's motion has shown it; `None` while that is the configuration's word.
    pub fn found_mount(&self) -> Option<Se3<Body, Camera>> {
        let [x, y, z, i, j, k, w] =
            std::array::from_fn(|at| f64::from_bits(self.found_mount[at].load(Ordering::Relaxed)));
        let is_there = [x, y, z, i, j, k, w].iter().all(|v| v.is_finite());
        is_there.then(|| Se3::new(UnitQuaternion::new_normalize(Quaternion::new(w, i, j, k)), Vector3::new(x, y, z)))
    }

    pub fn set_found_mount(&self, body_from_camera: &Se3<Body, Camera>) {
        let (t, q) = (&body_from_camera.translation, &body_from_camera.rotation);
        for (slot, number) in self.found_mount.iter().zip([t.x, t.y, t.z, q.i, q.j, q.k, q.w]) {
            slot.store(number.to_bits(), Ordering::Relaxed);
        }
    }

    /// Landmarks and keyframes of the map, as of its last snapshot.
    pub fn map_size(&self) -> (u32, u32) {
        (self.map_landmarks.load(Ordering::Relaxed), self.map_keyframes.load(Ordering::Relaxed))
    }

    /// Takes over the map's size.
    pub fn set_map(&self, map: &MapSnapshot) {
        self.map_landmarks.store(u32::try_from(map.totals()[0]).unwrap_or(u32::MAX), Ordering::Relaxed);
        self.map_keyframes.store(u32::try_from(map.totals()[1]).unwrap_or(u32::MAX), Ordering::Relaxed);
    }

    /// The current map, and how often poses became unrelated to earlier ones.
    pub fn map_and_resets(&self) -> (u32, u32) {
        (self.map_id.load(Ordering::Relaxed), self.reset_counter.load(Ordering::Relaxed))
    }

    /// Takes over how often and how far map coordinates were corrected, and how many maps are kept.
    pub fn set_corrections(&self, corrections: &Corrections, maps: usize) {
        self.map_revision.store(corrections.revision, Ordering::Relaxed);
        self.maps.store(u32::try_from(maps).unwrap_or(u32::MAX), Ordering::Relaxed);
        for (slot, number) in self.correction.iter().zip([corrections.distance, corrections.angle_rad]) {
            slot.store((number as f32).to_bits(), Ordering::Relaxed);
        }
    }

    /// Corrections of map coordinates so far; how far the last one moved (map units) and turned (rad) the pose.
    pub fn corrections(&self) -> (u32, [f32; 2]) {
        let far = std::array::from_fn(|i| f32::from_bits(self.correction[i].load(Ordering::Relaxed)));
        (self.map_revision.load(Ordering::Relaxed), far)
    }

    /// Bits of the wire's `map_mode`.
    pub fn set_map_mode(&self, mode: u8) {
        self.map_mode.store(mode, Ordering::Relaxed);
    }

    pub fn map_mode(&self) -> u8 {
        self.map_mode.load(Ordering::Relaxed)
    }

    /// Maps that are kept, the current one among them; 0 before the first frame.
    pub fn maps(&self) -> u32 {
        self.maps.load(Ordering::Relaxed)
    }

    /// CLOCK_MONOTONIC of the last frame's arrival, if there was one.
    pub fn last_arrival_ns(&self) -> Option<i64> {
        Some(self.last_arrival_ns.load(Ordering::Relaxed)).filter(|ns| *ns != 0)
    }

    /// The same of the last frame that was looked at, whatever came of it.
    pub fn last_processed_arrival_ns(&self) -> Option<i64> {
        Some(self.last_processed_arrival_ns.load(Ordering::Relaxed)).filter(|ns| *ns != 0)
    }

    /// The same of the last frame with a pose.
    pub fn last_pose_arrival_ns(&self) -> Option<i64> {
        Some(self.last_pose_arrival_ns.load(Ordering::Relaxed)).filter(|ns| *ns != 0)
    }

    /// When the base's driver was heard last on the wire, CLOCK_MONOTONIC ns.
    pub fn wheels_heard_ns(&self) -> Option<i64> {
        Some(self.wheels_heard_ns.load(Ordering::Relaxed)).filter(|ns| *ns != 0)
    }

    pub fn set_wheels_heard_ns(&self, ns: i64) {
        self.wheels_heard_ns.store(ns, Ordering::Relaxed);
    }

    pub fn set_last_arrival_ns(&self, ns: i64) {
        self.last_arrival_ns.store(ns, Ordering::Relaxed);
    }

    /// Takes over what reconstruction counts itself.
    pub fn set_counters(&self, c: &Counters) {
        self.keyframes.set(c.keyframes_made);
        self.landmarks_made.set(c.landmarks_made);
        self.resets.set(c.resets);
        self.relocalisations.set(c.relocalisations);
        self.maps_joined.set(c.maps_joined);
        self.loops_closed.set(c.loops_closed);
        self.loops_tied.set(c.loops_tied);
        self.blind_turns.set(c.blind_turns);
        self.blind_ns.set(c.blind_ns);
        self.blind_mm.set(c.blind_mm);
        self.adjustments.set(c.adjustments);
        self.adjustments_late.set(c.adjustments_late);
    }
}

/// A state's name as logged and printed.
pub fn state_name(state: TrackingState) -> &'static str {
    match state {
        TrackingState::Initializing => "INITIALIZING",
        TrackingState::Tracking => "TRACKING",
        TrackingState::Lost => "LOST",
        TrackingState::Orientation => "ORIENTATION",
        TrackingState::DeadReckoning => "DEAD_RECKONING",
    }
}
