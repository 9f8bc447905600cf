//! What is logged of frames that the wheels alone have placed: from when to when, and what it came to.

use tracing::{info, warn};

use crate::reconstruction::{PoseEstimate, Reckoned, Reconstruction};

/// What was told last.
#[derive(Debug, Default)]
pub struct BlindLog {
    reckoned: Option<Reckoned>,
    starts: u64,
}

impl BlindLog {
    /// After each frame; `state`: its state's name.
    pub fn follow(&mut self, reconstruction: &Reconstruction, e: &PoseEstimate, state: &'static str) {
        let (sequence, timestamp_ns, map) = (e.sequence, e.timestamp_ns, e.map.0);
        let now = reconstruction.reckoned();
        match (&self.reckoned, &now) {
            (None, Some(_)) => {
                warn!(sequence, timestamp_ns, map, "dead reckoning: the picture is lost, the wheels go on")
            }
            (Some(last), None) => {
                let Reckoned { span_s, way_m, sigma_m, sigma_rad, .. } = *last;
                info!(sequence, timestamp_ns, map, state, span_s, way_m, sigma_m, sigma_rad, "dead reckoning ended");
            }
            _ => {}
        }
        let starts = reconstruction.counters().blind_starts;
        if starts != self.starts
            && let Some(Reckoned { sigma_m, sigma_rad, .. }) = self.reckoned
        {
            warn!(sequence, timestamp_ns, map, sigma_m, sigma_rad, "map goes on from dead reckoning");
        }
        (self.reckoned, self.starts) = (now, starts);
    }
}
