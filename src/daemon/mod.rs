//! The daemon: the only room that spawns, wires, stops and joins threads.
//!
//! ```text
//! capture ──ring──► features ──parcels──► reconstruction ──records──► recorder
//!                      ▲                     │    ▲ ▼
//!                      └──empty parcels──────┘   mapping          supervisor = the calling thread: health, watchdog,
//!                         with feedback                           log, commands, signals, joining
//! ```
//!
//! - Frames are dropped in one place, the ring: the feature thread takes a frame only when it holds an empty parcel, and there
//!   are as many parcels as may wait plus the one that reconstruction works on. No queue between stages can overflow.
//! - A parcel is a frame's features on the way there and reconstruction's feedback on the way back; parcels are made once.
//! - Every stage is a plain step in a file of its own; [`lockstep`] calls the very same steps from one loop.
//! - Every wait is bounded by [`TURN`], so a stop is seen by every thread within that, and each thread says once a turn that it lives.
//! - What a driver may hang over, opening and closing a camera, has a thread of its own that nobody waits for (`background.rs`).
//! - A thread that panics ends the daemon with an error, so that a service manager starts it anew.

mod advice;
mod announce;
mod background;
mod base;
mod blind;
mod calibration;
mod camera_commands;
mod capture;
mod changes;
mod dock;
mod feature;
mod floor;
mod health;
pub mod lockstep;
mod map_commands;
mod map_file;
mod map_folder;
mod map_keeper;
mod map_requests;
mod obstacles;
mod outlet;
mod reconstruct;
mod recorder;
mod request;
mod status;
mod supervisor;
mod timestamps;
mod waiting;
mod wheels;
mod worker;

use std::path::PathBuf;
use std::sync::Arc;
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, bounded};

pub use advice::advice;
pub use background::{TURN, within};
pub use calibration::Calibration;
pub use capture::{Captured, Opener, Supply};
pub use map_file::MapPlan;
pub use map_folder::MapFolder;
pub use outlet::Outlet;
pub use recorder::{FinalMap, KeepLens, Outputs, SaveKind, Written};
pub use request::Request;
pub use status::{Status, state_name};
pub use supervisor::{Desk, End, EndCause, Tick, supervise};
pub use waiting::await_camera;

use crate::config::Config;
use crate::features::{Feedback, FrameFeatures};
use crate::frame::{RawFrame, monotonic_ns};
use crate::motion::wheel::WheelQueue;
use crate::ring::{Consumer, Producer, Wait, frame_ring};
use camera_commands::{CAMERA_QUEUE, CameraOrder};
use capture::CaptureStep;
use feature::FeatureStep;
use map_file::{KeeperLink, MapDesk};
use reconstruct::ReconstructStep;
use recorder::{Order, Recorder, RecorderLink, serve};
use wheels::WheelIntake;
use worker::ThreadWorker;

/// Records on their way to the recorder: some 30 seconds of frames while a disk hangs.
const RECORD_QUEUE: usize = 2048;
/// Changes of the map and orders of commands on their way to the disk: while some wait no further changes are taken.
const MAP_QUEUE: usize = 4;
/// Requests from the supervisor on their way to reconstruction.
const REQUEST_QUEUE: usize = 4;

/// Everything that one run is made of.
pub struct Parts {
    pub config: Config,
    pub supply: Supply,
    pub calibration: Calibration,
    pub outlet: Option<Outlet>,
    pub outputs: Outputs,
    /// Folder for the spool of a trajectory that only a later command may ask for; `None`: no such commands.
    pub spool_folder: Option<PathBuf>,
    /// Keeps what is learnt about an uncalibrated lens; `None`: nobody does.
    pub keep_lens: Option<KeepLens>,
    /// The map on disk; `None`: there is none, and the map ends with the run.
    pub map_file: Option<MapPlan>,
    /// Where commands load and store maps by name; `None`: there are no such commands.
    pub maps: Option<MapFolder>,
    pub status: Arc<Status>,
}

/// Why there is no daemon.
#[derive(Debug, thiserror::Error)]
pub enum DaemonError {
    #[error(transparent)]
    Spool(#[from] crate::trajectory::TrajectoryError),
    #[error("cannot start a thread: {0}")]
    Thread(std::io::Error),
    #[error("the search for a camera panicked")]
    Search,
}

/// A frame's features on the way to reconstruction; its feedback on the way back.
#[derive(Debug, Default)]
struct Parcel {
    features: FrameFeatures,
    ready_ns: i64,
    feedback: Feedback,
    /// It has been to reconstruction, so the feedback is one.
    returned: bool,
}

/// Where the map lies in the end, or why what came last is not there.
type MapThread = JoinHandle<Result<Option<PathBuf>, String>>;

/// What the threads of a run give back when they end.
pub(super) struct Threads {
    pub capture: JoinHandle<bool>,
    pub features: JoinHandle<()>,
    pub reconstruction: JoinHandle<Result<FinalMap, String>>,
    pub mapping: JoinHandle<()>,
    pub places: JoinHandle<()>,
    pub recorder: JoinHandle<Recorder>,
    /// Where the map lies, or why what came last is not there.
    pub map_file: Option<MapThread>,
    pub requests: Sender<Request>,
    pub camera: Sender<CameraOrder>,
    pub maps: Option<MapFolder>,
}

/// Starts all threads. They end when the source ends, or when [`Status::request_stop`] is called.
pub(super) fn start(parts: Parts) -> Result<Threads, DaemonError> {
    let Parts { config, supply, calibration, mut outlet, outputs, spool_folder, keep_lens, map_file, maps, status } =
        parts;
    let encoded = outlet.as_mut().and_then(Outlet::take_encoded);
    let spool = outputs.spool_folder(spool_folder.as_deref());
    let recorder = Recorder::new(&outputs, spool_folder.as_deref(), status.clone())?.keeping(keep_lens);
    let (orders, order_queue) = bounded::<Order>(RECORD_QUEUE);
    let recorder = spawn("cairn-recorder", move || serve(recorder, &order_queue))?;

    let (worker, mapping) = ThreadWorker::spawn("cairn-mapping", status.clone()).map_err(DaemonError::Thread)?;
    let (place_worker, places) = ThreadWorker::spawn("cairn-places", status.clone()).map_err(DaemonError::Thread)?;
    let link = RecorderLink::Queue(orders, status.clone());
    let wheels = Arc::new(WheelQueue::new(status.wheels.clone()));
    let (requests, request_queue) = bounded(REQUEST_QUEUE);
    let (desk, map_file) = keep_maps(map_file, maps.is_some(), &requests)?;
    let step = ReconstructStep::new(
        &config.reconstruction,
        calibration,
        Box::new(worker),
        false,
        outlet,
        link,
        status.clone(),
    )
    .recognising_in(Box::new(place_worker))
    .with_wheels(wheels.clone())
    .with_base(&config.mount, config.wheel.scale_sigma)
    .with_map_file(desk)
    .spooling_in(spool)
    .looking_for(&config.tag, &config.scale)
    .with_obstacles(&config.obstacles);

    // As many parcels as may wait, and the one that reconstruction works on.
    let parcels = config.daemon.queue_frames + 1;
    let (full, full_queue) = bounded::<Box<Parcel>>(parcels);
    let (empty, empty_queue) = bounded::<Box<Parcel>>(parcels);
    for _ in 0..parcels {
        // Cannot fail: the queue has room for all of them.
        let _ = empty.try_send(Box::default());
    }
    let (producer, consumer) = frame_ring(RawFrame::default);

    let beat = status.clone();
    let reconstruction =
        spawn("cairn-reconstruct", move || reconstruct(step, &full_queue, &empty, &request_queue, &beat))?;
    let feature_step = FeatureStep::new(&config.features, status.clone());
    let beat = status.clone();
    let features = spawn("cairn-features", move || extract(feature_step, consumer, &empty_queue, &full, &beat))?;
    let capture_step = CaptureStep::new(supply, status.clone()).map_err(DaemonError::Thread)?;
    let capture_step = capture_step.sharing(encoded).with_wheels(WheelIntake::new(wheels));
    let (camera, orders) = bounded(CAMERA_QUEUE);
    let capture = spawn("cairn-capture", move || capture_frames(capture_step, producer, &orders, &status))?;
    Ok(Threads { capture, features, reconstruction, mapping, places, recorder, map_file, requests, camera, maps })
}

/// Reconstruction's end of the map file, and the thread at the other: where there is a file, or commands may ask for one.
fn keep_maps(
    plan: Option<MapPlan>,
    by_command: bool,
    requests: &Sender<Request>,
) -> Result<(Option<MapDesk>, Option<MapThread>), DaemonError> {
    let (desk, keeper) = plan.map(MapPlan::split).unzip();
    let keeper = keeper.flatten();
    if keeper.is_none() && !by_command {
        return Ok((desk, None));
    }
    let (orders, queue) = bounded(MAP_QUEUE);
    let thread = spawn("cairn-map-file", move || map_keeper::serve(keeper, &queue))?;
    let desk = desk.unwrap_or_else(MapDesk::without_file).linked(Some(KeeperLink::Queue(orders)));
    let desk = if by_command { desk.answered_by(requests.clone()) } else { desk };
    Ok((Some(desk), Some(thread)))
}

/// A named thread whose panic is logged with the fields of any other record.
pub fn spawn<T: Send + 'static>(
    name: &'static str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<JoinHandle<T>, DaemonError> {
    thread::Builder::new().name(name.into()).spawn(work).map_err(DaemonError::Thread)
}

/// The capture thread: frames from the source into the ring; orders for the camera between frames. `true` if the source broke.
fn capture_frames(
    mut step: CaptureStep,
    mut ring: Producer<RawFrame>,
    orders: &Receiver<CameraOrder>,
    status: &Status,
) -> bool {
    let mut failed = false;
    while !status.stopping() && !ring.is_abandoned() {
        status.capture.beat(monotonic_ns());
        // One at a time: a camera that hangs keeps each waiting for 5 s, and the watchdog must see that the stage lives in between.
        if let Ok(order) = orders.try_recv() {
            step.obey(order);
        }
        match ring.write(|slot| step.step(slot, TURN)) {
            Captured::Frame => {
                ring.publish();
                status.dropped.set(ring.dropped());
            }
            Captured::Nothing => {}
            Captured::Absent(pause) => rest(pause, status),
            Captured::End { failed: broke } => {
                failed = broke;
                break;
            }
        }
    }
    status.capture.rest();
    failed
}

/// Sleeps for `pause` in turns, so that a stop is seen and the stage is known to live.
fn rest(pause: Duration, status: &Status) {
    let end = Instant::now() + pause;
    while !status.stopping() {
        let left = end.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return;
        }
        thread::sleep(left.min(TURN));
        status.capture.beat(monotonic_ns());
    }
}

/// The feature thread: newest frame of the ring into an empty parcel, full parcel on to reconstruction.
fn extract(
    mut step: FeatureStep,
    mut ring: Consumer<RawFrame>,
    empty: &Receiver<Box<Parcel>>,
    full: &Sender<Box<Parcel>>,
    status: &Status,
) {
    let mut held: Option<Box<Parcel>> = None;
    while !status.stopping() {
        status.features.beat(monotonic_ns());
        let mut parcel = match held.take().map_or_else(|| empty.recv_timeout(TURN), Ok) {
            Ok(parcel) => parcel,
            Err(RecvTimeoutError::Timeout) => continue,
            Err(RecvTimeoutError::Disconnected) => break,
        };
        if std::mem::take(&mut parcel.returned) {
            step.feedback(&parcel.feedback);
        }
        match ring.wait(TURN) {
            Wait::Ready if ring.read(|frame| step.step(frame, &mut parcel.features)) => {
                parcel.ready_ns = monotonic_ns();
                // Never blocks: the queue holds all parcels there are. It fails only when reconstruction is gone.
                if full.send(parcel).is_err() {
                    break;
                }
            }
            Wait::Ready | Wait::TimedOut => held = Some(parcel),
            Wait::Closed => break,
        }
    }
    status.features.rest();
}

/// The reconstruction thread: full parcels into poses and map, empty ones back; requests between frames.
fn reconstruct(
    mut step: ReconstructStep,
    full: &Receiver<Box<Parcel>>,
    empty: &Sender<Box<Parcel>>,
    requests: &Receiver<Request>,
    status: &Status,
) -> Result<FinalMap, String> {
    let mut outcome = Ok(());
    while !status.stopping() && outcome.is_ok() {
        status.reconstruction.beat(monotonic_ns());
        for request in requests.try_iter().take(REQUEST_QUEUE) {
            step.request(request);
        }
        match full.recv_timeout(TURN) {
            Ok(mut parcel) => {
                let Parcel { features, ready_ns, feedback, returned } = &mut *parcel;
                outcome = step.step(features, *ready_ns, feedback);
                *returned = true;
                // It fails only when the feature thread is gone, which the next turn will see.
                let _ = empty.send(parcel);
            }
            Err(RecvTimeoutError::Timeout) => step.listen(),
            Err(RecvTimeoutError::Disconnected) => break,
        }
    }
    let (map, link, _) = step.finish();
    drop(link);
    status.reconstruction.rest();
    outcome.map(|()| map)
}

#[cfg(all(test, feature = "tools"))]
mod tests;
