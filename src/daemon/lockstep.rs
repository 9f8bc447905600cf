//! Lock-step: the stages' own steps, one after the other, in the calling thread.
//!
//! Every frame of the source is processed; no step waits for a clock, and mapping results are merged a fixed number of frames
//! after they were posted. The same input, configuration and binary give the same trajectory, byte for byte.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use tracing::info;

use super::capture::{CaptureStep, Captured};
use super::feature::FeatureStep;
use super::map_file::KeeperLink;
use super::reconstruct::ReconstructStep;
use super::recorder::{Recorder, RecorderLink, Written};
use super::status::Status;
use super::supervisor::{End, EndCause};
use super::wheels::WheelIntake;
use super::{DaemonError, Parts, TURN};
use crate::features::{Feedback, FrameFeatures};
use crate::frame::{RawFrame, monotonic_ns};
use crate::motion::wheel::WheelQueue;
use crate::reconstruction::InlineWorker;

/// Replays until the source ends, `stop` is set, or `go_on` (called once a frame) says no.
pub fn run(parts: Parts, stop: &AtomicBool, go_on: &mut dyn FnMut(&Status) -> bool) -> Result<End, DaemonError> {
    let Parts { config, supply, calibration, outlet, outputs, spool_folder, keep_lens, map_file, maps: _, status } =
        parts;
    let spool = outputs.spool_folder(spool_folder.as_deref());
    let recorder = Recorder::new(&outputs, spool_folder.as_deref(), status.clone())?.keeping(keep_lens);
    let wheels = Arc::new(WheelQueue::new(status.wheels.clone()));
    let capture = CaptureStep::new(supply, status.clone()).map_err(DaemonError::Thread)?;
    let mut capture = capture.with_wheels(WheelIntake::new(wheels.clone()));
    let mut feature = FeatureStep::new(&config.features, status.clone());
    let desk = map_file.map(|plan| {
        let (desk, keeper) = plan.split();
        desk.linked(keeper.map(|keeper| KeeperLink::Inline(Box::new(keeper))))
    });
    let mut reconstruct = ReconstructStep::new(
        &config.reconstruction,
        calibration,
        Box::new(InlineWorker::default()),
        true,
        outlet,
        RecorderLink::Inline(recorder),
        status.clone(),
    )
    .with_wheels(wheels)
    .with_base(&config.mount, config.wheel.scale_sigma)
    .with_map_file(desk)
    .spooling_in(spool)
    .looking_for(&config.tag, &config.scale)
    .with_obstacles(&config.obstacles);
    let mut slot = RawFrame::default();
    let mut features = FrameFeatures::default();
    let mut feedback = Feedback::default();
    let cause = loop {
        if stop.load(Ordering::Relaxed) || !go_on(&status) {
            break EndCause::Stopped;
        }
        match capture.step(&mut slot, TURN) {
            Captured::Frame => {}
            Captured::Nothing => continue,
            Captured::End { failed: false } => break EndCause::SourceEnded,
            Captured::End { failed: true } | Captured::Absent(_) => break EndCause::SourceFailed,
        }
        if !feature.step(&slot, &mut features) {
            continue;
        }
        if let Err(reason) = reconstruct.step(&features, monotonic_ns(), &mut feedback) {
            break EndCause::Calibration(reason);
        }
        feature.feedback(&feedback);
    };
    Ok(wind_up(reconstruct, &outputs, cause, &status))
}

fn wind_up(step: ReconstructStep, outputs: &super::Outputs, cause: EndCause, status: &Arc<Status>) -> End {
    let (map, link, keeper) = step.finish();
    let mut written = Written::default();
    if let (RecorderLink::Inline(mut recorder), false) = (link, matches!(cause, EndCause::Calibration(_))) {
        written = recorder.write(outputs, &map);
    }
    if let Some(keeper) = keeper {
        written.note_map(keeper.close());
    }
    info!(cause = ?cause, frames = status.captured.get(), tracked = status.tracked.get(), "ended");
    End { cause, map, written }
}
