//! The reconstruction step: one frame's features into a published pose, then into the map.
//!
//! The order is the daemon's promise: track, publish the pose, and only then keyframe work, logs, records and the map's
//! message. Nothing before the publication allocates, writes or waits.

use std::sync::Arc;
use std::time::Instant;

use tracing::{debug, error, info, warn};

use super::base;
use super::blind::BlindLog;
use super::floor::FloorLog;
use super::map_file::MapDesk;
use super::map_keeper::Keeper;
use super::obstacles;
use super::outlet::Outlet;
use super::recorder::{FinalMap, Record, RecorderLink};
use super::request::Request;
use super::status::{Status, state_name};
use super::wheels::WheelListener;
use crate::config::MountConfig;
use crate::features::{Feedback, FrameFeatures};
use crate::frame::monotonic_ns;
use crate::geometry::CameraModel;
use crate::map::MapSnapshot;
use crate::map::scale::MapScale;
use crate::motion::floor::ScaleConfig;
use crate::motion::hand_eye::Robot;
use crate::motion::obstacles::ObstaclesConfig;
use crate::motion::scale::ScaleMeasurement;
use crate::motion::tag::TagConfig;
use crate::motion::wheel::WheelQueue;
use crate::publish::{MapContext, PublishError};
use crate::reconstruction::{
    LensKnowledge, LensPrior, MappingWorker, PlaceWorker, PoseEstimate, Reconstruction, ReconstructionConfig,
    TrackingState, TrajectoryEvent, guessed_camera,
};
use crate::telemetry::RateLimiter;

/// A camera model and where it came from, for messages.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    pub model: CameraModel,
    pub origin: String,
    /// How well it is known.
    pub prior: LensPrior,
}

impl Calibration {
    /// Of somebody who measured it or says so.
    pub fn known(model: CameraModel, origin: String) -> Self {
        Self { model, origin, prior: LensPrior::Calibrated }
    }

    /// Nobody knows: an angle of view, degrees, to begin with.
    pub fn guessed((width, height): (u32, u32), view_deg: f64) -> Option<Self> {
        let model = guessed_camera(width, height, view_deg)?;
        Some(Self { model, origin: format!("none: {view_deg} degrees are supposed"), prior: LensPrior::UNKNOWN })
    }

    /// The model for pictures of this size: the same, or scaled if only the resolution differs.
    pub fn fit(&self, width: u32, height: u32) -> Result<CameraModel, String> {
        let (from_width, from_height) = (self.model.width, self.model.height);
        if (from_width, from_height) == (width, height) {
            return Ok(self.model.clone());
        }
        if self.prior == LensPrior::UNKNOWN {
            let longer = f64::from(from_width.max(from_height));
            let view_deg = 2.0 * (0.5 * longer / self.model.fx).atan().to_degrees();
            return guessed_camera(width, height, view_deg).ok_or_else(|| format!("no camera has {width}x{height} px"));
        }
        let scaled = self.model.scaled(width, height).map_err(|e| {
            format!(
                "{}: the calibration is for {from_width}x{from_height} px, the pictures have {width}x{height} px: {e}",
                self.origin
            )
        })?;
        warn!(from_width, from_height, width, height, "calibration scaled to the size of the pictures");
        Ok(scaled)
    }
}

/// A lens is kept again when its focal length is known this much better than what was kept, as a share of the standard deviation.
const KEEP_AGAIN: f64 = 0.8;

/// The reconstruction stage without its thread.
pub struct ReconstructStep {
    config: ReconstructionConfig,
    pub(super) calibration: Calibration,
    tag: TagConfig,
    scale: ScaleConfig,
    obstacles: ObstaclesConfig,
    lockstep: bool,
    /// Given to reconstruction with the first frame, whose size completes the camera model.
    worker: Option<Box<dyn MappingWorker>>,
    /// As well; without one places are recognised between frames.
    place_worker: Option<Box<dyn PlaceWorker>>,
    pub(super) reconstruction: Option<Reconstruction>,
    /// Of the pictures that the camera model is for; 0, 0 before the first.
    pub(super) size: (u32, u32),
    outlet: Option<Outlet>,
    recorder: RecorderLink,
    pub(super) map_file: Option<MapDesk>,
    status: Arc<Status>,
    /// What the base's wheels tell; `None`: nobody asks them.
    wheels: Option<Arc<WheelQueue>>,
    /// Their driver on the wire.
    driver: Option<WheelListener>,
    publish_faults: RateLimiter,
    events: Vec<TrajectoryEvent>,
    snapshot: MapSnapshot,
    last_state: Option<TrackingState>,
    last_resets: u32,
    last_blind_turns: u64,
    base: Option<(Robot, f64)>,
    last_scale: MapScale,
    last_slipping: bool,
    blind: BlindLog,
    last_maps_joined: u64,
    last_tag_scale: Option<ScaleMeasurement>,
    floor: FloorLog,
    last_loops_closed: u64,
    /// Times that a planner has put the map elsewhere: to its readers each is a reset.
    placements: u32,
    last_frame_ns: i64,
    /// What is said of the lens, and how surely it was known when it was last handed over to be kept.
    lens: Option<LensKnowledge>,
    kept_sigma: f64,
}

impl ReconstructStep {
    pub fn new(
        config: &ReconstructionConfig,
        calibration: Calibration,
        worker: Box<dyn MappingWorker>,
        lockstep: bool,
        outlet: Option<Outlet>,
        recorder: RecorderLink,
        status: Arc<Status>,
    ) -> Self {
        if calibration.prior == LensPrior::Calibrated {
            status.set_lens_knowledge(LensKnowledge::Calibrated);
        }
        Self {
            config: config.clone(),
            calibration,
            tag: TagConfig::default(),
            scale: ScaleConfig::default(),
            obstacles: ObstaclesConfig::default(),
            lockstep,
            worker: Some(worker),
            place_worker: None,
            reconstruction: None,
            size: (0, 0),
            outlet,
            recorder,
            map_file: None,
            status,
            wheels: None,
            driver: None,
            publish_faults: RateLimiter::default(),
            events: Vec::new(),
            snapshot: MapSnapshot::default(),
            last_state: None,
            last_resets: 0,
            last_blind_turns: 0,
            base: None,
            last_scale: MapScale::Unknown,
            last_slipping: false,
            blind: BlindLog::default(),
            last_maps_joined: 0,
            last_tag_scale: None,
            floor: FloorLog::default(),
            last_loops_closed: 0,
            placements: 0,
            last_frame_ns: 0,
            lens: None,
            kept_sigma: f64::INFINITY,
        }
    }

    /// With somebody who knows places again meanwhile.
    pub fn recognising_in(mut self, worker: Box<dyn PlaceWorker>) -> Self {
        self.place_worker = Some(worker);
        self
    }

    /// With what the base's wheels tell.
    pub fn with_wheels(mut self, wheels: Arc<WheelQueue>) -> Self {
        let inbox = self.outlet.as_mut().and_then(Outlet::take_wheels);
        self.driver = inbox.map(|inbox| WheelListener::new(inbox, wheels.clone(), self.status.clone()));
        self.wheels = Some(wheels);
        self
    }

    /// Hears the base's driver; to be called while no frame comes, too.
    pub fn listen(&mut self) {
        if let Some(driver) = &mut self.driver {
            driver.listen();
        }
    }

    /// What is known of the camera's place on the base, and of the wheels, before they move. To be said before the first frame.
    pub fn with_base(mut self, mount: &MountConfig, radius_sigma: f64) -> Self {
        self.base = Some((base::given(mount), radius_sigma));
        self
    }

    /// With a map on disk.
    pub fn with_map_file(self, map_file: Option<MapDesk>) -> Self {
        Self { map_file, ..self }
    }

    /// Tags of a known size and the floor are looked for, where the configuration names that size, and how high the camera is above it.
    pub fn looking_for(self, tag: &TagConfig, scale: &ScaleConfig) -> Self {
        Self { tag: tag.clone(), scale: *scale, ..self }
    }

    /// Scans of what stands around the robot are made as this says.
    pub fn with_obstacles(self, obstacles: &ObstaclesConfig) -> Self {
        Self { obstacles: *obstacles, ..self }
    }

    /// One frame, from features to map. `ready_ns`: CLOCK_MONOTONIC when its features were ready. The error is the
    /// calibration's: no frame of this source can ever be placed.
    pub fn step(&mut self, features: &FrameFeatures, ready_ns: i64, feedback: &mut Feedback) -> Result<(), String> {
        self.status.queue.record_ns(monotonic_ns() - ready_ns);
        self.listen();
        if !self.fits(features)? {
            return Ok(());
        }
        let Some(reconstruction) = self.reconstruction.as_mut() else { return Ok(()) };
        let begin = Instant::now();
        if let Some(wheels) = &self.wheels {
            wheels.take(features.timestamp_ns, |reading| {
                reconstruction.add_wheel(reading);
            });
        }
        let mut estimate = reconstruction.track(features);
        estimate.reset_counter = estimate.reset_counter.wrapping_add(self.placements);
        self.status.track.record(begin.elapsed());
        self.publish_pose(features, &estimate);
        self.account(features, &estimate);

        let begin = Instant::now();
        if let Some(reconstruction) = self.reconstruction.as_mut() {
            let asked = self.outlet.as_ref().is_some_and(Outlet::obstacles_wanted);
            reconstruction.want_seen_floor(asked && self.obstacles.seen_floor);
            reconstruction.map(features, feedback);
        }
        self.status.mapping.record(begin.elapsed());
        self.last_frame_ns = estimate.timestamp_ns;
        let sequence = estimate.sequence;
        self.log_changes(&estimate);
        self.note_lens(KEEP_AGAIN);
        self.drain_events();
        self.recorder.record(Record::Published(estimate));
        if let (Some(desk), Some(reconstruction)) = (self.map_file.as_mut(), self.reconstruction.as_mut()) {
            desk.turn(reconstruction, features.timestamp_ns);
            self.status.set_map_mode(desk.mode(reconstruction.map_id()));
            self.status.set_map_not_stored(desk.fails());
        }
        self.publish_map();
        self.publish_obstacles(sequence);
        if let Some(outlet) = self.outlet.as_mut() {
            outlet.prepare();
        }
        Ok(())
    }

    /// Whether the pictures have the size that the camera model is for. The first frame tells it; a camera that sends another one later begins a
    /// new map, or, where its calibration cannot be scaled to that, is waited for until it sends the right size again.
    fn fits(&mut self, features: &FrameFeatures) -> Result<bool, String> {
        let Some(picture) = features.pyramid.levels.first() else { return Ok(false) };
        let size = |pixels: usize| u32::try_from(pixels).unwrap_or(u32::MAX);
        let (width, height) = (size(picture.width), size(picture.height));
        if self.size == (width, height) {
            self.status.set_calibration_refused(false);
            return Ok(true);
        }
        match self.calibration.fit(width, height) {
            Ok(camera) => self.begin(camera)?,
            Err(reason) if self.size == (0, 0) => return Err(reason),
            Err(reason) => {
                if !self.status.calibration_refused() {
                    error!(reason, "calibration does not fit the size that the camera sends now");
                }
                self.status.set_calibration_refused(true);
                self.status.wrong_size.add(1);
                return Ok(false);
            }
        }
        self.size = (width, height);
        self.status.set_calibration_refused(false);
        Ok(true)
    }

    /// The first frame, or the first of another size, completes the camera model.
    fn begin(&mut self, camera: CameraModel) -> Result<(), String> {
        info!(
            width = camera.width,
            height = camera.height,
            fx_px = camera.fx,
            fy_px = camera.fy,
            cx_px = camera.cx,
            cy_px = camera.cy,
            lens_model = camera.lens.name(),
            origin = self.calibration.origin,
            "camera model"
        );
        let prior = self.calibration.prior;
        if prior != LensPrior::Calibrated {
            warn!("the camera is not calibrated: focal length and distortion are estimated from its motion");
        }
        self.kept_sigma = f64::INFINITY;
        if let Some(reconstruction) = self.reconstruction.as_mut() {
            if let Some(desk) = self.map_file.as_mut().filter(|desk| !is_localisation_only(desk)) {
                desk.let_go("the camera sends another size of picture");
            }
            reconstruction.change_camera(&camera, prior);
            self.drain_events();
        } else if let Some(worker) = self.worker.take() {
            let mut begun = Reconstruction::with_lens(&self.config, &camera, prior, worker, self.lockstep);
            if let Some(worker) = self.place_worker.take() {
                begun.recognise_in(worker);
            }
            if let Some((base, radius_sigma)) = self.base {
                begun.set_base(base, radius_sigma);
            }
            begun.look_for_tags(&self.tag);
            begun.look_for_floor(&self.scale, &self.base.map_or_else(Robot::unknown, |(base, _)| base));
            if let Some(desk) = self.map_file.as_mut() {
                desk.begin(&mut begun, &camera, prior)?;
            }
            self.reconstruction = Some(begun);
        }
        Ok(())
    }

    fn publish_pose(&mut self, features: &FrameFeatures, estimate: &PoseEstimate) {
        let Some(outlet) = self.outlet.as_mut() else { return };
        let begin = Instant::now();
        let sent = outlet.pose(estimate, self.status.dropped.get());
        self.status.publish.record(begin.elapsed());
        match sent {
            Ok(()) => self.status.poses_published.add(1),
            Err(error) => self.publish_failed(&error),
        }
        self.status.latency.record_ns(monotonic_ns() - estimate.arrival_ns);
        // The picture last: who is woken by it finds what was found in it.
        let (Some(outlet), Some(reconstruction)) = (self.outlet.as_mut(), &self.reconstruction) else { return };
        let told = [outlet.features(features, reconstruction.matches()), outlet.frame(features)];
        for error in told.iter().filter_map(|told| told.as_ref().err()) {
            self.publish_failed(error);
        }
    }

    fn publish_failed(&mut self, error: &PublishError) {
        self.status.publish_failures.add(1);
        if let Some(messages) = self.publish_faults.event(monotonic_ns()) {
            warn!(messages, %error, "message cannot be sent");
        }
    }

    fn account(&mut self, features: &FrameFeatures, estimate: &PoseEstimate) {
        let status = &self.status;
        status.processed.add(1);
        if estimate.state == TrackingState::Tracking {
            status.tracked.add(1);
        }
        status.set_frame(estimate, features.tracks.len());
        status.set_scale_is_assumed(self.reconstruction.as_ref().is_some_and(Reconstruction::scale_is_assumed));
    }

    /// The scale that tags tell, when it is told first, has become surer by a fifth or has moved by two sigmas.
    fn log_tag_scale(&mut self, e: &PoseEstimate) {
        let told = self.reconstruction.as_ref().and_then(Reconstruction::scale_by_tags);
        let news = match (told, self.last_tag_scale) {
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
            self.last_tag_scale = told;
        }
    }

    fn log_loops(&mut self, e: &PoseEstimate) {
        let Some(reconstruction) = &self.reconstruction else { return };
        let loops_closed = reconstruction.counters().loops_closed;
        if loops_closed != self.last_loops_closed {
            let (sequence, timestamp_ns, map) = (e.sequence, e.timestamp_ns, e.map.0);
            let (distance, angle_rad) = (reconstruction.corrections().distance, reconstruction.corrections().angle_rad);
            info!(sequence, timestamp_ns, map, loops_closed, distance, angle_rad, "loop closed");
            self.last_loops_closed = loops_closed;
        }
    }

    fn log_changes(&mut self, e: &PoseEstimate) {
        self.log_tag_scale(e);
        let (sequence, timestamp_ns, map) = (e.sequence, e.timestamp_ns, e.map.0);
        if e.reset_counter != self.last_resets {
            info!(sequence, timestamp_ns, map, reset_counter = e.reset_counter, "reset");
            self.last_resets = e.reset_counter;
        }
        let maps_joined = self.reconstruction.as_ref().map_or(0, |r| r.counters().maps_joined);
        if maps_joined != self.last_maps_joined {
            info!(sequence, timestamp_ns, map, maps_joined, "map joined");
            self.last_maps_joined = maps_joined;
        }
        self.log_scale(e);
        self.log_loops(e);
        if let Some(reconstruction) = &self.reconstruction {
            self.blind.follow(reconstruction, e, state_name(e.state));
            if self.scale.is_on() {
                self.floor.follow(&self.scale, reconstruction, e);
            }
        }
        let blind_turns = self.reconstruction.as_ref().map_or(0, |r| r.counters().blind_turns);
        if blind_turns != self.last_blind_turns {
            warn!(sequence, timestamp_ns, map, blind_turns, "scale assumed after a turn on the spot");
            self.last_blind_turns = blind_turns;
        }
        if self.last_state != Some(e.state) {
            let from = self.last_state.map_or("none", state_name);
            let (state, landmarks) = (state_name(e.state), e.landmarks);
            // In dim light an orientation may come and go with each frame, which would fill a journal.
            let before_a_map = |s: TrackingState| matches!(s, TrackingState::Initializing | TrackingState::Orientation);
            if before_a_map(e.state) && self.last_state.is_some_and(before_a_map) {
                debug!(sequence, timestamp_ns, map, from, state, landmarks, "state");
            } else {
                info!(sequence, timestamp_ns, map, from, state, landmarks, "state");
            }
            self.last_state = Some(e.state);
        }
        let Some(reconstruction) = &self.reconstruction else { return };
        let counters = reconstruction.counters();
        self.status.set_counters(&counters);
        self.status.set_corrections(&reconstruction.corrections(), reconstruction.maps());
        if e.keyframe {
            let (keyframes, landmarks_made) = (counters.keyframes_made, counters.landmarks_made);
            // Where much is new there is one a second, which would fill a journal in a night.
            debug!(sequence, timestamp_ns, map, keyframes, landmarks_made, landmarks = e.landmarks, "keyframe");
        } else {
            debug!(sequence, landmarks = e.landmarks, sought = e.landmarks_sought, quality = e.quality, "frame");
        }
    }

    /// The map has become metric, or another one has begun that is not; the wheels slip.
    fn log_scale(&mut self, e: &PoseEstimate) {
        let Some(reconstruction) = &self.reconstruction else { return };
        let (sequence, timestamp_ns, scale) = (e.sequence, e.timestamp_ns, reconstruction.scale());
        let slipping = reconstruction.wheels_slip();
        let (robot, slips) = reconstruction.base().unzip();
        if let (MapScale::Metric { sigma, sources }, false) = (scale, self.last_scale.is_metric()) {
            let sources = format!("{sources}");
            info!(sequence, timestamp_ns, sigma, sources, "map is metric");
            if let Some(robot) = robot {
                base::tell(&robot);
                if let Some(outlet) = self.outlet.as_mut() {
                    outlet.found_mount(&robot);
                }
            }
        }
        if slipping && !self.last_slipping {
            warn!(sequence, timestamp_ns, slips, "wheels slip");
        }
        (self.last_scale, self.last_slipping) = (scale, slipping);
    }

    /// What is believed of the lens, for health and log; and for the next start, if it is found and less than `share` as uncertain as
    /// when it was last kept.
    fn note_lens(&mut self, share: f64) {
        let Some(reconstruction) = &self.reconstruction else { return };
        let lens = reconstruction.lens();
        self.status.set_lens(&lens);
        if self.lens != Some(lens.knowledge) {
            let (from, to) = (self.lens.map_or("none", LensKnowledge::name), lens.knowledge.name());
            info!(
                from,
                to,
                model = lens.camera.lens.name(),
                fx_px = lens.camera.fx,
                focal_sigma = lens.focal_sigma,
                "lens"
            );
            self.lens = Some(lens.knowledge);
        }
        if lens.knowledge == LensKnowledge::Estimated && lens.focal_sigma < share * self.kept_sigma {
            self.kept_sigma = lens.focal_sigma;
            self.recorder.record(Record::Lens(Box::new(lens)));
        }
    }

    pub(super) fn drain_events(&mut self) {
        if let Some(reconstruction) = self.reconstruction.as_mut() {
            reconstruction.take_trajectory_events(&mut self.events);
        }
        for event in self.events.drain(..) {
            if let Some(desk) = self.map_file.as_mut() {
                desk.note(&event);
            }
            self.recorder.record(Record::Event(event));
        }
    }

    /// The map, as often as the wire wants it.
    fn publish_map(&mut self) {
        let (Some(outlet), Some(reconstruction)) = (self.outlet.as_mut(), &self.reconstruction) else { return };
        if !outlet.map_is_due(monotonic_ns()) {
            return;
        }
        reconstruction.snapshot_newest(&mut self.snapshot, outlet.most_of_map());
        self.status.set_map(&self.snapshot);
        let context = context(reconstruction, self.placements, self.last_frame_ns, self.status.map_mode());
        match outlet.map(reconstruction, &self.snapshot, &context) {
            Ok(()) => self.status.maps_published.add(1),
            Err(error) => self.publish_failed(&error),
        }
    }

    /// What stands around the robot, as often as somebody wants it.
    fn publish_obstacles(&mut self, sequence: u64) {
        let (Some(outlet), Some(reconstruction)) = (self.outlet.as_mut(), self.reconstruction.as_mut()) else { return };
        if !outlet.obstacles_due() {
            return;
        }
        let map = context(reconstruction, self.placements, self.last_frame_ns, 0);
        if let Err(error) = obstacles::tell(outlet, reconstruction, &self.obstacles, &self.scale, sequence, map) {
            self.publish_failed(&error);
        }
    }

    /// Between two frames, or while none comes.
    pub fn request(&mut self, request: Request) {
        match request {
            Request::Reset { why } => {
                info!(why, "reset asked for");
                if let Some(desk) = self.map_file.as_mut().filter(|desk| !is_localisation_only(desk)) {
                    desk.let_go(why);
                }
                if let Some(reconstruction) = self.reconstruction.as_mut() {
                    reconstruction.reset();
                }
                self.drain_events();
            }
            Request::Save { kind, path, reply } => {
                let map = Box::new(self.final_map());
                self.recorder.save(kind, path, map, reply);
            }
            Request::Map { request, reply } => self.map_request(request, reply),
            Request::TakeMap { loaded, reply } => self.take_map(*loaded, &reply),
            Request::BeginMap { path, reply } => self.begin_map(path, &reply),
            Request::SetPose { map_from_body, reply } => {
                let moved = match self.outlet.as_mut() {
                    Some(outlet) => outlet.set_pose(&map_from_body).map_err(String::from),
                    None => Err("nothing is published".into()),
                };
                if moved.is_ok() {
                    self.placements = self.placements.wrapping_add(1);
                    info!("map put where a planner wants it");
                }
                let done = "poses, map and keyframes are published there from now on; files keep the map's own origin";
                // Whoever asked may have gone.
                let _ = reply.try_send(moved.map(|()| done.into()));
            }
        }
    }

    fn final_map(&self) -> FinalMap {
        let mut map = FinalMap::default();
        if let Some(reconstruction) = &self.reconstruction {
            map.keyframe_poses = reconstruction.keyframe_poses();
            reconstruction.snapshot(&mut map.snapshot);
        }
        map
    }

    /// Ends: merges the adjustment under way, hands out the last records, and gives back what files are written from.
    /// And who keeps the map on disk, if that is to be closed here.
    pub fn finish(mut self) -> (FinalMap, RecorderLink, Option<Keeper>) {
        if let Some(reconstruction) = self.reconstruction.as_mut() {
            reconstruction.finish();
        }
        self.kept_sigma = f64::INFINITY;
        self.note_lens(1.0);
        self.drain_events();
        let mut map = self.final_map();
        if let (Some(outlet), Some(reconstruction)) = (&self.outlet, self.reconstruction.as_mut()) {
            map.snapshot.around = obstacles::around(outlet, reconstruction, &self.obstacles, &self.scale);
        }
        if let Some(reconstruction) = &self.reconstruction {
            self.status.set_counters(&reconstruction.counters());
        }
        self.status.set_map(&map.snapshot);
        let keeper = self.map_file.and_then(|desk| desk.finish(self.reconstruction.as_mut()));
        (map, self.recorder, keeper)
    }
}

/// What a map message says of the map as it is now. It may have been dropped after the last frame was placed, so the counter is the map's and not
/// that of the frame's pose.
fn context(reconstruction: &Reconstruction, placements: u32, timestamp_ns: i64, map_mode: u8) -> MapContext {
    MapContext {
        timestamp_ns,
        reset_counter: reconstruction.reset_counter().wrapping_add(placements),
        map_revision: reconstruction.corrections().revision,
        map_mode,
    }
}

/// Its maps outlive a reset: nothing is written to them that would have to be kept from the file.
fn is_localisation_only(desk: &MapDesk) -> bool {
    desk.mode(crate::map::MapId::default()) & crate::messages::map_mode::LOCALISATION_ONLY != 0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reconstruction::InlineWorker;

    #[test]
    fn a_map_message_counts_the_reset_that_made_its_map() {
        let camera = guessed_camera(320, 240, 60.0).expect("camera");
        let mut r =
            Reconstruction::new(&ReconstructionConfig::default(), &camera, Box::new(InlineWorker::default()), true);
        let mut snapshot = MapSnapshot::default();
        for resets in 0..3 {
            r.snapshot(&mut snapshot);
            let context = context(&r, 4, 7, 0);
            assert_eq!((snapshot.map.0, context.reset_counter, context.timestamp_ns), (resets, 4 + resets, 7));
            r.reset();
        }
    }
}
