//! Whether a keyframe shows an old place, as a piece of work on a copy, so that it delays no pose.
//!
//! Input: the keyframe's picture, and a copy of the map around the likeliest places ([`Map::part`]). Output: where the keyframe is by
//! their landmarks, if it is there. It takes 30 to 90 ms at 640 x 480 (descriptors by gradients of the keyframe and of each place), so it
//! runs in a thread of its own, beside the mapping worker's, whose adjustments it would hold up. One is under way at a time. In lock-step
//! its result is taken a fixed number of frames later, by waiting.

use crate::features::FrameFeatures;
use crate::geometry::CameraModel;
use crate::geometry::camera_motion::CameraMotion;
use crate::map::{KeyframeId, Map};
use crate::reconstruction::config::ReconstructionConfig;
use crate::reconstruction::measurement::rolling_shutter::Shutter;
use crate::reconstruction::relocalise::Relocaliser;
use crate::reconstruction::relocalise::other_maps::{Sighting, found_in};
use crate::reconstruction::track::association::Bindings;
use crate::reconstruction::track::frame::Frame;
use crate::reconstruction::work::{InlineWorker, Work, Worker};

/// Work to be done. See the module.
pub struct Recognition {
    pub keyframe: KeyframeId,
    /// Keyframes of one place, the likeliest first.
    pub places: Vec<KeyframeId>,
    /// What is there of the map around them.
    pub part: Map,
    /// The keyframe's picture, without tracks.
    pub features: FrameFeatures,
    pub motion: Option<CameraMotion>,
    pub camera: CameraModel,
    pub shutter: Shutter,
    pub outlier_chi2: f64,
    pub config: ReconstructionConfig,
    /// Lent: its buffers, and the descriptors that it remembers.
    pub relocaliser: Box<Relocaliser>,
}

/// What came of it.
pub struct Recognised {
    pub sighting: Option<Sighting>,
    pub relocaliser: Box<Relocaliser>,
}

impl Work for Recognition {
    type Outcome = Recognised;

    fn run(mut self) -> Recognised {
        let sighting = self.find();
        Recognised { sighting, relocaliser: self.relocaliser }
    }
}

impl Recognition {
    /// Bounded by the number of places.
    fn find(&mut self) -> Option<Sighting> {
        self.part.bring_pictures_back();
        let Self { part, camera, features, relocaliser, .. } = self;
        let bindings = Bindings::default();
        let frame = Frame {
            features,
            map: part,
            bindings: &bindings,
            camera,
            config: &self.config,
            before: None,
            was_here: true,
            motion: self.motion,
            shutter: &self.shutter,
            outlier_chi2: self.outlier_chi2,
        };
        let placed = relocaliser.place_among(&frame, &self.places)?;
        found_in(&frame, &relocaliser.tracker, self.keyframe, &placed)
    }
}

/// The one recognition that is under way, and when its result is due.
pub struct Recogniser {
    pub worker: Box<dyn Worker<Recognition>>,
    /// Frame at which it was posted.
    posted: Option<u64>,
    /// Lent while one is under way.
    relocaliser: Option<Box<Relocaliser>>,
    attempts: u64,
}

impl Default for Recogniser {
    fn default() -> Self {
        Self { worker: Box::<InlineWorker<Recognition>>::default(), posted: None, relocaliser: None, attempts: 0 }
    }
}

impl Recogniser {
    pub fn is_busy(&self) -> bool {
        self.posted.is_some()
    }

    /// Number of the next attempt, and what it needs; of one that was given up nothing comes back.
    pub fn lend(&mut self) -> (u64, Box<Relocaliser>) {
        self.attempts += 1;
        (self.attempts, self.relocaliser.take().unwrap_or_default())
    }

    pub fn post(&mut self, work: Recognition, frame: u64) {
        self.worker.post(work);
        self.posted = Some(frame);
    }

    /// Forgets the one under way.
    pub fn discard(&mut self) {
        if self.posted.take().is_some() {
            self.worker.discard();
        }
    }

    /// The result, once it is to be used: with `wait` it is waited for, and not before frame `due_after` after it was posted unless `early`.
    pub fn take(&mut self, frame: u64, due_after: u64, wait: bool, early: bool) -> Option<Option<Sighting>> {
        let posted = self.posted?;
        if wait && !early && frame < posted + due_after {
            return None;
        }
        let Some(Recognised { sighting, relocaliser }) = self.worker.take(wait) else {
            // Waited for in vain: there is no worker any more.
            if wait {
                self.posted = None;
            }
            return None;
        };
        self.posted = None;
        self.relocaliser = Some(relocaliser);
        Some(sighting)
    }
}
