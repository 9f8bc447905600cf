//! The daemon's way in for wheel odometry: from a source or the wire into the queue that the reconstruction step empties.
//!
//! What is not believed is counted (`WheelCounts`) and named in the log, at once and then once a second with a count. Nothing here costs
//! anything while nobody tells of wheels.

use std::sync::Arc;

use tracing::warn;

use crate::frame::monotonic_ns;
use crate::motion::wheel::{WheelFault, WheelMessage, WheelQueue};
use crate::telemetry::RateLimiter;

/// One filler's end of the queue.
#[derive(Debug)]
pub struct WheelIntake {
    queue: Arc<WheelQueue>,
    refused: RateLimiter,
}

impl WheelIntake {
    pub fn new(queue: Arc<WheelQueue>) -> Self {
        Self { queue, refused: RateLimiter::default() }
    }

    /// Takes a message in. `known`: what is wrong with it as its source sees it; `origin`: who tells, for the log.
    pub fn take(&mut self, origin: &str, message: &WheelMessage, known: Option<WheelFault>) {
        let fault = match known {
            Some(fault) => {
                self.queue.counts().refuse(&fault);
                fault
            }
            None => match self.queue.push(message) {
                Ok(()) => return,
                Err(fault) => fault,
            },
        };
        if let Some(messages) = self.refused.event(monotonic_ns()) {
            let (number, fault, reason) = (message.number, fault.name(), fault.to_string());
            warn!(messages, origin, number, fault, reason, "wheel reading not believed");
        }
    }
}
