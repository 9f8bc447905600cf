//! `PREFIX/features`: corners, tracks and matched landmarks of a frame, made only while somebody subscribes.

use crate::map::LandmarkId;
use crate::messages::services::MAX_FEATURES;
use crate::messages::{Feature, FeaturesHeader, NO_LANDMARK, NO_TRACK};

use super::ports::Port;
use super::{FrameStamp, PublishError, convert, count};

/// See module.
#[derive(Debug)]
pub struct FeaturesPublisher {
    pub(super) port: Port<[Feature], FeaturesHeader>,
    pub(super) run_id: u64,
    /// Of the frame under way; as large as a message from the start.
    features: Vec<Feature>,
}

impl FeaturesPublisher {
    pub(super) fn new(port: Port<[Feature], FeaturesHeader>, run_id: u64) -> Self {
        Self { port, run_id, features: Vec::with_capacity(MAX_FEATURES) }
    }

    /// Somebody wants features.
    pub fn is_wanted(&self) -> bool {
        self.port.subscribers() > 0
    }

    /// Sends what was found in a picture, if somebody subscribes: places of landmarks, then tracks (id, place, age in frames). Allocates nothing
    /// of its own.
    pub fn publish(
        &mut self,
        matches: impl Iterator<Item = (LandmarkId, [f32; 2])>,
        tracks: impl Iterator<Item = (u64, [f32; 2], u32)>,
        (width, height): (usize, usize),
        stamp: &FrameStamp,
    ) -> Result<bool, PublishError> {
        if !self.is_wanted() {
            return Ok(false);
        }
        self.features.clear();
        let mut total = 0;
        let matches =
            matches.map(|(landmark, position)| Feature { track: NO_TRACK, position, age: 0, landmark: landmark.0 });
        let tracks = tracks.map(|(track, position, age)| Feature { track, position, age, landmark: NO_LANDMARK });
        for feature in matches.chain(tracks) {
            total += 1;
            if self.features.len() < MAX_FEATURES {
                self.features.push(feature);
            }
        }
        let header = FeaturesHeader {
            run_id: self.run_id,
            sequence: stamp.sequence,
            timestamp_ns: stamp.timestamp_ns,
            arrival_ns: stamp.arrival_ns,
            width: count(width),
            height: count(height),
            count: count(self.features.len()),
            total: count(total),
            clock: convert::clock(stamp.clock),
            reserved: [0; 7],
        };
        self.port.send_copy(header, &self.features)?;
        Ok(true)
    }
}
