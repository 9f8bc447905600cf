//! What is logged of the floor: that it tells the scale, and why it does not.

use tracing::{debug, info, warn};

use crate::motion::floor::{NoFloor, Plane, ScaleConfig, roll_pitch};
use crate::reconstruction::{PoseEstimate, Reconstruction};

/// Keyframes in a row without a floor, where it is looked for, after which that is worth a warning: some 10 m of a way.
const PATIENCE: u32 = 60;

/// What was logged last.
#[derive(Debug, Default)]
pub struct FloorLog {
    last: Option<Plane>,
    without: u32,
}

impl FloorLog {
    /// After each frame: the floor when it is found first, has become surer by a fifth, or its height has moved by two sigmas.
    pub fn follow(&mut self, config: &ScaleConfig, reconstruction: &Reconstruction, e: &PoseEstimate) {
        let (sequence, timestamp_ns, map) = (e.sequence, e.timestamp_ns, e.map.0);
        let told = reconstruction.floor().copied();
        let news = match (&told, &self.last) {
            (Some(now), Some(last)) => {
                now.sigma < 0.8 * last.sigma || (now.height / last.height).ln().abs() > 2.0 * last.sigma
            }
            (now, _) => now.is_some(),
        };
        if let Some(now) = told.filter(|_| news) {
            let (roll, pitch) = roll_pitch(&now.up_camera);
            info!(
                sequence,
                timestamp_ns,
                map,
                metres_per_unit = config.camera_height_m / now.height,
                sigma = now.sigma,
                roll_deg = roll.to_degrees(),
                pitch_deg = pitch.to_degrees(),
                landmarks = now.landmarks,
                "scale by the floor"
            );
        }
        if news || told.is_none() {
            self.last = told;
        }
        if e.keyframe {
            self.count(reconstruction.no_floor(), sequence, timestamp_ns, map);
        }
    }

    fn count(&mut self, refused: Option<NoFloor>, sequence: u64, timestamp_ns: i64, map: u32) {
        let Some(reason) = refused else {
            self.without = 0;
            return;
        };
        debug!(sequence, map, ?reason, "no floor");
        self.without += 1;
        if self.without == PATIENCE {
            let keyframes = self.without;
            warn!(sequence, timestamp_ns, map, keyframes, ?reason, "floor not found");
        }
    }
}
