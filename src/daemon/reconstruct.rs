//! The reconstruction step: one frame's features into a published pose, then into the map.
//!
//! The order is the daemon's promise: track, publish the pose, and only then keyframe work, logs, records and the map's
//! message. Nothing before the publication allocates, writes or waits.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use tracing::{error, info, warn};

use super::base;
use super::calibration::Calibration;
use super::changes::ChangeLog;
use super::dock::Dock;
use super::map_file::MapDesk;
use super::map_keeper::Keeper;
use super::obstacles;
use super::outlet::Outlet;
use super::recorder::{FinalMap, Record, RecorderLink};
use super::request::Request;
use super::status::Status;
use super::wheels::WheelListener;
use crate::config::MountConfig;
use crate::features::{Feedback, FrameFeatures};
use crate::frame::monotonic_ns;
use crate::geometry::CameraModel;
use crate::map::MapSnapshot;
use crate::messages::map_mode;
use crate::motion::floor::ScaleConfig;
use crate::motion::hand_eye::Robot;
use crate::motion::obstacles::ObstaclesConfig;
use crate::motion::tag::TagConfig;
use crate::motion::wheel::WheelQueue;
use crate::publish::{MapContext, PublishError};
use crate::reconstruction::{
    LensKnowledge, LensPrior, MappingJob, PoseEstimate, Recognition, Reconstruction, ReconstructionConfig,
    TrackingState, TrajectoryEvent, Worker,
};
use crate::telemetry::RateLimiter;

/// A lens is kept again when its focal length is known this much better than what was kept, as a share of the standard deviation.
const KEEP_AGAIN: f64 = 0.8;

/// The reconstruction stage without its thread.
pub struct ReconstructStep {
    config: ReconstructionConfig,
    pub(super) calibration: Calibration,
    /// One that was kept since, for the next map.
    pub(super) next_calibration: Option<Calibration>,
    tag: TagConfig,
    dock: Option<Dock>,
    scale: ScaleConfig,
    obstacles: ObstaclesConfig,
    lockstep: bool,
    /// Given to reconstruction with the first frame, whose size completes the camera model.
    worker: Option<Box<dyn Worker<MappingJob>>>,
    /// As well; without one places are recognised between frames.
    place_worker: Option<Box<dyn Worker<Recognition>>>,
    pub(super) reconstruction: Option<Reconstruction>,
    /// Of the pictures that the camera model is for; 0, 0 before the first.
    pub(super) size: (u32, u32),
    pub(super) outlet: Option<Outlet>,
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
    base: Option<(Robot, f64)>,
    /// Where pictures of far keyframes may wait.
    spool_folder: Option<PathBuf>,
    changes: ChangeLog,
    /// Times that a planner has put the map elsewhere: to its readers each is a reset.
    pub(super) placements: u32,
    /// Time of the newest frame, if there was one.
    last_frame_ns: Option<i64>,
    /// What is said of the lens, and how surely it was known when it was last handed over to be kept.
    lens: Option<LensKnowledge>,
    kept_sigma: f64,
}

impl ReconstructStep {
    pub fn new(
        config: &ReconstructionConfig,
        calibration: Calibration,
        worker: Box<dyn Worker<MappingJob>>,
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
            next_calibration: None,
            tag: TagConfig::default(),
            dock: None,
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
            base: None,
            spool_folder: None,
            changes: ChangeLog::default(),
            placements: 0,
            last_frame_ns: None,
            lens: None,
            kept_sigma: f64::INFINITY,
        }
    }

    /// With a folder on a disk where pictures of far keyframes may wait.
    pub fn spooling_in(mut self, folder: PathBuf) -> Self {
        self.spool_folder = Some(folder);
        self
    }

    /// With somebody who knows places again meanwhile.
    pub fn recognising_in(mut self, worker: Box<dyn Worker<Recognition>>) -> Self {
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
        Self { tag: tag.clone(), dock: Dock::new(tag), scale: *scale, ..self }
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
        // Times ascend, unless all that rests on earlier ones is void (`timestamps`). It ends here, between the last frame of the old time and the first
        // of the new one, however many frames were on their way.
        if self.last_frame_ns.replace(features.timestamp_ns).is_some_and(|last| features.timestamp_ns < last) {
            self.request(Request::Reset { why: "time went back" });
        }
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
        let sequence = estimate.sequence;
        self.note_changes(&estimate);
        self.note_lens(KEEP_AGAIN);
        self.drain_events();
        self.follow_dock(&estimate);
        self.recorder.record(Record::Published(estimate));
        let mut mode = if self.is_docked() { map_mode::DOCK_FRAME } else { 0 };
        if let (Some(desk), Some(reconstruction)) = (self.map_file.as_mut(), self.reconstruction.as_mut()) {
            desk.turn(reconstruction, features.timestamp_ns);
            mode |= desk.mode(reconstruction.map_id());
            self.status.set_map_not_stored(desk.fails());
        }
        self.status.set_map_mode(mode);
        self.publish_map();
        self.publish_obstacles(sequence);
        if let Some(outlet) = self.outlet.as_mut() {
            outlet.prepare();
        }
        Ok(())
    }

    /// Whether the pictures have the size that the camera model is for. The first frame tells it; a camera that sends another one later begins a
    /// new map, or, where its calibration cannot be scaled to that or frames are only located in a map, is waited for until it sends the right size
    /// again.
    fn fits(&mut self, features: &FrameFeatures) -> Result<bool, String> {
        let Some(picture) = features.pyramid.levels.first() else { return Ok(false) };
        let size = |pixels: usize| u32::try_from(pixels).unwrap_or(u32::MAX);
        let (width, height) = (size(picture.width), size(picture.height));
        if self.size == (width, height) {
            self.status.set_calibration_refused(false);
            return Ok(true);
        }
        let stays = self.reconstruction.is_some() && self.map_file.as_ref().is_some_and(|desk| desk.localise_only);
        let fitted = if stays { Err(None) } else { self.calibration.fit(width, height).map_err(Some) };
        match fitted {
            Ok(camera) => self.begin(camera)?,
            Err(Some(reason)) if self.size == (0, 0) => return Err(reason),
            Err(reason) => {
                let (map_width, map_height) = self.size;
                match reason {
                    _ if self.status.calibration_refused() => {}
                    Some(reason) => error!(reason, "calibration does not fit the size that the camera sends now"),
                    None => error!(width, height, map_width, map_height, "pictures are not of the located map's size"),
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

    /// Says which camera model frames are placed with from now on.
    pub(super) fn tell_camera(&mut self, camera: &CameraModel) {
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
        if self.calibration.prior != LensPrior::Calibrated {
            warn!("the camera is not calibrated: focal length and distortion are estimated from its motion");
        }
        self.kept_sigma = f64::INFINITY;
    }

    /// The first frame, or the first of another size, completes the camera model.
    fn begin(&mut self, camera: CameraModel) -> Result<(), String> {
        self.tell_camera(&camera);
        if let Some(reconstruction) = self.reconstruction.as_mut() {
            if let Some(desk) = self.map_file.as_mut() {
                desk.let_go("the camera sends another size of picture");
            }
            reconstruction.change_camera(&camera, self.calibration.prior);
            self.drain_events();
        } else if let Some(worker) = self.worker.take() {
            let prior = self.calibration.prior;
            let mut begun = Reconstruction::with_lens(&self.config, &camera, prior, worker, self.lockstep);
            if let Some(worker) = self.place_worker.take() {
                begun.recognise_in(worker);
            }
            if let Some(folder) = &self.spool_folder {
                begun.spool_pictures(folder);
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

    /// Where the dock hangs decides where the published map is.
    fn follow_dock(&mut self, e: &PoseEstimate) {
        let (Some(dock), Some(outlet)) = (self.dock.as_mut(), self.outlet.as_mut()) else { return };
        let Some(reconstruction) = self.reconstruction.as_mut() else { return };
        let localise_only = self.map_file.as_ref().is_some_and(|desk| desk.localise_only);
        dock.follow(reconstruction, localise_only, outlet, e);
    }

    /// The map is published in the dock's frame.
    pub(super) fn is_docked(&self) -> bool {
        let map = self.reconstruction.as_ref().map(Reconstruction::map_id);
        self.dock.as_ref().zip(map).is_some_and(|(dock, map)| dock.holds(map))
    }

    /// What is different since the last frame, for log and health.
    fn note_changes(&mut self, e: &PoseEstimate) {
        let Some(reconstruction) = &self.reconstruction else { return };
        let became_metric = self.changes.follow(reconstruction, &self.scale, e);
        if became_metric && let Some((robot, _)) = reconstruction.base() {
            base::tell(&robot);
            if let Some(outlet) = self.outlet.as_mut() {
                self.status.set_found_mount(&outlet.found_mount(&robot));
            }
        }
        self.status.set_counters(&reconstruction.counters());
        self.status.set_corrections(&reconstruction.corrections(), reconstruction.maps());
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
        let is_placed = self.reconstruction.as_ref().is_some_and(Reconstruction::is_placed);
        for event in self.events.drain(..) {
            if let TrajectoryEvent::MapJoined { map, into, .. } = &event
                && is_placed
                && let Some(outlet) = self.outlet.as_mut()
            {
                outlet.follow_join(*map, *into);
            }
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
        let context = context(reconstruction, self.placements, self.last_frame_ns.unwrap_or(0), self.status.map_mode());
        match outlet.map(reconstruction, &self.snapshot, &context, &self.tag) {
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
        let map = context(reconstruction, self.placements, self.last_frame_ns.unwrap_or(0), 0);
        if let Err(error) = obstacles::tell(outlet, reconstruction, &self.obstacles, &self.scale, sequence, map) {
            self.publish_failed(&error);
        }
    }

    /// Between two frames, or while none comes.
    pub fn request(&mut self, request: Request) {
        match request {
            Request::Reset { why } => {
                info!(why, "reset asked for");
                if let Some(desk) = self.map_file.as_mut().filter(|desk| !desk.localise_only) {
                    desk.let_go(why);
                }
                self.drop_map();
            }
            Request::Calibrated(calibration) => self.next_calibration = Some(*calibration),
            Request::Save { kind, path, reply } => {
                let map = Box::new(self.final_map());
                self.recorder.save(kind, path, map, reply);
            }
            Request::Map { request, reply } => self.map_request(request, reply),
            Request::TakeMap { loaded, reply } => self.take_map(*loaded, &reply),
            Request::TakeMerged { loaded, reply } => self.take_merged(*loaded, &reply),
            Request::BeginMap { path, reply } => self.begin_map(path, &reply),
            Request::SetPose { map_from_body, reply } => self.set_pose(&map_from_body, &reply),
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reconstruction::{InlineWorker, guessed_camera};

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
